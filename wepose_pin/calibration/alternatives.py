"""Problems that explain a recording better than the stated one: without some mounts, or with other labels.

Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
give the same gap. The solution's elbows then bend backward, or sideways, as a person's cannot. Any other exchange opens
the chain. Ranges of hinges are those of the body's table.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from .result import Calibration
from .solution import solve_problem

# Limits of a person's limbs, with soft tissue and headings some degrees off.
BACKWARD = 0.15  # share of samples out of a hinge's range
SIDEWAYS = np.deg2rad(14.0)  # [rad] rms of a segment off the plane in which it bends
OPEN = 0.06  # [m] rms of the gap
# [rad] by which segments turn at least, `measure_rotations`. Soft tissue alone gives people 4 deg, a minute of joined
# hands 36 to 39 deg.
LEAST_ROTATION = np.deg2rad(8.0)

BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


def measure_rotations(calibration: Calibration) -> dict[str, float]:
    """Segment → how far it turned [rad] while the closure held, the rms angle from its mean; empty without one."""
    if not calibration.closed.any():
        return {}
    R = {name: Rotation.from_quat(quat[calibration.closed]) for name, quat in calibration.quat_WL.items()}
    return {name: float(np.sqrt(np.mean((each.mean().inv() * each).magnitude() ** 2))) for name, each in R.items()}


def measure_doubt(calibration: Calibration) -> tuple[float, str]:
    """Return the largest ratio of the limbs' motion to a limit, above 1 where a person cannot move so, and its joint.

    It is that while the closure held; without a closure, that of all samples. The gap has no joint.
    """
    table, closed = calibration.problem.model.table, calibration.closed
    samples, doubts = np.ones(len(closed), dtype=bool), [(0.0, "")]
    if closed.any():
        samples = calibration.touching
        gap = np.sqrt(np.average(calibration.gap[closed] ** 2, weights=calibration.contact[closed]))
        doubts.append((float(gap) / OPEN, ""))
    R = {name: Rotation.from_quat(quat[samples]) for name, quat in calibration.quat_WL.items()}
    for joint, hinge in table.hinges.items():
        if hinge.on in R and hinge.moves in R:
            straight, axis = np.array(table.segments[hinge.on].along), np.array(hinge.axis)
            along = (R[hinge.on].inv() * R[hinge.moves]).apply(table.segments[hinge.moves].along)
            angle = np.arctan2(np.cross(straight, along) @ axis, along @ straight)
            low, high = hinge.range
            off_plane = np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along))
            doubts.append((float(np.mean((angle < low) | (angle > high))) / BACKWARD, joint))
            doubts.append((float(off_plane) / SIDEWAYS, joint))
    return max(doubts, key=lambda doubt: doubt[0])


def leave_out_mounts(stated: Calibration) -> Calibration:
    """Return the quick solution without the mounts that the motion contradicts."""
    problem = stated.problem
    if measure_doubt(stated)[0] <= 1.0:
        stated_mounts = problem.leave_out_mounts(stated.subject.mounts).unused_mounts
        if stated_mounts == problem.unused_mounts:
            return stated
    free = solve_problem(problem.remove_mounts(problem.filtered.R_VS), quick=True)
    without = problem.leave_out_mounts(free.subject.mounts)
    if without.unused_mounts == problem.unused_mounts or measure_doubt(free)[0] >= 1.0:
        return stated
    return solve_problem(without, quick=True)


def exchange_labels(stated: Calibration) -> Calibration:
    """Return the quick solution with two sensors, or both sides, exchanged if the limbs move as a person's then."""
    problem, (doubt, _), table = stated.problem, measure_doubt(stated), stated.problem.model.table
    rotations = [*measure_rotations(stated).values()]
    if doubt <= 1.0 or table.is_mechanism or not rotations or np.median(rotations) < LEAST_ROTATION:
        return stated
    places = [name for name in problem.sensors if name in table.needed]
    sides = [(a, b) for a, b in table.pairs.items() if {a, b} <= set(places)]
    exchanges = [dict((pair, pair[::-1])) for pair in combinations(places, 2)]
    exchanges.append({a: b for pair in sides for a, b in (pair, pair[::-1])})
    doubts = [measure_doubt(solve_problem(problem.relabel(labels), quick=True))[0] for labels in exchanges]
    least = min(doubts)
    if least >= min(1.0, BETTER * doubt):
        return stated
    note = "sensors sit elsewhere than labelled"
    subject = replace(stated.subject, note=note)
    return replace(stated, subject=subject, remarks=(), exchanged=exchanges[doubts.index(least)])
