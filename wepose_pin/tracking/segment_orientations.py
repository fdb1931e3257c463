"""`SegmentOrientations`: what is estimated of a recording's segments, and how; the covariances of segments in W."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body import BodyTable
from ..body.mounts import StartPose, compute_start_heading_var, find_mount_covariance
from ..body.subject import Subject
from ..diagnostics import Diagnostic
from ..filters import Orientation
from ..recording import Recording


@dataclass(frozen=True, repr=False)
class SegmentOrientations:
    """Orientation of each measured segment of a recording, or of a chunk of one."""

    recording: Recording  # the input, n samples; of a causal tracker the part after the start pose
    options: Mapping[str, Any]  # how it was tracked, as `Tracker.options`
    quat_WL: Mapping[str, np.ndarray]  # segment → (n, 4) xyzw
    quat_LS: Mapping[str, np.ndarray]  # segment → (4,) xyzw, the mount used
    heading_offset: Mapping[str, float]  # segment → ψ [rad], heading of its sensor's world V in W
    orientation: Mapping[str, Orientation]  # segment → result of its sensor's filter, in V; of IMUs alone
    start: tuple[float, float]  # [s] from which headings and mounts are
    static_phase: tuple[float, float]  # [s] from which noise and bias are
    diagnostics: tuple[Diagnostic, ...]  # of the recording, its start pose and its mounts

    def __repr__(self) -> str:
        return f"SegmentOrientations({self.recording!r}, {self.options['method']})"


def compute_heading_variance(quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
    """Compute the variance (n,) [rad²] of the heading from the covariance (n, 3, 3) [rad²] of the attitude error.

    `quat_VS` is (n, 4) xyzw; the attitude error is in S, on the right.
    """
    up_S = Rotation.from_quat(quat_VS).inv().apply([0.0, 0.0, 1.0])
    return np.einsum("na,nab,nb->n", up_S, attitude_cov, up_S)


def compute_segment_covariance(
    mounting: tuple[Recording, str, Subject | None, StartPose],
    R_LS: Rotation,
    filtered: tuple[np.ndarray, np.ndarray],
    heading_offset: np.ndarray,
    variance: np.ndarray,
    lost: np.ndarray,
) -> np.ndarray:
    """Compute a segment's covariance (n, 3, 3) [rad²] in W, error on the left, without soft tissue.

    It is the sum of the filter's and of the uncertainty of mount and start pose.

    Parameters
    ----------
    mounting : the recording, the segment, the person whose mounts are used, and the start pose
    R_LS : the sensor's mount
    filtered : of its filter, `quat_VS` (n, 4) xyzw and the covariance (n, 3, 3) [rad²] of its error, in S on the right
    heading_offset : (n,) ψ [rad]
    variance : (n, 3) [rad²] as `HeadingCorrector.variance`; NaN: the heading is that of the filter
    lost : (n,) bool: the sensor is lost, and neighbours do not tell where its segment is
    """
    (recording, segment, subject, start_pose), (quat_VS, attitude_cov) = mounting, filtered
    vertical = np.array([0.0, 0.0, 1.0])
    quat_WV = rotations.rotation_about(vertical, heading_offset)
    R = Rotation.from_quat(rotations.multiply(quat_WV, quat_VS)).as_matrix()
    cov_W = R @ attitude_cov @ R.swapaxes(1, 2)
    # A mount's error ε in L' becomes the error R_WL' ε in W. The heading offset ψ, computed with the same mount, takes
    # off the vertical component ε_z, so that in the start pose the heading has no error but that of the pose itself.
    R_WL = R @ start_pose.to_world(segment, R_LS).inv().as_matrix()
    mount_cov = find_mount_covariance(recording, segment, subject, start_pose)
    start_var = start_pose.std(segment) ** 2
    if mount_cov is not None and subject is not None:  # whose mount it is
        error_jacobian = R_WL - np.outer(vertical, vertical)
        if segment not in subject.start_pose_offset:
            # What is left after the start pose has corrected the tilt, as in `align_sensors`. A person repeats the
            # offset of the calibration's own start pose: then the start pose tells nothing new.
            tilt = mount_cov[:2]
            mount_cov = mount_cov - tilt.T @ np.linalg.solve(tilt[:, :2] + np.diag(start_var[:2]), tilt)
        if segment != start_pose.table.reference:
            # By how much the person turned the segment about the vertical in the calibration's start pose is not known.
            cov_W += start_var[2] * np.einsum("na,nb->nab", R_WL[:, :, 2], R_WL[:, :, 2])
    else:
        # The tilt of a stated mount is gravity's in the start pose, so that it has the error of the start pose.
        error_jacobian, mount_cov = R_WL, np.diag([start_var[0], start_var[1], 0.0])
    cov_W += error_jacobian @ mount_cov @ error_jacobian.swapaxes(1, 2)
    start_heading_var = compute_start_heading_var(*mounting)
    cov_W[:, 2, 2] += start_heading_var
    if np.isnan(variance).any():
        return cov_W
    # Variance from other sources, such as a mount's heading, is not observed by what neighbours share: it stays.
    R_VS = Rotation.from_quat(quat_VS)
    with_heading_V = R_VS.apply(np.einsum("nab,nb->na", attitude_cov, R_VS.inv().apply(vertical)))  # with each axis
    alone = with_heading_V[:, 2] + start_heading_var
    known, at_knot, correction = variance.T
    # The filter alone may know the heading better; to it a correction is an error of that size.
    corrected = np.minimum(known + np.maximum(with_heading_V[:, 2] - at_knot, 0.0), alone + correction)
    corrected = np.where(lost, np.maximum(corrected, alone), corrected)
    with_heading_W = Rotation.from_quat(quat_WV).apply(with_heading_V)
    removed = (1.0 - np.sqrt(corrected / alone))[:, None] * with_heading_W
    cov_W[:, 2, :2] -= removed[:, :2]
    cov_W[:, :2, 2] -= removed[:, :2]
    cov_W[:, 2, 2] += corrected - alone
    return cov_W


def compute_soft_tissue_covariance(table: BodyTable, quat_WL: Mapping[str, np.ndarray], segment: str) -> np.ndarray:
    """Compute the covariance (n, 3, 3) [rad²] in W by which soft tissue turns a segment's sensor in motion."""
    tissue, along = table.segments[segment].soft_tissue, np.array(table.segments[segment].along)
    var = np.square(tissue.std) + np.square(np.outer(_elevate(table, quat_WL, segment), tissue.per_tilt))
    if raised := [_elevate(table, quat_WL, other) for other in tissue.raised if other in quat_WL]:
        var = var + np.square(np.outer(np.mean(raised, axis=0), tissue.per_raised))
    if tissue.per_twist and tissue.relative_to in quat_WL:
        relative = rotations.multiply(rotations.conjugate(quat_WL[tissue.relative_to]), quat_WL[segment])
        twist = 2.0 * np.arctan2(np.abs(relative[:, :3] @ along), np.abs(relative[:, 3]))
        var = var + np.square(np.outer(tissue.per_twist * twist, along))
    matrix = Rotation.from_quat(quat_WL[segment]).as_matrix()
    return np.asarray((matrix * var[:, None, :]) @ matrix.swapaxes(1, 2))


def _elevate(table: BodyTable, quat_WL: Mapping[str, np.ndarray], segment: str) -> np.ndarray:
    """Return the angle (n,) [rad] of a segment's long axis from where it is in the start pose."""
    own = table.segments[segment]
    quat, below = quat_WL[segment], quat_WL.get(own.soft_tissue.relative_to)
    relative = quat if below is None else rotations.multiply(rotations.conjugate(below), quat)
    along = np.array(own.along)
    return np.asarray(np.arccos(np.clip(Rotation.from_quat(relative).as_matrix() @ along @ along, -1.0, 1.0)))
