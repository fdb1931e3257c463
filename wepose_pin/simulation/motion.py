"""The motion of a protocol: a closed form of continuous time.

It is exact between the samples as well, and shares no code with the model room, since tests compare the two. The torso
frame T has the origin of W: the torso rotates about it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel
from ..errors import BadOption
from ..rotations import compose, log, quat_from_matrix, turn_about
from .girdle import SimulatedGirdle
from .imperfections import IDEAL_PRESET, Imperfections
from .people import Elbow, StartPoseOffsets, Wrists
from .signals import Process, Sway, Wander, integrate_pulse, make_pulse, make_step

SIDES = {"left": 1.0, "right": -1.0}  # y of the side in W
CIRCLING_POINT = "right_palm"  # draws the circles after the protocol
SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
ARM = ("upper_arm", "forearm", "hand")

E_Z = np.array((0.0, 0.0, 1.0))
STAND_S = 5.0  # N-pose at the start
_BLEND_S = 2.5  # N-pose to clasp, clasp to table
RAMP_S = 2.0  # a motion grows and dies away over this time
END_S = 2.0  # after an activity the person stands still
_REST_S = (2.5, 2.0)  # first rest on the table, each later one
LIFT_S = 1.5  # table to circle, circle to table
MARGIN_S = 0.1  # the stated phases keep this distance from the motion beside them
_FLEXION = np.deg2rad((8.0, 140.0))  # of the elbow while the hand is led to a point
_LEAST_FLEXION = np.deg2rad(3.0)  # at which a hand is out of reach
_PERSON_LEAST_FLEXION = np.deg2rad(15.0)  # the same where shoulders move: below, the rounds would not settle
# Tried in turn: rounds in which an arm's reach is solved, and the distance [m] by which the hands stay nearer than the
# arms are long.
_REACHES = [
    (rounds, slack)
    for rounds, most in ((10, 0.05), (20, 0.05), (40, 0.2))
    for slack in np.arange(0.02, most, 0.01).tolist()
]
_RELAXATION = 0.75
_MOST_MISSING = 5e-6  # [m] from a hand to its aim after these rounds
_RATE_STEP_S = 0.02  # for the rate of elevation
_TILT_S = 1.5  # correlation time of the slow part of the sway, assumption


class BodyPose(NamedTuple):
    """Exact motion at n times."""

    R_WL: dict[str, Rotation]  # segment -> n rotations
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W
    origins: dict[str, np.ndarray]  # segment -> (n, 3) [m] in W, or (3,) where it does not move


class BodyMotion(ABC):
    """A body's motion as a function of continuous time, and where its sensors sit.

    Attributes
    ----------
    lengths : of the body [m]
    p_LS : segment → (3,) [m] in L, of its sensor
    """

    lengths: Mapping[str, float]
    p_LS: dict[str, np.ndarray]

    @property
    @abstractmethod
    def span(self) -> tuple[float, float]:
        """The times [s] at which the free motion begins and the recording ends."""

    @abstractmethod
    def __call__(self, t: np.ndarray, segments: Collection[str]) -> BodyPose:
        """Return the exact pose at the times `t` (n,) [s], of these segments at least."""

    @abstractmethod
    def activity(self, t: np.ndarray) -> np.ndarray:
        """Return the activity (n,): 1 in free motion, 0 where the segments are static."""

    @abstractmethod
    def moving_time(self, t: np.ndarray, segment: str = "", /) -> np.ndarray:
        """Return the time (n,) [s] that a segment has moved up to `t`: the integral of its activity."""

    @abstractmethod
    def phases(self) -> dict[str, list[tuple[float, float]]]:
        """Return the phases of the recording: phase → intervals [s]."""


class Flaws:
    """Random imperfections of the subject's motion; the sizes scale draws that do not depend on them."""

    def __init__(
        self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator], shoulder_width: float = 0.34
    ) -> None:
        self.sizes = sizes
        self.girdle = SimulatedGirdle(sizes, rngs, shoulder_width)
        self.elbow_joint = Elbow(sizes, rngs)
        self.wrists = Wrists(sizes, rngs)
        self.start_pose = StartPoseOffsets(sizes, rngs, SIDES)
        self.tilt = Process(rngs["sway_tilt"], _TILT_S, 2)
        self.slip = [Wander(rngs["palm_slip"]) for _ in range(3)]
        self.shoulder = {}  # side -> (3,) [m] in T at 90 deg of elevation
        for side, y in SIDES.items():
            direction = np.array((-0.3, -0.4 * y, 1.0)) + 0.3 * rngs["shoulder_wander"].standard_normal(3)
            self.shoulder[side] = sizes.shoulder_wander * direction / np.linalg.norm(direction)
        bend = 1.0 + 0.2 * np.clip(rngs["start_elbow"].standard_normal(2), -2.5, 2.5)
        self.elbow = dict(zip(SIDES, np.deg2rad(sizes.start_elbow_deg) * bend, strict=True))  # [rad]
        turn = np.deg2rad(sizes.start_segment_deg) / np.sqrt(3.0)
        self.start = {name: turn * rngs["start_segment"].standard_normal(3) for name in SEGMENTS[1:]}  # (3,) [rad]
        self.sway = {name: Sway(rngs["sway"]) for name in ("torso", *SIDES)}
        # The arms need slack for palm slip and shoulder motion.
        wander = sizes.palm_slip + sizes.shoulder_wander
        self.slack = max(0.012, wander) if wander else 0.0

    @property
    def iterates(self) -> bool:
        """True where the place of a hand follows from the arm's angles in steps only."""
        return self.girdle.moves or self.wrists.bend or not self.elbow_joint.is_ideal


class Activity(BodyMotion):
    """An activity of some seconds, after standing in the N-pose and before standing still."""

    phase: str
    body: str  # the model's name

    def __init__(self, model: BodyModel, rng: np.random.Generator, seconds: float, flaws: Flaws) -> None:
        self.model, self.lengths, self.flaws, self.seconds = model, model.lengths, flaws, seconds
        self.p_LS = place_sensors(self.lengths, flaws.sizes)
        self.prepare(rng)

    @abstractmethod
    def prepare(self, rng: np.random.Generator) -> None:
        """Draw what is this person's own."""

    @property
    def stop(self) -> float:
        """Time [s] at which the activity ends."""
        return STAND_S + self.seconds

    @property
    def span(self) -> tuple[float, float]:
        return STAND_S, self.stop + END_S

    def activity(self, t: np.ndarray) -> np.ndarray:
        return make_pulse(t, STAND_S, self.stop, RAMP_S)

    def phases(self) -> dict[str, list[tuple[float, float]]]:
        return {
            "start": [(0.5, STAND_S - 0.5)],
            self.phase: [(STAND_S + MARGIN_S, self.stop - MARGIN_S)],
            "rest": [(self.stop + MARGIN_S, self.stop + END_S - MARGIN_S)],
        }


@dataclass(frozen=True)
class _Circle:
    """One circle of the right hand, drawn between two rests on the table."""

    start: float  # [s] lift off the table
    duration: float  # [s] of the turn itself
    centre_W: np.ndarray  # (3,) [m]
    axes_W: np.ndarray  # (2, 3) [m], orthogonal, as long as the radius
    sense: float  # +1 or -1

    @property
    def stop(self) -> float:
        """Time [s] at which the hand is back on the table."""
        return self.start + self.duration + 2.0 * LIFT_S - 1.0  # turn, lift and return overlap by 0.5 s each

    def offset_W(self, t: np.ndarray, table_W: np.ndarray) -> np.ndarray:
        """Return the vector from the table point to the hand (n, 3) [m]."""
        angle = 2.0 * np.pi * self.sense * make_step(t, self.start + LIFT_S - 0.5, self.duration)
        circle_W = self.centre_W + np.cos(angle)[:, None] * self.axes_W[0] + np.sin(angle)[:, None] * self.axes_W[1]
        return make_pulse(t, self.start, self.stop, LIFT_S)[:, None] * (circle_W - table_W)


class _Aim(NamedTuple):
    """What torso and hands do at n times, whatever the shoulders do; by side but for the torso."""

    R_WT: Rotation
    palm_T: dict[str, np.ndarray]  # (n, 3) [m]
    lead: dict[str, np.ndarray]  # (n,) share by which the palm leads its arm; 0: the arm hangs
    swivel: dict[str, np.ndarray]  # (n,) [rad]
    pronation: dict[str, np.ndarray]  # (n,) [rad] about z of the forearm
    hand_F: dict[str, Rotation]  # hand in the forearm; empty: straight


class FreeArm(NamedTuple):
    """What an arm does beside hanging while its palm is led nowhere, at n times."""

    turn: np.ndarray  # (n, 3) [rad] rotation vector of the upper arm in T
    bend: np.ndarray  # (n, 2) [rad] of the elbow: less its flexion, and pronation about z of the forearm
    start: np.ndarray  # (n,) share of the offsets of the start pose


def _turn_to(vectors: np.ndarray, directions: np.ndarray) -> Rotation:
    """Return the least rotations (n) of vectors (n, 3) to the directions (n, 3), below a half turn."""
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (vectors, directions))
    return Rotation.from_quat(np.column_stack((np.cross(a, b), 1.0 + np.sum(a * b, axis=1))))


class Motion(BodyMotion):
    """The motion of a protocol, with torso and arms; `sequence` has those of other protocols than the clasp."""

    phase = "clasp"
    lean_deg: float | np.ndarray = 15.0  # yaw, pitch, roll of the torso in the clasp

    def prepare(self, rng: np.random.Generator) -> None:
        """Draw what a protocol needs beyond the clasp."""

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        """Return the phases between start and circles: phase → intervals [s]."""
        return {self.phase: [(self.clasp[0] + MARGIN_S, self.clasp[1] - MARGIN_S)]}

    def phases(self) -> dict[str, list[tuple[float, float]]]:
        return {
            "start": [(0.5, STAND_S - 0.5)],
            **self.protocol_phases(),
            "circles": [(self.circles[0].start, self.circles[-1].stop)] if self.circles else [],
            "rest": [(a + MARGIN_S, b - MARGIN_S) for a, b in self.rest],
        }

    @property
    def span(self) -> tuple[float, float]:
        return self.clasp[0], self.rest[-1][1]

    def __init__(
        self, lengths: Mapping[str, float], rng: np.random.Generator, clasp_s: float, circles: int, flaws: Flaws
    ) -> None:
        self.flaws = flaws
        self.lengths = lengths
        self.p_LS = place_sensors(lengths, flaws.sizes)
        self.least_flexion, self.most_missing, self.rounds = _LEAST_FLEXION, np.inf, 1
        self.half_width = 0.5 * lengths["shoulder_width"]
        self.arm = {s: (lengths[f"{s}_upper_arm"], lengths[f"{s}_forearm"] + lengths[f"{s}_hand"]) for s in SIDES}
        self.reach = min(sum(arm) for arm in self.arm.values())
        self.clasp = (STAND_S + _BLEND_S, STAND_S + _BLEND_S + clasp_s)
        names = ("azimuth", "elevation", "radius", "roll", "pitch", "yaw")
        arm_names = (f"{side}_{angle}" for side in SIDES for angle in ("swivel", "pronation"))
        self.wander = {name: Wander(rng) for name in (*names, *arm_names)}
        # In units of the reach, from the right shoulder: table above the hips, circles before the chest.
        shoulder_W = np.array((0.0, -self.half_width, lengths["trunk"]))
        self.table_W = shoulder_W + self.reach * np.array((0.52, 0.03, -0.6))
        t = self.clasp[1] + _BLEND_S
        self.rest = [(t, t + _REST_S[0])]
        self.circles: list[_Circle] = []
        for _ in range(circles):
            centre_W = shoulder_W + self.reach * (
                np.array((0.62, 0.03, 0.0)) + rng.uniform(-1, 1, 3) * (0.03, 0.1, 0.12)
            )
            radius = self.reach * rng.uniform(0.2, 0.31)
            tilt, turn, first = rng.uniform(-1.0, 1.0, 3) * np.array((0.5, 0.5, np.pi))  # mostly frontal
            plane = Rotation.from_euler("ZYX", [turn, tilt, first])
            axes_W = radius * plane.apply([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            circle = _Circle(self.rest[-1][1], rng.uniform(3.0, 4.0), centre_W, axes_W, rng.choice((-1.0, 1.0)))
            self.circles.append(circle)
            self.rest.append((circle.stop, circle.stop + _REST_S[1]))
        # The slip's gains [m]: the stated rms on each axis over the clasp, whatever the sampling rate.
        grid = np.arange(*self.clasp, 0.05)
        gate = make_pulse(grid, *self.clasp, RAMP_S)
        rms = np.array([np.sqrt(np.mean((gate * wander(grid)) ** 2)) for wander in flaws.slip])
        self.slip_gain = flaws.sizes.palm_slip / np.sqrt(3.0) / rms

    def fit_to_person(self, rng: np.random.Generator) -> None:
        """Prepare the motion; where shoulders and wrists move, hands stay as near as the arms then need.

        Raises
        ------
        BadOption
            The arms do not reach at all.
        """
        flaws = self.flaws
        if not flaws.iterates:
            self.prepare(rng)
            return
        self.least_flexion, self.most_missing = _PERSON_LEAST_FLEXION, _MOST_MISSING
        for self.rounds, flaws.slack in _REACHES:
            self.prepare(deepcopy(rng))
            grid, clasp_t = np.arange(*self.span, 0.05), np.arange(*self.clasp, 0.05)
            moving = self._motion_share(clasp_t)
            distance = np.linalg.norm(self._clasp_point(clasp_t, moving), axis=1)
            flaws.wrists.fit(clasp_t, moving, np.column_stack((distance, distance)))
            try:
                self(grid)
            except BadOption:
                if (self.rounds, flaws.slack) == _REACHES[-1]:
                    raise
            else:
                break
        self.least_flexion, self.most_missing = _LEAST_FLEXION, np.inf

    def protocol_pulses(self) -> list[tuple[float, float, float]]:
        """Return where the protocol moves the person: begin, end and ramp [s] of each pulse of motion."""
        return [(*self.clasp, RAMP_S)]

    def activity(self, t: np.ndarray) -> np.ndarray:
        return self._sum_pulses(make_pulse, t)

    def moving_time(self, t: np.ndarray, _segment: str = "", /) -> np.ndarray:
        return self._sum_pulses(integrate_pulse, t)

    def _sum_pulses(self, pulse: Callable[[np.ndarray, float, float, float], np.ndarray], t: np.ndarray) -> np.ndarray:
        protocol = sum((pulse(t, *each) for each in self.protocol_pulses()), np.zeros_like(t))
        return protocol + sum((pulse(t, c.start, c.stop, LIFT_S) for c in self.circles), np.zeros_like(t))

    def _clasp_point(self, t: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """Return the point where the palms meet (n, 3) [m] in T, from midway between the shoulders, in reach."""
        azimuth = np.deg2rad(38.0) * moving * self.wander["azimuth"](t)
        elevation = np.deg2rad(-4.0 + 46.0 * moving * self.wander["elevation"](t))
        fraction = 0.5 + 0.5 * moving * self.wander["radius"](t)
        ray = np.column_stack(
            (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
        )
        # Shoulder to palm at the limits of the elbow, for the arm that is nearer to them.
        span = np.array(
            [[np.sqrt(a * a + b * b + 2 * a * b * np.cos(f)) for f in _FLEXION] for a, b in self.arm.values()]
        )
        longest, shortest = span[:, 0].min() - self.flaws.slack, span[:, 1].max()
        # The far shoulder limits the radius from above, the near one from below; the smooth |y| is safe.
        side = self.half_width * np.sqrt(ray[:, 1] ** 2 + 0.01)
        upper = np.sqrt(side**2 + longest**2 - self.half_width**2) - side
        lower = np.sqrt(side**2 + max(shortest**2 - self.half_width**2, 0.0)) + side
        chest = 0.3 * self.reach / ray[:, 0]  # hands stay in front of the chest
        lower = (lower**8 + chest**8) ** 0.125  # a smooth maximum
        return (lower + fraction * (upper - lower))[:, None] * ray

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        return make_pulse(t, *self.clasp, RAMP_S)  # 0 at both ends of the clasp

    def _torso(self, _t: np.ndarray, lean: np.ndarray) -> Rotation:
        """Return R_WT from `lean` (n, 3) [rad]: yaw, pitch, roll."""
        return turn_about("ZYX", lean)

    def _palms(self, _t: np.ndarray, _motion_share: np.ndarray, clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        """Return the position (n, 3) [m] in T of each palm before the right one moves to the table."""
        return {"left": clasp_T, "right": clasp_T}

    def _lead_share(self, _t: np.ndarray, led: np.ndarray, table: np.ndarray) -> dict[str, np.ndarray]:
        """Return the share (n,) by which each palm leads its arm; 0: the arm hangs."""
        return {"left": led * (1.0 - table), "right": led}  # the left arm returns to hanging

    def _free(self, t: np.ndarray, _side: str) -> FreeArm:
        """Return what an arm does while its palm is led nowhere: it hangs."""
        return FreeArm(np.zeros((len(t), 3)), np.zeros((len(t), 2)), np.ones_like(t))

    def _arm(self, side: str, palm_T: np.ndarray, swivel: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """Upper arm in T and elbow flexion [rad] to bring the palm to `palm_T` (n, 3) [m], from the shoulder.

        `swivel` (n,) [rad] turns the elbow about the line from shoulder to palm, from below outwards. The
        elbow is a hinge: the forearm is the upper arm turned by flexion about -y, then by pronation about its
        own z.
        """
        upper, lower = self.arm[side]
        distance = np.linalg.norm(palm_T, axis=1)
        cos_flexion = (distance**2 - upper**2 - lower**2) / (2.0 * upper * lower)
        if not np.all(np.abs(cos_flexion) < np.cos(self.least_flexion)):
            raise BadOption(
                f"lengths: the {side} arm ({upper:.3f} m + {lower:.3f} m) does not reach through the motion"
            )
        flexion = np.arccos(cos_flexion)
        cos_alpha = (upper + lower * cos_flexion) / distance  # between upper arm and line to the palm
        sin_alpha = lower * np.sin(flexion) / distance
        n = palm_T / distance[:, None]
        down = np.array((0.0, 0.0, -1.0)) + n[:, 2:] * n  # e_down less its part along n
        down /= np.linalg.norm(down, axis=1)[:, None]
        m = np.cos(swivel)[:, None] * down + SIDES[side] * np.sin(swivel)[:, None] * np.cross(n, down)
        u = cos_alpha[:, None] * n + sin_alpha[:, None] * m  # shoulder to elbow
        x = sin_alpha[:, None] * n - cos_alpha[:, None] * m  # into which the forearm flexes
        return Rotation.from_quat(quat_from_matrix(np.stack((x, np.cross(n, m), -u), axis=2))), flexion

    def _aim(self, t: np.ndarray, *, wrists: bool = True) -> _Aim:
        """Compute what torso and hands do at the times `t` (n,) [s]; without `wrists` they are straight."""
        moving = self._motion_share(t)
        circling = sum((make_pulse(t, c.start, c.stop, LIFT_S) for c in self.circles), np.zeros_like(t))
        led = make_step(t, STAND_S, _BLEND_S)  # from the N-pose to the clasp
        table = make_step(t, self.clasp[1], _BLEND_S)  # from the clasp to the table

        lean = np.column_stack([self.wander[name](t) for name in ("yaw", "pitch", "roll")])
        lean *= np.deg2rad(self.lean_deg * moving[:, None] + circling[:, None] * np.array((5.0, 3.0, 3.0)))
        flaws = self.flaws
        lean[:, 1:] += np.deg2rad(flaws.sizes.sway_deg_s) * flaws.sway["torso"](t)
        lean[:, 1:] += np.deg2rad(flaws.sizes.sway_tilt_deg) / np.sqrt(2.0) * flaws.tilt(t)
        R_WT = self._torso(t, lean)
        if flaws.start_pose.torso.any():
            R_WT = compose(R_WT, Rotation.from_rotvec((1.0 - led)[:, None] * flaws.start_pose.torso))
        centred_T = self._clasp_point(t, moving)
        clasp_T = centred_T + self.lengths["trunk"] * E_Z
        hand_W = self.table_W + sum((c.offset_W(t, self.table_W) for c in self.circles), np.zeros((len(t), 3)))
        palm_T = self._palms(t, moving, clasp_T)
        palm_T["right"] = palm_T["right"] + table[:, None] * (R_WT.inv().apply(hand_W) - palm_T["right"])
        slips = [gain * wander(t) for gain, wander in zip(self.slip_gain, flaws.slip, strict=True)]
        slip_T = moving[:, None] * np.column_stack(slips)
        palm_T = {"left": palm_T["left"] + 0.5 * slip_T, "right": palm_T["right"] - 0.5 * slip_T}
        swivel, pronation = {}, {}
        for side in SIDES:
            wander = self.wander[f"{side}_swivel"](t)
            swivel[side] = np.deg2rad(35.0 + 30.0 * (moving + 0.3 * circling) * wander)
            palm_down = np.deg2rad(40.0) * table if side == "right" else 0.0 * t
            wander = np.deg2rad(55.0 * moving + 15.0 * circling) * self.wander[f"{side}_pronation"](t)
            pronation[side] = wander + palm_down
        hand_F: dict[str, Rotation] = {}
        if flaws.wrists.bend and wrists:
            distance = np.linalg.norm(centred_T, axis=1)
            hand_F = {side: flaws.wrists.rotate(y, t, moving, circling, distance) for side, y in SIDES.items()}
        return _Aim(R_WT, palm_T, self._lead_share(t, led, table), swivel, pronation, hand_F)

    def _raising(self, t: np.ndarray, side: str) -> np.ndarray:
        """Compute the rate (n,) [deg/s] at which the arm is raised, the shoulder at rest."""
        elevation = []
        for step in (-_RATE_STEP_S, _RATE_STEP_S):
            aim = self._aim(t + step, wrists=False)
            R_TU, _ = self._arm(side, aim.palm_T[side] - place_shoulder(side, self.lengths), aim.swivel[side])
            free, lead = self._free(t + step, side), aim.lead[side][:, None]
            down = Rotation.from_rotvec((1.0 - lead) * free.turn).apply(-E_Z)
            along_T = Rotation.from_rotvec(lead * log(R_TU.as_quat())).apply(down)
            elevation.append(np.rad2deg(np.arctan2(np.hypot(along_T[:, 0], along_T[:, 1]), -along_T[:, 2])))
        return (elevation[1] - elevation[0]) / (2.0 * _RATE_STEP_S)

    def _reach(self, t: np.ndarray, side: str, aim: _Aim, hang: Rotation) -> tuple[np.ndarray, Rotation, np.ndarray]:
        """Shoulder (n, 3) [m] in T, upper arm in T and elbow flexion (n,) [rad] that bring the palm to its aim.

        The shoulder follows the arm, elbow and wrist are not straight. Each round bends the elbow towards the distance
        from shoulder to palm and turns the straight arm's solution to the palm. A fixed number of rounds is a smooth
        function of time.
        """
        flaws, y = self.flaws, SIDES[side]
        upper, blend = self.lengths[f"{side}_upper_arm"], aim.lead[side][:, None]
        palm_F = self._palm_F(side, aim)
        lower = np.linalg.norm(palm_F, axis=1)
        hysteresis = flaws.sizes.girdle and flaws.sizes.girdle_hysteresis
        raising = self._raising(t, side) if hysteresis else np.zeros_like(t)
        centre_T = place_shoulder(side, self.lengths) + flaws.girdle.place(y, self.moving_time(t))
        down_U = hang.apply(-E_Z)

        def bend(flexion: np.ndarray) -> np.ndarray:
            """Palm (n, 3) [m] in the upper arm, from the shoulder."""
            return flaws.elbow_joint.rotate_vectors(y, flexion, aim.pronation[side], palm_F) - upper * E_Z

        def opening(palm: np.ndarray) -> np.ndarray:
            """Angle (n,) [rad] at the elbow, 0 where the arm is straight, from the palm seen from the shoulder."""
            cos = (np.sum(palm**2, axis=1) - upper**2 - lower**2) / (2.0 * upper * lower)
            return np.arccos(np.clip(cos, -1.0, 1.0))

        shoulder_T, flexion = centre_T, np.empty(0)
        for _ in range(self.rounds):
            palm_T = aim.palm_T[side] - shoulder_T
            R_TU, straight = self._arm(side, palm_T, aim.swivel[side])
            flexion = flexion if flexion.size else straight
            flexion = flexion + opening(palm_T) - opening(bend(flexion))
            R_TU = compose(_turn_to(R_TU.apply(bend(flexion)), palm_T), R_TU)
            along_T = Rotation.from_rotvec(blend * log(R_TU.as_quat())).apply(down_U)
            # A shoulder that rises lowers the arm, which lowers the shoulder: a part of the way settles sooner.
            displaced_T = centre_T + flaws.girdle.displace(along_T, y, raising)
            shoulder_T = shoulder_T + _RELAXATION * (displaced_T - shoulder_T)
        missing = np.linalg.norm(aim.palm_T[side] - shoulder_T - R_TU.apply(bend(flexion)), axis=1)
        worst = float(np.max(missing * (aim.lead[side] == 1.0), initial=0.0))
        if worst > self.most_missing:
            raise BadOption(f"lengths: the {side} arm does not reach through the motion, by {1e3 * worst:.2g} mm")
        return shoulder_T, R_TU, flexion

    def _palm_F(self, side: str, aim: _Aim) -> np.ndarray:
        """Palm (n, 3) [m] in the forearm, from the elbow."""
        hand = np.array((0.0, 0.0, -self.lengths[f"{side}_hand"]))
        bent = aim.hand_F[side].apply(hand) if aim.hand_F else np.tile(hand, (len(aim.lead[side]), 1))
        return bent - self.lengths[f"{side}_forearm"] * E_Z

    def __call__(self, t: np.ndarray, segments: Collection[str] = SEGMENTS) -> BodyPose:
        """Return the exact pose of the torso and of the arms of the segments' sides at the times `t` (n,) [s]."""
        aim, flaws = self._aim(t), self.flaws
        sway = np.deg2rad(flaws.sizes.sway_deg_s)
        R_WT = aim.R_WT
        pose = BodyPose({"torso": R_WT}, {}, {"torso": np.zeros(3)})
        for side in [side for side in SIDES if any(segment.startswith(side) for segment in segments)]:
            y, blend = SIDES[side], aim.lead[side]
            y, blend = SIDES[side], aim.lead[side]
            hanging, free = (1.0 - blend)[:, None], self._free(t, side)
            starting = hanging * free.start[:, None]
            turns = (  # of a hanging arm
                hanging * free.turn,
                hanging * sway * np.pad(flaws.sway[side](t), ((0, 0), (0, 1))),
                hanging * flaws.start[f"{side}_upper_arm"],
                starting * flaws.start_pose.upper_arm[side],
            )
            if flaws.iterates:
                hang = compose(Rotation.identity(len(t)), *(Rotation.from_rotvec(turn) for turn in turns))
                shoulder_T, R_TU, flexion = self._reach(t, side, aim, hang)
            else:
                shoulder_T = place_shoulder(side, self.lengths)
                R_TU, flexion = self._arm(side, aim.palm_T[side] - shoulder_T, aim.swivel[side])
            if flaws.sizes.shoulder_wander:
                # The elevation is that of the arm from the mean centre: the same to within a degree.
                along_T = Rotation.from_rotvec(blend[:, None] * log(R_TU.as_quat())).apply(-E_Z)
                shoulder_T = shoulder_T + (1.0 + along_T[:, 2:]) * flaws.shoulder[side]
                R_TU, flexion = self._arm(side, aim.palm_T[side] - shoulder_T, aim.swivel[side])
            bend = np.column_stack((-blend * flexion, blend * aim.pronation[side]))
            bend[:, 0] -= (1.0 - blend) * flaws.elbow[side]
            bend -= starting * np.array((flaws.start_pose.flexion[side], -flaws.start_pose.pronation[side]))
            bend += hanging * free.bend
            R_TU = Rotation.from_rotvec(blend[:, None] * log(R_TU.as_quat()))
            R_WU = compose(R_WT, R_TU, *(Rotation.from_rotvec(turn) for turn in turns))
            R_WF = compose(R_WU, flaws.elbow_joint.rotate(y, -bend[:, 0], bend[:, 1]))
            if flaws.sizes.start_segment_deg:
                R_WF = compose(R_WF, Rotation.from_rotvec(hanging * flaws.start[f"{side}_forearm"]))
            R_WH = compose(R_WF, aim.hand_F[side]) if aim.hand_F else R_WF
            place_arm(pose, side, R_WT.apply(shoulder_T), (R_WU, R_WF, R_WH), self.lengths)
        return pose


def place_shoulder(side: str, lengths: Mapping[str, float]) -> np.ndarray:
    """Place a shoulder's centre (3,) [m] in the torso, by the lengths."""
    return np.array((0.0, 0.5 * SIDES[side] * lengths["shoulder_width"], lengths["trunk"]))


def place_arm(
    pose: BodyPose,
    side: str,
    shoulder_W: np.ndarray,
    R_WL: tuple[Rotation, Rotation, Rotation],
    lengths: Mapping[str, float],
) -> None:
    """Put an arm into a pose, by its shoulder (n, 3) [m] in W and the rotations of upper arm, forearm and hand."""
    p_W = shoulder_W
    for part, start, R in zip(ARM, ("shoulder", "elbow", "wrist"), R_WL, strict=True):
        pose.R_WL[f"{side}_{part}"] = R
        pose.origins[f"{side}_{part}"] = pose.points[f"{side}_{start}"] = p_W
        p_W = p_W + R.apply((0.0, 0.0, -lengths[f"{side}_{part}"]))
    pose.points[f"{side}_palm"] = p_W


def place_sensors(lengths: Mapping[str, float], sizes: Imperfections = IDEAL_PRESET) -> dict[str, np.ndarray]:
    """Place each sensor in L [m]: on the sternum, and on the outer side of the arm segments, half-way if not told."""
    places = {"torso": np.array((0.11, 0.0, 0.8 * lengths["trunk"]))}
    upper_arm, forearm = sizes.upper_arm_place or 0.5, sizes.forearm_place or 0.5
    for side, y in SIDES.items():
        places[f"{side}_upper_arm"] = np.array((0.0, 0.045 * y, -upper_arm * lengths[f"{side}_upper_arm"]))
        places[f"{side}_forearm"] = np.array((0.01, 0.03 * y, -forearm * lengths[f"{side}_forearm"]))
    return places
