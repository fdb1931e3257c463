"""The static-phase detector: when a sensor counts as lying still (Lisini Baldi 2019, conditions (1) to (4))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import BadData
from .noise import SensorNoise
from .so3 import compiled

# A sample is gyro (3), accel/g (3) and the norm of accel/g; its statistics are their means and the co-moments
# Σ (x − mean)(y − mean): gyro xx xy xz yy yz zz, the same of accel, and the norm's.
_MEANS = 7
_MOMENTS = 13


@dataclass(frozen=True)
class StaticTest:
    """When a sensor counts as still; the defaults are the paper's; it leaves the window open.

    The covariance conditions hold as matrices: ``alpha * Σ̂ − S`` is positive semidefinite.
    """

    window_s: float = 0.5  # [s] W
    alpha: float = 2.0  # (1) gyro covariance against the still one
    beta: float = 2.0  # (2) accel/g covariance against the still one
    gamma1: float = 0.01  # (3) |mean ‖accel/g‖ − 1| at most
    gamma2: float = 0.01  # (4) variance of ‖accel/g‖ at most

    def samples(self, rate_hz: float) -> int:
        """N, the window in samples (at least 4: a covariance of three axes needs them)."""
        return max(4, round(self.window_s * rate_hz))


class StaticDetector:
    """Says for each sample whether the window that ends there is static.

    `update` for one sample and `run` for an array go through the same compiled code; a run cut in two gives the same
    answer to the last bit. Until the first window is full the answer is no.

    The cost per sample does not grow with the window, and nothing is ever subtracted, so nothing is lost over a day of
    samples: the window is the running statistics of the current block of N samples merged (Chan, Golub, LeVeque 1979)
    with those of the rest of the block before, which are summed up backwards once a block.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, test: StaticTest | None = None) -> None:
        self.test = test or StaticTest()
        self._gravity = noise.gravity
        self._limits = np.concatenate(
            [
                self.test.alpha * noise.gyro_cov[np.triu_indices(3)],
                self.test.beta * noise.accel_cov[np.triu_indices(3)],
                [self.test.gamma1, self.test.gamma2],
            ]
        )
        n = self.test.samples(rate_hz)
        self._block = np.zeros((n, _MEANS))
        self._tail_mean = np.zeros((n, _MEANS))
        self._tail_moment = np.zeros((n, _MOMENTS))
        self._head_mean = np.zeros(_MEANS)
        self._head_moment = np.zeros(_MOMENTS)
        self._count = np.zeros(2, dtype=np.int64)  # samples in the current block; blocks before it

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`static` (n,) bool for `gyro_S` (n, 3) [rad/s] and `accel_S` (n, 3) [m/s²]."""
        if len(gyro_S) != len(accel_S):  # the compiled step would read beyond an array's end
            raise BadData(f"{len(gyro_S)} rows of gyro_S and {len(accel_S)} of accel_S: not as many each")
        static = np.empty(len(gyro_S), dtype=np.bool_)
        _run(
            self._block,
            self._tail_mean,
            self._tail_moment,
            self._head_mean,
            self._head_moment,
            self._count,
            self._limits,
            self._gravity,
            np.ascontiguousarray(gyro_S, dtype=float),
            np.ascontiguousarray(accel_S, dtype=float),
            static,
        )
        return static

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> bool:
        """Whether the window that ends with this sample, `gyro_S` (3,), `accel_S` (3,), is static."""
        return bool(self.run(np.reshape(gyro_S, (1, 3)), np.reshape(accel_S, (1, 3)))[0])


@compiled
def _add(mean, moment, count, sample):  # type: ignore[no-untyped-def]
    """Welford: take one more sample into the statistics of `count` samples."""
    weight = count / (count + 1.0)
    m = 0
    for first in (0, 3):
        for i in range(first, first + 3):
            di = sample[i] - mean[i]
            for j in range(i, first + 3):
                moment[m] += weight * di * (sample[j] - mean[j])
                m += 1
    d = sample[6] - mean[6]
    moment[m] += weight * d * d
    for i in range(_MEANS):
        mean[i] += (sample[i] - mean[i]) / (count + 1.0)


@compiled
def _semidefinite(xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]
    """A symmetric 3×3 matrix is positive semidefinite if and only if no principal minor is negative."""
    if xx < 0.0 or yy < 0.0 or zz < 0.0:
        return False
    if xx * yy - xy * xy < 0.0 or xx * zz - xz * xz < 0.0 or yy * zz - yz * yz < 0.0:
        return False
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz) >= 0.0


@compiled
def _holds(limits, offset, moment, n):  # type: ignore[no-untyped-def]
    """Conditions (1) and (2): limit − S is positive semidefinite, S from the co-moments of n samples."""
    r = np.empty(6)
    for i in range(6):
        r[i] = limits[offset + i] - moment[offset + i] / (n - 1)
    return _semidefinite(r[0], r[1], r[2], r[3], r[4], r[5])


@compiled
def _run(  # type: ignore[no-untyped-def]
    block, tail_mean, tail_moment, head_mean, head_moment, count, limits, gravity, gyro_S, accel_S, static
):
    n = len(block)
    mean = np.empty(_MEANS)
    moment = np.empty(_MOMENTS)
    sample = np.empty(_MEANS)
    for k in range(len(gyro_S)):
        norm = 0.0
        for i in range(3):
            sample[i] = gyro_S[k, i]
            sample[3 + i] = accel_S[k, i] / gravity
            norm += sample[3 + i] * sample[3 + i]
        sample[6] = np.sqrt(norm)

        at = count[0]
        block[at] = sample
        _add(head_mean, head_moment, at, sample)
        head = at + 1
        tail = n - head  # samples of the block before that are still in the window
        mean[:] = head_mean
        moment[:] = head_moment
        if tail > 0 and count[1] > 0:
            weight = head * tail / n
            m = 0
            for first in (0, 3):
                for i in range(first, first + 3):
                    di = tail_mean[head, i] - head_mean[i]
                    for j in range(i, first + 3):
                        moment[m] += tail_moment[head, m] + weight * di * (tail_mean[head, j] - head_mean[j])
                        m += 1
            d = tail_mean[head, 6] - head_mean[6]
            moment[m] += tail_moment[head, m] + weight * d * d
            for i in range(_MEANS):
                mean[i] += (tail_mean[head, i] - head_mean[i]) * tail / n

        static[k] = (
            (tail == 0 or count[1] > 0)
            and abs(mean[6] - 1.0) <= limits[12]  # (3)
            and moment[12] / (n - 1) <= limits[13]  # (4)
            and _holds(limits, 0, moment, n)  # (1)
            and _holds(limits, 6, moment, n)  # (2)
        )

        count[0] = head
        if tail == 0:  # the block is full: sum it up backwards, begin the next
            mean[:] = 0.0
            moment[:] = 0.0
            for i in range(n):
                _add(mean, moment, i, block[n - 1 - i])
                tail_mean[n - 1 - i] = mean
                tail_moment[n - 1 - i] = moment
            head_mean[:] = 0.0
            head_moment[:] = 0.0
            count[0] = 0
            count[1] += 1
