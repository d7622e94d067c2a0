"""What reproduces a paper: its own method, the sequential design, and what they are set beside."""
