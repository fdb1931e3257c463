"""The sensor: noise, bias, scale, alignment, range, quantisation, clock and lost samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from ..arguments import NonNegative, Positive
from ..errors import BadOption
from .imperfections import Imperfections

GRAVITY = 9.81  # [m/s^2]
LONGEST_RUN_S = 0.05  # of lost samples
_MEAN_RUN_S = 0.02
_WARM_UP_S = 900.0


@dataclass(frozen=True, repr=False)
class ImuNoise:
    """Noise of an IMU; the defaults are those of the Xsens MTi-3.

    Densities and in-run stabilities: MTi 1-series data sheet (0.007 deg/s/sqrt(Hz), 10 deg/h; 120
    ug/sqrt(Hz), 0.03 mg). It gives no turn-on bias that is comparable: 0.2 deg/s and 3 mg are assumptions.

    White noise has the standard deviation density * sqrt(rate) at each sample, the convention of angle and
    velocity random walk. The bias is the turn-on bias, constant over the recording, plus a first-order
    Gauss-Markov process whose standard deviation is the in-run stability and whose correlation time is an
    assumption as well.
    """

    gyro_density: NonNegative = float(np.deg2rad(0.007))  # [rad/s/sqrt(Hz)]
    gyro_bias_std: NonNegative = float(np.deg2rad(0.2))  # [rad/s], turn-on, each axis
    gyro_bias_instability: NonNegative = float(np.deg2rad(10.0)) / 3600.0  # [rad/s]
    accel_density: NonNegative = 120e-6 * GRAVITY  # [m/s^2/sqrt(Hz)]
    accel_bias_std: NonNegative = 3e-3 * GRAVITY  # [m/s^2], turn-on, each axis
    accel_bias_instability: NonNegative = 0.03e-3 * GRAVITY  # [m/s^2]
    correlation_s: Positive = 100.0  # [s], of the in-run biases


MTI_3 = ImuNoise()
NOISE_FREE = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Readings(NamedTuple):
    """A sensor's samples and its true biases."""

    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s^2]
    gyro_bias: np.ndarray  # (n, 3) [rad/s]
    accel_bias: np.ndarray  # (n, 3) [m/s^2]


@dataclass(frozen=True)
class Device:
    """One sensor's own errors: measured = matrix @ true (+ g_matrix @ specific force), then bias and noise."""

    gyro_matrix: np.ndarray  # (3, 3)
    accel_matrix: np.ndarray  # (3, 3)
    g_matrix: np.ndarray  # (3, 3) [rad/s per m/s^2]
    warm_up: np.ndarray  # (3,) [rad/s] by which the gyroscope's bias changes in the first 15 min
    sizes: Imperfections  # range and bits

    @staticmethod
    def sample(rng: np.random.Generator, sizes: Imperfections, warm_up: np.random.Generator) -> Device:
        """Sample a sensor's errors; those of a gyroscope that warms up have their own stream."""
        direction = warm_up.standard_normal(3)
        change = np.deg2rad(sizes.gyro_warm_up_deg_s) * 10.0 ** warm_up.uniform(-1.0, 0.0)
        scale, tilt, g = rng.standard_normal((2, 3)), rng.standard_normal((2, 3, 3)), rng.standard_normal((3, 3))
        tilt *= np.deg2rad(sizes.misalignment_deg) * (1.0 - np.eye(3))
        return Device(
            np.eye(3) + sizes.gyro_scale * np.diag(scale[0]) + tilt[0],
            np.eye(3) + sizes.accel_scale * np.diag(scale[1]) + tilt[1],
            np.deg2rad(sizes.g_sensitivity_deg_s) / GRAVITY * g,
            change / np.linalg.norm(direction) * direction,
            sizes,
        )

    def measure(
        self, rate_S: np.ndarray, force_S: np.ndarray, rate_hz: float, noise: ImuNoise, rng: np.random.Generator
    ) -> Readings:
        """Measure the true rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2] with the sensor's errors."""
        n = len(rate_S)
        decay = np.exp(-1.0 / (noise.correlation_s * rate_hz))
        gyro_bias = _draw_bias(rng, (n, 3), noise.gyro_bias_std, noise.gyro_bias_instability, decay)
        accel_bias = _draw_bias(rng, (n, 3), noise.accel_bias_std, noise.accel_bias_instability, decay)
        white = rng.standard_normal((2, n, 3)) * np.sqrt(rate_hz)
        gyro_bias += np.minimum(np.arange(n) / (rate_hz * _WARM_UP_S), 1.0)[:, None] * self.warm_up
        gyro_S = rate_S @ self.gyro_matrix.T + force_S @ self.g_matrix.T + gyro_bias + noise.gyro_density * white[0]
        accel_S = force_S @ self.accel_matrix.T + accel_bias + noise.accel_density * white[1]
        gyro_S = _quantise(gyro_S, np.deg2rad(self.sizes.gyro_range_deg_s), self.sizes.bits)
        accel_S = _quantise(accel_S, self.sizes.accel_range_g * GRAVITY, self.sizes.bits)
        return Readings(gyro_S, accel_S, gyro_bias, accel_bias)


def _draw_bias(
    rng: np.random.Generator, shape: tuple[int, int], turn_on: float, in_run: float, decay: float
) -> np.ndarray:
    """Draw turn-on bias plus a Gauss-Markov process of standard deviation `in_run` and factor `decay` a sample."""
    white = rng.standard_normal(shape) * np.sqrt(1.0 - decay**2)
    white[0] /= np.sqrt(1.0 - decay**2)  # stationary from the first sample
    return turn_on * rng.standard_normal(shape[1]) + in_run * lfilter([1.0], [1.0, -decay], white, axis=0)


def _quantise(values: np.ndarray, full_scale: float, bits: int) -> np.ndarray:
    """Limit values to ± `full_scale` and round them to digits."""
    if not bits:
        return np.clip(values, -full_scale, full_scale) if np.isfinite(full_scale) else values
    count = 2 ** (bits - 1)
    return np.clip(np.round(values / full_scale * count), -count, count - 1) * (full_scale / count)


def jitter_time(rng: np.random.Generator, time: np.ndarray, rate_hz: float, std: float) -> np.ndarray:
    """Draw the sampling times of a clock with nominal times `time` (n,) [s] and jitter `std` [s], in order."""
    if std * rate_hz > 0.25:
        raise BadOption(f"clock_jitter {std} s must be at most a quarter of a step at {rate_hz} Hz")
    return time + np.clip(std * rng.standard_normal(len(time)), -0.45 / rate_hz, 0.45 / rate_hz)


def draw_lost(rng: np.random.Generator, n: int, rate_hz: float, share: float) -> np.ndarray:
    """Draw a mask (n,) of lost samples: runs of 20 ms on average and at most 50 ms, never at the ends or adjacent."""
    mask = np.zeros(n, dtype=bool)
    longest = max(1, int(LONGEST_RUN_S * rate_hz + 1e-9))
    # Draws do not depend on the share: another share gives the same runs at other distances.
    waits, lengths = rng.exponential(size=n), rng.exponential(size=n)
    runs = np.clip(np.round(lengths * _MEAN_RUN_S * rate_hz).astype(int), 1, longest)
    if share > 0.0:
        gaps = (waits * np.mean(runs) / share).astype(int) + 1
        ends = 1 + np.cumsum(gaps + runs)
        for end, run in zip(ends[ends < n], runs, strict=False):
            mask[end - run : end] = True
    return mask
