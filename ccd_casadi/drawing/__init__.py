"""What a page shows, as plain data, and how it is painted: nothing here computes."""
