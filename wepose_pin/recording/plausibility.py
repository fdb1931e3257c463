"""Plausibility of the sensors' values against the session: units, ranges, saturation.

The rules are physical and hold for any sensor on any body:

- a static accelerometer measures gravity;
- specific force, rotated by the gyroscope, averages to gravity over seconds, since speed is bounded;
- a sensor that was tilted has rotated at least by the tilt.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from ..compilation import compiled
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongUnit
from ..rotations import unroll
from .gaps import find_runs, find_static_second
from .intervals import format_span
from .limits import (
    GRAVITY_ERROR_NOTED,
    GRAVITY_ERROR_REFUSED,
    HIGHEST_ACCEL,
    HIGHEST_RATE,
    NARROWEST_ACCEL_RANGE,
    NARROWEST_GYRO_RANGE,
    STANDARD_GRAVITY,
)
from .recording import Recording
from .sensors import ImuSensor

WINDOW_S = 2.0  # [s] over which specific force averages to gravity
WINDOWS = 40  # number of windows, those with most motion
FEWEST_WINDOWS = 3
# Coherence measures how near the mean of rotated specific force is to gravity. Rates in deg/s that are taken for rad/s
# lower it below one of these shares of the coherence of rates smaller by a factor 57.3. In 41 real sensors with three
# windows or more, none is below the first share, and none that rotates so fast is below the second.
TUMBLES, COHERENT = 0.6, 0.8  # the share, and the least coherence of the smaller rates
TUMBLES_FAST, FAST = 0.85, 8.0  # the share, and the least mean rate [rad/s]
STIFF = 0.93  # the share of the coherence of rates larger by a factor 57.3, where these are coherent
TILTED = np.deg2rad(20.0)  # [rad] tilt between two windows that the gyroscope must measure
# Rates in deg/s that are taken for rad/s: gravity would turn by more than `TURNED` in both halves of some seconds while
# accel turns by less than `STEADY`, both averaged over `STEADY_MEAN_S`. In four seconds that is 6 deg/s, the fastest
# sway of a start pose.
TURNED, STEADY, STEADY_MEAN_S = np.deg2rad(10.0), np.deg2rad(5.0), 0.25  # [rad], [rad], [s]
UNSEEN = 0.25  # largest share of that tilt in the gyroscope's rotation where its unit is too small

# An axis with `PLATEAU` samples at its extreme is saturated if the motion before and after leads beyond it by `BEYOND`
# digits; a smooth peak stays within one digit. Noise that flattens a peak by chance is excluded at `IMPROBABLE`
# standard deviations, or at a probability below `COINCIDENCE`.
PLATEAU, BEYOND, IMPROBABLE, COINCIDENCE = 3, 2.0, 5.0, 1e-4
NOISE_SAMPLES = 25  # samples on each side of a plateau for the noise
NOISE_JERK = float(ndtri(0.75) * np.sqrt(20.0))  # median size of the third differences of noise with deviation 1
ROUNDING = 1e-9  # steps below this share of the largest value are rounding, not noise


def check_signals(recording: Recording) -> tuple[Diagnostic, ...]:
    """Check the sensors' values: units, ranges, and with diagnostics gravity's norm and saturation.

    Raises
    ------
    BadData
        Values of another unit, or beyond the range of any sensor.
    """
    diagnostics: list[Diagnostic] = []
    for segment, sensor in recording.imus.items():
        place = f"{recording.where()}: sensors.{segment}"
        diagnostics += _check_gravity(recording, segment, sensor, place)
        _check_gyro_unit(sensor, recording.rate_hz, place)
        _check_range(recording.time, sensor.gyro_S, HIGHEST_RATE, "rad/s", f"{place}.gyro")
        _check_range(recording.time, sensor.accel_S, HIGHEST_ACCEL, "m/s^2", f"{place}.accel")
        for name, values, least in (
            ("gyro", sensor.gyro_S, NARROWEST_GYRO_RANGE),
            ("accel", sensor.accel_S, NARROWEST_ACCEL_RANGE),
        ):
            cut = find_cut_off(values, least)
            if name == "gyro" and not cut.any():  # resampling mixes samples: the range is that of the sensor's own
                cut = np.abs(values) >= sensor.gyro_range
            if cut.any():
                facts: dict[str, float | str] = {"variant": name, "range": float(np.abs(values[cut]).min())}
                seconds = np.count_nonzero(cut.any(axis=1)) / recording.rate_hz
                diagnostics.append(Diagnostic("signal-saturated", WARNING, segment, seconds, facts=facts))
    return tuple(diagnostics)


def _check_gravity(recording: Recording, segment: str, sensor: ImuSensor, place: str) -> list[Diagnostic]:
    name = next((name for name in ("static", "start") if recording.phases.get(name)), "")
    if name:
        static, when = recording.find_measured(segment, recording.phases[name][0]), f"in phases.{name}"
    else:
        good = (np.abs(sensor.gyro_S) < sensor.gyro_range).all(axis=1)  # a rate at the limit varies least of all
        good = good if sensor.gap is None else good & ~sensor.gap
        static = find_static_second(sensor.gyro_S, good, recording.rate_hz)
        when = "in the second in which it turns most evenly"
    if len(static) < 2:
        return []
    first, last = (float(recording.time[k]) for k in static[[0, -1]])
    norm = float(np.linalg.norm(sensor.accel_S[static], axis=1).mean())
    share = norm / STANDARD_GRAVITY - 1.0
    if abs(share) > GRAVITY_ERROR_REFUSED:
        text = f"norm {norm:.4g} m/s^2 {when} ({format_span((first, last))})"
        raise _make_gravity_error(f"{place}.accel: {text}, where gravity's {STANDARD_GRAVITY:.3g} is expected", norm)
    if abs(share) <= GRAVITY_ERROR_NOTED:
        return []
    facts = {"norm": norm, "start": first, "end": last}
    return [Diagnostic("accel-scale", WARNING, segment, share, GRAVITY_ERROR_NOTED, facts)]


def _make_gravity_error(text: str, norm: float) -> BadData:
    """Make the error about a norm [m/s²] that is not gravity's, with the unit in which it would be."""
    for factor, unit in (
        (STANDARD_GRAVITY, "g"),
        (1.0 / STANDARD_GRAVITY, "m/s^2"),
        (1e-3 * STANDARD_GRAVITY, "mg"),
        (1e-3, "mg"),  # stated in g
    ):
        if abs(norm * factor / STANDARD_GRAVITY - 1.0) < GRAVITY_ERROR_REFUSED:
            return WrongUnit(text, "accel_unit", unit)
    return BadData(f"{text}; {_explain_norm(norm)}")


def _explain_norm(norm: float) -> str:
    """Explain a norm [m/s²] that is not gravity's in any unit."""
    if norm < 0.5:
        return "gravity seems to have been taken out; specific force is needed, +g up of a static sensor"
    return "check the unit and the sensor's calibration, and that it is static there"


def _check_gyro_unit(sensor: ImuSensor, rate_hz: float, place: str) -> None:
    """Raise `WrongUnit` where gravity shows that the rates are in another unit."""
    gyro_S = sensor.gyro_S
    size = round(WINDOW_S * rate_hz)
    count = len(gyro_S) // size
    gyro, accel = (values[: count * size].reshape(count, size, 3) for values in (gyro_S, sensor.accel_S))
    at = np.arange(count)
    if sensor.gap is not None:  # without bridged samples
        at = at[~sensor.gap[: count * size].reshape(count, size).any(axis=1)]
    if len(at) < FEWEST_WINDOWS:
        return
    speed = np.linalg.norm(gyro, axis=2).mean(axis=1)
    moving = at[np.argsort(-speed[at], kind="stable")[:WINDOWS]]
    as_stated = _average_coherence(1.0, gyro[moving], accel[moving], rate_hz)
    if as_stated < max(TUMBLES, TUMBLES_FAST, STIFF):  # coherence is at most 1: above it no other unit is better
        smaller = _average_coherence(np.pi / 180.0, gyro[moving], accel[moving], rate_hz)
        larger = _average_coherence(180.0 / np.pi, gyro[moving], accel[moving], rate_hz)
        peak = float(np.max(np.abs(gyro_S)))
        tumbles = as_stated < TUMBLES * smaller and smaller > COHERENT
        if tumbles or (as_stated < TUMBLES_FAST * smaller and speed[moving].mean() > FAST):
            raise WrongUnit(
                f"{place}.gyro: with rates up to {peak:.3g} rad/s gravity would tumble, and accel shows that it does "
                f"not",
                "gyro_unit",
                "deg/s",
                ", or the time or rate_hz is wrong",
            )
        measurable = peak * 180.0 / np.pi < HIGHEST_RATE  # a saturated sensor turns too little in its own unit
        if measurable and as_stated < STIFF * larger and larger > COHERENT:
            raise WrongUnit(
                f"{place}.gyro: with rates up to {peak:.3g} rad/s the sensor turns too little for what accel shows",
                "gyro_unit",
                "rad/s",
                ", or the time or rate_hz is wrong",
            )
    mean = accel.mean(axis=1)
    norm = np.linalg.norm(mean, axis=1)
    up = mean / np.maximum(norm, 1e-9)[:, None]
    tilt = np.arccos(np.clip(np.sum(up[1:] * up[:-1], axis=1), -1.0, 1.0))
    steady = (np.abs(norm / STANDARD_GRAVITY - 1.0) < 0.1) & np.isin(np.arange(count), at)
    tilt[~(steady[1:] & steady[:-1])] = 0.0
    path = WINDOW_S * speed
    unseen = (tilt > TILTED) & (path[1:] + path[:-1] < UNSEEN * tilt)
    if unseen.any():
        k = int(np.argmax(np.where(unseen, tilt, 0.0)))
        raise WrongUnit(
            f"{place}.gyro: accel shows a tilt by {np.degrees(tilt[k]):.0f} deg between {k * size / rate_hz:g} and "
            f"{(k + 2) * size / rate_hz:g} s from the beginning, gyro turns by {np.degrees(path[k] + path[k + 1]):.2g} "
            f"deg",
            "gyro_unit",
            "rad/s",
            ", or the gyroscope does not measure",
        )


def find_unseen_rate(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> float:
    """Find the largest rate [rad/s] of a sensor whose gyroscope turns gravity and whose accelerometer does not.

    NaN: they agree. The samples (n, 3) are some seconds without gaps; the unit of `accel_S` does not matter.
    """
    up = accel_S.mean(axis=0)
    if not np.linalg.norm(up) > 0.0 or _tilt_most(accel_S, rate_hz) > STEADY:
        return np.nan
    ups = unroll(gyro_S / rate_hz, np.tile(up, (len(gyro_S), 1)))
    turned = min(_tilt_most(half, rate_hz) for half in np.array_split(ups, 2))  # in both: a lost sample is no unit
    return float(np.linalg.norm(gyro_S, axis=1).max()) if turned > TURNED else np.nan


def _tilt_most(vectors: np.ndarray, rate_hz: float) -> float:
    """Return the largest angle [rad] between means of vectors (n, 3) over `STEADY_MEAN_S` and the first of these."""
    size = max(1, round(rate_hz * STEADY_MEAN_S))
    count = len(vectors) // size
    means = vectors[: count * size].reshape(count, size, 3).mean(axis=1)
    lengths = np.linalg.norm(means, axis=1)
    if count < 2 or not lengths.min() > 0.0:
        return 0.0
    return float(np.arccos(np.clip(means @ means[0] / (lengths * lengths[0]), -1.0, 1.0)).max())


def _average_coherence(scale: float, gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> float:
    """Average the coherence, 0 to 1, of `scale` times the rates over windows (k, n, 3).

    It is how near the mean specific force, rotated by the gyroscope, is to gravity. The specific force of a swinging
    arm is several times gravity and points along the arm in the sensor frame; its mean in the world is gravity.
    """
    forces = unroll(scale / rate_hz * gyro_S.reshape(-1, 3), accel_S.reshape(-1, 3))  # one world for all windows
    means_W = np.linalg.norm(forces.reshape(accel_S.shape).mean(axis=1), axis=1)
    return float(np.mean(np.maximum(0.0, 1.0 - np.abs(means_W / STANDARD_GRAVITY - 1.0))))


def _check_range(time: np.ndarray, values: np.ndarray, most: float, unit: str, place: str) -> None:
    size = np.abs(values)
    if size.max() > most:
        k, axis = np.unravel_index(int(np.argmax(size)), size.shape)
        raise BadData(
            f"{place}: {values[k, axis]:.6g} {unit} on {'xyz'[axis]} at {time[k]:.3f} s, no sensor measures above "
            f"{most:g}; check the unit, and leave cells of lost samples empty"
        )


def find_cut_off(values: np.ndarray, least: float) -> np.ndarray:
    """Find the samples (n, 3) at which an axis of `values` (n, 3) is saturated at its extreme, `least` or more.

    It is saturated where the motion before and after a plateau leads beyond it, and neither digits nor noise explain
    the plateau.
    """
    cut = np.zeros(values.shape, dtype=bool)
    if not has_plateaus(values, least):
        return cut
    for axis, x in enumerate(values.T):
        for extreme in (float(x.max()), float(x.min())):
            if abs(extreme) < least:
                continue
            same = ROUNDING * abs(extreme)
            plateaus = [(a, b) for a, b in find_runs(np.abs(x - extreme) <= same) if PLATEAU <= b - a < len(x)]
            if not plateaus:
                continue
            steps = np.abs(np.diff(x))
            digit = float(steps[steps > same].min())
            if any(_leads_beyond(x, a, b, digit) for a, b in plateaus):
                for a, b in plateaus:
                    cut[a:b, axis] = True
    return cut


@compiled
def has_plateaus(values, least):  # type: ignore[no-untyped-def]
    """Return whether an axis of `values` (n, 3) is at an extreme, `least` or more, so often that it may be cut off."""
    share = 1.0 - 2.0 * ROUNDING
    high, low, at_high, at_low = np.full(3, least), np.full(3, -least), np.zeros(3), np.zeros(3)
    for k in range(len(values)):
        for axis in range(3):
            x = values[k, axis]
            if x >= share * high[axis]:
                at_high[axis] = at_high[axis] + 1.0 if high[axis] >= share * x else 1.0
                high[axis] = max(high[axis], x)
            elif x <= share * low[axis]:
                at_low[axis] = at_low[axis] + 1.0 if low[axis] <= share * x else 1.0
                low[axis] = min(low[axis], x)
    return max(at_high.max(), at_low.max()) >= PLATEAU


def _leads_beyond(x: np.ndarray, first: int, last: int, digit: float) -> bool:
    """Return whether the signal (n,) leads beyond its plateau at samples `first` to before `last`."""
    length = last - first
    sides = [side for side in (x[max(0, first - length) : first], x[last : last + length]) if len(side)]
    # A parabola exceeds the plateau by an eighth of its drop over one plateau's length before and after.
    excess = float(np.mean([np.abs(side - x[first]).max() for side in sides])) / 8.0
    if excess < BEYOND * digit:
        return False
    near = x[max(0, first - NOISE_SAMPLES) : first], x[last : last + NOISE_SAMPLES]
    jerks = np.abs(np.concatenate([np.diff(side, 3) for side in near]))
    noise = float(np.hypot(np.median(jerks) / NOISE_JERK if len(jerks) else 0.0, digit / np.sqrt(12.0)))
    # Noise would have to flatten the parabola's top sample by sample or, for any motion, make the samples equal.
    top = excess * np.sqrt(16.0 / 180.0 * (length**2 - 1.0) * (length**2 - 4.0) / length**3)
    alike = 2.0 * float(ndtr(digit / (2.0 * np.sqrt(2.0) * noise))) - 1.0
    return bool(top > IMPROBABLE * noise or alike ** (length - 1) < COINCIDENCE)
