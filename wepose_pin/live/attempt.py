"""`Attempt`: the recording of one guided calibration, in its file and in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BadData
from ..readers.live_log import Markers, build_recording
from ..recording import Recording, check_recording
from ..recording.arrivals import Samples, Ticks
from ..writers.live_log import LiveLog
from .assignment import AssignedSource
from .ticks import TickStream


class Attempt:
    """Records raw samples with the phases of a protocol.

    The file gives the same samples and phases again, so that a calibration of it has the same numbers.

    Parameters
    ----------
    source : names the sensors by their segments
    header : of the recording, as `SensorSetup.header` with the method
    """

    def __init__(self, path: Path, source: AssignedSource, header: Mapping[str, Any]) -> None:
        self.log, self._source = LiveLog(path, header), source
        self.stream = TickStream(source.sensors, source.rate_hz, log=self.log, orientations=source.orientations)
        self._header, self._markers = dict(header), Markers()
        self._ticks: list[Ticks] = []

    @property
    def path(self) -> Path:
        return self.log.path

    @property
    def has_begun(self) -> bool:
        """Whether there are ticks: all sensors have sent."""
        return self.stream.synchronizer is not None

    @property
    def rate_hz(self) -> float:
        """Of the ticks.

        Raises
        ------
        BadData
            There are none yet.
        """
        if self.stream.synchronizer is None:
            raise BadData(f"{self.path}: has no samples of all sensors yet")
        return self.stream.synchronizer.rate_hz

    @property
    def newest(self) -> float:
        """Time [s] of the newest tick; 0 before the first."""
        return float(self._ticks[-1].time[-1]) if self._ticks else 0.0

    @property
    def segments(self) -> list[str]:
        """The segment of each sensor, in the order of the ticks' columns."""
        return [self._markers.segments.get(name, name) for name in self._source.sensors]

    @property
    def measured(self) -> np.ndarray:
        """(k,) bool: the sensors whose samples are orientations."""
        return np.array([name in self._source.orientations for name in self._source.sensors], dtype=np.bool_)

    def push(self, samples: Sequence[Samples]) -> Iterator[Ticks]:
        """Record samples of the source, and iterate over the ticks that they complete."""
        for ticks in self.stream.push(self._source.rename(samples)):
            if len(ticks.time):
                self._ticks.append(ticks)
                yield ticks

    def mark(self, kind: str, **values: Any) -> None:
        """Record an event of `Markers`."""
        self._markers.add(kind, values)
        self.log.event(kind, **values)

    def exchange(self, moved: Mapping[str, str]) -> None:
        """Move sensors from segment to segment."""
        now = zip(self._source.sensors, self.segments, strict=True)
        self.mark("assign", segments={name: moved.get(segment, segment) for name, segment in now})

    def measured_s(self, phase: str) -> float:
        """Duration [s] of a phase so far."""
        return sum(last - first for first, last in self._phases().get(phase, ()))

    def recording(self) -> Recording:
        """The recording so far, as a reader of the file gets it."""
        header = self._header | {"sensors": self.segments, "phases": self._phases()}
        return check_recording(build_recording(header, self.rate_hz, self._ticks, None, self.path))

    def close(self) -> None:
        self.log.close()

    def _phases(self) -> dict[str, Any]:
        return self._markers.phases(float(self._ticks[0].time[0]), self.newest) if self._ticks else {}
