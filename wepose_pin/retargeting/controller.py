"""One control step: current hand poses, their targets, the next joint velocities by one quadratic programme.

The tasks are those of differential inverse kinematics (hand, elbow swivel, posture, damping). Their unknown is w, the
joint velocity half a step after the next sample if the acceleration a' of that sample stays: w = v + dt (½ a + a').
Over a step the jerk is constant, and a' = (w - v) / dt - ½ a is the law that reaches a given velocity in two steps
without oscillating about it. Every limit on a' is a simple bound (`limits.compute_acceleration_bounds`). Each near pair
of shapes adds a linear constraint. The sums are those of Pink (a test compares them); its simultaneous limits of
acceleration and position become infeasible sooner or later.

A step is taken only if from the state behind it the robot can stop within its limits, and without self-contact. By
induction there is always such a stop: that of the step before (as braking trajectories in "provably safe" motion:
Fraichard and Asama 2004, inevitable collision states).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..arguments import NonNegative
from ..body.kinematics import find_columns
from ..compilation import compiled
from ..errors import WeposeError
from .collision import NEAR, CollisionModel, NearPairs
from .limits import compute_acceleration_bounds, compute_separation_bounds, compute_stop, reduce_acceleration_limits
from .robot import Arm, Robot
from .targets import HandTarget

HAND_POSE_DOF = 6  # an arm with no more joints has no redundancy for a swivel task
HALVINGS = 6  # of the difference between a step that leaves no stop open and the open stop's next one
_MIN_DISTANCE_JACOBIAN = 1e-3  # [m/rad] below it a joint does not change a distance
_DAQP_INFINITY = 1e30  # a bound that daqp ignores
_DAQP_SOFT = 8  # a constraint that may be violated, by as little as possible
_DAQP_SOLVED = (1, 2)  # flags: all constraints kept, or all but soft ones
_NO_JACOBIAN = np.empty((0, 0))
# Places of the parameters of `ControllerParams` in the array that the kernels get.
POSITION, ORIENTATION, SWIVEL, GAIN, DECELERATION, SINGULAR_BELOW, DAMPING, CURVATURE = range(8)
_MIN_SWIVEL = 0.01  # [m] below it the elbow has no swivel direction
_FULL_SWIVEL = 0.05  # [m] above it the swivel task has its full weight
_MAX_SWIVEL_RATE = 3.0  # [rad/s] of its correction
_LEVER = 0.2  # [m] from a joint to the hand, for the curvature of the hand's path


@dataclass(frozen=True)
class ControllerParams:
    """Weights of the squared errors of the tasks, gains, and damping.

    A weight w counts an error e as √w e, against a hand's velocity error of 1 m/s with the weight 1. The first eight
    are those of `_add_arm_tasks`, in its order.
    """

    position: NonNegative = 1.0  # velocity of a hand [m/s]
    orientation: NonNegative = 0.02  # its angular velocity [rad/s]: 1 rad/s counts as 0.14 m/s
    swivel: NonNegative = 0.05  # velocity of the elbow about the line shoulder-hand [m/s]
    task_gain: NonNegative = 12.0  # [1/s] at which errors of hand and elbow are corrected
    max_correction_deceleration: NonNegative = 8.0  # [m/s², rad/s²] by which a correction stops at zero error
    singular_value_limit: NonNegative = 0.06  # [m] of the hand per rad: below it the arm is near singular and damped
    max_damping: NonNegative = 0.05  # at the singularity
    curvature_damping: NonNegative = 1.0  # in proportion to the error, for the curvature of the hand's path; 0: none
    posture: NonNegative = 2e-4  # joint velocity [rad/s] towards the rest posture
    posture_gain: NonNegative = 0.5  # [1/s]
    joint_velocity: NonNegative = 5e-4  # joint velocity [rad/s]
    joint_velocity_change: NonNegative = 2e-3  # change of a joint's velocity step [rad/s] from the last


class ArmPose(NamedTuple):
    """Current pose of one arm of the robot, in B."""

    hand: np.ndarray  # (3,) [m]
    rotation: np.ndarray  # (3, 3) of the hand
    elbow: np.ndarray  # (3,) [m]; NaN for an arm without one


class StepReport(NamedTuple):
    """What determined a step, or many."""

    hull_distance: Any  # (…) [m] between convex hulls; inf where none were near
    stopping: Any  # (…) bool: no step kept all limits and left a stop open, the robot took one of its stop
    limited: Any  # (…, n) bool: the joint was at a bound of its own
    near_contact: Any  # (…, n) bool: the joint must not bring shapes nearer to each other


class JointState(NamedTuple):
    """Positions [rad or m], velocities and accelerations of the joints, (n,) each, as in `Robot.names`."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    @classmethod
    def at_rest(cls, position: np.ndarray) -> JointState:
        return cls(position.copy(), np.zeros(len(position)), np.zeros(len(position)))

    @property
    def is_static(self) -> bool:
        return not (self.velocity.any() or self.acceleration.any())


@dataclass
class QpController:
    """Steps the robot towards its targets, inside its limits."""

    robot: Robot
    collision: CollisionModel  # its pairs of shapes
    dt: float  # [s] of a step
    params: ControllerParams = field(default_factory=ControllerParams)  # weights, gains, damping
    limit_factor: float = 1.0  # widens the limits of velocity, acceleration and jerk
    guarded: bool = True  # takes only steps from which the robot can stop without self-contact
    posture_reference: tuple[np.ndarray, np.ndarray] | None = None  # position and velocity (n,), in place of the rest
    report: StepReport = field(init=False)  # of the last step
    poses: list[ArmPose] = field(init=False)  # of the arms, before it

    def __post_init__(self) -> None:
        try:
            import daqp
        except ImportError:
            raise WeposeError("retargeting needs daqp: pip install daqp") from None
        self._solve, robot = daqp.solve, self.robot
        self.data: Any = robot.model.createData()
        n = len(robot.names)
        v_max, a_max, j_max = (self.limit_factor * limit for limit in (robot.v_max, robot.a_max, robot.j_max))
        a_max = reduce_acceleration_limits(a_max, v_max, j_max, robot.upper - robot.lower, self.dt)
        self._limits = (robot.lower, robot.upper, v_max, a_max, j_max)
        self._bounds = np.empty(n), np.empty(n)  # of the acceleration at the end of the step
        self._task_params = np.array(astuple(self.params)[:8])
        self._arms = [_ArmTasks(robot, arm, self.data) for arm in robot.arms]
        self._stop = np.empty((0, 3, n))  # that the last step leaves open: the states up to rest
        self._limited, self._active_rows = np.zeros(n, dtype=bool), np.empty((0, n))  # of the last programme

    def update_kinematics(self, position: np.ndarray) -> None:
        """Set the joint positions (n,); compute Jacobians and `poses`."""
        pin.computeJointJacobians(self.robot.model, self.data, self.robot.configuration(position))
        self.poses = [arm.update_pose() for arm in self._arms]

    def step(self, state: JointState, targets: tuple[HandTarget, ...]) -> JointState:
        """Solve one step towards `targets` and return the next state; update `report`.

        Where no step keeps all limits and leaves a stop open, it is one of the stop that the step before has left open.
        """
        params, dt, n = self.params, self.dt, len(self.robot.names)
        self.update_kinematics(state.position)
        near = self.collision.find_near_pairs(self.data)
        H, f = np.zeros((n, n)), np.zeros(n)
        for arm, target in zip(self._arms, targets, strict=True):
            arm.add_to_objective(H, f, target, self._task_params, dt, state.velocity)
        posture, posture_rate = self.posture_reference or (self.robot.rest, np.zeros(n))
        velocity_mid = state.velocity + 0.5 * dt * state.acceleration  # half a step on, already determined
        H.flat[:: n + 1] += params.posture + params.joint_velocity + params.joint_velocity_change
        f += params.posture * (params.posture_gain * (posture - state.position) + posture_rate)
        f += params.joint_velocity_change * (velocity_mid + dt * state.acceleration)
        compute_acceleration_bounds(*state, *self._limits, dt, *self._bounds)
        w_min, w_max = (velocity_mid + dt * bound for bound in self._bounds)
        bound = compute_separation_bounds(
            near.jacobian, near.distance, near.clearance, state.velocity, state.acceleration, *self._bounds,
            *self._limits[3:], dt,
        )  # fmt: skip
        w = self._solve_qp(H, f, near.jacobian, bound, w_min, w_max)
        after = None
        if w is not None or not self.guarded:
            w = np.clip(0.0 if w is None else w, w_min, w_max)
            after = integrate(state, np.clip((w - velocity_mid) / dt, *self._bounds), dt)
        if self.guarded:
            after = self._find_guarded_step(state, after, near)
        self._report_step(near, stopping=after is None)
        return self._take_stop(state) if after is None else after

    def brake(self, state: JointState) -> JointState:
        """Return the state one step later, on the stop that the last step has left open; at rest it stays."""
        self.update_kinematics(state.position)
        self._limited, self._active_rows = np.zeros_like(self._limited), self._active_rows[:0]
        self._report_step(self.collision.find_near_pairs(self.data), stopping=False)
        return self._take_stop(state)

    def _solve_qp(
        self, H: np.ndarray, f: np.ndarray, rows: np.ndarray, bound: np.ndarray, w_min: np.ndarray, w_max: np.ndarray
    ) -> np.ndarray | None:
        """Return w (n,) within `w_min` and `w_max` and with rows @ w ≥ `bound` (m,); None: there is none.

        Where these exclude each other they are violated by as little as possible; whether a stop is open is checked.
        """
        n = len(w_max)
        upper = np.concatenate([w_max, np.full(len(rows), _DAQP_INFINITY)])
        lower = np.concatenate([w_min, bound])
        sense = np.zeros(len(upper), dtype=np.int32)
        w, _, flag, info = self._solve(H, -f, rows, upper, lower, sense)
        if flag not in _DAQP_SOLVED:
            sense[n:] = _DAQP_SOFT
            w, _, flag, info = self._solve(H, -f, rows, upper, lower, sense)
        if flag not in _DAQP_SOLVED or not np.isfinite(w).all():
            return None
        active = info["lam"] != 0.0
        self._limited, self._active_rows = active[:n], rows[active[n:]]
        return np.asarray(w)

    def _find_guarded_step(self, state: JointState, after: JointState | None, near: NearPairs) -> JointState | None:
        """Return the step, or one between it and the open stop's next, that leaves a stop open; None: none does."""
        braking = self._find_next_of_stop(state).acceleration
        for _ in range(1 + HALVINGS if after is not None else 0):
            if self._leaves_stop_open(state, after, near):  # type: ignore[arg-type]
                return after
            after = integrate(state, 0.5 * (after.acceleration + braking), self.dt)  # type: ignore[union-attr]
        return None

    def _leaves_stop_open(self, state: JointState, after: JointState, near: NearPairs) -> bool:
        """Return whether the robot can stop from the state `after` without self-contact, and remember how."""
        stop, travel = compute_stop(*after, *self._limits, self.dt)
        if stop[-1, 1:].any():
            return False
        distance = np.full(len(self.collision.pairs), NEAR)
        distance[near.pairs] = near.distance
        faster = np.maximum(np.abs(state.velocity), np.abs(after.velocity))
        travel[1:] = travel[:-1]  # up to each state, in place of after it
        travel[0] = self.dt * (faster + 0.125 * self.dt * np.abs(after.acceleration - state.acceleration))
        clear = self.collision.is_path_clear(distance, stop[:, 0], travel)
        if clear:
            self._stop = stop[1:]
        return clear

    def _find_next_of_stop(self, state: JointState) -> JointState:
        """Return the next state of the stop that the last step has left open; at rest where it is over."""
        return JointState(*self._stop[0]) if len(self._stop) else JointState.at_rest(state.position)

    def _take_stop(self, state: JointState) -> JointState:
        after, self._stop = self._find_next_of_stop(state), self._stop[1:]
        return after

    def _report_step(self, near: NearPairs, stopping: bool) -> None:
        moved = (np.abs(self._active_rows) > _MIN_DISTANCE_JACOBIAN).any(axis=0) | stopping
        distance = float(np.min(near.distance, initial=np.inf))
        self.report = StepReport(distance, stopping, self._limited & (not stopping), moved)


def integrate(state: JointState, acceleration: np.ndarray, dt: float) -> JointState:
    """Return the state one step later, with this acceleration there and a constant jerk between."""
    velocity = state.velocity + 0.5 * dt * (state.acceleration + acceleration)
    position = state.position + dt * (state.velocity + dt * (state.acceleration / 3.0 + acceleration / 6.0))
    return JointState(position, velocity, acceleration)


class _ArmTasks:
    """One arm's part of the programme; views into Pinocchio's memory are created once."""

    def __init__(self, robot: Robot, arm: Arm, data: Any) -> None:
        self.arm, self._data = arm, data
        self._frames = [self._view(robot, frame) for frame in (arm.hand, arm.elbow) if frame >= 0]
        self._has_swivel = len(self._frames) == 2 and len(arm.joints) > HAND_POSE_DOF
        self.pose = ArmPose(np.zeros(3), np.eye(3), np.full(3, np.nan))

    def _view(self, robot: Robot, index: int) -> tuple[Any, Any, Any, Any, np.ndarray]:
        """Return a frame's placement on its joint, that of the joint, and a mask (nv,) of the joints that move it."""
        frame, mask = robot.model.frames[index], np.zeros(robot.model.nv)
        on_joint, of_joint = frame.placement, self._data.oMi[frame.parentJoint]
        mask[find_columns(robot.model, robot.model.supports[frame.parentJoint].tolist()[1:])] = 1.0
        return on_joint.rotation.copy(), on_joint.translation.copy(), of_joint.rotation, of_joint.translation, mask

    def update_pose(self) -> ArmPose:
        """Take the pose from Pinocchio's data."""
        R_JH, *_ = self._frames[0]
        points = [R_J @ p_JF + p_J for _, p_JF, R_J, p_J, _ in self._frames]
        elbow = points[1] if len(points) == 2 else np.full(3, np.nan)
        self.pose = ArmPose(points[0], self._frames[0][2] @ R_JH, elbow)
        return self.pose

    def add_to_objective(
        self, H: np.ndarray, f: np.ndarray, target: HandTarget, params: np.ndarray, dt: float, v: np.ndarray
    ) -> None:
        """Add the arm's tasks to H and f."""
        J = np.ascontiguousarray(self._data.J)
        J_hand = J * self._frames[0][4]
        J_elbow = J * self._frames[1][4] if self._has_swivel else _NO_JACOBIAN
        rotation_error = pin.log3(target.rotation @ self.pose.rotation.T)
        _add_arm_tasks(
            H, f, J_hand, J_elbow, self.pose.hand, self.pose.elbow, self.arm.shoulder, rotation_error,
            target.position, target.velocity, target.angular_velocity, target.swivel, float(target.weight), v, dt,
            params, self.arm.joints,
        )  # fmt: skip


@compiled
def _add_arm_tasks(  # type: ignore[no-untyped-def]
    H, f, J_hand, J_elbow, hand, elbow, shoulder, rotation_error, position, velocity, angular_velocity, swivel, weight,
    v, dt, tasks, joints,
):  # fmt: skip
    """Add one arm's tasks to ½ wᵀ H w − fᵀ w.

    Parameters
    ----------
    H, f : (n, n), (n,), changed in place
    J_hand, J_elbow : (6, n) of what the hand's, the elbow's joint carries, at the origin of B: linear [m/s] over
        angular [rad/s]; `J_elbow` is (0, 0) for an arm without a swivel task
    hand, elbow, shoulder : (3,) [m] in B
    rotation_error : (3,) [rad] from the hand's orientation to its target
    position, velocity, angular_velocity, swivel, weight : of `HandTarget`
    v : (n,) joint velocities
    joints : (k,) of the arm
    """
    linear, angular = _compute_point_jacobian(J_hand, hand), J_hand[3:]
    # Half of the coming step is already decided.
    distance, rotation = position - hand - 0.5 * dt * (linear @ v), rotation_error - 0.5 * dt * (angular @ v)
    weight_p, weight_R = tasks[POSITION] * weight, tasks[ORIENTATION] * weight
    H += weight_p * (linear.T @ linear) + weight_R * (angular.T @ angular)
    f += weight_p * (linear.T @ _correct_error(distance, velocity, tasks))
    f += weight_R * (angular.T @ _correct_error(rotation, angular_velocity, tasks))
    if J_elbow.shape[0]:
        _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks)
    # The derivative of the Jacobian in the Hessian: where an arm is straight and its target farther away, the only term
    # that keeps the elbow from swinging through (Levenberg; Sugihara 2011 weighs it by the error too).
    curvature = weight_p * _LEVER * np.sqrt(distance @ distance) + weight_R * np.sqrt(rotation @ rotation)
    for j in joints:
        H[j, j] += tasks[CURVATURE] * curvature
    least = np.sqrt(max(np.linalg.eigvalsh(linear @ linear.T)[0], 0.0))
    if least >= tasks[SINGULAR_BELOW]:
        return
    damping = tasks[DAMPING] * (1.0 - least / tasks[SINGULAR_BELOW]) ** 2  # Nakamura and Hanafusa 1986
    for j in joints:
        H[j, j] += damping
        f[j] += 0.9 * damping * v[j]


@compiled
def _compute_point_jacobian(J, p):  # type: ignore[no-untyped-def]
    """Linear Jacobian (3, n) of the point `p` (3,) of a body, from `J` (6, n) at the origin."""
    linear = J[:3].copy()
    linear[0] += J[4] * p[2] - J[5] * p[1]
    linear[1] += J[5] * p[0] - J[3] * p[2]
    linear[2] += J[3] * p[1] - J[4] * p[0]
    return linear


@compiled
def _correct_error(error, feedforward, tasks):  # type: ignore[no-untyped-def]
    """Velocity (3,): the feedforward, and a correction that `DECELERATION` can stop within the error."""
    size, gain = np.sqrt(error @ error), tasks[GAIN]
    if size > 0.0:
        gain = min(gain, np.sqrt(2.0 * tasks[DECELERATION] / size))
    return feedforward + gain * error


@compiled
def _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks):  # type: ignore[no-untyped-def]
    """Rotate the elbow about the line shoulder-hand to the person's; the task fades where either arm is straight."""
    offset, upper = hand - shoulder, elbow - shoulder
    far = np.sqrt(offset @ offset)
    if far < _FULL_SWIVEL:
        return
    axis = offset / far
    along = upper @ axis
    own, target = upper - along * axis, swivel - (swivel @ axis) * axis
    radius, size = np.sqrt(own @ own), np.sqrt(target @ target)
    if radius < _MIN_SWIVEL or size < _MIN_SWIVEL:
        return
    tangent = np.cross(axis, own) / radius
    angle = np.arctan2(target @ tangent, target @ own / radius)
    rate = min(max(0.5 * tasks[GAIN] * angle, -_MAX_SWIVEL_RATE), _MAX_SWIVEL_RATE)
    w = tasks[SWIVEL] * weight * min(1.0, size / _FULL_SWIVEL) * min(1.0, radius / _FULL_SWIVEL)
    row = tangent @ (_compute_point_jacobian(J_elbow, elbow) - along / far * linear)
    H += w * np.outer(row, row)
    f += w * radius * rate * row
