"""What the covariance of a pose makes of ranges and rates, which are of two samples with a common error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..kinematics import Pose
from .joints import JOINTS, JointAngles, compute_gradients
from .tables import JointSummary


class SummaryStd(NamedTuple):
    """Standard deviations of a `JointSummary`, each (3,), to first order; NaN where nothing is stated."""

    lowest: np.ndarray  # [rad]
    highest: np.ndarray  # [rad]
    range: np.ndarray  # [rad]
    peak_rate: np.ndarray  # [rad/s]


def compute_summary_std(pose: Pose, name: str, joint: JointAngles, summary: JointSummary) -> SummaryStd:
    """Compute the standard deviations of a joint's extremes, ranges and peak rates.

    Those of a range and of a rate are of two samples. Their error is taken once as constant in W, as that of a heading
    is, and once as constant in each segment, as that of a mount is; the larger standard deviation of the two counts.

    Parameters
    ----------
    pose, joint, summary : of the same samples
    """
    stds = SummaryStd(*(np.full(3, np.nan) for _ in range(4)))
    if joint.std is None:
        return stds
    for k, (low, high, begin, end) in enumerate(summary.samples):
        if low >= 0:
            stds.lowest[k], stds.highest[k] = joint.std[[low, high], k]
            stds.range[k] = _difference_std(pose, name, joint, k, np.array([low, high]))
        if begin >= 0:
            span = pose.time[end] - pose.time[begin]
            stds.peak_rate[k] = _difference_std(pose, name, joint, k, np.array([begin, end])) / span
    return stds


def _difference_std(pose: Pose, name: str, joint: JointAngles, k: int, samples: np.ndarray) -> float:
    """Standard deviation [rad] of the k-th angle at the second sample less that at the first."""
    rows = compute_gradients(pose, name, joint, samples)[:, k]  # (2, 3)
    constant_W = constant_L = 0.0
    for segment in (JOINTS[name].proximal, JOINTS[name].distal):
        if segment == "world":
            continue
        cov_W = pose.segment_cov[segment][samples]
        R_WL = Rotation.from_quat(pose.quat_WL[segment][samples]).as_matrix()
        cov_L = np.swapaxes(R_WL, 1, 2) @ cov_W @ R_WL
        by_W, by_L = rows[1] - rows[0], rows[1] @ R_WL[1] - rows[0] @ R_WL[0]
        constant_W += float(by_W @ cov_W.mean(axis=0) @ by_W)
        constant_L += float(by_L @ cov_L.mean(axis=0) @ by_L)
    return float(np.sqrt(max(constant_W, constant_L, 0.0)))
