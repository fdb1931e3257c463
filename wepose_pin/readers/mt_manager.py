"""Xsens MT Manager text exports (MTi, MTw, MTx), one file a sensor.

Lines that begin with ``//`` say how it was recorded; then a line of names, separated by tabs, commas, semicolons or
single spaces. What was not measured is empty or ``NaN``.
Acc [m/s²] and Gyr [rad/s] in the sensor's frame, orientation to a world with z up as quaternion (q0 is w), matrix
(``Mat[row][column]``) or Roll, Pitch, Yaw [deg]. PacketCounter begins anew at 65536, SampleTimeFine counts 0.1 ms.

Source: MTw User Manual, table of exported data; MT Low Level Communication Protocol; headers of published exports.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadData, MissingRate
from ..model import load_table
from .device import Device, Text, compute_counted_time, make_table, read_text, unwrap_counter

COUNTER_WRAPS = 65536.0
FINE_S, FINE_WRAPS = 1e-4, 2.0**32
RAW = tuple(f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ")
QUATERNIONS = (
    tuple(f"Quat_q{k}" for k in range(4)),
    tuple(f"Quat_{c}" for c in "WXYZ"),
    tuple(f"Quat_{c}" for c in "wxyz"),
    tuple(f"q{k}" for k in range(4)),
)
EULERS = (("Roll", "Pitch", "Yaw"), ("Euler_X", "Euler_Y", "Euler_Z"))
MATRIX = tuple(f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3))


def read_mt_manager(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensor's raw data where the export has them, else its orientation; `use` selects one of the two.

    `rate_hz` is the update rate, where the export does not state it or states another.

    Raises
    ------
    MissingFile, BadData
        Not there; no such export; neither rate nor time in it; not what `use` asks for.
    """
    text = read_text(path, "PacketCounter", "an export of MT Manager")
    time, wraps_s = _time(text, rate_hz)
    kind = "raw" if RAW in text and use != "orientation" else "orientation"
    if use == "raw" and kind != "raw":
        raise BadData(f"{path}: no Acc and Gyr; export them too, or leave out data.use and its orientation is read")
    if kind == "raw":
        numbers = text.numbers(RAW)
        values = {"accel": numbers[:, :3], "gyro": numbers[:, 3:]}
    else:
        values = {"orientation": read_orientation(text)}
    # MT_012345_001-000_00B40001.txt: the last part is the sensor's number.
    label = path.stem.rpartition("_")[2] or path.stem
    labels = {label: load_table().guess_segment(path.stem)}
    table = make_table(time, {label: values})
    return Device("mt_manager", table, labels, kind, since_power_on=True, wraps_s=wraps_s)


def read_orientation(text: Text) -> np.ndarray:
    """Read `quat_WS` (n, 4) xyzw of an Xsens export, from a quaternion, a matrix or angles; NaN where it has none.

    Raises
    ------
    BadData
        None of these columns is there.
    """
    for names in QUATERNIONS:
        if names in text:
            return text.numbers(names)[:, [1, 2, 3, 0]]
    if MATRIX in text:
        cells = text.numbers(MATRIX)
        good = np.isfinite(cells).all(axis=1)
        matrices = cells[good].reshape(-1, 3, 3)
        off = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(initial=0.0)
        if off > 1e-2:
            raise BadData(f"{text.path}: Mat[1][1] to Mat[3][3] are no rotation, off by {off:.2g}; export them again")
        turned = Rotation.from_matrix(matrices) if len(matrices) else None
    else:
        angles = next((names for names in EULERS if names in text), None)
        if angles is None:
            raise BadData(
                f"{text.path}: neither Acc and Gyr nor an orientation (Quat, Mat, Euler angles); it has: "
                f"{', '.join(text.cells.columns[:12])}"
            )
        cells = text.numbers(angles)
        good = np.isfinite(cells).all(axis=1)
        turned = Rotation.from_euler("ZYX", cells[good][:, ::-1], degrees=True) if good.any() else None
    quat = np.full((len(cells), 4), np.nan)
    if turned is not None:
        quat[good] = turned.as_quat()
    return quat


def _time(text: Text, rate_hz: float | None) -> tuple[np.ndarray, float | None]:
    """Compute times (n,) [s] on the device's clock, and the time [s] after which its counter wraps.

    The counter over the rate where the rate is stated: it is the same for all sensors of a station, and shows what was
    lost on the air.
    """
    stated = next((value for name, value in text.about.items() if name in ("Update Rate", "Output Rate")), "")
    number = re.match(r"\d+(\.\d*)?(?![\d.])", stated)
    rate = rate_hz or (float(number[0]) if number else 0.0)
    counter = text.numbers(["PacketCounter"])[:, 0]
    if rate > 0.0 and np.isfinite(counter).all() and len(counter) > 1:
        return compute_counted_time(counter, rate, COUNTER_WRAPS)
    if rate_hz:
        return np.arange(len(counter)) / rate_hz, None
    if ["SampleTimeFine"] in text:
        return FINE_S * unwrap_counter(text.numbers(["SampleTimeFine"])[:, 0], FINE_WRAPS), FINE_S * FINE_WRAPS
    raise MissingRate(
        f"{text.path}: no line '// Update Rate: …' and no SampleTimeFine: times are not known; state the update rate "
        f"as rate_hz in [data], or export one of the two"
    )
