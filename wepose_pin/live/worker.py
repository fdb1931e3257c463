"""`Worker`: one calculation at a time in a thread of its own, so that samples are taken meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from ..errors import WeposeError

T = TypeVar("T")


class Worker(Generic[T]):
    """Runs a calculation in a thread, and hands out its result or its `WeposeError`; other errors are raised."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._outcome: list[T | BaseException] = []

    @property
    def busy(self) -> bool:
        return self._thread is not None

    def start(self, compute: Callable[[], T]) -> None:
        """Begin a calculation; the result of an earlier one is forgotten."""
        outcome: list[T | BaseException] = []

        def run() -> None:
            try:
                outcome.append(compute())
            except BaseException as error:
                outcome.append(error)

        self._outcome = outcome
        self._thread = threading.Thread(target=run, name="calibration", daemon=True)
        self._thread.start()

    def take(self) -> T | WeposeError | None:
        """The result of the calculation, once; None: there is none, or it runs still."""
        if not self._outcome:
            return None
        outcome, self._thread, self._outcome = self._outcome[0], None, []
        if isinstance(outcome, BaseException) and not isinstance(outcome, WeposeError):
            raise outcome
        return outcome

    def forget(self) -> None:
        """Drop the result of what runs."""
        self._thread, self._outcome = None, []
