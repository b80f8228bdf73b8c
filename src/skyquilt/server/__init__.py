"""A map server for a growing or finished run, for browsers, QGIS and other programs. It never
computes poses.
"""
