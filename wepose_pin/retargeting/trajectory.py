"""From a recorded pose to a trajectory of the robot, slower than the recording where the robot needs it.

The motion is solved twice. The first run, with limits `WIDE_LIMIT_FACTOR` times as wide, gives the velocity,
acceleration and jerk that each joint needs; from these follows a time scaling. The second run follows the time-scaled
motion within the true limits, with the joint path of the first run as posture reference.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ..arguments import Range, check_arguments
from ..body import BodyTable
from ..body.kinematics import Pose, find_samples
from ..body.urdf import read_urdf, resolve_meshes
from ..errors import BadOption
from ..recording import select_interval
from ..tracking import TrackResult
from ..writers import load_result, select_pose
from ..writers.motion import JointMotion
from .collision import CollisionModel
from .controller import ControllerParams, JointState, QpController, StepReport
from .limits import MAX_STOP_S
from .maps import list_sides
from .robot import Robot, load_robot
from .targets import SMOOTHING_HZ, ArmTargets, HandTarget, compute_arm_targets, compute_swivel
from .visuals import place_root

RATE_HZ = 100.0
PLAN_STEP_S = 0.01  # [s] of the first run at least, whatever the rate of the trajectory: coarser, the robot shakes
WIDE_LIMIT_FACTOR = 8.0  # on the limits of the first run
MAX_SLOWDOWN = 6.0  # largest time scaling of a sample; the robot lags behind a motion that needs more
# Fractions of the limits that the time scaling uses. The rest is a reserve to catch up.
VELOCITY_FRACTION, ACCELERATION_FRACTION, JERK_FRACTION = 0.85, 0.6, 0.6
SLOWDOWN_SPREAD_S = 0.15  # [s] by which a slowdown extends to both sides
PATH_SMOOTHING_S = 0.03  # [s] of the first run's joint path
APPROACH_SPEED, APPROACH_ANGULAR_SPEED = 0.25, 0.6  # [m/s], [rad/s] largest of the hands on their way from rest
QUINTIC_PEAK_SPEED = 1.875  # of the approach, over distance and duration
APPROACH_MIN_S = 2.0  # [s] of the approach at least
SETTLE_S = 1.0  # [s] in which the targets rest, after the approach and at the end
END_S = 0.5  # [s] at the end of the motion that are stretched to twice their duration, to end at rest
SETTLED = 1e-3  # [rad/s or m/s] below it all joints have settled at the end, and brake to rest
MAX_LAG_S = 5.0  # [s] for which the end waits until they have
TRACKING_POSTURE_FACTOR, TRACKING_POSTURE_GAIN = 50.0, 8.0  # of the second run: weight, gain [1/s] of its posture
PROGRESS_STEPS = 64  # steps between two calls of `progress`
QUANTITIES = ("velocity", "acceleration", "jerk")
STAGES = ("solving with wide limits", "solving with the robot's limits")  # of `progress`


@dataclass(frozen=True)
class Trajectory:
    """A trajectory of the robot. Over a step the jerk is constant, so that any denser rate keeps the same limits."""

    robot: Robot
    params: ControllerParams  # of the controller
    scale: dict[str, float]  # side → metres of the robot for one metre of the person
    time: np.ndarray  # (n,) [s] from 0, at a constant rate
    recorded_time: np.ndarray  # (n,) [s] of the recording at each sample; during the approach that of its first sample
    approach_samples: int  # number of samples from rest to the first pose of the recording
    targets: tuple[HandTarget, ...]  # (arms,) over time
    joint_position: np.ndarray  # (n, joints) [rad or m]
    joint_velocity: np.ndarray  # (n, joints)
    joint_acceleration: np.ndarray  # (n, joints)
    p_BH: np.ndarray  # (arms, n, 3) [m] of the hands
    R_BH: np.ndarray  # (arms, n, 3, 3)
    swivel: np.ndarray  # (arms, n, 3) [m] elbow swivel direction
    report: StepReport  # of the step from each sample
    # The joint that needs the largest slowdown, the time [s] of the recording, and the quantity, of `QUANTITIES`; None
    # where nothing had to be slowed for a limit.
    slowest: dict[str, Any] | None

    def __repr__(self) -> str:
        return f"Trajectory({self.robot.map.name!r}: {self.time[-1]:.1f} s, {len(self.robot.names)} joints)"

    @property
    def hand(self) -> dict[str, np.ndarray]:
        """Side → position (n, 3) [m] of the hand in B."""
        return {arm.side: self.p_BH[i] for i, arm in enumerate(self.robot.arms)}

    def joint_motion(self) -> JointMotion:
        """Return the motion as `export` takes it, the robot standing on the floor."""
        robot, urdf = self.robot, self.robot.map.urdf
        R_WB, p_WB = place_root(robot)
        return JointMotion(
            name=robot.map.name,
            where=robot.map.name,
            robot=read_urdf(urdf),
            urdf=resolve_meshes(urdf),
            joints=robot.names,
            time=self.time,
            position=self.joint_position,
            velocity=self.joint_velocity,
            posture=robot.posture,
            p_WB=p_WB,
            quat_WB=Rotation.from_matrix(R_WB).as_quat(),
            recorded_time=self.recorded_time,
            begin=self.approach_samples,
        )


def retarget(
    pose: Pose | TrackResult | str | Path,
    robot: Robot | str | Path,
    *,
    arm: Literal["left", "right", "both"] | None = None,
    task: Literal["both", "position", "orientation"] = "both",
    rate_hz: Annotated[float, Range(10.0, closed=True, high=2000.0, unit="Hz")] = RATE_HZ,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
    speed_scale: float | None = None,
    limit_margin: float | None = None,
    interval: tuple[float, float] | None = None,
    phase: str | None = None,
    params: ControllerParams | None = None,
    table: BodyTable | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Trajectory:
    """Compute the robot's joint trajectory for a person's motion, as `wepose retarget`. It begins and ends at rest.

    Parameters
    ----------
    pose : TrackResult, Pose, str or Path
        What `track` or `load_result` gives, or its `pose`; or a result folder.
    robot : str, Path or Robot (of `wepose_pin.retargeting.load_robot`, with its own arms and margins)
        Move this robot: a name such as panda, a URDF with a robot map beside it, or the robot map itself.
    arm : "left", "right" or "both", optional
        Move only this arm of the robot, or both. Without it all arms that the robot has.
    task : "both", "position" or "orientation"
        Follow the position of the person's hands, their orientation, or both.
    rate_hz : float
        Sample the trajectory at this rate, 10 to 2000 Hz. Choose that of the robot's controller.
    scale : float, optional
        Scale the distance from shoulder to hand by this factor. Without it the ratio of the reach of the robot's arm to
        the length of the person's (docs/retargeting.md).
    smoothing_hz : float
        Low-pass filter the person's motion at this frequency; 0 does not filter it.
    speed_scale : float, optional
        Use this share of the robot's limits of velocity, acceleration and jerk, above 0, up to 1. Without it 0.9.
    limit_margin : float, optional
        Keep this distance from the position limits, in radians; for a prismatic joint a tenth of it, in metres. Without
        it 0.05.
    interval : (float, float), optional
        Use only this time of the recording, from and to in seconds.
    phase : str, optional
        Use only this phase of the recording. If it has several intervals, NAME:2 is the second one.
    params : ControllerParams, optional
        Weights and gains of the controller.
    table : BodyTable, optional
        Of the person's body. Without it that of `pose`, where it has a body, else the upper body's.
    progress : function, optional
        Called with the current stage (`STAGES`) and the fraction of it that is done.

    Returns
    -------
    Trajectory
        `time` (n,) [s] from 0, `joint_position` (n, joints) [rad or m].

    Raises
    ------
    MissingFile, BadData, BadOption
        No result, no such robot, arm or phase; the pose lacks an arm; a number out of range.

    Examples
    --------
    >>> trajectory = wp.retarget("result", "arm.urdf", rate_hz=10.0)
    >>> trajectory
    Trajectory('arm': 29.0 s, 7 joints)
    >>> trajectory.joint_position.shape == (len(trajectory.time), 7)  # [rad]
    True
    """
    check_arguments(retarget, locals())
    motion = load_result(pose) if isinstance(pose, str | Path) else pose
    if isinstance(motion, TrackResult):
        table, motion = table or motion.model.table, select_pose(motion, interval, phase)
    elif (selected := select_interval(motion.time, {}, interval, phase)) is not None:
        motion = motion.cut(find_samples(motion.time, selected))
    stated = {"speed_scale": speed_scale, "limit_margin": limit_margin}
    margins = {name: value for name, value in stated.items() if value is not None}
    if not isinstance(robot, Robot):
        robot = load_robot(str(robot), list_sides(arm), **margins)
    elif arm is not None or margins:
        raise BadOption(
            "arm, speed_scale, limit_margin: a Robot has arms and margins of its own; give `load_robot` them"
        )
    left_out = [name for name in ("position", "orientation") if task not in ("both", name)]
    params = replace(params or ControllerParams(), **dict.fromkeys(left_out, 0.0))
    arm_targets = compute_arm_targets(motion, robot, table=table, scale=scale, smoothing_hz=smoothing_hz)
    return _compute_trajectory(arm_targets, robot, params, 1.0 / rate_hz, progress or (lambda _text, _fraction: None))


def _compute_trajectory(
    arm_targets: ArmTargets, robot: Robot, params: ControllerParams, dt: float, progress: Callable[[str, float], None]
) -> Trajectory:
    """Solve the motion with wide limits, slow it, and solve it with the robot's."""
    collision = CollisionModel(robot)
    step = max(dt, PLAN_STEP_S)
    clock = np.arange(0.0, arm_targets.time[-1] - arm_targets.time[0] + 0.5 * step, step)
    motion = arm_targets.resample(arm_targets.time[0] + clock, clock)
    wide = QpController(robot, collision, step, params, WIDE_LIMIT_FACTOR, guarded=False)
    motion, approach_samples = _prepend_approach(wide, motion)
    run = _run_controller(wide, motion.hands, None, None, partial(progress, STAGES[0]))
    path = gaussian_filter1d(run["joint_position"], PATH_SMOOTHING_S / step, axis=0, mode="nearest")
    slowdown, slowest = _compute_slowdown(path, robot, step, motion, approach_samples)
    # The motion's own time, its samples on the robot's time, and the moments of the motion at the robot's times.
    clock = np.arange(len(path)) * step
    sample_time = _stretch_end(np.concatenate([[0.0], np.cumsum(0.5 * (slowdown[1:] + slowdown[:-1])) * step]))
    robot_time = np.arange(0.0, sample_time[-1] + SETTLE_S + MAX_LAG_S + MAX_STOP_S, dt)
    moments = np.interp(robot_time, sample_time, clock)
    recorded_time = np.interp(moments, clock, motion.time)
    targets = replace(motion, time=clock).resample(moments, robot_time)
    posture = CubicSpline(clock, path)(moments)
    posture_weight = TRACKING_POSTURE_FACTOR * params.posture
    tracking_params = replace(params, posture=posture_weight, posture_gain=TRACKING_POSTURE_GAIN)
    tracking, settle = QpController(robot, collision, dt, tracking_params), int((sample_time[-1] + SETTLE_S) / dt)
    run = _run_controller(tracking, targets.hands, posture, settle, partial(progress, STAGES[1]))
    n = len(run["joint_position"])
    return Trajectory(
        robot=robot,
        params=params,
        scale=arm_targets.scale,
        time=robot_time[:n],
        recorded_time=recorded_time[:n],
        approach_samples=int(np.searchsorted(robot_time, sample_time[approach_samples])),
        targets=tuple(hand.sample(slice(n)) for hand in targets.hands),
        slowest=slowest,
        **run,
    )


def _run_controller(
    controller: QpController,
    hands: tuple[HandTarget, ...],
    posture: np.ndarray | None,
    settle: int | None,
    progress: Callable[[float], None],
) -> dict[str, Any]:
    """Follow the hands from rest, and `posture` (n, joints) where they leave joints free; None: the rest posture.

    From the sample `settle` on the robot comes to rest as soon as it has settled; None: it does not. Return the fields
    of `Trajectory` from `joint_position` to `report`.
    """
    robot, n, dt = controller.robot, len(hands[0].weight), controller.dt
    state, states, poses, reports = JointState.at_rest(robot.rest), [], [], []
    rate = np.gradient(posture, dt, axis=0) if posture is not None else None
    targets = [hand.compute_step_targets(dt) for hand in hands]
    latest, brakes = n - round(MAX_STOP_S / dt), False
    for k in range(n):
        if posture is not None and rate is not None:
            controller.posture_reference = posture[k], rate[min(k + 1, n - 1)]
        brakes |= settle is not None and k >= settle and (k >= latest or np.abs(state.velocity).max() < SETTLED)
        ends = brakes and state.is_static
        states.append(state)
        if brakes:
            state = controller.brake(state)
        else:
            state = controller.step(state, tuple(target.sample(k) for target in targets))
        reports.append(controller.report)
        poses.append(controller.poses)
        if ends:
            break
        if k % PROGRESS_STEPS == 0:
            progress(k / n)
    p_BH, R_BH, elbow = (
        np.array([[pose[key] for pose in arms] for arms in zip(*poses, strict=True)]) for key in range(3)
    )
    shoulders = np.array([arm.shoulder for arm in robot.arms])[:, None]
    position, velocity, acceleration = np.array(states).swapaxes(0, 1)
    run = {"joint_position": position, "joint_velocity": velocity, "joint_acceleration": acceleration}
    run |= {"p_BH": p_BH, "R_BH": R_BH, "swivel": compute_swivel(elbow - shoulders, p_BH - shoulders)}
    return run | {"report": StepReport(*map(np.array, zip(*reports, strict=True)))}


def _prepend_approach(controller: QpController, motion: ArmTargets) -> tuple[ArmTargets, int]:
    """Prepend a smooth approach of each hand from rest; return the motion and the number of samples of the approach."""
    robot, dt, longest = controller.robot, controller.dt, APPROACH_MIN_S
    controller.update_kinematics(robot.rest)
    ends = []
    for pose, path in zip(controller.poses, motion.hands, strict=True):
        first, last = rotations = Rotation.from_matrix(np.stack([pose.rotation, path.rotation[0]]))
        ends.append((pose, rotations))
        distance, angle = np.linalg.norm(path.position[0] - pose.hand), (first.inv() * last).magnitude()
        needed = distance / APPROACH_SPEED, angle / APPROACH_ANGULAR_SPEED
        longest = max(longest, QUINTIC_PEAK_SPEED * float(max(needed)))
    steps = round(longest / dt)
    x = np.minimum(np.arange(steps + round(SETTLE_S / dt)) / steps, 1.0)
    blend = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    count, hands = len(blend), []
    samples = np.maximum(np.arange(count + len(motion.time)) - count, 0)
    for (pose, rotations), hand, arm in zip(ends, motion.hands, robot.arms, strict=True):
        path = hand.sample(samples)
        swivel = compute_swivel(pose.elbow - arm.shoulder, pose.hand - arm.shoulder) if arm.elbow >= 0 else np.zeros(3)
        for values, start in ((path.position, pose.hand), (path.unclamped, pose.hand), (path.swivel, swivel)):
            values[:count] = start + blend[:, None] * (values[count] - start)
        path.rotation[:count] = Slerp([0.0, 1.0], rotations)(blend).as_matrix()
        path.weight[:count], path.lost[:count] = 1.0, False
        hands.append(path.differentiate(np.arange(len(samples)) * dt))
    slowdown = motion.slowdown[samples]
    slowdown[:count] = 1.0
    return replace(motion, time=motion.time[samples], hands=tuple(hands), slowdown=slowdown), count


def _compute_slowdown(
    path: np.ndarray, robot: Robot, dt: float, motion: ArmTargets, approach_samples: int
) -> tuple[np.ndarray, dict[str, Any] | None]:
    """Return the time scaling (n,) ≥ 1 that a joint path (n, joints) needs, and `Trajectory.slowest`."""
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
    slowest = None
    k = approach_samples + int(np.argmax(longest[approach_samples:]))
    if longest[k] > 1.0:
        quantity, j = np.unravel_index(int(np.argmax(needed[:, k])), needed[:, k].shape)
        slowest = {"joint": robot.names[j], "time": float(motion.time[k]), "quantity": QUANTITIES[quantity]}
    slowdown = np.minimum(np.maximum(np.maximum(longest, 1.0), motion.slowdown), MAX_SLOWDOWN)
    width = max(1, round(SLOWDOWN_SPREAD_S / dt))
    wide = maximum_filter1d(slowdown, 2 * width + 1, mode="nearest")
    return np.asarray(gaussian_filter1d(wide, 0.5 * width, mode="nearest")), slowest


def _stretch_end(time: np.ndarray) -> np.ndarray:
    """Return the times (n,) [s] with the last `END_S` stretched, so that its speed falls linearly to zero."""
    phase = np.clip((time - (time[-1] - END_S)) / END_S, 0.0, 1.0)
    return time + END_S * (2.0 * (1.0 - np.sqrt(1.0 - phase)) - phase)
