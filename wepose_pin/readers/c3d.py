"""C3D, markers and rotations as optical systems write them, by ezc3d: a reference for `wepose evaluate`.

Points in POINT:UNITS at POINT:RATE; a residual below 0, NaN or zeros mark a missing one. Labels lose a subject before a
colon. Rotations (HAS-Motion's extension, as Theia3D writes it) are 4×4 transforms of a segment to the laboratory at
ROTATION:RATE, labelled ``l_uarm_4X4``, or ``left_upper_arm_4X4`` by `wepose export`.

Source: The C3D File Format user guide (c3d.org); HAS-Motion's description of ROTATION.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadData, one_of
from ..libraries import import_library, library_errors
from .device import check_measured
from .markers import MarkerTable, Reference, locate

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "meters": 1.0, "millimeters": 1e-3}


class _C3d(NamedTuple):
    """The contents of a file."""

    path: Path
    parameters: dict[str, Any]  # group → name → {"value": …}
    points: np.ndarray  # (frames, k, 3) in the file's unit; NaN where missing
    rotations: np.ndarray  # (frames, k, 4, 4)

    def values(self, group: str, name: str) -> list[Any]:
        """Return the values of a parameter; none where it is not there."""
        return list(self.parameters.get(group, {}).get(name, {}).get("value", []))

    def labels(self, group: str) -> list[str]:
        """Return the labels of a group; more than 255 go on in LABELS2 and so on."""
        return [label for suffix in ("", *range(2, 17)) for label in self.values(group, f"LABELS{suffix}")]

    def rate_hz(self, group: str) -> float:
        """Return the rate of a group; raise `BadData` where it is none."""
        rate_hz = float([*self.values(group, "RATE"), 0.0][0])
        if not 1.0 <= rate_hz <= 1e5:
            raise BadData(f"{self.path}: {group}:RATE is {rate_hz:g}; frames a second are needed there")
        return rate_hz


def read_c3d(path: Path, table: MarkerTable) -> Reference:
    """Read the joints and segments that follow from the markers, or the segments that the file has."""
    file = _open(path)
    if not file.rotations.size:
        return locate(path, *_read_markers(file), table)
    reference = _read_rotations(file, table)
    if file.points.size and len(file.points) == len(reference.time):
        time, markers = _read_markers(file)
        with contextlib.suppress(BadData):  # markers of which no joint follows
            reference = reference._replace(points=locate(path, time, markers, table).points)
    return reference


def _open(path: Path) -> _C3d:
    ezc3d = import_library("ezc3d", path, "a C3D")
    with library_errors(path, "a C3D"):
        file = ezc3d.c3d(str(path))
        data = file["data"]
        points = data["points"][:3].transpose(2, 1, 0)
        valid = np.isfinite(points).all(axis=2) & (data["meta_points"]["residuals"][0].T >= 0.0) & points.any(axis=2)
        points = np.where(valid[:, :, None], points, np.nan)
        return _C3d(path, file["parameters"], points, data["rotations"].transpose(3, 2, 0, 1))


def _read_markers(file: _C3d) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read times (n,) [s] and marker → (n, 3) [m]."""
    labels = [label.rpartition(":")[2].strip() for label in file.labels("POINT")]
    frames, used, _ = file.points.shape
    if not used or not labels or frames < 2:
        raise BadData(f"{file.path}: {used} points in {frames} frames, and no rotations; export the markers")
    units = {text.strip().lower() for text in file.values("POINT", "UNITS") if text.strip()}
    if len(units) != 1 or not units <= set(UNITS):
        raise BadData(f"{file.path}: POINT:UNITS is {', '.join(sorted(units)) or 'missing'}; {one_of(UNITS)}")
    metres = UNITS[units.pop()] * file.points
    check_measured(file.path, metres.reshape(frames, -1), "a marker")
    markers = {name: metres[:, k] for k, name in enumerate(labels[:used])}
    return np.arange(frames) / file.rate_hz("POINT"), markers


def _read_rotations(file: _C3d, table: MarkerTable) -> Reference:
    """Read the segments' orientations among the rotations."""
    frames, used = file.rotations.shape[:2]
    labels = [label.strip().removesuffix("_4X4") for label in file.labels("ROTATION")][:used]
    if file.values("ROTATION", "RATE"):
        rate_hz = file.rate_hz("ROTATION")
    else:
        rate_hz = file.rate_hz("POINT") * float([*file.values("ROTATION", "RATIO"), 1.0][0])
    quats = {}
    for segment, name in table.rotations.items():
        label = next((each for each in (name, segment) if each in labels), None)
        if label is not None:
            R = file.rotations[:, labels.index(label), :3, :3]
            good = np.isfinite(R).all(axis=(1, 2))
            good &= np.abs(np.linalg.det(np.where(good[:, None, None], R, 0.0)) - 1.0) < 0.01
            quats[segment] = np.full((frames, 4), np.nan)
            quats[segment][good] = Rotation.from_matrix(R[good]).as_quat()
    if not quats:
        listed = ", ".join(labels[:8]) or "without labels"
        raise BadData(f"{file.path}: its rotations are of no known segment ({listed}); name them under --markers")
    return Reference(np.arange(frames) / rate_hz, quats, {}, own_frames=True)
