"""Samples in their order of arrival → ticks of one even clock, for live sources and for files of live sessions.

The ticks depend on the samples and their order alone, not on the time of day or on how many samples arrive at once. A
file with the arrivals therefore gives bit-identical ticks.
"""

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..compilation import compiled
from . import ImuSensor, Sensor
from .clocks import LONGEST_GAP_S
from .faults import (
    AT_RANGE,
    FROZEN_SAMPLES,
    MOST_REPEATS,
    NOISY_S,
    SATURATION,
    SMALL_TURN,
    are_noise,
    count_turns,
    is_same,
    start_saturation,
    watch_saturation,
)
from .limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED, NARROWEST_GYRO_RANGE

SAME = 0.01  # share of a step within which a sample counts as at the tick
HOLE = 1.5  # usual steps; a longer step contains a lost sample
REORDER_S = 0.02  # [s] a tick waits so long for a sample that a later one has overtaken
WAIT_S = 0.1  # [s] a tick waits so long for a silent sensor; then the sensor is lost until its next sample
JUMP_S = 1.0  # [s] a time further ahead of all others is an error, unless the sensor continues from there
LEARNED = 100  # samples after which a noisy sensor may count as frozen

MISSING, LATE, DUPLICATE, BAD, TAKEN, FROZEN, CUT_OFF = range(7)
COUNTS = ("missing", "late", "duplicate", "bad", "taken", "frozen", "cut_off")

_OUT = 1024  # ticks in a block
# What is known of a sensor. A row of its buffer has seven numbers: time [s], gyro, accel.
SENSOR = np.dtype(
    [
        ("is_orientation", np.bool_),
        ("lost", np.bool_),
        ("frozen", np.bool_),
        ("counts", np.int64, len(COUNTS)),
        ("buffered", np.int64),  # rows of its buffer in use
        ("jumps", np.int64),  # samples in a row that were too far ahead
        ("jump_time", float),  # [s] of the last of these
        ("newest", float),  # [s]
        ("value", float, 6),  # the newest sample
        ("before", float, 6),  # the one before it that differs
        ("since", float),  # [s] since when it repeats
        ("repeats", float),  # how often it does
        ("most_repeats", float),  # the most before; 0: it has never changed
        ("second", float),  # [s] start of this second
        ("turns", np.int64),  # reversals of all signals in this second, without the samples that repeat
        ("small", np.int64),  # those of them by `SMALL_TURN` at most
        ("noisy_s", np.int64),  # number of seconds in which the signals reversed as in noise
        ("saturation", SATURATION),  # of gyro
    ],
    align=True,
)
# `tick` of the next one, `newest` time [s] of all sensors
CLOCK = np.dtype([("begin", float), ("dt", float), ("tick", np.int64), ("newest", float)], align=True)


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
    rows: np.ndarray  # (m, 7) time [s], gyro, accel: rows of its buffer


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
    _, *columns = zip(*samples, strict=True)
    rows = np.column_stack([np.concatenate(column, dtype=float) for column in columns])
    order = np.argsort(rows[:, 0], kind="stable") if len(samples) > 1 else slice(None)
    return Arrivals(which[order], rows[order])


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
    sensor have overtaken and `WAIT_S` for a silent sensor, both measured on the samples' times. Then the sensor is
    lost, and ticks do not wait for it until its next sample. A sample at a tick is used unchanged. Between ticks the
    rate is the mean over the step, and specific force and measured orientations are interpolated. Gaps of up to
    `LONGEST_GAP_S` are bridged linearly; longer ones are NaN. So are the samples of a frozen sensor until they change,
    and ticks with a rate at which the gyroscope has saturated (`faults`).

    Parameters
    ----------
    sensors : segments, in the order of the ticks' columns
    rate_hz : ticks a second
    begin : time [s] of tick 0
    orientations : the sensors whose samples are measured orientations
    """

    def __init__(
        self, sensors: Sequence[str], rate_hz: float, begin: float, orientations: Collection[str] = ()
    ) -> None:
        self.sensors, self.rate_hz, self.begin = tuple(sensors), rate_hz, begin
        k = len(self.sensors)
        self._clock = np.array([(begin, 1.0 / rate_hz, 0, -np.inf)], CLOCK)
        self._sensors = state = np.zeros(k, SENSOR)
        state["is_orientation"] = [name in orientations for name in self.sensors]
        state["saturation"], state["newest"], state["value"] = start_saturation(), -np.inf, np.nan
        self.counts, self.lost, self.frozen = state["counts"], state["lost"], state["frozen"]
        # A sensor may be much faster than the ticks.
        room = 4096 + int(8.0 * rate_hz * WAIT_S)
        self._buffers = np.zeros((k, room, 7))
        self._out = np.empty((_OUT, k, 6)), np.empty((_OUT, k), dtype=np.bool_)

    @property
    def next_tick(self) -> int:
        """Number of the next tick."""
        return int(self._clock["tick"][0])

    @property
    def newest(self) -> float:
        """Time [s] of the newest sample of all; −inf before the first."""
        return float(self._clock["newest"][0])

    def push(self, arrivals: Arrivals) -> Iterator[Ticks]:
        """Take samples and iterate over the ticks that they complete, some at a time: after a silence they are many."""
        next_sample, count, state = 0, _OUT, (self._clock, self._sensors, self._buffers)
        while next_sample < len(arrivals.rows) or count == _OUT:
            first = self.next_tick
            next_sample, count = _take_samples(*state, *arrivals, next_sample, *self._out)
            if count:
                values, lost = (each[:count].copy() for each in self._out)
                time = self.begin + np.arange(first, first + count) / self.rate_hz
                yield Ticks(first, time, values[:, :, :3], values[:, :, 3:], lost)


# The kernels below take `clock` and `sensor` as records of `CLOCK` and `SENSOR`, and a `sample` as a row of a buffer.


@compiled
def _take_samples(clocks, sensors, buffers, which, samples, next_sample, out, out_lost):  # type: ignore[no-untyped-def]
    """Take samples from `next_sample` on; returns the next sample and the number of ticks, at most `len(out)`."""
    clock, count = clocks[0], 0
    while True:
        while count < len(out) and _write_tick(clock, sensors, buffers, out[count], out_lost[count]):
            count += 1
        if count == len(out) or next_sample == len(samples):
            return next_sample, count
        i, sample = which[next_sample], samples[next_sample]
        sensor, t = sensors[i], sample[0]
        next_sample += 1
        if not _is_plausible(clock, sensor, sample):
            sensor.counts[BAD] += 1
            continue
        if not sensor.is_orientation and t > sensor.newest:
            _watch_values(clock, sensors, sensor, sample)
        if sensor.frozen and t > sensor.since:
            sensor.counts[FROZEN] += 1
            clock.newest = max(clock.newest, t)
        else:
            _insert_sample(clock, sensor, buffers[i], sample)


@compiled
def _is_plausible(clock, sensor, sample):  # type: ignore[no-untyped-def]
    """Return whether a sample and its time are plausible."""
    t, gx, gy, gz, ax, ay, az = sample
    size, force = gx * gx + gy * gy + gz * gz, ax * ax + ay * ay + az * az
    if not (abs(t) < 1e12 and size < HIGHEST_RATE_SQUARED and force < HIGHEST_ACCEL_SQUARED):
        return False
    if t > clock.newest + JUMP_S and clock.newest > -np.inf:
        # A single time-stamp outlier must not make hours of ticks; after a real jump several samples continue from it.
        continues = sensor.jumps > 0 and 0.0 < t - sensor.jump_time < 1.0
        sensor.jumps = sensor.jumps + 1 if continues else 1
        sensor.jump_time = t
        if sensor.jumps < 4:
            return False
    sensor.jumps = 0
    return True


@compiled
def _watch_values(clock, sensors, sensor, sample):  # type: ignore[no-untyped-def]
    """Find whether a sensor is frozen at this sample, its newest, and at which rates its gyroscope saturates."""
    t, values = sample[0], sample[1:]
    sensor.newest = t
    if is_same(sensor.value, values):
        sensor.repeats += 1.0
        if sensor.repeats < FROZEN_SAMPLES or t - sensor.since <= LONGEST_GAP_S * (1.0 + 1e-6):
            return
        if sensor.most_repeats > 0.0:
            known = sensor.noisy_s >= NOISY_S and sensor.counts[TAKEN] >= LEARNED
            sensor.frozen = known and sensor.repeats > MOST_REPEATS * sensor.most_repeats
        elif t - sensor.since >= NOISY_S:  # it shows no noise; the others are of its kind
            sensor.frozen = sensors.noisy_s.max() >= NOISY_S
        return
    if not sensor.frozen:
        sensor.most_repeats = max(sensor.most_repeats, sensor.repeats)
    sensor.turns += count_turns(sensor.before, sensor.value, values, np.inf)
    sensor.small += count_turns(sensor.before, sensor.value, values, SMALL_TURN)
    seconds = t - sensor.second
    if seconds >= 1.0:
        sensor.noisy_s += are_noise(sensor.turns / 6.0, sensor.small / 6.0, seconds / clock.dt, seconds)
        sensor.second, sensor.turns, sensor.small = t, 0, 0
    sensor.frozen, sensor.since, sensor.repeats = False, t, 1.0
    watch_saturation(sensor.saturation, sample[1:4], NARROWEST_GYRO_RANGE)
    sensor.before[:] = sensor.value
    sensor.value[:] = values


@compiled
def _insert_sample(clock, sensor, buffer, sample):  # type: ignore[no-untyped-def]
    """Insert a sample into its sensor's buffer, in order of time."""
    dt, t = clock.dt, sample[0]
    i = np.searchsorted(buffer[: sensor.buffered, 0], t - SAME * dt)
    if i < sensor.buffered and buffer[i, 0] < t + SAME * dt:
        sensor.counts[DUPLICATE] += 1
        return
    # Only the first tick has no tick before it: a sample before the beginning is the start of its step.
    if clock.tick > 0 and t < clock.begin + (clock.tick - 1.0 + SAME) * dt:
        sensor.counts[LATE] += 1
        if t > clock.newest - WAIT_S:
            sensor.lost = False  # the next tick waits for it again
        return
    if sensor.buffered == len(buffer):  # it is ahead by a full buffer and no tick is complete: drop the oldest sample
        _drop_samples(sensor, buffer, 1)
        i = max(i - 1, 0)
    sensor.buffered += 1
    buffer[i + 1 : sensor.buffered] = buffer[i : sensor.buffered - 1].copy()
    buffer[i] = sample
    sensor.lost = False
    sensor.counts[TAKEN] += 1
    clock.newest = max(clock.newest, t)


@compiled
def _drop_samples(sensor, buffer, count):  # type: ignore[no-untyped-def]
    """Drop the oldest samples of a buffer."""
    for j in range(sensor.buffered - count):
        buffer[j] = buffer[j + count]
    sensor.buffered -= count


@compiled
def _write_tick(clock, sensors, buffers, out, out_lost):  # type: ignore[no-untyped-def]
    """Write the next tick into `out` (k, 6), if it is complete; drop the samples that no later tick needs."""
    dt, t = clock.dt, clock.begin + clock.tick * clock.dt
    if clock.newest < t - SAME * dt:
        return False
    for s in range(len(sensors)):
        buffer, n = buffers[s], sensors[s].buffered
        if sensors[s].lost or clock.newest >= t + WAIT_S:
            continue
        if n == 0 or buffer[n - 1, 0] < t - SAME * dt:
            return False
        if buffer[n - 1, 0] < t + REORDER_S:
            i = np.searchsorted(buffer[:n, 0], t - SAME * dt)
            if i > 0 and buffer[i, 0] - buffer[i - 1, 0] > HOLE * dt and buffer[i - 1, 0] > t - WAIT_S:
                return False  # a sample in the gap may still arrive
    for s in range(len(sensors)):
        sensor, buffer, n, level = sensors[s], buffers[s], sensors[s].buffered, sensors[s].saturation.level
        i = np.searchsorted(buffer[:n, 0], t - SAME * dt)
        sensor.lost = sensor.lost or i == n
        if not _write_value(buffer, n, i, t, dt, sensor.is_orientation, out[s]):
            sensor.counts[MISSING] += 1
            out[s, :] = np.nan
        elif np.abs(out[s, :3]).max() >= (1.0 - AT_RANGE) * level.min():
            sensor.counts[CUT_OFF] += 1
            out[s, :] = np.nan
        out_lost[s] = sensor.lost
        # The next step begins at the last sample at or before the tick.
        _drop_samples(sensor, buffer, max(0, i if i < n and buffer[i, 0] <= t + SAME * dt else i - 1))
    clock.tick += 1
    return True


@compiled
def _write_value(buffer, n, i, t, dt, is_orientation, out):  # type: ignore[no-untyped-def]
    """Write the sensor's values at `t` into `out` (6,); `i` is its first sample from `t` on. False: not known."""
    if i == n:
        return False
    step = buffer[i, 0] - buffer[i - 1, 0] if i > 0 else np.inf
    if buffer[i, 0] - t <= SAME * dt and step >= (1.0 - 2.0 * SAME) * dt:
        out[:] = buffer[i, 1:]
        return True
    if step - dt > max(LONGEST_GAP_S, dt) * (1.0 + 1e-6):  # as in `clocks`: a single lost sample is always bridged
        return False
    before, after, share = buffer[i - 1, 1:], buffer[i, 1:], (t - buffer[i - 1, 0]) / step
    if is_orientation:  # along the shorter way
        sign = 1.0 if (before[:4] * after[:4]).sum() >= 0.0 else -1.0
        out[:] = before + share * (sign * after - before)
        out[:4] /= np.sqrt((out[:4] * out[:4]).sum())
        return True
    out[:] = before + min(1.0, share) * (after - before)
    if step <= HOLE * dt:
        # Mean rate over (t − dt, t], each sample's rate from the one before to it; mean force of the samples within,
        # or with fewer than two samples the force at t.
        rate, force, covered, within, j = np.zeros(3), np.zeros(3), 0.0, 0, i
        while j > 0 and buffer[j, 0] > t - dt:
            width = max(0.0, min(buffer[j, 0], t) - max(buffer[j - 1, 0], t - dt))
            covered += width
            rate += width * buffer[j, 1:4]
            if buffer[j, 0] <= t + SAME * dt:
                within += 1
                force += buffer[j, 4:]
            j -= 1
        out[:3] = rate / covered
        if within >= 2:
            out[3:] = force / within
    return True
