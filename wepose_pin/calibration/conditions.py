"""A protocol's conditions on a body: what `wepose_pin.observations` observe in each phase."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..body import BodyModel
from ..body.lengths import UNIVERSE
from ..body.mounts import StartPose
from ..body.table import Vector
from ..errors import BadSession
from ..observations.paths import PointPath, SegmentVector, find_path
from ..observations.symbols import rotate, rotate_back
from ..recording import Recording
from .protocols import Closure, Direction, FreeMotion, Protocol


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
