"""A protocol's conditions on a body, and the samples at which a recording observes them.

Samples are used that all sensors measured, and that are connected with the start pose: after lost samples a filter
recovers the tilt from gravity, but never the heading.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..body import BodyModel
from ..body.lengths import UNIVERSE
from ..body.mounts import StartPose
from ..body.table import Vector
from ..data_tables import read_columns, read_table
from ..errors import BadSession
from ..observations.expressions import PointPath, SegmentVector, find_path, rotate, rotate_back
from ..recording import Recording
from ..recording.gaps import find_runs
from .protocols import Closure, Direction, FreeMotion, Protocol

LONGEST_LOSS_S = 0.1  # [s] over which the rate of an arm is interpolated to some degrees


@dataclass(frozen=True)
class Loop:
    """A closure of a protocol, resolved on a body."""

    closure: Closure
    # from the root to a point, or from one point to another where the closure is between two
    paths: tuple[PointPath, ...]
    unknown: int = 0  # number of its unknown fixed point or plane among those of its kind

    @property
    def kind(self) -> str:
        return self.closure.kind

    @property
    def parts(self) -> tuple[SegmentVector, ...]:
        """Of all paths."""
        return tuple(part for path in self.paths for part in path.vectors)


@dataclass(frozen=True)
class Pointing:
    """The long axis `along` (3,) of a segment points along `direction` (3,) of another; to within `std` [rad]."""

    segment: str
    reference: str
    along: Vector
    direction: Vector
    std: float

    def residual(self, quat_WL: Mapping[str, ca.SX]) -> ca.SX:
        """Return by how much the segment is off its direction (3,), in units of `std`."""
        along_W = rotate(quat_WL[self.segment], self.along)
        return (rotate_back(quat_WL[self.reference], along_W) - ca.DM(self.direction)) / self.std


@dataclass(frozen=True)
class Level:
    """The segment bends about `axis` (3,), level in the start pose; people bend about one within `std` [rad] of it."""

    segment: str
    axis: Vector
    std: float

    def residual(self, quat_WL: Mapping[str, ca.SX], start: ca.SX) -> ca.SX:
        """Return how far the axis has risen since `start` (4,), its `quat_WL` before it bent, in units of `std`."""
        return (rotate(quat_WL[self.segment], self.axis) - rotate(start, self.axis))[2] / self.std


Constraint = Loop | Pointing | Level | FreeMotion  # while limbs move freely only hinges hold


def resolve_conditions(
    protocol: Protocol, model: BodyModel, start: StartPose, recording: Recording
) -> tuple[Constraint, ...]:
    """The protocol's conditions on this body with the recording's sensors; raise as `CalibrationProblem.conditions`."""
    table, sensors, constraints = model.table, recording.sensors, list[Constraint]()
    where = f"{recording.where()}: protocol '{protocol.name}': "
    for condition in protocol.conditions:
        if isinstance(condition, Closure):
            paths = tuple(find_path(model, start, sensors, points, where) for points in condition.ways)
            between = {part.segment for path in paths for part in path.vectors} - {UNIVERSE}
            if len(between) < (2 if condition.kind == "coincide" else 1):
                moves = f"only the sensor on {', '.join(between)} moves" if between else "no sensor moves"
                points = " and ".join(condition.points)
                raise BadSession(f"{where}{moves} {points}; points that move against each other are needed")
            unknown = sum(isinstance(other, Loop) and other.kind == condition.kind for other in constraints)
            constraints.append(Loop(condition, paths, unknown))
        elif isinstance(condition, FreeMotion):
            constraints.append(condition)
        else:
            segment = condition.segment
            for each in (segment, table.reference) if isinstance(condition, Direction) else (segment,):
                if each not in sensors:
                    raise BadSession(f"{where}no sensor on {each}, which a pose or an axis is about")
            if isinstance(condition, Direction):
                along = start.turn(segment, table.segments[segment].along)
                direction = start.turn(table.reference, condition.direction)
                constraints.append(Pointing(segment, table.reference, along, direction, condition.std))
            else:
                constraints.append(Level(segment, start.turn(segment, (0.0, 1.0, 0.0)), condition.std))
    return tuple(constraints)


def is_scale_observed(constraints: Collection[Constraint]) -> bool:
    """Whether the closures determine the scale: by a recorded or known place, or by a link of known size."""
    return any(
        loop.kind == "recorded" or loop.closure.at is not None or any(np.any(part.constant) for part in loop.parts)
        for loop in constraints
        if isinstance(loop, Loop)
    )


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
