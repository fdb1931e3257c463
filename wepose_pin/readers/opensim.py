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

from ..data_tables import read_body
from ..errors import BadData
from ..libraries import library_errors
from .device import Device, Signal, make_device, read_first_lines

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
    """Read the orientations of all columns but time, as `Format.read`."""
    lines = read_first_lines(path)
    end = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise BadData(f"{path}: no line 'endheader' in its first {len(lines)} lines; an OpenSim .sto file has one")
    about = {key.strip().lower(): value.strip() for key, _, value in (line.partition("=") for line in lines[:end])}
    if about.get("datatype", "").lower() != "quaternion":
        raise BadData(
            f"{path}: DataType={about.get('datatype') or 'none'}; orientations are needed, DataType=Quaternion "
            f"(OpenSense's …_orientations.sto)"
        )
    own = about.get(OWN[0].lower()) == OWN[1]
    quats = {}
    with library_errors(path, "an OpenSim .sto"):
        cells = pl.read_csv(read_body(path, end + 1), separator="\t", infer_schema=False).with_columns(
            pl.all().str.strip_chars(" \r~[]()")
        )
        cells = cells.rename(str.strip).drop_nulls(cells.columns[0])
        time = cells["time"].cast(pl.Float64).to_numpy()
    for label in cells.columns[1:]:
        with library_errors(path, f"quaternions w,x,y,z, one a row, in column '{label}'"):
            wxyz = cells[label].str.split(",").list.to_array(4).cast(pl.Array(pl.Float64, 4)).to_numpy()
            quats[label] = wxyz[:, [1, 2, 3, 0]]
    if own:
        quats = {label: _segment_quat(label.removesuffix("_imu"), quat) for label, quat in quats.items()}
    found = {label: {"orientation": Signal(time, quat)} for label, quat in quats.items()}
    device = make_device(path, found, "gyroscope and accelerometer, a .sto has orientations", use, rate_hz)
    return device._replace(since_power_on=False, aligned=own)


def _segment_quat(body: str, quat_GB: np.ndarray) -> np.ndarray:
    """Compute `quat_WL` (n, 4) xyzw of our segment from that of the model's body; lost samples stay lost."""
    quat_WL = np.full(quat_GB.shape, np.nan)
    known = np.linalg.norm(np.nan_to_num(quat_GB), axis=1) > 0.5
    quat_WL[known] = (R_GW.inv() * Rotation.from_quat(quat_GB[known]) * compute_n_pose(body).inv() * R_GW).as_quat()
    return quat_WL
