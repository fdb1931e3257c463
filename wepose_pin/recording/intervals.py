"""Times and intervals [s] of a recording: their checks, and how they are written in texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import BadData, BadPhase

Intervals = tuple[tuple[float, float], ...]


def format_time(time: float, decimals: int = 3) -> str:
    """A time [s] as it stands in the file, to the millisecond: on a clock that counts from 1970 as well."""
    return f"{time:.{decimals}f}".rstrip("0").rstrip(".")


def span_text(interval: Sequence[float] | np.ndarray) -> str:
    """From when to when [s], in words."""
    return f"{format_time(interval[0])} to {format_time(interval[1])} s"


def check_time(where: str, time: np.ndarray) -> None:
    """Every time (n,) [s] is finite and later than the one before; `where` begins the error's text."""
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise BadData(f"{where}: time: not a finite number in row {bad[0] + 1}; every row needs its time in seconds")
    back = np.flatnonzero(time[1:] <= time[:-1])
    if back.size:
        k = int(back[0])
        how = "stands still" if time[k + 1] == time[k] else "goes back"
        raise BadData(
            f"{where}: time {how} in row {k + 2}: {format_time(time[k + 1], 6)} s after {format_time(time[k], 6)} s; "
            f"it must grow in every row"
        )


def check_phases(where: str, time: np.ndarray, phases: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Every interval [s] has a length and lies in the recording."""
    for name, intervals in phases.items():
        for first, last in intervals:
            place = f"{where}: phases.{name}: [{format_time(first)}, {format_time(last)}]"
            if not first < last:
                raise BadPhase(f"{place} is empty; the first number is the earlier one, in seconds")
            if first < time[0] - 1e-6 or last > time[-1] + 1e-6:
                raise BadPhase(f"{place} is outside the recording, which runs from {time[0]:.3f} to {time[-1]:.3f} s")
