"""What joint angles come to: range of motion and peak rates; and the columns of a file, in degrees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..body.kinematics import Pose
from .joints import JOINTS, Angles, JointAngles, compute_gradients

# Rates are means over this time [s], to the nearest whole number of samples: noise of the orientation is divided by it,
# and a sine of 2 Hz reads 1.6% low, one of 5 Hz 10%.
RATE_WINDOW_S = 0.05


class JointSummary(NamedTuple):
    """One joint over a recording; the three angles in the order of its `names`. NaN where no sample is left.

    Gaps count nowhere; what is near the lock counts in the lowest and highest of the second angle.
    """

    lowest: np.ndarray  # (3,) [rad]
    highest: np.ndarray  # (3,) [rad]
    peak_rate: np.ndarray  # (3,) [rad/s], the greatest absolute rate of the angle over `RATE_WINDOW_S`
    near_lock: float  # share of the samples
    gap: float  # share of the samples
    samples: np.ndarray  # (3, 4) int: of the lowest, the highest, begin and end of the fastest; −1 where there is none

    @property
    def range(self) -> np.ndarray:
        """Range of motion (3,) [rad]; there is no more than a full turn of it."""
        return np.minimum(self.highest - self.lowest, 2.0 * np.pi)


def summary(angles: Angles) -> dict[str, JointSummary]:
    """Range of motion and peak rates of every joint."""
    return {name: summarize_joint(angles.time, joint) for name, joint in angles.joints.items()}


def summarize_joint(time: np.ndarray, joint: JointAngles, part: slice = slice(None)) -> JointSummary:
    """Range of motion and peak rates of one joint in a part of the samples; `time` (n,) [s]."""
    time, values, gap, near_lock = time[part], joint.values[part], joint.gap[part], joint.near_lock[part]
    start = part.start or 0
    m = max(1, round(RATE_WINDOW_S / float(np.median(np.diff(time))))) if len(time) > 1 else 1
    span = time[m:] - time[:-m]
    lowest, highest, peak_rate = (np.full(3, np.nan) for _ in range(3))
    samples = np.full((3, 4), -1)
    bad = np.concatenate([[0], np.cumsum(gap | near_lock)])
    sound = np.flatnonzero(bad[m + 1 :] == bad[: -m - 1])  # none of the samples k … k + m is bad
    for k in range(3):
        usable = np.flatnonzero(~joint.hidden(k)[part])
        if len(usable):
            ends = usable[[values[usable, k].argmin(), values[usable, k].argmax()]]
            lowest[k], highest[k] = values[ends, k]
            samples[k, :2] = start + ends
        if len(sound):
            rates = np.abs(values[m:, k] - values[:-m, k])[sound] / span[sound]
            first = start + sound[rates.argmax()]
            samples[k, 2:] = first, first + m
            peak_rate[k] = rates.max()
    return JointSummary(lowest, highest, peak_rate, float(np.mean(near_lock)), float(np.mean(gap)), samples)


def compute_summary_std(pose: Pose, name: str, joint: JointAngles, samples: np.ndarray) -> np.ndarray:
    """Compute the standard deviations of a joint's summaries, to first order; NaN where nothing is stated.

    A range and a rate are of two samples. Their error is taken once as constant in W, as that of a heading, and once as
    constant in each segment, as that of a mount; the larger standard deviation of the two counts. `samples` (s, 3, 4)
    are those of `JointSummary` for each of s spans; of the same shape are the results: of the lowest, the highest and
    the range [rad], and of the peak rate [rad/s].
    """
    stds = np.full(samples.shape, np.nan)
    if joint.std is None:
        return stds
    for k in range(3):
        for column, ends in ((2, [0, 1]), (3, [2, 3])):
            known = np.flatnonzero(samples[:, k, ends[0]] >= 0)
            pairs = samples[known, k][:, ends]
            stds[known, k, column] = _difference_std(pose, name, joint, k, pairs)
            if column == 2:
                stds[known, k, :2] = joint.std[pairs, k]
            else:
                stds[known, k, 3] /= pose.time[pairs[:, 1]] - pose.time[pairs[:, 0]]
    return stds


def _difference_std(pose: Pose, name: str, joint: JointAngles, k: int, pairs: np.ndarray) -> np.ndarray:
    """Standard deviations (m,) [rad] of the k-th angle at the second sample of each pair (m, 2) less the first."""
    rows = compute_gradients(pose, name, joint, pairs.ravel())[:, k].reshape(-1, 2, 1, 3)
    variances = np.zeros((2, len(pairs)))  # constant in W, in L
    for segment in (JOINTS[name].proximal, JOINTS[name].distal):
        if segment == "world" or not len(pairs):
            continue
        cov_W = pose.segment_cov[segment][pairs]
        R_WL = Rotation.from_quat(pose.quat_WL[segment][pairs.ravel()]).as_matrix().reshape(-1, 2, 3, 3)
        frames = (rows, cov_W), (rows @ R_WL, np.swapaxes(R_WL, 2, 3) @ cov_W @ R_WL)
        for variance, (gradient, cov) in zip(variances, frames, strict=True):
            difference = gradient[:, 1] - gradient[:, 0]
            variance += (difference @ cov.mean(axis=1) @ np.swapaxes(difference, 1, 2))[:, 0, 0]
    return np.asarray(np.sqrt(np.maximum(variances.max(axis=0), 0.0)))


def summary_table(angles: Angles) -> pl.DataFrame:
    """`summary` in degrees, a row an angle; values of the joint are in each of its three rows."""
    return pl.DataFrame(
        {
            "joint": name,
            "angle": angle,
            "lowest_deg": np.degrees(ranges.lowest[k]),
            "highest_deg": np.degrees(ranges.highest[k]),
            "range_deg": np.degrees(ranges.range[k]),
            "peak_rate_deg_s": np.degrees(ranges.peak_rate[k]),
            "joint_near_lock": ranges.near_lock,
            "joint_gap": ranges.gap,
        }
        for name, ranges in summary(angles).items()
        for k, angle in enumerate(angles[name].names)
    )


def angle_table(angles: Angles) -> pl.DataFrame:
    """The columns of a file.

    ``time`` [s]; for each joint ``<joint>_<angle>_deg`` of its three angles, such as ``right_elbow_flexion_deg``, and
    ``<joint>_<angle>_std_deg`` where known; ``<joint>_gimbal_deg``, ``<joint>_near_lock``, ``<joint>_gap``; and the
    rotation itself, ``<joint>_qx,_qy,_qz,_qw``.
    """
    table = {"time": angles.time}
    for name, joint in angles.joints.items():
        for k, angle in enumerate(joint.names):
            table[f"{name}_{angle}_deg"] = np.degrees(joint.values[:, k])
            if joint.std is not None:
                table[f"{name}_{angle}_std_deg"] = np.degrees(joint.std[:, k])
        table[f"{name}_gimbal_deg"] = np.degrees(joint.gimbal)
        table[f"{name}_near_lock"] = joint.near_lock
        table[f"{name}_gap"] = joint.gap
        table |= {f"{name}_{c}": joint.quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
    return pl.DataFrame(table)
