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
  averages out over the phase, so all of it is unknown beside the lengths, with priors of its own (`problem`).

The weight of the data is measured, not assumed: the residual's own mean square sets its variance and its
autocorrelation the number of independent samples, in a few rounds of Gauss-Newton. Looks at which the palms were apart
stand out of the rest and lose their weight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import START_POSE_STD, Filtered, filtered, heading_to, mount_covariance, nominal_mount
from ..errors import BadOption, BadPhase, BadSession, BadSubject, NoSolution, one_of
from ..filters import BEST
from ..recording import Recording
from ..subject import LENGTHS, Hinge, Subject, average_subject, mount_rows
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
from .problem import HINGE_STD, Fit, K, Layout, Looks, carrier, placed, residuals, solve
from .protocols import Closure, Protocol, load_protocol
from .start import headings
from .touching import touching_start

# One standard deviation [m] of a length taped over the skin, where the user gives none.
GAUGE_STD = 0.003
# The gap is looked at this often [Hz]; more only repeats what the motion's own slowness correlates anyway.
LOOK_RATE_HZ = 8.0
# Priors, one standard deviation. A stated mount names sensor axes, put on by hand.
STATED_STD = np.deg2rad(10.0)  # [rad] of a stated mount's heading
READY_STD = np.deg2rad(2.0)  # [rad] about each axis, of segments that a device aligned itself
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
HEADING_STD = np.pi / np.sqrt(3.0)  # [rad] of a heading that nothing tells: the whole circle
POINT_STD = 3.0  # [m] of a point of W that nothing tells
SAG_STD = np.deg2rad(0.6)  # [rad] as the segment turns by a radian, each axis against each
SHOULDERS_STD = np.deg2rad(2.0)  # [rad] of the shoulders' line about the torso's z: some 9 mm of one of them
# Elbow axis (x, 1, z) in the upper arm: palms turn in or out alike on both sides, the torso's facing is common to both.
HINGE_MIRROR_STD, HINGE_COMMON_STD, HINGE_TILT_STD = np.deg2rad([20.0, 5.0, 5.0])
# Residual variance, in units of the weights', that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
# Errors of orientations are slow: two looks closer than this [s] are never independent, however white the residual
# looks in one phase. Found on simulated people, whose joint errors it brings within what the covariance says.
LEAST_CORRELATION_S = 3.0
LEAST_LOOKS = 10
THIRD_CHI2 = {1: 0.1485, 3: 1.4237}  # what 30 % of chi² with so many degrees stay below
ROUNDS = 5
MANY_LOOKS = 1000  # from twice as many on, all rounds but the last are made with every second, third, … look
# To see whether labels and mounts can be as stated, the closure alone at fewer looks tells enough.
QUICK_RATE_HZ, QUICK_ROUNDS, QUICK_STEPS = 1.0, 1, 15
# A look whose gap is this many times the usual is one at which the palms were apart.
APART = 5.0
TOUCHED = 0.1  # of a look's weight
SURE = 0.4  # below it the look is left out altogether, once the fit is about right
LOOSE_SCALE = 0.6  # of the prior's relative standard deviation, from which on a gauge is said to tell little
LEAST_LOOSE_SCALE = 0.025  # ... but not below this: a taped shoulder width leaves about 2 %
UNSEEN_HEADING_STD = np.deg2rad(15.0)  # [rad] from which on a heading is said to be unknown


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
    warnings : what the user should know
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
    labels : whether the sensors sit where the session says
    contradicted : stated mounts that could not be and were not used, in words
    """

    subject: Subject
    prior: Subject
    rms_gap: float
    prior_rms_gap: float
    independent: float
    gauge: Mapping[str, float]
    scale_std: float
    warnings: tuple[str, ...]
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
    labels: Labels = field(default_factory=Labels)
    contradicted: tuple[str, ...] = ()

    def arms(self) -> Arms:
        """How the arms moved while the chain was closed."""
        closed = np.isfinite(self.gap)
        touched = closed & (self.kept > TOUCHED) if closed.any() else np.ones(len(self.gap), dtype=bool)
        gap = np.sqrt(np.average(self.gap[closed] ** 2, weights=self.kept[closed])) if closed.any() else 0.0
        quat_WL = {name: quat[touched] for name, quat in self.quat_WL.items()}
        return arms(quat_WL, self.subject.lengths, float(gap))


def calibrate(
    recording: Recording, *, gauge: Mapping[str, float] | None = None, prior: Subject | None = None, **options: Any
) -> Subject:
    """The subject of a hands-together recording; options, and what else was found: see `calibrate_lengths`."""
    return calibrate_lengths(recording, gauge=gauge, prior=prior, **options).subject


def calibrate_lengths(
    recording: Recording,
    *,
    gauge: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    protocol: str | Protocol = "clasp",
    method: str = BEST,
    gauge_std: float = GAUGE_STD,
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
    if not isinstance(protocol, Protocol):
        protocol = load_protocol(protocol)
    gauge = dict(gauge or {})
    for name, value in gauge.items():
        if name not in (*LENGTHS, *protocol.gauges):
            raise BadOption(f"gauge {name}: not a length; {one_of((*LENGTHS, *protocol.gauges), name)}")
        if not 0.02 < value < 1.0:
            raise BadOption(f"gauge {name}={value:g}: a length in metres is needed, between 0.02 and 1.0")
    if not gauge_std > 0.0:
        raise BadOption(f"gauge_std={gauge_std:g}: a standard deviation in metres is needed, above 0")
    if len(set(gauge) & set(protocol.chain)) < protocol.taped:
        raise BadOption(
            f"protocol '{protocol.name}' needs {protocol.taped} taped length of its chain, as in --gauge "
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
    return _believed(recording, filtered(recording, method=method), protocol, before, gauge, gauge_std)


def _believed(
    recording: Recording,
    found: Filtered,
    protocol: Protocol,
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> Calibration:
    """The calibration by what the session says of its sensors, as far as gravity, motion and anatomy let it stand."""

    def tried(recording: Recording, found: Filtered, prior: Subject) -> Calibration:
        return _solve(recording, found, protocol, prior, gauge, gauge_std, quick=True)

    where = "correct it in the session or leave it out"
    notes = []
    wrong = against_gravity(recording, prior, found)
    for name, off in wrong.items():
        notes.append(f"sensors.{name}.mount is {off:.0f} deg off gravity in the start pose and was not used; {where}")
    recording, prior = without_mounts(recording, prior, wrong)
    stated = tried(recording, found, prior)
    doubt = stated.arms().doubt()
    if doubt > 1.0 or against_motion(recording, prior, stated.subject.mounts):
        bare, unknown = without_mounts(recording, prior, found.R_VS)
        free = tried(bare, found, unknown)
        if free.arms().doubt() < min(1.0, BETTER * max(doubt, 1.0 / BETTER)):
            wrong = against_motion(recording, prior, free.subject.mounts)
            for name, off in wrong.items():
                notes.append(
                    f"sensors.{name}.mount is {off:.0f} deg off what the motion says and was not used; {where}"
                )
            recording, prior = without_mounts(recording, prior, wrong)
            doubt = 0.0 if wrong else doubt
    if doubt > 1.0:
        labels = check_labels(
            stated.arms(),
            lambda moved: tried(*relabelled(recording, found, moved), prior).arms(),
            tuple(found.R_VS),
        )
        if labels.moved:
            return replace(stated, labels=labels, warnings=(labels.said(), *notes, *stated.warnings))
    best = _solve(recording, found, protocol, prior, gauge, gauge_std)
    how = best.arms()
    labels = Labels(how.doubt(), how.contradiction() if how.doubt() > 1.0 else "")
    said = [labels.said()] if labels.said() else []
    return replace(best, labels=labels, contradicted=tuple(notes), warnings=(*said, *notes, *best.warnings))


def _looks(
    recording: Recording, found: Filtered, protocol: Protocol, rate_hz: float = LOOK_RATE_HZ
) -> tuple[Looks, np.ndarray]:
    """The looks of all conditions, and their samples (n,)."""
    stride = max(1, round(recording.rate_hz / rate_hz))
    samples = []
    for condition in protocol.conditions:
        spans = [recording.span(interval) for interval in recording.phase(condition.phase)]
        # Each look once, however the intervals overlap.
        samples.append(np.unique(np.concatenate([np.arange(len(recording))[span] for span in spans]))[::stride])
        if len(samples[-1]) < LEAST_LOOKS * rate_hz / LOOK_RATE_HZ:
            raise BadPhase(
                f"{recording.where()}: phases.{condition.phase} holds {len(samples[-1])} looks at {LOOK_RATE_HZ:g} a "
                f"second; at least {LEAST_LOOKS} are needed"
                + (", better a minute" if isinstance(condition, Closure) else ", better five seconds")
            )
    at = np.concatenate(samples)
    seen = {carrier(segment, found.R_VS) for segment in protocol.segments}
    fixed = sum(closure.kind == "fixed_point" for closure in protocol.closures)
    layout = Layout(tuple(name for name in CHAIN if name in seen), fixed, protocol.gauges)
    turned = [(found.R_VS[name][at] * found.at_start[name].inv()).as_quat().T for name in layout.sensors]
    of = np.repeat(np.arange(len(samples)), [len(part) for part in samples])
    return Looks(layout, np.vstack([*turned, recording.time[at] - found.start[1]]), protocol.conditions, of), at


def _solve(
    recording: Recording,
    found: Filtered,
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
    center, information = _before(recording, found, looks, prior, gauge, gauge_std)
    start, touching = center, np.ones(len(at))
    if not quick:
        start, touching = touching_start(
            looks, lambda some: _before(recording, found, some, prior, gauge, gauge_std)[0]
        )

    fit, weights, weight, independent = _weighed(looks, center, information, start, touching, quick)
    lengths = fit.x[:K]
    if not quick and np.min(lengths) < 0.01:
        raise NoSolution(
            f"the lengths did not converge ({LENGTHS[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} mm); "
            f"check that the palms touch in the phase and that every sensor sits where the session says"
        )
    covariance = np.linalg.inv(fit.information)
    if not quick:
        learned = _learned(fit, looks.layout, weights, covariance)
        covariance = _covariance(looks, fit, information, weights, weight)
    order, joint = _handed_on(layout, covariance)
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
    without_data = np.linalg.inv(information[:K, :K])
    warnings = _remarks(protocol, lengths, covariance[:K, :K], without_data, prior, None if scaling else scale_std)
    warnings += _unseen(protocol, layout, covariance, gauge)
    seen = {side: SIDES.index(side) for side in (layout.arms if looks.closed.any() else ())}
    axes = {side: np.array([x, 1.0, z]) for side, (x, z) in zip(SIDES, fit.x[layout.hinge].reshape(2, 2), strict=True)}
    hinge = {side: axes[side] / np.linalg.norm(axes[side]) for side in seen}
    hinge_rms = {side: HINGE_STD * _rms(fit.hinge[looks.closed, i]) for side, i in seen.items()}
    subject = replace(
        prior,
        name=recording.name,
        hinges={side: Hinge(hinge[side], max(hinge_rms[side], HINGE_STD)) for side in seen},
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
        warnings=(*found.warnings, *warnings, *_apart(recording.time[at], weight, looks)),
        time=recording.time[at],
        gap=gap,
        prior_gap=prior_gap,
        kept=weight,
        start_tilt=dict(zip(layout.sensors, fit.x[layout.tilt].reshape(-1, 2), strict=True)),
        drift=dict(zip(layout.sensors, fit.x[layout.drift].tolist(), strict=True)),
        hinge=hinge,
        hinge_rms=hinge_rms,
        learned={} if quick else learned,
        before=_handed_on(layout, np.linalg.inv(information))[1],
        quat_WL=segments_at(found, mounts, at),
        protocol=protocol.name,
    )


def _before(
    recording: Recording,
    found: Filtered,
    looks: Looks,
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> tuple[np.ndarray, np.ndarray]:
    """All that is known before the closure, as one Gaussian over x: centre and information."""
    layout = looks.layout
    center, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    if not set(LENGTHS) <= set(prior.order) or np.linalg.eigvalsh(prior.lengths_covariance())[0] <= 0.0:
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    information[:K, :K] = np.linalg.inv(prior.lengths_covariance())
    target = information[:K, :K] @ [prior.lengths[name] for name in LENGTHS]
    for name in gauge.keys() & set(LENGTHS):
        i, value = LENGTHS.index(name), gauge[name]
        information[i, i] += 1.0 / gauge_std**2
        target[i] += value / gauge_std**2
    center[:K] = np.linalg.solve(information[:K, :K], target)

    for name, row in zip(layout.gauges, range(layout.size)[layout.distances], strict=True):
        stated = next(c for c in looks.conditions if isinstance(c, Closure) and c.gauge == name)
        center[row] = gauge.get(name, stated.metres)
        information[row, row] = (gauge_std if name in gauge else stated.metres_std) ** -2
    information[layout.points, layout.points] = np.eye(3 * layout.fixed) / POINT_STD**2

    guess = headings(looks, center[:K], center[layout.distances], _stated_headings(recording, found, layout, prior))
    for i, name in enumerate(layout.sensors):
        # What is known of this sensor's (ε_x, ε_y, ψ): the person stands nearly so, and of a mount R_LS = exp(m) R_0
        # that m = μ − ε + ψ' e_z is small, with μ the misfit of the start pose at the heading nearest to R_0.
        of = [layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i]
        known = np.diag([START_POSE_STD**-2, START_POSE_STD**-2, HEADING_STD**-2])
        mean = np.zeros(3)
        center[of[2]] = guess[i]
        mount = nominal_mount(recording, name, prior)
        if mount is not None:
            R_mount = Rotation.from_quat(mount)
            center[of[2]] = psi = heading_to(found.at_start[name], R_mount)
            misfit = (Rotation.from_rotvec([0.0, 0.0, psi]) * found.at_start[name] * R_mount.inv()).as_rotvec()
            sure = _mount_information(recording, name, prior)
            signs = np.diag([-1.0, -1.0, 1.0])
            mean = np.linalg.solve(
                known + signs @ sure @ signs + 1e-9 * np.eye(3), -signs @ sure @ np.append(misfit[:2], 0.0)
            )
            known = known + signs @ sure @ signs
        center[of] += mean
        information[np.ix_(of, of)] = known
    information[layout.drift, layout.drift] = np.eye(len(layout.sensors)) / DRIFT_STD**2
    information[layout.sag, layout.sag] = np.eye(9 * len(layout.sensors)) / SAG_STD**2
    information[layout.shoulders, layout.shoulders] = SHOULDERS_STD**-2
    x_left, z_left, x_right, z_right = range(layout.hinge.start, layout.hinge.stop)
    for std, rows, share in (
        (HINGE_COMMON_STD, (x_left, x_right), np.array([0.5, 0.5])),
        (HINGE_MIRROR_STD, (x_left, x_right), np.array([0.5, -0.5])),
        (HINGE_TILT_STD, (z_left,), np.ones(1)),
        (HINGE_TILT_STD, (z_right,), np.ones(1)),
    ):
        information[np.ix_(rows, rows)] += np.outer(share, share) / std**2
    return placed(center, looks), information


def _stated_headings(recording: Recording, found: Filtered, layout: Layout, prior: Subject) -> dict[str, float]:
    """Sensor → ψ [rad] to its nominal mount, of those that have one."""
    mounts = {name: nominal_mount(recording, name, prior) for name in layout.sensors}
    return {
        name: heading_to(found.at_start[name], Rotation.from_quat(mount))
        for name, mount in mounts.items()
        if mount is not None
    }


def _mount_information(recording: Recording, segment: str, prior: Subject) -> np.ndarray:
    """Information (3, 3) [1/rad²] of the nominal mount's error in L."""
    covariance = mount_covariance(recording, segment, prior)
    if covariance is not None:
        return np.linalg.inv(covariance + 1e-12 * np.eye(3))
    calibrated = segment in prior.mounts and recording.strapping != "new"
    if calibrated or recording.sensors[segment].ready:
        return np.eye(3) / READY_STD**2
    return np.diag([0.0, 0.0, STATED_STD**-2])


def _weighed(
    looks: Looks, center: np.ndarray, information: np.ndarray, start: np.ndarray, touching: np.ndarray, quick: bool
) -> tuple[Fit, np.ndarray, np.ndarray, float]:
    """The fit, the weights (n, 5), the weight (n,) that each look's gap kept, how many independent looks it is worth.

    Gap and hinges are weighed by their own residuals: variance, and how long it stays correlated.
    """
    n = looks.data.shape[1]
    closed, rounds, least = looks.closed, range(QUICK_ROUNDS if quick else ROUNDS), _least(looks)
    if n >= 2 * MANY_LOOKS and closed.any() and not quick:
        few = np.concatenate([np.arange(n)[span][:: n // MANY_LOOKS] for _, span in looks.spans()])
        fit, _, kept, _ = _weighed(looks.take(few), center, information, start, touching[few], quick)
        start, touching, rounds = fit.x, np.interp(np.arange(n), few, kept), rounds[-1:]
    x: np.ndarray | Fit = start
    kept = touching.copy()
    steps = QUICK_STEPS if quick else 60
    weights = np.full((n, 5), 1.0 / least)
    weights[:, :3] *= kept[:, None]
    if quick:
        weights[:, 3:] = 0.0
    independent = float(closed.sum())
    for condition, span in looks.spans():
        if not isinstance(condition, Closure):
            weights[span] = 1.0 / (span.stop - span.start)  # as it was held, it was held: one look altogether
    if not closed.any():
        return solve(looks, center, information, weights, x, steps, not quick), weights, kept, independent
    for k in rounds:
        x = fit = solve(looks, center, information, weights, x, steps, not quick)
        independent = 0.0
        for closure, span in looks.spans():
            if isinstance(closure, Closure):
                r = fit.closure[span, : closure.rows]
                size = np.sum(r**2, axis=1)
                # The lower third: the palms may be apart for half of the phase and more.
                usual = max(float(np.quantile(size, 0.3)) / THIRD_CHI2[closure.rows], LEAST_VARIANCE)
                weight = (1.0 + size / (usual * APART**2 * closure.rows)) ** -2
                kept[span] = np.where(weight > (SURE if k > 1 else TOUCHED), weight, 0.0)
                weights[span, :3] = _weights(r, kept[span], least)
                independent += float(kept[span].sum()) / _correlated(r * kept[span, None], least)
        arms = [SIDES.index(side) for side in looks.layout.arms]
        if arms and not quick:
            weights[closed, 3:] = _weights(fit.hinge[closed][:, arms], np.ones(int(closed.sum())), least)
    return solve(looks, center, information, weights, x, steps, not quick), weights, kept, independent


def _weights(r: np.ndarray, kept: np.ndarray, least: float) -> np.ndarray:
    """Weights (n, 1) of residuals (n, k): what each look kept, over variance and looks to an independent one."""
    variance = max(float(np.sum(kept * np.sum(r**2, axis=1))) / (r.shape[1] * float(kept.sum())), LEAST_VARIANCE)
    return kept[:, None] / (_correlated(r * kept[:, None], least) * variance)


def _least(looks: Looks) -> float:
    """How many looks `LEAST_CORRELATION_S` is."""
    return LEAST_CORRELATION_S / max(float(np.median(np.diff(looks.data[-1]))), 1e-3)


def _correlated(r: np.ndarray, least: float) -> float:
    """How many looks make one independent one."""
    return max(_correlation_time(r), least)


def _covariance(looks: Looks, fit: Fit, before: np.ndarray, weights: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Covariance of x: what errors that stay for a while do to this fit.

    The weights count as many looks for one as the errors last. That is what they are worth where the motion is as slow
    as the errors; where it turns through a good part of its reach meanwhile, an error pulls at other unknowns from look
    to look, and cancels. So the gradient's covariance is that of sums over windows of the errors' duration,
    C (Λ + Σ (Σ w J)ᵀ σ² (Σ w J) / duration) C, as of Newey and West 1987 with their triangle of weights.
    """
    C = np.linalg.inv(fit.information)
    J, r, least = fit.jacobian, np.hstack((fit.closure, fit.hinge)), _least(looks)
    weights = np.broadcast_to(weights, r.shape)
    arms = [3 + SIDES.index(side) for side in looks.layout.arms]
    gradient = before.copy()
    for condition, span in looks.spans():
        parts = [(list(range(condition.rows)), kept[span])]
        if isinstance(condition, Closure):
            parts += [(arms, np.ones(span.stop - span.start))] if arms else []
        for rows, share in parts:
            slope, w = J[span][:, rows], weights[span][:, rows]
            pull = w[:, :, None] * slope
            if not isinstance(condition, Closure):
                gradient += np.einsum("nki,nkj->ij", pull, slope)
                continue
            if not share.sum() > 0.0:
                continue
            # What the fit took out of the residuals is given back to their variance.
            size = np.sum(r[span][:, rows] ** 2, axis=1) + np.einsum("nki,ij,nkj->n", slope, C, slope, optimize=True)
            variance = max(float(share @ size) / (len(rows) * float(share.sum())), LEAST_VARIANCE)
            lasts = round(_correlated(r[span][:, rows] * share[:, None], least))
            summed = np.concatenate((np.zeros((1, *pull.shape[1:])), np.cumsum(pull, axis=0)))
            ends = np.arange(1, len(pull) + lasts)
            windows = summed[np.minimum(ends, len(pull))] - summed[np.maximum(ends - lasts, 0)]
            windows = windows.reshape(-1, C.shape[0])
            gradient += variance / lasts * windows.T @ windows
    return C @ gradient @ C


def _handed_on(layout: Layout, covariance: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
    """Lengths and mount errors of x's covariance, with their names: R_LS = exp(−ε) Rz(ψ) R_VS(start)."""
    rows = [row for name in layout.sensors for row in mount_rows(name)]
    take = np.zeros((K + len(rows), layout.size))
    take[:K, :K] = np.eye(K)
    for i in range(len(layout.sensors)):
        take[K + 3 * i, layout.tilt.start + 2 * i] = -1.0
        take[K + 3 * i + 1, layout.tilt.start + 2 * i + 1] = -1.0
        take[K + 3 * i + 2, layout.heading.start + i] = 1.0
    return (*LENGTHS, *rows), take @ covariance @ take.T


def _learned(fit: Fit, layout: Layout, weights: np.ndarray, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Which share of what is known each look brought: C = C (Σ Jᵀ W J + Λ) C, over C, is a sum to 1."""
    unit = np.eye(layout.size)
    of = dict(zip(LENGTHS, unit[:K], strict=True))
    of |= {f"{s}_forearm + {s}_hand": of[f"{s}_forearm"] + of[f"{s}_hand"] for s in SIDES}
    for i, name in enumerate(layout.sensors):
        rows = (layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i)
        of |= dict(zip(mount_rows(name), unit[list(rows)], strict=True))
    T = np.array(list(of.values()))
    moved = fit.jacobian @ covariance @ T.T  # (n, 5, k)
    share = np.einsum("ni,nik->kn", weights, moved**2) / np.einsum("ki,ij,kj->k", T, covariance, T)[:, None]
    return dict(zip(of, share, strict=True))


def _mount(found: Filtered, x: np.ndarray, layout: Layout, name: str) -> Rotation:
    i = layout.sensors.index(name)
    tilt = np.append(x[layout.tilt][2 * i : 2 * i + 2], 0.0)
    turn = Rotation.from_rotvec([0.0, 0.0, x[layout.heading][i]])
    return Rotation.from_rotvec(-tilt) * turn * found.at_start[name]


# What it means that a closure does not hold.
OPEN = {
    "coincide": "the palms were apart",
    "fixed_point": "the palm was off its point",
    "distance": "the hands did not keep their distance",
}


def _apart(time: np.ndarray, kept: np.ndarray, looks: Looks) -> list[str]:
    """A line on the moments at which each closure was open."""
    lines = []
    for closure, span in looks.spans():
        apart = kept[span] < TOUCHED
        if not isinstance(closure, Closure) or not apart.any():
            continue
        edges = span.start + np.flatnonzero(np.diff(np.concatenate(([0], apart.view(np.int8), [0]))))
        spans = [(time[a], time[b - 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        longest = sorted(spans, key=lambda span: span[0] - span[1])[:3]
        said = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in sorted(longest))
        lines.append(f"{OPEN[closure.kind]} for {100 * apart.mean():.0f} % of the phase, left out: {said}")
    return lines


def _unseen(protocol: Protocol, layout: Layout, covariance: np.ndarray, gauge: Mapping[str, float]) -> list[str]:
    """What the protocol, as it was done, does not tell."""
    remarks = []
    std = np.sqrt(np.diag(covariance)[layout.heading])
    if np.any(std > UNSEEN_HEADING_STD):
        said = ", ".join(
            f"{name} ± {np.degrees(s):.0f} deg"
            for name, s in zip(layout.sensors, std, strict=True)
            if s > UNSEEN_HEADING_STD
        )
        remarks.append(f"headings that the motion hardly told: {said}; move through more of the reach, trunk as well")
    remarks += [
        f"{closure.gauge} = {closure.metres:g} m is the protocol's, not measured: give yours, as in --gauge "
        f"{closure.gauge}={closure.metres:g}"
        for closure in protocol.closures
        if closure.gauge and closure.gauge not in gauge
    ]
    return remarks


def _remarks(
    protocol: Protocol,
    lengths: np.ndarray,
    covariance: np.ndarray,
    without_data: np.ndarray,
    prior: Subject,
    free_scale_std: float | None,
) -> list[str]:
    """What the user should know of the result; `free_scale_std`: relative, where no gauge fixes the scale."""
    remarks = []
    if not protocol.closures:
        return [
            f"{protocol.title} tell headings and no length: those are the average person's "
            f"({prior.note or prior.name}), or taped"
        ]
    if free_scale_std is not None:
        remarks.append(
            f"no gauge in the chain: {protocol.title} fix the proportions, not the scale, which is the prior's "
            f"({prior.note or prior.name}): all lengths may be off together by {100 * free_scale_std:.1f} %; tape one, "
            f"as in --gauge {protocol.tape}"
        )
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith(("upper_arm", "forearm"))]
    share = np.zeros(K)
    share[arms] = 1.0 / lengths[arms] / max(len(arms), 1)
    scale_std, before = (float(np.sqrt(share @ C @ share)) for C in (covariance, prior.lengths_covariance()))
    if free_scale_std is None and scale_std > max(LOOSE_SCALE * before, LEAST_LOOSE_SCALE):
        remarks.append(
            f"the gauge hardly tells the scale of the arms, which may be off together by {100 * scale_std:.1f} %: "
            f"tape another length, as in --gauge {protocol.tape}"
        )
    for name, length in zip(LENGTHS, lengths, strict=True):
        z = (length - prior.lengths[name]) / prior.std(name)
        if abs(z) > 4.0:
            remarks.append(
                f"{name} = {length:.3f} m lies {abs(z):.1f} standard deviations from the average; "
                f"check mounts and phases"
            )
    # Closures tell proportions: those must be known better than from the average person and the tape.
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith("upper_arm")]
    for a, b in ((arm, other) for arm in arms for other in map(LENGTHS.index, protocol.chain) if other not in arms):
        share = np.zeros(K)
        share[a], share[b] = 1.0 / lengths[a], -1.0 / lengths[b]
        if share @ covariance @ share < 0.5 * share @ without_data @ share:
            break
    else:
        remarks.append(
            f"{protocol.title} moved too little to tell the lengths, which are mostly the average person's: move "
            f"through the whole reach"
        )
    return remarks


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _correlation_time(r: np.ndarray) -> float:
    """How many samples of `r` (n, 3) make one independent one: 1 + 2 Σ ρ, summed to the first crossing of zero."""
    n = len(r)
    centred = r - r.mean(axis=0)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(centred, size, axis=0)) ** 2
    rho = np.fft.irfft(spectrum, size, axis=0)[:n].sum(axis=1)
    if not rho[0] > 0.0:
        return 1.0
    rho = rho / rho[0]
    crossing = int(np.argmax(rho <= 0.0)) if np.any(rho <= 0.0) else n
    return float(1.0 + 2.0 * rho[1:crossing].sum())
