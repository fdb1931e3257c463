"""Ctrl-C and SIGTERM: a command ends with what it has written whole, or nothing."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_stopped: list[int] = []


def _stop(number: int, _frame: Any) -> None:
    _stopped.append(number)
    raise KeyboardInterrupt


def catch_signals(handler: Any = _stop) -> None:
    """From here on both raise `KeyboardInterrupt` and are remembered, or are treated as by another handler."""
    for number in _SIGNALS:
        signal.signal(number, handler)


def is_stopped() -> bool:
    """Whether a signal came; a library may have turned what it raised into an error of its own."""
    return bool(_stopped)


def check_stopped() -> None:
    """Raise `KeyboardInterrupt` where a signal came and a library has swallowed what it raised."""
    if _stopped:
        raise KeyboardInterrupt


def describe_written() -> str:
    """What a command that ends early has written all the same, whole."""
    written = getattr(sys.modules.get("wepose_pin.documents"), "written", ())
    folders = [str(folder) for folder in written if folder.exists()]
    return f"{', '.join(folders)} was written before" if folders else "nothing was written"


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Whether a signal asked to stop. It interrupts nothing, unless nobody has looked yet or it comes twice."""
    requests: list[int] = []
    looked = False

    def ask(number: int, frame: Any) -> None:
        if requests or not looked:
            _stop(number, frame)
        requests.append(number)

    def is_asked() -> bool:
        nonlocal looked
        looked = True
        return bool(requests or _stopped)

    before = {number: signal.signal(number, ask) for number in _SIGNALS}
    try:
        yield is_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
