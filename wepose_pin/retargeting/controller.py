"""One control step: current hand poses, their targets, the next joint velocities by one quadratic programme.

The tasks are those of differential inverse kinematics (hand, elbow swivel, posture, damping). Their unknown is w, the
joint velocity half a step after the next sample if the acceleration a' of that sample stays: w = v + dt (½ a + a').
Over a step the jerk is constant, and a' = (w - v) / dt - ½ a is the law that reaches a given velocity in two steps
without oscillating about it. Every limit on a' is a simple bound (`limits.compute_acceleration_bounds`). Each near pair
of shapes adds a linear constraint. The sums are those of Pink (a test compares them); its simultaneous limits of
acceleration and position become infeasible sooner or later.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..arguments import NonNegative
from ..errors import WeposeError, how_to_install
from .collision import NEAR, CollisionModel, NearPairs
from .limits import compute_acceleration_bounds, compute_separation_bounds, reduce_acceleration_limits
from .objective import add_arm_tasks
from .robot import Arm, Robot
from .stopping import Stop, StopCheck, balance_braking, compute_stop
from .targets import HandPath

HAND_POSE_DOF = 6  # an arm with no more joints has no redundancy for a swivel task
MAX_BRAKE_SHARE = 0.9  # of the range of joint velocities in a step, used at most to keep two shapes apart
# Where a step leaves no stop open, it is solved again with larger clearances: by this share of what a pair lacks along
# the stop and by that distance for all pairs, both so many times more from one attempt to the next.
MAX_RAISES, RAISE_SHARE, MIN_RAISE_M, RAISE_GROWTH = 8, 1.5, 1e-4, 3.0
HALVINGS = 4  # of the difference between that step and the open stop's next one, where no clearance helps
NEAR_CLEARANCE_M = 0.01  # [m] to the clearance: pairs nearer than that are counted
_MIN_DISTANCE_JACOBIAN = 1e-3  # [m/rad] below it a joint does not change a distance
_DAQP_INFINITY = 1e30  # a bound that daqp ignores
_DAQP_SOFT = 8  # a constraint that may be violated, by as little as possible
_DAQP_SOLVED = (1, 2)  # flags: all constraints kept, or all but soft ones
_NO_JACOBIAN = np.empty((0, 0))


@dataclass(frozen=True)
class ControllerParams:
    """Weights of the squared errors of the tasks, gains, and damping.

    A weight w counts an error e as √w e, against a hand's velocity error of 1 m/s with the weight 1.
    """

    position: NonNegative = 1.0  # velocity of a hand [m/s]
    orientation: NonNegative = 0.02  # its angular velocity [rad/s]: 1 rad/s counts as 0.14 m/s
    swivel: NonNegative = 0.05  # velocity of the elbow about the line shoulder-hand [m/s]
    posture: NonNegative = 2e-4  # joint velocity [rad/s] towards the rest posture
    joint_velocity: NonNegative = 5e-4  # joint velocity [rad/s]
    joint_velocity_change: NonNegative = 2e-3  # change of a joint's velocity step [rad/s] from the last
    task_gain: NonNegative = 12.0  # [1/s] at which errors of hand and elbow are corrected
    posture_gain: NonNegative = 0.5  # [1/s]
    max_correction_deceleration: NonNegative = 8.0  # [m/s², rad/s²] by which a correction stops at zero error
    singular_value_limit: NonNegative = 0.06  # [m] of the hand per rad: below it the arm is near singular and damped
    max_damping: NonNegative = 0.05  # at the singularity
    curvature_damping: NonNegative = 1.0  # in proportion to the error, for the curvature of the hand's path; 0: none


class HandTarget(NamedTuple):
    """Target of one hand at one moment; fields as in `HandPath`."""

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    angular_velocity: np.ndarray
    swivel: np.ndarray
    weight: float


class ArmPose(NamedTuple):
    """Current pose of one arm of the robot, in B."""

    hand: np.ndarray  # (3,) [m]
    rotation: np.ndarray  # (3, 3) of the hand
    elbow: np.ndarray  # (3,) [m]; NaN for an arm without one


class ActiveConstraints(NamedTuple):
    """Constraints that were active in a step, or in many."""

    joints: np.ndarray  # (…, n) bool: a joint at a bound of its own
    arms_near_contact: np.ndarray  # (…, arms) bool: an arm that must not approach another shape


@dataclass
class StepCounts:
    """Number of steps: all, and those to which a condition applies."""

    steps: int = 0
    singular: int = 0  # arms near a singularity
    near_clearance: int = 0  # a pair of shapes near its clearance
    stopping: int = 0  # no step keeps all limits and clearances and leaves a stop open: the robot brakes


@dataclass
class JointState:
    """Positions [rad or m], velocities and accelerations of the independent joints, (n,) each, as in `Robot.names`."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    @classmethod
    def at_rest(cls, position: np.ndarray) -> JointState:
        return cls(position.copy(), np.zeros(len(position)), np.zeros(len(position)))


class PostureReference(NamedTuple):
    """Posture that joints tend to which the hands leave free."""

    position: np.ndarray  # (n,) [rad or m]
    velocity: np.ndarray | float  # (n,) [rad/s or m/s]; 0.0: at rest


@dataclass
class QpController:
    """Steps the robot towards its targets, inside its limits.

    Parameters
    ----------
    robot, collision : the robot and its pairs of shapes
    dt : [s] of a step
    params : weights, gains, damping
    limit_factor : widens the limits of velocity, acceleration and jerk
    guarded : takes only steps from which the robot can stop without self-contact; a search for postures needs none
    counts : of the steps so far
    stopping : whether the last step was one of braking, since there was no other
    posture_reference : replaces the rest posture
    pace : of the corrections of errors, above 0; 0.5: as slow as if time ran half as fast
    min_distance : [m] between hulls in the last step; inf where none were near
    nearest_pair : of `CollisionModel.pairs`, to which it belongs; -1 where none were near
    active : constraints of the last step
    """

    robot: Robot
    collision: CollisionModel
    dt: float
    params: ControllerParams = field(default_factory=ControllerParams)
    limit_factor: float = 1.0
    guarded: bool = True
    counts: StepCounts = field(default_factory=StepCounts)
    posture_reference: PostureReference | None = None
    pace: float = 1.0
    min_distance: float = np.inf
    nearest_pair: int = -1
    stopping: bool = False
    active: ActiveConstraints = field(init=False)

    def __post_init__(self) -> None:
        try:
            import daqp
        except ImportError:
            raise WeposeError(f"retargeting needs daqp: {how_to_install('daqp')}") from None
        self._solve = daqp.solve
        robot = self.robot
        self.data: Any = robot.model.createData()
        n = len(robot.names)
        self._min_accel, self._max_accel = np.empty(n), np.empty(n)
        v_max, a_max, j_max = (self.limit_factor * limit for limit in (robot.v_max, robot.a_max, robot.j_max))
        a_max = reduce_acceleration_limits(a_max, v_max, j_max, robot.upper - robot.lower, self.dt)
        self._limits = (v_max, a_max, j_max)
        self.active = ActiveConstraints(np.zeros(n, dtype=bool), np.zeros(len(robot.arms), dtype=bool))
        self._arms = [_ArmTasks(robot, arm, self.data) for arm in robot.arms]
        self._stop_check = StopCheck(robot, self.collision)
        self._stop: Stop | None = None  # that the last step leaves open
        self._stop_steps = 0  # of it that were taken

    def update_kinematics(self, position: np.ndarray) -> None:
        """Set the joint positions (n,), and compute Jacobians and the poses that `get_arm_pose` returns."""
        pin.computeJointJacobians(self.robot.model, self.data, self.robot.configuration(position))
        for arm in self._arms:
            arm.update_pose()

    def get_arm_pose(self, arm: int) -> ArmPose:
        """Return a copy of an arm's pose at the positions of `update_kinematics`."""
        tasks = self._arms[arm]
        return ArmPose(tasks.hand.copy(), tasks.rotation.copy(), tasks.elbow.copy())

    def step(self, state: JointState, targets: tuple[HandTarget, ...]) -> JointState:
        """Solve one step towards `targets` and return the next state; update `counts`, `min_distance` and `active`.

        Where no step keeps all limits and clearances and leaves a stop open, it is one of the stop that the step before
        has left open.
        """
        robot, params, dt, n = self.robot, self.params, self.dt, len(self.robot.names)
        self.counts.steps += 1
        near = self._update_distances(state)
        self.counts.near_clearance += bool((near.distance - near.clearance < NEAR_CLEARANCE_M).any())
        H, f = np.zeros((n, n)), np.zeros(n)
        weights = self._weigh_tasks()
        for arm, target in zip(self._arms, targets, strict=True):
            self.counts.singular += arm.add_to_objective(H, f, target, weights, dt, state.velocity)
        velocity_mid = _predict_mid_velocity(state, dt)
        H.flat[:: n + 1] += params.posture + params.joint_velocity + params.joint_velocity_change
        reference = self.posture_reference or PostureReference(robot.rest, 0.0)
        f += params.posture * (
            self.pace * params.posture_gain * (reference.position - state.position) + reference.velocity
        )
        f += params.joint_velocity_change * (velocity_mid + dt * state.acceleration)
        compute_acceleration_bounds(
            state.position, state.velocity, state.acceleration, robot.lower, robot.upper, *self._limits, dt,
            self._min_accel, self._max_accel,
        )  # fmt: skip
        after = self._solve_step(state, near, H, f)
        self.stopping = after is None
        if after is not None:
            return after
        self.counts.stopping += 1
        self.active.joints[:] = False
        self.active.arms_near_contact[:] = True
        return self._take_stop(state)

    def _weigh_tasks(self) -> np.ndarray:
        """Return weights, gains and damping as `add_arm_tasks` takes them."""
        p = self.params
        gain, deceleration = self.pace * p.task_gain, self.pace**2 * p.max_correction_deceleration
        weights = p.position, p.orientation, p.swivel
        return np.array([*weights, gain, deceleration, p.singular_value_limit, p.max_damping, p.curvature_damping])

    def _solve_step(self, state: JointState, near: NearPairs, H: np.ndarray, f: np.ndarray) -> JointState | None:
        """Return the next state, within all limits, that leaves a stop open; None: none was found.

        A solution that leaves no stop open is sought again with larger clearances, up to `MAX_RAISES` times, and then
        between the last one and the next step of the stop that is open, which keeps all limits.
        """
        velocity_mid = _predict_mid_velocity(state, self.dt)
        w_min, w_max = (velocity_mid + self.dt * limit for limit in (self._min_accel, self._max_accel))
        is_static = not (state.velocity.any() or state.acceleration.any())
        brake_share = MAX_BRAKE_SHARE
        for attempt in range(1 + MAX_RAISES):
            rows, bound = self._constrain_distances(state, near)
            # What joints cannot brake is not asked for; at rest it is enough not to approach.
            most = np.where(rows > 0.0, rows * w_max, rows * w_min).sum(axis=1)
            bound = np.minimum(bound, most - (1.0 - brake_share) * np.abs(rows) @ (w_max - w_min))
            if is_static:
                bound = np.minimum(bound, 0.0)
            w = self._solve_qp(H, f, rows, bound, w_min, w_max)
            if w is None and self.guarded:
                return None
            w = np.clip(0.0 if w is None else w, w_min, w_max)
            after = integrate(state, np.clip((w - velocity_mid) / self.dt, self._min_accel, self._max_accel), self.dt)
            shortfall = self._find_stop(state, after, near) if self.guarded else None
            if shortfall is None:
                return after
            more = RAISE_GROWTH**attempt * (RAISE_SHARE * shortfall[near.pairs] + MIN_RAISE_M)
            near, brake_share = near._replace(clearance=near.clearance + more), 1.0
        braking = self._find_next_of_stop(state).acceleration
        for _ in range(HALVINGS):
            after = integrate(state, 0.5 * (after.acceleration + braking), self.dt)
            if self._find_stop(state, after, near) is None:
                return after
        return None

    def brake(self, state: JointState) -> JointState:
        """Return the state one step later, on the stop that the last step has left open; at rest it stays."""
        self._update_distances(state)
        self.stopping = False
        return self._take_stop(state)

    def _take_stop(self, state: JointState) -> JointState:
        after = self._find_next_of_stop(state)
        self._stop_steps += 1
        return after

    def _find_next_of_stop(self, state: JointState) -> JointState:
        """Return the next state of the stop that the last step has left open; at rest where it is over."""
        k = self._stop_steps
        if self._stop is None or k >= len(self._stop.position):
            return JointState.at_rest(state.position)
        return JointState(self._stop.position[k], self._stop.velocity[k], self._stop.acceleration[k])

    def _find_stop(self, state: JointState, after: JointState, near: NearPairs) -> np.ndarray | None:
        """Return None where the robot can stop from the state `after` without self-contact, and remember how.

        Else how far (pairs,) [m] pairs would come below their least distance. First each joint brakes as hard as it
        can, then so that all come to rest together: the hands stay closer to their path.
        """
        robot, (v_max, a_max, j_max) = self.robot, self._limits
        distance = np.full(len(self.collision.pairs), NEAR)
        distance[near.pairs] = near.distance
        faster = np.maximum(np.abs(state.velocity), np.abs(after.velocity))
        travel = self.dt * (faster + 0.125 * self.dt * np.abs(after.acceleration - state.acceleration))
        shortfall = np.zeros(len(distance))
        for together in (False, True):
            braking = balance_braking(after.velocity, a_max) if together else a_max
            stop = Stop(
                *compute_stop(
                    after.position, after.velocity, after.acceleration, robot.lower, robot.upper, v_max, a_max, j_max,
                    braking, self.dt,
                )
            )  # fmt: skip
            if not stop.ends_at_rest:
                continue
            path = np.vstack([after.position, stop.position])
            violation = self._stop_check.find_shortfall(distance, path, np.vstack([travel, stop.travel]))
            if violation is None:
                self._stop, self._stop_steps = stop, 0
                return None
            shortfall = np.maximum(shortfall, violation)
        return shortfall

    def _update_distances(self, state: JointState) -> NearPairs:
        """Set the joint positions, and return the pairs that are near; update `min_distance`."""
        self.update_kinematics(state.position)
        near = self.collision.find_near_pairs(self.data)
        self.min_distance, self.nearest_pair = np.inf, -1
        if len(near.distance):
            k = int(np.argmin(near.distance))
            self.min_distance, self.nearest_pair = float(near.distance[k]), int(near.pairs[k])
        return near

    def _constrain_distances(self, state: JointState, near: NearPairs) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (m, n) and bound (m,) of rows @ w ≥ bound: near shapes approach no faster than they can stop."""
        rows = near.jacobian @ self.robot.coupling
        _, a_max, j_max = self._limits
        bound = compute_separation_bounds(
            rows, near.distance, near.clearance, state.velocity, state.acceleration, a_max, j_max, self.dt
        )  # fmt: skip
        return rows, bound

    def _solve_qp(
        self, H: np.ndarray, f: np.ndarray, rows: np.ndarray, bound: np.ndarray, w_min: np.ndarray, w_max: np.ndarray
    ) -> np.ndarray | None:
        """Return w (n,) within `w_min` and `w_max` that keeps the constraints of the distances; None: there is none.

        Where these exclude each other they are violated by as little as possible; whether a stop is open is checked.
        """
        n = len(w_max)
        upper = np.concatenate([w_max, np.full(len(rows), _DAQP_INFINITY)])
        lower = np.concatenate([w_min, bound])
        sense = np.zeros(len(upper), dtype=np.int32)
        rows = np.ascontiguousarray(rows)
        w, _, flag, info = self._solve(H, -f, rows, upper, lower, sense)
        if flag not in _DAQP_SOLVED:
            sense[n:] = _DAQP_SOFT
            w, _, flag, info = self._solve(H, -f, rows, upper, lower, sense)
        if flag not in _DAQP_SOLVED or not np.isfinite(w).all():
            return None
        active = info["lam"] != 0.0
        self.active.joints[:] = active[:n]
        active_rows = rows[active[n:]]
        for i, arm in enumerate(self.robot.arms):
            part = np.abs(active_rows[:, arm.joints]) > _MIN_DISTANCE_JACOBIAN
            self.active.arms_near_contact[i] = len(active_rows) > 0 and bool(part.any())
        return np.asarray(w)


def integrate(state: JointState, acceleration: np.ndarray, dt: float) -> JointState:
    """Return the state one step later, with this acceleration there and a constant jerk between."""
    velocity = state.velocity + 0.5 * dt * (state.acceleration + acceleration)
    position = state.position + dt * (state.velocity + dt * (state.acceleration / 3.0 + acceleration / 6.0))
    return JointState(position, velocity, acceleration)


def _predict_mid_velocity(state: JointState, dt: float) -> np.ndarray:
    """Return the joint velocities half a step on, which the accelerations so far determine."""
    return state.velocity + 0.5 * dt * state.acceleration


class _ArmTasks:
    """One arm's part of the programme; views into Pinocchio's memory are created once."""

    def __init__(self, robot: Robot, arm: Arm, data: Any) -> None:
        self.arm, self.robot, self.data = arm, robot, data
        frame = robot.model.frames[arm.hand]
        self._R_JH, self._p_JH = frame.placement.rotation.copy(), frame.placement.translation.copy()
        placement = data.oMi[frame.parentJoint]
        self._R_J, self._p_J = placement.rotation, placement.translation
        self._has_elbow = arm.elbow >= 0
        self._has_swivel = self._has_elbow and len(arm.joints) > HAND_POSE_DOF
        if self._has_elbow:
            elbow = robot.model.frames[arm.elbow]
            self._p_JE = elbow.placement.translation.copy()
            placement = data.oMi[elbow.parentJoint]
            self._R_E, self._p_E = placement.rotation, placement.translation
            self._moves_elbow = _build_ancestor_mask(robot, elbow.parentJoint)
        self._moves_hand = _build_ancestor_mask(robot, frame.parentJoint)
        self.hand, self.rotation, self.elbow = np.zeros(3), np.eye(3), np.full(3, np.nan)

    def update_pose(self) -> None:
        """Take the pose from Pinocchio's data."""
        self.rotation = self._R_J @ self._R_JH
        self.hand = self._R_J @ self._p_JH + self._p_J
        if self._has_elbow:
            self.elbow = self._R_E @ self._p_JE + self._p_E

    def add_to_objective(
        self, H: np.ndarray, f: np.ndarray, target: HandTarget, params: np.ndarray, dt: float, v: np.ndarray
    ) -> bool:
        """Add the arm's tasks to H and f; return whether the arm is near a singularity."""
        J_hand = self.data.J * self._moves_hand @ self.robot.coupling
        J_elbow = self.data.J * self._moves_elbow @ self.robot.coupling if self._has_swivel else _NO_JACOBIAN
        rotation_error = pin.log3(target.rotation @ self.rotation.T)
        return bool(
            add_arm_tasks(
                H, f, J_hand, J_elbow, self.hand, self.elbow, self.arm.shoulder, rotation_error, target.position,
                target.velocity, target.angular_velocity, target.swivel, target.weight, v, dt, params,
                self.arm.joints,
            )
        )  # fmt: skip


def sample_hand_targets(hands: tuple[HandPath, ...], k: int, dt: float) -> tuple[HandTarget, ...]:
    """Return the targets of the step from sample `k`: positions in its middle, velocities half a step after its end."""
    n = min(k + 1, len(hands[0].weight) - 1)
    after = min(k + 2, len(hands[0].weight) - 1)
    return tuple(
        HandTarget(
            hand.position[k] + 0.5 * dt * hand.velocity[k],
            0.5 * (hand.velocity[n] + hand.velocity[after]),
            hand.rotation[k],
            0.5 * (hand.angular_velocity[n] + hand.angular_velocity[after]),
            hand.swivel[k],
            float(hand.weight[k]),
        )
        for hand in hands
    )


def _build_ancestor_mask(robot: Robot, joint: int) -> np.ndarray:
    """Return a mask (nv,): 1 for `joint` and each joint of the model between it and the root."""
    mask = np.zeros(robot.model.nv)
    while joint > 0:
        mask[robot.model.idx_vs[joint]] = 1.0
        joint = robot.model.parents[joint]
    return mask
