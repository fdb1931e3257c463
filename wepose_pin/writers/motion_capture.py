"""Formats of motion capture: BVH, a skeleton and its motion; C3D, the points in mm and the segments' rotations.

Biovision hierarchy (.bvh): y is up, the person faces z with x on the left; centimetres and degrees. At zero the
skeleton stands in the N-pose. Offsets are constant: by how much the shoulders move on the torso is lost.

Sources: M. Meredith, S. Maddock 2001, "Motion Capture File Formats Explained", University of Sheffield CS-01-11, 3.3: a
joint turns by its channels in their order, each about an axis as turned so far. The C3D File Format user guide
(c3d.org), parameters POINT:UNITS, RATE, X_SCREEN, Y_SCREEN; a residual of −1 marks a point that is not valid.
HAS-Motion's description of ROTATION: 4×4 transforms of a segment to the laboratory, labelled ``…_4X4``, with the
translation in the unit of the points.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..body.configuration import solve_configuration
from ..body.kinematics import compute_link_poses, find_known_links, find_known_points
from ..diagnostics import Diagnostic
from ..errors import BadData
from ..libraries import import_library
from ..rotations import conjugate, multiply
from ..tracking import TrackResult
from .motion import check_complete, diagnose_gaps, find_measured_points, resample_evenly

# BVH -----------------------------------------------------------------------------------------------------------------

_ROTATIONS = "Zrotation Xrotation Yrotation"
# Segment → joint, as other programs name them; those of other bodies have the segment's name in capitals.
_LIMBS = {"upper_arm": "Arm", "forearm": "ForeArm", "hand": "Hand", "thigh": "UpLeg", "shank": "Leg", "foot": "Foot"}
NAMES = {"pelvis": "Hips", "torso": "Spine", "head": "Head"} | {
    f"{side}_{segment}": f"{side.capitalize()}{name}" for side in ("left", "right") for segment, name in _LIMBS.items()
}
ROOT = "Hips"  # whose orientation is that of the segment of this name, else of the reference segment
SHORT_M, LONG_M = 0.2, 0.3  # [m] of a bone whose end is not known: of a segment without a length, and of others


class Bone(NamedTuple):
    """A joint and what hangs on it."""

    name: str
    segment: str  # whose orientation it has
    at: np.ndarray  # (3,) [m] in W, in the N-pose
    children: list[Bone]
    end: np.ndarray  # (3,) [m] in W, in the N-pose: where it ends, if it has no children


def write_bvh(path: Path, motion: TrackResult) -> list[Diagnostic]:
    """Write hierarchy and motion; angles are followed over time, so they may go beyond 180°."""
    check_complete(motion, "a .bvh")
    table = motion.model.table
    if table.is_mechanism or table.reference not in motion.pose.quat_WL:
        raise BadData(f"{motion.where}: no orientation of a person's {table.reference}; a .bvh ties all to it")
    motion = resample_evenly(motion)
    # The points at which limbs hang on the reference segment, as the shoulders.
    anchors = next((limb.origin for limb in table.drawn_limbs.values() if limb.base == table.reference), ())
    root = _build_skeleton(motion, anchors)
    p_W = np.zeros((len(motion.time), 3))  # of the hips
    if anchors and set(anchors) <= set(motion.points) and not table.girdles:  # a spine without sensors may bend
        p_W = np.mean([motion.points[point] for point in anchors], axis=0)
        spine = root.children[0]
        p_W = p_W - Rotation.from_quat(motion.quat_WL[table.reference]).apply(spine.end - spine.at)
        p_W = p_W - Rotation.from_quat(motion.quat_WL[root.segment]).apply(spine.at)
    columns = [100.0 * _to_file_axes(p_W), *_compute_angles(motion, root, None)]
    lines = ["HIERARCHY", *_format_hierarchy(root, root.at, 0), "MOTION"]
    lines += [f"Frames: {len(columns[0])}", f"Frame Time: {1.0 / motion.rate_hz:.8f}"]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, np.column_stack(columns), fmt="%.6f")
    return diagnose_gaps(motion)


def _build_skeleton(motion: TrackResult, anchors: Sequence[str]) -> Bone:
    """Build the bones that are known: hips, spine, and of each limb as much as has sensors."""
    model, table, measured = motion.model, motion.model.table, motion.pose.quat_WL
    q = solve_configuration(model, {name: np.array([[0.0, 0.0, 0.0, 1.0]]) for name in measured})
    known, count = find_known_points(model, measured), len(table.segments)
    links = [*table.segments, *(model.point_frames[point] for point in known)]
    p_W = compute_link_poses(model, q, links, rotations=False)[1][0]
    starts, points = dict(zip(table.segments, p_W, strict=False)), dict(zip(known, p_W[count:], strict=True))
    hips, zero = next((segment for segment in table.segments if NAMES.get(segment) == ROOT), None), np.zeros(3)

    def find_end(segment: str, at: np.ndarray, above_at: np.ndarray) -> np.ndarray:
        """Find where the bone of a segment ends (3,) [m]."""
        own = [point for point in points if next(reversed(model.reaches[point]), None) == segment]
        own = list(anchors) if segment == table.reference and anchors else own
        if own:
            return np.asarray(np.mean([points[point] for point in own], axis=0))
        if table.ends(segment) is not None:
            return at + LONG_M * np.array(table.segments[segment].along)
        return at + SHORT_M * (at - above_at) / max(float(np.linalg.norm(at - above_at)), 1e-9)

    def hang(segment: str, above: str | None, above_at: np.ndarray) -> Bone | None:
        """Hang the bone of a segment; None where it has no sensor and does not lie rigidly between points."""
        rigid = table.segments[segment].rigid_without_sensor and table.ends(segment) is not None
        own = segment if segment in measured else above if rigid else None
        if own is None:
            return None
        at = zero if segment == table.reference and hips not in measured else starts[segment]
        below = [s for s, parent in model.parents.items() if parent == segment and s != hips]
        children = [bone for s in below if (bone := hang(s, own, at)) is not None]
        name = NAMES.get(segment) or "".join(word.capitalize() for word in segment.split("_"))
        return Bone(name, own, at, children, find_end(segment, at, above_at))

    on_hips = [s for s, parent in model.parents.items() if parent is None or parent == hips]
    bones = [bone for s in on_hips if s != hips and (bone := hang(s, None, zero)) is not None]
    return Bone(ROOT, hips if hips is not None and hips in measured else table.reference, zero, bones, bones[0].end)


def _to_file_axes(v_W: np.ndarray) -> np.ndarray:
    """Return vectors (…, 3) of W in the file's axes: x left, y up, z forward."""
    return v_W[..., [1, 2, 0]]


def _compute_angles(motion: TrackResult, bone: Bone, above: np.ndarray | None) -> Iterator[np.ndarray]:
    """Compute the angles (n, 3) [deg] about z, x, y of each bone, in the order of the hierarchy."""
    quat_WL = motion.pose.quat_WL[bone.segment]
    quat = quat_WL if above is None else multiply(conjugate(above), quat_WL)
    turned = np.column_stack([_to_file_axes(quat[:, :3]), quat[:, 3]])
    yield np.degrees(euler.follow(euler.decompose(turned, "ZXY"), "ZXY", NEAR_LOCK))
    for child in bone.children:
        yield from _compute_angles(motion, child, quat_WL)


def _format_hierarchy(bone: Bone, above: np.ndarray, depth: int) -> Iterator[str]:

    def offset(v_W: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{100.0 * value + 0.0:.6f}" for value in _to_file_axes(v_W))

    tabs = "\t" * depth
    yield from (f"{tabs}{'JOINT' if depth else 'ROOT'} {bone.name}", f"{tabs}{{", f"{tabs}\t{offset(bone.at - above)}")
    yield f"{tabs}\tCHANNELS " + (f"3 {_ROTATIONS}" if depth else f"6 Xposition Yposition Zposition {_ROTATIONS}")
    for child in bone.children:
        yield from _format_hierarchy(child, bone.at, depth + 1)
    if not bone.children:
        yield from (f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\t{offset(bone.end - bone.at)}", f"{tabs}\t}}")
    yield f"{tabs}}}"


# C3D -----------------------------------------------------------------------------------------------------------------

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
MOST_FRAMES = 65535  # of the header's 16 bits: readers cut the rest off in silence


def write_c3d(path: Path, motion: TrackResult) -> None:
    """Write points in W (z up, x forward) and segments to W, single precision; NaN in a gap, with a residual of −1."""
    ezc3d = import_library("ezc3d", "`format` c3d", "a C3D")
    motion = resample_evenly(motion)
    points = find_measured_points(motion)
    n = len(motion.pose.time)
    if n > MOST_FRAMES:
        rate_hz = np.floor(motion.rate_hz * MOST_FRAMES / n)
        raise BadData(f"{motion.where}: {n} samples; a .c3d holds {MOST_FRAMES}: `rate_hz` {rate_hz:g}, or a .trc")
    p_W = np.stack([p.T for p in points.values()], axis=1)  # (3, points, n)
    file = ezc3d.c3d()
    texts = [f"{point.replace('_', ' ')} of {motion.name}"[:127] for point in points]
    about = {"UNITS": ["mm"], "RATE": [motion.rate_hz], "LABELS": list(points), "DESCRIPTIONS": texts}
    for key, value in about.items():
        file["parameters"]["POINT"][key]["value"] = value
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    file["data"]["points"] = np.concatenate([1e3 * p_W, np.ones((1, *p_W.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(np.isfinite(p_W).all(axis=0), 0.0, -1.0)[None]
    if motion.pose.quat_WL:
        segments = _compute_transforms(motion)
        file.add_parameter("ROTATION", "RATE", [motion.rate_hz])
        file.add_parameter("ROTATION", "UNITS", ["mm"])
        file.add_parameter("ROTATION", "LABELS", [f"{segment}_4X4" for segment in segments])
        file["data"]["rotations"] = np.stack(list(segments.values()), axis=-1).transpose(1, 2, 3, 0)
    named = path.with_name(f"{path.name}.c3d")  # ezc3d adds the suffix where it is missing
    try:
        file.write(str(named))
        content, size = named.read_bytes(), (16 * len(points) + 68 * len(motion.pose.quat_WL)) * n
        # ezc3d raises no error of a full disk. Word 9 of the header is the first block of the data.
        if len(content) < 512 * (int.from_bytes(content[16:18], "little") - 1) + size:
            raise OSError(errno.ENOSPC, "the disk seems to be full")
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)


def _compute_transforms(motion: TrackResult) -> dict[str, np.ndarray]:
    """Segment → (n, 4, 4) from its frame, at its upper joint, to W [mm]; at the origin where no place is ever known.

    NaN where the segment or, if its place is known, one from which it hangs has no orientation or was bridged.
    """
    pose, model = motion.pose, motion.model
    known = {
        segment: np.isfinite(quat).all(axis=1) & ~pose.gap.get(segment, np.zeros(len(quat), dtype=bool))
        for segment, quat in pose.quat_WL.items()
    }
    quat_WL = {segment: np.where(known[segment][:, None], quat, IDENTITY) for segment, quat in pose.quat_WL.items()}
    placed, transforms = set(find_known_links(model, list(quat_WL))), dict[str, np.ndarray]()
    links = [model.table.segments[segment].link for segment in quat_WL]
    _, p_W = compute_link_poses(model, solve_configuration(model, quat_WL), links, rotations=False)
    for k, (segment, quat) in enumerate(quat_WL.items()):
        T = np.tile(np.eye(4), (len(pose.time), 1, 1))
        T[:, :3, :3] = Rotation.from_quat(quat).as_matrix()
        good, above = known[segment], model.parents.get(segment)
        if links[k] in placed:
            T[:, :3, 3] = 1e3 * p_W[:, k]
            while above is not None:  # on which its place hangs
                good, above = good & known.get(above, True), model.parents.get(above)
        T[~good] = np.nan
        transforms[segment] = T
    return transforms
