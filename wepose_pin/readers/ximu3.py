"""x-io x-IMU3 CSV, a folder a device: ``Inertial.csv``, ``Quaternion.csv`` and more.

Timestamp [µs] since the device was switched on, or since 1970 where its clock was set; Gyroscope [deg/s],
Accelerometer [g]; quaternion W, X, Y, Z to a world with z up (NWU or ENU; a device set to NED is not read rightly).

Source: the example data and the reader that x-io publish (x-IMU3-CSV).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import BadData, MissingFile
from ..model import load_table
from ..recording.limits import STANDARD_GRAVITY
from .device import Device, Text, make_table, read_first_lines, read_text

INERTIAL, QUATERNION = "Inertial.csv", "Quaternion.csv"
TIMES = {"Timestamp (us)": 1e-6, "Time (s)": 1.0}
RAW = tuple(f"{kind} {axis}" for kind, unit in (("Gyroscope", "(deg/s)"), ("Accelerometer", "(g)")) for axis in "XYZ")
UNITS = ("(deg/s)",) * 3 + ("(g)",) * 3


def read_ximu3(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a device's folder, or one of its two files; Inertial.csv where it exists, unless `use` is "orientation".

    `rate_hz` goes before the file's own times.

    Raises
    ------
    MissingFile, BadData
        Neither file is there; the file is none of x-IMU3's; it is not what `use` asks for.
    """
    folder = path if path.is_dir() else path.parent
    file = path
    if path.is_dir() or use is not None:
        wanted = {"raw": (INERTIAL,), "orientation": (QUATERNION,)}.get(use or "", (INERTIAL, QUATERNION))
        there = [folder / name for name in wanted if (folder / name).is_file()]
        if not there:
            raise MissingFile(
                f"{folder}: no {' or '.join(wanted)} in it; the folder of an x-IMU3's CSV files is needed"
            )
        file = there[0]
    first = next((name for name in TIMES if _has(file, name)), "Timestamp (us)")
    text = read_text(file, first, "a CSV of an x-IMU3")
    time = np.arange(text.cells.height) / rate_hz if rate_hz else TIMES[first] * text.numbers([first])[:, 0]
    names = tuple(f"{name} {unit}" for name, unit in zip(RAW, UNITS, strict=True))
    if names in text:
        numbers = text.numbers(names)
        values = {"gyro": np.deg2rad(numbers[:, :3]), "accel": STANDARD_GRAVITY * numbers[:, 3:]}
    else:
        values = {"orientation": _quat(text)}
    label = folder.name if file.name in (INERTIAL, QUATERNION) else file.stem
    kind = "raw" if "gyro" in values else "orientation"
    segment = load_table().guess_segment(folder.absolute().name if file.name in (INERTIAL, QUATERNION) else file.stem)
    return Device("ximu3", make_table(time, {label: values}), {label: segment}, kind, since_power_on=True)


def _has(file: Path, name: str) -> bool:
    return any(line.startswith(name) for line in read_first_lines(file, 3))


def _quat(text: Text) -> np.ndarray:
    for names in (("W", "X", "Y", "Z"), ("Quaternion W", "Quaternion X", "Quaternion Y", "Quaternion Z")):
        if names in text:
            return text.numbers(names)[:, [1, 2, 3, 0]]
    raise BadData(
        f"{text.path}: neither Gyroscope X (deg/s) … Accelerometer Z (g) nor W, X, Y, Z; it has: "
        f"{', '.join(text.cells.columns[:12])}"
    )
