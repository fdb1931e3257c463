"""Sensor noise, bias and tilt from a static phase (Lisini Baldi 2019, the Σ̂ of the static test)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import rotations
from ..errors import BadData, BadPhase
from ..recording.limits import STANDARD_GRAVITY

# Smallest standard deviations: a quantised signal may be constant, but no MEMS sensor is more precise, and the
# covariances stay invertible.
GYRO_FLOOR = 1e-5  # [rad/s]
ACCEL_FLOOR = 1e-5  # [g]
BIAS_FLOOR = 1e-6  # [rad/s] of the bias itself, that is 0.2 deg/h

# Length of blocks for the covariance of the mean: long against the sensor's noise, short against a person's sway.
BLOCK_S = 0.5

# A standing person sways at 0.3 to 0.5 deg/s (rms) below 0.5 Hz and tilts by 0.2 to 0.4 deg; a hanging arm and a
# breathing chest turn faster. The error of a sensor's mean rate over T seconds is that rate, and at most √2 σ/(ω T),
# which the tilt allows.
SWAY_RATE_STD = float(np.deg2rad(0.7))  # [rad/s] of a worn sensor
SWAY_RATE = 2.0 * np.pi * 0.2  # [rad/s] ω, of slow sway
PRIOR_BLOCKS = 4.0  # weight of `SWAY_RATE_STD` as a number of blocks
SWAY_CORRELATION_S = 2.0  # half a sway period: half-second means are correlated for so long
STEADY_TURN_S = 20.0  # longest steady rotation of a person, as on an office chair
LEAST_SWAY_STD = float(np.deg2rad(0.03))  # [rad/s] of the means of blocks beyond white noise; a person sways more

ACCEL_BIAS_STD = 0.003  # [rad] tilt error from the bias of a calibrated MEMS accelerometer (3 mg: our assumption)
MOVING_TILT_STD = 0.2  # [rad] tilt error of an accelerometer in motion


@dataclass(frozen=True)
class SensorNoise:
    """Noise and bias of one sensor from a static phase."""

    gyro_bias: np.ndarray  # (3,) mean of gyro [rad/s]
    gyro_bias_cov: np.ndarray  # (3, 3) [rad²/s²] of that mean, slow motion in the phase included (a person sways)
    gyro_cov: np.ndarray  # (3, 3) Σ̂_ω, sample covariance of gyro [rad²/s²]
    accel_cov: np.ndarray  # (3, 3) Σ̂_g, sample covariance of accel/gravity [1]
    bias_step_cov: np.ndarray  # (3, 3) [rad²/s²] Σ_b, that of gyro's first differences, as in the authors' software
    gravity: float  # mean norm of accel [m/s²]: the gravity scale
    # (3, 3) covariance of gyro's means over `BLOCK_S` [rad²/s²], with sway; None: white noise
    gyro_half_second_cov: np.ndarray | None = None

    def sway_density(self, rate_hz: float) -> float:
        """Compute the density [rad²/s] of sway on each axis; the mean rate over T s has 1/T of it as variance."""
        if self.gyro_half_second_cov is None:
            return 0.0
        white = float(np.trace(self.gyro_cov)) / 3.0 / (BLOCK_S * rate_hz)
        total, bias = float(np.trace(self.gyro_half_second_cov)) / 3.0, float(np.trace(self.gyro_bias_cov)) / 3.0
        if total <= white:
            return 0.0
        # Where the bias is hardly more certain than the sway, a steady rotation is as likely as a bias, while it lasts.
        duration_s = STEADY_TURN_S * min(1.0, bias / total) if bias > 0.3 * total else SWAY_CORRELATION_S
        return (total - white) * duration_s


# For a sensor without a static phase: noise of a usual MEMS sensor at 100 to 300 Hz, a bias as it may be from the
# factory. Only amekf and smoother estimate the bias in motion.
TYPICAL = SensorNoise(
    gyro_bias=np.zeros(3),
    gyro_bias_cov=np.deg2rad(0.5) ** 2 * np.eye(3),
    gyro_cov=np.deg2rad(0.1) ** 2 * np.eye(3),
    accel_cov=0.003**2 * np.eye(3),
    bias_step_cov=2.0 * np.deg2rad(0.1) ** 2 * np.eye(3),
    gravity=STANDARD_GRAVITY,
)


def estimate_noise(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, worn: bool = False) -> SensorNoise:
    """Estimate noise and bias from static samples: `gyro_S` (n, 3) [rad/s], `accel_S` (n, 3) [m/s²].

    `worn`: a person wears the sensor and sways. A phase of a second or two does not show sway, so its uncertainty is
    added to that of the bias. `BadPhase`: fewer than 10 samples, or accel without gravity.
    """
    n = len(gyro_S)
    if n < 10:
        raise BadPhase(f"the static phase holds {n} samples; at least 10 are needed to measure noise")
    gravity = float(np.linalg.norm(accel_S, axis=1).mean())
    if not gravity > 0.0:
        raise BadPhase("the static phase holds no gravity: accel is zero; specific force is needed, +g up when static")
    size = max(1, round(BLOCK_S * rate_hz))
    blocks, gyro_cov = n // size, _compute_cov(gyro_S)
    # Means of blocks average white noise out and keep sway; less than four show none.
    half_second_cov = _compute_cov(average_blocks(gyro_S, size)) if blocks >= 4 else None
    bias_cov = gyro_cov / n if half_second_cov is None or worn else half_second_cov / blocks
    bias_cov = _apply_floor(bias_cov, BIAS_FLOOR)
    if worn:  # what sways comes back: its mean is smaller than that of independent blocks
        half_second_cov = _estimate_sway_cov(gyro_S, size, half_second_cov)
        allowed = min(1.0, 2.0 / (SWAY_RATE * n / rate_hz) ** 2)
        bias_cov = bias_cov + float(np.trace(half_second_cov)) / 3.0 * allowed * np.eye(3)
    return SensorNoise(
        gyro_bias=average_blocks(gyro_S, n)[0],
        gyro_bias_cov=bias_cov,
        gyro_cov=_apply_floor(gyro_cov, GYRO_FLOOR),
        accel_cov=_apply_floor(_compute_cov(accel_S / gravity), ACCEL_FLOOR),
        bias_step_cov=_apply_floor(_compute_cov(gyro_S[1:] - gyro_S[:-1]), GYRO_FLOOR),
        gravity=gravity,
        gyro_half_second_cov=half_second_cov,
    )


def _estimate_sway_cov(gyro_S: np.ndarray, size: int, measured: np.ndarray | None) -> np.ndarray:
    """Estimate the covariance (3, 3) [rad²/s²] of a worn sensor's means over blocks of `size` samples by sway.

    It is the `measured` one with `SWAY_RATE_STD` as a prior, or without it where the means vary like white noise. A
    phase of less than two seconds gives no estimate: half a sway looks like a steady rotation.
    """
    if measured is None:
        return SWAY_RATE_STD**2 * np.eye(3)
    white = float(np.diff(gyro_S, axis=0).var(axis=0).mean()) / 2.0 / size
    excess = float(np.trace(measured)) / 3.0 - white
    prior = PRIOR_BLOCKS * min(1.0, max(0.0, excess) / LEAST_SWAY_STD**2)
    degrees = len(gyro_S) // size - 1
    return (prior * SWAY_RATE_STD**2 * np.eye(3) + degrees * measured) / (prior + degrees)


def _compute_cov(values: np.ndarray) -> np.ndarray:
    """Compute the covariance (3, 3) of samples (n, 3) as `np.cov`, in a quarter of its time."""
    off = values - average_blocks(values, len(values))
    return np.asarray(off.T @ off * (1.0 / (len(values) - 1)))


def average_blocks(values: np.ndarray, size: int) -> np.ndarray:
    """Means (n // size, 3) of the complete blocks of `size` samples (n, 3), in a tenth of the time of `mean`."""
    count = len(values) // size
    return np.asarray(np.full(size, 1.0 / size) @ values[: count * size].reshape(count, size, 3))


def _apply_floor(cov: np.ndarray, std: float) -> np.ndarray:
    """Add the variance of the floor where the covariance falls below it along any direction."""
    floor = std**2 * np.eye(3)
    (a, b, c), (_, d, e), (_, _, f) = (cov - floor).tolist()  # positive minors; LAPACK takes ten times as long
    is_above = a > 0.0 and a * d > b * b and a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d) > 0.0
    return cov if is_above else cov + floor


def estimate_start_tilt(
    gyro_S: np.ndarray, accel_S: np.ndarray, noise: SensorNoise, rate_hz: float
) -> tuple[np.ndarray, float]:
    """Estimate `quat_VS` (4,), with zero heading, before the first of some static samples from their mean force.

    The second number is one standard deviation of its roll and of its pitch [rad]. The gyroscope rotates each sample's
    force into the sensor frame of the first, so that sway does not blur the mean. NaN samples are left out. `gyro_S`,
    `accel_S`: (n, 3) [rad/s], [m/s²]. `BadData`: they have no gravity.
    """
    force = rotations.unroll((gyro_S - noise.gyro_bias) * (1.0 / rate_hz), np.ascontiguousarray(accel_S))
    if not np.isfinite(force).all():
        force = force[np.isfinite(force).all(axis=1)]
    mean = average_blocks(force, len(force))[0] if len(force) else np.zeros(3)
    norm = float(np.linalg.norm(mean))
    if not norm > 0.0:
        raise BadData("accel is zero in the start phase; the filter starts from the direction of gravity")
    across = force - (force @ mean)[:, None] * mean / norm**2
    size = max(1, round(BLOCK_S * rate_hz))
    blocks = len(across) // size
    # In less than four blocks sway does not average out.
    scatter, count = (
        (average_blocks(across, size).var(axis=0, ddof=1), blocks) if blocks >= 4 else (across.var(axis=0), 1)
    )
    variance = float(scatter.sum()) / 2.0 / count
    return rotations.quat_from_gravity(mean), float(np.hypot(ACCEL_BIAS_STD, np.sqrt(variance) / norm))
