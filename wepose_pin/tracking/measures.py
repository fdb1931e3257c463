"""Measures of a tracked recording: the sensors' signals, headings, hinges, tips of limbs, and the error budget.

The error budget is the contribution of each source of error to the standard deviation of each point. The contributions
add up in variance. The correlation of lengths and girdles goes to the lengths, that of the segments' headings to the
sensors.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel, BodyTable
from ..body.kinematics import Pose, compute_point_covariances
from ..body.subject import Subject
from ..recording import OrientationSensor, Recording, compute_rate, find_runs
from ..recording.faults import find_saturation
from ..recording.limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE
from .result import TrackResult
from .segment_orientations import compute_heading_variance, compute_soft_tissue_covariance

PERIOD_S = 1.0  # [s] from one sample of the error budget to the next
SOURCES = ("soft tissue", "sensor, mount, start pose", "lengths", "shoulder girdle")  # of the error budget


def measure_signal(recording: Recording, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Measure how fast a sensor turns (n,) [rad/s], and where an axis is cut off at the end of its range (n,) bool."""
    sensor = recording.sensors[name]
    if isinstance(sensor, OrientationSensor):
        return np.linalg.norm(compute_rate(sensor, recording.rate_hz), axis=1), np.zeros(len(recording), dtype=bool)
    cut = find_saturation(sensor.gyro_S, NARROWEST_GYRO_RANGE) | find_saturation(sensor.accel_S, NARROWEST_ACCEL_RANGE)
    return np.linalg.norm(sensor.gyro_S, axis=1), cut.any(axis=1)


def compute_heading_stds(tracked: TrackResult) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Compute segment → one standard deviation (n,) [rad] of its heading, and of the drift of its filter alone.

    The first includes start pose, soft tissue and the heading correction; with that the drift is at most what it
    leaves. There is none without a filter, or where that has no covariance.
    """
    stds, drifts, correction = {}, {}, tracked.correction
    for name, cov_W in tracked.pose.segment_cov.items():
        orientation = tracked.segments.orientation.get(name)
        if orientation is None or orientation.attitude_cov is None:
            continue
        drift = np.sqrt(np.maximum(compute_heading_variance(orientation.quat_VS, orientation.attitude_cov), 0.0))
        if correction is not None and len(correction.time) and name in correction.filter.names:
            i = correction.filter.names.index(name)
            drift = np.minimum(drift, np.sqrt(np.interp(tracked.time, correction.time, correction.covariance[:, i, i])))
        stds[name], drifts[name] = np.sqrt(np.maximum(cov_W[:, 2, 2], 0.0)), drift
    return stds, drifts


def compute_joint_heading_stds(stds: Mapping[str, np.ndarray], model: BodyModel) -> dict[str, np.ndarray]:
    """Joint → (n,) [rad] of the heading between its segments, as if `stds` of these were independent."""
    return {
        model.table.joint_name(segment): np.hypot(stds[above], stds[segment])
        for segment, above in model.parents.items()
        if above is not None and {above, segment} <= set(stds)
    }


def measure_hinge(
    pose: Pose, table: BodyTable, name: str, subject: Subject | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Measure a hinge of the table; None where a segment is not known.

    Without a calibrated axis it has that of the table.

    Returns
    -------
    bend : (n,) [rad] between the directions of the two segments, 0 in line
    flexion : (n,) [rad] the bend in the plane of the hinge; negative: against the way it bends
    aside : (n,) [rad] the moving segment out of that plane
    """
    hinge = table.hinges[name]
    if not {hinge.on, hinge.moves} <= set(pose.quat_WL):
        return None
    R_on, R_moves = (Rotation.from_quat(pose.quat_WL[segment]) for segment in (hinge.on, hinge.moves))
    along_on, along_moves = (np.array(table.segments[segment].along) for segment in (hinge.on, hinge.moves))
    axis = np.array(hinge.axis) if subject is None or name not in subject.hinges else subject.hinges[name].axis
    # Where the moving segment points at 90° of flexion: it bends to the wider end of its range.
    flexed = (-1.0 if sum(hinge.range) < 0.0 else 1.0) * np.cross(axis, along_on)
    moves = R_on.inv().apply(R_moves.apply(along_moves))
    bend = np.arctan2(np.linalg.norm(np.cross(along_on, moves), axis=1), moves @ along_on)
    flexion = np.arctan2(moves @ (flexed / np.linalg.norm(flexed)), moves @ along_on)
    return bend, flexion, np.arcsin(np.clip(moves @ axis, -1.0, 1.0))


def measure_reach(pose: Pose, table: BodyTable) -> dict[str, np.ndarray]:
    """Measure the reach (n, 3) [m] of each point whose path is drawn, as of a hand; only of points that are known.

    It is from the origin of its limb, in the segment on which that hangs; NaN: not known.
    """
    reaches = {}
    for name, limb in table.drawn_limbs.items():
        if not {name, *limb.origin} <= set(pose.points) or (limb.base is not None and limb.base not in pose.quat_WL):
            continue
        reach = pose.points[name] - np.mean([pose.points[point] for point in limb.origin], axis=0)
        if limb.base is not None:
            known = np.isfinite(pose.quat_WL[limb.base]).all(axis=1)
            quat = np.where(known[:, None], pose.quat_WL[limb.base], [0.0, 0.0, 0.0, 1.0])
            reach = Rotation.from_quat(quat).inv().apply(reach)
            reach[~known] = np.nan
        if np.isfinite(reach).all(axis=1).any():
            reaches[name] = reach
    return reaches


def find_samples_after_start(tracked: TrackResult) -> np.ndarray:
    """(n,) bool, the samples after the start pose, which the summaries of uncertainty are of.

    Before it the filters have not converged, and headings are extrapolated backwards.
    """
    since = tracked.time >= tracked.segments.start[1] - 1e-9
    return since if since.any() else ~since


def compute_error_budget(tracked: TrackResult) -> dict[str, dict[str, float]]:
    """Point → source of error → its share of the standard deviation [m] per axis, rms over time; the largest first.

    Shares below a tenth of a millimetre are left out. It is empty of a mechanism, and where no covariance is known.
    """
    pose, body = tracked.pose, tracked.model
    rows = np.arange(0, len(tracked.time), max(1, round(PERIOD_S * tracked.rate_hz)) if len(tracked.time) > 1 else 1)
    for known in (*pose.quat_WL.values(), *pose.segment_cov.values()):
        rows = rows[np.isfinite(known[rows].sum(axis=tuple(range(1, known.ndim))))]
    if body.table.is_mechanism or not pose.point_cov or not len(rows):
        return {}
    quat_WL = {name: quat[rows] for name, quat in pose.quat_WL.items()}
    soft = {name: compute_soft_tissue_covariance(body.personal_table, quat_WL, name) for name in pose.segment_cov}
    zero = {name: np.zeros_like(cov) for name, cov in soft.items()}
    shape_cov = tracked.subject.shape_covariance(body.table)
    of_girdles, none, k = shape_cov.copy(), 0.0 * shape_cov, len(body.lengths)
    of_girdles[:k], of_girdles[:, :k] = 0.0, 0.0
    cases = (zero, none), (zero, of_girdles), (zero, shape_cov), (soft, none)
    covs = [compute_point_covariances(body, quat_WL, *case) for case in cases]
    budget = {}
    for point, cov in pose.point_cov.items():
        total, law, girdles, shape, tissue = (
            float(np.mean(np.trace(each, axis1=1, axis2=2))) / 3.0
            for each in (cov[rows], *(own[point] for own in covs))
        )
        variances = tissue - law, total - shape - tissue + law, shape - girdles, girdles
        stds = {source: float(np.sqrt(max(value, 0.0))) for source, value in zip(SOURCES, variances, strict=True)}
        ordered = sorted(stds.items(), key=lambda item: -item[1])
        budget[point] = {source: std for source, std in ordered if std >= 1e-4}
    return budget


def finite_max(values: np.ndarray) -> float:
    """The largest of the finite values; NaN where there is none."""
    return float(np.max(values, initial=-np.inf, where=np.isfinite(values))) if np.isfinite(values).any() else np.nan


def finite_median(values: np.ndarray) -> float:
    """The median of the finite values; NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def longest_run_s(mask: np.ndarray, rate_hz: float) -> float:
    """The longest run of true values [s]."""
    return max((b - a for a, b in find_runs(mask)), default=0) / rate_hz


def has_stated_mounts(tracked: TrackResult) -> bool:
    """Whether the mounts are the session's and not calibrated ones."""
    return not tracked.subject.mounts or tracked.recording.remounted
