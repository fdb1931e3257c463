"""Plausibility of the sensors' values: units, ranges, saturation.

The rules are physical and hold for any sensor on any body: a static accelerometer measures gravity, and specific force,
rotated by the gyroscope, averages to gravity over seconds, since speed is bounded.
"""

import math
from collections.abc import Mapping
from itertools import permutations

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongUnit
from ..rotations import unroll
from .faults import find_saturation
from .intervals import Intervals, format_span
from .limits import HIGHEST_ACCEL, HIGHEST_RATE, NARROWEST_ACCEL_RANGE, STANDARD_GRAVITY
from .sensors import AXES, ImuSensor

# Relative error of a static accelerometer's mean norm against gravity. Data sheets of MEMS sensors state scale errors
# of 1 to 3 %; the published OpenAXES sensors on a robot show 3 %. An error of 20 % means another unit, or no gravity.
GRAVITY_ERROR_NOTED, GRAVITY_ERROR_REFUSED = 0.06, 0.2

WINDOW_S, SHORTEST_WINDOW_S = 6.0, 3.0  # [s] over which specific force averages to gravity, half of a short recording
FEWEST_WINDOWS, WINDOWS = 2, 20  # number of windows, those with most motion
# Coherence is the length of the mean of rotated specific force as a share of gravity. Rates in deg/s that are taken for
# rad/s lower it below `TUMBLES` of that of rates smaller by a factor 57.3, and rates in rad/s that are taken for deg/s
# below `STIFF` of that of larger ones, where these are `COHERENT`. Of 41 real sensors none is below 0.99.
TUMBLES, STIFF, COHERENT = 0.7, 0.95, 0.8
# Over some seconds in which accel alone is `STEADY`, rates in the right unit do not lower coherence below `UNTURNED` of
# it: in four seconds 6 deg/s do, as does the sway of a start pose in deg/s that is taken for rad/s.
STEADY, UNTURNED = 0.997, 0.995
# Changes of the rates that make a gyroscope agree with its accelerometer, the likeliest first: another unit, sign or
# scale, and signed permutations of the axes; left-handed axes of both sensors look like inverted rates. Coherence below
# `CONTRADICTED` of that of a change shows it; of good sensors of a person who throws it is at least 0.95. Changes whose
# coherence differs by less than `SIMILAR` cannot be told apart.
CONTRADICTED, SIMILAR = 0.9, 0.01
GYRO_CHANGES = {"deg/s": np.pi / 180.0 * np.eye(3), "rad/s": 180.0 / np.pi * np.eye(3), "-x, -y, -z": -np.eye(3)}
GYRO_CHANGES |= {f"{k:g} x, {k:g} y, {k:g} z": k * np.eye(3) for k in (0.5, 2.0, 0.25, 4.0)}
GYRO_CHANGES |= {
    ", ".join(axes): change
    for axes in permutations(AXES, 3)
    if np.linalg.det(change := np.array([AXES[axis] for axis in axes]))
}


def check_signals(
    where: str, time: np.ndarray, rate_hz: float, phases: Mapping[str, Intervals], imus: Mapping[str, ImuSensor]
) -> tuple[Diagnostic, ...]:
    """Check the values of a recording's sensors: units and ranges (`BadData`).

    Diagnostics: gravity's norm, saturation, and a gyroscope that contradicts its accelerometer.
    """
    diagnostics: list[Diagnostic] = []
    for segment, sensor in imus.items():
        place, gyro_S, accel_S = f"{where}: sensors.{segment}", sensor.gyro_S, sensor.accel_S
        diagnostics += _check_gravity(time, rate_hz, phases, segment, sensor, place)
        diagnostics += _check_gyro(segment, sensor, rate_hz, place)
        for name, values, most, unit, saturated in (
            ("gyro", gyro_S, HIGHEST_RATE, "rad/s", np.abs(gyro_S) >= sensor.gyro_range),
            ("accel", accel_S, HIGHEST_ACCEL, "m/s^2", find_saturation(accel_S, NARROWEST_ACCEL_RANGE)),
        ):
            k, axis = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
            if abs(values[k, axis]) > most:
                raise BadData(
                    f"{place}.{name}: {values[k, axis]:.6g} {unit} on {'xyz'[axis]} at {time[k]:.3f} s, no "
                    f"sensor measures above {most:g}; check the unit, and leave cells of lost samples empty"
                )
            if saturated.any():
                facts: dict[str, float | str] = {"variant": name, "range": float(np.abs(values[saturated]).max())}
                seconds = np.count_nonzero(saturated.any(axis=1)) / rate_hz
                diagnostics.append(Diagnostic("signal-saturated", WARNING, segment, seconds, facts=facts))
    return tuple(diagnostics)


def _check_gravity(
    time: np.ndarray, rate_hz: float, phases: Mapping[str, Intervals], segment: str, sensor: ImuSensor, place: str
) -> list[Diagnostic]:
    """Compare the mean norm of accel with gravity while the sensor is static: its unit, or a scale that is off."""
    name = next((name for name in ("static", "start") if phases.get(name)), "")
    gap = np.zeros(len(time), dtype=bool) if sensor.gap is None else sensor.gap
    if name:
        first, last = phases[name][0]
        static = np.flatnonzero((time >= first - 1e-9) & (time <= last + 1e-9) & ~gap)
        when = f"in phases.{name}"
    else:
        good = (np.abs(sensor.gyro_S) < sensor.gyro_range).all(axis=1)  # a rate at the limit varies least of all
        good &= ~gap
        size = min(len(good), max(2, round(rate_hz)))
        seconds = np.arange(len(good) // size * size).reshape(-1, size)
        seconds = seconds[good[seconds].all(axis=1)]
        motion = sensor.gyro_S[seconds].var(axis=1).sum(axis=1)
        static = seconds[np.argmin(motion)] if len(seconds) else np.arange(0)
        when = "in the second in which it turns most evenly"
    if len(static) < 2:
        return []
    first, last = (float(time[k]) for k in static[[0, -1]])
    norm = float(np.linalg.norm(sensor.accel_S[static], axis=1).mean())
    share = norm / STANDARD_GRAVITY - 1.0
    if abs(share) > GRAVITY_ERROR_REFUSED:
        text = (
            f"{place}.accel: norm {norm:.4g} m/s^2 {when} ({format_span((first, last))}), where gravity's "
            f"{STANDARD_GRAVITY:.3g} is expected"
        )
        g = STANDARD_GRAVITY
        for factor, unit in ((g, "g"), (1.0 / g, "m/s^2"), (1e-3 * g, "mg"), (1e-3, "mg")):  # the last: stated in g
            if abs(norm * factor / g - 1.0) < GRAVITY_ERROR_REFUSED:
                raise WrongUnit(text, "accel_unit", unit)
        if norm < 0.5:
            raise BadData(f"{text}; gravity seems to have been taken out: specific force is needed, +g up at rest")
        raise BadData(f"{text}; check the unit and the sensor's calibration, and that it is static there")
    if abs(share) <= GRAVITY_ERROR_NOTED:
        return []
    facts = {"norm": norm, "start": first, "end": last}
    return [Diagnostic("accel-scale", WARNING, segment, share, GRAVITY_ERROR_NOTED, facts)]


def _check_gyro(segment: str, sensor: ImuSensor, rate_hz: float, place: str) -> list[Diagnostic]:
    """Compare the rates with the motion of gravity: `WrongUnit`, or a diagnostic of other axes, signs or scale."""
    size = min(round(WINDOW_S * rate_hz), len(sensor.gyro_S) // FEWEST_WINDOWS)
    if size < SHORTEST_WINDOW_S * rate_hz:
        return []
    windows = np.arange(len(sensor.gyro_S) // size * size).reshape(-1, size)
    if sensor.gap is not None:  # without bridged samples
        windows = windows[~sensor.gap[windows].any(axis=1)]
    if len(windows) < FEWEST_WINDOWS:
        return []
    gyro, accel = sensor.gyro_S[windows], sensor.accel_S[windows]
    motion = np.linalg.norm(gyro, axis=2).mean(axis=1) + np.linalg.norm(accel.std(axis=1), axis=1) / STANDARD_GRAVITY
    moving = np.argsort(-motion, kind="stable")[:WINDOWS]

    turns, accel = gyro[moving] / rate_hz, accel[moving]
    stated = _average_coherence(turns, accel)
    if not stated < STIFF:  # coherence is at most 1: above it no other unit is better; NaN: beyond any range
        return []
    coherences = {name: _average_coherence(turns @ change.T, accel) for name, change in GYRO_CHANGES.items()}
    best = max(coherences.values())
    change = next(name for name, coherence in coherences.items() if coherence > best - SIMILAR)
    peak, hint = float(np.max(np.abs(sensor.gyro_S))), ", or the time or rate_hz is wrong"
    if change == "deg/s" and stated < TUMBLES * best and best > COHERENT:
        text = f"{place}.gyro: with rates up to {peak:.3g} rad/s gravity would tumble, and accel shows that it does not"
        raise WrongUnit(text, "gyro_unit", change, hint)
    measurable = peak * 180.0 / np.pi < HIGHEST_RATE  # a saturated sensor turns too little in its own unit
    if change == "rad/s" and measurable and stated < STIFF * best and best > COHERENT:
        text = f"{place}.gyro: with rates up to {peak:.3g} rad/s the sensor turns too little for what accel shows"
        raise WrongUnit(text, "gyro_unit", change, hint)
    if change.endswith("/s") or stated > CONTRADICTED * best or best < COHERENT:
        return []
    return [Diagnostic("gyro-contradicted", WARNING, segment, stated, CONTRADICTED * best, {"rates": change})]


def is_in_degrees(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> bool:
    """Whether the rates (n, 3) are in deg/s in place of rad/s, by the seconds about the fastest motion.

    `accel_S` (n, 3) is in m/s². A check of all seconds takes as long as a filter.
    """
    size, fastest = math.ceil(SHORTEST_WINDOW_S * rate_hz), int(gyro_S.argmax()) // 3
    if len(gyro_S) < FEWEST_WINDOWS * size:
        return False
    begin = min(max(0, fastest - size), len(gyro_S) - FEWEST_WINDOWS * size)
    part = slice(begin, begin + FEWEST_WINDOWS * size)
    turns, accel = gyro_S[part].reshape(-1, size, 3) / rate_hz, accel_S[part].reshape(-1, size, 3)
    stated = _average_coherence(turns, accel)
    if not stated < TUMBLES:  # coherence is at most 1
        return False
    smaller = _average_coherence(np.deg2rad(turns), accel)
    return smaller > COHERENT and stated < TUMBLES * smaller


def find_unseen_rate(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> float:
    """Find the largest rate [rad/s] of a sensor whose gyroscope turns gravity and whose accelerometer does not, or NaN.

    The samples (n, 3) are some seconds without gaps; the unit of `accel_S` does not matter.
    """
    turns, force = gyro_S[None] / rate_hz, float(np.linalg.norm(accel_S, axis=1).mean())
    steady, turned = (_average_force(scale * turns, accel_S[None])[0] for scale in (0.0, 1.0))
    is_unseen = steady > STEADY * force and turned < UNTURNED * steady
    return float(np.linalg.norm(gyro_S, axis=1).max()) if is_unseen else np.nan


def _average_coherence(turns: np.ndarray, accel_S: np.ndarray) -> float:
    """0 to 1; the specific force of a swinging arm is several times gravity, its mean in the world is gravity."""
    means = _average_force(turns, accel_S)
    return float(np.mean(np.maximum(0.0, 1.0 - np.abs(means / STANDARD_GRAVITY - 1.0))))


def _average_force(turns: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
    """Return the length (k,) of the mean force over each of k windows (k, n, 3), in a frame that does not turn."""
    forces = unroll(turns.reshape(-1, 3), accel_S.reshape(-1, 3)).reshape(accel_S.shape)
    size = accel_S.shape[1]
    return np.asarray(np.linalg.norm(np.full(size, 1.0 / size) @ forces, axis=1))
