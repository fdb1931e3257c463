"""C3D: the points, in mm, and the segments' rotations, by ezc3d.

Source: The C3D File Format user guide (c3d.org), parameters POINT:UNITS, RATE, X_SCREEN, Y_SCREEN; a residual of −1
marks a point that is not valid. HAS-Motion's description of ROTATION: 4×4 transforms of a segment to the laboratory,
labelled ``…_4X4``, with the translation in the unit of the points.
"""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.configuration import solve_configuration
from ..body.kinematics import compute_link_poses, find_known_links
from ..errors import BadData
from ..libraries import import_library
from ..tracking import TrackResult
from .motion import find_measured_points, resample_evenly

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
MOST_FRAMES = 65535  # of the header's 16 bits: readers cut the rest off in silence


def write_c3d(path: Path, motion: TrackResult) -> None:
    """Write points in W (z up, x forward) and segments to W, single precision; NaN in a gap, with a residual of −1."""
    ezc3d = import_library("ezc3d", "--format c3d", "a C3D")
    motion = resample_evenly(motion)
    points = find_measured_points(motion)
    n = len(motion.pose.time)
    if n > MOST_FRAMES:
        rate_hz = np.floor(motion.rate_hz * MOST_FRAMES / n)
        raise BadData(f"{motion.where}: {n} samples; a .c3d holds {MOST_FRAMES}: --rate-hz {rate_hz:g}, or a .trc")
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
