"""C3D: the points, in mm, by ezc3d.

Source: The C3D File Format user guide (c3d.org), parameters POINT:UNITS, RATE, X_SCREEN, Y_SCREEN; a residual of −1
marks a point that is not valid.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import BadOption
from .motion import Motion, even, seen_points


def write_c3d(path: Path, motion: Motion) -> list[str]:
    """Points in W (z up, x forward), single precision. A point in a gap is NaN with a residual of −1.

    Raises
    ------
    BadOption
        ezc3d is not installed.
    BadData
        No point is known.
    """
    try:
        import ezc3d
    except ImportError:
        raise BadOption("--format c3d: needs ezc3d, which is not installed: pip install 'wepose-pin[export]'") from None
    motion, notes = even(motion)
    points = seen_points(motion)
    p_W = np.stack([p.T for p in points.values()], axis=1)  # (3, points, n)
    file = ezc3d.c3d()
    parameters = file["parameters"]["POINT"]
    parameters["UNITS"]["value"] = ["mm"]
    parameters["RATE"]["value"] = [motion.rate_hz]
    parameters["LABELS"]["value"] = list(points)
    parameters["DESCRIPTIONS"]["value"] = [f"{point.replace('_', ' ')} of {motion.name}"[:127] for point in points]
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    file["data"]["points"] = np.concatenate([1e3 * p_W, np.ones((1, *p_W.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(np.isfinite(p_W).all(axis=0), 0.0, -1.0)[None]
    named = path.with_name(f"{path.name}.c3d")  # ezc3d adds the suffix where it is missing
    try:
        file.write(str(named))
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)
    return notes
