"""Times and intervals of a recording: their checks, their text, and the selection of one by an option or a phase."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import BadData, BadPhase, WrongOption, one_of

Intervals = tuple[tuple[float, float], ...]
MOST_BEYOND = 5.0  # samples by which an interval may exceed a recording: who states 0 s means its beginning


def format_time(time: float, decimals: int = 3) -> str:
    """Format a time [s] to the millisecond as in the file, also on a clock that starts in 1970."""
    return f"{time:.{decimals}f}".rstrip("0").rstrip(".")


def format_span(interval: Sequence[float] | np.ndarray) -> str:
    """Format an interval [s] as "begin to end s"."""
    return f"{format_time(interval[0])} to {format_time(interval[1])} s"


def check_time(where: str, time: np.ndarray) -> None:
    """Check that times (n,) [s] are finite and increase strictly; `where` begins the error's text."""
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise BadData(f"{where}: time: not a finite number in row {bad[0] + 1}; every row needs its time in seconds")
    back = np.flatnonzero(time[1:] <= time[:-1])
    if back.size:
        k, before, after = back[0], *time[back[0] : back[0] + 2]
        fault, remedy = "goes back", "sort the rows by time, or cut the recording there"
        if before == after:
            fault, remedy = "stands still", "delete one of the two rows, or state rate_hz in place of the times"
        raise BadData(
            f"{where}: time {fault} in row {k + 2}: {format_time(after, 6)} s after {format_time(before, 6)} s; "
            f"it must grow in every row: {remedy}"
        )


def check_phases(where: str, time: np.ndarray, phases: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Check that every interval [s] has a positive length and lies in the recording, to `MOST_BEYOND` samples."""
    for name, intervals in phases.items():
        for first, last in intervals:
            place = f"{where}: phases.{name}: [{format_time(first)}, {format_time(last)}]"
            if not first < last:
                raise BadPhase(f"{place} is empty; the first number is the earlier one, in seconds")
            if _is_beyond(time, first, last):
                raise BadPhase(f"{place} is outside the recording, which runs from {time[0]:.3f} to {time[-1]:.3f} s")


def _is_beyond(time: np.ndarray, first: float, last: float) -> bool:
    slack = MOST_BEYOND * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return bool(first < time[0] - slack or last > time[-1] + slack)


def check_order(interval: tuple[float, float]) -> None:
    """Raise `WrongOption` where an interval [s] does not run forwards."""
    if not interval[0] < interval[1]:
        shown = f"{format_time(interval[0])} {format_time(interval[1])}"
        raise WrongOption("interval", shown, "two times in seconds are needed, the earlier one first")


def select_interval(
    time: np.ndarray,
    phases: Mapping[str, Sequence[tuple[float, float]]],
    interval: tuple[float, float] | None,
    phase: str | None,
) -> tuple[float, float] | None:
    """Return the interval [s] that `interval` or `phase` selects; None: neither is given.

    It may exceed `time` (n,) [s] by `MOST_BEYOND` samples at each end. Of a phase with several intervals ``NAME:2`` is
    the second. `WrongOption`: both are given; the interval is empty or outside the recording; no such phase or number.
    """
    if interval is not None:
        check_order(interval)
        shown = f"{format_time(interval[0])} {format_time(interval[1])}"
        if phase is not None:
            raise WrongOption("interval", shown, f"`phase` {phase} is given too; only one of them can select the time")
        if _is_beyond(time, *interval):
            raise WrongOption("interval", shown, f"the recording runs from {format_span((time[0], time[-1]))}")
    if phase is None:
        return interval
    name, number = phase, 0
    if phase not in phases and (numbered := re.fullmatch(r"(.+):(\d{1,6})", phase)):
        name, number = numbered[1], int(numbered[2])
    intervals = phases.get(name, ())
    if not intervals:
        known = [each for each in phases if phases[each]]
        choices = one_of(known, name) if known else "the recording has no phases; use `interval`"
        raise WrongOption("phase", phase, f"the recording has no such phase; {choices}")
    if number > len(intervals) or (number == 0 and (len(intervals) > 1 or name != phase)):
        spans = ", ".join(f"{name}:{k} ({format_span(span)})" for k, span in enumerate(intervals[:5], 1))
        more = f" … {name}:{len(intervals)}" if len(intervals) > 5 else ""
        count = "one interval" if len(intervals) == 1 else f"{len(intervals)} intervals"
        raise WrongOption("phase", phase, f"{name} has {count}; choose {spans}{more}")
    return intervals[max(number, 1) - 1]


def find_runs(which: np.ndarray) -> list[tuple[int, int]]:
    """Find the runs of true values; returns the first and one past the last index of each."""
    edges = np.flatnonzero(np.diff(which, prepend=False, append=False))
    return [(a, b) for a, b in edges.reshape(-1, 2).tolist()]
