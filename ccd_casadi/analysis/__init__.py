"""What a finished loop does, over frequency and over time, whatever kind of design it is of."""
