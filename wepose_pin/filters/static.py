"""The static-phase detector: when a sensor counts as lying still.

Conditions (1) to (4) of Lisini Baldi 2019 bound how much gyro and accel vary, and a steady rotation about the vertical
varies nothing: an office chair passes them, and a filter that reads the gyroscope's bias at rest takes the chair's
rate for it. Condition (5), ours, holds the mean rate about the vertical against the bias that is known: from the start
phase, then from each rest that was accepted. About horizontal axes gravity would turn away, which (2) sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from ..arguments import NonNegative, Positive, Range, check_fields
from ..compilation import inlined, kernel
from ..errors import BadData, BadOption
from .noise import BLOCK_S, SensorNoise

# A sample is gyro (3), accel/g (3) and the norm of accel/g. The sums are of its differences from an anchor: those
# themselves, their products gyro xx xy xz yy yz zz, the same of accel, and the norm's square.
_SIGNALS = 7
_SUMS = 20
_UPPER = np.triu_indices(3)
# Limits of (5), behind those of (1) to (4): rate_stds², variance of a window's mean, of the average's, bias_spread²
# [rad²/s²], by how much the known bias' variance grows and the average fades in a sample, a sample's share of a window.
_STDS2, _WINDOW_VAR, _AVERAGE_VAR, _SPREAD_VAR, _WALK_VAR, _FADE, _SHARE, _LIMITS = 15, 16, 17, 18, 19, 20, 21, 22


@dataclass(frozen=True)
class StaticTest:
    """When a sensor counts as still; the defaults of (1) to (4) are the paper's, which leaves the window open.

    The covariance conditions hold as matrices: ``alpha * Σ̂ − S`` is positive semidefinite. Condition (5) is ours, and
    ``rate_stds=inf`` leaves the paper's test alone. It holds for the window and for an average over `averaging_s`, in
    which sway cancels; the standard deviation is that of the known bias, which grows by `bias_walk`, of the mean's
    noise and sway as measured in the start phase, and of `bias_spread`.
    """

    window_s: Annotated[float, Range(0.0, closed=False, high=60.0)] = 0.5  # [s] W
    alpha: NonNegative = 2.0  # (1) gyro covariance against the still one
    beta: NonNegative = 2.0  # (2) accel/g covariance against the still one
    gamma1: NonNegative = 0.01  # (3) |mean ‖accel/g‖ − 1| at most
    gamma2: NonNegative = 0.01  # (4) variance of ‖accel/g‖ at most
    rate_stds: float = 3.0  # (5) standard deviations by which the rate about the vertical may be off the known bias
    averaging_s: Positive = 4.0  # [s] of (5)'s average, about two periods of a standing person's sway
    # [rad/s] by which the bias depends on how the sensor lies; 0.01 deg/s, twice what BROAD's sensors show at rest
    bias_spread: NonNegative = float(np.deg2rad(0.01))
    # [rad/s/√s] by which it drifts: a strapped sensor warms by 5 to 10 K in a quarter of an hour, at 0.02 deg/s a
    # kelvin that is 0.2 deg/s, here three standard deviations
    bias_walk: NonNegative = float(np.deg2rad(0.002))

    def __post_init__(self) -> None:
        check_fields(self, "")
        if not self.rate_stds >= 0.0:
            raise BadOption(
                f"rate_stds = {self.rate_stds}: a number from 0 on is needed, infinite for the paper's test"
            )

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
    limits: (
        np.ndarray
    )  # (k, 22) right-hand sides of (1), (2) times N − 1, of (3), of (4) times N − 1; 1/gravity; of (5)
    bias: np.ndarray  # (k, 5) (5): the known bias [rad/s], its variance [rad²/s²], the average rate off it [rad/s]


class StaticDetector:
    """Says for each sample whether the window that ends there is static.

    `update` for one sample and `run` for an array go through the same compiled code; a run cut in two gives the same
    answer to the last bit. Until the first window is full the answer is no, and so it is while a sample that is no
    number lies in the window.

    The cost per sample does not grow with the window: the window is the sums of the current block of N samples and
    those of the rest of the block before, which are made backwards once a block. Nothing is ever subtracted from a sum,
    and the differences summed are from a sample within the window, so that (mean − anchor)² is at most N − 1 variances
    of the window itself: a window at rest is as precise after 1e8 samples of any motion as in the first second.
    Condition (5) alone remembers more, the known bias.
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
    dt, window_s = 1.0 / rate_hz, n / rate_hz
    limits, bias = np.empty((k, _LIMITS)), np.zeros((k, 5))
    for row, known, noise in zip(limits, bias, noises, strict=True):
        row[:6] = (n - 1) * test.alpha * noise.gyro_cov[_UPPER]
        row[6:12] = (n - 1) * test.beta * noise.accel_cov[_UPPER]
        row[12:15] = test.gamma1, (n - 1) * test.gamma2, 1.0 / noise.gravity
        white, sway = np.trace(noise.gyro_cov) / 3.0 / n, 0.0
        if noise.gyro_half_second_cov is not None:
            sway = np.trace(noise.gyro_half_second_cov) / 3.0 * BLOCK_S / window_s
        row[_STDS2], row[_WINDOW_VAR] = test.rate_stds**2, max(white, sway)
        row[_AVERAGE_VAR] = row[_WINDOW_VAR] * window_s / (2.0 * test.averaging_s)
        row[_SPREAD_VAR], row[_WALK_VAR] = test.bias_spread**2, test.bias_walk**2 * dt
        row[_FADE], row[_SHARE] = min(1.0, dt / test.averaging_s), 1.0 / n
        known[:3], known[3] = noise.gyro_bias, np.trace(noise.gyro_bias_cov) / 3.0
    return StaticState(
        block=np.zeros((k, n, _SIGNALS)),
        tail=np.zeros((k, n, _SUMS)),
        head=np.zeros((k, _SUMS)),
        anchor=np.zeros((k, _SIGNALS)),
        counts=np.zeros((k, 2), dtype=np.int64),
        limits=limits,
        bias=bias,
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
def _bias_agrees(bias, limits, static, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Condition (5) for a window that passes (1) to (4), of its mean rate g and mean specific force a; learns the bias.

    `static`: whether the window passes them; where it does not the average fades and the known bias ages.
    """
    bias[3] += limits[_WALK_VAR]
    if not static:
        bias[4] -= limits[_FADE] * bias[4]
        return False
    gx, gy, gz = gx - bias[0], gy - bias[1], gz - bias[2]
    off = (gx * ax + gy * ay + gz * az) / np.sqrt(ax * ax + ay * ay + az * az)
    known = bias[3] + limits[_SPREAD_VAR]
    bound = np.sqrt(limits[_STDS2] * (known + limits[_WINDOW_VAR]))
    # What enters the average is bounded, so that it is soon forgotten when a fast rotation ends.
    bias[4] += limits[_FADE] * (min(max(off, -bound), bound) - bias[4])
    if abs(off) > bound or bias[4] * bias[4] > limits[_STDS2] * (known + limits[_AVERAGE_VAR]):
        return False
    # A window's mean measures the bias; its samples share that, since windows overlap.
    gain = bias[3] / (bias[3] + limits[_WINDOW_VAR] / limits[_SHARE]) if bias[3] > 0.0 else 0.0
    bias[0] += gain * gx
    bias[1] += gain * gy
    bias[2] += gain * gz
    bias[3] -= gain * bias[3]
    return True


@inlined
def static_step(block, tail, head, anchor, counts, limits, bias, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
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
            bias[3] += limits[_WALK_VAR]
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
    static = (
        abs(anchor[6] + norm * share - 1.0) <= limits[12]  # (3)
        and head[19] + tail[row, 19] - norm * norm * share <= limits[13]  # (4)
        and _within(head, tail, row, limits, 0, 7, share)  # (1)
        and _within(head, tail, row, limits, 3, 13, share)  # (2)
    )
    return _bias_agrees(
        bias,
        limits,
        static,
        anchor[0] + (head[0] + tail[row, 0]) * share,
        anchor[1] + (head[1] + tail[row, 1]) * share,
        anchor[2] + (head[2] + tail[row, 2]) * share,
        anchor[3] + (head[3] + tail[row, 3]) * share,
        anchor[4] + (head[4] + tail[row, 4]) * share,
        anchor[5] + (head[5] + tail[row, 5]) * share,
    )


@kernel
def _run(block, tail, head, anchor, counts, limits, bias, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    block, tail, head, anchor, counts, limits = block[0], tail[0], head[0], anchor[0], counts[0], limits[0]
    bias = bias[0]
    for k in range(len(gyro_S)):
        static[k] = static_step(
            block,
            tail,
            head,
            anchor,
            counts,
            limits,
            bias,
            gyro_S[k, 0],
            gyro_S[k, 1],
            gyro_S[k, 2],
            accel_S[k, 0],
            accel_S[k, 1],
            accel_S[k, 2],
        )
