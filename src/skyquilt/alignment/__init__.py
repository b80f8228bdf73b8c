"""Processing stage from links to poses."""
