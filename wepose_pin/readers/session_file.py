"""Keys of a session file, checked before any data are read."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..body.table import NEUTRAL_POSE
from ..documents import Key, TomlTable, is_number, read_record, read_toml, toml_key, toml_string
from ..errors import BadPhase, BadSession, MissingFile, printable
from ..recording import CONFIGURATION, Intervals, Recording, compute_mount
from ..recording.clocks import TIME_UNITS
from ..recording.sensors import read_axes
from .device import ACCEL_UNITS, GYRO_UNITS, NEEDED

# Suffixes of data files.
DATA = (
    *(".csv", ".tsv", ".txt", ".parquet", ".mat", ".h5", ".hdf5", ".mvnx", ".sto"),
    *(".xdf", ".db3", ".mcap", ".bag", ".zip", ".c3d", ".trc"),
)
SESSION_KEYS = ("name", "model", "start_pose", "remounted", "data", "phases", "sensors", "joints")
# Keys of earlier versions, with their replacements.
_RENAMED_PHASES = {
    "still": "is called static now: write static = [[from, to]], seconds in which the sensors lie on a table"
}
# Keys of a sensor that have an effect only where a format reads the file, or only where the session names columns.
OF_FORMATS = ("format", "label", "use")
OF_COLUMNS = ("gyro_unit", "accel_unit", "time", "time_unit")
WIDTHS = {"gyro": 3, "accel": 3, "orientation": 4}
_UNITS = {"time_unit": TIME_UNITS, "gyro_unit": GYRO_UNITS, "accel_unit": ACCEL_UNITS}
_CHOICES: dict[str, Collection[str]] = {"use": NEEDED, **_UNITS}


class SensorKeys(NamedTuple):
    """The keys of a sensor's table, or of [data], which hold for every sensor that does not state them."""

    file: str = ""
    format: str = ""
    use: Annotated[str, Key(of="use")] = ""
    time: str = ""
    time_unit: Annotated[str, Key(of="time_unit")] = "s"
    rate_hz: Annotated[float | None, Key(least=1e-3)] = None
    offset_s: Annotated[float, Key(least=-1e12, most=1e12)] = 0.0  # between a clock since 1970 and one since power-on
    gyro_unit: Annotated[str, Key(of="gyro_unit")] = ""
    accel_unit: Annotated[str, Key(of="accel_unit")] = ""
    label: str = ""
    aligned: bool | None = None
    ignore: bool = False
    # Signal → columns, or one array; empty where the file's format defines them.
    signals: Annotated[Mapping[str, list[str]], None] = MappingProxyType({})
    mount: Annotated[np.ndarray | None, None] = None  # (4,) xyzw


def read_session_file(path: Path, values: Mapping[str, Any] | None = None) -> TomlTable:
    """Read a session file, or the one in a folder; `values` are its contents where it does not exist yet."""
    path = path / "session.toml" if path.is_dir() else path
    if path.suffix.lower() in DATA:
        written = f"which `wepose info {path.name} --write` writes"
        raise BadSession(f"{path}: is a table of data by its name; a session file is wanted here, {written}")
    top = TomlTable(read_toml(path, "a session file") if values is None else values, str(path))
    top.allow(*SESSION_KEYS)
    return top


def read_head(top: TomlTable) -> Recording:
    """Read what a session file states besides its data: a recording without sensors and samples."""
    path, name = Path(top.file), top.text("name", None)
    start_pose = top.text("start_pose", NEUTRAL_POSE) or NEUTRAL_POSE
    joints, truth = top.table("joints", {}), top.table("data", {}).text("truth", None)
    if joints.values and start_pose != CONFIGURATION:
        raise BadSession(f'{top.at("joints")} needs start_pose = "{CONFIGURATION}", and it is "{start_pose}"')
    if truth is not None and not (path.parent / truth).is_file():
        place = top.table("data").at("truth")
        raise MissingFile(f"{place}: no such file '{truth}' beside {path.name}; name it rightly or leave it out")
    return Recording(
        name=printable(name or path.absolute().parent.name or path.stem),
        time=np.empty(0),
        rate_hz=0.0,
        sensors={},
        phases=_read_phases(top.table("phases", {})),
        start_pose=start_pose,
        joints={joint: joints.number(joint, None) or 0.0 for joint in joints.values},
        model=_find_model(path, top),
        remounted=top.flag("remounted"),
        source=path,
        truth=None if truth is None else path.parent / truth,
    )


def _find_model(path: Path, top: TomlTable) -> str:
    """Find the body that the session names: a file beside it, or the name of a body of the package; empty: none."""
    name = top.text("model", None) or ""
    file = path.parent / name
    if name and not file.is_file() and (Path(name).suffix or len(Path(name).parts) > 1):
        needed = "a URDF, its table, or the name of a body of the package is needed"
        raise MissingFile(f"{top.at('model')}: no such file '{name}' beside {path.name}; {needed}")
    return str(file) if file.is_file() else name


def _read_phases(keys: TomlTable) -> dict[str, Intervals]:
    """Read the intervals [s] of each phase."""
    keys.allow(*keys.values, renamed=_RENAMED_PHASES)
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        pairs: list[Any] = value if isinstance(value, list) else [None]
        if not all(isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) for pair in pairs):
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in pairs)
        for first, last in phases[name]:
            if not first < last:
                raise BadPhase(f"{keys.at(name)}: [{first:g}, {last:g}] is empty; the earlier time comes first")
    return phases


def read_data_keys(table: TomlTable) -> SensorKeys:
    """Read the keys in [data]."""
    return read_record(SensorKeys, table, _CHOICES, others=("truth",))


def read_sensor_keys(table: TomlTable, data: SensorKeys) -> SensorKeys:
    """Read the keys of a sensor; those that its table lacks are those of [data]."""
    keys = read_record(SensorKeys, table, _CHOICES, data, others=(*WIDTHS, "mount"))
    if "time" in table or "rate_hz" in table:  # one replaces the other
        keys = keys._replace(time=table.text("time", None) or "", rate_hz=table.number("rate_hz", None))
    if "mount" in table:
        axes = table.table("mount")
        axes.allow("up", "forward")
        keys = keys._replace(mount=compute_mount(*read_axes(axes)))
    if not any(signal in table for signal in WIDTHS):
        return keys
    needed = NEEDED["orientation"] if "orientation" in table else NEEDED["raw"]
    if other := next((signal for signal in WIDTHS if signal in table and signal not in needed), None):
        raise BadSession(f"{table.at('orientation')} stands beside {other}; a sensor has one or the other")
    signals = {}
    for signal in needed:
        value = table.values.get(signal)
        signals[signal] = [value] if isinstance(value, str) and value else table.names(signal, WIDTHS[signal])
    return keys._replace(signals=signals)


def check_columns(tables: Mapping[str, TomlTable], keys: Mapping[str, SensorKeys]) -> None:
    """Raise `BadSession` where two sensors name one column."""
    owners: dict[tuple[str, str], str] = {}
    for name, each in keys.items():
        for signal, column in ((signal, column) for signal, own in each.signals.items() for column in own):
            if (owner := owners.setdefault((each.file, column), name)) != name:
                place = tables[name].at(signal)
                raise BadSession(f"{place}: '{column}' of {each.file} is a column of sensors.{owner} too")


def format_keys(keys: Mapping[str, Any], checks: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Format the keys of a table, one a line; `checks`: key → what the user has to check there."""
    return [
        f"{toml_key(key)} = {_format_value(value)}" + (f"   # CHECK: {checks[key]}" if key in checks else "")
        for key, value in keys.items()
    ]


def _format_value(value: Any) -> str:
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    return f"{{ {', '.join(format_keys(value))} }}" if isinstance(value, Mapping) else json.dumps(value)
