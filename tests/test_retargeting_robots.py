"""Retargeting on robots of example-robot-data, where they are installed, with the real recording where it is there."""

from dataclasses import replace

import numpy as np
import pytest
from arms import FORE, HAND, UPPER, is_sound, person
from scipy.spatial.transform import Rotation

from wepose_pin import retargeting
from wepose_pin.body.kinematics import Pose
from wepose_pin.body.urdf import find_example_data

pytest.importorskip("daqp")
pytestmark = [
    pytest.mark.robots,
    pytest.mark.skipif(find_example_data() is None, reason="example-robot-data is not installed"),
]


@pytest.mark.parametrize("name", retargeting.ROBOTS)
def test_every_robot_follows_and_keeps_its_limits(name: str) -> None:
    robot = retargeting.load_robot(name)
    right, left = person(4.0), person(4.0, side="left", swing=15.0)
    both = replace(right, quat_WL=right.quat_WL | left.quat_WL, points=right.points | left.points)
    trajectory = retargeting.retarget(both, robot)
    is_sound(trajectory)
    for arm, target in zip(robot.arms, trajectory.targets, strict=True):
        error = np.linalg.norm(trajectory.hand[arm.side] - target.position, axis=1)[trajectory.approach_samples :]
        assert np.median(error) < 0.02, arm.side


def violent(hz: float, swing: float, across: float, bend: float, phase: float, seconds: float = 6.0) -> Pose:
    """Both arms swung across the body at 1 to 2.5 Hz, as far apart in time as `phase` [rad]; angles in deg."""
    time = np.arange(0.0, seconds, 0.01)
    more, points = np.clip(0.5 * time - 0.5, 0.0, 1.0), {}
    quat = {"torso": np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))}

    def about(axis: int, angle_deg: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(np.radians(angle_deg)[:, None] * np.eye(3)[axis])

    for side, out in (("right", -1.0), ("left", 1.0)):
        at = 2.0 * np.pi * hz * time + phase * (side == "left")
        inward = -out * more * across * np.sin(at)
        upper = about(2, inward) * about(1, -30.0 - more * swing * np.cos(at - np.pi * hz * time))
        upper = upper * about(0, np.full(len(time), 15.0 * out))
        fore = upper * about(2, 0.5 * inward) * about(1, -40.0 - more * bend * (1.0 + np.sin(at + 1.0)))
        places = [np.tile([0.0, out * 0.19, 0.45], (len(time), 1))]
        for turn, length in ((upper, UPPER), (fore, FORE), (fore, HAND)):
            places.append(places[-1] + turn.apply([0.0, 0.0, -length]))
        quat |= {f"{side}_upper_arm": upper.as_quat(), f"{side}_forearm": fore.as_quat()}
        points |= {f"{side}_{n}": p for n, p in zip(("shoulder", "elbow", "wrist", "palm"), places, strict=True)}
    return Pose(time, quat, points)


@pytest.mark.parametrize(
    "motion",
    [(2.0, 40.0, 60.0, 45.0, 0.0), (2.0, 30.0, 70.0, 45.0, 2.0), (1.5, 60.0, 80.0, 50.0, 0.7)],
    ids=["together", "apart", "wide"],
)
def test_violent_arms_do_not_touch(motion: tuple[float, ...]) -> None:
    """Hands that meet, the body, and links of one arm that touch only where its joints end."""
    is_sound(retargeting.retarget(violent(*motion), retargeting.load_robot(retargeting.find_map("talos"))))
