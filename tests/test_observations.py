"""What segments share, as residuals: against differences, and against Pinocchio."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.kinematics import compute_pose
from wepose_pin.observations.closures import PointPair
from wepose_pin.observations.hinges import HingePlane, linearize_hinge
from wepose_pin.observations.joint_accelerations import find_joint_pairs, linearize_joint
from wepose_pin.observations.paths import StartPose
from wepose_pin.observations.symbols import rotate


def test_rotate_in_casadi_is_scipys() -> None:
    rotation = Rotation.random(random_state=1)
    v = np.array([0.2, -1.0, 0.7])
    np.testing.assert_allclose(
        np.asarray(rotate(ca.DM(rotation.as_quat()), ca.DM(v))).ravel(), rotation.apply(v), atol=1e-15
    )


def test_the_jacobian_of_a_joints_misfit_is_that_of_differences() -> None:
    rng = np.random.default_rng(0)
    near_B, far_B = rng.normal(size=(2, 50, 3, 8))

    def misfit(values: np.ndarray) -> np.ndarray:
        return linearize_joint(near_B, far_B, values[0], values[1:8], values[8:]).e.ravel()

    at = rng.normal(size=15)
    J = np.stack([(misfit(at + d) - misfit(at - d)) / 2e-6 for d in 1e-6 * np.eye(15)], axis=1)
    residual = linearize_joint(near_B, far_B, at[0], at[1:8], at[8:])
    np.testing.assert_allclose(residual.jacobian.reshape(J.shape), J, rtol=1e-6, atol=1e-6)
    R = Rotation.from_rotvec([0.0, 0.0, at[0]]).as_matrix()
    near = (near_B @ np.concatenate(([1.0], at[1:8]))) @ R.T
    np.testing.assert_allclose(residual.force, near, rtol=1e-12)
    np.testing.assert_allclose(residual.e, far_B @ np.concatenate(([1.0], at[8:])) - near, rtol=1e-12)


def test_pairs_are_neighbours_with_nothing_between_that_moves() -> None:
    model = load_model("upper_body")
    quat = np.array([0.0, 0.0, 0.0, 1.0])
    everything = find_joint_pairs(model, dict.fromkeys(("torso", "left_upper_arm", "left_forearm"), quat))
    assert [(pair.near, pair.far, pair.travels) for pair in everything] == [
        ("torso", "left_upper_arm", True),
        ("left_upper_arm", "left_forearm", False),
    ]
    elbow = everything[1]
    half = 0.5 * model.lengths["left_upper_arm"]
    np.testing.assert_allclose(elbow.levers[:3], [0.0, 0.0, half], atol=1e-6)  # from the elbow up to the sensor
    assert elbow.levers[5] < -0.05
    assert find_joint_pairs(model, dict.fromkeys(("torso", "left_forearm"), quat)) == ()


def test_a_hinge_is_brought_back_into_its_range() -> None:
    n, a = (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)
    hinge = HingePlane("elbow", "upper_arm", "forearm", n, a, a, (np.deg2rad(-165.0), np.deg2rad(15.0)))
    above = Rotation.from_euler("xyz", [0.3, 0.9, 0.2])

    def excess(flexion_deg: float, turned: float = 0.0) -> tuple[float, float]:
        below = Rotation.from_rotvec([0.0, 0.0, turned]) * above * Rotation.from_euler("y", -flexion_deg, degrees=True)
        rows = linearize_hinge(hinge, above.as_quat()[None], below.as_quat()[None], np.zeros(2))
        return float(rows.excess[0]), float(rows.slope[0])

    for flexion in (0.0, 60.0, 140.0):
        assert excess(flexion)[0] == 0.0
    assert np.degrees(excess(-40.0)[0]) == pytest.approx(25.0)
    step = 1e-6
    slope = (excess(-40.0, step)[0] - excess(-40.0, -step)[0]) / (2.0 * step)
    assert excess(-40.0)[1] == pytest.approx(slope, rel=1e-3)


def test_a_gap_is_pinocchios_and_its_slopes_are_those_of_differences() -> None:
    rng, model = np.random.default_rng(0), load_model()
    model = replace(model, girdles={name: rng.normal(scale=0.02, size=7) for name in model.table.girdles})
    names = tuple(name for name in model.parents if name not in ("head", "pelvis"))
    points = PointPair(model, StartPose(model.neutral_rotations), names, ("left_palm", "right_palm"))
    assert set(points.segments) == set(names)
    quat_WL = Rotation.random(len(names), random_state=rng).as_quat()
    headings = rng.normal(size=len(names))

    def gap(headings: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(np.outer(headings, [0.0, 0.0, 1.0])) * Rotation.from_quat(quat_WL)
        pose = compute_pose(model, np.zeros(1), dict(zip(names, turned.as_quat()[:, None], strict=True)))
        return (pose.points["left_palm"] - pose.points["right_palm"])[0]

    rows = points.linearize(quat_WL[None], headings)
    np.testing.assert_allclose(rows.gap[0], gap(headings), atol=1e-9)
    slopes = [(gap(headings + step) - gap(headings - step)) / 2e-6 for step in 1e-6 * np.eye(len(names))]
    np.testing.assert_allclose(rows.H[0], np.transpose(slopes), atol=1e-6)
    reference = Rotation.from_euler("z", headings[0]) * Rotation.from_quat(quat_WL[0])
    left, right = points.locate_ends(quat_WL[None], headings)
    np.testing.assert_allclose(reference.apply(left - right)[0], gap(headings), atol=1e-9)
    longer = model.with_lengths({"left_forearm": model.lengths["left_forearm"] + 0.01})
    other = PointPair(longer, StartPose(model.neutral_rotations), names, points.points)
    grown = 0.01 * rows.by_shape[0, :, list(model.lengths).index("left_forearm")]
    np.testing.assert_allclose((other.linearize(quat_WL[None], headings).gap - rows.gap)[0], grown, atol=1e-9)


def test_the_slopes_of_a_hinge_are_those_of_differences() -> None:
    rng = np.random.default_rng(2)
    axis, long_axis = (float(v) for v in Rotation.random(random_state=rng).apply([0.0, 1.0, 0.0])), (0.0, 0.0, -1.0)
    hinge = HingePlane("elbow", "upper_arm", "forearm", tuple(axis), long_axis, (0.6, 0.0, 0.8), (-2.0, 0.3))
    on, moves = Rotation.random(2, random_state=rng).as_quat()[:, None]

    def deviation(headings: np.ndarray) -> float:
        return float(linearize_hinge(hinge, on, moves, headings).r[0])

    at = rng.normal(size=2)
    slopes = [(deviation(at + step) - deviation(at - step)) / 2e-6 for step in 1e-6 * np.eye(2)]
    rows = linearize_hinge(hinge, on, moves, at)
    np.testing.assert_allclose(rows.H[0, :2], slopes, atol=1e-8)
    for tilt, slope in zip((hinge.across, hinge.tilted), rows.H[0, 2:], strict=True):
        changed = [np.array(hinge.axis) + step * tilt for step in (1e-6, -1e-6)]
        after, before = (
            float(linearize_hinge(hinge._replace(axis=tuple(n / np.linalg.norm(n))), on, moves, at).r[0])
            for n in changed
        )
        assert (after - before) / 2e-6 == pytest.approx(slope, abs=1e-8)
