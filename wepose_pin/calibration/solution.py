"""The solution of a calibration's problem, quick or in full, and the `Calibration` that it makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.girdle import PARAMETERS
from ..body.soft_tissue import estimate_scatter
from ..body.subject import HeadingDrift, Hinge, StartPoseOffset, Subject, mount_rows
from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import NoSolution
from .ambiguity import include_other_minima
from .conditions import Loop, Moving, is_scale_observed
from .couplings import add_couplings
from .equations import GAP_ROWS, HINGE_STD, Layout
from .initial_headings import search_headings
from .least_squares import MIN_LENGTH, Estimate, Gaussian
from .priors import build_prior, place_points
from .problem import SAMPLE_RATE_HZ, CalibrationProblem
from .result import Calibration
from .weights import (
    CONTRADICTED,
    LEAST_LENGTH_STD,
    WeightedFit,
    compare_measured,
    estimate_covariance,
    solve_reweighted,
)

WIDE = 0.15  # [m] a gap that neither the prior's lengths nor headings some degrees off explain
MOST_LAG_STD = 0.15  # [rad/rad] from which on the motion does not show how far a sensor lags behind a twist
QUICK_RATE_HZ = 1.0  # of samples that decide whether labels and mounts can be as stated


def solve_problem(problem: CalibrationProblem, *, quick: bool = False) -> Calibration:
    """Return the calibration, with other minima that explain the motion nearly as well.

    Parameters
    ----------
    quick : at fewer samples and by the closure alone, which shows whether mounts and labels can be as stated

    Raises
    ------
    NoSolution
        It did not converge, or a length is at its bound; not where it is quick.
    """
    observations, samples = problem.observe(QUICK_RATE_HZ if quick else SAMPLE_RATE_HZ)
    layout, prior = observations.layout, build_prior(problem, observations)
    couplings = [] if quick and problem.protocol.closures else problem.couplings
    stated = problem.stated_headings(layout.sensors)
    is_free = np.array([name not in stated for name in layout.sensors])

    def prior_at(psi: np.ndarray) -> Gaussian:
        """Return the prior with couplings, and with unknown headings at ψ (sensors,) [rad]."""
        mean = prior.mean.copy()
        mean[layout.heading] = np.where(is_free, psi, mean[layout.heading])
        return add_couplings(Gaussian(mean, prior.information), layout, couplings, mean)

    headings = search_headings(observations, prior.mean, stated, couplings)
    start = place_points(prior_at(headings[0]).mean, observations)
    # The weight of a gap in the initial guess: near 0 where the palms are apart.
    contact = (1.0 + np.sum(observations.gaps(start) ** 2, axis=1) / WIDE**2) ** -2
    result = solve_reweighted(observations, prior_at(headings[0]), start, contact, quick)
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


def _describe(problem: CalibrationProblem, samples: np.ndarray, result: WeightedFit, x_cov: np.ndarray) -> Calibration:
    """Return the calibration that a solution at samples (n,) makes, with the covariance (m, m) of x."""
    fit, observations = result.fit, result.fit.problem.observations
    layout = observations.layout
    lengths, covariance = fit.x[layout.length], x_cov[np.ix_(layout.length, layout.length)]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1) if len(lengths) else float("nan")
    scale_observed = is_scale_observed(problem.conditions)
    scale = "of the population prior" if problem.prior.is_population else f"of {problem.prior.name}"
    if problem.scale_lengths or scale_observed:
        scale = f"measured: {', '.join(problem.scale_lengths)}" if problem.scale_lengths else "of the closure"
    hinges = _estimate_hinges(problem, fit, x_cov)
    scatter = estimate_scatter([hinge.std for hinge, _ in hinges.values()])
    subject = _make_subject(problem, fit, x_cov, scatter)

    prior_x = fit.x.copy()
    prior_x[layout.length] = [problem.prior.lengths[name] for name in layout.lengths]
    gap, prior_gap = (
        np.where(observations.closed, np.linalg.norm(gaps, axis=1), np.nan)
        for gaps in (fit.gaps, observations.gaps(place_points(prior_x, observations)))
    )
    diagnostics = [*problem.filtered.diagnostics, *problem.diagnose_losses()]
    if not problem.protocol.closures:
        facts = {"protocol": problem.protocol.title, "prior": problem.prior.note or problem.prior.name}
        diagnostics.append(Diagnostic("lengths-not-observed", INFO, facts=facts))
    for name in problem.filtered.R_VS:
        if name not in subject.mounts:
            facts = {"protocol": problem.protocol.name}
            diagnostics.append(Diagnostic("mount-unknown", WARNING, name, facts=facts))
    for phase, deviation in result.posed.items() if observations.closed.any() else ():
        if deviation > CONTRADICTED:
            variant: dict[str, float | str] = {"variant": "unused"}
            unused = Diagnostic("pose-contradicted", WARNING, phase, deviation, CONTRADICTED, variant)
            diagnostics.append(unused)
    least_std = 0.0 if problem.model.table.is_mechanism else LEAST_LENGTH_STD
    return Calibration(
        problem=problem,
        subject=replace(
            subject,
            hinges={joint: hinge for joint, (hinge, _) in hinges.items()},
            note=f"{problem.protocol.title}; scale {scale}",
        ),
        effective_sample_size=result.effective_sample_size,
        scale_std=scale_std,
        remarks=tuple(diagnostics),
        time=problem.recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=result.contact,
        quat_WL=problem.orient_segments(subject.mounts, samples),
        measured_lengths=compare_measured(fit, layout, problem.measured, least_std),
        hinge_rms={joint: rms for joint, (_, rms) in hinges.items()},
        posed=result.posed,
    )


def _make_subject(problem: CalibrationProblem, fit: Estimate, x_cov: np.ndarray, scatter: float) -> Subject:
    """Return the subject of a solution, without hinges; `scatter` is that of its soft tissue (`TissueMean`)."""
    filtered, layout, x = problem.filtered, fit.problem.observations.layout, fit.x
    mounts, offsets, drifts = {}, {}, {}
    std = np.sqrt(np.diag(x_cov))
    for name, tilt, heading, drift in zip(layout.sensors, layout.tilt, layout.heading, layout.drift, strict=True):
        start_W = Rotation.from_rotvec(-np.append(x[tilt], 0.0)) * Rotation.from_rotvec([0.0, 0.0, x[heading]])
        mounts[name] = (problem.start_rotation(name).inv() * start_W * filtered.R_VS_start[name]).as_quat()
        offset_std = np.minimum(std[tilt], np.pi)  # no angle is more uncertain than half a turn
        offsets[name] = StartPoseOffset(x[tilt], float(np.sqrt(np.mean(offset_std**2))))
        drifts[name] = HeadingDrift(float(x[drift]), float(std[drift]))
    # The mounts of sensors outside the chain are those of the start pose.
    for name, psi in problem.stated_headings([name for name in filtered.R_VS if name not in mounts]).items():
        start_W = Rotation.from_rotvec([0.0, 0.0, psi]) * filtered.R_VS_start[name]
        mounts[name] = (problem.start_rotation(name).inv() * start_W).as_quat()
    order, covariance = _project_to_subject(problem, layout, x_cov, scatter)
    return replace(
        problem.prior,
        name=problem.recording.name,
        start_pose_offset=offsets,
        heading_drift=drifts,
        lengths=dict(zip(layout.lengths, x[layout.length].tolist(), strict=True)),
        girdles=dict(problem.prior.girdles)
        | {term.name: values for term, values in zip(layout.girdles, x[layout.girdle], strict=True)},
        order=order,
        covariance=covariance,
        mounts=mounts,
    )


def _estimate_hinges(
    problem: CalibrationProblem, fit: Estimate, x_cov: np.ndarray
) -> Mapping[str, tuple[Hinge, float]]:
    """Joint → its hinge, and the root mean square [rad] by which its segment leaves the plane across it."""
    hinges, observations = {}, fit.problem.observations
    layout = observations.layout
    moving = [fit.residuals[span, GAP_ROWS:] for c, span in observations.spans() if isinstance(c, Loop | Moving)]
    bending = np.concatenate([fit.residuals[:0, GAP_ROWS:], *moving])
    lags = {
        twist.segment: float(fit.x[row])
        for twist, row in zip(layout.twists, layout.twist, strict=True)
        if x_cov[row, row] < MOST_LAG_STD**2
    }
    for k, (term, (across, tilted)) in enumerate(zip(layout.hinges, fit.x[layout.hinge], strict=True)):
        if len(bending):
            axis = np.array(term.axis) + across * np.array(term.across) + tilted * np.array(term.tilted)
            axis_L = problem.start_rotation(term.on).inv().apply(axis / np.linalg.norm(axis))
            rms = float(HINGE_STD * np.sqrt(np.mean(bending[:, k] ** 2)))
            std = max(rms, problem.model.table.hinges[term.name].softness)
            hinges[term.name] = Hinge(axis_L, std, lags.get(term.on)), rms
    return hinges


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
    known = {} if problem.recording.remounted else problem.prior.mounts
    segments = problem.model.table.segments
    tissue = {name: scatter * np.array(segment.soft_tissue.std) for name, segment in segments.items()}
    headings = K + 3 * np.array([i for i, name in enumerate(layout.sensors) if name not in known], dtype=int) + 2
    projected[np.ix_(headings, headings)] += tissue[problem.model.table.reference][2] ** 2
    for i in (headings - K) // 3:
        tilts = K + 3 * i + np.arange(2)
        projected[tilts, tilts] += np.square(tissue[layout.sensors[i]][:2])
    return (*layout.lengths, *rows, *of_girdles), projected
