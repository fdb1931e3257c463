"""Samples in the order of arrival → ticks of one even clock, the same for whoever takes them live or from a file.

What comes out depends on what came in and in which order, on nothing else: not on the time of day, nor on how many
samples came at once. So a file that holds the arrivals gives the same ticks again, to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..compilation import inlined, kernel
from .clocks import LONGEST_GAP_S
from .faults import AT_RANGE, FROZEN_SAMPLES, NOISY_S, SAME_RANGE, TURNS_BACK, TURNS_BACK_HZ
from .limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED, NARROWEST_GYRO_RANGE
from .plausibility import ROUNDING

# A sample this near to a tick, as a share of a step, is the tick's own.
SAME = 0.01
# A longer step than this many usual ones holds a lost sample.
HOLE = 1.5
REORDER_S = 0.02  # [s] for how long a sample may come after one that is later, while its tick waits
WAIT_S = 0.1  # [s] for how long a tick waits for a sensor; then the sensor is lost until it comes again
JUMP_S = 1.0  # [s] a time further ahead of all others is an error, unless the sensor goes on from there

# A sensor that has noise is frozen when it repeats itself this many times as often as it ever did.
MOST_REPEATS = 4.0
# Samples for which gyro stands at its largest value so far, where its range cuts it off: more than of a whole recording
# (`plausibility.PLATEAU`), since there may be larger ones to come. The value is so many digits at least.
STANDS, FEWEST_DIGITS = 5, 100.0
# It comes there by a step of so many digits. Standing for `STANDS`, it comes by so many times the usual change from one
# step to the next: a peak as sharp is levelled by noise once in a million times, five standard deviations. What stands
# longer has been cut off further: the limit falls with its duration to the power 1.5.
STEEP, ROUGH = 3.0, 3.5
USUAL_CHANGES = 32.0  # over which the usual one is averaged

MISSING, LATE, DUPLICATE, BAD, TAKEN, FROZEN, CUT_OFF = range(7)
COUNTS = ("missing", "late", "duplicate", "bad", "taken", "frozen", "cut_off")

# A row of a sensor's room: time, gyro, accel.
_T, _GX, _AX, _WIDTH = 0, 1, 4, 7
_OUT = 1024
# What is remembered of a sensor's values. Of each of the six: the newest, its step, its largest size, how often it
# turned back in this second and whether it changed. Of all: when the second began and its samples; since when the
# values repeat, how often by now and at most before; [s] of noise; samples unlike the one before; the newest time.
# Of each axis of gyro: its smallest step, the last ones, how often it stood since, where it is cut off, and the usual
# change from step to step.
_LAST, _STEP, _SIZE, _TURNS, _CHANGES, _DIGIT, _ENTRY, _STANDS, _LEVEL = 0, 6, 12, 18, 24, 30, 33, 36, 39
_SECOND, _SAMPLES, _SINCE, _REPEATS, _MOST, _NOISY, _VALUES, _TIME = 42, 43, 44, 45, 46, 47, 48, 49
_CHANGE, _MEMORY = 50, 53
_TICK, _NEWEST = 0, 1  # of the scalars: ticks given, the newest time of all


class Samples(NamedTuple):
    """Samples of one sensor in the order in which they came, one or many."""

    sensor: str  # its segment
    time: np.ndarray  # (m,) [s], all sensors on one clock
    gyro_S: np.ndarray  # (m, 3) [rad/s], the rate over the interval that ends at the sample
    accel_S: np.ndarray  # (m, 3) [m/s²], specific force, +g up of a static sensor


class Arrivals(NamedTuple):
    """Samples of all sensors in the order in which they came."""

    which: np.ndarray  # (m,) uint8, number of the sensor
    time: np.ndarray  # (m,) [s]
    gyro_S: np.ndarray  # (m, 3) [rad/s]
    accel_S: np.ndarray  # (m, 3) [m/s²]


def order_arrivals(got: Sequence[Samples], sensors: Sequence[str]) -> Arrivals:
    """What one read gave, by time: which sensor was asked first says nothing of when its samples came."""
    which = np.repeat([sensors.index(s.sensor) for s in got], [len(s.time) for s in got]).astype(np.uint8)
    time, gyro_S, accel_S = (np.concatenate(of, dtype=float) for of in tuple(zip(*got, strict=True))[1:])
    if len(got) > 1:
        order = np.argsort(time, kind="stable")
        return Arrivals(which[order], time[order], gyro_S[order], accel_S[order])
    return Arrivals(which, time, gyro_S, accel_S)


class Ticks(NamedTuple):
    """Consecutive moments at which all sensors are known, or known to be lost."""

    first: int  # number of the first of them, from 0 on
    time: np.ndarray  # (m,) [s]
    gyro_S: np.ndarray  # (m, k, 3) [rad/s], NaN where the sensor was lost
    accel_S: np.ndarray  # (m, k, 3) [m/s²], the same
    lost: np.ndarray  # (m, k) bool: the sensor has been silent for longer than ticks wait


class Aligner:
    """Ticks of one even clock from samples that come one after another, out of order, twice, late or not at all.

    A tick goes as soon as every sensor has reached it. It waits `REORDER_S` for a sample that others of its sensor have
    overtaken and `wait_s` for a silent sensor, measured on the samples' own times; from then on the sensor is lost and
    none waits for it until it comes again. A sample on its tick is taken as it is; between ticks the rate is the mean
    over the step (each sample's rate holds for the interval that ends there) and the specific force is interpolated.
    Holes of up to `LONGEST_GAP_S` are bridged linearly, longer ones are NaN. A sensor that has noise and repeats itself
    bit for bit, for longer than is bridged and than it ever did, is frozen: what it sends is lost until it changes.
    Where an axis of gyro stood at its extreme, to which it came steeply, the sensor's range cuts it off: from then on
    ticks with a rate at that level are NaN, since nobody knows how far the sensor turned.

    Parameters
    ----------
    sensors : segments, in the order of the ticks' columns
    rate_hz : ticks a second
    begin : time [s] of tick 0
    wait_s : how long a tick waits for a silent sensor
    """

    def __init__(self, sensors: Sequence[str], rate_hz: float, begin: float, wait_s: float = WAIT_S) -> None:
        self.sensors, self.rate_hz, self.begin, self.wait_s = tuple(sensors), rate_hz, begin, wait_s
        k = len(self.sensors)
        self.counts = np.zeros((k, len(COUNTS)), dtype=np.int64)
        self.lost = np.zeros(k, dtype=np.bool_)
        self.frozen = np.zeros(k, dtype=np.bool_)
        self._memory = np.zeros((k, _MEMORY))
        self._memory[:, _DIGIT:_ENTRY] = self._memory[:, _LEVEL:_SECOND] = np.inf
        # A sensor may be much faster than the ticks.
        room = 4096 + int(8.0 * rate_hz * max(wait_s, REORDER_S, LONGEST_GAP_S))
        self._kept, self._held = np.zeros((k, room, _WIDTH)), np.zeros(k, dtype=np.int64)
        self._jump = np.zeros((k, 2))  # samples in a row that were too far ahead, and the last of their times
        self._scalars = np.array([0.0, -np.inf])
        self._settings = np.array([begin, 1.0 / rate_hz, wait_s])
        self._out = np.empty((_OUT, k, 6)), np.empty((_OUT, k), dtype=np.bool_)
        self._none = Ticks(0, np.empty(0), np.empty((0, k, 3)), np.empty((0, k, 3)), np.empty((0, k), dtype=np.bool_))

    @property
    def next_tick(self) -> int:
        return int(self._scalars[_TICK])

    @property
    def newest(self) -> float:
        """Time [s] of the newest sample of all; −inf before the first."""
        return float(self._scalars[_NEWEST])

    def push(self, came: Arrivals) -> Ticks:
        """Take samples; the ticks that are whole by them, often none."""
        parts = list(self.pieces(came))
        if len(parts) < 2:
            return parts[0] if parts else self._none
        return Ticks(parts[0].first, *map(np.concatenate, tuple(zip(*parts, strict=True))[1:]))

    def pieces(self, came: Arrivals) -> Iterator[Ticks]:
        """As `push`, a thousand at a time: after an hour of silence there are millions. To be taken to their end."""
        values, lost = self._out
        at, made = 0, _OUT
        while at < len(came.time) or made == _OUT:
            first = self.next_tick
            at, made = _take(
                self._kept,
                self._held,
                self._jump,
                self._scalars,
                self._settings,
                self.counts,
                self.lost,
                self.frozen,
                self._memory,
                *came,
                at,
                values,
                lost,
            )
            if made:
                time, whole = self.begin + np.arange(first, first + made) / self.rate_hz, values[:made].copy()
                yield Ticks(first, time, whole[:, :, :3], whole[:, :, 3:], lost[:made].copy())


@kernel
def _take(  # type: ignore[no-untyped-def]
    kept, held, jump, scalars, settings, counts, lost, frozen, memory, which, time, gyro, accel, at, out, out_lost
):
    """Samples from `at` on; gives how far it came and how many ticks it made, at most as many as `out` holds."""
    made = 0
    while True:
        while made < len(out) and _due(kept, held, scalars, settings, lost):
            _tick(kept, held, scalars, settings, counts, lost, memory, out[made], out_lost[made])
            made += 1
        if made == len(out) or at == len(time):
            return at, made
        s, t = which[at], time[at]
        if _is_sound(jump, scalars, counts, s, t, gyro[at], accel[at]):
            if t > memory[s, _TIME] or memory[s, _VALUES] == 0.0:
                frozen[s] = _repeats_itself(memory, frozen[s], s, t, gyro[at], accel[at])
            if frozen[s] and t > memory[s, _SINCE]:
                counts[s, FROZEN] += 1
                scalars[_NEWEST] = max(scalars[_NEWEST], t)
            else:
                _insert(kept, held, scalars, settings, counts, lost, s, t, gyro[at], accel[at])
        at += 1


@kernel
def _is_sound(jump, scalars, counts, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Whether a sample may have been measured, and at this time."""
    size = gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2]
    force = accel[0] * accel[0] + accel[1] * accel[1] + accel[2] * accel[2]
    if not (abs(t) < 1e12 and size < HIGHEST_RATE_SQUARED and force < HIGHEST_ACCEL_SQUARED):
        counts[s, BAD] += 1
        return False
    if t > scalars[_NEWEST] + JUMP_S and scalars[_NEWEST] > -np.inf:
        # One wild time must not make hours of ticks; a clock that really went on does so for some samples.
        goes_on = jump[s, 0] > 0.0 and 0.0 < t - jump[s, 1] < 1.0
        jump[s, 0] = jump[s, 0] + 1.0 if goes_on else 1.0
        jump[s, 1] = t
        if jump[s, 0] < 4.0:
            counts[s, BAD] += 1
            return False
    jump[s, 0] = 0.0
    return True


@kernel
def _repeats_itself(memory, frozen, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Whether sensor s is `frozen` with this sample, its newest, or is so still."""
    m = memory[s]
    same = m[_VALUES] > 0.0
    for k in range(6):
        same = same and m[_LAST + k] == (gyro[k] if k < 3 else accel[k - 3])
    m[_TIME] = t
    if not same:
        if not frozen:
            m[_MOST] = max(m[_MOST], m[_REPEATS], 1.0)
        _remember(m, t, gyro, accel)
        return False
    m[_REPEATS] += 1.0
    lasts = t - m[_SINCE]
    if m[_REPEATS] < FROZEN_SAMPLES or lasts <= LONGEST_GAP_S * (1.0 + 1e-6):
        return False
    if m[_NOISY] >= NOISY_S:
        return m[_REPEATS] > MOST_REPEATS * m[_MOST]
    # What never gave anything else shows no noise of its own; the others are of its kind.
    others_noisy = False
    for other in range(len(memory)):
        others_noisy = others_noisy or memory[other, _NOISY] >= NOISY_S
    return others_noisy and m[_VALUES] == 1.0 and lasts >= NOISY_S


@kernel
def _remember(m, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Values that are not those of the sample before; of each second, whether they turn back as noise does."""
    if m[_VALUES] == 0.0:
        m[_SECOND] = t
    m[_REPEATS], m[_SINCE] = 0.0, t
    m[_VALUES] += 1.0
    m[_SAMPLES] += 1.0
    for k in range(6):
        value = gyro[k] if k < 3 else accel[k - 3]
        step = value - m[_LAST + k] if m[_VALUES] > 1.0 else 0.0
        m[_SIZE + k] = max(m[_SIZE + k], abs(value))
        if abs(step) < ROUNDING * m[_SIZE + k]:
            step = 0.0
        if step * m[_STEP + k] < 0.0:
            m[_TURNS + k] += 1.0
        if k < 3:
            m[_CHANGE + k] += (abs(step - m[_STEP + k]) - m[_CHANGE + k]) / USUAL_CHANGES
        if step != 0.0:
            m[_CHANGES + k] = 1.0
        m[_LAST + k], m[_STEP + k] = value, step
    _look_for_range(m)
    seconds = t - m[_SECOND]
    if seconds >= 1.0:
        least = m[_SAMPLES] * min(TURNS_BACK, TURNS_BACK_HZ * seconds / m[_SAMPLES])
        changes, turns = False, m[_SAMPLES] >= 2.0 * FROZEN_SAMPLES
        for k in range(6):
            if m[_CHANGES + k] > 0.0:
                changes, turns = True, turns and m[_TURNS + k] > least
            m[_TURNS + k], m[_CHANGES + k] = 0.0, 0.0
        if changes and turns:
            m[_NOISY] += seconds
        m[_SECOND], m[_SAMPLES] = t, 0.0


@kernel
def _look_for_range(m):  # type: ignore[no-untyped-def]
    """Where axes of gyro are cut off: as `plausibility.find_cut_off`, with what came so far."""
    largest = max(m[_SIZE], m[_SIZE + 1], m[_SIZE + 2])
    for k in range(3):
        value, step = abs(m[_LAST + k]), abs(m[_STEP + k])
        if m[_SIZE + k] > m[_LEVEL + k] or (1.0 - SAME_RANGE) * largest > m[_LEVEL + k]:
            m[_LEVEL + k] = np.inf  # there are larger rates
        if step > 0.0:
            m[_DIGIT + k], m[_STANDS + k] = min(m[_DIGIT + k], step), 1.0
            m[_ENTRY + k] = max(step, 0.75 * m[_ENTRY + k])  # the last may be cut off itself
            continue
        m[_STANDS + k] += 1.0
        steep = m[_ENTRY + k] > STEEP * m[_DIGIT + k] and value > FEWEST_DIGITS * m[_DIGIT + k]
        steep = steep and m[_ENTRY + k] * (m[_STANDS + k] / STANDS) ** 1.5 > ROUGH * m[_CHANGE + k]
        at_extreme = value == m[_SIZE + k] and value >= max(NARROWEST_GYRO_RANGE, (1.0 - SAME_RANGE) * largest)
        if steep and at_extreme and m[_STANDS + k] >= STANDS:
            m[_LEVEL + k] = value


@inlined
def _range(m):  # type: ignore[no-untyped-def]
    """[rad/s] at which gyro is cut off; infinite where that was not seen."""
    return min(m[_LEVEL], m[_LEVEL + 1], m[_LEVEL + 2])


@kernel
def _insert(kept, held, scalars, settings, counts, lost, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """One sample into its sensor's room, in order of time."""
    dt = settings[1]
    last = settings[0] + (scalars[_TICK] - 1.0) * dt  # the tick that went last
    room, n = kept[s], held[s]
    if t < last + SAME * dt:
        # Only the first tick has none before it: what lies before the beginning is what its step began with.
        if n > 0 and abs(room[0, _T] - t) < SAME * dt:
            counts[s, DUPLICATE] += 1
            return
        if scalars[_TICK] > 0.0:
            counts[s, LATE] += 1
            if t > scalars[_NEWEST] - settings[2]:
                lost[s] = False  # it is back: the next tick waits for it
            return
    i = n
    while i > 0 and room[i - 1, _T] > t - SAME * dt:
        i -= 1
    if i < n and abs(room[i, _T] - t) <= SAME * dt:
        counts[s, DUPLICATE] += 1
        return
    if n == len(room):  # no tick can go though a sensor is this far ahead: the oldest is given up
        for j in range(n - 1):
            for m in range(_WIDTH):
                room[j, m] = room[j + 1, m]
        n -= 1
        i = max(i - 1, 0)
    for j in range(n, i, -1):
        for m in range(_WIDTH):
            room[j, m] = room[j - 1, m]
    room[i, _T] = t
    for m in range(3):
        room[i, _GX + m], room[i, _AX + m] = gyro[m], accel[m]
    held[s] = n + 1
    lost[s] = False
    counts[s, TAKEN] += 1
    if t > scalars[_NEWEST]:
        scalars[_NEWEST] = t


@kernel
def _due(kept, held, scalars, settings, lost):  # type: ignore[no-untyped-def]
    """Whether the next tick can go."""
    begin, dt, wait = settings[0], settings[1], settings[2]
    t = begin + scalars[_TICK] * dt
    newest = scalars[_NEWEST]
    if newest < t - SAME * dt:
        return False
    if newest >= t + wait:
        return True
    for s in range(len(held)):
        if lost[s]:
            continue
        room, n = kept[s], held[s]
        if n == 0 or room[n - 1, _T] < t - SAME * dt:
            return False
        if room[n - 1, _T] >= t + REORDER_S:
            continue
        i = _reached(room, n, t, dt)
        if i > 0 and room[i, _T] - room[i - 1, _T] > HOLE * dt and room[i - 1, _T] > t - wait:
            return False  # what lies in the hole may still come
    return True


@kernel
def _reached(room, n, t, dt):  # type: ignore[no-untyped-def]
    """The first sample at or after `t`; n where there is none."""
    i = 0
    while i < n and room[i, _T] < t - SAME * dt:
        i += 1
    return i


@kernel
def _tick(kept, held, scalars, settings, counts, lost, memory, out, out_lost):  # type: ignore[no-untyped-def]
    """The next tick into `out` (k, 6); what no later tick needs is forgotten."""
    dt = settings[1]
    t = settings[0] + scalars[_TICK] * dt
    for s in range(len(held)):
        room, n = kept[s], held[s]
        i = _reached(room, n, t, dt)
        if i == n:
            lost[s] = True
        if not _value(room, n, i, t, dt, out[s]):
            counts[s, MISSING] += 1
            out[s, :] = np.nan
        elif max(abs(out[s, 0]), abs(out[s, 1]), abs(out[s, 2])) >= (1.0 - AT_RANGE) * _range(memory[s]):
            counts[s, CUT_OFF] += 1
            out[s, :] = np.nan
        out_lost[s] = lost[s]
        # The last at or before the tick is where the next step begins.
        done = i if i < n and room[i, _T] <= t + SAME * dt else i - 1
        if done > 0:
            for j in range(n - done):
                for m in range(_WIDTH):
                    room[j, m] = room[j + done, m]
            held[s] = n - done
    scalars[_TICK] += 1.0


@kernel
def _value(room, n, i, t, dt, out):  # type: ignore[no-untyped-def]
    """The sensor at `t` into `out` (6,), where `i` is its first sample from there on; false where it is not known."""
    if i == n:
        return False
    first = i == 0
    step = 0.0 if first else room[i, _T] - room[i - 1, _T]
    if room[i, _T] - t <= SAME * dt and (first or step >= (1.0 - 2.0 * SAME) * dt):
        for m in range(6):
            out[m] = room[i, 1 + m]
        return True
    bridged = max(LONGEST_GAP_S, dt) * (1.0 + 1e-6)  # lost time, as in `clocks`: one sample always is
    if first or step - dt > bridged:
        return False
    if step > HOLE * dt:
        share = (t - room[i - 1, _T]) / step
        for m in range(6):
            out[m] = room[i - 1, 1 + m] + share * (room[i, 1 + m] - room[i - 1, 1 + m])
        return True
    # Mean rate over (t − dt, t], each sample's rate from the one before to it; mean force of the samples in there,
    # or, of less than two, the force at t.
    for m in range(6):
        out[m] = 0.0
    covered, inside = 0.0, 0
    j = i
    while j > 0 and room[j, _T] > t - dt:
        begin, end = max(room[j - 1, _T], t - dt), min(room[j, _T], t)
        width = max(0.0, end - begin)
        covered += width
        for m in range(3):
            out[m] += width * room[j, _GX + m]
        if room[j, _T] <= t + SAME * dt:
            inside += 1
            for m in range(3):
                out[3 + m] += room[j, _AX + m]
        j -= 1
    if covered <= 0.0:
        return False
    for m in range(3):
        out[m] /= covered
    if inside >= 2:
        for m in range(3):
            out[3 + m] /= inside
    else:
        share = min(1.0, (t - room[i - 1, _T]) / step)
        for m in range(3):
            out[3 + m] = room[i - 1, _AX + m] + share * (room[i, _AX + m] - room[i - 1, _AX + m])
    return True
