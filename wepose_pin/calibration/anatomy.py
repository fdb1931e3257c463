"""How limbs moved, and how a person's cannot move, which shows sensors that sit on other segments than stated.

Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
give the same gap. The solution's elbows then bend backward, or sideways. Any other exchange opens the chain.
Ranges of hinges are those of the body's table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import HingeJoint
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

    flexion: dict[str, np.ndarray]  # hinge → (n,) [deg] 0 straight, positive where it bends further
    doubts: tuple[Diagnostic, ...]  # what shows whether a person can move so, each with its limit
    gap: float  # [m] rms

    @property
    def contradiction(self) -> Diagnostic:
        """The value that is furthest beyond its limit."""
        return max(self.doubts, key=lambda each: float(each.value or 0.0))

    @property
    def doubt(self) -> float:
        """The largest ratio of a value to its limit; above 1 a person cannot move so."""
        return float(self.contradiction.value or 0.0)


def _diagnose_motion(variant: str, size: float, most: float, joint: str = "") -> Diagnostic:
    """Return the diagnostic of a value, [SI], of which a person has at most `most`; its own value is their ratio."""
    facts: dict[str, float | str] = {"variant": variant, "size": size, "most": most}
    return Diagnostic("limb-motion-implausible", ERROR, joint, size / most, 1.0, facts)


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
    behind = _share_behind(calibration, R)
    doubts = [_diagnose_motion("behind", behind, BEHIND), _diagnose_motion("open", gap, OPEN)]
    flexion = {}
    for joint, hinge in table.hinges.items():
        if hinge.on not in R or hinge.moves not in R:
            continue
        along = (R[hinge.on].inv() * R[hinge.moves]).apply(table.segments[hinge.moves].along)
        angle = compute_hinge_angles(hinge, table.segments[hinge.on].along, along)
        low, high = hinge.range
        backward = float(np.mean((angle < low) | (angle > high)))
        sideways = float(np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along)))
        doubts.append(_diagnose_motion("backwards", backward, BACKWARD, joint))
        doubts.append(_diagnose_motion("sideways", sideways, SIDEWAYS, joint))
        flexion[joint] = np.degrees(angle if high > -low else -angle)
    return LimbMotion(flexion, tuple(doubts), gap)


def compute_hinge_angles(hinge: HingeJoint, along_on: Sequence[float], along: np.ndarray) -> np.ndarray:
    """Return angles (n,) [rad] about a hinge's axis from the long axis of `on` to `along` (n, 3) in its frame."""
    straight, axis = np.array(along_on), np.array(hinge.axis)
    return np.arctan2(np.cross(straight, along) @ axis, along @ straight)


def reach_limbs(calibration: Calibration, R: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """Return the last point of a limb → vectors (n, 3) [m] in W from its first point, of limbs whose links are known.

    Parameters
    ----------
    R : segment → its orientations, n each
    """
    problem, reaches = calibration.problem, {}
    lengths = np.array([calibration.subject.lengths[name] for name in problem.model.lengths])
    for first, *_, last in problem.model.table.limbs:
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
    problem, moved = calibration.problem, calibration.exchanged
    if not moved:
        return contradiction
    place = ", ".join(f"{label} sits on the {place}" for place, label in sorted(moved.items()))
    variant, table = {"variant": "mixed"}, problem.model.table
    if all(moved[b] == a for a, b in moved.items()):  # pairs of sensors, exchanged
        order = list(table.segments)
        pairs = {tuple(sorted(pair, key=order.index)) for pair in moved.items()}
        place = ", ".join(f"{a} and {b}" for a, b in sorted(pairs))
        places = set(problem.sensors) & set(table.needed)
        sides = {(left, right) for left, right in table.pairs.items() if {left, right} <= places}
        variant = {"variant": "sides"} if pairs == sides else {}
    return Diagnostic("sensors-exchanged", ERROR, place, contradiction.value, 1.0, variant)
