"""Readers: one file a format, each gives a checked `Recording`."""

from __future__ import annotations

from .session import iter_session, load_session

__all__ = ["iter_session", "load_session"]
