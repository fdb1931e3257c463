"""Keys of a session file on sensors, phases and truth, checked before any data are read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..documents import TomlTable, is_number, read_toml
from ..errors import BadPhase, BadSession, MissingFile, one_of
from ..recording import CONFIGURATION, Intervals, compute_mount
from ..recording.sensors import read_axes
from .device import Device

# Suffixes of data files.
DATA = (
    *(".csv", ".tsv", ".txt", ".parquet", ".mat", ".h5", ".hdf5", ".mvnx", ".sto"),
    *(".xdf", ".db3", ".mcap", ".bag", ".zip", ".json", ".c3d", ".trc"),
)
SESSION_KEYS = ("name", "model", "start_pose", "remounted", "data", "phases", "sensors", "joints")
# Keys of earlier versions, with their replacements.
_RENAMED_PHASES = {
    "still": "is called static now: write static = [[from, to]], seconds in which the sensors lie on a table"
}
_RENAMED = {"strapping": 'is called remounted now: write remounted = true where it was "new", else leave it out'}
WIDTHS = {"gyro": 3, "accel": 3, "orientation": 4}


class SensorKeys(NamedTuple):
    """The keys of a sensor's table."""

    signals: Mapping[str, list[str]]  # signal → columns, or one array; empty where the file's format defines them
    mount: np.ndarray | None
    aligned: bool | None


def read_session_file(path: Path) -> TomlTable:
    """Read a session file, or the one in a folder.

    Raises
    ------
    MissingFile, BadSession
        The file is missing, is not TOML or a data file, or has an unknown key.
    """
    path = path / "session.toml" if path.is_dir() else path
    if path.suffix.lower() in DATA:
        raise BadSession(
            f"{path}: is a table of data by its name; a session file is wanted here, which names the table (`wepose "
            f"info {path.name} --write` writes one)"
        )
    return check_session_keys(read_toml(path, "a session file"), path)


def check_session_keys(values: Mapping[str, Any], path: Path) -> TomlTable:
    """Check the keys of a session file and return its table."""
    keys = TomlTable(values, str(path))
    keys.allow(*SESSION_KEYS, renamed=_RENAMED)
    return keys


def read_sensor_keys(keys: TomlTable) -> SensorKeys:
    """Read the columns by signal, the mount, and whether the orientations are the segment's own."""
    if "segment" in keys:
        name, segment = keys.place[:-1], keys.text("segment", None)
        raise BadSession(
            f"{keys.at('segment')} = '{segment}': a segment has one sensor, and its table has the segment's name; keep "
            f"one of [sensors.{segment}] and [{name}], and name it [sensors.{segment}]"
        )
    keys.allow(
        *("gyro", "accel", "orientation", "mount", "file", "time", "time_unit", "rate_hz", "offset_s"),
        *("format", "label", "aligned", "ignore"),
    )
    mount = _read_mount(keys.table("mount")) if "mount" in keys else None
    aligned = keys.flag("aligned") if "aligned" in keys else None
    named = [key for key in WIDTHS if key in keys]
    if not named:
        return SensorKeys({}, mount, aligned)
    for key in ("label", "format"):
        if key in keys:
            raise BadSession(
                f"{keys.at(key)} stands beside {named[0]}; a known format has a {key}, a table has columns"
            )
    if "orientation" not in keys:
        return SensorKeys({"gyro": _read_names(keys, "gyro"), "accel": _read_names(keys, "accel")}, mount, aligned)
    if "gyro" in keys or "accel" in keys:
        raise BadSession(f"{keys.at('orientation')} stands beside gyro or accel; a sensor has one or the other")
    return SensorKeys({"orientation": _read_names(keys, "orientation")}, mount, aligned)


def _read_names(keys: TomlTable, signal: str) -> list[str]:
    """Read the columns of a signal, or its one array."""
    value = keys.values.get(signal)
    return [value] if isinstance(value, str) and value else keys.names(signal, WIDTHS[signal])


def choose_label(keys: TomlTable, device: Device, segment: str, path: Path) -> str:
    """Choose the file's sensor on a segment: the stated label, the one with the segment's name, or the only sensor.

    The only one that is left of a file, with another segment's name, is none.
    """
    label = keys.text("label", None)
    if label is not None:
        if label not in device.sensors:
            raise BadSession(f"{keys.at('label')} = '{label}' is not in {path.name}; {one_of(device.sensors, label)}")
        return label
    incomplete = any(each.code == "sensors-left-out" for each in device.diagnostics)
    alone = len(device.sensors) == 1 and (
        not incomplete or any(sensor.segment is None for sensor in device.sensors.values())
    )
    matches = [name for name, sensor in device.sensors.items() if sensor.segment == segment or alone]
    if len(matches) != 1:
        raise BadSession(f"{keys.at('label')} is missing; which of {path.name} is it? {one_of(device.sensors)}")
    return matches[0]


def _read_mount(keys: TomlTable) -> np.ndarray:
    keys.allow("up", "forward")
    return compute_mount(*read_axes(keys))


def read_phases(keys: TomlTable) -> dict[str, Intervals]:
    """Read the intervals [s] of each phase."""
    keys.allow(*keys.values, renamed=_RENAMED_PHASES)
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        valid = isinstance(value, list) and all(
            isinstance(pair, list) and len(pair) == 2 and all(is_number(v) for v in pair) for pair in value
        )
        if not valid:
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in value)
        for first, last in phases[name]:
            if not first < last:
                raise BadPhase(f"{keys.at(name)}: [{first:g}, {last:g}] is empty; the earlier time comes first")
    return phases


def read_joints(top: TomlTable, start_pose: str) -> dict[str, float]:
    """Read the values of joints [rad or m] in the start pose."""
    if "joints" in top and start_pose != CONFIGURATION:
        raise BadSession(
            f'{top.at("joints")} stands beside start_pose = "{start_pose}"; joints have values where start_pose = '
            f'"{CONFIGURATION}"'
        )
    joints = top.table("joints", {})
    values = {name: joints.number(name, None) for name in joints.values}
    return {name: value for name, value in values.items() if value is not None}


def find_model(path: Path, top: TomlTable) -> str:
    """Find the body that the session file `path` names: a file beside it, or the name of a body of the package.

    Empty where it names none.
    """
    name = top.text("model", None)
    if name is None:
        return ""
    file = path.parent / name
    if not file.is_file() and (Path(name).suffix or len(Path(name).parts) > 1):
        raise MissingFile(
            f"{top.at('model')}: no such file '{name}' beside {path.name}; a URDF, a TOML that names one, or the name "
            f"of a body of the package is needed"
        )
    return str(file) if file.is_file() else name


def find_truth(path: Path, data: TomlTable) -> Path | None:
    """Find the file with the truth beside the session file `path`; None: the session has none."""
    name = data.text("truth", None)
    if name is None:
        return None
    if not (path.parent / name).is_file():
        raise MissingFile(
            f"{data.at('truth')}: no such file '{name}' beside {path.name}; name it rightly or not at all"
        )
    return path.parent / name
