"""What experiments share: the one alignment of headings, and curves thin enough to draw."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations

POINTS_DRAWN = 600


def align_rotation(R_VS: Rotation, R_WS: Rotation, where: np.ndarray) -> Rotation:
    """R_VS turned about the vertical such that its heading is that of R_WS where `where`."""
    psi = rotations.heading((R_WS[where] * R_VS[where].inv()).mean().as_quat())
    return Rotation.from_rotvec([0.0, 0.0, float(psi)]) * R_VS


def decimate_curves(time: np.ndarray, **curves: np.ndarray) -> dict[str, list[float]]:
    """`time` (n,) [s] and curves (n,), every so many samples, rounded for a file."""
    stride = max(1, len(time) // POINTS_DRAWN)
    return {name: np.round(curve[::stride], 4).tolist() for name, curve in {"time": time, **curves}.items()}
