"""The protocol of a source: it is opened, read in the order of arrival, and closed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from ...recording.arrivals import Samples
from .waiting import Waiting


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

    @property
    def orientations(self) -> Mapping[str, bool]:
        """Sensors whose samples are measured orientations (`pack_orientations`) → whether these are the segment's own.

        Then they are in one world; else they are the sensor's, in a world of its own.
        """
        ...

    def open(self, waiting: Waiting | None = None) -> None:
        """Connect, or bind, and wait for what is not there yet: with `waiting` until it returns False.

        Raises `WeposeError` with one line on what is missing, without `waiting` after some seconds.
        """
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


@runtime_checkable
class ReportsBattery(Protocol):
    """A source whose sensors say how much charge they have."""

    @property
    def batteries(self) -> Mapping[str, float]:
        """Sensor → share of its charge, 0 to 1, of those that have said it."""
        ...


@runtime_checkable
class ReportsAddress(Protocol):
    """A source that knows where it waits for what."""

    @property
    def awaited(self) -> str:
        """What is waited for, and at which address."""
        ...


def find_awaited(source: Source) -> str:
    """What a source waits for, and where; empty where it does not know."""
    return source.awaited if isinstance(source, ReportsAddress) else ""


def find_batteries(source: Source) -> Mapping[str, float]:
    """Sensor → share of its charge, 0 to 1; empty where the source does not know."""
    return source.batteries if isinstance(source, ReportsBattery) else {}
