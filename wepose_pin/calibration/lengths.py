"""From a hands-together recording to a subject: lengths, mounts and headings with their joint covariance.

While the palms are held together the chain shoulder–arm–palm–palm–arm–shoulder is closed: the gap

    g(ℓ) = R_torso e_y w + Σ_left R_i(−e_z) ℓ_i − Σ_right R_i(−e_z) ℓ_i

is zero. It is linear and homogeneous in the lengths ℓ, and that decides the form of the problem:

- Nothing in g fixes the scale: ℓ = 0 closes the chain perfectly. Errors of the orientations even favour it, since they
  add to ‖g‖² in proportion to ‖ℓ‖². So the residual is the gap whitened by the covariance that errors of the
  orientations give it, which is as homogeneous as the gap: the quotient no longer changes with the scale (total
  instead of ordinary least squares).
- The scale comes from outside: a gauge (a measured length), else the anthropometric prior; the result says which.
- What the gap does not see keeps the prior: `trunk` cancels, and of a hand without a sensor only the sum forearm + hand
  is seen, the prior splits it.
- Sensors may sit anywhere: headings come from the closure itself where no mount is stated, and nobody holds the start
  pose exactly. Without a magnetometer headings drift, and soft tissue lets a sensor sag. None of that is noise that
  averages out over the phase, so all of it is unknown beside the lengths (`problem`), with priors of its own (`known`).
- Of headings the accelerations of shoulders and elbows tell as well, which two sensors each feel (`joints`).
- How much the looks are worth is measured, not assumed (`weighing`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import STATED_LIMIT_DEG, STATED_WARNING_DEG, heading_to, nominal_mount
from ..arguments import Positive, check_arguments
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadOption, BadPhase, BadSession, NoSolution, one_of
from ..filters import BEST, check_method
from ..filters.sensors import FilteredRecording, filter_recording
from ..recording import Recording
from ..subject import LENGTHS, HeadingDrift, Hinge, StartPoseOffset, Subject, average_subject
from .alternatives import Alternative, alternatives, ambiguous_headings, spread_over
from .anatomy import (
    BETTER,
    Arms,
    Labels,
    against_gravity,
    against_motion,
    arms,
    check_labels,
    relabelled,
    segments_at,
    without_mounts,
)
from .chain import CHAIN, SIDES
from .joints import coupled, couplings
from .known import known_before, known_lengths, stated_headings
from .losses import connected, losses_of, need_start_pose, steps_of, tilted
from .observability import assumed_distances, open_closures, unknown_mounts, unobserved_lengths
from .problem import HINGE_STD, K, Layout, Looks, carrier, placed, residuals
from .protocols import Closure, Protocol, load_protocol
from .start import is_linear
from .touching import touching_start
from .weighing import TOUCHED, Tape, covariance_of, handed_on, learned_of, taped, weighed

# One standard deviation [m] of a length taped over the skin, where the user gives none.
GAUGE_STD = 0.003
# The gap is looked at this often [Hz]; more only repeats what the motion's own slowness correlates anyway.
LOOK_RATE_HZ = 8.0
LEAST_LOOKS = 10
# To see whether labels and mounts can be as stated, the closure alone at fewer looks tells enough.
QUICK_RATE_HZ = 1.0


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    Parameters
    ----------
    subject : lengths and mounts with their joint covariance
    prior : what was known before
    rms_gap : palm-to-palm residual [m], root mean square of its length, where the palms touched
    prior_rms_gap : the same with the prior's lengths
    independent : how many independent looks at the gap the phase is worth
    gauge : the measured lengths [m]; empty: the scale is the prior's
    scale_std : relative standard deviation of the overall scale, the proportions taken as found
    diagnostics : what the user should know besides its quality, see `assess`
    time, gap, prior_gap : (n,) [s], (n,) [m] the residual's length at each look, and with the prior's lengths
    kept : (n,) the weight that each look kept, near 0 where the palms were apart
    start_tilt : segment → (2,) [rad] about x and y of W, how far it was off the start pose
    drift : segment → [rad/s] of its sensor's heading
    hinge : side → (3,) the elbow's axis in the upper arm's frame, unit length, y towards the left
    hinge_rms : side → [rad] of the forearm against the plane of that hinge
    learned : name as in the subject's covariance, or ``left_forearm + left_hand`` → (n,) share of what is known of it
        that each look brought; their sum and what was known before make 1
    before : (k, k) covariance before the motion, in the order of the subject's
    quat_WL : segment → (n, 4) xyzw at each look, as `track` would have it
    protocol : its name
    closure : the kind of its closure, as in `protocols.KINDS`; empty where it has none
    tape : the gauge that serves it best, with an example
    tapes : each measured length beside what is known without it
    labels : whether the sensors sit where the session says
    contradicted : stated mounts that could not be and were not used
    scaling : measured lengths that fix the scale; empty: the prior does
    """

    subject: Subject
    prior: Subject
    rms_gap: float
    prior_rms_gap: float
    independent: float
    gauge: Mapping[str, float]
    scale_std: float
    diagnostics: tuple[Diagnostic, ...]
    time: np.ndarray
    gap: np.ndarray
    prior_gap: np.ndarray
    kept: np.ndarray
    start_tilt: Mapping[str, np.ndarray]
    drift: Mapping[str, float]
    hinge: Mapping[str, np.ndarray]
    hinge_rms: Mapping[str, float]
    learned: Mapping[str, np.ndarray] = field(default_factory=dict)
    before: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    quat_WL: Mapping[str, np.ndarray] = field(default_factory=dict)
    protocol: str = "clasp"
    closure: str = "coincide"
    tape: str = Protocol.tape
    tapes: Mapping[str, Tape] = field(default_factory=dict)
    labels: Labels = field(default_factory=Labels)
    contradicted: tuple[Diagnostic, ...] = ()
    scaling: tuple[str, ...] = ()

    def arms(self) -> Arms:
        """How the arms moved while the chain was closed."""
        closed = np.isfinite(self.gap)
        touched = closed & (self.kept > TOUCHED) if closed.any() else np.ones(len(self.gap), dtype=bool)
        gap = np.sqrt(np.average(self.gap[closed] ** 2, weights=self.kept[closed])) if closed.any() else 0.0
        quat_WL = {name: quat[touched] for name, quat in self.quat_WL.items()}
        return arms(quat_WL, self.subject.lengths, float(gap))


def calibrate_lengths(
    recording: Recording,
    *,
    gauge: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    protocol: str | Protocol = "clasp",
    method: str = BEST,
    gauge_std: Positive = GAUGE_STD,
) -> Calibration:
    """Link lengths with their covariance, and what was found beside them.

    Parameters
    ----------
    gauge : measured lengths, and distances that the protocol names, name → [m]; without one the scale is the prior's
    prior : lengths before, with covariance, and mounts; None for the anthropometric average
    protocol : what was done in which phase: a name, a .toml of one's own, or what `load_protocol` gave
    method : the orientation filter
    gauge_std : standard deviation [m] of each measured length

    Raises
    ------
    BadOption
        An unknown protocol, or a gauge that is no length or no plausible one.
    BadSession, BadPhase
        A sensor that the protocol needs is missing; there is no such phase.
    """
    check_arguments(calibrate_lengths, locals())
    check_method(method)
    if not isinstance(protocol, Protocol):
        protocol = load_protocol(protocol)
    gauge = dict(gauge or {})
    for name, value in gauge.items():
        if name not in (*LENGTHS, *protocol.gauges):
            raise BadOption(f"gauge {name}: not a length; {one_of((*LENGTHS, *protocol.gauges), name)}")
        if not 0.02 < value < 1.0:
            raise BadOption(f"gauge {name}={value:g}: a length in metres is needed, between 0.02 and 1.0")
    if len(set(gauge) & set(protocol.chain)) < protocol.taped:
        raise BadOption(
            f"protocol '{protocol.name}' needs {protocol.taped} taped length of its chain, as in --measured "
            f"{protocol.tape}; {one_of(protocol.chain)}"
        )
    for segment in protocol.needs:
        if segment not in recording.sensors:
            raise BadSession(
                f"{recording.where()}: no sensor on {segment}; protocol '{protocol.name}' needs one each on "
                f"{', '.join(protocol.needs)}"
            )
    before = prior or average_subject()
    for condition in protocol.conditions:
        recording.phase(condition.phase)
    return _believed(recording, filter_recording(recording, method=method), protocol, before, gauge, gauge_std)


def _believed(
    recording: Recording,
    found: FilteredRecording,
    protocol: Protocol,
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> Calibration:
    """The calibration by what the session says of its sensors, as far as gravity, motion and anatomy let it stand."""

    def tried(recording: Recording, found: FilteredRecording, prior: Subject) -> Calibration:
        return _solve(recording, found, protocol, prior, gauge, gauge_std, quick=True)

    wrong = against_gravity(recording, prior, found)
    contradicted = [_not_used(name, off, STATED_LIMIT_DEG) for name, off in wrong.items()]
    recording, prior = without_mounts(recording, prior, wrong)
    _need_start_pose(recording, found, protocol, prior)
    stated = tried(recording, found, prior)
    doubt = stated.arms().doubt()
    if doubt > 1.0 or against_motion(recording, prior, stated.subject.mounts):
        bare, unknown = without_mounts(recording, prior, found.R_VS)
        free = tried(bare, found, unknown)
        if free.arms().doubt() < min(1.0, BETTER * max(doubt, 1.0 / BETTER)):
            wrong = against_motion(recording, prior, free.subject.mounts)
            contradicted += [_not_used(name, off, STATED_WARNING_DEG, "motion") for name, off in wrong.items()]
            recording, prior = without_mounts(recording, prior, wrong)
            doubt = 0.0 if wrong else doubt
    if doubt > 1.0:
        labels = check_labels(
            stated.arms(),
            lambda moved: tried(*relabelled(recording, found, moved), prior).arms(),
            tuple(found.R_VS),
        )
        if labels.moved:
            stated = replace(stated, diagnostics=(*contradicted, *stated.diagnostics))
            return _nothing_learned(stated, labels, gauge, gauge_std)
    try:
        best = _solve(recording, found, protocol, prior, gauge, gauge_std)
    except NoSolution as error:
        raise NoSolution(f"{recording.where()}: {error}") from error
    how = best.arms()
    labels = Labels(how.doubt(), how.contradiction() if how.doubt() > 1.0 else None)
    return replace(best, labels=labels, contradicted=tuple(contradicted))


def _not_used(segment: str, off_deg: float, limit_deg: float, by: str = "") -> Diagnostic:
    off, limit = np.deg2rad([off_deg, limit_deg]).tolist()
    return Diagnostic("mount-not-used", WARNING, segment, off, limit, {"variant": by} if by else {})


def _nothing_learned(
    calibration: Calibration, labels: Labels, gauge: Mapping[str, float], gauge_std: float
) -> Calibration:
    """What is handed on where sensors sit elsewhere than labelled: the lengths and spreads of before the motion."""
    lengths, information = known_lengths(calibration.prior, gauge, gauge_std)
    subject = replace(
        calibration.subject,
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        covariance=calibration.before,
        hinges={},
        start_pose_offset={},
        heading_drift={},
        note="sensors sit elsewhere than labelled: nothing of the motion is used",
    )
    scale_std = float(np.sqrt(lengths @ information @ lengths) ** -1)
    return replace(calibration, subject=subject, scale_std=scale_std, labels=labels)


def _looks(
    recording: Recording, found: FilteredRecording, protocol: Protocol, rate_hz: float = LOOK_RATE_HZ
) -> tuple[Looks, np.ndarray]:
    """The looks of all conditions, and their samples (n,)."""
    stride = max(1, round(recording.rate_hz / rate_hz))
    seen = {carrier(segment, found.R_VS) for segment in protocol.segments}
    fixed = sum(closure.kind == "fixed_point" for closure in protocol.closures)
    layout = Layout(tuple(name for name in CHAIN if name in seen), fixed, protocol.gauges)
    losses = losses_of(recording, found.start, layout.sensors)
    # Where headings are searched, or poses tell them, those beyond a long loss are not to be found.
    apart = [] if is_linear(protocol.conditions) else [loss for loss in losses if loss.free]
    samples = []
    gaps = {name: of.gap for name, of in recording.sensors.items() if of.gap is not None}
    for condition in protocol.conditions:
        spans = [recording.span(interval) for interval in recording.phase(condition.phase)]
        # Each look once, however the intervals overlap.
        phase = np.unique(np.concatenate([np.arange(len(recording))[span] for span in spans]))[::stride]
        unseen = {name: gap[phase] for name, gap in gaps.items()}
        for name in {loss.sensor for loss in losses}:
            unseen[name] = unseen[name] | tilted(found.orientation[name], phase)
        lost = [name for name, of in unseen.items() if of.any()]
        measured = phase[~np.any([unseen[name] for name in lost], axis=0)] if lost else phase
        samples.append(measured[connected(apart, measured)])
        lost = [*dict.fromkeys([*lost, *(loss.sensor for loss in apart if loss.beyond(measured).any())])]
        if len(samples[-1]) < LEAST_LOOKS * rate_hz / LOOK_RATE_HZ:
            raise BadPhase(
                f"{recording.where()}: phases.{condition.phase} holds {len(samples[-1])} looks at {LOOK_RATE_HZ:g} a "
                f"second; at least {LEAST_LOOKS} are needed"
                + (", better a minute" if isinstance(condition, Closure) else ", better five seconds")
                + (f"; in the others {', '.join(f'sensors.{name}' for name in lost)} is lost" if lost else "")
                + (", or its orientation since it was" if losses else "")
            )
    at = np.concatenate(samples)
    steps, step_std, beyond = steps_of(losses, at)
    layout = layout._replace(steps=steps)
    turned = [(found.R_VS[name][at] * found.at_start[name].inv()).as_quat().T for name in layout.sensors]
    of = np.repeat(np.arange(len(samples)), [len(part) for part in samples])
    data = np.vstack([*turned, beyond, recording.time[at] - found.start[1]])
    return Looks(layout, data, protocol.conditions, of, step_std), at


def _need_start_pose(recording: Recording, found: FilteredRecording, protocol: Protocol, prior: Subject) -> None:
    """Raises `BadPhase` where lost samples keep the motion from telling a mount that is not known."""
    looks, at = _looks(recording, found, protocol)
    unknown = [name for name in looks.layout.sensors if nominal_mount(recording, name, prior) is None]
    losses = losses_of(recording, found.start, looks.layout.sensors)
    need_start_pose(recording, losses, at, unknown, LEAST_LOOKS)


def _solve(
    recording: Recording,
    found: FilteredRecording,
    protocol: Protocol,
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
    *,
    quick: bool = False,
) -> Calibration:
    """The calibration; a quick one at fewer looks, by the closure alone, to see whether it can be at all."""
    looks, at = _looks(recording, found, protocol, QUICK_RATE_HZ if quick else LOOK_RATE_HZ)
    layout = looks.layout
    center, known = known_before(recording, found, looks, prior, gauge, gauge_std)
    uncoupled, information = center, known
    start, touching = center, np.ones(len(at))
    others: list[Alternative] = []
    if not quick:
        start, touching = touching_start(
            looks, lambda some: known_before(recording, found, some, prior, gauge, gauge_std)[0]
        )
        spans = [span for closure in protocol.closures for span in recording.phase(closure.phase)]
        told = couplings(recording, found, layout.sensors, spans)
        center, information = coupled(center, known, layout, told, start)

    fit, weights, weight, independent = weighed(looks, center, information, start, touching, quick)
    if not quick:
        headings = stated_headings(recording, found, layout, prior)
        free = layout.heading.start + np.flatnonzero([name not in headings for name in layout.sensors])

        def known_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            begun = uncoupled.copy()
            begun[free] = x[free]
            return coupled(begun, known, layout, told, x)

        others = alternatives(looks, known_at, fit, weights, independent, headings)
    lengths = fit.x[:K]
    if not quick and np.min(lengths) < 0.01:
        raise NoSolution(
            f"the lengths did not converge ({LENGTHS[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} mm); "
            f"check that the hands do in the phase what the protocol says, and that every sensor sits where the "
            f"session says"
        )
    covariance = np.linalg.inv(fit.information)
    if not quick:
        learned = learned_of(fit, looks.layout, weights, covariance)
        covariance = spread_over(covariance_of(looks, fit, information, weights, weight), others, layout)
    order, joint = handed_on(layout, covariance)
    mounts = {name: _mount(found, fit.x, layout, name).as_quat() for name in layout.sensors}
    # Of sensors that are not in the chain the start pose has measured what it can.
    for name in [name for name in found.R_VS if name not in mounts]:
        stated = nominal_mount(recording, name, prior)
        if stated is not None:
            psi = heading_to(found.at_start[name], Rotation.from_quat(stated))
            mounts[name] = (Rotation.from_rotvec([0.0, 0.0, psi]) * found.at_start[name]).as_quat()

    at_prior = fit.x.copy()
    at_prior[:K] = [prior.lengths[name] for name in LENGTHS]
    at_prior = placed(at_prior, looks)
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance[:K, :K], lengths)) ** -1)
    # What is not in the chain, as the trunk where the hands are joined, cannot scale it.
    scaling = [*(name for name in gauge if name in (protocol.chain or LENGTHS)), *protocol.gauges]
    without_data = np.linalg.inv(known[:K, :K])
    measured = {name: (value, gauge_std) for name, value in gauge.items()}
    measured |= {c.gauge: (c.metres, c.metres_std) for c in protocol.closures if c.gauge and c.gauge not in gauge}
    loose = None if scaling else scale_std
    diagnostics = list(found.diagnostics)
    diagnostics += unobserved_lengths(protocol, lengths, covariance[:K, :K], without_data, prior, loose)
    diagnostics += assumed_distances(protocol, gauge)
    diagnostics += ambiguous_headings(others, layout)
    diagnostics += unknown_mounts([name for name in found.R_VS if name not in mounts], protocol)
    diagnostics += open_closures(recording.time[at], weight, looks)
    seen = {side: SIDES.index(side) for side in (layout.arms if looks.closed.any() else ())}
    axes = {side: np.array([x, 1.0, z]) for side, (x, z) in zip(SIDES, fit.x[layout.hinge].reshape(2, 2), strict=True)}
    hinge = {side: axes[side] / np.linalg.norm(axes[side]) for side in seen}
    hinge_rms = {side: HINGE_STD * _rms(fit.hinge[looks.closed, i]) for side, i in seen.items()}
    tilts, spread = fit.x[layout.tilt].reshape(-1, 2), np.sqrt(np.diag(covariance))
    # Half a turn and more is the same turn the other way round, and no uncertainty is larger.
    tilts = Rotation.from_rotvec(np.pad(tilts, ((0, 0), (0, 1)))).as_rotvec()[:, :2]
    spread[layout.tilt] = np.minimum(spread[layout.tilt], np.pi)
    subject = replace(
        prior,
        name=recording.name,
        hinges={side: Hinge(hinge[side], max(hinge_rms[side], HINGE_STD)) for side in seen},
        start_pose_offset={
            name: StartPoseOffset(tilt, float(np.sqrt(np.mean(std**2))))
            for name, tilt, std in zip(layout.sensors, tilts, spread[layout.tilt].reshape(-1, 2), strict=True)
        },
        heading_drift={
            name: HeadingDrift(float(rate), float(std))
            for name, rate, std in zip(layout.sensors, fit.x[layout.drift], spread[layout.drift], strict=True)
        },
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        order=order,
        covariance=joint,
        mounts=mounts,
        note=f"{protocol.title}; scale "
        + (f"taped: {', '.join(scaling)}" if scaling else "of the anthropometric prior"),
    )
    gap, prior_gap = (np.linalg.norm(gaps, axis=1) for gaps in (fit.gaps, residuals(at_prior, looks)[2]))
    gap[~looks.closed] = prior_gap[~looks.closed] = np.nan
    touched = looks.closed & (weight > TOUCHED)
    return Calibration(
        subject=subject,
        prior=prior,
        rms_gap=_rms(gap[touched]),
        prior_rms_gap=_rms(prior_gap[touched]),
        independent=independent,
        gauge=gauge,
        scale_std=scale_std,
        diagnostics=tuple(diagnostics),
        time=recording.time[at],
        gap=gap,
        prior_gap=prior_gap,
        kept=weight,
        start_tilt=dict(zip(layout.sensors, tilts, strict=True)),
        drift=dict(zip(layout.sensors, fit.x[layout.drift].tolist(), strict=True)),
        hinge=hinge,
        hinge_rms=hinge_rms,
        learned={} if quick else learned,
        before=handed_on(layout, np.linalg.inv(known))[1],
        quat_WL=segments_at(found, mounts, at),
        protocol=protocol.name,
        closure=next((closure.kind for closure in protocol.closures), ""),
        tape=protocol.tape,
        tapes=taped(fit, layout, measured),
        scaling=tuple(scaling),
    )


def _mount(found: FilteredRecording, x: np.ndarray, layout: Layout, name: str) -> Rotation:
    i = layout.sensors.index(name)
    tilt = np.append(x[layout.tilt][2 * i : 2 * i + 2], 0.0)
    turn = Rotation.from_rotvec([0.0, 0.0, x[layout.heading][i]])
    return Rotation.from_rotvec(-tilt) * turn * found.at_start[name]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
