"""Samples that no body sensor gives are dropped where they come in."""

from __future__ import annotations

import numpy as np

from ...recording.arrivals import Samples
from ...recording.limits import HIGHEST_ACCEL, HIGHEST_RATE

# Seconds since 1970 have ten digits; larger times are in another unit, or damaged.
MAX_TIME = 1e10  # [s]
_MAX_VALUES = np.repeat([HIGHEST_RATE, HIGHEST_ACCEL], 3)

IMPLAUSIBLE = "samples with values that no body sensor gives"


def find_plausible(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(m,) bool: time (m,) [s] and values (m, 6) [rad/s, m/s²] of a sample are finite and not too large."""
    return (np.abs(time) < MAX_TIME) & (np.abs(values) <= _MAX_VALUES).all(axis=1)  # a NaN is neither


def keep_plausible(sensor: str, time: np.ndarray, values: np.ndarray) -> tuple[list[Samples], int]:
    """The plausible of these samples, as one `Samples` or none; and how many are dropped."""
    plausible = find_plausible(time, values)
    dropped = len(time) - int(plausible.sum())
    if dropped:
        time, values = time[plausible], values[plausible]
    return [Samples(sensor, time, values[:, :3], values[:, 3:])] if len(time) else [], dropped
