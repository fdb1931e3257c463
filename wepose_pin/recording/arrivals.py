"""Samples in their order of arrival → ticks of one even clock, for live sources and for files of live sessions.

The ticks depend on the samples and their order alone, not on the time of day or on how many samples arrive at once. A
file with the arrivals therefore gives bit-identical ticks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..compilation import inlined, kernel
from .clocks import LONGEST_GAP_S
from .faults import AT_RANGE, FROZEN_SAMPLES, NOISY_S, SAME_RANGE, TURNS_BACK, TURNS_BACK_HZ
from .limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED, NARROWEST_GYRO_RANGE
from .plausibility import ROUNDING
from .sensors import ImuSensor, Sensor

# A sample within this share of a step from a tick counts as at the tick.
SAME = 0.01
# A step longer than this many usual steps contains a lost sample.
HOLE = 1.5
REORDER_S = 0.02  # [s] a tick waits so long for a sample that a later one has overtaken
WAIT_S = 0.1  # [s] a tick waits so long for a silent sensor; then the sensor is lost until its next sample
JUMP_S = 1.0  # [s] a time further ahead of all others is an error, unless the sensor continues from there

# A noisy sensor is frozen when it repeats a value this many times as often as ever before.
MOST_REPEATS = 4.0
# Saturation of gyro: it stays at its largest value so far for `STANDS` samples, more than in a whole recording
# (`plausibility.PLATEAU`), since larger values may follow. The value has at least `FEWEST_DIGITS` digits.
STANDS, FEWEST_DIGITS = 5, 100.0
# The step to that value has at least `STEEP` digits, and over `STANDS` samples at least `ROUGH` times the usual change
# from step to step: noise flattens a peak as sharp once in a million times (five standard deviations). A longer plateau
# is cut off further: the limit falls with its duration to the power 1.5.
STEEP, ROUGH = 3.0, 3.5
USUAL_CHANGES = 32.0  # number of changes in the average

MISSING, LATE, DUPLICATE, BAD, TAKEN, FROZEN, CUT_OFF = range(7)
COUNTS = ("missing", "late", "duplicate", "bad", "taken", "frozen", "cut_off")

# A row of a sensor's buffer: time, gyro, accel.
_T, _GX, _AX, _WIDTH = 0, 1, 4, 7
_OUT = 1024
# Memory of a sensor. For each of the six signals: newest value, its step, largest size, number of reversals in this
# second, whether it changed. For all signals together: start of this second and its number of samples; start of the
# current repetition, its length and the longest before; [s] of noise; number of changes; newest time. For each axis of
# gyro: smallest step, recent steps, samples at the same value, saturation level, usual change from step to step.
_LAST, _STEP, _SIZE, _TURNS, _CHANGES, _DIGIT, _ENTRY, _STANDS, _LEVEL = 0, 6, 12, 18, 24, 30, 33, 36, 39
_SECOND, _SAMPLES, _SINCE, _REPEATS, _MOST, _NOISY, _VALUES, _TIME = 42, 43, 44, 45, 46, 47, 48, 49
_CHANGE, _MEMORY = 50, 53
_TICK, _NEWEST = 0, 1  # the scalars: number of ticks so far, newest time of all sensors


class Samples(NamedTuple):
    """One or more samples of one sensor in their order of arrival.

    Of a sensor with measured orientations `gyro_S` and `accel_S` hold them, as `pack_orientations` gives them.
    """

    sensor: str  # its segment
    time: np.ndarray  # (m,) [s], all sensors on one clock
    gyro_S: np.ndarray  # (m, 3) [rad/s], the rate over the interval that ends at the sample
    accel_S: np.ndarray  # (m, 3) [m/s²], specific force, +g up of a static sensor


class Arrivals(NamedTuple):
    """Samples of all sensors in their order of arrival."""

    which: np.ndarray  # (m,) uint8, index of the sensor
    time: np.ndarray  # (m,) [s]
    gyro_S: np.ndarray  # (m, 3) [rad/s]
    accel_S: np.ndarray  # (m, 3) [m/s²]


def pack_orientations(quat_VS: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orientations (…, 4) xyzw as the six numbers of a sample: (…, 3) qx, qy, qz, and (…, 3) qw, 0, 0."""
    rest = np.zeros((*quat_VS.shape[:-1], 3))
    rest[..., 0] = quat_VS[..., 3]
    return quat_VS[..., :3].copy(), rest


def unpack_orientations(gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
    """Return the orientations (…, 4) xyzw that `pack_orientations` has packed."""
    return np.concatenate([gyro_S, accel_S[..., :1]], axis=-1)


def list_numbers(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the six numbers of each sample, (n, 3), (n, 3): rate and specific force, or packed orientations."""
    return (sensor.gyro_S, sensor.accel_S) if isinstance(sensor, ImuSensor) else pack_orientations(sensor.quat_VS)


def order_arrivals(samples: Sequence[Samples], sensors: Sequence[str]) -> Arrivals:
    """Merge the samples of one read in order of time; the order in which sensors were read has no meaning."""
    sensor = np.array([sensors.index(s.sensor) for s in samples], dtype=np.uint8)
    which = sensor.repeat([len(s.time) for s in samples])
    time, gyro_S, accel_S = (np.concatenate(column, dtype=float) for column in tuple(zip(*samples, strict=True))[1:])
    if len(samples) > 1 and not (time[1:] >= time[:-1]).all():
        order = np.argsort(time, kind="stable")
        return Arrivals(which[order], time[order], gyro_S[order], accel_S[order])
    return Arrivals(which, time, gyro_S, accel_S)


class Ticks(NamedTuple):
    """Consecutive ticks: at each one, every sensor has a value or is lost."""

    first: int  # number of the first tick, from 0 on
    time: np.ndarray  # (m,) [s]
    gyro_S: np.ndarray  # (m, k, 3) [rad/s], NaN where the sensor was lost
    accel_S: np.ndarray  # (m, k, 3) [m/s²], the same
    lost: np.ndarray  # (m, k) bool: the sensor was silent for longer than a tick waits


class StreamSynchronizer:
    """Makes ticks of one even clock from samples that may arrive out of order, twice, late or not at all.

    A tick is complete as soon as every sensor has reached it. It waits `REORDER_S` for a sample that others of its
    sensor have overtaken and `wait_s` for a silent sensor, both measured on the samples' times. Then the sensor is
    lost, and ticks do not wait for it until its next sample. A sample at a tick is used unchanged. Between ticks the
    rate is the mean over the step (a sample's rate holds for the interval that ends there) and the specific force is
    interpolated. Gaps of up to `LONGEST_GAP_S` are bridged linearly, longer ones are NaN. A noisy sensor is frozen when
    it repeats its values for longer than the silent bridge and than ever before; its samples are lost until they
    change. An axis of gyro that stays at its extreme after a steep rise is saturated: from then on, ticks with a rate
    at that level are NaN, because the rotation is not known. Measured orientations between ticks are interpolated; they
    may repeat, as a device's own filter lets them.

    Parameters
    ----------
    sensors : segments, in the order of the ticks' columns
    rate_hz : ticks a second
    begin : time [s] of tick 0
    wait_s : [s] that a tick waits for a silent sensor
    orientations : the sensors whose samples are measured orientations
    """

    def __init__(
        self,
        sensors: Sequence[str],
        rate_hz: float,
        begin: float,
        wait_s: float = WAIT_S,
        orientations: Collection[str] = (),
    ) -> None:
        self.sensors, self.rate_hz, self.begin, self.wait_s = tuple(sensors), rate_hz, begin, wait_s
        k = len(self.sensors)
        self.counts = np.zeros((k, len(COUNTS)), dtype=np.int64)
        self._measured = np.array([name in orientations for name in self.sensors], dtype=np.bool_)
        self.lost = np.zeros(k, dtype=np.bool_)
        self.frozen = np.zeros(k, dtype=np.bool_)
        self._memory = np.zeros((k, _MEMORY))
        self._memory[:, _DIGIT:_ENTRY] = self._memory[:, _LEVEL:_SECOND] = np.inf
        # A sensor may be much faster than the ticks.
        room = 4096 + int(8.0 * rate_hz * max(wait_s, REORDER_S, LONGEST_GAP_S))
        self._buffers, self._lengths = np.zeros((k, room, _WIDTH)), np.zeros(k, dtype=np.int64)
        self._jump = np.zeros((k, 2))  # samples in a row that were too far ahead, and the last of their times
        self._scalars = np.array([0.0, -np.inf])
        self._settings = np.array([begin, 1.0 / rate_hz, wait_s])
        self._out = np.empty((_OUT, k, 6)), np.empty((_OUT, k), dtype=np.bool_)
        self._none = Ticks(0, np.empty(0), np.empty((0, k, 3)), np.empty((0, k, 3)), np.empty((0, k), dtype=np.bool_))

    @property
    def next_tick(self) -> int:
        """Number of the next tick."""
        return int(self._scalars[_TICK])

    @property
    def newest(self) -> float:
        """Time [s] of the newest sample of all; −inf before the first."""
        return float(self._scalars[_NEWEST])

    def push(self, arrivals: Arrivals) -> Ticks:
        """Take samples and return the ticks that they complete, often none."""
        parts = list(self.iterate_ticks(arrivals))
        if len(parts) < 2:
            return parts[0] if parts else self._none
        return Ticks(parts[0].first, *map(np.concatenate, tuple(zip(*parts, strict=True))[1:]))

    def iterate_ticks(self, arrivals: Arrivals) -> Iterator[Ticks]:
        """Iterate over the ticks of `push` in blocks of at most a thousand; the caller takes them all.

        After an hour of silence there are millions.
        """
        values, lost = self._out
        next_sample, count = 0, _OUT
        while next_sample < len(arrivals.time) or count == _OUT:
            first = self.next_tick
            next_sample, count = _take_samples(
                self._buffers,
                self._lengths,
                self._jump,
                self._scalars,
                self._settings,
                self.counts,
                self.lost,
                self.frozen,
                self._memory,
                self._measured,
                *arrivals,
                next_sample,
                values,
                lost,
            )
            if count:
                time, block = self.begin + np.arange(first, first + count) / self.rate_hz, values[:count].copy()
                yield Ticks(first, time, block[:, :, :3], block[:, :, 3:], lost[:count].copy())


@kernel
def _take_samples(  # type: ignore[no-untyped-def]
    buffers,
    lengths,
    jump,
    scalars,
    settings,
    counts,
    lost,
    frozen,
    memory,
    measured,
    which,
    time,
    gyro,
    accel,
    next_sample,
    out,
    out_lost,
):
    """Take samples from `next_sample` on; returns the next sample and the number of ticks, at most `len(out)`."""
    count = 0
    while True:
        while count < len(out) and _is_complete(buffers, lengths, scalars, settings, lost):
            _write_tick(
                buffers, lengths, scalars, settings, counts, lost, memory, measured, out[count], out_lost[count]
            )
            count += 1
        if count == len(out) or next_sample == len(time):
            return next_sample, count
        s, t = which[next_sample], time[next_sample]
        if _is_sound(jump, scalars, counts, s, t, gyro[next_sample], accel[next_sample]):
            if not measured[s] and (t > memory[s, _TIME] or memory[s, _VALUES] == 0.0):
                frozen[s] = _repeats_itself(memory, frozen[s], s, t, gyro[next_sample], accel[next_sample])
            if frozen[s] and t > memory[s, _SINCE]:
                counts[s, FROZEN] += 1
                scalars[_NEWEST] = max(scalars[_NEWEST], t)
            else:
                _insert_sample(
                    buffers, lengths, scalars, settings, counts, lost, s, t, gyro[next_sample], accel[next_sample]
                )
        next_sample += 1


@kernel
def _is_sound(jump, scalars, counts, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Return whether a sample and its time are plausible."""
    size = gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2]
    force = accel[0] * accel[0] + accel[1] * accel[1] + accel[2] * accel[2]
    if not (abs(t) < 1e12 and size < HIGHEST_RATE_SQUARED and force < HIGHEST_ACCEL_SQUARED):
        counts[s, BAD] += 1
        return False
    if t > scalars[_NEWEST] + JUMP_S and scalars[_NEWEST] > -np.inf:
        # A single time-stamp outlier must not make hours of ticks; after a real jump several samples continue from it.
        continues = jump[s, 0] > 0.0 and 0.0 < t - jump[s, 1] < 1.0
        jump[s, 0] = jump[s, 0] + 1.0 if continues else 1.0
        jump[s, 1] = t
        if jump[s, 0] < 4.0:
            counts[s, BAD] += 1
            return False
    jump[s, 0] = 0.0
    return True


@kernel
def _repeats_itself(memory, frozen, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Return whether sensor s is frozen at this sample, its newest; `frozen`: it was frozen before."""
    m = memory[s]
    same = m[_VALUES] > 0.0
    for k in range(6):
        same = same and m[_LAST + k] == (gyro[k] if k < 3 else accel[k - 3])
    m[_TIME] = t
    if not same:
        if not frozen:
            m[_MOST] = max(m[_MOST], m[_REPEATS], 1.0)
        _store_sample(m, t, gyro, accel)
        return False
    m[_REPEATS] += 1.0
    lasts = t - m[_SINCE]
    if m[_REPEATS] < FROZEN_SAMPLES or lasts <= LONGEST_GAP_S * (1.0 + 1e-6):
        return False
    if m[_NOISY] >= NOISY_S:
        return m[_REPEATS] > MOST_REPEATS * m[_MOST]
    # A sensor that was constant from the beginning shows no noise; the others are of the same kind.
    others_noisy = False
    for other in range(len(memory)):
        others_noisy = others_noisy or memory[other, _NOISY] >= NOISY_S
    return others_noisy and m[_VALUES] == 1.0 and lasts >= NOISY_S


@kernel
def _store_sample(m, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Store a sample that differs from the one before, and detect noise by the reversals in each second."""
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
    _find_saturation(m)
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
def _find_saturation(m):  # type: ignore[no-untyped-def]
    """Find the saturation level of each axis of gyro, as `plausibility.find_cut_off`, from the samples so far."""
    largest = max(m[_SIZE], m[_SIZE + 1], m[_SIZE + 2])
    for k in range(3):
        value, step = abs(m[_LAST + k]), abs(m[_STEP + k])
        if m[_SIZE + k] > m[_LEVEL + k] or (1.0 - SAME_RANGE) * largest > m[_LEVEL + k]:
            m[_LEVEL + k] = np.inf  # larger rates exist
        if step > 0.0:
            m[_DIGIT + k], m[_STANDS + k] = min(m[_DIGIT + k], step), 1.0
            m[_ENTRY + k] = max(step, 0.75 * m[_ENTRY + k])  # the last step may be cut off itself
            continue
        m[_STANDS + k] += 1.0
        steep = m[_ENTRY + k] > STEEP * m[_DIGIT + k] and value > FEWEST_DIGITS * m[_DIGIT + k]
        steep = steep and m[_ENTRY + k] * (m[_STANDS + k] / STANDS) ** 1.5 > ROUGH * m[_CHANGE + k]
        at_extreme = value == m[_SIZE + k] and value >= max(NARROWEST_GYRO_RANGE, (1.0 - SAME_RANGE) * largest)
        if steep and at_extreme and m[_STANDS + k] >= STANDS:
            m[_LEVEL + k] = value


@inlined
def _saturation(m):  # type: ignore[no-untyped-def]
    """Return the rate [rad/s] at which gyro saturates; infinite: not detected."""
    return min(m[_LEVEL], m[_LEVEL + 1], m[_LEVEL + 2])


@kernel
def _insert_sample(buffers, lengths, scalars, settings, counts, lost, s, t, gyro, accel):  # type: ignore[no-untyped-def]
    """Insert a sample into its sensor's buffer, in order of time."""
    dt = settings[1]
    last = settings[0] + (scalars[_TICK] - 1.0) * dt  # time of the last complete tick
    buffer, n = buffers[s], lengths[s]
    if t < last + SAME * dt:
        # Only the first tick has no tick before it: a sample before the beginning is the start of its step.
        if n > 0 and abs(buffer[0, _T] - t) < SAME * dt:
            counts[s, DUPLICATE] += 1
            return
        if scalars[_TICK] > 0.0:
            counts[s, LATE] += 1
            if t > scalars[_NEWEST] - settings[2]:
                lost[s] = False  # the next tick waits for it again
            return
    i = n
    while i > 0 and buffer[i - 1, _T] > t - SAME * dt:
        i -= 1
    if i < n and abs(buffer[i, _T] - t) <= SAME * dt:
        counts[s, DUPLICATE] += 1
        return
    if n == len(buffer):  # the sensor is ahead by a full buffer and no tick is complete: drop the oldest sample
        for j in range(n - 1):
            for m in range(_WIDTH):
                buffer[j, m] = buffer[j + 1, m]
        n -= 1
        i = max(i - 1, 0)
    for j in range(n, i, -1):
        for m in range(_WIDTH):
            buffer[j, m] = buffer[j - 1, m]
    buffer[i, _T] = t
    for m in range(3):
        buffer[i, _GX + m], buffer[i, _AX + m] = gyro[m], accel[m]
    lengths[s] = n + 1
    lost[s] = False
    counts[s, TAKEN] += 1
    if t > scalars[_NEWEST]:
        scalars[_NEWEST] = t


@kernel
def _is_complete(buffers, lengths, scalars, settings, lost):  # type: ignore[no-untyped-def]
    """Return whether the next tick is complete."""
    begin, dt, wait = settings[0], settings[1], settings[2]
    t = begin + scalars[_TICK] * dt
    newest = scalars[_NEWEST]
    if newest < t - SAME * dt:
        return False
    if newest >= t + wait:
        return True
    for s in range(len(lengths)):
        if lost[s]:
            continue
        buffer, n = buffers[s], lengths[s]
        if n == 0 or buffer[n - 1, _T] < t - SAME * dt:
            return False
        if buffer[n - 1, _T] >= t + REORDER_S:
            continue
        i = _find_sample(buffer, n, t, dt)
        if i > 0 and buffer[i, _T] - buffer[i - 1, _T] > HOLE * dt and buffer[i - 1, _T] > t - wait:
            return False  # a sample in the gap may still arrive
    return True


@kernel
def _find_sample(buffer, n, t, dt):  # type: ignore[no-untyped-def]
    """Find the first sample at or after `t`; n: there is none."""
    i = 0
    while i < n and buffer[i, _T] < t - SAME * dt:
        i += 1
    return i


@kernel
def _write_tick(  # type: ignore[no-untyped-def]
    buffers, lengths, scalars, settings, counts, lost, memory, measured, out, out_lost
):
    """Write the next tick into `out` (k, 6), and drop the samples that no later tick needs."""
    dt = settings[1]
    t = settings[0] + scalars[_TICK] * dt
    for s in range(len(lengths)):
        buffer, n = buffers[s], lengths[s]
        i = _find_sample(buffer, n, t, dt)
        if i == n:
            lost[s] = True
        if not _write_value(buffer, n, i, t, dt, measured[s], out[s]):
            counts[s, MISSING] += 1
            out[s, :] = np.nan
        elif max(abs(out[s, 0]), abs(out[s, 1]), abs(out[s, 2])) >= (1.0 - AT_RANGE) * _saturation(memory[s]):
            counts[s, CUT_OFF] += 1
            out[s, :] = np.nan
        out_lost[s] = lost[s]
        # The next step begins at the last sample at or before the tick.
        done = i if i < n and buffer[i, _T] <= t + SAME * dt else i - 1
        if done > 0:
            for j in range(n - done):
                for m in range(_WIDTH):
                    buffer[j, m] = buffer[j + done, m]
            lengths[s] = n - done
    scalars[_TICK] += 1.0


@kernel
def _write_value(buffer, n, i, t, dt, measured, out):  # type: ignore[no-untyped-def]
    """Write the sensor's values at `t` into `out` (6,); `i` is its first sample from `t` on. False: not known."""
    if i == n:
        return False
    first = i == 0
    step = 0.0 if first else buffer[i, _T] - buffer[i - 1, _T]
    if buffer[i, _T] - t <= SAME * dt and (first or step >= (1.0 - 2.0 * SAME) * dt):
        for m in range(6):
            out[m] = buffer[i, 1 + m]
        return True
    bridged = max(LONGEST_GAP_S, dt) * (1.0 + 1e-6)  # [s] as in `clocks`: a single lost sample is always bridged
    if first or step - dt > bridged:
        return False
    if measured:
        _interpolate_orientation(buffer[i - 1], buffer[i], (t - buffer[i - 1, _T]) / step, out)
        return True
    if step > HOLE * dt:
        share = (t - buffer[i - 1, _T]) / step
        for m in range(6):
            out[m] = buffer[i - 1, 1 + m] + share * (buffer[i, 1 + m] - buffer[i - 1, 1 + m])
        return True
    # Mean rate over (t − dt, t], each sample's rate from the one before to it; mean force of the samples within, or
    # with fewer than two samples the force at t.
    for m in range(6):
        out[m] = 0.0
    covered, inside = 0.0, 0
    j = i
    while j > 0 and buffer[j, _T] > t - dt:
        begin, end = max(buffer[j - 1, _T], t - dt), min(buffer[j, _T], t)
        width = max(0.0, end - begin)
        covered += width
        for m in range(3):
            out[m] += width * buffer[j, _GX + m]
        if buffer[j, _T] <= t + SAME * dt:
            inside += 1
            for m in range(3):
                out[3 + m] += buffer[j, _AX + m]
        j -= 1
    if covered <= 0.0:
        return False
    for m in range(3):
        out[m] /= covered
    if inside >= 2:
        for m in range(3):
            out[3 + m] /= inside
    else:
        share = min(1.0, (t - buffer[i - 1, _T]) / step)
        for m in range(3):
            out[3 + m] = buffer[i - 1, _AX + m] + share * (buffer[i, _AX + m] - buffer[i - 1, _AX + m])
    return True


@kernel
def _interpolate_orientation(before, after, share, out):  # type: ignore[no-untyped-def]
    """Write the orientation between two samples, along the shorter way, into `out` (6,)."""
    dot, size = 0.0, 0.0
    for m in range(4):
        dot += before[1 + m] * after[1 + m]
    sign = 1.0 if dot >= 0.0 else -1.0
    for m in range(4):
        out[m] = (1.0 - share) * before[1 + m] + share * sign * after[1 + m]
        size += out[m] * out[m]
    for m in range(4):
        out[m] /= np.sqrt(size)
    out[4] = out[5] = 0.0
