"""The filters as they are compared: ours, those of others, and how each was set."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..filters import METHODS, run_filter
from ..noise import SensorNoise


class Contender(NamedTuple):
    """A filter with its settings.

    `orient` takes gyro_S (n, 3) [rad/s], accel_S (n, 3) [m/s²], rate_hz and the still phase's noise and gives quat_WS
    (n, 4) xyzw, in a world of its own with z up. `method`: the key of `METHODS` where it is ours with its defaults.
    """

    label: str
    orient: Callable[[np.ndarray, np.ndarray, float, SensorNoise], np.ndarray]
    method: str | None = None


def contenders(setting: str) -> list[Contender]:
    """Who takes part in an experiment of this `setting`: "simulated 100 Hz", "simulated 1 kHz" or "real"."""
    return [_ours(method) for method in METHODS]


def _ours(method: str) -> Contender:
    def orient(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
        return run_filter(gyro_S, accel_S, rate_hz, noise, method, measured_start=True).quat_WS

    return Contender(method, orient, method)
