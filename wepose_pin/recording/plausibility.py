"""Whether the sensors' values can be what the session says they are: units, ranges, saturation.

The rules are physics and not habits, so that they hold for any sensor that is strapped on anything:

- a static accelerometer shows gravity;
- turned by the gyroscope's own rotation, specific force averages to gravity over seconds, as speed stays bounded;
- a sensor that was tilted has turned at least by as much.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongUnit
from .gaps import find_runs
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

WINDOW_S = 2.0  # over which specific force averages to gravity
WINDOWS = 40  # those with most motion
FEWEST_WINDOWS = 3
# Coherence is how near the mean of turned specific force is to gravity. Taking deg/s for rad/s makes it
# tumble: it falls below one of these shares of that of rates a factor 57.3 smaller. By stretches of three windows or
# more of 41 real sensors, the first is met by none, the second by none that turns so fast.
TUMBLES, COHERENT = 0.6, 0.8  # the share, where the smaller rates themselves are coherent at least so
TUMBLES_FAST, FAST = 0.85, 8.0  # the share, where the mean rate is above this [rad/s]
STIFF = 0.93  # the share of the coherence of rates a factor 57.3 larger, where these are coherent so
TILTED = np.deg2rad(20.0)  # between two windows, from which the gyroscope must have seen it
UNSEEN = 0.25  # share of that tilt which the gyroscope has seen at most, where its unit is too small

# An axis that stays for so many samples at its extreme is cut off there if the motion before and after would have led
# beyond it by so many digits: a smooth peak stays within one. That noise has levelled a peak by chance is excluded from
# so many standard deviations on, or by a probability below this.
PLATEAU, BEYOND, IMPROBABLE, COINCIDENCE = 3, 2.0, 5.0, 1e-4
NOISE_SAMPLES = 25  # on each side of a plateau, of which the noise is measured
NOISE_JERK = float(ndtri(0.75) * np.sqrt(20.0))  # median size of the third differences of noise with deviation 1
ROUNDING = 1e-9  # steps below this share of the largest value are rounding, not noise


def check_signals(recording: Recording, *, whole: bool = True, units: bool = True) -> tuple[Diagnostic, ...]:
    """What is doubtful in the sensors' values: gravity's norm, saturation.

    In a piece that is not the `whole` sensors are static only in stated phases; `units` are checked in the first piece
    alone.

    Raises
    ------
    BadData
        Values that cannot be: of another unit, or out of every sensor's range.
    """
    found: list[Diagnostic] = []
    for segment, sensor in recording.imus.items():
        place = f"{recording.where()}: sensors.{segment}"
        found += _gravity(recording, segment, sensor, place, whole)
        if units:
            _gyro_unit(sensor, recording.rate_hz, place)
        _range(recording.time, sensor.gyro_S, HIGHEST_RATE, "rad/s", f"{place}.gyro")
        _range(recording.time, sensor.accel_S, HIGHEST_ACCEL, "m/s^2", f"{place}.accel")
        for name, values, least in (
            ("gyro", sensor.gyro_S, NARROWEST_GYRO_RANGE),
            ("accel", sensor.accel_S, NARROWEST_ACCEL_RANGE),
        ):
            cut = find_cut_off(values, least)
            if cut.any():
                facts: dict[str, float | str] = {"variant": name, "range": float(np.abs(values[cut]).min())}
                seconds = np.count_nonzero(cut.any(axis=1)) / recording.rate_hz
                found.append(Diagnostic("signal-saturated", WARNING, segment, seconds, facts=facts))
    return tuple(found)


def _gravity(recording: Recording, segment: str, sensor: ImuSensor, place: str, whole: bool) -> list[Diagnostic]:
    name = next((name for name in ("static", "start") if recording.phases.get(name)), "")
    if name:
        static, when = recording.find_measured(segment, recording.phases[name][0]), f"in phases.{name}"
    elif whole:
        static, when = _most_static_second(recording, sensor), "in the second in which it turns most evenly"
    else:
        return []
    if len(static) < 2:
        return []
    first, last = (float(recording.time[k]) for k in static[[0, -1]])
    norm = float(np.linalg.norm(sensor.accel_S[static], axis=1).mean())
    share = norm / STANDARD_GRAVITY - 1.0
    if abs(share) > GRAVITY_ERROR_REFUSED:
        found = f"norm {norm:.4g} m/s^2 {when} ({format_span((first, last))})"
        raise _wrong_gravity(f"{place}.accel: {found}, where gravity's {STANDARD_GRAVITY:.3g} is expected", norm)
    if abs(share) <= GRAVITY_ERROR_NOTED:
        return []
    facts = {"share": share, "start": first, "end": last}
    return [Diagnostic("accel-scale", WARNING, segment, norm, GRAVITY_ERROR_NOTED, facts)]


def _wrong_gravity(found: str, norm: float) -> BadData:
    """The error that names the unit which makes gravity of a norm [m/s²] that is not."""
    for factor, unit in ((STANDARD_GRAVITY, "g"), (1.0 / STANDARD_GRAVITY, "m/s^2")):
        if abs(norm * factor / STANDARD_GRAVITY - 1.0) < GRAVITY_ERROR_REFUSED:
            return WrongUnit(f'{found}; data.accel_unit = "{unit}" would fit', "accel_unit", unit)
    return BadData(f"{found}; {_no_gravity(norm)}")


def _no_gravity(norm: float) -> str:
    """What may be wrong with a norm [m/s²] that no unit makes gravity."""
    for factor in (1e-3, 1e-3 * STANDARD_GRAVITY):
        if abs(norm * factor / STANDARD_GRAVITY - 1.0) < GRAVITY_ERROR_REFUSED:
            return 'the values look like thousandths of g (mg); divide them by 1000 and state accel_unit = "g"'
    if norm < 0.5:
        return "gravity seems to have been taken out; specific force is needed, +g up of a static sensor"
    return "check data.accel_unit and the sensor's calibration, and that it is static there"


def _most_static_second(recording: Recording, sensor: ImuSensor) -> np.ndarray:
    """Samples of the second, measured as a whole, in which the rate varies least; empty where there is none."""
    n = len(recording)
    size = min(n, max(2, round(recording.rate_hz)))
    count = n // size
    motion = sensor.gyro_S[: count * size].reshape(count, size, 3).var(axis=1).sum(axis=1)
    if sensor.gap is not None:
        motion[sensor.gap[: count * size].reshape(count, size).any(axis=1)] = np.inf
    first = int(np.argmin(motion))
    return np.arange(first * size, (first + 1) * size) if np.isfinite(motion[first]) else np.empty(0, dtype=int)


def _gyro_unit(sensor: ImuSensor, rate_hz: float, place: str) -> None:
    gyro_S = sensor.gyro_S
    size = round(WINDOW_S * rate_hz)
    count = len(gyro_S) // size
    gyro, accel = (values[: count * size].reshape(count, size, 3) for values in (gyro_S, sensor.accel_S))
    at = np.arange(count)
    if sensor.gap is not None:  # what was bridged says nothing
        at = at[~sensor.gap[: count * size].reshape(count, size).any(axis=1)]
    if len(at) < FEWEST_WINDOWS:
        return
    speed = np.linalg.norm(gyro, axis=2).mean(axis=1)
    moving = at[np.argsort(-speed[at], kind="stable")[:WINDOWS]]
    as_stated = _mean_coherence(1.0, gyro[moving], accel[moving], rate_hz)
    if as_stated < max(TUMBLES, TUMBLES_FAST, STIFF):  # coherence is at most 1: above it no other unit is better
        smaller = _mean_coherence(np.pi / 180.0, gyro[moving], accel[moving], rate_hz)
        larger = _mean_coherence(180.0 / np.pi, gyro[moving], accel[moving], rate_hz)
        peak = float(np.max(np.abs(gyro_S)))
        tumbles = as_stated < TUMBLES * smaller and smaller > COHERENT
        if tumbles or (as_stated < TUMBLES_FAST * smaller and speed[moving].mean() > FAST):
            raise WrongUnit(
                f"{place}.gyro: with rates up to {peak:.3g} rad/s gravity would tumble, and accel shows that it does "
                f'not; data.gyro_unit = "deg/s" would fit, or the time or rate_hz is wrong',
                "gyro_unit",
                "deg/s",
            )
        if as_stated < STIFF * larger and larger > COHERENT:
            raise WrongUnit(
                f"{place}.gyro: with rates up to {peak:.3g} rad/s the sensor turns too little for what accel shows; "
                f'data.gyro_unit = "rad/s" would fit, or the time or rate_hz is wrong',
                "gyro_unit",
                "rad/s",
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
            f'deg; data.gyro_unit = "rad/s" would fit, or the gyroscope does not measure',
            "gyro_unit",
            "rad/s",
        )


def _mean_coherence(scale: float, gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> float:
    """Mean over windows (k, n, 3) of the coherence of `scale` times their rates."""
    return float(
        np.mean([_coherence(scale * gyro, accel, rate_hz) for gyro, accel in zip(gyro_S, accel_S, strict=True)])
    )


def _coherence(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> float:
    """How near the mean of specific force, turned by the gyroscope's rotation, is to gravity, from 1 to 0.

    In the sensor the specific force of an arm that swings is several times gravity, and points along the arm all the
    time; of its mean in the world gravity alone is left.
    """
    turned = Rotation.from_quat(rotations.integrate(gyro_S[1:] / rate_hz)).apply(accel_S)
    return max(0.0, 1.0 - abs(float(np.linalg.norm(turned.mean(axis=0))) / STANDARD_GRAVITY - 1.0))


def _range(time: np.ndarray, values: np.ndarray, most: float, unit: str, place: str) -> None:
    size = np.abs(values)
    if size.max() > most:
        k, axis = np.unravel_index(int(np.argmax(size)), size.shape)
        raise BadData(
            f"{place}: {values[k, axis]:.6g} {unit} on {'xyz'[axis]} at {time[k]:.3f} s, no sensor measures above "
            f"{most:g}; check the unit, and leave cells of lost samples empty"
        )


def find_cut_off(values: np.ndarray, least: float) -> np.ndarray:
    """(n, 3) bool: where an axis of `values` (n, 3) stays at its extreme, `least` or more, as if cut off there.

    It is cut off where the motion before and after one such plateau would have led beyond it, and neither digits nor
    noise explain that it did not.
    """
    cut = np.zeros(values.shape, dtype=bool)
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


def _leads_beyond(x: np.ndarray, first: int, last: int, digit: float) -> bool:
    """Whether the signal (n,) would have passed the value at which its samples `first` to before `last` stay."""
    length = last - first
    sides = [side for side in (x[max(0, first - length) : first], x[last : last + length]) if len(side)]
    # A parabola that is lower by so much one plateau's length before and after it has passed it by an eighth of that.
    excess = float(np.mean([np.abs(side - x[first]).max() for side in sides])) / 8.0
    if excess < BEYOND * digit:
        return False
    near = x[max(0, first - NOISE_SAMPLES) : first], x[last : last + NOISE_SAMPLES]
    jerks = np.abs(np.concatenate([np.diff(side, 3) for side in near]))
    noise = float(np.hypot(np.median(jerks) / NOISE_JERK if len(jerks) else 0.0, digit / np.sqrt(12.0)))
    # Noise would have to take the parabola's top off, sample by sample; or, of whatever form the motion is, to make the
    # samples alike.
    top = excess * np.sqrt(16.0 / 180.0 * (length**2 - 1.0) * (length**2 - 4.0) / length**3)
    alike = 2.0 * float(ndtr(digit / (2.0 * np.sqrt(2.0) * noise))) - 1.0
    return bool(top > IMPROBABLE * noise or alike ** (length - 1) < COINCIDENCE)
