"""The solution of a calibration's problem, quick or in full, and the `Calibration` that it makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.girdle import PARAMETERS
from ..body.soft_tissue import estimate_scatter
from ..body.subject import HeadingDrift, Hinge, StartPoseOffset, Subject, mount_rows
from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import NoSolution
from .conditions import Loop, is_scale_observed
from .couplings import add_couplings
from .equations import GAP_ROWS, HINGE_STD, Layout
from .initial_headings import search_headings, wrap_angle
from .least_squares import MIN_LENGTH, Gaussian, LeastSquares, solve
from .priors import build_prior, place_points
from .problem import SAMPLE_RATE_HZ, CalibrationProblem
from .protocols import FreeMotion
from .result import Calibration
from .weights import (
    CONTRADICTED,
    LEAST_LENGTH_STD,
    WeightedFit,
    compare_measured,
    estimate_covariance,
    solve_reweighted,
)

# [m] to which a length between joint centres is known at best: of simulated people with exact hinges, sums and
# differences of lengths that were stated to 0.1 mm are off by 0.2 to 1 mm.
JOINT_CENTRE_STD = 0.0003
WIDE = 0.15  # [m] a gap that neither the prior's lengths nor headings some degrees off explain
MOST_LAG_STD = 0.15  # [rad/rad] from which on the motion does not show how far a sensor lags behind a twist
QUICK_RATE_HZ = 1.0  # of samples that decide whether labels and mounts can be as stated

COMPARED_SAMPLES = 120  # on which solutions are compared
COMPARED_STEPS = 25
LEAST_WEIGHT = 1e-4  # of a solution that counts: its probability over that of the best one
NEAR = 3.0  # standard deviations within which two solutions are the same


def solve_problem(problem: CalibrationProblem, *, quick: bool = False) -> Calibration:
    """Return the calibration, with other minima that explain the motion nearly as well.

    `quick`: at fewer samples and by the closure alone, which shows whether mounts and labels can be as stated. Else
    `NoSolution` is raised where it did not converge, or where a length is at its bound.
    """
    observations, samples = problem.observe(QUICK_RATE_HZ if quick else SAMPLE_RATE_HZ)
    layout, (prior_mean, information) = observations.layout, build_prior(problem, observations)
    couplings = [] if quick and problem.protocol.closures else problem.couplings
    stated = problem.stated_headings(layout.sensors)
    is_free = np.array([name not in stated for name in layout.sensors])

    def prior_at(psi: np.ndarray) -> Gaussian:
        """Return the prior with couplings, and with unknown headings at ψ (sensors,) [rad]."""
        mean = prior_mean.copy()
        mean[layout.heading] = np.where(is_free, psi, mean[layout.heading])
        return add_couplings((mean, information), layout, couplings, mean)

    headings = search_headings(observations, prior_mean, stated, couplings)
    prior = prior_at(headings[0])
    start = place_points(prior[0], observations)
    # The weight of a gap in the initial guess: near 0 where the palms are apart.
    contact = (1.0 + np.sum(observations.gaps(start) ** 2, axis=1) / WIDE**2) ** -2
    result = solve_reweighted(observations, prior, start, contact, quick)
    if quick:
        return _describe(problem, samples, result, result.fit.covariance)
    lengths = result.fit.x[layout.length]
    if np.min(lengths, initial=np.inf) < 1.01 * MIN_LENGTH:  # it lies at its bound, to the solver's accuracy
        raise NoSolution(
            f"the lengths did not converge ({layout.lengths[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} "
            f"mm); check that the points do in the phase what the protocol says, and that every sensor sits where the "
            f"session says"
        )
    covariance, ambiguous = include_other_minima(result, estimate_covariance(result), headings[1:], prior_at)
    calibration = _describe(problem, samples, result, covariance)
    return replace(calibration, remarks=(*calibration.remarks, *ambiguous))


def include_other_minima(
    result: WeightedFit, covariance: np.ndarray, headings: np.ndarray, prior_at: Callable[[np.ndarray], Gaussian]
) -> tuple[np.ndarray, list[Diagnostic]]:
    """Return the covariance (m, m) about the solution with other minima included, and what to say of them.

    A covariance describes one minimum. Where the hands hardly move, the closure has several: one arm's headings turned
    by 118 deg close the chain as well. Each is solved and weighted by how much worse it explains all that is known.

    `headings` (k, sensors) [rad] are those of the other minima, the lowest first; `prior_at` gives the prior at some.
    """
    fit = result.fit
    observations, rows = fit.observations, fit.observations.layout.heading
    if not observations.closed.any():
        return covariance, []
    stride = max(1, len(observations) // COMPARED_SAMPLES)
    few = np.concatenate([np.arange(len(observations))[span][::stride] for _, span in observations.spans()])
    some, weights = observations.take(few), stride * fit.weights[few]

    def solve_from(psi: np.ndarray) -> LeastSquares:
        start = fit.x.copy()
        start[rows] += wrap_angle(psi - start[rows])
        start = place_points(start, some)
        return solve(LeastSquares(some, prior_at(start[rows]), weights, start), COMPARED_STEPS, strict=False)

    best, std = solve_from(fit.x[rows]), np.sqrt(np.diag(fit.covariance)[rows])
    # The residuals' variance is estimated from the effective samples: Student's t, not a Gaussian.
    degrees = max(3.0 * result.effective_sample_size, 1.0)
    offsets, likelihoods = [np.zeros_like(fit.x)], [1.0]
    for other in map(solve_from, headings):
        offset = other.x - best.x
        offset[rows] = wrap_angle(offset[rows])
        likelihood = float((1.0 + max(other.cost - best.cost, 0.0) / degrees) ** (-0.5 * degrees))
        if likelihood > LEAST_WEIGHT and all(np.abs((offset - o)[rows] / std).max() > NEAR for o in offsets):
            offsets.append(offset)
            likelihoods.append(likelihood)
    if len(offsets) == 1:
        return covariance, []
    shares = np.array(likelihoods) / sum(likelihoods)
    turned = np.abs(offsets[1 + int(np.argmax(shares[1:]))][rows])
    worst = int(np.argmax(turned))
    ambiguous = Diagnostic("headings-ambiguous", WARNING, observations.layout.sensors[worst], float(turned[worst]))
    return covariance + np.einsum("k,ki,kj->ij", shares, offsets, offsets), [ambiguous]


def _describe(problem: CalibrationProblem, samples: np.ndarray, result: WeightedFit, x_cov: np.ndarray) -> Calibration:
    """Return the calibration that a solution at samples (n,) makes, with the covariance (m, m) of x."""
    fit, observations, prior, filtered = result.fit, result.fit.observations, problem.prior, problem.filtered
    layout, is_closed = observations.layout, observations.closed
    lengths, covariance = fit.x[layout.length], x_cov[np.ix_(layout.length, layout.length)]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1) if len(lengths) else float("nan")
    scale = "of the population prior" if prior.is_population else f"of {prior.name}"
    if problem.scale_lengths:
        scale = f"measured: {', '.join(problem.scale_lengths)}"
    elif is_scale_observed(problem.conditions):
        scale = "of the closure"
    hinges, hinge_rms = _estimate_hinges(problem, fit, x_cov)
    scatter = estimate_scatter([hinge.std for hinge in hinges.values()])
    subject = _make_subject(problem, fit, x_cov, scatter)
    subject = replace(subject, hinges=hinges, note=f"{problem.protocol.title}; scale {scale}")
    prior_x = fit.x.copy()
    prior_x[layout.length] = [prior.lengths[name] for name in layout.lengths]
    gap, prior_gap = (
        np.where(is_closed, np.linalg.norm(gaps, axis=1), np.nan)
        for gaps in (fit.gaps, observations.gaps(place_points(prior_x, observations)))
    )
    diagnostics = [*filtered.diagnostics, *problem.diagnose_losses()]
    if not problem.protocol.closures:
        facts = {"protocol": problem.protocol.title, "prior": prior.note or prior.name}
        diagnostics.append(Diagnostic("lengths-not-observed", INFO, facts=facts))
    for name in filtered.R_VS:
        if name not in subject.mounts:
            facts = {"protocol": problem.protocol.name}
            diagnostics.append(Diagnostic("mount-unknown", WARNING, name, facts=facts))
    for phase, deviation in result.posed.items() if is_closed.any() else ():
        if deviation > CONTRADICTED:
            diagnostics.append(Diagnostic("pose-contradicted", WARNING, phase, deviation, CONTRADICTED))
    least_std = 0.0 if problem.model.table.is_mechanism else LEAST_LENGTH_STD
    return Calibration(
        problem=problem,
        subject=subject,
        effective_sample_size=result.effective_sample_size,
        scale_std=scale_std,
        remarks=tuple(diagnostics),
        time=problem.recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=result.contact,
        quat_WL=problem.orient_segments(subject.mounts, samples),
        measured_lengths=compare_measured(fit, problem.measured, least_std),
        hinge_rms=hinge_rms,
        posed=result.posed,
    )


def _make_subject(problem: CalibrationProblem, fit: LeastSquares, x_cov: np.ndarray, scatter: float) -> Subject:
    """Return the subject of a solution, without hinges; `scatter` is that of its soft tissue (`TissueMean`)."""
    R_VS_start, layout, x = problem.filtered.R_VS_start, fit.observations.layout, fit.x
    std, R_WS_start, offsets, drifts = np.sqrt(np.diag(x_cov)), {}, {}, {}
    headings = dict(zip(layout.sensors, x[layout.heading].tolist(), strict=True))
    # The mounts of sensors outside the chain are those of the start pose.
    headings |= problem.stated_headings([name for name in R_VS_start if name not in headings])
    for name, psi in headings.items():
        R_WS_start[name] = Rotation.from_rotvec([0.0, 0.0, psi]) * R_VS_start[name]
    for name, tilt, drift in zip(layout.sensors, layout.tilt, layout.drift, strict=True):
        R_WS_start[name] = Rotation.from_rotvec(-np.append(x[tilt], 0.0)) * R_WS_start[name]
        offset_std = np.minimum(std[tilt], np.pi)  # no angle is more uncertain than half a turn
        offsets[name] = StartPoseOffset(x[tilt], float(np.sqrt(np.mean(offset_std**2))))
        drifts[name] = HeadingDrift(float(x[drift]), float(std[drift]))
    order, covariance = _project_to_subject(problem, layout, x_cov, scatter)
    girdles = {term.name: values for term, values in zip(layout.girdles, x[layout.girdle], strict=True)}
    return replace(
        problem.prior,
        name=problem.recording.name,
        start_pose_offset=offsets,
        heading_drift=drifts,
        lengths=dict(zip(layout.lengths, x[layout.length].tolist(), strict=True)),
        girdles={**problem.prior.girdles, **girdles},
        order=order,
        covariance=covariance,
        mounts={name: (problem.start_rotation(name).inv() * R_WS).as_quat() for name, R_WS in R_WS_start.items()},
    )


def _estimate_hinges(
    problem: CalibrationProblem, fit: LeastSquares, x_cov: np.ndarray
) -> tuple[dict[str, Hinge], dict[str, float]]:
    """Return joint → its hinge, and the root mean square [rad] by which its segment leaves the plane across it."""
    layout, hinges, hinge_rms = fit.observations.layout, {}, {}
    spans = [span for c, span in fit.observations.spans() if isinstance(c, Loop | FreeMotion)]
    lags = {
        segment: float(fit.x[row])
        for (segment, *_), row in zip(layout.twists, layout.twist, strict=True)
        if x_cov[row, row] < MOST_LAG_STD**2
    }
    for k, (term, (across, tilted)) in enumerate(zip(layout.hinges, fit.x[layout.hinge], strict=True)):
        if spans:
            axis = np.array(term.axis) + across * np.array(term.across) + tilted * np.array(term.tilted)
            axis_L = problem.start_rotation(term.on).inv().apply(axis / np.linalg.norm(axis))
            bending = np.concatenate([fit.residuals[span, GAP_ROWS + k] for span in spans])
            hinge_rms[term.name] = rms = float(HINGE_STD * np.sqrt(np.mean(bending**2)))
            std = max(rms, problem.model.table.hinges[term.name].softness)
            hinges[term.name] = Hinge(axis_L, std, lags.get(term.on))
    return hinges, hinge_rms


def _project_to_subject(
    problem: CalibrationProblem, layout: Layout, covariance: np.ndarray, scatter: float
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and covariance of the lengths, mount errors and girdles, from that of x.

    Mounts are R_LS = exp(−ε) Rz(ψ) R_VS(start). Their errors are turned from the frames that equal W in the start pose
    to those of the segments. The tilt of a new mount is that of one recording: soft tissue in any pose is added to it.
    That of the segment that faces x in the start pose turns the headings of all mounts alike. By how much a person
    turns a segment about the vertical in the start pose is not in them: no closure shows it.
    """
    K, rows = len(layout.lengths), [row for name in layout.sensors for row in mount_rows(name)]
    of_girdles = [f"girdles.{term.name}.{parameter}" for term in layout.girdles for parameter in PARAMETERS]
    T = np.zeros((K + len(rows) + len(of_girdles), layout.size))
    T[:K, :K] = np.eye(K)
    T[K + len(rows) :, layout.girdle.ravel()] = np.eye(len(of_girdles))
    for i, name in enumerate(layout.sensors):
        own = np.zeros((3, layout.size))
        own[[0, 1], layout.tilt[i]] = -1.0
        own[2, layout.heading[i]] = 1.0
        T[K + 3 * i : K + 3 * i + 3] = problem.start_pose.rotation(name).T @ own
    projected = T @ covariance @ T.T
    if not problem.model.table.is_mechanism:
        shown = [k for k, name in enumerate(layout.lengths) if name in problem.lengths_in_closures]
        projected[shown, shown] += JOINT_CENTRE_STD**2
    known = {} if problem.recording.remounted else problem.prior.mounts
    segments = problem.model.table.segments
    tissue = {name: scatter * np.array(segment.soft_tissue.std) for name, segment in segments.items()}
    up = np.zeros(len(projected))  # the vertical of the start pose, in the frames of the new mounts' segments
    for i, name in enumerate(layout.sensors):
        if name not in known:
            mount, R_WL = slice(K + 3 * i, K + 3 * i + 3), problem.start_pose.rotation(name)
            up[mount] = R_WL[2]
            horizontal = R_WL[:2].T @ R_WL[:2]
            projected[mount, mount] += horizontal @ np.diag(tissue[name] ** 2) @ horizontal
    projected += tissue[problem.model.table.reference][2] ** 2 * np.outer(up, up)
    return (*layout.lengths, *rows, *of_girdles), projected
