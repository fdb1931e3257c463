"""From a hands-together recording to a subject: lengths, mounts and headings with their joint covariance.

While the palms are held together the chain shoulder–arm–palm–palm–arm–shoulder is closed: the gap

    g(ℓ) = R_torso e_y w + Σ_left R_i(−e_z) ℓ_i − Σ_right R_i(−e_z) ℓ_i

is zero. Other bodies and points have other terms (`conditions`). It is linear and homogeneous in the lengths ℓ, unless
a length of the chain is known as it is on a robot, which decides the form of the problem:

- Nothing in g fixes the scale: ℓ = 0 closes the chain perfectly. Errors of the orientations even favour it, since they
  add to ‖g‖² in proportion to ‖ℓ‖². So the residual is the gap whitened by the covariance that errors of the
  orientations give it. That covariance is as homogeneous as the gap, so the residual does not change with the scale
  (total instead of ordinary least squares).
- The scale comes from outside: a measured length, else the population prior; the result says which.
- What the gap does not show keeps the prior: `trunk` cancels, and of a hand without a sensor the gap shows only the sum
  forearm + hand, which the prior splits.
- Sensors may sit anywhere: where no mount is stated, headings come from the closure, and nobody holds the start pose
  exactly. Without a magnetometer headings drift, and soft tissue moves under the sensors. None of this is noise that
  averages out over the phase, so all of it is estimated beside the lengths (`least_squares`), with priors (`priors`).
- The accelerations of shoulders and elbows, which two sensors each measure, show headings as well (`joints`).
- The weight of the samples is measured, not assumed (`weights`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import MAX_MOUNT_ERROR_DEG, MOUNT_WARNING_DEG
from ..arguments import Positive, check_arguments
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadModel, BadOption, BadPhase, BadSession, NoSolution, one_of
from ..filters import BEST, check_method
from ..filters.sensors import filter_recording
from ..model import BodyModel, convert_breadths, list_breadths
from ..model.body import load_sensed_model
from ..recording import Recording
from ..subject import HeadingDrift, Hinge, StartPoseOffset, Subject, population_subject
from .alternatives import Alternative, diagnose_ambiguity, find_alternatives, widen_covariance
from .anatomy import BETTER, LEAST_ROTATION, LabelCheck, check_labels
from .conditions import Level, Pointing, find_hinges, group_lengths, is_scale_observed
from .contact import find_initial_guess
from .equations import HINGE_STD
from .fusion import fuse_calibrations, separate_mounts
from .initial_headings import Coupling, estimate_joint_headings
from .joints import add_couplings, estimate_couplings
from .least_squares import MIN_LENGTH, Gaussian, Observations
from .observability import diagnose_closures, diagnose_lengths, diagnose_mounts
from .paper import Formulation, check_paper_formulation, solve_paper_calibration
from .priors import build_prior, combine_lengths, place_points
from .problem import LOOSE, SAMPLE_RATE_HZ, CalibrationProblem
from .protocols import Protocol, choose_protocol, load_protocol
from .result import Calibration
from .weights import (
    CONTRADICTED,
    LEAST_LENGTH_STD,
    MIN_CONTACT,
    SUSPECT,
    WeightedFit,
    compare_measured,
    compare_posed,
    compute_information_shares,
    estimate_covariance,
    project_to_subject,
    solve_reweighted,
)

# One standard deviation [m] of a length measured over the skin, where the user gives none.
MEASURED_STD = 0.003
MEASURED_RANGE = 0.02, 1.0  # [m] of lengths that a user may measure
QUICK_RATE_HZ = 1.0  # of samples that decide whether labels and mounts can be as stated


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
    measured : mapping, optional
        Name → [m] that was measured on the person: a length of the body such as "shoulder_width"; the breadth
        "biacromial", from which a length follows. Without any the scale is the prior's.
    prior : Subject, optional
        Lengths with covariance, and mounts, as known before: the subject of an earlier calibration is combined with
        what this recording shows. None: `population_subject(stature, sex)`.
    stature : float, optional
        [m] the person's body height, which narrows the population prior.
    sex : str, optional
        "f" or "m", which narrows the population prior.
    model : BodyModel, str or Path, optional
        The body, or its file or name as for `load_model`; None: that which the recording states, else the upper body.
    protocol : str, Path or Protocol, optional
        What the person did in which phase: the name of a protocol, such as "clasp" or "free", a .toml file, or what
        `wepose_pin.calibration.load_protocol` returned; None: "clasp", with "t_pose" and "bow" if the recording has
        those phases and the formulation is not "paper".
    method : str
        The orientation filter: "amekf", "smoother", "smekf", "smekf_published", "ncf" or "gdc", as in
        `estimate_orientation`.
    measured_std : float
        Standard deviation [m] of each measured value; 3 mm by default.
    formulation : str
        "full" estimates lengths, mounts, headings, drift and soft tissue together; "paper" the lengths alone, by the
        plain least squares of Lisini Baldi et al. 2019, which needs a measured length.

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

    Examples
    --------
    >>> calibration = wp.calibrate(recording, measured={"shoulder_width": 0.33})
    >>> calibration.quality.quality
    'poor'
    >>> [diagnostic.code for diagnostic in calibration.diagnostics]
    ['motion-too-short']
    >>> wp.track(recording, calibration).subject.quality
    'poor'
    """
    check_arguments(calibrate, locals())
    check_method(method)
    if not isinstance(protocol, Protocol):
        protocol = load_protocol(choose_protocol(recording.phases, formulation) if protocol is None else protocol)
    if not isinstance(model, BodyModel):
        model = load_sensed_model(model or recording.model or None, recording.sensors, recording.where())
    table = model.table
    table.check_segments(recording.sensors, f"{recording.where()}: sensors.", BadSession)
    if not table.lengths:
        raise BadModel(
            f"{table.where}: this body has no lengths; a table beside the URDF names its points and [lengths], as "
            f"docs/models.md shows"
        )
    protocol.check_body(table)
    _check_measured(measured or {}, model)
    with_std = convert_breadths(measured or {}, table, measured_std)
    for segment in protocol.needs:
        if segment not in recording.sensors:
            raise BadSession(
                f"{recording.where()}: no sensor on {segment}; protocol '{protocol.name}' needs one each on "
                f"{', '.join(protocol.needs)}"
            )
    if prior is not None and (stature is not None or sex is not None):
        raise BadOption("prior has the lengths of a person; stature and sex narrow those of the population")
    prior = prior or population_subject(stature, sex, model)
    prior.check_body(table)
    if formulation == "paper":
        check_paper_formulation(protocol, model, with_std, recording.sensors, recording.start_pose)
    for condition in protocol.conditions:
        if condition.phase:
            recording.phase(condition.phase)
    filtered = filter_recording(recording, method=method, sways=not table.is_mechanism)
    earlier = prior if prior.start_pose_offset and formulation == "full" else None
    if earlier is not None:
        prior = separate_mounts(earlier, population_subject(body=model))
    problem = CalibrationProblem(recording, filtered, protocol, prior, with_std, model)
    if formulation == "paper":
        return solve_paper_calibration(problem).state_quality()
    calibration = _calibrate_checked(problem)
    if earlier is not None and not calibration.labels.moved:
        fused = fuse_calibrations(earlier, calibration.subject, prior, problem.measured, table)
        calibration = replace(calibration, subject=fused, prior=earlier)
    return calibration.state_quality()


def _check_measured(measured: Mapping[str, float], model: BodyModel) -> None:
    """Raises `BadOption` where what is measured is no length or breadth, or not plausible."""
    names, (low, high) = (*model.lengths, *list_breadths(model.table)), MEASURED_RANGE
    for name, metres in measured.items():
        if name not in names:
            raise BadOption(f"measured {name}: not a length; {one_of(names, name)}")
        if not low < metres < high:
            raise BadOption(f"measured {name}={metres:g}: a length in metres is needed, between {low} and {high}")


def _calibrate_checked(problem: CalibrationProblem) -> Calibration:
    """The calibration without the mounts and poses that gravity or the motion contradicts, its labels checked."""
    wrong = problem.mounts_against_gravity()
    unused = [_diagnose_unused_mount(name, angle, MAX_MOUNT_ERROR_DEG) for name, angle in wrong.items()]
    problem = problem.remove_mounts(wrong)
    problem.observe()  # raises where a phase is too short, before anything is estimated
    _check_free_motion(problem)
    stated = solve_calibration(problem, quick=True)
    doubt = stated.limbs().doubt()
    if doubt > 1.0 or problem.mounts_against_motion(stated.subject.mounts):
        free = solve_calibration(problem.remove_mounts(problem.filtered.R_VS), quick=True)
        if free.limbs().doubt() < min(1.0, BETTER * max(doubt, 1.0 / BETTER)):
            wrong = problem.mounts_against_motion(free.subject.mounts)
            unused += [_diagnose_unused_mount(n, angle, MOUNT_WARNING_DEG, "motion") for n, angle in wrong.items()]
            problem = problem.remove_mounts(wrong)
            doubt = 0.0 if wrong else doubt
    if doubt > 1.0 and stated.rotation < LEAST_ROTATION:  # hands that hardly move show nothing
        labels = LabelCheck.from_motion(stated.limbs(), problem.model.table)
        return replace(stated, labels=labels, posed={}, unused_mounts=tuple(unused))
    if doubt > 1.0 and stated.rotation >= LEAST_ROTATION:  # other labels close other chains
        labels = check_labels(
            stated.limbs(),
            lambda moved: solve_calibration(problem.relabel(moved), quick=True).limbs(),
            [name for name in problem.sensors if name in problem.model.table.needed],
            problem.model.table,
        )
        if labels.moved:
            return _keep_prior(replace(stated, remarks=(*unused, *stated.remarks)), labels, problem.measured)
    try:
        best = solve_calibration(problem)
    except NoSolution as error:
        turned_deg, hint = np.degrees(stated.rotation), ""
        if turned_deg < np.degrees(LEAST_ROTATION):
            hint = f"; the segments turned by {turned_deg:.1f} deg only: move for a minute through the whole reach"
        raise NoSolution(f"{problem.recording.where()}: {error}{hint}") from error
    posed = {phase: deviation for phase, deviation in best.posed.items() if phase not in problem.loose}
    phase = max(posed, key=lambda name: posed[name], default="")
    if phase and posed[phase] > SUSPECT and problem.protocol.closures:
        # Where a pose is wrong all else fits worse: what it is compared with must be found without it.
        loose = problem.loosen_phase(phase)
        deviation = solve_calibration(loose).posed[phase]
        if deviation > CONTRADICTED:
            without = _calibrate_checked(loose)
            left_out = Diagnostic("phase-not-used", WARNING, phase, deviation, CONTRADICTED)
            mounts = (*unused, *without.unused_mounts)
            return replace(without, remarks=(left_out, *without.remarks), unused_mounts=mounts)
    best = replace(best, posed={} if problem.protocol.closures else posed)
    return replace(best, labels=LabelCheck.from_motion(best.limbs(), problem.model.table), unused_mounts=tuple(unused))


def _diagnose_unused_mount(segment: str, angle_deg: float, limit_deg: float, contradiction: str = "") -> Diagnostic:
    angle, limit = np.deg2rad([angle_deg, limit_deg]).tolist()
    facts = {"variant": contradiction} if contradiction else {}
    return Diagnostic("mount-not-used", WARNING, segment, angle, limit, facts)


def _keep_prior(
    calibration: Calibration, labels: LabelCheck, measured: Mapping[str, tuple[float, float]]
) -> Calibration:
    """The calibration with the lengths and covariance from before the motion, where sensors sit on other segments."""
    names = tuple(calibration.subject.lengths)
    lengths, information = combine_lengths(calibration.prior, measured, names)
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
    return replace(calibration, subject=subject, scale_std=scale_std, labels=labels)


class _Solution(NamedTuple):
    """The solved least squares."""

    observations: Observations
    samples: np.ndarray  # (n,) of the recording
    prior: Gaussian  # without what accelerations show
    result: WeightedFit
    covariance: np.ndarray  # (m, m) of x
    information_shares: dict[str, np.ndarray]
    alternatives: list[Alternative]


def _solve(problem: CalibrationProblem) -> _Solution:
    """The least squares solved with all that is known."""
    observations, samples = problem.observe(SAMPLE_RATE_HZ)
    layout = observations.layout
    prior, couplings = build_prior(problem, observations), _estimate_couplings(problem, layout.sensors)
    prior = _start_without_closure(problem, observations, prior, couplings)
    guess, contact = find_initial_guess(observations, prior.mean, lambda some: build_prior(problem, some).mean)
    coupled = add_couplings(prior, layout, couplings, guess)
    result = solve_reweighted(observations, coupled, guess, contact)

    headings = problem.stated_headings(layout.sensors)
    free = layout.heading[[name not in headings for name in layout.sensors]]

    def prior_at(x: np.ndarray) -> Gaussian:
        mean = prior.mean.copy()
        mean[free] = x[free]
        return add_couplings(Gaussian(mean, prior.information), layout, couplings, x)

    alternatives = find_alternatives(observations, prior_at, result, headings)
    lengths = result.fit.x[layout.length]
    if np.min(lengths, initial=np.inf) < 1.01 * MIN_LENGTH:  # it lies at its bound, to the solver's accuracy
        raise NoSolution(
            f"the lengths did not converge ({layout.lengths[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} "
            f"mm); check that the points do in the phase what the protocol says, and that every sensor sits where the "
            f"session says"
        )
    sums = list(group_lengths(observations.conditions, layout.lengths).values())
    shares = compute_information_shares(result.fit, layout, result.weights, result.fit.covariance, sums)
    covariance = estimate_covariance(observations, result, coupled.information)
    covariance = widen_covariance(covariance, alternatives, layout)
    return _Solution(observations, samples, prior, result, covariance, shares, alternatives)


def _estimate_couplings(problem: CalibrationProblem, sensors: Sequence[str]) -> list[Coupling]:
    """The relative headings of these neighbours by the acceleration of the joint between them."""
    neighbours = [(problem.model.parents[name], name) for name in sensors]
    pairs = [(above, name) for above, name in neighbours if above is not None and above in sensors]
    return estimate_couplings(problem.recording, problem.filtered, pairs, problem.moving_intervals)


def _start_without_closure(
    problem: CalibrationProblem, observations: Observations, prior: Gaussian, couplings: Sequence[Coupling]
) -> Gaussian:
    """The prior with unknown headings as couplings and hinges show them, where limbs move and no closure holds."""
    if problem.protocol.closures or not problem.protocol.free_motions:
        return prior
    layout, mean = observations.layout, prior.mean.copy()
    stated = problem.stated_headings(layout.sensors)
    headings = estimate_joint_headings(observations, couplings, stated)
    for i, name in enumerate(layout.sensors):
        if name not in stated:
            mean[layout.heading[i]] = headings[i]
    return Gaussian(mean, prior.information)


def _check_free_motion(problem: CalibrationProblem) -> None:
    """Raises `BadPhase` where no closure holds and joints do not show the heading of a sensor without a mount."""
    if problem.protocol.closures or not problem.protocol.free_motions:
        return
    stated = set(problem.stated_headings(problem.sensors))
    couplings = _estimate_couplings(problem, problem.sensors)
    shown = {c.segment for c in problem.conditions if isinstance(c, Pointing | Level)}
    known = stated | shown or {problem.model.table.reference}
    for _ in couplings:
        known |= {name for c in couplings for name in (c.near, c.far) if {c.near, c.far} & known}
    unknown = [name for name in problem.sensors if name not in known]
    if unknown:
        raise BadPhase(
            f"{problem.recording.where()}: the motion does not show how {', '.join(f'sensors.{n}' for n in unknown)} "
            f"turned against {'its neighbour' if len(unknown) == 1 else 'their neighbours'}: too little of it, or no "
            f"accelerometer; state the mount, move both arms for a minute, or use a protocol with a closure"
        )


def _solve_quickly(problem: CalibrationProblem) -> _Solution:
    """The least squares solved at fewer samples, by the closure alone."""
    observations, samples = problem.observe(QUICK_RATE_HZ)
    prior = build_prior(problem, observations)
    if not problem.protocol.closures and problem.protocol.free_motions:
        couplings = _estimate_couplings(problem, observations.layout.sensors)
        prior = _start_without_closure(problem, observations, prior, couplings)
        prior = add_couplings(prior, observations.layout, couplings, prior.mean)
    result = solve_reweighted(observations, prior, prior.mean, np.ones(len(samples)), quick=True)
    return _Solution(observations, samples, prior, result, result.fit.covariance, {}, [])


def solve_calibration(problem: CalibrationProblem, *, quick: bool = False) -> Calibration:
    """The calibration with mounts and labels as stated; a quick one shows whether they can be."""
    solution = _solve_quickly(problem) if quick else _solve(problem)
    recording, protocol, prior = problem.recording, problem.protocol, problem.prior
    observations, samples, fit = solution.observations, solution.samples, solution.result.fit
    layout, contact = observations.layout, solution.result.contact
    lengths, covariance = fit.x[layout.length], solution.covariance[np.ix_(layout.length, layout.length)]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1) if len(lengths) else float("nan")
    # A length outside the chain, such as the trunk where the hands are joined, does not fix its scale.
    scale_lengths = [name for name in problem.measured if name in (problem.lengths_in_closures or layout.lengths)]
    bending = observations.bending
    hinges = _hinges(fit.hinge[bending], fit.x[layout.hinge], problem) if bending.any() else {}
    offsets = Rotation.from_rotvec(np.pad(fit.x[layout.tilt], ((0, 0), (0, 1)))).as_rotvec()[:, :2]
    subject = _make_subject(problem, solution, {joint: hinge for joint, (hinge, _) in hinges.items()}, offsets)
    scale_observed = is_scale_observed(problem.conditions)
    scale = "of the population prior" if prior.is_population else f"of {prior.name}"
    if scale_lengths or scale_observed:
        scale = f"measured: {', '.join(scale_lengths)}" if scale_lengths else "of the closure"

    prior_x = fit.x.copy()
    prior_x[layout.length] = [prior.lengths[name] for name in layout.lengths]
    prior_gaps = observations.gaps(place_points(prior_x, observations))
    gap, prior_gap = (np.linalg.norm(gaps, axis=1) for gaps in (fit.gaps, prior_gaps))
    gap[~observations.closed] = prior_gap[~observations.closed] = np.nan
    touching = observations.closed & (contact > MIN_CONTACT)

    diagnostics = [*problem.filtered.diagnostics, *problem.diagnose_losses()]
    prior_lengths_cov = np.linalg.inv(solution.prior.information[np.ix_(layout.length, layout.length)])
    if not scale_observed:
        free_scale_std = None if scale_lengths else scale_std
        diagnostics += diagnose_lengths(problem, lengths, covariance, prior_lengths_cov, free_scale_std)
    diagnostics += diagnose_ambiguity(solution.alternatives, layout)
    diagnostics += diagnose_mounts([name for name in problem.filtered.R_VS if name not in subject.mounts], problem)
    diagnostics += diagnose_closures(recording.time[samples], contact, observations, problem.model)
    return Calibration(
        subject=replace(subject, note=f"{protocol.title}; scale {scale}"),
        prior=prior,
        rms_gap=_rms(gap[touching]),
        prior_rms_gap=_rms(prior_gap[touching]),
        effective_sample_size=solution.result.effective_sample_size,
        measured={name: metres for name, (metres, _) in problem.measured.items()},
        scale_std=scale_std,
        remarks=tuple(diagnostics),
        time=recording.time[samples],
        gap=gap,
        prior_gap=prior_gap,
        contact=contact,
        start_pose_offset=dict(zip(layout.sensors, offsets, strict=True)),
        heading_drift=dict(zip(layout.sensors, fit.x[layout.drift].tolist(), strict=True)),
        hinge_axes={joint: hinge.axis for joint, (hinge, _) in hinges.items()},
        hinge_rms={joint: rms for joint, (_, rms) in hinges.items()},
        information_shares=solution.information_shares,
        prior_covariance=project_to_subject(layout, np.linalg.inv(solution.prior.information), problem.start_pose)[1],
        quat_WL=problem.orient_segments(subject.mounts, samples),
        protocol=protocol.name,
        closure=next((closure.kind for closure in protocol.closures), ""),
        measured_example=problem.measured_example,
        measured_lengths=compare_measured(
            fit, layout, problem.measured, 0.0 if problem.model.table.is_mechanism else LEAST_LENGTH_STD
        ),
        posed=compare_posed(
            observations,
            solution.result,
            [condition.phase for condition in protocol.conditions],
            dict.fromkeys(problem.loose, LOOSE),
        ),
        scale_lengths=tuple(scale_lengths),
        model=problem.model,
        start_pose=problem.start_pose,
        conditions=problem.conditions,
    )


def _hinges(
    hinge_residuals: np.ndarray, unknown: np.ndarray, problem: CalibrationProblem
) -> dict[str, tuple[Hinge, float]]:
    """Joint → its hinge, and the root mean square [rad] by which its segment leaves the plane across it.

    Parameters
    ----------
    hinge_residuals : (n, h) in units of `HINGE_STD`
    unknown : (h, 2) by which each axis is turned across and tilted
    """
    hinges = {}
    layout_hinges = find_hinges(problem.model, problem.start_pose, problem.sensors)
    for i, (hinge, (across, tilted)) in enumerate(zip(layout_hinges, unknown, strict=True)):
        axis = np.array(hinge.axis) + across * np.array(hinge.across) + tilted * np.array(hinge.tilted)
        axis_L = problem.start_rotation(hinge.on).inv().apply(axis / np.linalg.norm(axis))
        rms = HINGE_STD * _rms(hinge_residuals[:, i])
        hinges[hinge.name] = Hinge(axis_L, max(rms, problem.model.table.hinges[hinge.name].softness)), rms
    return hinges


def _make_subject(
    problem: CalibrationProblem, solution: _Solution, hinges: Mapping[str, Hinge], offsets: np.ndarray
) -> Subject:
    """The subject of a solution; `offsets` (sensors, 2) [rad] are those of the start pose."""
    layout, x, filtered = solution.observations.layout, solution.result.fit.x, problem.filtered
    mounts = {}
    for i, name in enumerate(layout.sensors):
        tilt = Rotation.from_rotvec(-np.append(x[layout.tilt[i]], 0.0))
        R_LS = problem.start_rotation(name).inv() * tilt * _about_z(x[layout.heading[i]]) * filtered.R_VS_start[name]
        mounts[name] = R_LS.as_quat()
    # The mounts of sensors outside the chain are those of the start pose.
    for name, psi in problem.stated_headings([name for name in filtered.R_VS if name not in mounts]).items():
        mounts[name] = (problem.start_rotation(name).inv() * _about_z(psi) * filtered.R_VS_start[name]).as_quat()
    order, covariance = project_to_subject(layout, solution.covariance, problem.start_pose)
    std = np.sqrt(np.diag(solution.covariance))
    offset_stds = np.minimum(std[layout.tilt], np.pi)  # no angle is more uncertain than half a turn
    return replace(
        problem.prior,
        name=problem.recording.name,
        hinges=hinges,
        start_pose_offset={
            name: StartPoseOffset(offset, float(np.sqrt(np.mean(offset_std**2))))
            for name, offset, offset_std in zip(layout.sensors, offsets, offset_stds, strict=True)
        },
        heading_drift={
            name: HeadingDrift(float(rate), float(rate_std))
            for name, rate, rate_std in zip(layout.sensors, x[layout.drift], std[layout.drift], strict=True)
        },
        lengths=dict(zip(layout.lengths, x[layout.length].tolist(), strict=True)),
        girdles=dict(problem.prior.girdles)
        | {term.name: values for term, values in zip(layout.girdles, x[layout.girdle], strict=True)},
        order=order,
        covariance=covariance,
        mounts=mounts,
    )


def _about_z(angle: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, angle])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
