"""Other minima that explain the motion nearly as well.

A covariance describes one minimum. Where the hands hardly move, the closure has several: one arm's headings turned by
118 deg close the chain as well. So the closure is searched for all its minima. Each is solved in full and weighted by
how much worse it explains all that is known.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from .initial_headings import wrap_angle
from .least_squares import Estimate, Gaussian, LeastSquares, solve
from .priors import place_points
from .weights import WeightedFit

COMPARED_SAMPLES = 120  # on which solutions are compared
STEPS = 25
LEAST_WEIGHT = 1e-4  # of a solution that counts: its probability over that of the best one
NEAR = 3.0  # standard deviations within which two solutions are the same


def include_other_minima(
    result: WeightedFit, covariance: np.ndarray, headings: np.ndarray, prior_at: Callable[[np.ndarray], Gaussian]
) -> tuple[np.ndarray, list[Diagnostic]]:
    """Return the covariance (m, m) about the solution with other minima included, and what to say of them.

    Parameters
    ----------
    result, covariance : the best solution
    headings : (k, sensors) [rad] of the other minima, the lowest first
    prior_at : headings (sensors,) → what is known without the closure; those without a stated mount are its mean
    """
    fit, (observations, _, weights) = result.fit, result.fit.problem
    rows = observations.layout.heading
    if not observations.closed.any():
        return covariance, []
    stride = max(1, len(observations) // COMPARED_SAMPLES)
    few = np.concatenate([np.arange(len(observations))[span][::stride] for _, span in observations.spans()])
    some, weights = observations.take(few), stride * weights[few]

    def solve_from(psi: np.ndarray) -> Estimate:
        start = fit.x.copy()
        start[rows] += wrap_angle(psi - start[rows])
        start = place_points(start, some)
        return solve(LeastSquares(some, prior_at(start[rows]), weights), start, STEPS, strict=False)

    best, std = solve_from(fit.x[rows]), np.sqrt(np.diag(fit.covariance)[rows])
    # The residuals' variance is estimated from the effective samples: Student's t, not a Gaussian.
    degrees = max(3.0 * result.effective_sample_size, 1.0)
    offsets, likelihoods = [np.zeros_like(fit.x)], [1.0]
    for other in map(solve_from, headings):
        offset = other.x - best.x
        offset[rows] = wrap_angle(offset[rows])
        likelihood = float((1.0 + max(other.cost - best.cost, 0.0) / degrees) ** (-0.5 * degrees))
        if likelihood > LEAST_WEIGHT and all(np.abs((offset - o)[rows] / std).max() > NEAR for o in offsets):
            offsets.append(offset)
            likelihoods.append(likelihood)
    if len(offsets) == 1:
        return covariance, []
    shares = np.array(likelihoods) / sum(likelihoods)
    turned = np.abs(offsets[1 + int(np.argmax(shares[1:]))][rows])
    worst = int(np.argmax(turned))
    ambiguous = Diagnostic("headings-ambiguous", WARNING, observations.layout.sensors[worst], float(turned[worst]))
    return covariance + np.einsum("k,ki,kj->ij", shares, offsets, offsets), [ambiguous]
