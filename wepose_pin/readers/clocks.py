"""Clocks: each sensor's own times, samples that were lost, and one even time base for all.

A sample is lost where its row is not there (a step in time) or its cells are empty. Up to `LONGEST_GAP_S` of lost
samples are bridged: the rate and the specific force linearly, ready orientations along the shortest rotation. What is
longer is an error, or is bridged and marked where the user allows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import so3
from ..errors import BadData
from ..recording import Sensor, check_time, span_text

LONGEST_GAP_S = 0.05
# A step this far from the usual one (as a share of it) is uneven, or a lost row; clocks of devices jitter less.
UNEVEN = 0.5
# A rate that differs by this share from its mean over a second or ten, a sample's jitter aside, is no longer one rate:
# as much is the scale error of a gyroscope.
DRIFT = 0.003
# A clock is regular, and a longer step in it a lost row, where three quarters of its steps are as usual to this share.
REGULAR = 0.2
# Rows come in packets where most steps are below this share of the mean, in packets of one size, this share of them.
WITHIN_PACKET, SAME_SIZE, FEWEST_PACKETS = 0.5, 0.8, 5
# Clocks that agree to this share of a step are one clock.
SAME = 0.01
# No body sensor measures more slowly [s]: the times are in another unit.
SLOWEST_STEP_S = 0.5
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# So many times are looked at together, so that what is in memory beside them does not grow.
BLOCK = 1 << 20
# In a long gap the rate falls to the sensor's rate at rest within this time [s]: a person's motion goes on no longer.
FADE_S = 0.1

GOOD, BRIDGED, LONG = 0, 1, 2


@dataclass(frozen=True)
class Clock:
    """A sensor's times with lost rows put back.

    Parameters
    ----------
    time : (n,) [s]
    row : (n,) row of the file, −1 for a lost one
    step : the usual step [s]
    packet : so many rows came at a time, and their times were spread evenly
    """

    time: np.ndarray
    row: np.ndarray
    step: float
    packet: int = 1

    @property
    def longest_bridge(self) -> float:
        """Lost time [s] that is still bridged: one sample always is."""
        return max(LONGEST_GAP_S, self.step) * (1.0 + 1e-6)


def clock_of(time: np.ndarray, place: str) -> Clock:
    """The clock of a sensor whose rows have these times [s]; `place` begins an error's text.

    Raises
    ------
    BadData
        Time stands still, goes back, is not in seconds, or jumps by more than the recording is long.
    """
    if len(time) < 2:
        raise BadData(f"{place}: {len(time)} samples; a recording has at least 2")
    packet, time = _unpacked(time)
    check_time(place, time)
    usual = np.diff(time[: BLOCK + 1])  # of a day's times not all are needed to know it
    step = float(np.median(usual))
    if step > SLOWEST_STEP_S:
        unit = time_unit_of(step)
        guess = f'; time_unit = "{unit}" would fit' if unit else ""
        raise BadData(f"{place}: time grows by {step:g} s from row to row, slower than any body sensor{guess}")
    wide = np.concatenate([first + np.flatnonzero(s > (1.0 + UNEVEN) * step) for first, s in _steps(time)])
    lost = np.round((time[wide + 1] - time[wide]) / step) - 1.0
    if np.quantile(np.abs(usual / step - 1.0), 0.75) > REGULAR:
        # No rate to tell lost rows by: up to a long gap, a sample's rate is that of its whole step.
        lost[lost * step <= max(LONGEST_GAP_S, step)] = 0.0
    if lost.sum() > 10 * len(time) + 1000:
        k = int(wide[np.argmax(time[wide + 1] - time[wide])])
        raise BadData(
            f"{place}: time jumps from {span_text(time[k : k + 2])} in row {k + 2}, by more than the recording "
            f"is long; cut the recording there"
        )
    if not lost.any():
        return Clock(time, np.arange(len(time), dtype=np.int32 if len(time) < 2**31 else np.int64), step, packet)
    counts = np.zeros(len(time), dtype=int)
    counts[wide] = lost.astype(int)
    row = np.repeat(np.arange(len(time)), counts + 1)
    nth = np.arange(len(row)) - np.searchsorted(row, row)  # 0 is the row itself, then the lost ones after it
    filled = time[row] + nth * np.append(np.diff(time) / (counts[:-1] + 1), 0.0)[row]
    return Clock(filled, np.where(nth == 0, row, -1), step, packet)


def _unpacked(time: np.ndarray) -> tuple[int, np.ndarray]:
    """Rows in a packet, and times (n,) [s] spread evenly where rows carry those at which their packet came.

    The last row of a packet is as old as the packet. One row where they do not come in packets.
    """
    n, steps = len(time), np.diff(time)
    if n < 4 * FEWEST_PACKETS or not np.isfinite(time).all() or (steps < 0.0).any():
        return 1, time
    mean = (time[-1] - time[0]) / (n - 1)
    if np.median(steps) > WITHIN_PACKET * mean:
        return 1, time
    ends = np.append(np.flatnonzero(steps > mean), n - 1)  # the last row of each packet
    sizes = np.diff(ends, prepend=-1)
    usual = int(np.median(sizes))
    if len(ends) < FEWEST_PACKETS or usual < 2 or np.mean(sizes == usual) < SAME_SIZE:
        return 1, time
    spans = np.diff(time[ends])
    step = float(np.median(spans)) / usual
    if step > SLOWEST_STEP_S:
        return 1, time
    # After a lost packet the rows keep to the time that a packet takes.
    own = np.append(step, np.where(spans < (1.0 + UNEVEN) * usual * step, spans / sizes[1:], step))
    came = time[ends]
    if sizes[-1] < usual:  # the recording ends within a packet: its rows go on from the one before
        came[-1] = min(came[-1], came[-2] + sizes[-1] * step)
        own[-1] = (came[-1] - came[-2]) / sizes[-1]
    packet = np.repeat(np.arange(len(ends)), sizes)
    return usual, came[packet] - own[packet] * (ends[packet] - np.arange(n))


def time_unit_of(step: float) -> str | None:
    """The unit in which the usual `step` of a column of times is that of a body sensor; None: in none.

    A step at which two units would do (0.2 to 0.5 s, or ms) is taken for seconds.
    """
    return next((name for name, unit in TIME_UNITS.items() if 1e-4 < step * unit < SLOWEST_STEP_S), None)


def _steps(time: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """The steps of so many times at once, and where the first of them is."""
    for first in range(0, len(time) - 1, BLOCK):
        yield first, np.diff(time[first : first + BLOCK + 1])


def common_time(where: str, clocks: Mapping[str, Clock]) -> tuple[np.ndarray, tuple[str, ...]]:
    """One time base for all sensors, and a note where it is not their own.

    Their own where they share an even one. Else an even one over their overlap at the rate of the slowest sensor: of a
    faster one the motion between two samples is summed and nothing is lost, of a slower one it would be invented.

    Raises
    ------
    BadData
        The clocks do not overlap.
    """
    first = next(iter(clocks.values()))
    own = list({id(clock): clock for clock in clocks.values()}.values())  # most often one for all
    uneven = max(float(np.max(np.abs(s / clock.step - 1.0))) for clock in own for _, s in _steps(clock.time))
    shared = all(_same(clock, first) for clock in clocks.values())
    off = max(_off_even(clock) for clock in own)
    if shared and uneven <= UNEVEN + 1e-9 and off <= DRIFT:
        return first.time, ()
    begin = max(float(clock.time[0]) for clock in clocks.values())
    end = min(float(clock.time[-1]) for clock in clocks.values())
    usual = max(float(clock.time[-1] - clock.time[0]) / (len(clock.time) - 1) for clock in clocks.values())
    if end - begin < 2.0 * usual:
        spans = ", ".join(f"{name} {span_text(c.time[[0, -1]])}" for name, c in clocks.items())
        raise BadData(
            f"{where}: the sensors' clocks do not overlap ({spans}); check each sensor's time and offset_s, in seconds"
        )
    dt = 1.0 / float(np.round(1.0 / usual, 3 if usual < 0.1 else 6))
    time = np.minimum(begin + dt * np.arange(int((end - begin) / dt + 1e-6) + 1), end)
    smallest = min(float(s.min()) for clock in own for _, s in _steps(clock.time))
    largest = max(float(s.max()) for clock in own for _, s in _steps(clock.time))
    if not shared:
        why = "the sensors' clocks differ"
    elif uneven > UNEVEN:
        why = f"the rate is uneven, off the usual step by up to {100 * uneven:.0f} %"
    else:
        why = f"the rate changes by up to {100 * off:.1f} %"
    note = (
        f"resampled to {1.0 / dt:g} Hz from {begin:.3f} to {time[-1]:.3f} s: {why} "
        f"(steps between {1e3 * smallest:.2f} and {1e3 * largest:.2f} ms)"
    )
    return time, (note,)


def _same(a: Clock, b: Clock) -> bool:
    return a is b or (
        len(a.time) == len(b.time) and bool(np.max(np.abs(a.time - b.time)) <= SAME * min(a.step, b.step))
    )


def _off_even(clock: Clock) -> float:
    """Largest share by which the rate over a second, or ten, is off its mean; one step is jitter and free."""
    time, n = clock.time, len(clock.time)
    mean = (time[-1] - time[0]) / (n - 1)
    off = 0.0
    for seconds in (1.0, 10.0):
        size = min(n - 1, max(1, round(seconds / mean)))
        for first in range(0, n - size, BLOCK):
            last = min(first + BLOCK, n - size)
            spans = time[first + size : last + size] - time[first:last]
            off = max(off, float(np.max(np.abs(spans - size * mean)) - mean) / (size * mean))
    return off


# Lost samples ------------------------------------------------------------------------------------------------------


def lost_samples(clock: Clock, good: np.ndarray) -> np.ndarray:
    """`GOOD`, `BRIDGED` or `LONG` for every sample (n,), of the runs that are not `good` (n,)."""
    marks = np.zeros(len(good), dtype=np.int8)
    for first, last in runs(~good):
        marks[first:last] = LONG if (last - first) * clock.step > clock.longest_bridge else BRIDGED
    return marks


def runs(which: np.ndarray) -> list[tuple[int, int]]:
    """First and one past the last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def bridge(values: np.ndarray, marks: np.ndarray, clock: Clock, *, rate: bool = False) -> np.ndarray:
    """`values` (n, k) with lost samples filled linearly in time; before the first and after the last they stay.

    Where all are lost, as in a piece of a recording, they are zero.

    With `rate` these are angular rates, which in long gaps fall to the rate at rest: the bias, that is.
    """
    lost = marks != GOOD
    if not lost.any():
        return values
    if lost.all():
        return np.zeros_like(values)
    time, filled = clock.time, values.copy()
    for k in range(values.shape[1]):
        filled[lost, k] = np.interp(time[lost], time[~lost], values[~lost, k])
    if rate and (marks == LONG).any():
        rest = _rate_at_rest(values, ~lost, clock)
        for first, last in runs(marks == LONG):
            edges = [edge for edge in (first - 1, last) if 0 <= edge < len(time)]
            near = [np.clip(1.0 - np.abs(time[first:last] - time[edge]) / FADE_S, 0.0, None) for edge in edges]
            whole = np.maximum(1.0, np.sum(near, axis=0))
            filled[first:last] = rest
            for edge, weight in zip(edges, near, strict=True):
                filled[first:last] += (weight / whole)[:, None] * (values[edge] - rest)
    return filled


def bridge_quat(
    quat: np.ndarray,
    marks: np.ndarray,
    clock: Clock,
    before: tuple[float, np.ndarray] | None = None,
    after: tuple[float, np.ndarray] | None = None,
) -> np.ndarray:
    """Unit quaternions (n, 4) with lost ones filled along the shortest rotation.

    `before` and `after` are the time [s] and the quaternion (4,) last and next measured beyond a piece of a recording.
    """
    filled = quat.copy()
    for first, last in runs(marks != GOOD):
        ends = [
            before if first == 0 else (clock.time[first - 1], quat[first - 1]),
            after if last == len(quat) else (clock.time[last], quat[last]),
        ]
        near = [end for end in ends if end is not None]
        if len(near) < 2:
            filled[first:last] = near[0][1]
            continue
        times, quats = zip(*near, strict=True)
        filled[first:last] = Slerp(times, Rotation.from_quat(np.array(quats)))(clock.time[first:last]).as_quat()
    return filled


def _rate_at_rest(gyro_S: np.ndarray, good: np.ndarray, clock: Clock) -> np.ndarray:
    """Mean rate (3,) of the second in which it varies least; zero where no second is whole."""
    size = max(2, round(1.0 / clock.step))
    blocks = len(gyro_S) // size
    whole = good[: blocks * size].reshape(blocks, size).all(axis=1)
    seconds = gyro_S[: blocks * size].reshape(blocks, size, 3)[whole]
    if not len(seconds):
        return np.zeros(3)
    return seconds[int(np.argmin(seconds.var(axis=1).sum(axis=1)))].mean(axis=0)


# Resampling --------------------------------------------------------------------------------------------------------


def on_time(sensor: Sensor, clock: np.ndarray, time: np.ndarray) -> Sensor:
    """The sensor, sampled at `clock` (n,) [s], on an even time base `time` (m,) within it.

    The gyroscope is integrated on its own clock, the orientation interpolated along each interval's own rate, and
    differenced again, so that no rotation is lost or made. The specific force is interpolated linearly; where the time
    base is coarser, it is the mean over a step of it, that noise and impacts between samples do not fold down.
    """
    gap = None
    if sensor.gap is not None:
        after = np.clip(np.searchsorted(clock, time - 1e-9), 0, len(clock) - 1)
        gap = sensor.gap[after] | (sensor.gap[np.maximum(after - 1, 0)] & (clock[after] > time + 1e-9))
    within = np.clip(time, clock[0], clock[-1])
    if sensor.quat_WS is not None:
        return replace(sensor, quat_WS=Slerp(clock, Rotation.from_quat(sensor.quat_WS))(within).as_quat(), gap=gap)
    assert sensor.gyro_S is not None
    assert sensor.accel_S is not None
    turned = so3.integrate(sensor.gyro_S[1:] * np.diff(clock)[:, None])
    at = Slerp(clock, Rotation.from_quat(turned))(within)
    rate = (at[:-1].inv() * at[1:]).as_rotvec() / np.diff(time)[:, None]
    dt = float(time[1] - time[0])
    if dt < (1.0 + UNEVEN) * float(np.median(np.diff(clock))):
        accel = np.column_stack([np.interp(within, clock, axis) for axis in sensor.accel_S.T])
    else:
        accel = _mean_about(sensor.accel_S, clock, within, dt)
    return replace(sensor, gyro_S=np.concatenate([rate[:1], rate]), accel_S=accel, gap=gap)


def _mean_about(values: np.ndarray, clock: np.ndarray, time: np.ndarray, width: float) -> np.ndarray:
    """Mean (m, k) of the piecewise linear signal over `width` [s] about each time, less where the clock ends."""
    trapezes = 0.5 * (values[1:] + values[:-1]) * np.diff(clock)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(trapezes, axis=0)])
    first, last = (np.clip(time + side * width / 2.0, clock[0], clock[-1]) for side in (-1.0, 1.0))

    def up_to(t: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(clock, t, side="right") - 1, 0, len(clock) - 2)
        part = (t - clock[k])[:, None]
        slope = (values[k + 1] - values[k]) / (clock[k + 1] - clock[k])[:, None]
        return integral[k] + part * (values[k] + 0.5 * part * slope)

    return (up_to(last) - up_to(first)) / (last - first)[:, None]
