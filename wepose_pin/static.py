"""The static-phase detector: when a sensor counts as lying still (Lisini Baldi 2019, conditions (1) to (4))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from .arguments import NonNegative, Range
from .errors import BadData
from .noise import SensorNoise
from .so3 import inlined, kernel

# A sample is gyro (3), accel/g (3) and the norm of accel/g. The sums are of its differences from an anchor: those
# themselves, their products gyro xx xy xz yy yz zz, the same of accel, and the norm's square.
_SIGNALS = 7
_SUMS = 20
_UPPER = np.triu_indices(3)


@dataclass(frozen=True)
class StaticTest:
    """When a sensor counts as still; the defaults are the paper's; it leaves the window open.

    The covariance conditions hold as matrices: ``alpha * Σ̂ − S`` is positive semidefinite.
    """

    window_s: Annotated[float, Range(0.0, closed=False, high=60.0)] = 0.5  # [s] W
    alpha: NonNegative = 2.0  # (1) gyro covariance against the still one
    beta: NonNegative = 2.0  # (2) accel/g covariance against the still one
    gamma1: NonNegative = 0.01  # (3) |mean ‖accel/g‖ − 1| at most
    gamma2: NonNegative = 0.01  # (4) variance of ‖accel/g‖ at most

    def samples(self, rate_hz: float) -> int:
        """N, the window in samples (at least 4: a covariance of three axes needs them)."""
        return max(4, round(self.window_s * rate_hz))


class StaticState(NamedTuple):
    """What the detector remembers of k sensors, a row each; a window has N samples."""

    block: np.ndarray  # (k, N, 7) samples of the current block, then of the one before
    tail: np.ndarray  # (k, N, 20) sums of the block before from each of its samples to its end
    head: np.ndarray  # (k, 20) sums of the current block so far
    anchor: np.ndarray  # (k, 7) what the differences are taken from: the last sample of the block before
    counts: np.ndarray  # (k, 2) samples in the current block; whether there is a block before it
    limits: np.ndarray  # (k, 15) right-hand sides of (1), (2) times N − 1, of (3), of (4) times N − 1; 1/gravity


class StaticDetector:
    """Says for each sample whether the window that ends there is static.

    `update` for one sample and `run` for an array go through the same compiled code; a run cut in two gives the same
    answer to the last bit. Until the first window is full the answer is no, and so it is while a sample that is no
    number lies in the window.

    The cost per sample does not grow with the window: the window is the sums of the current block of N samples and
    those of the rest of the block before, which are made backwards once a block. Nothing is ever subtracted from a sum,
    and the differences summed are from a sample within the window, so that (mean − anchor)² is at most N − 1 variances
    of the window itself: a window at rest is as precise after 1e8 samples of any motion as in the first second.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, test: StaticTest | None = None) -> None:
        self.test = test or StaticTest()
        self.state = static_state([noise], rate_hz, self.test)
        self._one = np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1, dtype=np.bool_)

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`static` (n,) bool for `gyro_S` (n, 3) [rad/s] and `accel_S` (n, 3) [m/s²]."""
        if len(gyro_S) != len(accel_S):  # the compiled step would read beyond an array's end
            raise BadData(f"{len(gyro_S)} rows of gyro_S and {len(accel_S)} of accel_S: not as many each")
        gyro, accel = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        static = np.empty(len(gyro), dtype=np.bool_)
        _run(*self.state, gyro, accel, static)
        return static

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> bool:
        """Whether the window that ends with this sample, `gyro_S` (3,), `accel_S` (3,), is static."""
        gyro, accel, static = self._one
        gyro[0], accel[0] = gyro_S, accel_S
        _run(*self.state, gyro, accel, static)
        return bool(static[0])


def static_state(noises: list[SensorNoise], rate_hz: float, test: StaticTest) -> StaticState:
    """The state of k detectors before their first sample, for `static_step`."""
    k, n = len(noises), test.samples(rate_hz)
    limits = np.empty((k, 15))
    for row, noise in zip(limits, noises, strict=True):
        row[:6] = (n - 1) * test.alpha * noise.gyro_cov[_UPPER]
        row[6:12] = (n - 1) * test.beta * noise.accel_cov[_UPPER]
        row[12:] = test.gamma1, (n - 1) * test.gamma2, 1.0 / noise.gravity
    return StaticState(
        block=np.zeros((k, n, _SIGNALS)),
        tail=np.zeros((k, n, _SUMS)),
        head=np.zeros((k, _SUMS)),
        anchor=np.zeros((k, _SIGNALS)),
        counts=np.zeros((k, 2), dtype=np.int64),
        limits=limits,
    )


@inlined
def _differences(block, at, anchor):  # type: ignore[no-untyped-def]
    """Sample `at` of the block from the anchor, as seven floats."""
    return (
        block[at, 0] - anchor[0],
        block[at, 1] - anchor[1],
        block[at, 2] - anchor[2],
        block[at, 3] - anchor[3],
        block[at, 4] - anchor[4],
        block[at, 5] - anchor[5],
        block[at, 6] - anchor[6],
    )


@inlined
def _add(head, block, at, anchor):  # type: ignore[no-untyped-def]
    """Take sample `at` of the block into the sums `head`."""
    gx, gy, gz, ax, ay, az, norm = _differences(block, at, anchor)
    head[0] += gx
    head[1] += gy
    head[2] += gz
    head[3] += ax
    head[4] += ay
    head[5] += az
    head[6] += norm
    head[7] += gx * gx
    head[8] += gx * gy
    head[9] += gx * gz
    head[10] += gy * gy
    head[11] += gy * gz
    head[12] += gz * gz
    head[13] += ax * ax
    head[14] += ax * ay
    head[15] += ax * az
    head[16] += ay * ay
    head[17] += ay * az
    head[18] += az * az
    head[19] += norm * norm


@inlined
def _sum_up(tail, block, anchor):  # type: ignore[no-untyped-def]
    """The sums from each sample of the block to its end."""
    n = len(block)
    for at in range(n):
        gx, gy, gz, ax, ay, az, norm = _differences(block, at, anchor)
        tail[at, 0] = gx
        tail[at, 1] = gy
        tail[at, 2] = gz
        tail[at, 3] = ax
        tail[at, 4] = ay
        tail[at, 5] = az
        tail[at, 6] = norm
        tail[at, 7] = gx * gx
        tail[at, 8] = gx * gy
        tail[at, 9] = gx * gz
        tail[at, 10] = gy * gy
        tail[at, 11] = gy * gz
        tail[at, 12] = gz * gz
        tail[at, 13] = ax * ax
        tail[at, 14] = ax * ay
        tail[at, 15] = ax * az
        tail[at, 16] = ay * ay
        tail[at, 17] = ay * az
        tail[at, 18] = az * az
        tail[at, 19] = norm * norm
    for at in range(n - 2, -1, -1):
        for m in range(_SUMS):
            tail[at, m] += tail[at + 1, m]


@inlined
def _within(head, tail, row, limits, first, at, share):  # type: ignore[no-untyped-def]
    """Conditions (1) and (2): (N − 1)(limit − S) is positive semidefinite: no principal minor is negative.

    The three signals begin at `first`, their products at `at` of the sums and at − 7 of the limits. NaN says no.
    """
    x = head[first] + tail[row, first]
    y = head[first + 1] + tail[row, first + 1]
    z = head[first + 2] + tail[row, first + 2]
    xx = limits[at - 7] - (head[at] + tail[row, at] - x * x * share)
    yy = limits[at - 4] - (head[at + 3] + tail[row, at + 3] - y * y * share)
    zz = limits[at - 2] - (head[at + 5] + tail[row, at + 5] - z * z * share)
    if not (xx >= 0.0 and yy >= 0.0 and zz >= 0.0):
        return False
    xy = limits[at - 6] - (head[at + 1] + tail[row, at + 1] - x * y * share)
    xz = limits[at - 5] - (head[at + 2] + tail[row, at + 2] - x * z * share)
    yz = limits[at - 3] - (head[at + 4] + tail[row, at + 4] - y * z * share)
    if not (xx * yy - xy * xy >= 0.0 and xx * zz - xz * xz >= 0.0 and yy * zz - yz * yz >= 0.0):
        return False
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz) >= 0.0


@inlined
def static_step(block, tail, head, anchor, counts, limits, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """One sample of one sensor, rows of a `StaticState`: is the window that it ends static?"""
    n = len(block)
    at = counts[0]
    ax, ay, az = ax * limits[14], ay * limits[14], az * limits[14]
    block[at, 0], block[at, 1], block[at, 2] = gx, gy, gz
    block[at, 3], block[at, 4], block[at, 5] = ax, ay, az
    norm = np.sqrt(ax * ax + ay * ay + az * az)
    block[at, 6] = norm
    row = at + 1  # where the window begins in the block before
    if row < n:
        counts[0] = row
        _add(head, block, at, anchor)
        if counts[1] == 0:
            return False
    else:  # the block is full and is the window: sum it up backwards, begin the next
        if (gx + gy + gz + norm) * 0.0 == 0.0:  # never anchor on NaN or infinity: it would outlast its window
            for m in range(_SIGNALS):
                anchor[m] = block[at, m]
        _sum_up(tail, block, anchor)
        for m in range(_SUMS):
            head[m] = 0.0
        counts[0] = 0
        counts[1] = 1
        row = 0
    norm, share = head[6] + tail[row, 6], 1.0 / n
    return (
        abs(anchor[6] + norm * share - 1.0) <= limits[12]  # (3)
        and head[19] + tail[row, 19] - norm * norm * share <= limits[13]  # (4)
        and _within(head, tail, row, limits, 0, 7, share)  # (1)
        and _within(head, tail, row, limits, 3, 13, share)  # (2)
    )


@kernel
def _run(block, tail, head, anchor, counts, limits, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    block, tail, head, anchor, counts, limits = block[0], tail[0], head[0], anchor[0], counts[0], limits[0]
    for k in range(len(gyro_S)):
        static[k] = static_step(
            block,
            tail,
            head,
            anchor,
            counts,
            limits,
            gyro_S[k, 0],
            gyro_S[k, 1],
            gyro_S[k, 2],
            accel_S[k, 0],
            accel_S[k, 1],
            accel_S[k, 2],
        )
