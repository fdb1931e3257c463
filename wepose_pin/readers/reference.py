"""Files of other systems as a reference for `wepose evaluate`: MVNX, C3D, and TRC, markers as OpenSim writes them.

Joint centres and segment orientations follow from markers by a small table (``markers.toml``, or one of the user's).

C3D, by ezc3d: points in POINT:UNITS at POINT:RATE; a residual below 0, NaN or zeros mark a missing one. Labels lose a
subject before a colon. Rotations (HAS-Motion's extension, as Theia3D writes it) are 4×4 transforms of a segment to the
laboratory at ROTATION:RATE, labelled ``l_uarm_4X4``, or ``left_upper_arm_4X4`` by `wepose export`.

A TRC has ``PathFileType``, a line of keys and one of values (``Units`` mm, cm or m), a line of names (one every third
cell), one of ``X1 Y1 Z1 …``, then rows ``frame time x y z …``, separated by tabs. Empty cells are missing markers.

Sources: the C3D File Format user guide (c3d.org); HAS-Motion's description of ROTATION; opensim-core,
`TRCFileAdapter.cpp`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..data_tables import parse_rows, read_body, read_columns, read_first_lines
from ..documents import TomlTable, read_toml
from ..errors import BadData, one_of
from ..libraries import check_file, import_library, library_errors
from .device import Reference, check_measured
from .mvnx import read_mvnx_reference

SUFFIXES = (".c3d", ".trc", ".mvnx")  # of files of other systems; others have the columns of pose.parquet
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "meters": 1.0, "millimeters": 1e-3}
# The axes of a segment's frame (x forward, y left, z up in the N-pose) that a direction is of.
DIRECTIONS = {"up": "z", "left": "y", "forward": "x", "lateral": "y"}
# Table → what its entries look like.
_FORMS = {
    "points": '[["A", "B"], ["C"]], ways, each of markers',
    "segments": '[{ up = [["A"], ["B"]], left = [["C"], ["D"]] }], ways, each of two directions',
    "rotations": "the name of a rotation",
}


def read_reference(path: Path, markers: Path | None = None) -> Reference:
    """Read what another system measured; `markers`: a table whose entries replace the shipped ones."""
    check_file(path, "a C3D, TRC or MVNX")
    suffix = path.suffix.lower()
    if suffix == ".mvnx":
        return read_mvnx_reference(path)
    table = read_marker_table(markers)
    if suffix == ".trc":
        return _locate(path, *_read_trc(path), table)
    ezc3d = import_library("ezc3d", path, "a C3D")
    with library_errors(path, "a C3D"):
        file = ezc3d.c3d(str(path))
    if not file["data"]["rotations"].size:
        return _locate(path, *_read_markers(path, file), table)
    reference = _read_rotations(path, file, table)
    if file["data"]["points"].size and file["data"]["points"].shape[2] == len(reference.time):
        time, places = _read_markers(path, file)
        with contextlib.suppress(BadData):  # markers of which no joint follows
            reference = reference._replace(points=_locate(path, time, places, table).points)
    return reference


# C3D and TRC ---------------------------------------------------------------------------------------------------------


def _values(file: Any, group: str, name: str) -> list[Any]:
    return list(file["parameters"].get(group, {}).get(name, {}).get("value", []))


def _read_labels(file: Any, group: str) -> list[str]:
    """Return the labels of a group; more than 255 go on in LABELS2 and so on."""
    return [label.strip() for suffix in ("", *range(2, 17)) for label in _values(file, group, f"LABELS{suffix}")]


def _read_rate(path: Path, file: Any, group: str) -> float:
    rate_hz = float([*_values(file, group, "RATE"), 0.0][0])
    if not 1.0 <= rate_hz <= 1e5:
        raise BadData(f"{path}: {group}:RATE is {rate_hz:g}; frames a second are needed there")
    return rate_hz


def _read_markers(path: Path, file: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read times (n,) [s] and marker → (n, 3) [m] of a C3D."""
    points = file["data"]["points"][:3].transpose(2, 1, 0)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    valid = np.isfinite(points).all(axis=2) & (residuals >= 0.0) & points.any(axis=2)
    labels, (frames, used, _) = _read_labels(file, "POINT"), points.shape
    if not used or not labels or frames < 2:
        raise BadData(f"{path}: {used} points in {frames} frames, and no rotations; export the markers")
    units = {text.strip().lower() for text in _values(file, "POINT", "UNITS") if text.strip()}
    if len(units) != 1 or not units <= set(UNITS):
        raise BadData(f"{path}: POINT:UNITS is {', '.join(sorted(units)) or 'missing'}; {one_of(UNITS)}")
    metres = UNITS[units.pop()] * np.where(valid[:, :, None], points, np.nan)
    check_measured(f"{path}: a marker", metres.reshape(frames, -1))
    time = np.arange(frames) / _read_rate(path, file, "POINT")
    return time, {label.rpartition(":")[2].strip(): metres[:, k] for k, label in enumerate(labels[:used])}


def _read_rotations(path: Path, file: Any, table: MarkerTable) -> Reference:
    transforms = file["data"]["rotations"].transpose(3, 2, 0, 1)
    labels = [label.removesuffix("_4X4") for label in _read_labels(file, "ROTATION")][: transforms.shape[1]]
    if _values(file, "ROTATION", "RATE"):
        rate_hz = _read_rate(path, file, "ROTATION")
    else:
        rate_hz = _read_rate(path, file, "POINT") * float([*_values(file, "ROTATION", "RATIO"), 1.0][0])
    quats = {}
    for segment, name in table.rotations.items():
        label = next((each for each in (name, segment) if each in labels), None)
        if label is not None:
            quats[segment] = _quat_from_matrices(transforms[:, labels.index(label), :3, :3])
    if not quats:
        listed = ", ".join(labels[:8]) or "without labels"
        raise BadData(f"{path}: its rotations are of no known segment ({listed}); name them under `markers`")
    return Reference(np.arange(len(transforms)) / rate_hz, quats, {}, own_frames=True)


def _read_trc(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read times (n,) [s] and marker → (n, 3) [m] of a TRC."""
    lines = read_first_lines(path, 5)
    if not lines[0].startswith("PathFileType"):
        raise BadData(f"{path}: is no TRC: its first line does not begin with PathFileType")
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = about.get("Units", "").strip().lower()
    if unit not in UNITS:
        raise BadData(f"{path}: Units '{about.get('Units', '')}'; {one_of(UNITS, unit)}")
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if not names or len(set(names)) < len(names):
        raise BadData(f"{path}: line 4 names {'no markers' if not names else 'a marker twice'}: {lines[3][:60]!r}")
    columns = ["Frame#", "Time", *(f"{name} {axis}" for name in names for axis in "XYZ")]
    table = parse_rows(path, read_body(path, 5), [*columns, "end"], "\t").drop_nulls("Time")  # a tab may end each row
    if table["end"].count():
        raise BadData(f"{path}: a row has more than the {len(columns)} cells of {len(names)} markers")
    rows = read_columns(table, columns, str(path), str(path))
    if len(rows) < 2 or not np.all(np.diff(rows[:, 1]) > 0.0):
        problem = "the times of its rows do not increase" if len(rows) > 1 else f"{len(rows)} rows of markers"
        raise BadData(f"{path}: {problem}; a recording has at least 2 rows, and time grows")
    points = UNITS[unit] * rows[:, 2:].reshape(len(rows), -1, 3)
    return rows[:, 1], {name: points[:, k] for k, name in enumerate(names)}


# Markers -------------------------------------------------------------------------------------------------------------


class MarkerTable(NamedTuple):
    """How points and segments follow from markers."""

    points: Mapping[str, Sequence[Sequence[str]]]
    segments: Mapping[str, Sequence[Mapping[str, Sequence[Sequence[str]]]]]
    rotations: Mapping[str, str]
    stated: Collection[str]  # points of the user's table


def read_marker_table(path: Path | None = None) -> MarkerTable:
    """Read the shipped table of markers; entries of a user's table replace its own."""
    entries: dict[str, dict[str, Any]] = {key: {} for key in _FORMS}
    for file in filter(None, (Path(__file__).with_name("markers.toml"), path)):
        top = TomlTable(read_toml(file, "a table of markers"), str(file))
        top.allow(*_FORMS)
        for key, form in _FORMS.items():
            for name, entry in top.table(key, {}).values.items():
                if not _has_form(key, entry):
                    raise BadData(f"{top.at(key)}.{name} = {str(entry)[:60]}; {form} is needed")
                entries[key][name] = entry
    return MarkerTable(**entries, stated=top.table("points", {}).values if path else ())


def _has_form(key: str, value: Any) -> bool:
    if key == "rotations" or not isinstance(value, list):
        return key == "rotations" and isinstance(value, str)
    if key == "points":
        return bool(value) and all(
            isinstance(way, list) and way and all(isinstance(name, str) for name in way) for way in value
        )
    return all(
        isinstance(frame, dict)
        and len(frame) == len({DIRECTIONS[name] for name in frame if name in DIRECTIONS}) == 2
        and all(_has_form("points", ends) and len(ends) == 2 for ends in frame.values())
        for frame in value
    )


def _locate(path: Path, time: np.ndarray, markers: Mapping[str, np.ndarray], table: MarkerTable) -> Reference:
    """Locate the joints and orient the segments of a body by its markers, name → (n, 3) [m]."""
    known = dict(markers)
    points: dict[str, np.ndarray] = {}
    for name, ways in table.points.items():
        way = next((way for way in ways if set(way) <= set(known)), None)
        if way is not None:
            points[name] = np.mean([known[each] for each in way], axis=0)
            known.setdefault(name, points[name])
        elif name in table.stated:
            lost = next(marker for way in ways for marker in way if marker not in known)
            raise BadData(f"{path}: no marker '{lost}', by which {name} is stated; {one_of(markers, lost)}")
    quats = {}
    for segment, frames in table.segments.items():
        for frame in frames:
            if {each for ends in frame.values() for end in ends for each in end} <= set(known):
                quats[segment] = _orient(segment, frame, known)
                break
    if not points and not quats:
        expected = sorted({each for ways in table.points.values() for way in ways for each in way} - set(table.points))
        listed = ", ".join(list(markers)[:8]) or "none"
        raise BadData(f"{path}: no joint follows from its markers ({listed}, …); {one_of(expected)}, or by `markers`")
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
    return _quat_from_matrices(np.stack([axes[axis] for axis in "xyz"], axis=2))


def _quat_from_matrices(R: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) xyzw of matrices (n, 3, 3), NaN where they are no rotations."""
    quat = np.full((len(R), 4), np.nan)
    good = np.isfinite(R).all(axis=(1, 2))
    good &= np.abs(np.linalg.det(np.where(good[:, None, None], R, 0.0)) - 1.0) < 0.01
    quat[good] = Rotation.from_matrix(R[good]).as_quat()
    return quat
