"""Faults of sensors: dead, frozen or stuck at one value, saturated, or copies of one another.

A repeated value alone is no fault: a coarse sensor on a table repeats for minutes, and so do data without noise. It is
one where the signal is noisy and repeats much longer than otherwise, or all along while another signal is noisy. So is
a single axis that never changes (again) while the sensor moves and the other two have noise of more than a digit.
Files and live streams (`arrivals`) share what tells noise and saturation.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..compilation import compiled, inlined, kernel
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from .intervals import format_time
from .limits import NARROWEST_GYRO_RANGE

# Shortest constant rate and force [s], [samples] of a frozen sensor: longer than gaps that are bridged silently.
FROZEN_S, FROZEN_SAMPLES = 0.2, 5
STUCK_S = 1.0  # [s] the same for rate or force alone
DEAD_S, DEAD_ROWS = 5.0, 100  # shortest constant end of one axis that counts as dead, and its least samples
MOST_REPEATS = 4.0  # times as long as it repeats otherwise
COARSE = 1e-4  # share of runs of equal rows above so many times the usual length from which the digits are coarse
# Noise reverses dozens of times a second; smooth motion hardly does.
NOISY_HZ, NOISY_S = 10.0, 2  # [1/s] mean over the signals, and seconds of it
# Of slower sensors, down to `SLOWEST_HZ`: the share of samples that reverse, two thirds in white noise. Fast motion
# reverses as often, by larger steps: only reversals by at most this product of two steps [SI²] count.
SLOWEST_HZ, NOISY_SHARE, SMALL_TURN = 7.0, 0.6, 0.01
MOVING = 0.5  # [m/s²] standard deviation of an axis of accel of a sensor that moves
ROUNDING_TURN = 1e-14  # product of two steps [SI] that are rounding

# An axis is saturated where it stands at its extreme for `PLATEAU` samples in a row, or `MANY` times for at least
# `SHORT_PLATEAU`, and comes to it by a step of so many digits: the top of a smooth peak has smaller steps.
PLATEAU, SHORT_PLATEAU, MANY, STEEP = 5, 3, 10, 4.0
SAME_LEVEL = 1e-3  # relative difference between the ends of an axis's range, and SAME_RANGE of those of the axes
SAME_RANGE = 0.1
AT_RANGE = 0.02  # relative distance below the range at which a sample counts as saturated: resampling mixes samples
ROUNDING = 1e-9  # steps below this share of the largest value are rounding

BOTH, GYRO, ACCEL = "gyro and accel", "gyro", "accel"

# Of each axis: newest value, largest magnitude so far, smallest step, recent steps, samples at the same value, short
# plateaus at the extreme, and the level of saturation, infinite where none is known.
_OF_AXES = ("value", "largest", "digit", "entry", "stands", "peaks", "level")
SATURATION = np.dtype([(name, float, 3) for name in _OF_AXES], align=True)


class Fault(NamedTuple):
    """An interval in which a sensor repeated one value and did not measure."""

    signals: str  # `BOTH`, `GYRO` or `ACCEL`, with the name of the axis where it is one
    first: float  # [s] the last measured sample
    last: float  # [s] the last faulty sample
    value: tuple[float, ...]  # the repeated value, SI

    def describe(self, since: float) -> str:
        """Describe the fault from the time [s] `since` on."""
        value = ", ".join(f"{v + 0.0:.4g}" for v in self.value)
        unit = "m/s^2" if self.signals.startswith(ACCEL) else "rad/s"
        stands = "stand still, gyro" if self.signals == BOTH else "stands still"
        return f"{self.signals} {stands} at {value} {unit} from {format_time(since)} to {format_time(self.last)} s"


def check_sensors(
    where: str, samples: Mapping[str, tuple[np.ndarray, ...]], start: tuple[float, float] | None
) -> tuple[dict[str, list[Fault]], dict[str, float], list[Diagnostic]]:
    """Return sensor → its faults in order of time, sensor → `find_gyro_range`, and a diagnostic of each frozen sensor.

    `samples`: sensor → times (n,) [s], and gyro and accel (n, 3) in SI or orientations (n, 4); NaN: lost. `start` [s]:
    the stated start pose. `BadData`: two sensors have the same values, or one is dead all along or in the start pose.
    """
    imus, orientations, diagnostics = {}, {}, []
    for name, (time, *values) in samples.items():
        good = np.isfinite(np.hstack(values)).all(axis=1)
        if len(values) == 2:
            imus[name] = (time, *values) if good.all() else (time[good], *(each[good] for each in values))
            continue
        known = values[0][good & values[0].any(axis=1)]  # zeros mark a lost sample
        orientations[name] = time, known
        if len(known) >= FROZEN_SAMPLES and (known == known[0]).all():
            facts: dict[str, float | str] = {"variant": "orientation", "rows": len(known)}
            diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, facts=facts))
    for (name, a), (other, b) in (*combinations(imus.items(), 2), *combinations(orientations.items(), 2)):
        is_copy = all(map(np.array_equal, a[1:], b[1:]))
        if is_copy and np.count_nonzero(~_mark_repeats(np.hstack(a[1:]))) > FROZEN_SAMPLES:
            raise BadData(
                f"{where}: sensors.{name} and sensors.{other} hold the same values in {len(a[1])} rows: "
                f"one is a copy of the other; name the file and columns in which each was recorded"
            )
    faults = find_faults(imus)
    for name, each in faults.items():
        begin, end = (float(imus[name][0][k]) for k in (0, -1))
        for fault in each:
            first, whole = max(fault.first, begin), fault.first < begin and fault.last >= end
            if whole or (start is not None and first <= start[0] and fault.last >= start[1]):
                when = "all along" if whole else "through the start pose"
                raise BadData(
                    f"{where}: sensors.{name}: {fault.describe(first)}, {when}: it does not measure; take "
                    f"[sensors.{name}] out to track the others" + ("" if whole else ", or name another start pose")
                )
        lost_s = sum(fault.last - max(fault.first, begin) for fault in each)
        facts = {"signals": each[0].signals, "intervals": len(each)}
        facts |= {"start": max(each[0].first, begin), "end": each[0].last}
        diagnostics.append(Diagnostic("sensor-frozen", WARNING, name, lost_s, facts=facts))
    return faults, {name: find_gyro_range(*each[1:]) for name, each in imus.items()}, diagnostics


def check_arrays(place: str, rate_hz: float, samples: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Raise `BadData` where a sensor does not measure; `samples`: sensor → gyro and accel (n, 3), all numbers."""
    step = max(1, int(FROZEN_S * rate_hz / FROZEN_SAMPLES))  # the shortest fault shows in so many rows
    if not any(_ends_with_dead_axis(each) or _may_stand(each, step) for arrays in samples.values() for each in arrays):
        return
    times = {name: (np.arange(len(arrays[0])) / rate_hz, *arrays) for name, arrays in samples.items()}
    for name, (fault, *_) in find_faults(times).items():
        text = f"{place}{name}{': ' * bool(name)}{fault.describe(max(fault.first, 0.0))}"
        whole = fault.first < 0.0 and fault.last >= times[name][0][-1]
        remedy = "; leave this sensor out" if whole else " there; leave these samples out"
        raise BadData(f"{text}: it does not measure{remedy}")


def find_faults(samples: Mapping[str, tuple[np.ndarray, ...]]) -> dict[str, list[Fault]]:
    """Find sensor → the intervals in which it was frozen or stuck, in order of time; a sensor without is left out.

    `samples`: sensor → times (n,) [s], gyro (n, 3) [rad/s], accel (n, 3) [m/s²], all numbers.
    """
    faults: dict[str, list[Fault]] = {}
    for name, (time, *values) in samples.items():
        if len(time) < FROZEN_SAMPLES:
            continue
        gyro_S, accel_S = (np.ascontiguousarray(each, dtype=float) for each in values)
        own, covered = list[Fault](), np.zeros(len(time), dtype=bool)
        before = float(np.nextafter(time[0], -np.inf))  # the first sample is faulty, too
        for signals, signal in ((GYRO, gyro_S), (ACCEL, accel_S)):
            if (dead := _find_dead_axis(time, signal, accel_S)) is not None:
                axis, row = dead
                begin = float(time[row]) if row else before
                own.append(Fault(f"{signals} {'xyz'[axis]}", begin, float(time[-1]), (float(signal[-1, axis]),)))
        of_gyro, of_accel = _mark_repeats(gyro_S), _mark_repeats(accel_S)
        for signals, columns, repeats, least_s in (
            (BOTH, (gyro_S, accel_S), of_gyro & of_accel, FROZEN_S),
            (GYRO, (gyro_S,), of_gyro, STUCK_S),
            (ACCEL, (accel_S,), of_accel, STUCK_S),
        ):
            if not repeats.any():
                continue
            first, last = np.flatnonzero(np.diff(repeats, prepend=False, append=False)).reshape(-1, 2).T - 1
            length = last - first + 1
            long = (length >= FROZEN_SAMPLES) & (time[last] - time[first] >= (1.0 - 1e-6) * least_s)
            if not long.any():
                continue
            runs = np.diff(np.flatnonzero(~repeats), append=len(time))  # with those of one row
            longer = np.count_nonzero(runs > MOST_REPEATS * np.median(runs))
            coarse = longer > 3 * np.count_nonzero(long) + COARSE * len(runs)
            noisy = not coarse and all(_is_noisy(time, values) for values in columns)
            rare = length > MOST_REPEATS * length[~long].max(initial=1)
            for a, b in zip(first[long & rare].tolist(), last[long & rare].tolist(), strict=True):
                if covered[a : b + 1].all():
                    continue
                is_stuck, is_whole = noisy, b - a == len(time) - 1
                if is_whole:
                    is_stuck = any(_is_noisy(each[0], values) for each in samples.values() for values in each[1:])
                if signals == GYRO and not gyro_S[a].any():  # a firmware with a dead zone reports zero at any rest
                    others = np.count_nonzero(of_gyro & ~gyro_S.any(axis=1)) - (b - a)
                    moves = accel_S[a : b + 1].std(axis=0).max() > MOVING
                    is_known = moves or (is_whole and any(each[1].any() for each in samples.values()))
                    is_stuck &= others < FROZEN_SAMPLES and is_known
                if is_stuck:
                    covered[a : b + 1] = True
                    begin = float(time[a]) if a else before
                    own.append(Fault(signals, begin, float(time[b]), tuple(columns[0][a].tolist())))
        if own:
            faults[name] = sorted(own, key=lambda fault: fault.first)
    return faults


def _find_dead_axis(time: np.ndarray, signal: np.ndarray, accel_S: np.ndarray) -> tuple[int, int] | None:
    """Find an axis of a signal (n, 3) that never changes from a row on, while the sensor moves; return both."""
    if not _ends_with_dead_axis(signal):
        return None
    differs = np.vstack([np.ones(3, dtype=bool), signal[:-1] != signal[-1]])
    begins = len(time) - 1 - np.argmax(differs[::-1], axis=0)  # rows from which the axes have their last values
    axis, row = int(np.argmin(begins)), int(begins.min())
    changes = np.flatnonzero(np.diff(signal[:row, axis], prepend=np.nan))
    repeats = np.diff(changes, append=row).max(initial=1)  # rows of its longest run before
    is_long = row == 0 or (time[-1] - time[row] >= DEAD_S and len(time) - row > MOST_REPEATS * repeats)
    if not is_long or np.count_nonzero(begins == row) > 1 or accel_S[row:].std(axis=0).max() <= MOVING:
        return None
    steps = np.abs(np.diff(signal[row:], axis=0))
    digit = steps.min(axis=0, where=steps > 0.0, initial=np.inf)
    # Noise below a digit turns by single digits: then an axis that hardly moves stands, too.
    is_noisy = _is_noisy(time[row:], signal[row:] * np.minimum(1.0, np.sqrt(ROUNDING_TURN / 1.5) / digit))
    return (axis, row) if is_noisy else None


def _ends_with_dead_axis(signal: np.ndarray) -> bool:
    """Return whether an axis of a signal (n, 3) does not change in the last rows."""
    return bool((signal[-DEAD_ROWS - 1 :] == signal[-1:]).all(axis=0).any())


@kernel
def _may_stand(signal, step):  # type: ignore[no-untyped-def]
    """Return whether `FROZEN_SAMPLES` rows of a signal (n, k) at intervals of `step` are the same."""
    repeats = 0
    for row in range(step, len(signal), step):
        repeats = repeats + 1 if is_same(signal[row - step], signal[row]) else 0
        if repeats == FROZEN_SAMPLES - 1:
            return True
    return False


@compiled
def _mark_repeats(signal):  # type: ignore[no-untyped-def]
    """Mark the rows (n,) in which a signal (n, k) repeats the row before."""
    repeats = np.zeros(len(signal), dtype=np.bool_)
    for row in range(1, len(signal)):
        repeats[row] = is_same(signal[row - 1], signal[row])
    return repeats


@kernel
def _is_noisy(time, values):  # type: ignore[no-untyped-def]
    """Return whether signals (n, 3) reverse as in noise for `NOISY_S` seconds, without the rows that repeat."""
    older = old = 0  # the last two rows that differ
    begin = turns = small = noisy_s = 0  # first row and reversals of this second
    for row in range(1, len(time)):
        if is_same(values[old], values[row]):
            continue
        turns += count_turns(values[older], values[old], values[row], np.inf)
        small += count_turns(values[older], values[old], values[row], SMALL_TURN)
        older, old = old, row
        if time[row] - time[begin] >= 1.0:
            noisy_s += are_noise(turns / 3.0, small / 3.0, row - begin, time[row] - time[begin])
            begin, turns, small = row, 0, 0
    return noisy_s >= NOISY_S


@inlined
def is_same(a, b):  # type: ignore[no-untyped-def]
    """Return whether two rows (k,) hold the same values."""
    for k in range(len(a)):  # noqa: SIM110  numba knows no generators
        if a[k] != b[k]:
            return False
    return True


@inlined
def count_turns(older, old, new, most):  # type: ignore[no-untyped-def]
    """Count the signals (k,) that reverse at the middle one of three rows, by at most this product of two steps."""
    turns = 0
    for k in range(len(new)):
        turns += -most <= (new[k] - old[k]) * (old[k] - older[k]) < -ROUNDING_TURN
    return turns


@inlined
def are_noise(turns, small, samples, seconds):  # type: ignore[no-untyped-def]
    """Return whether so many reversals of a signal, and so many of them small, are those of noise."""
    return turns > NOISY_HZ * seconds or (samples >= SLOWEST_HZ * seconds and small > NOISY_SHARE * samples)


# Saturation -----------------------------------------------------------------------------------------------------------


def find_gyro_range(gyro_S: np.ndarray, accel_S: np.ndarray) -> float:
    """Find the rate [rad/s] from which an axis of gyro counts as saturated, of samples (n, 3); infinite: none is."""
    levels = _find_levels(gyro_S, NARROWEST_GYRO_RANGE)
    if np.isfinite(levels).any():  # a frozen sensor stands, too
        levels = _find_levels(gyro_S[~_mark_repeats(np.hstack([gyro_S, accel_S]))], NARROWEST_GYRO_RANGE)
    return float((1.0 - AT_RANGE) * levels.min())


def find_saturation(values: np.ndarray, least: float) -> np.ndarray:
    """Find the samples (n, 3) at which an axis of `values` (n, 3) is saturated at its extreme, `least` or more."""
    return np.asarray(np.abs(values) >= (1.0 - SAME_LEVEL) * _find_levels(values, least))


def _find_levels(values: np.ndarray, least: float) -> np.ndarray:
    """Find the magnitude (3,) at which each axis of `values` (n, 3) saturates, `least` or more; infinite: none."""
    state, values = start_saturation(), np.ascontiguousarray(values)
    largest = max(values.max(initial=0.0), -values.min(initial=0.0))
    if _may_saturate(values, max(least, (1.0 - SAME_LEVEL) * (1.0 - SAME_RANGE) * largest)):
        _watch_all(state, values, least)
    return np.asarray(state["level"][0])


def start_saturation() -> np.ndarray:
    """Return the record (1,) with which `watch_saturation` begins."""
    state = np.zeros(1, SATURATION)
    state["digit"] = state["level"] = np.inf
    return state


@kernel
def _may_saturate(values, least):  # type: ignore[no-untyped-def]
    """Return whether an odd row repeats a value, `least` or more: in a plateau one does, in few other signals."""
    for row in range(1, len(values), 2):
        for k in range(3):
            if abs(values[row, k]) >= least and abs(values[row, k] - values[row - 1, k]) <= 2.0 * ROUNDING * least:
                return True
    return False


@kernel
def _watch_all(states, values, least):  # type: ignore[no-untyped-def]
    for row in range(len(values)):
        watch_saturation(states[0], values[row], least)


@inlined
def watch_saturation(state, sample, least):  # type: ignore[no-untyped-def]
    """Find the level of each axis, from `least` on, by the samples (3,) so far."""
    largest = max(abs(sample[0]), abs(sample[1]), abs(sample[2]), state.largest[0], state.largest[1], state.largest[2])
    least = max(least, (1.0 - SAME_RANGE) * largest)
    for k in range(3):
        size, step = abs(sample[k]), abs(sample[k] - state.value[k])
        state.value[k] = sample[k]
        if size > (1.0 + SAME_LEVEL) * state.largest[k] or state.level[k] < least:  # larger values exist
            state.level[k], state.peaks[k] = np.inf, 0.0
        state.largest[k] = max(state.largest[k], size)
        if step > ROUNDING * largest:
            state.digit[k], state.stands[k] = min(state.digit[k], step), 1.0
            state.entry[k] = max(step, 0.75 * state.entry[k])  # the last step may be cut off itself
            continue
        state.stands[k] += 1.0
        at_end = size >= least and size >= (1.0 - SAME_LEVEL) * state.largest[k]
        if at_end and state.entry[k] > STEEP * state.digit[k]:
            state.peaks[k] += state.stands[k] == SHORT_PLATEAU
            if state.stands[k] >= PLATEAU or state.peaks[k] >= MANY:
                state.level[k] = state.largest[k]
