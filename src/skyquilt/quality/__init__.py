"""Measures of the quality of a map."""
