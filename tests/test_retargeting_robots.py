"""Retargeting on robots of example-robot-data, where they are installed, with the real recording where it is there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from arms import person

from wepose_pin.pose import Pose
from wepose_pin.retargeting import ROBOTS, Trajectory, find_map, kept, load, retarget, table
from wepose_pin.retargeting.maps import example_data

pytest.importorskip("daqp")
pytestmark = pytest.mark.skipif(example_data() is None, reason="example-robot-data is not installed")


def touches(trajectory: Trajectory) -> list[int]:
    """Samples in which shapes touch that do not at rest, by the robot's whole model and all its shapes.

    Only links further apart than neighbours count; what the solver leaves out otherwise is not known here.
    """
    robot = trajectory.robot
    shapes = pin.GeometryModel(robot.shapes)
    shapes.addAllCollisionPairs()
    if robot.map.srdf is not None:
        pin.removeCollisionPairs(robot.model, shapes, str(robot.map.srdf))
    data, geometry = robot.model.createData(), shapes.createData()
    pin.computeCollisions(robot.model, data, shapes, geometry, robot.q(robot.rest), False)
    for k in reversed(range(len(shapes.collisionPairs))):
        pair = shapes.collisionPairs[k]
        a, b = (shapes.geometryObjects[i].parentJoint for i in (pair.first, pair.second))
        neighbours = robot.model.parents[a] == b or robot.model.parents[b] == a
        if neighbours or geometry.collisionResults[k].isCollision():
            shapes.removeCollisionPair(pin.CollisionPair(pair.first, pair.second))
    geometry = shapes.createData()
    boxes = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, shapes, geometry)
    return [
        k
        for k in range(len(trajectory.u))
        if pin.computeCollisions(robot.model, data, boxes, robot.q(trajectory.u[k]), True)
    ]


def both_arms(seconds: float) -> Pose:
    right, left = person(seconds), person(seconds, side="left", swing=15.0)
    return replace(right, quat_WL=right.quat_WL | left.quat_WL, points=right.points | left.points)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_follows_and_keeps_its_limits(name: str) -> None:
    robot = load(find_map(name))
    found = retarget(both_arms(4.0), robot)
    held = kept(table(found), robot.map.urdf, robot.map.acceleration)
    assert held.all, held
    assert touches(found) == []
    for arm, target in zip(robot.arms, found.targets, strict=True):
        error = np.linalg.norm(found.hand[arm.side] - target.position, axis=1)[found.approach :]
        assert np.median(error) < 0.02, arm.side


@pytest.fixture(scope="session")
def tracked(data: Path) -> Pose:
    from wepose_pin.readers import load_session
    from wepose_pin.tracking import track

    return track(load_session(data / "upper_body" / "session.toml"))


@pytest.mark.parametrize("name", ["panda", "ur5", "baxter", "tiago_dual"])
def test_the_real_recording(tracked: Pose, name: str) -> None:
    """Ten seconds of work at a table, the most agile of the recording."""
    keep = (tracked.time > 60.0) & (tracked.time < 70.0)
    pose = Pose(
        tracked.time[keep],
        {segment: quat[keep] for segment, quat in tracked.quat_WL.items()},
        {point: p[keep] for point, p in tracked.points.items()},
        point_cov={point: cov[keep] for point, cov in tracked.point_cov.items()},
    )
    robot = load(find_map(name))
    found = retarget(pose, robot)
    held = kept(table(found), robot.map.urdf, robot.map.acceleration)
    assert held.all, held
    assert touches(found) == []
    assert np.isfinite(found.u).all()
