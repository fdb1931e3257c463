"""Three angles of a rotation: taken apart, put together, followed over time through gimbal lock, with their errors.

A sequence such as ``ZXY`` is read as intrinsic turns, each about an axis of the frame as turned so far, which is the
joint coordinate system of the ISB: ``R = R_Z(first) R_X(second) R_Y(third)``.

All of it rests on one form. A proper sequence (i, j, i) has the quaternion

    w = cos(b/2) cos((a + c)/2)    q_i = cos(b/2) sin((a + c)/2)
    q_j = sin(b/2) cos((a − c)/2)  q_k = ε sin(b/2) sin((a − c)/2),    ε = (e_i × e_j) · e_k

and one of three axes is a proper one turned by a right angle: ``R_k(c) = T R_i(c) Tᵀ``, ``T = R_j(−ε π/2)``, so that
``R T = R_i(a) R_j(b − ε π/2) R_i(c)``. `tip` below is the proper sequence's b: the lock is where it is 0 or π.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..recording.gaps import find_runs

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


class Angles3(NamedTuple):
    """A rotation's angles, each in its principal range."""

    values: np.ndarray  # (n, 3) [rad]
    gimbal: np.ndarray  # (n,) [rad], from the lock


def sequence(name: str) -> Sequence:
    """Of three letters X, Y, Z, neighbours different."""
    i, j, last = ("XYZ".index(letter) for letter in name)
    k = 3 - i - j
    eps = 1.0 if (i + 1) % 3 == j else -1.0
    return Sequence(i, j, k, eps, 0.0 if last == i else eps * np.pi / 2.0)


def decompose(quat: np.ndarray, name: str) -> Angles3:
    """The angles of rotations (n, 4): first and third in (−π, π], second in [−π, 0] or, of three axes, [−π/2, π/2].

    A proper sequence's second angle is negative, as the ISB has the elevation of the arm. In the lock, where only the
    sum or the difference of first and third is defined, the first is held from the sample before (at the beginning,
    taken from the next one that has it; else zero).
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
        first = _fill_free(first, free)
        third = np.where(free, np.where(sine < cosine, 2.0 * half_sum - first, first - 2.0 * half_difference), third)
    if not s.offset or s.eps > 0.0:  # the other of the two solutions is the one in the principal range
        first, tip, third = first + np.pi, -tip, third + np.pi
    gimbal = 2.0 * np.arctan2(np.minimum(cosine, sine), np.maximum(cosine, sine))
    return Angles3(np.column_stack([wrap(first), tip + s.offset, wrap(third)]), gimbal)


def _fill_free(first: np.ndarray, free: np.ndarray) -> np.ndarray:
    """`first` (n,) with its `free` samples from the last sample that is not free, or from the next, or zero."""
    known = np.flatnonzero(~free)
    if not len(known):
        return np.zeros_like(first)
    source = np.searchsorted(known, np.arange(len(first)), side="right") - 1
    return first[known[np.maximum(source, 0)]]


def wrap(angle: np.ndarray) -> np.ndarray:
    """Wrap into [−π, π]; angles that are in it keep their bits."""
    return angle - round_to_turns(angle)


def round_to_turns(angle: ArrayLike) -> np.ndarray:
    """The nearest multiples of 2π."""
    return np.asarray(2.0 * np.pi * np.round(np.asarray(angle) / (2.0 * np.pi)))


def follow(angles: Angles3, name: str, near_lock: float) -> np.ndarray:
    """The angles (n, 3) over time, unwrapped: of the two solutions of each sample the one that continues the last.

    A motion that goes straight through the lock keeps its first and third angle, and the second goes on beyond its
    principal range. What the motion does within `near_lock` [rad] of the lock does not count, only how it came and how
    it left: on the plane of the first angle on which it came (within 45°), to either side, it is continued. Where it
    left on another there is nothing to continue, and what follows is read anew; the jump lies at the sample nearest
    to the lock. A stretch between two such jumps has the solution that is more, and further from the lock, in the
    principal range, and the multiples of 2π with which its sample furthest from the lock is there.
    """
    principal, gimbal = angles
    n = len(gimbal)
    if n == 0:
        return principal
    turned = principal + np.pi
    turned[:, 1] = 2.0 * sequence(name).offset - principal[:, 1]
    same = np.square(wrap(np.diff(principal, axis=0))).sum(axis=1)
    swap = np.square(wrap(turned[1:] - principal[:-1])).sum(axis=1) < same

    before, after, nearest = _find_passages(gimbal < near_lock, gimbal)
    change = np.abs(wrap(principal[after, 0] - principal[before, 0]))
    passed, anew = change > 0.75 * np.pi, (change >= 0.25 * np.pi) & (change <= 0.75 * np.pi)
    swap[nearest - 1] ^= _sum_steps(swap, before, after) % 2 != passed
    swapped = np.concatenate([[False], np.cumsum(swap) % 2 == 1])
    stretch = np.zeros(n, dtype=int)
    stretch[nearest[anew]] = 1
    stretch = np.cumsum(stretch)
    swapped ^= (np.bincount(stretch, np.where(swapped, -gimbal, gimbal)) < 0.0)[stretch]

    values = np.where(swapped[:, None], turned, principal)
    turns = np.zeros((n, 3), dtype=int)
    turns[1:] = -_count_turns(np.diff(values, axis=0))
    astray = _sum_steps(turns[1:], before, after) + _count_turns(values[after] - values[before])
    turns[nearest] -= astray
    values += 2.0 * np.pi * np.cumsum(turns, axis=0)
    ends = np.append(np.searchsorted(stretch, np.arange(stretch[-1] + 1)), n)
    furthest = [first + int(np.argmax(gimbal[first:end])) for first, end in pairwise(ends)]
    return values - 2.0 * np.pi * _count_turns(values[furthest])[stretch]


def _find_passages(near: np.ndarray, gimbal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Last sample before, first after, and nearest to the lock, of each stay near it that has both."""
    whole = [(a, b) for a, b in find_runs(near) if a > 0 and b < len(gimbal)]
    passages = [(a - 1, b, a + int(np.argmin(gimbal[a:b]))) for a, b in whole]
    before, after, nearest = np.array(passages, dtype=int).reshape(-1, 3).T
    return before, after, nearest


def drop_turns(values: np.ndarray, gimbal: np.ndarray, name: str, near_lock: float) -> np.ndarray:
    """`values` (n, 3) of `follow` without the full turns that the first and third angle add up in a stay near the lock.

    There they are within half a turn of those with which the motion came, and from the sample nearest to the lock on of
    those with which it left. The sum or difference of the two that is determined goes on. A motion that is never
    further from the lock has the first within half a turn of zero, and begins with that sum or difference so.
    """
    s, n = sequence(name), len(values)
    first, near = values[:, 0], gimbal < near_lock
    expected = first.copy()
    for a, b in find_runs(near):
        nearest = a + int(np.argmin(gimbal[a:b]))
        edges = [first[k] for k in (a - 1, b) if 0 <= k < n] or [0.0]
        expected[a:nearest], expected[nearest:b] = edges[0], edges[-1]
    turns = 2.0 * np.pi * _count_turns(first - expected)
    sign = np.where(
        np.cos(values[:, 1] - s.offset) > 0.0, 1.0, -1.0
    )  # the sum of both is determined, or the difference
    values = values.copy()
    values[:, 0] -= turns
    values[:, 2] += sign * turns
    if n and near.all():
        values[:, 2] -= 2.0 * np.pi * _count_turns(values[0, 2] + sign[0] * values[0, 0])
    return values


def _sum_steps(steps: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Sums of `steps` (n − 1, …), the k-th from sample k to k + 1, between samples `before` and `after`."""
    summed = np.concatenate([np.zeros((1, *steps.shape[1:]), dtype=int), np.cumsum(steps, axis=0)])
    return summed[after] - summed[before]


def _count_turns(angle: np.ndarray) -> np.ndarray:
    return np.round(angle / (2.0 * np.pi)).astype(int)


def gradients(values: np.ndarray, name: str) -> np.ndarray:
    """Derivatives of the angles (n, 3) by a small rotation on the left: rows (n, 3, 3).

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
