"""ROS 2 bags of a person or a robot, by rosbags: a folder with SQLite, or one MCAP file with the same messages.

Topics: ``/robot_description`` (the URDF), ``/joint_states``, ``/tf`` and ``/tf_static``. The fixed frame is ``map``.
Stamps are the motion's times [s]; that of 0, which means none in ROS, is 1 ns.

Source: sensor_msgs/JointState, tf2_msgs/TFMessage, REP 105 (frames); rosbags' documentation.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..libraries import import_library
from .motion import JointMotion, LinkTransform, compute_link_transforms

FIXED_FRAME = "map"
TYPES = {
    "/robot_description": "std_msgs/msg/String",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
}
LATCHED = ("/robot_description", "/tf_static")
NAME = "motion"  # of the file in a bag's folder
BAG_VERSION = 8


def write_rosbag(folder: Path, motion: JointMotion) -> None:
    """Write a bag into an existing folder: ``metadata.yaml`` and ``motion.db3``."""
    _write_bag(folder / NAME, motion, "SQLITE3")
    for path in sorted((folder / NAME).iterdir()):
        path.replace(folder / path.name)
    (folder / NAME).rmdir()


def write_mcap(path: Path, motion: JointMotion) -> None:
    """Write the messages of a bag as one MCAP file, its chunks compressed by zstd."""
    with tempfile.TemporaryDirectory(prefix=path.name, dir=path.parent) as folder:
        _write_bag(Path(folder) / NAME, motion, "MCAP")
        (Path(folder) / NAME / f"{NAME}.mcap").replace(path)


def _write_bag(folder: Path, motion: JointMotion, storage: str) -> None:
    qos = import_library("rosbags.interfaces", "--format rosbag, mcap", "a ROS bag")
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, never = get_typestore(Stores.ROS2_HUMBLE), qos.QosTime(0, 0)
    reliable, transient = qos.QosReliability.RELIABLE, qos.QosDurability.TRANSIENT_LOCAL
    automatic = qos.QosLiveliness.AUTOMATIC
    latched = qos.Qos(qos.QosHistory.KEEP_LAST, 1, reliable, transient, never, never, automatic, never, False)
    bag = Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin[storage])
    if storage == "MCAP":  # of a bag with SQLite only whole files or messages could be, which not every reader takes
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag as writer:
        profiles = {topic: [latched] if topic in LATCHED else [] for topic in TYPES}
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=profiles[topic])
            for topic, kind in TYPES.items()
        }
        for topic, time_ns, message in _list_messages(motion, store.types):
            writer.write(connections[topic], time_ns, store.serialize_cdr(message, TYPES[topic]))


def _list_messages(motion: JointMotion, types: Any) -> Iterator[tuple[str, int, Any]]:
    """List topic, time [ns] and message, of the types of a store, in the order of time."""
    time = motion.time - min(0.0, motion.time[0])
    stamps = np.maximum(np.rint(1e9 * time), 1).astype(np.int64).tolist()
    transforms = compute_link_transforms(motion)
    placed = {motion.root: LinkTransform(FIXED_FRAME, motion.quat_WB[None], motion.p_WB[None])} | transforms
    moving = {link: each for link, each in placed.items() if not each.fixed}
    still = {link: each for link, each in placed.items() if each.fixed}
    yield "/robot_description", stamps[0], types["std_msgs/msg/String"](data=motion.urdf)
    yield "/tf_static", stamps[0], _make_transforms(types, stamps[0], still, 0)
    joints = list(motion.moving)
    position, velocity = (np.stack([get(joint) for joint in joints], axis=1) for get in (motion.values, motion.rates))
    for k, stamp in enumerate(stamps):
        header = _make_header(types, stamp, "")
        state = types["sensor_msgs/msg/JointState"](header, joints, position[k], velocity[k], np.empty(0))
        yield "/joint_states", stamp, state
        if moving:
            yield "/tf", stamp, _make_transforms(types, stamp, moving, k)


def _make_transforms(types: Any, stamp_ns: int, links: Mapping[str, LinkTransform], k: int) -> Any:
    """Make the message of the transforms of some links at sample `k`."""
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform, stamped = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/TransformStamped"]
    transforms = []
    for link, (parent, quat, p) in links.items():
        place = transform(translation=vector(*p[k].tolist()), rotation=quaternion(*quat[k].tolist()))
        transforms.append(stamped(_make_header(types, stamp_ns, parent), child_frame_id=link, transform=place))
    return types["tf2_msgs/msg/TFMessage"](transforms=transforms)


def _make_header(types: Any, stamp_ns: int, frame: str) -> Any:
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)
