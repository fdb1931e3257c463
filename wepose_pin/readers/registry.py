"""The formats of devices and other programs, their detection, and those that are no tables of one kind.

Formats here are OpenSim's orientations, ROS bags, XDF and Sensor Logger; `mvnx`, `live_log` and `table_format` have the
others.
"""

import contextlib
import logging
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..data_tables import read_body, read_columns, read_first_lines, read_table
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, BadSession, WeposeError, one_of
from ..libraries import check_file, find_plugins, import_library, library_errors, load_plugin
from ..recording.limits import STANDARD_GRAVITY
from .device import ACCEL_UNITS, Device, Signal, check_measured, convert, join_signals, make_device, open_folder
from .guess import group_columns
from .live_log import is_live_log, read_live_device
from .mvnx import read_mvnx
from .table_format import TableFormat, load_format, load_formats

TEXTS = (".csv", ".tsv", ".txt", ".xml")  # whose first lines may tell the format


class Format(NamedTuple):
    """A format of a device or program."""

    title: str  # what a file of it is called
    detects: Callable[[Path, str], bool]  # path, which may be a folder, and the first lines of a text → is it one?
    # Path, "raw" or "orientation" or None, and a rate [Hz] or None → the contents: raw data where a sensor has them,
    # else orientations, or only what is asked for; with a rate its times are replaced.
    read: Callable[[Path, str | None, float | None], Device]
    whole: bool = False  # all sensors of a recording are in one file
    folder: bool = False  # a recording may be a folder


def look_up_format(name: str) -> Format | TableFormat:
    """Look up a format by its name, or the path of a description."""
    if name in find_plugins("readers"):
        return load_plugin("readers", name)
    return load_format(Path(name)) if name.endswith(".toml") else load_formats()[name]


def find_format(name: str, folder: Path, place: str) -> str:
    """Find a format by its name, or the path of a description from the folder of the session; `place` states it."""
    if name.endswith(".toml"):
        return str(folder / name)
    if name not in (known := [*find_plugins("readers"), *load_formats()]):
        raise BadSession(f"{place} = '{name}' is not known; {one_of(known, name)}; or a description, such as lab.toml")
    return name


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


def _has_suffix(path: Path, *suffixes: str) -> bool:
    return path.suffix.lower() in suffixes


# OpenSim -------------------------------------------------------------------------------------------------------------
# The header line of files that `wepose export` wrote, in OpenSim's ground. OpenSim takes it for a remark.
OWN_STO = ("Frames", "bodies of Rajagopal's model in ground")


def read_opensim(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the orientations of all columns of a .sto but time, as `Format.read`.

    Lines ``key=value`` up to ``endheader`` come first, then names and rows with tabs. A cell ``w,x,y,z`` is a
    quaternion of the sensor to its world, z up as the device had it. Source: OpenSim documentation, OpenSense.
    """
    lines = read_first_lines(path)
    end = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise BadData(f"{path}: no line 'endheader' in its first {len(lines)} lines; an OpenSim .sto file has one")
    about = {key.strip().lower(): value.strip() for key, _, value in (line.partition("=") for line in lines[:end])}
    if about.get("datatype", "").lower() != "quaternion":
        kind = about.get("datatype") or "none"
        raise BadData(f"{path}: DataType={kind}; orientations are needed, DataType=Quaternion, as of OpenSense")
    if about.get(OWN_STO[0].lower()) == OWN_STO[1]:
        raise BadData(f"{path}: was written by `wepose export`; use the result that it was made from")
    signals = {}
    with library_errors(path, "an OpenSim .sto"):
        cells = pl.read_csv(read_body(path, end + 1), separator="\t", infer_schema=False)
        cells = cells.with_columns(pl.all().str.strip_chars(" \r~[]()")).rename(str.strip)
        cells = cells.drop_nulls(cells.columns[0])
        time = cells["time"].cast(pl.Float64).to_numpy()
    for label in cells.columns[1:]:
        with library_errors(path, f"quaternions w,x,y,z, one a row, in column '{label}'"):
            wxyz = cells[label].str.split(",").list.to_array(4).cast(pl.Array(pl.Float64, 4)).to_numpy()
            signals[label] = {"orientation": Signal(time, wxyz[:, [1, 2, 3, 0]])}
    device = make_device(path, signals, "gyroscope and accelerometer, a .sto has orientations", use, rate_hz)
    return device._replace(since_power_on=False)


# ROS bags ------------------------------------------------------------------------------------------------------------

MESSAGE = "sensor_msgs/msg/Imu"


def is_rosbag(path: Path) -> bool:
    """Return whether a folder or a file is a bag."""
    is_bag = _has_suffix(path, ".db3", ".mcap", ".bag") and not is_live_log(path)
    return is_bag or (path / "metadata.yaml").is_file()


def read_rosbag(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a bag of ROS 1 or 2, as `Format.read`; a sensor is a topic, or each frame of one that has several.

    Messages sensor_msgs/Imu have angular_velocity [rad/s], linear_acceleration [m/s²] with gravity, and the orientation
    of the sensor to a world with z up. A quantity whose covariance begins with −1 is not provided. Times are the
    headers' stamps, or the bag's where these are zero. Source: sensor_msgs/Imu and REP 145; rosbags' documentation.
    """
    highlevel = import_library("rosbags.highlevel", path, "a ROS bag")
    typesys = import_library("rosbags.typesys", path, "a ROS bag")
    frames: dict[tuple[str, str], list[list[float]]] = {}  # topic, frame → rows
    first = 0  # [ns] from which times count
    with library_errors(path, "a ROS bag"):
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([path], default_typestore=types) as reader:
            connections = [each for each in reader.connections if each.msgtype == MESSAGE]
            for connection, bag_time, raw in reader.messages(connections=connections) if connections else ():
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec or bag_time
                first = first or stamp
                row = [float(stamp - first), *_read_imu(message)]
                frames.setdefault((connection.topic, message.header.frame_id), []).append(row)
    if not frames:
        raise BadData(f"{path}: no messages of type {MESSAGE} in it; record the topics of the IMUs")
    topics = [topic for topic, _ in frames]
    signals, hints = {}, {}
    for (topic, frame), rows in frames.items():
        label = topic if topics.count(topic) == 1 else f"{topic} {frame}"
        numbers = np.array(rows)
        time = 1e-9 * numbers[:, 0]
        raw_data = {"gyro": Signal(time, numbers[:, 3:6]), "accel": Signal(time, numbers[:, 6:9])}
        signals[label] = raw_data if numbers[:, 1].all() else {}
        if numbers[:, 2].all():
            signals[label]["orientation"] = Signal(time, numbers[:, 9:13])
        hints[label] = frame
    needs = "angular_velocity and linear_acceleration, nor orientation (a covariance of -1: not provided)"
    return make_device(path, signals, needs, use, rate_hz, hints=hints)


def _read_imu(message: Any) -> list[float]:
    rate, force, quat = message.angular_velocity, message.linear_acceleration, message.orientation
    has_raw = message.angular_velocity_covariance[0] != -1.0 and message.linear_acceleration_covariance[0] != -1.0
    has_quat = message.orientation_covariance[0] != -1.0 and any((quat.x, quat.y, quat.z, quat.w))
    values = [rate.x, rate.y, rate.z, force.x, force.y, force.z, quat.x, quat.y, quat.z, quat.w]
    return [float(has_raw), float(has_quat), *map(float, values)]


# XDF -----------------------------------------------------------------------------------------------------------------

XDF_MAGIC = b"XDF:", b"\x1f\x8b"  # the latter of gzip
_SIGNAL_WORDS = re.compile("accelerometer|gyroscope|accel|gyro|acc|gyr")


def read_xdf(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the streams of an XDF, as LabRecorder writes those of the lab streaming layer; as `Format.read`.

    A stream is one sensor or several, whose channels have labels and units (``acc_x`` in ``m/s^2``); what they measure
    is found by their labels as in tables. pyxdf brings the clocks to one. Source: sccn/xdf, specification; pyxdf.
    """
    pyxdf = import_library("pyxdf", path, "an XDF")
    with path.open("rb") as file:  # pyxdf leaves another file open
        if not file.read(4).startswith(XDF_MAGIC):
            raise BadData(f"{path}: is no XDF: it does not begin with 'XDF:'")
    logging.getLogger("pyxdf").setLevel(logging.CRITICAL)  # it reports what it mends
    with library_errors(path, "an XDF"):
        streams, _ = pyxdf.load_xdf(str(path))
    sensors: dict[str, dict[str, Signal]] = {}
    diagnostics: list[Diagnostic] = []
    if any(not stream.get("footer") for stream in streams):
        diagnostics.append(Diagnostic("file-incomplete", WARNING, path.name, facts={"variant": "footer"}))
    for stream in streams:
        values = stream["time_series"]
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or len(values) < 2:
            continue
        name = stream["info"]["name"][0] or "stream"
        columns = [f"{name} {label}" for label in _read_channels(stream, "label", values.shape[1])]
        units = dict(zip(columns, _read_channels(stream, "unit", values.shape[1]), strict=True))
        groups = group_columns(columns)
        for owner, signals in groups.items():
            label = name if owner == f"?{name.lower()}" or len(groups) == 1 else owner.removeprefix("?")
            for signal, channels in signals.items():
                read = values[:, [columns.index(channel) for channel in channels]].astype(float)
                check_measured(f"{path}: {signal} of {label}", read)
                if signal != "orientation":
                    unit = units[channels[0]] or _guess_unit(signal, read)
                    read = convert(path, signal, read, unit, channels[0])
                    if not units[channels[0]]:
                        facts = {"columns": channels[0], "unit": unit}
                        diagnostics.append(Diagnostic("file-assumption", WARNING, path.name, facts=facts))
                sensors.setdefault(label, {}).setdefault(signal, Signal(stream["time_stamps"], read))
    joined: dict[str, dict[str, Signal]] = {}  # rates with the forces of a stream whose name differs in that word alone
    for label, streamed in sensors.items():
        shared = _SIGNAL_WORDS.sub("", label.lower()).strip(" _-./") or label
        own = joined.setdefault(label if len(streamed) > 1 else shared, {})
        own |= {signal: values for signal, values in streamed.items() if signal not in own}
    needs = "gyroscope and accelerometer, nor orientation, by the labels of its channels; they need labels as gyr_x"
    return make_device(path, joined, needs, use, rate_hz, diagnostics)


def _read_channels(stream: Mapping[str, Any], key: str, count: int) -> list[str]:
    """Read a text of each channel; empty where the stream describes none."""
    try:
        channels = stream["info"]["desc"][0]["channels"][0]["channel"]
        texts = [((channel.get(key) or [""])[0] or "").strip() for channel in channels]
    except (KeyError, IndexError, TypeError, AttributeError):
        texts = []
    return [*texts, *[""] * count][:count]


def _guess_unit(signal: str, values: np.ndarray) -> str:
    """Guess the unit of a signal: SI, or that in which the specific force is gravity's."""
    if signal == "gyro":
        return "rad/s"
    norm = max(float(np.nanmedian(np.linalg.norm(values, axis=1))), 1e-9)
    return min(ACCEL_UNITS, key=lambda unit: abs(np.log(norm * ACCEL_UNITS[unit] / STANDARD_GRAVITY)))


# Sensor Logger -------------------------------------------------------------------------------------------------------

PHONE_COLUMNS = {
    **dict.fromkeys(("Gyroscope", "TotalAcceleration", "Accelerometer", "Gravity"), ("x", "y", "z")),
    "Orientation": ("qx", "qy", "qz", "qw"),
}


def is_sensor_logger(path: Path) -> bool:
    """Return whether a folder, a zip or a file is one of Sensor Logger's."""
    if not (path.is_dir() or _has_suffix(path, ".zip", *TEXTS)):
        return False
    names = {f"{name}.csv" for name in PHONE_COLUMNS}
    if path.is_file() and path.suffix.lower() != ".zip":
        names &= {path.name}
    with open_folder(path) as files:
        starts = [read_first_lines(files[name], 1)[0] for name in names & set(files)]
    return any(start.startswith("time,seconds_elapsed,") for start in starts)


def read_sensor_logger(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a phone's folder or zip, which has a CSV for each sensor, as `Format.read`.

    Columns are ``time`` [ns since 1970], ``seconds_elapsed``, then the axes from z to x. Gyroscope [rad/s];
    TotalAcceleration, or Accelerometer (without gravity) and Gravity [m/s²]; Orientation ``qz, qy, qx, qw`` to a world
    with z up. Accelerations have Android's sign (+g up at rest); an iPhone's have the opposite unless the app's setting
    standardises them, which Metadata says. Source: tszheichoi/awesome-sensor-logger, and published recordings.
    """
    with open_folder(path) as files:
        named = {name: files.get(f"{name}.csv") for name in (*PHONE_COLUMNS, "Metadata")}
        tables = {name: read_table(file) for name, file in named.items() if file is not None}
    signals = {}
    for name, columns in PHONE_COLUMNS.items():
        if name in tables:
            values = read_columns(tables[name], ["time", *columns], f"{name}.csv", str(path))
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
    needs = "Gyroscope with TotalAcceleration, or Accelerometer and Gravity, nor Orientation"
    return make_device(path, {label: phone}, needs, use, rate_hz, diagnostics)


# pyproject.toml registers them as those of other distributions.
MVNX = Format("Xsens MVNX", lambda path, start: _has_suffix(path, ".mvnx") or "<mvnx" in start, read_mvnx, whole=True)
PHONE = "recording of Sensor Logger"
SENSOR_LOGGER = Format(PHONE, lambda path, _: is_sensor_logger(path), read_sensor_logger, folder=True)
ROSBAG = Format("ROS bag", lambda path, _: is_rosbag(path), read_rosbag, whole=True, folder=True)
XDF = Format("XDF", lambda path, _: _has_suffix(path, ".xdf", ".xdfz"), read_xdf, whole=True)
STO = "OpenSim table of IMU orientations"
OPENSIM = Format(STO, lambda path, _: _has_suffix(path, ".sto"), read_opensim, whole=True)
WEPOSE_LIVE = Format("recording of wepose live", lambda path, _: is_live_log(path), read_live_device, whole=True)
