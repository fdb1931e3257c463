"""The whole figure of a person for programs that want one: what no sensor measures stands.

Frames of segments equal W in the T-pose (arms sideways, palms down), as MVN and avatars have them; ours do in the
N-pose. A leg without sensors stands, as `writers.standing` has it, on a pelvis that keeps its place and its heading;
where both feet are measured the lower one is on the floor. What lies between measured segments is interpolated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..writers.standing import (
    COLLAR_SHARE,
    FOREARM_M,
    HEAD_M,
    HIP_Z,
    LEG,
    NECK_M,
    SHOULDER_Y,
    SPINE,
    TOE_TIP,
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
_ARM, _LEG = ("upper_arm", "forearm", "hand"), ("upper_leg", "lower_leg", "foot")
_LEG_SEGMENTS = dict(zip(_LEG, ("thigh", "shank", "foot"), strict=True))
_OURS = {f"{side}_{part}": f"{side}_{own}" for side in _SIDES for part, own in _LEG_SEGMENTS.items()}
# Segment of the figure that a sensor may measure → ours.
MEASURED = {
    name: _OURS.get(name, name)
    for name in SEGMENTS
    if name in ("pelvis", "torso", "head") or name.endswith((*_ARM, *_LEG))
}
_QUARTER = {"left": [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], "right": [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]}
# R_BL (23, 4) xyzw, our frame in the figure's: from the N-pose to the T-pose an arm turns by a quarter about x.
N_TO_T = np.array(
    [_QUARTER[name.partition("_")[0]] if name.endswith(_ARM) else [0.0, 0.0, 0.0, 1.0] for name in SEGMENTS]
)
_T_TO_N = rotations.conjugate(N_TO_T)
_SOLES = tuple(f"{side}_{point}" for side in _SIDES for point in ("heel", "toe"))
# Of a part between two others its share of the turn from one to the other: of the spine, and the neck.
_TURN_SHARES = np.array([[share] for _, share in SPINE.values() if share < 1.0] + [[0.5]])


class Figure(NamedTuple):
    """The 23 segments of a whole figure, in the order of `SEGMENTS`."""

    position: np.ndarray  # (23, 3) [m] in W, from the floor below the pelvis, of the joint nearer to the pelvis
    quat_WB: np.ndarray  # (23, 4) xyzw; B equals W in the T-pose


class _Completed(NamedTuple):
    info: StreamInfo
    pose: LivePose
    figure: Figure


_newest: _Completed | None = None  # two outputs at the same rate ask for the figure of the same pose


def complete_figure(info: StreamInfo, pose: LivePose) -> Figure:
    """Return the whole figure of a pose; that of the newest pose is made once for all outputs."""
    global _newest
    if _newest is None or _newest.pose is not pose or _newest.info is not info:
        _newest = _Completed(info, pose, _complete_figure(info, pose))
    return _newest.figure


def _complete_figure(info: StreamInfo, pose: LivePose) -> Figure:
    quat_WL = _orient_segments(dict(zip(info.segments, pose.quat_WL, strict=True)))
    R_WL = dict(zip(SEGMENTS, Rotation.from_quat(quat_WL).as_matrix(), strict=True))
    known = np.isfinite(pose.points).all(axis=1)
    points = {name: pose.points[k] for k, name in enumerate(info.points) if known[k]}
    soles = [points[name][2] for name in _SOLES if name in points]
    root = np.array([0.0, 0.0, -min(soles) if len(soles) == len(_SOLES) else HIP_Z])
    shoulders = {
        side: points.get(f"{side}_shoulder", R_WL["torso"] @ [0.0, sign * SHOULDER_Y, TRUNK_M])
        for side, sign in _SIDES.items()
    }
    neck, up = 0.5 * (shoulders["left"] + shoulders["right"]), R_WL["torso"][:, 2]
    position = {"pelvis": np.zeros(3), "neck": neck + NECK_M * up, "head": neck + HEAD_M * up}
    position |= {name: share * neck for name, (share, _) in SPINE.items()}
    for side, sign in _SIDES.items():
        position[f"{side}_shoulder"] = neck + COLLAR_SHARE * (shoulders[side] - neck)
        joint = shoulders[side]
        for part, end, length in zip(_ARM, ("elbow", "wrist", ""), (UPPER_ARM_M, FOREARM_M, 0.0), strict=True):
            position[f"{side}_{part}"] = joint
            joint = points.get(f"{side}_{end}", joint - length * R_WL[f"{side}_{part}"][:, 2])
        above, begin = "pelvis", np.array([0.0, 0.0, HIP_Z])
        for part, point in (*zip(_LEG, ("hip", "knee", "ankle"), strict=True), ("toe", "")):
            name, place = f"{side}_{part}", np.array(LEG[part]) * [1.0, sign, 1.0]
            position[name] = points.get(f"{side}_{point}", position[above] + R_WL[above] @ (place - begin))
            above, begin = name, place
        if f"{side}_toe" in points:
            position[f"{side}_toe"] = points[f"{side}_toe"] - R_WL[f"{side}_toe"] @ TOE_TIP
    return Figure(root + np.array([position[name] for name in SEGMENTS]), rotations.multiply(quat_WL, _T_TO_N))


def _orient_segments(measured: dict[str, np.ndarray]) -> np.ndarray:
    """Orient the segments (23, 4) xyzw; one without a sensor goes on as the one above it, a whole arm or leg hangs."""
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    pelvis = measured.get("pelvis", upright)
    if not any(name in measured for name in _OURS.values()):
        pelvis = rotations.exp([0.0, 0.0, float(rotations.heading(pelvis))])
    torso = measured.get("torso", pelvis)
    head = measured.get("head", torso)
    below, above = np.array([pelvis, pelvis, pelvis, torso]), np.array([torso, torso, torso, head])
    turns = rotations.log(rotations.multiply(rotations.conjugate(below), above))
    l5, l3, t12, neck = rotations.multiply(below, rotations.exp(_TURN_SHARES * turns))
    quat = {"pelvis": pelvis, "l5": l5, "l3": l3, "t12": t12, "torso": torso, "neck": neck, "head": head}
    for side in _SIDES:
        quat[f"{side}_shoulder"] = torso
        for first, limb in ((upright, _ARM), (pelvis, (*_LEG, "toe"))):
            for part in limb:
                name = f"{side}_{part}"
                first = quat[name] = measured.get(_OURS.get(name, name), first)
    return np.array([quat[name] for name in SEGMENTS])
