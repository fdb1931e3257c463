"""The calibration of Lisini Baldi 2019: the lengths alone, by plain least squares of the gap between the palms.

Segment orientations are those of tracking: of the filter, from the start pose, with the mounts as stated. With them the
gap is linear in the lengths ℓ, g = A ℓ at each sample, and the lengths are the minimiser of

    ½ Σ ‖A ℓ‖²   with   E ℓ = d   and   ℓ ≥ `MIN_LENGTH`,

a quadratic program, which CasADi's `qpsol` solves. There is no prior, so E and d state what the gap does not show:

- Measured lengths. At least one fixes the scale: ℓ = 0 closes the chain perfectly.
- Lengths that always rotate together, as a forearm and a hand without a sensor: the gap shows their sum. Their
  proportions are those of the population.
- Lengths outside the chain, as the trunk: those of the population.

The covariance follows from the scatter of the gap and from the errors of d. It does not contain the errors of what is
not estimated: mounts, headings and their drift, soft tissue. `full` (see `lengths`) estimates these.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import block_diag, null_space

from ..alignment import PALM_SLIP_STD, align_sensors
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadOption, NoSolution, one_of
from ..subject import Subject
from .anatomy import LabelCheck
from .chain import LENGTHS, links
from .least_squares import K, Observations, sensor_of
from .observability import diagnose_lengths
from .priors import combine_lengths
from .problem import CalibrationProblem
from .protocols import Closure, Protocol, coefficients
from .result import Calibration
from .solver import MIN_LENGTH
from .weights import LEAST_VARIANCE, MeasuredLength, count_correlated_samples, min_correlation

Formulation = Literal["full", "paper"]
LEAST_EFFECT = 1e-6  # of a change of the lengths on the gaps, beside that of the change with the largest effect
DECIMALS = 9  # of a length's effect on the chain, by which lengths that rotate together are found


def check_paper_formulation(protocol: Protocol, measured: Collection[str], sensors: Collection[str]) -> None:
    """Check that the protocol has the paper's closure, and that a measured length fixes the scale.

    Raises
    ------
    BadOption
        It has another condition than points that coincide, or no such length is measured.
    """
    if not all(isinstance(c, Closure) and c.kind == "coincide" for c in protocol.conditions):
        raise BadOption(
            f"formulation 'paper' needs a protocol in which points of the body coincide and nothing else is asked, "
            f"such as clasp; not '{protocol.name}'"
        )
    groups = _group_lengths(protocol, sensors)
    if not any(set(group) <= set(measured) for group in groups):
        names = [group[0] for group in groups if len(group) == 1]
        raise BadOption(
            f"formulation 'paper' needs one measured length that fixes the scale, as in --measured "
            f"{protocol.measured_example}; {one_of(names)}"
        )


def solve_paper_calibration(problem: CalibrationProblem) -> Calibration:
    """The calibration with the lengths as the only unknowns.

    Raises
    ------
    BadSession
        A mount that is not known, or that gravity contradicts.
    NoSolution
        The gap does not determine the lengths.
    """
    recording, filtered, protocol, prior = problem.recording, problem.filtered, problem.protocol, problem.prior
    alignment = align_sensors(recording, prior, filtered)
    observations, samples = problem.observe()
    quat_WL = {
        name: (alignment.R_WV[name] * R_VS[samples] * alignment.R_LS[name].inv()).as_quat()
        for name, R_VS in filtered.R_VS.items()
    }
    A = compute_gap_matrices(observations, quat_WL)
    constraints = _state_constraints(problem, _group_lengths(protocol, filtered.R_VS))
    try:
        lengths = _minimise(A, constraints)
    except NoSolution as error:
        raise NoSolution(
            f"{recording.where()}: {error}; check that the hands do in the phase what the protocol says, and that "
            f"every mount is as the session states"
        ) from error
    gaps, prior_gaps = A @ lengths, A @ [prior.lengths[name] for name in LENGTHS]
    correlated = count_correlated_samples(gaps, min_correlation(observations))
    covariance = _estimate_covariance(A, gaps, constraints, correlated)
    gap, prior_gap = (np.linalg.norm(vectors, axis=1) for vectors in (gaps, prior_gaps))
    measured_covariance = np.linalg.inv(combine_lengths(prior, problem.measured)[1])
    scale_lengths = tuple(name for name in problem.measured if name in protocol.chain)
    calibration = Calibration(
        subject=_replace_lengths(
            prior, lengths, covariance,
            name=recording.name,
            note=f"{protocol.title}, lengths alone as in the paper; scale measured: {', '.join(scale_lengths)}",
        ),
        prior=prior,
        rms_gap=float(np.sqrt(np.mean(gap**2))),
        prior_rms_gap=float(np.sqrt(np.mean(prior_gap**2))),
        effective_sample_size=len(gap) / correlated,
        measured={name: metres for name, (metres, _) in problem.measured.items()},
        scale_std=float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1),
        diagnostics=(
            *alignment.diagnostics,
            *diagnose_lengths(problem, lengths, covariance, measured_covariance, None),
            Diagnostic("lengths-alone-estimated", WARNING),
        ),
        time=recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=np.ones(len(gap)),
        start_pose_offset={},
        heading_drift={},
        hinge_axes={},
        hinge_rms={},
        prior_covariance=_replace_lengths(prior, lengths, measured_covariance).covariance,
        quat_WL=quat_WL,
        protocol=protocol.name,
        closure="coincide",
        measured_example=protocol.measured_example,
        measured_lengths={  # beside the prior alone: the gap is least without any length
            name: MeasuredLength(metres, prior.lengths[name], prior.std(name), std)
            for name, (metres, std) in problem.measured.items()
        },
        scale_lengths=scale_lengths,
        formulation="paper",
    )  # fmt: skip
    arms = calibration.arms()
    return replace(calibration, labels=LabelCheck(arms.doubt(), arms.contradiction() if arms.doubt() > 1.0 else None))


def compute_gap_matrices(observations: Observations, quat_WL: Mapping[str, np.ndarray]) -> np.ndarray:
    """A (n, 3, 8) of each sample, from segment orientations (n, 4) xyzw: the gap [m] in W is ``A @ lengths``."""
    matrices = []
    for closure, span in observations.spans():
        assert isinstance(closure, Closure)
        way, lengths = coefficients(closure), ca.SX.sym("lengths", K)
        sensors = {segment: sensor_of(segment, quat_WL) for segment in way}
        quats = {sensor: ca.SX.sym(sensor, 4) for sensor in dict.fromkeys(sensors.values())}
        vectors = links(lengths, {segment: quats[sensor] for segment, sensor in sensors.items()}, way)
        gap = ca.sum2(ca.horzcat(*vectors.values()))
        function = ca.Function("gap", [*quats.values()], [ca.densify(ca.jacobian(gap, lengths))])
        n = span.stop - span.start
        rows = np.asarray(function.map(n)(*(quat_WL[sensor][span].T for sensor in quats)))  # (3, 8 n)
        matrices.append(rows.reshape(3, n, K).swapaxes(0, 1))
    return np.concatenate(matrices)


class _Constraints(NamedTuple):
    """E ℓ = d."""

    E: np.ndarray  # (m, 8)
    d: np.ndarray  # (m,)
    covariance: np.ndarray  # (m, m) of d

    def find_free(self) -> np.ndarray:
        """Directions (8, k) in which the lengths are free, orthonormal: ℓ = E⁺ d + free @ z."""
        return null_space(self.E)


def _group_lengths(protocol: Protocol, sensors: Collection[str]) -> list[tuple[str, ...]]:
    """The lengths in the chain; those that always rotate together are one group, of which the gap shows the sum."""
    columns = []
    for closure in protocol.closures:
        parts: dict[str, np.ndarray] = {}
        for segment, part in coefficients(closure).items():
            sensor = sensor_of(segment, sensors)
            parts[sensor] = parts.get(sensor, 0.0) + part
        columns += list(parts.values())
    groups: dict[tuple[float, ...], list[str]] = {}
    for name, column in zip(LENGTHS, np.round(np.vstack(columns), DECIMALS).T, strict=True):
        if np.any(column):
            groups.setdefault(tuple(column.tolist()), []).append(name)
    return [tuple(group) for group in groups.values()]


def _state_constraints(problem: CalibrationProblem, groups: list[tuple[str, ...]]) -> _Constraints:
    """Measured lengths, and the population's proportions and lengths where the gap shows none."""
    prior, measured, unit = problem.prior, problem.measured, dict(zip(LENGTHS, np.eye(K), strict=True))
    assumed = []
    for group in groups:
        names = [name for name in group if name not in measured]
        shares = [unit[name] / prior.lengths[name] for name in names]
        assumed += [a - b for a, b in pairwise(shares)]
    outside = set(LENGTHS).difference(measured, *groups)
    assumed += [unit[name] for name in LENGTHS if name in outside]
    E_measured = np.array([unit[name] for name in measured if name in unit])
    E_assumed = np.array(assumed).reshape(-1, K)
    stated = [measured[name] for name in measured if name in unit]
    prior_lengths = np.array([prior.lengths[name] for name in LENGTHS])
    return _Constraints(
        np.vstack([E_measured, E_assumed]),
        np.concatenate([[metres for metres, _ in stated], E_assumed @ prior_lengths]),
        block_diag(np.diag([std**2 for _, std in stated]), E_assumed @ prior.lengths_covariance() @ E_assumed.T),
    )


def _minimise(A: np.ndarray, constraints: _Constraints) -> np.ndarray:
    """The lengths (8,) [m] that make the gaps least under the constraints, by CasADi's `qpsol`.

    Raises
    ------
    NoSolution
        The gaps do not determine the lengths, or determine one that is at its bound.
    """
    effects = np.linalg.svd(A.reshape(-1, K) @ constraints.find_free(), compute_uv=False)
    if np.min(effects, initial=1.0) < LEAST_EFFECT * np.max(effects, initial=1.0):
        raise NoSolution("the motion does not determine the lengths: the gap does not change with some of them")
    x = ca.MX.sym("lengths", K)
    gaps = ca.mtimes(ca.DM(A.reshape(-1, K)), x)
    program = {"x": x, "f": 0.5 * ca.sumsqr(gaps), "g": ca.mtimes(ca.DM(constraints.E), x)}
    options: dict[str, Any] = {"print_iter": False, "print_header": False, "print_info": False, "print_time": False}
    solver = ca.qpsol("lengths", "qrqp", program, options)
    try:
        solution = solver(lbx=MIN_LENGTH, lbg=constraints.d, ubg=constraints.d)
    except RuntimeError as error:
        raise NoSolution("the quadratic program of the lengths has no solution") from error
    lengths = np.asarray(solution["x"]).ravel()
    if np.min(lengths) < 1.01 * MIN_LENGTH:  # it lies at its bound, to the solver's accuracy
        shortest = int(np.argmin(lengths))
        raise NoSolution(f"the gap is least with {LENGTHS[shortest]} = {1e3 * lengths[shortest]:.0f} mm")
    return lengths


def _estimate_covariance(A: np.ndarray, gaps: np.ndarray, constraints: _Constraints, correlated: float) -> np.ndarray:
    """Covariance (8, 8) [m²] of the lengths from the gaps' scatter and the constraints' errors; no bound is active.

    Parameters
    ----------
    correlated : samples that make one independent one
    """
    rows, free = A.reshape(-1, K), constraints.find_free()
    information = free.T @ rows.T @ rows @ free
    variance = max(np.sum(gaps**2) / (gaps.size - free.shape[1]), LEAST_VARIANCE * PALM_SLIP_STD**2)  # [m²]
    by_z = free @ np.linalg.solve(information, free.T)
    by_d = (np.eye(K) - by_z @ rows.T @ rows) @ np.linalg.pinv(constraints.E)
    covariance = correlated * variance * by_z + by_d @ constraints.covariance @ by_d.T
    return 0.5 * (covariance + covariance.T)


def _replace_lengths(subject: Subject, lengths: np.ndarray, covariance: np.ndarray, **fields: Any) -> Subject:
    """The subject with other lengths (8,) [m], their covariance, and other `fields`; what it knows of mounts stays."""
    others = [k for k, name in enumerate(subject.order) if name not in LENGTHS]
    return replace(
        subject,
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        order=(*LENGTHS, *(subject.order[k] for k in others)),
        covariance=block_diag(covariance, subject.covariance[np.ix_(others, others)]),
        **fields,
    )
