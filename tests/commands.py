"""The command line as a user types it, in this process."""

from __future__ import annotations

import pytest

from wepose_pin.cli import main


def run(*words: object) -> int:
    """The exit code of ``wepose`` with these words."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)
