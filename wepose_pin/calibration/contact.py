"""An initial guess of the least squares by the samples at which the palms touch.

The linear guess of the headings (`initial_headings`) weighs all samples alike: where the hands are apart for a good
part of the phase, it is wrong. Then it is computed from subsets of short windows, and that which closes most of the
samples is taken.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .conditions import Loop
from .least_squares import Observations

WIDE = 0.15  # [m] a gap that neither the prior's lengths nor headings some degrees off explain
MANY_WIDE = 0.05  # share of samples with such gaps, above which subsets are tried
# Windows of a subset, their length [s], and subsets: with the palms apart in half of the phase, in one of 16 subsets
# they touch in all windows.
WINDOWS, WINDOW_S, SUBSETS = 4, 2.5, 60
SCORED = 120  # samples by which a guess is scored


def find_initial_guess(
    observations: Observations, linear: np.ndarray, guess_from: Callable[[Observations], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The initial guess x (m,) of the unknowns, and the weight (n,) of each sample in it: 0 where palms are far apart.

    Parameters
    ----------
    linear : x (m,) from all observations
    guess_from : observations → x (m,), the prior's mean with headings from the closure of these observations
    """
    n, spans = len(observations), [span for _, span in observations.spans()]
    window = max(5, round(WINDOW_S / max(float(np.median(np.diff(observations.data[-1]))), 1e-3)))
    # Where points of the body coincide, these samples tell whether they touch; fixed points may be hardly known.
    joined = np.array([isinstance(c, Loop) and c.kind == "coincide" for c in observations.conditions])
    scored = np.flatnonzero(joined[observations.condition_index]) if joined.any() else np.arange(n)
    few = observations.take(scored[np.linspace(0, len(scored) - 1, min(len(scored), SCORED)).astype(int)])

    def gap_ratios(x: np.ndarray, some: Observations) -> np.ndarray:
        return np.sum(some.gaps(x) ** 2, axis=1) / WIDE**2

    def score(x: np.ndarray) -> float:
        return float(np.mean(np.minimum(gap_ratios(x, few), 1.0)))

    best = linear
    lowest = score(best)
    # A recorded place is the point's at any time: there is no contact that could be lost.
    touching = observations.closed.all() and any(
        c.kind != "recorded" for c in observations.conditions if isinstance(c, Loop)
    )
    if touching and np.mean(gap_ratios(best, few) > 1.0) > MANY_WIDE and n > 2 * WINDOWS * window:
        rng = np.random.default_rng(0)
        windows = [np.array_split(np.arange(n)[span], (span.stop - span.start) // window or 1) for span in spans]
        for _ in range(SUBSETS):
            chosen = [own[k] for own in windows for k in np.sort(rng.choice(len(own), min(WINDOWS, len(own)), False))]
            x = guess_from(observations.take(np.concatenate(chosen)))
            cost = score(x)
            if cost < lowest:
                best, lowest = x, cost
    return best, (1.0 + gap_ratios(best, observations)) ** -2
