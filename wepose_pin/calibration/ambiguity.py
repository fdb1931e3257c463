"""Other minima that explain the motion nearly as well.

A covariance describes one minimum. Where the hands hardly move, the closure has several: one arm's headings turned by
118 deg close the chain as well. So the closure is searched for all its minima. Each is solved in full and weighted by
how much worse it explains all that is known.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from .equations import Layout
from .initial_headings import wrap_angle
from .least_squares import Estimate, Gaussian, LeastSquares, solve
from .priors import place_points
from .weights import WeightedFit

COMPARED_SAMPLES = 120  # on which solutions are compared
STEPS = 25
LEAST_WEIGHT = 1e-4  # of a solution that counts
NEAR = 3.0  # standard deviations within which two solutions are the same
CIRCLE_STD = np.pi / np.sqrt(3.0)  # [rad] of a heading that may be anywhere


class OtherMinimum(NamedTuple):
    """Another solution."""

    offset: np.ndarray  # (m,) from the best solution, headings within half a turn
    weight: float  # its probability over that of the best solution, at most 1


def find_other_minima(
    result: WeightedFit, headings: np.ndarray, prior_at: Callable[[np.ndarray], Gaussian]
) -> list[OtherMinimum]:
    """Return solutions from other headings (k, sensors) [rad], the likeliest first, down to `LEAST_WEIGHT`.

    Parameters
    ----------
    result : the best solution
    prior_at : headings (sensors,) → what is known without the closure; those without a stated mount are its mean
    """
    fit, (observations, _, weights) = result.fit, result.fit.problem
    rows = observations.layout.heading
    if not observations.closed.any() or not len(headings):
        return []
    stride = max(1, len(observations) // COMPARED_SAMPLES)
    few = np.concatenate([np.arange(len(observations))[span][::stride] for _, span in observations.spans()])
    some, weights = observations.take(few), stride * weights[few]

    def solve_from(psi: np.ndarray) -> Estimate:
        start = fit.x.copy()
        start[rows] += wrap_angle(psi - start[rows])
        start = place_points(start, some)
        return solve(LeastSquares(some, prior_at(start[rows]), weights), start, STEPS, strict=False)

    best = solve_from(fit.x[rows])
    std = np.sqrt(np.diag(fit.covariance)[rows])
    minima: list[OtherMinimum] = []
    for psi in headings:
        other = solve_from(psi)
        offset = other.x - best.x
        offset[rows] = wrap_angle(offset[rows])
        # The residuals' variance is estimated from the effective samples: Student's t, not a Gaussian.
        degrees = max(3.0 * result.effective_sample_size, 1.0)
        new = OtherMinimum(offset, float((1.0 + max(other.cost - best.cost, 0.0) / degrees) ** (-0.5 * degrees)))
        if np.abs(offset[rows] / std).max() < NEAR or new.weight < LEAST_WEIGHT:
            continue
        if all(np.abs((offset - each.offset)[rows] / std).max() > NEAR for each in minima):
            minima.append(new)
    return sorted(minima, key=lambda each: -each.weight)


def widen_covariance(covariance: np.ndarray, others: list[OtherMinimum], layout: Layout) -> np.ndarray:
    """The covariance (m, m) about the solution with the minima included; no heading beyond the circle's."""
    if not others:
        return covariance
    total = 1.0 + sum(each.weight for each in others)
    outer = sum((each.weight / total * np.outer(each.offset, each.offset) for each in others), 0.0 * covariance)
    widened = covariance + outer
    rows = layout.heading
    std = np.sqrt(np.diag(widened))
    shrink = np.ones(layout.size)
    shrink[rows] = np.minimum(1.0, CIRCLE_STD / std[rows])
    return widened * np.outer(shrink, shrink)


def diagnose_ambiguity(others: list[OtherMinimum], layout: Layout) -> list[Diagnostic]:
    """The sensor whose heading differs most in the likeliest minimum, where there is one."""
    if not others:
        return []
    turned = np.abs(others[0].offset[layout.heading])
    worst = int(np.argmax(turned))
    return [Diagnostic("headings-ambiguous", WARNING, layout.sensors[worst], float(turned[worst]))]
