"""Places of a point that another system recorded, in the session's truth file."""

from __future__ import annotations

import numpy as np

from ..data_tables import read_columns, read_table
from ..errors import BadSession
from ..recording import Recording
from .protocols import Closure

LONGEST_STEP = 2.5  # between two rows, in usual steps, over which places are interpolated


def read_recorded_places(recording: Recording, closure: Closure, time: np.ndarray) -> np.ndarray:
    """Return places (n, 3) [m] in W of the closure's point from its origin at `time` (n,) [s]; NaN where it was lost.

    Places are interpolated linearly between two rows of the truth that both have them.

    Raises
    ------
    BadSession
        The session names no truth, or its rows are too few or their times do not increase.
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
    table, file, place = read_table(recording.truth), str(recording.truth), f"{recording.where()}: data.truth"
    known_time = read_columns(table, ["time"], file, place)[:, 0]
    places = read_columns(table, columns, file, place)
    if closure.origin:
        places = places - read_columns(table, [f"{closure.origin}_{axis}" for axis in "xyz"], file, place)
    steps = np.diff(known_time)
    if not len(steps) or not (steps > 0.0).all():
        raise BadSession(
            f"{place}: time of {recording.truth.name} does not increase from row to row; seconds that do "
            f"are needed, two at least"
        )
    row = np.clip(np.searchsorted(known_time, time) - 1, 0, len(steps) - 1)
    lost = steps[row] > LONGEST_STEP * np.median(steps)
    at = [np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in places.T]
    return np.where(lost[:, None], np.nan, np.column_stack(at))
