"""Other solutions that explain the motion nearly as well.

A covariance is that of one minimum and knows nothing of others. Where the hands hardly move, the closure has several:
one arm's headings turned by 118 deg close the chain as well. So the closure is searched for all its minima; each is
solved in full, and weighs by how much worse it explains all that is known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from .problem import Fit, K, Layout, Looks, placed, solve
from .start import distinct_headings

SEEN_LOOKS = 120  # on which solutions are compared
STEPS = 25
LEAST_WEIGHT = 1e-4  # of a solution that is worth a word
NEAR = 3.0  # standard deviations within which a solution is no other one
CIRCLE_STD = np.pi / np.sqrt(3.0)  # [rad] of a heading that may be anywhere


class Alternative(NamedTuple):
    """Another solution."""

    off: np.ndarray  # (m,) from the solution that is handed on, headings within half a turn
    weight: float  # its probability over that of the solution, at most 1


def alternatives(
    looks: Looks,
    known_at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    fit: Fit,
    weights: np.ndarray,
    independent: float,
    told: Mapping[str, float],
) -> list[Alternative]:
    """Solutions with other headings, the likeliest first, down to `LEAST_WEIGHT`.

    Parameters
    ----------
    known_at : x (m,) → centre (m,) and information (m, m) of what is known without the closure, where the headings that
        nothing tells are those of x
    fit, weights, independent : the solution, the weights (n, 5) of its looks, how many independent ones these are
    told : sensor → ψ [rad] where a stated mount tells it; where all are told there is nothing to search
    """
    layout = looks.layout
    unknown = np.array([name not in told for name in layout.sensors])
    if not looks.closed.any() or not unknown.any():
        return []
    every = max(1, looks.data.shape[1] // SEEN_LOOKS)
    few = np.concatenate([np.arange(looks.data.shape[1])[span][::every] for _, span in looks.spans()])
    some, weights = looks.take(few), every * weights[few]
    rows = np.arange(layout.size)[layout.heading]

    def solved(psi: np.ndarray) -> Fit:
        begin = fit.x.copy()
        begin[rows] += np.where(unknown, (psi - begin[rows] + np.pi) % (2.0 * np.pi) - np.pi, 0.0)
        begin = placed(begin, some)
        return solve(some, *known_at(begin), weights, begin, STEPS, strict=False)

    best = solved(fit.x[rows])
    std = np.sqrt(np.diag(np.linalg.inv(fit.information))[rows])
    found: list[Alternative] = []
    for psi in distinct_headings(looks.take(looks.closed).stepped(fit.x), fit.x[:K], fit.x[layout.distances], told):
        other = solved(psi)
        off = other.x - best.x
        off[rows] = (off[rows] + np.pi) % (2.0 * np.pi) - np.pi
        # The variance of the residuals is found from as many of them as are independent: Student's t, not a Gaussian.
        degrees = max(3.0 * independent, 1.0)
        new = Alternative(off, float((1.0 + max(other.cost - best.cost, 0.0) / degrees) ** (-0.5 * degrees)))
        if np.abs(off[rows] / std).max() < NEAR or new.weight < LEAST_WEIGHT:
            continue
        if all(np.abs((off - each.off)[rows] / std).max() > NEAR for each in found):
            found.append(new)
    return sorted(found, key=lambda each: -each.weight)


def spread_over(covariance: np.ndarray, others: list[Alternative], layout: Layout) -> np.ndarray:
    """The covariance (m, m) about the solution where it may be one of the others; no heading beyond the circle's."""
    if not others:
        return covariance
    total = 1.0 + sum(each.weight for each in others)
    spread = covariance + sum((each.weight / total * np.outer(each.off, each.off) for each in others), 0.0 * covariance)
    rows = np.arange(layout.size)[layout.heading]
    std = np.sqrt(np.diag(spread))
    shrunk = np.ones(layout.size)
    shrunk[rows] = np.minimum(1.0, CIRCLE_STD / std[rows])
    return spread * np.outer(shrunk, shrunk)


def ambiguous_headings(others: list[Alternative], layout: Layout) -> list[Diagnostic]:
    """The sensor whose heading differs most in the likeliest other solution, where there is one."""
    if not others:
        return []
    turned = np.abs(others[0].off[layout.heading])
    worst = int(np.argmax(turned))
    return [Diagnostic("headings-ambiguous", WARNING, layout.sensors[worst], float(turned[worst]))]
