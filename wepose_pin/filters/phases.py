"""The static phases from which filters start: noise, bias and tilt of sensors in them, their intervals and checks."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import stdtr  # of Student; scipy.stats takes half a second to load

from .. import rotations
from ..compilation import compiled
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, BadPhase, WeposeError
from ..recording import ImuSensor, OrientationSensor, Recording, compute_rate, find_runs, format_span, format_time
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
GRAVITY_RANGE = (3.0, 30.0)  # [m/s²] of a mean norm; another one is no gravity, or in another unit
MOVING_TILT_STD = 0.2  # [rad] tilt error of an accelerometer in motion


@dataclass(frozen=True)
class SensorNoise:
    """Noise and bias of one sensor from a static phase (Lisini Baldi 2019, the Σ̂ of the static test)."""

    gyro_bias: np.ndarray  # (3,) mean of gyro [rad/s]
    gyro_bias_cov: np.ndarray  # (3, 3) [rad²/s²] of that mean, slow motion in the phase included (a person sways)
    gyro_cov: np.ndarray  # (3, 3) Σ̂_ω, sample covariance of gyro [rad²/s²]
    accel_cov: np.ndarray  # (3, 3) Σ̂_g, sample covariance of accel/gravity [1]
    bias_step_cov: np.ndarray  # (3, 3) [rad²/s²] Σ_b, that of gyro's first differences, as in the authors' software
    gravity: float  # mean norm of accel [m/s²]: the gravity scale
    accel_step_var: float  # [1] variance of the first differences of accel/gravity, the mean over its axes
    # (3, 3) covariance of gyro's means over `BLOCK_S` [rad²/s²], with sway; zero: white noise
    gyro_half_second_cov: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    def sway_density(self, rate_hz: float) -> float:
        """Compute the density [rad²/s] of sway on each axis; the mean rate over T s has 1/T of it as variance."""
        white = average_variance(self.gyro_cov) / (BLOCK_S * rate_hz)
        total, bias = average_variance(self.gyro_half_second_cov), average_variance(self.gyro_bias_cov)
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
    accel_step_var=2.0 * 0.003**2,
)


def estimate_noise(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, worn: bool = False) -> SensorNoise:
    """Estimate noise and bias from static samples: `gyro_S` (n, 3) [rad/s], `accel_S` (n, 3) [m/s²].

    `worn`: a person wears the sensor and sways. A phase of a second or two does not show sway, so its uncertainty is
    added to that of the bias. `BadPhase`: fewer than 10 samples, or accel without gravity in m/s².
    """
    n = len(gyro_S)
    if n < 10:
        raise BadPhase(f"the static phase holds {n} samples; at least 10 are needed to measure noise")
    gravity = float(np.sqrt(np.einsum("ni,ni->n", accel_S, accel_S)).mean())
    if not GRAVITY_RANGE[0] < gravity < GRAVITY_RANGE[1]:
        needed = "specific force in m/s² is needed, 9.8 upwards when static"
        raise BadPhase(f"accel_S is {gravity:.3g} in the static phase, which is no gravity; {needed}")
    size = max(1, round(BLOCK_S * rate_hz))
    gyro_bias, gyro_cov, step_cov, half_second_cov = _compute_moments(gyro_S, size)
    _, accel_cov, accel_step_cov, _ = _compute_moments(accel_S / gravity, size)
    blocks = n // size
    if blocks < 4:  # means of blocks average white noise out and keep sway; so few show none
        half_second_cov = np.zeros((3, 3))
    bias_cov = gyro_cov / n if blocks < 4 or worn else half_second_cov / blocks
    floors = np.square([BIAS_FLOOR, GYRO_FLOOR, ACCEL_FLOOR, GYRO_FLOOR])[:, None, None] * np.eye(3)
    bias_cov, gyro_cov, accel_cov, step_cov = floors + [bias_cov, gyro_cov, accel_cov, step_cov]
    if worn:  # what sways comes back: its mean is smaller than that of independent blocks
        half_second_cov = _estimate_sway_cov(half_second_cov, average_variance(step_cov) / 2.0 / size, blocks)
        allowed = min(1.0, 2.0 / (SWAY_RATE * n / rate_hz) ** 2)
        bias_cov = bias_cov + average_variance(half_second_cov) * allowed * np.eye(3)
    return SensorNoise(
        gyro_bias=gyro_bias,
        gyro_bias_cov=bias_cov,
        gyro_cov=gyro_cov,
        accel_cov=accel_cov,
        bias_step_cov=step_cov,
        gravity=gravity,
        accel_step_var=average_variance(accel_step_cov),
        gyro_half_second_cov=half_second_cov,
    )


def _estimate_sway_cov(measured: np.ndarray, white: float, blocks: int) -> np.ndarray:
    """Estimate the covariance (3, 3) [rad²/s²] of a worn sensor's means over so many blocks by sway.

    It is the `measured` one with `SWAY_RATE_STD` as a prior, or without it where the means vary like `white` noise. A
    phase of less than two seconds gives no estimate: half a sway looks like a steady rotation.
    """
    if blocks < 4:
        return SWAY_RATE_STD**2 * np.eye(3)
    prior = PRIOR_BLOCKS * min(1.0, max(0.0, average_variance(measured) - white) / LEAST_SWAY_STD**2)
    return (prior * SWAY_RATE_STD**2 * np.eye(3) + (blocks - 1) * measured) / (prior + blocks - 1)


@compiled
def _compute_moments(values, size):  # type: ignore[no-untyped-def]
    """Compute the mean (3,) of samples (n, 3), and covariances of them, their steps and the means of their blocks."""
    steps, blocks = values[1:] - values[:-1], average_blocks(values, size)
    return average_blocks(values, len(values))[0], _compute_cov(values), _compute_cov(steps), _compute_cov(blocks)


@compiled
def _compute_cov(values):  # type: ignore[no-untyped-def]
    mean, cov = np.zeros(3), np.zeros((3, 3))
    for k in range(len(values)):
        for i in range(3):
            mean[i] += values[k, i] / len(values)
    for k in range(len(values)):
        for i in range(3):
            for j in range(3):
                cov[i, j] += (values[k, i] - mean[i]) * (values[k, j] - mean[j])
    return cov / (len(values) - 1)


@compiled
def average_blocks(values, size):  # type: ignore[no-untyped-def]
    """Means (n // size, 3) of the complete blocks of `size` samples (n, 3), in a tenth of the time of `mean`."""
    means = np.zeros((len(values) // size, 3))
    for k in range(len(means) * size):
        for i in range(3):
            means[k // size, i] += values[k, i]
    return means / size


def average_variance(cov: np.ndarray) -> float:
    """Return the mean variance of the axes of a covariance (3, 3)."""
    return float(cov[0, 0] + cov[1, 1] + cov[2, 2]) / 3.0


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
    size = max(1, round(BLOCK_S * rate_hz))
    blocks, up = len(force) // size, mean / norm
    # In less than four blocks sway does not average out.
    parts, count = (average_blocks(force, size), blocks) if blocks >= 4 else (force, 1)
    across = parts - np.outer(parts @ up, up)
    variance = float(across.var(axis=0, ddof=min(1, count - 1)).sum()) / 2.0 / count
    return rotations.quat_from_gravity(mean), float(np.hypot(ACCEL_BIAS_STD, np.sqrt(variance) / norm))


# Intervals -----------------------------------------------------------------------------------------------------------

# Motion in the start pose: root mean square of the rate, and largest rotation from the mean. A standing person sways
# below 3 deg/s and 3 deg. Above `MOVES` the mean pose is not the start pose; above `SWAYS` it is a warning.
MOVES_DEG_S, MOVES_DEG = 20.0, 15.0
SWAYS_DEG_S, SWAYS_DEG = 6.0, 5.0
# All sensors rotate about the vertical at one rate when the person rotates: a mean rate [rad/s] above `COMMON_RATE`
# with a probability by chance below `COMMON_RATE_CHANCE`, in three sensors or more.
COMMON_RATE, COMMON_RATE_CHANCE, FEWEST_SENSORS = float(np.deg2rad(0.5)), 1e-3, 3
# Where a sensor turns faster than `SWAYS_DEG_S` over `MOTION_BLOCK_S`, it moves; a tremor averages out over so long.
MOTION_BLOCK_S = 0.2
LEAST_STATIC_S = 1.0  # of an interval with motion in it, that must be static

# Without stated phases the most static window of this length in the beginning is used.
WINDOW_S = 2.0
BEGINNING_S = 20.0

# Samples of a static phase, and the share of them that each sensor must have measured.
FEWEST_AT_START, LEAST_SHARE_AT_START = 10, 0.5


def find_reference_phases(
    recording: Recording, sways: bool
) -> tuple[tuple[float, float], tuple[float, float], dict[str, SensorNoise], list[Diagnostic]]:
    """Find the start pose [s], the phase of noise and bias [s], segment → noise of its sensor, and their diagnostics.

    The noise is that of sensors with a filter; the recording's diagnostics come first. `sways`: a person stands in the
    start pose; a mechanism stands still. `WeposeError`: a phase with too few samples, with motion, or without gravity.
    """
    stated, lying = recording.phases.get("start", ()), recording.phases.get("static", ())
    where = recording.where()
    if lying and not stated:
        raise BadPhase(f"{where}: phases.static without phases.start; name its seconds, start = [[from, to]]")
    diagnostics = list(recording.diagnostics)
    for phase, intervals in (("start", stated), ("static", lying)):
        if len(intervals) > 1:
            facts = {"start": intervals[0][0], "end": intervals[0][1]}
            diagnostics.append(Diagnostic("phase-intervals-ignored", WARNING, phase, facts=facts))
    start, place = stated[0] if stated else find_static_window(recording), "phases.start"
    _check_samples(recording, start, "start")
    if not stated or recording.start_is_guessed:
        if not all(sensor.aligned for sensor in recording.sensors.values()):
            diagnostics.append(Diagnostic("start-pose-guessed", WARNING, facts={"start": start[0], "end": start[1]}))
        place = "the guessed start pose"
    else:
        start = _find_static_part(recording, start, "start", diagnostics)
    static = start
    if lying:
        _check_samples(recording, lying[0], "static")
        static = _find_static_part(recording, lying[0], "static", diagnostics)
    noises, up_S = dict[str, SensorNoise](), dict[str, np.ndarray]()
    for segment, sensor in recording.sensors.items():
        if not sensor.aligned:
            diagnostics += _check_motion(recording, segment, start, place)
            diagnostics += _check_motion(recording, segment, static, "phases.static") if lying else []
        if isinstance(sensor, ImuSensor):
            part, worn = sensor.part(recording.find_measured(segment, static)), static == start and sways
            try:
                noises[segment] = estimate_noise(part.gyro_S, part.accel_S, recording.rate_hz, worn)
            except WeposeError as error:
                raise type(error)(f"{where}: sensors.{segment}.{error}") from error
            force_S = part.accel_S.mean(axis=0)
            up_S[segment] = force_S / np.linalg.norm(force_S)
    diagnostics += _check_common_rotation(f"{where}: {'phases.static' if lying else place}", static, noises, up_S)
    return start, static, noises, diagnostics


def _check_samples(recording: Recording, interval: tuple[float, float], phase: str) -> None:
    """Check that each sensor has measured in an interval [s]."""
    place = f"{recording.where()}: phases.{phase}: [{format_time(interval[0])}, {format_time(interval[1])}]"
    samples = len(recording.time[recording.span(interval)])
    if samples < FEWEST_AT_START:
        raise BadPhase(f"{place} holds {samples} samples; it needs at least {FEWEST_AT_START}, better two seconds")
    for segment in recording.sensors:
        measured = len(recording.find_measured(segment, interval))
        if measured < max(FEWEST_AT_START, LEAST_SHARE_AT_START * samples):
            raise BadPhase(
                f"{place}: sensors.{segment} is lost in {samples - measured} of its {samples} samples: its tilt "
                f"is not known; name seconds in which it measures, or take [sensors.{segment}] out"
            )


def _find_static_part(
    recording: Recording, interval: tuple[float, float], phase: str, diagnostics: list[Diagnostic]
) -> tuple[float, float]:
    """Find the longest part [s] of a stated interval in which no sensor moves, and add the diagnostic that says so.

    `BadPhase`: the interval has motion in it, and no part of `LEAST_STATIC_S` without.
    """
    span = recording.span(interval)
    size = span.stop - span.start
    blocks = np.arange(0, size, max(1, round(MOTION_BLOCK_S * recording.rate_hz)))
    fastest, rate_deg_s, moves = "", 0.0, np.zeros(len(blocks), dtype=bool)
    for segment, sensor in recording.sensors.items():
        if sensor.aligned:
            continue
        part = sensor.part(span)
        measured = np.ones(size) if part.gap is None else 1.0 - part.gap
        counts = np.add.reduceat(measured, blocks)
        rate = compute_rate(part, recording.rate_hz) * measured[:, None]
        means = np.add.reduceat(rate, blocks) / np.maximum(1.0, counts)[:, None]
        off = np.degrees(np.linalg.norm(means - np.median(means[counts > 0.0], axis=0), axis=1)) * (counts > 0.0)
        moves |= off > SWAYS_DEG_S
        if off.max() > rate_deg_s:
            fastest, rate_deg_s = segment, float(off.max())
    if not moves.any():
        return interval
    moves = np.convolve(moves, [1, 1, 1], mode="same") > 0  # motion begins and ends gently: a block more on both sides
    begin, end = max(find_runs(~moves), key=lambda run: run[1] - run[0], default=(0, 0))
    rows = span.start + np.append(blocks, size)
    static = (float(recording.time[rows[begin]]), float(recording.time[rows[end] - 1]))
    if begin == end or static[1] - static[0] < LEAST_STATIC_S:
        raise BadPhase(
            f"{recording.where()}: phases.{phase}: sensors.{fastest} turns at up to {rate_deg_s:.0f} deg/s in "
            f"{format_span(interval)}, and less than {LEAST_STATIC_S:g} s of it is static; name seconds in which "
            f"nothing moves, better four"
        )
    facts: dict[str, float | str] = {"phase": f"phases.{phase}", "start": static[0], "end": static[1]}
    facts |= {"stated_start": interval[0], "stated_end": interval[1]}
    facts["example"] = f"{phase} = [[{format_time(static[0])}, {format_time(static[1])}]]"
    value, limit = np.deg2rad([rate_deg_s, SWAYS_DEG_S]).tolist()
    diagnostics.append(Diagnostic("static-phase-trimmed", WARNING, fastest, value, limit, facts))
    return static


def _check_motion(recording: Recording, segment: str, interval: tuple[float, float], place: str) -> list[Diagnostic]:
    """Check that a sensor is static in an interval [s]; sway gives a warning.

    The rotation excludes the mean rate, in which the gyroscope's bias and a steady rotation cannot be separated.
    """
    sensor = recording.sensors[segment].part(recording.find_measured(segment, interval))
    rate = np.degrees(compute_rate(sensor, recording.rate_hz))
    rms = float(np.sqrt(np.mean(np.sum(rate**2, axis=1))))
    bias = 0.0 if isinstance(sensor, OrientationSensor) else rate.mean(axis=0)
    angle = np.cumsum(rate - bias, axis=0) / recording.rate_hz
    turn = float(np.linalg.norm(angle - angle.mean(axis=0), axis=1).max())
    if rms > MOVES_DEG_S or turn > MOVES_DEG:
        raise BadPhase(
            f"{recording.where()}: sensors.{segment} turns by {turn:.0f} deg and at {rms:.0f} deg/s rms in {place} "
            f"({format_span(interval)}); name seconds in which it is static, up to {MOVES_DEG_S:g} deg/s and "
            f"{MOVES_DEG:g} deg"
        )
    if rms <= SWAYS_DEG_S and turn <= SWAYS_DEG:
        return []
    value, limit, rotation, rotation_limit = np.deg2rad([rms, SWAYS_DEG_S, turn, SWAYS_DEG]).tolist()
    facts: dict[str, float | str] = {"phase": place, "start": interval[0], "end": interval[1]}
    facts |= {"rotation": rotation, "rotation_limit": rotation_limit}
    return [Diagnostic("start-pose-motion", WARNING, segment, value, limit, facts)]


def _check_common_rotation(
    place: str, interval: tuple[float, float], noises: dict[str, SensorNoise], up_S: dict[str, np.ndarray]
) -> list[Diagnostic]:
    """Check that the person does not rotate in a phase: the mean rate there is taken for the gyroscopes' biases.

    Biases about the vertical differ from sensor to sensor; a common rate is the person's (one-sample t-test). A slow
    rotation gives a warning and is added to the biases' covariance in `noises`.
    """
    rates = np.array([noise.gyro_bias @ up_S[segment] for segment, noise in noises.items()])
    if len(rates) < FEWEST_SENSORS:
        return []
    mean, error = float(rates.mean()), max(float(rates.std(ddof=1)), 1e-9) / np.sqrt(len(rates))
    if abs(mean) < COMMON_RATE or 2.0 * stdtr(len(rates) - 1, -abs(mean) / error) > COMMON_RATE_CHANCE:
        return []
    turn_deg = abs(np.degrees(mean)) * (interval[1] - interval[0])
    if turn_deg > MOVES_DEG:
        raise BadPhase(
            f"{place} ({format_span(interval)}): all sensors turn about the vertical at {np.degrees(mean):.1f} deg/s, "
            f"by {turn_deg:.0f} deg in all: name seconds in which the person does not turn"
        )
    for segment, noise in noises.items():
        turning = mean**2 * np.outer(up_S[segment], up_S[segment])
        noises[segment] = replace(noise, gyro_bias_cov=noise.gyro_bias_cov + turning)
    facts: dict[str, float | str] = {"variant": "rotates", "rotation": float(np.deg2rad(turn_deg))}
    return [Diagnostic("start-pose-motion", WARNING, value=abs(mean), limit=COMMON_RATE, facts=facts)]


def find_static_window(recording: Recording) -> tuple[float, float]:
    """Find the interval [s] of `WINDOW_S` in the first `BEGINNING_S` in which all sensors measure and move least.

    A steady rotation about the vertical has no variance: the mean rate that all sensors share counts as motion.
    `BadPhase`: every window has a lost sensor.
    """
    time, rate_hz = recording.time, recording.rate_hz
    n = int(np.searchsorted(time, time[0] + BEGINNING_S, side="right"))
    window = min(max(round(WINDOW_S * rate_hz), 10), n)
    stride = max(1, window // 40)  # the windows need not begin at every sample

    def slide(values: np.ndarray) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(values[:n], window, axis=0)[::stride]

    motion, vertical_rates = np.zeros(len(range(0, n - window + 1, stride))), []
    for sensor in recording.sensors.values():
        rates = slide(compute_rate(sensor.part(slice(n)), rate_hz))
        motion += rates.var(axis=-1).sum(axis=-1)
        if isinstance(sensor, ImuSensor):
            up = slide(sensor.accel_S).mean(axis=-1)
            force = np.maximum(np.linalg.norm(up, axis=1), 1e-9)  # of a dead accelerometer zero
            vertical_rates.append(np.einsum("ni,ni->n", rates.mean(axis=-1), up) / force)
        if sensor.gap is not None:  # a bridge has no motion
            motion[slide(sensor.gap).any(axis=-1)] = np.inf
    if vertical_rates:
        motion += len(vertical_rates) * np.mean(vertical_rates, axis=0) ** 2
    if not np.isfinite(motion).any():
        lost = [name for name, sensor in recording.sensors.items() if sensor.gap is not None and sensor.gap[:n].any()]
        raise BadPhase(
            f"{recording.where()}: no {WINDOW_S:g} s in the first {BEGINNING_S:g} s in which all sensors measure: "
            f"{', '.join(f'sensors.{name}' for name in lost)} are lost there; take them out, or name the start pose, "
            f"[phases] start = [[from, to]]"
        )
    first = int(np.argmin(motion)) * stride
    return float(time[first]), float(time[first + window - 1])
