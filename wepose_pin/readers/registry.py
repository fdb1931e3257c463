"""The formats of devices and other programs, and their detection."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from ..errors import BadData, BadSession, MissingFile, WeposeError, one_of
from .device import Device, read_first_lines
from .live_log import is_live_log, read_live_device
from .mvnx import read_mvnx
from .opensim import read_opensim
from .rosbag import SUFFIXES as ROSBAGS
from .rosbag import is_rosbag, read_rosbag
from .sensor_logger import is_sensor_logger, read_sensor_logger
from .table_format import TableFormat, detects, load_format, load_formats, read_table_format
from .xdf import is_xdf, read_xdf

# Formats that are no tables of one kind: title, and reader.
MODULES: Mapping[str, tuple[str, Callable[[Path, str | None, float | None], Device]]] = {
    "mvnx": ("Xsens MVNX", read_mvnx),
    "sensor_logger": ("recording of Sensor Logger", read_sensor_logger),
    "rosbag": ("ROS bag", read_rosbag),
    "xdf": ("XDF", read_xdf),
    "opensim": ("OpenSim table of IMU orientations", read_opensim),
    "wepose_live": ("recording of wepose live", read_live_device),
}
USES = ("raw", "orientation")


def list_formats() -> list[str]:
    """List the names of all formats."""
    return [*MODULES, *load_formats()]


def find_format(name: str, folder: Path, place: str) -> str:
    """Find a format by its name, or the path of a description from the folder of the session; `place` states it.

    Raises
    ------
    WeposeError
        It is not known; the description is missing or wrong.
    """
    if name.endswith(".toml"):
        load_format(folder / name)
        return str(folder / name)
    if name not in list_formats():
        raise BadSession(
            f"{place} = '{name}' is not known; {one_of(list_formats(), name)}; or a description, such as lab.toml"
        )
    return name


def _describe(format: str) -> TableFormat:
    return load_format(Path(format)) if format.endswith(".toml") else load_formats()[format]


def find_title(format: str) -> str:
    """Find what a file of the format is called."""
    return MODULES[format][0] if format in MODULES else _describe(format).title


def is_whole(format: str) -> bool:
    """Return whether all sensors of a recording are in one file."""
    return format in ("mvnx", "opensim", "rosbag", "xdf") or (format not in MODULES and _describe(format).whole)


def may_be_folder(format: str) -> bool:
    """Return whether a recording may be a folder."""
    return format in ("sensor_logger", "rosbag") or (format not in MODULES and bool(_describe(format).files))


def detect_format(path: Path) -> str | None:
    """Detect the format of a file or folder from its suffix and first lines; None: none of them.

    A description beside the file (`*.toml` with `detect`) goes before those of the package; its path is the format.

    Raises
    ------
    MissingFile
        The file is not readable.
    """
    if not (path.is_file() or path.is_dir()) and path.exists():
        return None
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".zip", ".json"):
        tests = {"rosbag": is_rosbag, "sensor_logger": is_sensor_logger}
        return next((format for format, test in tests.items() if test(path)), None) or _detect_table(path, "")
    if is_live_log(path):
        return "wepose_live"
    by_suffix = {".mvnx": "mvnx", ".sto": "opensim", **dict.fromkeys(ROSBAGS, "rosbag")}
    if suffix in by_suffix or is_xdf(path):
        return by_suffix.get(suffix, "xdf")
    if suffix not in (".csv", ".tsv", ".txt", ".xml"):
        return None
    start = "\n".join(read_first_lines(path, 40))
    if "<mvnx" in start:
        return "mvnx"
    if suffix == ".csv" and is_sensor_logger(path):
        return "sensor_logger"
    return _detect_table(path, start)


def _detect_table(path: Path, start: str) -> str | None:
    for file in sorted((path if path.is_dir() else path.parent).glob("*.toml")):
        try:
            if detects(load_format(file), path, start):
                return str(file)
        except WeposeError:  # another TOML, such as a session
            continue
    return next((name for name, format in load_formats().items() if detects(format, path, start)), None)


def read_device(path: Path, format: str, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a file of this format, one of `list_formats` or the path of a description.

    `use` selects "raw" or "orientation" of a file with both; `rate_hz` replaces its own clock.

    Raises
    ------
    MissingFile, BadData
        The file is missing, damaged, or of another format.
    """
    title = find_title(format)
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder; a {title} is wanted here")
    if not (path.is_file() or path.is_dir()):
        raise MissingFile(f"{path}: is no regular file; a {title} is wanted here")
    if path.is_dir() and not may_be_folder(format):
        raise MissingFile(f"{path}: is a folder; a {title} is wanted here")
    if format in MODULES:
        device = MODULES[format][1](path, use, rate_hz)
    else:
        device = read_table_format(_describe(format), path, use, rate_hz)
    for table in (device.table, *device.own_tables.values()):
        if not table["time"].is_finite().any():
            raise BadData(f"{path}: no row with a time in it; the export is empty or cut off")
    return device
