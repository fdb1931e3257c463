"""Sensor Logger, an app for phones: a folder or zip with a CSV for each sensor, or one JSON of all.

Columns ``time`` [ns since 1970], ``seconds_elapsed``, then the axes from z to x. Gyroscope [rad/s]; TotalAcceleration,
or Accelerometer (without gravity) and Gravity [m/s²]; Orientation ``qz, qy, qx, qw`` to a world with z up. In the JSON
all values are text. The signs of accelerations are Android's (+g up at rest); on an iPhone they are the opposite unless
the app's setting standardises them, which Metadata says.

Source: tszheichoi/awesome-sensor-logger, the app's description of its exports, and published recordings.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..model import load_table
from .device import Device, check_measured, join_signals, make_device, open_folder, read_first_lines
from .tables import read_columns, read_table

NS = 1e-9
TIME = "time"
COLUMNS = {"Orientation": ("qx", "qy", "qz", "qw")}
AXES = ("x", "y", "z")
FILES = ("Gyroscope", "TotalAcceleration", "Accelerometer", "Gravity", "Orientation")


def is_sensor_logger(path: Path) -> bool:
    """Return whether a folder, a zip or a file is one of Sensor Logger's."""
    if path.suffix.lower() == ".json":
        start = "".join(read_first_lines(path, 3))[:2000]
        return '"seconds_elapsed"' in start and '"sensor"' in start
    try:
        with open_folder(path, "recording of a phone") as files:
            names = [path.name] if path.suffix.lower() == ".csv" else [f"{name}.csv" for name in FILES]
            starts = [read_first_lines(files[name], 1)[0] for name in names if name in files and name[:-4] in FILES]
    except (BadData, OSError):
        return False
    return any(start.startswith(f"{TIME},seconds_elapsed,") for start in starts)


def read_sensor_logger(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a phone's rates and specific forces where they are there, else its orientation; `use` selects one.

    `rate_hz` goes before the recording's own times.

    Raises
    ------
    BadData
        No recording of Sensor Logger; not what `use` asks for.
    """
    if path.suffix.lower() == ".json":
        signals, about = _read_json(path)
    else:
        with open_folder(path, "recording of a phone") as files:
            names = {name: files[f"{name}.csv"] for name in FILES if f"{name}.csv" in files}
            signals = {name: _read_values(file, read_table(file), name) for name, file in names.items()}
            about = _read_metadata(files)
    place = path.name
    total, diagnostics = _add_gravity(path, signals), list[Diagnostic]()
    if "Gyroscope" not in signals:
        total = None  # it is of no use alone
    if use == "raw" and total is None:
        raise BadData(f"{path}: no Gyroscope and no TotalAcceleration in it; record both, or leave out data.use")
    if total is not None and use != "orientation":
        standard = (about.get("standardisation") or about.get("standardization") or "false").lower() == "true"
        if not about.get("platform"):
            diagnostics.append(Diagnostic("accel-sign-assumed", WARNING, place))
        sign = -1.0 if about.get("platform", "").lower() == "ios" and not standard else 1.0
        time, values, joined = join_signals(place, signals["Gyroscope"], (total[0], sign * total[1]))
        diagnostics += joined
        kind = "raw"
    elif "Orientation" in signals:
        (time, quat), kind = signals["Orientation"], "orientation"
        values = {"orientation": quat}
    else:
        listed = ", ".join(signals) or "none of its files"
        raise BadData(f"{path}: no Gyroscope with TotalAcceleration, and no Orientation; there is: {listed}")
    folder = path if path.is_dir() or path.suffix.lower() in (".zip", ".json") else path.absolute().parent
    label = folder.stem if folder.is_file() else folder.absolute().name
    clock = np.arange(len(time)) / rate_hz if rate_hz else time
    labels = {label: load_table().guess_segment(label)}
    return make_device("sensor_logger", kind, {label: clock}, {label: values}, labels, diagnostics)


def _read_values(path: Path, table: pl.DataFrame, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read times (n,) [s] and values (n, 3 or 4) of one sensor of the phone."""
    columns = COLUMNS.get(name, AXES)
    values = read_columns(table, [TIME, *columns], str(path), str(path))
    check_measured(path, values, name)
    return NS * values[:, 0], values[:, 1:]


def _add_gravity(
    path: Path, signals: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times and specific force: as measured, or acceleration and gravity together; None: neither is there."""
    if "TotalAcceleration" in signals or not {"Accelerometer", "Gravity"} <= set(signals):
        return signals.get("TotalAcceleration")
    # One signal of the pair is brought to the other's times, as if it were the accelerometer.
    time, both, _ = join_signals(path.name, signals["Accelerometer"], signals["Gravity"])
    return time, both["gyro"] + both["accel"]


def _read_metadata(files: Mapping[str, Path]) -> dict[str, str]:
    if "Metadata.csv" not in files:
        return {}
    table = read_table(files["Metadata.csv"]).head(1)
    return {name: str(table[name][0] or "") for name in table.columns} if table.height else {}


def _read_json(path: Path) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, str]]:
    """Read the sensors of a JSON, and what its metadata say."""
    try:
        entries = json.loads(path.read_bytes())
    except (ValueError, RecursionError, OSError) as error:
        raise BadData(f"{path}: is no JSON, or cut off: {error}") from error
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise BadData(f"{path}: is no JSON of Sensor Logger, which is a list of objects with 'sensor' and 'time'")
    by_sensor: dict[str, list[dict[str, object]]] = {}
    for entry in entries:
        by_sensor.setdefault(str(entry.get("sensor")), []).append(entry)
    signals = {}
    for name in FILES:
        if name in by_sensor:
            columns = (TIME, *COLUMNS.get(name, AXES))
            rows = {column: [str(entry.get(column, "")) for entry in by_sensor[name]] for column in columns}
            signals[name] = _read_values(path, pl.DataFrame(rows), name)
    about = by_sensor.get("Metadata", [{}])[0]
    return signals, {key: str(value) for key, value in about.items()}
