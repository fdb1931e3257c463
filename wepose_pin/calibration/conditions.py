"""A protocol's conditions on a body: which vectors, fixed to segments with sensors, make up each closure.

A point is the sum of the vectors of the links between it and the root (`wepose_pin.body.reaches`). Each link rotates
with a segment that has a sensor, its own or the one above it with which it is rigid. As in `wepose_pin.alignment`, L'
is the frame of such a segment that equals W in the start pose: of a person in the N-pose the segment's own frame L.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..body import BodyModel, BodyTable, Girdle
from ..body.girdle import find_girdle_scale
from ..body.links import find_carrier
from ..body.reaches import UNIVERSE
from ..body.table_file import check_segments
from ..errors import BadOption, BadSession
from .protocols import Axis, Closure, Direction, Protocol

Vector = tuple[float, float, float]
ZERO_LENGTH = 1e-12  # [m] below which a vector is zero; its derivatives by the lengths alike


class Part(NamedTuple):
    """One segment's part of the way between points: the vector ``by_length @ lengths + constant`` [m] in L'."""

    sensor: str  # of the segment, named by it; `UNIVERSE`: the vector does not rotate
    by_length: tuple[Vector | tuple[float, ...], ...]  # (3, k), lengths in the order of the table
    constant: Vector

    def vector(self, lengths: np.ndarray) -> np.ndarray:
        """(3,) [m] for lengths (k,) [m]."""
        return np.array(self.by_length) @ lengths + np.array(self.constant)


@dataclass(frozen=True)
class Loop:
    """A closure of a protocol, resolved on a body.

    Parameters
    ----------
    ways : parts from the root to a point, or from one point to another where the closure is between two
    girdles : of each way, the girdles that move its points, each with the sign of its displacement
    unknown : number of its unknown fixed point or plane among those of its kind
    """

    closure: Closure
    ways: tuple[tuple[Part, ...], ...]
    girdles: tuple[tuple[tuple[str, float], ...], ...] = ()
    unknown: int = 0

    @property
    def kind(self) -> str:
        return self.closure.kind

    @property
    def rows(self) -> int:
        """How many residuals a sample has."""
        return self.closure.rows

    @property
    def parts(self) -> tuple[Part, ...]:
        """Of all ways."""
        return tuple(part for way in self.ways for part in way)


def choose_variant(closure: Closure, table: BodyTable) -> str:
    """The variant of texts about a closure: its kind, "general" where it is not one of a protocol for hands."""
    of_hands = closure.kind == "recorded" or set(closure.points) <= set(table.paths)
    return closure.kind if of_hands and closure.kind != "fixed_point" and not table.is_mechanism else "general"


@dataclass(frozen=True)
class Pointing:
    """The long axis `along` (3,) of a segment points along `direction` (3,) of another; to within `std` [rad]."""

    segment: str
    reference: str
    along: Vector
    direction: Vector
    std: float
    rows: int = 3


@dataclass(frozen=True)
class Level:
    """The segment bends about `axis` (3,), level in the start pose; people bend about one within `std` [rad] of it."""

    segment: str
    axis: Vector
    std: float
    rows: int = 1


@dataclass(frozen=True)
class Moving:
    """Limbs with sensors on these segments move freely: only hinges hold."""

    segments: tuple[str, ...]
    rows: int = 0


Constraint = Loop | Pointing | Level | Moving


class HingeUnknown(NamedTuple):
    """A hinge whose axis ``axis + x across + z tilted`` is estimated by x and z; vectors (3,) in L' of `on`.

    Parameters
    ----------
    on, moves : the segments above and below, both with a sensor
    along : the long axis of `moves`, in its own L'
    side : the direction to which it bends
    """

    name: str
    on: str
    moves: str
    axis: Vector
    across: Vector
    tilted: Vector
    along: Vector
    side: Vector


class GirdleTerm(NamedTuple):
    """A girdle with sensors on both its segments.

    Parameters
    ----------
    along : (3,) of the limb, in L' of `law.moves`
    R_on : (3, 3), row by row: maps the frame L of `law.on` to its L'
    scale : of the law
    """

    name: str
    law: Girdle
    along: Vector
    R_on: tuple[float, ...]
    scale: float


@dataclass(frozen=True)
class StartPose:
    """The orientation of the links of a body in the start pose, link → R_WK (3, 3)."""

    R_WK: Mapping[str, np.ndarray]

    def turn(self, link: str, vector: Collection[float]) -> Vector:
        """A vector (3,) of a link's frame, in L'."""
        R = self.R_WK.get(link)
        x, y, z = vector if R is None else R @ np.array(vector)
        return float(x), float(y), float(z)


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
    ways = tuple(find_parts(model, start, sensors, points) for points in closure.ways)
    if not any(part.sensor != UNIVERSE for way in ways for part in way):
        raise BadSession(
            f"protocol '{protocol.name}': no sensor moves {' and '.join(closure.points)}; a point that moves is needed"
        )
    between = {part.sensor for way in ways for part in way}
    if closure.kind == "coincide" and len(between) == 1:
        raise BadSession(
            f"protocol '{protocol.name}': {' and '.join(closure.points)} both move with the sensor on {between.pop()}, "
            f"so that their distance cannot change; points on two segments with sensors are needed"
        )
    return Loop(closure, ways, tuple(find_girdle_signs(model, points) for points in closure.ways))


def find_girdle_signs(model: BodyModel, points: Collection[tuple[str, float]]) -> tuple[tuple[str, float], ...]:
    """The girdles that move a signed sum of points, each with the sign of its displacement."""
    signs: dict[str, float] = {}
    for point, sign in points:
        for name in model.point_girdles[point]:
            signs[name] = signs.get(name, 0.0) + sign
    return tuple((name, sign) for name, sign in signs.items() if sign)


def find_parts(
    model: BodyModel, start: StartPose, sensors: Collection[str], points: Collection[tuple[str, float]]
) -> tuple[Part, ...]:
    """The parts of a signed sum of points, by sensors in the order of the table.

    Raises
    ------
    BadSession
        A link on the way has no sensor, and is not rigid with one that has.
    """
    lengths = len(model.lengths)
    sums: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    links: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for point, sign in points:
        for link, (by_length, constant) in model.reaches[point].items():
            B, c = links.get(link, (np.zeros((3, lengths)), np.zeros(3)))
            links[link] = B + sign * by_length, c + sign * constant
    for link, (by_length, constant) in links.items():
        if not (np.any(np.abs(by_length) > ZERO_LENGTH) or np.any(np.abs(constant) > ZERO_LENGTH)):
            continue
        carrier = UNIVERSE if link == UNIVERSE else find_carrier(model, link, sensors)
        if carrier is None:
            names = " and ".join(point for point, _ in points)
            if link not in model.table.segments:
                raise BadSession(
                    f"no segment of {model.table.name} moves with '{link}', so that the place of {names} is not known; "
                    f"add its link to [segments], with a sensor, or use a protocol without that point"
                )
            raise BadSession(
                f"sensors.{link} is missing: without it the place of {names} is not known; add it, or use a protocol "
                f"without that point"
            )
        R = start.R_WK.get(link, np.eye(3))
        B, c = sums.get(carrier, (np.zeros((3, lengths)), np.zeros(3)))
        sums[carrier] = B + R @ by_length, c + R @ constant
    order = [UNIVERSE, *model.table.segments]
    parts = []
    for carrier in sorted(sums, key=order.index):
        B, c = sums[carrier]
        if np.any(np.abs(B) > ZERO_LENGTH) or np.any(np.abs(c) > ZERO_LENGTH):
            x, y, z = (float(v) for v in c)
            parts.append(Part(carrier, tuple(tuple(row) for row in B.tolist()), (x, y, z)))
    return tuple(parts)


def find_hinges(model: BodyModel, start: StartPose, sensors: Collection[str]) -> tuple[HingeUnknown, ...]:
    """The hinges of the body whose two segments both have sensors."""
    hinges = []
    for name, hinge in model.table.hinges.items():
        if {hinge.on, hinge.moves} <= set(sensors):
            along_on = np.array(model.table.segments[hinge.on].along)
            hinges.append(
                HingeUnknown(
                    name,
                    hinge.on,
                    hinge.moves,
                    start.turn(hinge.on, hinge.axis),
                    start.turn(hinge.on, np.cross(along_on, hinge.axis)),
                    start.turn(hinge.on, -along_on),
                    start.turn(hinge.moves, model.table.segments[hinge.moves].along),
                    start.turn(hinge.on, np.sign(sum(hinge.range)) * np.cross(hinge.axis, along_on)),
                )
            )
    return tuple(hinges)


def find_girdles(model: BodyModel, start: StartPose, sensors: Collection[str]) -> tuple[GirdleTerm, ...]:
    """The girdles of the body whose two segments both have sensors."""
    terms = []
    for name, girdle in model.table.girdles.items():
        if {girdle.on, girdle.moves} <= set(sensors):
            along = start.turn(girdle.moves, model.table.segments[girdle.moves].along)
            R_on = tuple(float(v) for v in start.R_WK[girdle.on].ravel())
            terms.append(GirdleTerm(name, girdle, along, R_on, find_girdle_scale(girdle, model.lengths)))
    return tuple(terms)


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
            groups.setdefault(part.sensor, {}).update(dict.fromkeys(names))
    return {sensor: tuple(names) for sensor, names in groups.items() if names}
