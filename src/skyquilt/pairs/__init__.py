"""Stage: Photos -> candidate pairs."""
