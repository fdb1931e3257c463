"""OpenSim ``.sto`` tables of IMU orientations, as OpenSense reads and writes them.

Lines ``key=value`` up to ``endheader``, among them ``DataType=Quaternion``; then names and rows separated by tabs, each
cell a quaternion ``w,x,y,z`` of the sensor to its world, z up as the device had it. What `wepose export` wrote holds
bodies of a model in OpenSim's ground in place of that, and a line of its header says so.

Source: OpenSim documentation, OpenSense; the headers of OpenSense's example files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..errors import BadData
from ..model import load_table
from .device import Device, check_measured, make_table, read_first_lines
from .tables import read_columns

# The header line of our own files. OpenSim takes it for a remark.
OWN = ("Frames", "bodies of Rajagopal's model in ground")
# OpenSim's ground G: x forward, y up, z right.
R_GW = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# The axis of `pro_sup_r` in the humerus (Rajagopal_2015.osim); the left one is mirrored on the sagittal plane.
PRONATION = np.array([0.05639803, 0.99840646, 0.001952])


def compute_n_pose(body: str) -> Rotation:
    """Compute a body's rotation to G in the N-pose, palms to the thighs: 90° of `pro_sup`."""
    if not body.startswith(("radius", "hand")):
        return Rotation.identity()
    mirror = np.array([-1.0, -1.0, 1.0]) if body.endswith("_l") else 1.0
    return Rotation.from_rotvec(np.pi / 2.0 * mirror * PRONATION / np.linalg.norm(PRONATION))


def read_opensim(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the orientations of all columns but time; `rate_hz` replaces the file's own times.

    Raises
    ------
    MissingFile, BadData
        Not there; no .sto of quaternions; raw data asked for, which it has not.
    """
    if use == "raw":
        raise BadData(f"{path}: an OpenSim .sto holds orientations, no gyroscope and accelerometer; leave out data.use")
    lines = read_first_lines(path)
    end = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise BadData(f"{path}: no line 'endheader' in its first {len(lines)} lines; an OpenSim .sto file has one")
    about = {key.strip().lower(): value.strip() for key, _, value in (line.partition("=") for line in lines[:end])}
    kind = about.get("datatype", "")
    if kind.lower() != "quaternion":
        raise BadData(
            f"{path}: DataType={kind or 'none'}; orientations are needed, DataType=Quaternion (OpenSense's "
            f"…_orientations.sto)"
        )
    rows = [
        [cell.strip() for cell in line.split("\t")]
        for line in path.read_bytes().decode("utf-8-sig", errors="replace").splitlines()[end + 1 :]
        if line.strip()
    ]
    if len(rows) < 2 or rows[0][0].lower() != "time":
        raise BadData(f"{path}: a line of names that begins with time, and rows, are needed after endheader")
    names, rows = rows[0], rows[1:]
    for k, row in enumerate(rows):
        if len(row) != len(names):
            raise BadData(f"{path}: row {k + 1} has {len(row)} cells, the line of names has {len(names)}; mend the row")
    labels = names[1:]
    if len(set(labels)) < len(labels):
        raise BadData(f"{path}: two columns have one name; each needs its own: {', '.join(labels)}")
    time = read_columns(pl.DataFrame({"time": [row[0] for row in rows]}), ["time"], str(path), str(path))[:, 0]
    if rate_hz:
        time = np.arange(len(rows)) / rate_hz
    quats = {label: _quat(path, label, [row[k] for row in rows]) for k, label in enumerate(labels, 1)}
    own = about.get(OWN[0].lower()) == OWN[1]
    if own:
        quats = {label: _segment_quat(label.removesuffix("_imu"), quat) for label, quat in quats.items()}
    return Device(
        "opensim",
        make_table(time, {label: {"orientation": quat} for label, quat in quats.items()}),
        {label: load_table().guess_segment(label) for label in labels},
        "orientation",
        aligned=own,
    )


def _segment_quat(body: str, quat_GB: np.ndarray) -> np.ndarray:
    """Compute `quat_WL` (n, 4) xyzw of our segment from that of the model's body; lost samples stay lost."""
    quat_WL = np.full(quat_GB.shape, np.nan)
    known = np.linalg.norm(np.nan_to_num(quat_GB), axis=1) > 0.5
    quat_WL[known] = (R_GW.inv() * Rotation.from_quat(quat_GB[known]) * compute_n_pose(body).inv() * R_GW).as_quat()
    return quat_WL


def _quat(path: Path, label: str, cells: list[str]) -> np.ndarray:
    """Read quaternions (n, 4) xyzw from cells ``w,x,y,z``; ``nan`` is a lost sample."""
    quat = np.empty((len(cells), 4))
    for k, cell in enumerate(cells):
        try:
            quat[k] = [float(part) for part in cell.strip("~[]()").split(",")]
        except ValueError:
            raise BadData(
                f"{path}: column '{label}' holds '{cell[:40]}' in row {k + 1}; a quaternion w,x,y,z is needed"
            ) from None
    check_measured(path, quat, f"column '{label}'")
    return quat[:, [1, 2, 3, 0]]
