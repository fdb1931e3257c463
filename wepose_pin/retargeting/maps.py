"""A robot's map (TOML): the links that are shoulder, elbow and hand, its mount, its acceleration and jerk limits."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..assets import asset
from ..documents import is_number, read_toml
from ..errors import BadModel, MissingFile, one_of

ROBOTS = ("panda", "ur5", "baxter", "tiago_dual", "talos", "g1")
SIDES = ("left", "right")
AXES = {f"{sign}{name}": (1.0 if sign == "+" else -1.0) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in "+-"}
EXAMPLE_DATA = Path("share") / "example-robot-data" / "robots"
_KEYS = ("format", "urdf", "srdf", "description", "up", "forward", "base", "rest", "limits", "arms")
_ARM_KEYS = ("joints", "shoulder", "elbow", "hand", "reach")
RISE_S = 0.02  # [s] to the full acceleration, from which the jerk limit follows where the map has none


class LinkPoint(NamedTuple):
    """A point of the robot, at `offset` [m] in the frame of a link."""

    link: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ArmMap:
    """One arm of the robot.

    Parameters
    ----------
    joints : from the shoulder to the hand; all others keep the rest posture
    shoulder : corresponds to the person's shoulder; does not move
    elbow : None: the controller is free to choose it
    hand : corresponds to the person's palm
    fingers, thumb : axes of the hand's link along the fingers, and to the side of the thumb
    reach : [m] of the person's straight arm; None: 95 % of what the joints allow
    """

    joints: tuple[str, ...]
    shoulder: LinkPoint
    elbow: LinkPoint | None
    hand: LinkPoint
    fingers: str
    thumb: str
    reach: float | None = None


@dataclass(frozen=True)
class RobotMap:
    """What retargeting needs of a robot beyond its URDF.

    Parameters
    ----------
    where : the map's file name, for error messages
    urdf, srdf : files; without an SRDF pairs in collision in the rest posture, or always, are not checked
    base : link whose axes `up` and `forward` are; empty: the root
    up, forward : axes of the base that point up, and where the person faces
    rest : joint → value in the rest posture [rad or m]; zero where not named
    acceleration, jerk : joint → limit [rad/s²], [rad/s³]
    description : free text, with the sources of the limits
    """

    name: str
    where: str
    urdf: Path
    srdf: Path | None
    base: str
    up: str
    forward: str
    rest: Mapping[str, float]
    acceleration: Mapping[str, float]
    jerk: Mapping[str, float]
    arms: Mapping[str, ArmMap]
    description: str = ""


def find_map(robot: str) -> RobotMap:
    """The map of a robot by name, by its URDF with a map of the same name beside it, or by the map's file.

    Raises
    ------
    MissingFile, BadModel
        No such robot or file; the map lacks a key or has an unknown one.
    """
    path = Path(robot)
    if path.suffix.lower() == ".toml":
        return read_map(path)
    if path.suffix.lower() in (".urdf", ".xml"):
        if not path.is_file():
            raise MissingFile(f"--robot {robot}: no such file")
        file = path.with_suffix(".toml")
        if not file.is_file():
            raise MissingFile(
                f"--robot {robot}: no {file.name} beside it; a map says which links are shoulder, elbow and hand"
                " (docs/retargeting.md)"
            )
        return read_map(file, urdf=path)
    if robot not in ROBOTS:
        raise BadModel(f"--robot {robot}: not known; {one_of(ROBOTS, robot)}; or a file, FILE.urdf")
    return read_map(asset("urdf", f"robots/{robot}.toml"))


def read_map(path: Path, urdf: Path | None = None) -> RobotMap:
    """The map in a file; `urdf` replaces the URDF that it names.

    Raises
    ------
    MissingFile, BadModel
        As `find_map`.
    """
    table = read_toml(path, "a robot's map (docs/retargeting.md)", BadModel)
    where = path.name
    _check_keys(table, _KEYS, where)
    if table.get("format") != 1:
        raise BadModel(f"{where}: format = {table.get('format')!r}; this version reads format = 1")
    up, forward = _read_axis(table, "up", where), _read_axis(table, "forward", where)
    _check_perpendicular(up, forward, f"{where}: up, forward")
    arms = _read_table(table, "arms", where)
    if not arms:
        raise BadModel(f"{where}: no arms; at least one of [arms.left] and [arms.right] is needed")
    for side in arms:
        if side not in SIDES:
            raise BadModel(f"{where}: arms.{side} is no side; {one_of(SIDES, side)}")
    sides = {side: _read_arm(arms[side], f"{where}: arms.{side}") for side in SIDES if side in arms}
    limits = _read_table(table, "limits", where)
    _check_keys(limits, ("acceleration", "jerk", "source"), f"{where}: limits")
    joints = [name for arm in sides.values() for name in arm.joints]
    acceleration = _read_joint_values(limits, "acceleration", joints, f"{where}: limits")
    jerk = {name: limit / RISE_S for name, limit in acceleration.items()}
    jerk |= _read_joint_values(limits, "jerk", joints, f"{where}: limits")
    return RobotMap(
        name=path.stem,
        where=where,
        urdf=urdf or _find_file(path, table.get("urdf"), "urdf"),
        srdf=_find_file(path, table["srdf"], "srdf") if "srdf" in table else None,
        base=str(table.get("base", "")),
        up=up,
        forward=forward,
        rest=_read_numbers(_read_table(table, "rest", where), f"{where}: rest"),
        acceleration=acceleration,
        jerk=jerk,
        arms=sides,
        description=" ".join(str(text) for text in (table.get("description", ""), limits.get("source", "")) if text),
    )


def package_folders(urdf: Path) -> list[str]:
    """Folders in which ``package://`` paths of a URDF are looked up."""
    folders = [str(folder) for folder in urdf.absolute().parents]
    data = find_example_data()
    return folders if data is None else [*folders, str(data), str(data.parent), str(data.parent.parent)]


def find_example_data() -> Path | None:
    """The folder with the robots of example-robot-data; None where it is not installed."""
    for root in map(Path, sys.path):
        for prefix in (root / "cmeel.prefix", root.parent.parent.parent):
            if (prefix / EXAMPLE_DATA).is_dir():
                return prefix / EXAMPLE_DATA
    return None


def _find_file(path: Path, name: Any, key: str) -> Path:
    if not isinstance(name, str):
        raise BadModel(f"{path.name}: {key} = {name!r}; the path of a file is needed")
    file = path.parent / name
    if file.is_file():
        return file
    data = find_example_data()
    if data is not None and (data / name).is_file():
        return data / name
    if data is None and "/" in name:
        raise MissingFile(
            f"{path.name}: {key} = '{name}' is in example-robot-data, which is not installed; "
            "pip install --no-deps example-robot-data"
        )
    raise MissingFile(f"{path.name}: {key} = '{name}': no such file beside the map or in example-robot-data")


def _read_arm(table: Any, where: str) -> ArmMap:
    if not isinstance(table, dict):
        raise BadModel(f"{where} = {table!r} is not a table")
    _check_keys(table, _ARM_KEYS, where)
    joints = table.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(name, str) for name in joints):
        raise BadModel(f"{where}.joints = {joints!r}; a list of joints from the shoulder to the hand is needed")
    hand = table.get("hand")
    if not isinstance(hand, dict):
        raise BadModel(f"{where}.hand = {hand!r}; {{ link, offset, fingers, thumb }} is needed")
    fingers, thumb = _read_axis(hand, "fingers", f"{where}.hand"), _read_axis(hand, "thumb", f"{where}.hand")
    _check_perpendicular(fingers, thumb, f"{where}.hand: fingers, thumb")
    reach = table.get("reach")
    if reach is not None and not (_is_number(reach) and reach > 0.0):
        raise BadModel(f"{where}.reach = {reach!r}; metres above 0 are needed")
    return ArmMap(
        joints=tuple(joints),
        shoulder=_read_point(table.get("shoulder"), f"{where}.shoulder"),
        elbow=_read_point(table["elbow"], f"{where}.elbow") if "elbow" in table else None,
        hand=_read_point({key: hand[key] for key in ("link", "offset") if key in hand}, f"{where}.hand"),
        fingers=fingers,
        thumb=thumb,
        reach=None if reach is None else float(reach),
    )


def _read_point(value: Any, where: str) -> LinkPoint:
    if not isinstance(value, dict) or not isinstance(value.get("link"), str):
        raise BadModel(
            f'{where} = {value!r}; {{ link = "…" }} is needed, and offset = [x, y, z] in metres where it is not 0'
        )
    _check_keys(value, ("link", "offset"), where)
    offset = value.get("offset", [0.0, 0.0, 0.0])
    if not isinstance(offset, list) or len(offset) != 3 or not all(_is_number(v) for v in offset):
        raise BadModel(f"{where}.offset = {offset!r}; three numbers in metres are needed")
    return LinkPoint(value["link"], (float(offset[0]), float(offset[1]), float(offset[2])))


def _read_axis(table: Mapping[str, Any], key: str, where: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or value not in AXES:
        raise BadModel(f"{where}.{key} = {value!r}; {one_of(AXES)}" if value else f"{where}: no {key}; {one_of(AXES)}")
    return str(value)


def _check_perpendicular(a: str, b: str, where: str) -> None:
    if a[1] == b[1]:
        raise BadModel(f"{where}: {a} and {b} lie on one line; two axes at right angles are needed")


def _read_table(table: Mapping[str, Any], key: str, where: str) -> dict[str, Any]:
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise BadModel(f"{where}: {key} = {value!r} is not a table")
    return value


def _read_numbers(table: Mapping[str, Any], where: str) -> dict[str, float]:
    for name, value in table.items():
        if not _is_number(value):
            raise BadModel(f"{where}.{name} = {value!r}; a number is needed")
    return {name: float(value) for name, value in table.items()}


def _read_joint_values(table: Mapping[str, Any], key: str, joints: list[str], where: str) -> dict[str, float]:
    """One number for all joints, or a table with a number for each."""
    value = table.get(key, {})
    if _is_number(value):
        return dict.fromkeys(joints, float(value))
    if not isinstance(value, dict):
        raise BadModel(f"{where}.{key} = {value!r}; a number for all joints, or a table with one for each, is needed")
    return _read_numbers(value, f"{where}.{key}")


def _is_number(value: Any) -> bool:
    return is_number(value, 1e6)


def _check_keys(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in keys:
            raise BadModel(f"{where}: '{key}' is not a key; {one_of(keys, key)}")
