"""The reference of a live hand: it moves from the robot's hand to its target, and then with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from .controller import QpController
from .targets import WEIGHT_POOR, HandTarget

APPROACH_SPEED = 0.25  # [m/s] of a reference that has not reached its target yet
APPROACH_GROWTH = 0.1  # [m/s²] of that speed, so that it also reaches a target that moves
FREE_SPEED = 12.0  # [m/s] of a reference at a trusted target: only the robot's limits count
TURN_RATIO = 2.4  # [rad/m] of the reference's angular speed to its speed
CLOSING_GAIN = 5.0  # [1/s] at which the reference closes the distance to its target
REACHED_M, REACHED_RAD = 0.02, 0.1  # distance at which it has reached its target
SPEED_UP_S, SPEED_DOWN_S = 0.2, 0.1  # [s] time constants of the speed allowed


@dataclass
class HandReference:
    """Reference of one hand.

    Its acceleration is limited to what the joints can do: a robot that is asked for more shakes, and comes so near to
    itself that its limits leave no way out.
    """

    position: np.ndarray
    rotation: np.ndarray
    max_acceleration: float  # [m/s²]
    speed: float = APPROACH_SPEED  # [m/s] allowed now
    reached: bool = False
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    angular_velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def step(self, target: HandTarget, dt: float) -> HandTarget:
        """Target of the hand in this step, on the way to `target`."""
        away, turn = target.position - self.position, pin.log3(target.rotation @ self.rotation.T)
        self.reached = self.reached or (compute_norm(away) < REACHED_M and compute_norm(turn) < REACHED_RAD)
        if self.reached:
            trust = (target.weight - WEIGHT_POOR) / (1.0 - WEIGHT_POOR)
            target_speed = APPROACH_SPEED * (FREE_SPEED / APPROACH_SPEED) ** trust
            up, down = np.exp(dt / SPEED_UP_S), np.exp(-dt / SPEED_DOWN_S)
            self.speed = float(min(max(target_speed, down * self.speed), up * self.speed))
        else:
            self.speed += APPROACH_GROWTH * dt * float(target.weight)
        speed, limit = self.speed, self.max_acceleration
        self.velocity = _approach_velocity(self.velocity, target.velocity, away, speed, limit, dt)
        self.angular_velocity = _approach_velocity(
            self.angular_velocity, target.angular_velocity, turn, TURN_RATIO * speed, TURN_RATIO * limit, dt
        )
        position = self.position + 0.5 * dt * self.velocity
        rotation = pin.exp3(0.5 * dt * self.angular_velocity) @ self.rotation
        self.position = self.position + dt * self.velocity
        self.rotation = pin.exp3(dt * self.angular_velocity) @ self.rotation
        return HandTarget(position, self.velocity, rotation, self.angular_velocity, target.swivel, target.weight)


def start_references(controller: QpController, position: np.ndarray) -> list[HandReference]:
    """References at the hands of the robot at joint positions (n,)."""
    controller.update_kinematics(position)
    poses = [controller.get_arm_pose(i) for i in range(len(controller.robot.arms))]
    return [
        HandReference(pose.hand, pose.rotation, arm.reach * float(np.median(controller.robot.a_max[arm.joints])))
        for pose, arm in zip(poses, controller.robot.arms, strict=True)
    ]


def _approach_velocity(
    v: np.ndarray, target: np.ndarray, away: np.ndarray, speed: float, max_acceleration: float, dt: float
) -> np.ndarray:
    """Next velocity: the target's, and what closes the distance and stops with half of `max_acceleration`."""
    far = compute_norm(away)
    gain = min(CLOSING_GAIN, np.sqrt(max_acceleration / far)) if far > 0.0 else CLOSING_GAIN
    return v + _limit_norm(_limit_norm(target + gain * away, speed) - v, max_acceleration * dt)


def compute_norm(v: np.ndarray) -> float:
    """As `np.linalg.norm` of (3,), in a fifth of the time."""
    return math.sqrt(v @ v)


def _limit_norm(v: np.ndarray, limit: float) -> np.ndarray:
    size = compute_norm(v)
    return v if size <= limit else v * (limit / size)
