"""The samples of a recording that a calibration may use: measured by all sensors, and connected with the start pose.

After lost samples a filter recovers the tilt from gravity, but never the heading. So what lies beyond a loss, seen from
the start pose, is not used.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from ..data_tables import read_columns, read_table
from ..errors import BadSession
from ..recording import OrientationSensor, Recording
from ..recording.gaps import find_runs
from .protocols import Closure

LONGEST_LOSS_S = 0.1  # [s] over which the rate of an arm is interpolated to some degrees


def find_samples(recording: Recording, intervals: Iterable[tuple[float, float]]) -> np.ndarray:
    """Return the numbers (n,) of the samples in intervals [s], which may overlap: each sample counts once."""
    inside = np.zeros(len(recording), dtype=bool)
    for interval in intervals:
        inside[recording.span(interval)] = True
    return np.flatnonzero(inside)


def find_connected(
    recording: Recording, start: tuple[float, float], sensors: Collection[str]
) -> tuple[np.ndarray, str, tuple[float, float]]:
    """Find the samples between which and the start pose [s] none of these sensors lost more than `LONGEST_LOSS_S`.

    Returns
    -------
    connected : (n,) bool
    lost : the sensor whose loss ends them, else the one whose loss they begin with; empty: none was lost
    loss : [s] of that loss
    """
    begin = recording.span(start).start
    first, end, lost, loss = 0, len(recording), "", (np.nan, np.nan)
    for name in sensors:
        gap = recording.sensors[name].gap
        if gap is None or isinstance(recording.sensors[name], OrientationSensor):
            continue
        for a, b in find_runs(gap):
            if b - a <= LONGEST_LOSS_S * recording.rate_hz:
                continue
            span = float(recording.time[a]), float(recording.time[b - 1])
            if begin <= a < end:
                end, lost, loss = a, name, span
            elif a < begin and b > first:
                first = b
                if end == len(recording):
                    lost, loss = name, span
    samples = np.arange(len(recording))
    return (samples >= first) & (samples < end), lost, loss


def mask_measured(recording: Recording, sensors: Collection[str], samples: np.ndarray) -> np.ndarray:
    """Return (n,) bool: all of these sensors measured these samples (n,)."""
    gaps = [gap[samples] for name in sensors if (gap := recording.sensors[name].gap) is not None]
    return ~np.any([np.zeros(len(samples), dtype=bool), *gaps], axis=0)


def read_recorded_places(recording: Recording, closure: Closure, time: np.ndarray) -> np.ndarray:
    """Return places (n, 3) [m] in W of the closure's point from its origin at `time` (n,) [s]; NaN where it was lost.

    Places are interpolated linearly between two rows of the session's truth file that both have them.

    Raises
    ------
    BadSession
        The session names no truth, or its times do not increase.
    MissingFile, UnknownColumn, BadData
        The file is not there, or lacks a column, or holds something else than numbers.
    """
    [point] = closure.points
    columns = [f"{point}_{axis}" for axis in "xyz"]
    if recording.truth is None:
        raise BadSession(
            f"{recording.where()}: data.truth is missing; this protocol takes the place of {point} from it, a table "
            f"with the columns time, {', '.join(columns)}"
        )
    table, file, where = read_table(recording.truth), str(recording.truth), f"{recording.where()}: data.truth"
    known_time = read_columns(table, ["time"], file, where)[:, 0]
    places = read_columns(table, columns, file, where)
    if closure.origin:
        places = places - read_columns(table, [f"{closure.origin}_{axis}" for axis in "xyz"], file, where)
    if not (np.diff(known_time) > 0.0).all():
        raise BadSession(f"{where}: time of {recording.truth.name} does not increase from row to row")
    return np.column_stack([np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in places.T])
