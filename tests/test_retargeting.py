"""Retargeting on an arm of our own: following, collisions, targets out of reach, jumps, losses, other forms of arms."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from arms import HAND, JOINTS, UPPER, is_sound, person, write_arm
from scipy.spatial.transform import Rotation

from wepose_pin import errors, retargeting
from wepose_pin.retargeting import controller as control
from wepose_pin.retargeting.collision import CollisionModel

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory):
    return retargeting.load_robot(str(write_arm(tmp_path_factory.mktemp("arm"))))


@pytest.fixture(scope="module")
def swung(arm) -> retargeting.Trajectory:
    return retargeting.retarget(person(), arm)


def checked(trajectory: retargeting.Trajectory, changed: pl.DataFrame | None = None) -> retargeting.LimitCheck:
    return retargeting.check_limits(
        retargeting.build_table(trajectory) if changed is None else changed, trajectory.robot.map
    )


def summarized(trajectory: retargeting.Trajectory) -> dict[str, Any]:
    """What the summary says of the right arm."""
    contacts = retargeting.find_self_collisions(trajectory.robot, trajectory.time, trajectory.joint_position)
    return dict(retargeting.summarize(trajectory, checked(trajectory), contacts)["arms"]["right"])


def error(trajectory: retargeting.Trajectory, side: str = "right") -> np.ndarray:
    target = trajectory.targets[[arm.side for arm in trajectory.robot.arms].index(side)]
    return np.linalg.norm(trajectory.hand[side] - target.position, axis=1)[trajectory.approach_samples :]


def test_a_motion_leaves_the_margins_that_are_asked_for(arm, swung: retargeting.Trajectory, tmp_path: Path) -> None:
    """Of limits in the map before the URDF's, which here differ by far."""
    held = checked(swung)
    assert held.position > 0.05 - 1e-9
    assert min(held.velocity, held.acceleration, held.jerk) > 0.1 - 1e-9
    urdf = write_arm(tmp_path)
    stated = "[limits.position]\nelbow = [-1.5, -0.7]\n[limits.velocity]\nelbow = 0.8\n[arms.right]"
    said = urdf.with_suffix(".toml").read_text().replace("[arms.right]", stated)
    urdf.with_suffix(".toml").write_text(said)
    narrow = retargeting.load_robot(str(urdf), speed_scale=0.5, limit_margin=0.1)
    trajectory = retargeting.retarget(person(3.0), narrow)
    is_sound(trajectory)
    elbow = JOINTS.index("elbow")
    assert trajectory.joint_position[:, elbow].min() >= -1.4 - 1e-8  # the bounds are searched to 1e-9
    assert trajectory.joint_position[:, elbow].max() <= -0.8 + 1e-8
    assert np.abs(trajectory.joint_velocity[:, elbow]).max() <= 0.4 + 1e-8
    assert np.abs(trajectory.joint_acceleration).max() <= 6.0 + 1e-8
    table = retargeting.build_table(swung)
    assert retargeting.check_limits(table, arm.map).passed
    assert retargeting.check_limits(table, narrow.map).position < -0.1


@pytest.mark.parametrize("spoil", ["position", "velocity", "acceleration", "jerk", "consistent", "ends_at_rest"])
def test_the_check_sees_what_is_not_kept(swung: retargeting.Trajectory, spoil: str) -> None:
    whole = retargeting.build_table(swung)
    assert checked(swung).passed
    row = np.arange(len(whole)) == len(whole) // 2
    changed = {
        "position": ("elbow", 9.0 * row),
        "velocity": ("pitch_velocity", 4.0 * row),
        "acceleration": ("yaw_acceleration", 30.0 * row),
        "jerk": ("flexion_acceleration", 9.0 * row),
        "consistent": ("roll", 1e-6 * row),
        "ends_at_rest": ("roll_velocity", np.full(len(whole), 1e-6)),
    }[spoil]
    name, more = changed
    limits = checked(swung, whole.with_columns((pl.col(name) + pl.Series(more)).alias(name)))
    assert not limits.passed
    value = getattr(limits, spoil)
    assert value is False or value < 0.0


def test_the_robot_follows_hand_turn_and_elbow(swung: retargeting.Trajectory) -> None:
    is_sound(swung)
    assert np.median(error(swung)) < 5e-3
    assert np.quantile(error(swung), 0.95) < 0.02
    summary = summarized(swung)
    assert summary["hand_error_deg"]["median"] < 3.0
    assert summary["swivel_error_deg"]["median"] < 15.0
    assert summary["inside_reach_share"] == 1.0


def test_it_begins_and_ends_at_rest_and_shows_the_recording_to_its_end(swung: retargeting.Trajectory) -> None:
    assert np.array_equal(swung.joint_position[0], swung.robot.rest)
    assert not swung.joint_velocity[0].any()
    assert np.abs(swung.joint_velocity[-1]).max() < 1e-12
    assert (np.diff(swung.recorded_time) >= -1e-12).all()
    assert swung.recorded_time[0] == swung.recorded_time[swung.approach_samples - 1] == 0.0
    assert swung.recorded_time[-1] == pytest.approx(7.99, abs=0.02)


@pytest.mark.parametrize("only", ["position", "orientation"])
def test_a_task_can_be_left_out(arm, only: str) -> None:
    other = {"position": "orientation", "orientation": "position"}[only]
    trajectory = retargeting.retarget(person(4.0), arm, params=replace(retargeting.ControllerParams(), **{other: 0.0}))
    is_sound(trajectory)
    target, begin = trajectory.targets[0], trajectory.approach_samples
    asked = Rotation.from_matrix(target.rotation[begin:])
    turn = (Rotation.from_matrix(trajectory.R_BH[0, begin:]).inv() * asked).magnitude()
    if only == "position":
        assert np.median(error(trajectory)) < 3e-3
    else:
        assert np.median(turn) < np.radians(2.0)
        assert np.median(error(trajectory)) > 0.02


@pytest.mark.peer
def test_the_programme_is_that_of_pink(arm) -> None:
    pink = pytest.importorskip("pink")
    import pinocchio as pin

    free = replace(arm, geometry=pin.GeometryModel(), arms=(replace(arm.arms[0], elbow=-1),))
    params = retargeting.ControllerParams(
        joint_velocity_change=0.0,
        singular_value_limit=0.0,
        curvature_damping=0.0,
        joint_velocity=0.0,
        posture=1e-3,
        task_gain=10.0,
        posture_gain=10.0,
        max_correction_deceleration=1e9,
    )
    stepper = control.QpController(free, CollisionModel(free), 0.01, params, limit_factor=1e6)
    state = control.JointState(arm.rest + 0.1, np.zeros(7), np.zeros(7))
    stepper.update_kinematics(state.position)
    hand, turn, _ = stepper.poses[0]
    goal = pin.SE3(turn @ pin.exp3(np.array([0.02, -0.01, 0.03])), hand + [0.01, -0.02, 0.015])
    aim = control.HandTarget(goal.translation, np.zeros(3), goal.rotation, np.zeros(3), np.zeros(3), 1.0)
    ours = 0.01 * stepper.step(state, (aim,)).acceleration  # the programme's velocity: half a step on, from rest
    configuration = pink.Configuration(arm.model, arm.model.createData(), arm.configuration(state.position))
    task = pink.tasks.FrameTask(arm.model.frames[arm.arms[0].hand].name, 1.0, float(np.sqrt(params.orientation)))
    task.set_target(goal)
    posture = pink.tasks.PostureTask(cost=float(np.sqrt(params.posture)))
    posture.set_target(arm.configuration(arm.rest))
    task.gain = posture.gain = params.task_gain * 0.01
    theirs = pink.solve_ik(configuration, [task, posture], 0.01, solver="daqp", limits=[], damping=0.0)
    # Pink's error is the logarithm in SE(3), ours that of place and turn apart: alike to the product of both.
    assert np.abs(ours).max() > 0.1
    assert np.abs(ours - theirs).max() < 0.03 * np.abs(ours).max()


def test_five_seconds_out_of_reach(arm, swung: retargeting.Trajectory) -> None:
    """The arm is stretched out 1.6 times its length, forward and up."""
    pose = person(11.0, swing=0.0)
    inside = (pose.time >= 3.0) & (pose.time < 8.0)
    hand = pose.points["right_palm"].copy()
    away = 1.6 * (UPPER + 0.27 + HAND) * np.array([0.8, -0.3, 0.2])
    hand[inside] = pose.points["right_shoulder"][inside] + away
    pose = replace(pose, points=pose.points | {"right_palm": hand})
    trajectory = retargeting.retarget(pose, arm, scale=swung.scale["right"])
    is_sound(trajectory)
    target = trajectory.targets[0]
    outside = np.linalg.norm(target.position - target.unclamped, axis=1) > 1e-3
    assert outside[trajectory.approach_samples :].mean() > 0.3
    why = summarized(trajectory)["error_attribution"]
    assert why["beyond the reach"] == pytest.approx(outside[trajectory.approach_samples :].mean(), abs=0.1)
    settled = (trajectory.recorded_time > 5.5) & (trajectory.recorded_time < 7.5)
    assert np.abs(trajectory.joint_velocity[settled]).max() < 0.02  # still at the reach: it does not shake
    assert np.abs(np.diff(trajectory.joint_acceleration[settled], axis=0)).max() < 0.05 * 12.0
    back = trajectory.recorded_time > 9.5
    assert np.linalg.norm(trajectory.hand["right"] - target.position, axis=1)[back].max() < 0.02


def test_a_jump_of_a_metre_is_no_jump_of_the_robot(arm) -> None:
    pose = person(8.0)
    points = dict(pose.points)
    for name in ("right_elbow", "right_wrist", "right_palm"):
        moved = points[name].copy()
        moved[400:] += [0.0, 0.0, 1.0]
        points[name] = moved
    trajectory = retargeting.retarget(replace(pose, points=points), arm)
    is_sound(trajectory)
    at = np.searchsorted(trajectory.recorded_time, 4.0)
    speed = np.linalg.norm(np.diff(trajectory.hand["right"], axis=0), axis=1) * 100.0
    assert speed[at - 100 : at + 100].max() < 3.0
    assert trajectory.targets[0].lost[trajectory.approach_samples :].any()


def test_uncertain_hands_weigh_less_and_slow_the_robot(arm) -> None:
    pose = person(4.0)
    std = np.where((pose.time > 1.5) & (pose.time < 2.5), 0.4, 0.04)
    unsure = replace(pose, point_cov={"right_palm": std[:, None, None] ** 2 * np.eye(3)})
    asked = retargeting.compute_arm_targets(unsure, arm)
    assert asked.hands[0].weight[200] < 0.2
    assert asked.hands[0].weight[20] > 0.95
    assert len(retargeting.retarget(unsure, arm).time) > 1.2 * len(retargeting.retarget(pose, arm).time)


def test_an_arm_that_is_never_known_is_refused(arm) -> None:
    pose = person(2.0)
    nowhere = {name: np.full_like(p, np.nan) for name, p in pose.points.items()}
    with pytest.raises(errors.WeposeError, match="right arm is not known anywhere"):
        retargeting.retarget(replace(pose, points=nowhere), arm)
    with pytest.raises(errors.WeposeError, match=r"arm's right arm follows right_upper_arm"):
        retargeting.retarget(person(2.0, side="left"), arm)


@pytest.mark.slow
def test_a_hand_that_goes_through_the_body_stops_before_it(arm) -> None:
    pose = person(6.0, flexion=80.0, swing=10.0)
    points = dict(pose.points)
    hand = points["right_palm"].copy()
    inside = np.array([0.0, 0.0, 0.20])
    blend = np.clip((pose.time - 2.0) / 1.5, 0.0, 1.0)[:, None]
    points["right_palm"] = hand + blend * (inside - hand)
    trajectory = retargeting.retarget(replace(pose, points=points), arm)
    is_sound(trajectory)
    assert error(trajectory)[-1] > 0.05  # it could not get there
    assert trajectory.report.near_contact.any()
    why = summarized(trajectory)["error_attribution"]
    assert why["self-collision"] > 0.2
    assert why["self-collision"] > 0.9 * sum(why.values())


def test_too_fast_is_slowed(tmp_path: Path) -> None:
    slow = retargeting.load_robot(str(write_arm(tmp_path, acceleration=2.0)))
    pose = person(4.0, swing=45.0)
    trajectory = retargeting.retarget(pose, slow)
    is_sound(trajectory)
    assert trajectory.time[-1] - trajectory.time[trajectory.approach_samples] > 1.3 * 4.0
    assert trajectory.slowest is not None
    assert trajectory.slowest["joint"] in JOINTS
