"""How people differ from the model: shoulders, elbows, wrists, poses as they hold them, tissue under sensors."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..rotations import compose, log, turn_about
from .imperfections import GRAVITY, Imperfections
from .signals import Process, RandomWalk, Streams, Sway, Wander, integrate_step

SIDES = {"left": 1.0, "right": -1.0}  # y of the side in W
E_Z = np.array((0.0, 0.0, 1.0))
Rotations = Mapping[str, Rotation]  # segment -> n rotations


class BodyPose(NamedTuple):
    """Exact motion at n times."""

    R_WL: dict[str, Rotation]  # segment -> n rotations
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W
    origins: dict[str, np.ndarray]  # segment -> (n, 3) [m] in W, or (3,) where it does not move


class Offset(NamedTuple):
    """What people do otherwise than the ideal, in degrees or degrees per degree."""

    mean: float
    std: float  # between people


# The N-pose on request, each person's own: assumptions, checked against the drop from acromion to wrist of ANSUR II
# (Gordon 2014; a straight arm would be tilted by 10 to 12 deg) and N-pose errors in Bouvier 2015 and Bonfiglio 2024a.
_TRUNK_POSE_STD = np.deg2rad((3.0, 1.5, 5.0, 2.0, 5.0))  # pitch, roll of the torso; pitch, roll, heading of the head
ARM_POSE = {
    "upper_arm_outwards": Offset(8.0, 4.0),
    "upper_arm_forwards": Offset(0.0, 5.0),
    "upper_arm_inward_twist": Offset(5.0, 12.0),
    "elbow_flexion": Offset(12.0, 5.0),
    "forearm_inward_twist": Offset(5.0, 12.0),
}
_SIDES_CORRELATION = 0.5  # of the arms' offsets, assumption
_SWAY_DEG_S, _TILT_DEG = 0.5, 0.22  # rms, fast and slow part of the sway
_TILT_S = 1.5  # correlation time of the slow part, assumption

# Carrying angle, extended and supinated: Van Roy 2005, Ergonomics 48, 1645; in neutral pronation: as in ARM_POSE.
_CARRYING = (Offset(16.7, 2.6), Offset(11.6, 3.2))  # of women, of men
_NEUTRAL_CARRYING = Offset(5.0, 3.0)
_SUPINATION_DEG = 80.0  # full; Zwerus 2019, Shoulder Elbow 11, 215
_ABDUCTION_DEG = 1.5  # rms
_ABDUCTION_PERIOD_DEG = 120.0  # of flexion, in which the residual abduction goes once to and fro

_WRIST_DEG = (12.0, 8.0)  # flexion, deviation, rms
_WRIST_SHARE = (0.8, 0.6)  # of the hands' distance from the chest, and of a wandering
_WRIST_S = 2.0  # correlation time of the wandering, assumption

# Regression of de Groot & Brand 2001 (Clin Biomech 16, 735; 10 people, 23 arm positions), with the rest angles of the
# Delft arm model: constant, slope in the plane of elevation, slope in elevation, gain of the angle at rest, that angle.
# Degrees; right shoulder, x to the right, y up, z backwards; a clavicle turns about y then z, a scapula about y, z, x.
_CLAVICLE = np.array(((-4.983, 0.120, -0.242, 0.851, -28.6), (3.917, -0.046, 0.123, 0.493, 11.7)))
_SCAPULA = np.array(
    ((-1.203, 0.140, -0.049, 0.901, 32.0), (3.095, -0.079, 0.396, 0.414, 10.7), (0.659, -0.028, 0.184, 0.886, -10.3))
)
_CLAVICLE_LENGTH = 0.150  # [m] Bernat 2014 (149 ± 10 mm), of a shoulder width of _WIDTH
_WIDTH = 0.340  # [m] between the shoulder centres of the arm model of Holzbaur 2005
_AC_TO_GH = np.array((0.008, -0.036, 0.003))  # [m] at rest, outer end of the clavicle to the shoulder's centre
_AC_TO_GH_SCAPULA = Rotation.from_euler("YZX", _SCAPULA[:, 4], degrees=True).inv().apply(_AC_TO_GH)
_ONSET_DEG = 15.0  # the regression holds from about 30 deg of elevation: below, its angles grow from those at rest
_PLANE_BLUR = np.sin(np.deg2rad(8.0))  # the plane of a hanging arm has no meaning: it is blurred there
_PERSON = np.array((0.006, 0.005, 0.008))  # [m] x, y, z in T, at 90 deg: Matsuki 2011-14, Henninger 2020
_WANDER = np.array((0.007, 0.004, 0.008))  # [m] rms, assumption: 3 to 4 deg of girdle
_WANDER_S = 3.0  # its correlation time
_REST = np.array((0.018, 0.012, 0.013))  # [m] between people
_REST_CORRELATION = 0.7  # between left and right, assumption

# Rotation of a sensor on its segment, degree per degree of a joint's, and its spread between people and strappings.
GAINS = {
    # A bow turns the sternum more than the trunk, assumption.
    "torso_flexion": Offset(0.12, 0.05),
    # The chest extends by 12.8 (7.6) deg when both arms go up: Edmondston 2012, J Orthop Sports Phys Ther 42, 861.
    "torso_elevation": Offset(-0.04, 0.025),
    # One arm up bends and turns the chest to either side: Stewart 1995, J Man Manip Ther 3, 15.
    "torso_sides": Offset(0.0, 0.02),
    "upper_arm_elevation": Offset(-0.05, 0.04),  # Hamming 2012 J Biomech; Jackson 2015 Appl Ergon 47, 242
    "upper_arm_flexion": Offset(0.02, 0.02),  # biceps and triceps bulge, either sign, assumption
    "forearm_flexion": Offset(0.01, 0.01),  # assumption, either sign
    "pelvis_flexion": Offset(-0.08, 0.04),  # assumption
}
_TWIST_STD = 0.08  # of the two gains of twist, between people
# rms across and about the segment's long axis [deg], correlation time [s]; assumptions, checked against Lebel 2017.
RANDOM_DEG = {
    "torso": (1.5, 1.5, 3.0),
    "upper_arm": (2.0, 2.5, 2.0),
    "forearm": (2.0, 2.0, 2.0),
    "hand": (1.5, 1.5, 1.0),
    "pelvis": (2.0, 1.5, 3.0),
    "head": (1.0, 1.0, 5.0),
}
_ELEVATED = np.deg2rad((20.0, 20.0))  # elevation is read too small from 30 deg on: this far below, and so softly
_BREATH_DEG, _BREATH_HZ = 0.7, (0.22, 0.28)
_CREEP_DEG, _CREEP_S = 1.0, 600.0
_WOBBLE_DEG = 0.5  # per g

# Streams of random numbers; "-" are those of what there was: a seed keeps its person.
_STREAMS = (
    "motion strap noise palm_slip - - - sway - device clock_jitter clock_offset dropped mount task tissue_gain "
    "tissue_random breath creep - girdle_person girdle_wander girdle_rest carrying_angle elbow_abduction start_pose "
    "start_heading sway_tilt wrist gyro_warm_up clock_drift"
).split()


class Flaws:
    """Random imperfections of one person's motion; the sizes scale draws that do not depend on them.

    `rngs` are the person's streams of random numbers, `lengths` those of the body [m].
    """

    def __init__(self, sizes: Imperfections, seed: int, lengths: Mapping[str, float]) -> None:
        self.sizes, self.lengths = sizes, lengths
        # Whether the place of a hand follows from the arm's angles in steps only.
        self.iterates = any((sizes.girdle, sizes.wrists, sizes.elbow))
        rngs = dict(zip(_STREAMS, np.random.default_rng(seed).spawn(len(_STREAMS)), strict=True))
        self.rngs: Streams = rngs
        self.girdle = SimulatedGirdle(sizes, rngs, lengths)
        self.elbow_joint = Elbow(sizes, rngs)
        self.wrists = Wrists(sizes, rngs)
        self.start_pose = StartPoseOffsets(sizes, rngs)
        self.tilt = Process(rngs["sway_tilt"], _TILT_S, 2)
        self.slip = [Wander(rngs["palm_slip"]) for _ in range(3)]
        self.sway = {name: Sway(rngs["sway"]) for name in ("torso", *SIDES)}

    def sway_torso(self, t: np.ndarray) -> np.ndarray:
        """Return the sway of the torso (n, 2) [rad] about x and y, in either order."""
        fast, slow = np.deg2rad(self.sizes.sway * np.array((_SWAY_DEG_S, _TILT_DEG / np.sqrt(2.0))))
        return np.asarray(fast * self.sway["torso"](t) + slow * self.tilt(t))

    def sway_arm(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the rotation vector (n, 3) [rad] by which a hanging arm sways."""
        return np.deg2rad(self.sizes.sway * _SWAY_DEG_S) * np.pad(self.sway[side](t), ((0, 0), (0, 1)))


class StartPoseOffsets:
    """One person's offsets from the start pose: rotation vectors [rad] of torso and upper arms, angles of elbows."""

    def __init__(self, sizes: Imperfections, rngs: Streams) -> None:
        rng, heading = rngs["start_pose"], rngs["start_heading"].standard_normal()
        trunk = sizes.start_pose * _TRUNK_POSE_STD * rng.standard_normal(len(_TRUNK_POSE_STD))
        self.torso = np.array((trunk[1], trunk[0], np.deg2rad(sizes.start_heading_deg) * heading))
        self.head = trunk[[3, 2, 4]]
        self.upper_arm: dict[str, np.ndarray] = {}
        self.elbow: dict[str, np.ndarray] = {}  # flexion, and pronation about z of the forearm
        mean, std = np.deg2rad(list(ARM_POSE.values())).T
        common, *both = rng.standard_normal((3, len(ARM_POSE)))
        for (side, y), own in zip(SIDES.items(), both, strict=True):
            z = np.sqrt(_SIDES_CORRELATION) * common + np.sqrt(1.0 - _SIDES_CORRELATION) * own
            outwards, forwards, twist, flexion, inwards = sizes.start_pose * (mean + std * np.clip(z, -2.3, 2.3))
            self.upper_arm[side] = np.array((y * outwards, -forwards, -y * twist))
            self.elbow[side] = np.array((flexion, -y * inwards))


class Elbow:
    """One person's elbows: an oblique hinge, an abduction that varies with flexion, and pronation about the forearm.

    Half of the carrying angle tilts the axis of flexion in the humerus, half the forearm on that axis, so that it goes
    as the elbow flexes. Pronation carries the wrist inwards: from the carrying angle in full supination to that of the
    neutral forearm, and as far again.
    """

    def __init__(self, sizes: Imperfections, rngs: Streams) -> None:
        rng = rngs["carrying_angle"]
        supinated, neutral = (
            offset.mean + offset.std * np.clip(rng.standard_normal(), -2.5, 2.5)
            for offset in (_CARRYING[int(rng.integers(2))], _NEUTRAL_CARRYING)
        )
        self.carrying, self.neutral = sizes.elbow * np.deg2rad((supinated, neutral))
        self.abduction = sizes.elbow * np.deg2rad(_ABDUCTION_DEG) * np.sqrt(2.0)
        self.phase = rngs["elbow_abduction"].uniform(0.0, 2.0 * np.pi)

    def rotate(self, y: float, flexion: np.ndarray, pronation: np.ndarray) -> Rotation:
        """Return R_UF from flexion (n,) and pronation about z (n,) [rad] of the side y."""
        inwards = (self.carrying - self.neutral) * (1.0 - y * pronation / np.deg2rad(_SUPINATION_DEG))
        varying = self.abduction * np.sin(2.0 * np.pi * flexion / np.deg2rad(_ABDUCTION_PERIOD_DEG) + self.phase)
        half = 0.5 * self.carrying
        humerus = np.full_like(flexion, y * half)
        return turn_about("XYXZ", np.column_stack((humerus, -flexion, y * (half - inwards + varying), pronation)))


class Wrists:
    """One person's wrists, which bend as the hands come near the chest, and wander; hands have no sensor."""

    def __init__(self, sizes: Imperfections, rngs: Streams) -> None:
        self.rms = sizes.wrists * np.deg2rad(_WRIST_DEG)
        # Hands near the chest extend the wrists; a deviation goes either way.
        self.sign = np.array((-1.0, rngs["wrist"].choice((-1.0, 1.0))))
        self.wander = Process(rngs["wrist"], _WRIST_S, 4)
        self.mean, self.std = 0.0, 1.0  # of the distance [m]
        self.gain = np.ones((2, 2))  # side, angle

    def _parts(self, t: np.ndarray, distance: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts (n, 2) of a side's angles: by the hand's distance (n,) [m] from the chest, at random."""
        near = (distance - self.mean) / self.std
        follows = _WRIST_SHARE[0] * near[:, None] * self.sign
        return follows, _WRIST_SHARE[1] * self.wander(t, slice(2 * side, 2 * side + 2))

    def fit(self, t: np.ndarray, moving: np.ndarray, distance: np.ndarray) -> None:
        """Set the gains so that the angles have their rms at these times (n,), where hands move at all.

        `moving` (n,) is the share of the motion, `distance` (n, 2) [m] that of each hand from the chest.
        """
        if moving.any():
            self.mean, self.std = float(np.mean(distance)), max(float(np.std(distance)), 0.01)
            for side in range(2):
                angles = moving[:, None] * sum(self._parts(t, distance[:, side], side))
                self.gain[side] = 1.0 / np.sqrt(np.mean(angles**2, axis=0))

    def rotate(
        self, y: float, t: np.ndarray, moving: np.ndarray, circling: np.ndarray, distance: np.ndarray
    ) -> Rotation:
        """Return R_FH of the side y; both parts of the angles in the clasp, the wandering in the circles."""
        side = 0 if y > 0.0 else 1
        follows, wanders = self._parts(t, distance, side)
        angles = moving[:, None] * (follows + wanders) + circling[:, None] * wanders
        flexion, deviation = (self.rms * self.gain[side] * angles).T
        return turn_about("YX", np.column_stack((-flexion, y * deviation)))


# Shoulders ------------------------------------------------------------------------------------------------------------


def compute_girdle(along_T: np.ndarray, side: float) -> np.ndarray:
    """Compute the displacement (n, 3) [m] in T of a shoulder's centre from rest, of a clavicle of `_CLAVICLE_LENGTH`.

    `along_T` (n, 3) unit is the direction of the upper arm in T; `side` is 1 left, -1 right.
    """
    out, forward, up = side * along_T[:, 1], along_T[:, 0], along_T[:, 2]
    horizontal = np.hypot(out, forward)
    elevation = np.rad2deg(np.arctan2(horizontal, -up))
    # 0 sideways, 90 forwards, from the middle of that range, so that the jump of the angle is behind the body.
    a, b = (out + forward) / np.sqrt(2.0), (forward - out) / np.sqrt(2.0)
    plane = 45.0 + np.rad2deg(2.0 * np.arctan2(b, a + np.sqrt(horizontal**2 + _PLANE_BLUR**2)))
    onset = 1.0 - np.exp(-((elevation / _ONSET_DEG) ** 2))

    def locate(clavicle_deg: np.ndarray, scapula_deg: np.ndarray) -> np.ndarray:
        """Return the place (n, 3) [m] of the shoulder's centre by angles (k, n) of clavicle and scapula."""
        clavicle, scapula = (np.deg2rad(angles.T) for angles in (clavicle_deg, scapula_deg))
        outer_end = turn_about("YZ", clavicle).apply((_CLAVICLE_LENGTH, 0.0, 0.0))
        return outer_end + turn_about("YZX", scapula).apply(_AC_TO_GH_SCAPULA)

    def angles_deg(rows: np.ndarray) -> np.ndarray:
        constant, by_plane, by_elevation, by_rest, rest = (column[:, None] for column in rows.T)
        return rest + onset * (constant + by_plane * plane + by_elevation * elevation + (by_rest - 1.0) * rest)

    moved = locate(angles_deg(_CLAVICLE), angles_deg(_SCAPULA)) - locate(_CLAVICLE[:, 4:], _SCAPULA[:, 4:])
    return np.column_stack((-moved[:, 2], side * moved[:, 0], moved[:, 1]))


class SimulatedGirdle:
    """The girdle of one person: regression, own deviation, wandering and rest place.

    The lengths of a simulated person are those of the mean place at rest: `shoulder_width` is the distance of the two
    centres along y, `trunk` their mean height. So the place at rest leaves each shoulder its own x, half of the
    left-right difference in z and a common shift in y.
    """

    def __init__(self, sizes: Imperfections, rngs: Streams, lengths: Mapping[str, float]) -> None:
        self.size, self.lengths = sizes.girdle, lengths
        draws = np.clip(rngs["girdle_person"].standard_normal((2, 3)), -2.5, 2.5)
        self.wander = Process(rngs["girdle_wander"], _WANDER_S, 6)
        common, left, right = np.clip(rngs["girdle_rest"].standard_normal((3, 3)), -2.5, 2.5)
        both = [np.sqrt(_REST_CORRELATION) * common + np.sqrt(1.0 - _REST_CORRELATION) * own for own in (left, right)]
        rest = _REST * np.array(both)  # y is outwards here
        shift, tilt = 0.5 * (rest[0] - rest[1])[1:]
        rest[:, 1], rest[:, 2] = shift, (tilt, -tilt)
        self.rest = dict(zip(SIDES.values(), rest, strict=True))  # y of the side -> (3,) [m] in T
        self.person = dict(zip(SIDES.values(), draws, strict=True))

    def displace(self, along_T: np.ndarray, side: float) -> np.ndarray:
        """Return the displacement (n, 3) [m] in T of the shoulder of the side y by its arm, along `along_T` (n, 3)."""
        law = self.lengths["shoulder_width"] / _WIDTH * compute_girdle(along_T, side)
        elevation = _round_off(np.arctan2(np.hypot(along_T[:, 0], along_T[:, 1]), -along_T[:, 2]))
        share = elevation / (0.5 * np.pi)
        return np.asarray(self.size * (law + share[:, None] * _PERSON * self.person[side]))

    def place(self, side: float, moving_time: np.ndarray) -> np.ndarray:
        """Return the place (n, 3) [m] in T of a shoulder whatever its arm does, after that time of motion (n,) [s]."""
        own = slice(0, 3) if side > 0.0 else slice(3, 6)
        moved = self.size * (self.rest[side] + _WANDER * self.wander(moving_time, own))
        return np.asarray(place_shoulder(side, self.lengths) + moved)


def place_shoulder(side: float, lengths: Mapping[str, float]) -> np.ndarray:
    """Return the centre (3,) [m] of the shoulder of the side y in the torso, by the lengths."""
    return np.array((0.0, 0.5 * side * lengths["shoulder_width"], lengths["trunk"]))


def _round_off(angle: np.ndarray) -> np.ndarray:
    """Round off the kink that an angle from hanging (n,) [rad] has at zero, within a few degrees."""
    soft = np.deg2rad(3.0)
    return np.asarray(np.hypot(angle, soft) - soft)


# Soft tissue ----------------------------------------------------------------------------------------------------------


def _split(R: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Split R into swing @ twist about z: the swing's rotation vector (n, 3) after the twist, the twist (n,) [rad]."""
    z, w = R.as_quat()[:, 2:].T
    twist = 2.0 * np.arctan2(np.where(w < 0.0, -z, z), np.abs(w))
    about_z = Rotation.from_rotvec(twist[:, None] * E_Z)
    return about_z.inv().apply(log(compose(R, about_z.inv()).as_quat())), twist


def _read_arm(R_WL: Rotations, side: str) -> tuple[np.ndarray, ...]:
    """Return the upper arm's swing (n, 3) in its own frame, its elevation, flexion, twist and pronation (n,) [rad]."""
    R_WU = R_WL[f"{side}_upper_arm"]
    swing, twist = _split(compose(R_WL["torso"].inv(), R_WU))
    bend, pronation = _split(compose(R_WU.inv(), R_WL[f"{side}_forearm"]))
    elevation, flexion = (_round_off(np.linalg.norm(v, axis=1)) for v in (swing, bend))
    return swing, elevation, flexion, twist, pronation


class SoftTissue:
    """The rotation of one sensor on its segment: by the joints, at random, by breath, creep and acceleration.

    `place` is the sensor's, as a share of the segment's length; `start` is R_WL of trunk and arms in the start pose.
    """

    def __init__(
        self, segment: str, place: float, sizes: Imperfections, rngs: Streams, duration: float, start: Rotations
    ) -> None:
        side, _, part = segment.partition("_")
        self.side, self.part = (side, part) if part else ("", segment)
        self.sizes, self.start = sizes, start
        self.draw = np.clip(rngs["tissue_gain"].standard_normal(4), -2.5, 2.5)
        self.sign = rngs["tissue_gain"].choice((-1.0, 1.0), 2)
        heading = rngs["tissue_gain"].uniform(0.0, 2.0 * np.pi)
        self.across = np.array((np.cos(heading), np.sin(heading), 0.0))
        # Share of the twist that the sensor does not follow. Upper arm: a line through the 35 to 48 % of Cutti 2005
        # (Gait Posture 21, 341), the cluster gains of 0.64 to 0.74 of PubMed 40222145 and the ranges of Warner & Heller
        # 2025. Forearm: an assumption, of which only the direction is known (Charles 2022, J Biomech Eng 144, 071007).
        self.lost = 0.55 - 0.40 * place if self.part == "upper_arm" else 0.95 - 0.90 * place
        across_deg, twist_deg, correlation_s = RANDOM_DEG.get(self.part, (0.0, 0.0, 1.0))
        self.random_rms = np.deg2rad((across_deg, across_deg, twist_deg))
        self.random = Process(rngs["tissue_random"], correlation_s, 3)
        self.breath = 2.0 * np.pi * rngs["breath"].uniform(*_BREATH_HZ), rngs["breath"].uniform(0.0, 2.0 * np.pi)
        self.creep = RandomWalk(rngs["creep"], duration, 3)
        self.creep_rms = np.deg2rad(_CREEP_DEG) * np.sqrt(duration / _CREEP_S)

    def _gain(self, name: str, k: int, sign: float = 1.0) -> float:
        """Return this person's gain, with the draw k."""
        return sign * (GAINS[name].mean + self.draw[k] * GAINS[name].std)

    def follow(self, R_WL: Rotations) -> np.ndarray:
        """Return rotation vectors (n, 3) [rad] in L by the joints' rotation since the start pose, at people's size."""
        turn = np.zeros((len(R_WL["torso"]), 3))
        if self.part in ("torso", "pelvis"):
            flexion, first = (_split(each["torso"])[0][:, 1] for each in (R_WL, self.start))
            turn[:, 1] = self._gain(f"{self.part}_flexion", 0) * (flexion - first)
        if self.part == "torso":
            left, right = (_read_arm(R_WL, side)[1] - _read_arm(self.start, side)[1] for side in SIDES)
            turn[:, 1] += self._gain("torso_elevation", 1) * 0.5 * (left + right)
            turn[:, 0] = self._gain("torso_sides", 2) * (right - left)
            turn[:, 2] = self._gain("torso_sides", 3) * (right - left)
        elif self.part in ("upper_arm", "forearm"):
            (swing, *angles), (_, *first_angles) = _read_arm(R_WL, self.side), _read_arm(self.start, self.side)
            _, bend, twist, pronation = (angle - first for angle, first in zip(angles, first_angles, strict=True))
            turn[:, 2] = -(self.lost + self.draw[0] * _TWIST_STD) * (twist if self.part == "upper_arm" else pronation)
            if self.part == "upper_arm":
                # The angle above 30 deg, about the axis of elevation; none below 20 deg, where it has no meaning.
                angle = np.linalg.norm(swing, axis=1)
                above = integrate_step(angle, *_ELEVATED) / np.maximum(angle, _ELEVATED[0])
                turn += self._gain("upper_arm_elevation", 1) * above[:, None] * swing
                turn += self._gain("upper_arm_flexion", 2, self.sign[0]) * bend[:, None] * self.across
                turn[:, 2] += self._gain("upper_arm_flexion", 3, self.sign[1]) * bend
            else:
                turn += self._gain("forearm_flexion", 1, self.sign[0]) * bend[:, None] * self.across
        return turn

    def __call__(self, t: np.ndarray, moving_time: np.ndarray, R_WL: Rotations, accel_L: np.ndarray) -> np.ndarray:
        """Return rotation vectors (n, 3) [rad] in L at the times `t` (n,) [s].

        The random part stands where the segment does: `moving_time` (n,) [s] is how long it has moved. `R_WL` at `t`
        is of trunk and arms. Limbs move below 5 Hz: the low-pass of a strap at 15 Hz, which the literature gives, would
        change nothing of `accel_L` (n, 3) [m/s^2].
        """
        sizes, turn = self.sizes, np.zeros((len(t), 3))
        if sizes.tissue_random:
            across = np.cross(E_Z, accel_L)  # the free side of the strap lags
            turn = self.random_rms * self.random(moving_time) + self.creep_rms * self.creep(t)
            turn = sizes.tissue_random * (turn - np.deg2rad(_WOBBLE_DEG) / GRAVITY * across)
        if sizes.tissue_gain:
            turn = turn + sizes.tissue_gain * self.follow(R_WL)
        if sizes.sway and self.part == "torso":
            rate, phase = self.breath
            turn[:, 1] += sizes.sway * np.sqrt(2.0) * np.deg2rad(_BREATH_DEG) * np.sin(rate * t + phase)
        return turn
