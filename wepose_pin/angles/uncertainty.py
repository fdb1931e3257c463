"""What the covariance of a pose makes of ranges and rates, which are of two samples with a common error."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.kinematics import Pose
from .joints import JOINTS, JointAngles, compute_gradients


def compute_summary_std(pose: Pose, name: str, joint: JointAngles, samples: np.ndarray) -> np.ndarray:
    """Compute the standard deviations of a joint's summaries, to first order; NaN where nothing is stated.

    Those of a range and of a rate are of two samples. Their error is taken once as constant in W, as that of a heading
    is, and once as constant in each segment, as that of a mount is; the larger standard deviation of the two counts.

    Parameters
    ----------
    samples : (s, 3, 4) of the pose, as `JointSummary` has them for each of s spans

    Returns
    -------
    np.ndarray
        (s, 3, 4), of the lowest, the highest and the range [rad], and of the peak rate [rad/s]
    """
    stds = np.full(samples.shape, np.nan)
    if joint.std is None:
        return stds
    for k in range(3):
        low, high, begin, end = samples[:, k].T
        known = np.flatnonzero(low >= 0)
        stds[known, k, 0], stds[known, k, 1] = joint.std[low[known], k], joint.std[high[known], k]
        stds[known, k, 2] = _difference_std(pose, name, joint, k, np.column_stack([low, high])[known])
        known = np.flatnonzero(begin >= 0)
        spans = pose.time[end[known]] - pose.time[begin[known]]
        stds[known, k, 3] = _difference_std(pose, name, joint, k, np.column_stack([begin, end])[known]) / spans
    return stds


def _difference_std(pose: Pose, name: str, joint: JointAngles, k: int, pairs: np.ndarray) -> np.ndarray:
    """Standard deviations (m,) [rad] of the k-th angle at the second sample of each pair (m, 2) less the first."""
    rows = compute_gradients(pose, name, joint, pairs.ravel())[:, k].reshape(-1, 2, 1, 3)
    constant_W, constant_L = np.zeros(len(pairs)), np.zeros(len(pairs))
    for segment in (JOINTS[name].proximal, JOINTS[name].distal):
        if segment == "world" or not len(pairs):
            continue
        cov_W = pose.segment_cov[segment][pairs]
        R_WL = Rotation.from_quat(pose.quat_WL[segment][pairs.ravel()]).as_matrix().reshape(-1, 2, 3, 3)
        constant_W += _compute_variance(rows, cov_W)
        constant_L += _compute_variance(rows @ R_WL, np.swapaxes(R_WL, 2, 3) @ cov_W @ R_WL)
    return np.asarray(np.sqrt(np.maximum(np.maximum(constant_W, constant_L), 0.0)))


def _compute_variance(rows: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Variance (m,) of the second value less the first: derivatives (m, 2, 1, 3), covariances (m, 2, 3, 3)."""
    difference = rows[:, 1] - rows[:, 0]
    return np.asarray((difference @ cov.mean(axis=1) @ np.swapaxes(difference, 1, 2))[:, 0, 0])
