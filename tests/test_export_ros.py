"""Bags, MCAP files and recordings of rerun, each read back by the package of its format."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from arms import JOINTS, write_arm
from scipy.spatial.transform import Rotation
from test_export import LENGTHS, a_pose, write_folder
from test_export_robot import place_by_pinocchio, read_positions, write_trajectory_folder

from wepose_pin import Pose, WeposeError, export, load_model
from wepose_pin.body.configuration import solve_configuration
from wepose_pin.body.kinematics import compute_link_poses

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trajectory_folder(tmp_path_factory.mktemp("robot") / "arm", seconds=3.0)


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


@pytest.mark.parametrize(
    ("name", "read", "options"),
    [
        ("bag", read_bag, {}),
        ("x.mcap", read_bag, {"turned": (0.3, -0.2, 0.5), "continuous": "yaw"}),
        ("x.mcap", read_mcap, {"mimic": True}),
    ],
)
def test_a_bag_has_the_joints_and_the_links_of_the_robot(
    tmp_path: Path, name: str, read: Any, options: dict[str, Any]
) -> None:
    """Of a robot whose base is turned, whose joint turns without end, or is a copy of another."""
    folder = write_trajectory_folder(tmp_path / "arm", seconds=3.0)
    (tmp_path / "other").mkdir()
    write_arm(tmp_path / "other", **options).replace(folder / "robot.urdf")
    assert export(folder, tmp_path / name, "mcap" if "." in name else "rosbag").diagnostics == []
    messages = read(tmp_path / name)
    counts = {topic: len(each) for topic, each in messages.items()}
    assert counts == {"/robot_description": 1, "/tf_static": 1, "/joint_states": 150, "/tf": 150}
    assert messages["/robot_description"][0][1].data == (folder / "robot.urdf").read_text()
    for k in (0, 1, 149):
        time_ns, state = messages["/joint_states"][k]
        assert list(state.name) == list(JOINTS)
        np.testing.assert_array_equal(state.position, read_positions(folder)[k])
        assert time_ns == state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == max(1, k * 20_000_000)
        placed, expected = place_links(messages, k), place_by_pinocchio(folder, k)
        assert set(expected) - set(placed) <= {"world"}
        for link, M in placed.items():
            np.testing.assert_allclose(M, expected[link], atol=1e-12)


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


def test_a_rate_and_a_phase_of_a_trajectory(trajectory: Path, tmp_path: Path) -> None:
    """Between samples it is on the cubics: of sin(wt) they are off by at most (wh)^4 / 384."""
    export(trajectory, tmp_path / "x.mcap", phase="reach:1", rate_hz=25.0)
    states = read_bag(tmp_path / "x.mcap")["/joint_states"]
    assert len(states) == 25
    assert states[0][0] == 2_000_000_000
    for k in (0, 1, 24):
        np.testing.assert_allclose(states[k][1].position, read_positions(trajectory)[100 + 2 * k], atol=1e-12)
    export(trajectory, tmp_path / "y.mcap", rate_hz=400.0)
    finer = np.array([state.position for _, state in read_bag(tmp_path / "y.mcap")["/joint_states"]])
    truth = read_positions(write_trajectory_folder(tmp_path / "arm", seconds=3.0, rate_hz=400.0))
    assert np.abs(finer - truth[: len(finer)]).max() < 0.8 * (2.0 / 50.0) ** 4 / 384


@pytest.mark.parametrize(
    ("module", "name", "package"),
    [("rosbags.interfaces", "x.mcap", "rosbags"), ("rerun", "x.rrd", "rerun-sdk"), ("ezc3d", "x.c3d", "ezc3d")],
)
def test_without_its_package_a_format_says_which(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, name: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(WeposeError, match=f"pip install {package}"):
        export(result, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.peer
def test_rerun_reads_the_recording(trajectory: Path, result: Path, pose: Pose, tmp_path: Path) -> None:
    """By rerun's own catalogue (rerun-sdk[catalog]); numbers are single precision there."""
    rr = pytest.importorskip("rerun")
    pytest.importorskip("datafusion")
    export(trajectory, tmp_path / "robot.rrd")
    export(result, tmp_path / "person.rrd")
    with rr.server.Server(datasets={n: [str(tmp_path / f"{n}.rrd")] for n in ("robot", "person")}) as server:
        robot, person = (server.client().get_dataset(name) for name in ("robot", "person"))
        table = robot.filter_contents(["/joints/elbow", "/body/hand"]).reader(index="time").to_arrow_table()
        seconds = np.array([time.total_seconds() for time in table["time"].to_pylist()])
        np.testing.assert_allclose(seconds, np.arange(150) / 50.0, atol=1e-9)
        elbow = np.array(table["/joints/elbow:Scalars:scalars"].to_pylist())[:, 0]
        np.testing.assert_array_equal(elbow, read_positions(trajectory)[:, JOINTS.index("elbow")])
        at = np.array(table["/body/hand:Transform3D:translation"].to_pylist())[:, 0]
        for k in (0, 149):
            np.testing.assert_allclose(at[k], place_by_pinocchio(trajectory, k)["hand"][:3, 3], atol=1e-6)
        table = person.filter_contents(["/body/left_forearm"]).reader(index="time").to_arrow_table()
        turned = np.array(table["/body/left_forearm:Transform3D:quaternion"].to_pylist())[:, 0]
        np.testing.assert_allclose(np.abs(np.sum(turned * pose.quat_WL["left_forearm"], axis=1)), 1.0, atol=1e-6)
        shapes = {column for column in map(str, person.schema().column_names()) if "left_forearm/" in column}
        assert any("Mesh3D" in column for column in shapes)
