"""One command after another while the person moves: aims that look at nothing ahead, a careful way to them, the step.

Three things lie between a pose and the robot. A low-pass without a look ahead makes aims of what was seen
(`_Smoothed`). From where the robot's hand is, a reference goes to its aim no faster than trust allows (`_Reference`):
that is the approach, and that is how poor tracking slows the robot and a jump does not move it. The step keeps the
limits (`Stepper`), also where it brakes. Time is an argument: nothing here looks at a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadData, BadOption
from ..subject import LENGTHS
from .collision import Shapes
from .person import JUMP_SPEED, STD_GOOD, STD_POOR, WEIGHT_POOR, bend_of, drawn_in, robot_reach
from .robot import Arm, Robot
from .solver import Aim, Counts, State, Stepper, Tasks

SMOOTHING_HZ = 6.0  # natural frequency of the low-pass: at 6 Hz it halves, as the one that looks ahead does
AHEAD_S = 0.03  # [s] for which a pose is drawn on while the next has not come
HOLD_AFTER_S, STOP_AFTER_S = 0.1, 1.0  # [s] without a pose: brake; stop for good
JUMP_RATE = 40.0  # [rad/s] faster than any hand turns: a jump of the tracking
APPROACH_SPEED = 0.25  # [m/s] of the reference that has yet to find its aim
GROWTH = 0.1  # [m/s²] by which it becomes faster, so that it also finds one that moves
FREE_SPEED = 12.0  # [m/s] of the reference that is with its aim and trusted: no limit of ours, the robot's alone
TURN = 2.4  # [rad/m] how much faster it may turn than move
CLOSING = 5.0  # [1/s] at which the reference makes good what it is away from its aim
FOUND_M, FOUND_RAD = 0.02, 0.1  # so near it has found its aim
LOOSEN_S, TIGHTEN_S = 0.2, 0.1  # [s] in which the speed allowed grows, or falls, e-fold
TRUST_S, DOUBT_S = 0.5, 0.1  # [s] in which trust comes back, or goes, e-fold
TRUSTED = 0.9  # below it, "slow"
BRAKE_S = 0.06  # [s] in which the last of a velocity fades e-fold; what is faster brakes at the limits
FADES = 0.02  # share of what one step can brake: below it the velocity goes to zero at once
STANDS = 1e-9  # [rad/s or m/s] what is slower stands


class Seen(NamedTuple):
    """One arm of the person at one moment, in the robot's frame and size."""

    offset: np.ndarray  # (3,) [m] shoulder to hand
    bend: np.ndarray  # (3,) [m] from the line shoulder-hand to the elbow
    rotation: np.ndarray  # (3, 3)
    std: float  # [m] of the hand against the shoulder, in the person's size; NaN where the filter has no covariance
    lost: tuple[str, ...]  # segments of it without a sensor now
    scale: float = 1.0  # robot's metres for one of the person's


class Command(NamedTuple):
    """What the robot is to do now: position, velocity and acceleration of one motion, sampled at `clock`."""

    number: int
    time: float  # [s] tick of the newest pose in it; NaN before the first
    clock: float  # [s] since command 0, even
    state: str  # "approach", "follow", "slow", "hold", "stopped"
    reason: str  # why it does not follow; empty where it does
    u: np.ndarray  # (n,) [rad or m]
    v: np.ndarray
    a: np.ndarray
    error: np.ndarray  # (arms, 2) [m], [rad] of the hands against their aims; NaN where there is none now
    std: np.ndarray  # (arms,) [m], NaN where not known


@dataclass
class _Smoothed:
    """A critically damped low-pass of one arm: 2/ω late, exactly so on what moves evenly, whose rate it knows."""

    seen: Seen  # the newest
    offset: np.ndarray
    bend: np.ndarray
    R: np.ndarray
    offset_rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    bend_rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [rad/s] in the root

    @classmethod
    def at(cls, seen: Seen) -> _Smoothed:
        return cls(seen, seen.offset, seen.bend, seen.rotation)

    def push(self, seen: Seen, dt: float, omega: float) -> None:
        for name in ("offset", "bend"):
            before, now = getattr(self.seen, name), getattr(seen, name)
            away, rate = getattr(self, name) - before, getattr(self, f"{name}_rate")
            away, rate = _settled(away, rate, (now - before) / dt, omega, dt)
            setattr(self, name, now + away)
            setattr(self, f"{name}_rate", rate)
        turned = pin.log3(seen.rotation @ self.seen.rotation.T) / dt
        away, self.rate = _settled(pin.log3(self.R @ self.seen.rotation.T), self.rate, turned, omega, dt)
        self.R = pin.exp3(away) @ seen.rotation
        self.seen = seen


def _settled(
    away: np.ndarray, rate: np.ndarray, moves: np.ndarray, omega: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """x - r and ẋ after `dt` of ẍ = -ω² (x - r) - 2 ω ẋ, where r moves evenly at `moves`; exactly."""
    behind = 2.0 / omega * moves
    d, decay = away + behind, np.exp(-omega * dt)
    c = rate - moves + omega * d
    return (d + c * dt) * decay - behind, moves + (rate - moves - omega * c * dt) * decay


@dataclass
class _Reference:
    """Where one hand is asked to be: it goes from where the hand is to its aim, and then with it.

    It changes its velocity no faster than the robot's joints can: a robot that is asked for more shakes, and comes so
    near to itself that its limits leave it no way out.
    """

    position: np.ndarray
    R: np.ndarray
    brisk: float  # [m/s²]
    speed: float = APPROACH_SPEED  # [m/s] allowed now
    found: bool = False
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def step(self, aim: Aim, dt: float) -> Aim:
        """What the hand is to do in this step, on the way to `aim`."""
        away, turned = aim.position - self.position, pin.log3(aim.rotation @ self.R.T)
        self.found = self.found or bool(np.linalg.norm(away) < FOUND_M and np.linalg.norm(turned) < FOUND_RAD)
        if self.found:
            free = (aim.weight - WEIGHT_POOR) / (1.0 - WEIGHT_POOR)
            wanted = APPROACH_SPEED * (FREE_SPEED / APPROACH_SPEED) ** free
            up, down = np.exp(dt / LOOSEN_S), np.exp(-dt / TIGHTEN_S)
            self.speed = float(np.clip(wanted, down * self.speed, up * self.speed))
        else:
            self.speed += GROWTH * dt * aim.weight
        self.velocity = _towards(self.velocity, aim.velocity, away, self.speed, self.brisk, dt)
        self.rate = _towards(self.rate, aim.rate, turned, TURN * self.speed, TURN * self.brisk, dt)
        middle, R_middle = self.position + 0.5 * dt * self.velocity, pin.exp3(0.5 * dt * self.rate) @ self.R
        self.position, self.R = self.position + dt * self.velocity, pin.exp3(dt * self.rate) @ self.R
        return Aim(middle, self.velocity, R_middle, self.rate, aim.bend, aim.weight)


def _towards(v: np.ndarray, aim: np.ndarray, away: np.ndarray, speed: float, brisk: float, dt: float) -> np.ndarray:
    """The next velocity: the aim's, and what closes in on it as fast as half of `brisk` stops again."""
    far = float(np.linalg.norm(away))
    closing = min(CLOSING, np.sqrt(brisk / far)) if far > 0.0 else CLOSING
    return v + _at_most(_at_most(aim + closing * away, speed) - v, brisk * dt)


def _at_most(v: np.ndarray, most: float) -> np.ndarray:
    size = float(np.linalg.norm(v))
    return v if size <= most else v * (most / size)


class Person:
    """Reads the arms that a robot needs out of a live pose.

    Parameters
    ----------
    segments, points : what the rows of a pose are
    lengths_cov : (8, 8) [m²] of the person's lengths in the order of `LENGTHS`; None: exact
    scale : robot's metres for one of the person's; None: a straight arm becomes `robot_reach`

    Raises
    ------
    BadData
        The pose has not the arms that the robot needs.
    """

    def __init__(
        self,
        robot: Robot,
        segments: Sequence[str],
        points: Sequence[str],
        lengths_cov: np.ndarray | None = None,
        scale: float | None = None,
    ) -> None:
        needed(robot, segments)
        self._robot, self._scale = robot, scale
        self._lengths_cov = np.zeros((len(LENGTHS), len(LENGTHS))) if lengths_cov is None else lengths_cov
        self._segments = tuple(segments)
        self._points, self._rows, self._lengths = [], [], []
        for arm in robot.arms:
            self._points.append([points.index(f"{arm.side}_{p}") for p in ("shoulder", "elbow", "wrist", "hand")])
            hand = f"{arm.side}_hand" if f"{arm.side}_hand" in segments else f"{arm.side}_forearm"
            of = ("torso", f"{arm.side}_upper_arm", f"{arm.side}_forearm", hand)
            self._rows.append([self._segments.index(name) for name in of])
            names = (f"{arm.side}_{part}" for part in ("upper_arm", "forearm", "hand"))
            self._lengths.append([LENGTHS.index(name) for name in names])
        self.scales: list[float] = []

    def look(self, quat_WL: np.ndarray, points: np.ndarray, std: np.ndarray, lost: np.ndarray) -> list[Seen] | None:
        """The arms at one moment; None where something of them is not a number."""
        for rows, at in zip(self._rows, self._points, strict=True):
            quat = quat_WL[rows]
            if not (np.isfinite(points[at]).all() and np.isfinite(quat).all() and quat.any(axis=1).all()):
                return None
        if not self.scales:
            self.scales = [self._scale_of(i, arm, points) for i, arm in enumerate(self._robot.arms)]
        return [self._seen(i, quat_WL[rows], points[self._points[i]], std, lost) for i, rows in enumerate(self._rows)]

    def _seen(self, i: int, quat: np.ndarray, p: np.ndarray, std: np.ndarray, lost: np.ndarray) -> Seen:
        by, R_WL = self.scales[i], Rotation.from_quat(quat).as_matrix()
        R_BW = self._robot.R_BT @ R_WL[0].T
        offset, upper = by * R_BW @ (p[3] - p[0]), by * R_BW @ (p[1] - p[0])
        gone = tuple(self._segments[row] for row in dict.fromkeys(self._rows[i]) if lost[row])
        return Seen(offset, bend_of(upper, offset), R_BW @ R_WL[3], self._std(i, p, std), gone, by)

    def _scale_of(self, i: int, arm: Arm, points: np.ndarray) -> float:
        if self._scale is not None:
            return self._scale
        length = float(np.linalg.norm(np.diff(points[self._points[i]], axis=0), axis=1).sum())
        return robot_reach(self._robot, arm) / length

    def _std(self, i: int, p: np.ndarray, std: np.ndarray) -> float:
        """[m] of the hand against the shoulder: each segment's error turns what hangs on it, each length's is along.

        As `pose.point_covariance`, whose hand is against the root: a robot's shoulder does not hang on a trunk. A
        segment's covariance is known here as its mean over the axes.
        """
        torso, upper, fore, hand = self._rows[i]
        parts = np.diff(p, axis=0)
        moved = {torso: p[3] - p[0], upper: p[1] - p[0], fore: p[2] - p[1] if hand != fore else p[3] - p[1]}
        moved |= {} if hand == fore else {hand: p[3] - p[2]}
        turned = sum(2.0 * std[row] ** 2 * float(v @ v) for row, v in moved.items())
        along = (parts / np.linalg.norm(parts, axis=1, keepdims=True)).T
        at = self._lengths[i]
        lengths = float(np.trace(along @ self._lengths_cov[np.ix_(at, at)] @ along.T))
        return float(np.sqrt((turned + lengths) / 3.0))


def needed(robot: Robot, segments: Sequence[str]) -> None:
    """Raises `BadData` where an arm of the robot's has no sensors to follow."""
    for arm in robot.arms:
        need = ("torso", f"{arm.side}_upper_arm", f"{arm.side}_forearm")
        missing = [name for name in need if name not in segments]
        if missing:
            raise BadData(
                f"--robot {robot.map.name}: no sensor on {', '.join(missing)}, which its {arm.side} arm follows; "
                "--arm names the other"
            )


class CommandStream:
    """A robot that follows a live pose: poses go in as they come, commands come out at an even rate.

    It begins at rest in the robot's rest posture. Without a pose for `hold_after` [s] it brakes; without one for
    `stop_after` it stops, and then stays so until `resume`.

    Parameters
    ----------
    rate_hz : commands a second
    smoothing_hz : of the low-pass on the aims, which is ``1 / (π smoothing_hz)`` seconds late
    hold_after, stop_after : [s]

    Attributes
    ----------
    delay_s : [s] by which the low-pass is late
    state : the robot's, of the last command

    Raises
    ------
    BadOption
        A rate or a time that is none.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        rate_hz: float = 100.0,
        smoothing_hz: float = SMOOTHING_HZ,
        hold_after: float = HOLD_AFTER_S,
        stop_after: float = STOP_AFTER_S,
        tasks: Tasks | None = None,
    ) -> None:
        if not 10.0 <= rate_hz <= 1000.0:
            raise BadOption(f"--robot-hz {rate_hz:g}: from 10 to 1000 commands a second")
        if not 0.0 < hold_after < stop_after < np.inf:
            raise BadOption(f"--hold-after {hold_after:g}, --stop-after {stop_after:g}: seconds, the second longer")
        self.robot, self.dt = robot, 1.0 / rate_hz
        self._omega = 2.0 * np.pi * smoothing_hz
        self.delay_s = 2.0 / self._omega
        self._hold_after, self._stop_after = hold_after, stop_after
        shapes = Shapes(robot)
        self._stepper = Stepper(robot, shapes, self.dt, tasks or Tasks())
        braking = Tasks(posture=1.0, still=0.0, smooth=0.0, damping=0.0)
        self._brake = Stepper(robot, shapes, self.dt, braking)
        nowhere = Aim(np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), 0.0)
        self._nowhere = tuple(nowhere for _ in robot.arms)
        n = len(robot.names)
        self.state = State(robot.rest.copy(), np.zeros(n), np.zeros(n))
        for stepper in (self._stepper, self._brake):  # what is compiled or read from disk then is there when it moves
            stepper.step(self.state, self._nowhere)
            stepper.counts = Counts()
        self._number = 0
        self._time = np.nan
        self._seen: list[Seen] = []
        self._smoothed: list[_Smoothed] = []
        self._trust = np.ones(len(robot.arms))
        self._references: list[_Reference] | None = None
        self._why = ""  # of the approach
        self._stopped = ""  # why it stopped for good
        self._ending = ""

    @property
    def held(self) -> int:
        """Steps in which what is near left the programme no solution: the joints' limits were kept."""
        return self._stepper.counts.held + self._brake.counts.held

    @property
    def stopped(self) -> bool:
        return bool(self._stopped)

    def push(self, time: float, seen: list[Seen] | None) -> bool:
        """The newest pose's tick [s] and its arms; False, and forgotten, where it is none."""
        if seen is None or not np.isfinite(time):
            return False
        dt, before = time - self._time, self._seen
        self._time, self._seen = time, seen
        if not before or not 0.0 < dt <= self._hold_after or self._jumped(before, seen, dt):
            if before and 0.0 < dt <= self._hold_after:
                self._approach("the pose jumped")
            self._smoothed = [_Smoothed.at(one) for one in seen]
            return True
        for smoothed, one in zip(self._smoothed, seen, strict=True):
            smoothed.push(one, dt, self._omega)
        return True

    def step(self, now: float, age: float) -> Command:
        """The next command; `now` [s] on the poses' clock, `age` [s] since a pose came."""
        if self._seen and age > self._stop_after and not self._stopped:
            self._stopped = f"no sound pose for {self._stop_after:g} s"
        if self._ending or self._stopped:
            return self._braked(self._ending or self._stopped, final=True)
        if not self._seen:
            return self._braked("waiting for a pose")
        if age > self._hold_after:
            return self._braked(f"no sound pose for {self._hold_after:g} s")
        return self._moved(now)

    def end(self, reason: str) -> None:
        """From now on brake, and stop for good."""
        self._ending = reason

    def resume(self) -> None:
        """Go on after a stop, by an approach, as soon as a pose comes; and approach anew where it follows."""
        if self._stopped:
            self._stopped, self._seen = "", []
        self._approach("set anew")

    def _jumped(self, before: list[Seen], seen: list[Seen], dt: float) -> bool:
        return any(
            float(np.linalg.norm(b.offset - a.offset)) > JUMP_SPEED * b.scale * dt
            or float(np.linalg.norm(pin.log3(b.rotation @ a.rotation.T))) > JUMP_RATE * dt
            for a, b in zip(before, seen, strict=True)
        )

    def _approach(self, why: str) -> None:
        self._references, self._why = None, why

    def _moved(self, now: float) -> Command:
        """Towards the newest pose."""
        dt = self.dt
        if self._references is None:
            self._stepper.look(self.state.u)
            self._references = []
            for i, arm in enumerate(self.robot.arms):
                hand, turn, _ = self._stepper.place(i)
                brisk = arm.reach * float(np.median(self.robot.a_most[arm.joints]))
                self._references.append(_Reference(hand, turn, brisk))
            self._smoothed = self._smoothed or [_Smoothed.at(one) for one in self._seen]
        for i, seen in enumerate(self._seen):
            wanted = trust_in(seen)
            self._trust[i] += (wanted - self._trust[i]) * -np.expm1(
                -dt / (TRUST_S if wanted > self._trust[i] else DOUBT_S)
            )
        ahead = float(np.clip(now - self._time, -dt, AHEAD_S))
        aims = [self._aim(i, ahead, moving=now - self._time <= AHEAD_S) for i in range(len(self._seen))]
        asked = tuple(reference.step(aim, dt) for reference, aim in zip(self._references, aims, strict=True))
        self.state = self._stepper.step(self.state, asked)
        error = np.empty((len(aims), 2))
        for i, aim in enumerate(aims):
            hand, turn, _ = self._stepper.place(i)
            error[i] = np.linalg.norm(hand - aim.position), np.linalg.norm(pin.log3(aim.rotation @ turn.T))
        if not all(reference.found for reference in self._references):
            return self._command("approach", self._why, error)
        self._why = ""
        poor = [(arm.side, seen) for arm, seen, trust in zip(self.robot.arms, self._seen, self._trust, strict=True)
                if trust < TRUSTED]  # fmt: skip
        return self._command("slow" if poor else "follow", "; ".join(_doubt(*one) for one in poor), error)

    def _aim(self, i: int, ahead: float, moving: bool) -> Aim:
        """Of arm `i`, `ahead` [s] of its newest pose; it stands where the next one is overdue."""
        smoothed, arm, go = self._smoothed[i], self.robot.arms[i], float(moving)
        offset = smoothed.offset + ahead * smoothed.offset_rate
        here, next_ = drawn_in(np.stack([offset, offset + self.dt * smoothed.offset_rate]), arm.reach)
        return Aim(
            arm.shoulder + here,
            go * (next_ - here) / self.dt,
            pin.exp3(ahead * smoothed.rate) @ smoothed.R,
            go * smoothed.rate,
            smoothed.bend + ahead * smoothed.bend_rate,
            float(self._trust[i]),
        )

    def _braked(self, reason: str, final: bool = False) -> Command:
        """To rest, within the limits."""
        self._approach(reason)
        state, dt = self.state, self.dt
        if (np.abs(state.v) > STANDS).any() or (np.abs(state.a) > STANDS / dt).any():
            fades = (np.abs(state.v) > FADES * self.robot.a_most * dt).any()
            self._brake.lean = (state.u, max(0.0, 1.0 - dt / BRAKE_S) * state.v if fades else np.zeros_like(state.v))
            self.state = self._brake.step(state, self._nowhere)
        else:
            self.state = State(state.u, np.zeros_like(state.v), np.zeros_like(state.a))
        error = np.full((len(self.robot.arms), 2), np.nan)
        resting = not (self.state.v.any() or self.state.a.any())
        return self._command("stopped" if final and resting else "hold", reason, error)

    def _command(self, state: str, reason: str, error: np.ndarray) -> Command:
        number, self._number = self._number, self._number + 1
        std = np.array([seen.std for seen in self._seen]) if self._seen else np.full(len(self.robot.arms), np.nan)
        u, v, a = self.state.u, self.state.v, self.state.a
        return Command(number, self._time, number * self.dt, state, reason, u, v, a, error, std)


def trust_in(seen: Seen) -> float:
    """`WEIGHT_POOR` to 1: as the trajectory of a recording weighs its hands (`person`)."""
    std = STD_POOR if seen.lost else np.nan_to_num(seen.std, nan=0.0)
    grade = float(np.clip((std - STD_GOOD) / (STD_POOR - STD_GOOD), 0.0, 1.0))
    return 1.0 - (1.0 - WEIGHT_POOR) * grade**2 * (3.0 - 2.0 * grade)


def _doubt(side: str, seen: Seen) -> str:
    if seen.lost:
        return f"no samples from {', '.join(name.replace('_', ' ') for name in seen.lost)}"
    return f"the {side} hand is uncertain by {1e3 * seen.std:.0f} mm"
