"""Why a hand is off its target: the constraints that were active, and what the robot could have reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from .controller import HandTarget, JointState, QpController
from .trajectory import Trajectory

FAR = 0.02  # [m] off the target: above it the error is attributed
CLAMPED = 1e-3  # [m] by which a target was moved: it was outside the reach
AT_LIMIT = 0.01  # [rad or m] from a position limit: there an active joint is at its position limit
CATCH_UP_S = 0.3  # [s] after a joint was too slow in which its error is attributed to that
CAUSES = ("not measured", "beyond the reach", "self-collision", "joint limit", "too fast", "conflicting tasks")
_SAMPLES, _RANDOM_POSTURES, _STEPS = 40, 3, 25  # of the reachability: samples, start postures of each, steps from each
_PENETRATION = 4e-3  # [m] into the clearance, above which a posture does not count as reached


def attribute_errors(trajectory: Trajectory, arm: int) -> dict[str, float]:
    """Cause → share of the motion's samples at which the hand is more than `FAR` off for it, as `find_error_causes`."""
    cause = find_error_causes(trajectory, arm)[trajectory.approach_samples :]
    return {name: round(float(np.mean(cause == k)), 4) for k, name in enumerate(CAUSES)}


def find_error_causes(trajectory: Trajectory, arm: int) -> np.ndarray:
    """Return the cause (n,) of the error of a hand, its place in `CAUSES`; -1 where the hand is less than `FAR` off.

    The first that applies: a sensor was lost; the target is beyond the reach; links close to each other stop the arm; a
    joint is at its position limit; a joint is at a limit of velocity, acceleration or jerk, or was so shortly before;
    none of these: position, orientation and swivel cannot be met together.
    """
    robot, run = trajectory.robot, trajectory.run
    joints, target = robot.arms[arm].joints, trajectory.targets[arm]
    u = run.joint_position[:, joints]
    at_limit = (u - robot.lower[joints] < AT_LIMIT) | (robot.upper[joints] - u < AT_LIMIT)
    active, half = run.active.joints[:, joints], round(0.5 * CATCH_UP_S / float(trajectory.time[1]))
    holds = np.stack(
        [
            target.lost,
            np.linalg.norm(target.position - target.unclamped, axis=1) > CLAMPED,
            run.active.arms_near_contact[:, arm],
            (active & at_limit).any(axis=1),
            maximum_filter1d(active.any(axis=1), 2 * half + 1, origin=half),
            np.ones(len(u), dtype=bool),
        ]
    )
    far = np.linalg.norm(run.hand[arm] - target.unclamped, axis=1) > FAR
    return np.where(far, np.argmax(holds, axis=0), -1)


def assess_reachability(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return samples (m,), and the distance (m, arms) [m] of each hand from its target that unlimited time would leave.

    The same tasks, joint limits and clearances, without limits of velocity, acceleration and jerk, are solved until the
    robot rests, from several postures: its own at the sample, the rest posture, random ones. The search is local: the
    distance is an upper bound.
    """
    robot = trajectory.robot
    n, rng = len(robot.names), np.random.default_rng(0)
    params = replace(
        trajectory.params,
        task_gain=40.0,
        max_correction_deceleration=1e9,
        joint_velocity_change=0.0,
        posture=1e-5,
        joint_velocity=1e-4,
    )
    controller = QpController(robot, trajectory.collision, 0.01, params, limit_factor=1e4, guarded=False)
    samples = np.linspace(trajectory.approach_samples, len(trajectory.time) - 1, _SAMPLES).astype(int)
    distance = np.full((len(samples), len(robot.arms)), np.inf)
    for k, sample in enumerate(samples.tolist()):
        targets = tuple(
            HandTarget(path.position[sample], np.zeros(3), path.rotation[sample], np.zeros(3), path.swivel[sample], 1.0)
            for path in trajectory.targets
        )
        best = np.full(len(robot.arms), np.inf)
        for u in (trajectory.joint_position[sample], robot.rest, *rng.uniform(*robot.bounds, (_RANDOM_POSTURES, n))):
            state = JointState.at_rest(u)
            for _ in range(_STEPS):
                state = controller.step(state, targets)
            controller.update_kinematics(state.position)
            near = trajectory.collision.find_near_pairs(controller.data)
            if (near.distance < near.clearance - _PENETRATION).any():
                continue
            for i, target in enumerate(targets):
                pose = controller.get_arm_pose(i)
                far = float(np.linalg.norm(pose.hand - target.position))
                angle = Rotation.from_matrix(pose.rotation.T @ target.rotation).magnitude()
                cost = params.position * far**2 + params.orientation * angle**2
                if cost < best[i]:
                    best[i], distance[k, i] = cost, far
    return samples, distance
