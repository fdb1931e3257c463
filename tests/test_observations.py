"""What segments share, as residuals: against differences, and against Pinocchio."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.kinematics import compute_pose
from wepose_pin.body.mounts import StartPose
from wepose_pin.observations.hinges import HingePlane, linearize_hinge
from wepose_pin.observations.joint_accelerations import find_joint_pairs, linearize_joint
from wepose_pin.observations.paths import PointPair


def differentiate(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """The Jacobian (…, m) of a function of (m,), by differences."""
    steps = 1e-6 * np.eye(len(at))
    return np.stack([(function(at + step) - function(at - step)) / 2e-6 for step in steps], axis=-1)


def test_a_joints_misfit_and_its_jacobian() -> None:
    rng = np.random.default_rng(0)
    near_B, far_B = rng.normal(size=(2, 50, 3, 8))
    at = rng.normal(size=15)
    e, jacobian, force = linearize_joint(near_B, far_B, at[0], at[1:8], at[8:])
    J = differentiate(lambda x: linearize_joint(near_B, far_B, x[0], x[1:8], x[8:])[0], at)
    np.testing.assert_allclose(jacobian, J, rtol=1e-6, atol=1e-6)
    R = Rotation.from_rotvec([0.0, 0.0, at[0]]).as_matrix()
    near = (near_B @ np.concatenate(([1.0], at[1:8]))) @ R.T
    np.testing.assert_allclose(force, near, rtol=1e-12)
    np.testing.assert_allclose(e, far_B @ np.concatenate(([1.0], at[8:])) - near, rtol=1e-12)


def test_pairs_are_neighbours_with_nothing_between_that_moves() -> None:
    model, quat = load_model("upper_body"), np.array([0.0, 0.0, 0.0, 1.0])
    shoulder, elbow = find_joint_pairs(model, dict.fromkeys(("torso", "left_upper_arm", "left_forearm"), quat))
    assert (shoulder.near, shoulder.far, shoulder.travels) == ("torso", "left_upper_arm", True)
    assert (elbow.near, elbow.far, elbow.travels) == ("left_upper_arm", "left_forearm", False)
    half = 0.5 * model.lengths["left_upper_arm"]
    np.testing.assert_allclose(elbow.levers[:3], [0.0, 0.0, half], atol=1e-6)  # from the elbow up to the sensor
    assert elbow.levers[5] < -0.05
    assert find_joint_pairs(model, dict.fromkeys(("torso", "left_forearm"), quat)) == ()


def test_a_hinge_leaves_its_plane_and_its_range() -> None:
    hinge = HingePlane("elbow", "arm", "forearm", (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, -1.0), (-2.9, 0.3))
    above = Rotation.from_euler("xyz", [0.3, 0.9, 0.2])

    def linearize(flexion: float, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """The forearm is 0.1 rad aside; x: headings, and the axis off along `across` and `tilted`."""
        below = above * Rotation.from_euler("YX", [-flexion, 0.1])
        axis = np.array(hinge.axis) + x[2] * hinge.across + x[3] * hinge.tilted
        off = hinge._replace(axis=tuple(axis / np.linalg.norm(axis)))
        return linearize_hinge(off, above.as_quat()[None], below.as_quat()[None], x[:2])

    for flexion, excess in ((0.0, 0.0), (1.0, 0.0), (2.5, 0.0), (-0.7, 0.4)):
        r, H, beyond, slope = linearize(flexion, np.zeros(4))
        assert r[0] == pytest.approx(np.sin(0.1))
        assert beyond[0] == pytest.approx(excess)
        np.testing.assert_allclose(H, differentiate(lambda x, f=flexion: linearize(f, x)[0], np.zeros(4)), atol=1e-8)
        if excess:
            slopes = differentiate(lambda x: linearize(-0.7, x)[2], np.zeros(4))[0]
            np.testing.assert_allclose(slopes[:2], [slope[0], -slope[0]], rtol=1e-6)


def test_a_gap_is_pinocchios() -> None:
    rng, model = np.random.default_rng(0), load_model()
    model = replace(model, girdles={name: rng.normal(scale=0.02, size=7) for name in model.table.girdles})
    names = tuple(name for name in model.parents if name not in ("head", "pelvis"))
    quat_WL, headings = Rotation.random(len(names), random_state=rng).as_quat(), rng.normal(size=len(names))
    turned = Rotation.from_rotvec(np.outer(headings, [0.0, 0.0, 1.0])) * Rotation.from_quat(quat_WL)
    pose = compute_pose(model, np.zeros(1), dict(zip(names, turned.as_quat()[:, None], strict=True)))
    points = PointPair(model, StartPose(model.neutral_rotations), names, ("left_palm", "right_palm"))
    assert set(points.segments) == set(names)
    gap, H, by_shape, *_ = points.linearize(quat_WL[None], headings)
    np.testing.assert_allclose(gap, pose.points["left_palm"] - pose.points["right_palm"], atol=1e-9)
    J = differentiate(lambda x: points.linearize(quat_WL[None], x)[0], headings)
    np.testing.assert_allclose(H, J, atol=1e-6)
    longer = model.with_lengths({"left_forearm": model.lengths["left_forearm"] + 0.01})
    other = PointPair(longer, StartPose(model.neutral_rotations), names, points.points)
    grown = 0.01 * by_shape[:, :, list(model.lengths).index("left_forearm")]
    np.testing.assert_allclose(other.linearize(quat_WL[None], headings)[0] - gap, grown, atol=1e-9)
