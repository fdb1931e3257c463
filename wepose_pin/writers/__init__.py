"""Writers: one file a format; folders are written whole or not at all."""

from __future__ import annotations

from .folder import whole_folder
from .result import read_result, write_result
from .session import write_session

__all__ = ["read_result", "whole_folder", "write_result", "write_session"]
