"""The whole figure of a person for programs that want one: what no sensor measures stands.

Frames of segments equal W in the T-pose (arms sideways, palms down), as MVN and avatars have them; ours do in the
N-pose. Legs stand, as long as `writers.standing` has them; the pelvis keeps its place and its heading. What lies
between measured segments is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..rotations import heading
from ..writers.standing import (
    COLLAR_SHARE,
    FOREARM_M,
    HEAD_M,
    HIP_Z,
    LEG,
    NECK_M,
    SHOULDER_Y,
    SPINE,
    TRUNK_M,
    UPPER_ARM_M,
)
from .state import LivePose, StreamInfo

# Segments in the order of MVN.
SEGMENTS = (
    *("pelvis", "l5", "l3", "t12", "torso", "neck", "head"),
    *("right_shoulder", "right_upper_arm", "right_forearm", "right_hand"),
    *("left_shoulder", "left_upper_arm", "left_forearm", "left_hand"),
    *("right_upper_leg", "right_lower_leg", "right_foot", "right_toe"),
    *("left_upper_leg", "left_lower_leg", "left_foot", "left_toe"),
)
_SIDES = {"left": 1.0, "right": -1.0}
_QUARTER = {side: Rotation.from_rotvec([sign * 0.5 * np.pi, 0.0, 0.0]) for side, sign in _SIDES.items()}


class Figure(NamedTuple):
    """The 23 segments of a whole figure, in the order of `SEGMENTS`."""

    position: np.ndarray  # (23, 3) [m] in W, from the floor below the pelvis, of the joint nearer to the pelvis
    quat_WB: np.ndarray  # (23, 4) xyzw; B equals W in the T-pose


def complete_figure(info: StreamInfo, pose: LivePose) -> Figure:
    """Return the whole figure of a pose."""
    R_WL = {name: Rotation.from_quat(quat) for name, quat in zip(info.segments, pose.quat_WL, strict=True)}
    points = {name: point for name, point in zip(info.points, pose.points, strict=True) if np.isfinite(point).all()}
    root = np.array([0.0, 0.0, HIP_Z])
    upright = Rotation.identity()
    R_pelvis = upright
    if "pelvis" in R_WL:
        R_pelvis = Rotation.from_rotvec([0.0, 0.0, float(heading(R_WL["pelvis"].as_quat()))])
    R_torso = R_WL.get("torso", R_pelvis)
    shoulders = _place_shoulders(points, R_torso)
    neck = 0.5 * (shoulders["left"] + shoulders["right"])
    between = (R_pelvis.inv() * R_torso).as_rotvec()
    R_head = R_WL.get("head", R_torso)
    position = {"pelvis": root, "neck": root + neck, "head": root + neck + R_torso.apply([0.0, 0.0, HEAD_M])}
    turn = {"pelvis": R_pelvis, "neck": R_torso * Rotation.from_rotvec(0.5 * (R_torso.inv() * R_head).as_rotvec())}
    turn["head"] = R_head
    position["neck"] = position["neck"] + R_torso.apply([0.0, 0.0, NECK_M])
    for name, (share, turned) in SPINE.items():
        position[name], turn[name] = root + share * neck, R_pelvis * Rotation.from_rotvec(turned * between)
    for side, sign in _SIDES.items():
        position[f"{side}_shoulder"] = root + neck + COLLAR_SHARE * (shoulders[side] - neck)
        turn[f"{side}_shoulder"] = R_torso
        _place_arm(side, shoulders[side], points, R_WL, position, turn)
        for part in ("upper_arm", "forearm", "hand"):
            position[f"{side}_{part}"] = position[f"{side}_{part}"] + root
            turn[f"{side}_{part}"] = turn[f"{side}_{part}"] * _QUARTER[side].inv()
        for part, (x, y, z) in LEG.items():
            position[f"{side}_{part}"] = R_pelvis.apply([x, sign * y, z])
            turn[f"{side}_{part}"] = R_pelvis
    return Figure(
        np.array([position[name] for name in SEGMENTS]), np.array([turn[name].as_quat() for name in SEGMENTS])
    )


def _place_shoulders(points: Mapping[str, np.ndarray], R_torso: Rotation) -> dict[str, np.ndarray]:
    """Place each shoulder (3,) [m] from the middle of the hips: as measured, or by the torso."""
    return {
        side: points.get(f"{side}_shoulder", R_torso.apply([0.0, sign * SHOULDER_Y, TRUNK_M]))
        for side, sign in _SIDES.items()
    }


def _place_arm(
    side: str,
    shoulder: np.ndarray,
    points: Mapping[str, np.ndarray],
    R_WL: Mapping[str, Rotation],
    position: dict[str, np.ndarray],
    turn: dict[str, Rotation],
) -> None:
    """Place an arm; a segment without a sensor goes on as the one above it, a whole arm hangs."""
    R_above, joint = Rotation.identity(), shoulder
    parts = (("upper_arm", "elbow", UPPER_ARM_M), ("forearm", "wrist", FOREARM_M), ("hand", "", 0.0))
    for part, end, length in parts:
        name = f"{side}_{part}"
        R_above = R_WL.get(name, R_above)
        position[name], turn[name] = joint, R_above
        joint = points.get(f"{side}_{end}", joint + R_above.apply([0.0, 0.0, -length]))
