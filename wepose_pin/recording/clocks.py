"""Clocks: each sensor's own times with the rows that are missing put back, and one even time base for all sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ..diagnostics import INFO, Diagnostic
from ..errors import BadData
from .intervals import check_time, format_span
from .limits import LONGEST_STEP_S

LONGEST_GAP_S = 0.05  # [s] of lost samples that are bridged in silence
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
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# So many times are looked at together, so that what is in memory beside them does not grow.
BLOCK = 1 << 20


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


def build_clock(time: np.ndarray, place: str) -> Clock:
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
    if step > LONGEST_STEP_S:
        unit = guess_time_unit(step)
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
            f"{place}: time jumps from {format_span(time[k : k + 2])} in row {k + 2}, by more than the recording "
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
    if step > LONGEST_STEP_S:
        return 1, time
    # After a lost packet the rows keep to the time that a packet takes.
    own = np.append(step, np.where(spans < (1.0 + UNEVEN) * usual * step, spans / sizes[1:], step))
    came = time[ends]
    if sizes[-1] < usual:  # the recording ends within a packet: its rows go on from the one before
        came[-1] = min(came[-1], came[-2] + sizes[-1] * step)
        own[-1] = (came[-1] - came[-2]) / sizes[-1]
    packet = np.repeat(np.arange(len(ends)), sizes)
    return usual, came[packet] - own[packet] * (ends[packet] - np.arange(n))


def guess_time_unit(step: float) -> str | None:
    """The unit in which the usual `step` of a column of times is that of a body sensor; None: in none.

    A step at which two units would do (0.2 to 0.5 s, or ms) is taken for seconds.
    """
    return next((name for name, unit in TIME_UNITS.items() if 1e-4 < step * unit < LONGEST_STEP_S), None)


def _steps(time: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """The steps of so many times at once, and where the first of them is."""
    for first in range(0, len(time) - 1, BLOCK):
        yield first, np.diff(time[first : first + BLOCK + 1])


def find_common_time(where: str, clocks: Mapping[str, Clock]) -> tuple[np.ndarray, tuple[Diagnostic, ...]]:
    """One time base (n,) [s] for all sensors, and a diagnostic where it is not their own.

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
        spans = ", ".join(f"{name} {format_span(c.time[[0, -1]])}" for name, c in clocks.items())
        raise BadData(
            f"{where}: the sensors' clocks do not overlap ({spans}); check each sensor's time and offset_s, in seconds"
        )
    dt = 1.0 / float(np.round(1.0 / usual, 3 if usual < 0.1 else 6))
    time = np.minimum(begin + dt * np.arange(int((end - begin) / dt + 1e-6) + 1), end)
    smallest = min(float(s.min()) for clock in own for _, s in _steps(clock.time))
    largest = max(float(s.max()) for clock in own for _, s in _steps(clock.time))
    facts: dict[str, float | str] = {"start": begin, "end": float(time[-1]), "shortest": smallest, "longest": largest}
    if shared:
        facts |= {"variant": "uneven", "off": uneven} if uneven > UNEVEN else {"variant": "changing", "off": off}
    return time, (Diagnostic("time-resampled", INFO, value=1.0 / dt, facts=facts),)


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
