"""A protocol's conditions on a body, and the samples at which a recording observes them.

Samples are used that all sensors measured, and that are connected with the start pose: after lost samples a filter
recovers the tilt from gravity, but never the heading.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from ..body import BodyModel
from ..body.mounts import StartPose
from ..data_tables import read_columns, read_table
from ..errors import BadSession
from ..observations.expressions import PointPath
from ..recording import Recording
from ..recording.gaps import find_runs
from .protocols import Closure, Condition, Direction, FreeMotion, Protocol

LONGEST_LOSS_S = 0.1  # [s] over which the rate of an arm is interpolated to some degrees


def resolve_conditions(
    protocol: Protocol, model: BodyModel, start: StartPose, recording: Recording
) -> tuple[tuple[Condition, ...], dict[Closure, tuple[PointPath, ...]]]:
    """Return the protocol's conditions on this body, their vectors in L', and the paths of each closure.

    It raises `BadSession` for a closure between points that no sensor determines, or a pose without its sensor.
    """
    table, sensors, conditions = model.table, recording.sensors, list[Condition]()
    paths: dict[Closure, tuple[PointPath, ...]] = {}
    where = f"{recording.where()}: protocol '{protocol.name}': "
    for condition in protocol.conditions:
        if isinstance(condition, Closure):
            own = tuple(PointPath(model, start, tuple(sensors), points, where) for points in condition.ways)
            between = {segment for path in own for segment in path.segments}
            if len(between) < (2 if condition.kind == "coincide" else 1):
                moves = f"only the sensor on {', '.join(between)} moves" if between else "no sensor moves"
                points = " and ".join(condition.points)
                raise BadSession(f"{where}{moves} {points}; points that move against each other are needed")
            paths[condition] = own
        elif not isinstance(condition, FreeMotion):
            segment = condition.segment
            for each in (segment, table.reference) if isinstance(condition, Direction) else (segment,):
                if each not in sensors:
                    raise BadSession(f"{where}no sensor on {each}, which a pose or an axis is about")
            if isinstance(condition, Direction):
                condition = condition._replace(
                    direction=start.turn(table.reference, condition.direction),
                    reference=table.reference,
                    along=start.turn(segment, table.segments[segment].along),
                )
            else:
                condition = condition._replace(axis=start.turn(segment, condition.axis))
        conditions.append(condition)
    return tuple(conditions), paths


# Samples --------------------------------------------------------------------------------------------------------------


def find_samples(recording: Recording, intervals: Iterable[tuple[float, float]]) -> np.ndarray:
    """Return the numbers (n,) of the samples in intervals [s], which may overlap: each sample counts once."""
    inside = np.zeros(len(recording), dtype=bool)
    for interval in intervals:
        inside[recording.span(interval)] = True
    return np.flatnonzero(inside)


def find_connected(
    recording: Recording, start: tuple[float, float], sensors: Collection[str]
) -> tuple[np.ndarray, str, tuple[float, float]]:
    """Find the samples (n,) bool between which and the start pose [s] no sensor lost more than `LONGEST_LOSS_S`.

    Return also the sensor whose loss ends them, else the one after whose loss they begin, and that loss [s]; empty:
    nothing was lost.
    """
    n, begin, longest = len(recording), recording.span(start).start, LONGEST_LOSS_S * recording.rate_hz
    gaps = {name: recording.imus[name].gap for name in sensors if name in recording.imus}
    runs = [(a, b, name) for name, gap in gaps.items() if gap is not None for a, b in find_runs(gap)]
    losses = [(a, b, name) for a, b, name in runs if b - a > longest]
    before = max((loss for loss in losses if loss[0] < begin), key=lambda loss: loss[1], default=(0, 0, ""))
    after = min((loss for loss in losses if loss[0] >= begin), default=(n, n, ""))
    a, b, lost = after if after[2] else before
    interval = (float(recording.time[a]), float(recording.time[b - 1])) if lost else (np.nan, np.nan)
    samples = np.arange(n)
    return (samples >= before[1]) & (samples < after[0]), lost, interval


def mask_measured(recording: Recording, sensors: Collection[str], samples: np.ndarray) -> np.ndarray:
    """Return (n,) bool: all of these sensors measured these samples (n,)."""
    gaps = [gap[samples] for name in sensors if (gap := recording.sensors[name].gap) is not None]
    return ~np.any([np.zeros(len(samples), dtype=bool), *gaps], axis=0)


def read_recorded_places(recording: Recording, closure: Closure, time: np.ndarray) -> np.ndarray:
    """Return places (n, 3) [m] in W of the closure's point from its origin at `time` (n,) [s]; NaN where it was lost.

    Places are interpolated linearly between two rows of the session's truth file that both have them. It raises where
    there is no such file, or its columns and times are not as they should be.
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
