"""The preset `people`: sizes as the literature has them, physics kept, closures kept, switches independent."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from simulated import SUBJECT, G, check_accel, check_gyro, check_lengths, in_torso, within

from wepose_pin.cli import main
from wepose_pin.errors import BadOption
from wepose_pin.jobs.simulate import SimulateJob
from wepose_pin.kinematics import parse_pose_table
from wepose_pin.readers import load_session
from wepose_pin.rotations import heading
from wepose_pin.simulation import (
    IDEAL_PRESET,
    MEASURED_STD,
    MILD_PRESET,
    NOISE_FREE,
    PEOPLE_MEASURED_STD,
    PEOPLE_PRESET,
    PRESETS,
    SEGMENTS,
    Imperfections,
    Simulation,
    simulate,
    simulate_activity,
    simulate_person,
)
from wepose_pin.simulation.girdle import Girdle, compute_girdle
from wepose_pin.simulation.motion import SIDES, Flaws
from wepose_pin.simulation.people import START_POSE, Elbow, StartPoseOffsets
from wepose_pin.simulation.sequence import TASKS
from wepose_pin.simulation.signals import Process, RandomWalk, integrate_pulse, integrate_step, make_pulse, make_step
from wepose_pin.simulation.soft_tissue import GAINS, RANDOM_DEG, JointRotations, SoftTissue, lost_twist
from wepose_pin.simulation.subject import spawn_streams

MILD_GYRO = [-2.522546184523055, 0.08628641931856733, -0.49321743388267497]
MILD_ACCEL = [-9.551337890625, 1.59029296875, -0.0622705078125]
MILD_PALM = [0.2253376495869239, 0.11791698291767774, 0.6444541212989523]
SHORT = {"rate_hz": 20.0, "clasp_s": 5.0, "circles": 0, "noise": NOISE_FREE}
# The people preset with perfect sensors and clocks.
BODY = replace(
    PEOPLE_PRESET,
    **{
        field.name: getattr(IDEAL_PRESET, field.name)
        for field in fields(Imperfections)
        if field.name.startswith(("gyro", "accel", "clock", "bits", "misalignment", "g_sens", "dropped"))
    },
)
NEW = [
    field.name
    for field in fields(Imperfections)
    if getattr(PEOPLE_PRESET, field.name) != getattr(IDEAL_PRESET, field.name) == getattr(MILD_PRESET, field.name)
]
TISSUE = ("tissue_gain", "tissue_random", "breath_deg", "creep_deg", "strap_slip_deg", "wobble_deg")
SENSORS = (*TISSUE, "upper_arm_place", "forearm_place", "gyro_warm_up_deg_s", "clock_drift_ppm")


@pytest.fixture(scope="module")
def body() -> Simulation:
    return simulate(SUBJECT, seed=3, noise=NOISE_FREE, imperfections=BODY, clasp_s=30.0, circles=1)


def only(name: str) -> Imperfections:
    return replace(IDEAL_PRESET, **{name: getattr(PEOPLE_PRESET, name)})


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def shoulder_offset(sim: Simulation, side: str) -> np.ndarray:
    """Shoulder (n, 3) [m] in T from its place by the lengths."""
    place = (0.0, SIDES[side] * sim.lengths["shoulder_width"] / 2.0, sim.lengths["trunk"])
    return in_torso(sim, sim.points[f"{side}_shoulder"]) - place


# The presets -----------------------------------------------------------------------------------------------------


def test_the_mild_preset_is_what_it_was() -> None:
    assert PRESETS == {"ideal": IDEAL_PRESET, "mild": MILD_PRESET, "people": PEOPLE_PRESET}
    assert all(getattr(MILD_PRESET, name) == 0.0 for name in NEW)
    assert len(NEW) == 22
    sim = simulate(SUBJECT, seed=1, imperfections=MILD_PRESET, clasp_s=5.0, circles=1)
    # Figures of the version before the people preset.
    np.testing.assert_allclose(sim.gyro_S["left_forearm"][1000], MILD_GYRO, rtol=1e-9)
    np.testing.assert_allclose(sim.accel_S["left_forearm"][1000], MILD_ACCEL, rtol=1e-9)
    np.testing.assert_allclose(sim.points["right_palm"][1000], MILD_PALM, rtol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"girdle": -1.0}, "girdle -1"),
        ({"forearm_place": 1.5}, r"forearm_place 1\.5"),
        ({"tissue_gain": np.nan}, "gain"),
    ],
)
def test_wrong_sizes_are_named(wrong: dict, text: str) -> None:
    with pytest.raises(BadOption, match=text):
        Imperfections(**wrong)


# Signals ---------------------------------------------------------------------------------------------------------


def test_integrals_of_step_and_pulse() -> None:
    t = np.linspace(0.0, 10.0, 20001)
    for signal, integral in (
        (make_step(t, 2.0, 3.0), integrate_step(t, 2.0, 3.0)),
        (make_pulse(t, 1.0, 9.0, 2.0), integrate_pulse(t, 1.0, 9.0, 2.0)),
    ):
        np.testing.assert_allclose(integral, CubicSpline(t, signal).antiderivative()(t), atol=1e-9)


def test_processes_have_their_rms_and_correlation() -> None:
    t = np.arange(0.0, 400.0, 0.05)
    lag = round(2.0 / 0.05)
    values = np.hstack([Process(np.random.default_rng(seed), 2.0, 3)(t) for seed in range(40)])
    assert rms(values) == pytest.approx(1.0, rel=0.03)
    assert np.mean(values[lag:] * values[:-lag]) == pytest.approx(np.exp(-1.0), abs=0.06)
    assert np.mean(values[5 * lag :] * values[: -5 * lag]) == pytest.approx(0.0, abs=0.06)
    walks = np.stack(
        [RandomWalk(np.random.default_rng(seed), 600.0, 3)(np.array((0.0, 150.0, 600.0))) for seed in range(300)]
    )
    assert not walks[:, 0].any()
    assert rms(walks[:, 1]) == pytest.approx(0.5, rel=0.1)
    assert rms(walks[:, 2]) == pytest.approx(1.0, rel=0.1)


# The shoulder girdle ---------------------------------------------------------------------------------------------

# e, plane [deg] → up, back, to the middle [mm]: regression of de Groot & Brand 2001 through a clavicle of 150 mm.
DE_GROOT = {
    (60, 0): (17, 17, 18),
    (60, 90): (5, -1, 4),
    (90, 0): (31, 22, 29),
    (90, 90): (19, 6, 14),
    (120, 0): (46, 24, 42),
}


def direction(elevation_deg: float, plane_deg: float, y: float) -> np.ndarray:
    e, plane = np.deg2rad((elevation_deg, plane_deg))
    return np.array(((np.sin(e) * np.sin(plane), y * np.sin(e) * np.cos(plane), -np.cos(e)),))


@pytest.mark.parametrize("y", [1.0, -1.0])
def test_girdle_is_that_of_de_groot(y: float) -> None:
    for (e, plane), (up, back, middle) in DE_GROOT.items():
        moved_mm = 1e3 * compute_girdle(direction(e, plane, y), y)[0]
        np.testing.assert_allclose((moved_mm[2], -moved_mm[0], -y * moved_mm[1]), (up, back, middle), atol=1.8)
    assert np.abs(compute_girdle(direction(0.0, 0.0, y), y)).max() < 1e-6


def test_girdle_is_smooth_around_the_hanging_arm() -> None:
    """A swing past the hanging arm at 1 rad/s gives the shoulder no acceleration that a sensor would see as a step."""
    t = np.arange(-0.5, 0.5, 1e-3)
    for tilt in (0.0, 1e-3, 0.02):
        u = np.column_stack((np.sin(t), np.full_like(t, np.sin(tilt)), -np.cos(t)))
        moved = compute_girdle(u / np.linalg.norm(u, axis=1, keepdims=True), 1.0)
        accel = np.diff(moved, 2, axis=0) / 1e-6
        assert np.abs(np.diff(accel, axis=0)).max() < 0.05


def test_girdle_of_a_person(body: Simulation) -> None:
    sim = simulate(
        SUBJECT, seed=2, imperfections=only("girdle"), rate_hz=50.0, clasp_s=20.0, circles=0, noise=NOISE_FREE
    )
    scale = SUBJECT["shoulder_width"] / 0.340
    for side, y in SIDES.items():
        along_T = in_torso(sim, sim.points[f"{side}_elbow"] - sim.points[f"{side}_shoulder"])
        expected = scale * compute_girdle(along_T / np.linalg.norm(along_T, axis=1, keepdims=True), y)
        np.testing.assert_allclose(shoulder_offset(sim, side), expected, atol=1e-5)
    # 21 mm rms from the start over mixed arms, with what people do beside the law
    moved = [shoulder_offset(body, side)[within(body, "clasp")] - shoulder_offset(body, side)[100] for side in SIDES]
    assert 0.014 < np.sqrt(3.0) * rms(np.array(moved)) < 0.030


def test_rest_places_of_the_shoulders() -> None:
    """Lengths are those of the mean place: what is left is x of each, a shift in y, half the difference in z."""
    places = []
    for seed in range(400):
        rest = Girdle(only("girdle_rest"), spawn_streams(seed), 0.34).rest
        assert rest[1.0][1] == rest[-1.0][1]
        assert rest[1.0][2] == -rest[-1.0][2]
        places.append((rest[1.0], rest[-1.0]))
    left, right = np.moveaxis(np.array(places), 1, 0)
    assert rms(left[:, 0]) == pytest.approx(0.018, rel=0.1)
    assert np.corrcoef(left[:, 0], right[:, 0])[0, 1] == pytest.approx(0.7, abs=0.06)
    assert rms(left[:, 1]) == pytest.approx(0.012 * np.sqrt(0.15), rel=0.1)
    assert rms(left[:, 2]) == pytest.approx(0.013 * np.sqrt(0.15), rel=0.1)
    sim = simulate(SUBJECT, seed=2, imperfections=only("girdle_rest"), **SHORT)
    left, right = (in_torso(sim, sim.points[f"{side}_shoulder"]) for side in SIDES)
    np.testing.assert_allclose((left - right)[:, 1], SUBJECT["shoulder_width"], atol=1e-12)
    np.testing.assert_allclose((left + right)[:, 2] / 2.0, SUBJECT["trunk"], atol=1e-12)


def test_what_one_shoulder_does_differently() -> None:
    hanging, raised = direction(0.0, 0.0, 1.0), direction(90.0, 30.0, 1.0)
    moved, wandered = [], []
    for seed in range(400):
        girdle = Girdle(replace(IDEAL_PRESET, girdle_person=1.0, girdle_wander=1.0), spawn_streams(seed), 0.34)
        assert np.abs(girdle.displace(hanging, 1.0, np.zeros(1))).max() < 1e-9
        moved.append(girdle.displace(raised, 1.0, np.zeros(1))[0])
        wandered.append(girdle.place(1.0, np.array((50.0,)))[0])
    np.testing.assert_allclose(np.std(moved, axis=0), (0.006, 0.005, 0.008), rtol=0.12)
    np.testing.assert_allclose(np.std(wandered, axis=0), (0.007, 0.004, 0.008), rtol=0.12)


def test_girdle_leads_while_the_arm_is_raised() -> None:
    girdle = Girdle(replace(only("girdle"), girdle_hysteresis=0.03), spawn_streams(0), 0.34)
    u = direction(90.0, 0.0, 1.0)
    up, still, down = (girdle.displace(u, 1.0, np.array((rate,)))[0, 2] for rate in (100.0, 0.0, -100.0))
    assert up > still > down
    assert up - still == pytest.approx(compute_girdle(direction(92.7, 0.0, 1.0), 1.0)[0, 2] - still, abs=1e-5)


# Elbow, wrists, start pose ---------------------------------------------------------------------------------------


def abduction_deg(R_UF: Rotation, y: float) -> float:
    """Outward angle of the forearm, of a straight arm."""
    along = R_UF.apply((0.0, 0.0, -1.0))[0]
    return float(np.rad2deg(np.arctan2(y * along[1], -along[2])))


def test_carrying_angles() -> None:
    zero, supinated = np.zeros(1), np.deg2rad((80.0,))
    angles = []
    for seed in range(300):
        elbow = Elbow(only("carrying_angle"), spawn_streams(seed))
        for y in SIDES.values():
            full, neutral = (abduction_deg(elbow.rotate(y, zero, y * turn), y) for turn in (supinated, zero))
            bent = elbow.rotate(y, np.deg2rad((175.0,)), y * supinated).apply((0.0, 0.0, -1.0))[0]
            assert abs(np.rad2deg(bent[1])) < 2.0  # it goes as the elbow flexes
        angles.append((full, neutral))
    assert np.mean(angles, axis=0) == pytest.approx((14.15, 5.0), abs=0.6)
    assert np.std(angles, axis=0) == pytest.approx((3.87, 3.0), rel=0.15)


def test_elbow_turns_vectors_as_it_turns() -> None:
    rng = np.random.default_rng(0)
    elbow = Elbow(PEOPLE_PRESET, spawn_streams(1))
    flexion, pronation, vectors = rng.uniform(0.0, 2.4, 50), rng.uniform(-1.0, 1.0, 50), rng.standard_normal((50, 3))
    for y in SIDES.values():
        expected = elbow.rotate(y, flexion, pronation).apply(vectors)
        np.testing.assert_allclose(elbow.rotate_vectors(y, flexion, pronation, vectors), expected, atol=1e-12)


def test_residual_abduction() -> None:
    flexion = np.deg2rad(np.arange(0.0, 120.0))
    turns = []
    for seed in range(20):
        elbow = Elbow(only("elbow_abduction_deg"), spawn_streams(seed))
        hinge = Rotation.from_euler("Y", -flexion[:, None])
        turns.append((hinge.inv() * elbow.rotate(1.0, flexion, np.zeros(120))).as_rotvec(degrees=True))
    assert rms(np.array(turns)[:, :, 0]) == pytest.approx(1.5, rel=0.02)
    assert np.abs(np.array(turns)[:, :, 1:]).max() < 1e-9


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


def test_start_poses() -> None:
    poses = [StartPoseOffsets(PEOPLE_PRESET, spawn_streams(seed), SIDES) for seed in range(500)]
    arms = np.array([pose.upper_arm["left"] for pose in poses])
    np.testing.assert_allclose(np.rad2deg(arms.mean(axis=0)), (8.0, 0.0, -5.0), atol=1.2)
    np.testing.assert_allclose(np.rad2deg(arms.std(axis=0)), (4.0, 5.0, 12.0), rtol=0.1)
    flexion = np.rad2deg([list(pose.flexion.values()) for pose in poses])
    np.testing.assert_allclose(flexion.mean(axis=0), 12.0, atol=0.6)
    np.testing.assert_allclose(flexion.std(axis=0), 5.0, rtol=0.1)
    assert np.corrcoef(flexion.T)[0, 1] == pytest.approx(0.5, abs=0.1)
    torso = np.rad2deg([pose.torso for pose in poses])
    np.testing.assert_allclose(torso.std(axis=0), (1.5, 3.0, 4.0), rtol=0.1)
    assert set(START_POSE) >= {"head_pitch", "forearm_inward_twist"}
    # both arms are held outwards, elbows bent forwards
    sim = simulate(SUBJECT, seed=1, imperfections=only("start_pose"), **SHORT)
    for side, y in SIDES.items():
        upper = in_torso(sim, sim.points[f"{side}_elbow"] - sim.points[f"{side}_shoulder"])[40]
        wrist = in_torso(sim, sim.points[f"{side}_wrist"] - sim.points[f"{side}_elbow"])[40]
        assert y * upper[1] > 0.0
        assert wrist[0] > upper[0]


# Soft tissue -----------------------------------------------------------------------------------------------------


def joints(**turns: float) -> JointRotations:
    """Joints of both sides that are turned by these angles [rad]."""
    values = {name: np.array((turns.get(name, 0.0),)) for name in JointRotations._fields}
    swing = np.array(((0.0, -turns.get("elevation", 0.0), 0.0),))
    sides = {
        name: dict.fromkeys(SIDES, swing if name == "swing" else value)
        for name, value in values.items()
        if name != "trunk_flexion"
    }
    return JointRotations(values["trunk_flexion"], **sides)


def gains(segment: str, axis: int, **turns: float) -> np.ndarray:
    """Gains (400,) of persons: turn about an axis of L, over the angle of the one joint that is turned."""
    place = {"upper_arm": 0.6, "forearm": 0.85}.get(segment.partition("_")[2], 0.5)
    tissues = [SoftTissue(segment, place, only("tissue_gain"), spawn_streams(seed), 60.0) for seed in range(400)]
    turned = [tissue.follow(joints(**turns), joints())[0, axis] for tissue in tissues]
    return np.array(turned) / next(iter(turns.values()))


@pytest.mark.parametrize(
    ("segment", "axis", "joint", "angle", "mean", "std"),
    [
        ("left_upper_arm", 2, "twist", 0.5, -0.31, 0.08),
        ("right_forearm", 2, "pronation", 0.7, -0.185, 0.08),
        ("torso", 1, "trunk_flexion", 0.4, *GAINS["torso_flexion"]),
        ("torso", 1, "elevation", 1.0, *GAINS["torso_elevation"]),
        ("pelvis", 1, "trunk_flexion", 0.4, *GAINS["pelvis_flexion"]),
    ],
)
def test_sensors_follow_the_joints(segment: str, axis: int, joint: str, angle: float, mean: float, std: float) -> None:
    gain = gains(segment, axis, **{joint: angle})
    assert np.mean(gain) == pytest.approx(mean, abs=0.2 * std)
    assert np.std(gain) == pytest.approx(std, rel=0.15)


def test_elevation_is_read_too_small_above_30_deg() -> None:
    """About the axis of elevation, here −y; the angle over 30 deg counts."""
    gain = gains("left_upper_arm", 1, elevation=np.deg2rad(90.0)) * 90.0 / 60.0
    assert np.mean(gain) == pytest.approx(0.05, abs=0.01)
    assert np.std(gain) == pytest.approx(0.04, rel=0.15)
    assert not gains("left_upper_arm", 1, elevation=np.deg2rad(15.0)).any()


def test_bulging_muscles_turn_the_sensor_either_way() -> None:
    twist = gains("left_upper_arm", 2, flexion=1.0)
    assert np.mean(twist) == pytest.approx(0.0, abs=0.005)
    assert rms(twist) == pytest.approx(np.hypot(0.02, 0.02), rel=0.12)


def test_twist_is_lost_by_place() -> None:
    assert [lost_twist("upper_arm", p) for p in (0.3, 0.5, 0.8)] == pytest.approx([0.43, 0.35, 0.23])
    assert [lost_twist("forearm", p) for p in (0.5, 1.0)] == pytest.approx([0.50, 0.05])
    middle = simulate(SUBJECT, seed=2, imperfections=only("tissue_gain"), **SHORT)
    distal = simulate(SUBJECT, seed=2, imperfections=replace(only("tissue_gain"), forearm_place=0.85), **SHORT)
    for side in SIDES:
        name = f"{side}_forearm"
        assert distal.p_LS[name][2] == pytest.approx(-0.85 * SUBJECT[name])
        assert rms(distal.soft_tissue[name][:, 2]) < 0.8 * rms(middle.soft_tissue[name][:, 2])


@pytest.mark.parametrize("segment", ["torso", "left_upper_arm", "left_forearm", "head", "pelvis", "left_hand"])
def test_random_part_has_its_size_and_stands_with_the_segment(segment: str) -> None:
    t = np.arange(0.0, 60.0, 0.5)
    turns = []
    for seed in range(60):
        tissue = SoftTissue(segment, 0.5, only("tissue_random"), spawn_streams(seed), 60.0)
        turns.append(np.rad2deg(tissue(t, t, (joints(), joints()), np.zeros((len(t), 3)))))
        assert (
            np.ptp(tissue(t, np.full_like(t, 7.0), (joints(), joints()), np.zeros((len(t), 3))), axis=0).max() < 1e-15
        )
    across, twist, _ = RANDOM_DEG[segment.partition("_")[2] or segment]
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(turns), axis=(0, 1))), (across, across, twist), rtol=0.08)


@pytest.mark.slow
def test_breath_creep_slips_and_wobble() -> None:
    t = np.arange(0.0, 600.0, 0.1)
    still = (joints(), joints())
    none = np.zeros((len(t), 3))

    def turn(name: str, seed: int, segment: str = "torso", accel_L: np.ndarray = none) -> np.ndarray:
        return np.rad2deg(SoftTissue(segment, 0.5, only(name), spawn_streams(seed), 600.0)(t, 0.0 * t, still, accel_L))

    breath = turn("breath_deg", 1)
    assert rms(breath[:, 1]) == pytest.approx(0.7, rel=0.01)
    assert not breath[:, (0, 2)].any()
    crossings = np.sum(np.diff(np.sign(breath[:, 1])) != 0) / 2.0 / 600.0
    assert 0.22 <= crossings <= 0.28
    assert not turn("breath_deg", 1, "head").any()
    assert rms(np.array([turn("creep_deg", seed)[-1] for seed in range(150)])) == pytest.approx(1.0, rel=0.12)
    ends = np.array([turn("strap_slip_deg", seed)[-1] for seed in range(300)])
    assert not ends[:, :2].any()
    slipped = ends[ends[:, 2] != 0.0, 2]
    assert 6 < len(slipped) < 27  # of 15
    np.testing.assert_allclose(np.abs(slipped), 3.0)
    wobble = turn("wobble_deg", 1, accel_L=np.tile((0.0, 2.0 * G, 5.0 * G), (len(t), 1)))
    np.testing.assert_allclose(np.linalg.norm(wobble, axis=1), 1.0)


def test_turns_of_the_sensors_over_a_clasp(body: Simulation) -> None:
    """What the literature leads to expect: torso 2 to 4 deg in all, arms 2 to 4 across, more in twist; one person."""
    clasp = within(body, "clasp")
    for segment in SEGMENTS:
        turn = np.rad2deg(body.soft_tissue[segment][clasp])
        across, twist = rms(turn[:, :2]), rms(turn[:, 2])
        if segment == "torso":
            assert 1.5 < np.hypot(np.sqrt(2.0) * across, twist) < 5.0
        else:
            assert 1.2 < across < 5.0
            assert 2.0 < twist < 20.0
        R_WS = Rotation.from_quat(body.quat_WL[segment]) * Rotation.from_rotvec(body.soft_tissue[segment])
        R_WS = R_WS * Rotation.from_quat(body.quat_LS[segment])
        assert (R_WS.inv() * Rotation.from_quat(body.quat_WS[segment])).magnitude().max() < 1e-9


def test_sensors_stand_where_the_segments_do() -> None:
    sizes = replace(BODY, sway_deg_s=0.0, sway_tilt_deg=0.0, breath_deg=0.0, creep_deg=0.0)
    sim = simulate(SUBJECT, seed=5, imperfections=sizes, noise=NOISE_FREE, clasp_s=8.0, circles=1)
    for segment in SEGMENTS:
        for phase in ("start", "rest"):
            assert np.abs(sim.gyro_S[segment][within(sim, phase)]).max() < 1e-9
        assert np.abs(sim.soft_tissue[segment][within(sim, "start")]).max() > np.deg2rad(0.2)


# Physics stays whole ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("segment", SEGMENTS)
def test_gyro_integrates_to_the_sensors_own_orientation(body: Simulation, segment: str) -> None:
    check_gyro(body, segment, Rotation.from_quat(body.quat_WS[segment]), 30.0)


def check_path(sim: Simulation, start: float, stop: float) -> None:
    for segment in SEGMENTS:
        moved = check_accel(sim, segment, Rotation.from_quat(sim.quat_WS[segment]), start, stop)
        assert segment == "torso" or moved.max() > 0.05


@pytest.mark.slow
def test_accel_integrates_to_the_position() -> None:
    sim = simulate(SUBJECT, seed=4, rate_hz=300.0, noise=NOISE_FREE, imperfections=BODY, clasp_s=5.0, circles=0)
    check_path(sim, 4.5, 12.0)


def test_segments_keep_their_length(body: Simulation) -> None:
    check_lengths(body, rigid_hands=False)


def test_the_rate_does_not_change_the_motion(body: Simulation) -> None:
    slow = simulate(SUBJECT, seed=3, rate_hz=20.0, noise=NOISE_FREE, imperfections=BODY, clasp_s=30.0, circles=1)
    n = len(slow.time)
    for segment in SEGMENTS:
        np.testing.assert_allclose(slow.soft_tissue[segment], body.soft_tissue[segment][::5][:n], atol=1e-9)
    np.testing.assert_allclose(slow.points["right_palm"], body.points["right_palm"][::5][:n], atol=1e-9)


@pytest.mark.parametrize("protocol", TASKS)
def test_people_reach_in_every_protocol(protocol: str) -> None:
    for seed in (2, 36):  # they came to grief once
        person, rngs = simulate_person(seed), spawn_streams(seed)
        lengths = {name: float(value) for name, value in person.lengths.items()}
        flaws = Flaws(PEOPLE_PRESET, rngs, lengths["shoulder_width"])
        motion = TASKS[protocol](lengths, rngs["motion"], 30.0, 2, flaws)
        motion.fit_to_person(rngs["task"])
        t = np.arange(0.0, motion.span[1], 0.02)
        pose = motion(t)
        for side in SIDES:
            speed = np.linalg.norm(np.diff(pose.points[f"{side}_palm"], axis=0), axis=1) / 0.02
            assert speed.max() < 5.0


# Sensors ---------------------------------------------------------------------------------------------------------


def warm_up(seeds: range) -> list[float]:
    """How far each gyroscope's bias would go in 15 minutes [deg/s]; it goes at a constant rate."""
    changes = []
    for seed in seeds:
        clean, warm = (
            simulate(SUBJECT, seed=seed, imperfections=sizes, rate_hz=20.0, clasp_s=5.0, circles=0)
            for sizes in (IDEAL_PRESET, only("gyro_warm_up_deg_s"))
        )
        for segment in SEGMENTS:
            drift = np.rad2deg(warm.gyro_S[segment] - clean.gyro_S[segment])
            np.testing.assert_allclose(
                np.rad2deg(warm.gyro_bias[segment] - clean.gyro_bias[segment]), drift, atol=1e-12
            )
            np.testing.assert_allclose(drift, warm.time[:, None] / warm.time[-1] * drift[-1], atol=1e-12)
            changes.append(float(np.linalg.norm(drift[-1]) / warm.time[-1] * 900.0))
    return changes


def test_a_gyroscope_warms_up() -> None:
    assert all(0.02 <= change <= 0.2 for change in warm_up(range(2)))


@pytest.mark.monte_carlo
def test_gyroscopes_warm_up() -> None:
    changes = warm_up(range(60))
    assert 0.02 <= min(changes) < 0.03
    assert 0.15 < max(changes) <= 0.2
    assert np.median(changes) == pytest.approx(np.sqrt(0.02 * 0.2), rel=0.2)


def clock_rates(seeds: range) -> list[float]:
    """By how much each sensor's clock is off [ppm]: at all times the same."""
    rates = []
    for seed in seeds:
        sim = simulate(SUBJECT, seed=seed, imperfections=only("clock_drift_ppm"), rate_hz=20.0, clasp_s=5.0, circles=0)
        for segment in SEGMENTS:
            rates.append((sim.sample_time[segment][-1] / sim.time[-1] - 1.0) * 1e6)
            np.testing.assert_allclose(sim.sample_time[segment], sim.time * (1.0 + 1e-6 * rates[-1]), atol=1e-12)
    return rates


def test_a_clock_drifts() -> None:
    rates = clock_rates(range(2))
    assert len(set(rates)) == len(rates)
    assert all(abs(rate) < 4.0 * 5.0 for rate in rates)


@pytest.mark.monte_carlo
def test_clocks_drift() -> None:
    assert np.std(clock_rates(range(30))) == pytest.approx(5.0, rel=0.15)


def test_a_tape_errs_by_its_standard_deviation() -> None:
    for seed in range(5):
        careful, tape = simulate_person(seed), simulate_person(seed, PEOPLE_MEASURED_STD)
        for name, length in tape.lengths.items():
            if name in tape.measured:  # the same error, as many times as large
                error = (careful.measured[name] - length) * PEOPLE_MEASURED_STD / MEASURED_STD
                assert tape.measured[name] - length == pytest.approx(error, abs=1e-12)


@pytest.mark.monte_carlo
def test_measured_lengths_are_those_of_a_tape() -> None:
    errors = []
    for seed in range(200):
        person = simulate_person(seed, PEOPLE_MEASURED_STD)
        assert person.measured_std == 0.012
        errors += [person.measured[name] - person.lengths[name] for name in person.measured]
        assert person.lengths == simulate_person(seed).lengths
    assert np.std(errors) == pytest.approx(0.012, rel=0.1)


# Switches --------------------------------------------------------------------------------------------------------


def subject_draws(sizes: Imperfections, seed: int = 5) -> dict[str, np.ndarray]:
    """What is drawn for a subject, per imperfection, where it scales with it."""
    rngs = spawn_streams(seed)
    flaws = Flaws(sizes, rngs, 0.34)
    tissue = SoftTissue("left_upper_arm", 0.6, sizes, rngs, 600.0)
    girdle, start = flaws.girdle, flaws.start_pose
    return {
        "girdle_person": np.array(list(girdle.person.values())),
        "girdle_wander": girdle.wander.phase,
        "girdle_rest": np.array(list(girdle.rest.values())),
        "carrying_angle": np.array((flaws.elbow_joint.carrying, flaws.elbow_joint.neutral)),
        "elbow_abduction_deg": np.array(flaws.elbow_joint.phase),
        "start_pose": np.concatenate((start.torso[:2], *start.upper_arm.values(), list(start.flexion.values()))),
        "start_heading_deg": start.torso[2:],
        "sway_tilt_deg": flaws.tilt.phase,
        "wrist_flexion_deg": flaws.wrists.wander.phase,
        "palm_slip": np.array([wander.phase for wander in flaws.slip]),
        "sway_deg_s": np.array([sway.phase for sway in flaws.sway.values()]),
        "tissue_gain": tissue.draw,
        "tissue_random": tissue.random.phase,
        "breath_deg": np.array(tissue.breath),
        "creep_deg": tissue.creep.size,
    }


@pytest.mark.parametrize("name", NEW)
def test_switching_one_off_leaves_the_draws_of_the_others(name: str) -> None:
    draws, less = subject_draws(PEOPLE_PRESET), subject_draws(replace(PEOPLE_PRESET, **{name: 0.0}))
    for other, values in draws.items():
        if other == name and name in (
            "girdle_rest",
            "carrying_angle",
            "start_pose",
            "start_heading_deg",
            "tissue_gain",
        ):
            assert not less[other].any()
        else:
            assert np.array_equal(less[other], values), other


@pytest.mark.parametrize("name", NEW)
def test_switching_one_on_changes_only_it(name: str) -> None:
    options = {"seed": 5, "rate_hz": 20.0, "clasp_s": 8.0, "circles": 0}
    without = only("girdle") if name == "girdle_hysteresis" else IDEAL_PRESET  # it is one of the girdle
    ideal = simulate(SUBJECT, imperfections=without, **options)
    one = simulate(SUBJECT, imperfections=replace(without, **{name: getattr(PEOPLE_PRESET, name)}), **options)
    skeleton = all(np.array_equal(one.quat_WL[segment], ideal.quat_WL[segment]) for segment in SEGMENTS)
    assert skeleton == (name in SENSORS)
    assert any(values.any() for values in one.soft_tissue.values()) == (name in TISSUE and name != "strap_slip_deg")
    for segment in SEGMENTS:
        assert np.array_equal(one.quat_LS[segment], ideal.quat_LS[segment])
        assert np.array_equal(one.accel_bias[segment], ideal.accel_bias[segment])
        moved = name.endswith("_place") and segment.endswith(name.removesuffix("_place"))
        assert np.array_equal(one.p_LS[segment], ideal.p_LS[segment]) != moved
        assert np.array_equal(one.gyro_bias[segment], ideal.gyro_bias[segment]) == (name != "gyro_warm_up_deg_s")
        assert np.array_equal(one.sample_time[segment], ideal.sample_time[segment]) == (name != "clock_drift_ppm")
    if name not in ("wrist_flexion_deg", "wrist_deviation_deg"):
        clasp = within(one, "clasp")
        assert 1e3 * np.abs(one.points["left_palm"] - one.points["right_palm"])[clasp].max() < 0.01


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
        offset = shoulder_offset(sim, side)
        assert 0.008 < np.sqrt(3.0) * rms(offset[doing] - offset[100]) < 0.035
    # no instant at which all sensors rest for long: nobody stands as on a table
    moving = np.max([np.linalg.norm(sim.gyro_S[segment], axis=1) for segment in SEGMENTS], axis=0)[doing]
    assert np.mean(moving < np.deg2rad(0.3)) < 0.1


def test_tasks_keep_the_physics() -> None:
    sim = simulate_activity("tasks", seed=2, imperfections=BODY, noise=NOISE_FREE, seconds=8.0, rate_hz=500.0)
    check_path(sim, 4.0, 13.0)
    again = simulate_activity("tasks", seed=2, imperfections=BODY, noise=NOISE_FREE, seconds=8.0, rate_hz=50.0)
    np.testing.assert_allclose(again.points["left_palm"], sim.points["left_palm"][::10][: len(again.time)], atol=1e-9)


@pytest.mark.slow
def test_shoulders_move_in_activities_of_the_whole_body() -> None:
    options = {"seed": 3, "noise": NOISE_FREE, "seconds": 8.0, "rate_hz": 50.0}
    ideal = simulate_activity("walk", **options)
    tiny = simulate_activity("walk", imperfections=replace(IDEAL_PRESET, girdle_rest=1e-9), **options)
    for point, p_W in ideal.points.items():
        np.testing.assert_allclose(tiny.points[point], p_W, atol=1e-9, err_msg=point)
    for activity in ("walk", "sit"):
        sim = simulate_activity(activity, imperfections=BODY, **(options | {"seconds": 12.0}))
        for side in SIDES:
            assert np.ptp(shoulder_offset(sim, side), axis=0).max() > 0.003
            assert np.ptp(sim.soft_tissue[f"{side}_upper_arm"], axis=0).max() > np.deg2rad(2.0)
        assert rms(sim.soft_tissue["left_thigh"]) < np.deg2rad(1.0)  # creep and wobble only
        at_rest = Rotation.from_quat(sim.quat_WL["torso"][100]).magnitude()
        assert at_rest > np.deg2rad(0.3)


# The command -----------------------------------------------------------------------------------------------------


def run(*words: object) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(word) for word in words])
    assert stopped.value.code == 0


def test_the_command_has_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "made"
    words = ["simulate", "-o", str(out), "--preset", "people", "--seed", "4", "--rate-hz", "20", "--seconds", "5"]
    run(*words, "--imperfection", "girdle_wander=0")
    person = simulate_person(4, PEOPLE_MEASURED_STD)
    assert f"(measured: biacromial={person.measured['shoulder_width'] / 0.83:.4f}, stature" in capsys.readouterr().out
    session = load_session(out)
    assert session.truth is not None
    truth = parse_pose_table(pl.read_parquet(session.truth), "truth")
    held = (truth.time > session.phases["start"][0][0]) & (truth.time < session.phases["start"][0][1])
    faced = Rotation.from_quat(truth.quat_WL["torso"][held]).mean()
    assert abs(float(heading(faced.as_quat()))) < np.deg2rad(0.1)  # W's x is where the torso faces
    (clasp,) = session.phases["clasp"]
    assert clasp[1] - clasp[0] == pytest.approx(4.8)
    run("simulate", "-o", tmp_path / "tasks", "--activity", "tasks", "--rate-hz", 20, "--seconds", 6)
    assert set(load_session(tmp_path / "tasks").phases) == {"start", "tasks", "rest"}
    with pytest.raises(BadOption, match="--seconds 2"):
        SimulateJob(tmp_path, seconds=2.0).check()
