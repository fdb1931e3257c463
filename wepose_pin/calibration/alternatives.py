"""Other solutions that explain the motion nearly as well.

A covariance describes one minimum. Where the hands hardly move, the closure has several: one arm's headings turned by
118 deg close the chain as well. So the closure is searched for all its minima. Each is solved in full and weighted by
how much worse it explains all that is known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from .equations import Layout
from .initial_headings import find_distinct_headings
from .least_squares import Estimate, Gaussian, LeastSquares, solve
from .priors import place_points
from .weights import WeightedFit

COMPARED_SAMPLES = 120  # on which solutions are compared
STEPS = 25
LEAST_WEIGHT = 1e-4  # of a solution that counts
NEAR = 3.0  # standard deviations within which two solutions are the same
CIRCLE_STD = np.pi / np.sqrt(3.0)  # [rad] of a heading that may be anywhere


class Alternative(NamedTuple):
    """Another solution."""

    offset: np.ndarray  # (m,) from the best solution, headings within half a turn
    weight: float  # its probability over that of the best solution, at most 1


def find_alternatives(
    result: WeightedFit, prior_at: Callable[[np.ndarray], Gaussian], stated: Mapping[str, float]
) -> list[Alternative]:
    """Solutions with other headings, the likeliest first, down to `LEAST_WEIGHT`.

    Parameters
    ----------
    result : the best solution
    prior_at : x (m,) → what is known without the closure, where headings without a stated mount are those of x
    stated : sensor → ψ [rad] of its stated mount; where all sensors have one there is nothing to search
    """
    fit, (observations, _, weights) = result.fit, result.fit.problem
    layout = observations.layout
    unknown = np.array([name not in stated for name in layout.sensors])
    if not observations.closed.any() or not unknown.any():
        return []
    stride = max(1, len(observations) // COMPARED_SAMPLES)
    few = np.concatenate([np.arange(len(observations))[span][::stride] for _, span in observations.spans()])
    some, weights = observations.take(few), stride * weights[few]
    rows = layout.heading

    def solve_from(psi: np.ndarray) -> Estimate:
        start = fit.x.copy()
        start[rows] += np.where(unknown, (psi - start[rows] + np.pi) % (2.0 * np.pi) - np.pi, 0.0)
        start = place_points(start, some)
        return solve(LeastSquares(some, prior_at(start), weights), start, STEPS, strict=False)

    best = solve_from(fit.x[rows])
    std = np.sqrt(np.diag(fit.covariance)[rows])
    alternatives: list[Alternative] = []
    closed = observations.take(observations.closed)
    for psi in find_distinct_headings(closed, fit.x, stated):
        other = solve_from(psi)
        offset = other.x - best.x
        offset[rows] = (offset[rows] + np.pi) % (2.0 * np.pi) - np.pi
        # The residuals' variance is estimated from the effective samples: Student's t, not a Gaussian.
        degrees = max(3.0 * result.effective_sample_size, 1.0)
        new = Alternative(offset, float((1.0 + max(other.cost - best.cost, 0.0) / degrees) ** (-0.5 * degrees)))
        if np.abs(offset[rows] / std).max() < NEAR or new.weight < LEAST_WEIGHT:
            continue
        if all(np.abs((offset - each.offset)[rows] / std).max() > NEAR for each in alternatives):
            alternatives.append(new)
    return sorted(alternatives, key=lambda each: -each.weight)


def widen_covariance(covariance: np.ndarray, others: list[Alternative], layout: Layout) -> np.ndarray:
    """The covariance (m, m) about the solution with the alternatives included; no heading beyond the circle's."""
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


def diagnose_ambiguity(others: list[Alternative], layout: Layout) -> list[Diagnostic]:
    """The sensor whose heading differs most in the likeliest alternative, where there is one."""
    if not others:
        return []
    turned = np.abs(others[0].offset[layout.heading])
    worst = int(np.argmax(turned))
    return [Diagnostic("headings-ambiguous", WARNING, layout.sensors[worst], float(turned[worst]))]
