"""The formats of devices and other programs, and their detection."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..errors import BadData, MissingFile, WeposeError
from .apdm import is_apdm, read_apdm
from .delsys import is_delsys, read_delsys
from .device import Device, read_first_lines
from .dot import read_dot
from .live_log import is_live_log, read_live_device
from .mt_manager import read_mt_manager
from .mvnx import read_mvnx
from .noraxon import is_noraxon, read_noraxon
from .opensim import read_opensim
from .phyphox import is_phyphox, read_phyphox
from .rosbag import SUFFIXES as ROSBAGS
from .rosbag import is_rosbag, read_rosbag
from .sensor_logger import is_sensor_logger, read_sensor_logger
from .shimmer import is_shimmer, read_shimmer
from .tables import read_layout
from .xdf import is_xdf, read_xdf
from .ximu3 import INERTIAL, QUATERNION, read_ximu3

FORMATS: Mapping[str, Callable[[Path, str | None, float | None], Device]] = {
    "mvnx": read_mvnx,
    "mt_manager": read_mt_manager,
    "dot": read_dot,
    "ximu3": read_ximu3,
    "apdm": read_apdm,
    "shimmer": read_shimmer,
    "delsys": read_delsys,
    "noraxon": read_noraxon,
    "sensor_logger": read_sensor_logger,
    "phyphox": read_phyphox,
    "rosbag": read_rosbag,
    "xdf": read_xdf,
    "opensim": read_opensim,
    "wepose_live": read_live_device,
}
TITLES = {
    "mvnx": "Xsens MVNX",
    "mt_manager": "text export of Xsens MT Manager",
    "dot": "CSV of a Movella (Xsens) DOT",
    "ximu3": "CSV of an x-io x-IMU3",
    "apdm": "CSV of APDM",
    "shimmer": "CSV of Shimmer Consensys",
    "delsys": "CSV of Delsys",
    "noraxon": "CSV of Noraxon MR3",
    "sensor_logger": "recording of Sensor Logger",
    "phyphox": "recording of phyphox",
    "rosbag": "ROS bag",
    "xdf": "XDF",
    "opensim": "OpenSim table of IMU orientations",
    "wepose_live": "recording of wepose live",
}
# Formats with all sensors of a recording in one file, and those that may be a folder.
WHOLE = ("mvnx", "opensim", "apdm", "delsys", "noraxon", "rosbag", "xdf")
FOLDERS = {"ximu3": "x-IMU3", "sensor_logger": "Sensor Logger", "phyphox": "phyphox", "rosbag": "ROS"}
USES = ("raw", "orientation")


def detect_format(path: Path) -> str | None:
    """Detect the format of a file or folder, a key of `FORMATS`, from its suffix and first lines; None: none of them.

    Raises
    ------
    MissingFile
        The file is not readable.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        return None
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".zip", ".json"):
        if path.is_dir() and any((path / name).is_file() for name in (INERTIAL, QUATERNION)):
            return "ximu3"
        tests = {"rosbag": is_rosbag, "sensor_logger": is_sensor_logger, "phyphox": is_phyphox}
        return next((format for format, test in tests.items() if test(path)), None)
    if is_live_log(path):
        return "wepose_live"
    by_suffix = {".mvnx": "mvnx", ".sto": "opensim", **dict.fromkeys(ROSBAGS, "rosbag")}
    if suffix in by_suffix or is_xdf(path):
        return by_suffix.get(suffix, "xdf")
    if suffix not in (".csv", ".tsv", ".txt", ".xml"):
        return None
    lines = read_first_lines(path, 40)
    start = "\n".join(lines)
    if "<mvnx" in start:
        return "mvnx"
    if is_apdm(lines):
        return "apdm"
    if suffix == ".csv" and (detected := _detect_csv(path, lines)):
        return detected
    if lines[0].startswith(("Timestamp (us),", "Time (s),")) and (
        "(deg/s)" in lines[0] or lines[0].endswith("W,X,Y,Z")
    ):
        return "ximu3"
    if "PacketCounter" not in start:
        return None
    if start.startswith("sep=") or "DeviceTag:" in start:
        return "dot"
    if start.startswith("//") or any(name in start for name in ("Quat_q0", "Mat[1][1]")):
        return "mt_manager"
    # Rates without another hint could be in deg/s (DOT) or rad/s (MT Manager): data.format must be stated.
    return "dot" if any(name in start for name in ("dq_W", "Quat_W", "FreeAcc_X")) and suffix == ".csv" else None


def _detect_csv(path: Path, lines: Sequence[str]) -> str | None:
    """Detect the formats that are tables with names of their own."""
    if is_delsys(lines):
        return "delsys"
    try:
        names = list(read_layout(path).names)
    except WeposeError:
        return None
    tests = {"shimmer": is_shimmer(names), "noraxon": is_noraxon(names)}
    phones = {"sensor_logger": is_sensor_logger, "phyphox": is_phyphox}
    return next((format for format, fits in tests.items() if fits), None) or next(
        (format for format, test in phones.items() if test(path)), None
    )


def read_device(path: Path, format: str, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a file of this format.

    `use` selects "raw" or "orientation" of a file with both; `rate_hz` replaces its own clock.

    Raises
    ------
    MissingFile, BadData
        The file is missing, damaged, or of another format.
    """
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder; a {TITLES[format]} is wanted here")
    if not (path.is_file() or path.is_dir()):
        raise MissingFile(f"{path}: is no regular file; a {TITLES[format]} is wanted here")
    if path.is_dir() and format not in FOLDERS:
        raise MissingFile(f"{path}: is a folder; a {TITLES[format]} is wanted here")
    device = FORMATS[format](path, use, rate_hz)
    for table in (device.table, *device.own_tables.values()):
        if not table["time"].is_finite().any():
            raise BadData(f"{path}: no row with a time in it; the export is empty or cut off")
    return device
