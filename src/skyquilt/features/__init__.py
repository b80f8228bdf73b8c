"""Stage: Photo pixels -> Features."""
