"""Stage: Features x 2 -> Matches."""
