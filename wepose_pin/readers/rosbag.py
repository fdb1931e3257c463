"""ROS bags with messages sensor_msgs/Imu: of ROS 2 (a folder, or a lone .db3 or .mcap) and of ROS 1 (.bag), by rosbags.

angular_velocity [rad/s], linear_acceleration [m/s²] with gravity, orientation of the sensor to a world with z up. A
quantity whose covariance begins with −1 is not provided. Times are the headers' stamps, or the bag's where these are
zero. A sensor is a topic; where one topic has several frames, each of these.

Source: sensor_msgs/Imu and REP 145; rosbags' documentation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BadData
from ..libraries import import_library, library_errors
from .device import Device, Signal, make_device

SUFFIXES = (".db3", ".mcap", ".bag")
MESSAGE = "sensor_msgs/msg/Imu"
NS = 1e-9
NEEDS = "angular_velocity and linear_acceleration, nor orientation (a covariance of -1: not provided)"


def read_rosbag(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a bag, as `Format.read`; `rate_hz` replaces the stamps."""
    frames = _read_messages(path)
    if not frames:
        raise BadData(f"{path}: no messages of type {MESSAGE} in it; record the topics of the IMUs")
    topics = [topic for topic, _ in frames]
    signals, hints = {}, {}
    for (topic, frame), messages in frames.items():
        label = topic if topics.count(topic) == 1 else f"{topic} {frame}"
        numbers = np.array(messages)
        time, has_raw, has_orientation = NS * numbers[:, 0], numbers[:, 1].all(), numbers[:, 2].all()
        raw = {"gyro": Signal(time, numbers[:, 3:6]), "accel": Signal(time, numbers[:, 6:9])}
        orientation = {"orientation": Signal(time, numbers[:, 9:13])}
        signals[label] = (raw if has_raw else {}) | (orientation if has_orientation else {})
        hints[label] = frame
    return make_device(path, signals, NEEDS, use, rate_hz, hints=hints)


def _read_messages(path: Path) -> dict[tuple[str, str], list[list[float]]]:
    """Read rows of numbers by topic and frame; times count from the first message, in ns."""
    highlevel = import_library("rosbags.highlevel", path, "a ROS bag")
    typesys = import_library("rosbags.typesys", path, "a ROS bag")
    frames: dict[tuple[str, str], list[list[float]]] = {}
    first = 0
    with library_errors(path, "a ROS bag"):
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([path], default_typestore=types) as reader:
            wanted = [each for each in reader.connections if each.msgtype == MESSAGE]
            for connection, bag_time, raw in reader.messages(connections=wanted) if wanted else ():
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec or bag_time
                first = first or stamp
                row = [float(stamp - first), *_read_values(message)]
                frames.setdefault((connection.topic, message.header.frame_id), []).append(row)
    return frames


def _read_values(message: Any) -> list[float]:
    """Read whether raw data and an orientation are provided, and the values."""
    rate, force, quat = message.angular_velocity, message.linear_acceleration, message.orientation
    raw = message.angular_velocity_covariance[0] != -1.0 and message.linear_acceleration_covariance[0] != -1.0
    turned = message.orientation_covariance[0] != -1.0 and any((quat.x, quat.y, quat.z, quat.w))
    values = [rate.x, rate.y, rate.z, force.x, force.y, force.z, quat.x, quat.y, quat.z, quat.w]
    return [float(raw), float(turned), *map(float, values)]
