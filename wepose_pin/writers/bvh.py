"""Biovision hierarchy (.bvh), without a library: the format is a page of text.

The skeleton with the subject's lengths, and its motion.

y is up, the person faces z with x on the left; centimetres and degrees. At zero the skeleton stands in the N-pose.
Offsets are constant: by how much the shoulders move on the torso is lost.

Source: M. Meredith, S. Maddock 2001, "Motion Capture File Formats Explained", University of Sheffield CS-01-11, 3.3: a
joint turns by its channels in their order, each about an axis as turned so far.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..body.configuration import solve_configuration
from ..body.links import compute_link_poses, find_known_points, move_girdles
from ..diagnostics import Diagnostic
from ..errors import BadData
from ..rotations import conjugate, multiply
from .motion import Motion, check_complete, diagnose_gaps, resample_evenly

_ROTATIONS = "Zrotation Xrotation Yrotation"
# Segment → joint, as other programs name them; those of other bodies have the segment's name in capitals.
NAMES = {
    "pelvis": "Hips",
    "torso": "Spine",
    "head": "Head",
    **{
        f"{side}_{segment}": f"{side.capitalize()}{name}"
        for side in ("left", "right")
        for segment, name in (
            *(("upper_arm", "Arm"), ("forearm", "ForeArm"), ("hand", "Hand")),
            *(("thigh", "UpLeg"), ("shank", "Leg"), ("foot", "Foot")),
        )
    },
}
ROOTS = ("Hips", "Root")  # the root of a person, whose orientation is that of the segment of this name; of a mechanism
SHORT_M, LONG_M = 0.2, 0.3  # [m] of a bone whose end is not known: of a segment without a length, and of others


class Bone(NamedTuple):
    """A joint and what hangs on it."""

    name: str
    segment: str | None  # whose orientation it has; None: W's
    at: np.ndarray  # (3,) [m] in W, in the N-pose
    children: list[Bone]
    end: np.ndarray  # (3,) [m] in W, in the N-pose: where it ends, if it has no children


def build_skeleton(motion: Motion) -> Bone:
    """The bones that are known: of a person hips, spine, and of each limb as much as has sensors.

    Raises
    ------
    BadData
        The segment is not known to which the rest is tied.
    """
    model, table = motion.model, motion.model.table
    measured = motion.pose.quat_WL
    if not table.is_mechanism and table.reference not in measured:
        raise BadData(
            f"{motion.where}: no orientation of the {table.reference} in pose.parquet; a .bvh ties the rest to it"
        )
    starts, points = find_places(motion)
    hips = next((segment for segment in table.segments if NAMES.get(segment) == ROOTS[0]), None)

    def hang(segment: str, above: str | None, above_at: np.ndarray) -> Bone | None:
        """The bone of a segment; None where it has no sensor and does not lie rigidly between points."""
        rigid = table.segments[segment].rigid_without_sensor and table.ends(segment) is not None and above is not None
        if segment not in measured and not rigid:
            return None
        at = np.zeros(3) if segment == table.reference and not table.is_mechanism else starts[segment]
        own = segment if segment in measured else above
        below = [s for s, parent in model.parents.items() if parent == segment and s != hips]
        children = [bone for s in below if (bone := hang(s, own, at)) is not None]
        name = NAMES.get(segment) or "".join(word.capitalize() for word in segment.split("_"))
        return Bone(name, own, at, children, _find_end(motion, segment, at, above_at, points))

    zero = np.zeros(3)
    on_hips = [s for s, parent in model.parents.items() if parent is None or parent == hips]
    bones = [bone for s in on_hips if s != hips and (bone := hang(s, None, zero)) is not None]
    if table.is_mechanism:
        return Bone(ROOTS[1], None, zero, bones, zero)
    return Bone(ROOTS[0], hips if hips in measured else table.reference, zero, bones, bones[0].end)


def find_places(motion: Motion) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Where segments begin and points are (3,) [m] in W, in the N-pose; a mechanism's while its joints are at zero."""
    model = motion.model
    if model.table.is_mechanism:
        q = pin.neutral(model.pin)[None]
    else:
        q = solve_configuration(model, {name: np.array([[0.0, 0.0, 0.0, 1.0]]) for name in motion.pose.quat_WL})
    known = find_known_points(model, motion.pose.quat_WL)
    links = [*model.table.segments, *(model.point_frames[point] for point in known)]
    _, p_W = compute_link_poses(model, q, links, rotations=False)
    placed = [p_W[0, k] for k in range(len(links))]
    count = len(model.table.segments)
    return dict(zip(model.table.segments, placed, strict=False)), dict(zip(known, placed[count:], strict=True))


def _find_end(
    motion: Motion, segment: str, at: np.ndarray, above_at: np.ndarray, points: dict[str, np.ndarray]
) -> np.ndarray:
    """Where the bone of a segment ends (3,) [m]."""
    table = motion.model.table
    if segment == table.reference and (anchors := _find_anchors(motion)):
        return np.asarray(np.mean([points[point] for point in anchors], axis=0))
    own = [place for point, place in points.items() if next(reversed(motion.model.reaches[point]), None) == segment]
    if own:
        return np.asarray(np.mean(own, axis=0))
    if table.ends(segment) is not None:
        return at + LONG_M * np.array(table.segments[segment].along)
    away = at - above_at
    return at + SHORT_M * away / max(float(np.linalg.norm(away)), 1e-9)


def _find_anchors(motion: Motion) -> tuple[str, ...]:
    """The points at which limbs hang on the reference segment, as the shoulders; none: no limb does."""
    table = motion.model.table
    return next((limb.origin for limb in table.drawn_limbs.values() if limb.base == table.reference), ())


def _to_file_axes(v_W: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) of W in the file's axes: x left, y up, z forward."""
    return v_W[..., [1, 2, 0]]


def write_bvh(path: Path, motion: Motion) -> list[Diagnostic]:
    """Hierarchy and motion; angles are followed over time, so they may go beyond 180°.

    Raises
    ------
    BadData
        A segment to which the rest is tied is not known, or a sample has no orientation.
    """
    check_complete(motion, "a .bvh")
    motion = resample_evenly(motion)
    root = build_skeleton(motion)
    columns = [100.0 * _to_file_axes(_root_position(motion, root)), *_rotations(motion, root, None)]
    lines = ["HIERARCHY", *_hierarchy(root, root.at, 0), "MOTION"]
    lines += [f"Frames: {len(columns[0])}", f"Frame Time: {1.0 / motion.rate_hz:.8f}"]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, np.column_stack(columns), fmt="%.6f")
    return diagnose_gaps(motion)


def _root_position(motion: Motion, root: Bone) -> np.ndarray:
    """Where the hips are (n, 3) [m], so that the shoulders are where they were found; a spine of many joints bends.

    The shoulders without their motion on the torso, which does not lift the hips.
    """
    pose, anchors = motion.pose, _find_anchors(motion)
    if root.segment is None or not anchors:
        return np.zeros((len(pose.time), 3))
    for point in anchors:
        if point not in pose.points:
            raise BadData(
                f"{motion.where}: no columns {point}_x … in pose.parquet; a .bvh needs {' and '.join(anchors)}"
            )
    middle = np.mean([pose.points[point] - _girdle_motion(motion, point) for point in anchors], axis=0)
    return np.asarray(middle - Rotation.from_quat(pose.quat_WL[motion.model.table.reference]).apply(root.end))


def _girdle_motion(motion: Motion, point: str) -> np.ndarray:
    """By how much girdles have moved a point (n, 3) [m] in W, from where it is at rest."""
    model = motion.model
    R_WL = {segment: Rotation.from_quat(quat).as_matrix() for segment, quat in motion.pose.quat_WL.items()}
    moved = np.zeros((len(motion.pose.time), 3))
    for name, girdle_motion in move_girdles(model, R_WL, model.point_girdles[point]).items():
        at_rest = model.girdle_parameters(name)[1:4]
        R_on = R_WL[model.table.girdles[name].on]
        moved += np.einsum("nij,nj->ni", R_on, girdle_motion.displacement - at_rest)
    return moved


def _orientation(motion: Motion, segment: str | None) -> np.ndarray:
    """(n, 4) xyzw, the rotation of a segment from the pose of the file's zero."""
    if segment is None:
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(motion.pose.time), 1))
    quat_WL, model = motion.pose.quat_WL[segment], motion.model
    if not model.table.is_mechanism:
        return quat_WL
    R_WL, _ = compute_link_poses(model, pin.neutral(model.pin)[None], [segment])
    return multiply(quat_WL, conjugate(Rotation.from_matrix(R_WL[0, 0]).as_quat()))


def _rotations(motion: Motion, bone: Bone, above: np.ndarray | None) -> Iterator[np.ndarray]:
    """Angles (n, 3) [deg] about z, x, y of each bone, in the order of the hierarchy."""
    quat_WL = _orientation(motion, bone.segment)
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
