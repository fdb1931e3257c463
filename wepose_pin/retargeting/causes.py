"""Why a hand is not where it was asked to be: what held it in each step, and what the robot could have reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from .person import ArmTarget
from .plan import Trajectory
from .solver import Aim, State, Stepper

FAR = 0.02  # [m] off what was asked for: then a cause is looked for
DRAWN_IN = 1e-3  # [m] by which a target was moved: then it was outside the reach
AT_LIMIT = 0.01  # [rad or m] off a position limit: a joint that is held there is held by it
CAUSES = ("not measured", "beyond the reach", "own body", "joint limit", "too fast", "hand against turn")
CATCHES_UP_S = 0.3  # [s] after a joint was too slow
_FRAMES, _STARTS, _STEPS = 40, 3, 25
_IN_THE_WAY = 4e-3  # [m] into the clearance: such a place does not count as reached


def causes(trajectory: Trajectory, arm: int) -> dict[str, float]:
    """Cause → share of the motion's samples at which the hand is more than `FAR` off for it; the first that holds.

    `CAUSES` in their order: a sensor was lost; the target lies beyond the reach; shapes that are near hold one of the
    arm's joints; a joint is held at its position limit; at a limit of velocity, acceleration or jerk, or was so in the
    last moments; and nothing holds it, but place, turn and elbow ask for different things.
    """
    robot, begin = trajectory.robot, trajectory.approach
    of, target, held = robot.arms[arm], trajectory.targets[arm], trajectory.held
    u = trajectory.u[:, of.joints]
    at_limit = (u - robot.lower[of.joints] < AT_LIMIT) | (robot.upper[of.joints] - u < AT_LIMIT)
    bound, since = held.joints[:, of.joints], round(0.5 * CATCHES_UP_S / float(trajectory.time[1]))
    because = np.stack(
        [
            target.lost,
            np.linalg.norm(target.position - target.wish, axis=1) > DRAWN_IN,
            held.shapes[:, arm],
            (bound & at_limit).any(axis=1),
            maximum_filter1d(bound.any(axis=1), 2 * since + 1, origin=since),
            np.ones(len(u), dtype=bool),
        ]
    )
    off = np.linalg.norm(trajectory.hand[of.side] - target.wish, axis=1) > FAR
    which = np.argmax(because, axis=0)[begin:][off[begin:]]
    return {name: round(float(np.sum(which == k)) / len(off[begin:]), 4) for k, name in enumerate(CAUSES)}


def possible(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Samples (m,), and about how near each hand could have been there (m, arms) [m], had it all the time it wanted.

    The same tasks, joint limits and clearances, without limits of velocity, acceleration and jerk, solved to rest from
    several places: from where the robot was, from its rest, from random ones. Local searches: a robot may do better.
    """
    robot = trajectory.robot
    n, rng = len(robot.names), np.random.default_rng(0)
    tasks = replace(trajectory.tasks, gain=40.0, brake=1e9, smooth=0.0, posture=1e-5, still=1e-4)
    stepper = Stepper(robot, trajectory.shapes, 0.01, tasks, loose=1e4)
    frames = np.linspace(trajectory.approach, len(trajectory.time) - 1, _FRAMES).astype(int)
    low, high = np.clip(robot.lower, -np.pi, np.pi), np.clip(robot.upper, -np.pi, np.pi)
    found = np.full((len(frames), len(robot.arms)), np.inf)
    for k, frame in enumerate(frames.tolist()):
        aims = tuple(_still(target, frame) for target in trajectory.targets)
        best = np.full(len(robot.arms), np.inf)
        for u in (trajectory.u[frame], robot.rest, *rng.uniform(low, high, (_STARTS, n))):
            state = State(u.copy(), np.zeros(n), np.zeros(n))
            for _ in range(_STEPS):
                state = stepper.step(state, aims)
            stepper.look(state.u)
            near = trajectory.shapes.near(stepper.data)
            if (near.distance < near.clearance - _IN_THE_WAY).any():
                continue
            for i, aim in enumerate(aims):
                hand, turn, _ = stepper.place(i)
                far = float(np.linalg.norm(hand - aim.position))
                angle = Rotation.from_matrix(turn.T @ aim.rotation).magnitude()
                cost = tasks.position * far**2 + tasks.orientation * angle**2
                if cost < best[i]:
                    best[i], found[k, i] = cost, far
    return frames, found


def _still(target: ArmTarget, k: int) -> Aim:
    return Aim(target.position[k], np.zeros(3), target.rotation[k], np.zeros(3), target.bend[k], 1.0)
