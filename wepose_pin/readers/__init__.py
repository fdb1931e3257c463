"""Readers: one file a format, each gives a checked `Recording`."""

from __future__ import annotations

from .session import load_session

__all__ = ["load_session"]
