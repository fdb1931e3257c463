"""From a recorded pose to a trajectory of the robot, slower than the recording where the robot needs it.

The motion is solved twice. The first run, with limits `WIDE_LIMIT_FACTOR` times as wide, gives the velocity,
acceleration and jerk that each joint needs; from these follows a time scaling. The second run follows the time-scaled
motion within the true limits, with the joint path of the first run as posture reference.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ..arguments import check_arguments
from ..errors import BadOption, NoSolution, WrongOption
from ..kinematics import Pose, PosedBody, cut_pose
from ..model import BodyTable
from ..recording import Intervals, select_interval
from ..writers.joint_motion import JointMotion
from .collision import CollisionModel
from .controller import (
    ActiveConstraints,
    ControllerParams,
    JointState,
    PostureReference,
    QpController,
    StepCounts,
    sample_hand_targets,
)
from .maps import find_map, list_sides
from .reconfiguration import Planner
from .robot import LimitMargins, Robot, load_robot
from .targets import (
    SMOOTHING_HZ,
    WEIGHT_POOR,
    ArmTargets,
    HandPath,
    compute_arm_targets,
    compute_swivel,
    differentiate,
    resample_targets,
)

RATE_HZ = 100.0
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 2000.0
WIDE_LIMIT_FACTOR = 8.0  # on the limits of the first run
MAX_SLOWDOWN = 6.0  # largest time scaling of a sample; the robot lags behind a motion that needs more
# Fractions of the limits that the time scaling uses. The rest is a reserve to catch up.
VELOCITY_FRACTION, ACCELERATION_FRACTION, JERK_FRACTION = 0.85, 0.6, 0.6
SLOWDOWN_SPREAD_S = 0.15  # [s] by which a slowdown extends to both sides
PATH_SMOOTHING_S = 0.03  # [s] of the first run's joint path
APPROACH_SPEED, APPROACH_ANGULAR_SPEED = 0.25, 0.6  # [m/s], [rad/s] largest of the hands on their way from rest
QUINTIC_PEAK_SPEED = 1.9  # a quintic from rest to rest is 1.875 times as fast in its middle as on average
APPROACH_MIN_S = 2.0  # [s] of the approach at least
SETTLE_S = 1.0  # [s] in which the targets rest, after the approach and at the end
END_S = 0.5  # [s] at the end of the motion that are stretched to twice their duration, to end at rest
HALT_S = 0.3  # [s] at the very end, in which the remaining velocity decays to zero
SETTLED = 1e-9  # [rad or m, s] below it a joint's last velocity and acceleration count as zero
CONTACT_BEFORE_S, CONTACT_AFTER_S = 0.3, 0.1  # [s] about such a sample that take twice as long, in each run
CONTACT_RUNS = 5  # further runs at most, to slow such samples
TRACKING_POSTURE_FACTOR, TRACKING_POSTURE_GAIN = 50.0, 8.0  # of the second run: weight, gain [1/s] of its posture
MAX_STRICT_RATIO = 1.02  # of what a joint needs to its limit; above it `strict` refuses the motion
PROGRESS_STEPS = 64  # steps between two calls of `progress`
QUANTITIES = ("velocity", "acceleration", "jerk")
STAGES = ("solving with wide limits", "solving with the robot's limits")  # of `progress`; the second may be repeated
SELF_CONTACT = "the robot could not stop before its links touch"


class LimitingJoint(NamedTuple):
    """The joint that needs the largest slowdown."""

    joint: str
    time: float  # [s] of the recording
    factor: float  # of what it needs there to its limit
    quantity: str  # of `QUANTITIES`


class ControllerRun(NamedTuple):
    """States and constraints of the controller at each sample. Over a step the jerk is constant."""

    joint_position: np.ndarray  # (n, joints) [rad or m]
    joint_velocity: np.ndarray  # (n, joints)
    joint_acceleration: np.ndarray  # (n, joints)
    hand: np.ndarray  # (arms, n, 3) [m] in B
    rotation: np.ndarray  # (arms, n, 3, 3) of the hand
    swivel: np.ndarray  # (arms, n, 3) [m] elbow swivel direction
    hull_distance: np.ndarray  # (n,) [m] between convex hulls; inf where none were near
    nearest_pair: np.ndarray  # (n,) int, of `CollisionModel.pairs`, to which that belongs; -1: none
    stopping: np.ndarray  # (n,) bool: no step kept all limits and clearances, the robot braked
    active: ActiveConstraints  # in the step from each sample
    solve_s: np.ndarray  # (n,) [s] of each step


@dataclass(frozen=True)
class Trajectory:
    """A trajectory of the robot.

    Parameters
    ----------
    params : of the controller
    arm_targets : of the recording, on its own time
    time : (n,) [s] from 0, at a constant rate
    recorded_time : (n,) [s] of the recording at each sample; during the approach that of its first sample
    approach_samples : number of samples from rest to the first pose of the recording
    targets : (arms,) paths of the hands, at `time`
    run : joints, hands and constraints at `time`; any denser rate keeps the same limits
    counts : of the controller's steps
    limiting_joint : None where nothing had to be slowed for a limit
    contact_times : [s] of the recording at which the motion was slowed to avoid self-collision
    """

    robot: Robot
    collision: CollisionModel
    params: ControllerParams
    arm_targets: ArmTargets
    time: np.ndarray
    recorded_time: np.ndarray
    approach_samples: int
    targets: tuple[HandPath, ...]
    run: ControllerRun
    counts: StepCounts
    limiting_joint: LimitingJoint | None
    contact_times: tuple[float, ...] = ()

    def __repr__(self) -> str:
        return f"Trajectory({self.robot.map.name!r}: {self.time[-1]:.1f} s, {len(self.robot.names)} joints)"

    @property
    def joint_position(self) -> np.ndarray:
        """(n, joints) [rad or m]."""
        return self.run.joint_position

    def find_changes(self) -> np.ndarray:
        """Return (n, arms) bool: the arm is on its way to another posture, off the hand's path."""
        return np.stack([target.weight < 0.5 * WEIGHT_POOR for target in self.targets], axis=1)

    @property
    def hand(self) -> dict[str, np.ndarray]:
        """Side → position (n, 3) [m] of the hand in B."""
        return {arm.side: self.run.hand[i] for i, arm in enumerate(self.robot.arms)}

    def joint_motion(self) -> JointMotion:
        """Return the motion as `export` takes it."""
        from .files import build_joint_motion

        return build_joint_motion(self)


def retarget(
    pose: Pose | PosedBody | str | Path,
    robot: Robot | str | Path,
    *,
    arm: Literal["left", "right", "both"] | None = None,
    task: Literal["both", "position", "orientation"] = "both",
    rate_hz: float = RATE_HZ,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
    speed_scale: float | None = None,
    limit_margin: float | None = None,
    interval: tuple[float, float] | None = None,
    phase: str | None = None,
    strict: bool = False,
    params: ControllerParams | None = None,
    table: BodyTable | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Trajectory:
    """Compute the robot's joint trajectory for a person's motion, as `wepose retarget`. It begins and ends at rest.

    Parameters
    ----------
    pose : Pose, PosedBody, str or Path
        What `track` or `load_result` gives, or its `pose`; or a result folder.
    robot : Robot, str or Path
        A name such as "panda", a URDF with a map beside it, or the map; or what `wepose_pin.retargeting.load_robot`
        gives, with its own arms and margins.
    arm : str, optional
        Only this arm of the robot, "left" or "right", or "both"; None: all that it has.
    task : str
        Follow the "position" of the hands, their "orientation", or "both".
    rate_hz : float
        Samples a second of the trajectory, 10 to 2000 Hz.
    scale : float, optional
        Factor on the way from shoulder to hand; None: the reach of the robot's arm over the length of the person's.
    smoothing_hz : float
        Cut-off frequency of the person's motion; 0: not filtered.
    speed_scale : float, optional
        Share of the limits of velocity, acceleration and jerk that is used, above 0, up to 1; None: 0.9.
    limit_margin : float, optional
        Distance [rad] kept from the position limits; of a joint that slides a tenth of it in metres; None: 0.05.
    interval, phase : optional
        Follow only this interval, from and to [s], or this phase of the recording; of a phase with several intervals
        "NAME:2" is the second.
    strict : bool
        Raise `NoSolution` for a motion that is too fast for the robot, instead of slowing it.
    params : ControllerParams, optional
        Weights and gains of the controller; None: the default ones.
    table : BodyTable, optional
        Of the person's body; None: that of `pose`, where it has a body, else the upper body's.
    progress : callable, optional
        Called with the current stage (`STAGES`) and the fraction of it that is done.

    Returns
    -------
    Trajectory
        `time` (n,) [s] from 0, `joint_position` (n, joints) [rad or m].

    Raises
    ------
    MissingFile, BadData, BadOption
        No result, no such robot, arm or phase; the pose lacks an arm; a number out of range.
    NoSolution
        `strict`, and the motion is too fast.

    Examples
    --------
    >>> trajectory = wp.retarget("result", "arm.urdf", rate_hz=10.0)
    >>> trajectory
    Trajectory('arm': 29.0 s, 7 joints)
    >>> trajectory.joint_position.shape == (len(trajectory.time), 7)  # [rad]
    True
    """
    check_arguments(retarget, locals())
    check_rate(rate_hz)
    pose, body_table = _select_pose(pose, interval, phase)
    stated = {"arm": arm, "speed_scale": speed_scale, "limit_margin": limit_margin}
    if not isinstance(robot, Robot):
        chosen = {name: stated[name] for name in ("speed_scale", "limit_margin") if stated[name] is not None}
        robot = load_robot(find_map(str(robot)), list_sides(arm), LimitMargins(**chosen))  # type: ignore[arg-type]
    elif any(value is not None for value in stated.values()):
        raise BadOption(f"{', '.join(stated)}: a Robot has arms and margins of its own; `load_robot` takes them")
    left_out = [name for name in ("position", "orientation") if task not in ("both", name)]
    params = replace(params or ControllerParams(), **dict.fromkeys(left_out, 0.0))
    arm_targets = compute_arm_targets(pose, robot, table=table or body_table, scale=scale, smoothing_hz=smoothing_hz)
    report = progress or (lambda _text, _fraction: None)
    return _compute_trajectory(arm_targets, robot, params, 1.0 / rate_hz, strict, report)


def _select_pose(
    pose: Pose | PosedBody | str | Path, interval: tuple[float, float] | None, phase: str | None
) -> tuple[Pose, BodyTable | None]:
    """Return an interval or a phase of a motion, and the table of its body where it has one."""
    if isinstance(pose, str | Path):
        from ..writers import read_result

        selected_pose, body, _ = read_result(Path(pose), interval, phase)
        return selected_pose, body.table
    phases: Mapping[str, Intervals] = {}
    table = None
    if isinstance(pose, PosedBody):
        phases = getattr(pose, "phases", {})
        table, pose = pose.model.table, pose.pose
    selected = select_interval(pose.time, phases, interval, phase)
    return (pose if selected is None else cut_pose(pose, selected)), table


def _compute_trajectory(
    arm_targets: ArmTargets,
    robot: Robot,
    params: ControllerParams,
    dt: float,
    strict: bool,
    progress: Callable[[str, float], None],
) -> Trajectory:
    """Solve the motion with wide limits, slow it, and solve it with the robot's; where it brakes, slower again."""
    collision = CollisionModel(robot)
    uniform_time = np.arange(0.0, arm_targets.time[-1] - arm_targets.time[0] + 0.5 * dt, dt)
    motion = resample_targets(arm_targets, arm_targets.time[0] + uniform_time, uniform_time)
    motion, approach_samples = _prepend_approach(QpController(robot, collision, dt, params), motion)
    wide_controller = QpController(robot, collision, dt, params, WIDE_LIMIT_FACTOR, guarded=False)
    wide_run = _run_controller(wide_controller, motion, None, 0, lambda fraction: progress(STAGES[0], fraction))
    planner = Planner(wide_controller, motion, approach_samples)
    motion, path, approach_samples = planner.plan(wide_run.joint_position, wide_run.hand, wide_run.rotation)
    n = len(motion.time)
    path = gaussian_filter1d(path, PATH_SMOOTHING_S / dt, axis=0, mode="nearest")
    slowdown, limiting = _compute_slowdown(path, robot, dt, motion, approach_samples)
    if strict and limiting is not None and limiting.factor > MAX_STRICT_RATIO:
        reason = f"{limiting.joint} would need {limiting.factor:.1f} times its {limiting.quantity} limit"
        raise _build_too_fast_error(robot, limiting.time, reason)
    posture_at = CubicSpline(np.arange(n) * dt, path)
    tracking_params = replace(
        params, posture=TRACKING_POSTURE_FACTOR * params.posture, posture_gain=TRACKING_POSTURE_GAIN
    )
    contact_times: tuple[float, ...] = ()
    contact_slowdown = np.ones(n)
    settle_s = SETTLE_S
    for attempt in range(1 + CONTACT_RUNS):
        sample_time = np.concatenate([[0.0], np.cumsum(0.5 * (slowdown[1:] + slowdown[:-1])) * dt])
        sample_time = _stretch_end(sample_time)  # of the motion's samples, on the robot's time
        robot_time = np.arange(0.0, sample_time[-1] + settle_s + HALT_S, dt)
        index = np.interp(robot_time, sample_time, np.arange(n))
        targets = _resample_motion(motion, index, robot_time, dt)
        posture = posture_at(np.minimum(index, n - 1) * dt)
        controller = QpController(robot, collision, dt, tracking_params)
        halt_steps = round(HALT_S / dt)
        pace = np.interp(index, np.arange(n), 1.0 / contact_slowdown)
        run = _run_controller(
            controller, targets, posture, halt_steps, lambda fraction: progress(STAGES[1], fraction), pace
        )
        near_contact = np.flatnonzero(run.stopping)
        # A robot that lags far behind needs longer to come to rest.
        settled = float(np.abs([run.joint_velocity[-1], run.joint_acceleration[-1]]).max()) < SETTLED
        if (settled and not len(near_contact)) or attempt == CONTACT_RUNS:
            break
        if not settled:
            settle_s += SETTLE_S
            contact_slowdown[-1] *= 2.0
        if not len(near_contact):
            continue
        begins = index[near_contact[np.diff(near_contact, prepend=-2) > 1]].astype(int)
        if strict:
            raise _build_too_fast_error(robot, motion.time[begins[0]], SELF_CONTACT)
        contact_times = tuple(sorted({*contact_times, *np.round(motion.time[begins], 2).tolist()}))
        slower = _compute_contact_slowdown(index[near_contact], n, dt)
        slowdown, contact_slowdown = slowdown * slower, contact_slowdown * slower
    return Trajectory(
        robot=robot,
        collision=collision,
        params=params,
        arm_targets=arm_targets,
        time=robot_time,
        recorded_time=targets.time,
        approach_samples=int(np.searchsorted(robot_time, sample_time[approach_samples])),
        targets=targets.hands,
        run=run,
        counts=controller.counts,
        limiting_joint=limiting,
        contact_times=contact_times,
    )


def check_rate(rate_hz: float) -> None:
    """Raise `WrongOption` for a rate out of range."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise WrongOption("rate-hz", f"{rate_hz:g}", f"from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} samples a second")


def _build_too_fast_error(robot: Robot, time_s: float, reason: str) -> NoSolution:
    return NoSolution(
        f"{robot.map.name}: too fast at {time_s:.2f} s of the recording: {reason}; "
        "without --strict the motion is slowed there"
    )


def _run_controller(
    controller: QpController,
    targets: ArmTargets,
    posture: np.ndarray | None,
    halt_steps: int,
    progress: Callable[[float], None],
    pace: np.ndarray | None = None,
) -> ControllerRun:
    """Follow the targets from rest; come to rest in the last `halt_steps`.

    `posture` (n, joints) is a posture reference, `pace` (n,) that of corrections.
    """
    robot, n = controller.robot, len(targets.time)
    arms, joints = len(robot.arms), len(robot.names)
    run = ControllerRun(
        np.zeros((n, joints)), np.zeros((n, joints)), np.zeros((n, joints)), np.empty((arms, n, 3)),
        np.empty((arms, n, 3, 3)), np.empty((arms, n, 3)), np.full(n, np.inf), np.full(n, -1),
        np.zeros(n, dtype=bool),
        ActiveConstraints(np.zeros((n, joints), dtype=bool), np.zeros((n, arms), dtype=bool)), np.zeros(n),
    )  # fmt: skip
    state = JointState.at_rest(robot.rest)
    velocity = np.gradient(posture, controller.dt, axis=0) if posture is not None else None
    for k in range(n):
        run.joint_position[k], run.joint_velocity[k] = state.position, state.velocity
        run.joint_acceleration[k] = state.acceleration
        begin = time.perf_counter()
        if posture is not None and velocity is not None:
            controller.posture_reference = PostureReference(posture[k], velocity[min(k + 1, n - 1)])
        controller.pace = 1.0 if pace is None else float(pace[k])
        steps_left = n - 1 - k
        if steps_left < halt_steps:
            state = controller.brake(state)
        else:
            state = controller.step(state, sample_hand_targets(targets.hands, k, controller.dt))
        run.solve_s[k] = time.perf_counter() - begin
        run.hull_distance[k], run.nearest_pair[k] = controller.min_distance, controller.nearest_pair
        run.stopping[k] = controller.stopping
        run.active.joints[k], run.active.arms_near_contact[k] = controller.active
        for i in range(arms):
            run.hand[i, k], run.rotation[i, k], run.swivel[i, k] = controller.get_arm_pose(i)
        if k % PROGRESS_STEPS == 0:
            progress(k / n)
    for i, arm in enumerate(robot.arms):  # run.swivel holds the elbows' positions up to here
        run.swivel[i] = compute_swivel(run.swivel[i] - arm.shoulder, run.hand[i] - arm.shoulder)
    return run


def _prepend_approach(controller: QpController, motion: ArmTargets) -> tuple[ArmTargets, int]:
    """Prepend a smooth approach of each hand from rest; return the motion and the number of samples of the approach."""
    robot, dt = controller.robot, controller.dt
    controller.update_kinematics(robot.rest)
    poses = [controller.get_arm_pose(i) for i in range(len(robot.arms))]
    longest = APPROACH_MIN_S
    for pose, path in zip(poses, motion.hands, strict=True):
        distance = float(np.linalg.norm(path.position[0] - pose.hand))
        angle = (Rotation.from_matrix(pose.rotation).inv() * Rotation.from_matrix(path.rotation[0])).magnitude()
        longest = max(
            longest,
            QUINTIC_PEAK_SPEED * distance / APPROACH_SPEED,
            QUINTIC_PEAK_SPEED * float(angle) / APPROACH_ANGULAR_SPEED,
        )
    n = round(longest / dt)
    x = np.minimum(np.arange(n + round(SETTLE_S / dt)) / n, 1.0)
    blend = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    count = len(blend)
    hands = []
    for pose, path, arm in zip(poses, motion.hands, robot.arms, strict=True):
        position = pose.hand + blend[:, None] * (path.position[0] - pose.hand)
        ends = Rotation.from_matrix(np.stack([pose.rotation, path.rotation[0]]))
        rotation = Slerp([0.0, 1.0], ends)(blend).as_matrix()
        swivel = np.zeros(3)
        if arm.elbow >= 0:
            swivel = compute_swivel(pose.elbow - arm.shoulder, pose.hand - arm.shoulder)
        swivels = swivel + blend[:, None] * (path.swivel[0] - swivel)
        lost = np.zeros(count, dtype=bool)
        before = HandPath(position, position, rotation, position, swivels, position, np.ones(count), lost)
        whole = HandPath(*(np.concatenate([a, b]) for a, b in zip(before, path, strict=True)))
        hands.append(differentiate(whole, np.arange(len(whole.weight)) * dt))
    recorded_time = np.concatenate([np.full(count, motion.time[0]), motion.time])
    slowdown = np.concatenate([np.ones(count), motion.slowdown])
    return replace(motion, time=recorded_time, hands=tuple(hands), slowdown=slowdown), count


def _compute_slowdown(
    path: np.ndarray, robot: Robot, dt: float, motion: ArmTargets, approach_samples: int
) -> tuple[np.ndarray, LimitingJoint | None]:
    """Return the time scaling (n,) ≥ 1 that a joint path (n, joints) needs, and the limiting joint."""
    v = np.gradient(path, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    jerk = np.gradient(a, dt, axis=0)
    needed = np.stack(
        [
            np.abs(v) / (VELOCITY_FRACTION * robot.v_max),
            np.sqrt(np.abs(a) / (ACCELERATION_FRACTION * robot.a_max)),
            np.cbrt(np.abs(jerk) / (JERK_FRACTION * robot.j_max)),
        ]
    )
    longest = needed.max(axis=(0, 2))
    limiting = None
    k = approach_samples + int(np.argmax(longest[approach_samples:]))
    if longest[k] > 1.0:
        quantity, j = np.unravel_index(int(np.argmax(needed[:, k])), needed[:, k].shape)
        ratio = (np.abs(v[k]) / robot.v_max, np.abs(a[k]) / robot.a_max, np.abs(jerk[k]) / robot.j_max)[quantity][j]
        limiting = LimitingJoint(robot.names[j], float(motion.time[k]), float(ratio), QUANTITIES[quantity])
    slowdown = np.minimum(np.maximum(np.maximum(longest, 1.0), motion.slowdown), MAX_SLOWDOWN)
    width = max(1, round(SLOWDOWN_SPREAD_S / dt))
    wide = maximum_filter1d(slowdown, 2 * width + 1, mode="nearest")
    return np.asarray(gaussian_filter1d(wide, 0.5 * width, mode="nearest")), limiting


def _compute_contact_slowdown(near: np.ndarray, n: int, dt: float) -> np.ndarray:
    """Return a time scaling (n,) from 1 to 2, above 1 about the samples `near`."""
    slow = np.zeros(n, dtype=bool)
    for k in np.unique(near.astype(int)).tolist():
        slow[max(0, k - round(CONTACT_BEFORE_S / dt)) : k + round(CONTACT_AFTER_S / dt) + 1] = True
    return 1.0 + np.asarray(gaussian_filter1d(slow.astype(float), 0.5 * SLOWDOWN_SPREAD_S / dt, mode="nearest"))


def _stretch_end(time: np.ndarray) -> np.ndarray:
    """Return the times (n,) [s] with the last `END_S` stretched, so that its speed falls linearly to zero."""
    phase = np.clip((time - (time[-1] - END_S)) / END_S, 0.0, 1.0)
    return time + END_S * (2.0 * (1.0 - np.sqrt(1.0 - phase)) - phase)


def _resample_motion(motion: ArmTargets, index: np.ndarray, robot_time: np.ndarray, dt: float) -> ArmTargets:
    """Return the motion at fractional samples `index`, velocities on `robot_time` [s], `time` on the recording's."""
    uniform_time = np.arange(len(motion.time)) * dt
    recorded_time = np.interp(index * dt, uniform_time, motion.time)
    return replace(resample_targets(replace(motion, time=uniform_time), index * dt, robot_time), time=recorded_time)
