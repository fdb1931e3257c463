"""A simulated UR5 with a sensor on each link, its tip on points: two lengths are calibrated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from scipy.spatial.transform import Rotation
from test_chain import urdf  # noqa: F401  the arm's URDF

from wepose_pin.calibration import Calibration, Protocol, assess, calibrate
from wepose_pin.calibration.protocols import Closure
from wepose_pin.calibration.recorded import interpolate_places
from wepose_pin.cli import main
from wepose_pin.errors import WeposeError
from wepose_pin.model import BodyModel, load_model
from wepose_pin.recording import CONFIGURATION, ImuSensor, Recording
from wepose_pin.simulation import MTI_3
from wepose_pin.writers import write_session

RATE, START_S, MOVE_S = 50.0, (0.5, 4.5), 5.0
HOME = {
    "shoulder_pan_joint": 0.0,
    "shoulder_lift_joint": -1.2,
    "elbow_joint": 1.6,
    "wrist_1_joint": -1.0,
    "wrist_2_joint": -1.57,
    "wrist_3_joint": 0.3,
}
TRUE = {"upper_arm": 1.05, "forearm": 0.94}  # times the table's own, whose standard deviation is a tenth
LINKS = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
TABLE = """urdf = "arm.urdf"
kind = "mechanism"
[segments]
{segments}
[points]
base = "upper_arm_link"
elbow = "forearm_link"
wrist = "wrist_1_link"
tip = {{ link = "wrist_3_link", at = [0.0, 0.15, 0.0] }}
[lengths]
upper_arm = {{ segment = "upper_arm_link", from = "base", to = "elbow", std_percent = 10 }}
forearm = {{ segment = "forearm_link", from = "elbow", to = "wrist", std_percent = 10 }}
"""
START_STD = np.deg2rad(0.3)  # [rad] of each joint against the stated start pose
SENSOR_AT = np.array([0.05, 0.03, 0.02])  # [m] in its link
BIAS_STD, ACCEL_BIAS_STD = np.deg2rad(0.2), 0.02  # [rad/s], [m/s²]
AWAY = np.array([0.10, -0.15, 0.08])  # [m] the second point from the first


@pytest.fixture(scope="module")
def arm(urdf: Path) -> BodyModel:  # noqa: F811
    table = TABLE.format(segments="\n".join(f'{link} = "{link}"' for link in LINKS))
    (urdf.parent / "arm.toml").write_text(table, encoding="utf-8")
    return load_model(urdf.parent / "arm.toml")


@dataclass(frozen=True)
class Moved:
    """A recording of the arm, and the truth behind it."""

    recording: Recording
    lengths: dict[str, float]  # [m]
    tip: np.ndarray  # (n, 3) [m]


def move_arm(body: BodyModel, seed: int, *, seconds: float = 45.0, points: int = 1, stated: bool = False) -> Moved:
    """The arm moves with its tip on one point, on two one after the other, or free (0)."""
    true = body.with_lengths({name: ratio * body.lengths[name] for name, ratio in TRUE.items()})
    model, data, rng = true.pin, true.pin.createData(), np.random.default_rng(seed)
    time, tip_frame = np.arange(0.0, seconds, 1.0 / RATE), true.pin.getFrameId("tip")
    end = seconds - 1.0
    change = np.clip((time - 0.5 * (MOVE_S + end)) / 2.0 + 0.5, 0.0, 1.0)[:, None] if points == 2 else 0.0
    rise = np.clip((time - MOVE_S) / 2.0, 0.0, 1.0)
    frequency, phase = rng.uniform(0.05, 0.25, (6, 3)), rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    amplitude = rng.uniform(0.1, 0.35, (6, 3))
    wave = np.sin(2.0 * np.pi * frequency * (time[:, None, None] - MOVE_S) + phase)
    wanted = 0.9 * rise[:, None] * (amplitude * wave).sum(axis=2)  # [rad/s]
    q = np.empty((len(time), 6))
    q[0] = [HOME[name] for name in model.names[1:]] + rng.normal(scale=START_STD, size=6)
    pin.framesForwardKinematics(model, data, q[0])
    target = data.oMf[tip_frame].translation + change * AWAY * np.ones((len(time), 1))
    tip = np.empty((len(time), 3))
    R = {link: np.empty((len(time), 3, 3)) for link in LINKS}
    place = {link: np.empty((len(time), 3)) for link in LINKS}
    frames = {link: model.getFrameId(link) for link in LINKS}
    for k in range(len(time)):
        if k:
            pin.computeJointJacobians(model, data, q[k - 1])
            pin.updateFramePlacements(model, data)
            J = pin.getFrameJacobian(model, data, tip_frame, pin.LOCAL_WORLD_ALIGNED)[:3]
            step = wanted[k] / RATE
            if points:
                inverse = J.T @ np.linalg.inv(J @ J.T + 1e-6 * np.eye(3))
                step = step - inverse @ J @ step + inverse @ (target[k] - data.oMf[tip_frame].translation)
            q[k] = q[k - 1] + step
        pin.framesForwardKinematics(model, data, q[k])
        tip[k] = data.oMf[tip_frame].translation
        for link, frame in frames.items():
            R[link][k], place[link][k] = data.oMf[frame].rotation, data.oMf[frame].act(SENSOR_AT)
    sensors = {}
    for link in LINKS:
        mount = Rotation.random(random_state=rng)
        R_WS = Rotation.from_matrix(R[link]) * mount
        gyro = np.zeros((len(time), 3))
        gyro[1:] = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE
        accel_W = np.gradient(np.gradient(place[link], 1.0 / RATE, axis=0), 1.0 / RATE, axis=0)
        accel = R_WS.inv().apply(accel_W + [0.0, 0.0, 9.81])
        gyro += rng.normal(size=3) * BIAS_STD + rng.normal(size=gyro.shape) * MTI_3.gyro_density * np.sqrt(RATE)
        accel += rng.normal(size=3) * ACCEL_BIAS_STD
        accel += rng.normal(size=accel.shape) * MTI_3.accel_density * np.sqrt(RATE)
        in_start_pose = (Rotation.from_matrix(R[link][0]) * mount).as_quat() if stated else None
        sensors[link] = ImuSensor(gyro_S=gyro, accel_S=accel, stated_quat_LS=in_start_pose)
    phases = {"start": (START_S,), "tip": ((MOVE_S + 2.0, end),)}
    if points == 2:
        middle = 0.5 * (MOVE_S + end)
        phases |= {"tip": ((MOVE_S + 2.0, middle - 1.5),), "second": ((middle + 1.5, end),)}
    recording = Recording("arm", time, RATE, sensors, phases=phases, start_pose=CONFIGURATION, joints=HOME)
    return Moved(recording, {name: true.lengths[name] for name in TRUE}, tip)


def on_point(phase: str = "tip", at: np.ndarray | None = None) -> Closure:
    place = None if at is None else (float(at[0]), float(at[1]), float(at[2]))
    return Closure(phase, "fixed_point", ("tip",), slip=0.001, at=place, at_std=0.002)


def calibrate_arm(body: BodyModel, moved: Moved, *closures: Closure) -> Calibration:
    protocol = Protocol("points", "tip on points", (), (), closures or (on_point(),))
    return calibrate(moved.recording, model=body, protocol=protocol)


def deviations(calibration: Calibration, moved: Moved) -> np.ndarray:
    """(2,) errors of the lengths in standard deviations."""
    subject = calibration.subject
    return np.array([(subject.lengths[name] - true) / subject.std(name) for name, true in moved.lengths.items()])


def describe(what: str, calibration: Calibration, moved: Moved) -> None:
    for name, true in moved.lengths.items():
        value, std = calibration.subject.lengths[name], calibration.subject.std(name)
        print(f"{what:24} {name:10} {1e3 * value:7.1f} ± {1e3 * std:4.1f} mm, true {1e3 * true:.1f}")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lengths_are_found_within_their_deviation(arm: BodyModel, seed: int) -> None:
    moved = move_arm(arm, seed)
    calibration = calibrate_arm(arm, moved)
    describe(f"one point, seed {seed}", calibration, moved)
    assert np.abs(deviations(calibration, moved)).max() < 3.0
    assert calibration.rms_gap < 0.2 * calibration.prior_rms_gap
    for name in TRUE:  # a tenth before the motion
        assert calibration.subject.std(name) < 0.01 * moved.lengths[name]


@pytest.mark.slow
def test_a_known_point_two_points_and_stated_mounts(arm: BodyModel) -> None:
    moved = move_arm(arm, 3)
    known = calibrate_arm(arm, moved, on_point(at=moved.tip[0]))
    unknown = calibrate_arm(arm, moved)
    describe("known point", known, moved)
    describe("unknown point", unknown, moved)
    assert np.abs(deviations(known, moved)).max() < 3.0
    for name in TRUE:
        assert known.subject.std(name) < unknown.subject.std(name)
    moved = move_arm(arm, 4, points=2, seconds=55.0)
    both = calibrate_arm(arm, moved, on_point(), on_point("second"))
    describe("two points", both, moved)
    assert np.abs(deviations(both, moved)).max() < 3.0
    moved = move_arm(arm, 5, stated=True)
    stated = calibrate_arm(arm, moved)
    describe("stated mounts", stated, moved)
    assert np.abs(deviations(stated, moved)).max() < 3.0
    assert not stated.unused_mounts


def test_recorded_places_of_the_tip_close_the_chain(arm: BodyModel, tmp_path: Path) -> None:
    moved = move_arm(arm, 6, points=0)
    time = np.arange(0.013, moved.recording.time[-1], 1.0 / 30.0)
    places = np.column_stack([np.interp(time, moved.recording.time, axis) for axis in moved.tip.T])
    lost = np.sin(time) > 0.8
    places[lost] = np.nan
    columns = {"time": time, **{f"tip_{axis}": places[:, k] for k, axis in enumerate("xyz")}}
    pl.DataFrame(columns).write_parquet(tmp_path / "optical.parquet")
    moved = replace(moved, recording=replace(moved.recording, truth=tmp_path / "optical.parquet"))
    calibration = calibrate_arm(arm, moved, Closure("tip", "recorded", ("tip",), slip=0.001))
    describe("recorded tip", calibration, moved)
    assert np.abs(deviations(calibration, moved)).max() < 3.0
    seen = np.interp(calibration.time, time, (~lost).astype(float))
    assert seen.min() == 1.0
    assert len(calibration.time) < 0.9 * 8.0 * (moved.recording.phases["tip"][0][1] - MOVE_S - 2.0)
    assert "scale" not in {check.diagnostic.code.partition("-")[0] for check in assess(calibration).checks}


def test_places_are_interpolated_between_rows_that_have_them() -> None:
    known_time, lost = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 1.0, 1.1]), np.nan
    places = np.array([0.0, 1.0, 2.0, lost, 4.0, 10.0, 11.0])[:, None] * [1.0, 2.0, -1.0]
    time = np.array([-0.05, 0.0, 0.05, 0.2, 0.25, 0.35, 0.4, 0.7, 1.05, 1.1, 1.15])
    expected = np.array([lost, 0.0, 0.5, 2.0, lost, lost, 4.0, lost, 10.5, 11.0, lost])  # 0.4 to 1.0: rows are missing
    found = interpolate_places(time, known_time, places)
    np.testing.assert_allclose(found, expected[:, None] * [1.0, 2.0, -1.0], atol=1e-9)


def test_what_a_truth_lacks_is_said_in_one_line(arm: BodyModel, tmp_path: Path) -> None:
    recording = replace(move_arm(arm, 0, seconds=12.0).recording, truth=tmp_path / "optical.parquet")
    time = np.arange(0.0, 12.0, 0.1)
    lost = np.full(len(time), np.nan)
    good = {"time": time, "tip_x": time, "tip_y": time, "tip_z": time}
    closure = Closure("tip", "recorded", ("tip",), slip=0.001)
    for table, named in (
        ({"time": time, "tip_x": time, "tip_y": time}, "no column 'tip_z' in optical.parquet"),
        (good | {"time": time[::-1]}, "time of optical.parquet does not increase"),
        (good | {"tip_x": lost}, "are without a recorded place"),
    ):
        pl.DataFrame(table).write_parquet(tmp_path / "optical.parquet")
        with pytest.raises(WeposeError) as raised:
            calibrate_arm(arm, Moved(recording, {}, lost), closure)
        assert named in str(raised.value)
        assert "\n" not in str(raised.value)


def test_a_lost_sensor_is_named_in_one_line(arm: BodyModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = move_arm(arm, 0, seconds=20.0).recording
    sensors = {link: sensor for link, sensor in recording.sensors.items() if link != "forearm_link"}
    write_session(tmp_path, replace(recording, sensors=sensors))
    model = Path(arm.table.where)
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", str(tmp_path), "--model", str(model), "--protocol", "tip", "-o", str(tmp_path / "out")])
    assert stopped.value.code == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "forearm_link" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.monte_carlo
def test_stated_deviations_are_right_over_seeds(arm: BodyModel) -> None:
    z = []
    for seed in range(10, 20):
        moved = move_arm(arm, seed)
        z.append(deviations(calibrate_arm(arm, moved), moved))
    rms = np.sqrt(np.mean(np.square(z)))
    print(f"rms of z over {len(z)} seeds: {rms:.2f}")
    assert 0.4 < rms < 1.6
