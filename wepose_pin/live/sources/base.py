"""The protocol of a source: it is opened, read in the order of arrival, and closed."""

from __future__ import annotations

from typing import Protocol

from ...recording.arrivals import Samples


class Source(Protocol):
    """Samples of several sensors as they come.

    Attributes
    ----------
    sensors : segments, in the order in which results name them
    rate_hz : nominal samples a second of each; None where it has to be measured
    problems : problem → count of what was dropped so far ("bad checksums": 3)
    """

    sensors: tuple[str, ...]
    rate_hz: float | None
    problems: dict[str, int]

    def open(self) -> None:
        """Connect, or bind; raises `WeposeError` with one line on what is missing."""
        ...

    def read(self, timeout_s: float) -> list[Samples] | None:
        """Samples since the last call, in the order of arrival; [] after `timeout_s` without any; None at the end."""
        ...

    def clock(self) -> float:
        """Now [s], on the clock of the samples' times."""
        ...

    def close(self) -> None:
        """Disconnect and free what `open` took. May be called twice."""
        ...
