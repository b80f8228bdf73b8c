"""Looks at a growing or finished run: a map server for browsers, QGIS and other programs. It never
computes poses.
"""
