"""A Kalman filter of heading errors over knots of a recording: it owns the headings and the biases about the vertical.

δ_i is the heading error of segment i, on the left in W: R_WL,true = Rz(δ_i) R_WL. It changes by a random walk and by a
rate that changes slowly: the bias about the vertical. An orientation filter corrects both by what its own sensor shows,
as in a static phase. The headings here are those without its corrections, and what it has learned of the bias is one
more observation. Differences of two or more δ are observed by:

- the acceleration of a joint, which two sensors measure (`observations.joint_accelerations`), with their levers as
  unknowns;
- a hinge: the long axis of the segment below stays in the plane across the hinge's axis, within its range;
- two points that coincide: palms in a phase `clasp`.

Errors by soft tissue, tilted hinge axes and travelling joints are correlated over seconds or over the whole recording.
They are states, so that a long recording does not average them away.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from ..body.mounts import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..observations.hinges import linearize_hinge
from ..observations.joint_accelerations import JointResidual, linearize_joint
from ..observations.paths import GapRows
from .heading_problem import FilterHeadings, HeadingProblem, Knot

UNKNOWN_DRIFT_PSD = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance: 3° in a minute; assumption
MIN_DRIFT_PSD = 1e-10  # [rad²/s]
# The heading variance of an orientation filter leaps where a knot adds more than this many times the largest recent
# growth; that is forgotten with a time constant [s].
LEAP_RATIO, GROWTH_MEMORY_S = 10.0, 60.0
# An orientation filter learns of a bias where its variance falls by at least this share, and is off by twice what it
# states: its motions are not as random as it assumes. Found by simulated people who walk, run, throw and reach.
LEAST_LEARNED, LEARNED_VARIANCE_RATIO = 1e-4, 4.0
MISFIT_MEMORY_S = 30.0  # time constant of the recent misfit of a joint's accelerations
# People stand off the start pose as the population does, or by a share of it where they take care: the share, and how
# likely that is before anything is observed; assumptions.
CAREFUL_SHARE, CAREFUL_PROBABILITY = 0.1, 0.2
OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
HINGE_HEADING_MARGIN = np.deg2rad(10.0)  # [rad] that headings may have drifted before a hinge row is an outlier
ITERATIONS = 2  # linearizations of an update
# A heading may be feigned by this many times the rms of the coherent misfits that no heading explains, and by no more
# than a share of the rms misfit; found by simulated people who walk, run, throw and reach.
COHERENT_MARGIN, LARGEST_COHERENT_SHARE = 2.0, 0.5
_HINGE_COLUMNS = [0, 1, 2, 2, 3]  # of `HingeRows.H`: soft tissue twists a sensor about the same axis as the hinge's
# Jacobian of the angle and of the two sides of a joint by its columns (`HeadingProblem.pair_columns`).
_JOINT_JACOBIAN = np.zeros((15, 17))
_JOINT_JACOBIAN[0, :3], _JOINT_JACOBIAN[1:, 3:] = (1.0, -1.0, 1.0), np.eye(14)


class JointMisfit(NamedTuple):
    """The recent misfit of a joint: sums over samples, in which older ones count less.

    Some of a misfit repeats with the motion, as that of soft tissue with the gait: it is coherent with the joint's
    force and does not average out. A heading explains one coherent misfit, which turns the force about the vertical.
    The other ones, which stretch it or mix it with the vertical, show how large coherent misfits are in this motion.
    """

    products: np.ndarray = np.zeros((3, 3))  # [m²/s⁴] Σ e fᵀ of the misfit e and the force f
    misfit: np.ndarray = np.zeros(3)  # [m²/s⁴] Σ e²
    force: np.ndarray = np.zeros(3)  # [m²/s⁴] Σ f²
    samples: float = 0.0  # that count

    def add(self, residual: JointResidual, decay: float) -> JointMisfit:
        """Return the sums with the samples of a residual, the former ones times `decay`."""
        e, f = residual.e, residual.force
        return JointMisfit(
            decay * self.products + e.T @ f,
            decay * self.misfit + np.sum(e**2, axis=0),
            decay * self.force + np.sum(f**2, axis=0),
            decay * self.samples + len(e),
        )

    @property
    def variance(self) -> float:
        """[m²/s⁴] of the misfit, mean of the axes."""
        return float(self.misfit.sum() / (3.0 * self.samples)) if self.samples else 0.0

    def find_coherent_variance(self, correlated_samples: float) -> float:
        """Return the variance [rad²] of the heading that a coherent misfit can feign.

        `correlated_samples` are one observation; so many of them have coherent parts by chance.
        """
        horizontal = self.force[0] + self.force[1]
        if not horizontal:
            return 0.0
        E = self.products / horizontal
        mixed = E[:2, 2] * np.sqrt(horizontal / max(self.force[2], 1e-9 * horizontal))
        parts = np.array([E[0, 0] + E[1, 1], E[0, 0] - E[1, 1], E[0, 1] + E[1, 0], *mixed, *E[2, :2]])
        by_chance = self.variance / horizontal * correlated_samples / self.samples
        coherent = COHERENT_MARGIN**2 * max(float(np.mean(parts**2)) - by_chance, 0.0)
        return min(coherent, LARGEST_COHERENT_SHARE**2 * self.variance * 2.0 * self.samples / horizontal)


class Information:
    """What rows 0 = r + H (y − x) + e tell of a state y (n,), linearized at x: Σ Hᵀ W H (n, n) and Σ Hᵀ W r (n,)."""

    def __init__(self, n: int) -> None:
        self.matrix, self.vector = np.zeros((n, n)), np.zeros(n)

    def add(self, columns: np.ndarray, H: np.ndarray, r: np.ndarray, weight: np.ndarray | float) -> None:
        """Add rows r (m,), H (m, c) of these columns of the state, with weights of one over their variance."""
        weighted = weight * H.T
        self.matrix[columns[:, None], columns] += weighted @ H
        self.vector[columns] += weighted @ r


class Process(NamedTuple):
    """How the state changes within a knot, besides what it does by itself; (n,) each."""

    change: np.ndarray
    variance: np.ndarray


class HeadingFilter:
    """The state and its covariance, knot by knot.

    Parameters
    ----------
    start : what the orientation filters know at the end of the start pose

    Attributes
    ----------
    x, P : (n,), (n, n); the first k are δ [rad]
    process : of the last knot
    """

    def __init__(self, problem: HeadingProblem, start: FilterHeadings) -> None:
        self.problem = problem
        noise, knot_s, c, k = problem.noise, problem.knot_s, problem.columns, len(problem.names)
        self.x, std, decay = np.zeros(c.size), np.zeros(c.size), np.ones(c.size)
        known = np.sqrt(start.rate_var)
        std[c.rate] = np.hypot(noise.rate_std, np.where(np.isfinite(known), known, problem.rate_std))
        for i, pair in enumerate(problem.pairs):
            std[c.joint[i]] = noise.girdle_std if pair.travels else noise.joint_std
            self.x[c.lever[i]], std[c.lever[i]] = pair.levers, pair.lever_std
        decay[c.joint] = np.exp(-knot_s / noise.joint_correlation_s)
        std[c.delay] = problem.delay_std
        std[c.force], decay[c.force] = noise.force_std, np.exp(-knot_s / noise.force_correlation_s)
        std[c.axis], std[c.tilt] = problem.hinge_std[:, 0], problem.hinge_std[:, 1]
        std[c.twist], decay[c.twist] = noise.twist_std, np.exp(-knot_s / noise.twist_correlation_s)
        self.P = np.diag(std**2)
        self._set_start_covariance()
        self._decay, self._process_var = decay, (1.0 - decay**2) * std**2
        self._process_var[c.rate] = noise.rate_change_psd * knot_s
        self._misfits = [JointMisfit()] * len(problem.pairs)  # of each joint's accelerations
        self._last = start
        self._lost_before = np.zeros(k, dtype=bool)  # whether a sensor has lost a sample in the last knot
        self._recent_growth = np.zeros(k)  # [rad²] of the orientation filter's variance in a knot, the largest
        self._clasped_before = False  # whether the palms were joined in the last knot

    def reset(self, headings: np.ndarray) -> None:
        """Set δ (k,) [rad] as known to within the start pose."""
        columns = self.problem.columns
        self.x[columns.heading], self.x[columns.start] = headings, 0.0
        self._set_start_covariance()

    def _set_start_covariance(self) -> None:
        """Set the covariance of δ = s − ε_z, of the mounts' ε_z and of the segments' s after a start pose."""
        problem, c = self.problem, self.problem.columns
        for columns in (c.heading, c.mount, c.start):
            self.P[columns, :], self.P[:, columns] = 0.0, 0.0
        self.P[c.heading, c.heading] = problem.start_var + problem.mount_var
        self.P[c.mount, c.mount] = problem.mount_var
        self.P[c.heading, c.mount] = self.P[c.mount, c.heading] = -problem.mount_var
        self.P[c.start, c.start] = problem.start_var
        self.P[c.heading, c.start] = self.P[c.start, c.heading] = problem.start_var

    def step(self, knot: Knot) -> Iterator[None]:
        """Predict to the end of a knot and update by its observations.

        It yields between parts of a millisecond or two; the state is valid after the last one.
        """
        self.process = self._find_process(knot)
        self.predict(self.process)
        yield
        yield from self._update(knot)
        self._last, self._lost_before = knot.filters, knot.lost

    def _find_process(self, knot: Knot) -> Process:
        """Find how the state changes within a knot.

        The heading variance of an orientation filter grows by the bias too, which is a rate here. So its growth counts
        up to `drift_psd`. As a whole it counts where it leaps: samples were lost, or the gyroscope was saturated.
        What the filter has corrected of its heading and its bias is taken back. A bias is less certain where another
        axis of the sensor becomes vertical.
        """
        problem, now, last, c = self.problem, knot.filters, self._last, self.problem.columns
        least = problem.drift_psd * problem.knot_s
        gained = np.maximum(now.var - last.var, MIN_DRIFT_PSD * problem.knot_s)
        known = np.isfinite(gained)
        leaps = knot.lost | (gained > LEAP_RATIO * np.maximum(self._recent_growth, least))
        remembered = self._recent_growth * np.exp(-problem.knot_s / GROWTH_MEMORY_S)
        self._recent_growth = np.maximum(remembered, np.where(known, gained, 0.0))
        process = Process(np.zeros(c.size), self._process_var.copy())
        process.change[c.heading] = -np.nan_to_num(now.heading - last.heading)
        process.change[c.rate] = np.nan_to_num(now.rate - last.rate)
        drift = np.where(leaps, gained, np.minimum(gained, least))
        process.variance[c.heading] += np.where(known, drift, UNKNOWN_DRIFT_PSD * problem.knot_s)
        process.variance[c.rate] += np.nan_to_num(np.maximum(now.rate_var - last.rate_var, 0.0))
        return process

    def advance(self, values: np.ndarray) -> np.ndarray:
        """Return F v of one knot for v (n,) or (n, m): correlated states decay, headings change by their rates."""
        columns, advanced = self.problem.columns, np.asarray((self._decay * values.T).T)
        advanced[columns.heading] += self.problem.knot_s * values[columns.rate]
        return advanced

    def predict(self, process: Process) -> None:
        """Predict state and covariance at the end of the next knot."""
        self.x = self.advance(self.x) + process.change
        self.P = self.advance(self.advance(self.P).T).T + np.diag(process.variance)

    def _update(self, knot: Knot) -> Iterator[None]:
        """Update by a knot's observations."""
        k, unreliable = len(self.problem.names), knot.lost | self._lost_before  # after a loss the tilt may be wrong
        palms = self.problem.palms if knot.clasped.any() else None
        if palms is not None and unreliable[[self.problem.names.index(name) for name in palms.segments]].any():
            palms = None
        x, information, misfits = self.x, Information(len(self.x)), self._misfits
        for _ in range(ITERATIONS):
            information = Information(len(x))
            misfits = self._add_joints(knot, x, information)
            self._add_biases(knot, x, information)
            yield
            yield from self._add_hinges(knot, x, information, unreliable)
            if palms is not None:
                self._add_gap(palms.linearize(knot.quat_WL[knot.clasped], x[:k]), knot, information)
                yield
            x = self._fuse(x, information)
            yield
        self._misfits = misfits
        self._apply(x, information)
        self._clasped_before = bool(knot.clasped.any())

    def _add_biases(self, knot: Knot, x: np.ndarray, information: Information) -> None:
        """Add what the orientation filters have learned of the biases about the vertical.

        A filter that corrects a bias by c while its variance falls from v to v (1 − K) has observed c/K with the
        variance v (1 − K)/K. The rate here already has c; it is the bias and `rate_std`, which is no bias.
        """
        now, last, columns = knot.filters, self._last, self.problem.columns.rate
        other_var = self.problem.noise.rate_std**2
        learned = 1.0 - (now.rate_var + other_var) / (last.rate_var + other_var)
        learns = learned > LEAST_LEARNED  # false for NaN
        share = np.where(learns, learned, 1.0)
        correction = np.where(learns, now.rate - last.rate, 0.0)
        var = LEARNED_VARIANCE_RATIO * np.where(learns, now.rate_var + other_var, 1.0) / share
        information.add(columns, np.eye(len(columns)), x[columns] + correction * (1.0 / share - 1.0), learns / var)

    def _fuse(self, x: np.ndarray, information: Information) -> np.ndarray:
        """Return the state (n,) that fits both the prediction and rows that were linearized at x (n,) best."""
        right = self.P @ (information.matrix @ (x - self.x) - information.vector)
        return np.asarray(self.x + np.linalg.solve(np.eye(len(x)) + self.P @ information.matrix, right))

    def _apply(self, x: np.ndarray, information: Information) -> None:
        """Set the state, and the covariance that the information leaves."""
        self.x = x
        self.P = symmetric(np.linalg.solve(np.eye(len(x)) + self.P @ information.matrix, self.P))

    def _add_joints(self, knot: Knot, x: np.ndarray, information: Information) -> list[JointMisfit]:
        """Add the accelerations of joints; return the recent misfits with those of the knot."""
        problem, noise, misfits = self.problem, self.problem.noise, list(self._misfits)
        correlated = max(1.0, noise.acceleration_correlation_s * problem.rate_hz)
        decay = np.exp(-problem.knot_s / MISFIT_MEMORY_S)
        for i, columns in enumerate(problem.pair_columns):
            near, far, joint = columns[:3]
            if knot.lost[near] or knot.lost[far] or not len(knot.sides):
                continue
            near_B, far_B = knot.sides[:, near], knot.sides[:, far]
            residual = linearize_joint(near_B, far_B, x[near] - x[far] + x[joint], x[columns[3:10]], x[columns[10:]])
            misfit = misfits[i] = misfits[i].add(residual, decay)
            r, H = residual.e.ravel(), residual.jacobian.reshape(-1, len(_JOINT_JACOBIAN)) @ _JOINT_JACOBIAN
            weight = 1.0 / (max(float(np.mean(r**2)), misfit.variance, noise.acceleration_std**2) * correlated)
            # What is coherent counts as one observation over the time that is remembered.
            knots = misfit.samples / len(residual.e)
            weight /= 1.0 + weight * float(H[:, 0] @ H[:, 0]) * misfit.find_coherent_variance(correlated) * knots
            information.add(columns, H, r, weight)
        return misfits

    def _add_hinges(
        self, knot: Knot, x: np.ndarray, information: Information, unreliable: np.ndarray
    ) -> Iterator[None]:
        """Add the hinges and their ranges; yield between them."""
        problem, noise = self.problem, self.problem.noise
        samples = max(1.0, noise.hinge_correlation_s * problem.rate_hz)
        for hinge, columns, (_, _, std) in zip(problem.hinges, problem.hinge_columns, problem.hinge_std, strict=True):
            moves, on = columns[:2]
            if unreliable[on] or unreliable[moves]:
                continue
            rows = linearize_hinge(hinge, knot.quat_WL[:, on], knot.quat_WL[:, moves], x[columns[:2]])
            H = rows.H[:, _HINGE_COLUMNS]
            r = rows.r + H[:, 2:] @ x[columns[2:]]
            is_inlier = np.abs(r) < OUTLIER_STDS * std + HINGE_HEADING_MARGIN
            information.add(columns, H, r, is_inlier / (std**2 * samples))
            beyond = (rows.excess != 0.0) / (noise.range_std**2 * samples)
            information.add(columns[:2], rows.slope[:, None] * [1.0, -1.0], rows.excess, beyond)
            yield

    def _add_gap(self, rows: GapRows, knot: Knot, information: Information) -> None:
        """Add the gap between the palms, without outliers.

        As many samples as its residuals are correlated over are one observation.
        Causally all of a clasp's first knot is one: a clasp may be shorter than its residuals are correlated.
        """
        problem = self.problem
        covariance = PALM_SLIP_STD**2 * np.eye(3) + SEGMENT_ATTITUDE_STD**2 * rows.by_attitude + rows.off_law
        covariance += rows.by_shape @ problem.shape_cov @ rows.by_shape.swapaxes(1, 2)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        r, H = (whiten @ rows.gap[:, :, None])[..., 0], whiten @ rows.H
        is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
        correlated = max(1.0, problem.noise.closure_correlation_s * problem.rate_hz)
        if problem.causal and not self._clasped_before:
            correlated = float(len(knot.quat_WL))
        r, H = r[is_inlier].ravel(), H[is_inlier].reshape(-1, H.shape[2])
        information.add(problem.columns.heading, H, r, 1.0 / correlated)


def symmetric(P: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (P + P.T))


class HeadingEstimate(NamedTuple):
    """The headings of k segments, at a knot or at m of them (m, …).

    δ begins at s − ε_z, by errors s of the start pose and ε_z of the mount, and grows by the drift; a segment that
    hangs is off by δ + ε_z.
    """

    errors: np.ndarray  # (k,) [rad] δ
    covariance: np.ndarray  # (k, k) [rad²] of δ
    segment_covariance: np.ndarray  # (k, k) [rad²] of the segments' headings near the start pose


def find_care(problem: HeadingProblem, x: np.ndarray, P: np.ndarray) -> float:
    """Return the probability that the person took care in the start pose, by the state and its covariance.

    The filter's start pose is that of the population. With care, its headings have `CAREFUL_SHARE` of the standard
    deviation. The likelihood of that follows in closed form from what the filter knows of the errors s of the start
    pose, which are states. Only accelerations of joints tell that much.
    """
    if not problem.pairs:
        return 0.0
    columns = problem.columns.start
    s, information = x[columns], _information_by_care(problem)
    spread = np.eye(len(s)) + information[:, None] * P[np.ix_(columns, columns)]
    misfit = s @ np.linalg.solve(spread, information * s)
    log_ratio = -len(s) * np.log(CAREFUL_SHARE) - 0.5 * (np.linalg.slogdet(spread)[1] + misfit)
    return float(expit(logit(CAREFUL_PROBABILITY) + log_ratio))


def estimate_headings(problem: HeadingProblem, x: np.ndarray, P: np.ndarray, care: float) -> HeadingEstimate:
    """Return the mean over both start poses, with care of this probability and without, and its covariance."""
    columns, information, k = problem.columns, _information_by_care(problem), len(problem.names)
    rows = np.concatenate([columns.heading, columns.mount])
    by_start = P[:, columns.start]
    spread = np.eye(k) + information[:, None] * by_start[columns.start]
    gain = by_start[rows] @ np.linalg.solve(spread, np.diag(information))
    change = -gain @ x[columns.start]
    cov = symmetric(P[np.ix_(rows, rows)] - care * gain @ by_start[rows].T)
    cov += care * (1.0 - care) * np.outer(change, change)
    of_headings, both = cov[:k, :k], cov[:k, k:]
    return HeadingEstimate((x[rows] + care * change)[:k], of_headings, of_headings + cov[k:, k:] + both + both.T)


def _information_by_care(problem: HeadingProblem) -> np.ndarray:
    """Return what care adds to the information (k,) [1/rad²] of the start pose."""
    return np.asarray((CAREFUL_SHARE**-2 - 1.0) / problem.start_var)
