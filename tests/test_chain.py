"""Mechanisms: a made-up arm whose truth is known, and a UR5 beside its encoders."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from commands import run
from scipy.spatial.transform import Rotation

from benchmarks.ur5_arm import UPRIGHT, UR5, write_table, write_ur5_session, write_urdf
from wepose_pin import (
    ImuSensor,
    OrientationSensor,
    Recording,
    Subject,
    WeposeError,
    load_model,
    load_result,
    load_session,
    track,
)
from wepose_pin.recording import compute_mount
from wepose_pin.tracking import Tracker, track_chunks
from wepose_pin.writers import write_session

RATE = 100.0


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_urdf(tmp_path_factory.mktemp("ur5"))


def turned(model: pin.Model, q: np.ndarray, link: str) -> Rotation:
    """Orientations of a link in W."""
    data, frame = model.createData(), model.getFrameId(link)
    rows = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        rows.append(data.oMf[frame].rotation.copy())
    return Rotation.from_matrix(rows)


def made(urdf: Path, links: list[str], seconds: float = 30.0) -> tuple[Recording, np.ndarray]:
    """A recording of noiseless sensors, put on squarely, and the configurations (n, nq) behind it.

    They measure no acceleration but gravity.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    t = np.arange(0.0, seconds, 1.0 / RATE)
    start = [UPRIGHT.get(name, 0.0) for name in model.names[1:]]
    rise = np.clip((t - 4.0) / 2.0, 0.0, 1.0)[:, None] ** 2
    rng = np.random.default_rng(0)
    q = start + rise * 0.5 * (np.sin(np.outer(t, rng.uniform(0.3, 1.0, model.nq)) + rng.uniform(0.0, 6.0, model.nq)))
    sensors = {}
    for link in links:
        R_WL = turned(model, q, link)
        mount = compute_mount("-y", "-x")  # S to a frame that equals W at the start
        R_WS = R_WL * R_WL[0].inv() * Rotation.from_quat(mount)
        gyro = np.zeros((len(t), 3))
        gyro[1:] = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE
        sensors[link] = ImuSensor(gyro_S=gyro, accel_S=R_WS.inv().apply([0.0, 0.0, 9.81]), stated_quat_LS=mount)
    phases = {"start": ((0.5, 3.5),)}
    return Recording("made", t, RATE, sensors, phases=phases, start_pose="configuration", joints=UPRIGHT), q


def test_sensors_on_all_links_give_all_joints(urdf: Path) -> None:
    recording, q = made(urdf, ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"])
    tracked = track(recording, model=urdf)
    assert tracked.summary["undetermined_joints"] == []
    assert list(tracked.joints) == list(UR5)
    for k, value in enumerate(tracked.joints.values()):
        assert np.abs(value - q[:, k]).max() < np.deg2rad(1.0)
    for name, span in tracked.summary["joints"].items():
        ends = tracked.joints[name].min(), tracked.joints[name].max()
        assert (span["min"], span["max"]) == pytest.approx(ends, abs=1e-5)
    residual_deg = tracked.summary["orientation_residual_rms_deg"]
    assert set(residual_deg) == set(recording.sensors)
    assert max(residual_deg.values()) < 0.5
    assert "orientation-residual" not in {each.code for each in tracked.diagnostics}


def test_a_sensor_that_the_joints_contradict_is_named(urdf: Path) -> None:
    """Turned by 20 deg about the vertical of the start pose, which gravity does not show; and lost at the end."""
    recording, _ = made(urdf, ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"])
    right, turn = recording.imus["forearm_link"], Rotation.from_rotvec([0.0, np.deg2rad(20.0), 0.0])
    gap = recording.time > recording.time[-1] - 5.0
    wrong = replace(right, gyro_S=turn.apply(right.gyro_S), accel_S=turn.apply(right.accel_S), gap=gap)
    tracked = track(replace(recording, sensors={**recording.sensors, "forearm_link": wrong}), model=urdf)
    assert "forearm_link" in {each.place for each in tracked.diagnostics if each.code == "orientation-residual"}


def test_what_the_links_leave_open_is_named_and_the_rest_is_right(urdf: Path) -> None:
    recording, q = made(urdf, ["forearm_link"])
    tracked = track(recording, model=urdf)
    undetermined = {"shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"}
    assert set(tracked.summary["undetermined_joints"]) == undetermined
    joints = tracked.joints
    np.testing.assert_allclose(joints["shoulder_pan_joint"], q[:, 0], atol=np.deg2rad(1.0))
    both = joints["shoulder_lift_joint"] + joints["elbow_joint"]
    np.testing.assert_allclose(both, q[:, 1] + q[:, 2], atol=np.deg2rad(1.0))
    (diagnostic,) = [d for d in tracked.summary["diagnostics"] if d["code"] == "sensors-missing"]
    assert diagnostic["facts"]["joints"].startswith("shoulder_lift_joint, elbow_joint")


def test_open_joints_are_warned_of_beside_missing_sensors(tmp_path: Path) -> None:
    write_table(arm := write_urdf(tmp_path))
    diagnostics = track(made(arm, ["forearm_link"], 10.0)[0], model=arm).diagnostics
    assert [d.severity for d in diagnostics if d.code == "sensors-missing"] == ["warning", "info"]


def test_the_command_writes_joints_orientations_and_torques(urdf: Path, data: Path, tmp_path: Path) -> None:
    write_ur5_session(data, "circle-250", tmp_path)
    out = tmp_path / "out"
    assert run("track", tmp_path, "--model", urdf, "--torques", "-o", out) == 0
    assert {file.name for file in out.iterdir()} == {
        "joints.parquet",
        "model.toml",
        "pose.parquet",
        "report.html",
        "subject.toml",
        "subject.urdf",
        "summary.json",
        "torques.parquet",
        "view.html",
    }
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["torques"]["mass_kg"] == 6.0
    assert "elbow_joint" in summary["undetermined_joints"]
    joints, pose = pl.read_parquet(out / "joints.parquet"), pl.read_parquet(out / "pose.parquet")
    assert joints.columns == ["time", *UR5]
    assert {"forearm_link_qw", "wrist_1_link_qx", "wrist_1_link_std"} <= set(pose.columns)
    assert len(joints) == len(pose) == len(pl.read_parquet(out / "torques.parquet"))
    assert "the orientation of each link to ±" in (out / "report.html").read_text(encoding="utf-8")

    read = load_result(out)
    assert list(read.model.table.segments) == ["forearm_link", "wrist_1_link"]
    np.testing.assert_array_equal(read.joints["elbow_joint"], joints["elbow_joint"].to_numpy())


SESSION = """name = "arm"
start_pose = "configuration"
[data]
file = "arm.csv"
rate_hz = 100.0
gyro_unit = "rad/s"
accel_unit = "m/s^2"
[phases]
start = [[0.0, 2.0]]
[joints]
elbow_joint = 0.5
[sensors.forearm_link]
gyro = ["gx", "gy", "gz"]
accel = ["ax", "ay", "az"]
mount = { up = "+z", forward = "+x" }
"""


@pytest.mark.parametrize(
    ("old", "new", "error", "text"),
    [
        ("elbow_joint", "elbow_jiont", WeposeError, r"joints\.elbow_jiont is no joint .*did you mean 'elbow_joint'"),
        ("= 0.5", "= 7.0", WeposeError, r"joints\.elbow_joint = 7 is outside its limits, -6\.3 to 6\.3"),
        ("= 0.5", '= "up"', WeposeError, r"joints\.elbow_joint = 'up'; a finite number is needed"),
        ("forearm_link", "forearm", WeposeError, r"sensors\.forearm is no link of arm; did you mean 'forearm_link'"),
        ('"configuration"', '"n_pose"', WeposeError, "joints needs start_pose"),
    ],
)
def test_what_a_session_of_a_chain_may_not_say(
    urdf: Path, tmp_path: Path, old: str, new: str, error: type[WeposeError], text: str
) -> None:
    table = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (500, 1))
    pl.DataFrame(table, schema=["gx", "gy", "gz", "ax", "ay", "az"], orient="row").write_csv(tmp_path / "arm.csv")
    file = tmp_path / "session.toml"
    file.write_text(SESSION, encoding="utf-8")
    assert track(load_session(file), model=urdf).summary["start_joints"] == {"elbow_joint": 0.5}
    file.write_text(SESSION.replace(old, new), encoding="utf-8")
    with pytest.raises(error, match=text):
        track(load_session(file), model=urdf)


def test_a_mechanism_and_a_person_are_not_mixed_up(urdf: Path) -> None:
    recording, _ = made(urdf, ["forearm_link"], 6.0)
    with pytest.raises(WeposeError, match=r"sensors\.forearm_link is no segment of upper_body"):
        track(recording)
    with pytest.raises(WeposeError, match="start_pose = 'n_pose' is not known; there is: configuration"):
        track(replace(recording, start_pose="n_pose", joints={}), model=urdf)
    with pytest.raises(WeposeError, match=r"sensors\.torso is no link of"):
        track(replace(recording, sensors={"torso": recording.sensors["forearm_link"]}), model=urdf)


def test_values_of_a_joint_without_end_go_on(tmp_path: Path) -> None:
    file = tmp_path / "wheel.urdf"
    file.write_text(
        '<robot name="wheel"><link name="base"/><link name="rim"/><joint name="axle" type="continuous">'
        '<parent link="base"/><child link="rim"/><axis xyz="0 0 1"/></joint></robot>',
        encoding="utf-8",
    )
    angle = np.clip(np.linspace(-3.0, 9.0, 1200), 0.0, None)
    sensor = OrientationSensor(Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_quat(), np.eye(4)[3])
    recording = Recording("w", np.arange(1200) / 50.0, 50.0, {"rim": sensor}, {"start": ((0.5, 4.5),)})
    for start in (0.0, 0.3):
        tracked = track(replace(recording, start_pose="configuration", joints={"axle": start}), model=file)
        np.testing.assert_allclose(tracked.joints["axle"], start + angle, atol=1e-9)


MARKED_WITH_SENSORS = ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"]
TABLE = """urdf = "arm.urdf"
kind = "mechanism"
[segments]
upper = "upper_arm_link"
fore = "forearm_link"
wrist = "wrist_1_link"
tool = "wrist_3_link"
[points]
elbow = "forearm_link"
wrist = "wrist_1_link"
tip = { link = "wrist_3_link", at = [0.0, 0.0, -0.1] }
[lengths]
upper = { segment = "fore", from = "elbow", to = "wrist" }
[poses.home]
shoulder_lift_joint = -1.5707963267948966
wrist_1_joint = -1.5707963267948966
"""


@pytest.fixture
def table(urdf: Path, tmp_path: Path) -> Path:
    """A table of the arm's own, and the URDF beside it."""
    (tmp_path / "arm.urdf").write_bytes(urdf.read_bytes())
    (tmp_path / "arm.toml").write_text(TABLE, encoding="utf-8")
    return tmp_path / "arm.toml"


def as_segments(recording: Recording) -> Recording:
    """The recording with the table's names, from its named pose."""
    names = dict(zip(MARKED_WITH_SENSORS, ("upper", "fore", "wrist", "tool"), strict=True))
    sensors = {names[link]: sensor for link, sensor in recording.sensors.items()}
    return replace(recording, sensors=sensors, start_pose="home", joints={})


def test_a_table_names_segments_points_and_the_start_pose(urdf: Path, table: Path) -> None:
    recording, q = made(urdf, MARKED_WITH_SENSORS, 12.0)
    # Open loop: a table may name points between which sensors sit, which tell of headings.
    tracked = track(replace(as_segments(recording), model=str(table)), open_loop=True)
    bare = track(recording, model=urdf, open_loop=True)
    for name, values in bare.joints.items():
        np.testing.assert_allclose(tracked.joints[name], values, atol=1e-9)
    model, body = load_model(table), pin.buildModelFromUrdf(str(urdf))
    assert set(tracked.points) == {"elbow", "wrist", "tip"} == set(tracked.pose.point_cov)
    data = body.createData()
    for k in (0, 600, 1100):
        pin.framesForwardKinematics(body, data, q[k])
        M = data.oMf[body.getFrameId("wrist_3_link")]
        np.testing.assert_allclose(tracked.points["tip"][k], M.act(np.array([0.0, 0.0, -0.1])), atol=0.01)
    assert tracked.subject.lengths == pytest.approx(dict(model.lengths))
    longer = Subject("long", {"upper": 0.5}, ("upper",), np.array([[1e-4]]))
    again = track(replace(as_segments(recording), model=str(table)), longer)
    assert again.model.lengths["upper"] == pytest.approx(0.5)
    reach = np.linalg.norm(again.points["wrist"] - again.points["elbow"], axis=1)
    np.testing.assert_allclose(reach, 0.5, atol=1e-9)


def test_chunks_and_causal_tracking_give_the_joints_of_the_whole(urdf: Path) -> None:
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 20.0)
    whole = track(recording, model=urdf)
    parts = list(track_chunks(Tracker(model=urdf), recording, 6.0))
    assert len(parts) > 1
    for name, values in whole.joints.items():
        np.testing.assert_array_equal(np.concatenate([part.joints[name] for part in parts]), values)
    causal = track(recording, model=urdf, causal=True)
    last = len(causal.time)
    for name, values in causal.joints.items():
        np.testing.assert_allclose(values, whole.joints[name][-last:], atol=np.deg2rad(0.5))


def test_a_person_may_begin_in_another_pose() -> None:
    """Segment frames are W's in the N-pose; in the T-pose the arms' are turned by a right angle."""
    recording = t_pose_recording()
    by_name = track(recording)
    joints = {"left_upper_arm_x": 1.5708, "right_upper_arm_x": -1.5708}
    by_joints = track(replace(recording, start_pose="configuration", joints=joints))
    for tracked in (by_name, by_joints):
        begin = {name: Rotation.from_quat(quat[0]) for name, quat in tracked.quat_WL.items()}
        for side, angle_deg in (("left", 90.0), ("right", -90.0)):
            turn = Rotation.from_euler("x", angle_deg, degrees=True)
            assert np.degrees((begin[f"{side}_upper_arm"] * turn.inv()).magnitude()) < 1.0
            palm, shoulder = tracked.points[f"{side}_palm"][0], tracked.points[f"{side}_shoulder"][0]
            assert abs((palm - shoulder)[2]) < 0.01
        assert np.degrees(begin["torso"].magnitude()) < 1.0
    with pytest.raises(WeposeError, match=r"joints\.left_upper_arm_x = 9 is outside its limits"):
        track(replace(recording, start_pose="configuration", joints={"left_upper_arm_x": 9.0}))


def test_a_session_names_a_body_of_the_package(tmp_path: Path) -> None:
    recording = replace(t_pose_recording(), start_pose="n_pose", model="whole_body")
    write_session(tmp_path, recording)
    assert load_session(tmp_path).model == "whole_body"
    tracked = track(load_session(tmp_path))
    assert {"pelvis", "left_thigh"} <= set(tracked.model.table.segments)
    out = tmp_path / "out"
    assert run("track", tmp_path, "--no-view", "--no-report", "-o", out) == 0
    read = load_result(out)
    for part in ("segments", "lengths", "poses"):
        assert list(getattr(read.model.table, part)) == list(getattr(tracked.model.table, part))
    np.testing.assert_allclose(read.quat_WL["torso"], tracked.quat_WL["torso"], atol=1e-15)
    text = (tmp_path / "session.toml").read_text(encoding="utf-8")
    for wrong in ("whole_boddy", "none.urdf"):
        (tmp_path / "session.toml").write_text(text.replace("whole_body", wrong), encoding="utf-8")
        with pytest.raises(WeposeError, match=r"did you mean 'whole_body'|no such file 'none\.urdf' beside"):
            track(load_session(tmp_path))


def t_pose_recording() -> Recording:
    """A person of five sensors, put on squarely, in the T-pose."""
    n = 600
    mount = compute_mount("+z", "+x")
    rng = np.random.default_rng(0)
    sensors = {
        name: ImuSensor(
            gyro_S=1e-3 * rng.standard_normal((n, 3)),
            accel_S=[0.0, 0.0, 9.81] + 1e-2 * rng.standard_normal((n, 3)),
            stated_quat_LS=mount,
        )
        for name in ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
    }
    return Recording("t", np.arange(n) / RATE, RATE, sensors, {"start": ((0.5, 4.0),)}, start_pose="t_pose")
