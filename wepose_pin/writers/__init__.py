"""Writers: one file a format."""

from __future__ import annotations

from .result import load_result, select_pose
from .session import write_session

__all__ = ["load_result", "select_pose", "write_session"]
