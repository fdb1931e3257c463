"""Finds the body models and calibration files: the checkout's folders where there is a checkout, else the wheel's."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def asset(folder: str, name: str) -> Path:
    """Path of `name` in ``urdf/`` or ``calibration/``."""
    for root in (_PACKAGE.parent, _PACKAGE / "_assets"):
        path = root / folder / name
        if path.is_file():
            return path
    raise FileNotFoundError(f"wepose_pin was installed without {folder}/{name}; install it again")
