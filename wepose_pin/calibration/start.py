"""Headings without a guess.

Poses tell them directly: the azimuth at which an arm was raised, the axis about which the torso bowed.

Where points coincide, the closure is linear in lengths times headings. A hanging segment's direction in its sensor's
start world is v(t) = Q(t)(−e_z), and L Rz(ψ) v is linear in (L cos ψ, L sin ψ, L). So R_torso(t) s + Σ ± L_i Rz(ψ_i)
v_i(t) = 0, with s the line between the shoulders at the start, has its least-squares solution in the smallest singular
vector. Beyond a step of a sensor's heading (or the torso's, that all others are seen from) it has another ψ there and
the same L.

A fixed point is nearly the same, but a torso that hardly turns solves it by itself (s = c, no arms); a distance is not
linear at all. There the headings are searched: Gauss-Newton from many starts at once, over headings and the size of
each sensor's part of the way, which the prior knows to some per cent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from .problem import Looks, carrier
from .protocols import Axis, Closure, Condition, Direction, coefficients

STARTS, NEARER = 256, 24  # how many there are, and how many of the best go on after some rounds
MINIMA, MOST_DISTINCT = 64, 12  # as `NEARER` where all minima are wanted, and how many of these at most
DISTINCT = np.deg2rad(15.0)  # [rad] of one heading, by which two minima differ
FIRST_ROUNDS, MORE_ROUNDS = 6, 16
SEARCHED = 48  # looks of each closure
GAP_STD = 0.03  # [m] of a closure in the search, that stands for all that is not searched
SIZE_STD = 0.08  # of a part of the way, relative
TOLD_STD = np.deg2rad(10.0)  # [rad] of a heading that a mount or a pose tells


def headings(looks: Looks, lengths: np.ndarray, distances: np.ndarray, stated: Mapping[str, float]) -> np.ndarray:
    """ψ [rad] of each sensor of the chain, from its world to W, whose y is the line of the shoulders at the start, and
    each step of a heading [rad]: zero where the closure is not linear.

    Parameters
    ----------
    lengths, distances : (8,) and as many as the layout's gauges [m], as known before
    stated : sensor → ψ [rad] where it is known before
    """
    sensors = looks.layout.sensors
    if is_linear(looks.conditions):
        return _linear(looks.take(looks.closed), stated)
    told, none = {**_posed(looks, stated), **stated}, np.zeros(len(looks.layout.steps))
    if looks.closed.any() and not set(sensors) <= set(told):
        return np.append(_searched(looks, lengths, distances, told), none)
    return np.append([told.get(name, 0.0) for name in sensors], none)


def is_linear(conditions: Sequence[Condition]) -> bool:
    """Whether headings come from joined hands."""
    closures = [c for c in conditions if isinstance(c, Closure)]
    return len(closures) == 1 and closures[0].kind == "coincide" and closures[0].points == ("left_hand", "right_hand")


def _turns(looks: Looks) -> dict[str, Rotation]:
    """Q of each sensor, n of them."""
    data = looks.data
    return {name: Rotation.from_quat(data[4 * i : 4 * i + 4].T) for i, name in enumerate(looks.layout.sensors)}


def _posed(looks: Looks, stated: Mapping[str, float]) -> dict[str, float]:
    """Sensor → ψ [rad] that poses and axes tell; the torso's comes first, since directions are in its frame."""
    Q = _turns(looks)
    told: dict[str, float] = {}
    for condition, span in looks.spans():
        if isinstance(condition, Axis):
            turn = Q[condition.segment][span].as_rotvec().sum(axis=0)  # forwards: about +y
            told[condition.segment] = np.pi / 2.0 - np.arctan2(turn[1], turn[0])
    torso = {**told, **stated}.get("torso")
    for condition, span in looks.spans():
        if isinstance(condition, Direction) and np.hypot(*condition.direction[:2]) > 0.3:
            wanted = np.tile(condition.direction, (span.stop - span.start, 1))
            if torso is not None:
                to_W = Rotation.from_rotvec([0.0, 0.0, torso])
                wanted = (to_W * Q["torso"][span] * to_W.inv()).apply(wanted)
            v = Q[condition.segment][span].apply([0.0, 0.0, -1.0])
            turn = np.sum((wanted[:, 0] + 1j * wanted[:, 1]) * (v[:, 0] - 1j * v[:, 1]))
            told[condition.segment] = float(np.angle(turn))
    return told


def _linear(looks: Looks, stated: Mapping[str, float]) -> np.ndarray:
    columns, parts = [], []
    for i, (name, R) in enumerate(_turns(looks).items()):
        if i == 0:
            columns.append(R.as_matrix())
            continue
        v = R.apply([0.0, 0.0, -1.0 if name.startswith("left") else 1.0])
        zero = np.zeros(len(v))
        part = _parts(looks, name)
        parts.append(part)
        across = np.stack((np.column_stack((v[:, 0], v[:, 1], zero)), np.column_stack((-v[:, 1], v[:, 0], zero))), 2)
        columns += [across * (part == k)[:, None, None] for k in range(part.max() + 1)]
        columns.append(np.column_stack((zero, zero, v[:, 2]))[:, :, None])
    A = np.concatenate(columns, axis=2).reshape(3 * looks.data.shape[1], -1)
    z = np.linalg.svd(A, full_matrices=False)[2][-1]
    sizes = [2 * (int(part.max()) + 1) for part in parts]
    ends = 3 + np.cumsum([size + 1 for size in sizes])
    if z[ends - 1].sum() < 0.0:  # lengths are positive; their mirror image solves it as well
        z = -z
    torso = -np.arctan2(-z[0], z[1])  # turns s to y
    turned = [z[end - 1 - size : end - 1].reshape(-1, 2) for end, size in zip(ends, sizes, strict=True)]
    seen = np.array(
        [(np.arctan2(of[:, 1], of[:, 0]) + torso)[part] for of, part in zip(turned, parts, strict=True)]
    )  # (m − 1, n) ψ and steps of each sensor at each look, less the torso's steps
    return _with_steps(looks, np.vstack([np.full(seen.shape[1], torso), seen]), stated)


def _parts(looks: Looks, name: str) -> np.ndarray:
    """(n,) which looks have one heading of a sensor seen from the torso, numbered from 0 on."""
    between = [row for of, row in zip(looks.layout.steps, looks.beyond, strict=True) if of in (name, "torso")]
    if not between:
        return np.zeros(looks.data.shape[1], dtype=int)
    return np.unique(np.array(between), axis=1, return_inverse=True)[1].ravel()


def _with_steps(looks: Looks, seen: np.ndarray, stated: Mapping[str, float]) -> np.ndarray:
    """ψ of each of the m sensors and each step [rad], of the headings `seen` (m, n) from the torso at each look.

    The steps are made out from the start pose outwards: ψ is that before any of them, or the `stated` one.
    """
    layout, beyond = looks.layout, looks.beyond
    of = np.array([layout.sensors.index(name) for name in layout.steps], dtype=int)
    steps, known = np.zeros(len(of)), np.zeros(len(of), dtype=bool)
    psi = np.array([stated.get(name, np.nan) for name in layout.sensors])
    psi[0] = seen[0, 0]
    for k in np.argsort(beyond.sum(axis=0), kind="stable") if len(of) else [0]:
        here = beyond[:, k]
        psi = np.where(np.isnan(psi), seen[:, k], psi)
        if known[here].all():
            continue
        passed = np.bincount(of[here], steps[here], len(psi))
        off = _within_half_turn(seen[:, k] - psi - passed + passed[0])
        new = here & ~known
        old = np.setdiff1d(np.arange(1, len(psi)), of[new])
        turn = float(np.angle(np.exp(1j * off[old]).sum())) if 0 in of[new] and len(old) else 0.0  # the torso's, back
        for step in np.flatnonzero(new):
            steps[step] = -turn if of[step] == 0 else _within_half_turn(off[of[step]] - turn)
        known |= here
    return np.append(psi, steps)


def distinct_headings(
    looks: Looks, lengths: np.ndarray, distances: np.ndarray, told: Mapping[str, float]
) -> np.ndarray:
    """Headings (k, m) [rad] of the m sensors at which the closures have a minimum each, the best first.

    Parameters
    ----------
    told : sensor → ψ [rad] where a mount or a pose tells it; the others may be anywhere
    """
    x, _ = _minima(looks, lengths, distances, told, MINIMA)
    found: list[np.ndarray] = []
    for psi in x[:, : len(looks.layout.sensors)]:
        if all(np.abs(_within_half_turn(psi - other)).max() > DISTINCT for other in found):
            found.append(psi)
    return np.array(found[:MOST_DISTINCT])


def _within_half_turn(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _searched(looks: Looks, lengths: np.ndarray, distances: np.ndarray, told: Mapping[str, float]) -> np.ndarray:
    x, _ = _minima(looks, lengths, distances, told, NEARER)
    return x[0, : len(looks.layout.sensors)]


def _minima(
    looks: Looks, lengths: np.ndarray, distances: np.ndarray, told: Mapping[str, float], nearer: int
) -> tuple[np.ndarray, np.ndarray]:
    """Headings and sizes (`nearer`, 2 m) where the best of many starts end, and their costs, the lowest first."""
    sensors = looks.layout.sensors
    m = len(sensors)
    parts = []  # of each closure: it, Q (m, n, 3, 3), and u (m, 3), each sensor's part of the way in its own frame
    for closure, span in looks.spans():
        if not isinstance(closure, Closure):
            continue
        few = np.unique(np.linspace(span.start, span.stop - 1, SEARCHED).astype(int))
        Q = np.stack([R.as_matrix() for R in _turns(looks.take(few)).values()])
        u = np.zeros((m, 3))
        for segment, coefficient in coefficients(closure).items():
            u[sensors.index(carrier(segment, sensors))] += coefficient @ lengths
        parts.append((closure, Q, u))

    known = np.array([name in told for name in sensors])
    center = np.array([told.get(name, 0.0) for name in sensors] + [0.0] * m)
    prior = np.array([TOLD_STD**-2 if k else 0.0 for k in known] + [SIZE_STD**-2] * m)
    drawn = 2.0 * np.pi * qmc.Sobol(m, scramble=False).random(STARTS)
    x = np.column_stack([np.where(known, center[:m], drawn), np.zeros((STARTS, m))])
    x, cost = _descended(x, center, prior, parts, looks, distances, FIRST_ROUNDS)
    x = x[np.argsort(cost)[:nearer]]
    x, cost = _descended(x, center, prior, parts, looks, distances, MORE_ROUNDS)
    best = np.argsort(cost, kind="stable")
    return x[best], cost[best]


def _descended(
    x: np.ndarray,
    center: np.ndarray,
    prior: np.ndarray,
    parts: list,
    looks: Looks,
    distances: np.ndarray,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Starts (b, k) after some rounds of damped Gauss-Newton, and their costs (b,); `center`, `prior` (k,)."""
    x, damping = x.copy(), np.full(len(x), 1e-2)
    r, J = _ways(x, parts, looks, distances)
    cost = np.sum(r**2, axis=1) + np.sum(prior * (x - center) ** 2, axis=1)
    for _ in range(rounds):
        H = J.swapaxes(1, 2) @ J + np.diag(prior)
        gradient = np.einsum("brk,br->bk", J, r) + prior * (x - center)
        diagonal = np.einsum("bkk->bk", H)
        H = H + (damping[:, None] * diagonal + 1e-6)[:, :, None] * np.eye(x.shape[1])
        nearer = x - np.linalg.solve(H, gradient[:, :, None])[:, :, 0]
        r_next, J_next = _ways(nearer, parts, looks, distances)
        lower = np.sum(r_next**2, axis=1) + np.sum(prior * (nearer - center) ** 2, axis=1)
        better = lower < cost
        x[better], r[better], J[better], cost[better] = nearer[better], r_next[better], J_next[better], lower[better]
        damping = np.where(better, damping / 4.0, damping * 8.0).clip(1e-8, 1e8)
    return x, cost


def _ways(x: np.ndarray, parts: list, looks: Looks, distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (starts, r) of the closures and their Jacobian (starts, r, 2 sensors), for `x` (starts, 2 sensors)."""
    m = x.shape[1] // 2
    psi, size = x[:, :m], np.exp(x[:, m:])
    rs, Js = [], []
    for closure, Q, u in parts:
        c, s = np.cos(psi), np.sin(psi)
        # Rz(ψ) Q Rz(−ψ) u, and its derivative Rz(ψ) (e_z × Q b − Q (e_z × b)) with b = Rz(−ψ) u.
        b = np.stack([c * u[:, 0] + s * u[:, 1], c * u[:, 1] - s * u[:, 0], u[:, 2] + 0.0 * c], axis=2)  # (B, m, 3)
        across = np.stack([-b[..., 1], b[..., 0], 0.0 * c], axis=2)
        Qb, Qa = np.einsum("mnij,bmj->bmni", Q, b), np.einsum("mnij,bmj->bmni", Q, across)
        slope = np.stack([-Qb[..., 1], Qb[..., 0], 0.0 * Qb[..., 2]], axis=3) - Qa
        c, s, k = c[:, :, None], s[:, :, None], size[:, :, None, None]

        def turned(v: np.ndarray, c: np.ndarray = c, s: np.ndarray = s, k: np.ndarray = k) -> np.ndarray:
            return k * np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=3)

        way, J = turned(Qb), np.concatenate([turned(slope), turned(Qb)], axis=1)  # (B, m, n, 3), (B, 2m, n, 3)
        gap = way.sum(axis=1)
        if closure.kind == "fixed_point":
            gap, J = gap - gap.mean(axis=1, keepdims=True), J - J.mean(axis=2, keepdims=True)
        if closure.kind == "distance":
            length = np.linalg.norm(gap, axis=2) + 1e-9
            J = np.einsum("bkni,bni->bkn", J, gap / length[:, :, None])[..., None]
            gap = (length - distances[looks.layout.gauges.index(closure.gauge)])[..., None]
        rs.append(gap.reshape(len(x), -1) / GAP_STD)
        Js.append(J.reshape(len(x), 2 * m, -1).swapaxes(1, 2) / GAP_STD)
    return np.concatenate(rs, axis=1), np.concatenate(Js, axis=1)
