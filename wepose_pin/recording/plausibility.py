"""Plausibility of the sensors' values: units, ranges, saturation.

The rules are physical and hold for any sensor on any body: a static accelerometer measures gravity, and specific force,
rotated by the gyroscope, averages to gravity over seconds, since speed is bounded.
"""

from __future__ import annotations

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongUnit
from ..rotations import unroll
from .faults import find_saturation
from .gaps import find_static_second
from .intervals import format_span
from .limits import (
    GRAVITY_ERROR_NOTED,
    GRAVITY_ERROR_REFUSED,
    HIGHEST_ACCEL,
    HIGHEST_RATE,
    NARROWEST_ACCEL_RANGE,
    STANDARD_GRAVITY,
)
from .recording import Recording
from .sensors import ImuSensor

WINDOW_S = 3.0  # [s] over which specific force averages to gravity
FEWEST_WINDOWS, WINDOWS = 3, 40  # number of windows, those with most motion
# Coherence measures how near the mean of rotated specific force is to gravity. Rates in deg/s that are taken for rad/s
# lower it below `TUMBLES` of that of rates smaller by a factor 57.3, and rates in rad/s that are taken for deg/s below
# `STIFF` of that of larger ones, where these are `COHERENT`. Of 41 real sensors none is below 0.99.
TUMBLES, STIFF, COHERENT = 0.7, 0.95, 0.8
# In some seconds with hardly any tilt by accel, rates in deg/s that are taken for rad/s turn gravity by more than
# `TURNED` in both halves; both directions are averaged over `STEADY_MEAN_S`. In four seconds that is 6 deg/s, the
# fastest sway of a start pose.
TURNED, STEADY, STEADY_MEAN_S = np.deg2rad(10.0), np.deg2rad(5.0), 0.25  # [rad], [rad], [s]
# Tilt by accel [rad] between two windows that the gyroscope must measure; the largest share of it in the gyroscope's
# rotation where the unit is too small; and the relative difference of accel's mean from gravity in a steady window.
TILTED, UNSEEN, STEADY_NORM = np.deg2rad(20.0), 0.25, 0.1


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
        for name, values, most, unit, saturated in (
            ("gyro", sensor.gyro_S, HIGHEST_RATE, "rad/s", np.abs(sensor.gyro_S) >= sensor.gyro_range),
            (
                "accel",
                sensor.accel_S,
                HIGHEST_ACCEL,
                "m/s^2",
                find_saturation(sensor.accel_S, NARROWEST_ACCEL_RANGE),
            ),
        ):
            k, axis = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
            if abs(values[k, axis]) > most:
                raise BadData(
                    f"{place}.{name}: {values[k, axis]:.6g} {unit} on {'xyz'[axis]} at {recording.time[k]:.3f} s, no "
                    f"sensor measures above {most:g}; check the unit, and leave cells of lost samples empty"
                )
            if saturated.any():
                facts: dict[str, float | str] = {"variant": name, "range": float(np.abs(values[saturated]).max())}
                seconds = np.count_nonzero(saturated.any(axis=1)) / recording.rate_hz
                diagnostics.append(Diagnostic("signal-saturated", WARNING, segment, seconds, facts=facts))
    return tuple(diagnostics)


def _check_gravity(recording: Recording, segment: str, sensor: ImuSensor, place: str) -> list[Diagnostic]:
    """Compare the mean norm of accel with gravity while the sensor is static: its unit, or a scale that is off."""
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
        text = (
            f"{place}.accel: norm {norm:.4g} m/s^2 {when} ({format_span((first, last))}), where gravity's "
            f"{STANDARD_GRAVITY:.3g} is expected"
        )
        for factor, unit in (
            (STANDARD_GRAVITY, "g"),
            (1.0 / STANDARD_GRAVITY, "m/s^2"),
            (1e-3 * STANDARD_GRAVITY, "mg"),
            (1e-3, "mg"),  # stated in g
        ):
            if abs(norm * factor / STANDARD_GRAVITY - 1.0) < GRAVITY_ERROR_REFUSED:
                raise WrongUnit(text, "accel_unit", unit)
        if norm < 0.5:
            raise BadData(f"{text}; gravity seems to have been taken out: specific force is needed, +g up at rest")
        raise BadData(f"{text}; check the unit and the sensor's calibration, and that it is static there")
    if abs(share) <= GRAVITY_ERROR_NOTED:
        return []
    facts = {"norm": norm, "start": first, "end": last}
    return [Diagnostic("accel-scale", WARNING, segment, share, GRAVITY_ERROR_NOTED, facts)]


def _check_gyro_unit(sensor: ImuSensor, rate_hz: float, place: str) -> None:
    """Raise `WrongUnit` where gravity shows that the rates are in another unit."""
    size = round(WINDOW_S * rate_hz)
    count = len(sensor.gyro_S) // size
    gyro, accel = (values[: count * size].reshape(count, size, 3) for values in (sensor.gyro_S, sensor.accel_S))
    speed = np.linalg.norm(gyro, axis=2).mean(axis=1)
    if sensor.gap is not None:  # without bridged samples
        speed[sensor.gap[: count * size].reshape(count, size).any(axis=1)] = -1.0
    moving = np.argsort(-speed, kind="stable")[: min(WINDOWS, np.count_nonzero(speed >= 0.0))]
    if len(moving) < FEWEST_WINDOWS:
        return
    _check_tilts(accel.mean(axis=1), speed * WINDOW_S, place)

    def average_coherence(scale: float) -> float:
        """0 to 1; the specific force of a swinging arm is several times gravity, its mean in the world is gravity."""
        forces = unroll(scale / rate_hz * gyro[moving].reshape(-1, 3), accel[moving].reshape(-1, 3))
        means = np.linalg.norm(forces.reshape(-1, size, 3).mean(axis=1), axis=1)
        return float(np.mean(np.maximum(0.0, 1.0 - np.abs(means / STANDARD_GRAVITY - 1.0))))

    stated = average_coherence(1.0)
    if stated >= STIFF:  # coherence is at most 1: above it no other unit is better
        return
    peak, hint = float(np.max(np.abs(sensor.gyro_S))), ", or the time or rate_hz is wrong"
    smaller, larger = average_coherence(np.pi / 180.0), average_coherence(180.0 / np.pi)
    if stated < TUMBLES * smaller and smaller > COHERENT:
        text = f"{place}.gyro: with rates up to {peak:.3g} rad/s gravity would tumble, and accel shows that it does not"
        raise WrongUnit(text, "gyro_unit", "deg/s", hint)
    measurable = peak * 180.0 / np.pi < HIGHEST_RATE  # a saturated sensor turns too little in its own unit
    if measurable and stated < STIFF * larger and larger > COHERENT:
        text = f"{place}.gyro: with rates up to {peak:.3g} rad/s the sensor turns too little for what accel shows"
        raise WrongUnit(text, "gyro_unit", "rad/s", hint)


def _check_tilts(means: np.ndarray, paths: np.ndarray, place: str) -> None:
    """Raise `WrongUnit` where accel tilts from window to window and gyro does not turn.

    `means` (n, 3) [m/s²] of accel; `paths` (n,) [rad] of gyro, negative in a window with a gap.
    """
    norms = np.linalg.norm(means, axis=1)
    steady = (np.abs(norms / STANDARD_GRAVITY - 1.0) < STEADY_NORM) & (paths >= 0.0)
    cosines = np.sum(means[1:] * means[:-1], axis=1) / np.maximum(norms[1:] * norms[:-1], 1e-9)
    tilts = np.where(steady[1:] & steady[:-1], np.arccos(np.clip(cosines, -1.0, 1.0)), 0.0)
    turns = paths[1:] + paths[:-1]
    unseen = np.where((tilts > TILTED) & (turns < UNSEEN * tilts), tilts, 0.0)
    if not unseen.any():
        return
    k = int(np.argmax(unseen))
    raise WrongUnit(
        f"{place}.gyro: accel shows a tilt by {np.degrees(tilts[k]):.0f} deg between {k * WINDOW_S:g} and "
        f"{(k + 2) * WINDOW_S:g} s from the beginning, gyro turns by {np.degrees(turns[k]):.2g} deg",
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
