"""What no body sensor gives is thrown away at the door."""

from __future__ import annotations

import numpy as np

from ...recording.limits import HIGHEST_ACCEL, HIGHEST_RATE

# Seconds since 1970 have ten digits; what has more is in another unit, or damaged.
MOST_TIME = 1e10  # [s]
_MOST = np.repeat([HIGHEST_RATE, HIGHEST_ACCEL], 3)

UNSOUND = "samples with values that no body sensor gives"


def sound(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Which samples (m,) can be, of their time (m,) [s] and values (m, 6) [rad/s, m/s²]: finite, and not too large."""
    return (np.abs(time) < MOST_TIME) & (np.abs(values) <= _MOST).all(axis=1)  # a NaN is neither
