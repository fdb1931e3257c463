"""Common parts of experiments: the alignment of headings, and decimated curves for charts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations

POINTS_DRAWN = 600


def align_rotation(R_VS: Rotation, R_WS: Rotation, where: np.ndarray) -> Rotation:
    """Rotate R_VS about the vertical so that its heading is that of R_WS at the samples `where`."""
    psi = rotations.heading((R_WS[where] * R_VS[where].inv()).mean().as_quat())
    return Rotation.from_rotvec([0.0, 0.0, float(psi)]) * R_VS


def decimate_curves(time: np.ndarray, **curves: np.ndarray) -> dict[str, list[float]]:
    """Decimate `time` (n,) [s] and curves (n,), and round them for a file."""
    stride = max(1, len(time) // POINTS_DRAWN)
    return {name: np.round(curve[::stride], 4).tolist() for name, curve in {"time": time, **curves}.items()}
