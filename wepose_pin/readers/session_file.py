"""What a session's keys say of a sensor, its phases, its truth: checked by themselves, before any data is read."""

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

# Endings of files that hold the data themselves.
DATA = (".csv", ".parquet", ".txt", ".mat", ".h5", ".hdf5", ".mvnx", ".sto", ".wepose")
SESSION_KEYS = ("name", "start_pose", "remounted", "data", "phases", "sensors", "joints")
# Of earlier versions: what to write in their place.
_RENAMED_PHASES = {
    "still": "is called static now: write static = [[from, to]], seconds in which the sensors lie on a table"
}
_RENAMED = {"strapping": 'is called remounted now: write remounted = true where it was "new", else leave it out'}
WIDTHS = {"gyro": 3, "accel": 3, "orientation": 4}


class SensorKeys(NamedTuple):
    """What a sensor's table says of its values."""

    signals: Mapping[str, list[str]] | None  # columns, or one array; None where the file's own format knows them
    mount: np.ndarray | None
    aligned: bool | None


def read_session_file(path: Path) -> TomlTable:
    """The contents of a session file, or of the one in a folder.

    Raises
    ------
    MissingFile, BadSession
        Not there; no TOML, or data themselves; a key in it that no session has.
    """
    path = path / "session.toml" if path.is_dir() else path
    if path.suffix.lower() in DATA:
        raise BadSession(
            f"{path}: is a table of data by its name; a session file is wanted here, which names the table (`wepose "
            f"info {path.name} --write` writes one)"
        )
    return check_session_keys(read_toml(path, "a session file"), path)


def check_session_keys(values: Mapping[str, Any], path: Path) -> TomlTable:
    """What a session file holds, with keys that are all known."""
    keys = TomlTable(values, str(path))
    keys.allow(*SESSION_KEYS, renamed=_RENAMED)
    return keys


def read_sensor_keys(keys: TomlTable) -> SensorKeys:
    """Columns by signal, the mount, and whether the orientations are the segment's own."""
    keys.allow(
        *("gyro", "accel", "orientation", "mount", "file", "time", "time_unit", "rate_hz", "offset_s"),
        *("format", "label", "aligned"),
    )
    mount = _mount(keys.table("mount")) if "mount" in keys else None
    aligned = keys.flag("aligned") if "aligned" in keys else None
    named = [key for key in WIDTHS if key in keys]
    if not named:
        return SensorKeys(None, mount, aligned)
    for key in ("label", "format"):
        if key in keys:
            raise BadSession(
                f"{keys.at(key)} stands beside {named[0]}; a known format has a {key}, a table has columns"
            )
    if "orientation" not in keys:
        return SensorKeys({"gyro": _names(keys, "gyro"), "accel": _names(keys, "accel")}, mount, aligned)
    if "gyro" in keys or "accel" in keys:
        raise BadSession(f"{keys.at('orientation')} stands beside gyro or accel; a sensor has one or the other")
    return SensorKeys({"orientation": _names(keys, "orientation")}, mount, aligned)


def _names(keys: TomlTable, signal: str) -> list[str]:
    """The columns of a signal, or the one array that holds them all."""
    value = keys.values.get(signal)
    return [value] if isinstance(value, str) and value else keys.names(signal, WIDTHS[signal])


def choose_label(keys: TomlTable, device: Device, segment: str, path: Path) -> str:
    """Which of the file's sensors is strapped to the segment: as stated, the only one, or the one that is named so."""
    label = keys.text("label", None)
    if label is not None:
        if label not in device.labels:
            raise BadSession(f"{keys.at('label')} = '{label}' is not in {path.name}; {one_of(device.labels, label)}")
        return label
    fitting = [name for name, its in device.labels.items() if its == segment or len(device.labels) == 1]
    if len(fitting) != 1:
        raise BadSession(f"{keys.at('label')} is missing; which of {path.name} is it? {one_of(device.labels)}")
    return fitting[0]


def _mount(keys: TomlTable) -> np.ndarray:
    keys.allow("up", "forward")
    return compute_mount(*read_axes(keys))


def read_phases(keys: TomlTable) -> dict[str, Intervals]:
    keys.allow(*keys.values, renamed=_RENAMED_PHASES)
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        well = isinstance(value, list) and all(
            isinstance(pair, list) and len(pair) == 2 and all(is_number(v) for v in pair) for pair in value
        )
        if not well:
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in value)
        for first, last in phases[name]:
            if not first < last:
                raise BadPhase(f"{keys.at(name)}: [{first:g}, {last:g}] is empty; the earlier time comes first")
    return phases


def read_joints(top: TomlTable, start_pose: str) -> dict[str, float]:
    """Values of joints in the start pose of a chain that is not a person's arms."""
    if "joints" in top and start_pose != CONFIGURATION:
        raise BadSession(
            f'{top.at("joints")} stands beside start_pose = "{start_pose}"; joints have values where start_pose = '
            f'"{CONFIGURATION}"'
        )
    joints = top.table("joints", {})
    values = {name: joints.number(name, None) for name in joints.values}
    return {name: value for name, value in values.items() if value is not None}


def find_truth(path: Path, data: TomlTable) -> Path | None:
    name = data.text("truth", None)
    if name is None:
        return None
    if not (path.parent / name).is_file():
        raise MissingFile(
            f"{data.at('truth')}: no such file '{name}' beside {path.name}; name it rightly or not at all"
        )
    return path.parent / name
