"""`Source`: it is opened, read in the order of arrival, and closed."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from ...recording.arrivals import Samples
from .waiting import Waiting


class Source(ABC):
    """Samples of several sensors as they come.

    Attributes
    ----------
    sensors : segments, in the order in which results name them
    rate_hz : nominal samples a second of each; None where it has to be measured
    problems : problem → count of what was dropped so far ("bad checksums": 3)
    measures_orientations : whether it has orientations in place of rates and specific forces
    """

    measures_orientations = False

    def __init__(self, sensors: Iterable[str] = (), rate_hz: float | None = None) -> None:
        self.sensors, self.rate_hz = tuple(sensors), rate_hz
        self.problems: dict[str, int] = Counter()

    @property
    def orientations(self) -> Mapping[str, bool]:
        """Sensors whose samples are measured orientations (`pack_orientations`) → whether these are the segment's own.

        Then they are in one world; else they are the sensor's, in a world of its own.
        """
        return {}

    @property
    def batteries(self) -> Mapping[str, float]:
        """Sensor → share of its charge, 0 to 1, of those that have said it."""
        return {}

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:  # noqa: ARG002
        """Describe what is awaited from these sensors, without any from all, and where; empty where nothing is."""
        return ""

    def explain_unit(self, key: str, unit: str) -> str:
        """What to do where samples are in `unit`; `key` as in a session's [data], ``gyro_unit`` or ``accel_unit``."""
        return f"The source must give rad/s and m/s^2, not {unit} ({key})"

    @abstractmethod
    def open(self, waiting: Waiting | None = None) -> None:
        """Connect, or bind, and wait for what is not there yet: with `waiting` until it returns False.

        Raises `WeposeError` with one line on what is missing, without `waiting` after some seconds.
        """

    @abstractmethod
    def read(self, timeout_s: float) -> list[Samples] | None:
        """Samples since the last call, in the order of arrival; [] after `timeout_s` without any; None at the end."""

    def clock(self) -> float:
        """Now [s], on the clock of the samples' times."""
        return time.monotonic()

    @abstractmethod
    def close(self) -> None:
        """Disconnect and free what `open` took. May be called twice."""
