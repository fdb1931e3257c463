"""Writers: one file a format."""

from __future__ import annotations

from .result import read_result, write_result
from .session import write_session

__all__ = ["read_result", "write_result", "write_session"]
