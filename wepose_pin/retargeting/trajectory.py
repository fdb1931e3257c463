"""From a recorded pose to a trajectory of the robot, slower than the recording where the robot needs it.

The motion is solved twice. The first run has wide limits and shows how fast each joint would have to be where; from
that follows how much longer each moment takes. The second run has the true limits, on the stretched time, and tracks
the joint path of the first as its posture.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ..arguments import check_arguments
from ..errors import NoSolution, WrongOption
from ..kinematics import Pose
from .collision import CollisionModel
from .controller import ActiveConstraints, JointState, QpController, StepCounts, Tasks, sample_hand_targets
from .maps import find_map
from .robot import Robot, load_robot
from .targets import (
    SMOOTHING_HZ,
    ArmTargets,
    HandPath,
    compute_arm_targets,
    compute_swivel,
    differentiate,
    resample_targets,
)

RATE_HZ = 100.0
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 2000.0
WIDE_LIMITS = 8.0  # factor on the limits of the first run
MAX_SLOWDOWN = 6.0  # of one moment; what is still too fast then lags behind
VELOCITY_SHARE, ACCELERATION_SHARE, JERK_SHARE = 0.85, 0.6, 0.6  # of the limits; the rest is a reserve to catch up
SPREAD_S = 0.15  # [s] to each side over which a slow moment slows its surroundings
PATH_SMOOTHING_S = 0.03  # [s] of the first run's joint path
APPROACH_SPEED, APPROACH_RATE = 0.25, 0.6  # [m/s], [rad/s] of the hands on their way from rest
APPROACH_MIN_S, SETTLE_S = 2.0, 1.0
FADE_S = 0.5  # [s] at the end of the motion that take twice as long, to fade to rest
HALT_S = 0.3  # [s] in which the very last of the motion fades
MIN_CLEARANCE_SHARE = 0.25  # shapes that come nearer are slowed there
CONTACT_BEFORE_S, CONTACT_AFTER_S = 0.6, 0.2  # [s] about such a moment that take twice as long, in each run
CONTACT_RUNS = 3  # runs at most to slow such moments
STRICT_FACTOR = 1.02  # above this slowdown, `strict` refuses
QUANTITIES = ("velocity", "acceleration", "jerk")
SELF_CONTACT = "it could not stop before it touches itself"


class SlowestMoment(NamedTuple):
    """The joint that needs the most time, and where."""

    joint: str
    time: float  # [s] of the recording
    factor: float
    quantity: str  # of `QUANTITIES`


class Run(NamedTuple):
    """What the controller did, step by step. Over a step the jerk is constant."""

    u: np.ndarray  # (n, joints) [rad or m]
    v: np.ndarray  # (n, joints)
    a: np.ndarray  # (n, joints)
    hand: np.ndarray  # (arms, n, 3) [m] in B
    rotation: np.ndarray  # (arms, n, 3, 3) of the hand
    swivel: np.ndarray  # (arms, n, 3) [m] elbow swivel direction
    hull_distance: np.ndarray  # (n,) [m] between convex hulls; inf where none were near
    clearance_share: np.ndarray  # (n,) smallest share of a pair's clearance
    active: ActiveConstraints  # in the step from each sample
    solve_s: np.ndarray  # (n,) [s] of each step


@dataclass(frozen=True)
class Trajectory:
    """A trajectory of the robot.

    Parameters
    ----------
    arm_targets : of the recording, on its own time
    time : (n,) [s] from 0, at a constant rate
    recorded_time : (n,) [s] of the recording at each moment; that of its first moment during the approach
    approach : number of samples that lead from rest to the first moment of the recording
    targets : of the hands at these times
    run : joints, hands and constraints at these times; any denser rate keeps the same limits
    slowest : None where nothing had to be slowed for a limit
    contact_times : moments [s] of the recording that were slowed to avoid self-collision
    """

    robot: Robot
    collision: CollisionModel
    tasks: Tasks
    arm_targets: ArmTargets
    time: np.ndarray
    recorded_time: np.ndarray
    approach: int
    targets: tuple[HandPath, ...]
    run: Run
    counts: StepCounts
    slowest: SlowestMoment | None
    contact_times: tuple[float, ...] = ()

    @property
    def u(self) -> np.ndarray:
        """(n, joints) [rad or m]."""
        return self.run.u

    @property
    def hand(self) -> dict[str, np.ndarray]:
        """Side → position (n, 3) [m] of the hand in B."""
        return {arm.side: self.run.hand[i] for i, arm in enumerate(self.robot.arms)}


def retarget(
    pose: Pose,
    robot: Robot | str | Path,
    *,
    rate_hz: float = RATE_HZ,
    tasks: Tasks | None = None,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
    strict: bool = False,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> Trajectory:
    """The robot's trajectory for a person's motion, from rest to rest.

    Parameters
    ----------
    robot : of `load_robot`; or a name such as "panda", or a file, as for `find_map`, then with all its arms
    rate_hz : of the trajectory
    scale, smoothing_hz : as for `compute_arm_targets`
    strict : refuse a motion that is too fast for the robot, instead of slowing it
    progress : called with the current stage and the share of it that is done

    Raises
    ------
    BadData, BadOption
        The pose lacks an arm; a rate out of range.
    NoSolution
        `strict`, and the motion is too fast.
    """
    check_arguments(retarget, locals())
    if not isinstance(robot, Robot):
        robot = load_robot(find_map(str(robot)))
    check_rate(rate_hz)
    tasks, dt = tasks or Tasks(), 1.0 / rate_hz
    arm_targets = compute_arm_targets(pose, robot, scale=scale, smoothing_hz=smoothing_hz)
    collision = CollisionModel(robot)
    even = np.arange(0.0, arm_targets.time[-1] - arm_targets.time[0] + 0.5 * dt, dt)
    motion = resample_targets(arm_targets, arm_targets.time[0] + even, even)
    motion, approach = _prepend_approach(QpController(robot, collision, dt, tasks), motion)
    n = len(motion.time)
    wide = QpController(robot, collision, dt, tasks, limit_factor=WIDE_LIMITS)
    path = _run(wide, motion, None, 0, lambda share: progress("looking at the motion", share)).u
    path = gaussian_filter1d(path, PATH_SMOOTHING_S / dt, axis=0, mode="nearest")
    factor, slowest = _compute_slowdown(path, robot, dt, motion, approach)
    if strict and slowest is not None and slowest.factor > STRICT_FACTOR:
        raise _too_fast(
            robot, slowest.time, f"{slowest.joint} would need {slowest.factor:.1f} times its {slowest.quantity} limit"
        )
    posture_at = CubicSpline(np.arange(n) * dt, path)
    contact_times: tuple[float, ...] = ()
    settle = SETTLE_S
    for runs in range(1 + CONTACT_RUNS):
        stretched = _fade_out(np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1])) * dt]))
        clock = np.arange(0.0, stretched[-1] + settle + HALT_S, dt)
        index = np.interp(clock, stretched, np.arange(n))
        targets = _resample_at(motion, index, clock, dt)
        posture = posture_at(np.minimum(index, n - 1) * dt)
        exact = QpController(robot, collision, dt, replace(tasks, posture=50.0 * tasks.posture, posture_gain=8.0))
        run = _run(exact, targets, posture, round(HALT_S / dt), lambda share: progress("solving", share))
        near = np.flatnonzero(run.clearance_share < MIN_CLEARANCE_SHARE)
        settled = float(np.abs([run.v[-1], run.a[-1]]).max()) < 1e-9  # a robot that lags far behind needs longer
        if (settled and not len(near)) or runs == CONTACT_RUNS:
            break
        settle += 0.0 if settled else SETTLE_S
        if not len(near):
            continue
        moments = index[near[np.diff(near, prepend=-2) > 1]]
        if strict:
            raise _too_fast(robot, motion.time[int(moments[0])], SELF_CONTACT)
        contact_times = tuple(sorted({*contact_times, *np.round(motion.time[moments.astype(int)], 2).tolist()}))
        factor = factor * _contact_slowdown(index[near], n, dt)
    return Trajectory(
        robot=robot,
        collision=collision,
        tasks=tasks,
        arm_targets=arm_targets,
        time=clock,
        recorded_time=targets.time,
        approach=int(np.searchsorted(clock, stretched[approach])),
        targets=targets.hands,
        run=run,
        counts=exact.counts,
        slowest=slowest,
        contact_times=contact_times,
    )


def check_rate(rate_hz: float) -> None:
    """Raise `WrongOption` for a rate out of range."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise WrongOption("rate-hz", f"{rate_hz:g}", f"from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} samples a second")


def _too_fast(robot: Robot, moment: float, reason: str) -> NoSolution:
    return NoSolution(
        f"{robot.map.name}: too fast at {moment:.2f} s of the recording: {reason}; "
        "without --strict the motion is slowed there"
    )


def _run(
    controller: QpController,
    targets: ArmTargets,
    posture: np.ndarray | None,
    halts: int,
    progress: Callable[[float], None],
) -> Run:
    """Follow the targets from rest, with a posture (n, joints) at each sample; halt in the last `halts` steps."""
    robot, n = controller.robot, len(targets.time)
    arms, joints = len(robot.arms), len(robot.names)
    run = Run(
        np.zeros((n, joints)), np.zeros((n, joints)), np.zeros((n, joints)), np.empty((arms, n, 3)),
        np.empty((arms, n, 3, 3)), np.empty((arms, n, 3)), np.full(n, np.inf), np.full(n, np.inf),
        ActiveConstraints(np.zeros((n, joints), dtype=bool), np.zeros((n, arms), dtype=bool)), np.zeros(n),
    )  # fmt: skip
    state = JointState.at_rest(robot.rest)
    velocity = np.gradient(posture, controller.dt, axis=0) if posture is not None else None
    for k in range(n):
        run.u[k], run.v[k], run.a[k] = state.u, state.v, state.a
        begin = time.perf_counter()
        if posture is not None and velocity is not None:
            controller.posture = (posture[k], velocity[min(k + 1, n - 1)])
        left = n - 1 - k
        if left < halts:
            state = controller.halt(state, left)
        else:
            state = controller.step(state, sample_hand_targets(targets.hands, k, controller.dt))
        run.solve_s[k] = time.perf_counter() - begin
        run.hull_distance[k], run.clearance_share[k] = controller.min_distance, controller.clearance_share
        run.active.joints[k], run.active.shapes[k] = controller.active
        for i in range(arms):
            run.hand[i, k], run.rotation[i, k], run.swivel[i, k] = controller.arm_pose(i)
        if k % 64 == 0:
            progress(k / n)
    for i, arm in enumerate(robot.arms):  # so far the elbows are there
        run.swivel[i] = compute_swivel(run.swivel[i] - arm.shoulder, run.hand[i] - arm.shoulder)
    return run


def _prepend_approach(controller: QpController, motion: ArmTargets) -> tuple[ArmTargets, int]:
    """The motion after a smooth approach of each hand from rest; and the number of samples of the approach."""
    robot, dt = controller.robot, controller.dt
    controller.set_joints(robot.rest)
    poses = [controller.arm_pose(i) for i in range(len(robot.arms))]
    longest = APPROACH_MIN_S
    for pose, path in zip(poses, motion.hands, strict=True):
        far = float(np.linalg.norm(path.position[0] - pose.hand))
        angle = (Rotation.from_matrix(pose.rotation).inv() * Rotation.from_matrix(path.rotation[0])).magnitude()
        longest = max(longest, 1.9 * far / APPROACH_SPEED, 1.9 * float(angle) / APPROACH_RATE)
    n = round(longest / dt)
    x = np.minimum(np.arange(n + round(SETTLE_S / dt)) / n, 1.0)
    share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    count = len(share)
    hands = []
    for pose, path, arm in zip(poses, motion.hands, robot.arms, strict=True):
        position = pose.hand + share[:, None] * (path.position[0] - pose.hand)
        ends = Rotation.from_matrix(np.stack([pose.rotation, path.rotation[0]]))
        rotation = Slerp([0.0, 1.0], ends)(share).as_matrix()
        swivel = np.zeros(3)
        if arm.elbow >= 0:
            swivel = compute_swivel(pose.elbow - arm.shoulder, pose.hand - arm.shoulder)
        swivels = swivel + share[:, None] * (path.swivel[0] - swivel)
        lost = np.zeros(count, dtype=bool)
        before = HandPath(position, position, rotation, position, swivels, position, np.ones(count), lost)
        whole = HandPath(*(np.concatenate([a, b]) for a, b in zip(before, path, strict=True)))
        hands.append(differentiate(whole, np.arange(len(whole.weight)) * dt))
    recorded_time = np.concatenate([np.full(count, motion.time[0]), motion.time])
    slowdown = np.concatenate([np.ones(count), motion.slowdown])
    return replace(motion, time=recorded_time, hands=tuple(hands), slowdown=slowdown), count


def _compute_slowdown(
    u: np.ndarray, robot: Robot, dt: float, motion: ArmTargets, approach: int
) -> tuple[np.ndarray, SlowestMoment | None]:
    """(n,) from 1, how much longer each moment takes for a joint path `u` (n, joints), and the slowest moment."""
    v = np.gradient(u, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    jerk = np.gradient(a, dt, axis=0)
    needed = np.stack(
        [
            np.abs(v) / (VELOCITY_SHARE * robot.v_max),
            np.sqrt(np.abs(a) / (ACCELERATION_SHARE * robot.a_max)),
            np.cbrt(np.abs(jerk) / (JERK_SHARE * robot.j_max)),
        ]
    )
    longest = needed.max(axis=(0, 2))
    slowest = None
    k = approach + int(np.argmax(longest[approach:]))
    if longest[k] > 1.0:
        which, j = np.unravel_index(int(np.argmax(needed[:, k])), needed[:, k].shape)
        ratio = (np.abs(v[k]) / robot.v_max, np.abs(a[k]) / robot.a_max, np.abs(jerk[k]) / robot.j_max)[which][j]
        slowest = SlowestMoment(robot.names[j], float(motion.time[k]), float(ratio), QUANTITIES[which])
    factor = np.minimum(np.maximum(np.maximum(longest, 1.0), motion.slowdown), MAX_SLOWDOWN)
    width = max(1, round(SPREAD_S / dt))
    wide = maximum_filter1d(factor, 2 * width + 1, mode="nearest")
    return np.asarray(gaussian_filter1d(wide, 0.5 * width, mode="nearest")), slowest


def _contact_slowdown(near: np.ndarray, n: int, dt: float) -> np.ndarray:
    """(n,) from 1 to 2: factor on the duration of each moment about the samples `near`."""
    slow = np.zeros(n, dtype=bool)
    for k in np.unique(near.astype(int)).tolist():
        slow[max(0, k - round(CONTACT_BEFORE_S / dt)) : k + round(CONTACT_AFTER_S / dt) + 1] = True
    return 1.0 + np.asarray(gaussian_filter1d(slow.astype(float), 0.5 * SPREAD_S / dt, mode="nearest"))


def _fade_out(clock: np.ndarray) -> np.ndarray:
    """Times of the samples, the last `FADE_S` of them stretched so that their speed falls linearly to zero."""
    share = np.clip((clock - (clock[-1] - FADE_S)) / FADE_S, 0.0, 1.0)
    return clock + FADE_S * (2.0 * (1.0 - np.sqrt(1.0 - share)) - share)


def _resample_at(motion: ArmTargets, index: np.ndarray, clock: np.ndarray, dt: float) -> ArmTargets:
    """The motion at fractional samples `index`, passed at `clock` [s] of the robot; its time stays the recording's."""
    even = np.arange(len(motion.time)) * dt
    recorded_time = np.interp(index * dt, even, motion.time)
    return replace(resample_targets(replace(motion, time=even), index * dt, clock), time=recorded_time)
