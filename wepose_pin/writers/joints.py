"""Motions by joints for other programs: ROS 2 and rerun, of a person or a robot; LeRobot's data sets, of robots.

Sources: sensor_msgs/JointState, tf2_msgs/TFMessage, REP 105 (frames); rosbags' documentation; rerun-sdk 0.41; lerobot
0.4.4, lerobot/datasets/lerobot_dataset.py and utils.py.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from ..body.urdf import Mesh, package_folders, reduce_triangles, triangulate
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, BadOption, WrongOption, native_stderr_muted, one_of
from ..libraries import import_library
from ..rotations import multiply
from .motion import ROBOT_URDF, JointMotion, LinkTransform, compute_link_transforms, is_even
from .result import write_table

# ROS 2 ---------------------------------------------------------------------------------------------------------------

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
    """Write a bag with the topics of `TYPES`; a stamp is the motion's time [s], and that of 0, none in ROS, is 1 ns."""
    qos = import_library("rosbags.interfaces", "`format` rosbag, mcap", "a ROS bag")
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
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform, stamped = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/TransformStamped"]

    def make_header(stamp_ns: int, frame: str) -> Any:
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def make_transforms(stamp_ns: int, links: Mapping[str, LinkTransform], k: int) -> Any:
        transforms = []
        for link, (parent, quat, p) in links.items():
            place = transform(translation=vector(*p[k].tolist()), rotation=quaternion(*quat[k].tolist()))
            transforms.append(stamped(make_header(stamp_ns, parent), child_frame_id=link, transform=place))
        return types["tf2_msgs/msg/TFMessage"](transforms=transforms)

    time = motion.time - min(0.0, motion.time[0])
    stamps = np.maximum(np.rint(1e9 * time), 1).astype(np.int64).tolist()
    root = LinkTransform(FIXED_FRAME, motion.quat_WB[None], motion.p_WB[None])
    placed = {motion.root: root} | compute_link_transforms(motion)
    still = {link: each for link, each in placed.items() if len(each.p) == 1}
    moving = {link: each for link, each in placed.items() if link not in still}
    yield "/robot_description", stamps[0], types["std_msgs/msg/String"](data=motion.urdf)
    yield "/tf_static", stamps[0], make_transforms(stamps[0], still, 0)
    joints = list(motion.moving)
    position, velocity = np.stack([motion.values(joint) for joint in joints], axis=2)
    for k, stamp in enumerate(stamps):
        state = types["sensor_msgs/msg/JointState"]
        yield "/joint_states", stamp, state(make_header(stamp, ""), joints, position[k], velocity[k], np.empty(0))
        if moving:
            yield "/tf", stamp, make_transforms(stamp, moving, k)


# Rerun ---------------------------------------------------------------------------------------------------------------


def write_rrd(path: Path, motion: JointMotion) -> None:
    """Write entities ``body/LINK``, with its transform in W and its shapes, and ``joints/JOINT`` [rad or m]."""
    try:
        import rerun as rr
    except ImportError:
        raise BadOption("`format` rrd: needs rerun: pip install rerun-sdk") from None
    recording = rr.RecordingStream("wepose", recording_id=f"{motion.name} {motion.time[0]:g}", send_properties=False)
    recording.save(path)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    index = [rr.TimeColumn("time", duration=motion.time)]
    for link, (quat, p) in _compute_link_poses_W(motion).items():
        entity = f"body/{rr.escape_entity_path_part(link)}"
        if np.ptp(p, axis=0).any() or np.ptp(quat, axis=0).any():
            columns = rr.Transform3D.columns(translation=p, quaternion=quat)
            recording.send_columns(entity, indexes=index, columns=columns)
        else:
            place = rr.Transform3D(translation=p[0], quaternion=rr.Quaternion(xyzw=quat[0]))
            recording.log(entity, place, static=True)
    for k, (link, (vertices, triangles), rgba) in enumerate(_load_meshes(motion)):
        mesh = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=rgba)
        recording.log(f"body/{rr.escape_entity_path_part(link)}/{k}", mesh, static=True)
    for joint in motion.moving:
        entity = f"joints/{rr.escape_entity_path_part(joint)}"
        recording.send_columns(entity, indexes=index, columns=rr.Scalars.columns(scalars=motion.values(joint)[0]))
    recording.flush()
    recording.disconnect()


def _compute_link_poses_W(motion: JointMotion) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compute xyzw (n, 4) and [m] (n, 3) of every link in W, parents before children."""
    n = len(motion.time)
    poses = {motion.root: (np.tile(motion.quat_WB, (n, 1)), np.tile(motion.p_WB, (n, 1)))}
    for link, (parent, quat, p) in compute_link_transforms(motion).items():
        quat_WP, p_WP = poses[parent]
        offset = Rotation.from_quat(quat_WP).apply(np.array(np.broadcast_to(p, (n, 3))))
        poses[link] = (multiply(quat_WP, np.broadcast_to(quat, (n, 4))), p_WP + offset)
    return poses


def _load_meshes(motion: JointMotion) -> list[tuple[str, Mesh, np.ndarray]]:
    """Load link, mesh in its frame and colour of all shapes; none where a file of a mesh is not found."""
    folders, kind = package_folders(Path(motion.where) / ROBOT_URDF), pin.GeometryType.VISUAL
    try:
        with native_stderr_muted():
            model = pin.buildModelFromXML(motion.urdf)
            shapes = pin.buildGeomFromUrdfString(model, motion.urdf, kind, package_dirs=folders).geometryObjects
    except (ValueError, RuntimeError):
        return []
    links, meshes = [], []
    for shape in shapes:
        frame = model.frames[shape.parentFrame]
        placed = frame.placement.inverse() * shape.placement
        vertices, triangles = triangulate(shape.geometry)
        links.append((frame.name, np.asarray(shape.meshColor).ravel()))
        meshes.append((vertices @ placed.rotation.T + placed.translation, triangles))
    return [(link, mesh, rgba) for (link, rgba), mesh in zip(links, reduce_triangles(meshes), strict=True)]


# LeRobot -------------------------------------------------------------------------------------------------------------

STATE, ACTION = "observation.state", "action"
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
FILE = Path("chunk-000", "file-000.parquet")

# A motion that is one episode, the state (joints,) that follows it, and what the robot does in it.
Episode = tuple[JointMotion, np.ndarray, str]


def write_lerobot(
    folder: Path, motions: Sequence[JointMotion], episodes: str | None = None, instruction: str | None = None
) -> list[Diagnostic]:
    """Write a data set of version 3.0 into an existing folder; the action is the positions of the next frame.

    ``data/`` has a row a frame of all episodes one after another, ``meta/`` their beginnings, tasks and statistics.
    `episodes`: the intervals of this phase; None: the motions. `instruction`: the task of all; None: "follow NAME", and
    the name of the phase.
    """
    rate_hz, diagnostics = _check_alike(motions), list[Diagnostic]()
    listed = [each for motion in motions for each in _list_episodes(motion, episodes, instruction, diagnostics)]
    tasks = list(dict.fromkeys(task for _, _, task in listed))
    lengths = [len(part.time) for part, _, _ in listed]
    begins, episode = np.cumsum([0, *lengths]), np.repeat(np.arange(len(listed)), lengths)
    index = np.arange(begins[-1])
    columns = {
        STATE: _to_lists([part.position for part, _, _ in listed]),
        ACTION: _to_lists([rows for part, after, _ in listed for rows in (part.position[1:], after[None])]),
        "timestamp": ((index - begins[episode]) / rate_hz).astype(np.float32),
        "frame_index": index - begins[episode],
        "episode_index": episode,
        "index": index,
        "task_index": np.array([tasks.index(task) for _, _, task in listed])[episode],
    }
    frames = pl.DataFrame(columns)
    for name in ("data", "meta/episodes"):
        (folder / name / FILE).parent.mkdir(parents=True)
    write_table(folder / "data" / FILE, frames)
    about: dict[str, Any] = {
        "episode_index": np.arange(len(listed)),
        "tasks": [[task] for _, _, task in listed],
        "length": lengths,
        "dataset_from_index": begins[:-1],
        "dataset_to_index": begins[1:],
    }
    for name in ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index"):
        about[name] = np.zeros(len(listed), dtype=np.int64)
    stats = [_compute_stats(frames.slice(*span)) for span in zip(begins, lengths, strict=False)]
    for feature, of_feature in stats[0].items():
        about |= {f"stats/{feature}/{name}": [each[feature][name] for each in stats] for name in of_feature}
    write_table(folder / "meta" / "episodes" / FILE, pl.DataFrame(about))
    _write_tasks(folder / "meta" / "tasks.parquet", tasks)
    info = json.loads(Path(__file__).with_name("lerobot.json").read_text(encoding="utf-8"))  # what all data sets have
    info |= {"robot_type": motions[0].name, "total_episodes": len(listed), "total_frames": int(begins[-1])}
    info |= {"total_tasks": len(tasks), "fps": rate_hz, "splits": {"train": f"0:{len(listed)}"}}
    names = list(motions[0].joints)
    joints = {"dtype": "float32", "shape": [len(names)], "names": names}
    info["features"] |= {STATE: joints, ACTION: joints}
    for name, content in (("stats", _compute_stats(frames)), ("info", info)):
        (folder / "meta" / f"{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
    return diagnostics


def _list_episodes(
    motion: JointMotion, by: str | None, instruction: str | None, diagnostics: list[Diagnostic]
) -> list[Episode]:
    """List the episodes of a motion; intervals that it does not follow become a diagnostic."""
    text = instruction or f"follow {motion.source or motion.name}"
    if by is None:
        return [(motion, motion.position[-1], text)]
    spans = motion.phases.get(by, ())
    text += "" if instruction else f", {by}"
    parts = [part for span in spans if (part := motion.samples(span)).stop - part.start >= 2]
    if not parts:
        why = "the trajectory follows none of it" if spans else "it has no such phase"
        known = [name for name, intervals in motion.phases.items() if intervals and name != by]
        raise WrongOption("episodes", by, f"{motion.where}: {why}; {one_of(known, by)}")
    if len(parts) < len(spans):
        first, last = motion.recorded_time[[motion.begin, -1]]
        facts: dict[str, float | str] = {"count": float(len(spans)), "recorded": f"{first:g} to {last:g} s"}
        diagnostics.append(Diagnostic("episodes-cut", WARNING, by, float(len(spans) - len(parts)), facts=facts))
    last_row = len(motion.time) - 1
    return [(motion.cut(part), motion.position[min(part.stop, last_row)], text) for part in parts]


def _check_alike(motions: Sequence[JointMotion]) -> int:
    """Return the whole rate [Hz] that all motions have."""
    first, *others = motions
    descriptions = [f"robot {each.name}, {each.rate_hz:g} Hz, joints {', '.join(each.joints)}" for each in motions]
    for other, description in zip(others, descriptions[1:], strict=True):
        if description != descriptions[0]:
            reason = f"and {first.where} is of {descriptions[0]}; `rate_hz` makes one rate of all"
            raise BadData(f"{other.where}: {description}; a data set has one robot and one rate, {reason}")
    rate_hz = round(first.rate_hz)
    if not is_even(first.time) or abs(rate_hz - first.rate_hz) > 1e-3:
        stated = f"{first.where}: {first.rate_hz:g} samples a second, or times that are uneven"
        raise BadData(f"{stated}; a data set has a whole number of them, which `rate_hz` makes")
    return rate_hz


def _to_lists(parts: Sequence[np.ndarray]) -> pl.Series:
    return pl.Series(np.vstack(parts).astype(np.float32), dtype=pl.Array(pl.Float32, parts[0].shape[1]))


def _compute_stats(table: pl.DataFrame) -> dict[str, dict[str, list[Any]]]:
    """Return feature → statistic → a value for each of its components."""
    stats = {}
    for feature in table.columns:
        values = table[feature].to_numpy().reshape(len(table), -1).astype(float)
        of_feature = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        of_feature |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
        stats[feature] = {name: each.tolist() for name, each in of_feature.items()} | {"count": [len(values)]}
    return stats


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks as pandas writes a table whose index is their text; pyarrow stores what pandas says of it."""
    pyarrow = import_library("pyarrow", "`format` lerobot", "a data set")
    from pyarrow import parquet

    index, keys = "__index_level_0__", ("name", "field_name", "pandas_type", "numpy_type", "metadata")
    kinds = ("task_index", "task_index", "int64", "int64", None), (None, index, "unicode", "object", None)
    columns = [dict(zip(keys, kind, strict=True)) for kind in kinds]
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pyarrow.table({"task_index": list(range(len(tasks))), index: list(tasks)})
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)
