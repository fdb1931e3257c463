"""Legs: the whole body's URDF, activities with known truth, and their joint angles through the commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import NOISE_FREE, Simulation, WeposeError, evaluate, joint_angles, load_model, simulate_activity
from wepose_pin.commands.results import evaluate as evaluate_result

SIDES = ("left", "right")


@pytest.fixture(scope="module", params=["walk", "sit", "run", "throw"])
def activity(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def made(activity: str) -> Simulation:
    return simulate_activity(
        activity, seed=2, noise=NOISE_FREE, seconds=10.0, rate_hz=400.0 if activity == "run" else 100.0
    )


def test_the_true_pose_has_the_angles_of_the_activity(activity: str, made: Simulation) -> None:
    angles = joint_angles(made.truth())
    most = {name: np.degrees(angle.values.max(axis=0)) for name, angle in angles.joints.items()}
    knee, hip = (angles[f"left_{joint}"]["flexion"] for joint in ("knee", "hip"))
    assert knee.min() > -0.01  # it does not bend forwards
    if activity == "walk":
        assert 50.0 < most["left_knee"][0] < 72.0
        shoulder = joint_angles(made.truth(), "XZY")["left_shoulder"]["flexion"]
        assert np.corrcoef(hip, shoulder)[0, 1] < -0.8  # arms swing against the legs
        middle = slice(700, 1000)
        other = angles["right_knee"]["flexion"]
        shifted = [np.corrcoef(knee[middle], np.roll(other, k)[middle])[0, 1] for k in range(90)]
        assert max(shifted) > 0.99  # the other leg does the same half a stride later
        assert 40 < int(np.argmax(shifted)) < 75
    elif activity == "sit":
        assert 90.0 < most["left_knee"][0] < 95.0
        assert 90.0 < most["left_hip"][0] < 105.0


def test_points_and_sensors_are_where_the_segments_put_them(activity: str, made: Simulation) -> None:
    lengths, R_WL = made.lengths, {segment: Rotation.from_quat(quat) for segment, quat in made.quat_WL.items()}
    for side, y in (("left", 1.0), ("right", -1.0)):
        p_W = R_WL["pelvis"].apply([0.0, y * lengths["hip_width"] / 2.0, 0.0])
        origins = {}
        for segment, point, end in (("thigh", "hip", "knee"), ("shank", "knee", "ankle"), ("foot", "ankle", None)):
            np.testing.assert_allclose(made.points[f"{side}_{point}"], p_W, atol=1e-12)
            origins[segment] = p_W
            if end is not None:
                p_W = p_W + R_WL[f"{side}_{segment}"].apply([0.0, 0.0, -lengths[f"{side}_{segment}"]])
        toe_L = R_WL[f"{side}_foot"].inv().apply(made.points[f"{side}_toe"] - p_W)
        assert np.linalg.norm(toe_L, axis=1) == pytest.approx(lengths[f"{side}_foot"], abs=1e-12)
        heel_L = R_WL[f"{side}_foot"].inv().apply(made.points[f"{side}_heel"] - p_W)
        np.testing.assert_allclose(toe_L[:, 2], heel_L[:, 2], atol=1e-12)  # both on the sole
        for segment, origin in origins.items():
            sensor = f"{side}_{segment}"
            p_WS = origin + R_WL[sensor].apply(made.p_LS[sensor])
            R_WS = R_WL[sensor] * Rotation.from_quat(made.quat_LS[sensor])
            accel_W = R_WS.apply(made.accel_S[sensor]) - [0.0, 0.0, 9.81]
            if activity != "run":  # which moves the root
                spline = CubicSpline(made.time, p_WS).derivative(2)(made.time)
                assert np.abs(accel_W - spline)[10:-10].max() < 0.02 * max(1.0, np.abs(accel_W).max())
            turned = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * made.rate_hz
            np.testing.assert_allclose(made.gyro_S[sensor][1:], turned, atol=1e-9)


def test_an_activity_that_is_none_or_too_short_is_named() -> None:
    with pytest.raises(WeposeError, match=r"activity 'swim' is not known; .*walk, sit, tasks, run, throw"):
        simulate_activity("swim", seed=1)
    with pytest.raises(WeposeError, match="seconds 5: sitting down and standing up once takes 8"):
        simulate_activity("sit", seed=1, seconds=5.0)


SHORT = ("--seconds", "15")
LEG_JOINTS = [f"{side}_{joint}" for side in SIDES for joint in ("hip", "knee", "ankle")]


@pytest.mark.parametrize(
    ("activity", "preset", "most_deg"),
    [
        ("walk", "ideal", 0.6),
        *(pytest.param(*row, marks=pytest.mark.slow) for row in (("sit", "ideal", 0.6), ("walk", "mild", 2.5))),
    ],
)
def test_the_commands_find_the_angles_of_the_legs(activity: str, preset: str, most_deg: float, tmp_path: Path) -> None:
    made, result = tmp_path / "made", tmp_path / "result"
    assert (
        run(
            "simulate", "-o", made, "--seed", "5", "--activity", activity, "--preset", preset, *SHORT, "--rate-hz", "60"
        )
        == 0
    )
    # Open loop: what neighbours tell of headings has an error of its own, of half a degree and more.
    assert run("track", made, "--model", "whole_body", "--open-loop", "--no-view", "--no-report", "-o", result) == 0
    assert run("evaluate", result, made) == 0
    errors = evaluate_result(result, made)
    for joint in LEG_JOINTS:
        for name, error in errors.joints[joint].items():
            assert error.rmse < most_deg, (joint, name)

    assert run("export", result, "-o", tmp_path / "result.csv") == 0
    table = pl.read_csv(tmp_path / "result.csv")
    angles = joint_angles(wp.load_result(result))
    for joint in LEG_JOINTS:
        for name in angles[joint].names:
            np.testing.assert_allclose(table[f"{joint}_{name}_deg"], np.degrees(angles[joint][name]), atol=1e-6)
    assert {"pelvis_qx", "pelvis_in_world_qx", "left_toe_x", "right_heel_z"} <= set(table.columns)
    assert run("export", result, "-o", tmp_path / "result.sto") == 0
    labels = (tmp_path / "result.sto").read_text(encoding="utf-8").split("endheader\n")[1].splitlines()[0].split("\t")
    assert {f"{body}_{side}_imu" for body in ("femur", "tibia", "calcn") for side in "lr"} <= set(labels)
    again = load_model(result / "subject.urdf")
    assert set(again.table.segments) == set(load_model("whole_body").table.segments)


@pytest.mark.parametrize("torso", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_seven_sensors_from_the_pelvis_down_are_enough(torso: bool) -> None:
    simulation = simulate_activity("walk", seed=4, seconds=10.0)
    recording = simulation.recording()
    wanted = {"pelvis", *(f"{side}_{part}" for side in SIDES for part in ("thigh", "shank", "foot"))}
    wanted |= {"torso"} if torso else set()
    sensors = {segment: sensor for segment, sensor in recording.sensors.items() if segment in wanted}
    model = load_model("whole_body", simulation.lengths)
    pose = wp.track(replace(recording, sensors=sensors), model=model).pose
    errors = evaluate(pose, simulation.truth())
    below = {f"{side}_{point}" for side in SIDES for point in ("hip", "knee", "ankle", "heel", "toe")}
    assert set(pose.points) == below | ({"left_shoulder", "right_shoulder"} if torso else set())
    assert set(pose.point_cov) == set(pose.points)
    for joint in LEG_JOINTS:
        assert all(error.rmse < 0.5 for error in errors.joints[joint].values())
    for point in below:
        assert errors.position[point].rmse < 5.0  # mm


def test_legs_on_the_upper_body_are_refused_with_the_body_that_has_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "made"
    assert run("simulate", "-o", made, "--activity", "sit", *SHORT) == 0
    assert run("track", made, "-o", tmp_path / "result") == 2
    error = capsys.readouterr().err
    assert "sensors.left_thigh is no segment of upper_body; the body whole_body has it" in error
    assert "ignore = true in [sensors.left_thigh]" in error
    assert run("simulate", "-o", made, "--activity", "sit", "--protocol", "clasp", "--force") == 2
    assert "--activity sit with --protocol clasp" in capsys.readouterr().err
    assert run("track", made, "--model", "half_body", "-o", tmp_path / "result") == 2
    assert "no body 'half_body' comes with the package; did you mean 'whole_body'" in capsys.readouterr().err
    session = made / "session.toml"
    text = session.read_text(encoding="utf-8")
    for side in SIDES:
        for segment in ("thigh", "shank", "foot"):
            text = text.replace(f"[sensors.{side}_{segment}]\n", f"[sensors.{side}_{segment}]\nignore = true\n")
    session.write_text(text, encoding="utf-8")
    assert run("track", made, "-o", tmp_path / "result", "--no-view", "--no-report") == 0
    assert "left_thigh_qx" not in pl.read_parquet_schema(tmp_path / "result" / "pose.parquet")


def test_what_the_torso_does_not_carry_shares_how_that_is_turned() -> None:
    """Legs that stand together are off together, for x of W is where the torso faces; an arm goes with the torso."""
    recording = simulate_activity("walk", seed=2, noise=NOISE_FREE, seconds=4.0).recording()
    pose = wp.track(recording, model="whole_body", causal=True).pose
    variance = {name: cov[-1, 2, 2] for name, cov in pose.segment_cov.items()}
    for near, far, least, most in (("pelvis", "left_thigh", 0.4, 1.0), ("pelvis", "left_upper_arm", -0.2, 0.2)):
        shared = next(cov[-1] for pair, cov in pose.heading_cov.items() if set(pair) == {near, far})
        assert least < shared / np.sqrt(variance[near] * variance[far]) < most
