"""Joint centres and segment orientations from markers, by a small table (``markers.toml``, or one of the user's)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import Diagnostic
from ..documents import TomlTable, read_toml
from ..errors import BadData, one_of

SIDES = ({"side": "left", "S": "L", "s": "l"}, {"side": "right", "S": "R", "s": "r"})
# The axes of a segment's frame (x forward, y left, z up in the N-pose) that a direction is of.
DIRECTIONS = {"up": "z", "left": "y", "forward": "x", "lateral": "y"}
# Table → what its entries look like.
_FORMS = {
    "points": '[["A", "B"], ["C"]], ways, each of markers',
    "segments": '[{ up = [["A"], ["B"]], left = [["C"], ["D"]] }], ways, each of two directions',
    "rotations": "the name of a rotation",
}


class Reference(NamedTuple):
    """What another system measured, on its own clock and in its own world V."""

    time: np.ndarray  # (n,) [s]
    quat_VT: Mapping[str, np.ndarray]  # segment → (n, 4) xyzw, its frame to V; NaN: missing
    points: Mapping[str, np.ndarray]  # point → (n, 3) [m] in V; NaN: missing
    up: str | None = None  # the axis of V that is up; None: not known
    own_frames: bool = False  # frames are of another convention than ours
    diagnostics: tuple[Diagnostic, ...] = ()


class MarkerTable(NamedTuple):
    """How points and segments follow from markers, with sides written out."""

    points: Mapping[str, Sequence[Sequence[str]]]
    segments: Mapping[str, Sequence[Mapping[str, Sequence[Sequence[str]]]]]
    rotations: Mapping[str, str]
    own: Mapping[str, Sequence[Sequence[str]]] = MappingProxyType({})  # points of the user's table


def read_marker_table(path: Path | None = None) -> MarkerTable:
    """Read a table of markers; None: the shipped one. What a user's table has goes before that.

    Raises
    ------
    MissingFile, BadSession, BadData
        No such file; no TOML; an unknown key; an entry that is none.
    """
    table = _read_table(Path(__file__).with_suffix(".toml"))
    if path is None:
        return table
    own = _read_table(path)

    def join(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
        return {name: [*theirs.get(name, ()), *ours.get(name, ())] for name in {**ours, **theirs}}

    points, segments = join(table.points, own.points), join(table.segments, own.segments)
    return MarkerTable(points, segments, {**table.rotations, **own.rotations}, own.points)


def _read_table(path: Path) -> MarkerTable:
    top = TomlTable(read_toml(path, "a table of markers"), str(path))
    top.allow(*_FORMS)
    entries: dict[str, dict[str, Any]] = {key: {} for key in _FORMS}
    for key, form in _FORMS.items():
        for name, value in top.table(key, {}).values.items():
            for side in SIDES if "{" in name else SIDES[:1]:
                entry = _write_side(value, side)
                if not _has_form(key, entry):
                    raise BadData(f"{top.at(key)}.{name} = {str(entry)[:60]}; {form} is needed")
                entries[key][_write_side(name, side)] = entry
    return MarkerTable(**entries)


def _write_side(value: Any, side: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        for key, text in side.items():
            value = value.replace(f"{{{key}}}", text)
        return value
    if isinstance(value, list):
        return [_write_side(each, side) for each in value]
    return {key: _write_side(each, side) for key, each in value.items()} if isinstance(value, dict) else value


def _has_form(key: str, value: Any) -> bool:
    """Return whether an entry of a table is what `_FORMS` says."""
    if key == "rotations":
        return isinstance(value, str)
    if key == "points":
        ways = value if isinstance(value, list) else [None]
        return all(isinstance(way, list) and way and all(isinstance(name, str) for name in way) for way in ways)
    return isinstance(value, list) and all(
        isinstance(frame, dict)
        and len(frame) == 2
        and len({DIRECTIONS.get(each) for each in frame} - {None}) == 2
        and all(_has_form("points", ends) and len(ends) == 2 for ends in frame.values())
        for frame in value
    )


def locate(path: Path, time: np.ndarray, markers: Mapping[str, np.ndarray], table: MarkerTable) -> Reference:
    """Locate the joints and orient the segments of a body by its markers, name → (n, 3) [m]."""
    known = dict(markers)
    points: dict[str, np.ndarray] = {}
    for name, ways in table.points.items():
        way = next((way for way in ways if set(way) <= set(known)), None)
        if way is not None:
            points[name] = np.mean([known[each] for each in way], axis=0)
            known.setdefault(name, points[name])
    for name, ways in table.own.items():
        lost = [marker for way in ways for marker in way if marker not in known]
        if lost and not any(set(way) <= set(known) for way in ways):
            raise BadData(f"{path}: no marker '{lost[0]}', by which {name} is stated; {one_of(markers, lost[0])}")
    quats = {}
    for segment, frames in table.segments.items():
        for frame in frames:
            if {each for ends in frame.values() for end in ends for each in end} <= set(known):
                quats[segment] = _orient(segment, frame, known)
                break
    if not points and not quats:
        expected = sorted({each for ways in table.points.values() for way in ways for each in way} - set(table.points))
        raise BadData(
            f"{path}: no joint follows from its markers ({', '.join(list(markers)[:8]) or 'none'}, …); "
            f"{one_of(expected, most=12)}. Name yours in a table of markers (--markers)"
        )
    return Reference(time, quats, points)


def _orient(segment: str, frame: Mapping[str, Sequence[Sequence[str]]], known: Mapping[str, np.ndarray]) -> np.ndarray:
    """Orient a segment (n, 4) xyzw by two directions, the first of which is exact; NaN where markers are missing."""
    axes: dict[str, np.ndarray] = {}
    for direction, (begin, end) in frame.items():
        sign = -1.0 if direction == "lateral" and segment.startswith("right") else 1.0
        along = np.mean([known[each] for each in end], axis=0) - np.mean([known[each] for each in begin], axis=0)
        axes[DIRECTIONS[direction]] = sign * along
    (first, exact), (second, near) = axes.items()
    third = ({"x", "y", "z"} - {first, second}).pop()
    in_order = first + second in "xyzx"
    across = np.cross(exact, near) if in_order else np.cross(near, exact)
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = {name: v / np.linalg.norm(v, axis=1)[:, None] for name, v in ((first, exact), (third, across))}
    axes[second] = np.cross(axes[third], axes[first]) if in_order else np.cross(axes[first], axes[third])
    return quat_from_matrices(np.stack([axes[axis] for axis in "xyz"], axis=2))


def quat_from_matrices(R: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) xyzw of matrices (n, 3, 3), NaN where they are no rotations."""
    quat = np.full((len(R), 4), np.nan)
    good = np.isfinite(R).all(axis=(1, 2))
    good &= np.abs(np.linalg.det(np.where(good[:, None, None], R, 0.0)) - 1.0) < 0.01
    quat[good] = Rotation.from_matrix(R[good]).as_quat()
    return quat
