"""The preset `people`: sizes as the literature has them, physics kept, closures kept; `mild` is a smaller one."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from scipy.spatial.transform import Rotation
from simulated import SEGMENTS, SIDES, SUBJECT, check_accel, check_gyro, in_torso, within

from wepose_pin import (
    IDEAL_PRESET,
    NOISE_FREE,
    PEOPLE_PRESET,
    Imperfections,
    Simulation,
    load_session,
    simulate,
    simulate_activity,
    simulate_person,
)

# The people preset with perfect sensors and clocks.
BODY = replace(
    PEOPLE_PRESET,
    **{
        field.name: getattr(IDEAL_PRESET, field.name)
        for field in fields(Imperfections)
        if field.name.startswith(("gyro", "accel", "clock", "bits", "misalignment", "g_sens", "dropped"))
    },
)


@pytest.fixture(scope="module")
def body() -> Simulation:
    return simulate(SUBJECT, seed=3, noise=NOISE_FREE, imperfections=BODY, clasp_s=30.0, circles=1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# Elbow, wrists, start pose ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.monte_carlo) for seed in (1, 2))])
def test_palms_close_but_for_slip(seed: int) -> None:
    person = simulate_person(seed)
    options = {"seed": seed, "noise": NOISE_FREE, "rate_hz": 20.0, "clasp_s": 20.0, "circles": 0}
    for sizes, most_mm in ((replace(BODY, palm_slip=0.0), 0.01), (BODY, 30.0)):
        sim = simulate(person.lengths, imperfections=sizes, **options)
        gap = np.linalg.norm(sim.points["left_palm"] - sim.points["right_palm"], axis=1)[within(sim, "clasp")]
        assert 1e3 * np.abs(gap).max() < most_mm
    assert 1e3 * rms(gap) == pytest.approx(10.0, rel=0.1)


def test_wrists_bend(body: Simulation) -> None:
    clasp = within(body, "clasp")
    for side in SIDES:
        hand_W = body.points[f"{side}_palm"] - body.points[f"{side}_wrist"]
        hand_F = Rotation.from_quat(body.quat_WL[f"{side}_forearm"]).inv().apply(hand_W)[clasp]
        flexion, deviation = (
            np.rad2deg(np.arctan2(hand_F[:, 0], -hand_F[:, 2])),
            np.rad2deg(np.arcsin(hand_F[:, 1] / SUBJECT[f"{side}_hand"])),
        )
        assert rms(flexion) == pytest.approx(12.0, rel=0.1)
        assert rms(deviation) == pytest.approx(8.0, rel=0.1)
        # tied to the distance of the hands from the chest
        distance = np.linalg.norm(
            in_torso(body, body.points[f"{side}_palm"])[clasp] - (0.0, 0.0, SUBJECT["trunk"]), axis=1
        )
        assert abs(np.corrcoef(flexion, distance)[0, 1]) > 0.5


# Physics stays whole ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("segment", SEGMENTS)
def test_gyro_integrates_to_the_sensors_own_orientation(body: Simulation, segment: str) -> None:
    check_gyro(body, segment, Rotation.from_quat(body.quat_WS[segment]), 30.0)


@pytest.mark.parametrize("protocol", ["clasp", "t_pose", "bow"])
def test_people_reach_in_every_protocol(protocol: str) -> None:
    for seed in (2, 36):  # they came to grief once
        lengths = simulate_person(seed).lengths
        options = {"rate_hz": 20.0, "clasp_s": 10.0, "circles": 1, "noise": NOISE_FREE}
        sim = simulate(lengths, seed=seed, imperfections=PEOPLE_PRESET, protocol=protocol, **options)
        for side in SIDES:
            speed = np.linalg.norm(np.diff(sim.points[f"{side}_palm"], axis=0), axis=1) * sim.rate_hz
            assert speed.max() < 5.0


# Activities ------------------------------------------------------------------------------------------------------


def test_arms_do_tasks_as_people_do() -> None:
    sim = simulate_activity("tasks", seed=1, imperfections=BODY, noise=NOISE_FREE, seconds=240.0, rate_hz=50.0)
    assert set(sim.quat_WL) == set(SEGMENTS)
    doing = within(sim, "tasks")
    assert np.linalg.norm(sim.points["left_palm"] - sim.points["right_palm"], axis=1)[doing].min() > 0.02
    for side in SIDES:
        rate_deg_s = np.rad2deg(np.linalg.norm(sim.gyro_S[f"{side}_forearm"][doing], axis=1))
        assert 0.3 < np.mean(rate_deg_s < 6.0) < 0.6  # still
        assert 90.0 < np.percentile(rate_deg_s, 90) < 200.0
        assert 250.0 < np.percentile(rate_deg_s, 99) < 500.0
        upper_W = Rotation.from_quat(sim.quat_WL[f"{side}_upper_arm"][doing]).apply((0.0, 0.0, -1.0))
        elevation = np.rad2deg(np.arccos(-upper_W[:, 2]))
        assert 0.01 < np.mean(elevation > 60.0) < 0.15
        shoulder = in_torso(sim, sim.points[f"{side}_shoulder"])
        assert 0.008 < np.sqrt(3.0) * rms(shoulder[doing] - shoulder[100]) < 0.035
    # no instant at which all sensors rest for long: nobody stands as on a table
    moving = np.max([np.linalg.norm(sim.gyro_S[segment], axis=1) for segment in SEGMENTS], axis=0)[doing]
    assert np.mean(moving < np.deg2rad(0.3)) < 0.1


def test_tasks_keep_the_physics() -> None:
    sim = simulate_activity("tasks", seed=2, imperfections=BODY, noise=NOISE_FREE, seconds=8.0, rate_hz=500.0)
    for segment in SEGMENTS:
        moved = check_accel(sim, segment, Rotation.from_quat(sim.quat_WS[segment]), 4.0, 13.0)
        assert segment == "torso" or moved.max() > 0.05
    again = simulate_activity("tasks", seed=2, imperfections=BODY, noise=NOISE_FREE, seconds=8.0, rate_hz=50.0)
    np.testing.assert_allclose(again.points["left_palm"], sim.points["left_palm"][::10][: len(again.time)], atol=1e-9)


# The command -----------------------------------------------------------------------------------------------------


def test_the_command_has_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "made"
    words = ["simulate", "-o", str(out), "--preset", "people", "--seed", "4", "--rate-hz", "20", "--seconds", "5"]
    assert run(*words, "--imperfection", "girdle=0") == 0
    person = simulate_person(4, 0.012)
    assert f"(measured: biacromial={person.measured['shoulder_width'] / 0.83:.4f}, stature" in capsys.readouterr().out
    session = load_session(out)
    truth = simulate(person.lengths, seed=4, rate_hz=20.0, clasp_s=5.0, imperfections=PEOPLE_PRESET).truth()
    held = (truth.time > session.phases["start"][0][0]) & (truth.time < session.phases["start"][0][1])
    faced = Rotation.from_quat(truth.quat_WL["torso"][held]).mean()
    assert abs(faced.as_euler("ZYX")[0]) < np.deg2rad(0.1)  # W's x is where the torso faces
    (clasp,) = session.phases["clasp"]
    assert clasp[1] - clasp[0] == pytest.approx(4.8)
    assert run("simulate", "-o", tmp_path / "tasks", "--activity", "tasks", "--rate-hz", 20, "--seconds", 6) == 0
    assert set(load_session(tmp_path / "tasks").phases) == {"start", "tasks", "rest"}
    assert run("simulate", "-o", tmp_path / "short", "--seconds", 2) == 2
