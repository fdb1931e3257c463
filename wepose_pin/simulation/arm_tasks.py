"""Tasks of the arms with known truth: reaches, rests of seconds and typing, each arm for itself, while standing.

Trunk and arms go from posture to posture, in joint angles. The postures and times are held to what people do with
their arms in a day: still for about 43 % of the time in pieces of seconds (Bailey & Lang 2013, J Rehabil Res Dev 50,
1213), the upper arm above 60 deg for 4 to 8 % and above 90 for 1 to 3 % (Lewis 2026, Ann Work Expo Health 70), trunk up
to 23 deg of lean, 32 of turn and 59 of bend (Gates 2016, Am J Occup Ther 70); speeds are assumptions.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..model import DEFAULT_BODY, BodyModel
from ..rotations import compose, turn_about
from .motion import E_Z, MARGIN_S, SEGMENTS, SIDES, STAND_S, BodyMotion, BodyPose, Flaws, place_arm, place_sensors
from .signals import Process, make_pulse, make_step

_END_S = 2.0  # the person stands still at the end
_RAMP_S = 2.0
_RATE_STEP_S = 0.02  # for the rate of elevation
_TYPING_S = (2.0, 8.0)
_TYPING = np.deg2rad((0.0, 0.0, 1.0, 0.7, 1.5))  # [rad] rms of each angle of the arm
_TYPING_CORRELATION_S = 0.05


class _Kind(NamedTuple):
    """A kind of posture of an arm: how often it is, mean and spread [deg] of its angles between postures."""

    share: float
    mean: tuple[float, float, float, float, float]  # elevation, plane, inward twist, elbow flexion, inward pronation
    std: tuple[float, float, float, float, float]
    typing: bool = False


_KINDS = (
    _Kind(0.54, (28.0, 60.0, 20.0, 75.0, 20.0), (10.0, 30.0, 18.0, 20.0, 25.0)),  # work before the body
    _Kind(0.12, (22.0, 65.0, 25.0, 85.0, 45.0), (6.0, 20.0, 8.0, 8.0, 8.0), typing=True),
    _Kind(0.12, (78.0, 60.0, 0.0, 35.0, 10.0), (24.0, 30.0, 20.0, 15.0, 25.0)),  # reach far and high
    _Kind(0.10, (45.0, 70.0, 10.0, 118.0, 0.0), (10.0, 15.0, 15.0, 8.0, 20.0)),  # hand to the face
    _Kind(0.12, (10.0, 30.0, 5.0, 20.0, 5.0), (4.0, 40.0, 8.0, 8.0, 12.0)),  # hanging
)
_RANGE = np.deg2rad(((4.0, -30.0, -60.0, 8.0, -60.0), (130.0, 120.0, 70.0, 130.0, 70.0)))
_SPEED = np.deg2rad(95.0)  # [rad/s] mean over a move, of the angle that turns most
_SHORTEST_S = 0.4
_REST_SHARE = 0.3  # of the postures
_REST_S = 2.0  # mean of a rest
_PAUSE_S = 0.15  # at the other postures
_TRUNK_STD = np.deg2rad((4.0, 10.0, 13.0))  # roll, pitch, turn
_TRUNK_MEAN = np.deg2rad((0.0, 10.0, 0.0))
_TRUNK_MOST = np.deg2rad((23.0, 59.0, 32.0))


class _Path:
    """Values (n, k) that go from posture to posture, standing still between them, and the time spent moving."""

    def __init__(self, first: np.ndarray) -> None:
        self.postures, self.start, self.duration = [first], [0.0], [1.0]
        self.typing: list[tuple[float, float]] = []

    def move(self, posture: np.ndarray, start: float, duration: float) -> None:
        """Append a move."""
        self.postures.append(posture)
        self.start.append(start)
        self.duration.append(duration)

    def close(self) -> None:
        """Freeze the path."""
        self._values = np.array([self.postures[0], *self.postures])
        self._start, self._duration = np.array(self.start), np.array(self.duration)
        moved = np.concatenate(([0.0, 0.0], np.cumsum(self._duration[1:])))
        self._values = np.column_stack((self._values, moved))

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (n, k) and the time (n,) [s] spent moving at the times `t` (n,) [s]."""
        k = np.clip(np.searchsorted(self._start, t, side="right") - 1, 0, None)
        share = make_step((t - self._start[k]) / self._duration[k], 0.0, 1.0)[:, None]
        values = self._values[k] + share * (self._values[k + 1] - self._values[k])
        return values[:, :-1], values[:, -1]


class ArmTasks(BodyMotion):
    """Random reaches, rests and typing of both arms, while the trunk leans and turns."""

    phase = "tasks"
    body = DEFAULT_BODY

    def __init__(self, model: BodyModel, rng: np.random.Generator, seconds: float, flaws: Flaws) -> None:
        self.flaws, self.lengths, self.seconds = flaws, model.lengths, seconds
        self.p_LS = place_sensors(self.lengths, flaws.sizes)
        self.trunk = self._draw_trunk(rng)
        self.arms = {side: self._draw_arm(rng, side) for side in SIDES}
        self.tremble = {side: Process(rng, _TYPING_CORRELATION_S, 5) for side in SIDES}
        grid = np.arange(*self.span, 0.1)
        if flaws.wrists.bend:
            distance = np.column_stack([self._distance(grid, side) for side in SIDES])
            flaws.wrists.fit(grid, self.activity(grid), distance)

    @property
    def span(self) -> tuple[float, float]:
        return STAND_S, STAND_S + self.seconds + _END_S

    def activity(self, t: np.ndarray) -> np.ndarray:
        return make_pulse(t, STAND_S, STAND_S + self.seconds, _RAMP_S)

    def moving_time(self, t: np.ndarray, segment: str = "", /) -> np.ndarray:
        return self.arms.get(segment.partition("_")[0], self.trunk)(t)[1]

    def phases(self) -> dict[str, list[tuple[float, float]]]:
        stop = STAND_S + self.seconds
        return {
            "start": [(0.5, STAND_S - 0.5)],
            self.phase: [(STAND_S + MARGIN_S, stop - MARGIN_S)],
            "rest": [(stop + MARGIN_S, stop + _END_S - MARGIN_S)],
        }

    def _draw_trunk(self, rng: np.random.Generator) -> _Path:
        """Draw the path of the trunk's rotation vector (3,) [rad], from the start pose and back to it."""
        start = self.flaws.start_pose.torso
        path, at, stop = _Path(start), STAND_S, STAND_S + self.seconds
        while True:
            posture = np.clip(_TRUNK_MEAN + _TRUNK_STD * rng.standard_normal(3), -_TRUNK_MOST, _TRUNK_MOST)
            duration, hold = rng.uniform(1.0, 2.5), rng.exponential(3.0)
            if at + duration + hold > stop - _RAMP_S:
                path.move(start, stop - _RAMP_S, _RAMP_S)
                path.close()
                return path
            path.move(posture, at, duration)
            at += duration + hold

    def _draw_arm(self, rng: np.random.Generator, side: str) -> _Path:
        """Draw the path of an arm, from the start pose and back to it.

        Values: rotation vector of the elevation about x and y of the torso, twist, elbow flexion, pronation [rad].
        """
        y, pose = SIDES[side], self.flaws.start_pose
        start = np.array((*pose.upper_arm[side], pose.flexion[side], pose.pronation[side]))
        path, at, stop, before = _Path(start), STAND_S, STAND_S + self.seconds, start
        while True:
            kind = _KINDS[rng.choice(len(_KINDS), p=[kind.share for kind in _KINDS])]
            drawn = np.deg2rad(np.array(kind.mean) + np.array(kind.std) * rng.standard_normal(5))
            elevation, plane, twist, flexion, pronation = np.clip(drawn, *_RANGE)
            swing = elevation * np.array((y * np.cos(plane), -np.sin(plane)))
            posture = np.array((*swing, -y * twist, flexion, -y * pronation))
            duration = max(_SHORTEST_S, np.abs(posture - before).max() / _SPEED * rng.uniform(0.7, 1.5))
            hold, rest = rng.exponential(_PAUSE_S), rng.exponential(_REST_S)
            rests, types = rng.uniform() < _REST_SHARE, rng.uniform(*_TYPING_S)
            hold = types if kind.typing else rest if rests else hold
            if at + duration + hold > stop - _RAMP_S:
                path.move(start, stop - _RAMP_S, _RAMP_S)
                path.close()
                return path
            path.move(posture, at, duration)
            if kind.typing:
                path.typing.append((at + duration, at + duration + hold))
            at += duration + hold
            before = posture

    def _angles(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the arm's values (n, 5) [rad], as `_draw_arm` has them."""
        values, _ = self.arms[side](t)
        typing = sum((make_pulse(t, a, b, 0.5) for a, b in self.arms[side].typing), np.zeros_like(t))
        return values + _TYPING * typing[:, None] * self.tremble[side](t)

    def _distance(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the distance (n,) [m] of the hand from the middle of the shoulders, by the elbow's angle."""
        values, _ = self.arms[side](t)
        upper = self.lengths[f"{side}_upper_arm"]
        lower = self.lengths[f"{side}_forearm"] + self.lengths[f"{side}_hand"]
        return np.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * np.cos(values[:, 3]))

    def _raising(self, t: np.ndarray, side: str) -> np.ndarray:
        """Compute the rate (n,) [deg/s] at which the arm is raised."""
        before, after = (
            np.linalg.norm(self._angles(t + step, side)[:, :2], axis=1) for step in (-_RATE_STEP_S, _RATE_STEP_S)
        )
        return np.rad2deg(after - before) / (2.0 * _RATE_STEP_S)

    def __call__(self, t: np.ndarray, segments: Collection[str] = SEGMENTS) -> BodyPose:
        """Return the exact pose of the torso and of the arms of the segments' sides at the times `t` (n,) [s]."""
        flaws, sizes = self.flaws, self.flaws.sizes
        sway, tilt = np.deg2rad(sizes.sway_deg_s), np.deg2rad(sizes.sway_tilt_deg) / np.sqrt(2.0)
        lean = self.trunk(t)[0]
        lean[:, :2] += sway * flaws.sway["torso"](t) + tilt * flaws.tilt(t)
        R_WT = Rotation.from_rotvec(lean)
        R_WL, origins = {"torso": R_WT}, {"torso": np.zeros(3)}
        points: dict[str, np.ndarray] = {}
        for side in [side for side in SIDES if any(segment.startswith(side) for segment in segments)]:
            y, angles = SIDES[side], self._angles(t, side)
            swing = np.pad(angles[:, :2], ((0, 0), (0, 1)))
            R_TU = compose(Rotation.from_rotvec(swing), turn_about("Z", angles[:, 2:3]))
            hanging = make_pulse(t, -10.0, STAND_S + 0.5, 0.5) + make_step(t, self.span[1] - _END_S - 0.5, 0.5)
            swaying = sway * hanging[:, None] * np.pad(flaws.sway[side](t), ((0, 0), (0, 1)))
            R_TU = compose(R_TU, Rotation.from_rotvec(swaying))
            along_T = R_TU.apply(-E_Z)
            shoulder_T = np.array((0.0, 0.5 * y * self.lengths["shoulder_width"], self.lengths["trunk"]))
            shoulder_T = shoulder_T + flaws.girdle.place(y, self.moving_time(t, f"{side}_upper_arm"))
            raising = self._raising(t, side) if sizes.girdle_hysteresis else np.zeros_like(t)
            shoulder_T = shoulder_T + flaws.girdle.displace(along_T, y, raising)
            R_WU = compose(R_WT, R_TU)
            R_WF = compose(R_WU, flaws.elbow_joint.rotate(y, angles[:, 3], angles[:, 4]))
            R_WH = R_WF
            if flaws.wrists.bend:
                none = np.zeros_like(t)
                R_WH = compose(R_WF, flaws.wrists.rotate(y, t, self.activity(t), none, self._distance(t, side)))
            R_WL[f"{side}_upper_arm"], R_WL[f"{side}_forearm"] = R_WU, R_WF
            points |= place_arm(R_WT.apply(shoulder_T), side, (R_WU, R_WF, R_WH), self.lengths)
            origins |= {f"{side}_upper_arm": points[f"{side}_shoulder"], f"{side}_forearm": points[f"{side}_elbow"]}
        return BodyPose(R_WL, points, origins)
