"""A finished run, opened again: its layers, poses and rasters, and files of any part of it."""
