"""Link lengths from a hands-together phase: the closed chain of both arms, solved with CasADi.

While the palms are held together the chain shoulder–arm–palm–palm–arm–shoulder is closed: the gap

    g(ℓ) = R_torso e_y w + Σ_left R_i(−e_z) ℓ_i − Σ_right R_i(−e_z) ℓ_i

is zero. It is linear and homogeneous in the lengths ℓ, and that decides the form of the problem:

- Nothing in g fixes the scale: ℓ = 0 closes the chain perfectly. Errors of the orientations even favour it, since they
  add to ‖g‖² in proportion to ‖ℓ‖². So the residual is the gap over its own standard deviation, which is as
  homogeneous as the gap, and the quotient no longer changes with the scale (total instead of ordinary least squares).
- The scale comes from outside: a gauge (a measured length), else the anthropometric prior; the result says which.
- What the gap does not see keeps the prior: `trunk` cancels, and of a hand without a sensor only the sum forearm + hand
  is seen, the prior splits it.

The weight of the data is measured, not assumed: the residual's own mean square sets its variance and its
autocorrelation the number of independent samples, in two rounds of Gauss–Newton.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from .alignment import Segments, segment_orientations
from .errors import BadOption, BadSession, one_of
from .recording import Recording
from .subject import LENGTHS, Subject, average_subject

PROTOCOLS = ("clasp",)
ARMS = tuple(f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm", "hand"))

# One standard deviation [m] of a length taped over the skin, where the user gives none.
GAUGE_STD = 0.003
# The gap is looked at this often [Hz]; more only repeats what the motion's own slowness correlates anyway.
LOOK_RATE_HZ = 20.0
# Spread [rad] of a segment's orientation about the truth (filter, mount, soft tissue), before the data say better; only
# the shares of the segments in the gap's variance hang on it, and here all have the same.
ATTITUDE_STD = 0.035
ROUNDS = 3


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    Parameters
    ----------
    subject : lengths with covariance, mounts as used
    prior : what was known before
    rms_gap : palm-to-palm residual [m], root mean square of its length
    prior_rms_gap : the same with the prior's lengths
    independent : how many independent looks at the gap the phase is worth
    gauge : the measured lengths [m]; empty: the scale is the prior's
    scale_std : relative standard deviation of the overall scale
    warnings : what the user should know
    """

    subject: Subject
    prior: Subject
    rms_gap: float
    prior_rms_gap: float
    independent: float
    gauge: Mapping[str, float]
    scale_std: float
    warnings: tuple[str, ...]


def palm_gap(lengths: Any, quat_WL: Mapping[str, Any]) -> Any:
    """Palm-to-palm vector (3,) [m] in W as a CasADi expression: left palm minus right palm.

    Parameters
    ----------
    lengths : (8,) CasADi, in the order of `LENGTHS` [m]
    quat_WL : segment → (4,) CasADi xyzw, for the torso and both upper arms, forearms, hands
    """
    sided = {"left": 1.0, "right": -1.0}
    gap = rotate(quat_WL["torso"], ca.vertcat(0.0, lengths[LENGTHS.index("shoulder_width")], 0.0))
    for name in ARMS:
        side, _ = name.split("_", 1)
        gap += sided[side] * rotate(quat_WL[name], ca.vertcat(0.0, 0.0, -lengths[LENGTHS.index(name)]))
    return gap


def rotate(quat: Any, v: Any) -> Any:
    """``R v`` of a unit quaternion (4,) xyzw and a vector (3,), in CasADi."""
    u = quat[:3]
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def calibrate(
    recording: Recording,
    *,
    gauge: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    protocol: str = "clasp",
    method: str = "smekf",
    gauge_std: float = GAUGE_STD,
) -> Subject:
    """The subject of a hands-together recording; see `calibrate_lengths` for all that was found beside it.

    Parameters
    ----------
    gauge : measured lengths, name → [m]; without one the scale is the prior's
    prior : lengths before, with covariance, and mounts; None for the anthropometric average
    protocol : phase of the session in which the palms touch
    method : the orientation filter
    gauge_std : standard deviation [m] of each measured length
    """
    return calibrate_lengths(
        recording, gauge=gauge, prior=prior, protocol=protocol, method=method, gauge_std=gauge_std
    ).subject


def calibrate_lengths(
    recording: Recording,
    *,
    gauge: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    protocol: str = "clasp",
    method: str = "smekf",
    gauge_std: float = GAUGE_STD,
) -> Calibration:
    """Link lengths with their covariance; parameters as `calibrate`.

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
    segments = segment_orientations(recording, before, method=method)
    return _solve(recording, segments, intervals, before, gauge, gauge_std)


def _solve(
    recording: Recording,
    segments: Segments,
    intervals: tuple[tuple[float, float], ...],
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> Calibration:
    stride = max(1, round(recording.rate_hz / LOOK_RATE_HZ))
    looks = np.concatenate([np.arange(len(recording))[recording.span(i)][::stride] for i in intervals])
    quats = _chain_quats(segments.quat_WL, looks)
    warnings = list(segments.warnings)

    mean = np.array([prior.lengths[name] for name in LENGTHS])
    information = np.linalg.inv(prior.lengths_covariance())
    target = information @ mean
    for name, value in gauge.items():
        k = LENGTHS.index(name)
        information[k, k] += 1.0 / gauge_std**2
        target[k] += value / gauge_std**2
    # Prior and gauge as one Gaussian: the start of the solver, and all there is of the scale.
    center = np.linalg.solve(information, target)

    residual = _residuals(len(looks))
    lengths, weight, independent = center, 1.0, float(len(looks))
    for _ in range(ROUNDS):
        lengths = _gauss_newton(len(looks), quats, center, information, weight, lengths)
        r = np.asarray(residual(lengths, quats)).T  # (n, 3), of unit variance if ATTITUDE_STD were right
        independent = len(r) / _correlation_time(r)
        freedom = max(r.size - 5.0, 1.0)
        weight = float(independent / len(r) / (np.sum(r**2) / freedom))
    J = np.asarray(_jacobian(len(looks))(lengths, quats))
    data_information = weight * J.T @ J
    covariance = np.linalg.inv(data_information + information)
    covariance = (covariance + covariance.T) / 2.0

    gaps = np.asarray(_gaps(len(looks))(lengths, quats))
    gaps_before = np.asarray(_gaps(len(looks))(mean, quats))
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1)
    if not gauge:
        warnings.append(
            f"no gauge: the hands together fix the proportions, not the scale, which is the prior's "
            f"({prior.note or prior.name}): all lengths may be off together by {100 * scale_std:.1f} %; tape one, "
            f"as in --gauge shoulder_width=0.385"
        )
    for k, name in enumerate(LENGTHS):
        z = (lengths[k] - mean[k]) / prior.std(name)
        if abs(z) > 4.0:
            warnings.append(
                f"{name} = {lengths[k]:.3f} m lies {abs(z):.1f} standard deviations from the average; "
                f"check mounts and phases"
            )
    if not np.any(np.linalg.eigvalsh(data_information) > 10.0 * np.min(np.linalg.eigvalsh(information))):
        warnings.append(
            "the hands hardly moved: the lengths are the prior's; move the joined hands through the whole reach"
        )
    subject = replace(
        prior,
        name=recording.name,
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        order=LENGTHS,
        covariance=covariance,
        mounts=dict(segments.quat_LS),
        note="hands together; scale " + (f"taped: {', '.join(gauge)}" if gauge else "of the anthropometric prior"),
    )
    return Calibration(
        subject=subject,
        prior=prior,
        rms_gap=_rms(gaps),
        prior_rms_gap=_rms(gaps_before),
        independent=independent,
        gauge=gauge,
        scale_std=scale_std,
        warnings=tuple(warnings),
    )


def _rms(gaps: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(gaps**2, axis=0))))


CHAIN = ("torso", *ARMS)


def _chain_quats(quat_WL: Mapping[str, np.ndarray], looks: np.ndarray) -> np.ndarray:
    """Orientations (28, n): xyzw of the chain's segments stacked; a hand without a sensor turns with its forearm."""
    rows = []
    for segment in CHAIN:
        own = segment if segment in quat_WL else segment.replace("hand", "forearm")
        rows.append(quat_WL[own][looks].T)
    return np.concatenate(rows)


@cache
def _frame_gap() -> Any:
    lengths, quats = ca.SX.sym("lengths", len(LENGTHS)), ca.SX.sym("quats", 4 * len(CHAIN))
    parts = {segment: quats[4 * k : 4 * k + 4] for k, segment in enumerate(CHAIN)}
    return ca.Function("gap", [lengths, quats], [palm_gap(lengths, parts)])


@cache
def _frame_residual() -> Any:
    """The gap over its own standard deviation.

    An orientation error of variance σ² about each axis moves the end of a link ℓ d by a vector of covariance
    σ² ℓ² (1 − d dᵀ); averaged over directions that is ⅔ σ² ℓ² in each component.
    """
    lengths, quats = ca.SX.sym("lengths", len(LENGTHS)), ca.SX.sym("quats", 4 * len(CHAIN))
    spread = lengths[LENGTHS.index("shoulder_width")] ** 2 + sum(
        (lengths[LENGTHS.index(name)] ** 2 for name in ARMS), start=ca.SX(0)
    )
    std = ATTITUDE_STD * ca.sqrt(2.0 / 3.0 * spread)
    return ca.Function("residual", [lengths, quats], [_frame_gap()(lengths, quats) / std])


@cache
def _gaps(n: int) -> Any:
    return _frame_gap().map("gaps", "serial", n, [0], [])


@cache
def _residuals(n: int) -> Any:
    return _frame_residual().map("residuals", "serial", n, [0], [])


@cache
def _jacobian(n: int) -> Any:
    lengths, quats = ca.MX.sym("lengths", len(LENGTHS)), ca.MX.sym("quats", 4 * len(CHAIN), n)
    return ca.Function("jacobian", [lengths, quats], [ca.jacobian(ca.vec(_residuals(n)(lengths, quats)), lengths)])


@cache
def _solver(n: int) -> Any:
    """IPOPT on ½ weight ‖r(ℓ)‖² + ½ (ℓ − c)ᵀ Λ (ℓ − c), with the Gauss–Newton Hessian in place of the exact one."""
    k, m = len(LENGTHS), 4 * len(CHAIN)
    lengths, p = ca.MX.sym("lengths", k), ca.MX.sym("p", m * n + k + k * k + 1)
    quats, center, information, weight = ca.vertsplit(p, [0, m * n, m * n + k, m * n + k + k * k, p.numel()])
    information = ca.reshape(information, k, k)
    r = ca.vec(_residuals(n)(lengths, ca.reshape(quats, m, n)))
    off = lengths - center
    cost = 0.5 * weight * ca.sumsqr(r) + 0.5 * ca.bilin(information, off, off)
    J = ca.jacobian(r, lengths)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
    lagged = ca.Function(
        "nlp_hess_l",
        [lengths, p, lam_f, lam_g],
        [lam_f * ca.triu(weight * (J.T @ J) + information)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": 1e-9,
        "hess_lag": lagged,
    }
    problem: dict[str, Any] = {"x": lengths, "p": p, "f": cost}
    return ca.nlpsol("lengths", "ipopt", problem, options)


def _gauss_newton(
    n: int, quats: np.ndarray, center: np.ndarray, information: np.ndarray, weight: float, start: np.ndarray
) -> np.ndarray:
    solver = _solver(n)
    p = np.concatenate([quats.ravel(order="F"), center, information.ravel(order="F"), [weight]])
    solution = solver(x0=start, p=p, lbx=0.01, ubx=2.0)
    if not solver.stats()["success"]:
        raise RuntimeError(f"the length problem did not converge: {solver.stats()['return_status']}")
    return np.asarray(solution["x"]).ravel()


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
