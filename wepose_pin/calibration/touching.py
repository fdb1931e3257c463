"""Which looks have the palms together, and headings from those alone.

The linear start weighs every look alike: where the hands are apart for a good part of the phase, its headings are those
of no closed chain. Then it is made from subsets of short windows, and the one that closes most of the looks is kept.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .problem import Looks, residuals

# A gap [m] that neither an average person's lengths nor headings some degrees off explain.
WIDE = 0.15
# A share of looks wider apart than that, from which on the start is looked for in subsets.
MANY_WIDE = 0.05
# Windows of a subset, their length [s], and subsets: with half of the phase apart one in 16 has none of it.
WINDOWS, WINDOW_S, SUBSETS = 4, 2.5, 60
SCORED = 120  # looks on which a start is scored


def touching_start(looks: Looks, place: Callable[[Looks], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A start x (m,) and the weight (n,) of each look's gap in it, near 0 where the palms are apart.

    Parameters
    ----------
    place : looks → x (m,), what is known before, with headings from the closure of these looks
    """
    n = looks.data.shape[1]
    window = max(5, round(WINDOW_S / max(float(np.median(np.diff(looks.data[-1]))), 1e-3)))
    few = looks.take(np.linspace(0, n - 1, min(n, SCORED)).astype(int))

    def wide(x: np.ndarray, at: Looks) -> np.ndarray:
        return np.sum(residuals(x, at)[2] ** 2, axis=1) / WIDE**2

    def score(x: np.ndarray) -> float:
        return float(np.mean(np.minimum(wide(x, few), 1.0)))

    best = place(looks)
    lowest = score(best)
    if looks.closed.all() and np.mean(wide(best, few) > 1.0) > MANY_WIDE and n > 2 * WINDOWS * window:
        rng = np.random.default_rng(0)
        windows = np.array_split(np.arange(n), n // window)
        for _ in range(SUBSETS):
            chosen = rng.choice(len(windows), WINDOWS, replace=False)
            columns = np.concatenate([windows[k] for k in np.sort(chosen)])
            x = place(looks.take(columns))
            found = score(x)
            if found < lowest:
                best, lowest = x, found
    return best, (1.0 + wide(best, looks)) ** -2
