"""Limits: bounds on the acceleration that never lead to a violation, the stop that each step of a robot leaves open."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import person, write_arm
from test_live_robot import Session, keeps_its_limits, live_poses

from wepose_pin import errors, retargeting
from wepose_pin.body.kinematics import Pose
from wepose_pin.retargeting import limits
from wepose_pin.retargeting.collision import CollisionModel

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> retargeting.Robot:
    return retargeting.load_robot(str(write_arm(tmp_path_factory.mktemp("arm"))))


def ridden(share, dt: float, seconds: float, n: int = 60):
    """Joints that take `share` of what the bounds leave at each step; where they were, between the samples too."""
    rng = np.random.default_rng(3)
    lower, upper = -rng.uniform(0.05, 2.0, n), rng.uniform(0.05, 2.0, n)  # at most 14 s from end to end
    v_max, a_max = rng.uniform(0.3, 4.0, n), rng.uniform(0.5, 30.0, n)
    j_max = a_max * rng.choice([10.0, 20.0, 50.0, 500.0], n)
    a_max = limits.reduce_acceleration_limits(a_max, v_max, j_max, upper - lower, dt)
    u, v, a, low, high = np.zeros(n), np.zeros(n), np.zeros(n), np.empty(n), np.empty(n)
    t = np.linspace(0.0, dt, 11)[:, None, None]
    times = np.arange(round(seconds / dt)) * dt
    for block in np.array_split(times, len(times) // 500 + 1):  # checked together, which is faster
        steps = np.empty((len(block), 5, n))
        for row, now in zip(steps, block, strict=True):
            limits.compute_acceleration_bounds(u, v, a, lower, upper, v_max, a_max, j_max, dt, low, high)
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


@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_a_stop_keeps_the_limits_and_ends_at_rest(dt: float) -> None:
    """From states of joints that now rush to an end of what the bounds leave, now take any of it."""
    rng, n = np.random.default_rng(5), 40
    lower, upper = -rng.uniform(0.05, 1.5, n), rng.uniform(0.05, 1.5, n)
    v_max, a_max = rng.uniform(0.3, 4.0, n), rng.uniform(0.5, 30.0, n)
    j_max = a_max * rng.choice([10.0, 20.0, 50.0, 500.0], n)
    a_max = limits.reduce_acceleration_limits(a_max, v_max, j_max, upper - lower, dt)
    ranges = lower, upper, v_max, a_max, j_max
    u, v, a, low, high = np.zeros(n), np.zeros(n), np.zeros(n), np.empty(n), np.empty(n)
    share = np.ones(n)
    for k in range(round(6.0 / dt)):
        limits.compute_acceleration_bounds(u, v, a, *ranges, dt, low, high)
        if k % round(0.4 / dt) == 0:
            share = rng.choice([0.0, 1.0, rng.uniform()], n)
        after = low + share * (high - low)
        u, v, a = u + dt * (v + dt * (a / 3.0 + after / 6.0)), v + 0.5 * dt * (a + after), after
        if k % round(0.05 / dt):
            continue
        states, travel = limits.compute_stop(u, v, a, *ranges, dt)
        path, velocity, acceleration = states.swapaxes(0, 1)
        assert not velocity[-1].any()
        assert not acceleration[-1].any()
        assert (path >= lower - 1e-7).all()
        assert (path <= upper + 1e-7).all()
        assert (np.abs(velocity) <= v_max + 1e-7).all()
        assert (np.abs(acceleration) <= a_max + 1e-7).all()
        # The very last step, below 1e-9 rad/s, is a jump to rest.
        assert (np.abs(np.diff(acceleration, axis=0)) <= dt * j_max + 1e-6).all()
        assert (np.abs(np.diff(path, axis=0)) <= travel[:-1] + 1e-12).all()
        assert len(path) * dt < 3.0


def pushed(seconds: float, hz: float) -> Pose:
    """A hand that goes through the torso and out again, faster than any robot can follow."""
    pose = person(seconds, flexion=80.0, swing=10.0)
    into = 0.5 - 0.5 * np.cos(2.0 * np.pi * hz * np.maximum(pose.time - 3.0, 0.0))
    hand = pose.points["right_palm"]
    away = np.array([-0.1, 0.25, 0.15]) - hand
    return replace(pose, points=pose.points | {"right_palm": hand + into[:, None] * away})


@pytest.mark.parametrize("guarded", [True, False])
def test_live_a_robot_that_is_driven_into_itself_stops_short_of_it(
    arm: retargeting.Robot, guarded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the check of its stops alone: the constraints that keep shapes apart are taken away."""
    pose = pushed(7.0, 0.6)
    session = Session(arm, pose)
    controller = session.stream._controller
    controller.guarded = guarded
    monkeypatch.setattr("wepose_pin.retargeting.controller.compute_separation_bounds", lambda _, d, *__: 0.0 * d - 1e30)
    session.run(live_poses(pose))
    clock, u = (np.array([getattr(command, key) for command in session.commands]) for key in ("clock", "u"))
    keeps_its_limits(session.messages(), arm)
    contacts = retargeting.find_self_collisions(arm, clock, u).samples
    if not guarded:
        assert contacts > 10
        return
    assert contacts == 0
    assert session.stream.stopping > 10
    collision = CollisionModel(arm)
    every = np.arange(len(collision.pairs))
    for position in u:
        assert (collision.compute_distances(position, every) >= collision.least_distance - 1e-9).all()


def test_nothing_of_a_robot_on_a_table_goes_below_it(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    said = urdf.with_suffix(".toml").read_text()
    urdf.with_suffix(".toml").write_text(said.replace('forward = "+x"', 'forward = "+x"\ntable = -0.6'))
    robot = retargeting.load_robot(str(urdf))
    with pytest.raises(errors.WeposeError, match="rest, table: forearm_0 is in the table in the rest posture"):
        retargeting.retarget(person(2.0), retargeting.load_robot(robot.map._replace(table=-0.4)))
    pose = person(4.0, flexion=15.0)  # the hand hangs 0.6 m below the shoulder
    lowest = {}
    for name, own in (
        ("table", robot),
        ("none", retargeting.load_robot(retargeting.find_map(str(urdf))._replace(table=None))),
    ):
        trajectory = retargeting.retarget(pose, own)
        base = own.full.frames[own.full.getFrameId("base")].placement
        height = [base.actInv(hand)[2] for hand in trajectory.hand["right"]]
        lowest[name] = min(height)
        assert retargeting.find_self_collisions(own, trajectory.time, trajectory.joint_position).samples == 0
    assert lowest["none"] < -0.65
    assert lowest["table"] > -0.63  # its point is 0.03 m ahead of its shape
