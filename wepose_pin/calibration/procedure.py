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
  averages out over the phase, so all of it is estimated beside the lengths (`equations`), with priors (`priors`).
- The accelerations of shoulders and elbows, which two sensors each measure, show headings as well (`couplings`).
- The weight of the samples is measured, not assumed (`weights`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..arguments import Positive, check_arguments
from ..body import BodyModel, BodyTable, convert_breadths, list_breadths
from ..body.body import load_sensed_model
from ..body.girdle import PARAMETERS
from ..body.subject import Subject, girdle_rows, population_subject
from ..body.table import check_segments
from ..errors import BadModel, BadOption, BadSession, NoSolution, one_of
from ..filters import BEST, check_method
from ..filters.sensors import start_filters
from ..recording import Recording
from .equations import Layout
from .paper import Formulation, solve_paper_calibration
from .problem import CalibrationProblem
from .protocols import Protocol, choose_protocol, load_protocol
from .result import LEAST_ROTATION, Calibration, assess, measure_doubt, measure_rotations
from .solution import solve_problem

# One standard deviation [m] of a length measured over the skin, where the user gives none.
MEASURED_STD = 0.003
LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible
MEASURED_RANGE = 0.02, 1.0  # [m] of lengths that a user may measure
BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


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
    check_method(method)
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
    _, filtered = start_filters(recording, method=method, sways=not model.table.is_mechanism)
    earlier = prior if prior.start_pose_offset and formulation == "full" else None
    if earlier is not None:  # the two calibrations are fused, each on the population prior
        prior = separate_mounts(earlier, population_subject(body=model))
    layout = Layout(protocol, model, recording)
    problem = CalibrationProblem(recording, filtered, layout, prior, lengths)
    calibration = solve_paper_calibration(problem) if formulation == "paper" else solve_plausible(problem)
    if earlier is not None:
        fused = fuse_calibrations(earlier, calibration.subject, model.table)
        calibration = replace(calibration, subject=fused, problem=replace(calibration.problem, prior=earlier))
    quality = assess(calibration)
    return replace(calibration, quality=quality, subject=replace(calibration.subject, quality=quality.quality))


def _check_inputs(recording: Recording, protocol: Protocol, model: BodyModel, measured: Mapping[str, float]) -> None:
    """Raise where body, protocol, sensors and measured lengths do not fit each other."""
    check_segments(model.table, recording.sensors, f"{recording.where()}: sensors.", BadSession)
    if not model.table.lengths:
        raise BadModel(
            f"{model.table.where}: this body has no lengths; a table beside the URDF names its points and [lengths], "
            f"as docs/models.md shows"
        )
    protocol.check_body(model.table)
    names, (low, high) = (*model.lengths, *list_breadths(model.table)), MEASURED_RANGE
    for name, metres in measured.items():
        if name not in names:
            raise BadOption(f"measured {name}: not a length; {one_of(names, name)}")
        if not low < metres < high:
            raise BadOption(f"measured {name}={metres:g}: a length in metres is needed, between {low} and {high}")
    for segment in protocol.needs:
        if segment not in recording.sensors:
            raise BadSession(
                f"{recording.where()}: no sensor on {segment}; protocol '{protocol.name}' needs one each on "
                f"{', '.join(protocol.needs)}"
            )


def solve_plausible(problem: CalibrationProblem) -> Calibration:
    """Return the solution without the mounts that gravity or the motion contradicts, its labels checked."""
    problem = problem.leave_out_mounts()
    problem.observe()  # raises where a phase is too short
    quick = exchange_labels(leave_out_mounts(solve_problem(problem, quick=True)))
    try:
        return quick if quick.exchanged else solve_problem(quick.problem)
    except NoSolution as error:
        raise NoSolution(f"{problem.recording.where()}: {error}") from error


def leave_out_mounts(stated: Calibration) -> Calibration:
    """Return the quick solution without the mounts that the motion contradicts."""
    problem = stated.problem
    contradicted = problem.leave_out_mounts(stated.subject.mounts).unused_mounts != problem.unused_mounts
    if measure_doubt(stated)[0] <= 1.0 and not contradicted:
        return stated
    free = solve_problem(problem.remove_mounts(problem.filtered.R_VS), quick=True)
    without = problem.leave_out_mounts(free.subject.mounts)
    if without.unused_mounts == problem.unused_mounts or measure_doubt(free)[0] >= 1.0:
        return stated
    return solve_problem(without, quick=True)


def exchange_labels(stated: Calibration) -> Calibration:
    """Return the quick solution with two sensors, or both sides, exchanged if the limbs move as a person's then.

    Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
    give the same gap. The solution's elbows then bend backward, or sideways, as a person's cannot. Any other exchange
    opens the chain.
    """
    problem, (doubt, _), table = stated.problem, measure_doubt(stated), stated.problem.model.table
    rotations = [*measure_rotations(stated).values()]
    if doubt <= 1.0 or table.is_mechanism or not rotations or np.median(rotations) < LEAST_ROTATION:
        return stated
    places = [name for name in problem.layout.sensors if name in table.needed]
    sides = [(a, b) for a, b in table.pairs.items() if {a, b} <= set(places)]
    exchanges = [dict((pair, pair[::-1])) for pair in combinations(places, 2)]
    exchanges.append({a: b for pair in sides for a, b in (pair, pair[::-1])})
    doubts = [measure_doubt(solve_problem(problem.relabel(labels), quick=True))[0] for labels in exchanges]
    least = min(doubts)
    if least >= min(1.0, BETTER * doubt):
        return stated
    subject = replace(stated.subject, note="sensors sit elsewhere than labelled")
    return replace(stated, subject=subject, remarks=(), exchanged=exchanges[doubts.index(least)])


def separate_mounts(earlier: Subject, population: Subject) -> Subject:
    """Return the population prior with the mounts of an earlier calibration."""
    rows = [row for row in earlier.order if row.startswith("mounts.")]
    at = [earlier.order.index(row) for row in rows]
    covariance = block_diag(population.covariance, earlier.covariance[np.ix_(at, at)])
    order = (*population.order, *rows)
    return replace(population, name=earlier.name, mounts=earlier.mounts, order=order, covariance=covariance)


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
    covariance, at = (
        block_diag(subject.covariance, np.zeros((missing, missing))),
        [order.index(row) for row in shape_rows],
    )
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
