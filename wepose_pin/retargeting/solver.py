"""One step: where the hands are, where they are to be, the next joint velocities by one quadratic programme.

The tasks are those of differential inverse kinematics (hand, elbow swivel, posture, damping), written for the velocity
w of all joints half a step after the coming one, were the acceleration to stay what it is at the coming one's end:
w = v + dt (½ a + a'). Over a step the jerk is even, and a' = (w - v) / dt - ½ a is the one such law that reaches a
given velocity in two steps, without swinging about it. Every limit on a' is a simple bound
(`limits.acceleration_bounds`). What is near in space adds a row each. The sums are those of Pink (a test holds them
against it), whose limits on acceleration and position together leave its programme without a solution sooner or later.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..arguments import NonNegative
from ..errors import WeposeError
from .collision import Shapes
from .limits import acceleration_bounds, opening_bounds, usable
from .person import ArmTarget
from .robot import Arm, Robot
from .rows import add_arm

HAND_TAKES = 6  # joints that a hand's place and turn need: with no more of them an elbow would pull the hand away
HALTS = 30.0  # [1/s] at which the last of a velocity fades
_HARDLY = 1e-3  # [m/rad] by which a joint that has no part in it changes a distance
_NONE = np.empty((0, 0))


@dataclass(frozen=True)
class Tasks:
    """How much each task counts, against 1 m/s of the hand, and how fast an error is made good."""

    position: NonNegative = 1.0  # a hand's velocity [m/s]
    orientation: NonNegative = 0.02  # its rate [rad/s]: 1 rad/s counts as 0.14 m/s
    swivel: NonNegative = 0.05  # the elbow's velocity about the line shoulder-hand [m/s]
    posture: NonNegative = 2e-4  # a joint's velocity [rad/s] away from the rest posture
    still: NonNegative = 5e-4  # a joint's velocity [rad/s]
    smooth: NonNegative = 2e-3  # a joint's velocity step beyond that of the step before [rad/s]
    gain: NonNegative = 12.0  # [1/s] of hand and elbow
    posture_gain: NonNegative = 0.5  # [1/s]
    brake: NonNegative = 8.0  # [m/s², rad/s²]: an error is made good no faster than this stops it
    straight: NonNegative = 0.06  # [m] of the hand per rad/s: below it the arm counts as singular, and is damped
    damping: NonNegative = 0.05  # at most, where it is singular
    curved: NonNegative = 1.0  # how far an error damps the arm, as the path of its hand bends; 0: not at all


class Aim(NamedTuple):
    """What one hand is to do now; as `ArmTarget`, of one moment."""

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray
    bend: np.ndarray
    weight: float


class Held(NamedTuple):
    """What held the robot in a step, or in many."""

    joints: np.ndarray  # (…, n) bool: at a bound of its own
    shapes: np.ndarray  # (…, arms) bool: an arm that comes no nearer to something


@dataclass
class Counts:
    """What happened, in steps."""

    steps: int = 0
    singular: int = 0
    near: int = 0
    held: int = 0  # the programme had no solution: all joints braked


@dataclass
class State:
    """Where the robot is: values [rad or m], velocities and accelerations of its joints (n,)."""

    u: np.ndarray
    v: np.ndarray
    a: np.ndarray


@dataclass
class Stepper:
    """Takes the robot from one step to the next.

    Parameters
    ----------
    dt : [s] of a step
    loose : velocity, acceleration and jerk limits are so many times wider: to see what a motion would ask for
    """

    robot: Robot
    shapes: Shapes
    dt: float
    tasks: Tasks = field(default_factory=Tasks)
    loose: float = 1.0
    counts: Counts = field(default_factory=Counts)
    closest: float = np.inf  # [m] between hulls in the last step; inf where nothing was near
    room: float = np.inf  # the least share of its clearance that a pair had in the last step
    held: Held = field(init=False)  # by what, in the last step
    lean: tuple[np.ndarray, np.ndarray] | None = None  # posture and its velocity in place of the rest

    def __post_init__(self) -> None:
        try:
            import daqp
        except ImportError:
            raise WeposeError("retargeting needs daqp: pip install 'wepose-pin[retarget]'") from None
        self._solve = daqp.solve
        self.data: Any = self.robot.model.createData()
        n = len(self.robot.names)
        self._low, self._high = np.empty(n), np.empty(n)
        v_most, a_most, j_most = (self.loose * of for of in (self.robot.v_most, self.robot.a_most, self.robot.j_most))
        self._most = (v_most, usable(a_most, v_most, j_most, self.robot.upper - self.robot.lower, self.dt), j_most)
        self._plain = np.array_equal(self.robot.coupling, np.eye(len(self.robot.coupling), n))
        t = self.tasks
        self._numbers = np.array(
            [t.position, t.orientation, t.swivel, t.gain, t.brake, t.straight, t.damping, t.curved]
        )
        self.held = Held(np.zeros(n, dtype=bool), np.zeros(len(self.robot.arms), dtype=bool))
        self._follow = [_Follower(self.robot, arm, self.data) for arm in self.robot.arms]

    def look(self, u: np.ndarray) -> None:
        """Put the robot at `u`: `place` then says where hands and elbows are."""
        pin.computeJointJacobians(self.robot.model, self.data, self.robot.q(u))
        for follower in self._follow:
            follower.update()

    def place(self, arm: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hand (3,), its rotation (3, 3) and elbow (3,) of an arm, in the root; copies."""
        follower = self._follow[arm]
        return follower.p.copy(), follower.R.copy(), follower.elbow.copy()

    def step(self, state: State, aims: tuple[Aim, ...]) -> State:
        """The state one step on."""
        robot, tasks, dt, n = self.robot, self.tasks, self.dt, len(self.robot.names)
        self.counts.steps += 1
        self.look(state.u)
        H, f = np.zeros((n, n)), np.zeros(n)
        for follower, aim in zip(self._follow, aims, strict=True):
            singular = follower.add(H, f, aim, self._numbers, dt, state.v)
            self.counts.singular += singular
        decided = state.v + 0.5 * dt * state.a
        H[np.diag_indices(n)] += tasks.posture + tasks.still + tasks.smooth
        posture, pull = (robot.rest, 0.0) if self.lean is None else self.lean
        f += tasks.posture * (tasks.posture_gain * (posture - state.u) + pull)
        f += tasks.smooth * (decided + dt * state.a)
        acceleration_bounds(
            state.u, state.v, state.a, robot.lower, robot.upper, *self._most, dt, self._low, self._high
        )  # fmt: skip
        low, high = decided + dt * self._low, decided + dt * self._high
        rows, bound = self._apart(state)
        w = np.clip(self._programme(H, f, rows, bound, low, high), low, high)
        a = np.clip((w - decided) / dt, self._low, self._high)
        return moved(state, a, dt)

    def halt(self, state: State, steps: int) -> State:
        """The state one step on, on the way to rest; exactly there when `steps`, the steps left, come to none.

        For a robot that hardly moves any more: shapes that are near are not looked at.
        """
        robot, dt, decided = self.robot, self.dt, state.v + 0.5 * self.dt * state.a
        self.look(state.u)
        acceleration_bounds(state.u, state.v, state.a, robot.lower, robot.upper, *self._most, dt, self._low, self._high)
        w = 0.0 if steps <= 2 else (1.0 - HALTS * dt) * state.v
        return moved(state, np.clip((w - decided) / dt, self._low, self._high), dt)

    def _apart(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Rows @ w ≥ bound: near shapes come no closer than they can stop."""
        near = self.shapes.near(self.data)
        self.closest = float(near.distance.min()) if len(near.distance) else np.inf
        clear = near.clearance > 0.0  # the hulls of others are in each other at rest, and their shapes need not be
        self.room = float((near.distance[clear] / near.clearance[clear]).min(initial=np.inf))
        growth = near.growth if self._plain else near.growth @ self.robot.coupling
        _, a_most, j_most = self._most
        self.counts.near += bool((near.distance - near.clearance < 0.01).any())
        return growth, opening_bounds(growth, near.distance, near.clearance, state.v, state.a, a_most, j_most, self.dt)

    def _programme(
        self, H: np.ndarray, f: np.ndarray, rows: np.ndarray, bound: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray:
        m = len(rows)
        upper = np.concatenate([high, np.full(m, 1e30)])
        lower = np.concatenate([low, bound])
        sense = np.zeros(len(upper), dtype=np.int32)
        w, _, flag, told = self._solve(H, -f, np.ascontiguousarray(rows), upper, lower, sense)
        if flag != 1:
            sense[len(high) :] = 8  # soft: as far apart as the joints' limits allow
            w, _, flag, told = self._solve(H, -f, np.ascontiguousarray(rows), upper, lower, sense)
            self.counts.held += 1
        if flag <= 0 or not np.isfinite(w).all():
            self.held.joints[:] = True
            return np.clip(0.0, low, high)
        holds = told["lam"] != 0.0
        self.held.joints[:] = holds[: len(high)]
        stopping = rows[holds[len(high) :]]
        for i, arm in enumerate(self.robot.arms):
            self.held.shapes[i] = len(stopping) > 0 and bool((np.abs(stopping[:, arm.joints]) > _HARDLY).any())
        return np.asarray(w)


def moved(state: State, a: np.ndarray, dt: float) -> State:
    """The state one step on, with accelerations `a` there: the jerk between is even."""
    v = state.v + 0.5 * dt * (state.a + a)
    return State(state.u + dt * (state.v + dt * (state.a / 3.0 + a / 6.0)), v, a)


class _Follower:
    """One arm's rows of the programme; views into Pinocchio's memory are looked up once."""

    def __init__(self, robot: Robot, arm: Arm, data: Any) -> None:
        self.arm, self.robot, self.data = arm, robot, data
        frame = robot.model.frames[arm.hand]
        self._R_JH, self._p_JH = frame.placement.rotation.copy(), frame.placement.translation.copy()
        self._R_J, self._p_J = (getattr(data.oMi[frame.parentJoint], part) for part in ("rotation", "translation"))
        self._elbowed = arm.elbow >= 0
        self._swivels = self._elbowed and len(arm.joints) > HAND_TAKES
        if self._elbowed:
            elbow = robot.model.frames[arm.elbow]
            self._p_JE = elbow.placement.translation.copy()
            self._R_E, self._p_E = (getattr(data.oMi[elbow.parentJoint], part) for part in ("rotation", "translation"))
            self._above = _moved_by(robot, elbow.parentJoint)
        self._moved = _moved_by(robot, frame.parentJoint)
        self._plain = np.array_equal(robot.coupling, np.eye(*robot.coupling.shape))
        self.p, self.R, self.elbow = np.zeros(3), np.eye(3), np.full(3, np.nan)

    def update(self) -> None:
        self.R = self._R_J @ self._R_JH
        self.p = self._R_J @ self._p_JH + self._p_J
        if self._elbowed:
            self.elbow = self._R_E @ self._p_JE + self._p_E

    def add(self, H: np.ndarray, f: np.ndarray, aim: Aim, numbers: np.ndarray, dt: float, v: np.ndarray) -> bool:
        """Add hand, orientation and swivel; whether the hand cannot move in some direction."""
        J = self.data.J
        hand, above = J * self._moved, J * self._above if self._swivels else _NONE
        if not self._plain:
            hand, above = hand @ self.robot.coupling, above @ self.robot.coupling if self._swivels else _NONE
        turn = pin.log3(aim.rotation @ self.R.T)
        return bool(
            add_arm(
                H, f, hand, above, self.p, self.elbow, self.arm.shoulder, turn, aim.position, aim.velocity, aim.rate,
                aim.bend, aim.weight, v, dt, numbers, self.arm.joints,
            )
        )  # fmt: skip


def aims_at(targets: tuple[ArmTarget, ...], k: int, dt: float) -> tuple[Aim, ...]:
    """What the hands are to do in the step from sample `k`: the velocity half a step after it, the position amid it."""
    n = min(k + 1, len(targets[0].weight) - 1)
    after = min(k + 2, len(targets[0].weight) - 1)
    return tuple(
        Aim(
            t.position[k] + 0.5 * dt * t.velocity[k],
            0.5 * (t.velocity[n] + t.velocity[after]),
            t.rotation[k],
            0.5 * (t.rate[n] + t.rate[after]),
            t.bend[k],
            float(t.weight[k]),
        )
        for t in targets
    )


def _moved_by(robot: Robot, joint: int) -> np.ndarray:
    """(nv,) 1 where a joint of the model moves what hangs on another."""
    found = np.zeros(robot.model.nv)
    while joint > 0:
        found[robot.model.idx_vs[joint]] = 1.0
        joint = robot.model.parents[joint]
    return found
