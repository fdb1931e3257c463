"""C3D: the points, in mm, by ezc3d.

Source: The C3D File Format user guide (c3d.org), parameters POINT:UNITS, RATE, X_SCREEN, Y_SCREEN; a residual of −1
marks a point that is not valid.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..diagnostics import Diagnostic
from ..errors import BadData, BadOption, ExistingOutput
from .motion import Motion, find_measured_points, resample_evenly

MOST_FRAMES = 65535  # of the header's 16 bits: readers cut the rest off in silence


def write_c3d(path: Path, motion: Motion) -> list[Diagnostic]:
    """Points in W (z up, x forward), single precision. A point in a gap is NaN with a residual of −1.

    Raises
    ------
    BadOption
        ezc3d is not installed.
    BadData
        No point is known, or there are more frames than the format counts.
    ExistingOutput
        It cannot be written whole.
    """
    try:
        import ezc3d
    except ImportError:
        raise BadOption("--format c3d: needs ezc3d, which is not installed: pip install 'wepose-pin[export]'") from None
    motion, diagnostics = resample_evenly(motion)
    points = find_measured_points(motion)
    n = len(motion.pose.time)
    if n > MOST_FRAMES:
        rate_hz = np.floor(motion.rate_hz * MOST_FRAMES / n)
        raise BadData(
            f"{motion.where}: {n} samples; a .c3d holds {MOST_FRAMES}, which --rate-hz {rate_hz:g} makes fewer than; "
            f"a .trc holds all"
        )
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
        _check(named, p_W.shape[1] * p_W.shape[2])
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)
    return diagnostics


def _check(file: Path, points: int) -> None:
    """Raise an error on a truncated file: ezc3d does not report a full disk."""
    with file.open("rb") as opened:
        first_block = int.from_bytes(opened.read(18)[16:], "little")  # word 9 of the header, counted from 1
    if file.stat().st_size < 512 * (first_block - 1) + 16 * points:
        raise ExistingOutput(f"{file.name}: cannot be written whole; is the disk full? nothing was written")
