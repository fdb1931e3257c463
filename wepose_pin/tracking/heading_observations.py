"""Rows of a heading filter: hinges, and points that coincide, as stated or found by themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..alignment import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..body import GirdleMotion
from ..body.girdle import PARAMETERS
from ..body.links import move_girdles
from ..compilation import kernel
from .heading_problem import CoincidentPoints, HeadingProblem, HingeAxis, Knot

OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier


def correct_headings(quat_WL: np.ndarray, headings: np.ndarray) -> np.ndarray:
    """Return Rz(δ) R_WL (k, n, 3, 3) for orientations (n, k, 4) xyzw and headings δ (k,) or more [rad]."""
    R = np.empty((quat_WL.shape[1], len(quat_WL), 3, 3))
    _turn_about_vertical(quat_WL, headings, R)
    return R


@kernel
def _turn_about_vertical(quat_WL, headings, R):  # type: ignore[no-untyped-def]
    for k in range(len(R)):
        s, c = np.sin(headings[k]), np.cos(headings[k])
        for n in range(len(quat_WL)):
            x, y, z, w = quat_WL[n, k, 0], quat_WL[n, k, 1], quat_WL[n, k, 2], quat_WL[n, k, 3]
            xx, xy, xz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
            yx, yy, yz = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
            R[k, n, 0, 0], R[k, n, 0, 1], R[k, n, 0, 2] = c * xx - s * yx, c * xy - s * yy, c * xz - s * yz
            R[k, n, 1, 0], R[k, n, 1, 1], R[k, n, 1, 2] = s * xx + c * yx, s * xy + c * yy, s * xz + c * yz
            R[k, n, 2, 0], R[k, n, 2, 1] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
            R[k, n, 2, 2] = 1.0 - 2.0 * (x * x + y * y)


def _cross_vertical(v: np.ndarray) -> np.ndarray:
    """Return ``[0, 0, 1] × v`` of vectors (..., 3): how they change as they turn about the vertical."""
    turned = np.zeros(v.shape)
    turned[..., 0], turned[..., 1] = -v[..., 1], v[..., 0]
    return turned


class HingeRows(NamedTuple):
    """What n samples of two orientations tell of a hinge.

    Parameters
    ----------
    r : (n,) [rad] out of the hinge's plane
    H : (n, 5) its slope by the headings of `moves` and `on`, the axis about the long axis of `on`, tissue there, and
        the axis across
    excess : (n,) [rad] beyond the hinge's range, signed
    slope : (n,) of that by the heading of `moves`; by the heading of `on` it is the negative
    """

    r: np.ndarray
    H: np.ndarray
    excess: np.ndarray
    slope: np.ndarray


def linearize_hinge(R_on: np.ndarray, R_moves: np.ndarray, hinge: HingeAxis) -> HingeRows:
    """Linearize a hinge of orientations (n, 3, 3)."""
    n = len(R_on)
    rows = HingeRows(np.empty(n), np.empty((n, 5)), np.empty(n), np.empty(n))
    _linearize_hinge(R_on, R_moves, hinge.axis, hinge.on_along, hinge.along, hinge.range, *rows)
    return rows


@kernel
def _linearize_hinge(R_on, R_moves, axis, on_along, along, limits, r, H, excess, slope):  # type: ignore[no-untyped-def]
    nx, ny, nz = axis[0], axis[1], axis[2]
    ax, ay, az = on_along[0], on_along[1], on_along[2]
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax  # axis × long axis
    tx, ty, tz = by * nz - bz * ny, bz * nx - bx * nz, bx * ny - by * nx  # that × axis
    middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
    for i in range(len(R_on)):
        A, B = R_on[i], R_moves[i]
        # The long axis of `moves` in W, in the frame of `on`, and its slope there by the heading of `moves`.
        ux = B[0, 0] * along[0] + B[0, 1] * along[1] + B[0, 2] * along[2]
        uy = B[1, 0] * along[0] + B[1, 1] * along[1] + B[1, 2] * along[2]
        uz = B[2, 0] * along[0] + B[2, 1] * along[1] + B[2, 2] * along[2]
        vx = A[0, 0] * ux + A[1, 0] * uy + A[2, 0] * uz
        vy = A[0, 1] * ux + A[1, 1] * uy + A[2, 1] * uz
        vz = A[0, 2] * ux + A[1, 2] * uy + A[2, 2] * uz
        dx, dy, dz = A[1, 0] * ux - A[0, 0] * uy, A[1, 1] * ux - A[0, 1] * uy, A[1, 2] * ux - A[0, 2] * uy
        r[i] = vx * nx + vy * ny + vz * nz
        by_heading = dx * nx + dy * ny + dz * nz
        sine, cosine = vx * bx + vy * by + vz * bz, vx * ax + vy * ay + vz * az
        H[i, 0], H[i, 1], H[i, 2], H[i, 3] = by_heading, -by_heading, -sine, -sine
        H[i, 4] = -(vx * tx + vy * ty + vz * tz)
        off = np.arctan2(sine, cosine) - middle
        off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
        excess[i] = np.sign(off) * max(abs(off) - half, 0.0)
        by_sine, by_cosine = dx * bx + dy * by + dz * bz, dx * ax + dy * ay + dz * az
        slope[i] = (by_sine * cosine - by_cosine * sine) / max(sine * sine + cosine * cosine, 0.1)


class Rows(NamedTuple):
    """Scalar measurements 0 = r + H δ + e."""

    sample: np.ndarray  # (m,) its index
    r: np.ndarray  # (m,)
    H: np.ndarray  # (m, k), δ of the segments in their order
    weight: np.ndarray  # (m,) 1 / variance of e


def move_all_girdles(problem: HeadingProblem, R_WL: np.ndarray) -> dict[str, GirdleMotion]:
    """Return the motions of the girdles for orientations (k, n, 3, 3) of the problem's segments."""
    return move_girdles(problem.model, dict(zip(problem.names, R_WL, strict=True)))


def build_gap_rows(
    R_WL: np.ndarray,
    problem: HeadingProblem,
    closure: CoincidentPoints,
    closed: np.ndarray,
    slip_std: float = PALM_SLIP_STD,
) -> Rows:
    """Build three whitened rows for each sample at which the points coincide, without outliers.

    Parameters
    ----------
    R_WL : (k, n, 3, 3) of the problem's segments
    closed : (n,) bool
    """
    model, gap, R = problem.model, closure.gap, R_WL[:, closed]
    motions = move_all_girdles(problem, R)
    v = gap.turn(R, motions)
    n, lengths = v.shape[1], len(model.lengths)
    squares = np.sum(v**2, axis=(0, 2))
    covariance = (slip_std**2 + SEGMENT_ATTITUDE_STD**2 * squares)[:, None, None] * np.eye(3)
    links = v.transpose(1, 2, 0)
    covariance -= SEGMENT_ATTITUDE_STD**2 * (links @ links.swapaxes(1, 2))
    shape_cov = problem.shape_cov
    J = np.zeros((n, 3, len(shape_cov)))
    J[:, :, :lengths] = (R[gap.segments] @ gap.by_length[:, None]).sum(axis=0)
    for name, sign, i in gap.girdles:
        girdle, motion, R_on = model.table.girdles[name], motions[name], R[gap.segments[i]]
        first = lengths + len(PARAMETERS) * list(model.table.girdles).index(name)
        J[:, :, first : first + len(PARAMETERS)] += sign * R_on @ motion.jacobian
        covariance += (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
    covariance += J @ shape_cov @ J.swapaxes(1, 2)
    H = np.zeros((n, 3, len(problem.names)))
    for i, link in zip(gap.segments, v, strict=True):
        H[:, :, i] += _cross_vertical(link)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = (whiten @ r[:, :, None])[..., 0], whiten @ H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    sample = np.repeat(np.flatnonzero(closed)[is_inlier], 3)
    return Rows(sample, r[is_inlier].ravel(), H[is_inlier].reshape(-1, len(problem.names)), np.ones(len(sample)))


@dataclass(frozen=True)
class ClaspTest:
    """When points of a closure are found to coincide; lengths are rms over the time.

    With the lengths of the population or stated mounts the joined hands of simulated people seem up to 25 cm apart, and
    hands apart seem joined: clasps are found where all mounts between the points are calibrated.

    Parameters
    ----------
    seconds : [s] for which they do
    gap : [m] most between them, once the headings have closed it as far as their uncertainty lets them
    change : [m] most around the mean of that gap
    height : [m] most of the gap's vertical part
    speed : [m/s] least of each of them in the frame of the reference segment
    speed_ratio : most of the gap's rate against that
    """

    seconds: float = 2.0
    gap: float = 0.06
    change: float = 0.03
    height: float = 0.12
    speed: float = 0.08
    speed_ratio: float = 0.3


OFFLINE_CLASP = ClaspTest()
# Over the shorter time of a clasp of two seconds tissue moves the gap by more of the hands' speed.
CAUSAL_CLASP = ClaspTest(change=0.04, gap=0.08, speed_ratio=0.8)


class ClaspDetector:
    """Finds the knots in which two points of a closure stay together while both move.

    The gap between them, once the headings have closed it as far as their uncertainty lets them, is short and constant,
    and its rate is small beside those of the points in the frame of the reference segment.
    """

    def __init__(self, problem: HeadingProblem) -> None:
        self._problem = problem
        # Of a clasp of that many seconds so many knots are whole, whenever it begins.
        self._test = CAUSAL_CLASP if problem.causal else OFFLINE_CLASP
        self._knots = max(2, int(self._test.seconds / problem.knot_s) - 1)
        self._recent: list[Knot] = []

    def _is_calibrated(self, closure: CoincidentPoints) -> bool:
        problem = self._problem
        return all(problem.names[i] in problem.subject.mounts for i in closure.gap.segments)

    def find(self, knot: Knot, headings: np.ndarray, covariance: np.ndarray) -> list[tuple[tuple[str, ...], Rows]]:
        """Return the points that coincide and the rows of the gap between them in the last knot.

        Parameters
        ----------
        headings, covariance : (k,) [rad] and (k, k) [rad²] of δ
        """
        problem, test = self._problem, self._test
        names, reference = problem.names, problem.model.table.reference
        if reference not in names or not any(self._is_calibrated(closure) for closure in problem.closures):
            return []
        self._recent = [*self._recent, knot][-self._knots :]
        if len(self._recent) < self._knots and len(self._recent) * problem.knot_s < 0.8 * test.seconds:
            return []
        k, rate = len(names), problem.samples_per_knot / problem.knot_s
        quats = np.concatenate([each.quat_WL for each in self._recent])
        time = np.concatenate([each.time for each in self._recent])
        if len(time) < 2:
            return []
        R = correct_headings(quats, headings)
        motions = move_all_girdles(problem, R)
        R_reference = R[names.index(reference)]
        clasps = []
        tested = set[tuple[str, ...]]()
        for closure in problem.closures:
            if closure.points in tested or closure.holds(knot.time).any() or not self._is_calibrated(closure):
                continue
            tested.add(closure.points)
            paths = [(way.turn(R, motions).sum(axis=0)[:, None] @ R_reference)[:, 0] for way in closure.ways]
            speed = min(_find_rms(np.gradient(path, time, axis=0)) for path in paths)
            v = closure.gap.turn(R, motions)
            gap = v.sum(axis=0)
            if speed < test.speed or np.abs(gap[:, 2]).max() > test.height:
                continue
            H = np.zeros((len(time), 3, k))
            for i, link in zip(closure.gap.segments, v, strict=True):
                H[:, :, i] += _cross_vertical(link)
            # The headings that close the gap best, within their covariance.
            P, flat, r = covariance, H.reshape(-1, k), gap.ravel()
            weight = 1.0 / (problem.noise.slip_std**2 * max(1.0, test.seconds * rate))
            turn = -np.linalg.solve(np.eye(k) + P @ (weight * flat.T @ flat), P @ (weight * flat.T @ r))
            closed = gap + H @ turn
            change, length = _find_rms(closed - closed.mean(axis=0)), _find_rms(closed)
            drift = _find_rms(np.gradient(closed, time, axis=0))
            if length > test.gap or change > test.change or drift > test.speed_ratio * speed:
                continue
            joined = np.ones(len(knot.time), dtype=bool)
            rows = build_gap_rows(R[:, -len(knot.time) :], problem, closure, joined, problem.noise.slip_std)
            clasps.append((closure.points, rows))
        return clasps


def _find_rms(v: np.ndarray) -> float:
    """Return the rms length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(v**2, axis=1))))
