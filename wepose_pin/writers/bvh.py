"""Biovision hierarchy (.bvh), without a library: the format is a page of text.

The skeleton with the subject's lengths, and its motion.

y is up, the person faces z with x on the left; centimetres and degrees. At zero the skeleton stands in the N-pose.

Source: M. Meredith, S. Maddock 2001, "Motion Capture File Formats Explained", University of Sheffield CS-01-11, 3.3: a
joint turns by its channels in their order, each about an axis as turned so far.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..diagnostics import Diagnostic
from ..errors import BadData
from ..kinematics import compute_link_poses, compute_pose, solve_configuration
from ..rotations import conjugate, multiply
from .motion import Motion, check_complete, diagnose_gaps, resample_evenly

_ROTATIONS = "Zrotation Xrotation Yrotation"
_NAMES = {"upper_arm": "Arm", "forearm": "ForeArm", "hand": "Hand"}
_POINT_ABOVE = {"upper_arm": "shoulder", "forearm": "elbow", "hand": "wrist"}


class Bone(NamedTuple):
    """A joint and what hangs on it."""

    name: str
    segment: str  # whose orientation it has
    at: np.ndarray  # (3,) [m] in W, in the N-pose
    children: list[Bone]
    end: np.ndarray  # (3,) [m] in W, in the N-pose: where it ends, if it has no children


def skeleton(motion: Motion) -> Bone:
    """The bones that are known: Hips, Spine, Head, and of each arm as much as has sensors.

    Raises
    ------
    BadData
        The torso is not known, to which the rest is tied.
    """
    pose, model = motion.pose, motion.model
    measured = set(pose.quat_WL)
    if "torso" not in measured:
        raise BadData(f"{motion.where}: no orientation of the torso in pose.parquet; a .bvh ties the arms to it")
    upright = {segment: np.array([[0.0, 0.0, 0.0, 1.0]]) for segment in measured}
    points = {name: p[0] for name, p in compute_pose(model, np.zeros(1), upright).points.items()}
    middle = 0.5 * (points["left_shoulder"] + points["right_shoulder"])
    children = [bone for side in ("left", "right") if (bone := _arm(side, "upper_arm", measured, points)) is not None]
    if "head" in measured:
        _, p_W = compute_link_poses(model, solve_configuration(model, upright), ["head"], rotations=False)
        children.append(Bone("Head", "head", p_W[0, 0], [], p_W[0, 0] + [0.0, 0.0, 0.2]))
    spine = Bone("Spine", "torso", np.zeros(3), children, middle)
    return Bone("Hips", "pelvis" if "pelvis" in measured else "torso", np.zeros(3), [spine], middle)


def _arm(side: str, part: str, measured: set[str], points: dict[str, np.ndarray]) -> Bone | None:
    """An arm from this part down; None where its orientation is not known. A hand may be rigid with its forearm."""
    segment = f"{side}_{part}"
    if part == "hand" and segment not in measured:
        segment = f"{side}_forearm"
    if segment not in measured:
        return None
    at = points[f"{side}_{_POINT_ABOVE[part]}"]
    if part == "hand":
        return Bone(f"{side.capitalize()}Hand", segment, at, [], points[f"{side}_palm"])
    below = "forearm" if part == "upper_arm" else "hand"
    child = _arm(side, below, measured, points)
    lower = points.get(f"{side}_{_POINT_ABOVE[below]}", at + [0.0, 0.0, -0.3])
    return Bone(f"{side.capitalize()}{_NAMES[part]}", segment, at, [child] if child else [], lower)


def _to_file_axes(v_W: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) of W in the file's axes: x left, y up, z forward."""
    return v_W[..., [1, 2, 0]]


def write_bvh(path: Path, motion: Motion) -> list[Diagnostic]:
    """Hierarchy and motion; angles are followed over time, so they may go beyond 180°.

    Raises
    ------
    BadData
        The torso is not known, or a sample has no orientation.
    """
    check_complete(motion, "a .bvh")
    motion, diagnostics = resample_evenly(motion)
    root = skeleton(motion)
    columns = [100.0 * _to_file_axes(_root_position(motion, root)), *_rotations(motion, root, None)]
    lines = ["HIERARCHY", *_hierarchy(root, root.at, 0), "MOTION"]
    lines += [f"Frames: {len(motion.pose.time)}", f"Frame Time: {1.0 / motion.rate_hz:.8f}"]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, np.column_stack(columns), fmt="%.6f")
    return [*diagnostics, *diagnose_gaps(motion)]


def _root_position(motion: Motion, root: Bone) -> np.ndarray:
    """Where the hips are (n, 3) [m], so that the shoulders are where they were found; a spine of many joints bends."""
    pose = motion.pose
    for point in ("left_shoulder", "right_shoulder"):
        if point not in pose.points:
            raise BadData(f"{motion.where}: no columns {point}_x … in pose.parquet; a .bvh needs both shoulders")
    middle = 0.5 * (pose.points["left_shoulder"] + pose.points["right_shoulder"])
    return middle - Rotation.from_quat(pose.quat_WL["torso"]).apply(root.end)


def _rotations(motion: Motion, bone: Bone, above: np.ndarray | None) -> Iterator[np.ndarray]:
    """Angles (n, 3) [deg] about z, x, y of each bone, in the order of the hierarchy."""
    quat_WL = motion.pose.quat_WL[bone.segment]
    quat = quat_WL if above is None else multiply(conjugate(above), quat_WL)
    turned = np.column_stack([_to_file_axes(quat[:, :3]), quat[:, 3]])
    yield np.degrees(euler.follow(euler.decompose(turned, "ZXY"), "ZXY", NEAR_LOCK))
    for child in bone.children:
        yield from _rotations(motion, child, quat_WL)


def _hierarchy(bone: Bone, above: np.ndarray, depth: int) -> Iterator[str]:
    """The lines of a bone and all below it."""
    tabs = "\t" * depth
    yield f"{tabs}{'JOINT' if depth else 'ROOT'} {bone.name}"
    yield f"{tabs}{{"
    yield f"{tabs}\t{_offset(bone.at - above)}"
    yield f"{tabs}\tCHANNELS " + (f"3 {_ROTATIONS}" if depth else f"6 Xposition Yposition Zposition {_ROTATIONS}")
    for child in bone.children:
        yield from _hierarchy(child, bone.at, depth + 1)
    if not bone.children:
        yield from (f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\t{_offset(bone.end - bone.at)}", f"{tabs}\t}}")
    yield f"{tabs}}}"


def _offset(v_W: np.ndarray) -> str:
    return "OFFSET " + " ".join(f"{100.0 * value + 0.0:.6f}" for value in _to_file_axes(v_W))
