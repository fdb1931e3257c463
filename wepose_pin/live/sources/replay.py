"""A recording, replayed as its sensors would deliver it."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import BadOption
from ...readers import load_session
from ...recording import OrientationSensor, Recording
from ...recording.arrivals import Samples, list_numbers
from . import Source, SourceKind, SourceOptions

BLOCK = 64  # samples that come together as fast as possible
MIN_SLEEP_S = 0.0005  # up to 1 kHz every sample comes when it is due, faster ones come together


def open_spec(rest: str, options: SourceOptions) -> ReplaySource:
    """The source of ``replay:PATH``."""
    try:
        speed = math.inf if options.speed == "max" else float(options.speed)
    except ValueError:
        speed = math.nan
    if not speed > 0.0:
        raise BadOption(f"speed: '{options.speed}'; a positive number, 1.0 is the recording's own, or max")
    recording = load_session(Path(rest), gaps=True)
    chosen = options.choose(recording.sensors, "sensor")
    return ReplaySource(replace(recording, sensors={name: recording.sensors[name] for name in chosen}), speed)


class ReplaySource(Source):
    """A recording at `speed` times its own pace.

    Samples in marked gaps are left out, as of a silent sensor. Samples that become due between two reads come together;
    as fast as possible, `speed` ``math.inf``, `BLOCK` of every sensor.
    """

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        super().__init__(recording.sensors, recording.rate_hz)
        self.recording, self.begin = recording, float(recording.time[0])
        self._numbers = {name: list_numbers(sensor) for name, sensor in recording.sensors.items()}
        # Samples are taken as evenly spaced: the jitter of the clock is no motion, and every sample has its own tick.
        self._time = recording.time[0] + np.arange(len(recording)) / recording.rate_hz
        self._speed, self._next, self._begin = speed, 0, 0.0

    @property
    def orientations(self) -> dict[str, bool]:
        sensors = self.recording.sensors.items()
        return {name: each.aligned for name, each in sensors if isinstance(each, OrientationSensor)}

    def open(self) -> None:
        self._next, self._begin = 0, time.monotonic()

    def clock(self) -> float:
        if math.isinf(self._speed):
            return float(self._time[max(self._next - 1, 0)])
        return float(self._time[0]) + (time.monotonic() - self._begin) * self._speed

    def read(self, timeout_s: float) -> list[Samples] | None:
        """Samples that became due since the last call, one `Samples` a sensor; None after the last."""
        first, last = self._next, self._next + BLOCK
        if first >= len(self._time):
            return None
        deadline = time.monotonic() + timeout_s
        while (
            not math.isinf(self._speed) and (last := int(np.searchsorted(self._time, self.clock(), "right"))) <= first
        ):
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return []
            due_s = (float(self._time[first]) - self.clock()) / self._speed
            time.sleep(min(max(due_s, MIN_SLEEP_S), left_s))
        self._next = min(last, len(self._time))
        samples = []
        for name, sensor in self.recording.sensors.items():
            rows: slice | np.ndarray = slice(first, self._next)
            if sensor.gap is not None and sensor.gap[rows].any():
                rows = first + np.flatnonzero(~sensor.gap[rows])
            gyro_S, accel_S = self._numbers[name]
            samples.append(Samples(name, self._time[rows], gyro_S[rows], accel_S[rows]))
        return [each for each in samples if len(each.time)]


KIND = SourceKind("replay:PATH", open_spec)
