"""From a hands-together recording to a subject: lengths, mounts and headings with their joint covariance.

While the palms are held together the chain shoulder–arm–palm–palm–arm–shoulder is closed: the gap

    g(ℓ) = R_torso e_y w + Σ_left R_i(−e_z) ℓ_i − Σ_right R_i(−e_z) ℓ_i

is zero. It is linear and homogeneous in the lengths ℓ, unless a length of the chain is known as it is on a robot:

- Nothing in g fixes the scale: ℓ = 0 closes the chain perfectly. Errors of the orientations even favour it, since they
  add to ‖g‖² in proportion to ‖ℓ‖². So the residual is the gap whitened by its covariance under these errors, which
  does not change with the scale (total instead of ordinary least squares). A measured length gives the scale, else the
  population prior.
- What the gap does not show keeps the prior: `trunk` cancels, and of a hand without a sensor the gap shows only the sum
  forearm + hand, which the prior splits.
- Headings of sensors are not known, they drift, nobody holds the start pose exactly, and soft tissue moves under the
  sensors. None of this is noise that averages out, so all of it is estimated beside the lengths (`equations`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..arguments import Positive, check_arguments, check_names
from ..body import BodyModel, BodyTable, convert_breadths, list_breadths
from ..body.body import load_sensed_model
from ..body.girdle import PARAMETERS
from ..body.soft_tissue import estimate_pose_share, estimate_scatter
from ..body.subject import Hinge, Subject, girdle_rows, mount_rows, population_subject
from ..body.table import check_segments
from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import BadModel, BadOption, BadSession, NoSolution, one_of
from ..filters import BEST, METHODS, SensorFilters, collect_orientations
from ..filters.phases import find_reference_phases
from ..recording import Recording
from .equations import GAP_ROWS, HINGE_STD, Layout, build_prior
from .headings import add_couplings, search_headings
from .least_squares import CONTRADICTED, LeastSquares, compare_measured, estimate_covariance, solve_reweighted
from .paper import Formulation, solve_paper_calibration
from .problem import LEAST_S, SAMPLE_RATE_HZ, CalibrationProblem, find_layout
from .protocols import ALSO, Closure, FreeMotion, Protocol, choose_protocol, load_protocol
from .result import LEAST_ROTATION, OTHER_HEADING, Calibration, assess, measure_doubt, measure_rotations

# One standard deviation [m] of a length measured over the skin, where the user gives none.
MEASURED_STD = 0.003
LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible
MEASURED_RANGE = 0.02, 1.0  # [m] of lengths that a user may measure
# [m] to which a length between joint centres is known at best: of simulated people with exact hinges, sums and
# differences of lengths that were stated to 0.1 mm are off by 0.2 to 1 mm.
JOINT_CENTRE_STD = 0.0003
WIDE = 0.15  # [m] a gap that neither the prior's lengths nor headings some degrees off explain
MOST_LAG_STD = 0.15  # [rad/rad] from which on the motion does not show how far a sensor lags behind a twist
QUICK_RATE_HZ = 1.0  # of samples that decide whether labels and mounts can be as stated
BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one
MOST_OPEN = 0.3  # of a closure's samples, with that other labelling

Alternative = Callable[[CalibrationProblem], CalibrationProblem]  # with other labels, or without some mounts


def calibrate(
    recording: Recording,
    *,
    measured: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    stature: Positive | None = None,
    sex: Literal["f", "m"] | None = None,
    model: BodyModel | str | Path | None = None,
    protocol: str | Path | Protocol | None = None,
    method: str = BEST,
    measured_std: Positive = MEASURED_STD,
    formulation: Formulation = "full",
) -> Calibration:
    """Calibrate a subject: estimate lengths and mounts with their covariance from joined hands, or another protocol.

    Joined hands determine the proportions of the arms and not their scale: that comes from a measured length. A poor
    or failed calibration raises nothing: it is returned, and its `quality` says so.

    Parameters
    ----------
    recording : Recording
        With the phases of the protocol, "clasp" for joined hands.
    measured : mapping of names to [m], optional
        Use these measured lengths: biacromial, the breadth over the bony edges on top of the shoulders, or a name of
        [lengths] in subject.toml, such as left_forearm, from joint centre to joint centre. Without any the scale is
        that of the prior.
    prior : Subject, optional
        Use the subject of an earlier calibration of the same person as the prior, so that each session adds to what is
        known; its mounts too, unless the session has remounted = true. Without it the population prior.
    stature : float, optional
        Narrow the population prior to people of this body height [m].
    sex : "f" or "m", optional
        Narrow the population prior to women or men.
    model : BodyModel, str or Path, optional
        As in `track`.
    protocol : str, Path or Protocol, optional
        Calibrate by this protocol, or several joined by +, as in clasp+t_pose: clasp (hands together), t_pose (arms
        sideways), bow (the trunk bends forwards), table (both palms on a table), tip (of a robot's arm: its point "tip"
        on a fixed point), free (any motion: headings and mounts alone), or a file of your own, made like those in
        calibration/. Without it clasp, and t_pose and bow where the session has those phases.
    method : str
        As in `track`.
    measured_std : float
        Standard deviation [m] of each measured value; 3 mm by default.
    formulation : "full" or "paper"
        Estimate by this formulation: full (lengths, mounts, headings, their drift and soft tissue together, with
        priors) or paper (Lisini Baldi et al. 2019: the lengths alone, with stated mounts and a measured length).

    Returns
    -------
    Calibration
        `subject`, which `track` takes; `quality`, whose `quality` is "pass", "poor" or "fail"; `diagnostics`.

    Raises
    ------
    BadOption
        An unknown protocol, method or formulation; a measured name that is no length of the body, an implausible value,
        or none with the formulation "paper".
    BadSession, BadPhase
        The recording lacks a sensor or a phase that the protocol needs.
    BadModel
        The table of the body names no lengths.
    BadSubject, NoSolution
        The prior has no positive definite covariance of its lengths; the lengths do not converge.

    Examples
    --------
    >>> calibration = wp.calibrate(recording, measured={"shoulder_width": 0.33})
    >>> calibration.quality.quality
    'poor'
    >>> [diagnostic.code for diagnostic in calibration.diagnostics]
    ['motion-too-small']
    >>> wp.track(recording, calibration).subject.quality
    'poor'
    """
    check_arguments(calibrate, locals())
    check_names("method", [method], METHODS)
    is_stated = protocol is not None
    if not isinstance(protocol, Protocol):
        protocol = load_protocol(choose_protocol(recording.phases, formulation) if protocol is None else protocol)
    if not isinstance(model, BodyModel):
        model = load_sensed_model(model or recording.model or None, recording.sensors, recording.where())
    _check_inputs(recording, protocol, model, measured or {})
    if prior is not None and (stature is not None or sex is not None):
        raise BadOption("prior has the lengths of a person; stature and sex narrow those of the population")
    prior = prior or population_subject(stature, sex, model)
    prior.check_body(model.table)
    lengths = convert_breadths(measured or {}, model.table, measured_std)
    start, _, noises, diagnostics = find_reference_phases(recording, not model.table.is_mechanism)
    filtered = SensorFilters(noises, method=method, start=recording.span(start)).push(recording)
    recording, R_VS = replace(recording, diagnostics=tuple(diagnostics)), collect_orientations(recording, filtered)
    earlier = prior if prior.start_pose_offset and formulation == "full" else None
    if earlier is not None:  # the two calibrations are fused, each on the population prior
        prior = separate_mounts(earlier, population_subject(body=model))
    problem = CalibrationProblem(recording, R_VS, start, find_layout(protocol, model, recording), prior, lengths)
    short = {} if is_stated else {phase: time for phase, time in problem.short_phases.items() if phase in ALSO}
    if short:  # the phases of the default protocol without which it works as well
        unused = [Diagnostic("phase-not-used", WARNING, phase, time, LEAST_S) for phase, time in short.items()]
        recording = replace(recording, diagnostics=(*recording.diagnostics, *unused))
        protocol = load_protocol(choose_protocol(recording.phases.keys() - short.keys(), formulation))
        problem = replace(problem, recording=recording, layout=find_layout(protocol, model, recording))
    calibration = solve_paper_calibration(problem) if formulation == "paper" else solve_plausible(problem)
    if earlier is not None:
        fused = fuse_calibrations(earlier, calibration.subject, model.table)
        calibration = replace(calibration, subject=fused, problem=replace(calibration.problem, prior=earlier))
    quality = assess(calibration)
    subject = replace(calibration.subject, quality=quality.quality)
    if any(check.quality == "fail" and not check.diagnostic.code.endswith("-uncertain") for check in quality.checks):
        # Something contradicts the estimate, which its ± does not show.
        subject, calibration = _widen(subject, calibration.problem.prior), replace(calibration, scale_std=float("nan"))
    return replace(calibration, quality=quality, subject=subject)


def _widen(subject: Subject, prior: Subject) -> Subject:
    """Return a subject with each ± at least that of the prior, and of mounts `OTHER_HEADING`."""
    least = [OTHER_HEADING[1] if row.startswith("mounts.") else prior.std(row) for row in subject.order]
    missing = np.fmax(np.square(least) - np.diagonal(subject.covariance), 0.0)  # a row that is not of the prior has NaN
    return replace(subject, covariance=subject.covariance + np.diag(missing))


def _check_inputs(recording: Recording, protocol: Protocol, model: BodyModel, measured: Mapping[str, float]) -> None:
    """Raise where body, protocol, sensors and measured lengths do not fit each other."""
    check_segments(model.table, recording.sensors, f"{recording.where()}: sensors.", BadSession)
    if not model.table.lengths:
        remedy = "a table beside the URDF names its points and [lengths], as docs/models.md shows"
        raise BadModel(f"{model.table.where}: this body has no lengths; {remedy}")
    protocol.check_body(model.table)
    names, (low, high) = (*model.lengths, *list_breadths(model.table)), MEASURED_RANGE
    for name, metres in measured.items():
        if name not in names:
            raise BadOption(f"measured {name}: not a length; {one_of(names, name)}")
        if not low < metres < high:
            raise BadOption(f"measured {name}={metres:g}: a length in metres is needed, between {low} and {high}")
    for segment in protocol.needs:
        if segment not in recording.sensors:
            needs = f"protocol '{protocol.name}' needs one each on {', '.join(protocol.needs)}"
            raise BadSession(f"{recording.where()}: no sensor on {segment}; {needs}")


def solve_plausible(problem: CalibrationProblem) -> Calibration:
    """Return the solution without the mounts that gravity or the motion contradicts, its labels checked.

    Alternatives are tried quickly. The best one replaces the problem if the limbs move as a person's with it.
    """
    problem = problem.leave_out_mounts()
    problem.observe()  # raises where a phase is too short
    best = stated = solve_problem(problem, quick=True)
    for list_alternatives, better, open_share in (
        (list_mount_alternatives, np.inf, 1.0),
        (list_label_alternatives, BETTER, MOST_OPEN),
    ):
        stated = best
        limit = min(1.0, better * measure_doubt(stated)[0])
        tried = [solve_problem(change(stated.problem), quick=True) for change in list_alternatives(stated)]
        doubts = [measure_doubt(each)[0] if each.open_share <= open_share else np.inf for each in tried]
        if min(doubts, default=np.inf) < limit:
            best = tried[int(np.argmin(doubts))]
    if best.problem.exchanged:
        subject = replace(stated.subject, note="sensors sit elsewhere than labelled")
        return replace(stated, subject=subject, remarks=(), exchanged=best.problem.exchanged)
    pose_share = estimate_pose_share(best.subject.start_pose_offset, problem.model.table)
    try:
        return solve_problem(replace(best.problem, pose_share=pose_share))
    except NoSolution as error:
        raise NoSolution(f"{problem.recording.where()}: {error}") from error


def list_mount_alternatives(stated: Calibration) -> list[Alternative]:
    """Return how to leave out mounts that the motion contradicts; none where the quick solution gives no reason."""

    def leave_out_contradicted(problem: CalibrationProblem) -> CalibrationProblem:
        free = solve_problem(problem.remove_mounts(problem.R_VS), quick=True)
        return problem.leave_out_mounts(free.subject.mounts)

    contradicted = stated.problem.leave_out_mounts(stated.subject.mounts).unused_mounts != stated.problem.unused_mounts
    return [leave_out_contradicted] if contradicted or measure_doubt(stated)[0] > 1.0 else []


def list_label_alternatives(stated: Calibration) -> list[Alternative]:
    """Return exchanges of two sensors, and of both sides; none where limbs move as a person's or a gyroscope is wrong.

    Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
    give the same gap. The solution's elbows then bend backward, or sideways, as a person's cannot. Any other exchange
    opens the chain.
    """
    rotations, table = [*measure_rotations(stated).values()], stated.problem.model.table
    if measure_doubt(stated)[0] <= 1.0 or table.is_mechanism or not rotations or np.median(rotations) < LEAST_ROTATION:
        return []
    if any(each.code == "gyro-contradicted" for each in stated.problem.recording.diagnostics):
        return []
    places = [name for name in stated.problem.layout.sensors if name in table.needed]
    exchanges = [dict((pair, pair[::-1])) for pair in combinations(places, 2)]
    sides = [pair for pair in table.pairs.items() if set(pair) <= set(places)]
    exchanges.append({a: b for pair in sides for a, b in (pair, pair[::-1])})
    return [partial(CalibrationProblem.relabel, exchanged=exchange) for exchange in exchanges]


# Solution -------------------------------------------------------------------------------------------------------------


def solve_problem(problem: CalibrationProblem, *, quick: bool = False) -> Calibration:
    """Return the calibration; it raises `NoSolution` where it did not converge.

    `quick`: at fewer samples and by the closure alone, which shows whether mounts and labels can be as stated, and
    raises nothing.
    """
    data, condition_index, samples = problem.observe(QUICK_RATE_HZ if quick else SAMPLE_RATE_HZ)
    layout, sensors = problem.layout, {name: problem.sensor_prior(name) for name in problem.layout.sensors}
    mean, information = build_prior(layout, problem.prior, problem.measured, sensors)
    weights, contact = np.ones((len(samples), layout.residuals)), np.ones(len(samples))
    fit = LeastSquares(layout, data, condition_index, (mean, information), mean.copy(), weights, contact)
    couplings = None if quick and problem.protocol.closures else problem.couplings
    headings = search_headings(fit, problem.stated_headings, couplings)
    is_free = [name not in problem.stated_headings for name in layout.sensors]
    mean[layout.heading[is_free]] = headings[is_free]
    prior = add_couplings((mean, information), couplings) if couplings else (mean, information)
    start = fit.place_points(prior[0])
    # The weight of a gap in the initial guess: near 0 where the palms are apart.
    contact = (1.0 + np.sum(fit.measure_gaps(start) ** 2, axis=1) / WIDE**2) ** -2
    fit = solve_reweighted(replace(fit, prior=prior, x=start, contact=contact), quick)
    return _describe(problem, samples, fit, fit.covariance if quick else estimate_covariance(fit))


def _describe(problem: CalibrationProblem, samples: np.ndarray, fit: LeastSquares, x_cov: np.ndarray) -> Calibration:
    """Return the calibration that a solution at samples (n,) makes, with the covariance (m, m) of x."""
    layout, prior = problem.layout, problem.prior
    closed = np.array([isinstance(condition, Closure) for condition in layout.conditions])[fit.condition_index]
    lengths, covariance = fit.x[layout.length], x_cov[np.ix_(layout.length, layout.length)]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1) if len(lengths) else float("nan")
    scale = "of the population prior" if prior.is_population else f"of {prior.name}"
    if problem.scale_lengths:
        scale = f"measured: {', '.join(problem.scale_lengths)}"
    elif layout.scale_observed:
        scale = "of the closure"
    hinges, hinge_rms = _estimate_hinges(fit, x_cov)
    scatter = estimate_scatter([hinge.std for hinge in hinges.values()])
    subject = _make_subject(problem, fit, x_cov, scatter)
    subject = replace(subject, hinges=hinges, note=f"{problem.protocol.title}; scale {scale}")
    diagnostics = [*problem.recording.diagnostics, *problem.diagnose_losses()]
    if not problem.protocol.closures:
        facts = {"protocol": problem.protocol.title, "prior": prior.note or prior.name}
        diagnostics.append(Diagnostic("lengths-not-observed", INFO, facts=facts))
    for name in [name for name in problem.R_VS if name not in subject.mounts]:
        diagnostics.append(Diagnostic("mount-unknown", WARNING, name, facts={"protocol": problem.protocol.name}))
    for phase, deviation in fit.posed.items():
        if deviation > CONTRADICTED and fit.closures:
            diagnostics.append(Diagnostic("pose-contradicted", WARNING, phase, deviation, CONTRADICTED))
    return Calibration(
        problem=problem,
        subject=subject,
        effective_sample_size=fit.effective_sample_size,
        scale_std=scale_std,
        remarks=tuple(diagnostics),
        time=problem.recording.time[samples],
        gap=np.where(closed, np.linalg.norm(fit.measure_gaps(fit.x), axis=1), np.nan),
        contact=fit.contact,
        quat_WL=problem.orient_segments(subject.mounts, samples),
        measured_lengths=compare_measured(fit, problem.measured),
        hinge_rms=hinge_rms,
        posed=fit.posed,
    )


def _make_subject(problem: CalibrationProblem, fit: LeastSquares, x_cov: np.ndarray, scatter: float) -> Subject:
    """Return the subject of a solution, without hinges; `scatter` is that of its soft tissue (`estimate_scatter`)."""
    R_VS_start, layout, x = problem.R_VS_start, fit.layout, fit.x
    std, R_WS_start, offsets, drifts = np.sqrt(np.diag(x_cov)), {}, {}, {}
    for name, heading, tilt, drift in zip(layout.sensors, layout.heading, layout.tilt, layout.drift, strict=True):
        R_WV = Rotation.from_rotvec([0.0, 0.0, x[heading]])
        R_WS_start[name] = Rotation.from_rotvec(-np.append(x[tilt], 0.0)) * (R_WV * R_VS_start[name])
        offset_std = np.minimum(std[tilt], np.pi)  # no angle is more uncertain than half a turn
        offsets[name] = np.append(x[tilt], np.sqrt(np.mean(offset_std**2)))
        drifts[name] = np.array([x[drift], std[drift]])
    # The mounts of sensors outside the chain are those of the start pose.
    for name in [name for name in problem.stated_headings if name not in R_WS_start]:
        R_WS_start[name] = Rotation.from_rotvec([0.0, 0.0, problem.stated_headings[name]]) * R_VS_start[name]
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


def _estimate_hinges(fit: LeastSquares, x_cov: np.ndarray) -> tuple[dict[str, Hinge], dict[str, float]]:
    """Return joint → its hinge, and the root mean square [rad] by which its segment leaves the plane across it."""
    layout, hinges, hinge_rms = fit.layout, {}, {}
    spans = [span for c, span in fit.spans if isinstance(c, Closure | FreeMotion)]
    twists = zip(layout.twists, layout.twist, strict=True)
    lags = {hinge.on: float(fit.x[row]) for hinge, row in twists if x_cov[row, row] < MOST_LAG_STD**2}
    carrying = dict(zip(layout.carried, fit.x[layout.carrying].tolist(), strict=True))
    for k, (term, (across, tilted)) in enumerate(zip(layout.hinges, fit.x[layout.hinge], strict=True)):
        if spans:
            axis = np.array(term.axis) + across * term.across + tilted * term.tilted
            axis_L = layout.start_pose.rotation(term.on).T @ axis / np.linalg.norm(axis)
            bending = np.concatenate([fit.residuals[span, GAP_ROWS + k] for span in spans])
            hinge_rms[term.name] = rms = float(HINGE_STD * np.sqrt(np.mean(bending**2)))
            hinges[term.name] = Hinge(axis_L, rms, lags.get(term.on), carrying.get(term.name))
    return hinges, hinge_rms


def _project_to_subject(
    problem: CalibrationProblem, layout: Layout, covariance: np.ndarray, scatter: float
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and covariance of the lengths, mount errors and girdles, from that of x.

    Mounts are R_LS = exp(−ε) Rz(ψ) R_VS(start). Their errors are turned from the frames that equal W in the start pose
    to those of the segments. The tilt of a new mount is that of one recording: soft tissue in any pose is added to it,
    and tracking does not add it again (`Subject.shape`).
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


# Earlier calibrations -------------------------------------------------------------------------------------------------


def separate_mounts(earlier: Subject, population: Subject) -> Subject:
    """Return the population prior with the mounts of an earlier calibration."""
    rows = [row for row in earlier.order if row.startswith("mounts.")]
    at = [earlier.order.index(row) for row in rows]
    covariance = block_diag(population.covariance, earlier.covariance[np.ix_(at, at)])
    order = (*population.order, *rows)
    return replace(
        population,
        name=earlier.name,
        mounts=earlier.mounts,
        start_pose_offset=earlier.start_pose_offset,
        order=order,
        covariance=covariance,
    )


def fuse_calibrations(earlier: Subject, subject: Subject, table: BodyTable) -> Subject:
    """Return the subject with lengths and girdles of an earlier calibration too; its mounts follow by correlation.

    Most of a calibration's error comes again in the next one. So each is solved on the population prior, and they are
    fused by covariance intersection, which holds whatever their errors have in common (Julier and Uhlmann 1997).
    """
    shape_rows, still = (*table.lengths, *girdle_rows(table)), np.zeros(len(PARAMETERS))
    x, C = [], []
    for each in (earlier, subject):
        own = [each.girdles.get(name, still) for name in table.girdles]
        x.append(np.concatenate(([each.lengths[name] for name in table.lengths], *own)))
        C.append(each.shape_covariance(table) + LEAST_STD**2 * np.eye(len(shape_rows)))
    # The share of each is the larger the less uncertain its lengths are (Niehsen 2002).
    k = len(table.lengths)
    variance = np.array([np.trace(each[:k, :k]) for each in C])
    shares, K = variance[::-1] / variance.sum(), np.linalg.inv(C)
    fused = np.linalg.inv(np.tensordot(shares, K, axes=1))
    mean = fused @ sum(share * each @ own for share, each, own in zip(shares, K, x, strict=True))

    order = [*subject.order, *(row for row in shape_rows if row not in subject.order)]
    missing = len(order) - len(subject.order)
    covariance = block_diag(subject.covariance, np.zeros((missing, missing)))
    at = [order.index(row) for row in shape_rows]
    gain = covariance[:, at] @ K[1]
    gain[at] = np.eye(len(at))
    covariance += gain @ (fused - covariance[np.ix_(at, at)]) @ gain.T
    moved = dict(zip(order, gain @ (mean - x[1]), strict=True))
    mounts = {}
    for segment, quat in subject.mounts.items():
        turn = [moved.get(f"mounts.{segment}.{axis}", 0.0) for axis in "xyz"]
        mounts[segment] = (Rotation.from_rotvec(turn) * Rotation.from_quat(quat)).as_quat()
    return replace(
        subject,
        lengths=dict(subject.lengths) | dict(zip(table.lengths, mean[:k].tolist(), strict=True)),
        girdles=dict(zip(table.girdles, mean[k:].reshape(-1, len(PARAMETERS)), strict=True)),
        mounts=mounts,
        order=tuple(order),
        covariance=covariance,
    )
