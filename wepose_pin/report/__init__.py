"""The HTML reports: one file each, opens offline, prints on A4."""

from .calibration import calibration_report, unsaid

__all__ = ["calibration_report", "unsaid"]
