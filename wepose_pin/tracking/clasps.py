"""Points that coincide, in a phase or found by themselves, as rows of the heading filter."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ..body.mounts import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..observations.closures import GapRows
from .heading_problem import HeadingProblem, Knot

OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
Rows = tuple[np.ndarray, np.ndarray]  # r (m,) and H (m, k) of measurements 0 = r + H δ + e, of variance 1


def whiten_gap(problem: HeadingProblem, rows: GapRows, slip_std: float = PALM_SLIP_STD) -> Rows:
    """Return the rows of a gap, three of each sample, without outliers; `slip_std` [m] is the gap of joined points."""
    covariance = slip_std**2 * np.eye(3) + SEGMENT_ATTITUDE_STD**2 * rows.by_attitude + rows.off_law
    covariance += rows.by_shape @ problem.shape_cov @ rows.by_shape.swapaxes(1, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if len(covariance) else covariance
    r, H = (whiten @ rows.gap[:, :, None])[..., 0], whiten @ rows.H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    return r[is_inlier].ravel(), H[is_inlier].reshape(-1, H.shape[2])


@dataclass(frozen=True)
class ClaspTest:
    """When points of a closure are found to coincide; lengths are rms over the time."""

    seconds: float = 2.0  # [s] for which they do
    gap: float = 0.06  # [m] most between them, once headings have closed it as far as their uncertainty lets them
    change: float = 0.03  # [m] most around the mean of that gap
    height: float = 0.12  # [m] most of the gap's vertical part
    speed: float = 0.08  # [m/s] least of each of them in the frame of the reference segment
    speed_ratio: float = 0.3  # most of the gap's rate against that


OFFLINE_CLASP = ClaspTest()
# Over the shorter time of a clasp of two seconds tissue moves the gap by more of the hands' speed.
CAUSAL_CLASP = ClaspTest(change=0.04, gap=0.08, speed_ratio=0.8)


class ClaspDetector:
    """Finds the knots in which two points of a closure stay together while both move.

    The gap between them, once the headings have closed it as far as their uncertainty lets them, is short and constant,
    and its rate is small beside those of the points in the frame of the reference segment.

    With the lengths of the population or stated mounts the joined hands of simulated people seem up to 25 cm apart, and
    hands apart seem joined: clasps are found where all mounts between the points are calibrated.
    """

    def __init__(self, problem: HeadingProblem) -> None:
        self._problem = problem
        # Of a clasp of that many seconds so many knots are whole, whenever it begins.
        self._test = CAUSAL_CLASP if problem.causal else OFFLINE_CLASP
        self._knots = max(2, int(self._test.seconds / problem.knot_s) - 1)
        self._recent: list[Knot] = []
        has_reference = problem.model.table.reference in problem.names
        self._closures = {
            phase: points
            for phase, points in problem.closures.items()
            if has_reference and set(points.segments) <= set(problem.subject.mounts)
        }

    def find(
        self, knot: Knot, headings: np.ndarray, covariance: np.ndarray, stated: Collection[str]
    ) -> dict[str, Rows]:
        """Return the closures whose points coincide outside of their phase, and the rows of the last knot.

        Parameters
        ----------
        headings, covariance : (k,) [rad] and (k, k) [rad²] of δ
        stated : phases of this knot
        """
        problem, test = self._problem, self._test
        if not self._closures:
            return {}
        self._recent = [*self._recent, knot][-self._knots :]
        time = np.concatenate([each.time for each in self._recent])
        is_short = len(self._recent) < self._knots and len(self._recent) * problem.knot_s < 0.8 * test.seconds
        if is_short or len(time) < 2:
            return {}
        quats = np.concatenate([each.quat_WL for each in self._recent])
        clasps = {}
        for phase, points in self._closures.items():
            if phase in stated:
                continue
            ends = points.locate_ends(quats, headings)
            speed = min(_find_rms(np.gradient(end, time, axis=0)) for end in ends)
            rows = points.linearize(quats, headings)
            if speed >= test.speed and self._stays_closed(rows, time, speed, covariance):
                last = GapRows(*(values[-len(knot.time) :] for values in rows))
                clasps[phase] = whiten_gap(problem, last, problem.noise.slip_std)
        return clasps

    def _stays_closed(self, rows: GapRows, time: np.ndarray, speed: float, covariance: np.ndarray) -> bool:
        """Whether headings within their covariance (k, k) [rad²] close a gap, of points of this speed [m/s]."""
        problem, test = self._problem, self._test
        if np.abs(rows.gap[:, 2]).max() > test.height:
            return False
        flat, r = rows.H.reshape(-1, len(covariance)), rows.gap.ravel()
        weight = 1.0 / (problem.noise.slip_std**2 * max(1.0, test.seconds * problem.rate_hz))
        information = covariance @ (weight * flat.T @ flat)
        turn = -np.linalg.solve(np.eye(len(covariance)) + information, covariance @ (weight * flat.T @ r))
        closed = rows.gap + rows.H @ turn
        change, length = _find_rms(closed - closed.mean(axis=0)), _find_rms(closed)
        drift = _find_rms(np.gradient(closed, time, axis=0))
        return length <= test.gap and change <= test.change and drift <= test.speed_ratio * speed


def _find_rms(v: np.ndarray) -> float:
    """Return the rms length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(v**2, axis=1))))
