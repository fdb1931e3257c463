"""Problems that explain a recording better than the stated one: without some mounts, with other labels, without a pose.

Each function takes the solution of a problem. It returns that of a better problem where there is one, else the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations

import numpy as np

from ..body.mounts import MOUNT_WARNING_DEG
from ..diagnostics import WARNING, Diagnostic
from .anatomy import LEAST_ROTATION, OPEN, LimbMotion, measure_limbs, measure_rotation
from .priors import combine_lengths
from .result import Calibration
from .solution import solve_problem
from .weights import CONTRADICTED, SUSPECT

BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


def leave_out_mounts(stated: Calibration) -> Calibration:
    """Return the quick solution without the mounts that the motion contradicts."""
    problem = stated.problem
    if measure_limbs(stated).doubt <= 1.0 and not problem.mounts_against_motion(stated.subject.mounts):
        return stated
    free = solve_problem(problem.remove_mounts(problem.filtered.R_VS), quick=True)
    wrong = problem.mounts_against_motion(free.subject.mounts)
    if not wrong or measure_limbs(free).doubt >= 1.0:
        return stated
    return solve_problem(problem.leave_out_mounts(wrong, MOUNT_WARNING_DEG, "motion"), quick=True)


def exchange_labels(stated: Calibration) -> Calibration:
    """Return the quick solution with the labels by which the limbs move as a person's; its lengths are the prior's.

    First one labelling of those that close the same chain shows whether it closes, then those that do are compared.
    """
    problem, doubt, table = stated.problem, measure_limbs(stated).doubt, stated.problem.model.table
    if doubt <= 1.0 or table.is_mechanism or not measure_rotation(stated) >= LEAST_ROTATION:
        return stated

    def measure(labels: Mapping[str, str]) -> LimbMotion:
        return measure_limbs(solve_problem(problem.relabel(labels), quick=True))

    places = [name for name in problem.sensors if name in table.needed]
    alike: dict[frozenset, list[dict[str, str]]] = {}
    for order in permutations(places):
        labels = dict(zip(places, order, strict=True))
        sides = frozenset(frozenset(labels[p] for p in places if table.side(p) == side) for side in ("left", "right"))
        alike.setdefault(sides, []).append({place: label for place, label in labels.items() if place != label})
    gaps = {sides: measure(min(labellings, key=len)).gap for sides, labellings in alike.items()}
    closing = [sides for sides, gap in gaps.items() if gap < OPEN and gap < 2.0 * min(gaps.values())]
    doubts = [(measure(labels).doubt, labels) for sides in closing for labels in sorted(alike[sides], key=len)]
    least, exchanged = min(doubts, key=lambda pair: pair[0], default=(np.inf, {}))
    return _keep_prior(replace(stated, exchanged=exchanged)) if least < min(1.0, BETTER * doubt) else stated


def leave_out_poses(best: Calibration) -> Calibration:
    """Return the full solution without the phases of poses that contradict all else, the worst first."""
    problem = best.problem
    posed = {phase: deviation for phase, deviation in best.posed.items() if phase not in problem.loose}
    phase = max(posed, key=lambda name: posed[name], default="")
    if not phase or posed[phase] <= SUSPECT or not problem.protocol.closures:
        return best
    # Where a pose is wrong all else fits worse: what it is compared with must be found without it.
    loose = solve_problem(problem.loosen_phase(phase))
    deviation = loose.posed[phase]
    if deviation <= CONTRADICTED:
        return best
    unused = Diagnostic("pose-contradicted", WARNING, phase, deviation, CONTRADICTED, {"variant": "unused"})
    return leave_out_poses(replace(loose, remarks=(unused, *loose.remarks)))


def _keep_prior(calibration: Calibration) -> Calibration:
    """Return the calibration with the lengths and covariance from before the motion."""
    problem, names = calibration.problem, tuple(calibration.subject.lengths)
    lengths, information = combine_lengths(problem.prior, problem.measured, names)
    subject = replace(
        calibration.subject,
        lengths=dict(zip(names, lengths.tolist(), strict=True)),
        covariance=calibration.prior_covariance,
        hinges={},
        start_pose_offset={},
        heading_drift={},
        note="sensors sit elsewhere than labelled: nothing of the motion is used",
    )
    scale_std = float(np.sqrt(lengths @ information @ lengths) ** -1)
    return replace(calibration, subject=subject, scale_std=scale_std, hinge_rms={}, remarks=())
