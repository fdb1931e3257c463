"""What the loop hands to whoever shows or sends it: the newest pose, and how each sensor is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class LivePose(NamedTuple):
    """One moment of the person; arrays belong to the receiver."""

    time: float  # [s] on the source's clock
    quat_WL: np.ndarray  # (k, 4) xyzw, in the order of `Stage.segments`
    points: np.ndarray  # (p, 3) [m] in W, in the order of `Stage.points`
    std: np.ndarray  # (k,) [rad] one standard deviation of an axis; NaN where the filter has none
    lost: np.ndarray  # (k,) bool: its sensor has been silent for longer than the loop waits, or is frozen
    latency: float  # [s] from the newest sample's time to this pose


class Stage(NamedTuple):
    """What stays the same from the start on."""

    segments: tuple[str, ...]
    points: tuple[str, ...]
    rate_hz: float


class SensorStatus(NamedTuple):
    """How one sensor is, a few times a second."""

    segment: str
    rate_hz: float  # samples a second over the last second, on the source's clock
    lost: bool  # silent for longer than the loop waits, or frozen
    static: bool
    gyro_bias: tuple[float, float, float]  # [rad/s]
    heading_std: float  # [rad]; NaN where the filter has no covariance
    heading_age: float  # [s] since its heading was last set: at the start, or by a reset
    missing: int  # ticks that it had no sample for
    late: int  # samples that came after their tick had gone
    duplicate: int
    frozen: bool  # it repeats itself bit for bit, and has noise


class Status(NamedTuple):
    """What the person and who stands beside should read, a few times a second."""

    state: str  # "waiting" for sensors, "hold" the start pose, "moved" in it and must hold again, "ready", "ended"
    message: str  # the same in a sentence, for the person
    progress: float  # 0 to 1 of the start pose; 1 when ready
    time: float  # [s] on the source's clock
    sensors: tuple[SensorStatus, ...]
    latency_ms: tuple[float, float]  # p50, p99 of the last seconds, from the newest sample to the pose
    recorded_s: float  # [s] in the file of --record; 0 without one
    problems: dict[str, int]  # what the source counted: bytes skipped, packets that were none, …
