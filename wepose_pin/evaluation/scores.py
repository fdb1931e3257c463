"""How wrong a pose is against a reference: attitude, joint angles, positions, and how far its stated ± is right."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..angles import euler, joint_angles
from ..arguments import check_arguments
from ..body import BodyTable, load_table
from ..body.kinematics import Pose, parse_pose_table
from ..data_tables import read_table
from ..errors import BadData, BadOption
from ..recording import format_span
from ..tracking import TrackResult
from .registration import Registration, sample

LIMITS = 1.96  # standard deviations of the differences, in which 95 % of them are where they are normal
SINGULAR = 1e-12  # ratio of a covariance's least variance to its largest, below which it states no error in a direction


class AttitudeError(NamedTuple):
    """Error of one segment [deg].

    Roll, pitch, yaw as the paper reports them: mean and standard deviation over time of the absolute angles of the
    error rotation R_WL,estimated R_WL,trueᵀ about the axes x, y, z of W, so that they mean the same at any pose.
    """

    roll: tuple[float, float]
    pitch: tuple[float, float]
    yaw: tuple[float, float]
    inclination_rmse: float  # angle between the verticals
    heading_rmse: float  # twist of the error about the vertical
    total_rmse: float
    drift_deg_min: float  # slope of a line through the heading error [deg/min]


class AngleError(NamedTuple):
    """Error of one angle of a joint [deg], where neither pose nor reference is near gimbal lock or in a gap.

    Samples follow each other closely: limits of agreement (Bland and Altman 1986) and correlation describe this
    recording, and are no statistics of as many independent draws.
    """

    mean: float  # with its sign: estimated less true
    rmse: float
    worst: float
    std: float  # of the differences
    lower: float  # limits of agreement, mean ± 1.96 std
    upper: float
    icc: float  # ICC(A,1): two-way, absolute agreement, single measurement
    range: float  # of the reference, largest less smallest


class PositionError(NamedTuple):
    """Error of one point [mm]: the distance to the truth."""

    mean: float
    std: float
    rmse: float
    worst: float


class Uncertainty(NamedTuple):
    """The consistency of stated standard deviations, over time and axes of W.

    The errors of one recording are slow: over a minute they are a few draws, not thousands. Judge many recordings.
    """

    nees: float  # mean normalised squared error; 3 is right, above it the deviations are too small
    within_1: float  # share of errors within one standard deviation; 0.683 is consistent
    within_2: float  # 0.954 is consistent


@dataclass(frozen=True)
class Evaluation:
    """Errors over the time that pose and reference share."""

    attitude: dict[str, AttitudeError]  # segment → [deg]
    joints: dict[str, dict[str, AngleError]]  # joint → angle → [deg]
    position: dict[str, PositionError]  # point → [mm], relative to the root
    position_on_limb: dict[str, PositionError]  # the same relative to where its limb begins, as between the shoulders
    attitude_uncertainty: dict[str, Uncertainty]  # segment → how far the stated covariance agrees with the error
    position_uncertainty: dict[str, Uncertainty]  # point → the same
    interval: tuple[float, float]  # from, to [s], that is compared
    samples: int  # that are compared
    registration: Registration | None = None  # how the reference was brought to the pose; None: it is taken as it is

    def __repr__(self) -> str:
        total = max((error.total_rmse for error in self.attitude.values()), default=float("nan"))
        position = max((error.rmse for error in self.position.values()), default=float("nan"))
        return (
            f"Evaluation({self.samples} samples; largest rms error of a segment {total:.1f}°, of a point "
            f"{position:.0f} mm)"
        )


def evaluate(
    pose: Pose | TrackResult,
    truth: Pose | TrackResult | str | Path,
    interval: tuple[float, float] | None = None,
    table: BodyTable | None = None,
) -> Evaluation:
    """Compute the errors of a pose against a reference in the same W, which is interpolated to the pose's times.

    Parameters
    ----------
    pose : TrackResult or Pose
        What `track` or `load_result` gives, or its `pose`.
    truth : TrackResult or Pose, str or Path
        The reference, or a table (.parquet, .csv) with the columns of pose.parquet, such as `load_session(…).truth`;
        where it is NaN, or has no sample near a time of the pose, that time is left out.
    interval : (float, float), optional
        Use only this time of the recording, from and to in seconds.
    table : BodyTable, optional
        Of the body: it names the limbs, for errors of a hand relative to the shoulders. Without it that of `pose`,
        where it has a body, else the upper body's.

    Returns
    -------
    Evaluation
        `attitude[segment]` [deg], `joints[joint][angle]` [deg], `position[point]` [mm] relative to the root, and in
        `attitude_uncertainty` and `position_uncertainty` how far the stated covariances agree with the errors.

    Raises
    ------
    BadOption
        The interval's end is not after its beginning.
    BadData
        No time in common, or nothing to compare.

    Examples
    --------
    >>> errors = wp.evaluate(result, simulation.truth())
    >>> errors.attitude["right_forearm"].inclination_rmse < 5.0  # [deg]
    True
    >>> errors.position["right_palm"].rmse < 150.0  # [mm]
    True
    """
    check_arguments(evaluate, locals())
    if isinstance(pose, TrackResult):
        table, pose = table or pose.model.table, pose.pose
    if isinstance(truth, str | Path):
        truth = parse_pose_table(read_table(Path(truth)), str(truth))
    if isinstance(truth, TrackResult):
        truth = truth.pose
    if interval is not None and not interval[0] < interval[1]:
        raise BadOption(f"interval = {interval}: from and to in seconds are needed, the earlier one first")
    first = max(pose.time[0], truth.time[0], interval[0] if interval else -np.inf)
    last = min(pose.time[-1], truth.time[-1], interval[1] if interval else np.inf)
    inside = (pose.time >= first - 1e-9) & (pose.time <= last + 1e-9)
    if not np.any(inside):
        ours, theirs = (format_span(each.time[[0, -1]]) for each in (pose, truth))
        within = f" within the interval {format_span(interval)}" if interval else ""
        raise BadData(f"pose ({ours}) and reference ({theirs}) have no time in common{within}")
    pose = pose.cut(inside)
    time = np.clip(pose.time, truth.time[0], truth.time[-1])
    truth = Pose(
        time,
        {name: sample(truth.time, quat, time) for name, quat in truth.quat_WL.items()},
        {name: sample(truth.time, points, time) for name, points in truth.points.items()},
    )
    attitude, attitude_uncertainty = {}, {}
    for segment in [segment for segment in pose.quat_WL if segment in truth.quat_WL]:
        quats = pose.quat_WL[segment], truth.quat_WL[segment]
        known = np.isfinite(quats).all(axis=(0, 2))
        if known.any():
            R_estimated, R_true = (Rotation.from_quat(quat[known]) for quat in quats)
            attitude[segment] = attitude_error(R_estimated, R_true, truth.time[known])
            if segment in pose.segment_cov:
                turn = (R_true * R_estimated.inv()).as_rotvec()
                attitude_uncertainty[segment] = uncertainty(turn, pose.segment_cov[segment][known])
    table = table or load_table()
    position, position_on_limb, position_uncertainty = {}, {}, {}
    for point in [point for point in pose.points if point in truth.points]:
        difference = pose.points[point] - truth.points[point]
        known = np.isfinite(difference).all(axis=1)
        if not known.any():
            continue
        position[point] = position_error(difference[known])
        if point in pose.point_cov:
            position_uncertainty[point] = uncertainty(difference[known], pose.point_cov[point][known])
        limb = table.find_limb(point)
        if limb is not None and all(set(limb.origin) <= set(each.points) for each in (pose, truth)):
            difference = difference - np.mean([pose.points[name] - truth.points[name] for name in limb.origin], axis=0)
            known = np.isfinite(difference).all(axis=1)
            if known.any():
                position_on_limb[point] = position_error(difference[known])
    for kind, common, errors in (
        ("orientation of a segment", pose.quat_WL.keys() & truth.quat_WL.keys(), attitude),
        ("position of a point", pose.points.keys() & truth.points.keys(), position),
    ):
        if common and not errors:
            raise BadData(f"no {kind} is known to both at a time: of {', '.join(sorted(common))} one of the two is NaN")
    if not attitude and not position:
        raise BadData("pose and reference have no segment and no point in common; columns of pose.parquet are needed")
    joints = _joint_errors(pose, truth, list(attitude))
    uncertainties = attitude_uncertainty, position_uncertainty
    span = float(truth.time[0]), float(truth.time[-1])
    return Evaluation(attitude, joints, position, position_on_limb, *uncertainties, span, len(pose.time))


def _joint_errors(pose: Pose, truth: Pose, segments: list[str]) -> dict[str, dict[str, AngleError]]:
    """Joint → angle → its error, of joints between these segments."""
    poses = (
        replace(each, quat_WL={name: each.quat_WL[name] for name in segments}, segment_cov={}) for each in (pose, truth)
    )
    try:
        angles, true = map(joint_angles, poses)
    except BadData:  # no joint has both of its segments
        return {}
    errors = {}
    for name, joint in angles.joints.items():
        sound = ~(joint.gap | joint.near_lock | true[name].gap | true[name].near_lock)
        if sound.any():
            # Principal values: two sets of angles that differ by half turns are the same pose.
            values = [euler.decompose(each.quat[sound], joint.sequence)[0] for each in (joint, true[name])]
            error, measured = np.degrees(euler.wrap(values[0] - values[1])), np.degrees(values[1])
            errors[name] = {
                angle: angle_error(measured[:, k] + error[:, k], measured[:, k]) for k, angle in enumerate(joint.names)
            }
    return errors


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def attitude_error(estimated: Rotation, true: Rotation, time: np.ndarray) -> AttitudeError:
    """Compute the attitude error of n orientations in W at `time` (n,) [s]."""
    error = estimated * true.inv()
    yaw, pitch, roll = np.abs(error.as_euler("ZYX", degrees=True)).T
    heading = np.degrees(np.unwrap(rotations.heading(error.as_quat())))
    inclination = np.degrees(np.arccos(np.clip(error.as_matrix()[:, 2, 2], -1.0, 1.0)))
    slope = np.polyfit(time - time[0], heading, 1)[0] if np.ptp(time) > 0.0 else 0.0
    x, y, z = ((float(angle.mean()), float(angle.std())) for angle in (roll, pitch, yaw))
    rms = _rms(inclination), _rms(heading), _rms(np.degrees(error.magnitude()))
    return AttitudeError(x, y, z, *rms, 60.0 * float(slope))


def uncertainty(error: np.ndarray, cov: np.ndarray) -> Uncertainty:
    """Compare errors (n, 3) with stated covariances (n, 3, 3), without samples that have none; NaN where all are."""
    stated = np.isfinite(cov).all(axis=(1, 2))
    eigenvalues = np.linalg.eigvalsh(cov[stated])
    stated[stated] = eigenvalues[:, 0] > SINGULAR * eigenvalues[:, 2]
    error, cov = error[stated], cov[stated]
    if not len(error):
        return Uncertainty(np.nan, np.nan, np.nan)
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])
    normalised = np.abs(error) / np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return Uncertainty(float(squared.mean()), *(float(np.mean(normalised <= stds)) for stds in (1.0, 2.0)))


def angle_error(estimated: np.ndarray, true: np.ndarray) -> AngleError:
    """Compute the error of values (n,) [deg] against a reference's (n,); the ICC is that of McGraw and Wong 1996."""
    error, icc, n = estimated - true, np.nan, len(estimated)
    mean, std = float(error.mean()), float(error.std(ddof=1)) if n > 1 else np.nan
    limits = mean - LIMITS * std, mean + LIMITS * std
    if n > 1:  # mean squares of rows, and of the rest; the last term is that of the two columns less the rest
        rows, rest = 0.5 * float(np.var(estimated + true, ddof=1)), 0.5 * std**2
        spread = rows + rest + mean**2 - 2.0 * rest / n
        icc = (rows - rest) / spread if spread > 0.0 else np.nan
    return AngleError(mean, _rms(error), float(np.abs(error).max()), std, *limits, icc, float(np.ptp(true)))


def position_error(difference: np.ndarray) -> PositionError:
    """Position error of differences (n, 3) [m]."""
    distance = 1e3 * np.linalg.norm(difference, axis=1)
    return PositionError(float(distance.mean()), float(distance.std()), _rms(distance), float(distance.max()))
