"""The motion of protocols: a closed form of continuous time, exact between the samples as well.

It shares no code with the body room, since tests compare the two. The torso frame T has the origin of W: the torso
rotates about it.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadOption
from ..rotations import compose, log, turn_about
from .people import E_Z, SIDES, BodyPose, Flaws, Offset, place_shoulder
from .signals import Wander, integrate_step, make_pulse, make_step

CIRCLING_POINT = "right_palm"  # draws the circles after the protocol
SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
ARM = ("upper_arm", "forearm", "hand")

STAND_S = 5.0  # N-pose at the start
_LEAD_S = 2.5  # N-pose to clasp, clasp to table
RAMP_S = 2.0  # a motion grows and dies away over this time
_REST_S = (2.5, 2.0)  # first rest on the table, each later one
_LIFT_S = 1.5  # table to circle, circle to table
MARGIN_S = 0.1  # the stated phases keep this distance from the motion beside them
_LEAN_DEG = 15.0  # yaw, pitch, roll of the torso in the clasp
_FLEXION = np.deg2rad((8.0, 140.0))  # of the elbow while the hand is led to a point
# Flexion at which a hand is out of reach, and the same while rounds are chosen: below, they would not settle.
_LEAST_FLEXION, _STRICT_FLEXION = np.deg2rad((3.0, 15.0))
# Tried in turn: rounds in which an arm's reach is solved, and the distance [m] by which the hands stay nearer than the
# arms are long.
_REACHES = [
    (rounds, slack)
    for rounds, most in ((5, 0.025), (10, 0.05), (20, 0.05), (40, 0.2))
    for slack in np.arange(0.02, most, 0.01).tolist()
]
_RELAXATION = 0.75
_MOST_MISSING = 5e-6  # [m] from a hand to its aim after these rounds

PARTS = ("bow", "clasp", "t_pose")
_LONG_S = 45.0  # [s] of a session, from which on parts have their full length
_PART_S = {"bow": (5.0, 6.0), "t_pose": (4.0, 5.0)}  # short, full; what leads the hands takes the time that is left
_LEAST_CLASP_S = 5.0
_BLEND_S = 1.5  # between hanging arms and hands that are led, or arms held sideways
_POSE_RAMP_S = 1.0  # in which the motion of a T-pose grows and dies away
BOW = np.deg2rad(45.0)
BOW_AXIS_STD = np.deg2rad(3.5)  # from the torso's y: such axes repeat within 2 to 5 deg (Luinge 2007, de Vries 2010)
# How people hold the T-pose, each their own: assumptions, checked against N- and T-poses in Robert-Lachaine 2017.
T_POSE = {
    "elevation": Offset(-3.0, 5.0),
    "plane": Offset(10.0, 6.0),
    "elbow": Offset(5.0, 4.0),
    "forearm_twist": Offset(0.0, 15.0),
}


class BodyMotion(ABC):
    """A body's motion as a function of continuous time, after standing in the N-pose."""

    end: float  # [s] of the recording

    def __init__(self, flaws: Flaws) -> None:
        self.lengths, self.flaws = flaws.lengths, flaws
        # Segment → where its sensor is, (3,) [m] in L: on the sternum, and on the outer side of the arm segments.
        self.p_LS = {"torso": np.array((0.11, 0.0, 0.8 * self.lengths["trunk"]))}
        upper_arm, forearm = 0.5 + flaws.sizes.sensor_place * np.array((0.1, 0.35))
        for side, y in SIDES.items():
            self.p_LS[f"{side}_upper_arm"] = np.array((0.0, 0.045 * y, -upper_arm * self.lengths[f"{side}_upper_arm"]))
            self.p_LS[f"{side}_forearm"] = np.array((0.01, 0.03 * y, -forearm * self.lengths[f"{side}_forearm"]))
        self.pulses: list[tuple[float, float, float]] = []  # begin, end and ramp [s] of each time of motion
        self.phases: dict[str, list[tuple[float, float]]] = {"start": [(0.5, STAND_S - 0.5)]}

    @abstractmethod
    def __call__(self, t: np.ndarray, /) -> BodyPose:
        """Return the exact pose at the times `t` (n,) [s]."""

    def activity(self, t: np.ndarray) -> np.ndarray:
        """Return the activity (n,): 1 in free motion, 0 where the segments are static."""
        return sum((make_pulse(t, *pulse) for pulse in self.pulses), np.zeros_like(t))

    def moving_time(self, t: np.ndarray, _segment: str = "", /) -> np.ndarray:
        """Return the time (n,) [s] that a segment has moved up to `t`: the integral of its activity."""
        moved = (integrate_step(t, a, ramp) - integrate_step(t, b - ramp, ramp) for a, b, ramp in self.pulses)
        return sum(moved, np.zeros_like(t))  # their ramps do not overlap


class _Circle(NamedTuple):
    """One circle of the right hand, drawn between two rests on the table."""

    start: float  # [s] lift off the table
    duration: float  # [s] of the turn itself
    centre_W: np.ndarray  # (3,) [m]
    axes_W: np.ndarray  # (2, 3) [m], orthogonal, as long as the radius
    sense: float  # +1 or -1

    @property
    def pulse(self) -> tuple[float, float, float]:
        """Begin, end and ramp [s]: turn, lift and return overlap by 0.5 s each."""
        return self.start, self.start + self.duration + 2.0 * _LIFT_S - 1.0, _LIFT_S

    def offset_W(self, t: np.ndarray, table_W: np.ndarray) -> np.ndarray:
        """Return the vector from the table point to the hand (n, 3) [m]."""
        angle = 2.0 * np.pi * self.sense * make_step(t, self.start + _LIFT_S - 0.5, self.duration)
        circle_W = self.centre_W + np.cos(angle)[:, None] * self.axes_W[0] + np.sin(angle)[:, None] * self.axes_W[1]
        return make_pulse(t, *self.pulse)[:, None] * (circle_W - table_W)


class _Part(NamedTuple):
    """A part of the session, during which the person moves."""

    start: float  # [s]
    stop: float  # [s]
    ramp: float  # [s] in which the motion grows and dies away


class _Hand(NamedTuple):
    """What one hand does at n times, wherever its shoulder is."""

    lead: np.ndarray  # (n,) share by which the palm leads its arm; 0: the arm hangs
    palm_T: np.ndarray  # (n, 3) [m]
    palm_F: np.ndarray  # (n, 3) [m] from the elbow
    swivel: np.ndarray  # (n,) [rad]
    pronation: np.ndarray  # (n,) [rad] about z of the forearm


class Motion(BodyMotion):
    """Torso and arms in the motions of protocols, one after the other, then circles of the right hand."""

    closes = True  # palms must reach each other to some micrometres

    def __init__(self, flaws: Flaws, parts: Sequence[str], clasp_s: float, circles: int) -> None:
        super().__init__(flaws)
        lengths, rng = flaws.lengths, flaws.rngs["motion"]
        self.strict, self.rounds = False, 1  # whether hands must reach with some flexion, and to some micrometres
        self.slack = max(0.012, flaws.sizes.palm_slip) if flaws.sizes.palm_slip else 0.0  # arms need it for the slip
        self.half_width = 0.5 * lengths["shoulder_width"]
        self.arm = {s: (lengths[f"{s}_upper_arm"], lengths[f"{s}_forearm"] + lengths[f"{s}_hand"]) for s in SIDES}
        self.reach = min(sum(arm) for arm in self.arm.values())
        self.clasp = (STAND_S + _LEAD_S, STAND_S + _LEAD_S + clasp_s)
        self.schedule = _schedule(parts, *self.clasp)
        self.led = next((name for name in parts if name not in _PART_S), "")  # in which palms are led to a point
        names = ("azimuth", "elevation", "radius", "roll", "pitch", "yaw")
        arm_names = (f"{side}_{angle}" for side in SIDES for angle in ("swivel", "pronation"))
        self.wander = {name: Wander(rng) for name in (*names, *arm_names)}
        # In units of the reach, from the right shoulder: table above the hips, circles before the chest.
        shoulder_W = place_shoulder(SIDES["right"], lengths)
        self.table_W = shoulder_W + self.reach * np.array((0.52, 0.03, -0.6))
        self.circles: list[_Circle] = []
        at = self.clasp[1] + _LEAD_S
        rests = [(at, at + _REST_S[0])]
        for _ in range(circles):
            centre_W = shoulder_W + self.reach * (
                np.array((0.62, 0.03, 0.0)) + rng.uniform(-1, 1, 3) * (0.03, 0.1, 0.12)
            )
            radius = self.reach * rng.uniform(0.2, 0.31)
            tilt, turn, first = rng.uniform(-1.0, 1.0, 3) * np.array((0.5, 0.5, np.pi))  # mostly frontal
            plane = Rotation.from_euler("ZYX", [turn, tilt, first])
            axes_W = radius * plane.apply([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            circle = _Circle(rests[-1][1], rng.uniform(3.0, 4.0), centre_W, axes_W, rng.choice((-1.0, 1.0)))
            self.circles.append(circle)
            rests.append((circle.pulse[1], circle.pulse[1] + _REST_S[1]))
        self.end = rests[-1][1]
        self.pulses = [*self.schedule.values(), *(circle.pulse for circle in self.circles)]
        self.phases |= {k: [(part.start + MARGIN_S, part.stop - MARGIN_S)] for k, part in self.schedule.items()}
        if self.circles:
            self.phases["circles"] = [(self.circles[0].start, self.circles[-1].pulse[1])]
        self.phases["rest"] = [(a + MARGIN_S, b - MARGIN_S) for a, b in rests]
        # The slip's gains [m]: the stated rms on each axis over the clasp, whatever the sampling rate.
        grid = np.arange(*self.clasp, 0.05)
        gate = make_pulse(grid, *self.clasp, RAMP_S)
        rms = np.array([np.sqrt(np.mean((gate * wander(grid)) ** 2)) for wander in flaws.slip])
        self.slip_gain = flaws.sizes.palm_slip / np.sqrt(3.0) / rms
        self.prepare(flaws.rngs["task"])
        if flaws.iterates:
            self._fit_reach()

    def prepare(self, rng: np.random.Generator) -> None:
        """Draw how this person does the parts."""
        size = self.flaws.sizes.start_pose
        self.raised, self.bent = dict[str, np.ndarray](), dict[str, np.ndarray]()  # rotation of an arm, of its forearm
        for side, y in SIDES.items():
            rng.standard_normal(9), rng.uniform(size=5)  # of parts that there were: a seed keeps its person
            elevation, plane, *bent = (
                np.deg2rad(offset.mean + size * offset.std * np.clip(rng.standard_normal(), -2.3, 2.3))
                for offset in T_POSE.values()
            )
            raised = Rotation.from_euler("x", y * (0.5 * np.pi + elevation))
            self.raised[side] = (Rotation.from_euler("z", -y * plane) * raised).as_rotvec()
            self.bent[side] = np.array(bent)
        self.bow_axis = size * BOW_AXIS_STD * np.clip(rng.standard_normal(), -2.3, 2.3)

    def _fit_reach(self) -> None:
        """Keep the hands as near as the arms need where shoulders and wrists move."""
        grid, clasp_t = np.arange(self.clasp[0], self.end, 0.05), np.arange(*self.clasp, 0.05)
        moving = self._motion_share(clasp_t)
        reaches = _REACHES if self.closes else [(1, self.slack)]
        self.strict = True
        for self.rounds, self.slack in reaches:
            distance = np.linalg.norm(self._clasp_point(clasp_t, moving), axis=1)
            self.flaws.wrists.fit(clasp_t, moving, np.column_stack((distance, distance)))
            try:
                if self.closes:
                    self(grid)
                break
            except BadOption:
                if (self.rounds, self.slack) == reaches[-1]:
                    raise
        self.strict = False

    def _clasp_point(self, t: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """Return the point where the palms meet (n, 3) [m] in T, from midway between the shoulders, in reach."""
        azimuth = np.deg2rad(38.0) * moving * self.wander["azimuth"](t)
        elevation = np.deg2rad(-4.0 + 46.0 * moving * self.wander["elevation"](t))
        fraction = 0.5 + 0.5 * moving * self.wander["radius"](t)
        ray = aim_ray(azimuth, elevation)
        # Shoulder to palm at the limits of the elbow, for the arm that is nearer to them.
        span = np.array(
            [[np.sqrt(a * a + b * b + 2 * a * b * np.cos(f)) for f in _FLEXION] for a, b in self.arm.values()]
        )
        longest, shortest = span[:, 0].min() - self.slack, span[:, 1].max()
        # The far shoulder limits the radius from above, the near one from below; the smooth |y| is safe.
        side = self.half_width * np.sqrt(ray[:, 1] ** 2 + 0.01)
        upper = np.sqrt(side**2 + longest**2 - self.half_width**2) - side
        lower = np.sqrt(side**2 + max(shortest**2 - self.half_width**2, 0.0)) + side
        chest = 0.3 * self.reach / ray[:, 0]  # hands stay in front of the chest
        lower = (lower**8 + chest**8) ** 0.125  # a smooth maximum
        return (lower + fraction * (upper - lower))[:, None] * ray

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        """Return the share (n,) of the hands' motion, 0 at both ends of a clasp."""
        return make_pulse(t, *self.schedule[self.led]) if self.led else np.zeros_like(t)

    def _palms(self, _t: np.ndarray, _motion_share: np.ndarray, clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        """Return the position (n, 3) [m] in T of each palm before the right one moves to the table."""
        return {"left": clasp_T, "right": clasp_T}

    def _lead_shares(self, t: np.ndarray, table: np.ndarray) -> dict[str, np.ndarray]:
        """Return the share (n,) by which each palm leads its arm; 0: the arm hangs."""
        if not self.led:
            return {"left": np.zeros_like(t), "right": table}
        names, part = list(self.schedule), self.schedule[self.led]
        from_n_pose = self.led == names[0]
        rise = make_step(t, STAND_S, _LEAD_S) if from_n_pose else make_step(t, part.start - _BLEND_S, _BLEND_S)
        if self.led == names[-1]:
            return {"left": rise * (1.0 - table), "right": rise}  # the left arm returns to hanging
        share = rise * (1.0 - make_step(t, part.stop, _BLEND_S))
        return {"left": share, "right": share + table}

    def _arm(self, side: str, palm_T: np.ndarray, swivel: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """Upper arm in T and elbow flexion [rad] to bring the palm to `palm_T` (n, 3) [m], from the shoulder.

        `swivel` (n,) [rad] turns the elbow about the line from shoulder to palm, from below outwards. The elbow is a
        hinge: the forearm is the upper arm turned by flexion about -y, then by pronation about its own z.
        """
        upper, lower = self.arm[side]
        distance = np.linalg.norm(palm_T, axis=1)
        cos_flexion = (distance**2 - upper**2 - lower**2) / (2.0 * upper * lower)
        if not np.all(np.abs(cos_flexion) < np.cos(_STRICT_FLEXION if self.strict else _LEAST_FLEXION)):
            raise BadOption(f"lengths: the {side} arm ({upper:.3f} + {lower:.3f} m) does not reach through the motion")
        flexion = np.arccos(cos_flexion)
        cos_alpha = (upper + lower * cos_flexion) / distance  # between upper arm and line to the palm
        sin_alpha = lower * np.sin(flexion) / distance
        n = palm_T / distance[:, None]
        down = np.array((0.0, 0.0, -1.0)) + n[:, 2:] * n  # e_down less its part along n
        down /= np.linalg.norm(down, axis=1)[:, None]
        m = np.cos(swivel)[:, None] * down + SIDES[side] * np.sin(swivel)[:, None] * np.cross(n, down)
        u = cos_alpha[:, None] * n + sin_alpha[:, None] * m  # shoulder to elbow
        x = sin_alpha[:, None] * n - cos_alpha[:, None] * m  # into which the forearm flexes
        return Rotation.from_matrix(np.stack((x, np.cross(n, m), -u), axis=2)), flexion

    def _reach(self, t: np.ndarray, side: str, hand: _Hand, hang: Rotation) -> tuple[np.ndarray, Rotation, np.ndarray]:
        """Shoulder (n, 3) [m] in T, upper arm in T and elbow flexion (n,) [rad] that bring the palm to its aim.

        The shoulder follows the arm, elbow and wrist are not straight. Each round bends the elbow towards the distance
        from shoulder to palm and turns the straight arm's solution to the palm. A fixed number of rounds is a smooth
        function of time.
        """
        flaws, y = self.flaws, SIDES[side]
        upper, lower = self.lengths[f"{side}_upper_arm"], np.linalg.norm(hand.palm_F, axis=1)
        centre_T = shoulder_T = flaws.girdle.place(y, self.moving_time(t))
        if not flaws.iterates:
            return shoulder_T, *self._arm(side, hand.palm_T - shoulder_T, hand.swivel)
        down_U = hang.apply(-E_Z)

        def bend(flexion: np.ndarray) -> np.ndarray:
            """Palm (n, 3) [m] in the upper arm, from the shoulder."""
            return flaws.elbow_joint.rotate(y, flexion, hand.pronation).apply(hand.palm_F) - upper * E_Z

        def opening(palm: np.ndarray) -> np.ndarray:
            """Angle (n,) [rad] at the elbow, 0 where the arm is straight, from the palm seen from the shoulder."""
            cos = (np.sum(palm**2, axis=1) - upper**2 - lower**2) / (2.0 * upper * lower)
            return np.arccos(np.clip(cos, -1.0, 1.0))

        for k in range(self.rounds):
            palm_T = hand.palm_T - shoulder_T
            R_TU, straight = self._arm(side, palm_T, hand.swivel)
            if k == 0:
                flexion, palm_U = straight, bend(straight)
            flexion = flexion + opening(palm_T) - opening(palm_U)
            palm_U = bend(flexion)
            R_TU = compose(_turn_to(R_TU.apply(palm_U), palm_T), R_TU)
            along_T = _scale(R_TU, hand.lead).apply(down_U)
            # A shoulder that rises lowers the arm, which lowers the shoulder: a part of the way settles sooner.
            shoulder_T = shoulder_T + _RELAXATION * (centre_T + flaws.girdle.displace(along_T, y) - shoulder_T)
        missing = np.linalg.norm(hand.palm_T - shoulder_T - R_TU.apply(palm_U), axis=1)
        worst = float(np.max(missing * (hand.lead == 1.0), initial=0.0))
        if self.strict and worst > _MOST_MISSING:
            raise BadOption(f"lengths: the {side} arm does not reach through the motion, by {1e3 * worst:.2g} mm")
        return shoulder_T, R_TU, flexion

    def __call__(self, t: np.ndarray, /) -> BodyPose:
        flaws, start_pose = self.flaws, self.flaws.start_pose
        moving = self._motion_share(t)
        circling = sum((make_pulse(t, *circle.pulse) for circle in self.circles), np.zeros_like(t))
        table = make_step(t, self.clasp[1], _LEAD_S)  # from the clasp to the table

        lean = np.column_stack([self.wander[name](t) for name in ("yaw", "pitch", "roll")])
        lean *= np.deg2rad(_LEAN_DEG * moving[:, None] + circling[:, None] * np.array((5.0, 3.0, 3.0)))
        lean[:, 1:] += flaws.sway_torso(t)
        R_WT = turn_about("ZYX", lean)
        if "bow" in self.schedule:
            across = np.array((-np.sin(self.bow_axis), np.cos(self.bow_axis), 0.0))
            bent = BOW * make_pulse(t, *self.schedule["bow"])
            R_WT = compose(Rotation.from_rotvec(bent[:, None] * across), R_WT)
        starting = 1.0 - make_step(t, STAND_S, _LEAD_S)
        R_WT = compose(R_WT, Rotation.from_rotvec(starting[:, None] * start_pose.torso))

        centred_T = self._clasp_point(t, moving)
        distance = np.linalg.norm(centred_T, axis=1)
        palms_T = self._palms(t, moving, centred_T + self.lengths["trunk"] * E_Z)
        hand_W = self.table_W + sum((c.offset_W(t, self.table_W) for c in self.circles), np.zeros((len(t), 3)))
        palms_T["right"] = palms_T["right"] + table[:, None] * (R_WT.inv().apply(hand_W) - palms_T["right"])
        slips = [gain * wander(t) for gain, wander in zip(self.slip_gain, flaws.slip, strict=True)]
        slip_T = 0.5 * moving[:, None] * np.column_stack(slips)
        leads, t_pose = self._lead_shares(t, table), np.zeros_like(t)  # the share of the T-pose
        if (part := self.schedule.get("t_pose")) is not None:
            t_pose = make_pulse(t, part.start - _BLEND_S, part.stop + _BLEND_S, _BLEND_S)

        pose = BodyPose({"torso": R_WT}, {}, {"torso": np.zeros(3)})
        for side, y in SIDES.items():
            lead = leads[side]
            hand_F = Rotation.identity(len(t))
            if flaws.sizes.wrists:
                hand_F = flaws.wrists.rotate(y, t, moving, circling, distance)
            palm_F = hand_F.apply((0.0, 0.0, -self.lengths[f"{side}_hand"])) - self.lengths[f"{side}_forearm"] * E_Z
            turning = np.deg2rad(55.0 * moving + 15.0 * circling) * self.wander[f"{side}_pronation"](t)
            hand = _Hand(
                lead,
                palms_T[side] + y * slip_T,
                palm_F,
                np.deg2rad(35.0 + 30.0 * (moving + 0.3 * circling) * self.wander[f"{side}_swivel"](t)),
                turning + (np.deg2rad(40.0) * table if side == "right" else 0.0),  # palm down on the table
            )
            hanging = (1.0 - lead)[:, None]
            raised, offsets = t_pose[:, None], hanging * (1.0 - t_pose)[:, None]
            turns = (
                hanging * (raised * self.raised[side]),
                hanging * flaws.sway_arm(t, side),
                offsets * start_pose.upper_arm[side],
            )
            hang = compose(*(Rotation.from_rotvec(each) for each in turns))
            shoulder_T, R_TU, flexion = self._reach(t, side, hand, hang)
            elbow = hanging * (raised * self.bent[side]) + offsets * start_pose.elbow[side]
            elbow += lead[:, None] * np.column_stack((flexion, hand.pronation))
            R_WU = compose(R_WT, _scale(R_TU, lead), hang)
            R_WF = compose(R_WU, flaws.elbow_joint.rotate(y, *elbow.T))
            place_arm(pose, side, R_WT.apply(shoulder_T), (R_WU, R_WF, compose(R_WF, hand_F)), flaws)
        return pose


def _schedule(parts: Sequence[str], begin: float, end: float) -> dict[str, _Part]:
    """Arrange the parts, by name, from `begin` to `end` [s]; a clasp takes the time that is left."""
    seconds = [_PART_S[kind][end - begin >= _LONG_S] if kind in _PART_S else 0.0 for kind in parts]
    # Time passes before and after a part but a bow: hands are led there, or arms are raised.
    changes = [_BLEND_S * ((a != "bow") + (b != "bow")) for a, b in pairwise(parts)]
    first, last = _BLEND_S * (parts[0] == "t_pose"), _BLEND_S * (parts[-1] == "t_pose")
    left = end - begin - sum(seconds) - sum(changes) - first - last
    leads = any(kind not in _PART_S for kind in parts)
    least = _LEAST_CLASP_S if leads else 0.0
    if left < least:
        needed = end - begin + least - left
        raise BadOption(f"protocol '{'+'.join(parts)}' needs {needed:.0f} s, {end - begin:g} are given")
    schedule, at = dict[str, _Part](), begin + first
    for kind, fixed, change in zip(parts, seconds, [*changes, last], strict=True):
        # Without a clasp the parts last longer.
        own = left if kind not in _PART_S else fixed + (0.0 if leads else left / len(parts))
        schedule[kind] = _Part(at, at + own, _POSE_RAMP_S if kind == "t_pose" else RAMP_S)
        at += own + change
    return schedule


def aim_ray(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return the unit vectors (n, 3) at these angles (n,) [rad] from x: azimuth to the left, elevation up."""
    level = np.cos(elevation)
    return np.column_stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)))


def _turn_to(vectors: np.ndarray, directions: np.ndarray) -> Rotation:
    """Return the least rotations (n) of vectors (n, 3) to the directions (n, 3), below a half turn."""
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (vectors, directions))
    return Rotation.from_quat(np.column_stack((np.cross(a, b), 1.0 + np.sum(a * b, axis=1))))


def _scale(R: Rotation, share: np.ndarray) -> Rotation:
    """Return shares (n,) of rotations (n), about the same axes."""
    return Rotation.from_rotvec(share[:, None] * log(R.as_quat()))


def place_arm(pose: BodyPose, side: str, shoulder_W: np.ndarray, R_WL: Sequence[Rotation], flaws: Flaws) -> None:
    """Put an arm into a pose, by its shoulder (n, 3) [m] in W and the rotations of upper arm, forearm and hand."""
    p_W = shoulder_W
    for part, start, R in zip(ARM, ("shoulder", "elbow", "wrist"), R_WL, strict=True):
        pose.R_WL[f"{side}_{part}"] = R
        pose.origins[f"{side}_{part}"] = pose.points[f"{side}_{start}"] = p_W
        p_W = p_W + R.apply((0.0, 0.0, -flaws.lengths[f"{side}_{part}"]))
    pose.points[f"{side}_palm"] = p_W
