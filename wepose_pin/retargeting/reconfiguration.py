"""Where an arm stays away from targets that it could reach: which other posture to continue from, and how to get there.

An arm of six joints reaches a hand pose in several postures. One that follows the hand step by step stays in its family
of postures until a joint limit or its own links stop it, though another family goes on. As in IKLink (Wang, Sisco and
Gleicher 2024, "End-effector trajectory tracking with minimal reconfigurations") the arm then leaves its path, moves to
the posture from which it follows the longest, and continues. No other change would need fewer reconfigurations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from .collision import CollisionModel
from .controller import ControllerParams, JointState, QpController
from .robot import Robot
from .targets import ArmTargets, HandPath, HandTarget

# [m] of a hand's position; its rotation counts as the tasks weigh it: 8 and 20 deg as much. Beyond the first a posture
# to begin with is compared with others; beyond the second the arm leaves its path for another posture.
BEGIN_LOST_M, LOST_M = 0.02, 0.05
LOST_S = 1.0  # [s] for which such an error lasts when the arm is lost
REACHED_M = 0.01  # [m] below it, rotation included, a posture reaches its targets
HORIZON_S = 10.0  # [s] over which postures are compared
ALIKE_S = 0.5  # [s] of being lost, below which a difference between postures does not count: the nearest is taken
MIN_WEIGHT = 0.5  # of a hand; where its target is more uncertain, its error does not count
RANDOM_STARTS = 12  # of the search for postures
SEARCH_STEPS = 25
SAME_POSTURE = 0.3  # [rad or m] largest difference of a joint between two postures that are one
PENETRATION_M = 4e-3  # into the clearance, above which a posture does not count as reached
CHANGE_SPEED_SHARE = 0.5  # of the limits of velocity and acceleration, which a change of posture uses
CHANGE_CHECKS = 40  # postures on the way that are checked for self-contact
CHANGE_REST_S = 0.2  # after it
QUINTIC_PEAK_SPEED, QUINTIC_PEAK_ACCELERATION = 1.875, 5.774  # from rest to rest, over distance and duration


class Posture(NamedTuple):
    """A posture that a search ended in."""

    position: np.ndarray  # (n,) [rad or m]
    distance: np.ndarray  # (arms,) [m] of the hands from their targets
    cost: np.ndarray  # (arms,) of position and rotation, as the tasks weigh them


class PostureSearch:
    """Moves the robot as near to targets as joints and clearances allow, without limits of time."""

    def __init__(self, robot: Robot, collision: CollisionModel, params: ControllerParams) -> None:
        weights = {"joint_velocity_change": 0.0, "posture": 1e-5, "joint_velocity": 1e-4}
        params = replace(params, task_gain=40.0, max_correction_deceleration=1e9, **weights)
        self.controller = QpController(robot, collision, 0.01, params, limit_factor=1e4, guarded=False)

    def search(self, targets: tuple[HandTarget, ...], start: np.ndarray) -> Posture | None:
        """Return the posture that is found from `start` (n,); None where links are too near each other in it."""
        rest = np.zeros(3)
        targets = tuple(target._replace(velocity=rest, angular_velocity=rest, weight=1.0) for target in targets)
        state = JointState.at_rest(start)
        for _ in range(SEARCH_STEPS):
            state = self.controller.step(state, targets)
        if not self.is_clear(state.position):
            return None
        return Posture(state.position, *measure_errors(self.controller, targets))

    def is_clear(self, position: np.ndarray) -> bool:
        """Whether all pairs of links keep their clearance at joint positions (n,)."""
        self.controller.update_kinematics(position)
        near = self.controller.collision.find_near_pairs(self.controller.data)
        return not bool((near.distance < near.clearance - PENETRATION_M).any())


def measure_errors(controller: QpController, targets: tuple[HandTarget, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [m] and cost (arms,) of the hands against their targets, at the controller's joint positions."""
    poses = [controller.get_arm_pose(i) for i in range(len(targets))]
    distance, angle = np.array(
        [
            (np.linalg.norm(pose.hand - target.position), np.linalg.norm(pin.log3(pose.rotation.T @ target.rotation)))
            for pose, target in zip(poses, targets, strict=True)
        ]
    ).T
    return distance, _compute_cost(controller.params, distance, angle)


def find_lost(
    params: ControllerParams, targets: tuple[HandPath, ...], hand: np.ndarray, rotation: np.ndarray, error_m: float
) -> np.ndarray:
    """Return (n, arms) bool: the hand at (arms, n, 3), (arms, n, 3, 3) is `error_m` off a target that is certain."""
    lost = []
    for target, at, turned in zip(targets, hand, rotation, strict=True):
        distance = np.linalg.norm(at - target.position, axis=1)
        angle = (Rotation.from_matrix(turned).inv() * Rotation.from_matrix(target.rotation)).magnitude()
        lost.append((_compute_cost(params, distance, angle) > _limit_cost(params, error_m)) & _is_certain(target))
    return np.stack(lost, axis=1)


def find_lasting(lost: np.ndarray, samples: int) -> list[tuple[int, int]]:
    """Return begin and end of each run of at least `samples` true values (n,) in `lost`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= samples]


def _is_certain(target: HandPath) -> np.ndarray:
    """Return (n,) bool: the target is measured, and not so uncertain that its error does not count."""
    return np.asarray((target.weight >= MIN_WEIGHT) & ~target.lost)


def _compute_cost(params: ControllerParams, distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return params.position * distance**2 + params.orientation * angle**2


def _limit_cost(params: ControllerParams, error_m: float) -> float:
    """Return the cost of a hand that is `error_m` off, or rotated by what the tasks weigh alike."""
    return error_m**2 * (params.position or 1.0)


class _Run(NamedTuple):
    """The motion as followed from one of its samples on."""

    first: int  # that sample
    position: np.ndarray  # (m, joints)
    lost: np.ndarray  # (m, arms) bool: the hand is farther off than allowed


class _Part(NamedTuple):
    """A part of the plan."""

    samples: np.ndarray  # (m,) int, of the motion
    position: np.ndarray  # (m, joints)
    changing: np.ndarray  # (arms,) bool: arms that change their posture


@dataclass
class Planner:
    """Plans changes of posture where the arms would stay away from targets that they can reach.

    Parameters
    ----------
    controller : follows the motion
    motion : targets; `approach_samples` of them are the way from the rest posture
    """

    controller: QpController
    motion: ArmTargets
    approach_samples: int

    def __post_init__(self) -> None:
        self._robot, dt = self.controller.robot, self.controller.dt
        self._search = PostureSearch(self._robot, self.controller.collision, self.controller.params)
        self._targets = [hand.compute_step_targets(dt) for hand in self.motion.hands]
        self._certain = np.stack([_is_certain(hand) for hand in self.motion.hands], axis=1)
        self._lasting, self._horizon = round(LOST_S / dt), round(HORIZON_S / dt)

    def plan(self, path: np.ndarray, hand: np.ndarray, rotation: np.ndarray) -> tuple[ArmTargets, np.ndarray, int]:
        """Return the motion, the joints' path to follow (n, joints), and the number of samples of the approach.

        Those given where no change of posture helps. While an arm changes its posture, its hand's weight is 0.

        Parameters
        ----------
        path, hand, rotation : (n, joints), (arms, n, 3), (arms, n, 3, 3), as the controller followed the motion
        """
        n, begin, approach_samples = len(path), self.approach_samples, self.approach_samples
        lost = [find_lost(self.controller.params, self.motion.hands, hand, rotation, m) for m in (BEGIN_LOST_M, LOST_M)]
        everywhere = np.ones(len(self._robot.arms), dtype=bool)
        parts: list[_Part] = []
        run = _Run(0, path, lost[1])
        failure = self._find_failure(_Run(0, path, lost[0]), begin)
        if failure is not None:  # another posture to begin with
            change = self._choose(begin, self._robot.rest, failure[2], lost[0][begin:], BEGIN_LOST_M)
            if change is not None:
                parts.append(_Part(np.full(len(change), begin), change, everywhere))
                run, approach_samples = self._follow(change[-1], begin, n), len(change)
        while (failure := self._find_failure(run, begin)) is not None:
            first, last, arms = failure
            at = first - run.first
            change = self._choose(first, run.position[at], arms, run.lost[at:][: self._horizon])
            begin = last
            if change is not None:
                parts.append(_Part(np.arange(run.first, first), run.position[:at], ~everywhere))
                parts.append(_Part(np.full(len(change), first), change, arms))
                run, begin = self._follow(change[-1], first, n), first
        if not parts:
            return self.motion, path, approach_samples
        parts.append(_Part(np.arange(run.first, n), run.position, ~everywhere))
        motion = self.motion.select(np.concatenate([part.samples for part in parts]), self.controller.dt)
        changing = np.concatenate([np.tile(part.changing, (len(part.samples), 1)) for part in parts])
        hands = tuple(
            path._replace(weight=np.where(changing[:, i], 0.0, path.weight)) for i, path in enumerate(motion.hands)
        )
        return replace(motion, hands=hands), np.concatenate([part.position for part in parts]), approach_samples

    def _follow(
        self, position: np.ndarray, begin: int, end: int, error_m: float = LOST_M, most: float = np.inf
    ) -> _Run:
        """Follow the motion from rest at `position` (n,), from sample `begin` to `end`, or until `most` are lost."""
        state, positions, lost = JointState.at_rest(position), [], []
        limit = _limit_cost(self.controller.params, error_m)
        for k in range(begin, end):
            positions.append(state.position)
            targets = tuple(target.sample(k) for target in self._targets)
            state = self.controller.step(state, targets)
            lost.append((measure_errors(self.controller, targets)[1] > limit) & self._certain[k])
            most -= lost[-1].any()
            if most < 0:
                break
        return _Run(begin, np.array(positions), np.array(lost))

    def _find_failure(self, run: _Run, begin: int) -> tuple[int, int, np.ndarray] | None:
        """Return the first samples from `begin` on in which an arm is lost for `LOST_S`, and which arms are (arms,)."""
        spans = [span for lost in run.lost.T for span in find_lasting(lost[begin - run.first :], self._lasting)]
        if not spans:
            return None
        first, last = (begin + k for k in min(spans))
        return first, last, np.any(run.lost[first - run.first : last - run.first], axis=0)

    def _choose(
        self, k: int, start: np.ndarray, arms: np.ndarray, lost: np.ndarray, error_m: float = LOST_M
    ) -> np.ndarray | None:
        """Return the way (m, joints) from `start` to the posture from which the arms follow best; None: none is better.

        `lost` (m, arms) are the samples from `k` on that it has to better, by as long as the way there takes the hand
        off its path. The approach is needed anyhow.
        """
        best: np.ndarray | None = None
        least = lost.any(axis=1).sum() - self._lasting
        for posture in self._find_postures(k, start, arms):
            way = self._find_way(start, posture)
            if way is None:
                continue
            followed = np.any(self._follow(posture, k, k + len(lost), error_m, least).lost, axis=1)
            count = followed.sum() + (0 if k == self.approach_samples else len(way))
            if followed[: self._lasting].any() or count > least:
                continue
            alike = count > least - round(ALIKE_S / self.controller.dt)
            if best is None or not alike or len(way) < len(best):
                best, least = way, min(count, least)
        return best

    def _find_postures(self, k: int, start: np.ndarray, arms: np.ndarray) -> list[np.ndarray]:
        """Return postures that reach the targets of sample `k`; only the joints of `arms` may differ much."""
        robot, targets = self._robot, tuple(target.sample(k) for target in self._targets)
        joints = np.concatenate([arm.joints for arm, moves in zip(robot.arms, arms, strict=True) if moves])
        rng, limit = np.random.default_rng(0), _limit_cost(self.controller.params, REACHED_M)
        starts = np.tile(start, (RANDOM_STARTS + 3, 1))
        others = [robot.rest, self._unwind(start), *rng.uniform(*robot.bounds, (RANDOM_STARTS, len(start)))]
        starts[1:, joints] = np.array(others)[:, joints]
        postures: list[np.ndarray] = []
        for each in starts:
            posture = self._search.search(targets, each)
            if posture is None or (posture.cost[arms] > limit).any():
                continue
            for position in (posture.position, self._unwind(posture.position)):
                if all(np.abs(position - other).max() > SAME_POSTURE for other in postures):
                    postures.append(position)
        return postures

    def _unwind(self, position: np.ndarray) -> np.ndarray:
        """Return joint positions (n,) with whole turns taken off, where that is the same posture nearer the middle."""
        lower, upper = self._robot.lower, self._robot.upper
        winds = np.isfinite(upper - lower) & (upper - lower > 2.0 * np.pi)
        middle = np.where(winds, 0.5 * (lower + upper), position)
        return np.asarray(position - 2.0 * np.pi * np.round((position - middle) / (2.0 * np.pi)))

    def _find_way(self, start: np.ndarray, end: np.ndarray) -> np.ndarray | None:
        """Return positions (m, joints) on the way, in a straight line or over the rest posture; None: links meet."""
        shares = np.linspace(0.0, 1.0, CHANGE_CHECKS)[1:]
        for stops in ((start, end), (start, self._robot.rest, end)):
            if all(self._search.is_clear(a + x * (b - a)) for a, b in pairwise(stops) for x in shares):
                return np.concatenate([self._interpolate(a, b) for a, b in pairwise(stops)])
        return None

    def _interpolate(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return positions (m, joints) from rest to rest."""
        robot, dt, way = self._robot, self.controller.dt, np.abs(end - start)
        by_velocity = QUINTIC_PEAK_SPEED * way / (CHANGE_SPEED_SHARE * robot.v_max)
        by_acceleration = np.sqrt(QUINTIC_PEAK_ACCELERATION * way / (CHANGE_SPEED_SHARE * robot.a_max))
        steps = max(1, round(float(np.maximum(by_velocity, by_acceleration).max()) / dt))
        x = np.minimum(np.arange(steps + round(CHANGE_REST_S / dt)) / steps, 1.0)[:, None]
        return start + x**3 * (10.0 - 15.0 * x + 6.0 * x**2) * (end - start)
