"""Bags, MCAP files and recordings of rerun, each read back by the package of its format."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from arms import JOINTS
from scipy.spatial.transform import Rotation
from test_export import LENGTHS, a_pose, write_folder
from test_export_robot import write_trajectory_folder

from wepose_pin.body import load_model
from wepose_pin.body.configuration import solve_configuration
from wepose_pin.body.kinematics import Pose
from wepose_pin.body.links import compute_link_poses
from wepose_pin.errors import BadOption
from wepose_pin.writers.export import export
from wepose_pin.writers.motion import JointMotion, compute_link_poses_W, read_joint_motion
from wepose_pin.writers.rrd import _load_meshes

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trajectory_folder(tmp_path_factory.mktemp("robot") / "arm", seconds=3.0)


@pytest.fixture(scope="module")
def motion(trajectory: Path) -> JointMotion:
    return read_joint_motion(trajectory)


@pytest.fixture(scope="module")
def pose() -> Pose:
    return a_pose(n=60)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, pose: Pose) -> Path:
    return write_folder(tmp_path_factory.mktemp("person") / "result", pose)


def read_bag(path: Path) -> dict[str, list[Any]]:
    """Topic → messages with their bag's time [ns], by rosbags."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        messages: dict[str, list[Any]] = {connection.topic: [] for connection in reader.connections}
        for connection, time_ns, raw in reader.messages():
            messages[connection.topic].append((time_ns, reader.deserialize(raw, connection.msgtype)))
    return messages


def read_mcap(path: Path) -> dict[str, list[Any]]:
    """The same by mcap, and messages by mcap-ros2-support, from the schemas in the file."""
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    messages: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for _, channel, message, value in reader.make_reader(
            file, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, value))
    return messages


def place_links(messages: dict[str, list[Any]], k: int) -> dict[str, np.ndarray]:
    """Link → (4, 4) in the fixed frame at the k-th /tf, through all parents."""
    parents = {}
    for each in [*messages["/tf_static"][0][1].transforms, *messages["/tf"][k][1].transforms]:
        M, turn, at = np.eye(4), each.transform.rotation, each.transform.translation
        M[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        M[:3, 3] = [at.x, at.y, at.z]
        parents[each.child_frame_id] = (each.header.frame_id, M)

    def place(link: str) -> np.ndarray:
        parent, M = parents[link]
        return M if parent == "map" else place(parent) @ M

    return {link: place(link) for link in parents}


@pytest.mark.parametrize(("name", "read"), [("bag", read_bag), ("x.mcap", read_bag), ("x.mcap", read_mcap)])
def test_a_bag_has_the_joints_and_the_links_of_the_robot(
    trajectory: Path, motion: JointMotion, tmp_path: Path, name: str, read: Any
) -> None:
    assert export(trajectory, tmp_path / name, "mcap" if "." in name else "rosbag").diagnostics == []
    messages = read(tmp_path / name)
    assert {topic: len(each) for topic, each in messages.items()} == {
        "/robot_description": 1,
        "/tf_static": 1,
        "/joint_states": 150,
        "/tf": 150,
    }
    assert messages["/robot_description"][0][1].data == (trajectory / "robot.urdf").read_text()
    for k in (0, 1, 149):
        time_ns, state = messages["/joint_states"][k]
        assert list(state.name) == list(JOINTS)
        np.testing.assert_array_equal(state.position, motion.position[k])
        np.testing.assert_array_equal(state.velocity, motion.velocity[k])
        assert time_ns == state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == max(1, k * 20_000_000)
        placed = place_links(messages, k)
        for link, (quat, p) in compute_link_poses_W(motion).items():
            np.testing.assert_allclose(placed[link][:3, 3], p[k], atol=1e-12)
            np.testing.assert_allclose(placed[link][:3, :3], Rotation.from_quat(quat[k]).as_matrix(), atol=1e-12)


def test_a_person_is_a_robot_of_revolute_joints(result: Path, pose: Pose, tmp_path: Path) -> None:
    """URDF and joint states through Pinocchio, which joins nothing here, against the pose; and so is /tf."""
    export(result, tmp_path / "x.mcap")
    messages = read_mcap(tmp_path / "x.mcap")
    model = pin.buildModelFromXML(messages["/robot_description"][0][1].data)
    data = model.createData()
    own = load_model(lengths=LENGTHS)
    links = list(pose.quat_WL)
    _, p_W = compute_link_poses(own, solve_configuration(own, pose.quat_WL), links)
    for k in (0, 17, 59):
        time_ns, state = messages["/joint_states"][k]
        assert time_ns == round(1e9 * pose.time[k])
        assert set(state.name) == set(model.names[1:])
        q = np.array([state.position[state.name.index(name)] for name in model.names[1:]])
        pin.framesForwardKinematics(model, data, q)
        placed = place_links(messages, k)
        for i, (link, quat) in enumerate(pose.quat_WL.items()):
            frame = data.oMf[model.getFrameId(link)]
            R_WL = Rotation.from_quat(quat[k]).as_matrix()
            np.testing.assert_allclose(frame.rotation, R_WL, atol=1e-9)
            np.testing.assert_allclose(frame.translation, p_W[k, i], atol=1e-9)
            np.testing.assert_allclose(placed[link][:3, :3], R_WL, atol=1e-9)
            np.testing.assert_allclose(placed[link][:3, 3], p_W[k, i], atol=1e-9)


def test_a_rate_and_a_phase_of_a_trajectory(trajectory: Path, motion: JointMotion, tmp_path: Path) -> None:
    export(trajectory, tmp_path / "x.mcap", phase="reach:1", rate_hz=25.0)
    states = read_bag(tmp_path / "x.mcap")["/joint_states"]
    assert len(states) == 25
    assert states[0][0] == 2_000_000_000
    for k in (0, 1, 24):
        np.testing.assert_allclose(states[k][1].position, motion.position[100 + 2 * k], atol=1e-12)


@pytest.mark.parametrize(
    ("module", "name", "package"),
    [("rosbags.interfaces", "x.mcap", "rosbags"), ("rerun", "x.rrd", "rerun-sdk"), ("ezc3d", "x.c3d", "ezc3d")],
)
def test_without_its_package_a_format_says_which(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, name: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(BadOption, match=f"pip install {package}"):
        export(result, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_meshes_are_in_the_frames_of_their_links(trajectory: Path, tmp_path: Path) -> None:
    """Scaled and placed as the URDF says; none where a file is not found."""
    folder = tmp_path / "robot"
    shutil.copytree(trajectory, folder)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    (folder / "parts").mkdir()
    trimesh.Trimesh(corners, faces, process=False).export(folder / "parts" / "hand.stl")
    mesh = '<geometry><mesh filename="package://parts/hand.stl" scale="0.1 0.2 0.3"/></geometry>'
    visual = f'<visual><origin xyz="0.01 0.02 0.03" rpy="0 0 {np.pi / 2.0}"/>{mesh}</visual>'
    urdf = (folder / "robot.urdf").read_text()
    assert urdf.count('<link name="hand">') == 1
    (folder / "robot.urdf").write_text(urdf.replace('<link name="hand">', f'<link name="hand">{visual}'))
    ((link, (vertices, triangles), _),) = _load_meshes(read_joint_motion(folder))
    expected = (corners * [0.1, 0.2, 0.3])[:, [1, 0, 2]] * [-1.0, 1.0, 1.0] + [0.01, 0.02, 0.03]
    assert link == "hand"
    assert len(triangles) == 4
    np.testing.assert_allclose(sorted(map(tuple, vertices)), sorted(map(tuple, expected)), atol=1e-6)
    (folder / "parts" / "hand.stl").unlink()
    assert _load_meshes(read_joint_motion(folder)) == []


@pytest.mark.peer
def test_rerun_reads_the_recording(
    trajectory: Path, motion: JointMotion, result: Path, pose: Pose, tmp_path: Path
) -> None:
    """By rerun's own catalogue (rerun-sdk[catalog]); numbers are single precision there."""
    rr = pytest.importorskip("rerun")
    pytest.importorskip("datafusion")
    export(trajectory, tmp_path / "robot.rrd")
    export(result, tmp_path / "person.rrd")
    with rr.server.Server(datasets={n: [str(tmp_path / f"{n}.rrd")] for n in ("robot", "person")}) as server:
        robot, person = (server.client().get_dataset(name) for name in ("robot", "person"))
        table = robot.filter_contents(["/joints/elbow", "/body/hand"]).reader(index="time").to_arrow_table()
        seconds = np.array([time.total_seconds() for time in table["time"].to_pylist()])
        np.testing.assert_allclose(seconds, motion.time, atol=1e-9)
        elbow = np.array(table["/joints/elbow:Scalars:scalars"].to_pylist())[:, 0]
        np.testing.assert_array_equal(elbow, motion.values("elbow"))
        _, p = compute_link_poses_W(motion)["hand"]
        at = np.array(table["/body/hand:Transform3D:translation"].to_pylist())[:, 0]
        np.testing.assert_allclose(at, p, atol=1e-6)
        table = person.filter_contents(["/body/left_forearm"]).reader(index="time").to_arrow_table()
        turned = np.array(table["/body/left_forearm:Transform3D:quaternion"].to_pylist())[:, 0]
        np.testing.assert_allclose(np.abs(np.sum(turned * pose.quat_WL["left_forearm"], axis=1)), 1.0, atol=1e-6)
        shapes = {column for column in map(str, person.schema().column_names()) if "left_forearm/" in column}
        assert any("Cylinders3D" in column or "Capsules3D" in column for column in shapes)
