"""The static-phase detector: when a sensor counts as static.

Conditions (1) to (4) of Lisini Baldi 2019 bound how much gyro and accel vary, and a steady rotation about the vertical
varies nothing: an office chair passes them, and a filter that reads the gyroscope's bias in static phases takes the
chair's rate for it. Condition (5), ours, compares the mean rate about the vertical with the known bias: that of the
start phase, then of each accepted static phase. Rotation about horizontal axes turns gravity in S, which (2) detects.

(1) to (4) compare samples with the noise of samples, which grows with the rate of sampling. At 1 kHz the start of a
smooth motion hides in it for 0.13 s in the paper's dynamic experiment, and a filter takes that motion for bias. At
25 Hz the covariance of a window's dozen samples scatters beyond the limit. So (1) and (2), but for the published
method, allow no more slow motion than they would at `WHITE_RATE_HZ`, and at low rates the scatter. Condition (6), ours,
compares the mean gyro of the window's newest part with that of the window. The noise of these means does not depend on
the rate.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.special import gammainc, gammaincinv

from ..arguments import NonNegative, PositiveOrInfinite, Range
from ..compilation import inlined, kernel
from .base import FilterParams, make_record
from .phases import BLOCK_S, SensorNoise, average_variance

WHITE_RATE_HZ = 200.0  # of (1) and (2), where 0.5 s are 100 samples, the longest window of the authors' software
NEWEST_S = 0.05  # [s] of condition (6), about as long as the fastest smooth motion takes to begin
# Of condition (5): about two periods of a standing person's sway, which cancels in the average; one standard deviation
# by which the bias depends on how the sensor lies, twice what BROAD's sensors show at rest; drift of the bias, of which
# three standard deviations are the warming of a strapped sensor by 5 to 10 K in a quarter of an hour.
AVERAGING_S = 4.0  # [s]
BIAS_SPREAD = float(np.deg2rad(0.01))  # [rad/s]
BIAS_WALK = float(np.deg2rad(0.002))  # [rad/s/√s]

# A sample is gyro [rad/s] (3), accel/g (3) and the norm of accel/g. Sums over samples are of these, of the products of
# gyro and of accel (upper triangles xx xy xz yy yz zz), and of the squared norm, each of differences from an anchor.
SIGNALS, SUMS = 7, 20
_UPPER = np.triu_indices(3)


@dataclass(frozen=True)
class StaticTest(FilterParams):
    """When a sensor counts as static: where all six conditions hold for the window that ends with the sample.

    Conditions (1) to (4) and their limits are those of Lisini Baldi et al. 2019, who do not state a window. (5) and (6)
    are additions of this package, and so is that (1) and (2) allow the same slow motion at any rate of sampling;
    ``rate_stds=inf`` leaves all three out, as the method "smekf_published" does. "Static phase" is that of the
    recording, in which noise and bias were measured.

    Parameters
    ----------
    window_s : [s] length of the window
    alpha : (1) the covariance of gyro in the window is at most so many times that of the static phase, along any axis
    beta : (2) the same of accel/g
    gamma1 : (3) the mean of ‖accel/g‖ differs from 1 by at most this
    gamma2 : (4) the variance of ‖accel/g‖ is at most this
    rate_stds : (5) the mean rate about the vertical differs from the known bias by at most so many standard deviations,
        in the window and in an average over 4 s. (6) the mean rate in the newest 0.05 s differs from that of the window
        by no more, on an ellipsoid that is as probable as so many standard deviations of one axis
    """

    window_s: Annotated[float, Range(0.0, closed=False, high=60.0)] = 0.5
    alpha: NonNegative = 2.0
    beta: NonNegative = 2.0
    gamma1: NonNegative = 0.01
    gamma2: NonNegative = 0.01
    rate_stds: PositiveOrInfinite = 3.0

    def samples(self, rate_hz: float) -> int:
        """Return the window's length in samples, at least 4: a covariance of three axes needs them."""
        return max(4, round(self.window_s * rate_hz))


USUAL_TEST = StaticTest()


def make_static_records(noise: SensorNoise, rate_hz: float, test: StaticTest) -> tuple[np.ndarray, ...]:
    """Return the state with which `find_static` begins: records (1,), and arrays as long as the window."""
    n, newest = test.samples(rate_hz), max(1, round(NEWEST_S * rate_hz))
    dt, window_s = 1.0 / rate_hz, n / rate_hz
    half_second_cov = noise.gyro_half_second_cov
    white, sway = average_variance(noise.gyro_cov) / n, average_variance(half_second_cov) * BLOCK_S / window_s
    # (6): the inverse covariance of the change over the square of its bound, χ² of three axes as probable as of one
    squared_bound = 2.0 * gammaincinv(1.5, gammainc(0.5, test.rate_stds**2 / 2.0))
    rate_change = np.zeros((3, 3))
    if newest < n and 0.0 < squared_bound < np.inf:
        change_cov = noise.gyro_cov * (1.0 / newest - 1.0 / n) + half_second_cov
        rate_change = np.linalg.inv(change_cov) / squared_bound
    # Beyond white noise (1) and (2) allow what they would with that of `WHITE_RATE_HZ` at most, and twice its scatter
    white_share = max(min(1.0, WHITE_RATE_HZ / rate_hz), 4.0 * np.sqrt(3.0 / n))
    white_share = white_share if np.isfinite(test.rate_stds) else 1.0
    limits = []
    for factor, cov, white_var in (
        (test.alpha, noise.gyro_cov, average_variance(noise.bias_step_cov) / 2.0),
        (test.beta, noise.accel_cov, noise.accel_step_var / 2.0),
    ):
        if white_share < 1.0:  # what is taken away, the quietest axis has too
            white_var = min(white_var, np.linalg.eigvalsh(cov)[0])
        limits.append((factor * cov + (factor - 1.0) * (white_share - 1.0) * white_var * np.eye(3))[_UPPER])
    model = make_record(
        inverse_gravity=1.0 / noise.gravity,  # [s²/m]
        # right-hand sides of conditions (1) and (2), of (4), each times N - 1, and of (3)
        limits=(n - 1) * np.array(limits),
        norm_variance=(n - 1) * test.gamma2,
        norm_error=test.gamma1,
        newest=np.int64(min(newest, n)),  # (6): samples of the newest part
        rate_change=rate_change,  # [s²/rad²] dᵀ M d ≤ 1 for the change d of the mean gyro; M zero: no condition
        # condition (5)
        squared_stds=test.rate_stds**2,
        window_var=max(white, sway),  # [rad²/s²] of a window's mean
        average_var=max(white, sway) * window_s / (2.0 * AVERAGING_S),  # [rad²/s²] of the average
        spread_var=BIAS_SPREAD**2,  # [rad²/s²]
        walk_var=BIAS_WALK**2 * dt,  # [rad²/s²] by which the known bias ages in a sample
        fade=min(1.0, dt / AVERAGING_S),  # share of the average that a sample replaces
    )
    # Arrays of their own, so that the compiled step is one for all rates of sampling
    block = np.zeros((n, SIGNALS))  # samples of the current block, then of the one before
    tail = np.zeros((n, SUMS))  # sums of the block before, from each of its samples to its end
    state = make_record(
        samples=np.int64(0),  # in the current block
        anchor=np.zeros(SIGNALS),  # the last sample of the block before
        head=np.zeros(SUMS),  # sums of the current block so far, while it does not move
        window=np.zeros(SUMS),  # sums of the window
        moves=np.bool_(False),  # a sample of the block is too far from the anchor for any static window
        moves_until=np.int64(n),  # of the block before, the last sample that is; `tail` begins after it
        bias=noise.gyro_bias,  # [rad/s] the known bias of condition (5)
        bias_var=average_variance(noise.gyro_bias_cov),  # [rad²/s²]
        average_rate=0.0,  # [rad/s] about the vertical, beyond the known bias
    )
    return state, model, block, tail


@inlined
def _add(sums, before, sample, anchor):  # type: ignore[no-untyped-def]
    """Fill `sums` with `before` and a sample; both may be one."""
    for part in range(2):
        k, m = 3 * part, 7 + 6 * part
        x, y, z = sample[k] - anchor[k], sample[k + 1] - anchor[k + 1], sample[k + 2] - anchor[k + 2]
        sums[k], sums[k + 1], sums[k + 2] = before[k] + x, before[k + 1] + y, before[k + 2] + z
        sums[m], sums[m + 1], sums[m + 2] = before[m] + x * x, before[m + 1] + x * y, before[m + 2] + x * z
        sums[m + 3], sums[m + 4], sums[m + 5] = before[m + 3] + y * y, before[m + 4] + y * z, before[m + 5] + z * z
    norm = sample[6] - anchor[6]
    sums[6], sums[19] = before[6] + norm, before[19] + norm * norm


@inlined
def _is_far(anchor, limit, sample):  # type: ignore[no-untyped-def]
    """Return whether gyro of a sample is too far from the anchor for any static window with both.

    Two samples that differ by d make (N − 1) S ≥ d²/2; twice the limit is beyond rounding. NaN is not far.
    """
    x, y, z = sample[0] - anchor[0], sample[1] - anchor[1], sample[2] - anchor[2]
    return x * x > 4.0 * limit[0] or y * y > 4.0 * limit[3] or z * z > 4.0 * limit[5]


@inlined
def _is_within(window, limit, part, share):  # type: ignore[no-untyped-def]
    """Conditions (1), `part` 0, and (2): (N − 1)(limit − S) is positive semidefinite: no principal minor is negative.

    NaN says no.
    """
    k, first = 3 * part, 7 + 6 * part
    x, y, z = window[k], window[k + 1], window[k + 2]
    xx = limit[0] - (window[first] - x * x * share)
    yy = limit[3] - (window[first + 3] - y * y * share)
    zz = limit[5] - (window[first + 5] - z * z * share)
    xy = limit[1] - (window[first + 1] - x * y * share)
    xz = limit[2] - (window[first + 2] - x * z * share)
    yz = limit[4] - (window[first + 4] - y * z * share)
    of_two = xx * yy - xy * xy >= 0.0 and xx * zz - xz * xz >= 0.0 and yy * zz - yz * yz >= 0.0
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return xx >= 0.0 and yy >= 0.0 and zz >= 0.0 and of_two and determinant >= 0.0


@inlined
def _rate_is_steady(state, model, tail):  # type: ignore[no-untyped-def]
    """Condition (6): the mean rate of the newest part is near that of the window."""
    head, window, newest, M = state.head, state.window, model.newest, model.rate_change
    begin, share = state.samples - newest, newest / len(tail)  # first sample of the newest part in the block
    x, y, z = head[0] - share * window[0], head[1] - share * window[1], head[2] - share * window[2]
    if begin < 0:
        rest = tail[len(tail) + begin]
        x, y, z = x + rest[0], y + rest[1], z + rest[2]
    elif begin > 0:
        rest = tail[begin - 1]
        x, y, z = x - rest[0], y - rest[1], z - rest[2]
    across = M[0, 1] * x * y + M[0, 2] * x * z + M[1, 2] * y * z
    return M[0, 0] * x * x + M[1, 1] * y * y + M[2, 2] * z * z + 2.0 * across <= newest * newest


@inlined
def _bias_agrees(state, model, n, share):  # type: ignore[no-untyped-def]
    """Condition (5) for a window of n samples that passes the others; learns the bias."""
    bias, anchor, window = state.bias, state.anchor, state.window
    gx, gy, gz = anchor[0] + window[0] * share, anchor[1] + window[1] * share, anchor[2] + window[2] * share
    ax, ay, az = anchor[3] + window[3] * share, anchor[4] + window[4] * share, anchor[5] + window[5] * share
    gx, gy, gz = gx - bias[0], gy - bias[1], gz - bias[2]
    off = (gx * ax + gy * ay + gz * az) / np.sqrt(ax * ax + ay * ay + az * az)
    known = state.bias_var + model.spread_var
    squared_bound = model.squared_stds * (known + model.window_var)
    agrees = off * off <= squared_bound
    # What enters the average is bounded, so that it is soon forgotten when a fast rotation ends.
    bounded = off if agrees else np.copysign(np.sqrt(squared_bound), off)
    state.average_rate += model.fade * (bounded - state.average_rate)
    average = state.average_rate
    if not agrees or average * average > model.squared_stds * (known + model.average_var):
        return False
    # A window's mean measures the bias; its samples share that, since windows overlap.
    variance = state.bias_var
    gain = variance / (variance + n * model.window_var) if variance > 0.0 else 0.0
    bias[0] += gain * gx
    bias[1] += gain * gy
    bias[2] += gain * gz
    state.bias_var -= gain * variance
    return True


@inlined
def _add_sample(state, model, block, tail, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Add a sample; return where the window begins in the block before, or −1 where it is not full or surely moves."""
    at, anchor, head, limit = state.samples, state.anchor, state.head, model.limits[0]
    ax, ay, az = ax * model.inverse_gravity, ay * model.inverse_gravity, az * model.inverse_gravity
    sample = gx, gy, gz, ax, ay, az, np.sqrt(ax * ax + ay * ay + az * az)
    for m in range(SIGNALS):
        block[at, m] = sample[m]
    state.samples = at + 1
    if state.samples < len(block):
        if not state.moves:
            state.moves = _is_far(anchor, limit, sample)
            _add(head, head, sample, anchor)
            # No window needs the sums of the block before from here; those up to here serve condition (6).
            tail[at, 0], tail[at, 1], tail[at, 2] = head[0], head[1], head[2]
        return -1 if state.moves or state.samples <= state.moves_until else state.samples
    # The block is full and is the window: sum it up backwards, begin the next.
    if (gx + gy + gz + sample[6]) * 0.0 == 0.0:  # never anchor on NaN or infinity: it would outlast its window
        for m in range(SIGNALS):
            anchor[m] = sample[m]
    head[:] = 0.0
    _add(tail[at], head, sample, anchor)
    state.moves, state.moves_until, state.samples = False, -1, 0
    for before in range(at - 1, -1, -1):
        if _is_far(anchor, limit, block[before]):
            state.moves_until = before
            return -1
        _add(tail[before], tail[before + 1], block[before], anchor)
    return 0


@kernel
def find_static(states, models, block, tail, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    """Fill `static` (n,): the window that ends at a sample of `gyro_S`, `accel_S` (n, 3), contiguous, is static.

    Until the first window is full the answer is no, and so it is while a sample that is no number lies in the window.

    The cost per sample does not grow with the window: the window is the sums of the current block of N samples and
    those of the rest of the block before, which are made backwards once a block. Nothing is ever subtracted from a sum,
    and the differences summed are from a sample within the window: a static window is as precise after 1e8 samples of
    any motion as in the first second. Condition (5) alone has a longer memory, the known bias.
    """
    state, model = states[0], models[0]
    window, anchor, limits, share = state.window, state.anchor, model.limits, 1.0 / len(block)
    for k in range(len(gyro_S)):
        static[k] = False
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        first = _add_sample(state, model, block, tail, gx, gy, gz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2])
        state.bias_var += model.walk_var
        if first >= 0:
            for m in range(SUMS):
                window[m] = state.head[m] + tail[first, m]
            norm = window[6] * share
            if (
                abs(anchor[6] + norm - 1.0) <= model.norm_error  # (3)
                and window[19] - window[6] * norm <= model.norm_variance  # (4)
                and _is_within(window, limits[0], 0, share)  # (1)
                and _is_within(window, limits[1], 1, share)  # (2)
                and _rate_is_steady(state, model, tail)  # (6)
            ):
                static[k] = _bias_agrees(state, model, len(block), share)  # (5)
                continue
        state.average_rate -= model.fade * state.average_rate
