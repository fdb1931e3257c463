"""Problems that explain a recording better than the stated one: without some mounts, or with other labels.

Each function takes the solution of a problem. It returns that of a better problem where there is one, else the same.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from .anatomy import LEAST_ROTATION, measure_limbs, measure_rotation
from .result import Calibration
from .solution import solve_problem

BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


def leave_out_mounts(stated: Calibration) -> Calibration:
    """Return the quick solution without the mounts that the motion contradicts."""
    problem = stated.problem
    if measure_limbs(stated).doubt <= 1.0:
        stated_mounts = problem.leave_out_mounts(stated.subject.mounts).unused_mounts
        if stated_mounts == problem.unused_mounts:
            return stated
    free = solve_problem(problem.remove_mounts(problem.filtered.R_VS), quick=True)
    without = problem.leave_out_mounts(free.subject.mounts)
    if without.unused_mounts == problem.unused_mounts or measure_limbs(free).doubt >= 1.0:
        return stated
    return solve_problem(without, quick=True)


def exchange_labels(stated: Calibration) -> Calibration:
    """Return the quick solution with two sensors, or both sides, exchanged if the limbs move as a person's then."""
    problem, doubt, table = stated.problem, measure_limbs(stated).doubt, stated.problem.model.table
    if doubt <= 1.0 or table.is_mechanism or not measure_rotation(stated) >= LEAST_ROTATION:
        return stated
    places = [name for name in problem.sensors if name in table.needed]
    sides = [(a, b) for a, b in table.pairs.items() if {a, b} <= set(places)]
    exchanges = [dict((pair, pair[::-1])) for pair in combinations(places, 2)]
    exchanges.append({a: b for pair in sides for a, b in (pair, pair[::-1])})
    doubts = [measure_limbs(solve_problem(problem.relabel(labels), quick=True)).doubt for labels in exchanges]
    least = min(doubts)
    if least >= min(1.0, BETTER * doubt):
        return stated
    note = "sensors sit elsewhere than labelled"
    subject = replace(stated.subject, note=note)
    return replace(stated, subject=subject, remarks=(), exchanged=exchanges[doubts.index(least)])
