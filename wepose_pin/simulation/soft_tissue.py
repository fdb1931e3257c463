"""Soft-tissue artefact: how a sensor turns on its segment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..rotations import compose, log
from .imperfections import Imperfections
from .imu import GRAVITY
from .motion import E_Z, BodyPose
from .people import SIDES, Offset
from .signals import Process, RandomWalk, integrate_step

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
# rms across and about the segment's long axis [deg], correlation time [s]; assumptions, held to Lebel 2017.
RANDOM_DEG = {
    "torso": (1.5, 1.5, 3.0),
    "upper_arm": (2.0, 2.5, 2.0),
    "forearm": (2.0, 2.0, 2.0),
    "hand": (1.5, 1.5, 1.0),
    "pelvis": (2.0, 1.5, 3.0),
    "head": (1.0, 1.0, 5.0),
}
_ONSET = np.deg2rad((20.0, 20.0))  # elevation is read too small from 30 deg on: this far below, and so softly
_ROUND = np.deg2rad(3.0)  # an angle from hanging has a kink there: rounded off
_BREATH_DEG, _BREATH_HZ = 0.7, (0.22, 0.28)
_CREEP_DEG, _CREEP_S = 1.0, 600.0
_WOBBLE_DEG = 0.5  # per g


class _ArmRotations(NamedTuple):
    """What the joints of an arm do at n times [rad]."""

    elevation: np.ndarray  # (n,) of the upper arm in T
    swing: np.ndarray  # (n, 3) rotation vector of the elevation, in the upper arm
    twist: np.ndarray  # (n,) of the upper arm against the torso, about its long axis
    flexion: np.ndarray  # (n,) of the elbow
    pronation: np.ndarray  # (n,) of the forearm against the upper arm, about its long axis


def _split(R: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Split R into swing @ twist about z: the swing's rotation vector (n, 3) after the twist, the twist (n,) [rad]."""
    z, w = R.as_quat()[:, 2:].T
    twist = 2.0 * np.arctan2(np.where(w < 0.0, -z, z), np.abs(w))
    about_z = Rotation.from_rotvec(twist[:, None] * E_Z)
    return about_z.inv().apply(log(compose(R, about_z.inv()).as_quat())), twist


def _read_arm(pose: BodyPose, side: str) -> _ArmRotations:
    R_WU = pose.R_WL[f"{side}_upper_arm"]
    swing, twist = _split(compose(pose.R_WL["torso"].inv(), R_WU))
    bend, pronation = _split(compose(R_WU.inv(), pose.R_WL[f"{side}_forearm"]))
    elevation, flexion = (np.hypot(np.linalg.norm(v, axis=1), _ROUND) - _ROUND for v in (swing, bend))
    return _ArmRotations(elevation, swing, twist, flexion, pronation)


class SoftTissue:
    """The rotation of one sensor on its segment: by the joints, at random, by breath, creep and acceleration."""

    def __init__(
        self,
        segment: str,
        place: float,
        sizes: Imperfections,
        rngs: Mapping[str, np.random.Generator],
        duration: float,
        start: BodyPose,
    ) -> None:
        """`place`: of the sensor, as a share of the segment's length; `start`: trunk and arms in the start pose."""
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

    def follow(self, pose: BodyPose) -> np.ndarray:
        """Rotation vectors (n, 3) [rad] in L by the joints' rotation since the start pose, at the size of people."""
        turn = np.zeros((len(pose.R_WL["torso"]), 3))
        if self.part in ("torso", "pelvis"):
            flexion, first = (_split(each.R_WL["torso"])[0][:, 1] for each in (pose, self.start))
            turn[:, 1] = self._gain(f"{self.part}_flexion", 0) * (flexion - first)
        if self.part == "torso":
            left, right = (_read_arm(pose, side).elevation - _read_arm(self.start, side).elevation for side in SIDES)
            turn[:, 1] += self._gain("torso_elevation", 1) * 0.5 * (left + right)
            turn[:, 0] = self._gain("torso_sides", 2) * (right - left)
            turn[:, 2] = self._gain("torso_sides", 3) * (right - left)
        elif self.part in ("upper_arm", "forearm"):
            arm, first_arm = _read_arm(pose, self.side), _read_arm(self.start, self.side)
            bend = arm.flexion - first_arm.flexion
            twist = arm.twist - first_arm.twist if self.part == "upper_arm" else arm.pronation - first_arm.pronation
            turn[:, 2] = -(self.lost + self.draw[0] * _TWIST_STD) * twist
            if self.part == "upper_arm":
                # The angle above 30 deg, about the axis of elevation; none below 20 deg, where it has no meaning.
                angle = np.linalg.norm(arm.swing, axis=1)
                above = integrate_step(angle, *_ONSET) / np.maximum(angle, _ONSET[0])
                turn += self._gain("upper_arm_elevation", 1) * above[:, None] * arm.swing
                turn += self._gain("upper_arm_flexion", 2, self.sign[0]) * bend[:, None] * self.across
                turn[:, 2] += self._gain("upper_arm_flexion", 3, self.sign[1]) * bend
            else:
                turn += self._gain("forearm_flexion", 1, self.sign[0]) * bend[:, None] * self.across
        return turn

    def __call__(self, t: np.ndarray, moving_time: np.ndarray, pose: BodyPose, accel_L: np.ndarray) -> np.ndarray:
        """Return rotation vectors (n, 3) [rad] in L at the times `t` (n,) [s].

        The random part stands where the segment does: `moving_time` (n,) [s] is how long it has moved. `pose` at `t` is
        of the torso and what carries the sensor, of the torso's sensor of both arms. Limbs move below 5 Hz: the
        low-pass of a strap at 15 Hz, which the literature gives, would change nothing of `accel_L` (n, 3) [m/s^2].
        """
        sizes, turn = self.sizes, np.zeros((len(t), 3))
        if sizes.tissue_random:
            across = np.cross(E_Z, accel_L)  # the free side of the strap lags
            turn = self.random_rms * self.random(moving_time) + self.creep_rms * self.creep(t)
            turn = sizes.tissue_random * (turn - np.deg2rad(_WOBBLE_DEG) / GRAVITY * across)
        if sizes.tissue_gain:
            turn = turn + sizes.tissue_gain * self.follow(pose)
        if sizes.sway and self.part == "torso":
            rate, phase = self.breath
            turn[:, 1] += sizes.sway * np.sqrt(2.0) * np.deg2rad(_BREATH_DEG) * np.sin(rate * t + phase)
        return turn
