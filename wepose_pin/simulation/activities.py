"""Activities with known truth: tasks of the arms, walking on the spot, sitting down, running, throwing.

In tasks of the arms, trunk and arms go from posture to posture, each arm for itself. The postures and times are held to
what people do in a day: still for about 43 % of the time in pieces of seconds (Bailey & Lang 2013, J Rehabil Res Dev
50, 1213), the upper arm above 60 deg for 4 to 8 % and above 90 for 1 to 3 % (Lewis 2026, Ann Work Expo Health 70),
trunk up to 23 deg of lean, 32 of turn and 59 of bend (Gates 2016, Am J Occup Ther 70); speeds are assumptions.

An activity of the whole body is a set of joint angles as closed forms of time, of the hips and ankles after Wu et al.
2002, of the knees after Grood and Suntay 1983; segment orientations are put together from them here, without the code
of the angles room. Where the segments and their sensors are follows from the model's placements at rest. Points are
relative to the root, midway between the hips, so a person who sits down raises the feet. A person who runs moves the
root, which the accelerometers measure.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ..body import DEFAULT_BODY, BodyModel
from ..body.kinematics import compute_link_poses
from ..errors import BadOption
from ..rotations import compose, turn_about
from .motion import ARM, MARGIN_S, RAMP_S, STAND_S, BodyMotion, place_arm
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
# Signs by which angles of a right leg, with the names and signs of `angles.JOINTS`, are turns about y, x, z; those of a
# left one about x and z are of opposite sign.
_LEG_SIGNS = {"thigh": (-1.0, 1.0, 1.0), "shank": (1.0, 1.0, -1.0), "foot": (-1.0, 1.0, 1.0)}


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
        self.prepare(flaws.rngs["motion"])  # draws what is this person's own

    @abstractmethod
    def prepare(self, rng: np.random.Generator) -> None: ...


# Tasks of the arms ----------------------------------------------------------------------------------------------------


class _Move(NamedTuple):
    posture: np.ndarray  # (k,) at its end
    duration: float  # [s]
    hold: float  # [s] for which the posture is held then
    types: bool = False  # the hand types meanwhile


class _Path:
    """Values (n, k) that go from posture to posture, standing still between them, and the time spent moving."""

    def __init__(self, rest: np.ndarray, stop: float, draw: Callable[[np.ndarray], _Move]) -> None:
        """Go from `rest` (k,) and be back at `stop` [s]; `draw` draws the next move from a posture."""
        postures, begins, durations, at = [rest, rest], [0.0], [1.0], STAND_S
        self.typing: list[tuple[float, float]] = []
        while at + (move := draw(postures[-1])).duration + move.hold <= stop - RAMP_S:
            postures.append(move.posture)
            begins.append(at)
            durations.append(move.duration)
            if move.types:
                self.typing.append((at + move.duration, at + move.duration + move.hold))
            at += move.duration + move.hold
        self._start, self._duration = np.array([*begins, stop - RAMP_S]), np.array([*durations, RAMP_S])
        moved = np.concatenate(([0.0, 0.0], np.cumsum(self._duration[1:])))
        self._values = np.column_stack((np.array([*postures, rest]), moved))

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (n, k) and the time (n,) [s] spent moving at the times `t` (n,) [s]."""
        k = np.clip(np.searchsorted(self._start, t, side="right") - 1, 0, None)
        share = make_step((t - self._start[k]) / self._duration[k], 0.0, 1.0)[:, None]
        values = self._values[k] + share * (self._values[k + 1] - self._values[k])
        return values[:, :-1], values[:, -1]


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
        return _Move(posture, rng.uniform(1.0, 2.5), rng.exponential(3.0))

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
            types = kind == _TYPING_KIND
            return _Move(posture, duration, typing_s if types else hold, types)

        return _Path(np.array((*pose.upper_arm[side], *pose.elbow[side])), self.stop, draw)

    def _distance(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the distance (n,) [m] of the hand from the middle of the shoulders, by the elbow's angle."""
        upper = self.lengths[f"{side}_upper_arm"]
        lower = self.lengths[f"{side}_forearm"] + self.lengths[f"{side}_hand"]
        return np.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * np.cos(self.arms[side](t)[0][:, 3]))

    def __call__(self, t: np.ndarray, /) -> BodyPose:
        flaws = self.flaws
        lean = self.trunk(t)[0]
        lean[:, :2] += flaws.sway_torso(t)
        R_WT = Rotation.from_rotvec(lean)
        pose = BodyPose({"torso": R_WT}, {}, {"torso": np.zeros(3)})
        for side, y in SIDES.items():
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


# Whole body -----------------------------------------------------------------------------------------------------------


class WholeBodyActivity(Activity):
    """An activity of a body with legs, with a sensor on each segment."""

    body = "whole_body"

    def __init__(self, model: BodyModel, seconds: float, flaws: Flaws) -> None:
        super().__init__(model, seconds, flaws)
        self._carriers = find_carriers(model)
        lengths = self.lengths
        self.p_LS |= {"pelvis": np.array((-0.1, 0.0, 0.02)), "head": np.array((-0.1, 0.0, 0.15))}
        for side, y in SIDES.items():
            self.p_LS[f"{side}_hand"] = np.array((0.0, 0.02 * y, -lengths[f"{side}_hand"]))
            self.p_LS[f"{side}_thigh"] = np.array((0.0, 0.07 * y, -0.7 * lengths[f"{side}_thigh"]))
            self.p_LS[f"{side}_shank"] = np.array((0.06, 0.0, -0.36 * lengths[f"{side}_shank"]))
            self.p_LS[f"{side}_foot"] = np.array((0.4 * lengths[f"{side}_foot"], 0.0, 0.0))

    @abstractmethod
    def trunk(self, t: np.ndarray) -> np.ndarray:
        """Return the rotation vectors of torso, pelvis and head (3, n, 3) [rad] in W at the times `t` (n,) [s]."""

    @abstractmethod
    def arm(self, side: str, t: np.ndarray) -> np.ndarray:
        """Return flexion of shoulder and elbow (n, 2) [rad]."""

    def leg(self, _side: str, t: np.ndarray) -> np.ndarray:
        """Return the angles of hip, knee and ankle (3, n, 3) [rad], as `angles.JOINTS`."""
        return np.zeros((3, len(t), 3))

    def shoulder(self, side: str, t: np.ndarray) -> Rotation:
        """Return the rotation of the upper arm in the torso."""
        return turn_about("Y", -self.arm(side, t)[:, :1])

    def root(self, t: np.ndarray, /) -> np.ndarray:
        """Return where the root is (n, 3) [m] in a world at rest."""
        return np.zeros((len(t), 3))

    def __call__(self, t: np.ndarray, /) -> BodyPose:
        R_WL = self._orientations(t)
        p_W: dict[str, np.ndarray] = {}
        for link, (carrier, place) in self._carriers.items():
            p_W[link] = p_W[carrier] + R_WL[carrier].apply(place) if carrier else np.tile(place, (len(t), 1))
        origins = {segment: p_W[segment] for segment in R_WL}
        points = {point: p_W[link] for point, link in self.model.point_frames.items()}
        pose, girdle, R_WT = BodyPose(R_WL, points, origins), self.flaws.girdle, R_WL["torso"]
        for side in SIDES if girdle.size else ():  # on shoulders that move
            R_arm = [R_WL[f"{side}_{part}"] for part in ARM]
            along_T = compose(R_WT.inv(), R_arm[0]).apply(-E_Z)
            shoulder_T = girdle.place(SIDES[side], self.moving_time(t)) + girdle.displace(along_T, SIDES[side])
            place_arm(pose, side, origins["torso"] + R_WT.apply(shoulder_T), R_arm, self.flaws)
        root = self.root(t)
        return pose._replace(origins={segment: origin + root for segment, origin in origins.items()})

    def _orientations(self, t: np.ndarray) -> dict[str, Rotation]:
        start = self.flaws.start_pose
        R_WT, R_WP, R_WH = (Rotation.from_rotvec(turn) for turn in self.trunk(t))
        R_WT, R_WH = R_WT * Rotation.from_rotvec(start.torso), R_WH * Rotation.from_rotvec(start.head)
        R_WL = {"torso": R_WT, "pelvis": R_WP, "head": R_WH}
        for side, y in SIDES.items():
            R_WU = compose(R_WT, self.shoulder(side, t)) * Rotation.from_rotvec(start.upper_arm[side])
            flexion, pronation = start.elbow[side]
            bent = self.arm(side, t)[:, 1] + flexion
            R_WF = R_WU * self.flaws.elbow_joint.rotate(y, bent, np.full_like(t, pronation))
            R_WL |= {f"{side}_upper_arm": R_WU, f"{side}_forearm": R_WF, f"{side}_hand": R_WF}
            R = R_WP
            for (part, signs), angles in zip(_LEG_SIGNS.items(), self.leg(side, t), strict=True):
                R = compose(R, turn_about("YXZ", angles * signs * np.array((1.0, -y, -y))))
                R_WL[f"{side}_{part}"] = R
        return R_WL


def find_carriers(model: BodyModel) -> dict[str, tuple[str, np.ndarray]]:
    """Find for the link of each segment and point the segment that carries it and its place (3,) [m] there.

    Carriers come first; what the root carries has an empty carrier.
    """
    body, segments = model.pin, model.table.segments
    links = list(dict.fromkeys((*segments, *model.point_frames.values())))
    joints = {link: body.frames[body.getFrameId(link)].parentJoint for link in links}
    segment_of = {joints[segment]: segment for segment in segments}
    carriers = {link: model.parents[link] or "" if link in segments else segment_of[joints[link]] for link in links}
    _, p_W = compute_link_poses(model, pin.neutral(body)[np.newaxis], links, rotations=False)
    places = dict(zip(links, p_W[0], strict=True))
    return {link: (carrier, places[link] - places.get(carrier, 0.0)) for link, carrier in carriers.items()}


class Walk(WholeBodyActivity):
    """Walking: each leg the other half a stride later, the arms against the legs, torso against pelvis.

    Sagittal angles of the leg and the pelvis's motion: Perry & Burnfield 2010, "Gait Analysis: Normal and Pathological
    Function". The shoulder: Perry 1992, first edition, chapter 8. All other angles are assumptions.
    """

    phase = "walk"
    # Share of the stride at the initial contact, loading response, mid and terminal stance, pre-swing, initial, mid and
    # terminal swing; then hip flexion, knee flexion and ankle dorsiflexion [deg] there.
    _STRIDE = (
        (0.00, 0.12, 0.31, 0.50, 0.62, 0.75, 0.87, 1.00),
        (20.0, 20.0, 0.0, -20.0, -10.0, 15.0, 25.0, 20.0),
        (5.0, 15.0, 5.0, 10.0, 40.0, 60.0, 25.0, 5.0),
        (0.0, -5.0, 5.0, 10.0, -15.0, -5.0, 0.0, 0.0),
    )
    _STRIDE_S = 1.06  # 113 steps a minute, Perry & Burnfield 2010
    # Right side down and up, mean of forward and its change, turn. At the right foot's first contact the right side of
    # the pelvis is in front; then its left side drops.
    _PELVIS_DEG, _TORSO_DEG = (-4.0, 0.0, 2.0, 5.0), (2.0, 1.0, 1.0, -5.0)
    _HEAD_SHARE = 0.3  # of the torso's
    _ARM_DEG = np.array(((-24.0, 20.0), (32.0, 24.0)))  # flexion of shoulder and elbow: behind, and from there forward

    def prepare(self, rng: np.random.Generator) -> None:
        self.stride_s = self._STRIDE_S * rng.uniform(0.92, 1.08)
        self.size = rng.uniform(0.85, 1.15, 3)  # of hip, knee and ankle
        share, *angles = self._STRIDE
        self.curves = CubicSpline(share, np.radians(angles).T, bc_type="periodic")

    def _cycle(self, t: np.ndarray, side: str) -> np.ndarray:
        """Share of the stride (n,), from the first contact of this side's foot."""
        return (t - STAND_S) / self.stride_s + (0.5 if side == "left" else 0.0)

    def leg(self, side: str, t: np.ndarray) -> np.ndarray:
        share = self._cycle(t, side)
        wave, quadrature = np.sin(2.0 * np.pi * share), np.cos(2.0 * np.pi * share)
        sagittal = self.activity(t)[:, None] * self.size * self.curves(share % 1.0)
        small = np.radians(self.activity(t))
        frontal, transverse = np.outer((6.0, 2.0, -4.0), small * wave), np.outer((4.0, 4.0, 3.0), small * quadrature)
        return np.stack((sagittal.T, frontal, transverse), axis=2)

    def trunk(self, t: np.ndarray) -> np.ndarray:
        angle = 2.0 * np.pi * self._cycle(t, "right")
        size = np.radians(self.activity(t))[:, None]

        def sway(side: float, mean: float, forward: float, turn: float) -> np.ndarray:
            pitch = mean + forward * np.sin(2.0 * angle)
            return np.column_stack((side * np.sin(angle), pitch, turn * np.cos(angle)))

        torso = sway(*self._TORSO_DEG)
        return np.stack((size * torso, size * sway(*self._PELVIS_DEG), size * self._HEAD_SHARE * torso))

    def arm(self, side: str, t: np.ndarray) -> np.ndarray:
        forward = 0.5 - 0.5 * np.cos(2.0 * np.pi * self._cycle(t, side))  # 0 at the first contact of its own foot
        return self.activity(t)[:, None] * np.radians(self._ARM_DEG[0] + self._ARM_DEG[1] * forward[:, None])


class Run(Walk):
    """Running straight on at 3 m/s with 2.6 to 3 steps/s and arms that swing; it begins and ends within `RAMP_S`.

    All sizes are assumptions; hip, knee and ankle are near those of Novacheck 1998, Gait & Posture 7, 77-95. The trunk
    has 2 g at mid-stance, another g of impact at the contact, and brakes before it pushes off.
    """

    phase = "run"
    _STRIDE = (
        (0.00, 0.15, 0.35, 0.50, 0.65, 0.80, 0.92, 1.00),
        (35.0, 25.0, -10.0, -5.0, 25.0, 45.0, 42.0, 35.0),
        (15.0, 40.0, 15.0, 55.0, 95.0, 80.0, 25.0, 15.0),
        (5.0, 20.0, -20.0, -15.0, 0.0, 5.0, 5.0, 5.0),
    )
    _STRIDE_S = 0.72
    _PELVIS_DEG, _TORSO_DEG = (-5.0, 8.0, 3.0, 8.0), (3.0, 10.0, 2.0, -12.0)
    _HEAD_SHARE = 0.2
    _ARM_DEG = np.array(((-50.0, 75.0), (75.0, 25.0)))
    _SPEED = 3.0  # [m/s]
    _BOUNCE, _BRAKING, _IMPACT = 0.035, 0.008, 0.0012  # [m]

    def root(self, t: np.ndarray, /) -> np.ndarray:
        after = 4.0 * np.pi * self._cycle(t, "right")  # [rad] since a foot's contact, a turn is a step
        impact = self._IMPACT * (0.5 + 0.5 * np.cos(after)) ** 4 * np.cos(5.0 * after)
        up = -self._BOUNCE * np.cos(after - 1.0) - impact
        forward = -self._BRAKING * np.sin(after - 1.0)
        steps = self.activity(t)[:, None] * np.column_stack((forward, np.zeros_like(t), up))
        return steps + np.outer(self._SPEED * self.moving_time(t), np.eye(3)[0])


class Throw(WholeBodyActivity):
    """Overhand throws from where the person stands: one arm throws, the other hangs.

    The upper arm is cocked, turns by 110° about its long axis and by 75° forward in `_THROW_S`, at 15 to 20 rad/s, and
    is braked while it goes down. All sizes are assumptions: a pitcher's arm turns several times faster.
    """

    phase = "throw"
    _PERIOD_S, _THROW_S = 4.0, 0.4
    # Begin [s], duration [s]; then plane of elevation (0 to the side, forward positive), elevation, external rotation
    # and elbow flexion of the arm, turn of the trunk towards the other side and its lean [deg].
    _THROW = (
        (0.0, 0.9, -15.0, 95.0, 100.0, 95.0, -25.0, -5.0),
        (1.1, _THROW_S, 60.0, 95.0, -10.0, 20.0, 20.0, 15.0),
        (1.1 + _THROW_S, 0.35, 85.0, 50.0, -25.0, 30.0, 30.0, 25.0),
        (2.0, 1.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )

    def prepare(self, rng: np.random.Generator) -> None:
        self.side = str(rng.choice(list(SIDES)))
        self.sizes = rng.uniform(0.93, 1.05, max(1, int(self.seconds // self._PERIOD_S)))  # of each throw

    def _angles(self, t: np.ndarray) -> np.ndarray:
        """Return the columns of `_THROW` from the third on, (n, 6) [rad]."""
        changes = np.diff(np.radians([row[2:] for row in self._THROW]), axis=0, prepend=0.0)
        angles = np.zeros((len(t), changes.shape[1]))
        for k, size in enumerate(self.sizes):
            for (begin, duration, *_), change in zip(self._THROW, changes, strict=True):
                at = STAND_S + k * self._PERIOD_S + 0.5 + begin
                angles += np.outer(make_step(t, at, duration), size * change)
        return angles

    def trunk(self, t: np.ndarray) -> np.ndarray:
        turn, lean = self._angles(t)[:, 4:].T
        torso = np.column_stack((np.zeros_like(t), lean, SIDES[self.side] * -turn))
        return np.stack((torso, 0.4 * torso, 0.2 * torso))

    def arm(self, side: str, t: np.ndarray) -> np.ndarray:
        return np.column_stack((np.zeros_like(t), self._angles(t)[:, 3] if side == self.side else np.zeros_like(t)))

    def shoulder(self, side: str, t: np.ndarray) -> Rotation:
        if side != self.side:
            return super().shoulder(side, t)
        plane, elevation, external = self._angles(t)[:, :3].T
        return turn_about("ZXZ", SIDES[side] * np.column_stack((-plane, elevation, external)))


class Sit(WholeBodyActivity):
    """Sitting down and standing up again, some times; the trunk leans forward while the body moves.

    Durations are near those of Nuzik et al. 1986 (Phys Ther 66:1708-1713); sizes of lean and tilt are assumptions.
    """

    phase = "sit"
    _MOVE_S = 2.0  # down, and up
    _PAUSE_S = (1.0, 3.0)  # standing, seated

    def prepare(self, rng: np.random.Generator) -> None:
        period = 2.0 * self._MOVE_S + sum(self._PAUSE_S)
        times = int(self.seconds // period)
        if times < 1:
            raise BadOption(f"seconds {self.seconds:g}: sitting down and standing up once takes 8")
        starts = STAND_S + self._PAUSE_S[0] + period * np.arange(times)
        up = self._MOVE_S + self._PAUSE_S[1]
        self.ways = [(start, start + up) for start in starts.tolist()]  # the ways down and up begin [s]
        self.lean = np.radians(35.0 * rng.uniform(0.85, 1.15))
        self.tilt = 0.6 * self.lean  # of the pelvis, forward
        self.spread = np.radians(rng.uniform(3.0, 10.0, 2))  # of each thigh outwards, seated

    def _shares(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shares (n,): 0 standing, 1 seated; 1 in the middle of each way down or up."""
        move, none = self._MOVE_S, np.zeros_like(t)
        seated = sum((make_pulse(t, down, up + move, move) for down, up in self.ways), none)
        return seated, sum((make_pulse(t, at, at + move, 0.5 * move) for way in self.ways for at in way), none)

    def leg(self, side: str, t: np.ndarray) -> np.ndarray:
        seated, moving = self._shares(t)
        shank_forward, none = np.radians(12.0) * moving, np.zeros_like(t)
        spread = self.spread[list(SIDES).index(side)] * seated
        hip = (np.radians(90.0) * seated + self.tilt * moving, -spread, 0.3 * spread)
        knee = (np.radians(90.0) * seated + shank_forward, none, np.radians(5.0) * seated)
        return np.moveaxis(np.array((hip, knee, (shank_forward, none, none))), 1, 2)

    def trunk(self, t: np.ndarray) -> np.ndarray:
        seated, moving = self._shares(t)
        forward = self.lean * moving + np.radians(3.0) * seated
        turn, none = np.radians(4.0) * moving, np.zeros_like(t)
        pelvis = (none, self.tilt * moving, none)
        return np.moveaxis(np.array(((none, forward, turn), pelvis, (none, 0.4 * forward, 2.0 * turn))), 1, 2)

    def arm(self, _side: str, t: np.ndarray) -> np.ndarray:
        seated, moving = self._shares(t)
        return moving[:, None] * np.radians((30.0, 20.0)) + seated[:, None] * np.radians((15.0, 75.0))


ACTIVITIES: dict[str, type[Activity]] = {each.phase: each for each in (Walk, Sit, ArmTasks, Run, Throw)}
