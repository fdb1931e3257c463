"""Measures of a tracked recording: the sensors' signals, static phases, headings, hinges, tips of limbs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel, BodyTable, HingeJoint
from ..body.covariance import compute_axis_std
from ..body.kinematics import Pose
from ..body.subject import Subject
from ..filters import Orientation
from ..recording import OrientationSensor, Recording
from ..recording.faults import find_saturation
from ..recording.gaps import find_runs
from ..recording.limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE
from ..recording.sensors import compute_rate
from .result import TrackResult
from .segment_orientations import compute_heading_variance

BENT = np.deg2rad(20.0)  # above which a hinge shows the plane in which it bends
PEAK_OVER_S = 0.1  # a tip's speed is that of its mean over so long


class Signal(NamedTuple):
    """One sensor's signal."""

    rate: np.ndarray  # (n,) [rad/s], how fast it turns
    cut: np.ndarray  # (n,) bool, an axis is cut off at the end of its range
    gap: np.ndarray  # (n,) bool, bridged over a long gap
    static: np.ndarray | None  # (n,) bool by the filter's test; None for measured orientations
    gravity: float  # [m/s²]
    bias: tuple[np.ndarray, np.ndarray] | None  # (3,) [rad/s] at the beginning and at the end


def measure_signal(
    recording: Recording, name: str, orientation: Orientation | None, static: np.ndarray | None, every: int
) -> Signal:
    """The signal of a sensor, with the results of its filter.

    Parameters
    ----------
    recording, static : with all samples, static (n,) bool
    every : samples that are shown as one: as their fastest, and as what any of them is, or all are static
    """
    sensor = recording.sensors[name]
    bins = np.arange(0, len(recording), every)
    nothing = np.zeros(len(recording), dtype=bool)
    gap = np.logical_or.reduceat(sensor.gap if sensor.gap is not None else nothing, bins)
    if isinstance(sensor, OrientationSensor) or orientation is None or static is None:
        rate = np.linalg.norm(compute_rate(sensor, recording.rate_hz), axis=1)
        return Signal(np.maximum.reduceat(rate, bins), nothing[bins], gap, None, float("nan"), None)
    cut = find_saturation(sensor.gyro_S, NARROWEST_GYRO_RANGE) | find_saturation(sensor.accel_S, NARROWEST_ACCEL_RANGE)
    return Signal(
        np.maximum.reduceat(np.linalg.norm(sensor.gyro_S, axis=1), bins),
        np.logical_or.reduceat(cut.any(axis=1), bins),
        gap,
        np.logical_and.reduceat(static, bins),
        orientation.noise.gravity,
        (orientation.noise.gyro_bias, orientation.gyro_bias[-1]),
    )


def finite_max(values: np.ndarray) -> float:
    """The largest of the finite values; NaN where there is none."""
    return float(np.max(values, initial=-np.inf, where=np.isfinite(values))) if np.isfinite(values).any() else np.nan


def finite_median(values: np.ndarray) -> float:
    """The median of the finite values; NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def find_samples_after_start(tracked: TrackResult) -> np.ndarray:
    """(n,) bool, the samples after the start pose, which the summaries of uncertainty are of.

    Before it the filters have not converged, and headings are extrapolated backwards.
    """
    since = tracked.time >= tracked.segments.start[1] - 1e-9
    return since if since.any() else ~since


def longest_run_s(mask: np.ndarray, rate_hz: float) -> float:
    """The longest run of true values [s]."""
    return max((b - a for a, b in find_runs(mask)), default=0) / rate_hz


def has_stated_mounts(tracked: TrackResult) -> bool:
    """Whether the mounts are the session's and not calibrated ones."""
    return not tracked.subject.mounts or tracked.recording.remounted


# Headings -------------------------------------------------------------------------------------------------------------


class Budget(NamedTuple):
    """The uncertainty of a segment's heading, one standard deviation [rad]."""

    std: np.ndarray  # (n,) with start pose, soft tissue and the heading correction
    drift: np.ndarray  # (n,) of the filter alone; with a heading correction at most what that leaves
    growth: float  # of the filter's, a minute of motion; NaN where it was never in motion


def compute_heading_uncertainties(tracked: TrackResult) -> dict[str, Budget]:
    """Segment → its budget, from the covariances; none where there is no filter, or it has none."""
    budgets = {}
    for name, cov_W in tracked.pose.segment_cov.items():
        orientation = tracked.segments.orientation.get(name)
        if orientation is None or orientation.attitude_cov is None:
            continue
        drift = np.sqrt(np.maximum(compute_heading_variance(orientation.quat_VS, orientation.attitude_cov), 0.0))
        first, last = float(drift[0]), float(drift[-1])
        minutes = float(np.count_nonzero(~orientation.static)) / tracked.recording.rate_hz / 60.0
        growth = max(last - first, 0.0) / minutes if minutes > 0.0 else float("nan")
        correction = tracked.correction
        if correction is not None and len(correction.time) and name in correction.segments:
            i = correction.segments.index(name)
            drift = np.minimum(drift, np.sqrt(np.interp(tracked.time, correction.time, correction.covariance[:, i, i])))
        budgets[name] = Budget(np.sqrt(np.maximum(cov_W[:, 2, 2], 0.0)), drift, growth)
    return budgets


def compute_joint_heading_stds(
    budgets: Mapping[str, Budget], model: BodyModel, part: Literal["std", "drift"] = "std"
) -> dict[str, np.ndarray]:
    """Joint → (n,) [rad], one standard deviation of the heading between its segments, as if they were independent.

    From the body outwards: all of a limb before the next. `part` "drift": without start pose and soft tissue.
    """
    stds = {}
    segments = [segment for segment, above in model.parents.items() if above is None]
    while segments:
        segment = segments.pop(0)
        segments = [*(each for each, above in model.parents.items() if above == segment), *segments]
        above = model.parents[segment]
        if above is not None and {above, segment} <= set(budgets):
            both = (getattr(budgets[name], part) for name in (above, segment))
            stds[model.table.joint_name(segment)] = np.hypot(*both)
    return stds


# Hinges ---------------------------------------------------------------------------------------------------------------


class HingeMotion(NamedTuple):
    """A hinge over time, from the directions of its two segments; NaN where one of them is not known."""

    bend: np.ndarray  # (n,) [rad] between the two, 0 in line
    std: np.ndarray | None  # (n,) [rad]; None where the filter has no covariance
    flexion: np.ndarray  # (n,) [rad], the bend in the plane of the hinge; negative: against the way it bends
    aside: np.ndarray  # (n,) [rad], the moving segment out of that plane


def find_flexion_sign(hinge: HingeJoint) -> float:
    """1 where a hinge bends by rotating about its axis, −1 where it does so against it: the wider end of its range."""
    return -1.0 if hinge.range[0] + hinge.range[1] < 0.0 else 1.0


def measure_hinge(pose: Pose, table: BodyTable, name: str, subject: Subject | None = None) -> HingeMotion | None:
    """A hinge of the table; None where a segment is not known. Without a calibrated axis it has that of the table."""
    hinge = table.hinges[name]
    names = hinge.on, hinge.moves
    if not set(names) <= set(pose.quat_WL):
        return None
    known: np.ndarray = np.all([np.isfinite(pose.quat_WL[segment]).all(axis=1) for segment in names], axis=0)
    if not known.any():
        return None
    R_on, R_moves = (_rotations(pose.quat_WL[segment], known) for segment in names)
    along_on, along_moves = (np.array(table.segments[segment].along) for segment in names)
    on_W, moves_W = R_on.apply(along_on), R_moves.apply(along_moves)
    across_W = np.cross(on_W, moves_W)
    sine = np.linalg.norm(across_W, axis=1)
    bend = np.arctan2(sine, np.sum(on_W * moves_W, axis=1))
    std = None
    if set(names) <= set(pose.segment_cov):
        # Only rotation errors about the axis across both segments change the angle.
        both = pose.segment_cov[names[0]] + pose.segment_cov[names[1]]
        across = across_W / np.maximum(sine, 1e-9)[:, None]
        std = np.sqrt(np.einsum("na,nab,nb->n", across, both, across))
    axis = np.array(hinge.axis)
    if subject is not None and name in subject.hinges:
        axis = subject.hinges[name].axis
    flexed = find_flexion_sign(hinge) * np.cross(axis, along_on)  # where the moving segment points at 90° of flexion
    moves_on = R_on.inv().apply(moves_W)
    flexion = np.arctan2(moves_on @ (flexed / np.linalg.norm(flexed)), moves_on @ along_on)
    aside = np.arcsin(np.clip(moves_on @ axis, -1.0, 1.0))
    for values in (bend, flexion, aside):
        values[~known] = np.nan
    return HingeMotion(bend, std, flexion, aside)


# Tips of limbs --------------------------------------------------------------------------------------------------------


class TipMotion(NamedTuple):
    """The motion of a point whose path is drawn, as of a hand."""

    reach: np.ndarray  # (n, 3) [m] from the origin of its limb, in the segment on which that hangs; NaN: not known
    std: np.ndarray | None  # (n,) [m], one axis, from the root; None where the filter has no covariance
    peak_speed: float  # [m/s]


def measure_tips(pose: Pose, rate_hz: float, table: BodyTable) -> dict[str, TipMotion]:
    """Point whose path is drawn → its motion; only points that are known."""
    tips = {}
    for name, limb in table.drawn_limbs.items():
        if not {name, *limb.origin} <= set(pose.points) or (limb.base is not None and limb.base not in pose.quat_WL):
            continue
        middle = np.mean([pose.points[point] for point in limb.origin], axis=0)
        reach = pose.points[name] - middle
        if limb.base is not None:
            known = np.isfinite(pose.quat_WL[limb.base]).all(axis=1)
            reach = _rotations(pose.quat_WL[limb.base], known).inv().apply(reach)
            reach[~known] = np.nan
        if not np.isfinite(reach).all(axis=1).any():
            continue
        size = max(1, round(PEAK_OVER_S * rate_hz))
        moved = reach[size:] - reach[:-size]
        peak = float(np.nan_to_num(np.linalg.norm(moved, axis=1)).max(initial=0.0)) * rate_hz / size
        std = compute_axis_std(pose.point_cov[name]) if name in pose.point_cov else None
        tips[name] = TipMotion(reach, std, peak)
    return tips


# All ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measures:
    """All measures of a tracked recording."""

    samples: int  # of the recording
    rate_hz: float  # of its samples
    steps_ms: tuple[float, float]  # shortest and longest step between samples
    signals: Mapping[str, Signal]  # of each sensor
    budgets: Mapping[str, Budget]  # of each segment's heading
    hinges: Mapping[str, HingeMotion]
    tips: Mapping[str, TipMotion]  # of each point whose path is drawn
    error_budget: Mapping[str, Mapping[str, float]]  # as `ErrorBudget.summarize`


def measure(
    tracked: TrackResult,
    recording: Recording,
    static: Mapping[str, np.ndarray],
    error_budget: Mapping[str, Mapping[str, float]],
    peak_speed: Mapping[str, float],
) -> Measures:
    """All measures of a recording.

    Parameters
    ----------
    tracked : the samples that are shown
    recording : with all samples, as `static`, segment → (n,) bool
    peak_speed : point → [m/s] of all samples, where fewer are shown
    """
    table, every = tracked.model.table, round(recording.rate_hz / tracked.recording.rate_hz)
    steps = 1e3 * np.diff(recording.time)
    subject = replace(tracked.subject, hinges=tracked.subject.turn_hinges(tracked.model))
    hinges = {name: measure_hinge(tracked.pose, table, name, subject) for name in table.hinges}
    tips = measure_tips(tracked.pose, tracked.recording.rate_hz, table)
    orientation = tracked.segments.orientation
    return Measures(
        len(recording),
        recording.rate_hz,
        (float(steps.min()), float(steps.max())),
        {
            name: measure_signal(recording, name, orientation.get(name), static.get(name), every)
            for name in recording.sensors
        },
        compute_heading_uncertainties(tracked),
        {name: motion for name, motion in hinges.items() if motion is not None},
        {name: tip._replace(peak_speed=peak_speed.get(name, tip.peak_speed)) for name, tip in tips.items()},
        error_budget,
    )


def _rotations(quat: np.ndarray, known: np.ndarray) -> Rotation:
    """Rotations of quaternions (n, 4), the identity where they are not `known`."""
    return Rotation.from_quat(np.where(known[:, None], quat, [0.0, 0.0, 0.0, 1.0]))
