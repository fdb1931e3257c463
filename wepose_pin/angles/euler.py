"""Three angles of a rotation: taken apart, put together, followed over time through gimbal lock, with their errors.

A sequence such as ``ZXY`` is read as intrinsic turns, each about an axis of the frame as turned so far, which is the
joint coordinate system of the ISB: ``R = R_Z(first) R_X(second) R_Y(third)``.

All of it rests on one form. A proper sequence (i, j, i) has the quaternion

    w = cos(b/2) cos((a + c)/2)    q_i = cos(b/2) sin((a + c)/2)
    q_j = sin(b/2) cos((a − c)/2)  q_k = ε sin(b/2) sin((a − c)/2),    ε = (e_i × e_j) · e_k

and one of three axes is a proper one turned by a right angle: ``R_k(c) = T R_i(c) Tᵀ``, ``T = R_j(−ε π/2)``, so that
``R T = R_i(a) R_j(b − ε π/2) R_i(c)``. `tip` below is the proper sequence's b: the lock is where it is 0 or π.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..recording import find_runs

# The standard deviation [rad] of an unknown angle: uniform over the circle.
UNKNOWN = np.pi / np.sqrt(3.0)
# Below this sine or cosine of half the tip the first angle is rounding error.
_LOCKED = 1e-13


class Sequence(NamedTuple):
    """The axes of a sequence as indices, and its constants in the formulas."""

    i: int
    j: int
    k: int
    eps: float  # (e_i × e_j) · e_k
    offset: float  # second angle less tip [rad]


def sequence(name: str) -> Sequence:
    """Read a sequence of three letters X, Y, Z, neighbours different."""
    i, j, last = ("XYZ".index(letter) for letter in name)
    k = 3 - i - j
    eps = 1.0 if (i + 1) % 3 == j else -1.0
    return Sequence(i, j, k, eps, 0.0 if last == i else eps * np.pi / 2.0)


def decompose(quat: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Take rotations (n, 4) apart: return their angles (n, 3) and how far they are from gimbal lock (n,) [rad].

    First and third are in (−π, π], the second in [−π, 0], as the ISB has the elevation of the arm, or, of three axes,
    in [−π/2, π/2]. In the lock, where only the sum or the difference of first and third is defined, the first is held
    from the sample before (at the beginning, taken from the next one that has it; else zero).
    """
    s = sequence(name)
    w, qi, qj, qk = quat[:, 3], quat[:, s.i], quat[:, s.j], quat[:, s.k]
    if s.offset:
        half = np.sqrt(0.5)
        w, qi, qj, qk = half * (w + s.eps * qj), half * (qi + qk), half * (qj - s.eps * w), half * (qk - qi)
    cosine, sine = np.hypot(w, qi), np.hypot(qj, qk)
    tip = 2.0 * np.arctan2(sine, cosine)
    half_sum, half_difference = np.arctan2(qi, w), np.arctan2(s.eps * qk, qj)
    first, third = half_sum + half_difference, half_sum - half_difference
    free = np.minimum(cosine, sine) < _LOCKED
    if free.any():
        known = np.flatnonzero(~free)
        source = np.searchsorted(known, np.arange(len(first)), side="right") - 1
        first = first[known[np.maximum(source, 0)]] if len(known) else np.zeros_like(first)
        third = np.where(free, np.where(sine < cosine, 2.0 * half_sum - first, first - 2.0 * half_difference), third)
    if not s.offset or s.eps > 0.0:  # the other of the two solutions is the one in the principal range
        first, tip, third = first + np.pi, -tip, third + np.pi
    gimbal = 2.0 * np.arctan2(np.minimum(cosine, sine), np.maximum(cosine, sine))
    return np.column_stack([wrap(first), tip + s.offset, wrap(third)]), gimbal


def wrap(angle: np.ndarray) -> np.ndarray:
    """Wrap into [−π, π]; angles that are in it keep their bits."""
    return angle - round_to_turns(angle)


def round_to_turns(angle: ArrayLike) -> np.ndarray:
    """Round to the nearest multiples of 2π."""
    return np.asarray(2.0 * np.pi * np.round(np.asarray(angle) / (2.0 * np.pi)))


def count_turns(angles: np.ndarray) -> np.ndarray:
    """Count the full turns [rad] by which angles (s, …) are off the first that is known, and this one off zero.

    Angles are continuous in time: a motion about the lock may return to a posture a full turn later.
    """
    known = np.isfinite(angles)
    first = np.take_along_axis(angles, np.argmax(known, axis=0)[None], axis=0) if len(angles) else angles
    return round_to_turns(np.where(known, angles - wrap(np.nan_to_num(first)), 0.0))


def follow(angles: tuple[np.ndarray, np.ndarray], name: str, near_lock: float) -> np.ndarray:
    """Follow the angles of `decompose` over time (n, 3), unwrapped: the solutions that continue each other.

    A motion that goes straight through the lock keeps its first and third angle, and the second goes on beyond its
    principal range. What the motion does within `near_lock` [rad] of the lock does not count. A sequence of two axes is
    continued where it left on the plane of the first angle on which it came (within 45°), to either side. Where it left
    on another there is nothing to continue, and what follows is read anew, in the principal range for the most part. A
    sequence of three axes is read anew after each lock, so that no way leads to another solution for the same posture:
    the angles are the ones nearest to zero at the posture nearest to zero; without a lock, in the principal range.
    Near the lock the first angle is within a right angle of that with which the motion came, and from the sample
    nearest to the lock on of that with which it left (else of zero); no full turns add up there, and the sum or
    difference with the third, which is determined, goes on.
    """
    principal, gimbal = angles
    values, s = principal.copy(), sequence(name)
    if not len(values):
        return values
    groups: list[list[tuple[int, int]]] = []  # of stretches that continue each other
    for a, b in find_runs(gimbal >= near_lock):
        part, continues = _continue(principal[a:b], s), False
        if groups and not s.offset:
            last = values[groups[-1][-1][1] - 1]
            change = abs(float(wrap(part[0, 0] - last[0])))
            continues = not 0.25 * np.pi <= change <= 0.75 * np.pi
            part = _solve_otherwise(part, s) if change > 0.75 * np.pi else part
            part = part - round_to_turns(part[0] - last) if continues else part
        values[a:b] = part
        groups = [*groups[:-1], [*groups[-1], (a, b)]] if continues else [*groups, [(a, b)]]
    for group in groups:
        index = np.concatenate([np.arange(a, b) for a, b in group])
        part, weights = values[index], gimbal[index]
        beyond = np.cos(part[:, 1] - principal[index, 1]) < 1.0 - 1e-9
        swap, clear = weights[beyond].sum() > weights[~beyond].sum(), np.argmax(weights)
        if s.offset and len(groups) > 1:  # of the absolute angles' sum the other solution has the rest to 3π
            total = np.abs(wrap(part)).sum(axis=1)
            clear = np.argmin(np.minimum(total, 3.0 * np.pi - total) // near_lock)  # the first one within that
            swap = total[clear] > 1.5 * np.pi
        part = _solve_otherwise(part, s) if swap else part
        values[index] = part - round_to_turns(part[clear])
    for a, b in find_runs(gimbal < near_lock):
        middle = a + int(np.argmin(gimbal[a:b]))
        middle = b if b == len(values) else a if a == 0 else middle
        values[middle:b] = _stay_near(principal[middle:b][::-1], values[b : b + 1], s)[::-1]
        values[a:middle] = _stay_near(principal[a:middle], values[max(a - 1, 0) : a], s)
    return values


def _solve_otherwise(values: np.ndarray, s: Sequence) -> np.ndarray:
    """The other solution (n, 3) for the same rotations."""
    return np.column_stack([values[:, 0] + np.pi, 2.0 * s.offset - values[:, 1], values[:, 2] + np.pi])


def _continue(principal: np.ndarray, s: Sequence) -> np.ndarray:
    """The angles (n, 3) from the first sample on, away from the lock."""
    other = _solve_otherwise(principal, s)
    same = np.square(wrap(np.diff(principal, axis=0))).sum(axis=1)
    swap = np.square(wrap(other[1:] - principal[:-1])).sum(axis=1) < same
    swapped = np.concatenate([[False], np.cumsum(swap) % 2 == 1])
    return np.unwrap(np.where(swapped[:, None], other, principal), axis=0)


def _stay_near(principal: np.ndarray, edge: np.ndarray, s: Sequence) -> np.ndarray:
    """The angles (n, 3) near the lock, next to those of the sample before, (1, 3); (0, 3): there is none."""
    known, edge = bool(len(edge)), edge if len(edge) else np.zeros((1, 3))
    other = _solve_otherwise(principal, s)
    nearer = np.cos(principal[:, :1] - edge[:, :1]) >= 0.0
    values = np.where(nearer, principal, other)
    values[:, :2] -= round_to_turns(values[:, :2] - (edge[:, :2] if known else (0.0, s.offset)))
    sign = np.where(np.cos(values[:, 1] - s.offset) > 0.0, 1.0, -1.0)  # the sum is determined, or the difference
    total = values[:, 2] + sign * values[:, 0]
    before = edge[:, 2] + sign[:1] * edge[:, 0] if known else total[:1] - round_to_turns(total[:1])
    values[:, 2] = np.unwrap(np.concatenate([before, total]))[1:] - sign * values[:, 0]
    return values


def gradients(values: np.ndarray, name: str) -> np.ndarray:
    """Compute derivatives of the angles (n, 3) by a small rotation on the left: rows (n, 3, 3).

    In axes turned by the first angle the turn is ``ȧ e_i + ḃ e_j + ċ (cos(tip) e_i − ε sin(tip) e_k)``; this solved
    for the rates. The first and the third row grow with 1/sin(tip), without bound at the lock.
    """
    s = sequence(name)
    tip = values[:, 1] - s.offset
    sine = np.sin(tip)
    sine = np.where(np.abs(sine) < 1e-12, 1e-12, sine)
    axes = Rotation.from_rotvec(np.outer(values[:, 0], np.eye(3)[s.i])).as_matrix()
    rows = np.empty((len(values), 3, 3))
    rows[:, 0] = axes[:, :, s.i] + (s.eps * np.cos(tip) / sine)[:, None] * axes[:, :, s.k]
    rows[:, 1] = axes[:, :, s.j]
    rows[:, 2] = (-s.eps / sine)[:, None] * axes[:, :, s.k]
    return rows
