"""The low-pass of a pose: on orientations, so that gimbal lock and full turns of angles play no part in it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..body.kinematics import Pose
from ..errors import WrongOption
from ..filters.butterworth import low_pass
from ..recording.gaps import find_runs
from ..rotations import unwrap_signs

# A longer time step than this many usual ones ends a run: the samples on its two sides are filtered apart.
_LONGEST_STEP = 1.5
_SHORTEST_RUN = 10  # samples; a shorter run is not filtered


def smooth_pose(pose: Pose, cutoff_hz: float) -> Pose:
    """Return the pose with orientations low-passed by a Butterworth filter of second order, forwards and backwards.

    Nothing is delayed; at `cutoff_hz` the two passes together halve the amplitude (−6 dB). Filtered are the components
    of the quaternions, which are normalised afterwards. Points, covariances and gaps stay.

    Raises
    ------
    WrongOption
        The cut-off is not above 0 and below 0.45 of the sampling rate.
    """
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 1.0
    if not 0.0 < cutoff_hz < 0.45 / step:
        raise WrongOption("low-pass-hz", f"{cutoff_hz:g}", f"above 0 and below {0.45 / step:.3g} Hz is needed here")
    even = np.concatenate([[True], np.diff(pose.time) < _LONGEST_STEP * step])
    quat_WL = {}
    for segment, quat in pose.quat_WL.items():
        smooth = quat.copy()
        for first, last in find_runs(np.isfinite(quat).all(axis=1)):
            starts = [first, *(first + 1 + np.flatnonzero(~even[first + 1 : last])), last]
            for a, b in pairwise(starts):
                if b - a >= _SHORTEST_RUN:
                    filtered = low_pass(unwrap_signs(quat[a:b]), cutoff_hz, 1.0 / step)
                    smooth[a:b] = filtered / np.linalg.norm(filtered, axis=1, keepdims=True)
        quat_WL[segment] = smooth
    return replace(pose, quat_WL=quat_WL, q=None)
