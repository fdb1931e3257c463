"""Where a robot's root is in W: at its origin, on the floor, or beside the person."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from .collision import list_corners
from .robot import Robot

SIDE_DISTANCE = 1.35  # [m] of the robot to the left of the person
STANDING_HEIGHT = 0.75  # [m] of the shoulders above the lowest point, from which on the robot stands on the floor


def place_root(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """R_WB (3, 3) and p_WB (3,) [m] of the root in W: where a standing robot is on the floor, else at its origin."""
    R_WB, data, p_WB = robot.R_BT.T, robot.model.createData(), np.zeros(3)
    pin.forwardKinematics(robot.model, data, robot.configuration(robot.rest))
    lowest = [
        (R_WB @ data.oMi[shape.parentJoint].act(corner))[2]
        for shape in robot.geometry.geometryObjects
        for corner in list_corners(shape)
    ]
    if lowest and _find_shoulder(robot)[2] - min(lowest) > STANDING_HEIGHT:
        p_WB[2] = -min(lowest)
    return R_WB, p_WB


def _find_shoulder(robot: Robot) -> np.ndarray:
    """(3,) [m] the middle of the shoulders, from the root along the axes of W."""
    return np.asarray(robot.R_BT.T @ np.mean([arm.shoulder for arm in robot.arms], axis=0))


def place_beside_person(robot: Robot, shoulder_z: float, floor_z: float) -> tuple[np.ndarray, np.ndarray]:
    """R_WB (3, 3) and p_WB (3,) [m]: the root in W, beside the person and facing the same way."""
    (R_WB, (_, _, height)), shoulder = place_root(robot), _find_shoulder(robot)
    z = floor_z + height if height else shoulder_z - shoulder[2]
    return R_WB, np.array([-shoulder[0], SIDE_DISTANCE - shoulder[1], z])
