"""Shimmer Consensys CSV of calibrated data, of one device or several in a file.

A line ``"sep=;"``, names, units, and a separator at the end of each line. Names begin with that of the device:
``Shimmer_8665_Timestamp_Unix_CAL`` [ms since 1970], ``…_Accel_LN_X_CAL`` [m/(s^2)], ``…_Gyro_X_CAL`` [deg/s].
Of the two accelerometers the one of low noise (LN, ±2 g) is taken, unless it touches its range and the other (WR) is
there. Samples of one packet may have one time.

Source: files of published data sets and the readers of devicely and pyshimmer.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import polars as pl

from ..errors import BadData
from ..model import load_table
from .device import AXES, Device, make_device, read_converted, spread_equal_times
from .tables import Rows, read_columns, read_table

_TIME = re.compile(r"(?P<label>.+)_Timestamp(Sync)?_(?P<kind>Unix|FormattedUnix)_CAL")
_SIGNAL = re.compile(r"(?P<label>.+)_(?P<kind>Accel_LN|Accel_WR|Gyro|Quat_\w+)_(?P<axis>[WXYZ])_CAL", re.IGNORECASE)
LOW_NOISE_RANGE = 19.0  # [m/s²] short of ±2 g


def is_shimmer(names: list[str]) -> bool:
    """Return whether columns of these names are those of a Shimmer."""
    return any(map(_TIME.fullmatch, names)) and any(map(_SIGNAL.fullmatch, names))


def read_shimmer(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the devices' raw data where they have them, else their orientations; `use` selects one of the two.

    `rate_hz` replaces the file's own times.

    Raises
    ------
    MissingFile, BadData
        Not there; no export of Consensys; an unknown unit; not what `use` asks for.
    """
    rows = Rows(path)
    if not is_shimmer(rows.names):
        raise BadData(
            f"{path}: is no CSV of Consensys: no columns such as Shimmer_8665_Timestamp_Unix_CAL and _Gyro_X_CAL"
        )
    table, units = read_table(path), rows.units
    columns: dict[str, dict[str, dict[str, str]]] = {}  # device → kind → axis → column
    times: dict[str, str] = {}
    for name in rows.names:
        if match := _SIGNAL.fullmatch(name):
            kind = "Quat" if match["kind"].startswith("Quat") else match["kind"]
            columns.setdefault(match["label"], {}).setdefault(kind, {})[match["axis"].lower()] = name
        elif match := _TIME.fullmatch(name):
            times.setdefault(match["label"], name)
    raw = any({"Gyro"} < set(kinds) and any(kind.startswith("Accel") for kind in kinds) for kinds in columns.values())
    kind = use or ("raw" if raw else "orientation")
    clocks, values = {}, {}
    for label, kinds in columns.items():
        wanted = _choose_columns(path, table, kinds, kind)
        if wanted is None:
            continue
        time = times.get(label) or next(iter(times.values()))  # of several devices the times may be shared
        clocks[label] = np.arange(table.height) / rate_hz if rate_hz else _read_time(path, table, time)
        values[label] = {
            signal: read_converted(path, table, signal, names, units.get(names[0], ""))
            for signal, names in wanted.items()
        }
    if not values:
        what = "Gyro and Accel_LN or Accel_WR" if kind == "raw" else "Quat"
        raise BadData(f"{path}: no device has {what} in it{'; leave out data.use' if use else ''}")
    table_of_body = load_table()
    labels = {label: table_of_body.guess_segment(label) for label in values}
    if len(labels) == 1:
        labels = {label: segment or table_of_body.guess_segment(path.stem) for label, segment in labels.items()}
    return make_device("shimmer", kind, clocks, values, labels)


def _choose_columns(
    path: Path, table: pl.DataFrame, kinds: dict[str, dict[str, str]], kind: str
) -> dict[str, list[str]] | None:
    """Choose the columns by signal, the scalar of a quaternion first; None: the device has not what is wanted."""
    columns = {name: [axes[axis] for axis in AXES["accel"] if axis in axes] for name, axes in kinds.items()}
    if kind == "orientation":
        quat = kinds.get("Quat", {})
        return {kind: [quat[axis] for axis in "wxyz"]} if set(quat) == set("wxyz") else None
    accels = [name for name in ("Accel_LN", "Accel_WR") if len(columns.get(name, ())) == 3]
    if len(columns.get("Gyro", ())) < 3 or not accels:
        return None
    accel = columns[accels[0]]
    if len(accels) == 2 and (np.abs(read_columns(table, accel, str(path), str(path))) > LOW_NOISE_RANGE).any():
        accel = columns["Accel_WR"]
    return {"gyro": columns["Gyro"], "accel": accel}


def _read_time(path: Path, table: pl.DataFrame, name: str) -> np.ndarray:
    """Read times (n,) [s]: milliseconds, or dates such as 2016/11/30 14:32:11.123."""
    if table[name].dtype == pl.String:
        dates = table[name].str.strip_chars().str.to_datetime("%Y/%m/%d %H:%M:%S%.f", time_unit="us", strict=False)
        if dates.null_count() < len(dates):
            return spread_equal_times(1e-6 * dates.to_physical().cast(pl.Float64).fill_null(np.nan).to_numpy())
    return spread_equal_times(1e-3 * read_columns(table, [name], str(path), str(path))[:, 0])
