"""Stage: a finished run -> one self-contained page."""
