"""The calibration of Lisini Baldi 2019: the lengths alone, by plain least squares of the gap between the palms.

Segment orientations are those of tracking: of the filter, from the start pose, with the mounts as stated. With them the
gap is linear in the lengths ℓ, g = A ℓ at each sample, and the lengths are the minimiser of

    ½ Σ ‖A ℓ‖²   with   E ℓ = d,

and not shorter than `MIN_LENGTH`. There is no prior, so E and d state what the gap does not show:

- Measured lengths. At least one fixes the scale: ℓ = 0 closes the chain perfectly.
- Lengths that always rotate together, as a forearm and a hand without a sensor: the gap shows their sum. Their
  proportions are those of the population.
- Lengths outside the chain, as the trunk: those of the population.

The shoulders are fixed on the trunk: no girdle moves them, in the subject neither.

The covariance follows from the scatter of the gap and from the errors of d. It does not contain the errors of what is
not estimated: mounts, headings and their drift, soft tissue. `full` estimates these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.spatial.transform import Rotation

from ..body.mounts import PALM_SLIP_STD, align_sensors
from ..body.table import NEUTRAL_POSE
from ..errors import BadOption, NoSolution, one_of
from .conditions import Loop, group_lengths
from .least_squares import MIN_LENGTH, Observations
from .problem import CalibrationProblem
from .protocols import Closure
from .result import Calibration, MeasuredLength
from .weights import LEAST_VARIANCE, count_correlated_samples, min_correlation

Formulation = Literal["full", "paper"]
LEAST_EFFECT = 1e-6  # of a change of the lengths on the gaps, beside that of the change with the largest effect


def _check_problem(problem: CalibrationProblem) -> None:
    """Raise `BadOption` for another start pose, other conditions, or a scale that was not measured."""
    protocol, start_pose = problem.protocol, problem.recording.start_pose
    if start_pose != NEUTRAL_POSE:
        raise BadOption(
            f"formulation 'paper' takes orientations from the N-pose on, and the recording has start_pose = "
            f"'{start_pose}'; record a start in {NEUTRAL_POSE}, or use --formulation full"
        )
    if not all(isinstance(c, Closure) and c.kind == "coincide" for c in protocol.conditions):
        raise BadOption(
            f"formulation 'paper' needs a protocol in which points of the body coincide and nothing else is asked, "
            f"such as clasp; not '{protocol.name}'"
        )
    groups = group_lengths(problem.conditions, problem.model.lengths).values()
    if not any(set(group) <= set(problem.measured) for group in groups):
        names = [group[0] for group in groups if len(group) == 1]
        raise BadOption(
            f"formulation 'paper' needs one measured length that fixes the scale, as in --measured "
            f"{protocol.measured_example}; {one_of(names)}"
        )


def solve_paper_calibration(problem: CalibrationProblem) -> Calibration:
    """The calibration with the lengths as the only unknowns.

    Raises
    ------
    BadOption
        What `_check_problem` refuses.
    BadSession
        A mount that is not known, or that gravity contradicts.
    NoSolution
        The gap does not determine the lengths.
    """
    _check_problem(problem)
    recording, filtered, protocol, prior = problem.recording, problem.filtered, problem.protocol, problem.prior
    mounts, headings, mount_diagnostics = align_sensors(recording, prior, filtered.R_VS_start, filtered.start)
    observations, samples = problem.observe()
    quat_WL = {
        name: (Rotation.from_rotvec([0.0, 0.0, headings[name]]) * R_VS[samples] * mounts[name].inv()).as_quat()
        for name, R_VS in filtered.R_VS.items()
    }
    A = compute_gap_matrices(observations, quat_WL)
    constraints = _state_constraints(problem)
    try:
        lengths = _minimise(A, constraints, tuple(problem.model.lengths))
    except NoSolution as error:
        raise NoSolution(
            f"{recording.where()}: {error}; check that the hands do in the phase what the protocol says, and that "
            f"every mount is as the session states"
        ) from error
    gaps, prior_gaps = A @ lengths, A @ [prior.lengths[name] for name in problem.model.lengths]
    correlated = count_correlated_samples(gaps, min_correlation(observations))
    covariance = _estimate_covariance(A, gaps, constraints, correlated)
    gap, prior_gap = (np.linalg.norm(vectors, axis=1) for vectors in (gaps, prior_gaps))
    names = tuple(problem.model.lengths)
    others = [k for k, name in enumerate(prior.order) if name not in prior.lengths]
    subject = replace(  # what the prior knows of mounts stays
        prior,
        name=recording.name,
        lengths=dict(zip(names, lengths.tolist(), strict=True)),
        order=(*names, *(prior.order[k] for k in others)),
        covariance=block_diag(covariance, prior.covariance[np.ix_(others, others)]),
        note=f"{protocol.title}, lengths alone as in the paper; scale measured: {', '.join(problem.scale_lengths)}",
    )
    return Calibration(
        problem=problem,
        subject=subject.fix_girdles(problem.model.table),
        effective_sample_size=len(gap) / correlated,
        scale_std=float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1),
        remarks=(*filtered.diagnostics, *mount_diagnostics),
        time=recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=np.ones(len(gap)),
        quat_WL=quat_WL,
        measured_lengths={  # beside the prior alone: the gap is least without any length
            name: MeasuredLength(metres, prior.lengths[name], prior.std(name), std)
            for name, (metres, std) in problem.measured.items()
        },
        formulation="paper",
    )


def compute_gap_matrices(observations: Observations, quat_WL: Mapping[str, np.ndarray]) -> np.ndarray:
    """A (n, 3, 8) of each sample, from segment orientations (n, 4) xyzw: the gap [m] in W is ``A @ lengths``."""
    A = np.zeros((len(observations), 3, len(observations.layout.lengths)))
    for loop, span in observations.spans():
        assert isinstance(loop, Loop)
        for part in loop.parts:
            A[span] += Rotation.from_quat(quat_WL[part.segment][span]).as_matrix() @ np.array(part.by_length)
    return A


class _Constraints(NamedTuple):
    """E ℓ = d."""

    E: np.ndarray  # (m, 8)
    d: np.ndarray  # (m,)
    covariance: np.ndarray  # (m, m) of d


def _state_constraints(problem: CalibrationProblem) -> _Constraints:
    """Return measured lengths, and the population's proportions and lengths where the gap shows none."""
    groups = group_lengths(problem.conditions, problem.model.lengths).values()
    names, prior, measured = tuple(problem.model.lengths), problem.prior, problem.measured
    unit = dict(zip(names, np.eye(len(names)), strict=True))
    assumed = []
    for group in groups:
        shares = [unit[name] / prior.lengths[name] for name in group if name not in measured]
        assumed += [a - b for a, b in pairwise(shares)]
    assumed += [unit[name] for name in names if name not in {*measured, *(n for group in groups for n in group)}]
    E_assumed = np.array(assumed).reshape(-1, len(names))
    return _Constraints(
        np.vstack([[unit[name] for name in measured], E_assumed]),
        np.concatenate([[metres for metres, _ in measured.values()], E_assumed @ [prior.lengths[n] for n in names]]),
        block_diag(
            np.diag([std**2 for _, std in measured.values()]),
            E_assumed @ prior.lengths_covariance(names) @ E_assumed.T,
        ),
    )


def _minimise(A: np.ndarray, constraints: _Constraints, names: tuple[str, ...]) -> np.ndarray:
    """The lengths ℓ = E⁺ d + Z z (8,) [m] that make the gaps least, where Z spans what E leaves free.

    Raises
    ------
    NoSolution
        The gaps do not determine the lengths, or are least with one that nobody has.
    """
    rows, Z = A.reshape(-1, A.shape[-1]), null_space(constraints.E)
    stated = np.linalg.pinv(constraints.E) @ constraints.d
    z, _, rank, _ = np.linalg.lstsq(rows @ Z, -rows @ stated, rcond=LEAST_EFFECT)
    if rank < Z.shape[1]:
        raise NoSolution("the motion does not determine the lengths: the gap does not change with some of them")
    lengths = stated + Z @ z
    if np.min(lengths) < MIN_LENGTH:
        shortest = int(np.argmin(lengths))
        raise NoSolution(f"the gap is least with {names[shortest]} = {1e3 * lengths[shortest]:.0f} mm")
    return np.asarray(lengths)


def _estimate_covariance(A: np.ndarray, gaps: np.ndarray, constraints: _Constraints, correlated: float) -> np.ndarray:
    """Covariance (8, 8) [m²] of the lengths from the gaps' scatter and the constraints' errors.

    Parameters
    ----------
    correlated : samples that make one independent one
    """
    rows, Z = A.reshape(-1, A.shape[-1]), null_space(constraints.E)
    variance = max(np.sum(gaps**2) / (gaps.size - Z.shape[1]), LEAST_VARIANCE * PALM_SLIP_STD**2)  # [m²]
    by_z = Z @ np.linalg.solve(Z.T @ rows.T @ rows @ Z, Z.T)
    by_d = (np.eye(len(by_z)) - by_z @ rows.T @ rows) @ np.linalg.pinv(constraints.E)
    covariance = correlated * variance * by_z + by_d @ constraints.covariance @ by_d.T
    return 0.5 * (covariance + covariance.T)
