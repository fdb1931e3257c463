"""Sensor Logger, an app for phones: a folder or zip with a CSV for each sensor.

Columns ``time`` [ns since 1970], ``seconds_elapsed``, then the axes from z to x. Gyroscope [rad/s]; TotalAcceleration,
or Accelerometer (without gravity) and Gravity [m/s²]; Orientation ``qz, qy, qx, qw`` to a world with z up. The signs of
accelerations are Android's (+g up at rest); on an iPhone they are the opposite unless the app's setting standardises
them, which Metadata says.

Source: tszheichoi/awesome-sensor-logger, the app's description of its exports, and published recordings.
"""

from __future__ import annotations

from pathlib import Path

from ..data_tables import read_columns, read_first_lines, read_table
from ..diagnostics import WARNING, Diagnostic
from .device import Device, Signal, join_signals, make_device, open_folder

COLUMNS = {
    **dict.fromkeys(("Gyroscope", "TotalAcceleration", "Accelerometer", "Gravity"), ("x", "y", "z")),
    "Orientation": ("qx", "qy", "qz", "qw"),
}
NEEDS = "Gyroscope with TotalAcceleration, or Accelerometer and Gravity, nor Orientation"


def is_sensor_logger(path: Path) -> bool:
    """Return whether a folder, a zip or a file is one of Sensor Logger's."""
    alone = path.is_file() and path.suffix.lower() != ".zip"
    with open_folder(path) as files:
        names = [path.name] if alone else [f"{name}.csv" for name in COLUMNS]
        starts = [read_first_lines(files[name], 1)[0] for name in names if name in files and name[:-4] in COLUMNS]
    return any(start.startswith("time,seconds_elapsed,") for start in starts)


def read_sensor_logger(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a phone, as `Format.read`."""
    with open_folder(path) as files:
        names = [name for name in (*COLUMNS, "Metadata") if f"{name}.csv" in files]
        tables = {name: read_table(files[f"{name}.csv"]) for name in names}
    signals = {}
    for name in (name for name in COLUMNS if name in tables):
        values = read_columns(tables[name], ["time", *COLUMNS[name]], f"{name}.csv", str(path))
        signals[name] = Signal(1e-9 * values[:, 0], values[:, 1:])
    if "TotalAcceleration" not in signals and {"Accelerometer", "Gravity"} <= set(signals):
        time, parts = join_signals(path.name, {name: signals[name] for name in ("Accelerometer", "Gravity")})
        signals["TotalAcceleration"] = Signal(time, parts["Accelerometer"] + parts["Gravity"])
    phone, diagnostics = {}, []
    if {"TotalAcceleration", "Gyroscope"} <= set(signals):
        about = tables["Metadata"].row(0, named=True) if len(tables.get("Metadata", ())) else {}
        platform = str(about.get("platform") or "").lower()
        standard = str(about.get("standardisation") or about.get("standardization")).lower() == "true"
        if not platform and use != "orientation":
            diagnostics.append(Diagnostic("file-assumption", WARNING, path.name, facts={"variant": "sign"}))
        time, accel = signals["TotalAcceleration"]
        sign = -1.0 if platform == "ios" and not standard else 1.0
        phone = {"gyro": signals["Gyroscope"], "accel": Signal(time, sign * accel)}
    if "Orientation" in signals:
        phone["orientation"] = signals["Orientation"]
    folder = path if path.is_dir() or path.suffix.lower() == ".zip" else path.absolute().parent
    label = folder.stem if folder.is_file() else folder.absolute().name
    return make_device(path, {label: phone}, NEEDS, use, rate_hz, diagnostics)
