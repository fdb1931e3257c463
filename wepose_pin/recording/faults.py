"""Faults of sensors: dead, frozen or stuck at one value, saturated, or copies of one another.

A repeated value alone is no fault: a coarse sensor on a table repeats for minutes, and so do data without noise. It is
one where the signal is noisy as long as it does not repeat, where the gyroscope turns gravity and the accelerometer
does not or the other way round, and where a gyroscope has one value all along while others measure.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from .gaps import find_runs
from .intervals import format_time
from .limits import NARROWEST_GYRO_RANGE

# Shortest constant rate and force [s], [samples] of a frozen sensor: longer than gaps that are bridged silently.
FROZEN_S, FROZEN_SAMPLES = 0.2, 5
STUCK_S = 1.0  # [s] the same for rate or force alone
# Noise reverses at two of three samples or, filtered, dozens of times a second; smooth motion hardly does.
TURNS_BACK, TURNS_BACK_HZ, NOISY_S = 0.3, 15.0, 2  # share of the samples, [1/s], and seconds of it
ROWS = 1 << 18  # rows in which noise is looked for
COARSE = 1e-4  # share of runs of equal rows above twice the usual length from which the digits are coarse
# A constant signal contradicts the other one where gravity by the gyroscope and by the accelerometer part by so much
# [rad] in some seconds, each averaged over `MEAN_S`; no bias of a gyroscope and no sway does that.
PARTED, PARTED_S, MEAN_S = 0.3, 2.0, 0.25

# An axis is saturated where it stands at its extreme for `PLATEAU` samples in a row, or `MANY` times for at least
# `SHORT_PLATEAU`, and comes to it or leaves it by a step of so many digits: the top of a smooth peak has smaller steps.
# Then all these plateaus count.
PLATEAU, SHORT_PLATEAU, MANY, STEEP = 5, 3, 10, 4.0
SAME_RANGE = 0.1  # relative difference between the ranges of a sensor's axes, which have different scales
AT_RANGE = 0.02  # relative distance below the range at which a sample counts as saturated: resampling mixes samples
ROUNDING = 1e-9  # steps below this share of the largest value are rounding

LARGEST = 1e9  # numbers of a file are bounded by it, in any unit, so that their squares are numbers too
BOTH, GYRO, ACCEL = "gyro and accel", "gyro", "accel"


class Fault(NamedTuple):
    """An interval in which a sensor repeated one value and did not measure."""

    signals: str  # `BOTH`, `GYRO` or `ACCEL`
    first: float  # [s] the last measured sample
    last: float  # [s] the last faulty sample
    value: tuple[float, ...]  # the repeated value, SI

    def describe(self, since: float) -> str:
        """Describe the fault from the time [s] `since` on."""
        value = ", ".join(f"{v:.4g}" for v in self.value[:3])
        unit = "m/s^2" if self.signals == ACCEL else "rad/s"
        stands = "stand still, gyro" if self.signals == BOTH else "stands still"
        return f"{self.signals} {stands} at {value} {unit} from {format_time(since)} to {format_time(self.last)} s"


class SensorCheck(NamedTuple):
    """What the samples of a recording say about its sensors."""

    faults: dict[str, list[Fault]]  # sensor → faults in the order of time
    gyro_range: dict[str, float]  # [rad/s] as `find_gyro_range`
    diagnostics: list[Diagnostic]


def check_sensors(
    where: str, samples: Mapping[str, tuple[np.ndarray, ...]], start: tuple[float, float] | None
) -> SensorCheck:
    """Check that the sensors measure, and find where they do not.

    Parameters
    ----------
    where : the file, for messages
    samples : sensor → times (n,) [s], and gyro and accel (n, 3) in SI or orientations (n, 4); NaN: lost
    start : [s] the stated start pose

    Raises
    ------
    BadData
        Two sensors have the same values, or one is dead in the whole recording or in the start pose.
    """
    imus = {name: _take_numbers(*each) for name, each in samples.items() if len(each) == 3}
    for (name, a), (other, b) in combinations(imus.items(), 2):
        if all(map(np.array_equal, a[1:], b[1:])) and len(a[0]) - len(_find_repeats(*a[1:])) > FROZEN_SAMPLES:
            raise BadData(
                f"{where}: sensors.{name} and sensors.{other} hold the same values in {len(a[0])} rows: "
                f"one is a copy of the other; name the file and columns in which each was recorded"
            )
    diagnostics = []
    faults = find_faults(imus)
    for name, each in faults.items():
        begin, end = (float(imus[name][0][k]) for k in (0, -1))
        for fault in each:
            first = max(fault.first, begin)
            whole = fault.first < begin and fault.last >= end
            if whole or (start is not None and first <= start[0] and fault.last >= start[1]):
                when = "all along" if whole else "through the start pose"
                raise BadData(
                    f"{where}: sensors.{name}: {fault.describe(first)}, {when}: it does not measure; take "
                    f"[sensors.{name}] out to track the others" + ("" if whole else ", or name another start pose")
                )
        lost_s = sum(fault.last - max(fault.first, begin) for fault in each)
        facts: dict[str, float | str] = {"signals": each[0].signals, "intervals": len(each)}
        facts |= {"start": max(each[0].first, begin), "end": each[0].last}
        diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, lost_s, facts=facts))
    for name, (_, *values) in samples.items():
        known = values[0][np.isfinite(values[0]).all(axis=1) & values[0].any(axis=1)]  # zeros mark a lost sample
        if name not in imus and len(known) >= FROZEN_SAMPLES and (known == known[0]).all():
            facts = {"variant": "orientation", "rows": len(known)}
            diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, facts=facts))
    return SensorCheck(faults, {name: find_gyro_range(*each[1:]) for name, each in imus.items()}, diagnostics)


def _take_numbers(*values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Take the rows that are numbers, each at most `LARGEST`; without a copy where there is nothing to do."""
    if not all(np.isfinite(each).all() for each in values):
        good = np.all([np.isfinite(each[:, None] if each.ndim == 1 else each).all(axis=1) for each in values], axis=0)
        values = tuple(each[good] for each in values)
    time, *signals = values
    most = max(max(signal.max(initial=0.0), -signal.min(initial=0.0)) for signal in signals)
    return time, *(np.clip(signal, -LARGEST, LARGEST) if most > LARGEST else signal for signal in signals)


def find_faults(samples: Mapping[str, tuple[np.ndarray, ...]]) -> dict[str, list[Fault]]:
    """Find the intervals in which sensors were frozen or stuck, in the order of time.

    Parameters
    ----------
    samples : sensor → times (n,) [s], gyro (n, 3) [rad/s], accel (n, 3) [m/s²], all numbers

    Returns
    -------
    dict
        Sensor → its faults; sensors without are left out.
    """
    faults = {}
    for name, (time, gyro_S, accel_S) in samples.items():
        others = [other for key, other in samples.items() if key != name]
        found: list[Fault] = []
        covered = np.zeros(len(time), dtype=bool)
        of_gyro, of_accel = _find_repeats(gyro_S), _find_repeats(accel_S)
        for signals, columns, repeats, least_s in (
            (BOTH, (gyro_S, accel_S), np.intersect1d(of_gyro, of_accel, assume_unique=True), FROZEN_S),
            (GYRO, (gyro_S,), of_gyro, STUCK_S),
            (ACCEL, (accel_S,), of_accel, STUCK_S),
        ):
            begins = np.flatnonzero(np.diff(repeats, prepend=-1) > 1)
            first, last = repeats[begins] - 1, np.append(repeats[begins[1:] - 1], repeats[-1:])
            long = (last - first + 1 >= FROZEN_SAMPLES) & (time[last] - time[first] >= (1.0 - 1e-6) * least_s)
            noisy = long.any() and _is_noisy(time, columns)
            for a, b in zip(first[long].tolist(), last[long].tolist(), strict=True):
                rows = slice(a, b + 1)
                if covered[rows].all():
                    continue
                at_rest = signals == GYRO and not gyro_S[a].any()  # a firmware with a dead zone reports zero
                is_stuck = (noisy and not at_rest) or _contradict(time[rows], gyro_S[rows], accel_S[rows])
                if b - a == len(time) - 1:
                    is_stuck |= signals == BOTH and any(_is_noisy(t, signal) for t, *signal in others)
                    is_stuck |= signals == GYRO and any((gyro != gyro[0]).any() for _, gyro, _ in others)
                if is_stuck:
                    covered[rows] = True
                    # At the beginning of the recording the first sample is faulty, too.
                    begin = float(time[a] if a else np.nextafter(time[a], -np.inf))
                    value = np.concatenate([column[a] for column in columns])
                    found.append(Fault(signals, begin, float(time[b]), tuple(value.tolist())))
        if found:
            faults[name] = sorted(found, key=lambda fault: fault.first)
    return faults


def _find_repeats(*signals: np.ndarray) -> np.ndarray:
    """Find the rows (m,) in which all signals (n, 3) repeat the row before."""
    first, *others = (signal[:, k] for signal in signals for k in range(3))
    rows = np.flatnonzero(first[1:] == first[:-1]) + 1
    for column in others:  # few are left after the first
        rows = rows[column[rows] == column[rows - 1]]
    return rows


def _is_noisy(time: np.ndarray, signals: tuple[np.ndarray, ...] | list[np.ndarray]) -> bool:
    """Return whether only a fault makes signals (n, 3) repeat for long: their noise is larger than their digits.

    All axes reverse as in noise in some seconds, which happens with little motion, and rows repeat briefly or for long.
    """
    rows = np.delete(np.arange(len(time)), _find_repeats(*signals))
    lengths = np.diff(rows, append=len(time))
    if len(rows) < 2 * FROZEN_SAMPLES:
        return False
    longer = lengths > 2.0 * np.median(lengths)
    long = longer & (time[rows + lengths - 1] - time[rows] >= (1.0 - 1e-6) * FROZEN_S)
    if np.count_nonzero(longer) > 3 * np.count_nonzero(long) + COARSE * len(lengths):
        return False
    rows = rows[:ROWS]
    values = np.hstack([signal[rows] for signal in signals])
    steps = np.diff(values, axis=0)
    steps[np.abs(steps) < ROUNDING * np.abs(values).max(axis=0)] = 0.0
    turns = np.sign(steps[1:]) * np.sign(steps[:-1]) < 0.0
    usual = max(float(np.median(np.diff(time[rows]))), 1e-9)
    size = max(FROZEN_SAMPLES, round(1.0 / usual))
    count = len(turns) // size
    share = turns[: count * size].reshape(count, size, -1).mean(axis=1)
    return bool(np.count_nonzero((share > min(TURNS_BACK, TURNS_BACK_HZ * usual)).all(axis=1)) >= NOISY_S)


def _contradict(time: np.ndarray, gyro_S: np.ndarray, accel_S: np.ndarray) -> bool:
    """Return whether gravity by the gyroscope and by the accelerometer part as no measuring sensor's do."""
    window = np.floor((time - time[0]) / MEAN_S).astype(int)
    edges = np.flatnonzero(np.diff(window, prepend=-1))  # of windows that hold samples; the last one is not complete
    if len(edges) < 3:
        return False
    force = rotations.unroll(gyro_S * np.diff(time, prepend=time[0])[:, None], accel_S)
    mean = np.add.reduceat(force, edges)[:-1]
    apart, size = min(len(mean) - 1, round(PARTED_S / MEAN_S)), np.linalg.norm(mean, axis=1)
    along = np.sum(mean[apart:] * mean[:-apart], axis=1)
    return bool((along < np.cos(PARTED) * size[apart:] * size[:-apart]).any())


# Saturation -----------------------------------------------------------------------------------------------------------


def find_gyro_range(gyro_S: np.ndarray, accel_S: np.ndarray) -> float:
    """Find the rate [rad/s] from which an axis of gyro counts as saturated, of samples (n, 3); infinite: none is."""
    if not find_saturation(gyro_S, NARROWEST_GYRO_RANGE).any():
        return np.inf
    gyro_S = np.delete(gyro_S, _find_repeats(gyro_S, accel_S), axis=0)
    levels = np.abs(gyro_S[find_saturation(gyro_S, NARROWEST_GYRO_RANGE)])
    return float((1.0 - AT_RANGE) * levels.min(initial=np.inf))


def find_saturation(values: np.ndarray, least: float) -> np.ndarray:
    """Find the samples (n, 3) at which an axis of `values` (n, 3) is saturated at its extreme, `least` or more."""
    saturated = np.zeros(values.shape, dtype=bool)
    largest = max(values.max(initial=0.0), -values.min(initial=0.0))
    if largest < least:
        return saturated
    least = max(least, (1.0 - SAME_RANGE) * largest)
    for axis, x in enumerate(np.ascontiguousarray(values.T)):  # of one piece: ten times faster
        for extreme in (float(x.max()), float(x.min())):
            if abs(extreme) < least:
                continue
            same = ROUNDING * abs(extreme)
            at = np.abs(x - extreme) <= same
            if np.count_nonzero(at) < PLATEAU:
                continue
            plateaus = [(a, b) for a, b in find_runs(at) if SHORT_PLATEAU <= b - a < len(x)]
            steps = np.abs(np.diff(x))
            digit = steps[steps > same].min(initial=np.inf)
            steep = [b - a for a, b in plateaus if steps[max(a - 1, 0) : b].max() > STEEP * digit]
            if len(steep) >= MANY or max(steep, default=0) >= PLATEAU:
                for a, b in plateaus:
                    saturated[a:b, axis] = True
    return saturated
