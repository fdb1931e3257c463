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
from ..recording import Recording
from ..subject import LENGTHS, Subject, average_subject, mount_rows
from .chain import ARMS, CHAIN, SIDES
from .problem import HINGE_STD, Fit, K, Layout, Looks, residuals, solve
from .start import headings

PROTOCOLS = ("clasp",)

# One standard deviation [m] of a length taped over the skin, where the user gives none.
GAUGE_STD = 0.003
# The gap is looked at this often [Hz]; more only repeats what the motion's own slowness correlates anyway.
LOOK_RATE_HZ = 8.0
# Priors, one standard deviation. A stated mount names sensor axes, put on by hand.
STATED_STD = np.deg2rad(10.0)  # [rad] of a stated mount's heading
READY_STD = np.deg2rad(2.0)  # [rad] about each axis, of segments that a device aligned itself
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
SAG_STD = np.deg2rad(0.6)  # [rad] as the segment turns by a radian, each axis against each
# Elbow axis (x, 1, z) in the upper arm: palms turn in or out alike on both sides, the torso's facing is common to both.
HINGE_MIRROR_STD, HINGE_COMMON_STD, HINGE_TILT_STD = np.deg2rad([20.0, 5.0, 5.0])
# Residual variance, in units of the weights', that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
# Errors of orientations are slow: two looks closer than this [s] are never independent, however white the residual
# looks in one phase. Found on simulated people, whose joint errors it brings within what the covariance says.
LEAST_CORRELATION_S = 3.0
LEAST_LOOKS = 10
ROUNDS = 5
# A look whose gap is this many times the usual is one at which the palms were apart.
APART = 5.0
TOUCHED = 0.1  # of a look's weight


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
    protocol: str = "clasp",
    method: str = "smekf",
    gauge_std: float = GAUGE_STD,
) -> Calibration:
    """Link lengths with their covariance, and what was found beside them.

    Parameters
    ----------
    gauge : measured lengths, name → [m]; without one the scale is the prior's
    prior : lengths before, with covariance, and mounts; None for the anthropometric average
    protocol : phase of the session in which the palms touch
    method : the orientation filter
    gauge_std : standard deviation [m] of each measured length

    Raises
    ------
    BadOption
        An unknown protocol, or a gauge that is no length or no plausible one.
    BadSession, BadPhase
        A sensor that the closed chain needs is missing; there is no such phase.
    """
    if protocol not in PROTOCOLS:
        raise BadOption(f"protocol '{protocol}' is not known; {one_of(PROTOCOLS, protocol)}")
    gauge = dict(gauge or {})
    for name, value in gauge.items():
        if name not in LENGTHS:
            raise BadOption(f"gauge {name}: not a length; {one_of(LENGTHS, name)}")
        if not 0.02 < value < 1.0:
            raise BadOption(f"gauge {name}={value:g}: a length in metres is needed, between 0.02 and 1.0")
    if not gauge_std > 0.0:
        raise BadOption(f"gauge_std={gauge_std:g}: a standard deviation in metres is needed, above 0")
    needed = ("torso", *(name for name in ARMS if not name.endswith("hand")))
    for segment in needed:
        if segment not in recording.sensors:
            raise BadSession(
                f"{recording.where()}: no sensor on {segment}; the closed chain needs one each on {', '.join(needed)}"
            )
    before = prior or average_subject()
    intervals = recording.phase(protocol)
    return _solve(recording, filtered(recording, method=method), intervals, before, gauge, gauge_std)


def _solve(
    recording: Recording,
    found: Filtered,
    intervals: tuple[tuple[float, float], ...],
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> Calibration:
    stride = max(1, round(recording.rate_hz / LOOK_RATE_HZ))
    at = np.concatenate([np.arange(len(recording))[recording.span(i)][::stride] for i in intervals])
    if len(at) < LEAST_LOOKS:
        raise BadPhase(
            f"{recording.where()}: phases.clasp holds {len(at)} looks at {LOOK_RATE_HZ:g} a second; at least "
            f"{LEAST_LOOKS} are needed, better a minute"
        )
    layout = Layout(tuple(name for name in CHAIN if name in found.R_VS))
    turned = [(found.R_VS[name][at] * found.at_start[name].inv()).as_quat().T for name in layout.sensors]
    looks = Looks(layout, np.vstack([*turned, recording.time[at] - found.start[1]]))
    center, information = _before(recording, found, looks, prior, gauge, gauge_std)

    fit, weights, weight, independent = _weighed(looks, center, information)
    lengths = fit.x[:K]
    if np.min(lengths) < 0.01:
        raise NoSolution(
            f"the lengths did not converge ({LENGTHS[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} mm); "
            f"check that the palms touch in the phase and that every sensor sits where the session says"
        )
    covariance = np.linalg.inv(fit.information)
    order, joint = _handed_on(layout, covariance)
    mounts = {name: _mount(found, fit.x, layout, name).as_quat() for name in layout.sensors}
    # Of sensors that are not in the chain the start pose has measured what it can.
    for name in set(found.R_VS) - set(mounts):
        stated = nominal_mount(recording, name, prior)
        if stated is not None:
            psi = heading_to(found.at_start[name], Rotation.from_quat(stated))
            mounts[name] = (Rotation.from_rotvec([0.0, 0.0, psi]) * found.at_start[name]).as_quat()

    at_prior = fit.x.copy()
    at_prior[:K] = [prior.lengths[name] for name in LENGTHS]
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance[:K, :K], lengths)) ** -1)
    scaling = [name for name in gauge if name != "trunk"]  # the trunk is not in the chain and cannot scale it
    without_data = np.linalg.inv(information[:K, :K])
    warnings = _remarks(lengths, covariance[:K, :K], without_data, prior, None if scaling else scale_std)
    subject = replace(
        prior,
        name=recording.name,
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        order=order,
        covariance=joint,
        mounts=mounts,
        note="hands together; scale " + (f"taped: {', '.join(scaling)}" if scaling else "of the anthropometric prior"),
    )
    gap, prior_gap = (np.linalg.norm(gaps, axis=1) for gaps in (fit.gaps, residuals(at_prior, looks)[2]))
    axes = [np.array([x, 1.0, z]) for x, z in fit.x[layout.hinge].reshape(2, 2)]
    return Calibration(
        subject=subject,
        prior=prior,
        rms_gap=_rms(gap[weight > TOUCHED]),
        prior_rms_gap=_rms(prior_gap[weight > TOUCHED]),
        independent=independent,
        gauge=gauge,
        scale_std=scale_std,
        warnings=(*found.warnings, *warnings, *_apart(recording.time[at], weight)),
        time=recording.time[at],
        gap=gap,
        prior_gap=prior_gap,
        kept=weight,
        start_tilt=dict(zip(layout.sensors, fit.x[layout.tilt].reshape(-1, 2), strict=True)),
        drift=dict(zip(layout.sensors, fit.x[layout.drift].tolist(), strict=True)),
        hinge={side: axis / np.linalg.norm(axis) for side, axis in zip(SIDES, axes, strict=True)},
        hinge_rms={side: HINGE_STD * _rms(r) for side, r in zip(SIDES, fit.hinge.T, strict=True)},
        learned=_learned(fit.x, looks, weights, covariance),
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
    for name, value in gauge.items():
        i = LENGTHS.index(name)
        information[i, i] += 1.0 / gauge_std**2
        target[i] += value / gauge_std**2
    center[:K] = np.linalg.solve(information[:K, :K], target)

    guess = headings(looks)
    for i, name in enumerate(layout.sensors):
        # What is known of this sensor's (ε_x, ε_y, ψ): the person stands nearly so, and of a mount R_LS = exp(m) R_0
        # that m = μ − ε + ψ' e_z is small, with μ the misfit of the start pose at the heading nearest to R_0.
        of = [layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i]
        known = np.diag([START_POSE_STD**-2, START_POSE_STD**-2, 0.0])
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
    x_left, z_left, x_right, z_right = range(layout.hinge.start, layout.hinge.stop)
    for std, rows, share in (
        (HINGE_COMMON_STD, (x_left, x_right), np.array([0.5, 0.5])),
        (HINGE_MIRROR_STD, (x_left, x_right), np.array([0.5, -0.5])),
        (HINGE_TILT_STD, (z_left,), np.ones(1)),
        (HINGE_TILT_STD, (z_right,), np.ones(1)),
    ):
        information[np.ix_(rows, rows)] += np.outer(share, share) / std**2
    return center, information


def _mount_information(recording: Recording, segment: str, prior: Subject) -> np.ndarray:
    """Information (3, 3) [1/rad²] of the nominal mount's error in L."""
    covariance = mount_covariance(recording, segment, prior)
    if covariance is not None:
        return np.linalg.inv(covariance + 1e-12 * np.eye(3))
    calibrated = segment in prior.mounts and recording.strapping != "new"
    if calibrated or recording.sensors[segment].ready:
        return np.eye(3) / READY_STD**2
    return np.diag([0.0, 0.0, STATED_STD**-2])


def _weighed(looks: Looks, center: np.ndarray, information: np.ndarray) -> tuple[Fit, np.ndarray, np.ndarray, float]:
    """The fit, the weights (n, 5), the weight (n,) that each look's gap kept, how many independent looks it is worth.

    Gap and hinges are weighed by their own residuals: variance, and how long it stays correlated.
    """
    n = looks.data.shape[1]
    x, kept = center, np.ones(n)
    weights = np.full((n, 5), 1.0 / (LEAST_CORRELATION_S * LOOK_RATE_HZ))
    independent = float(n)
    for _ in range(ROUNDS):
        fit = solve(looks, center, information, weights, x)
        x = fit.x
        for columns, r in ((slice(0, 3), fit.closure), (slice(3, 5), fit.hinge)):
            size = np.sum(r**2, axis=1)
            if columns.start == 0:
                usual = max(float(np.median(size)) / 2.366, LEAST_VARIANCE)  # the median of chi² with 3 degrees
                kept = (1.0 + size / (usual * APART**2 * 3.0)) ** -2
            of = kept if columns.start == 0 else np.ones(n)
            correlated = max(_correlation_time(r * of[:, None]), LEAST_CORRELATION_S * LOOK_RATE_HZ)
            variance = max(float(np.sum(of * size)) / (r.shape[1] * float(of.sum())), LEAST_VARIANCE)
            weights[:, columns] = of[:, None] / (correlated * variance)
            if columns.start == 0:
                independent = float(of.sum()) / correlated
    return solve(looks, center, information, weights, x), weights, kept, independent


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


def _learned(x: np.ndarray, looks: Looks, weights: np.ndarray, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Which share of what is known each look brought: C = C (Σ Jᵀ W J + Λ) C, over C, is a sum to 1."""
    layout, unit = looks.layout, np.eye(looks.layout.size)
    of = dict(zip(LENGTHS, unit[:K], strict=True))
    of |= {f"{s}_forearm + {s}_hand": of[f"{s}_forearm"] + of[f"{s}_hand"] for s in SIDES}
    for i, name in enumerate(layout.sensors):
        rows = (layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i)
        of |= dict(zip(mount_rows(name), unit[list(rows)], strict=True))
    T = np.array(list(of.values()))
    _, J, _ = residuals(x, looks)
    moved = J @ covariance @ T.T  # (n, 5, k)
    share = np.einsum("ni,nik->kn", weights, moved**2) / np.einsum("ki,ij,kj->k", T, covariance, T)[:, None]
    return dict(zip(of, share, strict=True))


def _mount(found: Filtered, x: np.ndarray, layout: Layout, name: str) -> Rotation:
    i = layout.sensors.index(name)
    tilt = np.append(x[layout.tilt][2 * i : 2 * i + 2], 0.0)
    turn = Rotation.from_rotvec([0.0, 0.0, x[layout.heading][i]])
    return Rotation.from_rotvec(-tilt) * turn * found.at_start[name]


def _apart(time: np.ndarray, kept: np.ndarray) -> list[str]:
    """A line on the moments at which the palms were apart."""
    apart = kept < TOUCHED
    if not apart.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate(([0], apart.view(np.int8), [0]))))
    spans = [(time[a], time[b - 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    longest = sorted(spans, key=lambda span: span[0] - span[1])[:3]
    said = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in sorted(longest))
    return [f"the palms were apart for {100 * apart.mean():.0f} % of the phase, left out: {said}"]


def _remarks(
    lengths: np.ndarray,
    covariance: np.ndarray,
    without_data: np.ndarray,
    prior: Subject,
    free_scale_std: float | None,
) -> list[str]:
    """What the user should know of the result; `free_scale_std`: relative, where no gauge fixes the scale."""
    remarks = []
    if free_scale_std is not None:
        remarks.append(
            f"no gauge in the chain: the hands together fix the proportions, not the scale, which is the prior's "
            f"({prior.note or prior.name}): all lengths may be off together by {100 * free_scale_std:.1f} %; tape one, "
            f"as in --gauge shoulder_width=0.385"
        )
    for name, length in zip(LENGTHS, lengths, strict=True):
        z = (length - prior.lengths[name]) / prior.std(name)
        if abs(z) > 4.0:
            remarks.append(
                f"{name} = {length:.3f} m lies {abs(z):.1f} standard deviations from the average; "
                f"check mounts and phases"
            )
    # The hands tell the proportions: those must be known better than from the average person and the tape.
    width = LENGTHS.index("shoulder_width")
    for arm in (LENGTHS.index("left_upper_arm"), LENGTHS.index("right_upper_arm")):
        share = np.zeros(len(LENGTHS))
        share[arm], share[width] = 1.0 / lengths[arm], -1.0 / lengths[width]
        if share @ covariance @ share < 0.5 * share @ without_data @ share:
            break
    else:
        remarks.append(
            "the joined hands moved too little to tell the lengths, which are mostly the average person's: move them "
            "through the whole reach"
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
