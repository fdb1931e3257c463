"""Waiting for senders: for a time, or for ever, with a sentence on what is awaited and where."""

from __future__ import annotations

import time
from collections.abc import Callable

from ...errors import BadSource

# Called a few times a second with what is awaited and where; False: no longer.
Waiting = Callable[[str], bool]

POLL_S = 0.2  # [s]


def wait_for(
    is_found: Callable[[float], bool], describe: Callable[[], str], wait_s: float, waiting: Waiting | None
) -> bool:
    """Wait until `is_found`, called with the seconds that it may take; with `waiting` until that returns False.

    Raises
    ------
    BadSource
        Without `waiting` it is not found in `wait_s` [s].
    """
    deadline = time.monotonic() + wait_s
    while not is_found(POLL_S):
        if waiting is not None:
            if not waiting(f"Waiting for {describe()}."):
                return False
        elif time.monotonic() >= deadline:
            raise BadSource(f"nothing came within {wait_s:g} s from {describe()}")
    return True
