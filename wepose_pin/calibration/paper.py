"""The calibration of Lisini Baldi 2019: the lengths alone, by plain least squares of the gap between the palms.

Segment orientations are those of tracking: of the filter, from the start pose, with the mounts as stated. With them the
gap is linear in the lengths ℓ, g = A ℓ at each sample, and the lengths are the minimiser of

    ½ Σ ‖A ℓ‖²   with   E ℓ = d,

and not shorter than `MIN_LENGTH`. There is no prior, so E and d state what the gap does not show: measured lengths, of
which at least one fixes the scale, as ℓ = 0 closes the chain perfectly; the population's proportions of lengths that
always rotate together, as a forearm and a hand without a sensor; and its lengths outside the chain, as the trunk. No
girdle moves the shoulders, in the subject neither.

The covariance follows from the scatter of the gap and from the errors of d. It does not contain the errors of what is
not estimated: mounts, headings and their drift, soft tissue. `full` estimates these.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.spatial.transform import Rotation

from ..body.girdle import FIXED
from ..body.mounts import PALM_SLIP_STD, align_sensors
from ..body.table import NEUTRAL_POSE
from ..errors import BadOption, BadSubject, NoSolution, one_of
from .least_squares import LEAST_VARIANCE, MIN_LENGTH, MeasuredLength, count_correlated_samples
from .problem import CalibrationProblem
from .protocols import Closure
from .result import Calibration

Formulation = Literal["full", "paper"]
LEAST_EFFECT = 1e-6  # of a change of the lengths on the gaps, beside that of the change with the largest effect


def solve_paper_calibration(problem: CalibrationProblem) -> Calibration:
    """The calibration with the lengths as the only unknowns.

    Raises
    ------
    BadOption
        Another start pose, other conditions, or a scale that was not measured.
    BadSession
        A mount that is not known, or that gravity contradicts.
    BadSubject
        The prior has no positive definite covariance of its lengths.
    NoSolution
        The gap does not determine the lengths.
    """
    _check_problem(problem)
    recording, prior = problem.recording, problem.prior
    mounts, _, mount_diagnostics, _ = align_sensors(recording, prior, problem.R_VS_start, problem.start)
    data, condition_index, samples = problem.observe()
    quat_WL = problem.orient_segments({name: mount.as_quat() for name, mount in mounts.items()}, samples)
    names = problem.layout.lengths
    A = np.zeros((len(samples), 3, len(names)))
    for k, closure in enumerate(problem.protocol.closures):
        own, [path] = condition_index == k, problem.layout.paths[closure]
        for segment, (B, _) in path.vectors.items():
            A[own] += Rotation.from_quat(quat_WL[segment][own]).as_matrix() @ B
    rows = A.reshape(-1, len(names))
    advice = "check that the hands do in the phase what the protocol says, and every mount"
    E, d, d_cov = _state_constraints(problem)
    Z = null_space(E)
    if np.linalg.matrix_rank(rows @ Z, rtol=LEAST_EFFECT) < Z.shape[1]:
        raise NoSolution(f"{recording.where()}: the motion does not determine the lengths; {advice}")
    # AᵀA ℓ + Eᵀ λ = 0 and E ℓ = d, with multipliers λ
    N = rows.T @ rows
    solved = np.linalg.inv(np.block([[N, E.T], [E, np.zeros((len(E), len(E)))]]))[: len(names)]
    by_gap, by_d = np.split(solved, [len(names)], axis=1)
    lengths = by_d @ d
    if np.min(lengths) < MIN_LENGTH:
        shortest = f"{names[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} mm"
        raise NoSolution(f"{recording.where()}: the gap is least with {shortest}; {advice}")
    gaps = A @ lengths
    correlated = count_correlated_samples(gaps, data[-1])  # samples that make one independent one
    variance = max(np.sum(gaps**2) / (gaps.size - Z.shape[1]), LEAST_VARIANCE * PALM_SLIP_STD**2)  # [m²]
    covariance = correlated * variance * by_gap + by_d @ d_cov @ by_d.T
    others = [k for k, name in enumerate(prior.order) if name not in prior.lengths]
    subject = replace(  # what the prior knows of mounts stays
        prior,
        name=recording.name,
        lengths=dict(zip(names, lengths.tolist(), strict=True)),
        order=(*names, *(prior.order[k] for k in others)),
        covariance=block_diag(0.5 * (covariance + covariance.T), prior.covariance[np.ix_(others, others)]),
        note=f"{problem.protocol.title}, lengths alone as in the paper; scale measured: "
        f"{', '.join(problem.scale_lengths)}",
    )
    return Calibration(
        problem=problem,
        subject=replace(subject, girdles=dict.fromkeys(problem.model.table.girdles, FIXED)),
        effective_sample_size=len(gaps) / correlated,
        scale_std=float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1),
        remarks=(*recording.diagnostics, *mount_diagnostics),
        time=recording.time[samples],
        gap=np.linalg.norm(gaps, axis=1),
        contact=np.ones(len(gaps)),
        quat_WL=quat_WL,
        measured_lengths={  # beside the prior alone: the gap is least without any length
            name: MeasuredLength(metres, prior.lengths[name], prior.std(name), std)
            for name, (metres, std) in problem.measured.items()
        },
        formulation="paper",
    )


def _check_problem(problem: CalibrationProblem) -> None:
    protocol, start_pose = problem.protocol, problem.recording.start_pose
    if start_pose != NEUTRAL_POSE:
        raise BadOption(
            f"formulation 'paper' takes orientations from the N-pose on, and the recording has start_pose = "
            f"'{start_pose}'; record a start in {NEUTRAL_POSE}, or use `formulation` full"
        )
    if not all(isinstance(c, Closure) and c.kind == "coincide" for c in protocol.conditions):
        raise BadOption(
            f"formulation 'paper' needs a protocol in which points of the body coincide and nothing else is asked, "
            f"such as clasp; not '{protocol.name}'"
        )
    names, prior, groups = problem.layout.lengths, problem.prior, problem.layout.length_groups.values()
    if np.any(np.linalg.eigvalsh(prior.lengths_covariance(names)) <= 0.0):
        raise BadSubject(f"prior '{prior.name}': all its lengths need a covariance, and it must be positive definite")
    if not any(set(group) <= set(problem.measured) for group in groups):
        single = [group[0] for group in groups if len(group) == 1]
        raise BadOption(
            f"formulation 'paper' needs one measured length that fixes the scale, as in `measured` "
            f"{problem.measured_example}; {one_of(single)}"
        )


def _state_constraints(problem: CalibrationProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return E (m, k), d (m,) and its covariance (m, m): measured lengths, and what only the population tells."""
    groups, measured = problem.layout.length_groups.values(), problem.measured
    names, prior = problem.layout.lengths, problem.prior
    unit = dict(zip(names, np.eye(len(names)), strict=True))
    rows, lengths, covariance = [unit[name] for name in measured], dict(prior.lengths), prior.lengths_covariance(names)
    for group in groups:  # proportions
        rows += [a - b for a, b in pairwise(unit[n] / prior.lengths[n] for n in group if n not in measured)]
    rows += [unit[name] for name in names if name not in {*measured, *(n for group in groups for n in group)}]
    for i, name in [(names.index(name), name) for name in measured]:
        lengths[name], std = measured[name]
        covariance[i], covariance[:, i], covariance[i, i] = 0.0, 0.0, std**2
    E = np.array(rows)
    return E, E @ [lengths[name] for name in names], E @ covariance @ E.T
