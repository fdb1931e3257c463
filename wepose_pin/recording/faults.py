"""Faults of sensors: dead, stuck or frozen at one value, saturated, or copies of one another.

A repeated value alone is no fault: a coarse sensor on a table repeats for minutes, and so do data without noise. It is
a fault where it contradicts physics, or where the sensor is noisy whenever it does not repeat:

- constant specific force in the sensor while it rotates about a horizontal axis;
- a constant rate while the specific force changes as in motion;
- constant rate and force of a sensor with noise larger than its digits: two consecutive samples are never equal;
- a constant rate, or a constant force, where the noise that this signal has elsewhere makes so many repetitions
  improbable.

Some gyroscopes report exactly zero at rest: their firmware has a dead zone. Zeros while the specific force shows no
motion are therefore no fault.

A single axis may be constant during motion about another axis. It is a fault where

- the noise of the other axes makes so many repetitions improbable; or
- the mean specific force over some seconds, rotated by the gyroscope, does not point up, since an axis is missing.

The scan works block by block, so that a recording in chunks has the same faults as the whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from .clocks import LONGEST_GAP_S, Clock
from .gaps import GOOD, find_runs
from .intervals import format_time
from .limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE, STANDARD_GRAVITY
from .plausibility import ROUNDING, find_cut_off

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

ROWS = 1 << 16  # rows in a block
SAME_RANGE = 0.1  # relative difference between the ranges of a sensor's axes, which have different scales
COPIED = 0.5  # share of a sensor's changing rows from which equal rows in another sensor prove a copy
AT_RANGE = (
    0.02  # relative distance below the range at which a sample counts as saturated, since resampling mixes samples
)


class Fault(NamedTuple):
    """An interval in which a sensor repeated one value and did not measure."""

    signals: str  # "gyro", "accel", "gyro and accel", or an axis, "gyro x"
    first: float  # [s] the last measured sample
    last: float  # [s] the last faulty sample
    value: tuple[float, ...]  # the repeated value, SI

    def describe(self, since: float) -> str:
        """Describe the fault from the time [s] `since` on."""
        value = ", ".join(f"{v:.4g}" for v in self.value[:3])
        unit = "m/s^2" if self.signals.startswith("accel") else "rad/s"
        stands = "stand still, gyro" if "and" in self.signals else "stands still"
        return f"{self.signals} {stands} at {value} {unit} from {format_time(since)} to {format_time(self.last)} s"


@dataclass
class _Run:
    """Consecutive rows with equal values of a signal, and the other signals meanwhile."""

    rows: int
    first: float  # [s]
    last: float  # [s]
    value: np.ndarray  # (6,) gyro and accel of the first row
    low: np.ndarray  # (3,) of accel
    high: np.ndarray  # (3,)
    mean_low: np.ndarray  # (3,) of accel's means over `REST_WINDOW_S`
    mean_high: np.ndarray  # (3,)
    tipped: float  # [rad], ∫ |gyro × up|
    up_off: float  # [rad] change of up by the whole sensor; 0: not computed
    distinct: int  # rows in which other axes of the signal differ from the row before
    first_row: bool  # the run begins with the recording

    def join(self, after: _Run) -> _Run:
        """Join this run and the one after it, which have one row in common."""
        return replace(
            self,
            rows=self.rows + after.rows - 1,
            last=after.last,
            low=np.minimum(self.low, after.low),
            high=np.maximum(self.high, after.high),
            mean_low=np.minimum(self.mean_low, after.mean_low),
            mean_high=np.maximum(self.mean_high, after.mean_high),
            tipped=self.tipped + after.tipped,
            up_off=max(self.up_off, after.up_off),
            distinct=self.distinct + after.distinct,
        )

    @property
    def seconds(self) -> float:
        return self.last - self.first

    def rests(self, name: str) -> bool:
        """Return whether gyro, or this axis of it, reports zero while accel shows no motion."""
        zero = np.abs(self.value[_SIGNALS[name]]).max() < ZERO_RATE
        return bool(name.startswith("gyro") and zero and 0.0 <= np.max(self.mean_high - self.mean_low) < REST_FORCE)

    @property
    def tips(self) -> float:
        """Mean rate [rad/s] at which gyro tilts accel."""
        return self.tipped / max(self.seconds, 1e-9)


_Sample = tuple[float, np.ndarray]  # time [s], value
_LONGEST = 1000  # longest run in the histogram of lengths [rows]
_AXES = {f"{name} {axis}": slice(k, k + 1) for k, (name, axis) in enumerate(product(("gyro", "accel"), "xyz"))}
_SIGNALS = {"gyro and accel": slice(0, 6), "gyro": slice(0, 3), "accel": slice(3, 6), **_AXES}


@dataclass
class SensorScan:
    """Statistics of a sensor's rows that prove faults, from blocks in SI and in the order of time."""

    rows: int = 0
    first: float = 0.0  # [s]
    last: float = 0.0  # [s]
    _before: np.ndarray | None = None  # (7,) time and values of the last row
    _long: dict[str, list[_Run]] = field(default_factory=lambda: {name: [] for name in _SIGNALS})
    _open: dict[str, _Run | None] = field(default_factory=lambda: dict.fromkeys(_SIGNALS))
    _lengths: np.ndarray = field(default_factory=lambda: np.zeros(_LONGEST + 1, dtype=np.int64))  # rows → runs
    _noisy_s: float = 0.0  # [s] with reversals as in noise
    _noise_steps: np.ndarray = field(default_factory=lambda: np.zeros(6))  # number of steps of each axis in that time
    _wide_steps: np.ndarray = field(default_factory=lambda: np.zeros(6))  # number of these steps wider than a digit
    _peak: float = 0.0  # [rad/s] largest rate of all axes
    _levels: list[float] = field(default_factory=list)  # [rad/s] levels at which an axis seems saturated

    def push(self, time: np.ndarray, values: np.ndarray) -> None:
        """Add the next rows: times (n,) [s], gyro and accel (n, 6)."""
        if not len(time):
            return
        block = np.column_stack([time, values])
        first_row = self._before is None
        if self._before is None:
            self.first = float(time[0])
        else:
            block = np.concatenate([self._before[None], block])
        self.rows += len(time)
        self.last, self._before = float(time[-1]), block[-1].copy()
        if len(block) < 2:
            return
        equal = np.stack([axis[1:] == axis[:-1] for axis in block[:, 1:].T])
        for name, axes in _SIGNALS.items():
            self._collect_runs(name, block, np.logical_and.reduce(equal[axes]), first_row)
        changing = block[np.concatenate([[True], ~np.logical_and.reduce(equal)])]
        if self._noisy_s < ENOUGH_NOISE_S:
            self._count_noise(changing)
        self._find_levels(changing[:, 1:])

    def _collect_runs(self, name: str, block: np.ndarray, same: np.ndarray, first_row: bool) -> None:
        spans = np.array(find_runs(same), dtype=np.int64).reshape(-1, 2)
        length = spans[:, 1] - spans[:, 0] + 1
        if name == "gyro and accel":
            length = np.minimum(length, _LONGEST)
            self._lengths += np.bincount(length, minlength=_LONGEST + 1)
            self._lengths[1] += int(len(same) - same.sum()) - len(spans)
        edge = (spans[:, 0] == 0) | (spans[:, 1] == len(same))
        seconds = block[spans[:, 1], 0] - block[spans[:, 0], 0]
        open_, self._open[name] = self._open[name], None
        if open_ is not None and not same[0]:
            self._close(name, open_)
            open_ = None
        for a, b in spans[((length >= FROZEN_SAMPLES) & (seconds >= _least_s(name))) | edge]:
            run = _make_run(block[a : b + 1], name, first_row and a == 0)
            if open_ is not None and a == 0:
                run, open_ = open_.join(run), None
            if b == len(same):
                self._open[name] = run
            else:
                self._close(name, run)

    def _close(self, name: str, run: _Run) -> None:
        if run.rows >= FROZEN_SAMPLES and run.seconds >= _least_s(name):
            self._long[name].append(run)

    def _count_noise(self, distinct: np.ndarray) -> None:
        """Count the seconds in which all axes reverse as in noise, which happens with little motion."""
        if len(distinct) < 2 * FROZEN_SAMPLES:
            return
        usual = max(float(np.median(np.diff(distinct[:, 0]))), 1e-9)
        size = min(len(distinct) - 2, max(FROZEN_SAMPLES, round(1.0 / usual)))
        steps = np.diff(distinct[:, 1:], axis=0)
        steps[np.abs(steps) < ROUNDING * np.abs(distinct[1:, 1:]).max(axis=0)] = 0.0
        count = (len(steps) - 1) // size
        turns = (np.sign(steps[1:]) * np.sign(steps[:-1]) < 0.0)[: count * size].reshape(count, size, 6).mean(axis=1)
        varies = (steps[1:] != 0.0)[: count * size].reshape(count, size, 6).any(axis=1)
        share = np.where(varies, turns, np.inf).min(axis=1)  # least of all axes: in motion some do not reverse
        share[~varies.any(axis=1)] = 0.0
        noise = share > min(TURNS_BACK, TURNS_BACK_HZ * usual)
        self._noisy_s += float(np.count_nonzero(noise)) * size * usual
        self._count_wide_steps(np.abs(steps[1:])[: count * size].reshape(count, size, 6)[noise])

    def _count_wide_steps(self, steps: np.ndarray) -> None:
        """Count steps (m, size, 6) of noise, and those wider than a digit, the smallest step of their second."""
        digit = np.where(steps > 0.0, steps, np.inf).min(axis=1)  # (m, 6)
        fine = digit < COARSEST
        for signal in (_SIGNALS["gyro"], _SIGNALS["accel"]):
            measured = (steps[:, :, signal] > 0.0).any(axis=2).sum(axis=1)  # a signal may have a lower rate
            self._noise_steps[signal] += measured @ fine[:, signal]
        self._wide_steps += ((steps > WIDE * digit[:, None]) & fine[:, None]).sum(axis=(0, 1))

    def repeats(self, axis: int) -> float:
        """Return a bound on the probability that this axis repeats a sample, from the noise of the signal's other axes.

        A step wider than a digit is a change of the noise by more than a digit, whatever the value between two digits.
        The share of such steps gives a lower bound on the noise, and so an upper bound on repetitions.
        """
        first = 3 * (axis // 3)
        return self._bound_repeats([k for k in range(first, first + 3) if k != axis])

    def repeats_of(self, name: str) -> float:
        """Return a bound on the probability that all axes of gyro or accel repeat a row, from their own noise.

        The rows are those of the faster signal: the other one repeats between its samples.
        """
        axes = range(6)[_SIGNALS[name]]
        fresh = min(1.0, self._noise_steps[axes[0]] / max(float(self._noise_steps.max()), 1.0))
        return float(np.prod([self._bound_repeats([k]) ** fresh for k in axes]))

    def _bound_repeats(self, axes: list[int]) -> float:
        """Return the bound on the probability that an axis with at least the noise of these repeats a sample."""
        others = [k for k in axes if self._noise_steps[k] > 0]
        if not others:
            return 1.0
        wide = min((self._wide_steps[k] - 3.0 * np.sqrt(self._wide_steps[k])) / self._noise_steps[k] for k in others)
        if wide * min(self._noise_steps[k] for k in others) < FEWEST_WIDE:
            return 1.0
        std = -1.0 / (np.sqrt(2.0) * float(ndtri(min(wide, 1.0) / 2.0)))  # [digits]
        return float(2.0 * ndtr(0.5 / std) - 1.0)

    def _find_levels(self, values: np.ndarray) -> None:
        """Find the levels at which an axis of gyro is constant while another signal changes."""
        gyro = values[:, :3]
        self._peak = max(self._peak, float(np.abs(gyro).max()))
        cut = find_cut_off(gyro, NARROWEST_GYRO_RANGE)
        if cut.any():
            changes = (np.abs(np.diff(values, axis=0)) > ROUNDING * np.abs(values).max(axis=0)).any(axis=1)
            stays = cut[1:] & cut[:-1] & changes[:, None]
            if stays.any():
                self._levels.append(float(np.abs(gyro[1:][stays]).min()))

    @property
    def gyro_range(self) -> float:
        """Rate [rad/s] from which an axis counts as saturated; infinite: none is. A sensor's axes have one range."""
        return (1.0 - AT_RANGE) * min((v for v in self._levels if v > (1.0 - SAME_RANGE) * self._peak), default=np.inf)

    def long_runs(self, name: str) -> list[_Run]:
        """Return the runs of equal rows of a signal so far."""
        open_, known = self._open[name], self._long[name]
        if open_ is None or open_.rows < FROZEN_SAMPLES or open_.seconds < _least_s(name):
            return known
        return [*known, open_]

    def noisy(self) -> bool:
        """Return whether only a fault makes two samples in a row equal: the noise is larger than the digits."""
        if self._noisy_s < NOISY_S:
            return False
        long_ = sum(run.rows >= FROZEN_SAMPLES for run in self.long_runs("gyro and accel"))
        short = self._lengths.copy()
        usual = int(np.searchsorted(np.cumsum(short), 0.5 * short.sum()))
        longer = int(short[2 * usual + 1 :].sum()) - long_
        return longer <= 2 * long_ + COARSE * short.sum()

    def long_repeats(self) -> list[_Run]:
        """Return the runs of equal rows that are much longer than all others of the sensor."""
        counts = self._lengths.copy()
        runs_ = [run for run in self.long_runs("gyro and accel") if run.seconds >= REPEATED_S]
        for run in runs_:
            counts[min(run.rows, _LONGEST)] -= 1
        usual = int(np.flatnonzero(counts > 0).max(initial=1))
        return [run for run in runs_ if run.rows > REPEATED_TIMES * usual]

    def constant(self, name: str) -> bool:
        """Return whether the signal has one value in all rows."""
        return any(run.rows == self.rows for run in self.long_runs(name))


def scan_sensor(time: np.ndarray, gyro_S: np.ndarray, accel_S: np.ndarray) -> SensorScan:
    """Scan the rows of one sensor for faults: times (n,) [s], (n, 3) [rad/s], (n, 3) [m/s²]."""
    scan = SensorScan()
    for first in range(0, len(time), ROWS):
        rows = slice(first, first + ROWS)
        scan.push(time[rows], np.column_stack([gyro_S[rows], accel_S[rows]]))
    return scan


def _least_s(name: str) -> float:
    """Return the shortest duration [s] of a run of equal samples of the signal."""
    return (FROZEN_S if name == "gyro and accel" else STUCK_S) * (1.0 - 1e-6)


def _make_run(rows: np.ndarray, name: str, first_row: bool) -> _Run:
    time, gyro, accel = rows[:, 0], rows[1:, 1:4], rows[1:, 4:]
    up = accel / np.maximum(np.linalg.norm(accel, axis=1), 1e-9)[:, None]
    tipped = float(np.sum(np.linalg.norm(np.cross(gyro, up), axis=1) * np.diff(time)))
    low, high = rows[:, 4:].min(axis=0), rows[:, 4:].max(axis=0)
    up_off, distinct = 0.0, 0
    if name in _AXES:
        signal = rows[:, 1:4] if name.startswith("gyro") else rows[:, 4:]
        up_off, distinct = _compute_up_change(rows), int(np.count_nonzero((np.diff(signal, axis=0) != 0.0).any(axis=1)))
    value, means = rows[0, 1:].copy(), _average_force(time[1:], accel)
    mean_low, mean_high = means.min(axis=0, initial=np.inf), means.max(axis=0, initial=-np.inf)
    ends = float(time[0]), float(time[-1])
    return _Run(len(rows), *ends, value, low, high, mean_low, mean_high, tipped, up_off, distinct, first_row)


def _average_force(time: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """Compute the mean specific forces (m, 3) over the complete windows of `REST_WINDOW_S`."""
    window = np.floor((time - time[0]) / REST_WINDOW_S).astype(int)
    edges = np.flatnonzero(np.diff(window, prepend=-1))  # of windows that hold samples; the last one is not complete
    return np.add.reduceat(accel, edges)[:-1] / np.diff(edges)[:, None]


def _compute_up_change(rows: np.ndarray) -> float:
    """Compute the largest angle [rad] between mean specific forces over `UP_S` two windows apart, in the world."""
    time, gyro, accel = rows[:, 0], rows[1:, 1:4], rows[:, 4:]
    window = np.floor((time - time[0]) / UP_S).astype(int)
    count = int(window[-1])  # complete windows
    if count < 3:
        return 0.0
    force = Rotation.from_quat(rotations.integrate(gyro * np.diff(time)[:, None])).apply(accel)
    edges = np.searchsorted(window, np.arange(count + 1))
    if (np.diff(edges) == 0).any():
        return 0.0
    mean = np.add.reduceat(force, edges[:-1])[:count] / np.diff(edges)[:, None]
    size = np.linalg.norm(mean, axis=1)
    known = np.abs(size / STANDARD_GRAVITY - 1.0) < UP_FORCE
    up = mean / np.maximum(size, 1e-9)[:, None]
    off = np.arccos(np.clip(np.sum(up[2:] * up[:-2], axis=1), -1.0, 1.0))
    return float(np.max(off * (known[2:] & known[:-2]), initial=0.0))


def find_faults(scans: Mapping[str, SensorScan]) -> dict[str, list[Fault]]:
    """Find the intervals in which sensors were frozen or stuck: sensor → faults in the order of time."""
    noisy = {name: scan.noisy() for name, scan in scans.items()}
    all_faults = {}
    for name, scan in scans.items():
        others = [other for other in scans if other != name]
        faults = []
        for run in scan.long_runs("gyro and accel"):
            # A sensor that is constant from the beginning shows no noise; the others are of the same kind.
            fine = any(noisy[other] for other in others) if run.rows == scan.rows else noisy[name]
            if fine or run.tips > TIPS:
                faults.append(_make_fault("gyro and accel", run))
        whole = [(fault.first, fault.last) for fault in faults]
        improbable = {signal: -np.log(max(scan.repeats_of(signal), 1e-300)) for signal in ("gyro", "accel")}
        for run in scan.long_runs("gyro"):
            dead = scan.constant("gyro") and not scan.constant("accel") and noisy[name]
            dead &= any(not scans[other].constant("gyro") for other in others)
            stuck = dead or np.max(run.high - run.low) > MOVES or run.rows * improbable["gyro"] > IMPROBABLE
            if stuck and not run.rests("gyro") and not _is_within(run, whole):
                faults.append(_make_fault("gyro", run))
        for run in scan.long_runs("accel"):
            stuck = (run.tipped > TIPPED and run.tips > TIPS) or run.rows * improbable["accel"] > IMPROBABLE
            if stuck and not _is_within(run, whole):
                faults.append(_make_fault("accel", run))
        whole = [(fault.first, fault.last) for fault in faults]
        for axis, signals in enumerate(_AXES):
            repeats = -np.log(max(scan.repeats(axis), 1e-300))
            limit = scan.gyro_range if axis < 3 else NARROWEST_ACCEL_RANGE
            for run in scan.long_runs(signals):
                stuck = run.distinct * repeats > IMPROBABLE or run.up_off > UP_OFF
                # A constant value at the end of the range is saturation.
                saturated = abs(run.value[axis]) >= limit
                if stuck and not saturated and not run.rests(signals) and not _is_within(run, whole):
                    faults.append(_make_fault(signals, run))
        if faults:
            all_faults[name] = sorted(faults, key=lambda fault: fault.first)
    return all_faults


def _is_within(run: _Run, spans: list[tuple[float, float]]) -> bool:
    return any(first <= run.first and run.last <= last for first, last in spans)


def _make_fault(signals: str, run: _Run) -> Fault:
    # At the beginning of the recording the first sample is faulty, too.
    first = float(np.nextafter(run.first, -np.inf)) if run.first_row else run.first
    return Fault(signals, first, run.last, tuple(run.value[_SIGNALS[signals]].tolist()))


@dataclass
class Scan:
    """Scan of all sensors of a recording, from blocks of rows, for faults and copies."""

    sensors: dict[str, SensorScan] = field(default_factory=dict)  # sensors with gyro and accel
    orientations: dict[str, OrientationScan] = field(default_factory=dict)
    _equal: dict[tuple[str, str], int] = field(default_factory=dict)  # changing rows that are equal in both sensors
    _changes: dict[str, int] = field(default_factory=dict)  # rows that change
    faults: dict[str, list[Fault]] = field(default_factory=dict)  # set by `finish`

    def push(self, blocks: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
        """Add the next rows of each sensor: times (n,) [s], and gyro and accel (n, 6) or orientations (n, 4)."""
        changed = {}
        for name, (time, values) in blocks.items():
            changed[name] = np.concatenate([[True], (np.diff(values, axis=0) != 0.0).any(axis=1)])[: len(values)]
            self._changes[name] = self._changes.get(name, 0) + int(changed[name].sum())
            good = np.isfinite(values).all(axis=1)
            values = np.clip(values, -LARGEST, LARGEST)
            if values.shape[1] == 4:
                norm = np.linalg.norm(values, axis=1)
                good &= norm > 0.0  # zeros mark a lost sample
                quat_WS = values[good] / norm[good, None]
                self.orientations.setdefault(name, OrientationScan()).push(time[good], quat_WS)
            else:
                self.sensors.setdefault(name, SensorScan()).push(time[good], values[good])
        for name, other in combinations(blocks, 2):
            a, b = blocks[name][1], blocks[other][1]
            if a.shape == b.shape:
                equal = int(((a == b).all(axis=1) & changed[name]).sum())
                self._equal[name, other] = self._equal.get((name, other), 0) + equal

    def finish(self, where: str, start: tuple[float, float] | None) -> None:
        """Find the faults after the last block; `start` [s] is the stated start pose.

        Raises
        ------
        BadData
            Two sensors have the same values, or one is dead in the whole recording or in the start pose.
        """
        for name, other in self._find_copies(self.sensors):
            raise BadData(
                f"{where}: sensors.{name} and sensors.{other} hold the same values in {self._equal[name, other]} rows: "
                f"one is a copy of the other; name the file and columns in which each was recorded"
            )
        self.faults = find_faults(self.sensors)
        for name, faults in self.faults.items():
            scan = self.sensors[name]
            for fault in faults:
                first, last = max(fault.first, scan.first), fault.last
                whole = fault.first < scan.first and last >= scan.last
                if whole or (start is not None and first <= start[0] and last >= start[1]):
                    when = "all along" if whole else "through the start pose"
                    raise BadData(
                        f"{where}: sensors.{name}: {fault.describe(first)}, {when}: it does not measure; take "
                        f"[sensors.{name}] out to track the others" + ("" if whole else ", or name another start pose")
                    )

    def _find_copies(self, names: Iterable[str]) -> list[tuple[str, str]]:
        return [
            pair
            for pair, equal in self._equal.items()
            if pair[0] in names and equal >= FROZEN_SAMPLES and equal > COPIED * self._changes[pair[0]]
        ]

    def diagnostics(self) -> list[Diagnostic]:
        """Return the diagnostics of the faults that `finish` accepted."""
        diagnostics = []
        for name, faults in self.faults.items():
            begin = max(faults[0].first, self.sensors[name].first)
            lost_s = sum(fault.last - max(fault.first, self.sensors[name].first) for fault in faults)
            facts: dict[str, float | str] = {"signals": faults[0].signals, "intervals": len(faults)}
            facts |= {"start": begin, "end": faults[0].last}
            diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, lost_s, facts=facts))
        diagnostics += self._find_repeats()
        for name, scan in self.orientations.items():
            if scan.rows >= FROZEN_SAMPLES and scan.constant:
                diagnostics.append(Diagnostic("orientation-constant", WARNING, name, scan.rows))
        for name, other in self._find_copies(self.orientations):
            diagnostics.append(Diagnostic("orientations-copied", WARNING, name, facts={"other": other}))
        return diagnostics

    def _find_repeats(self) -> list[Diagnostic]:
        """Find sensors that repeat their values for seconds while others change: static on a table, or faulty."""
        repeats = {name: scan.long_runs("gyro and accel") for name, scan in self.sensors.items()}
        diagnostics = []
        for name, scan in self.sensors.items():
            faults = [(fault.first, fault.last) for fault in self.faults.get(name, [])]
            for run in scan.long_repeats():
                moving = [
                    other
                    for other, runs_ in repeats.items()
                    if sum(max(0.0, min(run.last, r.last) - max(run.first, r.first)) for r in runs_) < 0.5 * run.seconds
                ]
                if moving and not _is_within(run, faults):
                    facts: dict[str, float | str] = {"start": run.first, "end": run.last}
                    diagnostics.append(Diagnostic("sensor-repeats", WARNING, name, run.seconds, facts=facts))
        return diagnostics


@dataclass
class OrientationScan:
    """Statistics of measured orientations, and the long gaps between them."""

    rows: int = 0
    constant: bool = True
    _first: np.ndarray | None = None
    _last: _Sample | None = None
    _gaps: list[tuple[_Sample | None, _Sample | None]] = field(default_factory=list)  # last before, first after

    def push(self, time: np.ndarray, quat_WS: np.ndarray) -> None:
        """Add the next rows: times (n,) [s], orientations (n, 4) xyzw."""
        if not len(time):
            return
        if self._first is None:
            self._first = quat_WS[0].copy()
            self._gaps.append((None, (float(time[0]), quat_WS[0].copy())))
        elif self._last is not None and time[0] - self._last[0] > LONGEST_GAP_S:
            self._gaps.append((self._last, (float(time[0]), quat_WS[0].copy())))
        for k in np.flatnonzero(np.diff(time) > LONGEST_GAP_S):
            ends = [(float(time[i]), quat_WS[i].copy()) for i in (k, k + 1)]
            self._gaps.append((ends[0], ends[1]))
        self.rows += len(time)
        self.constant &= bool((quat_WS == self._first).all())
        self._last = float(time[-1]), quat_WS[-1].copy()

    def find_neighbours(self, clock: Clock, marks: np.ndarray) -> tuple[_Sample | None, _Sample | None]:
        """Find the last sample before a span of the clock and the next one after it, where its ends are lost."""
        before, after = (
            next(
                (
                    gap
                    for gap in [*self._gaps, (self._last, None)]
                    if (gap[0] is None or gap[0][0] < time) and (gap[1] is None or gap[1][0] > time)
                ),
                (None, None),
            )
            for time in clock.time[[0, -1]]
        )
        return before[0] if marks[0] != GOOD else None, after[1] if marks[-1] != GOOD else None
