"""The report of a finished run: one self-contained HTML page."""

from skyquilt.report.input import CameraResiduals, ReportInput, SeamMark, Shot
from skyquilt.report.page import build_report, write_report

__all__ = ["CameraResiduals", "ReportInput", "SeamMark", "Shot", "build_report", "write_report"]
