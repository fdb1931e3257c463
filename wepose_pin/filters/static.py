"""The static-phase detector: when a sensor counts as static.

Conditions (1) to (4) of Lisini Baldi 2019 bound how much gyro and accel vary, and a steady rotation about the vertical
varies nothing: an office chair passes them, and a filter that reads the gyroscope's bias in static phases takes the
chair's rate for it. Condition (5), ours, compares the mean rate about the vertical with the known bias: that of the
start phase, then of each accepted static phase. Rotation about horizontal axes turns gravity in S, which (2) detects.

(1) to (4) compare samples with the noise of samples, which grows with the rate of sampling. At 1 kHz the start of a
smooth motion hides in it for 0.13 s in the paper's dynamic experiment, and a filter takes that motion for bias.
Condition (6), ours, compares the mean gyro of the window's newest part with that of the window. The noise of these
means does not depend on the rate of sampling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.special import gammainc, gammaincinv

from ..arguments import NonNegative, Positive, Range, check_fields, format_settings
from ..compilation import inlined, kernel
from ..errors import BadData, BadOption
from .noise import BLOCK_S, SensorNoise

# A sample is gyro [rad/s] (3), accel/g (3) and the norm of accel/g.
SIGNALS = 7
# Sums over samples, of their differences from an anchor. Upper triangles are xx xy xz yy yz zz.
SUMS = np.dtype([("signals", float, SIGNALS), ("products", float, (2, 6)), ("norm_square", float)], align=True)
# Memory of the detector of one sensor, its windows aside.
DETECTOR = np.dtype(
    [
        ("samples", np.int64),  # in the current block
        ("has_block", np.bool_),  # there is a block before it
        ("anchor", float, SIGNALS),  # the last sample of the block before
        ("sums", SUMS),  # of the current block so far, while it does not move
        ("moves", np.bool_),  # a sample of it is too far from the anchor for any static window
        ("moves_until", np.int64),  # of the block before, the last sample that is; `tail` begins after it
        ("inverse_gravity", float),  # [s²/m]
        # right-hand sides of conditions (1) and (2), of (4), each times N - 1, and of (3)
        ("limits", float, (2, 6)),
        ("norm_variance", float),
        ("norm_error", float),
        # condition (6)
        ("newest", np.int64),  # samples of the newest part
        ("rate_change", float, 6),  # [s²/rad²] dᵀ M d ≤ 1 for the change d of the mean gyro; M zero: no condition
        # condition (5): the known bias
        ("bias", float, 3),  # [rad/s]
        ("bias_var", float),  # [rad²/s²]
        ("average_rate", float),  # [rad/s] about the vertical, beyond the known bias
        ("squared_stds", float),  # `StaticTest.rate_stds`²
        ("window_var", float),  # [rad²/s²] of a window's mean
        ("average_var", float),  # [rad²/s²] of the average
        ("spread_var", float),  # [rad²/s²]
        ("walk_var", float),  # [rad²/s²] by which the known bias ages in a sample
        ("fade", float),  # share of the average that a sample replaces
    ],
    align=True,
)
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, repr=False)
class StaticTest:
    """When a sensor counts as static: where all six conditions hold for the window that ends with the sample.

    Conditions (1) to (4) and their limits are those of Lisini Baldi et al. 2019, who do not state a window. (5) and (6)
    are additions of this package; ``rate_stds=inf`` leaves them out, as the method "smekf_published" does. "Static
    phase" is that of the recording, in which noise and bias were measured.

    Parameters
    ----------
    window_s : [s] length of the window
    alpha : (1) the covariance of gyro in the window is at most so many times that of the static phase, along any axis
    beta : (2) the same of accel/g
    gamma1 : (3) the mean of ‖accel/g‖ differs from 1 by at most this
    gamma2 : (4) the variance of ‖accel/g‖ is at most this
    rate_stds : (5) the mean rate about the vertical differs from the known bias by at most so many standard deviations,
        in the window and in an average over `averaging_s`. (6) the mean rate in the newest `newest_s` differs from that
        of the window by no more, on an ellipsoid that is as probable as so many standard deviations of one axis
    newest_s : [s] of (6), about as long as the fastest smooth motion takes to begin
    averaging_s : [s] of (5), about two periods of a standing person's sway, which cancels in the average
    bias_spread : [rad/s] of (5), one standard deviation by which the bias depends on how the sensor lies
    bias_walk : [rad/s/√s] of (5), by which the bias drifts
    """

    window_s: Annotated[float, Range(0.0, closed=False, high=60.0)] = 0.5
    alpha: NonNegative = 2.0
    beta: NonNegative = 2.0
    gamma1: NonNegative = 0.01
    gamma2: NonNegative = 0.01
    rate_stds: float = 3.0
    newest_s: Positive = 0.05
    averaging_s: Positive = 4.0
    bias_spread: NonNegative = float(np.deg2rad(0.01))  # twice what BROAD's sensors show at rest
    # A strapped sensor warms by 5 to 10 K in a quarter of an hour, at 0.02 deg/s a kelvin that is 0.2 deg/s, here three
    # standard deviations.
    bias_walk: NonNegative = float(np.deg2rad(0.002))

    def __repr__(self) -> str:
        return format_settings(self)

    def __post_init__(self) -> None:
        check_fields(self, "")
        if not self.rate_stds >= 0.0:
            raise BadOption(
                f"rate_stds = {self.rate_stds}: a number from 0 on is needed, infinite for the paper's test"
            )

    def samples(self, rate_hz: float) -> int:
        """Return the window's length in samples, at least 4: a covariance of three axes needs them."""
        return max(4, round(self.window_s * rate_hz))


USUAL_TEST = StaticTest()


class StaticDetector:
    """Decides for each sample whether the window that ends there is static.

    A run cut in two gives the same answer to the last bit. Until the first window is full the answer is no, and so it
    is while a sample that is no number lies in the window.

    The cost per sample does not grow with the window: the window is the sums of the current block of N samples and
    those of the rest of the block before, which are made backwards once a block. Nothing is ever subtracted from a sum,
    and the differences summed are from a sample within the window, so that (mean − anchor)² is at most N − 1 variances
    of the window itself: a static window is as precise after 1e8 samples of any motion as in the first second.
    Condition (5) alone has a longer memory, the known bias.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, test: StaticTest | None = None) -> None:
        self.test = test or USUAL_TEST
        n = self.test.samples(rate_hz)
        self._detector = _first_state(noise, rate_hz, self.test)
        self._block = np.zeros((n, SIGNALS))  # samples of the current block, then of the one before
        # Sums of the block before from each of its samples to its end; where no window begins any more, `signals` are
        # those of the current block up to the sample.
        self._tail = np.zeros(n, SUMS)

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`static` (n,) bool for `gyro_S` (n, 3) [rad/s] and `accel_S` (n, 3) [m/s²]."""
        if len(gyro_S) != len(accel_S):  # the compiled step would read beyond an array's end
            raise BadData(f"{len(gyro_S)} rows of gyro_S and {len(accel_S)} of accel_S: they must be as many")
        gyro, accel = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        static = np.empty(len(gyro), dtype=np.bool_)
        _run(self._detector, self._block, self._tail, gyro, accel, static)
        return static


def _first_state(noise: SensorNoise, rate_hz: float, test: StaticTest) -> np.ndarray:
    """Build the memory of a detector before its first sample, (1,) of `DETECTOR`."""
    n = test.samples(rate_hz)
    newest = max(1, round(test.newest_s * rate_hz))
    dt, window_s = 1.0 / rate_hz, n / rate_hz
    white, sway = np.trace(noise.gyro_cov) / 3.0 / n, 0.0
    if noise.gyro_half_second_cov is not None:
        sway = np.trace(noise.gyro_half_second_cov) / 3.0 * BLOCK_S / window_s
    detector = np.zeros(1, DETECTOR)
    values = {
        "inverse_gravity": 1.0 / noise.gravity,
        "limits": (n - 1) * np.array([test.alpha * noise.gyro_cov[_UPPER], test.beta * noise.accel_cov[_UPPER]]),
        "norm_error": test.gamma1,
        "moves_until": -1,
        "norm_variance": (n - 1) * test.gamma2,
        "newest": min(newest, n),
        "rate_change": _bound_rate_change(noise, newest, n, test.rate_stds)[_UPPER],
        "bias": noise.gyro_bias,
        "bias_var": np.trace(noise.gyro_bias_cov) / 3.0,
        "squared_stds": test.rate_stds**2,
        "window_var": max(white, sway),
        "average_var": max(white, sway) * window_s / (2.0 * test.averaging_s),
        "spread_var": test.bias_spread**2,
        "walk_var": test.bias_walk**2 * dt,
        "fade": min(1.0, dt / test.averaging_s),
    }
    for name, value in values.items():
        detector[name] = value
    return detector


def _bound_rate_change(noise: SensorNoise, newest: int, n: int, rate_stds: float) -> np.ndarray:
    """M (3, 3) of condition (6): the inverse covariance of the change, over the square of its bound."""
    squared_bound = 2.0 * gammaincinv(1.5, gammainc(0.5, rate_stds**2 / 2.0))  # χ² of three axes, as probable as of one
    if newest >= n or not 0.0 < squared_bound < np.inf:
        return np.zeros((3, 3))
    sway = 0.0 if noise.gyro_half_second_cov is None else noise.gyro_half_second_cov
    return np.linalg.inv(noise.gyro_cov * (1.0 / newest - 1.0 / n) + sway) / squared_bound


@inlined
def _add(sums, before, block, at, anchor):  # type: ignore[no-untyped-def]
    """Fill `sums` with `before` and sample `at` of the block; both may be one."""
    for part in range(2):
        k = 3 * part
        x, y, z = block[at, k] - anchor[k], block[at, k + 1] - anchor[k + 1], block[at, k + 2] - anchor[k + 2]
        signals, products = sums.signals, sums.products[part]
        signals[k] = before.signals[k] + x
        signals[k + 1] = before.signals[k + 1] + y
        signals[k + 2] = before.signals[k + 2] + z
        products[0], products[1] = before.products[part, 0] + x * x, before.products[part, 1] + x * y
        products[2], products[3] = before.products[part, 2] + x * z, before.products[part, 3] + y * y
        products[4], products[5] = before.products[part, 4] + y * z, before.products[part, 5] + z * z
    norm = block[at, 6] - anchor[6]
    sums.signals[6] = before.signals[6] + norm
    sums.norm_square = before.norm_square + norm * norm


@inlined
def _clear(sums):  # type: ignore[no-untyped-def]
    for i in range(SIGNALS):
        sums.signals[i] = 0.0
    for i in range(6):
        sums.products[0, i] = sums.products[1, i] = 0.0
    sums.norm_square = 0.0


@inlined
def _is_far(detector, block, at):  # type: ignore[no-untyped-def]
    """Return whether gyro at a sample is too far from the anchor for any static window with both.

    Two samples that differ by d make (N − 1) S ≥ d²/2; twice the limit is beyond rounding. NaN is not far.
    """
    limit, anchor = detector.limits[0], detector.anchor
    x, y, z = block[at, 0] - anchor[0], block[at, 1] - anchor[1], block[at, 2] - anchor[2]
    return x * x > 4.0 * limit[0] or y * y > 4.0 * limit[3] or z * z > 4.0 * limit[5]


@inlined
def _is_within(detector, rest, part, share):  # type: ignore[no-untyped-def]
    """Conditions (1), `part` 0, and (2): (N − 1)(limit − S) is positive semidefinite: no principal minor is negative.

    The window is the current block and `rest`, that of the one before. NaN says no.
    """
    head, limit, k = detector.sums, detector.limits[part], 3 * part
    products, rest_products = head.products[part], rest.products[part]
    x = head.signals[k] + rest.signals[k]
    y = head.signals[k + 1] + rest.signals[k + 1]
    z = head.signals[k + 2] + rest.signals[k + 2]
    xx = limit[0] - (products[0] + rest_products[0] - x * x * share)
    yy = limit[3] - (products[3] + rest_products[3] - y * y * share)
    zz = limit[5] - (products[5] + rest_products[5] - z * z * share)
    if not (xx >= 0.0 and yy >= 0.0 and zz >= 0.0):
        return False
    xy = limit[1] - (products[1] + rest_products[1] - x * y * share)
    xz = limit[2] - (products[2] + rest_products[2] - x * z * share)
    yz = limit[4] - (products[4] + rest_products[4] - y * z * share)
    if not (xx * yy - xy * xy >= 0.0 and xx * zz - xz * xz >= 0.0 and yy * zz - yz * yz >= 0.0):
        return False
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz) >= 0.0


@inlined
def _rate_is_steady(detector, tail, n, gx, gy, gz):  # type: ignore[no-untyped-def]
    """Condition (6) for a window of n samples whose mean rate is g; the rates are differences from the anchor."""
    newest, head = detector.newest, detector.sums.signals
    begin = detector.samples - newest  # first sample of the newest part in the current block
    x, y, z = head[0] - newest * gx, head[1] - newest * gy, head[2] - newest * gz
    if begin < 0:
        part = tail[n + begin].signals
        x, y, z = x + part[0], y + part[1], z + part[2]
    elif begin > 0:
        part = tail[begin - 1].signals
        x, y, z = x - part[0], y - part[1], z - part[2]
    M = detector.rate_change
    across = M[1] * x * y + M[2] * x * z + M[4] * y * z
    return M[0] * x * x + M[3] * y * y + M[5] * z * z + 2.0 * across <= newest * newest


@inlined
def _bias_agrees(detector, window, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Condition (5) for a window of mean rate g and mean specific force a; learns the bias.

    `window`: its length in samples where it passes (1) to (4) and (6); 0 where it does not: the average fades and the
    known bias ages.
    """
    bias = detector.bias
    detector.bias_var += detector.walk_var
    if window == 0:
        detector.average_rate -= detector.fade * detector.average_rate
        return False
    gx, gy, gz = gx - bias[0], gy - bias[1], gz - bias[2]
    off = (gx * ax + gy * ay + gz * az) / np.sqrt(ax * ax + ay * ay + az * az)
    known = detector.bias_var + detector.spread_var
    squared_bound = detector.squared_stds * (known + detector.window_var)
    agrees = off * off <= squared_bound
    # What enters the average is bounded, so that it is soon forgotten when a fast rotation ends.
    bounded = off if agrees else np.copysign(np.sqrt(squared_bound), off)
    detector.average_rate += detector.fade * (bounded - detector.average_rate)
    average = detector.average_rate
    if not agrees or average * average > detector.squared_stds * (known + detector.average_var):
        return False
    # A window's mean measures the bias; its samples share that, since windows overlap.
    variance = detector.bias_var
    gain = variance / (variance + window * detector.window_var) if variance > 0.0 else 0.0
    bias[0] += gain * gx
    bias[1] += gain * gy
    bias[2] += gain * gz
    detector.bias_var -= gain * variance
    return True


@inlined
def _step(detector, block, tail, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """One sample: is the window that it ends static?"""
    n, at, anchor, head = len(block), detector.samples, detector.anchor, detector.sums
    ax, ay, az = ax * detector.inverse_gravity, ay * detector.inverse_gravity, az * detector.inverse_gravity
    block[at, 0], block[at, 1], block[at, 2] = gx, gy, gz
    block[at, 3], block[at, 4], block[at, 5] = ax, ay, az
    norm = np.sqrt(ax * ax + ay * ay + az * az)
    block[at, 6] = norm
    first = at + 1  # where the window begins in the block before
    if first < n:
        detector.samples = first
        if not detector.moves:
            detector.moves = detector.has_block and _is_far(detector, block, at)
            _add(head, head, block, at, anchor)
            # No window needs the sums of the block before from here; those up to here serve condition (6).
            for i in range(3):
                tail[at].signals[i] = head.signals[i]
        if not detector.has_block:
            detector.bias_var += detector.walk_var
            return False
    else:  # the block is full and is the window: sum it up backwards, begin the next
        if (gx + gy + gz + norm) * 0.0 == 0.0:  # never anchor on NaN or infinity: it would outlast its window
            for m in range(SIGNALS):
                anchor[m] = block[at, m]
        _clear(head)
        _add(tail[at], head, block, at, anchor)
        detector.moves, detector.moves_until = False, -1
        for before in range(at - 1, -1, -1):
            if _is_far(detector, block, before):
                detector.moves_until = before
                break
            _add(tail[before], tail[before + 1], block, before, anchor)
        detector.samples, detector.has_block, first = 0, True, 0
    if detector.moves or first <= detector.moves_until:
        return _bias_agrees(detector, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rest, share = tail[first], 1.0 / n
    norm = head.signals[6] + rest.signals[6]
    static = (
        abs(anchor[6] + norm * share - 1.0) <= detector.norm_error  # (3)
        and head.norm_square + rest.norm_square - norm * norm * share <= detector.norm_variance  # (4)
        and _is_within(detector, rest, 0, share)  # (1)
        and _is_within(detector, rest, 1, share)  # (2)
    )
    if not static:
        return _bias_agrees(detector, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    gx = (head.signals[0] + rest.signals[0]) * share
    gy = (head.signals[1] + rest.signals[1]) * share
    gz = (head.signals[2] + rest.signals[2]) * share
    ax = anchor[3] + (head.signals[3] + rest.signals[3]) * share
    ay = anchor[4] + (head.signals[4] + rest.signals[4]) * share
    az = anchor[5] + (head.signals[5] + rest.signals[5]) * share
    window = n if _rate_is_steady(detector, tail, n, gx, gy, gz) else 0  # (6)
    return _bias_agrees(detector, window, anchor[0] + gx, anchor[1] + gy, anchor[2] + gz, ax, ay, az)


@kernel
def _run(detectors, block, tail, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    detector = detectors[0]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        static[k] = _step(detector, block, tail, gx, gy, gz, ax, ay, az)
