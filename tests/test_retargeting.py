"""Retargeting on an arm of our own: limits, collisions, targets out of reach, jumps, losses, other forms of robots."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import trimesh
from arms import HAND, JOINTS, UPPER, person, write_arm
from scipy.spatial.transform import Rotation

from wepose_pin.commands import main
from wepose_pin.errors import BadData, BadModel, BadOption, MissingFile, NoSolution
from wepose_pin.kinematics import Pose
from wepose_pin.retargeting import (
    LimitCheck,
    LimitMargins,
    Trajectory,
    build_table,
    check_limits,
    compute_arm_targets,
    find_map,
    find_self_collisions,
    load_robot,
    retarget,
    summarize,
    write_trajectory,
)
from wepose_pin.retargeting.checks import AT_REST, SelfCollisions
from wepose_pin.retargeting.collision import CollisionModel
from wepose_pin.retargeting.controller import ControllerParams, HandTarget, JointState, QpController
from wepose_pin.retargeting.error_attribution import MissedTarget, assess_reachability, attribute_errors
from wepose_pin.retargeting.limits import compute_acceleration_bounds, reduce_acceleration_limits
from wepose_pin.retargeting.maps import KEYS, read_map
from wepose_pin.writers.export import export
from wepose_pin.writers.joint_motion import compute_link_poses_W, read_joint_motion

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory):
    return load_robot(find_map(str(write_arm(tmp_path_factory.mktemp("arm")))))


@pytest.fixture(scope="module")
def swung(arm) -> Trajectory:
    return retarget(person(), arm)


def checked(trajectory: Trajectory, changed: pl.DataFrame | None = None) -> LimitCheck:
    return check_limits(build_table(trajectory) if changed is None else changed, trajectory.robot.map)


def is_sound(trajectory: Trajectory) -> None:
    """Limits against the URDF and the map, and no contact; none of it by the solver's code."""
    robot = trajectory.robot
    limits = checked(trajectory)
    assert limits.passed, limits
    assert find_self_collisions(robot, trajectory.time, trajectory.joint_position).samples == 0
    assert np.isfinite(trajectory.joint_position).all()


def error(trajectory: Trajectory, side: str = "right") -> np.ndarray:
    target = trajectory.targets[[arm.side for arm in trajectory.robot.arms].index(side)]
    return np.linalg.norm(trajectory.hand[side] - target.position, axis=1)[trajectory.approach_samples :]


# Limits ------------------------------------------------------------------------------------------------------------


def ridden(share, dt: float, seconds: float, n: int = 60):
    """Joints that take `share` of what the bounds leave at each step; where they were, between the samples too."""
    rng = np.random.default_rng(3)
    lower, upper = -rng.uniform(0.05, 2.0, n), rng.uniform(0.05, 2.0, n)  # at most 14 s from end to end
    v_max, a_max = rng.uniform(0.3, 4.0, n), rng.uniform(0.5, 30.0, n)
    j_max = a_max * rng.choice([10.0, 20.0, 50.0, 500.0], n)
    a_max = reduce_acceleration_limits(a_max, v_max, j_max, upper - lower, dt)
    u, v, a, low, high = np.zeros(n), np.zeros(n), np.zeros(n), np.empty(n), np.empty(n)
    t = np.linspace(0.0, dt, 11)[:, None, None]
    times = np.arange(round(seconds / dt)) * dt
    for block in np.array_split(times, len(times) // 500 + 1):  # checked together, which is faster
        steps = np.empty((len(block), 5, n))
        for row, now in zip(steps, block, strict=True):
            compute_acceleration_bounds(u, v, a, lower, upper, v_max, a_max, j_max, dt, low, high)
            after = low + share(now, rng, n) * (high - low)
            jerk = (after - a) / dt
            row[:] = u, v, a, jerk, high - low
            u, v, a = u + dt * (v + dt * (a / 2.0 + dt * jerk / 6.0)), v + dt * (a + 0.5 * dt * jerk), after
        us, vs, accelerations, jerks, room = steps.swapaxes(0, 1)
        places = us + t * (vs + t * (accelerations / 2.0 + t * jerks / 6.0))
        speeds = vs + t * (accelerations + 0.5 * t * jerks)
        ends = accelerations + dt * jerks
        assert (room >= 0.0).all()
        assert (np.abs(jerks) <= j_max * (1.0 + 1e-9)).all()
        assert (np.abs(ends) <= a_max + 1e-9).all()
        assert (np.abs(speeds) <= v_max + 1e-8).all()
        assert (places >= lower - 1e-8).all()
        assert (places <= upper + 1e-8).all()
        yield from zip(upper - places.max(axis=0), speeds[-1], ends, strict=True)


@pytest.mark.parametrize("dt", [pytest.param(0.002, marks=pytest.mark.slow), 0.01, 0.05])
def test_whoever_goes_as_fast_as_the_bounds_allow_still_keeps_every_limit(dt: float) -> None:
    def mood(time: float, rng: np.random.Generator, n: int) -> np.ndarray:
        return (np.zeros(n), np.ones(n), rng.uniform(0.0, 1.0, n), rng.integers(0, 2, n))[int(time // 15.0) % 4]

    nearest = np.min([room for room, _, _ in ridden(mood, dt, 60.0)], axis=0)
    assert (nearest < 1e-3).all()  # and the bounds do not hold it off the limit


@pytest.mark.parametrize("dt", [pytest.param(0.002, marks=pytest.mark.slow), 0.01, 0.05])
def test_a_joint_that_is_pushed_against_its_limit_lies_still_there(dt: float) -> None:
    """Braking at full strength up to the limit would bounce off it: a brake cannot be let go at once."""
    end = list(ridden(lambda _time, _rng, n: np.ones(n), dt, 25.0))[-round(1.0 / dt) :]
    assert max(np.abs(v).max() for _, v, _ in end) < 1e-4
    assert max(np.abs(a).max() for _, _, a in end) < 1e-3


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("elbow.limit", "joint 'elbow' has no position limits"),
        ("elbow.velocity", "joint 'elbow' has no velocity limit"),
        ("pitch.acceleration", "limits.acceleration: joint 'pitch' has none"),
    ],
)
def test_a_robot_without_limits_is_refused_with_the_joint_named(tmp_path: Path, key: str, text: str) -> None:
    with pytest.raises(BadModel, match=text):
        load_robot(find_map(str(write_arm(tmp_path, without=key))))


STATED = {
    "format": "1",
    "urdf": '"arm.urdf"',
    "srdf": '"arm.srdf"',
    "description": '"a test"',
    "base": '"base"',
    "up": '"+z"',
    "forward": '"+x"',
    "table": "-2.0",
    "rest.JOINT": "-1.2",
    "limits.source": '"nobody"',
    "limits.acceleration": "12.0",
    "limits.jerk": "600.0",
    "limits.velocity": "2.0",
    "limits.position.JOINT": "[-2.0, -0.1]",
    "collision.LINK.xyz": "[0.0, 0.0, -0.2]",
    "collision.LINK.rpy": "[0.0, 0.5, 0.0]",
    "arms.SIDE.joints": json.dumps(JOINTS),
    "arms.SIDE.shoulder.link": '"upper_arm"',
    "arms.SIDE.shoulder.offset": "[0.0, 0.0, 0.0]",
    "arms.SIDE.elbow.link": '"forearm"',
    "arms.SIDE.elbow.offset": "[0.0, 0.0, 0.0]",
    "arms.SIDE.hand.link": '"hand"',
    "arms.SIDE.hand.offset": "[0.0, 0.0, -0.1]",
    "arms.SIDE.hand.fingers": '"-z"',
    "arms.SIDE.hand.thumb": '"+x"',
    "arms.SIDE.reach": "0.6",
}  # a map with every key


@pytest.mark.parametrize("without", ["nothing", *STATED])
def test_a_map_needs_the_keys_that_its_table_calls_required(tmp_path: Path, without: str) -> None:
    urdf = write_arm(tmp_path)
    (tmp_path / "arm.srdf").write_text("<robot name='arm'/>")
    left_out = "arms.SIDE.elbow" if without == "arms.SIDE.elbow.link" else without  # an elbow has a link
    lines = [f"{key} = {value}" for key, value in STATED.items() if not key.startswith(left_out)]
    text = "\n".join(lines).replace("SIDE", "right").replace("JOINT", "elbow").replace("LINK", "forearm")
    urdf.with_suffix(".toml").write_text(text)
    if without != "nothing" and not KEYS[without].default:
        with pytest.raises(BadModel):
            load_robot(read_map(tmp_path / "arm.toml"))
        return
    robot = load_robot(read_map(tmp_path / "arm.toml"))
    shape = next(shape for shape in robot.geometry.geometryObjects if shape.name == "forearm_0")
    stated = {key: not key.startswith(left_out) for key in STATED}
    assert shape.placement.translation[2] == (-0.2 if stated["collision.LINK.xyz"] else 0.0)
    assert shape.placement.rotation[0, 0] == pytest.approx(np.cos(0.5 if stated["collision.LINK.rpy"] else 0.0))


def test_the_page_and_the_loader_have_the_same_keys_of_a_map() -> None:
    page = (Path(__file__).parents[1] / "docs" / "robot-maps.md").read_text(encoding="utf-8")
    rows = [
        f"| `{name}` | {key.unit} | {key.default or '**required**'} | {key.meaning} |" for name, key in KEYS.items()
    ]
    assert "\n".join(["| key | unit or type | without it | what |", "|---|---|---|---|", *rows, ""]) in page
    assert set(STATED) == set(KEYS)


def test_a_motion_leaves_the_margins_that_are_asked_for(arm, swung: Trajectory, tmp_path: Path) -> None:
    """Of limits in the map before the URDF's, which here differ by far."""
    held = checked(swung)
    assert held.position > 0.05 - 1e-9
    assert min(held.velocity, held.acceleration, held.jerk) > 0.1 - 1e-9
    urdf = write_arm(tmp_path)
    stated = "[limits.position]\nelbow = [-1.5, -0.7]\n[limits.velocity]\nelbow = 0.8\n[arms.right]"
    said = urdf.with_suffix(".toml").read_text().replace("[arms.right]", stated)
    urdf.with_suffix(".toml").write_text(said)
    narrow = load_robot(find_map(str(urdf)), margins=LimitMargins(0.5, 0.1))
    trajectory = retarget(person(3.0), narrow)
    is_sound(trajectory)
    elbow = JOINTS.index("elbow")
    assert trajectory.joint_position[:, elbow].min() >= -1.4 - 1e-8  # the bounds are searched to 1e-9
    assert trajectory.joint_position[:, elbow].max() <= -0.8 + 1e-8
    assert np.abs(trajectory.run.joint_velocity[:, elbow]).max() <= 0.4 + 1e-8
    assert np.abs(trajectory.run.joint_acceleration).max() <= 6.0 + 1e-8
    table = build_table(swung)
    assert check_limits(table, arm.map).passed
    assert check_limits(table, narrow.map).position < -0.1


@pytest.mark.parametrize("spoil", ["position", "velocity", "acceleration", "jerk", "consistent", "ends_at_rest"])
def test_the_check_sees_what_is_not_kept(swung: Trajectory, spoil: str) -> None:
    whole = build_table(swung)
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


# Following ---------------------------------------------------------------------------------------------------------


def test_the_robot_follows_hand_turn_and_elbow(swung: Trajectory) -> None:
    is_sound(swung)
    assert np.median(error(swung)) < 5e-3
    assert np.quantile(error(swung), 0.95) < 0.02
    summary = summarize(swung, checked(swung), find_self_collisions(
        swung.robot, swung.time, swung.joint_position))["arms"]["right"]  # fmt: skip
    assert summary["hand_error_deg"]["median"] < 3.0
    assert summary["swivel_error_deg"]["median"] < 15.0
    assert summary["inside_reach_share"] == 1.0


def test_what_can_be_reached_is_reached(swung: Trajectory) -> None:
    frames, reached = assess_reachability(swung)
    assert len(frames) == len(reached) == 40
    assert reached.max() < 5e-3
    assert sum(attribute_errors(swung, 0).values()) == pytest.approx(np.mean(error(swung) > 0.02), abs=1e-3)


def test_it_begins_and_ends_at_rest_and_shows_the_recording_to_its_end(swung: Trajectory) -> None:
    assert np.array_equal(swung.joint_position[0], swung.robot.rest)
    assert not swung.run.joint_velocity[0].any()
    assert np.abs(swung.run.joint_velocity[-1]).max() < 1e-12
    assert (np.diff(swung.recorded_time) >= -1e-12).all()
    assert swung.recorded_time[0] == swung.recorded_time[swung.approach_samples - 1] == 0.0
    assert swung.recorded_time[-1] == pytest.approx(7.99, abs=0.02)


def test_a_small_person_and_a_tall_one_move_the_robot_alike(arm) -> None:
    small, tall = (retarget(person(4.0, size=size), arm) for size in (0.8, 1.2))
    assert small.arm_targets.scale["right"] == pytest.approx(1.5 * tall.arm_targets.scale["right"])
    n = min(len(small.time), len(tall.time))
    assert np.abs(small.joint_position[:n] - tall.joint_position[:n]).max() < 1e-6


def test_a_link_may_have_the_name_of_its_fixed_joint(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    plain = retarget(person(2.0), str(urdf))
    text = urdf.read_text(encoding="utf-8").replace('joint name="stand"', 'joint name="base"')
    urdf.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(retarget(person(2.0), str(urdf)).joint_position, plain.joint_position)


@pytest.mark.slow
def test_turned_bases_move_alike(arm, tmp_path: Path) -> None:
    straight = retarget(person(4.0), arm)
    turned = load_robot(find_map(str(write_arm(tmp_path, turned=(0.5 * np.pi, 0.2, -1.1)))))
    trajectory = retarget(person(4.0), turned)
    assert np.abs(trajectory.joint_position - straight.joint_position).max() < 1e-6
    # Said of the root's axes in place of the base's: y of the root is where z of the base points to −z, z up is +y.
    (tmp_path / "root").mkdir()
    by_root = load_robot(find_map(str(write_arm(tmp_path / "root", turned=(0.5 * np.pi, 0.0, 0.0), base="", up="-y"))))
    assert np.abs(retarget(person(4.0), by_root).joint_position - straight.joint_position).max() < 1e-6


@pytest.mark.slow
def test_a_joint_without_end_and_one_that_copies_another(tmp_path: Path) -> None:
    (tmp_path / "c").mkdir()
    endless = load_robot(find_map(str(write_arm(tmp_path / "c", continuous="roll"))))
    assert endless.model.nq == endless.model.nv + 1
    trajectory = retarget(person(4.0), endless)
    is_sound(trajectory)
    assert np.median(error(trajectory)) < 5e-3
    copied = load_robot(find_map(str(write_arm(tmp_path, mimic=True))))
    assert copied.names == JOINTS
    assert copied.model.nv == len(JOINTS) + 1
    trajectory = retarget(person(4.0), copied)
    is_sound(trajectory)
    assert np.median(error(trajectory)) < 5e-3
    q = copied.configuration(trajectory.joint_position[-1])
    joint = copied.model.names.tolist().index("elbow") - 1
    assert q[joint] == q[joint + 1] == trajectory.joint_position[-1][JOINTS.index("elbow")]


@pytest.mark.parametrize("only", ["position", "orientation"])
def test_a_task_can_be_left_out(arm, only: str) -> None:
    other = {"position": "orientation", "orientation": "position"}[only]
    trajectory = retarget(person(4.0), arm, params=replace(ControllerParams(), **{other: 0.0}))
    is_sound(trajectory)
    target, begin = trajectory.targets[0], trajectory.approach_samples
    asked = Rotation.from_matrix(target.rotation[begin:])
    turn = (Rotation.from_matrix(trajectory.run.rotation[0, begin:]).inv() * asked).magnitude()
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
    params = ControllerParams(
        joint_velocity_change=0.0,
        singular_value_limit=0.0,
        curvature_damping=0.0,
        joint_velocity=0.0,
        posture=1e-3,
        task_gain=10.0,
        posture_gain=10.0,
        max_correction_deceleration=1e9,
    )
    stepper = QpController(free, CollisionModel(free), 0.01, params, limit_factor=1e6)
    state = JointState(arm.rest + 0.1, np.zeros(7), np.zeros(7))
    stepper.update_kinematics(state.position)
    hand, turn, _ = stepper.get_arm_pose(0)
    goal = pin.SE3(turn @ pin.exp3(np.array([0.02, -0.01, 0.03])), hand + [0.01, -0.02, 0.015])
    aim = HandTarget(goal.translation, np.zeros(3), goal.rotation, np.zeros(3), np.zeros(3), 1.0)
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


# What goes wrong ---------------------------------------------------------------------------------------------------


def far_away(pose: Pose, span: tuple[float, float], by: float) -> Pose:
    """The arm stretched out `by` times its length, forward and up, over a span."""
    inside = (pose.time >= span[0]) & (pose.time < span[1])
    points = dict(pose.points)
    hand = points["right_palm"].copy()
    hand[inside] = points["right_shoulder"][inside] + by * (UPPER + 0.27 + HAND) * np.array([0.8, -0.3, 0.2])
    return replace(pose, points=points | {"right_palm": hand})


def test_five_seconds_out_of_reach(arm, swung: Trajectory) -> None:
    pose = far_away(person(11.0, swing=0.0), (3.0, 8.0), 1.6)
    trajectory = retarget(pose, arm, scale=swung.arm_targets.scale["right"])
    is_sound(trajectory)
    target = trajectory.targets[0]
    outside = np.linalg.norm(target.position - target.unclamped, axis=1) > 1e-3
    assert outside[trajectory.approach_samples :].mean() > 0.3
    why = attribute_errors(trajectory, 0)
    assert why["beyond the reach"] == pytest.approx(outside[trajectory.approach_samples :].mean(), abs=0.1)
    settled = (trajectory.recorded_time > 5.5) & (trajectory.recorded_time < 7.5)
    assert np.abs(trajectory.run.joint_velocity[settled]).max() < 0.02  # still at the reach: it does not shake
    assert np.abs(np.diff(trajectory.run.joint_acceleration[settled], axis=0)).max() < 0.05 * 12.0
    back = trajectory.recorded_time > 9.5
    assert np.linalg.norm(trajectory.hand["right"] - target.position, axis=1)[back].max() < 0.02


def test_no_jerk_where_a_moving_target_passes_the_reach(arm, swung: Trajectory) -> None:
    inside = retarget(person(6.0, flexion=20.0, swing=15.0), arm, scale=0.9 * swung.arm_targets.scale["right"])
    across = retarget(person(6.0, flexion=20.0, swing=15.0), arm, scale=1.12 * swung.arm_targets.scale["right"])
    drawn = np.linalg.norm(across.targets[0].position - across.targets[0].unclamped, axis=1) > 1e-3
    assert drawn[across.approach_samples :].mean() > 0.1
    is_sound(across)
    jerk = [
        np.abs(np.diff(trajectory.run.joint_acceleration[trajectory.approach_samples :], axis=0)).max() * 100.0
        for trajectory in (inside, across)
    ]
    assert jerk[1] < 3.0 * max(jerk[0], 100.0)


def test_a_jump_of_a_metre_is_no_jump_of_the_robot(arm) -> None:
    pose = person(8.0)
    points = dict(pose.points)
    for name in ("right_elbow", "right_wrist", "right_palm"):
        moved = points[name].copy()
        moved[400:] += [0.0, 0.0, 1.0]
        points[name] = moved
    trajectory = retarget(replace(pose, points=points), arm)
    is_sound(trajectory)
    at = np.searchsorted(trajectory.recorded_time, 4.0)
    speed = np.linalg.norm(np.diff(trajectory.hand["right"], axis=0), axis=1) * 100.0
    assert speed[at - 100 : at + 100].max() < 3.0
    assert trajectory.targets[0].lost[trajectory.approach_samples :].any()


@pytest.mark.slow
def test_nan_and_lost_samples_slow_the_robot(arm, swung: Trajectory) -> None:
    pose = person(8.0)
    points = {name: p.copy() for name, p in pose.points.items()}
    for name in ("right_elbow", "right_wrist", "right_palm"):
        points[name][300:420] = np.nan
    nan = retarget(replace(pose, points=points), arm)
    lost = np.zeros(len(pose.time), dtype=bool)
    lost[300:420] = True
    gone = retarget(replace(pose, gap={"right_forearm": lost}), arm)
    for trajectory in (nan, gone):
        is_sound(trajectory)
        during = ((trajectory.recorded_time > 3.1) & (trajectory.recorded_time < 4.1)).sum()
        usual = ((swung.recorded_time > 3.1) & (swung.recorded_time < 4.1)).sum()
        assert during > 2 * usual
        assert np.quantile(error(trajectory), 0.95) < 0.03
    assert attribute_errors(gone, 0)["not measured"] == pytest.approx(
        np.mean((error(gone) > 0.02) & gone.targets[0].lost[gone.approach_samples :]), abs=1e-3
    )
    assert summarize(gone, checked(gone), find_self_collisions(arm, gone.time, gone.joint_position))[
        "arms"]["right"]["lost_share"] > 0.1  # fmt: skip


def test_uncertain_hands_weigh_less_and_slow_the_robot(arm) -> None:
    pose = person(4.0)
    std = np.where((pose.time > 1.5) & (pose.time < 2.5), 0.4, 0.04)
    unsure = replace(pose, point_cov={"right_palm": std[:, None, None] ** 2 * np.eye(3)})
    asked = compute_arm_targets(unsure, arm)
    assert asked.hands[0].weight[200] < 0.2
    assert asked.hands[0].weight[20] > 0.95
    assert len(retarget(unsure, arm).time) > 1.2 * len(retarget(pose, arm).time)


def test_an_arm_that_is_never_known_is_refused(arm) -> None:
    pose = person(2.0)
    nowhere = {name: np.full_like(p, np.nan) for name, p in pose.points.items()}
    with pytest.raises(BadData, match="right arm is not known anywhere"):
        retarget(replace(pose, points=nowhere), arm)
    with pytest.raises(BadData, match=r"right arm is not in the pose: right_upper_arm"):
        retarget(person(2.0, side="left"), arm)


@pytest.mark.slow
def test_a_hand_that_goes_through_the_body_stops_before_it(arm) -> None:
    pose = person(6.0, flexion=80.0, swing=10.0)
    points = dict(pose.points)
    hand = points["right_palm"].copy()
    inside = np.array([0.0, 0.0, 0.20])
    blend = np.clip((pose.time - 2.0) / 1.5, 0.0, 1.0)[:, None]
    points["right_palm"] = hand + blend * (inside - hand)
    trajectory = retarget(replace(pose, points=points), arm)
    is_sound(trajectory)
    assert error(trajectory)[-1] > 0.05  # it could not get there
    assert trajectory.counts.near_clearance > 0
    why = attribute_errors(trajectory, 0)
    assert why["self-collision"] > 0.2
    assert why["self-collision"] > 0.9 * sum(why.values())
    _, reached = assess_reachability(trajectory)
    assert reached[-1, 0] == pytest.approx(error(trajectory)[-1], abs=0.02)  # nor could it with all the time there is


def test_too_fast_is_slowed_or_refused(tmp_path: Path) -> None:
    slow = load_robot(find_map(str(write_arm(tmp_path, acceleration=2.0))))
    pose = person(4.0, swing=45.0)
    trajectory = retarget(pose, slow)
    is_sound(trajectory)
    assert trajectory.time[-1] - trajectory.time[trajectory.approach_samples] > 1.3 * 4.0
    assert trajectory.limiting_joint is not None
    assert trajectory.limiting_joint.joint in JOINTS
    with pytest.raises(NoSolution, match=r"too fast at \d.*s of the recording: \w+ would need"):
        retarget(pose, slow, strict=True)


# Maps --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("format = 1", "format = 2", "format = 2; this version reads format = 1"),
        ('up = "+z"', 'up = "z"', r"arm.toml: up = 'z' is not known; .*there is: \+x, -x"),
        ('up = "+z"', 'up = "+x"', r"arm.toml: up, forward: \+x and \+x lie on one line"),
        (
            'link = "forearm"',
            'link = "foream"',
            "arms.right.elbow: no link 'foream' in arm.urdf; did you mean 'forearm'",
        ),
        ('"yaw"]', '"jaw"]', "arms.right.joints: no joint 'jaw' that moves in arm.urdf; did you mean 'yaw'"),
        ("[arms.right]", "[arms.middle]", "arms.middle is not a side"),
        ("shoulder =", "schoulder =", "arms.right.schoulder is not a known key; did you mean 'shoulder'"),
        ("elbow = -1.2", "elbow = 1.2", "rest.elbow = 1.2 is outside its limits, -2.6 to -0.02"),
        ("elbow = -1.2", "elbo = -1.2", "rest.elbo: no joint that moves in arm.urdf; did you mean 'elbow'"),
        ("offset = [0.0, 0.0, -0.1]", "offset = [0.0, 0.0]", r"hand.offset = \[0.0, 0.0\]; three numbers in metres"),
        ("yaw = 12.0", "yaw = 12.0\n[limits.jerk]\nyaw = -5.0", "limits.jerk: joint 'yaw' is -5"),
        (
            "[limits.acceleration]",
            "[limits]\njerk = 'high'\n[limits.acceleration]",
            "limits.jerk = 'high'; a number for",
        ),
        ("[rest]", "[limits.velocity]\njaw = 1.0\n[rest]", "limits.velocity.jaw: no joint that moves in arm.urdf"),
        (
            "[rest]",
            "[limits.position]\nyaw = [1.0, -1.0]\n[rest]",
            r"limits.position.yaw = \[1.0, -1.0\]; \[lower, upper\]",
        ),
        ("yaw = 12.0", "yaw = -1.0", "limits.acceleration: joint 'yaw' is -1; no URDF holds it"),
        ("[rest]", "[rest", "not valid TOML"),
    ],
)
def test_a_map_that_is_wrong_says_where(tmp_path: Path, old: str, new: str, text: str) -> None:
    urdf = write_arm(tmp_path)
    said = urdf.with_suffix(".toml").read_text()
    assert old in said
    urdf.with_suffix(".toml").write_text(said.replace(old, new, 1))
    with pytest.raises(BadModel, match=text):
        load_robot(find_map(str(urdf)))


def test_a_joint_that_fingers_copy_is_no_joint_of_the_arm(tmp_path: Path) -> None:
    """A gripper of joints that rotate, one finger of which bears the hand."""
    urdf = write_arm(tmp_path)
    fingers = "".join(
        f'<link name="finger_{k}"/><joint name="knuckle_{k}" type="revolute"><parent link="hand"/>'
        f'<child link="finger_{k}"/><axis xyz="1 0 0"/><limit lower="0" upper="0.8" velocity="2" effort="1"/>'
        + ('<mimic joint="knuckle_1" multiplier="-1"/></joint>' if k == 2 else "</joint>")
        for k in (1, 2)
    )
    urdf.write_text(urdf.read_text().replace("</robot>", f"{fingers}</robot>"))
    said = urdf.with_suffix(".toml").read_text().replace('"yaw"]', '"yaw", "knuckle_1"]')
    said = said.replace("yaw = 12.0", "yaw = 12.0\nknuckle_1 = 1.0").replace('{ link = "hand"', '{ link = "finger_1"')
    urdf.with_suffix(".toml").write_text(said)
    with pytest.raises(BadModel, match="'knuckle_1' is no joint of the arm: it is copied by 'knuckle_2'"):
        load_robot(find_map(str(urdf)))


def with_gripper(urdf: Path, link: str) -> None:
    """Two fingers that slide, the first of them named as a joint of the arm, whose hand is `link`."""
    fingers = "".join(
        f'<link name="finger_{k}"/><joint name="finger_{k}_joint" type="prismatic"><parent link="hand"/>'
        f'<child link="finger_{k}"/><origin xyz="0 0 -0.1"/><axis xyz="1 0 0"/>'
        f'<limit lower="0" upper="0.04" velocity="0.2" effort="10"/></joint>'
        for k in (1, 2)
    )
    urdf.write_text(urdf.read_text().replace("</robot>", f"{fingers}</robot>"))
    said = urdf.with_suffix(".toml").read_text()
    said = said.replace('"yaw"]', '"yaw", "finger_1_joint"]').replace("yaw = 12.0", "yaw = 12.0\nfinger_1_joint = 1.0")
    urdf.with_suffix(".toml").write_text(said.replace('hand = { link = "hand"', f'hand = {{ link = "{link}"'))


@pytest.mark.parametrize("link", ["hand", "finger_1", "finger_2"])
def test_a_gripper_is_no_joint_of_the_arm(tmp_path: Path, link: str) -> None:
    urdf = write_arm(tmp_path)
    with_gripper(urdf, link)
    with pytest.raises(BadModel, match=r"arms.right.joints: 'finger_1_joint' is no joint of the arm"):
        load_robot(find_map(str(urdf)))


@pytest.mark.parametrize(("up", "forward"), [("-z", "+x"), ("+z", "-x"), ("+x", "+y")])
def test_a_rest_of_another_mount_is_refused(tmp_path: Path, up: str, forward: str) -> None:
    urdf = write_arm(tmp_path, up=up, forward=forward)
    with pytest.raises(BadModel, match=r"arm.toml: rest: the right hand is .* give a rest for this mount"):
        load_robot(find_map(str(urdf)))
    text = urdf.with_suffix(".toml").read_text()
    urdf.with_suffix(".toml").write_text(text.replace("[rest]\nelbow = -1.2", ""))
    load_robot(find_map(str(urdf)))


def test_of_an_arm_that_is_not_there_the_message_says_what_to_do(arm) -> None:
    pose = person(2.0)

    def without(*parts: str) -> Pose:
        quat = {name: quat for name, quat in pose.quat_WL.items() if name not in parts}
        return replace(pose, quat_WL=quat, points={n: p for n, p in pose.points.items() if "torso" not in parts})

    with pytest.raises(BadData, match="right_forearm is missing; an arm needs sensors on torso, upper arm and forearm"):
        retarget(without("right_forearm"), arm)
    with pytest.raises(BadData, match="torso, right_shoulder"):
        retarget(without("torso"), arm)
    with pytest.raises(BadData, match=r"right arm is not in the pose.*arm has no arm for the left one, which is there"):
        retarget(person(2.0, side="left"), arm)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    with pytest.raises(BadModel, match="--robot pandas: not known; did you mean 'panda'"):
        find_map("pandas")
    with pytest.raises(BadOption, match=r"--arm left: arm has no left arm; there is: right"):
        load_robot(find_map(str(urdf)), ("left",))
    text = urdf.with_suffix(".toml").read_text()
    urdf.with_suffix(".toml").write_text(f"{text}[collision.w1]\nxyz = [0.0, 0.0, 0.1]\n")
    with pytest.raises(BadModel, match=r"arm.toml: collision.w1: the link has 0 collision shapes in arm.urdf"):
        load_robot(find_map(str(urdf)))
    urdf.with_suffix(".toml").unlink()
    with pytest.raises(MissingFile, match=r"no arm.toml beside it; a map says which links"):
        find_map(str(urdf))


# Files and the command ---------------------------------------------------------------------------------------------


def test_the_files_say_the_same(swung: Trajectory, tmp_path: Path) -> None:
    write_trajectory(tmp_path, swung)
    whole = pl.read_parquet(tmp_path / "trajectory.parquet")
    assert whole.columns[:5] == ["time", "recorded_time", "flexion", "flexion_velocity", "flexion_acceleration"]
    text = pl.read_csv(tmp_path / "trajectory.csv")
    assert text.columns == whole.columns
    assert np.abs(text.to_numpy() - whole.to_numpy()).max() < 1e-8
    message = json.loads((tmp_path / "joint_trajectory.json").read_text())
    assert message["joint_names"] == list(JOINTS)
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert np.allclose(times, swung.time)
    assert np.allclose([p["positions"] for p in message["points"]], swung.joint_position, atol=1e-8)


def test_the_links_of_a_trajectory_are_where_the_controller_had_them(swung: Trajectory) -> None:
    """By the URDF alone, against Pinocchio's kinematics in the controller."""
    motion = swung.joint_motion()
    quat, p = compute_link_poses_W(motion)["hand"]
    hand = Rotation.from_quat(quat).apply([0.0, 0.0, -0.1]) + p
    expected = Rotation.from_quat(motion.quat_WB).apply(swung.hand["right"]) + motion.p_WB
    np.testing.assert_allclose(hand, expected, atol=1e-12)
    assert motion.begin == swung.approach_samples


def test_the_same_motion_at_another_rate(arm) -> None:
    trajectory = retarget(person(3.0), arm, rate_hz=250.0)
    is_sound(trajectory)
    assert trajectory.time[1] == pytest.approx(0.004)
    assert np.median(error(trajectory)) < 5e-3
    with pytest.raises(BadOption, match="--rate-hz 5: from 10 to 2000"):
        retarget(person(), arm, rate_hz=5.0)


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main(list(argv))
    text = capsys.readouterr()
    return int(stop.value.code or 0), text.out + text.err


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from wepose_pin import tracking
    from wepose_pin.simulation import simulate, simulate_person
    from wepose_pin.writers import write_result

    folder = tmp_path_factory.mktemp("result")
    made = simulate(simulate_person(2).lengths, seed=2)
    tracked = tracking.track(made.recording("made"))
    pose, keep = tracked.pose, slice(0, 600)
    short = replace(
        pose,
        time=pose.time[keep],
        quat_WL={name: quat[keep] for name, quat in pose.quat_WL.items()},
        points={name: p[keep] for name, p in pose.points.items()},
        segment_cov={name: cov[keep] for name, cov in pose.segment_cov.items()},
        point_cov={name: cov[keep] for name, cov in pose.point_cov.items()},
    )
    write_result(folder, replace(tracked, pose=short), tracking.summarize(tracked))
    return folder


def test_the_command(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_arm(tmp_path)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"))
    assert code == 0, text
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert made == {"trajectory.parquet", "trajectory.csv", "joint_trajectory.json", "robot.urdf", "summary.json",
                    "view.html", "report.html"}  # fmt: skip
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["recording"], summary["recorded_phases"].keys()) == ("made", set())
    motion = read_joint_motion(tmp_path / "out")
    assert (motion.name, motion.source, motion.joints) == ("arm", "made", JOINTS)
    assert motion.time[motion.begin] == pytest.approx(summary["approach_s"], abs=1e-6)
    assert export(tmp_path / "out", tmp_path / "data", "lerobot") == ("lerobot", [])
    frames = pl.read_parquet(tmp_path / "data" / "data" / "chunk-000" / "file-000.parquet")
    np.testing.assert_array_equal(frames["observation.state"].to_numpy(), motion.position.astype(np.float32))
    assert summary["within_limits"] is True
    assert summary["self_collisions"]["samples"] == 0
    assert "Limits kept" in text
    page = (tmp_path / "out" / "view.html").read_text()
    assert '"robot 0"' in page
    assert '"right_robot"' in page
    assert '"target right"' in page
    report = (tmp_path / "out" / "report.html").read_text()
    assert "cannot be made" not in report
    for joint in JOINTS:
        assert f"<td>{joint}</td>" in report
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"))
    assert (code, "--force replaces" in text) == (2, True)


def test_the_exit_code_says_that_no_robot_should_run_it(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the check of the written trajectory finds decides, not what the solver thinks of it."""
    urdf = write_arm(tmp_path)
    hit = SelfCollisions(3, "hand_0 and base_0 at 2.00 s", 10, {AT_REST: []})
    monkeypatch.setattr("wepose_pin.retargeting.find_self_collisions", lambda *_: hit)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"))
    assert code == 3
    assert "touch each other in 3 samples, first hand_0 and base_0 at 2.00 s" in " ".join(text.split())
    assert (tmp_path / "out" / "trajectory.parquet").is_file()


def test_a_hand_that_stays_off_a_target_within_reach_ends_in_exit_code_3(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    missed = [MissedTarget("right", 3.0, 5.5, 0.4)]
    monkeypatch.setattr("wepose_pin.retargeting.files.find_missed_targets", lambda _: missed)
    code, _ = run(capsys, "retarget", str(result), "--robot", str(write_arm(tmp_path)), "-o", str(tmp_path / "out"))
    assert code == 3
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [each["code"] for each in summary["diagnostics"] if each["severity"] == "error"] == [
        "reachable-target-missed"
    ]
    assert summary["missed_targets"] == [{"side": "right", "begin": 3.0, "end": 5.5, "error": 0.4}]


def test_a_robot_without_shapes_is_said_to_be_unchecked(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = write_arm(tmp_path)
    urdf.write_text(re.sub("<collision>.*?</collision>", "", urdf.read_text()))
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"), "--no-view")
    assert code == 0
    assert "No self-collision" not in text
    diagnostics = json.loads((tmp_path / "out" / "summary.json").read_text())["diagnostics"]
    assert "robot-self-collision-unchecked" in [each["code"] for each in diagnostics]


@pytest.mark.parametrize(
    ("robot", "more", "text"),
    [
        ("nobody", (), "--robot nobody: not known"),
        ("missing.urdf", (), "missing.urdf: no such file"),
        ("arm.urdf", ("--arm", "both"), "--arm left: arm has no left arm"),
        ("arm.urdf", ("--scale", "-1"), "--scale -1"),
        ("arm.urdf", ("--smoothing-hz", "-1"), "--smoothing-hz -1"),
        ("arm.urdf", ("--speed-scale", "1.2"), "--speed-scale 1.2: above 0, up to 1"),
        ("arm.urdf", ("--limit-margin", "1.5"), "--limit-margin 1.5: joint 'elbow' moves from -2.6 to -0.02 only"),
    ],
)
def test_wrong_usage_is_one_line_and_writes_nothing(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], robot: str, more: tuple[str, ...], text: str
) -> None:
    write_arm(tmp_path)
    where = str(tmp_path / robot) if "." in robot else robot
    code, said = run(capsys, "retarget", str(result), "--robot", where, "-o", str(tmp_path / "out"), *more)
    assert code == 2
    assert text in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_meshes_are_found_in_the_written_robot_and_a_missing_one_is_left_out_of_the_view(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    urdf = write_arm(tmp_path / "arm")
    trimesh.creation.box((0.1, 0.1, 0.2)).export(tmp_path / "arm" / "meshes" / "hand.stl")
    drawn, lost = (
        f'<visual><geometry><mesh filename="meshes/{name}.stl"/></geometry></visual></link>'
        for name in ("hand", "lost")
    )
    links = re.split("(?<=</link>)", urdf.read_text())
    links[-2] = links[-2].replace("</link>", drawn)
    links[1] = links[1].replace("</link>", lost)
    urdf.write_text("".join(links))
    out = tmp_path / "out"
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(out))
    assert code == 0, text
    assert (out / "view.html").is_file()
    codes = [each["code"] for each in json.loads((out / "summary.json").read_text())["diagnostics"]]
    assert "visual-mesh-missing" in codes
    export(out, tmp_path / "robot.urdf")
    for file in (out / "robot.urdf", tmp_path / "robot.urdf"):
        meshes = re.findall('filename="(.*?)"', file.read_text())
        assert sorted(meshes) == sorted([str(tmp_path / "arm" / "meshes" / "hand.stl"), "meshes/lost.stl"])
