"""Times and intervals [s] of a recording: checks and format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import BadData, BadPhase

Intervals = tuple[tuple[float, float], ...]


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
        k = int(back[0])
        fault = "stands still" if time[k + 1] == time[k] else "goes back"
        raise BadData(
            f"{where}: time {fault} in row {k + 2}: {format_time(time[k + 1], 6)} s after {format_time(time[k], 6)} s; "
            f"it must grow in every row"
        )


def check_phases(where: str, time: np.ndarray, phases: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Check that every interval [s] has a positive length and lies in the recording."""
    for name, intervals in phases.items():
        for first, last in intervals:
            place = f"{where}: phases.{name}: [{format_time(first)}, {format_time(last)}]"
            if not first < last:
                raise BadPhase(f"{place} is empty; the first number is the earlier one, in seconds")
            if first < time[0] - 1e-6 or last > time[-1] + 1e-6:
                raise BadPhase(f"{place} is outside the recording, which runs from {time[0]:.3f} to {time[-1]:.3f} s")
