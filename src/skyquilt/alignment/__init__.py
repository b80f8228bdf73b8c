"""Stage: Links -> poses."""
