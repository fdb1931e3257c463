"""How people differ from the model: shoulders, elbows and wrists that move otherwise, poses as they hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..rotations import turn_about
from .imperfections import Imperfections
from .signals import Process, Sway, Wander, rotate_about

SIDES = {"left": 1.0, "right": -1.0}  # y of the side in W


class Offset(NamedTuple):
    """What people do otherwise than the ideal, in degrees or degrees per degree."""

    mean: float
    std: float  # between people


# The N-pose on request, each person's own: assumptions, held to the drop from acromion to wrist of ANSUR II (Gordon
# 2014; a straight arm would be tilted by 10 to 12 deg), to N-pose errors in Bouvier 2015 and Bonfiglio 2024a.
TRUNK_POSE = {
    "torso_pitch": Offset(0.0, 3.0),
    "torso_roll": Offset(0.0, 1.5),
    "head_pitch": Offset(0.0, 5.0),
    "head_roll": Offset(0.0, 2.0),
    "head_heading": Offset(0.0, 5.0),
}
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
_CARRYING = {"m": Offset(11.6, 3.2), "f": Offset(16.7, 2.6)}
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
_ROUND = np.deg2rad(3.0)
_PERSON = np.array((0.006, 0.005, 0.008))  # [m] x, y, z in T, at 90 deg: Matsuki 2011-14, Henninger 2020
_WANDER = np.array((0.007, 0.004, 0.008))  # [m] rms, assumption: 3 to 4 deg of girdle
_WANDER_S = 3.0  # its correlation time
_REST = np.array((0.018, 0.012, 0.013))  # [m] between people
_REST_CORRELATION = 0.7  # between left and right, assumption


class Flaws:
    """Random imperfections of one person's motion; the sizes scale draws that do not depend on them."""

    def __init__(
        self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator], lengths: Mapping[str, float]
    ) -> None:
        self.sizes = sizes
        self.girdle = SimulatedGirdle(sizes, rngs, lengths)
        self.elbow_joint = Elbow(sizes, rngs)
        self.wrists = Wrists(sizes, rngs)
        self.start_pose = StartPoseOffsets(sizes, rngs)
        self.tilt = Process(rngs["sway_tilt"], _TILT_S, 2)
        self.slip = [Wander(rngs["palm_slip"]) for _ in range(3)]
        self.sway = {name: Sway(rngs["sway"]) for name in ("torso", *SIDES)}

    @property
    def iterates(self) -> bool:
        """True where the place of a hand follows from the arm's angles in steps only."""
        return any((self.sizes.girdle, self.sizes.wrists, self.sizes.elbow))

    def sway_torso(self, t: np.ndarray) -> np.ndarray:
        """Return the sway of the torso (n, 2) [rad] about x and y, in either order."""
        fast, slow = np.deg2rad(self.sizes.sway * np.array((_SWAY_DEG_S, _TILT_DEG / np.sqrt(2.0))))
        return np.asarray(fast * self.sway["torso"](t) + slow * self.tilt(t))

    def sway_arm(self, t: np.ndarray, side: str) -> np.ndarray:
        """Return the rotation vector (n, 3) [rad] by which a hanging arm sways."""
        return np.deg2rad(self.sizes.sway * _SWAY_DEG_S) * np.pad(self.sway[side](t), ((0, 0), (0, 1)))


class StartPoseOffsets:
    """One person's offsets from the start pose: rotation vectors [rad] of torso and upper arms, angles of elbows."""

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator]) -> None:
        z = rngs["start_pose"].standard_normal(len(TRUNK_POSE))
        trunk = sizes.start_pose * np.deg2rad([offset.std for offset in TRUNK_POSE.values()]) * z
        heading = np.deg2rad(sizes.start_heading_deg) * rngs["start_heading"].standard_normal()
        self.torso = np.array((trunk[1], trunk[0], heading))
        self.head = trunk[[3, 2, 4]]
        self.upper_arm: dict[str, np.ndarray] = {}
        self.flexion: dict[str, float] = {}
        self.pronation: dict[str, float] = {}  # about z of the forearm
        mean, std = np.deg2rad(list(ARM_POSE.values())).T
        both = rngs["start_pose"].standard_normal((3, len(ARM_POSE)))
        for (side, y), own in zip(SIDES.items(), both[1:], strict=True):
            z = np.sqrt(_SIDES_CORRELATION) * both[0] + np.sqrt(1.0 - _SIDES_CORRELATION) * own
            outwards, forwards, twist, flexion, inwards = sizes.start_pose * (mean + std * np.clip(z, -2.3, 2.3))
            self.upper_arm[side] = np.array((y * outwards, -forwards, -y * twist))
            self.flexion[side] = flexion
            self.pronation[side] = -y * inwards


class Elbow:
    """One person's elbows: an oblique hinge, an abduction that varies with flexion, and pronation about the forearm.

    Half of the carrying angle tilts the axis of flexion in the humerus, half the forearm on that axis, so that it goes
    as the elbow flexes. Pronation carries the wrist inwards: from the carrying angle in full supination to that of the
    neutral forearm, and as far again.
    """

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator]) -> None:
        rng = rngs["carrying_angle"]
        sex = ("f", "m")[int(rng.integers(2))]
        supinated, neutral = (
            offset.mean + offset.std * np.clip(rng.standard_normal(), -2.5, 2.5)
            for offset in (_CARRYING[sex], _NEUTRAL_CARRYING)
        )
        self.carrying, self.neutral = sizes.elbow * np.deg2rad((supinated, neutral))
        self.abduction = sizes.elbow * np.deg2rad(_ABDUCTION_DEG) * np.sqrt(2.0)
        self.phase = rngs["elbow_abduction"].uniform(0.0, 2.0 * np.pi)

    def _angles(self, y: float, flexion: np.ndarray, pronation: np.ndarray) -> np.ndarray:
        """Angles (n, 4) [rad] about x, y, x, z, one after the other, of the side y."""
        inwards = (self.carrying - self.neutral) * (1.0 - y * pronation / np.deg2rad(_SUPINATION_DEG))
        varying = self.abduction * np.sin(2.0 * np.pi * flexion / np.deg2rad(_ABDUCTION_PERIOD_DEG) + self.phase)
        half = 0.5 * self.carrying
        humerus = np.full_like(flexion, y * half)
        return np.column_stack((humerus, -flexion, y * (half - inwards + varying), pronation))

    def rotate(self, y: float, flexion: np.ndarray, pronation: np.ndarray) -> Rotation:
        """R_UF from flexion (n,) and pronation about z (n,) [rad] of the side y."""
        return turn_about("XYXZ", self._angles(y, flexion, pronation))

    def rotate_vectors(self, y: float, flexion: np.ndarray, pronation: np.ndarray, vectors_F: np.ndarray) -> np.ndarray:
        """Vectors (n, 3) in the upper arm from those in the forearm: `rotate`, made for speed."""
        x, flex, abduct, pronate = self._angles(y, flexion, pronation).T
        vectors = rotate_about(0, abduct, rotate_about(2, pronate, vectors_F))
        return rotate_about(0, x, rotate_about(1, flex, vectors))


class Wrists:
    """One person's wrists, which bend as the hands come near the chest, and wander; hands have no sensor."""

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator]) -> None:
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
        if not moving.any():
            return
        self.mean, self.std = float(np.mean(distance)), max(float(np.std(distance)), 0.01)
        for side in range(2):
            angles = moving[:, None] * sum(self._parts(t, distance[:, side], side))
            self.gain[side] = 1.0 / np.sqrt(np.mean(angles**2, axis=0))

    def rotate(
        self, y: float, t: np.ndarray, moving: np.ndarray, circling: np.ndarray, distance: np.ndarray
    ) -> Rotation:
        """R_FH of the side y, its hand at that distance (n,); both parts in the clasp, the wandering in the circles."""
        side = 0 if y > 0.0 else 1
        follows, wanders = self._parts(t, distance, side)
        angles = moving[:, None] * (follows + wanders) + circling[:, None] * wanders
        flexion, deviation = (self.rms * self.gain[side] * angles).T
        return turn_about("YX", np.column_stack((-flexion, y * deviation)))


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

    def locate(clavicle: np.ndarray, scapula: np.ndarray) -> np.ndarray:
        """Place (n, 3) [m] of the shoulder's centre by the angles (k, n) [deg] of clavicle and scapula."""
        clavicle, scapula = np.deg2rad(clavicle), np.deg2rad(scapula)
        outer_end = rotate_about(1, clavicle[0], rotate_about(2, clavicle[1], np.array((_CLAVICLE_LENGTH, 0.0, 0.0))))
        about_x = rotate_about(0, scapula[2], _AC_TO_GH_SCAPULA)
        return outer_end + rotate_about(1, scapula[0], rotate_about(2, scapula[1], about_x))

    def angles(rows: np.ndarray) -> np.ndarray:
        """Angles (k, n) [deg]."""
        constant, by_plane, by_elevation, by_rest, rest = (column[:, None] for column in rows.T)
        return rest + onset * (constant + by_plane * plane + by_elevation * elevation + (by_rest - 1.0) * rest)

    moved = locate(angles(_CLAVICLE), angles(_SCAPULA)) - locate(_CLAVICLE[:, 4:], _SCAPULA[:, 4:])
    return np.column_stack((-moved[:, 2], side * moved[:, 0], moved[:, 1]))


class SimulatedGirdle:
    """The girdle of one person: regression, own deviation, wandering and rest place.

    The lengths of a simulated person are those of the mean place at rest: `shoulder_width` is the distance of the two
    centres along y, `trunk` their mean height. So the place at rest leaves each shoulder its own x, half of the
    left-right difference in z and a common shift in y.
    """

    def __init__(
        self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator], lengths: Mapping[str, float]
    ) -> None:
        self.size, self.lengths = sizes.girdle, lengths
        self.scale = lengths["shoulder_width"] / _WIDTH
        draws = np.clip(rngs["girdle_person"].standard_normal((2, 3)), -2.5, 2.5)
        self.wander = Process(rngs["girdle_wander"], _WANDER_S, 6)
        common, left, right = np.clip(rngs["girdle_rest"].standard_normal((3, 3)), -2.5, 2.5)
        both = [np.sqrt(_REST_CORRELATION) * common + np.sqrt(1.0 - _REST_CORRELATION) * own for own in (left, right)]
        rest = _REST * np.array(both)  # y is outwards here
        shift, tilt = 0.5 * (rest[0] - rest[1])[1:]
        rest[:, 1], rest[:, 2] = shift, (tilt, -tilt)
        self.rest = {1.0: rest[0], -1.0: rest[1]}  # y of the side -> (3,) [m] in T
        self.person = {1.0: draws[0], -1.0: draws[1]}

    def displace(self, along_T: np.ndarray, side: float) -> np.ndarray:
        """Displacement (n, 3) [m] in T of the shoulder of the side y by its arm, along `along_T` (n, 3)."""
        law = self.scale * compute_girdle(along_T, side)
        horizontal = np.hypot(along_T[:, 0], along_T[:, 1])
        # An angle from hanging has a kink there: rounded off within a few degrees.
        elevation = np.hypot(np.arctan2(horizontal, -along_T[:, 2]), _ROUND) - _ROUND
        share = elevation / (0.5 * np.pi)
        return np.asarray(self.size * (law + share[:, None] * _PERSON * self.person[side]))

    def place(self, side: float, moving_time: np.ndarray) -> np.ndarray:
        """Place (n, 3) [m] in T of a shoulder whatever its arm does, after that time of motion (n,) [s]."""
        own = slice(0, 3) if side > 0.0 else slice(3, 6)
        moved = self.size * (self.rest[side] + _WANDER * self.wander(moving_time, own))
        return np.asarray(place_shoulder(side, self.lengths) + moved)


def place_shoulder(side: float, lengths: Mapping[str, float]) -> np.ndarray:
    """Place the centre (3,) [m] of the shoulder of the side y in the torso, by the lengths."""
    return np.array((0.0, 0.5 * side * lengths["shoulder_width"], lengths["trunk"]))
