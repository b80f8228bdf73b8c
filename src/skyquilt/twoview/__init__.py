"""Stage: Matches -> Link or RejectedLink."""
