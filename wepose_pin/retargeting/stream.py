"""Robot commands while the person moves: causal targets, a limited approach to them, the control step.

Three stages lie between a pose and the robot. A causal low-pass smooths the targets (`_LowPass`). A reference moves
from the robot's hand to its target no faster than the tracking's quality allows (`_Reference`): it makes the approach,
slows the robot where tracking is poor, and keeps jumps from it. The control step (`QpController`) keeps the limits,
also while braking. Time is an argument: nothing here reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadData, WrongOption
from ..model import BodyTable, load_table
from .collision import CollisionModel
from .controller import HandTarget, JointState, QpController
from .robot import Arm, Robot
from .targets import (
    JUMP_SPEED,
    STD_GOOD,
    STD_POOR,
    WEIGHT_POOR,
    clamp_to_reach,
    compute_swivel,
    compute_target_reach,
    find_hand_segment,
    find_person_arm,
    list_needed_segments,
)

SMOOTHING_HZ = 6.0  # natural frequency of the low-pass, which halves the amplitude there as the zero-phase one does
EXTRAPOLATE_S = 0.03  # [s] for which a pose is extrapolated until the next comes
HOLD_AFTER_S, STOP_AFTER_S = 0.1, 1.0  # [s] without a pose: brake; stop until `resume`
JUMP_RATE = 40.0  # [rad/s] no hand rotates faster, so the tracking has jumped
APPROACH_SPEED = 0.25  # [m/s] of a reference that has not reached its target yet
APPROACH_GROWTH = 0.1  # [m/s²] of that speed, so that it also reaches a target that moves
FREE_SPEED = 12.0  # [m/s] of a reference at a trusted target: only the robot's limits count
TURN_RATIO = 2.4  # [rad/m] of the reference's angular speed to its speed
CLOSING_GAIN = 5.0  # [1/s] at which the reference closes the distance to its target
REACHED_M, REACHED_RAD = 0.02, 0.1  # distance at which it has reached its target
SPEED_UP_S, SPEED_DOWN_S = 0.2, 0.1  # [s] time constants of the speed allowed
TRUST_UP_S, TRUST_DOWN_S = 0.5, 0.1  # [s] time constants of the trust
WAITING = "waiting for a pose"
TRUSTED = 0.9  # below it the state is "slow"


class ArmObservation(NamedTuple):
    """One arm of the person at one moment, in B, scaled."""

    offset: np.ndarray  # (3,) [m] shoulder to hand
    swivel: np.ndarray  # (3,) [m] elbow swivel direction
    rotation: np.ndarray  # (3, 3) of the hand
    std: float  # [m] of the hand against the shoulder, not scaled; NaN where the filter has no covariance
    lost: tuple[str, ...]  # segments of the arm whose sensor is lost
    scale: float = 1.0  # metres of the robot for one of the person


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


@dataclass
class _LowPass:
    """A critically damped low-pass of one arm; its delay on constant motion is exactly 2/ω, its rates are exact."""

    newest: ArmObservation
    offset: np.ndarray
    swivel: np.ndarray
    rotation: np.ndarray
    offset_rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    swivel_rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    angular_velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [rad/s] in B

    @classmethod
    def start(cls, observation: ArmObservation) -> _LowPass:
        return cls(observation, observation.offset, observation.swivel, observation.rotation)

    def push(self, observation: ArmObservation, dt: float, omega: float) -> None:
        last = self.newest
        self.offset, self.offset_rate = _track(
            self.offset, self.offset_rate, last.offset, observation.offset, omega, dt
        )
        self.swivel, self.swivel_rate = _track(
            self.swivel, self.swivel_rate, last.swivel, observation.swivel, omega, dt
        )
        rate = pin.log3(observation.rotation @ last.rotation.T) / dt
        away = pin.log3(self.rotation @ last.rotation.T)
        away, self.angular_velocity = _relax(away, self.angular_velocity, rate, omega, dt)
        self.rotation = pin.exp3(away) @ observation.rotation
        self.newest = observation


def _track(
    value: np.ndarray, rate: np.ndarray, before: np.ndarray, now: np.ndarray, omega: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Low-passed value and rate after an input that went from `before` to `now`."""
    away, rate = _relax(value - before, rate, (now - before) / dt, omega, dt)
    return now + away, rate


def _relax(
    away: np.ndarray, rate: np.ndarray, input_rate: np.ndarray, omega: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """x - r and ẋ after `dt` of ẍ = -ω² (x - r) - 2 ω ẋ with ṙ = `input_rate` constant; exact."""
    behind = 2.0 / omega * input_rate
    d, decay = away + behind, np.exp(-omega * dt)
    c = rate - input_rate + omega * d
    return (d + c * dt) * decay - behind, input_rate + (rate - input_rate - omega * c * dt) * decay


@dataclass
class _Reference:
    """Reference of one hand: it moves from the hand to its target, and then with it.

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
            trust = (target.weight - WEIGHT_POOR) / (1.0 - WEIGHT_POOR)
            target_speed = APPROACH_SPEED * (FREE_SPEED / APPROACH_SPEED) ** trust
            up, down = np.exp(dt / SPEED_UP_S), np.exp(-dt / SPEED_DOWN_S)
            self.speed = float(min(max(target_speed, down * self.speed), up * self.speed))
        else:
            self.speed += APPROACH_GROWTH * dt * target.weight
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
    """Takes the arms that a robot needs from a live pose.

    Parameters
    ----------
    segments, points : rows of a live pose
    table : of the person's body; None: the upper body
    lengths_cov : (k, k) [m²] of the person's lengths in the order of the table; None: exact
    scale : metres of the robot for one of the person; None: a straight arm becomes `compute_target_reach`

    Raises
    ------
    BadData
        The pose lacks an arm of the robot.
    """

    def __init__(
        self,
        robot: Robot,
        segments: Sequence[str],
        points: Sequence[str],
        lengths_cov: np.ndarray | None = None,
        scale: float | None = None,
        table: BodyTable | None = None,
    ) -> None:
        table = table or load_table()
        check_segments(robot, segments, table)
        self._robot, self._scale = robot, scale
        lengths = list(table.lengths)
        cov = np.zeros((len(lengths), len(lengths))) if lengths_cov is None else lengths_cov
        self._segments = tuple(segments)
        self._points, self._rows, self._lengths_cov = [], [], []  # of each arm, into points, segments; [m²]
        for arm in robot.arms:
            limb = find_person_arm(table, arm.side)
            self._points.append([points.index(name) for name in limb.points])
            chain = (*list_needed_segments(limb), find_hand_segment(limb, segments))
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
            self.scales = [self._compute_scale(arm, p) for arm, (_, p) in zip(self._robot.arms, arms, strict=True)]
        return [self._observe_arm(i, quat, p, std, lost) for i, (quat, p) in enumerate(arms)]

    def _observe_arm(
        self, i: int, quat: np.ndarray, p: np.ndarray, std: np.ndarray, lost: np.ndarray
    ) -> ArmObservation:
        scale, R_WL = self.scales[i], Rotation.from_quat(quat).as_matrix()
        R_BW = self._robot.R_BT @ R_WL[0].T
        offset, upper = scale * R_BW @ (p[3] - p[0]), scale * R_BW @ (p[1] - p[0])
        lost_segments = tuple(self._segments[row] for row in dict.fromkeys(self._rows[i]) if lost[row])
        swivel = compute_swivel(upper, offset)
        return ArmObservation(offset, swivel, R_BW @ R_WL[3], self._hand_std(i, p, std), lost_segments, scale)

    def _compute_scale(self, arm: Arm, p: np.ndarray) -> float:
        if self._scale is not None:
            return self._scale
        return compute_target_reach(self._robot, arm) / float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())

    def _hand_std(self, i: int, p: np.ndarray, std: np.ndarray) -> float:
        """[m] of the hand against the shoulder: an error of a segment rotates what it carries, one of a length shifts.

        As `kinematics.compute_point_covariances`, whose hand is against the root: a robot's shoulder does not depend on
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


def check_segments(robot: Robot, segments: Sequence[str], table: BodyTable | None = None) -> None:
    """Raise `BadData` where an arm of the robot has no sensors to follow."""
    for arm in robot.arms:
        needed = list_needed_segments(find_person_arm(table or load_table(), arm.side))
        missing = [name for name in needed if name not in segments]
        if missing:
            raise BadData(
                f"--robot {robot.map.name}: no sensor on {', '.join(missing)}, which its {arm.side} arm follows; "
                "arm names the other"
            )


@dataclass(frozen=True)
class StreamOptions:
    """Timing of a `CommandStream`.

    Parameters
    ----------
    rate_hz : commands a second
    hold_after, stop_after : [s] without a pose, after which the robot brakes, and stops until `resume`
    smoothing_hz : of the low-pass, whose delay is ``1 / (π smoothing_hz)`` seconds

    Raises
    ------
    WrongOption
        A value out of range.
    """

    rate_hz: float = 100.0
    hold_after: float = HOLD_AFTER_S
    stop_after: float = STOP_AFTER_S
    smoothing_hz: float = SMOOTHING_HZ

    def __post_init__(self) -> None:
        if not 10.0 <= self.rate_hz <= 1000.0:
            raise WrongOption("rate-hz", f"{self.rate_hz:g}", "from 10 to 1000 commands a second")
        if not 0.0 < self.hold_after < self.stop_after < np.inf:
            needed = f"seconds, above 0 and less than stop_after = {self.stop_after:g}"
            raise WrongOption("hold-after", f"{self.hold_after:g}", needed)


class CommandStream:
    """Commands at a constant rate for a robot that follows a live pose.

    It begins at rest in the robot's rest posture. Without a pose for `hold_after` it brakes, and continues when one
    comes; without one for `stop_after` it stops until `resume`.

    Attributes
    ----------
    delay_s : [s] of the low-pass
    state : of the robot at the last command
    """

    def __init__(self, robot: Robot, options: StreamOptions | None = None) -> None:
        self.robot, self.options = robot, options or StreamOptions()
        self.dt = 1.0 / self.options.rate_hz
        self._omega = 2.0 * np.pi * self.options.smoothing_hz
        self.delay_s = 2.0 / self._omega
        collision = CollisionModel(robot)
        self._controller = QpController(robot, collision, self.dt)
        self.state = JointState.at_rest(robot.rest)
        no_target = HandTarget(np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), 0.0)
        self._controller.step(self.state, (no_target,) * len(robot.arms))  # compiles before the robot moves
        self._controller = QpController(robot, collision, self.dt)
        self._number = 0
        self._time = np.nan
        self._observed: list[ArmObservation] = []
        self._low_passes: list[_LowPass] = []
        self._trust = np.ones(len(robot.arms))
        self._references: list[_Reference] | None = None
        self._approach_reason = ""
        self._stop_reason = ""
        self._end_reason = ""

    @property
    def stopping(self) -> int:
        """Steps in which the robot braked, since none kept all limits and clearances and left a stop open."""
        return self._controller.counts.stopping

    @property
    def stopped(self) -> bool:
        return bool(self._stop_reason)

    def push(self, time: float, observed: list[ArmObservation] | None) -> bool:
        """Take the newest pose: its time [s] and its arms. False for none or NaN, which are ignored."""
        if observed is None or not np.isfinite(time):
            return False
        dt, before = time - self._time, self._observed
        self._time, self._observed = time, observed
        continues = bool(before) and 0.0 < dt <= self.options.hold_after
        if continues and not _jumps(before, observed, dt):
            for low_pass, observation in zip(self._low_passes, observed, strict=True):
                low_pass.push(observation, dt, self._omega)
            return True
        if continues:
            self._restart_approach("the pose jumped")
        self._low_passes = [_LowPass.start(observation) for observation in observed]
        return True

    def step(self, now: float, age: float) -> Command:
        """The next command; `now` [s] on the poses' clock, `age` [s] since a pose came."""
        hold_after, stop_after = self.options.hold_after, self.options.stop_after
        if self._observed and age > stop_after and not self._stop_reason:
            self._stop_reason = f"no sound pose for {stop_after:g} s"
        if self._end_reason or self._stop_reason:
            return self._brake_to_rest(self._end_reason or self._stop_reason, final=True)
        if not self._observed:
            return self._brake_to_rest(WAITING)
        if age > hold_after:
            return self._brake_to_rest(f"no sound pose for {hold_after:g} s")
        return self._follow(now)

    def end(self, reason: str) -> None:
        """From now on brake, and stop."""
        self._end_reason = reason

    def resume(self) -> None:
        """Continue after a stop as soon as a pose comes, by an approach; approach anew where the robot follows."""
        if self._stop_reason:
            self._stop_reason, self._observed = "", []
        self._restart_approach("reset")

    def _restart_approach(self, reason: str) -> None:
        self._references, self._approach_reason = None, reason

    def _start_references(self) -> list[_Reference]:
        """References at the robot's hands."""
        self._controller.update_kinematics(self.state.position)
        references = []
        for i, arm in enumerate(self.robot.arms):
            pose = self._controller.get_arm_pose(i)
            max_acceleration = arm.reach * float(np.median(self.robot.a_max[arm.joints]))
            references.append(_Reference(pose.hand, pose.rotation, max_acceleration))
        return references

    def _follow(self, now: float) -> Command:
        """A step towards the newest pose."""
        dt = self.dt
        if self._references is None:
            self._references = self._start_references()
        for i, observation in enumerate(self._observed):
            trust = _compute_trust(observation)
            time_constant = TRUST_UP_S if trust > self._trust[i] else TRUST_DOWN_S
            self._trust[i] += (trust - self._trust[i]) * -math.expm1(-dt / time_constant)
        ahead = min(max(now - self._time, -dt), EXTRAPOLATE_S)
        moving = now - self._time <= EXTRAPOLATE_S
        targets = [self._extrapolate(i, ahead, moving) for i in range(len(self._observed))]
        limited = tuple(reference.step(target, dt) for reference, target in zip(self._references, targets, strict=True))
        self.state = self._controller.step(self.state, limited)
        error = np.empty((len(targets), 2))
        for i, target in enumerate(targets):
            pose = self._controller.get_arm_pose(i)
            turn = pin.log3(target.rotation @ pose.rotation.T)
            error[i] = _norm(pose.hand - target.position), _norm(turn)
        if not all(reference.reached for reference in self._references):
            why = "" if self._approach_reason in ("", WAITING) else f": {self._approach_reason}"
            return self._command("approach", f"on the way to the person's hands{why}", error)
        self._approach_reason = ""
        arms = zip(self.robot.arms, self._observed, self._trust, strict=True)
        poor = [_describe_doubt(arm.side, observation) for arm, observation, trust in arms if trust < TRUSTED]
        return self._command("slow" if poor else "follow", "; ".join(poor), error)

    def _extrapolate(self, i: int, ahead: float, moving: bool) -> HandTarget:
        """Target of arm `i`, `ahead` [s] of its newest pose; without velocity where the next pose is overdue."""
        low_pass, arm, factor = self._low_passes[i], self.robot.arms[i], float(moving)
        offset = low_pass.offset + ahead * low_pass.offset_rate
        here, next_ = clamp_to_reach(np.stack([offset, offset + self.dt * low_pass.offset_rate]), arm.reach)
        return HandTarget(
            arm.shoulder + here,
            factor * (next_ - here) / self.dt,
            pin.exp3(ahead * low_pass.angular_velocity) @ low_pass.rotation,
            factor * low_pass.angular_velocity,
            low_pass.swivel + ahead * low_pass.swivel_rate,
            float(self._trust[i]),
        )

    def _brake_to_rest(self, reason: str, final: bool = False) -> Command:
        """A step to rest, within the limits."""
        self._restart_approach(reason)
        self.state = self._controller.brake(self.state)
        error = np.full((len(self.robot.arms), 2), np.nan)
        at_rest = not (self.state.velocity.any() or self.state.acceleration.any())
        return self._command("stopped" if final and at_rest else "hold", reason, error)

    def _command(self, state: str, reason: str, error: np.ndarray) -> Command:
        number, self._number = self._number, self._number + 1
        std = np.array([arm.std for arm in self._observed] or [np.nan] * len(self.robot.arms))
        u, v, a = self.state.position, self.state.velocity, self.state.acceleration
        return Command(number, self._time, number * self.dt, state, reason, u, v, a, error, std)


def _jumps(before: list[ArmObservation], now: list[ArmObservation], dt: float) -> bool:
    """Whether a hand moved or rotated faster than any can."""
    return any(
        _norm(b.offset - a.offset) > JUMP_SPEED * b.scale * dt
        or _norm(pin.log3(b.rotation @ a.rotation.T)) > JUMP_RATE * dt
        for a, b in zip(before, now, strict=True)
    )


def _compute_trust(observation: ArmObservation) -> float:
    """`WEIGHT_POOR` to 1, as `HandPath.weight`."""
    std = STD_POOR if observation.lost else 0.0 if math.isnan(observation.std) else observation.std
    poorness = min(max((std - STD_GOOD) / (STD_POOR - STD_GOOD), 0.0), 1.0)
    return 1.0 - (1.0 - WEIGHT_POOR) * poorness**2 * (3.0 - 2.0 * poorness)


def _describe_doubt(side: str, observation: ArmObservation) -> str:
    if observation.lost:
        return f"no samples from {', '.join(name.replace('_', ' ') for name in observation.lost)}"
    return f"the {side} hand is uncertain by {1e3 * observation.std:.0f} mm"
