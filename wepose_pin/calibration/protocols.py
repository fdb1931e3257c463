"""Protocols as data: what a person does in which phase, and the conditions that hold for the body meanwhile.

A ``calibration/<name>.toml`` lists steps for the person and conditions for the solver. Points, segments and lengths are
those of the body's table (`wepose_pin.body.BodyTable`). There are four kinds of conditions:

- ``[[closure]]``: two points coincide (``kind = "coincide"``), one stays at a point of W (``"fixed_point"``), unknown
  or stated by ``at``, points move on a level plane of unknown height (``"plane"``), or a point is where the session's
  truth recorded it (``"recorded"``). All of them show lengths and headings by motion.
- ``[[motion]]``: limbs move freely. Hinges show headings and mounts, accelerations that two sensors share at a joint
  show headings; nothing shows lengths.
- ``[[pose]]``: segments point in given directions of the body's first segment; `std_deg` is how well a person does it.
- ``[[axis]]``: a segment bends forwards about its own y, as the torso in a bow; `std_deg` is how far people are off.

The residual of a pose does not show how exactly it was taken, so its weight is stated; that of a closure is measured.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from ..body import BodyModel, BodyTable
from ..body.mounts import PALM_SLIP_STD, StartPose
from ..body.table import ZERO, Vector, check_segments
from ..documents import Key, TomlTable, is_number, read_record, read_toml
from ..errors import BadOption, BadSession, one_of
from ..libraries import asset
from ..observations import PointPath
from ..recording import Recording

PROTOCOLS = ("bow", "clasp", "free", "t_pose", "table", "tip")
DEFAULT = "clasp"
GUIDED, BOW = "clasp+t_pose", "bow"  # the best of docs/validation.md in a minute; for whom hands alone are not enough
ALSO = ("t_pose", BOW)  # what makes it better within the same minute, by phases of their names
# How many points each kind takes, and the kinds of the keys that not all of them have.
KINDS = {"coincide": (2,), "fixed_point": (1,), "plane": (1, 2, 3), "recorded": (1,)}
_KINDS_OF_KEYS = {"at": ("fixed_point",), "at_std": ("fixed_point",), "origin": ("fixed_point", "recorded")}
PoseStd = Annotated[float, Key("std_deg", "deg", 0.1, 45.0)]


class Closure(NamedTuple):
    """Points that stay together, at a point of W, on a level plane, or where they were recorded.

    `slip` [m] is one standard deviation, each axis, of what holds only nearly; it sets the weights' shape, not size.
    `at` (3,) [m] is a fixed point of W, where it is known. A recorded place or a fixed point is counted from `origin`;
    empty: from the root.
    """

    phase: str  # of the session in which it holds
    kind: Annotated[str, Key(of="kinds")]
    points: tuple[str, ...]
    slip: Annotated[float, Key("slip", "m", 1e-4, 0.1)] = PALM_SLIP_STD
    at: Annotated[tuple[float, float, float] | None, Key("at", "m", -100.0, 100.0)] = None
    at_std: Annotated[float, Key("at_std", "m", 1e-5, 1.0)] = 0.005
    origin: str = ""

    @property
    def rows(self) -> int:
        """How many residuals a sample has."""
        return len(self.points) if self.kind == "plane" else 3

    @property
    def ways(self) -> tuple[tuple[tuple[str, float], ...], ...]:
        """Each way that it closes, as a signed sum of points."""
        other = self.points[1] if self.kind == "coincide" else self.origin
        return (((self.points[0], 1.0), (other, -1.0)),) if other else tuple(((point, 1.0),) for point in self.points)


class Direction(NamedTuple):
    """A segment's long axis points along a direction of another, to within `std` [rad]; unit vectors (3,).

    Vectors are in the segments' frames L; of a body's conditions in L'.
    """

    phase: str
    std: PoseStd
    segment: Annotated[str, None] = ""
    direction: Annotated[Vector, None] = ZERO
    reference: Annotated[str, None] = ""  # segment of `direction`; that of the body which faces x
    along: Annotated[Vector, None] = (0.0, 0.0, -1.0)  # the long axis


class Axis(NamedTuple):
    """The segment bends forwards about `axis` (3,), which is level in the start pose, to within `std` [rad]."""

    phase: str
    segment: str
    std: PoseStd
    axis: Annotated[Vector, None] = (0.0, 1.0, 0.0)  # in L; of a body's conditions in L'


class FreeMotion(NamedTuple):
    """Limbs move freely."""

    phase: str  # of the session; empty: from the start pose on


Condition = Closure | Direction | Axis | FreeMotion


class Step(NamedTuple):
    """What the person does, for how long [s]."""

    phase: str
    seconds: Annotated[float, Key("seconds", "s", 0.0, 3600.0)]
    do: str


@dataclass(frozen=True)
class Protocol:
    """A calibration session as data."""

    name: str  # of the protocol, and of its file
    title: str  # in a few words, for the subject's note
    needs: tuple[str, ...]  # segments that must carry a sensor
    steps: Annotated[tuple[Step, ...], None]  # for the person
    conditions: Annotated[tuple[Condition, ...], None]  # for the solver

    @property
    def closures(self) -> tuple[Closure, ...]:
        return tuple(c for c in self.conditions if isinstance(c, Closure))

    def check_body(self, table: BodyTable) -> None:
        """Raise `BadOption` where the body lacks a point or a segment of the protocol."""
        where = f"protocol '{self.name}': "
        for closure in self.closures:
            for point in (*closure.points, *filter(None, [closure.origin])):
                if point not in table.points:
                    raise BadOption(f"{where}'{point}' is no point of {table.name}; {one_of(table.points, point)}")
        named = [c.segment for c in self.conditions if isinstance(c, Direction | Axis)]
        check_segments(table, (*named, *self.needs), where, BadOption)

    def resolve(
        self, model: BodyModel, start: StartPose, recording: Recording
    ) -> tuple[tuple[Condition, ...], dict[Closure, tuple[PointPath, ...]]]:
        """Return the conditions on this body, their vectors in L', and the paths of each closure.

        It raises `BadSession` for a closure between points that no sensor determines, or a pose without its sensor.
        """
        table, sensors, conditions = model.table, recording.sensors, list[Condition]()
        paths: dict[Closure, tuple[PointPath, ...]] = {}
        where = f"{recording.where()}: protocol '{self.name}': "
        for condition in self.conditions:
            if isinstance(condition, Closure):
                own = tuple(PointPath(model, start, tuple(sensors), points, where) for points in condition.ways)
                between = {segment for path in own for segment in path.segments}
                if len(between) < (2 if condition.kind == "coincide" else 1):
                    moves = f"only the sensor on {', '.join(between)} moves" if between else "no sensor moves"
                    points = " and ".join(condition.points)
                    raise BadSession(f"{where}{moves} {points}; points that move against each other are needed")
                paths[condition] = own
            elif isinstance(condition, FreeMotion):
                hinges = [f"{hinge.on} and {hinge.moves}" for hinge in table.hinges.values()]
                if hinges and not any({hinge.on, hinge.moves} <= sensors.keys() for hinge in table.hinges.values()):
                    raise BadSession(f"{where}free motion needs sensors on {', or on '.join(hinges)}")
            else:
                segment, reference = condition.segment, table.reference
                for each in (segment, reference) if isinstance(condition, Direction) else (segment,):
                    if each not in sensors:
                        raise BadSession(f"{where}no sensor on {each}, which a pose or an axis is about")
                if isinstance(condition, Direction):
                    direction = start.turn(reference, condition.direction)
                    along = start.turn(segment, table.segments[segment].along)
                    condition = condition._replace(direction=direction, reference=reference, along=along)
                else:
                    condition = condition._replace(axis=start.turn(segment, condition.axis))
            conditions.append(condition)
        return tuple(conditions), paths


def choose_protocol(phases: Collection[str], formulation: str = "full") -> str:
    """The protocol where none is named: `DEFAULT`, with those of `ALSO` that are phases; the paper takes no poses."""
    return "+".join([DEFAULT, *(name for name in ALSO if name in phases and formulation == "full")])


def load_protocol(name: str | Path) -> Protocol:
    """A protocol by its name, from a TOML file of one's own, or one after another joined by "+", as ``clasp+t_pose``.

    It raises `BadOption` where there is no such protocol, or its file has a key or value that is none.
    """
    names = split_protocol(name)
    if len(names) > 1:  # one after another; the start pose is held once
        parts = [load_protocol(each) for each in names]
        steps = [parts[0].steps, *([step for step in each.steps if step.phase != "start"] for each in parts[1:])]
        return Protocol(
            str(name),
            ", ".join(each.title for each in parts),
            tuple(dict.fromkeys(segment for each in parts for segment in each.needs)),
            tuple(step for each in steps for step in each),
            tuple(condition for each in parts for condition in each.conditions),
        )
    if str(name).endswith(".toml"):
        return _read_protocol(Path(name))
    if name not in PROTOCOLS:
        raise BadOption(
            f"protocol '{name}' is not known; {one_of(PROTOCOLS, str(name))}; or the path of a .toml of one's own"
        )
    return _read_protocol(asset("calibration", f"{name}.toml"))


def _read_protocol(path: Path) -> Protocol:
    top = TomlTable(read_toml(path, "a protocol", BadOption), str(path), error=BadOption)
    lists = ("step", "closure", "pose", "axis", "motion")
    protocol = read_record(Protocol, top, base=Protocol(path.stem, "", (), (), ()), others=lists)
    conditions: list[Condition] = [_read_closure(entry) for entry in top.entries("closure")]
    for entry in top.entries("pose"):
        pose, directions = read_record(Direction, entry, others=("directions",)), entry.table("directions")
        for segment, value in directions.values.items():
            numbers = isinstance(value, list) and len(value) == 3 and all(is_number(v, 1e6) for v in value)
            length = float(np.linalg.norm(value)) if numbers else 0.0
            if not length > 1e-6:
                raise BadOption(f"{directions.at(segment)} = {value}; three numbers are needed: x, y, z")
            x, y, z = (float(v) / length for v in value)
            conditions.append(pose._replace(segment=segment, direction=(x, y, z)))
    conditions += [read_record(Axis, entry) for entry in top.entries("axis")]
    conditions += [read_record(FreeMotion, entry, base=FreeMotion("")) for entry in top.entries("motion")]
    if not conditions:
        raise BadOption(f"{path}: no [[closure]], [[pose]], [[axis]] or [[motion]]; a protocol needs one at least")
    steps = tuple(read_record(Step, entry) for entry in top.entries("step"))
    return replace(protocol, title=protocol.title or protocol.name, steps=steps, conditions=tuple(conditions))


def _read_closure(entry: TomlTable) -> Closure:
    closure = read_record(Closure, entry, {"kinds": KINDS})
    kind, points = closure.kind, closure.points
    if len(points) not in KINDS[kind] or len(set(points)) < len(points):
        counts = " or ".join(map(str, KINDS[kind]))
        raise BadOption(f"{entry.at('points')} = {list(points)}; kind '{kind}' takes {counts} different ones")
    for key, kinds in _KINDS_OF_KEYS.items():
        if key in entry and kind not in kinds:
            raise BadOption(f"{entry.at(key)} is no key of kind '{kind}'; it is of {' and '.join(kinds)}")
    return closure


def split_protocol(name: str | Path) -> list[str]:
    """The names of protocols that are joined by "+"; a path may have a +."""
    return [str(name)] if Path(name).is_file() else str(name).split("+")
