"""One control step: current hand poses, their targets, the next joint velocities by one quadratic programme.

The tasks are those of differential inverse kinematics (hand, elbow swivel, posture, damping), written for the joint
velocity w half a step after the coming sample, if the acceleration a' at that sample stays: w = v + dt (½ a + a').
Over a step the jerk is constant, and a' = (w - v) / dt - ½ a is the law that reaches a given velocity in two steps
without oscillating about it. Every limit on a' is a simple bound (`limits.compute_acceleration_bounds`). Each near pair
of shapes adds a linear constraint. The sums are those of Pink (a test compares them), whose limits on acceleration and
position together make its programme infeasible sooner or later.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..arguments import NonNegative
from ..errors import WeposeError
from .collision import CollisionModel
from .limits import compute_acceleration_bounds, compute_separation_bounds, reduce_acceleration_limits
from .objective import add_arm_tasks
from .robot import Arm, Robot
from .targets import HandPath

HAND_JOINTS = 6  # joints that the hand's pose needs: with no more, a swivel task would pull the hand away
HALT_GAIN = 30.0  # [1/s] at which the last of a velocity fades
_MIN_LEVER = 1e-3  # [m/rad] below which a joint has no part in a distance
_SOFT = 8  # daqp's flag for a soft constraint
_NO_JACOBIAN = np.empty((0, 0))


@dataclass(frozen=True)
class Tasks:
    """Weights of the tasks against 1 m/s of the hand, and gains at which errors are corrected."""

    position: NonNegative = 1.0  # velocity of a hand [m/s]
    orientation: NonNegative = 0.02  # its angular velocity [rad/s]: 1 rad/s counts as 0.14 m/s
    swivel: NonNegative = 0.05  # velocity of the elbow about the line shoulder-hand [m/s]
    posture: NonNegative = 2e-4  # joint velocity [rad/s] towards the rest posture
    joint_velocity: NonNegative = 5e-4  # joint velocity [rad/s]
    joint_acceleration: NonNegative = 2e-3  # change of a joint's velocity step [rad/s] from the last
    gain: NonNegative = 12.0  # [1/s] of hand and elbow
    posture_gain: NonNegative = 0.5  # [1/s]
    deceleration: NonNegative = 8.0  # [m/s², rad/s²] that a correction may need to stop within its error
    singular_below: NonNegative = 0.06  # [m] of the hand per rad/s: below it the arm is near singular and damped
    damping: NonNegative = 0.05  # largest, at the singularity
    curvature: NonNegative = 1.0  # damping by the error, for the curvature of the hand's path; 0: none


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
    shapes: np.ndarray  # (…, arms) bool: an arm that must not approach another shape


@dataclass
class StepCounts:
    """Number of steps, and of those with a property."""

    steps: int = 0
    singular: int = 0  # arms near a singularity
    near: int = 0  # shapes near their clearance
    infeasible: int = 0  # the programme had no solution: only the joints' limits were kept


@dataclass
class JointState:
    """Values [rad or m], velocities and accelerations of the joints, (n,) each."""

    u: np.ndarray
    v: np.ndarray
    a: np.ndarray

    @classmethod
    def at_rest(cls, u: np.ndarray) -> JointState:
        return cls(u.copy(), np.zeros(len(u)), np.zeros(len(u)))


@dataclass
class QpController:
    """Steps the robot towards its targets, inside its limits.

    Parameters
    ----------
    dt : [s] of a step
    limit_factor : widens the limits of velocity, acceleration and jerk
    posture : posture (n,) and its velocity (n,) in place of the rest posture
    min_distance : [m] between hulls in the last step; inf where none were near
    clearance_share : smallest share of its clearance that a pair had in the last step
    active : constraints of the last step
    """

    robot: Robot
    collision: CollisionModel
    dt: float
    tasks: Tasks = field(default_factory=Tasks)
    limit_factor: float = 1.0
    counts: StepCounts = field(default_factory=StepCounts)
    posture: tuple[np.ndarray, np.ndarray] | None = None
    min_distance: float = np.inf
    clearance_share: float = np.inf
    active: ActiveConstraints = field(init=False)

    def __post_init__(self) -> None:
        try:
            import daqp
        except ImportError:
            raise WeposeError("retargeting needs daqp: pip install 'wepose-pin[retarget]'") from None
        self._solve = daqp.solve
        robot, t = self.robot, self.tasks
        self.data: Any = robot.model.createData()
        n = len(robot.names)
        self._low, self._high = np.empty(n), np.empty(n)
        v_max, a_max, j_max = (self.limit_factor * limit for limit in (robot.v_max, robot.a_max, robot.j_max))
        a_max = reduce_acceleration_limits(a_max, v_max, j_max, robot.upper - robot.lower, self.dt)
        self._limits = (v_max, a_max, j_max)
        self._uncoupled = _is_uncoupled(robot)
        self._parameters = np.array(
            [t.position, t.orientation, t.swivel, t.gain, t.deceleration, t.singular_below, t.damping, t.curvature]
        )
        self.active = ActiveConstraints(np.zeros(n, dtype=bool), np.zeros(len(robot.arms), dtype=bool))
        self._arms = [_ArmTasks(robot, arm, self.data) for arm in robot.arms]

    def set_joints(self, u: np.ndarray) -> None:
        """Move the model to `u`, from which `arm_pose` follows."""
        pin.computeJointJacobians(self.robot.model, self.data, self.robot.configuration(u))
        for arm in self._arms:
            arm.update()

    def arm_pose(self, arm: int) -> ArmPose:
        """Pose of an arm; copies."""
        tasks = self._arms[arm]
        return ArmPose(tasks.hand.copy(), tasks.rotation.copy(), tasks.elbow.copy())

    def step(self, state: JointState, targets: tuple[HandTarget, ...]) -> JointState:
        """The state one step later."""
        robot, tasks, dt, n = self.robot, self.tasks, self.dt, len(self.robot.names)
        self.counts.steps += 1
        self.set_joints(state.u)
        H, f = np.zeros((n, n)), np.zeros(n)
        for arm, target in zip(self._arms, targets, strict=True):
            self.counts.singular += arm.add(H, f, target, self._parameters, dt, state.v)
        decided = state.v + 0.5 * dt * state.a
        H[np.diag_indices(n)] += tasks.posture + tasks.joint_velocity + tasks.joint_acceleration
        posture, posture_velocity = (robot.rest, 0.0) if self.posture is None else self.posture
        f += tasks.posture * (tasks.posture_gain * (posture - state.u) + posture_velocity)
        f += tasks.joint_acceleration * (decided + dt * state.a)
        self._bound_accelerations(state)
        low, high = decided + dt * self._low, decided + dt * self._high
        rows, bound = self._constrain_distances(state)
        w = np.clip(self._solve_qp(H, f, rows, bound, low, high), low, high)
        return integrate(state, np.clip((w - decided) / dt, self._low, self._high), dt)

    def halt(self, state: JointState, steps: int) -> JointState:
        """The state one step later on the way to rest, which is reached exactly when no `steps` are left.

        For a robot that hardly moves any more: distances between shapes are not constrained.
        """
        dt, decided = self.dt, state.v + 0.5 * self.dt * state.a
        self.set_joints(state.u)
        self._bound_accelerations(state)
        w = 0.0 if steps <= 2 else (1.0 - HALT_GAIN * dt) * state.v
        return integrate(state, np.clip((w - decided) / dt, self._low, self._high), dt)

    def _bound_accelerations(self, state: JointState) -> None:
        """Fill `_low` and `_high`."""
        lower, upper = self.robot.lower, self.robot.upper
        compute_acceleration_bounds(
            state.u, state.v, state.a, lower, upper, *self._limits, self.dt, self._low, self._high
        )

    def _constrain_distances(self, state: JointState) -> tuple[np.ndarray, np.ndarray]:
        """Rows (m, n) and bound (m,) of rows @ w ≥ bound: near shapes approach no faster than they can stop."""
        near = self.collision.find_near_pairs(self.data)
        self.min_distance = float(near.distance.min()) if len(near.distance) else np.inf
        apart = near.clearance > 0.0  # other hulls overlap in the rest posture; their shapes need not
        self.clearance_share = float((near.distance[apart] / near.clearance[apart]).min(initial=np.inf))
        rows = near.jacobian if self._uncoupled else near.jacobian @ self.robot.coupling
        _, a_max, j_max = self._limits
        self.counts.near += bool((near.distance - near.clearance < 0.01).any())
        bound = compute_separation_bounds(
            rows, near.distance, near.clearance, state.v, state.a, a_max, j_max, self.dt
        )  # fmt: skip
        return rows, bound

    def _solve_qp(
        self, H: np.ndarray, f: np.ndarray, rows: np.ndarray, bound: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray:
        """w (n,); where nothing solves the programme, with the distances as soft constraints."""
        n = len(high)
        upper = np.concatenate([high, np.full(len(rows), 1e30)])
        lower = np.concatenate([low, bound])
        sense = np.zeros(len(upper), dtype=np.int32)
        w, _, flag, info = self._solve(H, -f, np.ascontiguousarray(rows), upper, lower, sense)
        if flag != 1:
            sense[n:] = _SOFT
            w, _, flag, info = self._solve(H, -f, np.ascontiguousarray(rows), upper, lower, sense)
            self.counts.infeasible += 1
        if flag <= 0 or not np.isfinite(w).all():
            self.active.joints[:] = True
            return np.clip(0.0, low, high)
        active = info["lam"] != 0.0
        self.active.joints[:] = active[:n]
        stopping = rows[active[n:]]
        for i, arm in enumerate(self.robot.arms):
            self.active.shapes[i] = len(stopping) > 0 and bool((np.abs(stopping[:, arm.joints]) > _MIN_LEVER).any())
        return np.asarray(w)


def integrate(state: JointState, a: np.ndarray, dt: float) -> JointState:
    """The state one step later, with accelerations `a` there and a constant jerk between."""
    v = state.v + 0.5 * dt * (state.a + a)
    return JointState(state.u + dt * (state.v + dt * (state.a / 3.0 + a / 6.0)), v, a)


class _ArmTasks:
    """One arm's part of the programme; views into Pinocchio's memory are created once."""

    def __init__(self, robot: Robot, arm: Arm, data: Any) -> None:
        self.arm, self.robot, self.data = arm, robot, data
        frame = robot.model.frames[arm.hand]
        self._R_JH, self._p_JH = frame.placement.rotation.copy(), frame.placement.translation.copy()
        placement = data.oMi[frame.parentJoint]
        self._R_J, self._p_J = placement.rotation, placement.translation
        self._has_elbow = arm.elbow >= 0
        self._has_swivel = self._has_elbow and len(arm.joints) > HAND_JOINTS
        if self._has_elbow:
            elbow = robot.model.frames[arm.elbow]
            self._p_JE = elbow.placement.translation.copy()
            placement = data.oMi[elbow.parentJoint]
            self._R_E, self._p_E = placement.rotation, placement.translation
            self._moves_elbow = _find_ancestors(robot, elbow.parentJoint)
        self._moves_hand = _find_ancestors(robot, frame.parentJoint)
        self._uncoupled = _is_uncoupled(robot)
        self.hand, self.rotation, self.elbow = np.zeros(3), np.eye(3), np.full(3, np.nan)

    def update(self) -> None:
        """Take the pose from Pinocchio's data."""
        self.rotation = self._R_J @ self._R_JH
        self.hand = self._R_J @ self._p_JH + self._p_J
        if self._has_elbow:
            self.elbow = self._R_E @ self._p_JE + self._p_E

    def add(
        self, H: np.ndarray, f: np.ndarray, target: HandTarget, parameters: np.ndarray, dt: float, v: np.ndarray
    ) -> bool:
        """Add the arm's tasks to the objective; return whether the arm is near a singularity."""
        J_hand = self.data.J * self._moves_hand
        J_elbow = self.data.J * self._moves_elbow if self._has_swivel else _NO_JACOBIAN
        if not self._uncoupled:
            J_hand = J_hand @ self.robot.coupling
            J_elbow = J_elbow @ self.robot.coupling if self._has_swivel else J_elbow
        rotation_error = pin.log3(target.rotation @ self.rotation.T)
        return bool(
            add_arm_tasks(
                H, f, J_hand, J_elbow, self.hand, self.elbow, self.arm.shoulder, rotation_error, target.position,
                target.velocity, target.angular_velocity, target.swivel, target.weight, v, dt, parameters,
                self.arm.joints,
            )
        )  # fmt: skip


def sample_hand_targets(hands: tuple[HandPath, ...], k: int, dt: float) -> tuple[HandTarget, ...]:
    """Targets of the step from sample `k`: positions in its middle, velocities half a step after its end."""
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


def _is_uncoupled(robot: Robot) -> bool:
    return np.array_equal(robot.coupling, np.eye(*robot.coupling.shape))


def _find_ancestors(robot: Robot, joint: int) -> np.ndarray:
    """(nv,) 1 where a joint of the model moves `joint`, itself included."""
    moves = np.zeros(robot.model.nv)
    while joint > 0:
        moves[robot.model.idx_vs[joint]] = 1.0
        joint = robot.model.parents[joint]
    return moves
