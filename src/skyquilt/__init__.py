"""Skyquilt: drone photos, visible and thermal, to a georeferenced, orthorectified mosaic."""

__version__ = "0.1.0"
