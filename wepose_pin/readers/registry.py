"""The formats of devices and other programs, and their detection."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..data_tables import read_first_lines
from ..errors import BadData, BadSession, WeposeError, one_of
from ..libraries import check_file, find_plugins, load_plugin
from .device import Device
from .live_log import is_live_log, read_live_device
from .mvnx import read_mvnx
from .opensim import read_opensim
from .rosbag import SUFFIXES as ROSBAGS
from .rosbag import read_rosbag
from .sensor_logger import is_sensor_logger, read_sensor_logger
from .table_format import TableFormat, load_format, load_formats
from .xdf import read_xdf


class Format(NamedTuple):
    """A format of a device or program."""

    title: str  # what a file of it is called
    detects: Callable[[Path, str], bool]  # path, which may be a folder, and the first lines of a text → is it one?
    # Path, "raw" or "orientation" or None, and a rate [Hz] or None → the contents: raw data where a sensor has them,
    # else orientations, or only what is asked for; with a rate its times are replaced.
    read: Callable[[Path, str | None, float | None], Device]
    whole: bool = False  # all sensors of a recording are in one file
    folder: bool = False  # a recording may be a folder


TEXTS = (".csv", ".tsv", ".txt", ".xml")  # whose first lines may tell the format


def _has_suffix(path: Path, *suffixes: str) -> bool:
    return path.suffix.lower() in suffixes


# Formats that are no tables of one kind; pyproject.toml registers them as those of other distributions.
MVNX = Format("Xsens MVNX", lambda path, start: _has_suffix(path, ".mvnx") or "<mvnx" in start, read_mvnx, whole=True)
SENSOR_LOGGER = Format(
    "recording of Sensor Logger",
    lambda path, _: (path.is_dir() or _has_suffix(path, ".zip", *TEXTS)) and is_sensor_logger(path),
    read_sensor_logger,
    folder=True,
)
ROSBAG = Format(
    "ROS bag",
    lambda path, _: (_has_suffix(path, *ROSBAGS) and not is_live_log(path)) or (path / "metadata.yaml").is_file(),
    read_rosbag,
    whole=True,
    folder=True,
)
XDF = Format("XDF", lambda path, _: _has_suffix(path, ".xdf", ".xdfz"), read_xdf, whole=True)
STO = "OpenSim table of IMU orientations"
OPENSIM = Format(STO, lambda path, _: _has_suffix(path, ".sto"), read_opensim, whole=True)
WEPOSE_LIVE = Format("recording of wepose live", lambda path, _: is_live_log(path), read_live_device, whole=True)


def look_up_format(name: str) -> Format | TableFormat:
    """Look up a format by its name, or the path of a description."""
    if name in find_plugins("readers"):
        return load_plugin("readers", name)
    return load_format(Path(name)) if name.endswith(".toml") else load_formats()[name]


def find_format(name: str, folder: Path, place: str) -> str:
    """Find a format by its name, or the path of a description from the folder of the session; `place` states it."""
    known = [*find_plugins("readers"), *load_formats()]
    if not name.endswith(".toml") and name not in known:
        raise BadSession(f"{place} = '{name}' is not known; {one_of(known, name)}; or a description, such as lab.toml")
    return str(folder / name) if name.endswith(".toml") else name


def detect_format(path: Path) -> str | None:
    """Detect the format of a file or folder from its suffix and first lines; None: none of them.

    A description beside the file (`*.toml` with `detect`) goes before those of the package; its path is the format.
    """
    if not (path.is_file() or path.is_dir()) and path.exists():
        return None
    is_table = path.is_dir() or _has_suffix(path, ".zip", *TEXTS)
    start = "\n".join(read_first_lines(path, 40)) if path.is_file() and _has_suffix(path, *TEXTS) else ""
    for name in find_plugins("readers"):
        if look_up_format(name).detects(path, start):
            return name
    for file in sorted((path if path.is_dir() else path.parent).glob("*.toml")) if is_table else ():
        with contextlib.suppress(WeposeError):  # another TOML, such as a session
            if load_format(file).detects(path, start):
                return str(file)
    return next((name for name, format in load_formats().items() if is_table and format.detects(path, start)), None)


def read_device(path: Path, name: str, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a file of a format, by its name or the path of a description; `use` and `rate_hz` as of `Format.read`."""
    format = look_up_format(name)
    if not (format.folder and path.is_dir()):
        check_file(path, f"a {format.title}")
    device = format.read(path, use, rate_hz)
    if not all(np.isfinite(sensor.time).any() for sensor in device.sensors.values()):
        raise BadData(f"{path}: no row with a time in it; the export is empty or cut off")
    return device
