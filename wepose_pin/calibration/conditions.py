"""A protocol's conditions on a body: what `wepose_pin.observations` observe in each phase."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ..body import BodyModel
from ..body.lengths import UNIVERSE
from ..body.start_pose import StartPose
from ..body.table_file import check_segments
from ..errors import BadOption, BadSession
from ..observations.directions import Level, Pointing
from ..observations.paths import ZERO_LENGTH, PointPath, SegmentVector, find_path
from .protocols import Axis, Closure, Direction, Protocol


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
class Moving:
    """Limbs with sensors on these segments move freely: only hinges hold."""

    segments: tuple[str, ...]


Constraint = Loop | Pointing | Level | Moving


def resolve_conditions(
    protocol: Protocol, model: BodyModel, start: StartPose, sensors: Collection[str]
) -> tuple[Constraint, ...]:
    """The protocol's conditions on this body with these sensors.

    Raises
    ------
    BadOption
        A point or segment that the body does not have.
    BadSession
        A closure between points that no sensor determines, or a pose of a segment without a sensor.
    """
    table, constraints = model.table, list[Constraint]()
    where = f"protocol '{protocol.name}': "
    for condition in protocol.conditions:
        if isinstance(condition, Direction | Axis):
            posed = (condition.segment, table.reference) if isinstance(condition, Direction) else (condition.segment,)
            check_segments(table, posed, where, BadOption)
            for segment in posed:
                if segment not in sensors:
                    raise BadSession(
                        f"{where}no sensor on {segment}, which a pose or an axis is about; add it, or leave out that "
                        f"condition"
                    )
        if isinstance(condition, Closure):
            paths = tuple(find_path(model, start, sensors, points) for points in condition.ways)
            between = {part.segment for path in paths for part in path.vectors} - {UNIVERSE}
            if len(between) < (2 if condition.kind == "coincide" else 1):
                points = " and ".join(condition.points)
                moves = f"{points} both move with the sensor on {', '.join(between)}"
                raise BadSession(
                    f"{where}{moves if between else f'no sensor moves {points}'}; points that move against each other "
                    f"are needed"
                )
            unknown = sum(isinstance(other, Loop) and other.kind == condition.kind for other in constraints)
            constraints.append(Loop(condition, paths, unknown))
        elif isinstance(condition, Direction):
            along = start.turn(condition.segment, table.segments[condition.segment].along)
            direction = start.turn(table.reference, condition.direction)
            constraints.append(Pointing(condition.segment, table.reference, along, direction, condition.std))
        elif isinstance(condition, Axis):
            axis = start.turn(condition.segment, (0.0, 1.0, 0.0))
            constraints.append(Level(condition.segment, axis, condition.std))
        else:
            constraints.append(Moving(tuple(segment for segment in table.segments if segment in sensors)))
    return tuple(constraints)


def is_scale_observed(constraints: Collection[Constraint]) -> bool:
    """Whether the closures determine the scale: by a recorded or known place, or by a link of known size."""
    loops = [constraint for constraint in constraints if isinstance(constraint, Loop)]
    return any(
        loop.kind == "recorded" or loop.closure.at is not None or any(np.any(part.constant) for part in loop.parts)
        for loop in loops
    )


def group_lengths(constraints: Collection[Constraint], lengths: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Sensor → the lengths that rotate with it in some closure, which observes the sum of those in one direction."""
    groups: dict[str, dict[str, None]] = {}
    for loop in constraints:
        for part in loop.parts if isinstance(loop, Loop) else ():
            moved = np.abs(np.array(part.by_length)).max(axis=0) > ZERO_LENGTH
            names = [name for name, moves in zip(lengths, moved, strict=True) if moves]
            groups.setdefault(part.segment, {}).update(dict.fromkeys(names))
    return {sensor: tuple(names) for sensor, names in groups.items() if names}
