"""Orientations to configuration to points, against the closed form p = Σ R l and brute force."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import POINTS, RIGID_SHOULDERS, measure_residuals
from scipy.spatial.transform import Rotation

from wepose_pin import BodyModel, load_model
from wepose_pin.body.configuration import compute_pose, solve_configuration
from wepose_pin.body.kinematics import compute_link_poses

CORE = ["torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm"]
SEGMENTS = [*CORE, "pelvis", "head", "left_hand", "right_hand"]
N = 40


def orientations(segments: list[str], seed: int = 0, n: int = N) -> dict[str, np.ndarray]:
    """Any orientation for each segment; signs of the quaternions at random."""
    rng = np.random.default_rng(seed)
    return {s: Rotation.random(n, random_state=rng).as_quat() * rng.choice([-1, 1], (n, 1)) for s in segments}


def gazebo(data: Path, dof: int) -> BodyModel:
    return load_model(data / "human_urdf" / f"humanSubject01_{dof}dof.urdf")


# Ours -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hands", [True, False])
def test_points_are_the_sum_of_turned_lengths(hands: bool) -> None:
    lengths = {"trunk": 0.5, "shoulder_width": 0.4, "left_upper_arm": 0.31, "right_hand": 0.08}
    body = replace(load_model(lengths=lengths), girdles=RIGID_SHOULDERS)
    L = body.lengths
    quat_WL = orientations(SEGMENTS if hands else CORE)
    pose = compute_pose(body, np.arange(N) / 100.0, quat_WL)
    R = {segment: Rotation.from_quat(quat) for segment, quat in quat_WL.items()}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        p = R["torso"].apply([0.0, sign * L["shoulder_width"] / 2.0, L["trunk"]])
        np.testing.assert_allclose(pose.points[f"{side}_shoulder"], p, atol=1e-12)
        for segment, point in (("upper_arm", "elbow"), ("forearm", "wrist"), ("hand", "palm")):
            turned = R.get(f"{side}_{segment}", R[f"{side}_forearm"])  # a hand without a sensor is rigid
            p = p + turned.apply([0.0, 0.0, -L[f"{side}_{segment}"]])
            np.testing.assert_allclose(pose.points[f"{side}_{point}"], p, atol=1e-12)
    assert set(pose.points) == set(POINTS)


GIRDLES = {
    "left_shoulder": np.array([-0.3, 0.01, -0.005, 0.004, 0.006, 0.003, -0.008]),
    "right_shoulder": np.array([0.2, -0.012, 0.004, 0.006, -0.005, 0.002, 0.009]),
}


def test_a_hanging_arm_leaves_the_shoulder_at_rest_and_a_raised_one_lifts_it() -> None:
    """90 deg sideways: up 33.5 mm, 23 mm to the middle, and 21.5 mm back, of shoulders 0.34 m apart."""
    body = load_model(lengths={"shoulder_width": 0.34})
    neutral = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    quat_WL = {name: neutral.copy() for name in CORE}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        quat_WL[f"{side}_upper_arm"][1] = Rotation.from_rotvec([sign * np.pi / 2.0, 0.0, 0.0]).as_quat()
    points = compute_pose(body, np.arange(2.0), quat_WL).points
    back = 2.0 + 20.0 * (1.0 - np.exp(-90.0 / 25.0))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at_rest, raised = points[f"{side}_shoulder"]
        np.testing.assert_allclose(at_rest, [0.0, sign * 0.17, body.lengths["trunk"]], atol=1e-4)
        np.testing.assert_allclose(1e3 * (raised - at_rest), [-back, -sign * 23.0, 33.5], atol=0.05)


def test_an_arm_without_a_sensor_leaves_its_shoulder_at_rest() -> None:
    """What is beyond is not known, but the shoulder is: where the person holds it at rest."""
    body = replace(load_model(), girdles=GIRDLES)
    quat_WL = orientations(["torso"])
    points = compute_pose(body, np.arange(N) / 100.0, quat_WL).points
    for name, sign in (("left_shoulder", 0.5), ("right_shoulder", -0.5)):
        at = np.array([0.0, sign * body.lengths["shoulder_width"], body.lengths["trunk"]]) + GIRDLES[name][1:4]
        np.testing.assert_allclose(points[name], Rotation.from_quat(quat_WL["torso"]).apply(at), atol=1e-12)


def test_the_configuration_does_not_jump() -> None:
    t = np.linspace(0.0, 20.0, 2000)
    turns = {s: Rotation.from_rotvec(np.outer(t, np.roll([1.0, 0.3, -0.5], k))) for k, s in enumerate(SEGMENTS)}
    q = solve_configuration(
        load_model(), {s: R.as_quat() * np.where(np.sin(7.0 * t) < 0.0, -1.0, 1.0)[:, None] for s, R in turns.items()}
    )
    assert np.abs(np.diff(q, axis=0)).max() < 0.05


def test_the_unmeasured_is_rigid_with_what_is_above() -> None:
    body = load_model()
    quat_WL = orientations(CORE)
    q = solve_configuration(body, quat_WL)
    for segment, above in (("left_hand", "left_forearm"), ("head", "torso"), ("pelvis", "torso")):
        assert measure_residuals(body, q, {segment: quat_WL[above]})[segment].max() < 1e-7


# Models of others -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [48, 66, None])
def test_what_hangs_on_spherical_joints_follows_exactly(data: Path, dof: int | None) -> None:
    body = gazebo(data, dof) if dof else load_model()
    exact = {48: ["torso", "head"], 66: [segment for segment in SEGMENTS if segment != "pelvis"], None: SEGMENTS}[dof]
    quat_WL = orientations(SEGMENTS)
    q = solve_configuration(body, quat_WL)
    residuals = measure_residuals(body, q, quat_WL)
    assert {name for name, angle in residuals.items() if angle.max() < 1e-7} == set(exact)
    for k in map(body.pin.getJointId, body.axes):
        first = body.pin.idx_qs[k]
        np.testing.assert_allclose(np.linalg.norm(q[:, first : first + 4], axis=1), 1.0, atol=1e-14)


def test_a_spine_bends_evenly_and_does_not_twist_when_the_person_turns_round(data: Path) -> None:
    for dof in (48, 66):
        body = gazebo(data, dof)
        bend, turn = Rotation.from_euler("y", 60.0, degrees=True), Rotation.from_euler("z", 179.0, degrees=True)
        for heading in (Rotation.identity(), turn, turn * turn):
            q = solve_configuration(body, {"torso": (heading * bend).as_quat()[None]})
            links = ["L5", "L3", "T12", "left_upper_arm", "right_upper_arm"]
            R_WL, p_W = compute_link_poses(body, q, links)
            for k in range(3):
                bent = heading * Rotation.from_euler("y", 15.0 * (k + 1), degrees=True)
                np.testing.assert_allclose(R_WL[0, k, :, 2], bent.apply([0.0, 0.0, 1.0]), atol=0.01)
            middle = p_W[0, 3:].mean(axis=0)
            forward = heading.apply([1.0, 0.0, 0.0])
            assert middle @ forward > 0.15  # it leans where it faces
            np.testing.assert_allclose(middle - (middle @ forward) * forward, [0.0, 0.0, middle[2]], atol=0.01)
