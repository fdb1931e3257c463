"""Limits of a person's limbs, which show sensors that sit on other segments than the session says.

Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
give the same gap. The solution's elbows then bend backward, or sideways. Any other exchange opens the chain. Where the
stated labels contradict anatomy, all others are tried: first which of them close the chain, then which of these have
the limbs of a person. Ranges of hinges are those of the body's table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyTable, HingeJoint
from ..diagnostics import ERROR, Diagnostic
from ..errors import BadSession
from ..observations.paths import find_path
from .conditions import Loop
from .result import Calibration, LabelCheck

# Limits of a person's limbs, with soft tissue and headings some degrees off.
BACKWARD = 0.15  # share of samples out of a hinge's range
SIDEWAYS_DEG = 14.0  # rms of a segment off the plane in which it bends
BEHIND = 0.3  # share of samples with a point further than `BACK` [m] behind its limb's beginning
BACK = 0.1
OPEN = 0.06  # [m] rms of the gap
# [rad] by which segments turn at least, `measure_rotation`. Soft tissue alone gives people 4 deg, a minute of joined
# hands 36 to 39 deg.
LEAST_ROTATION = np.deg2rad(8.0)
BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


class LimbMotion(NamedTuple):
    """How the limbs moved; angles [deg], shares of samples."""

    flexion: dict[str, np.ndarray]  # hinge → (n,) 0 straight, positive where it bends further
    backward: dict[str, float]  # hinge → share of samples out of its range
    sideways: dict[str, float]  # hinge → rms of the segment off the plane in which it bends
    behind: float  # share of samples with a point behind the segment in front of which it is
    gap: float  # [m] rms

    def doubt(self) -> float:
        """The largest ratio of a value to its limit; above 1 a person cannot move so."""
        return max(doubt for doubt, _ in self._doubts())

    def contradiction(self) -> Diagnostic:
        """The value that is furthest beyond its limit."""
        return max(self._doubts(), key=lambda pair: pair[0])[1]

    def _doubts(self) -> list[tuple[float, Diagnostic]]:
        """The ratio of each value to its limit, and its diagnostic."""
        values = [
            ("calibration-points-behind", "", self.behind, BEHIND),
            ("calibration-chain-open", "", self.gap, OPEN),
        ]
        values += [("calibration-hinge-backward", joint, v, BACKWARD) for joint, v in self.backward.items()]
        doubts = [(value / limit, Diagnostic(code, ERROR, place, value, limit)) for code, place, value, limit in values]
        for joint, angle in self.sideways.items():
            sideways = np.deg2rad([angle, SIDEWAYS_DEG]).tolist()
            code = "calibration-hinge-sideways"
            doubts.append((angle / SIDEWAYS_DEG, Diagnostic(code, ERROR, joint, *sideways)))
        return doubts


def measure_rotation(calibration: Calibration) -> float:
    """How far the segments turned [rad] while the closure held: the rms angle from their mean, median over them.

    NaN without a closure.
    """
    if not calibration.closed.any():
        return float("nan")
    R = [Rotation.from_quat(quat[calibration.closed]) for quat in calibration.quat_WL.values()]
    return float(np.median([np.sqrt(np.mean((each.mean().inv() * each).magnitude() ** 2)) for each in R]))


def measure_limbs(calibration: Calibration) -> LimbMotion:
    """How the limbs moved while the closure held; without a closure, in all samples."""
    table, closed = calibration.problem.model.table, calibration.closed
    rows = calibration.touching if closed.any() else np.ones(len(closed), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    flexion, backward, sideways = {}, {}, {}
    for joint, hinge in table.hinges.items():
        if hinge.on not in R or hinge.moves not in R:
            continue
        along = (R[hinge.on].inv() * R[hinge.moves]).apply(table.segments[hinge.moves].along)
        angle = np.degrees(compute_hinge_angles(hinge, table.segments[hinge.on].along, along))
        low, high = np.degrees(hinge.range)
        backward[joint] = float(np.mean((angle < low) | (angle > high)))
        sideways[joint] = float(np.degrees(np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along))))
        flexion[joint] = angle if high > -low else -angle
    gap = 0.0
    if closed.any():
        gap = float(np.sqrt(np.average(calibration.gap[closed] ** 2, weights=calibration.contact[closed])))
    return LimbMotion(flexion, backward, sideways, _share_behind(calibration, R), gap)


def compute_hinge_angles(hinge: HingeJoint, along_on: Sequence[float], along: np.ndarray) -> np.ndarray:
    """Angles (n,) [rad] about a hinge's axis from the long axis of `on` to directions `along` (n, 3) in its frame."""
    straight, axis = np.array(along_on), np.array(hinge.axis)
    return np.arctan2(np.cross(straight, along) @ axis, along @ straight)


def reach_limbs(calibration: Calibration, R: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """Last point of a limb → the vectors (n, 3) [m] in W from its first point to it, of limbs whose links are known.

    Parameters
    ----------
    R : segment → its orientations, n each
    """
    problem, reaches = calibration.problem, {}
    lengths = np.array([calibration.subject.lengths[name] for name in problem.model.lengths])
    for first, *_, last in problem.model.table.limbs:
        try:
            parts = find_path(problem.model, problem.start_pose, R, [(last, 1.0), (first, -1.0)]).vectors
        except BadSession:  # the limb's end is not known
            continue
        turned = [R[part.segment] * problem.start_rotation(part.segment).inv() for part in parts]
        reaches[last] = np.sum([t.apply(part.vector(lengths)) for t, part in zip(turned, parts, strict=True)], axis=0)
    return reaches


def _share_behind(calibration: Calibration, R: Mapping[str, Rotation]) -> float:
    """The largest share of samples in which a closure's point is behind the segment in front of which it belongs."""
    shares, reaches = [0.0], reach_limbs(calibration, R)
    for loop in calibration.problem.conditions:
        if isinstance(loop, Loop) and loop.closure.in_front_of in R:
            to_segment = R[loop.closure.in_front_of].inv()
            forwards = [to_segment.apply(reaches[point])[:, 0] for point in loop.closure.points if point in reaches]
            shares += [float(np.mean(x < -BACK)) for x in forwards]
    return max(shares)


def check_limbs(limbs: LimbMotion, table: BodyTable) -> LabelCheck:
    """The check of labels by how the limbs moved; a mechanism has no limits of anatomy."""
    doubt = 0.0 if table.is_mechanism else limbs.doubt()
    return LabelCheck(doubt, limbs.contradiction() if doubt > 1.0 else None)


def check_labels(
    stated: LimbMotion, solve: Callable[[Mapping[str, str]], LimbMotion], places: Sequence[str], table: BodyTable
) -> LabelCheck:
    """Whether the stated labels give a person's limbs, and where they do not, the labelling that does.

    Parameters
    ----------
    stated : how the limbs moved with the stated labels
    solve : segment → label of the sensor on it → how the limbs moved with these
    places : segments with sensors of the chain
    """
    check = check_limbs(stated, table)
    if check.doubt <= 1.0:
        return check
    # Labellings that close the same chain, fewest moves first: one of each shows whether it closes.
    alike: dict[frozenset, list[dict[str, str]]] = {}
    for order in permutations(places):
        moved = dict(zip(places, order, strict=True))
        sides = frozenset(frozenset(moved[p] for p in places if table.side(p) == side) for side in ("left", "right"))
        alike.setdefault(sides, []).append({a: b for a, b in moved.items() if a != b})
    gaps = {}
    for sides, labellings in alike.items():
        labellings.sort(key=len)
        gaps[sides] = solve(labellings[0]).gap
    closing = [sides for sides, gap in gaps.items() if gap < OPEN and gap < 2.0 * min(gaps.values())]
    doubts = [(solve(labelling).doubt(), labelling) for sides in closing for labelling in alike[sides]]
    best, moved = min(doubts, key=lambda pair: pair[0], default=(np.inf, {}))
    return check._replace(moved=moved) if best < min(1.0, BETTER * check.doubt) else check


def diagnose_labels(calibration: Calibration) -> Diagnostic:
    """The sensors that sit on other segments, or the movement that a person cannot make."""
    labels, table = calibration.labels, calibration.problem.model.table
    if not labels.moved:
        return Diagnostic("limb-motion-implausible", ERROR, "", labels.doubt, 1.0)
    place = ", ".join(f"{label} sits on the {place}" for place, label in sorted(labels.moved.items()))
    variant = {"variant": "mixed"}
    if all(labels.moved[b] == a for a, b in labels.moved.items()):  # pairs of sensors, exchanged
        order = list(table.segments)
        pairs = {tuple(sorted(pair, key=order.index)) for pair in labels.moved.items()}
        place = ", ".join(f"{a} and {b}" for a, b in sorted(pairs))
        places = set(calibration.problem.sensors) & set(table.needed)
        sides = {(left, right) for left, right in table.pairs.items() if {left, right} <= places}
        variant = {"variant": "sides"} if pairs == sides else {}
    return Diagnostic("sensors-exchanged", ERROR, place, labels.doubt, 1.0, variant)
