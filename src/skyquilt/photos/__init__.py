"""Stage: files -> Photo."""
