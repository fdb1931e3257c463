"""A robot's map (TOML): the links that are shoulder, elbow and hand, its mount, its limits; and those of its URDF."""

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..arguments import Range
from ..body.urdf import find_example_data, read_urdf
from ..documents import Key, TomlTable, read_record, read_toml
from ..errors import BadModel, MissingFile, one_of
from ..libraries import asset
from ..recording import AXES

ROBOTS = ("panda", "panda_table", "ur5", "ur5_table", "so101", "baxter", "tiago_dual", "talos", "g1")
SIDES = ("left", "right")
Limit = Annotated[float, Range(-1e6, closed=True, high=1e6)]  # of a joint [rad or m, s]
RISE_S = 0.02  # [s] to the full acceleration, from which the jerk limit follows where the map has none


class JointLimit(NamedTuple):
    """Limits of one joint [rad or m, s]."""

    kind: str  # "revolute", "continuous", "prismatic"
    lower: float  # −inf for a continuous joint
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None  # joint, multiplier, offset: value = multiplier * its value + offset


class LinkPoint(NamedTuple):
    """A point of the robot, at `offset` [m] in the frame of a link."""

    link: str
    offset: Annotated[tuple[float, float, float], Key("offset", "m", -10.0, 10.0)] = (0.0, 0.0, 0.0)


class HandPoint(NamedTuple):
    """The hand, a point like any other, with the axes of its link along the fingers and to the side of the thumb."""

    link: str
    fingers: Annotated[str, Key(of="axes")]
    thumb: Annotated[str, Key(of="axes")]
    offset: Annotated[tuple[float, float, float], Key("offset", "m", -10.0, 10.0)] = (0.0, 0.0, 0.0)


class ArmMap(NamedTuple):
    """One arm of the robot: the keys of ``arms.SIDE``."""

    joints: tuple[str, ...]
    shoulder: LinkPoint
    hand: HandPoint
    elbow: LinkPoint | None = None
    reach: Annotated[float | None, Key("reach", "", 1e-3)] = None


_NOTHING: Mapping[str, Any] = MappingProxyType({})


class RobotMap(NamedTuple):
    """What retargeting needs of a robot beyond its URDF: the keys of its map, as docs/robot-maps.md has them.

    `description` has the source of the limits too.
    """

    urdf_file: Annotated[str, Key("urdf")]  # as it stands in the map, as is `srdf_file`
    up: Annotated[str, Key(of="axes")]
    forward: Annotated[str, Key(of="axes")]
    arms: Mapping[str, ArmMap]
    srdf_file: Annotated[str, Key("srdf")] = ""
    base: str = ""
    description: str = ""
    table: float | None = None
    rest: Mapping[str, float] = _NOTHING
    name: Annotated[str, None] = ""
    where: Annotated[str, None] = ""  # the file's name, for error messages
    urdf: Annotated[Path, None] = Path()
    srdf: Annotated[Path | None, None] = None
    acceleration: Annotated[Mapping[str, float], None] = _NOTHING
    jerk: Annotated[Mapping[str, float], None] = _NOTHING
    velocity: Annotated[Mapping[str, float], None] = _NOTHING
    position: Annotated[Mapping[str, tuple[float, ...]], None] = _NOTHING

    def read_joint_limits(self) -> dict[str, JointLimit]:
        """Return the limits of every movable joint: those of the map, else the URDF's, zero where that has none.

        They are read without Pinocchio, so that a check against them shares no code with the controller. `MissingFile`,
        `BadModel`: the URDF is not there, or is none; the map has limits of a joint that the URDF lacks.
        """
        limits = {}
        for joint in read_urdf(self.urdf).joints:
            if joint.type in ("revolute", "continuous", "prismatic"):
                limit, mimic = joint.limit, joint.mimic
                lower, upper, velocity = (getattr(limit, key, 0.0) or 0.0 for key in ("lower", "upper", "velocity"))
                if joint.type == "continuous":
                    lower, upper = -np.inf, np.inf
                source = None if mimic is None else (mimic.joint, mimic.multiplier, mimic.offset)
                limits[joint.name] = JointLimit(joint.type, lower, upper, velocity, source)
        for key, values in (("velocity", self.velocity), ("position", self.position)):
            for name in values:
                self.check_name(f"limits.{key}", "moving joint", name, limits)
        for name, velocity in self.velocity.items():
            limits[name] = limits[name]._replace(velocity=velocity)
        for name, (lower, upper) in self.position.items():
            limits[name] = limits[name]._replace(lower=lower, upper=upper)
        return limits

    def check_name(self, key: str, kind: str, name: str, known: Collection[str]) -> None:
        """Raise `BadModel` where the link or joint that a key names is not among those of the URDF."""
        if name not in known:
            raise BadModel(f"{self.where}: {key}: no {kind} '{name}' in {self.urdf.name}; {one_of(known, name)}")


def find_map(robot: str) -> RobotMap:
    """Find the map of a robot by name, by its URDF with a map of the same name beside it, or by the map's file.

    Raises
    ------
    MissingFile, BadModel
        No such robot or file; the map lacks a key or has an unknown one.
    """
    path = Path(robot)
    if path.suffix.lower() == ".toml":
        return read_map(path)
    if path.suffix.lower() in (".urdf", ".xml"):
        file = path.with_suffix(".toml")
        if not path.is_file():
            raise MissingFile(f"`robot` {robot}: no such file")
        if not file.is_file():
            raise MissingFile(f"`robot` {robot}: no {file.name} beside it; a robot needs a map (docs/robot-maps.md)")
        return read_map(file, urdf=path)
    if robot not in ROBOTS:
        raise BadModel(f"`robot` {robot}: not known; {one_of(ROBOTS, robot)}; or a file, FILE.urdf")
    return read_map(asset("urdf", f"robots/{robot}.toml"))


def read_map(path: Path, urdf: Path | None = None) -> RobotMap:
    """Read the map in a file; `urdf` replaces the URDF that it names. Errors are those of `find_map`."""
    top = TomlTable(read_toml(path, "a robot's map (docs/robot-maps.md)", BadModel), path.name, error=BadModel)
    if top.values.get("format") != 1:
        raise BadModel(f"{top.at('format')} = {top.values.get('format')!r}; this version reads format = 1")
    robot = read_record(RobotMap, top, {"axes": AXES}, others=("format", "limits"))
    _check_axes(top, "up", "forward")
    arms = top.table("arms")
    arms.allow(*SIDES)
    sides = {side: arms.table(side) for side in arms.values}
    if not robot.arms:
        raise BadModel(f"{top.at('arms')}: at least one of [arms.left] and [arms.right] is needed")
    for side, arm in robot.arms.items():
        _check_axes(sides[side].table("hand"), "fingers", "thumb")
        if not arm.joints:
            raise BadModel(f"{sides[side].at('joints')}: a list of joints from the shoulder to the hand is needed")
    limits = top.table("limits", {})
    limits.allow("source", "acceleration", "jerk", "velocity", "position")
    joints = [name for arm in robot.arms.values() for name in arm.joints]
    acceleration = _read_joint_values(limits, "acceleration", joints)
    jerk = {name: limit / RISE_S for name, limit in acceleration.items()}
    return robot._replace(
        name=path.stem,
        where=path.name,
        urdf=urdf or _find_file(path, top, "urdf"),
        srdf=_find_file(path, top, "srdf") if robot.srdf_file else None,
        arms={side: robot.arms[side] for side in SIDES if side in robot.arms},
        description=" ".join(filter(None, (robot.description, limits.text("source", None)))),
        acceleration=acceleration,
        jerk=jerk | _read_joint_values(limits, "jerk", joints),
        velocity=_read_joint_values(limits, "velocity", joints),
        position=_read_ranges(limits),
    )


def list_sides(arm: str | None) -> tuple[str, ...] | None:
    """Return the sides of "left", "right" or "both"; None: all arms that a robot has."""
    return SIDES if arm == "both" else None if arm is None else (arm,)


def _find_file(path: Path, top: TomlTable, key: str) -> Path:
    """Find the file that a map names: beside the map, or in example-robot-data."""
    name, data = top.values[key], find_example_data()
    for folder in (path.parent, data):
        if folder is not None and (folder / name).is_file():
            return folder / name
    install = "" if data else ", which is not installed: pip install --no-deps example-robot-data"
    raise MissingFile(f"{top.at(key)} = '{name}': no such file beside the map or in example-robot-data{install}")


def _check_axes(table: TomlTable, first: str, second: str) -> None:
    """Raise `BadModel` where two axes are not at right angles."""
    a, b = table.values[first], table.values[second]
    if a[1] == b[1]:
        raise BadModel(f"{table.at(first)}, {second}: {a} and {b} lie on one line; axes at right angles are needed")


def _read_joint_values(limits: TomlTable, key: str, joints: list[str]) -> dict[str, float]:
    """Read one number for all joints, or a table with a number for each."""
    value = limits.get(key, {}, Limit | Mapping[str, Limit])
    values = value if isinstance(value, Mapping) else dict.fromkeys(joints, value)
    return {name: float(number) for name, number in values.items()}


def _read_ranges(limits: TomlTable) -> dict[str, tuple[float, ...]]:
    """Read joint → lower and upper limit."""
    ranges = limits.get("position", {}, Mapping[str, tuple[Limit, Limit]])
    for name, (lower, upper) in ranges.items():
        if not lower < upper:
            raise BadModel(f"{limits.at('position')}.{name} = [{lower:g}, {upper:g}]; the first must be smaller")
    return {name: (float(lower), float(upper)) for name, (lower, upper) in ranges.items()}
