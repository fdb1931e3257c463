"""The solution of a calibration's problem, quick or in full, and the `Calibration` that it makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.girdle import PARAMETERS
from ..body.soft_tissue import estimate_scatter
from ..body.subject import Hinge, Subject, mount_rows
from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import NoSolution
from .equations import GAP_ROWS, HINGE_STD, Layout, build_prior
from .headings import add_couplings, search_headings
from .least_squares import (
    CONTRADICTED,
    LEAST_LENGTH_STD,
    MIN_LENGTH,
    LeastSquares,
    compare_measured,
    estimate_covariance,
    solve_reweighted,
)
from .problem import SAMPLE_RATE_HZ, CalibrationProblem
from .protocols import Closure, FreeMotion
from .result import Calibration

# [m] to which a length between joint centres is known at best: of simulated people with exact hinges, sums and
# differences of lengths that were stated to 0.1 mm are off by 0.2 to 1 mm.
JOINT_CENTRE_STD = 0.0003
WIDE = 0.15  # [m] a gap that neither the prior's lengths nor headings some degrees off explain
MOST_LAG_STD = 0.15  # [rad/rad] from which on the motion does not show how far a sensor lags behind a twist
QUICK_RATE_HZ = 1.0  # of samples that decide whether labels and mounts can be as stated


def solve_problem(problem: CalibrationProblem, *, quick: bool = False) -> Calibration:
    """Return the calibration.

    `quick`: at fewer samples and by the closure alone, which shows whether mounts and labels can be as stated. Else
    `NoSolution` is raised where it did not converge, or where a length is at its bound.
    """
    observations, samples = problem.observe(QUICK_RATE_HZ if quick else SAMPLE_RATE_HZ)
    layout, sensors = problem.layout, {name: problem.sensor_prior(name) for name in problem.layout.sensors}
    mean, information = build_prior(layout, problem.prior, problem.measured, sensors)
    couplings = [] if quick and problem.protocol.closures else problem.couplings
    stated = problem.stated_headings(layout.sensors)
    headings = search_headings(observations, mean, stated, couplings)
    is_free = [name not in stated for name in layout.sensors]
    mean[layout.heading[is_free]] = headings[is_free]
    prior = add_couplings((mean, information), layout, couplings, mean)
    start = observations.place_points(prior[0])
    # The weight of a gap in the initial guess: near 0 where the palms are apart.
    contact = (1.0 + np.sum(observations.gaps(start) ** 2, axis=1) / WIDE**2) ** -2
    fit = solve_reweighted(observations, prior, start, contact, quick)
    if quick:
        return _describe(problem, samples, fit, fit.covariance)
    lengths = fit.x[layout.length]
    if np.min(lengths, initial=np.inf) < 1.01 * MIN_LENGTH:  # it lies at its bound, to the solver's accuracy
        raise NoSolution(
            f"the lengths did not converge ({layout.lengths[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} "
            f"mm); check that the points do in the phase what the protocol says, and that every sensor sits where the "
            f"session says"
        )
    return _describe(problem, samples, fit, estimate_covariance(fit))


def _describe(problem: CalibrationProblem, samples: np.ndarray, fit: LeastSquares, x_cov: np.ndarray) -> Calibration:
    """Return the calibration that a solution at samples (n,) makes, with the covariance (m, m) of x."""
    observations, layout, prior, filtered = fit.observations, problem.layout, problem.prior, problem.filtered
    closed = np.zeros(len(observations), dtype=bool)
    for _, span in observations.closures:
        closed[span] = True
    lengths, covariance = fit.x[layout.length], x_cov[np.ix_(layout.length, layout.length)]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1) if len(lengths) else float("nan")
    scale = "of the population prior" if prior.is_population else f"of {prior.name}"
    if problem.scale_lengths:
        scale = f"measured: {', '.join(problem.scale_lengths)}"
    elif layout.scale_observed:
        scale = "of the closure"
    hinges, hinge_rms = _estimate_hinges(problem, fit, x_cov)
    scatter = estimate_scatter([hinge.std for hinge in hinges.values()])
    subject = _make_subject(problem, fit, x_cov, scatter)
    subject = replace(subject, hinges=hinges, note=f"{problem.protocol.title}; scale {scale}")
    prior_x = fit.x.copy()
    prior_x[layout.length] = [prior.lengths[name] for name in layout.lengths]
    gap, prior_gap = (
        np.where(closed, np.linalg.norm(gaps, axis=1), np.nan)
        for gaps in (fit.gaps, observations.gaps(observations.place_points(prior_x)))
    )
    diagnostics = [*filtered.diagnostics, *problem.diagnose_losses()]
    if not problem.protocol.closures:
        facts = {"protocol": problem.protocol.title, "prior": prior.note or prior.name}
        diagnostics.append(Diagnostic("lengths-not-observed", INFO, facts=facts))
    for name in filtered.R_VS:
        if name not in subject.mounts:
            facts = {"protocol": problem.protocol.name}
            diagnostics.append(Diagnostic("mount-unknown", WARNING, name, facts=facts))
    for phase, deviation in fit.posed.items() if observations.closures else ():
        if deviation > CONTRADICTED:
            diagnostics.append(Diagnostic("pose-contradicted", WARNING, phase, deviation, CONTRADICTED))
    least_std = 0.0 if problem.model.table.is_mechanism else LEAST_LENGTH_STD
    return Calibration(
        problem=problem,
        subject=subject,
        effective_sample_size=fit.effective_sample_size,
        scale_std=scale_std,
        remarks=tuple(diagnostics),
        time=problem.recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=fit.contact,
        quat_WL=problem.orient_segments(subject.mounts, samples),
        measured_lengths=compare_measured(fit, problem.measured, least_std),
        hinge_rms=hinge_rms,
        posed=fit.posed,
    )


def _make_subject(problem: CalibrationProblem, fit: LeastSquares, x_cov: np.ndarray, scatter: float) -> Subject:
    """Return the subject of a solution, without hinges; `scatter` is that of its soft tissue (`estimate_scatter`)."""
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
        offsets[name] = np.append(x[tilt], np.sqrt(np.mean(offset_std**2)))
        drifts[name] = np.array([x[drift], std[drift]])
    order, covariance = _project_to_subject(problem, layout, x_cov, scatter)
    girdles = dict(zip(layout.girdles, x[layout.girdle], strict=True))
    return replace(
        problem.prior,
        name=problem.recording.name,
        start_pose_offset=offsets,
        heading_drift=drifts,
        lengths=dict(zip(layout.lengths, x[layout.length].tolist(), strict=True)),
        girdles={**problem.prior.girdles, **girdles},
        order=order,
        covariance=covariance,
        mounts={name: layout.start_pose.to_segment(name, R_WS).as_quat() for name, R_WS in R_WS_start.items()},
    )


def _estimate_hinges(
    problem: CalibrationProblem, fit: LeastSquares, x_cov: np.ndarray
) -> tuple[dict[str, Hinge], dict[str, float]]:
    """Return joint → its hinge, and the root mean square [rad] by which its segment leaves the plane across it."""
    layout, hinges, hinge_rms = fit.observations.layout, {}, {}
    spans = [span for c, span in fit.observations.spans if isinstance(c, Closure | FreeMotion)]
    lags = {
        hinge.on: float(fit.x[row])
        for hinge, row in zip(layout.twists, layout.twist, strict=True)
        if x_cov[row, row] < MOST_LAG_STD**2
    }
    for k, (term, (across, tilted)) in enumerate(zip(layout.hinges, fit.x[layout.hinge], strict=True)):
        if spans:
            axis = np.array(term.axis) + across * np.array(term.across) + tilted * np.array(term.tilted)
            axis_L = layout.start_pose.rotation(term.on).T @ axis / np.linalg.norm(axis)
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
    K, start_pose, table = len(layout.lengths), layout.start_pose, layout.model.table
    names = [*layout.lengths, *(row for name in layout.sensors for row in mount_rows(name))]
    names += [f"girdles.{name}.{parameter}" for name in layout.girdles for parameter in PARAMETERS]
    T, added = np.zeros((len(names), layout.size)), np.zeros((len(names), len(names)))
    T[:K, layout.length] = np.eye(K)
    T[len(names) - layout.girdle.size :, layout.girdle.ravel()] = np.eye(layout.girdle.size)
    if not table.is_mechanism:
        shown = [k for k, name in enumerate(layout.lengths) if name in layout.lengths_in_closures]
        added[shown, shown] = JOINT_CENTRE_STD**2
    known = {} if problem.recording.remounted else problem.prior.mounts
    tissue = {name: scatter * np.array(segment.soft_tissue.std) for name, segment in table.segments.items()}
    up = np.zeros(len(names))  # the vertical of the start pose, in the frames of the new mounts' segments
    for i, name in enumerate(layout.sensors):
        mount, R_WL = slice(K + 3 * i, K + 3 * i + 3), start_pose.rotation(name)
        T[mount, layout.tilt[i]], T[mount, layout.heading[i]] = -R_WL[:2].T, R_WL[2]
        if name not in known:
            up[mount] = R_WL[2]
            horizontal = R_WL[:2].T @ R_WL[:2]
            added[mount, mount] = horizontal @ np.diag(tissue[name] ** 2) @ horizontal
    return tuple(names), T @ covariance @ T.T + added + tissue[table.reference][2] ** 2 * np.outer(up, up)
