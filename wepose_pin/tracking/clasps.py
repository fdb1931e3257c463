"""Points that coincide, in a phase or found by themselves, as rows of the heading filter."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ..body.mounts import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..observations.closures import GapRows
from .heading_problem import HeadingProblem, Knot

OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
Rows = tuple[np.ndarray, np.ndarray]  # r (m,) and H (m, k) of measurements 0 = r + H δ + e, of variance 1

# When points of a closure are found to coincide; lengths are rms over the time.
SECONDS = 2.0  # [s] for which they do
HEIGHT = 0.12  # [m] most of the gap's vertical part
SPEED = 0.08  # [m/s] least of each of them in the frame of the reference segment
# The gap once headings have closed it as far as their uncertainty lets them, and the most change around its mean [m];
# most of its rate against the speed. Over the shorter time of a causal test tissue moves the gap by more of that.
OFFLINE_TEST, CAUSAL_TEST = (0.06, 0.03, 0.3), (0.08, 0.04, 0.8)


def whiten_gap(problem: HeadingProblem, rows: GapRows, slip_std: float = PALM_SLIP_STD) -> Rows:
    """Return the rows of a gap, three of each sample, without outliers; `slip_std` [m] is the gap of joined points."""
    covariance = slip_std**2 * np.eye(3) + SEGMENT_ATTITUDE_STD**2 * rows.by_attitude + rows.off_law
    covariance += rows.by_shape @ problem.shape_cov @ rows.by_shape.swapaxes(1, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if len(covariance) else covariance
    r, H = (whiten @ rows.gap[:, :, None])[..., 0], whiten @ rows.H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    return r[is_inlier].ravel(), H[is_inlier].reshape(-1, H.shape[2])


class ClaspDetector:
    """Finds the knots in which two points of a closure stay together while both move.

    The gap between them, once the headings have closed it as far as their uncertainty lets them, is short and constant,
    and its rate is small beside those of the points in the frame of the reference segment.

    With the lengths of the population or stated mounts the joined hands of simulated people seem up to 25 cm apart, and
    hands apart seem joined: clasps are found where all mounts between the points are calibrated.
    """

    def __init__(self, problem: HeadingProblem) -> None:
        self._problem = problem
        self._knots = max(2, int(SECONDS / problem.knot_s) - 1)  # that a clasp of that time has whole
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
        problem = self._problem
        if not self._closures:
            return {}
        self._recent = [*self._recent, knot][-self._knots :]
        time = np.concatenate([each.time for each in self._recent])
        is_short = len(self._recent) < self._knots and len(self._recent) * problem.knot_s < 0.8 * SECONDS
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
            if speed >= SPEED and self._stays_closed(rows, time, speed, covariance):
                last = GapRows(*(values[-len(knot.time) :] for values in rows))
                clasps[phase] = whiten_gap(problem, last, problem.noise.slip_std)
        return clasps

    def _stays_closed(self, rows: GapRows, time: np.ndarray, speed: float, covariance: np.ndarray) -> bool:
        """Whether headings within their covariance (k, k) [rad²] close a gap, of points of this speed [m/s]."""
        problem = self._problem
        most, most_change, most_ratio = CAUSAL_TEST if problem.causal else OFFLINE_TEST
        if np.abs(rows.gap[:, 2]).max() > HEIGHT:
            return False
        flat, r = rows.H.reshape(-1, len(covariance)), rows.gap.ravel()
        weight = 1.0 / (problem.noise.slip_std**2 * max(1.0, SECONDS * problem.rate_hz))
        information = covariance @ (weight * flat.T @ flat)
        turn = -np.linalg.solve(np.eye(len(covariance)) + information, covariance @ (weight * flat.T @ r))
        closed = rows.gap + rows.H @ turn
        change, drift = _find_rms(closed - closed.mean(axis=0)), _find_rms(np.gradient(closed, time, axis=0))
        return _find_rms(closed) <= most and change <= most_change and drift <= most_ratio * speed


def _find_rms(v: np.ndarray) -> float:
    """Return the rms length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(v**2, axis=1))))
