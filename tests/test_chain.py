"""Mechanisms: a made-up arm whose truth is known, and a UR5 beside its encoders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.ur5_arm import UPRIGHT, UR5, write_ur5_session, write_urdf
from wepose_pin.body import BodyModel, load_model
from wepose_pin.body.body import load_sensed_model
from wepose_pin.body.kinematics import KinematicsSolver
from wepose_pin.body.links import compute_link_poses, compute_point_covariances
from wepose_pin.body.mounts import compute_start_configuration
from wepose_pin.body.subject import Subject, load_subject
from wepose_pin.commands import main
from wepose_pin.commands.track import track as track_session
from wepose_pin.errors import WeposeError
from wepose_pin.live import LivePose, Output, SensorSetup, run_session
from wepose_pin.live.sources.replay import ReplaySource
from wepose_pin.readers import load_session
from wepose_pin.readers.live_log import read_live_log
from wepose_pin.recording import CONFIGURATION, ImuSensor, Recording, compute_mount
from wepose_pin.tracking import summarize, track, track_chunks
from wepose_pin.writers import write_session
from wepose_pin.writers.result import read_result, write_subject

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


def load(urdf: Path) -> BodyModel:
    """The arm with all of its links as segments."""
    return load_sensed_model(urdf, [link for link, *_ in UR5.values()], "test")


def made(urdf: Path, links: list[str], seconds: float = 30.0) -> tuple[Recording, np.ndarray]:
    """A recording of noiseless sensors, put on squarely, and the configurations (n, nq) behind it.

    They measure no acceleration but gravity.
    """
    body = load(urdf)
    model = body.pin
    t = np.arange(0.0, seconds, 1.0 / RATE)
    start = compute_start_configuration(body, CONFIGURATION, UPRIGHT, "made")
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
    return Recording("made", t, RATE, sensors, phases=phases, start_pose=CONFIGURATION, joints=UPRIGHT), q


def rms_deg(angle: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def test_sensors_on_all_links_give_all_joints(urdf: Path) -> None:
    recording, q = made(urdf, ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"])
    tracked = track(recording, model=urdf)
    assert tracked.find_undetermined_joints() == []
    assert list(tracked.joints) == list(UR5)
    for k, value in enumerate(tracked.joints.values()):
        assert np.abs(value - q[:, k]).max() < np.deg2rad(1.0)
    residual = tracked.compute_orientation_residuals()
    assert set(residual) == set(recording.sensors)
    assert max(rms_deg(angle) for angle in residual.values()) < 0.5


def test_the_ranges_of_joints_are_those_of_all_samples(urdf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wepose_pin.tracking.summary.MOST_SAMPLES", 20)
    tracked = track(made(urdf, ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"])[0], model=urdf)
    for name, span in summarize(tracked).content["joints"].items():
        assert span["min"] == round(float(tracked.joints[name].min()), 5)
        assert span["max"] == round(float(tracked.joints[name].max()), 5)


def test_what_the_links_leave_open_is_named_and_the_rest_is_right(urdf: Path) -> None:
    recording, q = made(urdf, ["forearm_link"])
    tracked = track(recording, model=urdf)
    undetermined = {"shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"}
    assert set(tracked.find_undetermined_joints()) == undetermined
    joints = tracked.joints
    np.testing.assert_allclose(joints["shoulder_pan_joint"], q[:, 0], atol=np.deg2rad(1.0))
    both = joints["shoulder_lift_joint"] + joints["elbow_joint"]
    np.testing.assert_allclose(both, q[:, 1] + q[:, 2], atol=np.deg2rad(1.0))
    (diagnostic,) = [d for d in summarize(tracked).content["diagnostics"] if d["code"] == "sensors-missing"]
    assert diagnostic["facts"]["joints"].startswith("shoulder_lift_joint, elbow_joint")


def test_the_command_writes_joints_orientations_and_torques(
    urdf: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ur5_session(data, "circle-250", tmp_path)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(["track", str(tmp_path), "--model", str(urdf), "--torques", "-o", str(out)])
    assert end.value.code == 0
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

    capsys.readouterr()
    read, model, _ = read_result(out)
    assert model.table.is_mechanism
    assert list(model.table.segments) == ["forearm_link", "wrist_1_link"]
    np.testing.assert_array_equal(read.joints["elbow_joint"], joints["elbow_joint"].to_numpy())
    assert model.pin.nq == 6


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
    assert summarize(track(load_session(file), model=urdf)).content["start_joints"] == {"elbow_joint": 0.5}
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
    body = load_sensed_model(file, ["rim"], "test")
    angle, time = np.linspace(0.0, 9.0, 200), np.arange(200.0)
    quat = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_quat()
    solver = KinematicsSolver(body, ["rim"])
    chunks = [solver.solve_chunk(time[part], {"rim": quat[part]}) for part in (slice(0, 150), slice(150, 200))]
    np.testing.assert_allclose(np.concatenate([pose.joints["axle"] for pose in chunks]), angle, atol=1e-9)
    np.testing.assert_allclose(compute_start_configuration(body, CONFIGURATION, {"axle": 0.3}, "x"), [0.3])


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
    model, body = load_model(table), load(urdf).pin
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


@pytest.mark.slow
def test_the_covariance_of_points_is_that_of_many_fits(urdf: Path, table: Path) -> None:
    """Orientations and the length drawn from what is stated of them; two of the arm's six axes carry no sensor."""
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 8.0)
    subject = Subject("s", {"upper": 0.392}, ("upper",), np.array([[0.01**2]]))
    tracked = track(replace(as_segments(recording), model=str(table)), subject)
    at, rng, n = 700, np.random.default_rng(0), 600
    cov = {name: np.diag(rng.uniform(0.5, 2.0, 3) * 1e-4) for name in tracked.quat_WL}
    quat = {
        name: (
            Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), cov[name], n)) * Rotation.from_quat(q[at])
        ).as_quat()
        for name, q in tracked.quat_WL.items()
    }
    segments = list(quat)
    q = KinematicsSolver(tracked.model, segments, start=tracked.q[at]).solve_chunk(np.arange(float(n)), quat).q
    lengths = rng.normal(0.392, 0.01, n)
    placed = {point: [] for point in tracked.points}
    for row, length in zip(q, lengths, strict=True):
        body = tracked.model.with_lengths({"upper": float(length)})
        _, p_W = compute_link_poses(body, row[None], [body.point_frames[point] for point in placed], rotations=False)
        for k, point in enumerate(placed):
            placed[point].append(p_W[0, k])
    stated = compute_point_covariances(
        tracked.model,
        {name: tracked.quat_WL[name][at : at + 1] for name in segments},
        {name: cov[name][None] for name in segments},
        subject.lengths_covariance(["upper"]),
        tracked.q[at : at + 1],
    )
    for point, positions in placed.items():
        sampled, expected = np.cov(np.array(positions).T), stated[point][0]
        assert np.linalg.norm(sampled - expected) < 0.25 * np.linalg.norm(expected)


def test_a_joint_that_slides_stays_where_it_is(urdf: Path, tmp_path: Path) -> None:
    """Orientations do not tell of it: it is undetermined, and what it moves is not written."""
    slider = (
        '<link name="rod"/><joint name="slider" type="prismatic"><parent link="wrist_1_link"/><child link="rod"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint></robot>'
    )
    text = urdf.read_text(encoding="utf-8").replace("</robot>", slider)
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    table = TABLE.replace("[lengths]", 'rod = "rod"\n[lengths]')
    table = table.replace("[poses.home]", "[poses.home]\nslider = 0.2")
    (tmp_path / "arm.toml").write_text(table, encoding="utf-8")
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 8.0)
    subject = Subject("s", {"upper": 0.392}, ("upper",), np.array([[0.01**2]]))
    tracked = track(replace(as_segments(recording), model=str(tmp_path / "arm.toml")), subject)
    assert tracked.find_undetermined_joints() == ["slider"]
    assert set(tracked.points) == {"elbow", "wrist", "tip"}
    np.testing.assert_allclose(tracked.joints["slider"], 0.2, atol=1e-9)


def test_calibrated_mounts_are_those_of_the_links(urdf: Path, table: Path) -> None:
    """A mount R_LS that was found holds from any start configuration; a stated one is of the start pose."""
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 12.0)
    recording = replace(as_segments(recording), model=str(table))
    stated = track(recording)
    names = list(recording.sensors)
    order = tuple(f"mounts.{name}.{axis}" for name in names for axis in "xyz")
    person = Subject(
        "arm", dict(load_model(table).lengths), order, 1e-6 * np.eye(len(order)), mounts=dict(stated.segments.quat_LS)
    )
    bare = {name: replace(sensor, stated_quat_LS=None) for name, sensor in recording.sensors.items()}
    tracked = track(replace(recording, sensors=bare), person)
    for name, values in stated.joints.items():
        np.testing.assert_allclose(tracked.joints[name], values, atol=np.deg2rad(0.1))


def test_chunks_and_causal_tracking_give_the_joints_of_the_whole(urdf: Path) -> None:
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 20.0)
    whole = track(recording, model=urdf)
    parts = list(track_chunks(recording, model=urdf, chunk_s=6.0))
    assert len(parts) > 1
    for name, values in whole.joints.items():
        np.testing.assert_array_equal(np.concatenate([part.joints[name] for part in parts]), values)
    causal = track(recording, model=urdf, causal=True)
    last = len(causal.time)
    for name, values in causal.joints.items():
        np.testing.assert_allclose(values, whole.joints[name][-last:], atol=np.deg2rad(0.5))


def test_a_mechanism_live(urdf: Path, tmp_path: Path, data: Path) -> None:
    """What is displayed and recorded live is what causal tracking of the recording gives."""
    write_ur5_session(data, "circle-250", tmp_path)
    recording = replace(load_session(tmp_path), model=str(urdf))
    shown: list[LivePose] = []

    class Shown(Output):
        def show(self, pose: LivePose) -> None:
            shown.append(pose)

    setup = SensorSetup.from_recording(recording.cut(slice(0, 1200)))
    source = ReplaySource(recording.cut(slice(0, 1200)), np.inf)
    file = tmp_path / "live.mcap"
    summary = run_session(source, setup, record=file, outputs=[Shown()])
    log = read_live_log(file)
    assert (log.recording.start_pose, log.recording.model) == (CONFIGURATION, str(urdf))
    assert log.recording.joints == recording.joints
    tracked = track(log.recording, causal=True)
    assert len(tracked.time) == summary.poses == len(log.quat_WL)
    for i, name in enumerate(recording.sensors):
        np.testing.assert_array_equal(tracked.segments.quat_WL[name], log.quat_WL[:, i])
        at = int(np.argmin(np.abs(tracked.time - shown[-1].time)))
        off = Rotation.from_quat(shown[-1].quat_WL[i]).inv() * Rotation.from_quat(tracked.quat_WL[name][at])
        assert off.magnitude() < np.deg2rad(0.2)


def test_a_subject_of_a_body_without_lengths(urdf: Path, tmp_path: Path) -> None:
    """It holds mounts alone; its files give the same result again."""
    recording, _ = made(urdf, MARKED_WITH_SENSORS, 8.0)
    tracked = track(recording, model=urdf)
    person = replace(tracked.subject, mounts=dict(tracked.segments.quat_LS))
    write_subject(tmp_path, person, tracked.model)
    again = track(recording, load_subject(tmp_path), model=tmp_path / "subject.urdf")
    assert again.model.table.is_mechanism
    for name, values in tracked.joints.items():
        np.testing.assert_allclose(again.joints[name], values, atol=1e-6)
    with pytest.raises(WeposeError, match=r"trunk, shoulder_width.* of the body upper_body is missing"):
        track(replace(recording, sensors={"torso": recording.sensors["forearm_link"]}, start_pose="n_pose"), person)


def test_a_result_on_another_body_does_not_stay(urdf: Path, data: Path, tmp_path: Path) -> None:
    """Its table and its joints would be read with the next result in the same folder."""
    write_ur5_session(data, "circle-100", tmp_path)
    out = tmp_path / "out"
    track_session(tmp_path, out=out, model=urdf, view=False, report=False)
    assert (out / "model.toml").is_file()
    assert (out / "joints.parquet").is_file()
    (tmp_path / "person").mkdir()
    write_session(tmp_path / "person", replace(t_pose_recording(), start_pose="n_pose"))
    track_session(tmp_path / "person", out=out, view=False, report=False, force=True)
    assert not (out / "model.toml").exists()
    assert not (out / "joints.parquet").exists()
    assert not read_result(out)[1].table.is_mechanism


def test_a_person_may_begin_in_another_pose() -> None:
    """Segment frames are W's in the N-pose; in the T-pose the arms' are turned by a right angle."""
    recording = t_pose_recording()
    by_name = track(recording)
    joints = {"left_upper_arm_x": 1.5708, "right_upper_arm_x": -1.5708}
    by_joints = track(replace(recording, start_pose=CONFIGURATION, joints=joints))
    for tracked in (by_name, by_joints):
        begin = {name: Rotation.from_quat(quat[0]) for name, quat in tracked.quat_WL.items()}
        for side, angle_deg in (("left", 90.0), ("right", -90.0)):
            turn = Rotation.from_euler("x", angle_deg, degrees=True)
            assert np.degrees((begin[f"{side}_upper_arm"] * turn.inv()).magnitude()) < 1.0
            palm, shoulder = tracked.points[f"{side}_palm"][0], tracked.points[f"{side}_shoulder"][0]
            assert abs((palm - shoulder)[2]) < 0.01
        assert np.degrees(begin["torso"].magnitude()) < 1.0
    with pytest.raises(WeposeError, match=r"joints\.left_upper_arm_x = 9 is outside its limits"):
        track(replace(recording, start_pose=CONFIGURATION, joints={"left_upper_arm_x": 9.0}))


def test_a_session_names_a_body_of_the_package(tmp_path: Path) -> None:
    recording = replace(t_pose_recording(), start_pose="n_pose", model="whole_body")
    write_session(tmp_path, recording)
    assert load_session(tmp_path).model == "whole_body"
    tracked = track(load_session(tmp_path))
    assert {"pelvis", "left_thigh"} <= set(tracked.model.table.segments)
    out = tmp_path / "out"
    track_session(tmp_path, out=out, view=False, report=False)
    pose, model, _ = read_result(out)
    assert list(model.table.segments) == list(tracked.model.table.segments)
    assert list(model.table.lengths) == list(tracked.model.table.lengths)
    assert list(model.table.poses) == list(tracked.model.table.poses)
    np.testing.assert_allclose(pose.quat_WL["torso"], tracked.quat_WL["torso"], atol=1e-15)
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
