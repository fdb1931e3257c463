"""Why a hand is off its target: the constraints that were active, and what the robot could have reached."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from .reconfiguration import LOST_M, LOST_S, PostureSearch, find_lasting, find_lost
from .targets import HandTarget
from .trajectory import Trajectory

FAR = 0.02  # [m] off the target: above it the error is attributed
CLAMPED = 1e-3  # [m] by which a target was moved: it was outside the reach
AT_LIMIT = 0.01  # [rad or m] from a position limit: there an active joint is at its position limit
CATCH_UP_S = 0.3  # [s] after a joint was too slow in which its error is attributed to that
CAUSES = (
    *("not measured", "change of posture", "beyond the reach", "self-collision", "joint limit", "too fast"),
    "conflicting tasks",
)
_SAMPLES, _RANDOM_POSTURES = 40, 3  # of the reachability: samples, random start postures of each
_MISSED_SHARES = (0.25, 0.5, 0.75)  # of the time of a lasting error, at which its target has to be reachable


def attribute_errors(trajectory: Trajectory, arm: int) -> dict[str, float]:
    """Cause → share of the motion's samples at which the hand is more than `FAR` off for it, as `find_error_causes`."""
    cause = find_error_causes(trajectory, arm)[trajectory.approach_samples :]
    return {name: round(float(np.mean(cause == k)), 4) for k, name in enumerate(CAUSES)}


def find_error_causes(trajectory: Trajectory, arm: int) -> np.ndarray:
    """Return the cause (n,) of the error of a hand, its place in `CAUSES`; -1 where the hand is less than `FAR` off.

    The first that applies: a sensor was lost; the arm changes its posture; the target is beyond the reach; links close
    to each other stop the arm; a joint is at its position limit; a joint is at a limit of velocity, acceleration or
    jerk, or was so shortly before; none of these: position, orientation and swivel cannot be met together.
    """
    robot, run = trajectory.robot, trajectory.run
    joints, target = robot.arms[arm].joints, trajectory.targets[arm]
    u = run.joint_position[:, joints]
    at_limit = (u - robot.lower[joints] < AT_LIMIT) | (robot.upper[joints] - u < AT_LIMIT)
    active, half = run.report.limited[:, joints], round(0.5 * CATCH_UP_S / float(trajectory.time[1]))
    holds = np.stack(
        [
            target.lost,
            trajectory.find_changes()[:, arm],
            np.linalg.norm(target.position - target.unclamped, axis=1) > CLAMPED,
            run.report.near_contact[:, joints].any(axis=1),
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
    rng = np.random.default_rng(0)
    search = PostureSearch(trajectory.robot, trajectory.collision, trajectory.params)
    samples = np.linspace(trajectory.approach_samples, len(trajectory.time) - 1, _SAMPLES).astype(int)
    return samples, np.array([_find_distance(trajectory, search, k, rng) for k in samples.tolist()])


class MissedTarget(NamedTuple):
    """A time in which a hand stays off a target that its arm can reach."""

    side: str
    begin: float  # [s] of the recording
    end: float
    error: float  # [m] largest


def find_missed_targets(trajectory: Trajectory) -> list[MissedTarget]:
    """Return when a hand is off by more than `LOST_M`, rotation included, for longer than `LOST_S`, without need.

    That is where its target can be reached, as in `assess_reachability`, and the arm is not on its way to another
    posture.
    """
    begin, run, rng = trajectory.approach_samples, trajectory.run, np.random.default_rng(0)
    lost = find_lost(trajectory.params, trajectory.targets, run.hand, run.rotation, LOST_M)
    search = PostureSearch(trajectory.robot, trajectory.collision, trajectory.params)
    missed = []
    for i, arm in enumerate(trajectory.robot.arms):
        for span in find_lasting(lost[begin:, i], round(LOST_S / float(trajectory.time[1]))):
            first, last = begin + span[0], begin + span[1] - 1
            moments = [first + int(share * (last - first)) for share in _MISSED_SHARES]
            if all(_find_distance(trajectory, search, k, rng)[i] < FAR for k in moments):
                error = np.linalg.norm(run.hand[i] - trajectory.targets[i].position, axis=1)[first : last + 1]
                begin_s, end_s = trajectory.recorded_time[[first, last]].tolist()
                missed.append(MissedTarget(arm.side, begin_s, end_s, float(error.max())))
    return missed


def _find_distance(trajectory: Trajectory, search: PostureSearch, k: int, rng: np.random.Generator) -> np.ndarray:
    """Return the distance (arms,) [m] that the best posture found at sample `k` leaves; inf where none is clear."""
    robot = trajectory.robot
    targets = tuple(HandTarget(*path[: len(HandTarget._fields)]).sample(k) for path in trajectory.targets)
    best, distance = np.full(len(robot.arms), np.inf), np.full(len(robot.arms), np.inf)
    others = rng.uniform(*robot.bounds, (_RANDOM_POSTURES, len(robot.names)))
    for start in (trajectory.joint_position[k], robot.rest, *others):
        posture = search.search(targets, start)
        if posture is not None:
            distance = np.where(posture.cost < best, posture.distance, distance)
            best = np.minimum(best, posture.cost)
    return distance
