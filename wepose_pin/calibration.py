"""Link lengths from a hands-together phase: the closed chain of both arms, solved with CasADi.

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
- Without a magnetometer every sensor's heading is a little off and drifts, and its tilt is off by the accelerometer's
  bias. That is no noise that averages out over the phase, so a turn in W and a drift of the heading are unknowns of
  each sensor beside the lengths, with priors of their own; they are not handed on, but the lengths' covariance holds
  what they cost.

The weight of the data is measured, not assumed: the residual's own mean square sets its variance and its
autocorrelation the number of independent samples, in a few rounds of Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import block_diag

from .alignment import Segments, segment_orientations
from .errors import BadOption, BadPhase, BadSession, BadSubject, NoSolution, one_of
from .recording import Recording
from .subject import LENGTHS, Subject, average_subject, mount_rows

PROTOCOLS = ("clasp",)
ARMS = tuple(f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm", "hand"))

# One standard deviation [m] of a length taped over the skin, where the user gives none.
GAUGE_STD = 0.003
# The gap is looked at this often [Hz]; more only repeats what the motion's own slowness correlates anyway.
LOOK_RATE_HZ = 8.0
# Errors of a segment's orientation [rad] before the data say better: what hangs on it is the weights' start.
ATTITUDE_STD = 0.035
# Prior of each sensor's heading in the start pose, and of its drift since: the mounts are taken as known.
HEADING_STD = np.deg2rad(2.0)  # [rad]
TILT_STD = np.deg2rad(0.5)  # [rad] of the start pose's tilt: the accelerometer's bias, about x and y of W
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
# Residual variance, in units of ATTITUDE_STD², that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
# Errors of orientations are slow: two looks closer than this [s] are never independent, however white the residual
# looks in one phase. Found on simulated people, whose joint errors it brings within what the covariance says.
LEAST_CORRELATION_S = 8.0
LEAST_LOOKS = 10
ROUNDS = 4


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
    scale_std : relative standard deviation of the overall scale, the proportions taken as found
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
    return sum(links(lengths, quat_WL).values(), start=ca.SX.zeros(3))


def links(lengths: Any, quat_WL: Mapping[str, Any]) -> dict[str, Any]:
    """Segment → its part (3,) [m] of the way from the right palm to the left one, in W."""
    found = {"torso": rotate(quat_WL["torso"], ca.vertcat(0.0, lengths[LENGTHS.index("shoulder_width")], 0.0))}
    for name in ARMS:
        down = -lengths[LENGTHS.index(name)] if name.startswith("left") else lengths[LENGTHS.index(name)]
        found[name] = rotate(quat_WL[name], ca.vertcat(0.0, 0.0, down))
    return found


def rotate(quat: Any, v: Any) -> Any:
    """``R v`` of a unit quaternion (4,) xyzw and a vector (3,), in CasADi."""
    u = quat[:3]
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


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
    if len(looks) < LEAST_LOOKS:
        raise BadPhase(
            f"{recording.where()}: phases.clasp holds {len(looks)} looks at {LOOK_RATE_HZ:g} a second; at least "
            f"{LEAST_LOOKS} are needed, better a minute"
        )
    problem = _problem(len(looks), tuple(name for name in CHAIN if name in segments.quat_WL))
    since = recording.time[looks] - segments.start[1]
    data = np.vstack([_chain_quats(segments.quat_WL, looks), since])
    center, information = _before(prior, gauge, gauge_std, problem.sensors)
    k = len(LENGTHS)
    mean = np.array([prior.lengths[name] for name in LENGTHS])

    x, weight, independent = center, 1.0, float(len(looks))
    for _ in range(ROUNDS):
        x = problem.solve(data, center, information, weight, x)
        r = np.asarray(problem.residuals(x, data)).T  # (n, 3), of unit variance if ATTITUDE_STD were right
        independent = len(r) / max(_correlation_time(r), LEAST_CORRELATION_S * LOOK_RATE_HZ)
        freedom = max(r.size - 5.0, 1.0)
        weight = float(independent / len(r) / max(np.sum(r**2) / freedom, LEAST_VARIANCE))
    J = np.asarray(problem.jacobian(x, data))
    data_information = weight * J.T @ J
    covariance = np.linalg.inv(data_information + information)[:k, :k]
    covariance = (covariance + covariance.T) / 2.0
    lengths = x[:k]

    gaps = np.asarray(problem.gaps(x, data))
    gaps_before = np.asarray(problem.gaps(np.concatenate([mean, np.zeros(4 * problem.sensors)]), data))
    scale_std = float(np.sqrt(lengths @ np.linalg.solve(covariance, lengths)) ** -1)
    without_data = np.linalg.inv(information)[:k, :k]
    scaling = [name for name in gauge if name != "trunk"]  # the trunk is not in the chain and cannot scale it
    warnings = _remarks(lengths, covariance, without_data, prior, None if scaling else scale_std)
    # Mounts of known uncertainty are the prior's still; of others the start pose has measured the tilt.
    sure = [] if recording.strapping == "new" else [n for n in prior.mounts if prior.mount_covariance(n) is not None]
    rows = [row for segment in sure for row in mount_rows(segment)]
    at = [prior.order.index(row) for row in rows]
    subject = replace(
        prior,
        name=recording.name,
        lengths=dict(zip(LENGTHS, lengths.tolist(), strict=True)),
        order=(*LENGTHS, *rows),
        covariance=block_diag(covariance, prior.covariance[np.ix_(at, at)]),
        mounts=dict(segments.quat_LS) | {segment: prior.mounts[segment] for segment in sure},
        note="hands together; scale " + (f"taped: {', '.join(scaling)}" if scaling else "of the anthropometric prior"),
    )
    return Calibration(
        subject=subject,
        prior=prior,
        rms_gap=_rms(gaps),
        prior_rms_gap=_rms(gaps_before),
        independent=independent,
        gauge=gauge,
        scale_std=scale_std,
        warnings=(*segments.warnings, *warnings),
    )


def _before(
    prior: Subject, gauge: Mapping[str, float], gauge_std: float, sensors: int
) -> tuple[np.ndarray, np.ndarray]:
    """Prior and gauge as one Gaussian over [lengths, turns, drifts]: centre and information."""
    k = len(LENGTHS)
    turn_std = np.tile([TILT_STD, TILT_STD, HEADING_STD], sensors)
    drift_std = np.full(sensors, DRIFT_STD)
    information = np.diag(np.concatenate([np.zeros(k), turn_std**-2, drift_std**-2]))
    if not set(LENGTHS) <= set(prior.order) or np.linalg.eigvalsh(prior.lengths_covariance())[0] <= 0.0:
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    information[:k, :k] = np.linalg.inv(prior.lengths_covariance())
    target = information[:, :k] @ [prior.lengths[name] for name in LENGTHS]
    for name, value in gauge.items():
        i = LENGTHS.index(name)
        information[i, i] += 1.0 / gauge_std**2
        target[i] += value / gauge_std**2
    return np.linalg.solve(information, target), information


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


class _Problem(NamedTuple):
    """CasADi functions of n looks at the gap; x is [lengths, turns, drifts], a column of data is [quats, since]."""

    sensors: int  # each has a turn in W (3) [rad] and a drift of its heading [rad/s]
    gaps: Any  # (x, data) → (3, n) [m]
    residuals: Any  # (x, data) → (3, n), whitened
    jacobian: Any  # (x, data) → (3 n, len(x)) of the residuals
    solver: Any

    def solve(
        self, data: np.ndarray, center: np.ndarray, information: np.ndarray, weight: float, start: np.ndarray
    ) -> np.ndarray:
        """Minimiser x of ½ weight ‖r(x)‖² + ½ (x − c)ᵀ Λ (x − c) with positive lengths.

        Raises
        ------
        NoSolution
            It did not converge.
        """
        k = len(LENGTHS)
        low = np.full(len(start), -np.inf)
        low[:k] = 0.01
        p = np.concatenate([data.ravel(order="F"), center, information.ravel(order="F"), [weight]])
        x = np.asarray(self.solver(x0=start, p=p, lbx=low)["x"]).ravel()
        # IPOPT's own verdict hangs on the scale of the cost; what counts is the step still to go, in standard
        # deviations, of those lengths that are free.
        J = np.asarray(self.jacobian(x, data))
        r = np.asarray(self.residuals(x, data)).ravel(order="F")
        free = x > low + 1e-6
        gradient = (weight * J.T @ r + information @ (x - center))[free]
        hessian = (weight * J.T @ J + information)[np.ix_(free, free)]
        to_go = float(np.sqrt(gradient @ np.linalg.solve(hessian, gradient)))
        if not to_go < 0.05:
            raise NoSolution(
                f"the lengths did not converge ({to_go:.2g} standard deviations to go); check that the palms touch in "
                f"the phase and that the mounts are right"
            )
        return x


@lru_cache(maxsize=1)
def _problem(n: int, sensors: tuple[str, ...]) -> _Problem:
    k, s = len(LENGTHS), len(sensors)
    m = k + 4 * s
    x, data = ca.SX.sym("x", m), ca.SX.sym("data", 4 * len(CHAIN) + 1)
    quats = {segment: data[4 * i : 4 * i + 4] for i, segment in enumerate(CHAIN)}
    # A link without a sensor of its own, a hand, is rigid with the forearm and shares its errors.
    carrier = {name: name if name in sensors else name.replace("hand", "forearm") for name in CHAIN}
    moved = {sensor: ca.SX.zeros(3) for sensor in sensors}
    for name, vector in links(x[:k], quats).items():
        moved[carrier[name]] += vector
    gap, covariance = ca.SX.zeros(3), ca.SX.zeros(3, 3)
    for i, v in enumerate(moved.values()):
        turn = x[k + 3 * i : k + 3 * i + 3]
        turn[2] += x[k + 3 * s + i] * data[-1]
        gap += v + ca.cross(turn, v)
        # An error of variance σ² about each axis moves the end of v by a vector of covariance σ² (‖v‖² 1 − v vᵀ).
        covariance += ATTITUDE_STD**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
    whitened = ca.solve(ca.chol(covariance).T, gap)
    gaps = ca.Function("gap", [x, data], [gap]).map("gaps", "serial", n, [0], [])
    residuals = ca.Function("residual", [x, data], [whitened]).map("residuals", "serial", n, [0], [])

    # IPOPT, with the Gauss-Newton Hessian in place of the exact one: the exact one costs fifty times as much.
    X = ca.MX.sym("X", m)
    P = ca.MX.sym("P", data.numel() * n + m + m * m + 1)
    at = np.cumsum([0, data.numel() * n, m, m * m, 1]).tolist()
    D, center, information, weight = ca.vertsplit(P, at)
    D, information = ca.reshape(D, data.numel(), n), ca.reshape(information, m, m)
    r = ca.vec(residuals(X, D))
    J = ca.jacobian(r, X)
    cost = 0.5 * weight * ca.sumsqr(r) + 0.5 * ca.bilin(information, X - center, X - center)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
    gauss_newton = ca.Function(
        "nlp_hess_l",
        [X, P, lam_f, lam_g],
        [lam_f * ca.triu(weight * (J.T @ J) + information)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": 1e-9,
        "ipopt.nlp_scaling_method": "none",
        "hess_lag": gauss_newton,
    }
    solver = ca.nlpsol("lengths", "ipopt", {"x": X, "p": P, "f": cost}, options)
    data_n = ca.MX.sym("data", data.numel(), n)
    jacobian = ca.Function("jacobian", [X, data_n], [ca.jacobian(ca.vec(residuals(X, data_n)), X)])
    return _Problem(s, gaps, residuals, jacobian, solver)


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
