"""Units of what sensors send, checked before anything is tracked."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence

import numpy as np

from ..diagnostics import Diagnostic
from ..errors import BadData, WrongUnit
from ..recording import Recording
from ..recording.arrivals import Samples
from ..recording.plausibility import check_signals, find_unseen_rate
from .losses import measure_step
from .sources.base import Source
from .state import join_names

WINDOW_S = 4.0  # [s] newest samples of a sensor that are compared
LEAST_SHARE = 0.9  # of that, from which on they are


class RateWatch:
    """Compares each sensor's rates with the direction of gravity in it, over the newest seconds."""

    def __init__(self) -> None:
        self._recent: dict[str, deque[Samples]] = {}

    def push(self, samples: Sequence[Samples], orientations: Collection[str]) -> None:
        """Add samples of any sensors; those with measured orientations have no rates."""
        for chunk in samples:
            if chunk.sensor in orientations or not len(chunk.time):
                continue
            recent = self._recent.setdefault(chunk.sensor, deque())
            recent.append(chunk)
            while recent[0].time[-1] < recent[-1].time[-1] - WINDOW_S:
                recent.popleft()

    def describe(self, source: Source) -> str:
        """Describe the sensors whose rates contradict gravity, and what to do; empty: there is none."""
        rates = {}
        for sensor, recent in self._recent.items():
            time_s, gyro_S, accel_S = (np.concatenate(column) for column in tuple(zip(*recent, strict=True))[1:])
            step_s = measure_step(time_s)
            if step_s and time_s[-1] - time_s[0] > LEAST_SHARE * WINDOW_S:
                rate = find_unseen_rate(gyro_S, accel_S, 1.0 / step_s)
                if math.isfinite(rate):
                    rates[sensor] = rate
        if not rates:
            return ""
        remedy = source.explain_unit("gyro_unit", "deg/s")
        rate = max(rates.values())
        return f"{join_names(list(rates))}: rates of {rate:.2g} rad/s while gravity does not turn: deg/s? {remedy}."


def check_units(recording: Recording, source: Source) -> tuple[Diagnostic, ...]:
    """Check the sensors' values as those of a file, and return the diagnostics.

    Raises
    ------
    BadData
        Values of another unit; the text says how the source states it.
    """
    try:
        return check_signals(recording)
    except WrongUnit as error:
        raise BadData(f"{error.finding}: {error.unit}? {source.explain_unit(error.key, error.unit)}.") from None
