"""Sensor noise and bias from a phase in which the sensor lies still (Lisini Baldi 2019, the Σ̂ of the static test)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import BadPhase
from ..recording import ImuSensor, Recording

# A quantised signal can stand still to the last bit; below these standard deviations no MEMS sensor is believed, and
# the covariances stay invertible.
GYRO_FLOOR = 1e-5  # [rad/s]
ACCEL_FLOOR = 1e-5  # [g]
BIAS_FLOOR = 1e-6  # [rad/s] of the bias itself, that is 0.2 deg/h

# Blocks for the covariance of the mean: long against the sensor's noise, short against a person's sway.
BLOCK_S = 0.5

# A person who stands sways at 0.3 to 0.5 deg/s (rms) below 0.5 Hz and tilts by 0.2 to 0.4 deg; a hanging arm and a
# breathing chest turn faster. What a sensor's mean rate over T seconds is off by is that rate, and at most what such a
# tilt allows: √2 σ/(ω T).
SWAY_RATE_STD = float(np.deg2rad(0.7))  # [rad/s] of a worn sensor
SWAY_RATE = 2.0 * np.pi * 0.2  # [rad/s] ω, of the slower sways
PRIOR_BLOCKS = 4.0
SWAY_CORRELATION_S = 2.0  # half a sway: so long half-second means go on alike
STEADY_TURN_S = 20.0  # so long may a person turn steadily, as on an office chair
LEAST_SWAY_STD = float(np.deg2rad(0.03))  # [rad/s] of the means of blocks, beyond white noise: less is no person

# Without stated phases: the find_static_window stretch of this length within the beginning is taken.
QUIET_S = 2.0
BEGINNING_S = 20.0


@dataclass(frozen=True)
class SensorNoise:
    """What a static phase says of one sensor.

    Parameters
    ----------
    gyro_bias : (3,) mean of gyro [rad/s]
    gyro_bias_cov : (3, 3) covariance of that mean [rad²/s²], slow motion in the phase included (a person sways)
    gyro_cov : (3, 3) Σ̂_ω, sample covariance of gyro [rad²/s²]
    accel_cov : (3, 3) Σ̂_g, sample covariance of accel/gravity [1]
    bias_step_cov : (3, 3) Σ_b, covariance of the first differences of gyro [rad²/s²], as in the authors' software
    gravity : mean norm of accel [m/s²]: the gravity scale
    gyro_half_second_cov : (3, 3) covariance of gyro's means over `BLOCK_S` [rad²/s²]: a person sways; None: white noise
    """

    gyro_bias: np.ndarray
    gyro_bias_cov: np.ndarray
    gyro_cov: np.ndarray
    accel_cov: np.ndarray
    bias_step_cov: np.ndarray
    gravity: float
    gyro_half_second_cov: np.ndarray | None = None

    def sway_density(self, rate_hz: float) -> float:
        """Density [rad²/s] of slow motion at rest, each axis: the variance of the mean rate over T s is 1/T of it."""
        if self.gyro_half_second_cov is None:
            return 0.0
        white = float(np.trace(self.gyro_cov)) / 3.0 / (BLOCK_S * rate_hz)
        total, bias = float(np.trace(self.gyro_half_second_cov)) / 3.0, float(np.trace(self.gyro_bias_cov)) / 3.0
        if total <= white:
            return 0.0
        # Where the bias is hardly better known than the sway, a steady turn is as likely as a bias, while it lasts.
        lasts_s = STEADY_TURN_S * min(1.0, bias / total) if bias > 0.3 * total else SWAY_CORRELATION_S
        return (total - white) * lasts_s


def estimate_noise(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, worn: bool = False) -> SensorNoise:
    """Noise and bias from samples at rest: `gyro_S` (n, 3) [rad/s], `accel_S` (n, 3) [m/s²].

    `worn`: a person wears the sensor and sways, which a phase of a second or two does not show: the bias is then as
    uncertain as sway makes it.

    Raises
    ------
    BadPhase
        Fewer than 10 samples, or no gravity in them.
    """
    if len(gyro_S) < 10:
        raise BadPhase(f"the static phase holds {len(gyro_S)} samples; at least 10 are needed to measure noise")
    gravity = float(np.linalg.norm(accel_S, axis=1).mean())
    if not gravity > 0.0:
        raise BadPhase(
            "the static phase holds no gravity: accel is zero; the filter needs specific force, +g up at rest"
        )
    half_second_cov, bias_cov = _cov_of_half_seconds(gyro_S, rate_hz), _cov_of_mean(gyro_S, rate_hz)
    if worn:
        half_second_cov = _sway_cov(gyro_S, rate_hz, half_second_cov)
        allowed = min(1.0, 2.0 / (SWAY_RATE * len(gyro_S) / rate_hz) ** 2)
        bias_cov = bias_cov + float(np.trace(half_second_cov)) / 3.0 * allowed * np.eye(3)
    return SensorNoise(
        gyro_bias=gyro_S.mean(axis=0),
        gyro_bias_cov=bias_cov,
        gyro_cov=_floored(np.cov(gyro_S.T), GYRO_FLOOR),
        accel_cov=_floored(np.cov(accel_S.T / gravity), ACCEL_FLOOR),
        bias_step_cov=_floored(np.cov(np.diff(gyro_S, axis=0).T), GYRO_FLOOR),
        gravity=gravity,
        gyro_half_second_cov=half_second_cov,
    )


def _sway_cov(gyro_S: np.ndarray, rate_hz: float, measured: np.ndarray | None) -> np.ndarray:
    """Covariance (3, 3) [rad²/s²] of a worn sensor's half-second means by sway: as `measured`, with `SWAY_RATE_STD`
    counted as `PRIOR_BLOCKS` more of them, or as none where they vary by no more than white noise.

    Of fewer than two seconds, in which half a sway is a steady turn, nothing can be told: it is `SWAY_RATE_STD`.
    """
    if measured is None:
        return SWAY_RATE_STD**2 * np.eye(3)
    half_second = max(1, round(BLOCK_S * rate_hz))
    white = float(np.diff(gyro_S, axis=0).var(axis=0).mean()) / 2.0 / half_second
    excess = float(np.trace(measured)) / 3.0 - white
    prior = PRIOR_BLOCKS * min(1.0, max(0.0, excess) / LEAST_SWAY_STD**2)
    degrees = len(gyro_S) // half_second - 1
    return (prior * SWAY_RATE_STD**2 * np.eye(3) + degrees * measured) / (prior + degrees)


def _cov_of_mean(gyro_S: np.ndarray, rate_hz: float) -> np.ndarray:
    """Covariance of the mean from the means of blocks: white noise averages out in them, sway stays and is counted."""
    of_blocks = _cov_of_half_seconds(gyro_S, rate_hz)
    if of_blocks is None:  # too short to see sway: the white part is all that can be said
        return _floored(np.cov(gyro_S.T) / len(gyro_S), BIAS_FLOOR)
    return _floored(of_blocks / (len(gyro_S) // max(1, round(BLOCK_S * rate_hz))), BIAS_FLOOR)


def _cov_of_half_seconds(gyro_S: np.ndarray, rate_hz: float) -> np.ndarray | None:
    """Covariance of the means of blocks; None where there are fewer than four."""
    size = max(1, round(BLOCK_S * rate_hz))
    blocks = len(gyro_S) // size
    if blocks < 4:
        return None
    return np.cov(gyro_S[: blocks * size].reshape(blocks, size, 3).mean(axis=1).T)


def _floored(cov: np.ndarray, std: float) -> np.ndarray:
    return cov if np.linalg.eigvalsh(cov)[0] >= std**2 else cov + std**2 * np.eye(3)


def find_static_window(recording: Recording) -> tuple[float, float]:
    """Interval [s] of `QUIET_S` within the first `BEGINNING_S` in which all sensors measure and together move least.

    A steady rotation about the vertical varies nothing: what all sensors have of it in common counts as motion.

    Raises
    ------
    BadPhase
        In each of them a sensor was lost.
    """
    time, rate_hz = recording.time, recording.rate_hz
    n = int(np.searchsorted(time, time[0] + BEGINNING_S, side="right"))
    window = min(max(round(QUIET_S * rate_hz), 10), n)
    stride = max(1, window // 40)  # the windows need not begin at every sample
    motion = np.zeros(len(range(0, n - window + 1, stride)))
    vertical_rate = np.zeros((0, len(motion)))
    for sensor in recording.sensors.values():
        if isinstance(sensor, ImuSensor):
            signal = sensor.gyro_S[:n]
        else:
            # 2 (q[k] − q[k−1]) is the rotation between samples, with the signs made to agree.
            quat = sensor.quat_WS[:n]
            flips = np.sign(np.einsum("ni,ni->n", quat[1:], quat[:-1]))[:, None]
            signal = 2.0 * rate_hz * np.concatenate([np.zeros((1, 4)), quat[1:] - flips * quat[:-1]])
        windows = np.lib.stride_tricks.sliding_window_view(signal, window, axis=0)[::stride]
        motion += windows.var(axis=-1).sum(axis=-1)
        if isinstance(sensor, ImuSensor):
            up = np.lib.stride_tricks.sliding_window_view(sensor.accel_S[:n], window, axis=0)[::stride].mean(axis=-1)
            rate = np.einsum("ni,ni->n", windows.mean(axis=-1), up) / np.linalg.norm(up, axis=1)
            vertical_rate = np.vstack([vertical_rate, rate])
        if sensor.gap is not None:  # what was bridged is quieter than any person
            motion[np.lib.stride_tricks.sliding_window_view(sensor.gap[:n], window)[::stride].any(axis=-1)] = np.inf
    if len(vertical_rate):
        motion += len(vertical_rate) * vertical_rate.mean(axis=0) ** 2
    if not np.isfinite(motion).any():
        lost = [name for name, sensor in recording.sensors.items() if sensor.gap is not None and sensor.gap[:n].any()]
        raise BadPhase(
            f"{recording.where()}: no {QUIET_S:g} s in the first {BEGINNING_S:g} s in which all sensors measure: "
            f"{', '.join(f'sensors.{name}' for name in lost)} are lost there; take them out, or name the start pose, "
            f"[phases] start = [[from, to]]"
        )
    first = int(np.argmin(motion)) * stride
    return float(time[first]), float(time[first + window - 1])
