"""Fuzzing of everything that reads what comes from outside. See docs/security.md."""
