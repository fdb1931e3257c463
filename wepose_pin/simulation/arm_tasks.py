"""Tasks of the arms with known truth: reaches, rests of seconds and typing, each arm for itself, while standing.

Trunk and arms go from posture to posture, in joint angles. The postures and times are held to what people do with
their arms in a day: still for about 43 % of the time in pieces of seconds (Bailey & Lang 2013, J Rehabil Res Dev 50,
1213), the upper arm above 60 deg for 4 to 8 % and above 90 for 1 to 3 % (Lewis 2026, Ann Work Expo Health 70), trunk up
to 23 deg of lean, 32 of turn and 59 of bend (Gates 2016, Am J Occup Ther 70); speeds are assumptions.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import DEFAULT_BODY, BodyModel
from ..rotations import compose, turn_about
from .motion import MARGIN_S, RAMP_S, SEGMENTS, STAND_S, BodyMotion, place_arm
from .people import E_Z, SIDES, BodyPose, Flaws
from .signals import Process, make_pulse, make_step

END_S = 2.0  # after an activity the person stands still
_TYPING_S = (2.0, 8.0)
_TYPING = np.deg2rad((0.0, 0.0, 1.0, 0.7, 1.5))  # [rad] rms of each angle of the arm
_TYPING_CORRELATION_S = 0.05


# Kinds of postures of an arm: how often each is; mean and spread [deg] of elevation, plane, inward twist, elbow flexion
# and inward pronation between postures.
_KINDS = (
    (0.54, (28.0, 60.0, 20.0, 75.0, 20.0), (10.0, 30.0, 18.0, 20.0, 25.0)),  # work before the body
    (0.12, (22.0, 65.0, 25.0, 85.0, 45.0), (6.0, 20.0, 8.0, 8.0, 8.0)),  # typing
    (0.12, (78.0, 60.0, 0.0, 35.0, 10.0), (24.0, 30.0, 20.0, 15.0, 25.0)),  # reach far and high
    (0.10, (45.0, 70.0, 10.0, 118.0, 0.0), (10.0, 15.0, 15.0, 8.0, 20.0)),  # hand to the face
    (0.12, (10.0, 30.0, 5.0, 20.0, 5.0), (4.0, 40.0, 8.0, 8.0, 12.0)),  # hanging
)
_TYPING_KIND = 1
_RANGE = np.deg2rad(((4.0, -30.0, -60.0, 8.0, -60.0), (130.0, 120.0, 70.0, 130.0, 70.0)))
_SPEED = np.deg2rad(95.0)  # [rad/s] mean over a move, of the angle that turns most
_SHORTEST_S = 0.4
_REST_SHARE = 0.3  # of the postures
_REST_S = 2.0  # mean of a rest
_PAUSE_S = 0.15  # at the other postures
_TRUNK_STD = np.deg2rad((4.0, 10.0, 13.0))  # roll, pitch, turn
_TRUNK_MEAN = np.deg2rad((0.0, 10.0, 0.0))
_TRUNK_MOST = np.deg2rad((23.0, 59.0, 32.0))


# A move: to which posture (k,), in what time [s], for how long it is held [s], and whether the hand types meanwhile.
_Move = tuple[np.ndarray, float, float, bool]


class _Path:
    """Values (n, k) that go from posture to posture, standing still between them, and the time spent moving."""

    def __init__(self, rest: np.ndarray, stop: float, draw: Callable[[np.ndarray], _Move]) -> None:
        """Go from `rest` (k,) and be back at `stop` [s]; `draw` draws the next move from a posture."""
        postures, start, durations, at = [rest, rest], [0.0], [1.0], STAND_S
        self.typing: list[tuple[float, float]] = []
        while True:
            posture, duration, hold, types = draw(postures[-1])
            arrived = at + duration
            if arrived + hold > stop - RAMP_S:
                break
            postures.append(posture)
            start.append(at)
            durations.append(duration)
            if types:
                self.typing.append((arrived, arrived + hold))
            at += duration + hold
        self._start, self._duration = np.array([*start, stop - RAMP_S]), np.array([*durations, RAMP_S])
        moved = np.concatenate(([0.0, 0.0], np.cumsum(self._duration[1:])))
        self._values = np.column_stack((np.array([*postures, rest]), moved))

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (n, k) and the time (n,) [s] spent moving at the times `t` (n,) [s]."""
        k = np.clip(np.searchsorted(self._start, t, side="right") - 1, 0, None)
        share = make_step((t - self._start[k]) / self._duration[k], 0.0, 1.0)[:, None]
        values = self._values[k] + share * (self._values[k + 1] - self._values[k])
        return values[:, :-1], values[:, -1]


class Activity(BodyMotion):
    """An activity of some seconds, after standing in the N-pose and before standing still."""

    phase: str
    body: str  # the model's name

    def __init__(self, model: BodyModel, seconds: float, flaws: Flaws) -> None:
        super().__init__(flaws)
        self.model, self.seconds, self.stop = model, seconds, STAND_S + seconds
        self.end = self.stop + END_S
        self.pulses = [(STAND_S, self.stop, RAMP_S)]
        self.phases[self.phase] = [(STAND_S + MARGIN_S, self.stop - MARGIN_S)]
        self.phases["rest"] = [(self.stop + MARGIN_S, self.end - MARGIN_S)]
        self.prepare(flaws.rngs["motion"])

    @abstractmethod
    def prepare(self, rng: np.random.Generator) -> None:
        """Draw what is this person's own."""


class ArmTasks(Activity):
    """Random reaches, rests and typing of both arms, while the trunk leans and turns."""

    phase = "tasks"
    body = DEFAULT_BODY

    def prepare(self, rng: np.random.Generator) -> None:
        self.trunk = _Path(self.flaws.start_pose.torso, self.stop, lambda _: self._draw_trunk(rng))
        self.arms = {side: self._draw_arm(rng, side) for side in SIDES}
        self.tremble = {side: Process(rng, _TYPING_CORRELATION_S, 5) for side in SIDES}
        grid = np.arange(STAND_S, self.end, 0.1)
        distance = np.column_stack([self._distance(grid, side) for side in SIDES])
        self.flaws.wrists.fit(grid, self.activity(grid), distance)

    def moving_time(self, t: np.ndarray, segment: str = "", /) -> np.ndarray:
        return self.arms.get(segment.partition("_")[0], self.trunk)(t)[1]

    @staticmethod
    def _draw_trunk(rng: np.random.Generator) -> _Move:
        """Draw a move of the trunk, by its rotation vector (3,) [rad]."""
        posture = np.clip(_TRUNK_MEAN + _TRUNK_STD * rng.standard_normal(3), -_TRUNK_MOST, _TRUNK_MOST)
        return posture, rng.uniform(1.0, 2.5), rng.exponential(3.0), False

    def _draw_arm(self, rng: np.random.Generator, side: str) -> _Path:
        """Draw the path of an arm: elevation about x and y of the torso, twist, elbow flexion, pronation [rad]."""
        y, pose = SIDES[side], self.flaws.start_pose

        def draw(before: np.ndarray) -> _Move:
            kind = rng.choice(len(_KINDS), p=[share for share, _, _ in _KINDS])
            _, mean, std = _KINDS[kind]
            drawn = np.deg2rad(np.array(mean) + np.array(std) * rng.standard_normal(5))
            elevation, plane, twist, flexion, pronation = np.clip(drawn, *_RANGE)
            swing = elevation * np.array((y * np.cos(plane), -np.sin(plane)))
            posture = np.array((*swing, -y * twist, flexion, -y * pronation))
            duration = max(_SHORTEST_S, np.abs(posture - before).max() / _SPEED * rng.uniform(0.7, 1.5))
            hold, rest = rng.exponential(_PAUSE_S), rng.exponential(_REST_S)
            hold, typing_s = rest if rng.uniform() < _REST_SHARE else hold, rng.uniform(*_TYPING_S)
            return (posture, duration, typing_s, True) if kind == _TYPING_KIND else (posture, duration, hold, False)

        return _Path(np.array((*pose.upper_arm[side], pose.flexion[side], pose.pronation[side])), self.stop, draw)

    def _distance(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the distance (n,) [m] of the hand from the middle of the shoulders, by the elbow's angle."""
        upper = self.lengths[f"{side}_upper_arm"]
        lower = self.lengths[f"{side}_forearm"] + self.lengths[f"{side}_hand"]
        return np.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * np.cos(self.arms[side](t)[0][:, 3]))

    def __call__(self, t: np.ndarray, segments: Collection[str] = SEGMENTS) -> BodyPose:
        flaws = self.flaws
        lean = self.trunk(t)[0]
        lean[:, :2] += flaws.sway_torso(t)
        R_WT = Rotation.from_rotvec(lean)
        pose = BodyPose({"torso": R_WT}, {}, {"torso": np.zeros(3)})
        for side in [side for side in SIDES if any(segment.startswith(side) for segment in segments)]:
            y = SIDES[side]
            typing = sum((make_pulse(t, a, b, 0.5) for a, b in self.arms[side].typing), np.zeros_like(t))
            angles = self.arms[side](t)[0] + _TYPING * typing[:, None] * self.tremble[side](t)
            swing = np.pad(angles[:, :2], ((0, 0), (0, 1)))
            hanging = make_pulse(t, -10.0, STAND_S + 0.5, 0.5) + make_step(t, self.stop - 0.5, 0.5)
            swaying = Rotation.from_rotvec(hanging[:, None] * flaws.sway_arm(t, side))
            R_TU = compose(Rotation.from_rotvec(swing), turn_about("Z", angles[:, 2:3]), swaying)
            R_WU = compose(R_WT, R_TU)
            R_WF = compose(R_WU, flaws.elbow_joint.rotate(y, angles[:, 3], angles[:, 4]))
            R_FH = flaws.wrists.rotate(y, t, self.activity(t), np.zeros_like(t), self._distance(t, side))
            shoulder_T = flaws.girdle.place(y, self.moving_time(t, f"{side}_upper_arm"))
            shoulder_T = shoulder_T + flaws.girdle.displace(R_TU.apply(-E_Z), y)
            place_arm(pose, side, R_WT.apply(shoulder_T), (R_WU, R_WF, compose(R_WF, R_FH)), flaws)
        return pose
