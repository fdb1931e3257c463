"""The formats of devices and other programs, and their detection."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from ..errors import MissingFile
from .apdm import is_apdm, read_apdm
from .device import Device, read_first_lines
from .dot import read_dot
from .live_log import is_live_log, read_live_device
from .mt_manager import read_mt_manager
from .mvnx import read_mvnx
from .opensim import read_opensim
from .ximu3 import INERTIAL, QUATERNION, read_ximu3

FORMATS: Mapping[str, Callable[[Path, str | None, float | None], Device]] = {
    "mvnx": read_mvnx,
    "mt_manager": read_mt_manager,
    "dot": read_dot,
    "ximu3": read_ximu3,
    "apdm": read_apdm,
    "opensim": read_opensim,
    "wepose_live": read_live_device,
}
TITLES = {
    "mvnx": "Xsens MVNX",
    "mt_manager": "text export of Xsens MT Manager",
    "dot": "CSV of a Movella (Xsens) DOT",
    "ximu3": "CSV of an x-io x-IMU3",
    "apdm": "CSV of APDM",
    "opensim": "OpenSim table of IMU orientations",
    "wepose_live": "recording of wepose live",
}
USES = ("raw", "orientation")


def detect_format(path: Path) -> str | None:
    """Detect the format of a file or folder, a key of `FORMATS`, from its suffix and first lines; None: none of them.

    Raises
    ------
    MissingFile
        The file is not readable.
    """
    if path.is_dir():
        return "ximu3" if any((path / name).is_file() for name in (INERTIAL, QUATERNION)) else None
    if path.exists() and not path.is_file():
        return None
    if is_live_log(path):
        return "wepose_live"
    suffix = path.suffix.lower()
    if suffix in (".mvnx", ".sto"):
        return {".mvnx": "mvnx", ".sto": "opensim"}[suffix]
    if suffix not in (".csv", ".txt", ".xml"):
        return None
    lines = read_first_lines(path, 40)
    start = "\n".join(lines)
    if "<mvnx" in start:
        return "mvnx"
    if is_apdm(lines):
        return "apdm"
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
    if path.is_dir() and format != "ximu3":
        raise MissingFile(f"{path}: is a folder; a {TITLES[format]} is wanted here")
    return FORMATS[format](path, use, rate_hz)
