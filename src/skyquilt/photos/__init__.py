"""Stage: files -> Photo.

`survey.read_survey` reads a folder, `read.read_photo` one file, `pixels.read_color` and `read_gray`
its pixels, `gcp.read_gcp_list` control points; `contradictions.contradictions` reports where
metadata disagree with each other.
"""
