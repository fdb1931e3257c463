"""Error metrics on hand-made cases with known answers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import Pose, WeposeError, evaluate

TIME = np.arange(101) / 10.0


def pose(turn_deg: tuple[float, float, float] = (0, 0, 0), shift: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    """A torso that turns, shoulders and a hand that move; off by a turn about W's axes x, y, z and a shift [m]."""
    torso = Rotation.from_rotvec(np.outer(TIME, [0.1, 0.2, -0.3]))
    off = Rotation.from_euler("ZYX", [turn_deg[2], turn_deg[1], turn_deg[0]], degrees=True)
    hand = np.column_stack([np.sin(TIME), np.cos(TIME), TIME]) + shift
    points = {
        "left_shoulder": np.tile([0.0, 0.2, 0.5], (101, 1)),
        "right_shoulder": np.tile([0.0, -0.2, 0.5], (101, 1)),
        "left_palm": hand,
    }
    return Pose(TIME, {"torso": (off * torso).as_quat()}, points)


def test_a_known_turn_and_shift_come_out() -> None:
    errors = evaluate(pose((1.0, -2.0, 3.0), (0.003, 0.0, -0.004)), pose())
    attitude = errors.attitude["torso"]
    assert attitude.roll == pytest.approx((1.0, 0.0), abs=1e-9)
    assert attitude.pitch == pytest.approx((2.0, 0.0), abs=1e-9)
    assert attitude.yaw == pytest.approx((3.0, 0.0), abs=1e-9)
    assert attitude.total_rmse == pytest.approx(
        np.degrees(Rotation.from_euler("ZYX", [3, -2, 1], degrees=True).magnitude())
    )
    assert errors.position["left_palm"] == pytest.approx((5.0, 0.0, 5.0, 5.0), abs=1e-9)
    assert errors.samples == 101


def test_the_error_of_a_joint_is_that_of_its_angles() -> None:
    flexion = np.radians(60.0 + 50.0 * np.sin(TIME))
    upper = Rotation.from_euler("xy", [[20.0, -40.0]] * len(TIME), degrees=True)

    def arm(off_deg: float, carrying_deg: float) -> Pose:
        bend = np.column_stack([-flexion - np.radians(off_deg), np.full(len(TIME), -np.radians(carrying_deg))])
        forearm = upper * Rotation.from_euler("YX", bend)
        return Pose(TIME, {"right_upper_arm": upper.as_quat(), "right_forearm": forearm.as_quat()}, {})

    truth = arm(0.0, 0.0)
    truth.quat_WL["right_forearm"][:20] = np.nan
    estimated = arm(3.0, 2.0)
    estimated.quat_WL["torso"] = upper.as_quat()  # which the reference does not have
    cov = np.tile(1e-4 * np.eye(3), (len(TIME), 1, 1))
    errors = evaluate(replace(estimated, segment_cov=dict.fromkeys(estimated.quat_WL, cov)), truth).joints
    assert set(errors) == {"right_elbow"}
    assert errors["right_elbow"]["flexion"][:3] == pytest.approx((3.0, 3.0, 3.0), abs=1e-9)
    assert errors["right_elbow"]["carrying_angle"][:3] == pytest.approx((-2.0, 2.0, 2.0), abs=1e-9)
    assert errors["right_elbow"]["pronation"][:3] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_agreement_is_bland_and_altmans_and_the_icc_that_of_shrout_and_fleiss() -> None:
    """ICC(2,1) of two raters, by the mean squares of their analysis of variance."""
    true = np.linspace(-40.0, 60.0, 101)
    rated = true + 3.0 + np.where(np.arange(101) % 2, 1.0, -1.0)

    def arm(flexion_deg: np.ndarray) -> Pose:
        forearm = Rotation.from_euler("y", -flexion_deg[:, None], degrees=True).as_quat()
        upper = np.tile([0.0, 0.0, 0.0, 1.0], (101, 1))
        return Pose(TIME, {"right_upper_arm": upper, "right_forearm": forearm}, {})

    agreement = evaluate(arm(rated), arm(true)).joints["right_elbow"]["flexion"]
    assert (agreement.mean, agreement.rmse) == pytest.approx((3.0, np.sqrt(10.0)), abs=0.02)
    assert (agreement.lower, agreement.upper) == pytest.approx((3.0 - 1.96, 3.0 + 1.96), abs=0.03)
    assert agreement.range == pytest.approx(100.0)
    ratings = np.column_stack([rated, true])
    n, k, mean = 101, 2, ratings.mean()
    rows = k * np.sum((ratings.mean(axis=1) - mean) ** 2) / (n - 1)
    raters = n * np.sum((ratings.mean(axis=0) - mean) ** 2) / (k - 1)
    rest = (np.sum((ratings - mean) ** 2) - rows * (n - 1) - raters * (k - 1)) / ((n - 1) * (k - 1))
    icc = (rows - rest) / (rows + (k - 1) * rest + k * (raters - rest) / n)
    assert agreement.icc == pytest.approx(icc, abs=1e-4)


def test_near_the_lock_there_is_no_error_of_an_angle() -> None:
    """A shoulder's Y-X-Y is locked while the arm hangs."""
    segments = {s: np.tile([0.0, 0.0, 0.0, 1.0], (len(TIME), 1)) for s in ("torso", "right_upper_arm")}
    errors = evaluate(Pose(TIME, segments, {}), Pose(TIME, segments, {}))
    assert set(errors.joints) == {"thorax"}


def test_a_trunk_of_another_length_is_not_seen_from_the_shoulders() -> None:
    off = pose()
    for points in off.points.values():
        points[:, 2] += 0.02
    errors = evaluate(off, pose())
    assert errors.position["left_palm"].mean == pytest.approx(20.0)
    assert errors.position_on_limb["left_palm"].mean == pytest.approx(0.0, abs=1e-9)
    assert "left_shoulder" not in errors.position_on_limb


def test_the_reference_is_brought_to_the_poses_times_on_the_rotation() -> None:
    whole = pose()
    every_third = replace(
        whole,
        time=TIME[::3],
        quat_WL={"torso": whole.quat_WL["torso"][::3]},
        points={name: p[::3] for name, p in whole.points.items()},
    )
    errors = evaluate(whole, every_third)
    assert errors.attitude["torso"].total_rmse < 1e-9  # a constant rate about one axis: slerp is exact
    assert errors.interval == pytest.approx((0.0, 9.9))


def test_only_the_interval_counts() -> None:
    off = pose()
    off.points["left_palm"][:50] += 1.0  # type: ignore[index]
    assert evaluate(off, pose(), (5.0, 10.0)).position["left_palm"].mean == pytest.approx(0.0, abs=1e-9)
    assert evaluate(off, pose(), (0.0, 4.0)).position["left_palm"].mean == pytest.approx(1e3 * np.sqrt(3))


def test_no_error_is_taken_within_a_gap_of_the_truth() -> None:
    truth, off = pose(), pose()
    off.points["left_palm"][40:60] += 1.0  # type: ignore[index]
    truth.points["left_palm"][38:62] = np.nan  # type: ignore[index]
    assert evaluate(off, truth).position["left_palm"].worst == pytest.approx(0.0, abs=1e-9)


def test_heading_inclination_and_drift() -> None:
    truth = pose()
    drifting = Rotation.from_rotvec(np.outer(TIME, [0.0, 0.0, np.deg2rad(0.1)]))  # 0.1 deg/s
    tilted = Rotation.from_rotvec([np.deg2rad(2.0), 0.0, 0.0])
    off = replace(truth, quat_WL={"torso": (drifting * tilted * Rotation.from_quat(truth.quat_WL["torso"])).as_quat()})
    error = evaluate(off, truth).attitude["torso"]
    assert error.drift_deg_min == pytest.approx(6.0, abs=1e-6)
    assert error.inclination_rmse == pytest.approx(2.0, abs=1e-6)
    assert error.heading_rmse == pytest.approx(0.1 * np.sqrt(np.mean(TIME**2)), abs=1e-6)
    assert error.total_rmse == pytest.approx(np.hypot(error.inclination_rmse, error.heading_rmse), rel=1e-3)


def judge(error: np.ndarray, cov: np.ndarray) -> Any:
    """What is said of errors (n, 3) [m] of a point whose stated covariances are (n, 3, 3)."""
    time = np.arange(len(error)) / 100.0
    torso = np.tile([0.0, 0.0, 0.0, 1.0], (len(error), 1))
    off, true = (Pose(time, {"torso": torso}, {"left_palm": p}) for p in (error, np.zeros_like(error)))
    return evaluate(replace(off, point_cov={"left_palm": cov}), true).position_uncertainty["left_palm"]


def test_stated_uncertainty_is_judged() -> None:
    rng = np.random.default_rng(0)
    n = 20000
    cov = 1e-4 * (np.diag([1.0, 4.0, 9.0]) + 0.5)
    draws = rng.multivariate_normal(np.zeros(3), cov, n)
    right = judge(draws, np.tile(cov, (n, 1, 1)))
    assert right.nees == pytest.approx(3.0, abs=0.1)
    assert right.within_1 == pytest.approx(0.683, abs=0.01)
    assert right.within_2 == pytest.approx(0.954, abs=0.01)
    assert judge(draws, np.tile(cov / 4, (n, 1, 1))).nees == pytest.approx(12.0, abs=0.4)
    cov = np.tile(np.deg2rad(0.5) ** 2 * np.eye(3), (101, 1, 1))
    turned = replace(pose((0.5, 0.5, 0.5)), segment_cov={"torso": cov})
    assert evaluate(turned, pose()).attitude_uncertainty["torso"].nees == pytest.approx(3.0, abs=0.1)
    assert evaluate(pose(), pose()).position_uncertainty == {}


def test_nothing_in_common_is_named() -> None:
    with pytest.raises(WeposeError, match="no time in common"):
        evaluate(pose(), replace(pose(), time=TIME + 100.0))
    with pytest.raises(WeposeError, match="no time in common within the interval 20 to 30 s"):
        evaluate(pose(), pose(), (20.0, 30.0))
    with pytest.raises(WeposeError, match="no segment and no point in common"):
        evaluate(pose(), Pose(TIME, {"head": pose().quat_WL["torso"]}, {}))
