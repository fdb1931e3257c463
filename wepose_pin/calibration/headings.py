"""Headings of sensors without an initial guess, and by the accelerations of the joints between them.

In a closure, a sensor's part u of the way between the points is Rz(ψ) Q(t) Rz(−ψ) u, linear in

    h(ψ) = (1, cos ψ, sin ψ, cos 2ψ, sin 2ψ).

So is all else that shows headings: the direction in which a segment points, the axis about which it bows, the heading
of a neighbour. With the lengths as known before, the residuals of samples are therefore r = c + Σ_i h(ψ_i) F_i. Their
minima are found by Gauss-Newton from many starts at once. A sample with large residuals loses its weight: palms may be
apart for half of the phase, and a pose may be wrong.

Two neighbours both measure the acceleration of the joint between them, with levers that are constant and estimated with
the heading (`linearize_joint`). It separates what the closure confuses: soft tissue that rotates the
torso's sensor sideways as the torso leans forwards has the same effect on the closure as a heading, but none on a
joint's acceleration, since orientation and specific force are the sensor's.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.tree import UNIVERSE
from ..filters.butterworth import band_pass
from ..observations import BAND_HZ, LEAST_RATE_HZ, compute_sides, find_neighbours, linearize_joint
from ..recording import Recording
from ..rotations import wrap_angle
from .equations import Gaussian, Layout
from .least_squares import LEAST_CORRELATION_S, LeastSquares
from .protocols import Axis, Closure, Direction, FreeMotion

STARTS, NEARER = 256, 64  # starts of the search, and how many of the best continue after some rounds
FIRST_ROUNDS, MORE_ROUNDS = 6, 16
SEARCH_SAMPLES, LEAST_SEARCH_SAMPLES = 48, 8  # of all closures together, of each
GAP_STD = 0.03  # [m] of a closure; includes errors of the lengths and all that the search leaves out
KNOWN_STD = np.deg2rad(10.0)  # [rad] of a heading from a mount
OUTLIER = 5.0  # standard deviations of a sample, at which it has a quarter of its weight
# Couplings of neighbours: H (c, m), whose product with x (m,) is the heading ψ of the sensor nearer the root less that
# of the far one, mean over the samples; this heading as it was observed (c,), and its standard deviation (c,) [rad].
Couplings = tuple[np.ndarray, np.ndarray, np.ndarray]
_FIFTHS = 2.0 * np.pi / 5.0 * np.arange(5)
SAMPLES_HZ = 10.0  # of couplings
LEAST_S = 20.0  # of motion that is used
LEAST_LEVER = 1e-6  # [1/s⁴], keeps unobserved levers finite
LEAST_MISMATCH = 0.005  # [m/s²] below which no two sensors agree
JOINT_STARTS, JOINT_ROUNDS = 24, 20
DISTANT = np.deg2rad(30.0)  # [rad] from the best heading, from where on others count as other explanations
# What lasts in the error: tissue that changes the lever as it goes, clocks a millisecond apart. On simulated people it
# is 1.1 deg at elbows and 1.6 at shoulders, where the residual alone gives half of it.
SYSTEMATIC_STD = np.deg2rad(1.5)
MAX_STD = np.deg2rad(20.0)  # above it the problem is not linear


# Search ---------------------------------------------------------------------------------------------------------------


def search_headings(fit: LeastSquares, stated: Mapping[str, float], couplings: Couplings | None) -> np.ndarray:
    """Return the headings ψ (sensors,) [rad] of the lowest minimum.

    Lengths are those of the fit's x; `stated` has the ψ of sensors with a stated mount, others may be anywhere.
    """
    sensors = fit.layout.sensors
    is_known = np.array([name in stated for name in sensors])
    center = np.array([stated.get(name, 0.0) for name in sensors])
    constant, F = _collect_terms(fit, couplings)
    # A Latin hypercube: each angle of each sensor once, in any order.
    order = np.random.default_rng(0).permuted(np.tile(np.arange(STARTS), (len(sensors), 1)), axis=1).T
    psi, information = np.where(is_known, center, 2.0 * np.pi / STARTS * order), is_known / KNOWN_STD**2
    psi = _descend(psi, constant, F, center, information, FIRST_ROUNDS)[:NEARER]
    headings = wrap_angle(_descend(psi, constant, F, center, information, MORE_ROUNDS)[0])
    if not stated and all(isinstance(condition, FreeMotion) for condition in fit.layout.conditions):
        return headings + _turn_by_hinges(fit, headings)
    return headings


def _collect_terms(fit: LeastSquares, couplings: Couplings | None) -> tuple[np.ndarray, np.ndarray]:
    """Return c (n, 3) and F (sensors, 5, n, 3) in units of their standard deviations.

    They are those of closures at some of their samples, of poses and bows on average, and of couplings.
    """
    layout, sensors, lengths = fit.layout, fit.layout.sensors, fit.x[fit.layout.length]
    constants, harmonics = [np.zeros((0, 3))], [np.zeros((len(sensors), 5, 0, 3))]

    def add(std: float, constant: np.ndarray, parts: Mapping[str, np.ndarray]) -> None:
        """Add n samples with the constant (n, 3) and the harmonics (5, n, 3) of sensors."""
        F = np.zeros((len(sensors), 5, *constant.shape))
        for name, part in parts.items():
            F[sensors.index(name)] = part
        constants.append(constant / std)
        harmonics.append(F / std)

    count = max(SEARCH_SAMPLES // max(len(fit.closures), 1), LEAST_SEARCH_SAMPLES)
    for condition, span in fit.spans:
        some = np.arange(span.start, span.stop)
        if isinstance(condition, Closure):
            some = np.unique(np.linspace(span.start, span.stop - 1, count).astype(int))
        Q = {name: Rotation.from_quat(fit.data[4 * i : 4 * i + 4, some].T) for i, name in enumerate(sensors)}
        if isinstance(condition, Closure):
            axes = np.array([condition.kind != "plane", condition.kind != "plane", True])
            for path in layout.paths[condition]:
                constant, parts = np.zeros((len(some), 3)), {}
                for segment, (B, c) in path.vectors.items():
                    vector = B @ lengths + c
                    if segment == UNIVERSE:
                        constant = constant + axes * vector
                    else:
                        parts[segment] = axes * _expand(Q[segment], vector)
                if condition.kind == "recorded":
                    constant = constant - fit.data[layout.place][:, some].T
                elif condition.at is not None:
                    constant = constant - condition.at
                elif condition.kind in ("fixed_point", "plane"):  # of any mean
                    constant = constant - constant.mean(axis=0)
                    parts = {name: F - F.mean(axis=1, keepdims=True) for name, F in parts.items()}
                add(GAP_STD, constant, parts)
        elif isinstance(condition, Direction):
            parts = {condition.segment: _expand(Q[condition.segment], condition.along)}
            if condition.reference != condition.segment:
                parts[condition.reference] = -_expand(Q[condition.reference], condition.direction)
            add(condition.std, np.zeros((1, 3)), {k: F.mean(axis=1, keepdims=True) for k, F in parts.items()})
        elif isinstance(condition, Axis):
            turn = Q[condition.segment].as_rotvec().sum(axis=0) * [1.0, 1.0, 0.0]  # forwards: about the axis
            turn = turn / max(float(np.linalg.norm(turn)), 1e-9)
            add(condition.std, -np.array([condition.axis]), {condition.segment: _turn_about_z(turn)})
    for H, heading, std in zip(*couplings, strict=True) if couplings else ():
        near, far = (sensors[int(at(H[layout.heading]))] for at in (np.argmax, np.argmin))
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        add(std, np.zeros((1, 3)), {near: _turn_about_z(np.array([1.0, 0.0, 0.0])), far: -_turn_about_z(ahead)})
    return np.concatenate(constants), np.concatenate(harmonics, axis=2)


def _harmonics(psi: np.ndarray) -> np.ndarray:
    """Return h(ψ) (…, 5) of angles."""
    return np.stack([np.ones_like(psi), np.cos(psi), np.sin(psi), np.cos(2.0 * psi), np.sin(2.0 * psi)], axis=-1)


def _expand(Q: Rotation, u: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return F (5, n, 3) of Rz(ψ) Q Rz(−ψ) u = h(ψ) F, for n rotations."""
    turns = [Rotation.from_rotvec([0.0, 0.0, angle]) for angle in _FIFTHS]
    values = np.stack([(turn * Q * turn.inv()).apply(u) for turn in turns])
    return np.tensordot(np.linalg.inv(_harmonics(_FIFTHS)), values, axes=1)


def _turn_about_z(v: np.ndarray) -> np.ndarray:
    """Return F (5, 1, 3) of Rz(ψ) v = h(ψ) F."""
    F = np.zeros((5, 1, 3))
    F[:3, 0] = [0.0, 0.0, v[2]], [v[0], v[1], 0.0], [-v[1], v[0], 0.0]
    return F


def _descend(
    psi: np.ndarray, constant: np.ndarray, F: np.ndarray, center: np.ndarray, information: np.ndarray, rounds: int
) -> np.ndarray:
    """Return headings (b, sensors) after some rounds of damped Gauss-Newton from ψ, the lowest cost first.

    `center` and `information` (sensors,) are what is known of them before.
    """
    m, n = len(center), len(constant)
    F = F.reshape(m, 5, 3 * n)

    def linearize(psi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cost (b,), gradient (b, m) and Hessian (b, m, m)."""
        h = _harmonics(psi)
        slope = np.stack([0.0 * psi, -h[..., 2], h[..., 1], -2.0 * h[..., 4], 2.0 * h[..., 3]], axis=-1)
        r = constant.ravel() + h.reshape(len(psi), -1) @ F.reshape(5 * m, -1)
        J = (slope.swapaxes(0, 1) @ F).swapaxes(0, 1)
        size = 1.0 + np.sum(r.reshape(len(psi), n, 3) ** 2, axis=2) / OUTLIER**2
        weighted = J * np.repeat(size**-2, 3, axis=1)[:, None]
        off = psi - center
        cost = OUTLIER**2 * np.sum(1.0 - 1.0 / size, axis=1) + off**2 @ information
        gradient = (weighted @ r[:, :, None])[:, :, 0] + information * off
        return cost, gradient, weighted @ J.swapaxes(1, 2) + np.diag(information)

    cost, gradient, H = linearize(psi)
    damping = np.full(len(psi), 1e-2)
    for _ in range(rounds):
        damped = H + (damping[:, None] * np.einsum("bkk->bk", H) + 1e-6)[:, :, None] * np.eye(m)
        nearer = psi - np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        lower = linearize(nearer)
        better = lower[0] < cost
        psi = np.where(better[:, None], nearer, psi)
        gradient, H = np.where(better[:, None], lower[1], gradient), np.where(better[:, None, None], lower[2], H)
        cost = np.where(better, lower[0], cost)
        damping = np.where(better, damping / 4.0, damping * 8.0).clip(1e-8, 1e8)
    return psi[np.argsort(cost, kind="stable")]


def _turn_by_hinges(fit: LeastSquares, headings: np.ndarray) -> float:
    """Return the rotation [rad] of all headings by which segments lie on the side to which their hinges bend."""
    sensors, bent = fit.layout.sensors, 0.0j
    turns = [Rotation.from_rotvec([0.0, 0.0, heading]) for heading in headings]
    for hinge in fit.layout.hinges:
        pair = sensors.index(hinge.on), sensors.index(hinge.moves)
        Q = (Rotation.from_quat(fit.data[4 * i : 4 * i + 4].T) for i in pair)
        on, moves = (turns[i] * each * turns[i].inv() for i, each in zip(pair, Q, strict=True))
        along = (on.inv() * moves).apply(hinge.along)
        bent += np.sum(along[:, 0] + 1j * along[:, 1]) * complex(hinge.side[0], -hinge.side[1])
    return -float(np.angle(bent)) if bent else 0.0


# Couplings ------------------------------------------------------------------------------------------------------------


def estimate_couplings(
    recording: Recording, R_VS: Mapping[str, Rotation], start: tuple[float, float], layout: Layout, samples: np.ndarray
) -> Couplings | None:
    """Return those of each joint between two IMUs, from the motion in these samples (n,); None: it is too short."""
    neighbours = find_neighbours(layout.model, layout.sensors)
    pairs = [pair for pair in neighbours if set(pair) <= set(recording.imus)]
    if recording.rate_hz < LEAST_RATE_HZ or len(samples) < LEAST_S * recording.rate_hz:
        return None
    samples = samples[:: max(1, round(recording.rate_hz / SAMPLES_HZ))]
    names = dict.fromkeys(name for pair in pairs for name in pair)
    sides = {name: compute_joint_sides(recording, R_VS[name], name)[samples] for name in names}
    elapsed_s = float(np.mean(recording.time[samples]) - start[1])
    H, heading, std = np.zeros((len(pairs), layout.size)), np.empty(len(pairs)), np.empty(len(pairs))
    for row, pair in enumerate(pairs):
        heading[row], std[row] = estimate_heading(*(sides[name] for name in pair))
        for name, sign in zip(pair, (1.0, -1.0), strict=True):
            i = layout.sensors.index(name)
            H[row, layout.heading[i]], H[row, layout.drift[i]] = sign, sign * elapsed_s
    known = std < MAX_STD
    return H[known], heading[known], np.hypot(std, SYSTEMATIC_STD)[known]


def add_couplings(prior: Gaussian, couplings: Couplings) -> Gaussian:
    """Return the prior of x with the headings and drifts of the couplings, whole turns as at its mean."""
    (mean, information), (H, heading, std) = prior, couplings
    weighted = H.T / std**2
    information = information + weighted @ H
    return mean + np.linalg.solve(information, weighted @ wrap_angle(heading - H @ mean)), information


def compute_joint_sides(recording: Recording, R_VS: Rotation, name: str) -> np.ndarray:
    """(n, 3, 4) in V, band-passed: specific force, and what a lever of 1 m along each axis adds to the joint's."""
    accel_S, at = recording.imus[name].accel_S, np.arange(len(recording))
    finite = np.isfinite(accel_S).all(axis=1)
    if not finite.all():
        accel_S = np.column_stack([np.interp(at, at[finite], axis[finite]) for axis in accel_S.T])
    sides = compute_sides(R_VS.as_matrix()[:, None], accel_S[:, None], recording.rate_hz)[:, 0, :, :4]
    return band_pass(np.concatenate([sides[:1], sides, sides[-1:]]), BAND_HZ, recording.rate_hz)


def estimate_heading(near: np.ndarray, far: np.ndarray) -> tuple[float, float]:
    """The rotation [rad] about z from the near sensor's world to the far one's, by their sides, and its std."""
    starts = np.linspace(0.0, 2.0 * np.pi, JOINT_STARTS, endpoint=False)
    costs = np.array([np.sum(_fit_levers(near, far, angle)[0] ** 2) for angle in starts])
    heading = float(starts[int(np.argmin(costs))])
    for _ in range(JOINT_ROUNDS):
        r, J = _fit_levers(near, far, heading)
        step = -float(J @ r) / max(float(J @ J), 1e-12)
        heading += step
        if abs(step) < 1e-6:
            break
    r, J = _fit_levers(near, far, heading)
    variance = max(float(np.mean(r**2)), LEAST_MISMATCH**2) * LEAST_CORRELATION_S * SAMPLES_HZ
    std = float(np.sqrt(variance / max(float(J @ J), 1e-12)))
    # Where little moves, a heading half a turn away explains it nearly as well: the whole circle's variance counts.
    off = wrap_angle(starts - heading)
    distant = np.abs(off) > DISTANT
    mass = np.exp(-0.5 * np.maximum(costs[distant] - float(r @ r), 0.0) / variance) * (2.0 * np.pi / JOINT_STARTS)
    total = np.sqrt(2.0 * np.pi) * std + mass.sum()
    return heading, float(np.sqrt(((total - mass.sum()) * std**2 + mass @ off[distant] ** 2) / total))


def _fit_levers(near: np.ndarray, far: np.ndarray, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Misfit (3 n,) of the joint with the best levers, and its derivative by the heading."""
    e, jacobian, _ = linearize_joint(near, far, heading, np.zeros(3), np.zeros(3))
    H = jacobian[:, :, 1:].reshape(-1, 6)
    normal = H.T @ H + LEAST_LEVER * len(H) * np.eye(6)
    levers = -np.linalg.solve(normal, H.T @ e.ravel())
    e, jacobian, _ = linearize_joint(near, far, heading, levers[:3], levers[3:])
    slope = jacobian[:, :, 0].ravel()
    return e.ravel(), slope - H @ np.linalg.solve(normal, H.T @ slope)
