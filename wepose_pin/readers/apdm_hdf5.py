"""APDM (Opal) HDF5, as Motion Studio and Mobility Lab write it: all sensors of a recording in one file.

Versions 3 and 4: ``/SI-000123/Calibrated/Accelerometers`` [m/s²], ``Gyroscopes`` [rad/s] and ``Orientation``, and
``/SI-000123/Time``; the attributes ``CaseIdList`` and ``MonitorLabelList`` of the file name them. Version 5:
``/Sensors/<id>/Accelerometer``, ``Gyroscope``, ``Time``, the attribute ``Label 0`` of ``Configuration``, and
``/Processed/<id>/Orientation``. Time is in µs since 1970; quaternions (scalar first) are of the sensor to a world with
z up.

Source: the readers of kielmat (MIT) and of scikit-digital-health (MIT).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..model import load_table
from .arrays import ArrayFile, import_h5py, open_hdf5
from .device import Device, check_measured, make_device

US = 1e-6
WIDTHS = {"gyro": 3, "accel": 3, "orientation": 4}


class _Places(NamedTuple):
    """The arrays of a sensor in the file."""

    label: str
    time: str
    arrays: dict[str, str]  # signal → path


def is_apdm_hdf5(path: Path) -> bool:
    """Return whether an HDF5 file is one of APDM's; False without h5py."""
    try:
        h5py = import_h5py(path)
        with h5py.File(path) as file:
            return _list_sensors(file) != []
    except (BadData, OSError, KeyError, ValueError, RuntimeError, AttributeError, TypeError):
        return False


def read_apdm_hdf5(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where all have them, else their orientations; `use` selects one of the two.

    `rate_hz` replaces the file's own times.

    Raises
    ------
    BadData
        No HDF5 of APDM; damaged; not what `use` asks for; h5py is not installed.
    """
    needed = {"raw": ("gyro", "accel"), "orientation": ("orientation",)}
    with open_hdf5(path) as file:
        sensors = _list_sensors(file)
    if not sensors:
        raise BadData(f"{path}: is no HDF5 of APDM: neither CaseIdList nor Sensors with a Configuration is in it")
    arrays = ArrayFile(path)
    kind = use or ("raw" if any({"gyro", "accel"} <= set(each.arrays) for each in sensors) else "orientation")
    complete = [each for each in sensors if {*needed[kind]} <= set(each.arrays) and each.time in arrays.shapes]
    if not complete:
        instead = "; leave out data.use" if use else ""
        raise BadData(f"{path}: no sensor in it has {' and '.join(needed[kind])}, and times{instead}")
    clocks, values = {}, {}
    for each in complete:
        time = _read(arrays, each.time)
        clocks[each.label] = np.arange(len(time)) / rate_hz if rate_hz else US * time[:, 0]
        values[each.label] = {name: _read(arrays, each.arrays[name], WIDTHS[name]) for name in needed[kind]}
        lengths = {len(time), *map(len, values[each.label].values())}
        if len(lengths) > 1:
            raise BadData(f"{path}: the arrays of '{each.label}' differ in length: {sorted(lengths)}; export it again")
        if kind == "orientation":
            values[each.label] = {kind: values[each.label][kind][:, [1, 2, 3, 0]]}
    left_out = [each.label for each in sensors if each not in complete]
    facts = {"devices": ", ".join(left_out), "signals": " and ".join(needed[kind])}
    missing = (Diagnostic("devices-left-out", WARNING, path.name, len(left_out), facts=facts),) if left_out else ()
    labels = {label: load_table().guess_segment(label) for label in values}
    return make_device("apdm_hdf5", kind, clocks, values, labels, missing)


def _list_sensors(file: Any) -> list[_Places]:
    """List the sensors of a file with their arrays, those that exist."""
    sensors = []
    if "CaseIdList" in file.attrs:
        names = [_text(each) for each in file.attrs.get("MonitorLabelList", [])]
        for k, case in enumerate(file.attrs["CaseIdList"]):
            # Versions before 4 pad the number with characters of no meaning.
            case = next((name for name in (_text(case), _text(case)[:9]) if name in file), "")
            label = names[k] if k < len(names) and names[k] else case
            own = f"/{case}/Calibrated"
            arrays = {"gyro": "Gyroscopes", "accel": "Accelerometers", "orientation": "Orientation"}
            sensors.append((label, f"/{case}/Time", {name: f"{own}/{array}" for name, array in arrays.items()}))
    elif "Sensors" in file:
        for number, sensor in file["Sensors"].items():
            if "Configuration" not in sensor:
                continue
            arrays = {"gyro": f"/Sensors/{number}/Gyroscope", "accel": f"/Sensors/{number}/Accelerometer"}
            arrays["orientation"] = f"/Processed/{number}/Orientation"
            label = _text(sensor["Configuration"].attrs.get("Label 0", number)) or number
            sensors.append((label, f"/Sensors/{number}/Time", arrays))
    labels = [label for label, _, _ in sensors]
    return [
        _Places(
            label if labels.count(label) == 1 else f"{label} {time.split('/')[-2]}",
            time,
            {name: place for name, place in arrays.items() if place in file},
        )
        for label, time, arrays in sensors
    ]


def _text(value: Any) -> str:
    text = value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)
    return text.replace("\0", "").strip()


def _read(arrays: ArrayFile, place: str, width: int = 1) -> np.ndarray:
    """Read an array (n, width)."""
    shape = arrays.shapes.get(place, ())
    if len(shape) != (1 if width == 1 else 2) or (width > 1 and shape[1] != width):
        raise BadData(f"{arrays.path}: {place} has shape {shape}; (n, {width}) numbers are needed")
    values = arrays.read_array(place).reshape(-1, width)
    check_measured(arrays.path, values, place)
    return values
