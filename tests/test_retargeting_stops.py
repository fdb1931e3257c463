"""The stop that each step of a robot leaves open: within limits, clear of the robot itself, taken where no step is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from arms import person, write_arm
from test_live_robot import Session, keeps_its_limits, live_poses, stream_info

from wepose_pin.errors import BadModel
from wepose_pin.kinematics import Pose
from wepose_pin.retargeting import Robot, find_map, find_self_collisions, load_robot, retarget
from wepose_pin.retargeting.collision import NEAR, CollisionModel
from wepose_pin.retargeting.limits import compute_acceleration_bounds, reduce_acceleration_limits
from wepose_pin.retargeting.stopping import StopCheck, balance_braking, compute_stop

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(find_map(str(write_arm(tmp_path_factory.mktemp("arm")))))


@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_a_stop_keeps_the_limits_and_ends_at_rest(dt: float) -> None:
    """From states of joints that now rush to an end of what the bounds leave, now take any of it."""
    rng, n = np.random.default_rng(5), 40
    lower, upper = -rng.uniform(0.05, 1.5, n), rng.uniform(0.05, 1.5, n)
    v_max, a_max = rng.uniform(0.3, 4.0, n), rng.uniform(0.5, 30.0, n)
    j_max = a_max * rng.choice([10.0, 20.0, 50.0, 500.0], n)
    a_max = reduce_acceleration_limits(a_max, v_max, j_max, upper - lower, dt)
    limits = lower, upper, v_max, a_max, j_max
    u, v, a, low, high = np.zeros(n), np.zeros(n), np.zeros(n), np.empty(n), np.empty(n)
    share = np.ones(n)
    for k in range(round(6.0 / dt)):
        compute_acceleration_bounds(u, v, a, *limits, dt, low, high)
        if k % round(0.4 / dt) == 0:
            share = rng.choice([0.0, 1.0, rng.uniform()], n)
        after = low + share * (high - low)
        u, v, a = u + dt * (v + dt * (a / 3.0 + after / 6.0)), v + 0.5 * dt * (a + after), after
        if k % round(0.05 / dt):
            continue
        braking = rng.choice([a_max, balance_braking(v, a_max)])
        path, velocity, acceleration, travel = compute_stop(u, v, a, *limits, braking, dt)
        assert not velocity[-1].any()
        assert not acceleration[-1].any()
        assert (path >= lower - 1e-7).all()
        assert (path <= upper + 1e-7).all()
        assert (np.abs(velocity) <= v_max + 1e-7).all()
        assert (np.abs(acceleration) <= a_max + 1e-7).all()
        # The very last step, below 1e-9 rad/s, is a jump to rest.
        assert (np.abs(np.diff(np.vstack([a, acceleration]), axis=0)) <= dt * j_max + 1e-6).all()
        assert (np.abs(np.diff(np.vstack([u, path]), axis=0)) <= travel + 1e-12).all()
        assert len(path) * dt < 3.0


def test_the_way_to_rest_is_as_clear_as_a_dense_search_finds(arm: Robot) -> None:
    """Straight ways between random postures: one is refused where some sample of it is too near, and seldom else."""
    collision = CollisionModel(arm)
    check, every = StopCheck(arm, collision), np.arange(len(collision.pairs))
    rng, data = np.random.default_rng(1), arm.model.createData()
    share = np.linspace(0.0, 1.0, 41)[:, None]
    refused = 0
    for _ in range(60):
        begin = rng.uniform(*arm.bounds)
        path = begin + share * rng.normal(0.0, 1.0, len(begin))
        rooms = []
        for position in path:
            pin.forwardKinematics(arm.model, data, arm.configuration(position))
            rooms.append(collision.compute_distances(data, every))
        room = np.array(rooms) - collision.least_distance
        if room[0].min() < 0.0:
            continue
        travel = np.abs(np.diff(path, axis=0))
        clear = check.find_shortfall(np.minimum(rooms[0], NEAR), path[1:], travel) is None
        assert clear == (room.min() >= 0.0) or abs(room.min()) < 1e-3
        refused += not clear
        moved = np.abs(np.diff(np.array(rooms), axis=0))
        assert (moved <= travel @ collision.levers.T + 1e-6).all()
    assert 5 < refused < 50


def pushed(seconds: float, hz: float) -> Pose:
    """A hand that goes through the torso and out again, faster than any robot can follow."""
    pose = person(seconds, flexion=80.0, swing=10.0)
    into = 0.5 - 0.5 * np.cos(2.0 * np.pi * hz * np.maximum(pose.time - 3.0, 0.0))
    hand = pose.points["right_palm"]
    away = np.array([-0.1, 0.25, 0.15]) - hand
    return replace(pose, points=pose.points | {"right_palm": hand + into[:, None] * away})


@pytest.mark.parametrize("guarded", [True, False])
def test_live_a_robot_that_is_driven_into_itself_stops_short_of_it(arm: Robot, guarded: bool) -> None:
    """By the check of its stops alone: the constraints that keep shapes apart are taken away."""
    pose = pushed(7.0, 0.6)
    session = Session(arm, stream_info(pose))
    controller = session.stream._controller
    controller.guarded = guarded
    constrain = controller._constrain_distances
    controller._constrain_distances = lambda *near: (constrain(*near)[0], np.full(len(near[1].distance), -1e30))
    session.run(live_poses(pose))
    clock, u = (np.array([getattr(command, key) for command in session.commands]) for key in ("clock", "u"))
    keeps_its_limits(session.messages(), arm)
    contacts = find_self_collisions(arm, clock, u).samples
    if not guarded:
        assert contacts > 10
        return
    assert contacts == 0
    assert session.stream.stopping > 10
    collision, data = CollisionModel(arm), arm.model.createData()
    every = np.arange(len(collision.pairs))
    for position in u:
        pin.forwardKinematics(arm.model, data, arm.configuration(position))
        assert (collision.compute_distances(data, every) >= collision.least_distance - 1e-9).all()


def test_no_step_that_keeps_all_the_robot_stands_and_goes_on_when_there_is_one(
    arm: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solver that finds nothing for a second: the robot brakes within its limits, waits, and follows again."""
    pose = person(10.0)
    session = Session(arm, stream_info(pose))
    session.run(live_poses(pose)[:600])
    with monkeypatch.context() as nothing:
        nothing.setattr(session.stream._controller, "_solve_qp", lambda *_: None)
        session.run(live_poses(pose)[600:700])
    assert session.stream.stopping == 100
    assert not session.commands[-1].v.any()
    session.run(live_poses(pose)[700:])
    assert session.stream.stopping == 100
    assert np.abs(session.commands[-1].v).max() > 0.01
    keeps_its_limits(session.messages(), arm)


def test_nothing_of_a_robot_on_a_table_goes_below_it(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    said = urdf.with_suffix(".toml").read_text()
    urdf.with_suffix(".toml").write_text(said.replace('forward = "+x"', 'forward = "+x"\ntable = -0.6'))
    robot = load_robot(find_map(str(urdf)))
    with pytest.raises(BadModel, match="rest, table: forearm_0 is in the table in the rest posture"):
        load_robot(replace(robot.map, table=-0.4))
    pose = person(4.0, flexion=15.0)  # the hand hangs 0.6 m below the shoulder
    lowest = {}
    for name, own in (("table", robot), ("none", load_robot(replace(find_map(str(urdf)), table=None)))):
        trajectory = retarget(pose, own)
        base = own.full.frames[own.full.getFrameId("base")].placement
        height = [base.actInv(hand)[2] for hand in trajectory.hand["right"]]
        lowest[name] = min(height)
        assert find_self_collisions(own, trajectory.time, trajectory.joint_position).samples == 0
    assert lowest["none"] < -0.65
    assert lowest["table"] > -0.63  # its point is 0.03 m ahead of its shape
