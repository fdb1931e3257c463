"""phyphox, an app for phones: CSV of its experiments, one file a sensor, in a folder or a zip.

``Time (s)`` and ``Acceleration x (m/s^2)`` (with gravity), ``Gyroscope x (rad/s)``; an experiment of one's own may have
both in one file, Raw Data.csv. Separator and decimal sign are chosen at the export. Times begin with the experiment.

Source: phyphox/phyphox-experiments, labels of the exports; published recordings.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..errors import BadData, MissingFile
from ..model import load_table
from .device import Device, join_signals, make_device, open_folder, read_converted
from .guess import group_columns, split_unit
from .tables import read_columns, read_layout, read_table

MOST_FILES = 50  # of a folder that are looked into
_TIME = re.compile(r"(time|zeit) \(s\)", re.IGNORECASE)


def is_phyphox(path: Path) -> bool:
    """Return whether a folder, a zip or a CSV has the names of phyphox; a CSV of both signals is a table of its own."""
    try:
        if path.suffix.lower() == ".csv" and len(_find_signals({path.name: path})) != 1:
            return False
        with open_folder(path, "recording of a phone") as files:
            return {"gyro", "accel"} <= set(_find_signals(files))
    except (BadData, MissingFile, OSError):
        return False


def read_phyphox(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a phone's rates and specific forces; `rate_hz` goes before the files' own times.

    Raises
    ------
    MissingFile, BadData
        No files of phyphox with both; an unknown unit; orientations asked for.
    """
    if use == "orientation":
        raise BadData(f"{path}: the attitude of phyphox is not read; leave out data.use")
    with open_folder(path, "recording of a phone") as files:
        signals = _find_signals(files)
        lacking = [name for name in ("gyro", "accel") if name not in signals]
        if lacking:
            names = " and ".join({"gyro": "Gyroscope x (rad/s)", "accel": "Acceleration x (m/s^2)"}[k] for k in lacking)
            raise BadData(f"{path}: no file with Time (s) and {names}; export both sensors, into one folder or zip")
        read = {}
        for signal, (file, columns) in signals.items():
            table = read_table(file)
            time = read_columns(table, table.columns[:1], str(file), str(file))[:, 0]
            read[signal] = time, read_converted(file, table, signal, columns, split_unit(columns[0])[1])
    label = (
        path.absolute().name if path.is_dir() else path.stem if path.suffix == ".zip" else path.absolute().parent.name
    )
    time, values, joined = join_signals(path.name, read["gyro"], read["accel"])
    clock = np.arange(len(time)) / rate_hz if rate_hz else time
    labels = {label: load_table().guess_segment(label)}
    return make_device("phyphox", "raw", {label: clock}, {label: values}, labels, joined)


def _find_signals(files: dict[str, Path]) -> dict[str, tuple[Path, list[str]]]:
    """Find the file and the columns of gyro and accel, the axes of which follow on a time."""
    by_signal: dict[str, tuple[Path, list[str]]] = {}
    for file in [file for name, file in files.items() if name.lower().endswith(".csv")][:MOST_FILES]:
        names = read_layout(file).names
        if not names or not _TIME.fullmatch(names[0].strip()):
            continue
        for signals in group_columns(names).values():
            for signal, columns in signals.items():
                by_signal.setdefault(signal, (file, columns))
    return by_signal
