"""Stage: poses and tie points -> heights."""
