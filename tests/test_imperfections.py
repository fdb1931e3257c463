"""Imperfections of the simulated subject and its sensors: sizes as documented, physics kept, switches independent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from simulated import SIDES, SUBJECT, G, check_gyro, in_torso, multiply, within

from wepose_pin.readers import load_session
from wepose_pin.recording import ImuSensor, Recording, compute_mount
from wepose_pin.simulation import (
    IDEAL_PRESET,
    MILD_PRESET,
    NOISE_FREE,
    SEGMENTS,
    Imperfections,
    Simulation,
    SingleSensor,
    simulate,
    simulate_paper_drift,
    simulate_paper_dynamic,
)
from wepose_pin.writers import write_session

# The subject's own imperfections, with perfect sensors.
BODY = Imperfections(
    soft_tissue_deg=1.5,
    palm_slip=0.008,
    shoulder_wander=0.004,
    start_elbow_deg=5.0,
    start_segment_deg=1.5,
    sway_deg_s=0.1,
)
IN_MILD = [f.name for f in fields(Imperfections) if getattr(MILD_PRESET, f.name) != getattr(IDEAL_PRESET, f.name)]
IN_BODY = ("soft_tissue_deg", "palm_slip", "shoulder_wander", "start_elbow_deg", "start_segment_deg", "sway_deg_s")
SHORT = {"rate_hz": 20.0, "clasp_s": 5.0, "circles": 0, "noise": NOISE_FREE}
SHORTER = {"clasp_s": 8.0, "circles": 1}


@pytest.fixture(scope="module")
def body() -> Simulation:
    return simulate(SUBJECT, seed=3, noise=NOISE_FREE, imperfections=BODY)


@pytest.fixture(scope="module")
def realistic() -> Simulation:
    return simulate(SUBJECT, seed=5, imperfections=MILD_PRESET, **SHORTER)


def rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


# Presets and the perfect world -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"palm_slip": -0.001}, r"palm_slip -0\.001"),
        ({"mount": "some"}, "mount = 'some'"),
        ({"bits": 16}, "bits 16 need a finite"),
        ({"gyro_range_deg_s": 0.0}, "gyro_range_deg_s"),
        ({"dropped": 0.5}, r"dropped 0\.5"),
        ({"sway_deg_s": np.nan}, "sway_deg_s = nan"),
        ({"girdle": -1.0}, "girdle -1"),
        ({"forearm_place": 1.5}, r"forearm_place 1\.5"),
    ],
)
def test_wrong_sizes_are_named(wrong: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Imperfections(**wrong)
    with pytest.raises(ValueError, match="clock_jitter"):
        simulate(SUBJECT, seed=0, imperfections=Imperfections(clock_jitter=0.01), clasp_s=5.0, circles=0)


# Physics stays whole ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("segment", SEGMENTS)
def test_gyro_integrates_to_the_sensors_own_orientation(body: Simulation, segment: str) -> None:
    truth = Rotation.from_quat(body.quat_WS[segment])
    check_gyro(body, segment, truth, 60.0)
    skeleton = Rotation.from_quat(body.quat_WL[segment]) * Rotation.from_quat(body.quat_LS[segment])
    assert np.rad2deg((truth.inv() * skeleton).magnitude()).max() > 2.5  # which is not the segment's
    # The first rate is that of the sway as well, not a step.
    assert rms(body.gyro_S[segment][:1] - body.gyro_S[segment][1:2]) < np.deg2rad(0.05)


# Sizes as documented ---------------------------------------------------------------------------------------------


def test_soft_tissue_has_its_rms(body: Simulation) -> None:
    moving = body.time >= body.phases["clasp"][0][0]
    for segment in SEGMENTS:
        soft_deg = np.rad2deg(body.soft_tissue[segment])
        assert rms(soft_deg[moving]) == pytest.approx(1.5, rel=0.1)
        np.testing.assert_allclose(np.sqrt(np.mean(soft_deg[moving] ** 2, axis=0)), 0.87, rtol=0.12)
        assert rms(soft_deg[within(body, "start")]) < 0.3  # the strap's place is that of the start pose
        assert np.abs(np.diff(soft_deg, axis=0)).max() < 0.5  # smooth: 50 deg/s at the very most


def test_soft_tissue_follows_the_movement_and_is_still_at_rest() -> None:
    """Half of it is a fixed mixture of force and rate: a regression on them finds that half and no more."""
    sim = simulate(SUBJECT, seed=6, noise=NOISE_FREE, imperfections=Imperfections(soft_tissue_deg=1.5))
    moving = sim.time >= sim.phases["clasp"][0][0]
    explained = []
    for segment in SEGMENTS:
        R_WL = Rotation.from_quat(sim.quat_WL[segment])
        force_L = R_WL.inv().apply(Rotation.from_quat(sim.quat_WS[segment]).apply(sim.accel_S[segment]))
        rate_L = np.vstack((np.zeros(3), (R_WL[:-1].inv() * R_WL[1:]).as_rotvec() * sim.rate_hz))
        X = np.column_stack((force_L - [0.0, 0.0, G], rate_L))[moving]
        y = sim.soft_tissue[segment][moving]
        residual = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
        explained.append(1.0 - np.sum(residual**2) / np.sum(y**2))
        for phase in ("start", "rest"):
            assert np.abs(sim.gyro_S[segment][within(sim, phase)]).max() < 1e-9
    assert 0.4 < np.mean(explained) < 0.75


def test_palms_slip_by_as_much_as_stated(body: Simulation) -> None:
    clasp = within(body, "clasp")
    slip_mm = 1e3 * in_torso(body, body.points["left_palm"] - body.points["right_palm"])[clasp]
    assert rms(slip_mm) == pytest.approx(8.0, rel=0.1)
    np.testing.assert_allclose(np.sqrt(np.mean(slip_mm**2, axis=0)), 8.0 / np.sqrt(3.0), rtol=0.1)
    assert np.linalg.norm(np.diff(slip_mm, axis=0), axis=1).max() * body.rate_hz < 60.0  # [mm/s]
    assert np.linalg.norm(slip_mm[[0, -1]], axis=1).max() < 0.1


def test_shoulders_wander_with_elevation(body: Simulation) -> None:
    for side, y in (("left", 1.0), ("right", -1.0)):
        mean_T = np.array((0.0, y * SUBJECT["shoulder_width"] / 2, SUBJECT["trunk"]))
        off_T = in_torso(body, body.points[f"{side}_shoulder"]) - mean_T
        along_T = in_torso(body, body.points[f"{side}_elbow"] - body.points[f"{side}_shoulder"])
        one_less_cos = 1.0 + along_T[:, 2] / SUBJECT[f"{side}_upper_arm"]
        np.testing.assert_allclose(np.linalg.norm(off_T, axis=1), 0.004 * one_less_cos, atol=2e-4)
        raised = one_less_cos > 0.5
        assert raised.sum() > 500
        assert (off_T[raised, 2] > 0).all()  # up
        assert np.linalg.norm(off_T[within(body, "start")], axis=1).max() < 2e-5


@pytest.mark.slow
def test_start_pose_is_off_as_stated() -> None:
    sizes = Imperfections(start_elbow_deg=5.0)
    elbows = []
    for seed in range(20):
        sim = simulate(SUBJECT, seed=seed, imperfections=sizes, **SHORT)
        for side in SIDES:
            bend = Rotation.from_quat(sim.quat_WL[f"{side}_forearm"][40]).as_rotvec(degrees=True)
            np.testing.assert_allclose(bend[[0, 2]], 0.0, atol=1e-9)
            elbows.append(-bend[1])
    assert np.mean(elbows) == pytest.approx(5.0, rel=0.1)
    assert 0.5 < np.std(elbows) < 1.5
    assert min(elbows) > 0.0

    turns = []
    for seed in range(40):
        sim = simulate(SUBJECT, seed=seed, imperfections=Imperfections(start_segment_deg=1.5), **SHORT)
        at = {name: Rotation.from_quat(quat[40]) for name, quat in sim.quat_WL.items()}
        assert at["torso"].magnitude() < 1e-12
        for side in SIDES:
            upper = at[f"{side}_upper_arm"]
            turns += [upper.as_rotvec(degrees=True), (upper.inv() * at[f"{side}_forearm"]).as_rotvec(degrees=True)]
    assert rms(np.array(turns)) == pytest.approx(1.5, rel=0.12)


# Sensors ---------------------------------------------------------------------------------------------------------


def test_data_are_the_device_times_the_truth() -> None:
    options = {"seed": 2, "noise": NOISE_FREE, "clasp_s": 10.0, "circles": 1}
    clean = simulate(SUBJECT, **options)
    sizes = replace(IDEAL_PRESET, gyro_scale=0.01, accel_scale=0.02, misalignment_deg=1.0, g_sensitivity_deg_s=0.1)
    sim = simulate(SUBJECT, imperfections=sizes, **options)
    for segment, device in sim.device.items():
        accel_S = clean.accel_S[segment]
        gyro_S = clean.gyro_S[segment] @ device.gyro_matrix.T + accel_S @ device.g_matrix.T
        np.testing.assert_allclose(sim.gyro_S[segment], gyro_S, atol=1e-12)
        np.testing.assert_allclose(sim.accel_S[segment], accel_S @ device.accel_matrix.T, atol=1e-12)
        assert np.abs(sim.accel_S[segment] - accel_S).max() > 0.05


def test_quantisation_and_range() -> None:
    options = {"seed": 2, "clasp_s": 10.0, "circles": 1}
    clean = simulate(SUBJECT, **options)
    digital = simulate(
        SUBJECT, imperfections=Imperfections(gyro_range_deg_s=2000.0, accel_range_g=16.0, bits=16), **options
    )
    cut = simulate(SUBJECT, imperfections=Imperfections(gyro_range_deg_s=90.0, accel_range_g=1.05), **options)
    gyro_step, accel_step = np.deg2rad(2000.0) / 2**15, 16.0 * G / 2**15
    for segment in SEGMENTS:
        for name, step in (("gyro_S", gyro_step), ("accel_S", accel_step)):
            counts = getattr(digital, name)[segment] / step
            np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
            error = getattr(digital, name)[segment] - getattr(clean, name)[segment]
            assert np.abs(error).max() <= 0.5 * step * (1 + 1e-9)
            assert error.std() == pytest.approx(step / np.sqrt(12.0), rel=0.1)
        for name, limit in (("gyro_S", np.deg2rad(90.0)), ("accel_S", 1.05 * G)):
            expected = np.clip(getattr(clean, name)[segment], -limit, limit)
            assert np.array_equal(getattr(cut, name)[segment], expected)
    assert np.sum(np.abs(cut.gyro_S["left_forearm"]) == np.deg2rad(90.0)) > 10


def test_clocks_shift_the_samples_in_the_data() -> None:
    options = {"seed": 2, "noise": NOISE_FREE, "clasp_s": 10.0, "circles": 1, "rate_hz": 200.0}
    clean = simulate(SUBJECT, **options)
    sizes = Imperfections(clock_jitter=2e-4, clock_offset=5e-3)
    sim = simulate(SUBJECT, imperfections=sizes, **options)
    offsets = []
    for segment in SEGMENTS:
        late = sim.sample_time[segment] - sim.time
        offsets.append(late.mean())
        assert late.std() == pytest.approx(2e-4, rel=0.1)
        expected = CubicSpline(clean.time, clean.accel_S[segment])(sim.sample_time[segment])
        assert np.abs(sim.accel_S[segment] - expected)[20:-20].max() < 5e-3
        # a rate times the time that it was measured over is the rotation
        R_WS = Rotation.from_quat(sim.quat_WS[segment])
        turned = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() / np.diff(sim.sample_time[segment])[:, None]
        np.testing.assert_allclose(sim.gyro_S[segment][1:], turned, atol=1e-12)
    assert np.ptp(offsets) > 2e-3
    recorded = sim.recording()
    assert np.array_equal(recorded.time, sim.time)
    assert np.array_equal(recorded.sensors["torso"].gyro_S, sim.gyro_S["torso"])


def test_lost_samples_are_bridged_as_in_a_users_file(realistic: Simulation, tmp_path: Path) -> None:
    recorded = realistic.recording()
    raw = {
        segment: ImuSensor(realistic.gyro_S[segment], realistic.accel_S[segment], compute_mount(*mount))
        for segment, mount in realistic.stated_mount.items()
        if mount is not None
    }
    assert sum(np.isnan(sensor.gyro_S[:, 0]).sum() for sensor in raw.values()) > 10
    write_session(tmp_path, Recording("raw", recorded.time, recorded.rate_hz, raw, recorded.phases))
    read = load_session(tmp_path)
    for segment, sensor in recorded.sensors.items():
        np.testing.assert_allclose(read.sensors[segment].gyro_S, sensor.gyro_S, rtol=1e-12)
        np.testing.assert_allclose(read.sensors[segment].accel_S, sensor.accel_S, rtol=1e-12)
        assert not np.array_equal(sensor.gyro_S, realistic.gyro_S[segment])


def test_mounts_are_at_any_rotation() -> None:
    sizes = Imperfections(mount="any")
    mounts = []
    for seed in range(30):
        sim = simulate(SUBJECT, seed=seed, imperfections=sizes, **SHORT)
        assert set(sim.stated_mount.values()) == {None}
        mounts += list(sim.quat_LS.values())
    # 150 uniform rotations: each entry of the mean matrix has the standard deviation sqrt(1/3/150)
    assert np.abs(Rotation.from_quat(mounts).as_matrix().mean(axis=0)).max() < 4 * np.sqrt(1 / 450)


# Switches --------------------------------------------------------------------------------------------------------


def off(name: str) -> Imperfections:
    if name.endswith(("range_deg_s", "range_g")):  # bits need a range
        return replace(MILD_PRESET, **{name: np.inf, "bits": 0})
    return replace(MILD_PRESET, **{name: "any" if name == "mount" else getattr(IDEAL_PRESET, name)})


def sensor_draws(sim: Simulation) -> dict[str, np.ndarray]:
    eye = np.eye(3, dtype=bool)
    gyro, accel = (np.stack([getattr(d, f"{n}_matrix") for d in sim.device.values()]) for n in ("gyro", "accel"))
    clock = np.stack(list(sim.sample_time.values())) - sim.time
    return {
        "noise": np.stack([*sim.gyro_bias.values(), *sim.accel_bias.values()]),
        "mount": np.stack(list(sim.quat_LS.values())),
        "gyro_scale": gyro[:, eye],
        "accel_scale": accel[:, eye],
        "misalignment_deg": np.stack((gyro[:, ~eye], accel[:, ~eye])),
        "g_sensitivity_deg_s": np.stack([d.g_matrix for d in sim.device.values()]),
        "clock_jitter": np.diff(clock, axis=1).round(12),
        "clock_offset": clock.mean(axis=1).round(4),
        "dropped": np.stack([np.isnan(v) for v in sim.gyro_S.values()]),
    }


@pytest.mark.parametrize("name", [*IN_MILD, "mount"])
def test_switching_one_off_leaves_the_others_as_they_are(realistic: Simulation, name: str) -> None:
    without = simulate(SUBJECT, seed=5, imperfections=off(name), **SHORTER)
    less = sensor_draws(without)
    for other, values in sensor_draws(realistic).items():
        if other == name:
            assert not np.array_equal(values, less[other]), other
        else:
            np.testing.assert_allclose(less[other], values, atol=2e-4 if other == "clock_offset" else 2e-12)
    if name not in IN_BODY:
        for segment in SEGMENTS:
            assert np.array_equal(without.quat_WL[segment], realistic.quat_WL[segment])
        assert np.array_equal(without.points["right_palm"], realistic.points["right_palm"])
    # What is seen of the others does not change either.
    clasp = within(realistic, "clasp")
    slip, less_slip = (in_torso(s, s.points["left_palm"] - s.points["right_palm"])[clasp] for s in (realistic, without))
    if name == "palm_slip":
        assert np.abs(less_slip).max() < 1e-9
    else:
        np.testing.assert_allclose(less_slip, slip, atol=1e-9)
    if name == "soft_tissue_deg":
        assert not any(v.any() for v in without.soft_tissue.values())
    elif name not in (*IN_BODY, "clock_jitter", "clock_offset"):
        for segment in SEGMENTS:
            assert np.array_equal(without.soft_tissue[segment], realistic.soft_tissue[segment])


# One sensor ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "moving", "rate_peak", "accel_peak"),
    [
        (simulate_paper_dynamic, (5.0, 55.0), (6.0, 8.0), (15.0, 20.0)),
        (simulate_paper_drift, (25.0, 35.0), (13.0, 15.0), (40.0, 50.0)),
    ],
)
def test_single_sensor(make: Callable[..., SingleSensor], moving: tuple, rate_peak: tuple, accel_peak: tuple) -> None:
    for seed in range(3):
        one = make(seed, 1000.0, noise=NOISE_FREE)
        assert one.moving == moving
        assert one.time[-1] == 60.0
        R_WS = Rotation.from_quat(one.quat_WS)
        for end in (30000, 60000):
            assert (multiply(one.gyro_S[1 : end + 1] / 1000.0).inv() * R_WS[0].inv() * R_WS[end]).magnitude() < 1e-6
        accel_W = R_WS.apply(one.accel_S) - [0.0, 0.0, G]
        k = slice(int(moving[0] * 1000) - 1000, int(moving[0] * 1000) + 9001)  # 10 s from before the motion
        integrated = one.p_WS[k][0] + CubicSpline(one.time[k], accel_W[k]).antiderivative(2)(one.time[k])
        assert np.abs(integrated - one.p_WS[k]).max() < 1e-3
        for a, b in one.static:
            rest = (one.time > a + 0.01) & (one.time < b - 0.01)
            assert np.abs(one.gyro_S[rest]).max() < 1e-12
            np.testing.assert_allclose(np.linalg.norm(one.accel_S[rest], axis=1), G, atol=1e-9)
        for values, peak in ((one.gyro_S, rate_peak), (accel_W, accel_peak)):
            assert peak[0] * 0.97 < np.linalg.norm(values, axis=1).max() < peak[1] * 1.03
        assert np.abs(one.p_WS).max() < 0.8  # within reach of an arm
