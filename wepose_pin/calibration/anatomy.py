"""How limbs moved, and how a person's cannot move, which shows sensors that sit on other segments than stated.

Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
give the same gap. The solution's elbows then bend backward, or sideways. Any other exchange opens the chain.
Ranges of hinges are those of the body's table.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import ERROR, Diagnostic
from ..errors import BadSession
from ..observations.paths import find_path
from .conditions import Loop
from .result import Calibration

# Limits of a person's limbs, with soft tissue and headings some degrees off.
BACKWARD = 0.15  # share of samples out of a hinge's range
SIDEWAYS = np.deg2rad(14.0)  # [rad] rms of a segment off the plane in which it bends
BEHIND = 0.3  # share of samples with a point further than `BACK` [m] behind its limb's beginning
BACK = 0.1
OPEN = 0.06  # [m] rms of the gap
# [rad] by which segments turn at least, `measure_rotation`. Soft tissue alone gives people 4 deg, a minute of joined
# hands 36 to 39 deg.
LEAST_ROTATION = np.deg2rad(8.0)


class LimbMotion(NamedTuple):
    """How the limbs moved."""

    flexion: dict[str, np.ndarray]  # hinge → (n,) [rad] 0 straight, positive where it bends further
    contradiction: Diagnostic  # the value that is furthest beyond the limit of a person
    doubt: float  # its ratio to the limit; above 1 a person cannot move so


def measure_rotation(calibration: Calibration) -> float:
    """Return how far the segments turned [rad] while the closure held: the rms angle from their mean, median over them.

    NaN without a closure.
    """
    if not calibration.closed.any():
        return float("nan")
    R = [Rotation.from_quat(quat[calibration.closed]) for quat in calibration.quat_WL.values()]
    return float(np.median([np.sqrt(np.mean((each.mean().inv() * each).magnitude() ** 2)) for each in R]))


def measure_limbs(calibration: Calibration) -> LimbMotion:
    """Return how the limbs moved while the closure held; without a closure, in all samples."""
    table, closed = calibration.problem.model.table, calibration.closed
    rows = calibration.touching if closed.any() else np.ones(len(closed), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    gap = 0.0
    if closed.any():
        gap = float(np.sqrt(np.average(calibration.gap[closed] ** 2, weights=calibration.contact[closed])))
    # Variant of the text, the value, its limit and the joint.
    values = [("behind", _share_behind(calibration, R), BEHIND, ""), ("open", gap, OPEN, "")]
    flexion = {}
    for joint, hinge in table.hinges.items():
        if hinge.on in R and hinge.moves in R:
            straight, axis = np.array(table.segments[hinge.on].along), np.array(hinge.axis)
            along = (R[hinge.on].inv() * R[hinge.moves]).apply(table.segments[hinge.moves].along)
            angle = np.arctan2(np.cross(straight, along) @ axis, along @ straight)
            low, high = hinge.range
            values.append(("backwards", float(np.mean((angle < low) | (angle > high))), BACKWARD, joint))
            off_plane = float(np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along)))
            values.append(("sideways", off_plane, SIDEWAYS, joint))
            flexion[joint] = angle if high > -low else -angle
    variant, size, most, joint = max(values, key=lambda each: each[1] / each[2])
    facts: dict[str, float | str] = {"variant": variant, "size": size, "most": most}
    contradiction = Diagnostic("limb-motion-implausible", ERROR, joint, size / most, 1.0, facts)
    return LimbMotion(flexion, contradiction, size / most)


def reach_limbs(calibration: Calibration, R: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """Return the last point of a limb → vectors (n, 3) [m] in W from its first point, of limbs whose links are known.

    Parameters
    ----------
    R : segment → its orientations, n each
    """
    problem, reaches = calibration.problem, {}
    lengths = np.array([calibration.subject.lengths[name] for name in problem.model.lengths])
    for first, *_, last in problem.model.table.draw.limbs:
        try:
            vectors = find_path(problem.model, problem.start_pose, R, [(last, 1.0), (first, -1.0)]).vectors
        except BadSession:  # the limb's end is not known
            continue
        turned = [R[part.segment] * problem.start_rotation(part.segment).inv() for part in vectors]
        reaches[last] = np.sum([t.apply(part.vector(lengths)) for t, part in zip(turned, vectors, strict=True)], axis=0)
    return reaches


def _share_behind(calibration: Calibration, R: Mapping[str, Rotation]) -> float:
    """Return the largest share of samples in which a point is behind the segment in front of which it belongs."""
    shares, reaches = [0.0], reach_limbs(calibration, R)
    for loop in calibration.problem.conditions:
        if isinstance(loop, Loop) and loop.closure.in_front_of in R:
            to_segment = R[loop.closure.in_front_of].inv()
            forwards = [to_segment.apply(reaches[point])[:, 0] for point in loop.closure.points if point in reaches]
            shares += [float(np.mean(x < -BACK)) for x in forwards]
    return max(shares)


def diagnose_labels(calibration: Calibration, contradiction: Diagnostic) -> Diagnostic:
    """Return the sensors that sit on other segments, or else the contradiction to a person's limbs."""
    moved, order = calibration.exchanged, list(calibration.problem.model.table.segments)
    if not moved:
        return contradiction
    pairs = {tuple(sorted(pair, key=order.index)) for pair in moved.items()}
    place = ", ".join(f"{a} and {b}" for a, b in sorted(pairs))
    facts = {"variant": "sides"} if len(pairs) > 1 else {}
    return Diagnostic("sensors-exchanged", ERROR, place, contradiction.value, 1.0, facts)
