"""How people differ from the model: the pose they start in, their elbows and their wrists."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..rotations import turn_about
from .imperfections import Imperfections
from .signals import Process, rotate_about


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

# Carrying angle, extended and supinated: Van Roy 2005, Ergonomics 48, 1645; in neutral pronation: as in ARM_POSE.
_CARRYING = {"m": Offset(11.6, 3.2), "f": Offset(16.7, 2.6)}
_NEUTRAL_CARRYING = Offset(5.0, 3.0)
_SUPINATION_DEG = 80.0  # full; Zwerus 2019, Shoulder Elbow 11, 215
_ABDUCTION_PERIOD_DEG = 120.0  # of flexion, in which the residual abduction goes once to and fro

_WRIST_SHARE = (0.8, 0.6)  # of the hands' distance from the chest, and of a wandering
_WRIST_S = 2.0  # correlation time of the wandering, assumption


class StartPoseOffsets:
    """One person's offsets from the start pose: rotation vectors [rad] of torso and upper arms, angles of elbows."""

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator], sides: Mapping[str, float]):
        z = rngs["start_pose"].standard_normal(len(TRUNK_POSE))
        turn = {
            name: sizes.start_pose * np.deg2rad(offset.std) * own
            for (name, offset), own in zip(TRUNK_POSE.items(), z, strict=True)
        }
        heading = np.deg2rad(sizes.start_heading_deg) * rngs["start_heading"].standard_normal()
        self.torso = np.array((turn["torso_roll"], turn["torso_pitch"], heading))
        self.head = np.array((turn["head_roll"], turn["head_pitch"], turn["head_heading"]))
        self.upper_arm: dict[str, np.ndarray] = {}
        self.flexion: dict[str, float] = {}
        self.pronation: dict[str, float] = {}  # about z of the forearm
        both = rngs["start_pose"].standard_normal((3, len(ARM_POSE)))
        for (side, y), own in zip(sides.items(), both[1:], strict=True):
            z = np.sqrt(_SIDES_CORRELATION) * both[0] + np.sqrt(1.0 - _SIDES_CORRELATION) * own
            size = {
                name: sizes.start_pose * np.deg2rad(offset.mean + offset.std * np.clip(u, -2.3, 2.3))
                for (name, offset), u in zip(ARM_POSE.items(), z, strict=True)
            }
            self.upper_arm[side] = np.array(
                (y * size["upper_arm_outwards"], -size["upper_arm_forwards"], -y * size["upper_arm_inward_twist"])
            )
            self.flexion[side] = size["elbow_flexion"]
            self.pronation[side] = -y * size["forearm_inward_twist"]


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
        self.carrying, self.neutral = sizes.carrying_angle * np.deg2rad((supinated, neutral))
        self.abduction = np.deg2rad(sizes.elbow_abduction_deg) * np.sqrt(2.0)
        self.phase = rngs["elbow_abduction"].uniform(0.0, 2.0 * np.pi)

    @property
    def is_ideal(self) -> bool:
        """True where the elbow is a hinge across both segments."""
        return not (self.carrying or self.abduction)

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
        self.rms = np.deg2rad((sizes.wrist_flexion_deg, sizes.wrist_deviation_deg))
        # Hands near the chest extend the wrists; a deviation goes either way.
        self.sign = np.array((-1.0, rngs["wrist"].choice((-1.0, 1.0))))
        self.wander = Process(rngs["wrist"], _WRIST_S, 4)
        self.mean, self.std = 0.0, 1.0  # of the distance [m]
        self.gain = np.ones((2, 2))  # side, angle

    @property
    def bend(self) -> bool:
        """True where they do."""
        return bool(self.rms.any())

    def _parts(self, t: np.ndarray, distance: np.ndarray, sides: slice = slice(0, 2)) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts (n, s, 2) of the angles: by the distance (n, s) [m] of hands from the chest, at random."""
        near = (distance - self.mean) / self.std
        follows = _WRIST_SHARE[0] * near[:, :, None] * self.sign
        return follows, _WRIST_SHARE[1] * self.wander(t, slice(2 * sides.start, 2 * sides.stop)).reshape(len(t), -1, 2)

    def fit(self, t: np.ndarray, moving: np.ndarray, distance: np.ndarray) -> None:
        """Set the gains so that the angles have their rms at these times (n,), where hands move at all.

        `moving` (n,) is the share of the motion, `distance` (n, 2) [m] that of each hand from the chest.
        """
        if not moving.any():
            return
        self.mean, self.std = float(np.mean(distance)), max(float(np.std(distance)), 0.01)
        angles = moving[:, None, None] * sum(self._parts(t, distance))
        self.gain = 1.0 / np.sqrt(np.mean(angles**2, axis=0))

    def rotate(
        self, y: float, t: np.ndarray, moving: np.ndarray, circling: np.ndarray, distance: np.ndarray
    ) -> Rotation:
        """R_FH of the side y, its hand at that distance (n,); both parts in the clasp, the wandering in the circles."""
        side = 0 if y > 0.0 else 1
        follows, wanders = self._parts(t, distance[:, None], slice(side, side + 1))
        angles = moving[:, None, None] * (follows + wanders) + circling[:, None, None] * wanders
        flexion, deviation = (self.rms * self.gain[side] * angles[:, 0]).T
        return turn_about("YX", np.column_stack((-flexion, y * deviation)))
