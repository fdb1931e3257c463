"""Measures of a tracked recording's report: the sensors' signals, static phases, headings, elbows, hands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..kinematics import Pose, compute_axis_std
from ..recording import OrientationSensor, Recording
from ..recording.gaps import find_runs
from ..recording.limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE
from ..recording.plausibility import find_cut_off
from ..subject import Subject
from ..tracking import TrackedRecording

# Segments that meet in a joint, from the trunk outwards: their headings make an angle of that joint.
JOINTS = (
    ("neck", "torso", "head"),
    ("waist", "pelvis", "torso"),
    *(
        (f"{side} {joint}", "torso" if above == "torso" else f"{side}_{above}", f"{side}_{below}")
        for side in ("left", "right")
        for joint, above, below in (
            ("shoulder", "torso", "upper_arm"),
            ("elbow", "upper_arm", "forearm"),
            ("wrist", "forearm", "hand"),
        )
    ),
)
BENT = np.deg2rad(20.0)  # above which a forearm shows the plane of its elbow
PEAK_OVER_S = 0.1  # a hand's speed is that of its mean over so long


class Signal(NamedTuple):
    """One sensor's signal."""

    rate: np.ndarray  # (n,) [rad/s], how fast it turns
    peak_accel: float  # [m/s²], NaN for measured orientations
    cut: np.ndarray  # (n,) bool, an axis is cut off at the end of its range
    gap: np.ndarray  # (n,) bool, bridged over a long gap
    static: np.ndarray | None  # (n,) bool by the filter's test; None for measured orientations
    gyro_noise: float  # [rad/s], root mean square of an axis in the static phase
    accel_noise: float  # [m/s²], the same
    gravity: float  # [m/s²]
    bias: tuple[np.ndarray, np.ndarray] | None  # (3,) [rad/s] at the beginning and at the end


def measure_signal(recording: Recording, name: str, tracked: TrackedRecording) -> Signal:
    """The signal of a sensor, with the results of its filter."""
    sensor = recording.sensors[name]
    nothing = np.zeros(len(recording), dtype=bool)
    gap = sensor.gap if sensor.gap is not None else nothing
    if isinstance(sensor, OrientationSensor):
        R = Rotation.from_quat(sensor.quat_WS)
        rate = (R[:-1].inv() * R[1:]).magnitude() * recording.rate_hz
        nan = float("nan")
        return Signal(np.concatenate([rate[:1], rate]), nan, nothing, gap, None, nan, nan, nan, None)
    orientation = tracked.segments.orientation[name]
    cut = find_cut_off(sensor.gyro_S, NARROWEST_GYRO_RANGE) | find_cut_off(sensor.accel_S, NARROWEST_ACCEL_RANGE)
    return Signal(
        np.linalg.norm(sensor.gyro_S, axis=1),
        float(np.linalg.norm(sensor.accel_S, axis=1).max()),
        cut.any(axis=1),
        gap,
        orientation.static,
        _rms(orientation.noise.gyro_cov),
        orientation.noise.gravity * _rms(orientation.noise.accel_cov),
        orientation.noise.gravity,
        (orientation.noise.gyro_bias, orientation.gyro_bias[-1].copy()),  # a view would keep the whole run
    )


def finite_max(values: np.ndarray) -> float:
    """The largest of the finite values; NaN where there is none."""
    return float(np.max(values, initial=-np.inf, where=np.isfinite(values))) if np.isfinite(values).any() else np.nan


def finite_median(values: np.ndarray) -> float:
    """The median of the finite values; NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def find_samples_after_start(tracked: TrackedRecording) -> np.ndarray:
    """(n,) bool, the samples after the start pose, which the summaries of uncertainty are of.

    Before it the filters have not converged, and headings are extrapolated backwards.
    """
    since = tracked.time >= tracked.segments.start[1] - 1e-9
    return since if since.any() else ~since


def longest_run_s(mask: np.ndarray, rate_hz: float) -> float:
    """The longest run of true values [s]."""
    return max((b - a for a, b in find_runs(mask)), default=0) / rate_hz


def has_stated_mounts(tracked: TrackedRecording) -> bool:
    """Whether the mounts are the session's and not calibrated ones."""
    return not tracked.subject.mounts or tracked.recording.remounted


@dataclass(frozen=True)
class Measures:
    """All measures of a tracked recording.

    Parameters
    ----------
    signals : sensor → its signal
    budgets : segment → the uncertainty of its heading
    elbows : side → its elbow
    hands : point → the motion of the hand
    """

    signals: Mapping[str, Signal]
    budgets: Mapping[str, Budget]
    elbows: Mapping[str, Elbow]
    hands: Mapping[str, Hand]


# Headings -------------------------------------------------------------------------------------------------------------


class Budget(NamedTuple):
    """The uncertainty of a segment's heading, one standard deviation [rad]."""

    std: np.ndarray  # (n,) with the start pose and the heading correction
    filter_end: float  # of the filter alone, at the end
    growth: float  # of the filter's, a minute of motion; NaN where it was never in motion


def compute_heading_uncertainties(tracked: TrackedRecording) -> dict[str, Budget]:
    """Segment → its budget, from the covariances; none where the filter has none."""
    budgets = {}
    for name, cov_W in tracked.pose.segment_cov.items():
        orientation = tracked.segments.orientation[name]
        if orientation.attitude_cov is None:
            continue
        ends = np.array([0, -1])
        up_S = Rotation.from_quat(orientation.quat_WS[ends]).inv().apply([0.0, 0.0, 1.0])
        variance = np.einsum("na,nab,nb->n", up_S, orientation.attitude_cov[ends], up_S)
        first, last = np.sqrt(np.maximum(variance, 0.0))
        minutes = float(np.count_nonzero(~orientation.static)) / tracked.recording.rate_hz / 60.0
        growth = max(float(last - first), 0.0) / minutes if minutes > 0.0 else float("nan")
        budgets[name] = Budget(np.sqrt(np.maximum(cov_W[:, 2, 2], 0.0)), float(last), growth)
    return budgets


def compute_joint_heading_stds(budgets: Mapping[str, Budget]) -> dict[str, np.ndarray]:
    """Joint → (n,) [rad], one standard deviation of the heading between its segments, as if they were independent."""
    return {
        joint: np.hypot(budgets[above].std, budgets[below].std)
        for joint, above, below in JOINTS
        if above in budgets and below in budgets
    }


# Elbows ---------------------------------------------------------------------------------------------------------------


class Elbow(NamedTuple):
    """An elbow over time, from the directions of upper arm and forearm; NaN where one of them is not known."""

    bend: np.ndarray  # (n,) [rad] between the two, 0 in line
    std: np.ndarray | None  # (n,) [rad]; None where the filter has no covariance
    forward: np.ndarray  # (n,) [rad], the bend in the plane of the hinge; negative: backward
    aside: np.ndarray  # (n,) [rad], the forearm out of that plane


def measure_elbow(pose: Pose, side: str, subject: Subject | None = None) -> Elbow | None:
    """An elbow; None where a segment is not known. Without a calibrated hinge its axis is the upper arm's y."""
    names = f"{side}_upper_arm", f"{side}_forearm"
    if not set(names) <= set(pose.quat_WL):
        return None
    known: np.ndarray = np.all([np.isfinite(pose.quat_WL[name]).all(axis=1) for name in names], axis=0)
    if not known.any():
        return None
    R_U, R_F = (_rotations(pose.quat_WL[name], known) for name in names)
    upper_W, fore_W = (R.apply([0.0, 0.0, -1.0]) for R in (R_U, R_F))
    axis_W = np.cross(upper_W, fore_W)
    sine = np.linalg.norm(axis_W, axis=1)
    bend = np.arctan2(sine, np.sum(upper_W * fore_W, axis=1))
    std = None
    if set(names) <= set(pose.segment_cov):
        # Only rotation errors about the axis across both segments change the angle.
        both = pose.segment_cov[names[0]] + pose.segment_cov[names[1]]
        along = axis_W / np.maximum(sine, 1e-9)[:, None]
        std = np.sqrt(np.einsum("na,nab,nb->n", along, both, along))
    axis_U = np.array([0.0, 1.0, 0.0])
    if subject is not None and f"{side}_elbow" in subject.hinges:
        axis_U = subject.hinges[f"{side}_elbow"].axis
    ahead_U = np.cross(axis_U, [0.0, 0.0, 1.0])
    fore_U = R_U.inv().apply(fore_W)
    forward = np.arctan2(fore_U @ (ahead_U / np.linalg.norm(ahead_U)), -fore_U[:, 2])
    aside = np.arcsin(np.clip(fore_U @ axis_U, -1.0, 1.0))
    for values in (bend, forward, aside):
        values[~known] = np.nan
    return Elbow(bend, std, forward, aside)


# Hands ----------------------------------------------------------------------------------------------------------------


class Hand(NamedTuple):
    """The motion of a hand."""

    reach: np.ndarray  # (n, 3) [m] from the middle of the shoulders, in the torso's frame; NaN where not known
    std: np.ndarray | None  # (n,) [m], one axis, from the root; None where the filter has no covariance
    peak_speed: float  # [m/s]


def measure_hands(pose: Pose, rate_hz: float) -> dict[str, Hand]:
    """Point → motion of the hand; only hands that are known."""
    points = pose.points
    if not {"left_shoulder", "right_shoulder"} <= set(points) or "torso" not in pose.quat_WL:
        return {}
    middle = 0.5 * (points["left_shoulder"] + points["right_shoulder"])
    known = np.isfinite(pose.quat_WL["torso"]).all(axis=1)
    R_LW = _rotations(pose.quat_WL["torso"], known).inv()
    hands = {}
    for name in ("left_palm", "right_palm"):
        if name not in points:
            continue
        reach = R_LW.apply(points[name] - middle)
        reach[~known] = np.nan
        if not np.isfinite(reach).all(axis=1).any():
            continue
        size = max(1, round(PEAK_OVER_S * rate_hz))
        moved = reach[size:] - reach[:-size]
        peak = float(np.nan_to_num(np.linalg.norm(moved, axis=1)).max(initial=0.0)) * rate_hz / size
        std = compute_axis_std(pose.point_cov[name]) if name in pose.point_cov else None
        hands[name] = Hand(reach, std, peak)
    return hands


def _rotations(quat: np.ndarray, known: np.ndarray) -> Rotation:
    """Rotations of quaternions (n, 4), the identity where they are not `known`."""
    return Rotation.from_quat(np.where(known[:, None], quat, [0.0, 0.0, 0.0, 1.0]))


def _rms(cov: np.ndarray) -> float:
    return float(np.sqrt(np.trace(cov) / 3.0))
