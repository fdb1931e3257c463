"""A protocol's conditions on a body: what `wepose_pin.observations` observe in each phase."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ..body import BodyModel, BodyTable
from ..body.reaches import UNIVERSE
from ..body.start_pose import StartPose
from ..body.table_file import check_segments
from ..errors import BadOption, BadSession
from ..observations.directions import Level, Pointing
from ..observations.paths import ZERO_LENGTH, PointPath, SegmentVector, find_path
from .protocols import Axis, Closure, Direction, Protocol


@dataclass(frozen=True)
class Loop:
    """A closure of a protocol, resolved on a body.

    Parameters
    ----------
    paths : from the root to a point, or from one point to another where the closure is between two
    unknown : number of its unknown fixed point or plane among those of its kind
    """

    closure: Closure
    paths: tuple[PointPath, ...]
    unknown: int = 0

    @property
    def kind(self) -> str:
        return self.closure.kind

    @property
    def rows(self) -> int:
        """How many residuals a sample has."""
        return self.closure.rows

    @property
    def parts(self) -> tuple[SegmentVector, ...]:
        """Of all paths."""
        return tuple(part for path in self.paths for part in path.vectors)


def choose_variant(closure: Closure, table: BodyTable) -> str:
    """The variant of texts about a closure: its kind, "general" where it is not one of a protocol for hands."""
    of_hands = closure.kind == "recorded" or set(closure.points) <= set(table.paths)
    return closure.kind if of_hands and closure.kind != "fixed_point" and not table.is_mechanism else "general"


@dataclass(frozen=True)
class Moving:
    """Limbs with sensors on these segments move freely: only hinges hold."""

    segments: tuple[str, ...]
    rows: int = 0


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
    for condition in protocol.conditions:
        if isinstance(condition, Closure):
            loop = _resolve_closure(condition, protocol, model, start, sensors)
            unknown = sum(isinstance(other, Loop) and other.kind == loop.kind for other in constraints)
            constraints.append(replace(loop, unknown=unknown))
        elif isinstance(condition, Direction):
            _check_posed((condition.segment, table.reference), protocol, model, sensors)
            constraints.append(
                Pointing(
                    condition.segment,
                    table.reference,
                    start.turn(condition.segment, table.segments[condition.segment].along),
                    start.turn(table.reference, condition.direction),
                    condition.std,
                )
            )
        elif isinstance(condition, Axis):
            _check_posed((condition.segment,), protocol, model, sensors)
            axis = start.turn(condition.segment, (0.0, 1.0, 0.0))
            constraints.append(Level(condition.segment, axis, condition.std))
        else:
            constraints.append(Moving(tuple(segment for segment in table.segments if segment in sensors)))
    return tuple(constraints)


def _check_posed(segments: tuple[str, ...], protocol: Protocol, model: BodyModel, sensors: Collection[str]) -> None:
    """Raise `BadOption` where the body lacks a segment of a pose, `BadSession` where it has no sensor."""
    check_segments(model.table, segments, f"protocol '{protocol.name}': ", BadOption)
    lacking = [segment for segment in segments if segment not in sensors]
    if lacking:
        raise BadSession(
            f"protocol '{protocol.name}': no sensor on {lacking[0]}, which a pose or an axis is about; add it, or "
            f"leave out that condition"
        )


def _resolve_closure(
    closure: Closure, protocol: Protocol, model: BodyModel, start: StartPose, sensors: Collection[str]
) -> Loop:
    loop = Loop(closure, tuple(find_path(model, start, sensors, points) for points in closure.ways))
    between = {part.segment for part in loop.parts}
    if not between - {UNIVERSE}:
        raise BadSession(
            f"protocol '{protocol.name}': no sensor moves {' and '.join(closure.points)}; a point that moves is needed"
        )
    if closure.kind == "coincide" and len(between) == 1:
        raise BadSession(
            f"protocol '{protocol.name}': {' and '.join(closure.points)} both move with the sensor on {between.pop()}, "
            f"so that their distance cannot change; points on two segments with sensors are needed"
        )
    return loop


def find_segments(protocol: Protocol, model: BodyModel) -> frozenset[str]:
    """The segments whose orientation some condition of a protocol uses where all of them have sensors."""
    used = {condition.segment for condition in protocol.conditions if isinstance(condition, Direction | Axis)}
    if protocol.free_motions:
        used |= set(model.table.needed)
    if any(isinstance(condition, Direction) for condition in protocol.conditions):
        used.add(model.table.reference)
    for closure in protocol.closures:
        points = {point for way in closure.ways for point, _ in way}
        for link in {link for point in points for link in model.reaches.get(point, {})}:
            used |= {link} & set(model.table.segments)
    return frozenset(used & set(model.table.segments))


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
