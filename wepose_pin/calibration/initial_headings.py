"""Headings without an initial guess.

Poses show them directly: the azimuth at which an arm is raised, the axis about which the torso bows.

Where two points coincide and all parts of the way between them but one hang vertically in the start pose, the closure
is linear in lengths times headings. A hanging part's direction in its sensor's start world is v(t) = Q(t)(−e_z), and
L Rz(ψ) v is linear in (L cos ψ, L sin ψ, L). So R_0(t) s + Σ ± L_i Rz(ψ_i) v_i(t) = 0, with s the other part at the
start, such as the line between the shoulders, has its least-squares solution in the smallest singular vector.

A fixed point is nearly the same, but a torso that hardly turns solves it by itself (s = c, no arms); a plane shows one
axis only. There the headings are searched: Gauss-Newton from many starts at once, over headings and
the size of each sensor's part of the chain, with the prior's few per cent of uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.reaches import UNIVERSE
from ..observations.directions import Level, Pointing
from ..observations.paths import SegmentVector
from .conditions import Constraint, Loop
from .joints import Coupling
from .least_squares import Observations

STARTS, NEARER = 256, 24  # starts, and how many of the best continue after some rounds
MINIMA, MOST_DISTINCT = 64, 12  # as `NEARER` for a search of all minima, and how many of these at most
DISTINCT = np.deg2rad(15.0)  # [rad] of one heading, by which two minima differ
FIRST_ROUNDS, MORE_ROUNDS = 6, 16
SEARCH_SAMPLES, LEAST_SEARCH_SAMPLES = 48, 8  # of all closures together, of each
GAP_STD = 0.03  # [m] of a closure in the search; includes all that the search leaves out
SIZE_STD = 0.08  # of a part of the chain, relative
KNOWN_STD = np.deg2rad(10.0)  # [rad] of a heading from a mount or a pose


def estimate_headings(observations: Observations, x: np.ndarray, stated: Mapping[str, float]) -> np.ndarray:
    """ψ [rad] of each sensor of the chain.

    ψ turns the sensor's world to W, in which the body's start pose is known.

    Parameters
    ----------
    x : (m,) with the lengths, points and heights as known before
    stated : sensor → ψ [rad] of its stated mount
    """
    sensors = observations.layout.sensors
    linear = find_linear(observations.conditions)
    if linear is not None:
        held = np.array([c is linear for c in observations.conditions])[observations.condition_index]
        return _solve_linear(observations.take(held), linear, x, stated)
    known = {**_solve_poses(observations, stated), **stated}
    if observations.closed.any() and not set(sensors) <= set(known):
        minima = _find_minima(observations, x, known, NEARER)
        return minima[0, : len(sensors)]
    return np.array([known.get(name, 0.0) for name in sensors])


def find_linear(conditions: Sequence[Constraint]) -> Loop | None:
    """The one closure of points that coincide, with all parts but the first vertical, that shows all headings."""
    loops = [c for c in conditions if isinstance(c, Loop)]
    joined = [loop for loop in loops if loop.kind == "coincide"]
    if len(joined) != 1 or not {p.segment for c in loops for p in c.parts} <= {p.segment for p in joined[0].parts}:
        return None
    first, *others = joined[0].parts
    linear = first.segment != UNIVERSE and not _is_vertical(first) and all(map(_is_vertical, others))
    return joined[0] if linear else None


def _is_vertical(part: SegmentVector) -> bool:
    return part.segment != UNIVERSE and not np.any(np.array(part.by_length)[:2]) and not np.any(part.constant[:2])


def _rotations(observations: Observations) -> dict[str, Rotation]:
    """Q of each sensor, n of them."""
    data = observations.data
    return {name: Rotation.from_quat(data[4 * i : 4 * i + 4].T) for i, name in enumerate(observations.layout.sensors)}


def _solve_poses(observations: Observations, stated: Mapping[str, float]) -> dict[str, float]:
    """Sensor → ψ [rad] from poses and axes; the reference's comes first, since directions are in its frame."""
    Q = _rotations(observations)
    headings: dict[str, float] = {}
    for condition, span in observations.spans():
        if isinstance(condition, Level):
            turn = Q[condition.segment][span].as_rotvec().sum(axis=0)  # forwards: about the axis
            axis = np.arctan2(condition.axis[1], condition.axis[0])
            headings[condition.segment] = axis - np.arctan2(turn[1], turn[0])
    for condition, span in observations.spans():
        if isinstance(condition, Pointing) and np.hypot(*condition.direction[:2]) > 0.3:
            reference = {**headings, **stated}.get(condition.reference)
            target = np.tile(condition.direction, (span.stop - span.start, 1))
            if reference is not None:
                to_W = Rotation.from_rotvec([0.0, 0.0, reference])
                target = (to_W * Q[condition.reference][span] * to_W.inv()).apply(target)
            v = Q[condition.segment][span].apply(condition.along)
            turn = np.sum((target[:, 0] + 1j * target[:, 1]) * (v[:, 0] - 1j * v[:, 1]))
            headings[condition.segment] = float(np.angle(turn))
    return headings


def _solve_linear(observations: Observations, loop: Loop, x: np.ndarray, stated: Mapping[str, float]) -> np.ndarray:
    """ψ [rad] of each sensor, from the smallest singular vector of the closure; a stated one as it is."""
    layout = observations.layout
    lengths, (first, *others) = x[layout.length], loop.parts
    rotations = _rotations(observations)
    columns = [rotations[first.segment].as_matrix()]
    for other in others:
        v = rotations[other.segment].apply([0.0, 0.0, float(np.sign(other.vector(lengths)[2]))])
        zero = np.zeros(len(v))
        columns.append(
            np.stack((np.column_stack((v[:, 0], v[:, 1], zero)), np.column_stack((-v[:, 1], v[:, 0], zero))), 2)
        )
        columns.append(np.column_stack((zero, zero, v[:, 2]))[:, :, None])
    A = np.concatenate(columns, axis=2).reshape(3 * observations.data.shape[1], -1)
    z = np.linalg.svd(A, full_matrices=False)[2][-1]
    solved = z[3:].reshape(-1, 3)  # L cos ψ, L sin ψ, L of each other sensor
    if solved[:, 2].sum() < 0.0:  # lengths are positive; their mirror image solves it as well
        z, solved = -z, -solved
    known = first.vector(lengths)
    reference = float(np.arctan2(known[1], known[0]) - np.arctan2(z[1], z[0]))  # turns s to its direction
    headings = {
        other.segment: float(np.arctan2(xy[1], xy[0]) + reference) for other, xy in zip(others, solved, strict=True)
    }
    headings = {**headings, **stated, first.segment: reference}
    return np.array([headings.get(name, 0.0) for name in layout.sensors])


def find_distinct_headings(observations: Observations, x: np.ndarray, known: Mapping[str, float]) -> np.ndarray:
    """Headings (k, m) [rad] of the m sensors at which the closures have a minimum each, the best first.

    Parameters
    ----------
    x : (n,) with the lengths, points and heights
    known : sensor → ψ [rad] from a mount or a pose; the others may be anywhere
    """
    minima = _find_minima(observations, x, known, MINIMA)
    distinct: list[np.ndarray] = []
    for psi in minima[:, : len(observations.layout.sensors)]:
        if all(np.abs(_within_half_turn(psi - other)).max() > DISTINCT for other in distinct):
            distinct.append(psi)
    return np.array(distinct[:MOST_DISTINCT])


def _within_half_turn(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _find_minima(
    observations: Observations, known_x: np.ndarray, known: Mapping[str, float], nearer: int
) -> np.ndarray:
    """Headings and log sizes (`nearer`, 2 m) at the minima that the best of many starts reach, the lowest first."""
    sensors, layout = observations.layout.sensors, observations.layout
    m = len(sensors)
    # Of each way of a closure: it, Q (m, n, 3, 3), u (m, 3) each sensor's part, what does not move (3,), or less the
    # recorded places (n, 3).
    parts = []
    loops = sum(isinstance(condition, Loop) for condition in observations.conditions)
    count = max(SEARCH_SAMPLES // loops, LEAST_SEARCH_SAMPLES)
    for loop, span in observations.spans():
        if not isinstance(loop, Loop):
            continue
        few = np.unique(np.linspace(span.start, span.stop - 1, count).astype(int))
        Q = np.stack([R.as_matrix() for R in _rotations(observations.take(few)).values()])
        places = observations.data[layout.place][:, few].T if loop.kind == "recorded" else np.zeros(3)
        for path in loop.paths:
            u, still = np.zeros((m, 3)), -places
            for part in path.vectors:
                if part.segment == UNIVERSE:
                    still = still + part.vector(known_x[layout.length])
                else:
                    u[sensors.index(part.segment)] += part.vector(known_x[layout.length])
            parts.append((loop, Q, u, still))

    def closure_residuals(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _closure_residuals(x, parts)

    is_known = np.array([name in known for name in sensors])
    center = np.array([known.get(name, 0.0) for name in sensors] + [0.0] * m)
    prior = np.array([KNOWN_STD**-2 if k else 0.0 for k in is_known] + [SIZE_STD**-2] * m)
    # A Latin hypercube: each angle of each sensor once, in any order.
    order = np.random.default_rng(0).permuted(np.tile(np.arange(STARTS), (m, 1)), axis=1).T
    starts = 2.0 * np.pi / STARTS * order
    x = np.column_stack([np.where(is_known, center[:m], starts), np.zeros((STARTS, m))])
    x, cost = _descend(x, center, prior, closure_residuals, FIRST_ROUNDS)
    x = x[np.argsort(cost)[:nearer]]
    x, cost = _descend(x, center, prior, closure_residuals, MORE_ROUNDS)
    return x[np.argsort(cost, kind="stable")]


def _descend(
    x: np.ndarray,
    center: np.ndarray,
    prior: np.ndarray,
    residuals: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Starts (b, k) after some rounds of damped Gauss-Newton, and their costs (b,); `center`, `prior` (k,)."""
    x, damping = x.copy(), np.full(len(x), 1e-2)
    r, J = residuals(x)
    cost = np.sum(r**2, axis=1) + np.sum(prior * (x - center) ** 2, axis=1)
    for _ in range(rounds):
        H = J.swapaxes(1, 2) @ J + np.diag(prior)
        gradient = np.einsum("brk,br->bk", J, r) + prior * (x - center)
        diagonal = np.einsum("bkk->bk", H)
        H = H + (damping[:, None] * diagonal + 1e-6)[:, :, None] * np.eye(x.shape[1])
        nearer = x - np.linalg.solve(H, gradient[:, :, None])[:, :, 0]
        r_next, J_next = residuals(nearer)
        lower = np.sum(r_next**2, axis=1) + np.sum(prior * (nearer - center) ** 2, axis=1)
        better = lower < cost
        x[better], r[better], J[better], cost[better] = nearer[better], r_next[better], J_next[better], lower[better]
        damping = np.where(better, damping / 4.0, damping * 8.0).clip(1e-8, 1e8)
    return x, cost


def _closure_residuals(x: np.ndarray, parts: list) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (starts, r) of the closures and their Jacobian (starts, r, 2 sensors), for `x` (starts, 2 sensors)."""
    m = x.shape[1] // 2
    psi, size = x[:, :m], np.exp(x[:, m:])
    rs, Js = [], []
    for loop, Q, u, still in parts:
        c, s = np.cos(psi), np.sin(psi)
        # Rz(ψ) Q Rz(−ψ) u, and its derivative Rz(ψ) (e_z × Q b − Q (e_z × b)) with b = Rz(−ψ) u.
        b = np.stack([c * u[:, 0] + s * u[:, 1], c * u[:, 1] - s * u[:, 0], u[:, 2] + 0.0 * c], axis=2)  # (B, m, 3)
        across = np.stack([-b[..., 1], b[..., 0], 0.0 * c], axis=2)
        Qb, Qa = np.einsum("mnij,bmj->bmni", Q, b), np.einsum("mnij,bmj->bmni", Q, across)
        slope = np.stack([-Qb[..., 1], Qb[..., 0], 0.0 * Qb[..., 2]], axis=3) - Qa
        c, s, k = c[:, :, None], s[:, :, None], size[:, :, None, None]

        def turned(v: np.ndarray, c: np.ndarray = c, s: np.ndarray = s, k: np.ndarray = k) -> np.ndarray:
            return k * np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=3)

        parts_W, J = turned(Qb), np.concatenate([turned(slope), turned(Qb)], axis=1)  # (B, m, n, 3), (B, 2m, n, 3)
        gap = parts_W.sum(axis=1) + still
        if loop.kind == "fixed_point" and loop.closure.at is not None:
            gap = gap - np.array(loop.closure.at)
        elif loop.kind in ("fixed_point", "plane"):
            gap, J = gap - gap.mean(axis=1, keepdims=True), J - J.mean(axis=2, keepdims=True)
        if loop.kind == "plane":
            gap, J = gap[..., 2:], J[..., 2:]
        rs.append(gap.reshape(len(x), -1) / GAP_STD)
        Js.append(J.reshape(len(x), 2 * m, -1).swapaxes(1, 2) / GAP_STD)
    return np.concatenate(rs, axis=1), np.concatenate(Js, axis=1)


def estimate_joint_headings(
    observations: Observations, couplings: Sequence[Coupling], stated: Mapping[str, float]
) -> np.ndarray:
    """ψ [rad] of each sensor where there is no closure: by poses, couplings of neighbours, and how hinges bend.

    Where neither a mount nor a pose shows a heading, all are turned together until the segments that hinges move lie on
    the side to which they bend.

    Parameters
    ----------
    stated : sensor → ψ [rad] of its stated mount
    """
    layout, Q = observations.layout, _rotations(observations)
    shown = {**_solve_poses(observations, stated), **stated}
    headings = shown or {layout.sensors[0]: 0.0}
    while True:
        known = {c.near: headings[c.far] + c.heading for c in couplings if c.far in headings}
        known |= {c.far: headings[c.near] - c.heading for c in couplings if c.near in headings}
        if set(known) <= set(headings):
            break
        headings = known | headings
    bent = 0.0j
    for hinge in layout.hinges:
        if not shown and {hinge.on, hinge.moves} <= set(headings):
            R_on, R_moves = (
                Rotation.from_rotvec([0.0, 0.0, headings[name]])
                * Q[name]
                * Rotation.from_rotvec([0.0, 0.0, -headings[name]])
                for name in (hinge.on, hinge.moves)
            )
            along = (R_on.inv() * R_moves).apply(hinge.along)
            bent += np.sum(along[:, 0] + 1j * along[:, 1]) * complex(hinge.side[0], -hinge.side[1])
    turn = -float(np.angle(bent)) if bent else 0.0
    return np.array([headings.get(name, 0.0) + turn for name in layout.sensors])
