"""Clocks: the times of each sensor with lost samples, which are bridged, and resampling to one even time base.

A sample is lost when its row is missing (a long step in time) or its cells are empty. Gaps of up to `LONGEST_GAP_S` are
bridged: rate and specific force linearly, measured orientations along the shortest rotation. A longer gap is an error,
or is bridged and marked where the user allows it: filters take no sample in it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import rotations
from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import BadData
from . import OrientationSensor, Sensor
from .intervals import check_time, find_runs, format_span
from .limits import LONGEST_STEP_S, SHORTEST_STEP_S

LONGEST_GAP_S = 0.05  # [s] of lost samples that are bridged silently
MOST_MISSING_S = 5.0  # [s] by which a sensor may begin later and end earlier than most without a warning
# Relative deviation of a step from the usual one that means an uneven clock or a lost row; devices jitter less.
UNEVEN = 0.5
# Relative deviation of the rate over 1 s or 10 s from its mean, apart from one sample's jitter, at which the rate is
# not constant. A gyroscope has a scale error of this size.
DRIFT = 0.003
# A clock is regular when three quarters of its steps deviate by less than this; a longer step then means a lost row.
REGULAR = 0.2
# Rows come in packets when the median step is below `WITHIN_PACKET` of the mean, and `SAME_SIZE` of at least
# `FEWEST_PACKETS` packets have one size.
WITHIN_PACKET, SAME_SIZE, FEWEST_PACKETS = 0.5, 0.8, 5
SHORTEST_SHARE = 0.1  # of the usual step, that equal times which are spread are apart; less is a clock that stood still
# Clocks that agree to this share of a step are one clock.
SAME = 0.01
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class Clock:
    """The times of a sensor with lost rows filled in."""

    time: np.ndarray  # (n,) [s]
    row: np.ndarray  # (n,) row of the file, −1 for a lost row
    step: float  # [s] the usual one
    packet: int = 1  # rows in a packet; their times were spread evenly


def build_clock(time: np.ndarray, place: str, is_device: bool = False) -> Clock:
    """Build the clock of a sensor from the times [s] of its rows; `place` begins an error's text.

    `is_device`: equal times that make no packets are spread too; in a user's own table they are a mistake.
    `BadData`: time does not increase, is not in seconds, or jumps by more than the length of the recording.
    """
    if len(time) < 2:
        raise BadData(f"{place}: {len(time)} samples; a recording has at least 2")
    packet, time = _spread_packets(time)
    time = spread_equal_times(time) if is_device else time
    check_time(place, time)
    steps = np.diff(time)
    step = float(np.median(steps))
    if not SHORTEST_STEP_S <= step <= LONGEST_STEP_S:
        pace, unit = ("slower", guess_time_unit(step)) if step > LONGEST_STEP_S else ("faster", None)
        guess = f'; time_unit = "{unit}" would fit' if unit else "; is it in seconds?"
        raise BadData(f"{place}: time grows by {step:g} s from row to row, {pace} than any body sensor{guess}")
    # How many rows are lost in each step.
    lost = np.where(steps > (1.0 + UNEVEN) * step, np.round(steps / step) - 1.0, 0.0)
    if np.quantile(np.abs(steps / step - 1.0), 0.75) > REGULAR:
        # The clock has no rate that shows lost rows: up to a long gap, a sample's rate holds for its whole step.
        lost[lost * step <= max(LONGEST_GAP_S, step)] = 0.0
    if lost.sum() > 10 * len(time) + 1000:
        k = int(np.argmax(steps))
        raise BadData(
            f"{place}: time jumps from {format_span(time[k : k + 2])} in row {k + 2}, by more than the recording "
            f"is long; cut the recording there"
        )
    rows = np.arange(len(time), dtype=np.int32)
    if not lost.any():
        return Clock(time, rows, step, packet)
    sample = rows + np.append(0, np.cumsum(lost, dtype=int))  # number of each row on the clock
    row = np.full(sample[-1] + 1, -1, dtype=np.int32)
    row[sample] = rows
    return Clock(np.interp(np.arange(len(row)), sample, time), row, step, packet)


def _spread_packets(time: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the rows in a packet, and times (n,) [s] spread evenly where all rows of a packet carry its arrival time.

    The last row of a packet has the packet's time. Without packets the number is 1 and the times are unchanged.
    """
    n, steps = len(time), np.diff(time)
    if n < 4 * FEWEST_PACKETS or not np.isfinite(time).all() or (steps < 0.0).any():
        return 1, time
    mean = (time[-1] - time[0]) / (n - 1)
    ends = np.append(np.flatnonzero(steps > mean), n - 1)  # the last row of each packet
    sizes, spans = np.diff(ends, prepend=-1), np.diff(time[ends])
    usual = int(np.median(sizes))
    if len(ends) < FEWEST_PACKETS or usual < 2 or np.mean(sizes == usual) < SAME_SIZE:
        return 1, time
    step = float(np.median(spans)) / usual
    if step > LONGEST_STEP_S or np.median(steps) > WITHIN_PACKET * mean:
        return 1, time
    # After a lost packet the rows have the usual step.
    steps_within = np.append(step, np.where(spans < (1.0 + UNEVEN) * usual * step, spans / sizes[1:], step))
    arrival = time[ends]
    if sizes[-1] < usual:  # the recording ends within a packet: its rows continue from the packet before
        arrival[-1], steps_within[-1] = arrival[-2] + sizes[-1] * step, step
    packet = np.repeat(np.arange(len(ends)), sizes)
    return usual, arrival[packet] - steps_within[packet] * (ends[packet] - np.arange(n))


def spread_equal_times(time: np.ndarray) -> np.ndarray:
    """Spread equal times (n,) evenly up to the next one: of a clock coarser than the rate, or of uneven packets."""
    new = np.flatnonzero(np.diff(time, prepend=-np.inf))
    if len(new) < 2 or len(new) == len(time):
        return time
    step = (time[new[-1]] - time[new[0]]) / (new[-1] - new[0])
    last = time[new[-1]] + step * (len(time) - new[-1])
    spread = np.interp(np.arange(len(time)), [*new, len(time)], [*time[new], last])
    steps = np.diff(spread)
    return spread if steps.min() > SHORTEST_SHARE * np.median(steps) else time


def guess_time_unit(step: float) -> str | None:
    """Guess the unit of a column of times from its usual `step`, seconds if possible; None: no unit fits a sensor."""
    return next((name for name, unit in TIME_UNITS.items() if 1e-4 < step * unit < LONGEST_STEP_S), None)


def find_common_time(where: str, clocks: Mapping[str, Clock]) -> tuple[np.ndarray, tuple[Diagnostic, ...]]:
    """Find one time base (n,) [s] for all sensors, with a diagnostic where they must be resampled.

    Sensors with one even clock keep it. Otherwise the time base is even, over the overlap of all clocks, at the rate of
    the slowest sensor: the motion of faster sensors is summed between samples without loss. `BadData`: no overlap.
    """
    distinct = list({id(clock): clock for clock in clocks.values()}.values())  # usually one for all sensors
    first, steps = distinct[0], [np.diff(clock.time) for clock in distinct]
    uneven = max(float(np.abs(each / clock.step - 1.0).max()) for clock, each in zip(distinct, steps, strict=True))
    drift = max(_compute_drift(clock.time) for clock in distinct)
    shared = all(
        len(clock.time) == len(first.time)
        and np.max(np.abs(clock.time - first.time)) <= SAME * min(clock.step, first.step)
        for clock in distinct
    )
    if shared and uneven <= UNEVEN + 1e-9 and drift <= DRIFT:
        return first.time, ()
    begin, end = max(float(clock.time[0]) for clock in distinct), min(float(clock.time[-1]) for clock in distinct)
    usual = max(float(each.mean()) for each in steps)
    if end - begin < 2.0 * usual:
        spans = ", ".join(f"{name} {format_span(c.time[[0, -1]])}" for name, c in clocks.items())
        raise BadData(
            f"{where}: the sensors' clocks do not overlap ({spans}); check each sensor's time and offset_s, in seconds"
        )
    dt = 1.0 / float(np.round(1.0 / usual, 3 if usual < 0.1 else 6))
    time = np.minimum(begin + dt * np.arange(int((end - begin) / dt + 1e-6) + 1), end)
    facts: dict[str, float | str] = {"start": begin, "end": float(time[-1]), "rate": 1.0 / dt}
    facts |= {"shortest": min(float(each.min()) for each in steps), "longest": max(float(each.max()) for each in steps)}
    variant, off = ("uneven", uneven) if uneven > UNEVEN else ("changing", drift)
    facts["variant"] = variant if shared else "clocks"
    found = [Diagnostic("time-stamps-uneven", INFO, value=off if shared else None, facts=facts)]
    # Loggers are switched on one by one: one that begins long before the others makes none of them late.
    usual_begin = np.quantile([clock.time[0] for clock in clocks.values()], 0.5, method="lower")
    usual_end = np.quantile([clock.time[-1] for clock in clocks.values()], 0.5, method="higher")
    for name, clock in clocks.items():
        own: dict[str, float | str] = {"start": float(clock.time[0]), "end": float(clock.time[-1])}
        missing_s = max(0.0, float(clock.time[0] - usual_begin)) + max(0.0, float(usual_end - clock.time[-1]))
        if missing_s > MOST_MISSING_S:
            found.append(Diagnostic("sensor-short", WARNING, name, missing_s, facts=own))
    return time, tuple(found)


def _compute_drift(time: np.ndarray) -> float:
    """Compute the largest relative deviation of the rate over 1 s or 10 s from its mean, less one step's jitter."""
    n = len(time)
    mean = (time[-1] - time[0]) / (n - 1)
    sizes = [min(n - 1, max(1, round(seconds / mean))) for seconds in (1.0, 10.0)]
    return max(0.0, *(float(np.abs(time[s:] - time[:-s] - s * mean).max() - mean) / (s * mean) for s in sizes))


# Lost samples, and resampling, which preserves total rotation ---------------------------------------------------------


def find_long_gaps(lost: np.ndarray, step: float) -> np.ndarray:
    """Find which `lost` samples (n,) are in a gap too long to be bridged silently, at a `step` [s]."""
    long = np.zeros(len(lost), dtype=bool)
    for first, last in find_runs(lost):  # a single lost sample is always bridged
        long[first:last] = (last - first) * step > max(LONGEST_GAP_S, step) * (1.0 + 1e-6)
    return long


def bridge(values: np.ndarray, lost: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Fill the `lost` rows (n,) of `values`, as `interpolate` does from the others at their times (n,) [s]."""
    if not lost.any():
        return values
    filled = values.copy()
    filled[lost] = interpolate(time[~lost], values[~lost], time[lost])
    return filled


def interpolate(clock: np.ndarray, values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Interpolate from times `clock` (n,) to `time` (m,), both [s]; beyond its ends the nearest value holds.

    `values` are (n, 4) xyzw, which follow the shortest rotation, or (n, 3), which are linear in time.
    """
    if values.shape[1] != 4:
        return np.column_stack([np.interp(time, clock, axis) for axis in values.T])
    if len(clock) == 1:
        return values.repeat(len(time), axis=0)
    return np.asarray(Slerp(clock, Rotation.from_quat(values))(np.clip(time, clock[0], clock[-1])).as_quat())


def resample(sensor: Sensor, clock: np.ndarray, time: np.ndarray) -> Sensor:
    """Resample a sensor from its own times `clock` (n,) [s] to an even time base `time` (m,) within them.

    The rate is integrated, interpolated as an orientation and differenced again, which preserves total rotation. The
    specific force is interpolated linearly; on a coarser time base it is averaged over each step against aliasing.
    """
    gap = None
    if sensor.gap is not None:
        after = np.clip(np.searchsorted(clock, time - 1e-9), 0, len(clock) - 1)
        gap = sensor.gap[after] | (sensor.gap[np.maximum(after - 1, 0)] & (clock[after] > time + 1e-9))
    if isinstance(sensor, OrientationSensor):
        return replace(sensor, quat_VS=interpolate(clock, sensor.quat_VS, time), gap=gap)
    steps, dt, accel_S = np.diff(clock), float(time[1] - time[0]), sensor.accel_S
    quat = interpolate(clock, rotations.integrate(sensor.gyro_S[1:] * steps[:, None]), time)
    rate = rotations.compute_turns(quat) / np.diff(time)[:, None]
    if dt < (1.0 + UNEVEN) * float(np.median(steps)):
        accel = interpolate(clock, accel_S, time)
    else:
        # A mean over each step is the difference of integrals at its ends.
        trapezes = 0.5 * (accel_S[1:] + accel_S[:-1]) * steps[:, None]
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum(trapezes, axis=0)])
        first, last = (np.clip(time + side * dt / 2.0, clock[0], clock[-1]) for side in (-1.0, 1.0))
        accel = interpolate(clock, integral, last) - interpolate(clock, integral, first)
        accel /= (last - first)[:, None]
    return replace(sensor, gyro_S=np.concatenate([rate[:1], rate]), accel_S=accel, gap=gap)
