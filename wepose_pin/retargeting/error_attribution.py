"""Why a hand is off its target: the constraints that were active."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from .trajectory import Trajectory

FAR = 0.02  # [m] off the target: above it the error is attributed
CLAMPED = 1e-3  # [m] by which a target was moved: it was outside the reach
AT_LIMIT = 0.01  # [rad or m] from a position limit: there an active joint is at its position limit
CATCH_UP_S = 0.3  # [s] after a joint was too slow in which its error is attributed to that
CAUSES = (
    *("not measured", "beyond the reach", "self-collision", "joint limit", "too fast"),
    "conflicting tasks",
)
LOST_M, LOST_S = 0.05, 1.0  # a hand is lost that is farther off for longer; rotation counts as the tasks weigh it
MIN_WEIGHT = 0.5  # of a hand; where its target is more uncertain, its error does not count


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
    active, half = run.report.limited[:, joints], round(0.5 * CATCH_UP_S / float(trajectory.time[1]))
    holds = np.stack(
        [
            target.lost,
            np.linalg.norm(target.position - target.unclamped, axis=1) > CLAMPED,
            run.report.near_contact[:, joints].any(axis=1),
            (active & at_limit).any(axis=1),
            maximum_filter1d(active.any(axis=1), 2 * half + 1, origin=half),
            np.ones(len(u), dtype=bool),
        ]
    )
    far = np.linalg.norm(run.hand[arm] - target.unclamped, axis=1) > FAR
    return np.where(far, np.argmax(holds, axis=0), -1)


class MissedTarget(NamedTuple):
    """A time in which a hand stays off its target."""

    side: str
    begin: float  # [s] of the recording
    end: float
    error: float  # [m] largest


def find_missed_targets(trajectory: Trajectory) -> list[MissedTarget]:
    """Return when a hand is off by more than `LOST_M`, rotation included, for longer than `LOST_S`."""
    run, params, missed = trajectory.run, trajectory.params, []
    least = round(LOST_S / float(trajectory.time[1]))
    for i, (arm, target) in enumerate(zip(trajectory.robot.arms, trajectory.targets, strict=True)):
        distance = np.linalg.norm(run.hand[i] - target.position, axis=1)
        angle = (Rotation.from_matrix(run.rotation[i]).inv() * Rotation.from_matrix(target.rotation)).magnitude()
        cost = params.position * distance**2 + params.orientation * angle**2
        lost = (cost > LOST_M**2 * (params.position or 1.0)) & (target.weight >= MIN_WEIGHT) & ~target.lost
        lost[: trajectory.approach_samples] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            if end - first >= least:
                begin_s, end_s = trajectory.recorded_time[[first, end - 1]].tolist()
                missed.append(MissedTarget(arm.side, begin_s, end_s, float(distance[first:end].max())))
    return missed
