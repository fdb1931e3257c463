"""The weights of the samples, their effective size, and the covariance of the result.

The weight of the data is measured, not assumed. In a few rounds of Gauss-Newton the residual's own mean square gives
its variance, and its autocorrelation the effective sample size. Samples at which the palms are apart are outliers and
lose their weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .couplings import LEAST_CORRELATION_S
from .equations import GAP_ROWS, HINGE_STD, Gaussian
from .least_squares import STEPS, LeastSquares, Observations, solve
from .protocols import Axis, Closure, Direction, FreeMotion
from .result import MIN_CONTACT, MeasuredLength

# Residual variance, in units of the weights', that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
THIRD_CHI2 = {1: 0.1485, 2: 0.7133, 3: 1.4237}  # 30 % quantile of chi², by degrees of freedom
ROUNDS = 5
ROUND_STEPS = 2  # of the rounds after the first: the next one goes on
FINAL_STEPS = 300  # of the last solve, which must converge: hands that hardly move take a hundred
QUICK_ROUNDS, QUICK_STEPS = 1, 15
OUTLIER = 5.0  # times the usual gap, at which the palms are apart
MIN_LATE_CONTACT = 0.4  # weight below which the palms are apart in the last rounds, when the fit is about right
# [rad] by which people's elbows leave a hinge (docs/people.md): an oblique axis, and one that wanders.
ELBOW_STD = np.deg2rad(4.0)
LEAST_BEND = 0.2  # sine of the angle by which a segment must bend to show its axis
CONTRADICTED = 3.0  # standard deviations between a measured length, or a pose, and what is known without it
POSED_ROUND = 1  # after which poses are used that do not contradict the closures
# [m] rms error of the lengths of simulated people after a minute (docs/validation.md), from soft tissue and shoulders,
# which the residuals show in part.
LEAST_LENGTH_STD = 0.010

# Residuals of a closure whose weight is measured: their samples and columns, the contact (n,) of these samples, and the
# least variance.
Block = tuple[slice, slice, np.ndarray, float]


def solve_reweighted(
    observations: Observations, prior: Gaussian, start: np.ndarray, contact: np.ndarray, quick: bool = False
) -> LeastSquares:
    """Return the fit with gap and hinges weighted by their own residuals: variance, and how long it stays correlated.

    Poses beside a closure are used where they do not contradict it. What they are compared with is found without them.
    It begins with x `start` (m,), in which `contact` (n,) is the weight of each sample's gap. `quick`: one round with
    few steps and without hinges.
    """
    rounds, steps = (QUICK_ROUNDS, QUICK_STEPS) if quick else (ROUNDS, STEPS)
    correlation, closures, poses = min_correlation(observations), observations.closures, observations.poses
    stated, posed = _state_weights(observations, contact, correlation), dict[str, float]()
    if quick:
        stated[:, GAP_ROWS:] = 0.0
    weights = stated.copy()
    for span in [span for own in poses.values() for _, span in own] if closures else ():
        weights[span] = 0.0
    fit = LeastSquares(observations, prior, weights, start, contact)
    for k in range(rounds if closures else 0):
        fit = solve(fit, steps if k == 0 else ROUND_STEPS, strict=False)
        weights, contact = fit.weights.copy(), fit.contact.copy()
        least = MIN_LATE_CONTACT if k > 1 else MIN_CONTACT
        for closure, span in closures:
            # The lower third: the palms may be apart for half of the phase and more.
            rows = closure.rows
            size = np.sum(fit.residuals[span, :rows] ** 2, axis=1)
            usual = max(float(np.quantile(size, 0.3)) / THIRD_CHI2[rows], LEAST_VARIANCE)
            weight = (1.0 + size / (usual * OUTLIER**2 * rows)) ** -2
            contact[span] = np.where(weight > least, weight, 0.0)
        for block in _list_blocks(observations, contact, hinges=not quick):
            span, columns, touch, _ = block
            variance, correlated = _measure_block(fit, block, correlation)
            weights[span, columns] = touch[:, None] / (correlated * variance)
        if k == min(POSED_ROUND, rounds - 1):
            posed = {phase: _measure_pose(fit, own, stated, used=False) for phase, own in poses.items()}
            for span in [span for phase, own in poses.items() if posed[phase] <= CONTRADICTED for _, span in own]:
                weights[span] = stated[span]
        fit = replace(fit, weights=weights, contact=contact)
    fit = solve(fit, steps if quick else FINAL_STEPS, strict=not quick)
    if not closures and not quick:
        posed = {phase: _measure_pose(fit, own, stated, used=True) for phase, own in poses.items()}
    blocks = _list_blocks(observations, contact, hinges=False)
    size = sum((float(block[2].sum()) / _measure_block(fit, block, correlation)[1] for block in blocks), 0.0)
    return replace(fit, effective_sample_size=size, posed=posed)


def _list_blocks(observations: Observations, contact: np.ndarray, hinges: bool = True) -> list[Block]:
    blocks: list[Block] = []
    for closure, span in observations.closures:
        blocks.append((span, slice(closure.rows), contact[span], LEAST_VARIANCE))
        if observations.layout.hinges and hinges:
            # However well an elbow's axis fits this motion: what it leaves a hinge by follows the pose.
            every = np.ones(span.stop - span.start)
            blocks.append((span, slice(GAP_ROWS, None), every, (ELBOW_STD / HINGE_STD) ** 2))
    return [block for block in blocks if block[2].sum() > 0.0]


def _measure_block(fit: LeastSquares, block: Block, least: float) -> tuple[float, float]:
    """Return the variance of a block's residuals, and of how many samples one is independent, at least `least`."""
    span, columns, contact, least_variance = block
    r = fit.residuals[span, columns]
    variance = float(contact @ np.sum(r**2, axis=1)) / (r.shape[1] * float(contact.sum()))
    return max(variance, least_variance), count_correlated_samples(r * contact[:, None], least)


def _state_weights(observations: Observations, contact: np.ndarray, correlation: float) -> np.ndarray:
    """Return the weights (n, k) of poses, which are stated, and those of closures to begin with."""
    weights = np.full((len(observations), observations.layout.residuals), 1.0 / correlation)
    weights[:, :GAP_ROWS] *= contact[:, None]
    for condition, span in observations.spans:
        # The error of a pose is constant, and how an elbow leaves its hinge follows its angles: one effective sample.
        size = ELBOW_STD / HINGE_STD if isinstance(condition, FreeMotion) else 1.0
        if isinstance(condition, Axis):  # by the sine of its bend an axis leaves the horizontal if it is off
            first = 4 * observations.layout.sensors.index(condition.segment)
            x, y, _, _ = observations.data[first : first + 4, span]
            size = max(float(np.sqrt(np.mean(1.0 - (1.0 - 2.0 * (x**2 + y**2)) ** 2))), LEAST_BEND)
        if not isinstance(condition, Closure):
            weights[span] = size**-2 / (span.stop - span.start)
    return weights


def min_correlation(observations: Observations) -> float:
    """The number of samples in `LEAST_CORRELATION_S`."""
    return LEAST_CORRELATION_S / max(float(np.median(np.diff(observations.data[-1]))), 1e-3)


def count_correlated_samples(r: np.ndarray, least: float) -> float:
    """How many samples of `r` (n, k) make one independent one, at least `least`: 1 + 2 Σ ρ up to the first zero."""
    n = len(r)
    spectrum = np.abs(np.fft.rfft(r - r.mean(axis=0), 2 * n, axis=0)) ** 2
    rho = np.fft.irfft(spectrum, 2 * n, axis=0)[:n].sum(axis=1)
    if not rho[0] > 0.0:
        return max(1.0, least)
    crossing = int(np.argmax(rho <= 0.0)) if np.any(rho <= 0.0) else n
    return max(float(1.0 + 2.0 * rho[1:crossing].sum() / rho[0]), least)


def estimate_covariance(fit: LeastSquares) -> np.ndarray:
    """Return the covariance (m, m) of x under errors that are correlated over time.

    The weights count as many samples as one as the errors last. That is right where the motion is as slow as the
    errors. Where the motion covers a good part of its range meanwhile, an error acts on other unknowns from sample to
    sample and cancels. So the gradient's covariance is that of sums over windows of the errors' duration,
    C (Λ + Σ (Σ w J)ᵀ σ² (Σ w J) / duration) C, as of Newey and West 1987 with their triangle of weights.
    """
    observations, weights, J, C = fit.observations, fit.weights, fit.jacobian, fit.covariance
    gradient, least = fit.prior[1].copy(), min_correlation(observations)
    for condition, span in observations.spans:
        if not isinstance(condition, Closure):
            gradient += np.einsum("nk,nki,nkj->ij", weights[span], J[span], J[span], optimize=True)
    for block in _list_blocks(observations, fit.contact):
        span, columns, contact, _ = block
        slope, (variance, duration) = J[span, columns], _measure_block(fit, block, least)
        # The fit has reduced the residuals: their variance gets back what it took.
        taken = np.einsum("nki,ij,nkj->n", slope, C, slope, optimize=True)
        variance += float(contact @ taken) / (slope.shape[1] * float(contact.sum()))
        pull, length = weights[span, columns, None] * slope, round(duration)
        summed = np.concatenate((np.zeros((1, *pull.shape[1:])), np.cumsum(pull, axis=0)))
        ends = np.arange(1, len(pull) + length)
        windows = summed[np.minimum(ends, len(pull))] - summed[np.maximum(ends - length, 0)]
        windows = windows.reshape(-1, C.shape[0])
        gradient += variance / length * windows.T @ windows
    return C @ gradient @ C


def compare_measured(
    fit: LeastSquares, measured: Mapping[str, tuple[float, float]], least_std: float
) -> dict[str, MeasuredLength]:
    """Each measured length, name → ([m], its standard deviation [m]), beside the solution without it.

    `least_std` [m] is that of any estimate of a length.
    """
    compared = {}
    for name, (metres, std) in measured.items():
        row = fit.observations.layout.lengths.index(name)
        variance = fit.covariance[row, row]
        rest = 1.0 / variance - 1.0 / std**2  # information without that of the measured length
        expected = metres + (fit.x[row] - metres) / (variance * rest)
        compared[name] = MeasuredLength(metres, float(expected), max(float(rest**-0.5), least_std), std)
    return compared


def _measure_pose(
    fit: LeastSquares, poses: Sequence[tuple[Direction | Axis, slice]], stated: np.ndarray, used: bool
) -> float:
    """By how many standard deviations a phase of poses deviates from what is known without it.

    A pose has no residual that would show how it was held, as a closure has: only the other conditions can. `stated`
    (n, k) are the weights of the residuals where the poses are used, and `used` says whether the fit uses them.
    """
    r, H, degrees = [], [], 0
    for condition, span in poses:
        whiten = np.sqrt(stated[span, :GAP_ROWS].sum(axis=0))
        r.append(whiten * fit.residuals[span, :GAP_ROWS].mean(axis=0))
        H.append(whiten[:, None] * fit.jacobian[span, :GAP_ROWS].mean(axis=0))
        degrees += 2 if isinstance(condition, Direction) else 1
    z, slope = np.concatenate(r), np.concatenate(H)
    of_rest = slope @ fit.covariance @ slope.T
    chi2 = float(z @ np.linalg.solve(np.eye(len(z)) + (-of_rest if used else of_rest), z))
    # The deviate of a normal variable that is as rare as chi² (Wilson and Hilferty 1931).
    spread = 2.0 / (9.0 * degrees)
    return float((np.cbrt(chi2 / degrees) - (1.0 - spread)) / np.sqrt(spread))
