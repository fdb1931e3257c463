"""The HTML reports: one file each, opens offline, prints on A4."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Loaded on first use: tracking does not need the calibration's imports.
_WHERE = {
    "render_calibration_report": "calibration",
    "render_track_report": "track",
    "write_calibration_page": "calibration",
    "write_track_pages": "pages",
}
__all__ = [
    "render_calibration_report",
    "render_track_report",
    "write_calibration_page",
    "write_track_pages",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)
