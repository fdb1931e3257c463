"""Robot commands while the person moves: causal targets, a limited approach to them, the control step.

Three stages lie between a pose and the robot. A causal low-pass smooths the targets (`_LowPass`). A reference moves
from the robot's hand to its target no faster than the tracking's quality allows (`_HandReference`): it makes the
approach, slows the robot where tracking is poor, and keeps jumps from it. The control step (`QpController`) keeps the
limits, also while braking. Time is an argument: nothing here reads a clock.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from ..body import BodyTable, load_table
from ..errors import WrongOption
from . import targets
from .collision import CollisionModel
from .controller import JointState, QpController
from .robot import Robot
from .targets import ArmMotion, HandTarget

SMOOTHING_HZ = 6.0  # natural frequency of the low-pass, which halves the amplitude there as the zero-phase one does
EXTRAPOLATE_S = 0.03  # [s] for which a pose is extrapolated until the next comes
HOLD_AFTER_S, STOP_AFTER_S = 0.1, 1.0  # [s] without a pose: brake; stop until `resume`
JUMP_RATE = 40.0  # [rad/s] no hand rotates faster, so the tracking has jumped
TRUST_UP_S, TRUST_DOWN_S = 0.5, 0.1  # [s] time constants of the trust
WAITING = "waiting for a pose"
TRUSTED = 0.9  # below it the state is "slow"

APPROACH_SPEED = 0.25  # [m/s] of a reference that has not reached its target yet
APPROACH_GROWTH = 0.1  # [m/s²] of that speed, so that it also reaches a target that moves
FREE_SPEED = 12.0  # [m/s] of a reference at a trusted target: only the robot's limits count
TURN_RATIO = 2.4  # [rad/m] of the reference's angular speed to its speed
CLOSING_GAIN = 5.0  # [1/s] at which the reference closes the distance to its target
REACHED_M, REACHED_RAD = 0.02, 0.1  # distance at which it has reached its target
SPEED_UP_S, SPEED_DOWN_S = 0.2, 0.1  # [s] time constants of the speed allowed


class ArmObservation(NamedTuple):
    """One arm of the person at one moment."""

    motion: ArmMotion
    std: float  # [m] of the hand against the shoulder, not scaled; NaN where the filter has no covariance
    lost: tuple[str, ...]  # segments of the arm whose sensor is lost
    scale: float  # metres of the robot for one of the person


class Command(NamedTuple):
    """Position, velocity and acceleration of the robot at `clock`."""

    number: int
    time: float  # [s] of the newest pose; NaN before the first
    clock: float  # [s] since command 0
    state: str  # "approach", "follow", "slow", "hold", "stopped"
    reason: str  # why the robot does not follow; empty where it does
    u: np.ndarray  # (n,) [rad or m]
    v: np.ndarray
    a: np.ndarray
    error: np.ndarray  # (arms, 2) [m], [rad] of the hands against their targets; NaN where there is none
    std: np.ndarray  # (arms,) [m]; NaN where not known


class _LowPass:
    """A critically damped low-pass of one arm; its delay on constant motion is exactly 2/ω, its rates are exact."""

    def __init__(self, motion: ArmMotion) -> None:
        self._newest = motion
        self.vectors, self.rates = np.stack(motion[:2]), np.zeros((2, 3))  # offset, upper [m]
        self.rotation, self.angular_velocity = motion.rotation, np.zeros(3)  # [rad/s] in B

    def push(self, motion: ArmMotion, dt: float, omega: float) -> None:
        last, now = np.stack(self._newest[:2]), np.stack(motion[:2])
        away, self.rates = _relax(self.vectors - last, self.rates, (now - last) / dt, omega, dt)
        self.vectors = now + away
        turn, last_R = pin.log3(self.rotation @ self._newest.rotation.T), self._newest.rotation
        rate = pin.log3(motion.rotation @ last_R.T) / dt
        turn, self.angular_velocity = _relax(turn, self.angular_velocity, rate, omega, dt)
        self.rotation, self._newest = pin.exp3(turn) @ motion.rotation, motion


def _relax(
    away: np.ndarray, rate: np.ndarray, input_rate: np.ndarray, omega: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """x - r and ẋ after `dt` of ẍ = -ω² (x - r) - 2 ω ẋ with ṙ = `input_rate` constant; exact."""
    behind = 2.0 / omega * input_rate
    d, decay = away + behind, np.exp(-omega * dt)
    c = rate - input_rate + omega * d
    return (d + c * dt) * decay - behind, input_rate + (rate - input_rate - omega * c * dt) * decay


@dataclass
class _HandReference:
    """The reference of a live hand: it moves from the robot's hand to its target, and then with it.

    Its acceleration is limited to what the joints can do: a robot that is asked for more shakes, and comes so near to
    itself that its limits leave no way out.
    """

    position: np.ndarray
    rotation: np.ndarray
    max_acceleration: float  # [m/s²]
    speed: float = APPROACH_SPEED  # [m/s] allowed now
    reached: bool = False
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    angular_velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def step(self, target: HandTarget, dt: float) -> HandTarget:
        """Target of the hand in this step, on the way to `target`."""
        away, turn = target.position - self.position, pin.log3(target.rotation @ self.rotation.T)
        self.reached = self.reached or (_norm(away) < REACHED_M and _norm(turn) < REACHED_RAD)
        if self.reached:
            trust = (target.weight - targets.WEIGHT_POOR) / (1.0 - targets.WEIGHT_POOR)
            target_speed = APPROACH_SPEED * (FREE_SPEED / APPROACH_SPEED) ** trust
            up, down = np.exp(dt / SPEED_UP_S), np.exp(-dt / SPEED_DOWN_S)
            self.speed = float(min(max(target_speed, down * self.speed), up * self.speed))
        else:
            self.speed += APPROACH_GROWTH * dt * float(target.weight)
        speed, limit = self.speed, self.max_acceleration
        self.velocity = _approach_velocity(self.velocity, target.velocity, away, speed, limit, dt)
        self.angular_velocity = _approach_velocity(
            self.angular_velocity, target.angular_velocity, turn, TURN_RATIO * speed, TURN_RATIO * limit, dt
        )
        position = self.position + 0.5 * dt * self.velocity
        rotation = pin.exp3(0.5 * dt * self.angular_velocity) @ self.rotation
        self.position = self.position + dt * self.velocity
        self.rotation = pin.exp3(dt * self.angular_velocity) @ self.rotation
        return HandTarget(position, self.velocity, rotation, self.angular_velocity, target.swivel, target.weight)


def _approach_velocity(
    v: np.ndarray, target: np.ndarray, away: np.ndarray, speed: float, max_acceleration: float, dt: float
) -> np.ndarray:
    """Next velocity: the target's, and what closes the distance and stops with half of `max_acceleration`."""
    far = _norm(away)
    gain = min(CLOSING_GAIN, np.sqrt(max_acceleration / far)) if far > 0.0 else CLOSING_GAIN
    return v + _limit_norm(_limit_norm(target + gain * away, speed) - v, max_acceleration * dt)


def _norm(v: np.ndarray) -> float:
    """As `np.linalg.norm` of (3,), in a fifth of the time."""
    return math.sqrt(v @ v)


def _limit_norm(v: np.ndarray, limit: float) -> np.ndarray:
    size = _norm(v)
    return v if size <= limit else v * (limit / size)


class ArmObserver:
    """Takes the arms that a robot needs from a live pose, of which `segments` and `points` are the rows.

    `lengths_cov` (k, k) [m²] is of the person's lengths in the order of the table; None: exact. `BadData`: the pose
    lacks an arm of the robot.
    """

    def __init__(
        self,
        robot: Robot,
        segments: Sequence[str],
        points: Sequence[str],
        lengths_cov: np.ndarray | None = None,
        table: BodyTable | None = None,
    ) -> None:
        table = table or load_table()
        targets.check_person_arms(robot, segments, points, table)
        self._robot = robot
        lengths = list(table.lengths)
        cov = np.zeros((len(lengths), len(lengths))) if lengths_cov is None else lengths_cov
        self._segments = tuple(segments)
        self._points, self._rows, self._lengths_cov = [], [], []  # of each arm, into points, segments; [m²]
        for arm in robot.arms:
            limb = targets.find_person_arm(table, arm.side)
            self._points.append([points.index(name) for name in limb.points])
            chain = (str(limb.base), *limb.segments[:-1], targets.find_hand_segment(limb, segments))
            self._rows.append([self._segments.index(name) for name in chain])
            names = (table.find_length(*ends) for ends in pairwise(limb.points))
            own = [lengths.index(name) for name in names if name is not None]
            self._lengths_cov.append(cov[np.ix_(own, own)])
        self.scales: list[float] = []

    def observe(
        self, quat_WL: np.ndarray, points: np.ndarray, std: np.ndarray, lost: np.ndarray
    ) -> list[ArmObservation] | None:
        """The arms at one moment; None where a value of them is NaN."""
        arms = [(quat_WL[rows], points[own]) for rows, own in zip(self._rows, self._points, strict=True)]
        for quat, p in arms:
            if not (np.isfinite(p).all() and np.isfinite(quat).all() and quat.any(axis=1).all()):
                return None
        if not self.scales:
            lengths = (float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for _, p in arms)
            reaches = (targets.compute_target_reach(self._robot, arm) for arm in self._robot.arms)
            self.scales = [reach / length for reach, length in zip(reaches, lengths, strict=True)]
        observations = []
        for i, (quat, p) in enumerate(arms):
            motion = targets.map_arm(self._robot, self.scales[i], quat[0], quat[3], p)
            lost_segments = tuple(self._segments[row] for row in dict.fromkeys(self._rows[i]) if lost[row])
            observations.append(ArmObservation(motion, self._compute_std(i, p, std), lost_segments, self.scales[i]))
        return observations

    def _compute_std(self, i: int, p: np.ndarray, std: np.ndarray) -> float:
        """[m] of the hand against the shoulder: an error of a segment rotates what it carries, one of a length shifts.

        As `compute_point_covariances`, whose hand is against the root: a robot's shoulder does not depend on
        the trunk. The covariance of a segment is known here only as its mean over the axes.
        """
        base, upper, fore, hand = self._rows[i]
        links = p[1:] - p[:-1]
        levers = {base: p[3] - p[0], upper: links[0], fore: links[1] if hand != fore else p[3] - p[1]}
        levers |= {} if hand == fore else {hand: links[2]}
        variance = sum(2.0 * std[row] ** 2 * (lever @ lever) for row, lever in levers.items())
        along = links / np.sqrt(np.einsum("li,li->l", links, links))[:, None]
        variance += np.einsum("li,lm,mi->", along, self._lengths_cov[i], along)
        return math.sqrt(variance / 3.0)


class CommandStream:
    """`rate_hz` commands a second for a robot that follows a live pose.

    It begins at rest in the robot's rest posture. Without a pose for `hold_after` [s] it brakes, and continues when one
    comes; without one for `stop_after` [s] it stops until `resume`.
    """

    def __init__(
        self, robot: Robot, rate_hz: float = 100.0, hold_after: float = HOLD_AFTER_S, stop_after: float = STOP_AFTER_S
    ) -> None:
        if not 10.0 <= rate_hz <= 1000.0:
            raise WrongOption("rate_hz", f"{rate_hz:g}", "from 10 to 1000 commands a second")
        if not 0.0 < hold_after < stop_after < np.inf:
            needed = f"seconds, above 0 and less than stop_after = {stop_after:g}"
            raise WrongOption("hold_after", f"{hold_after:g}", needed)
        self.robot, self.dt, self.hold_after, self.stop_after = robot, 1.0 / rate_hz, hold_after, stop_after
        self._omega = 2.0 * np.pi * SMOOTHING_HZ
        self.collision = CollisionModel(robot)
        self._controller = QpController(robot, self.collision, self.dt)
        self.state = JointState.at_rest(robot.rest)  # at the last command
        self.stopping = 0  # steps in which the robot braked, since none kept all limits and left a stop open
        no_target = HandTarget(np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), 0.0)
        self._controller.step(self.state, (no_target,) * len(robot.arms))  # compiles before the robot moves
        self._controller = QpController(robot, self.collision, self.dt)
        self._number = 0
        self._time = np.nan
        self._observed: list[ArmObservation] = []
        self._low_passes: list[_LowPass] = []
        self._trust = np.ones(len(robot.arms))
        self._references: list[_HandReference] | None = None
        self._approach_reason = self._stop_reason = self._end_reason = ""

    @property
    def stopped(self) -> bool:
        return bool(self._stop_reason)

    def push(self, time: float, observed: list[ArmObservation] | None) -> bool:
        """Take the newest pose: its time [s] and its arms. False for none or NaN, which are ignored."""
        if observed is None or not np.isfinite(time):
            return False
        dt, before = time - self._time, self._observed
        self._time, self._observed = time, observed
        continues = bool(before) and 0.0 < dt <= self.hold_after
        if continues and not _jumps(before, observed, dt):
            for low_pass, observation in zip(self._low_passes, observed, strict=True):
                low_pass.push(observation.motion, dt, self._omega)
            return True
        if continues:
            self._references, self._approach_reason = None, "the pose jumped"
        self._low_passes = [_LowPass(observation.motion) for observation in observed]
        return True

    def step(self, now: float, age: float) -> Command:
        """The next command; `now` [s] on the poses' clock, `age` [s] since a pose came."""
        if self._observed and age > self.stop_after and not self._stop_reason:
            self._stop_reason = f"no sound pose for {self.stop_after:g} s"
        if self._end_reason or self._stop_reason:
            return self._brake_to_rest(self._end_reason or self._stop_reason, final=True)
        if not self._observed:
            return self._brake_to_rest(WAITING)
        if age > self.hold_after:
            return self._brake_to_rest(f"no sound pose for {self.hold_after:g} s")
        return self._follow(now)

    def end(self, reason: str) -> None:
        """From now on brake, and stop."""
        self._end_reason = reason

    def resume(self) -> None:
        """Continue after a stop as soon as a pose comes, by an approach; approach anew where the robot follows."""
        if self._stop_reason:
            self._stop_reason, self._observed = "", []
        self._references, self._approach_reason = None, "reset"

    def _follow(self, now: float) -> Command:
        """A step towards the newest pose."""
        dt = self.dt
        if self._references is None:
            self._controller.update_kinematics(self.state.position)
            limits = (arm.reach * float(np.median(self.robot.a_max[arm.joints])) for arm in self.robot.arms)
            self._references = [
                _HandReference(pose.hand, pose.rotation, limit)
                for pose, limit in zip(self._controller.poses, limits, strict=True)
            ]
        for i, observation in enumerate(self._observed):
            std = targets.STD_POOR if observation.lost else 0.0 if math.isnan(observation.std) else observation.std
            trust = float(targets.compute_weight(std))
            time_constant = TRUST_UP_S if trust > self._trust[i] else TRUST_DOWN_S
            self._trust[i] += (trust - self._trust[i]) * -math.expm1(-dt / time_constant)
        ahead = min(max(now - self._time, -dt), EXTRAPOLATE_S)
        moving = now - self._time <= EXTRAPOLATE_S
        hands = [self._extrapolate(i, ahead, moving) for i in range(len(self._observed))]
        limited = tuple(reference.step(target, dt) for reference, target in zip(self._references, hands, strict=True))
        self.state = self._controller.step(self.state, limited)
        self.stopping += self._controller.report.stopping
        pairs = zip(self._controller.poses, hands, strict=True)
        error = np.array([[_norm(a.hand - b.position), _norm(pin.log3(b.rotation @ a.rotation.T))] for a, b in pairs])
        if not all(reference.reached for reference in self._references):
            why = "" if self._approach_reason in ("", WAITING) else f": {self._approach_reason}"
            return self._command("approach", f"on the way to the person's hands{why}", error)
        self._approach_reason = ""
        arms = zip(self.robot.arms, self._observed, self._trust, strict=True)
        poor = [
            f"no samples from {', '.join(name.replace('_', ' ') for name in observation.lost)}"
            if observation.lost
            else f"the {arm.side} hand is uncertain by {1e3 * observation.std:.0f} mm"
            for arm, observation, trust in arms
            if trust < TRUSTED
        ]
        return self._command("slow" if poor else "follow", "; ".join(poor), error)

    def _extrapolate(self, i: int, ahead: float, moving: bool) -> HandTarget:
        """Target of arm `i`, `ahead` [s] of its newest pose; without velocity where the next pose is overdue."""
        low_pass, arm, factor = self._low_passes[i], self.robot.arms[i], float(moving)
        offset, upper = low_pass.vectors + ahead * low_pass.rates
        here, next_ = targets.clamp_to_reach(np.stack([offset, offset + self.dt * low_pass.rates[0]]), arm.reach)
        return HandTarget(
            arm.shoulder + here,
            factor * (next_ - here) / self.dt,
            pin.exp3(ahead * low_pass.angular_velocity) @ low_pass.rotation,
            factor * low_pass.angular_velocity,
            targets.compute_swivel(upper, offset),
            float(self._trust[i]),
        )

    def _brake_to_rest(self, reason: str, final: bool = False) -> Command:
        """A step to rest, within the limits."""
        self._references, self._approach_reason = None, reason
        self.state = self._controller.brake(self.state)
        error = np.full((len(self.robot.arms), 2), np.nan)
        return self._command("stopped" if final and self.state.is_static else "hold", reason, error)

    def _command(self, state: str, reason: str, error: np.ndarray) -> Command:
        number, self._number = self._number, self._number + 1
        std = np.array([arm.std for arm in self._observed] or [np.nan] * len(self.robot.arms))
        return Command(number, self._time, number * self.dt, state, reason, *self.state, error, std)


def _jumps(before: list[ArmObservation], now: list[ArmObservation], dt: float) -> bool:
    """Whether a hand moved or rotated faster than any can."""
    return any(
        _norm(b.motion.offset - a.motion.offset) > targets.JUMP_SPEED * b.scale * dt
        or _norm(pin.log3(b.motion.rotation @ a.motion.rotation.T)) > JUMP_RATE * dt
        for a, b in zip(before, now, strict=True)
    )
