"""Any chain: a made-up arm whose truth is known, and a UR5 beside its encoders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.cli import main
from wepose_pin.errors import BadModel, BadOption, BadSession, WeposeError
from wepose_pin.model.robot import joint_values, load_robot, start_configuration
from wepose_pin.readers import load_session
from wepose_pin.readers.describe import describe_file
from wepose_pin.readers.trials import find_ur5, read_ur5
from wepose_pin.recording import CONFIGURATION, ImuSensor, Recording, compute_mount
from wepose_pin.tracking import track, track_chain
from wepose_pin.validation.real import UNSCORED_S, UR5_EXCLUDED
from wepose_pin.writers import write_session

RATE = 100.0
# The axes of a UR5's joints while all are at zero, the arm stretched out along x.
UR5 = {
    "shoulder_pan_joint": ("shoulder_link", "0 0 1", "0 0 0.089"),
    "shoulder_lift_joint": ("upper_arm_link", "0 1 0", "0 0.136 0"),
    "elbow_joint": ("forearm_link", "0 1 0", "0.425 -0.12 0"),
    "wrist_1_joint": ("wrist_1_link", "0 1 0", "0.392 0 0"),
    "wrist_2_joint": ("wrist_2_link", "0 0 -1", "0 0.093 0"),
    "wrist_3_joint": ("wrist_3_link", "0 1 0", "0 0 -0.095"),
}
HOME = {"shoulder_lift_joint": -np.pi / 2.0, "wrist_1_joint": -np.pi / 2.0}
LINKS = {"radius": "forearm_link", "carpus": "wrist_1_link"}
RUNS = ("circle-100", "circle-250", "triangle-150", "triangle-250")


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm with a UR5's axes; 1 kg a link."""
    text, parent = '<link name="base_link"/>', "base_link"
    mass = '<inertial><mass value="1"/><inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial>'
    for name, (child, axis, at) in UR5.items():
        text += (
            f'<link name="{child}">{mass}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
            f'<limit lower="-6.3" upper="6.3" effort="100" velocity="3"/></joint>'
        )
        parent = child
    file = tmp_path_factory.mktemp("ur5") / "arm.urdf"
    file.write_text(f'<robot name="arm">{text}</robot>', encoding="utf-8")
    return file


def turned(model: pin.Model, q: np.ndarray, link: str) -> Rotation:
    """Orientations of a link in W."""
    data, frame = model.createData(), model.getFrameId(link)
    rows = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        rows.append(data.oMf[frame].rotation.copy())
    return Rotation.from_matrix(rows)


def made(model: pin.Model, links: list[str], seconds: float = 30.0) -> tuple[Recording, np.ndarray]:
    """A recording of noiseless sensors, put on squarely, and the configurations (n, nq) behind it.

    They measure no acceleration but gravity.
    """
    t = np.arange(0.0, seconds, 1.0 / RATE)
    start = start_configuration(model, HOME, "made")
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
    return Recording("made", t, RATE, sensors, phases=phases, start_pose=CONFIGURATION, joints=HOME), q


def rms_deg(angle: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def test_sensors_on_all_links_give_all_joints(urdf: Path) -> None:
    model = load_robot(urdf)
    recording, q = made(model, ["upper_arm_link", "forearm_link", "wrist_1_link", "wrist_3_link"])
    chain = track_chain(recording, model)
    assert chain.open == ()
    assert list(chain.joints) == list(UR5)
    for k, value in enumerate(chain.joints.values()):
        assert np.abs(value - q[:, k]).max() < np.deg2rad(1.0)
    assert max(rms_deg(angle) for angle in chain.residual.values()) < 0.5


def test_a_link_may_have_the_name_of_its_fixed_joint(urdf: Path, tmp_path: Path) -> None:
    joint = '<joint name="tool" type="fixed"><parent link="wrist_1_link"/><child link="tool"/></joint>'
    text = urdf.read_text(encoding="utf-8").replace("</robot>", f'<link name="tool"/>{joint}</robot>')
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    model = load_robot(tmp_path / "arm.urdf")
    recording, _ = made(model, ["forearm_link", "tool"], 8.0)
    chain = track_chain(recording, model)
    assert max(rms_deg(angle) for angle in chain.residual.values()) < 0.5
    assert set(chain.orientations()) == {"forearm_link", "tool"}


def test_what_the_links_leave_open_is_named_and_the_rest_is_right(urdf: Path) -> None:
    model = load_robot(urdf)
    recording, q = made(model, ["forearm_link"])
    chain = track_chain(recording, model)
    assert set(chain.open) == {"shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"}
    joints = chain.joints
    np.testing.assert_allclose(joints["shoulder_pan_joint"], q[:, 0], atol=np.deg2rad(1.0))
    both = joints["shoulder_lift_joint"] + joints["elbow_joint"]
    np.testing.assert_allclose(both, q[:, 1] + q[:, 2], atol=np.deg2rad(1.0))
    (undetermined,) = [d for d in chain.summary()["diagnostics"] if d["code"] == "joints-undetermined"]
    assert undetermined["facts"]["joints"].startswith("shoulder_lift_joint, elbow_joint")


def test_the_pose_is_that_of_the_start_configuration_at_the_start(urdf: Path) -> None:
    model = load_robot(urdf)
    recording, q = made(model, ["forearm_link", "wrist_1_link"], 8.0)
    chain = track_chain(recording, model)
    for link, quat in chain.orientations().items():
        off = (turned(model, q[:1], link)[0].inv() * Rotation.from_quat(quat[:350])).magnitude()
        assert np.degrees(off.max()) < 0.1


def ur5_session(data: Path, run: str, folder: Path) -> dict[str, Rotation]:
    """A run as a session, squarely mounted as the axes say, and its encoders' orientations of the links in W.

    The encoders' frames equal each other at the start, where the arm stands upright; their x is W's y there. That their
    joint angles, taken so, have the tool drawn in a plane to 0.1 mm is what says that the start is `HOME`.
    """
    files = [each for each in find_ur5(data) if each.recording == run and (run, each.sensor) not in UR5_EXCLUDED]
    trials = {each.sensor: read_ur5(each) for each in files}
    table, text, truth = {}, "", {}
    for sensor, trial in trials.items():
        for kind, values in (("gyr", trial.gyro_S), ("acc", trial.accel_S)):
            table |= {f"{sensor}_{kind}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        columns = ({kind: [f"{sensor}_{kind}_{axis}" for axis in "xyz"]} for kind in ("gyr", "acc"))
        gyro, accel = (json.dumps(next(iter(each.values()))) for each in columns)
        text += f'[sensors.{LINKS[sensor]}]\ngyro = {gyro}\naccel = {accel}\nmount = {{ up = "-y", forward = "-x" }}\n'
        R_WB = Rotation.from_euler("z", np.pi / 2.0) * Rotation.from_quat(trial.quat_VB)
        start = R_WB[trial.static].mean()
        lift = {"radius": -np.pi / 2.0, "carpus": -np.pi}[sensor]
        truth[LINKS[sensor]] = R_WB * start.inv() * Rotation.from_euler("y", lift)
    trial = next(iter(trials.values()))
    pl.DataFrame(table).write_csv(folder / "ur5.csv")
    head = (
        f'name = "{run}"\nstart_pose = "configuration"\n[data]\nfile = "ur5.csv"\nrate_hz = {trial.rate_hz}\n'
        f'gyro_unit = "rad/s"\naccel_unit = "m/s^2"\n'
        f"[phases]\nstart = [[0.0, {(trial.static.stop - 1) / trial.rate_hz}]]\n[joints]\n"
        + "".join(f"{name} = {value}\n" for name, value in HOME.items())
    )
    (folder / "session.toml").write_text(head + text, encoding="utf-8")
    return truth


@pytest.mark.parametrize("method", ["smekf", "amekf"])
def test_a_ur5_beside_its_encoders(data: Path, urdf: Path, tmp_path: Path, method: str) -> None:
    """Nothing is fitted to the encoders: neither clock nor frames nor heading. Printed with -s."""
    model = load_robot(urdf)
    errors: dict[str, list[float]] = {"sensor alone": [], "chain": []}
    for run in RUNS:
        truth = ur5_session(data, run, tmp_path)
        recording = load_session(tmp_path)
        chain = track_chain(recording, model, method=method)
        scored = recording.time - recording.time[0] > UNSCORED_S
        fitted = chain.orientations()
        for link, true in truth.items():
            for name, quat in (("sensor alone", chain.quat_WL[link]), ("chain", fitted[link])):
                errors[name].append(rms_deg((Rotation.from_quat(quat) * true.inv()).magnitude()[scored]))
            print(f"\n{method} {run} {link}: " + ", ".join(f"{k} {v[-1]:.2f} deg" for k, v in errors.items()), end="")
    alone, fitted_ = (float(np.mean(each)) for each in errors.values())
    print(f"\n{method}: mean {alone:.2f} and {fitted_:.2f} deg")
    assert max(errors["chain"]) < 1.6
    assert fitted_ < 0.7 * alone


def test_the_command_writes_joints_orientations_and_torques(
    urdf: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ur5_session(data, "circle-250", tmp_path)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(["track", str(tmp_path), "--model", str(urdf), "--torques", "-o", str(out)])
    assert end.value.code == 0
    assert {file.name for file in out.iterdir()} == {
        "joints.parquet",
        "pose.parquet",
        "torques.parquet",
        "summary.json",
        "provenance.json",
    }
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["torques"]["mass_kg"] == 6.0
    assert "elbow_joint" in summary["joints_left_open"]
    joints, pose = pl.read_parquet(out / "joints.parquet"), pl.read_parquet(out / "pose.parquet")
    assert joints.columns == ["time", *UR5]
    assert {"forearm_link_qw", "wrist_1_link_measured_qx", "wrist_1_link_std"} <= set(pose.columns)
    assert len(joints) == len(pose) == len(pl.read_parquet(out / "torques.parquet"))

    for words in (["export", str(out), "-o", str(tmp_path / "x.trc")], ["view", str(out), "--no-open"]):
        with pytest.raises(SystemExit) as end:
            main(words)
        assert end.value.code == 2
        assert "of a chain, its motion is in joints.parquet; a person's result" in capsys.readouterr().err
    said = describe_file(out)
    assert "of a chain, sensors on: wrist_1_link, forearm_link" in said.facts
    assert not any("wepose view" in fact for fact in said.facts)


def test_a_session_that_is_written_gives_the_recording_back(urdf: Path, tmp_path: Path) -> None:
    recording, _ = made(load_robot(urdf), ["forearm_link", "wrist_1_link"], 6.0)
    odd = {"forearm.link": recording.sensors["forearm_link"], "wrist 1": recording.sensors["wrist_1_link"]}
    recording = replace(recording, sensors=odd, joints={**HOME, "elbow/1": 0.1}, remounted=True)
    write_session(tmp_path, recording)
    again = load_session(tmp_path)
    assert (again.start_pose, again.joints, again.remounted) == (CONFIGURATION, recording.joints, True)
    assert list(again.sensors) == list(odd)
    for link, sensor in odd.items():
        np.testing.assert_array_equal(again.sensors[link].gyro_S, sensor.gyro_S)
        np.testing.assert_allclose(again.sensors[link].stated_quat_LS, sensor.stated_quat_LS)


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
        ("elbow_joint", "elbow_jiont", BadSession, r"joints\.elbow_jiont is no joint .*did you mean 'elbow_joint'"),
        ("= 0.5", "= 7.0", BadSession, r"joints\.elbow_joint = 7 is outside its limits, -6\.3 to 6\.3"),
        ("= 0.5", '= "up"', BadSession, r"joints\.elbow_joint = 'up' is not a number"),
        ("forearm_link", "forearm", BadSession, r"sensors\.forearm is no link of arm; did you mean 'forearm_link'"),
        ('"configuration"', '"n_pose"', BadSession, "joints stands beside start_pose"),
    ],
)
def test_what_a_session_of_a_chain_may_not_say(
    urdf: Path, tmp_path: Path, old: str, new: str, error: type[WeposeError], text: str
) -> None:
    table = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (500, 1))
    pl.DataFrame(table, schema=["gx", "gy", "gz", "ax", "ay", "az"], orient="row").write_csv(tmp_path / "arm.csv")
    file = tmp_path / "session.toml"
    file.write_text(SESSION, encoding="utf-8")
    model = load_robot(urdf)
    assert track_chain(load_session(file), model).summary()["start"] == {"elbow_joint": 0.5}
    file.write_text(SESSION.replace(old, new), encoding="utf-8")
    with pytest.raises(error, match=text):
        track_chain(load_session(file), model)


def test_joints_stand_only_beside_a_configuration(tmp_path: Path) -> None:
    file = tmp_path / "session.toml"
    file.write_text(SESSION.replace('"configuration"', '"n_pose"').replace("forearm_link", "torso"), encoding="utf-8")
    with pytest.raises(BadSession, match=r'joints stands beside start_pose = "n_pose"'):
        load_session(file)


def test_a_chain_and_a_person_are_not_mixed_up(urdf: Path) -> None:
    model = load_robot(urdf)
    recording, _ = made(model, ["forearm_link"], 6.0)
    with pytest.raises(BadOption, match="give its URDF"):
        track(recording)
    with pytest.raises(BadOption, match='"configuration" is needed'):
        track_chain(Recording("p", recording.time, RATE, recording.sensors), model)
    with pytest.raises(BadOption, match="is a person's"):
        track_chain(Recording("p", recording.time, RATE, {"torso": recording.sensors["forearm_link"]}), model)


def test_a_urdf_in_which_nothing_moves(tmp_path: Path) -> None:
    file = tmp_path / "stone.urdf"
    file.write_text('<robot name="stone"><link name="base"/></robot>', encoding="utf-8")
    with pytest.raises(BadModel, match="no joint moves"):
        load_robot(file)


def test_values_of_a_joint_without_end_go_on(tmp_path: Path) -> None:
    file = tmp_path / "wheel.urdf"
    file.write_text(
        '<robot name="wheel"><link name="base"/><link name="rim"/><joint name="axle" type="continuous">'
        '<parent link="base"/><child link="rim"/><axis xyz="0 0 1"/></joint></robot>',
        encoding="utf-8",
    )
    model = load_robot(file)
    angle = np.linspace(0.0, 9.0, 200)
    np.testing.assert_allclose(joint_values(model, np.column_stack([np.cos(angle), np.sin(angle)]))["axle"], angle)
    np.testing.assert_allclose(start_configuration(model, {"axle": 0.3}, "x"), [np.cos(0.3), np.sin(0.3)])
