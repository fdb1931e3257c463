"""Writers: our own folders, and the formats of other programs."""

from .result import load_result, select_pose, write_session

__all__ = ["load_result", "select_pose", "write_session"]
