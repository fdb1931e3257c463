"""Biovision hierarchy (.bvh) as the loaders of GMR (General Motion Retargeting) ask for it: a whole person who stands.

Each loader looks bones up by their names and takes their orientations for those of one rig: where the axes of a bone
point in the N-pose is stated here for each (`RIGS`). Legs that are not both known stand, and so does the pelvis but for
its heading; legs that are have the lower foot on the floor at all times. The spine is rigid with the torso.

Source: GMR, github.com/YanjieZe/GMR, utils/lafan1.py, soma.py and xsens.py, which read the files; the axes follow from
the rotations from bones to links of the G1 in its ik_configs bvh_lafan1_to_g1, bvh_nokov_to_g1, bvh_soma_to_g1 and
xsens_bvh_to_g1. MVN User Manual (MV0319P): the exporter for 3ds Max ("3DSM") writes a neutral pose, arms parallel to
the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..diagnostics import Diagnostic
from ..errors import BadData
from ..rotations import conjugate, heading, multiply, xyzw_from_wxyz
from .bvh import find_places, save_bvh
from .motion import Motion, check_complete, diagnose_gaps, resample_evenly
from .standing import COLLAR_SHARE, FOREARM_M, HEAD_M, HIP_Z, LEG, NECK_M, SHOULDER_Y, SPINE, TRUNK_M, UPPER_ARM_M

SIDES = {"left": 1.0, "right": -1.0}
# Ends of bones [m] in the N-pose: top of the head, tip of the toes, of the fingers.
ENDS = {"head": (0.0, 0.0, 0.13), "toe": (0.06, 0.0, 0.0), "hand": (0.0, 0.0, -0.18)}


class Rig(NamedTuple):
    """What a loader asks for.

    Parameters
    ----------
    names : part of a person → bone, ``{}`` for the side; ``root``, where there is one, is above the hips
    spine : bones from the hips to the torso; the last one has the torso's orientation
    axes : part, with its side where the sides differ → where the bone's x, y, z point in the N-pose, or its wxyz there
    default : axes of all other parts
    R_FW : (3, 3), maps W to the file's axes
    unit : of the file, in a metre
    order : of the channels of rotation
    """

    names: Mapping[str, str]
    spine: tuple[str, ...]
    axes: Mapping[str, tuple[str, ...] | tuple[float, ...]]
    default: tuple[str, str, str]
    R_FW: np.ndarray
    unit: float
    order: str


class Joint(NamedTuple):
    """A bone: its part and side as ``left_hand``, the bone above, R_LB, and where it is in the N-pose (3,) [m]."""

    name: str
    part: str
    above: int
    R_LB: np.ndarray
    at: np.ndarray


_LAFAN1 = {
    **{"hips": "Hips", "neck": "Neck", "head": "Head", "collar": "{}Shoulder"},
    **{"upper_arm": "{}Arm", "forearm": "{}ForeArm", "hand": "{}Hand"},
    **{"upper_leg": "{}UpLeg", "lower_leg": "{}Leg", "foot": "{}Foot", "toe": "{}Toe"},
}
_XSENS = {
    **{"hips": "Hips", "neck": "Neck", "head": "Head", "collar": "{}Collar"},
    **{"upper_arm": "{}Shoulder", "forearm": "{}Elbow", "hand": "{}Wrist"},
    **{"upper_leg": "{}Hip", "lower_leg": "{}Knee", "foot": "{}Ankle", "toe": "{}Toe"},
}
_SOMA = {
    **{"root": "Root", "hips": "Hips", "neck": "Neck", "head": "Head", "collar": "{}Shoulder"},
    **{"upper_arm": "{}Arm", "forearm": "{}ForeArm", "hand": "{}Hand"},
    **{"upper_leg": "{}Leg", "lower_leg": "{}Shin", "foot": "{}Foot", "toe": "{}ToeBase"},
}
_ARM, _LEG, _FOOT = ("upper_arm", "forearm", "hand"), ("upper_leg", "lower_leg"), ("foot", "toe")
_LEG_SEGMENTS = {"upper_leg": "thigh", "lower_leg": "shank", "foot": "foot", "toe": "foot"}
_SOLES = tuple(f"{side}_{point}" for side in SIDES for point in ("heel", "toe"))
_SPINE = ("Spine", "Spine1", "Spine2")
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the loader turns it back
_Z_FORWARD = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
RIGS = {
    "lafan1": Rig(
        _LAFAN1,
        _SPINE,
        {
            **dict.fromkeys(_ARM, ("-z", "-x", "+y")),
            **dict.fromkeys(_LEG, ("-z", "+x", "-y")),
            **dict.fromkeys(_FOOT, ("+x", "+z", "-y")),
            "left_collar": ("+y", "-x", "+z"),
            "right_collar": ("-y", "+x", "+z"),
        },
        ("+z", "+x", "+y"),
        _Y_UP,
        100.0,
        "ZYX",
    ),
    "nokov": Rig(
        _LAFAN1 | {"toe": "{}ToeBase"},
        _SPINE,
        {f"left_{part}": ("-z", "+y", "+x") for part in _ARM} | {f"right_{part}": ("+z", "-y", "+x") for part in _ARM},
        ("+y", "+z", "+x"),
        _Y_UP,
        100.0,
        "ZYX",
    ),
    # Its arms and feet are not along an axis; the numbers follow from GMR's configuration.
    "soma": Rig(
        _SOMA,
        ("Spine1", "Spine2", "Chest"),
        {
            **{f"left_{part}": ("-z", "-x", "+y") for part in _LEG},
            **{f"right_{part}": ("+z", "+x", "+y") for part in _LEG},
            **{f"left_{part}": (0.69535, -0.69535, 0.1284072, 0.1284072) for part in _FOOT},
            **{f"right_{part}": (-0.1284072, 0.1284072, 0.69535, 0.69535) for part in _FOOT},
            "hips": (-0.4991683, 0.4991683, 0.5008303, 0.5008303),
            "torso": (-0.4991149, 0.4991149, 0.5008836, 0.5008836),
            "left_upper_arm": (0.4519943, 0.5658562, 0.5130639, -0.4607313),
            "left_forearm": (0.4686334, 0.5238728, 0.4435667, -0.5560472),
            "left_hand": (0.5084625, 0.476318, 0.4708575, -0.5411841),
            "right_upper_arm": (-0.5130635, -0.4607314, 0.4519941, -0.5658567),
            "right_forearm": (-0.4435663, -0.5560475, 0.4686337, -0.5238727),
            "right_hand": (-0.4708574, -0.5411846, 0.5084624, -0.4763176),
        },
        ("+z", "+x", "+y"),
        _Z_FORWARD,
        100.0,
        "ZYX",
    ),
    "xsens": Rig(_XSENS, ("Chest", "Chest2", "Chest3", "Chest4"), {}, ("+y", "+z", "+x"), _Z_FORWARD, 1.0, "YXZ"),
}


def write_gmr(path: Path, motion: Motion, rig: Rig) -> list[Diagnostic]:
    """Write hierarchy and motion for one of GMR's loaders.

    Raises
    ------
    BadData
        The motion is of no person, the torso is not known, or a sample has no orientation.
    """
    check_complete(motion, "a .bvh")
    if motion.model.table.is_mechanism or "torso" not in motion.pose.quat_WL:
        raise BadData(f"{motion.where}: no orientation of the torso of a person; GMR retargets the motion of a person")
    motion, diagnostics = resample_evenly(motion)
    joints = _build_joints(motion, rig)
    quat_WL = _orient_parts(motion)
    root = rig.unit * _place_root(motion) @ rig.R_FW.T
    save_bvh(path, _format_hierarchy(joints, rig), [root, *_turn_joints(joints, quat_WL, rig)], motion.rate_hz)
    return [*diagnostics, *diagnose_gaps(motion)]


def _build_joints(motion: Motion, rig: Rig) -> list[Joint]:
    """The bones, each after the one above it."""
    places = _place_parts(motion)
    joints: list[Joint] = []

    def add(part: str, above: int, name: str = "", at: np.ndarray | None = None) -> int:
        side, _, own = part.partition("_")
        if side not in SIDES:
            side, own = "", part
        axes = rig.axes.get(part) or rig.axes.get(own) or rig.default
        R_LB = _read_axes(axes)
        name = name or rig.names[own].format(side.capitalize())
        joints.append(Joint(name, part, above, R_LB, places[part] if at is None else at))
        return len(joints) - 1

    hips = add("hips", -1, rig.names["root"]) if "root" in rig.names else -1
    hips = add("hips", hips)
    for side in SIDES:
        above = hips
        for part in (*_LEG, *_FOOT):
            above = add(f"{side}_{part}", above)
    neck = places["mid_shoulders"] - places["hips"]
    above = hips
    shares = [0.0, *(share for share, _ in SPINE.values())][-len(rig.spine) + 1 :]
    for name, share in zip(rig.spine, (0.0, *shares), strict=True):
        above = add("torso", above, name, places["hips"] + share * neck)
    torso = above
    add("head", add("neck", torso))
    for side in SIDES:
        above = torso
        for part in ("collar", *_ARM):
            above = add(f"{side}_{part}", above)
    return joints


def _place_parts(motion: Motion) -> dict[str, np.ndarray]:
    """Part → where it begins (3,) [m] in the N-pose, from the floor below the hips; the subject's lengths."""
    _, points = find_places(motion)
    legs = _knows_legs(motion)
    hips = np.array([0.0, 0.0, -points["left_toe"][2] if legs else HIP_Z])
    places = {"hips": hips}
    for side, sign in SIDES.items():
        at = hips + points.get(f"{side}_shoulder", np.array([0.0, sign * SHOULDER_Y, TRUNK_M]))
        for part, end, length in (
            ("upper_arm", "elbow", UPPER_ARM_M),
            ("forearm", "wrist", FOREARM_M),
            ("hand", "", 0),
        ):
            places[f"{side}_{part}"] = at
            known = points.get(f"{side}_{end}")
            at = hips + known if known is not None else at - [0.0, 0.0, length]
        for part, (x, y, z) in LEG.items():
            places[f"{side}_{part}"] = np.array([x, sign * y, z])
        if legs:
            for part, point in (("upper_leg", "hip"), ("lower_leg", "knee"), ("foot", "ankle")):
                places[f"{side}_{part}"] = hips + points[f"{side}_{point}"]
            tip = hips + points[f"{side}_toe"]
            places[f"{side}_toe"] = tip - [ENDS["toe"][0], 0.0, -LEG["toe"][2]]
    middle = 0.5 * (places["left_upper_arm"] + places["right_upper_arm"])
    places |= {"mid_shoulders": middle, "neck": middle + [0.0, 0.0, NECK_M], "head": middle + [0.0, 0.0, HEAD_M]}
    for side in SIDES:
        places[f"{side}_collar"] = middle + COLLAR_SHARE * (places[f"{side}_upper_arm"] - middle)
    return places


def _knows_legs(motion: Motion) -> bool:
    """Whether both feet are known."""
    return all(point in motion.pose.points for point in _SOLES)


def _place_root(motion: Motion) -> np.ndarray:
    """Where the hips are (n, 3) [m]: so high that the lower foot, or its lower end, is on the floor."""
    n, height = len(motion.pose.time), HIP_Z
    if not _knows_legs(motion):
        return np.tile([0.0, 0.0, height], (n, 1))
    _, standing = find_places(motion)
    sole = standing["left_toe"][2]
    lowest = np.min([motion.pose.points[point][:, 2] - (standing[point][2] - sole) for point in _SOLES], axis=0)
    return np.column_stack([np.zeros((n, 2)), -lowest])


def _orient_parts(motion: Motion) -> dict[str, np.ndarray]:
    """Part → (n, 4) xyzw in W; what is not measured goes on as what is above it, legs and a whole arm hang."""
    measured, n = motion.pose.quat_WL, len(motion.pose.time)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    hips = upright
    if "pelvis" in measured and _knows_legs(motion):
        hips = measured["pelvis"]
    elif "pelvis" in measured:
        hips = Rotation.from_rotvec(heading(measured["pelvis"])[:, None] * [0.0, 0.0, 1.0]).as_quat()
    torso = measured["torso"]
    head = measured.get("head", torso)
    half = Rotation.from_rotvec(0.5 * (Rotation.from_quat(torso).inv() * Rotation.from_quat(head)).as_rotvec())
    quat = {"hips": hips, "torso": torso, "head": head, "neck": (Rotation.from_quat(torso) * half).as_quat()}
    for side in SIDES:
        above = upright
        for part in _ARM:
            above = quat[f"{side}_{part}"] = measured.get(f"{side}_{part}", above)
        quat[f"{side}_collar"] = torso
        above = hips
        for part in (*_LEG, *_FOOT):
            above = quat[f"{side}_{part}"] = measured.get(f"{side}_{_LEG_SEGMENTS[part]}", above)
    return quat


def _turn_joints(joints: list[Joint], quat_WL: Mapping[str, np.ndarray], rig: Rig) -> Iterator[np.ndarray]:
    """Angles (n, 3) [deg] of each bone in the order of the channels, followed over time."""
    frames = []
    for joint in joints:
        frames.append(multiply(quat_WL[joint.part], Rotation.from_matrix(joint.R_LB).as_quat()[None]))
        above = Rotation.from_matrix(rig.R_FW.T).as_quat()[None] if joint.above < 0 else frames[joint.above]
        local = multiply(conjugate(above), frames[-1])
        yield np.degrees(euler.follow(euler.decompose(local, rig.order), rig.order, NEAR_LOCK))


def _format_hierarchy(joints: list[Joint], rig: Rig) -> Iterator[str]:
    """The lines of the skeleton."""
    channels = " ".join(f"{axis}rotation" for axis in rig.order)

    def offset(v_B: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{rig.unit * value + 0.0:.6f}" for value in v_B)

    def grow(k: int, depth: int) -> Iterator[str]:
        joint, tabs = joints[k], "\t" * depth
        way = np.zeros(3) if joint.above < 0 else joints[joint.above].R_LB.T @ (joint.at - joints[joint.above].at)
        yield from (f"{tabs}{'JOINT' if depth else 'ROOT'} {joint.name}", f"{tabs}{{", f"{tabs}\t{offset(way)}")
        yield f"{tabs}\tCHANNELS " + (f"3 {channels}" if depth else f"6 Xposition Yposition Zposition {channels}")
        below = [i for i, each in enumerate(joints) if each.above == k]
        for i in below:
            yield from grow(i, depth + 1)
        if not below:
            end = joint.R_LB.T @ np.array(ENDS[joint.part.rpartition("_")[2]])
            yield from (f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\t{offset(end)}", f"{tabs}\t}}")
        yield f"{tabs}}}"

    yield from grow(0, 0)


def _read_axes(axes: tuple[str, ...] | tuple[float, ...]) -> np.ndarray:
    """R_LB (3, 3) of three axes such as ``-z``, or of a rotation wxyz."""
    columns = [float(f"{axis[0]}1") * np.eye(3)["xyz".index(axis[1])] for axis in axes if isinstance(axis, str)]
    if columns:
        return np.stack(columns, axis=1)
    return np.asarray(Rotation.from_quat(xyzw_from_wxyz(axes)).as_matrix())
