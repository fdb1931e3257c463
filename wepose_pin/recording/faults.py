"""Faults of sensors: dead, stuck or frozen at one value, saturated, or copies of one another.

A repeated value alone is no fault: a coarse sensor on a table repeats for minutes, and so do data without noise. It is
a fault where it contradicts physics, or where the sensor is noisy whenever it does not repeat:

- constant specific force in the sensor while it rotates about a horizontal axis;
- a constant rate while the specific force changes as in motion;
- constant rate and force of a sensor with noise larger than its digits: two consecutive samples are never equal;
- a constant rate, or a constant force, where the noise that this signal has elsewhere makes so many repetitions
  improbable.

Some gyroscopes report exactly zero at rest: their firmware has a dead zone. Zeros while the specific force shows no
motion are therefore no fault, unless all other sensors turn on about the vertical, which specific force does not show.

A single axis may be constant during motion about another axis. It is a fault where

- the noise of the other axes makes so many repetitions improbable; or
- the mean specific force over some seconds, rotated by the gyroscope, does not point up, since an axis is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from .. import rotations
from ..compilation import compiled, inlined
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from .intervals import format_time
from .limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE, STANDARD_GRAVITY
from .plausibility import ROUNDING, find_cut_off, has_plateaus

# Shortest constant rate and force [s], [samples] of a frozen sensor: longer than gaps that are bridged silently.
FROZEN_S, FROZEN_SAMPLES = 0.2, 5
STUCK_S = 1.0  # [s] the same for rate or force alone, or for one axis
# While accel is constant: rate [rad/s] at which gyro tilts it, above any bias, and total tilt [rad].
TIPS, TIPPED = 0.2, 1.0
MOVES = 2.0  # [m/s²] change of accel on an axis that proves motion
# A gyroscope with a dead zone reports zero [rad/s]; at rest the mean force over some time [s] is constant to [m/s²],
# a degree of tilt. Noise is some 0.05 m/s² a sample.
ZERO_RATE = 1e-4
REST_WINDOW_S, REST_FORCE = 0.5, 0.2
# Arms that all turn about the vertical by so much [rad] in some time [s], the same way, turn with the trunk: without
# it they turn by 180 deg from one side to the other, and by 90 deg stirring.
TURN_ON_S, TURNED_ON = 10.0, np.deg2rad(270.0)
# Noise reverses at two of three samples or, filtered, dozens of times a second; smooth motion hardly does.
TURNS_BACK, TURNS_BACK_HZ = 0.3, 15.0
NOISY_S = 1.5  # [s] of noise that prove a sensor to be noisy
COARSE = 1e-4  # share of long runs (twice the usual length) of equal samples from which the digits are coarse

# An axis is stuck when the noise of its neighbours gives its repetitions a probability below e^-60. Only digits up to
# these sizes [rad/s], [m/s²] count: with coarser ones a tremor may be visible on one axis alone.
IMPROBABLE = 60.0
COARSEST = np.repeat([np.deg2rad(0.25), 0.05], 3)
WIDE = 1.5  # [digits] a step above this is wider than one digit
FEWEST_WIDE = 10  # steps
LARGEST = 1e9  # of what a file states, in any unit; numbers are bounded by it, so that their squares are numbers too
ENOUGH_NOISE_S = 30.0  # [s] of noise that are evaluated
# Up is the mean specific force over `UP_S`; for a measuring sensor it changes by less than `UP_OFF` over two windows.
UP_S, UP_OFF = 2.0, 0.8  # [s], [rad]
UP_FORCE = 0.3  # allowed relative error of its norm against gravity

# Rows that repeat for so long [s], and so many times longer than any others, are reported without proof of a fault.
REPEATED_S, REPEATED_TIMES = 2.0, 10

NOISE_ROWS = 1 << 16  # rows whose noise is evaluated at a time
SAME_RANGE = 0.1  # relative difference between the ranges of a sensor's axes, which have different scales
COPIED = 0.5  # share of a sensor's changing rows from which equal rows in another sensor prove a copy
# Relative distance below the range at which a sample counts as saturated, since resampling mixes samples.
AT_RANGE = 0.02

BOTH, GYRO, ACCEL = "gyro and accel", "gyro", "accel"
AXES = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
SIGNALS = (BOTH, GYRO, ACCEL, *AXES)
COLUMNS = {BOTH: slice(0, 6), GYRO: slice(0, 3), ACCEL: slice(3, 6)} | {a: slice(k, k + 1) for k, a in enumerate(AXES)}
_MASKS = np.array([sum(1 << axis for axis in range(6)[COLUMNS[signals]]) for signals in SIGNALS])  # a bit for each axis
_LEAST_S = (1.0 - 1e-6) * np.array([FROZEN_S] + [STUCK_S] * 8)  # [s] of a run of each of `SIGNALS`


class Fault(NamedTuple):
    """An interval in which a sensor repeated one value and did not measure."""

    signals: str  # of `SIGNALS`
    first: float  # [s] the last measured sample
    last: float  # [s] the last faulty sample
    value: tuple[float, ...]  # the repeated value, SI

    def describe(self, since: float) -> str:
        """Describe the fault from the time [s] `since` on."""
        value = ", ".join(f"{v:.4g}" for v in self.value[:3])
        unit = "m/s^2" if self.signals.startswith("accel") else "rad/s"
        stands = "stand still, gyro" if "and" in self.signals else "stands still"
        return f"{self.signals} {stands} at {value} {unit} from {format_time(since)} to {format_time(self.last)} s"


class Run(NamedTuple):
    """Consecutive rows with equal values of a signal."""

    signals: str  # of `SIGNALS`
    first: int  # row
    last: int


@inlined
def _find_equal_axes(gyro_S, accel_S, k):  # type: ignore[no-untyped-def]
    """Find the axes on which row k repeats the one before, a bit each."""
    equal = 0
    for axis in range(3):
        equal |= (gyro_S[k, axis] == gyro_S[k - 1, axis]) << axis
        equal |= (accel_S[k, axis] == accel_S[k - 1, axis]) << (3 + axis)
    return equal


@compiled
def _find_runs(time, gyro_S, accel_S, runs):  # type: ignore[no-untyped-def]
    """Fill `runs` with the long runs of equal rows: index of `SIGNALS`, first and last row. Return their number."""
    count, n, k, equal = 0, len(time), 1, 0
    begin = np.full(len(_MASKS), -1)
    while k <= n:
        # Of so few rows, a long run repeats a value in the last one too.
        last = k + FROZEN_SAMPLES - 2
        if equal == 0 and last < n and _find_equal_axes(gyro_S, accel_S, last) == 0:
            k = last + 1
            continue
        before, equal = equal, _find_equal_axes(gyro_S, accel_S, k) if k < n else 0
        for signals in range(len(_MASKS) if before | equal else 0):
            first = begin[signals]
            if equal & _MASKS[signals] == _MASKS[signals]:
                begin[signals] = k - 1 if first < 0 else first
            elif first >= 0:
                begin[signals] = -1
                if k - first >= FROZEN_SAMPLES and time[k - 1] - time[first] >= _LEAST_S[signals]:
                    runs[count, 0], runs[count, 1], runs[count, 2] = signals, first, k - 1
                    count += 1
        k += 1
    return count


class SensorScan:
    """The long runs of equal values of one sensor, and what its other samples say about them.

    Parameters
    ----------
    time, gyro_S, accel_S : (n,) [s], (n, 3) [rad/s], (n, 3) [m/s²], numbers
    """

    def __init__(self, time: np.ndarray, gyro_S: np.ndarray, accel_S: np.ndarray) -> None:
        self.time, self.gyro_S, self.accel_S = (np.ascontiguousarray(each) for each in (time, gyro_S, accel_S))
        runs = np.empty((len(SIGNALS) * (len(time) // (FROZEN_SAMPLES - 1) + 1), 3), dtype=np.int64)
        count = _find_runs(self.time, self.gyro_S, self.accel_S, runs)
        self.runs = [Run(SIGNALS[index], first, last) for index, first, last in runs[:count].tolist()]

    def long_runs(self, signals: str) -> list[Run]:
        """Return the long runs of equal rows of a signal."""
        return [run for run in self.runs if run.signals == signals]

    def is_constant(self, signals: str) -> bool:
        """Return whether the signal has one value in all rows."""
        return any(run.last - run.first == len(self.time) - 1 for run in self.long_runs(signals))

    def seconds(self, run: Run) -> float:
        """Return the duration [s] of a run."""
        return float(self.time[run.last] - self.time[run.first])

    @cached_property
    def gyro_range(self) -> float:
        """Rate [rad/s] from which an axis counts as saturated; infinite: none is. A sensor's axes have one range."""
        gyro = self.gyro_S
        if not has_plateaus(gyro, NARROWEST_GYRO_RANGE):
            return np.inf
        # It is constant there while another signal changes.
        values = np.hstack([gyro[self._changing], self.accel_S[self._changing]])
        cut = find_cut_off(values[:, :3], NARROWEST_GYRO_RANGE)
        moves = (np.abs(np.diff(values, axis=0)) > ROUNDING * np.abs(values).max(axis=0)).any(axis=1)
        levels = np.abs(values[1:, :3][cut[1:] & cut[:-1] & moves[:, None]])
        return float((1.0 - AT_RANGE) * levels[levels > (1.0 - SAME_RANGE) * np.abs(gyro).max()].min(initial=np.inf))

    @cached_property
    def _changing(self) -> np.ndarray:
        """The rows that differ from the one before, (m,)."""
        return np.flatnonzero(_find_changes(self.gyro_S, self.accel_S))

    @cached_property
    def _noise(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Seconds in which all axes reverse as in noise; steps there, (6,); those wider than a digit, (6,)."""
        seconds, steps, wide_steps = 0.0, np.zeros(6), np.zeros(6)
        for first in range(0, len(self._changing), NOISE_ROWS):
            rows = self._changing[first : first + NOISE_ROWS]
            if len(rows) < 2 * FROZEN_SAMPLES or seconds >= ENOUGH_NOISE_S:
                break
            usual = max(float(np.median(np.diff(self.time[rows]))), 1e-9)
            noise = _find_noise(np.hstack([self.gyro_S[rows], self.accel_S[rows]]), usual)
            seconds += noise.shape[0] * noise.shape[1] * usual
            # A digit is the smallest step of a second.
            digit = np.where(noise > 0.0, noise, np.inf).min(axis=1)  # (m, 6)
            fine = digit < COARSEST
            for signals in (GYRO, ACCEL):
                columns = COLUMNS[signals]
                measured = (noise[:, :, columns] > 0.0).any(axis=2).sum(axis=1)  # a signal may have a lower rate
                steps[columns] += measured @ fine[:, columns]
            wide_steps += ((noise > WIDE * digit[:, None]) & fine[:, None]).sum(axis=(0, 1))
        return seconds, steps, wide_steps

    @cached_property
    def repeat_surprisal(self) -> dict[str, float]:
        """−log of a bound on the probability that a row repeats a signal's value.

        For gyro and accel the bound comes from their own noise, for an axis from that of the other axes of its signal.
        """
        _, steps, _ = self._noise
        bounds = {BOTH: 1.0}
        for signals in (GYRO, ACCEL):
            axes = range(6)[COLUMNS[signals]]
            # The rows are those of the faster signal: the other one repeats between its samples.
            fresh = min(1.0, steps[axes[0]] / max(float(steps.max()), 1.0))
            bounds[signals] = float(np.prod([self._bound_repeats([k]) ** fresh for k in axes]))
            bounds |= {AXES[axis]: self._bound_repeats([k for k in axes if k != axis]) for axis in axes}
        return {signals: -float(np.log(max(bound, 1e-300))) for signals, bound in bounds.items()}

    def _bound_repeats(self, axes: list[int]) -> float:
        """Return the bound on the probability that an axis with at least the noise of these repeats a sample.

        A step wider than a digit is a change of the noise by more than a digit, whatever the value between two digits.
        The share of such steps gives a lower bound on the noise, and so an upper bound on repetitions.
        """
        _, steps, wide_steps = self._noise
        known = [k for k in axes if steps[k] > 0]
        wide = min(((wide_steps[k] - 3.0 * np.sqrt(wide_steps[k])) / steps[k] for k in known), default=0.0)
        if wide * min((steps[k] for k in known), default=0.0) < FEWEST_WIDE:
            return 1.0
        std = -1.0 / (np.sqrt(2.0) * float(ndtri(min(wide, 1.0) / 2.0)))  # [digits]
        return float(2.0 * ndtr(0.5 / std) - 1.0)

    @cached_property
    def is_noisy(self) -> bool:
        """Whether only a fault makes two samples in a row equal: the noise is larger than the digits."""
        lengths, long_ = np.sort(self._lengths), len(self.long_runs(BOTH))
        if not len(lengths):
            return False
        usual = lengths[(len(lengths) - 1) // 2]
        longer = np.count_nonzero(lengths > 2 * usual) - long_
        return bool(self._noise[0] >= NOISY_S and longer <= 2 * long_ + COARSE * len(lengths))

    @property
    def _lengths(self) -> np.ndarray:
        """The lengths [rows] of all runs of equal rows, those of one row as well."""
        return np.diff(self._changing, append=len(self.time))

    def find_long_repeats(self) -> list[Run]:
        """Find the runs of equal rows that are much longer than all others of the sensor."""
        seconds = self.time[self._changing + self._lengths - 1] - self.time[self._changing]
        most = REPEATED_TIMES * self._lengths[seconds < REPEATED_S].max(initial=1)
        runs = (run for run in self.long_runs(BOTH) if self.seconds(run) >= REPEATED_S)
        return [run for run in runs if run.last - run.first + 1 > most]


def _find_changes(*signals: np.ndarray) -> np.ndarray:
    """Find the rows (n,) in which any of the signals (n, k) differs from the row before; the first one does."""
    changes = np.any([(signal[1:] != signal[:-1]).any(axis=1) for signal in signals], axis=0)
    return np.concatenate([[True], changes])[: len(signals[0])]


def _find_noise(values: np.ndarray, usual: float) -> np.ndarray:
    """Find the seconds in which all axes of `values` (n, 6) reverse as in noise, which happens with little motion.

    Return the sizes of the steps in them, (seconds, samples, 6); `usual` [s] is the step of time.
    """
    size = min(len(values) - 2, max(FROZEN_SAMPLES, round(1.0 / usual)))
    steps = np.diff(values, axis=0)
    steps[np.abs(steps) < ROUNDING * np.abs(values[1:]).max(axis=0)] = 0.0
    count = (len(steps) - 1) // size
    turns = (np.sign(steps[1:]) * np.sign(steps[:-1]) < 0.0)[: count * size].reshape(count, size, 6).mean(axis=1)
    steps = np.abs(steps[1 : count * size + 1]).reshape(count, size, 6)
    varies = (steps != 0.0).any(axis=1)
    share = np.where(varies, turns, np.inf).min(axis=1)  # least of all axes: in motion some do not reverse
    return steps[varies.any(axis=1) & (share > min(TURNS_BACK, TURNS_BACK_HZ * usual))]


def find_faults(scans: Mapping[str, SensorScan]) -> dict[str, list[Fault]]:
    """Find the intervals in which sensors were frozen or stuck: sensor → faults in the order of time."""
    faults = {}
    for name, scan in scans.items():
        others = [other for other in scans.values() if other is not scan]
        stuck: list[Run] = []
        for group in ((BOTH,), (GYRO, ACCEL), AXES):
            runs = [run for run in scan.runs if run.signals in group and not _is_within(run, stuck)]
            stuck += [run for run in runs if _is_stuck(run, scan, others)]
        if stuck:
            stuck.sort(key=lambda run: (run.first, SIGNALS.index(run.signals)))
            faults[name] = [_make_fault(run, scan) for run in stuck]
    return faults


def _is_stuck(run: Run, scan: SensorScan, others: list[SensorScan]) -> bool:
    """Return whether physics or noise contradict that the sensor measured in a run."""
    time, gyro, accel = (each[run.first : run.last + 1] for each in (scan.time, scan.gyro_S, scan.accel_S))
    count = len(time)
    if run.signals in (BOTH, ACCEL):
        up = accel[1:] / np.maximum(np.linalg.norm(accel[1:], axis=1), 1e-9)[:, None]
        tipped = float(np.sum(np.linalg.norm(np.cross(gyro[1:], up), axis=1) * np.diff(time)))
        tips = tipped > TIPS * scan.seconds(run)
        if run.signals == BOTH:
            # A sensor that is constant from the beginning shows no noise; the others are of the same kind.
            return tips or (any(other.is_noisy for other in others) if count == len(scan.time) else scan.is_noisy)
        contradicts = tips and tipped > TIPPED
    elif run.signals == GYRO:
        dead = count == len(scan.time) and not scan.is_constant(ACCEL) and not all(o.is_constant(GYRO) for o in others)
        contradicts = float(np.ptp(accel, axis=0).max()) > MOVES or (dead and scan.is_noisy)
    else:
        axes = gyro if run.signals in AXES[:3] else accel
        count = int(np.count_nonzero((np.diff(axes, axis=0) != 0.0).any(axis=1)))
        contradicts = _compute_up_change(time, gyro, accel) > UP_OFF
    contradicts = contradicts or count * scan.repeat_surprisal[run.signals] > IMPROBABLE
    value = np.abs(_find_value(run, scan)).max()
    if run.signals in AXES:  # a constant value at the end of the range is saturation
        contradicts &= bool(value < (scan.gyro_range if run.signals in AXES[:3] else NARROWEST_ACCEL_RANGE))
    if run.signals.startswith("gyro") and value < ZERO_RATE:
        means = _average_force(time[1:], accel[1:])
        contradicts &= not (len(means) and float(np.ptp(means, axis=0).max()) < REST_FORCE)
        contradicts |= run.signals == GYRO and _turn_together(scan.time[run.first], scan.time[run.last], others)
    return contradicts


def _turn_together(begin: float, end: float, scans: list[SensorScan]) -> bool:
    """Return whether all sensors that measure turn on about the vertical, the same way, in some `TURN_ON_S`."""
    at, turns = np.arange(begin, end - TURN_ON_S, 1.0), []
    for scan in scans:
        if not scan.is_constant(GYRO):
            up = scan.accel_S / np.maximum(np.linalg.norm(scan.accel_S, axis=1), 1e-9)[:, None]
            steps = np.sum(scan.gyro_S * up, axis=1) * np.diff(scan.time, prepend=scan.time[0])
            turned = np.interp([at, at + TURN_ON_S], scan.time, np.cumsum(steps))
            turns.append(turned[1] - turned[0])
    return bool(turns) and bool((np.min(turns, axis=0) > TURNED_ON).any() or (np.max(turns, axis=0) < -TURNED_ON).any())


def _average_force(time: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """Compute the mean specific forces (m, 3) over the complete windows of `REST_WINDOW_S`."""
    window = np.floor((time - time[0]) / REST_WINDOW_S).astype(int)
    edges = np.flatnonzero(np.diff(window, prepend=-1))  # of windows that hold samples; the last one is not complete
    return np.add.reduceat(accel, edges)[:-1] / np.diff(edges)[:, None]


def _compute_up_change(time: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> float:
    """Compute the largest angle [rad] between mean specific forces over `UP_S` two windows apart, in the world."""
    window = np.floor((time - time[0]) / UP_S).astype(int)
    count = int(window[-1])  # complete windows
    edges = np.searchsorted(window, np.arange(count + 1))
    if count < 3 or (np.diff(edges) == 0).any():
        return 0.0
    force = rotations.unroll(gyro * np.diff(time, prepend=time[0])[:, None], accel)
    mean = np.add.reduceat(force, edges[:-1])[:count] / np.diff(edges)[:, None]
    size = np.linalg.norm(mean, axis=1)
    known = np.abs(size / STANDARD_GRAVITY - 1.0) < UP_FORCE
    up = mean / np.maximum(size, 1e-9)[:, None]
    off = np.arccos(np.clip(np.sum(up[2:] * up[:-2], axis=1), -1.0, 1.0))
    return float(np.max(off * (known[2:] & known[:-2]), initial=0.0))


def _is_within(run: Run, others: list[Run]) -> bool:
    return any(other.first <= run.first and run.last <= other.last for other in others)


def _find_value(run: Run, scan: SensorScan) -> np.ndarray:
    return np.concatenate([scan.gyro_S[run.first], scan.accel_S[run.first]])[COLUMNS[run.signals]]


def _make_fault(run: Run, scan: SensorScan) -> Fault:
    first = scan.time[run.first]
    if run.first == 0:  # at the beginning of the recording the first sample is faulty, too
        first = np.nextafter(first, -np.inf)
    return Fault(run.signals, float(first), float(scan.time[run.last]), tuple(_find_value(run, scan).tolist()))


class SensorCheck(NamedTuple):
    """What the samples of a recording say about its sensors."""

    faults: dict[str, list[Fault]]  # sensor → faults in the order of time
    gyro_range: dict[str, float]  # [rad/s] as `SensorScan.gyro_range`
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
    scans = {name: SensorScan(*_take_numbers(*each)) for name, each in samples.items() if len(each) == 3}
    diagnostics = []
    for name, other, rows in _find_copies(samples):
        if name in scans:
            raise BadData(
                f"{where}: sensors.{name} and sensors.{other} hold the same values in {rows} rows: "
                f"one is a copy of the other; name the file and columns in which each was recorded"
            )
        diagnostics.append(Diagnostic("orientations-copied", WARNING, name, facts={"other": other}))
    faults = find_faults(scans)
    for name, each in faults.items():
        begin, end = (float(scans[name].time[k]) for k in (0, -1))
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
    diagnostics += _find_repeats(scans, faults)
    for name, (_, *values) in samples.items():
        known = values[0][np.isfinite(values[0]).all(axis=1) & values[0].any(axis=1)]  # zeros mark a lost sample
        if name not in scans and len(known) >= FROZEN_SAMPLES and (known == known[0]).all():
            diagnostics.append(
                Diagnostic("sensor-frozen", WARNING, name, facts={"variant": "orientation", "rows": len(known)})
            )
    return SensorCheck(faults, {name: scan.gyro_range for name, scan in scans.items()}, diagnostics)


def _take_numbers(*values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Take the rows that are numbers, each at most `LARGEST`."""
    if not all(np.isfinite(each).all() for each in values):  # far faster than row by row
        good = np.all([np.isfinite(each[:, None] if each.ndim == 1 else each).all(axis=1) for each in values], axis=0)
        values = tuple(each[good] for each in values)
    time, *signals = values
    # Without larger ones no copy is made: of a day it is gigabytes.
    most = max(max(signal.max(initial=0.0), -signal.min(initial=0.0)) for signal in signals)
    return time, *(np.clip(signal, -LARGEST, LARGEST) if most > LARGEST else signal for signal in signals)


def _find_copies(samples: Mapping[str, tuple[np.ndarray, ...]]) -> list[tuple[str, str, int]]:
    """Find pairs of sensors of one kind with the same values, and the number of equal rows that change."""
    copies = []
    for (name, (_, *a)), (other, (_, *b)) in combinations(samples.items(), 2):
        if len(a) == len(b) and len(a[0]) == len(b[0]):
            alike = np.flatnonzero(a[0][:, 0] == b[0][:, 0])  # few, unless it is a copy
            if len(alike) < FROZEN_SAMPLES:
                continue
            changes = _find_changes(*a)
            equal = np.all([(x[alike] == y[alike]).all(axis=1) for x, y in zip(a, b, strict=True)], axis=0)
            rows = int(np.count_nonzero(equal & changes[alike]))
            if rows >= FROZEN_SAMPLES and rows > COPIED * np.count_nonzero(changes):
                copies.append((name, other, rows))
    return copies


def _find_repeats(scans: Mapping[str, SensorScan], faults: Mapping[str, list[Fault]]) -> list[Diagnostic]:
    """Find sensors that repeat their values for seconds while others change: static on a table, or faulty."""
    spans = {name: [scan.time[[run.first, run.last]] for run in scan.long_runs(BOTH)] for name, scan in scans.items()}
    diagnostics = []
    for name, scan in scans.items():
        for run in scan.find_long_repeats():
            first, last = (float(scan.time[k]) for k in run[1:])
            repeated_s = [sum(max(0.0, min(last, b) - max(first, a)) for a, b in each) for each in spans.values()]
            explained = any(fault.first <= first and last <= fault.last for fault in faults.get(name, []))
            if min(repeated_s) < 0.5 * (last - first) and not explained:
                facts: dict[str, float | str] = {"variant": "repeats", "start": first, "end": last}
                diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, last - first, facts=facts))
    return diagnostics
