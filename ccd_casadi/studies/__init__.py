"""What one command computes: methods side by side, other back ends, plants that exist."""
