"""Imperfections of subject and sensors, each with its size, source and switch; and the sensor that has them."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.signal import lfilter

from ..arguments import Count, NonNegative, Positive, PositiveOrInfinite, Range, check_fields
from ..errors import BadOption

GRAVITY = 9.81  # [m/s^2]
LONGEST_RUN_S = 0.05  # of lost samples
_MEAN_RUN_S = 0.02
_WARM_UP_S = 900.0
Share = Annotated[float, Range(0.0, closed=True, high=1.0)]


@dataclass(frozen=True)
class Imperfections:
    """Sizes of the imperfections; the defaults are `IDEAL_PRESET`, without any.

    Those of the body are multiples of what the literature gives for people, so 1 is `PEOPLE_PRESET` and 0.3
    `MILD_PRESET`; docs/people.md has sizes and sources. Those of sensors are of the MTi 1-series data sheet, or
    assumptions. An imperfection is off at zero, or a range at infinity. Each has its own stream of random numbers, and
    the number of draws does not depend on the size: a change of one does not change the draws of the others, of the
    motion, the mounts or the noise.
    """

    tissue_gain: NonNegative = 0.0  # sensors turn on their segments as the joints turn
    tissue_random: NonNegative = 0.0  # … at random while these move, by creep of the strap, by acceleration
    sensor_place: Share = 0.0  # sensors sit half-way along a segment; at 1: at 0.6 of an upper arm, 0.85 of a forearm
    girdle: NonNegative = 0.0  # shoulders follow the arm by de Groot & Brand 2001, and each person's differ from that
    elbow: NonNegative = 0.0  # carrying angle, half in the humerus, half in the forearm; abduction in flexion
    wrists: NonNegative = 0.0  # bend in the clasp
    start_pose: NonNegative = 0.0  # offsets of the start pose and of other poses
    sway: NonNegative = 0.0  # of a standing person and hanging arms; breath turns the sensor on the sternum
    palm_slip: NonNegative = 0.0  # [m] palm to palm, rms of the vector's length over the clasp; half each
    start_heading_deg: NonNegative = 0.0  # std of the torso's heading in the start pose; W's x is that of the feet
    mount: Literal["stated", "any"] = "stated"  # within 10 deg of stated axes; any: uniformly random, nothing stated
    gyro_scale: NonNegative = 0.0  # std of each axis, a share
    accel_scale: NonNegative = 0.0  # the same
    misalignment_deg: NonNegative = 0.0  # std of each sensing axis towards each other axis, of either chip
    g_sensitivity_deg_s: NonNegative = 0.0  # [deg/s per g] of the gyroscope, std of the matrix's entries
    gyro_warm_up_deg_s: NonNegative = 0.0  # of the bias in the first 15 min, log-uniform from a tenth of it
    gyro_range_deg_s: PositiveOrInfinite = np.inf  # full scale, cut off beyond
    accel_range_g: PositiveOrInfinite = np.inf  # the same
    bits: Count = 0  # of a sample over the full scale; 0: not quantised
    clock_jitter: NonNegative = 0.0  # [s] std of each sampling time, at most a quarter of a step; not stated
    clock_offset: NonNegative = 0.0  # [s] std of each sensor's clock against the stated time
    clock_drift_ppm: NonNegative = 0.0  # std of each clock's rate
    # share of samples that each sensor loses, in runs of up to 50 ms (mean 20 ms)
    dropped: Annotated[float, Range(0.0, closed=True, high=0.2)] = 0.0
    accel_average: Share = 0.0  # share of the interval that the accelerometer averages; at 1 it is half of it late

    def __post_init__(self) -> None:
        check_fields(self, "")
        if self.bits and not np.isfinite([self.gyro_range_deg_s, self.accel_range_g]).all():
            raise BadOption(f"bits {self.bits} need a finite gyro_range_deg_s and accel_range_g")


_BODY = ("tissue_gain", "tissue_random", "girdle", "elbow", "wrists", "start_pose", "sway")  # of the literature's size
IDEAL_PRESET = Imperfections()
MILD_PRESET = Imperfections(
    **dict.fromkeys(_BODY, 0.3),  # type: ignore[arg-type]
    sensor_place=1.0,
    palm_slip=0.008,
    gyro_scale=0.001,  # this and the next two: non-linearities of the data sheet taken for scale errors, alignment
    accel_scale=0.005,
    misalignment_deg=0.05,
    g_sensitivity_deg_s=0.001,
    gyro_range_deg_s=2000.0,
    accel_range_g=16.0,
    bits=16,
    clock_jitter=0.1e-3,
    clock_offset=1e-3,
    dropped=0.002,
)
PEOPLE_PRESET = replace(
    MILD_PRESET,
    **dict.fromkeys(_BODY, 1.0),  # type: ignore[arg-type]
    palm_slip=0.010,
    start_heading_deg=4.0,
    gyro_warm_up_deg_s=0.2,  # 5 to 10 K under a strap, by data sheets of BMI055, BMI160, ICM-20602, ICM-42688
    clock_drift_ppm=5.0,
)
PRESETS = {"ideal": IDEAL_PRESET, "mild": MILD_PRESET, "people": PEOPLE_PRESET}


# The sensor -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an IMU; the defaults are those of the Xsens MTi-3.

    Densities and in-run stabilities are of the MTi 1-series data sheet; turn-on biases and the correlation time are
    assumptions. White noise has the standard deviation density * sqrt(rate) at each sample, the convention of angle
    and velocity random walk. The bias is the turn-on bias, constant over the recording, plus a first-order Gauss-Markov
    process whose standard deviation is the in-run stability.
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


class Device:
    """One sensor's own errors: measured = matrix @ true (+ g_matrix @ specific force), then bias and noise."""

    def __init__(self, rng: np.random.Generator, sizes: Imperfections, warm_up: np.random.Generator) -> None:
        """Draw the errors; those of a gyroscope that warms up have their own stream."""
        self.sizes = sizes  # range and bits
        direction = warm_up.standard_normal(3)
        change = np.deg2rad(sizes.gyro_warm_up_deg_s) * 10.0 ** warm_up.uniform(-1.0, 0.0)
        self.warm_up = change / np.linalg.norm(direction) * direction  # (3,) [rad/s] in the first 15 min
        scale, tilt, g = rng.standard_normal((2, 3)), rng.standard_normal((2, 3, 3)), rng.standard_normal((3, 3))
        tilt *= np.deg2rad(sizes.misalignment_deg) * (1.0 - np.eye(3))
        self.gyro_matrix = np.eye(3) + sizes.gyro_scale * np.diag(scale[0]) + tilt[0]
        self.accel_matrix = np.eye(3) + sizes.accel_scale * np.diag(scale[1]) + tilt[1]
        self.g_matrix = np.deg2rad(sizes.g_sensitivity_deg_s) / GRAVITY * g  # [rad/s per m/s^2]

    def measure(
        self, rate_S: np.ndarray, force_S: np.ndarray, rate_hz: float, noise: ImuNoise, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Measure the true rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2] with the sensor's errors.

        Return `gyro_S`, `accel_S`, and the true biases `gyro_bias` and `accel_bias`, each (n, 3).
        """
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
        return {"gyro_S": gyro_S, "accel_S": accel_S, "gyro_bias": gyro_bias, "accel_bias": accel_bias}


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
