"""What the looks are worth: their weights, how many independent ones they are, and the covariance of what they tell.

The weight of the data is measured, not assumed: the residual's own mean square sets its variance and its
autocorrelation the number of independent samples, in a few rounds of Gauss-Newton. Looks at which the palms were apart
stand out of the rest and lose their weight.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..subject import LENGTHS, mount_rows
from .chain import SIDES
from .problem import Fit, K, Layout, Looks, solve
from .protocols import Closure

# Residual variance, in units of the weights', that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
# Errors of orientations are slow: two looks closer than this [s] are never independent, however white the residual
# looks in one phase. Found on simulated people, whose joint errors it brings within what the covariance says.
LEAST_CORRELATION_S = 3.0
THIRD_CHI2 = {1: 0.1485, 3: 1.4237}  # what 30 % of chi² with so many degrees stay below
ROUNDS = 5
MANY_LOOKS = 1000  # from twice as many on, all rounds but the last are made with every second, third, … look
QUICK_ROUNDS, QUICK_STEPS = 1, 15
# A look whose gap is this many times the usual is one at which the palms were apart.
APART = 5.0
TOUCHED = 0.1  # of a look's weight
SURE = 0.4  # below it the look is left out altogether, once the fit is about right
CONTRADICTED = 3.0  # standard deviations of a taped length from what is known without it, from which on it is doubted


class Tape(NamedTuple):
    """A measured length beside what all the rest says of it: the motion, the average person, other tapes."""

    metres: float  # [m] as measured
    expected: float  # [m] without it
    std: float  # [m] of that
    measured_std: float  # [m]

    @property
    def off(self) -> float:
        """By how many standard deviations the two differ."""
        return abs(self.metres - self.expected) / float(np.hypot(self.std, self.measured_std))


def weighed(
    looks: Looks, center: np.ndarray, information: np.ndarray, start: np.ndarray, touching: np.ndarray, quick: bool
) -> tuple[Fit, np.ndarray, np.ndarray, float]:
    """The fit, the weights (n, 5), the weight (n,) that each look's gap kept, how many independent looks it is worth.

    Gap and hinges are weighed by their own residuals: variance, and how long it stays correlated.
    """
    n = looks.data.shape[1]
    closed, rounds, least = looks.closed, range(QUICK_ROUNDS if quick else ROUNDS), _least(looks)
    if n >= 2 * MANY_LOOKS and closed.any() and not quick:
        few = np.concatenate([np.arange(n)[span][:: n // MANY_LOOKS] for _, span in looks.spans()])
        fit, _, kept, _ = weighed(looks.take(few), center, information, start, touching[few], quick)
        start, touching, rounds = fit.x, np.interp(np.arange(n), few, kept), rounds[-1:]
    x: np.ndarray | Fit = start
    kept = touching.copy()
    steps = QUICK_STEPS if quick else 60
    weights = np.full((n, 5), 1.0 / least)
    weights[:, :3] *= kept[:, None]
    if quick:
        weights[:, 3:] = 0.0
    independent = float(closed.sum())
    for condition, span in looks.spans():
        if not isinstance(condition, Closure):
            weights[span] = 1.0 / (span.stop - span.start)  # as it was held, it was held: one look altogether
    if not closed.any():
        return solve(looks, center, information, weights, x, steps, not quick), weights, kept, independent
    for k in rounds:
        x = fit = solve(looks, center, information, weights, x, steps, strict=False)  # these weights are not the last
        independent = 0.0
        for closure, span in looks.spans():
            if isinstance(closure, Closure):
                r = fit.closure[span, : closure.rows]
                size = np.sum(r**2, axis=1)
                # The lower third: the palms may be apart for half of the phase and more.
                usual = max(float(np.quantile(size, 0.3)) / THIRD_CHI2[closure.rows], LEAST_VARIANCE)
                weight = (1.0 + size / (usual * APART**2 * closure.rows)) ** -2
                kept[span] = np.where(weight > (SURE if k > 1 else TOUCHED), weight, 0.0)
                weights[span, :3] = _weights(r, kept[span], least)
                independent += float(kept[span].sum()) / _correlated(r * kept[span, None], least)
        arms = [SIDES.index(side) for side in looks.layout.arms]
        if arms and not quick:
            weights[closed, 3:] = _weights(fit.hinge[closed][:, arms], np.ones(int(closed.sum())), least)
    return solve(looks, center, information, weights, x, steps, not quick), weights, kept, independent


def _weights(r: np.ndarray, kept: np.ndarray, least: float) -> np.ndarray:
    """Weights (n, 1) of residuals (n, k): what each look kept, over variance and looks to an independent one."""
    variance = max(float(np.sum(kept * np.sum(r**2, axis=1))) / (r.shape[1] * float(kept.sum())), LEAST_VARIANCE)
    return kept[:, None] / (_correlated(r * kept[:, None], least) * variance)


def _least(looks: Looks) -> float:
    """How many looks `LEAST_CORRELATION_S` is."""
    return LEAST_CORRELATION_S / max(float(np.median(np.diff(looks.data[-1]))), 1e-3)


def _correlated(r: np.ndarray, least: float) -> float:
    """How many looks make one independent one."""
    return max(_correlation_time(r), least)


def _correlation_time(r: np.ndarray) -> float:
    """How many samples of `r` (n, 3) make one independent one: 1 + 2 Σ ρ, summed to the first crossing of zero."""
    n = len(r)
    centred = r - r.mean(axis=0)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(centred, size, axis=0)) ** 2
    rho = np.fft.irfft(spectrum, size, axis=0)[:n].sum(axis=1)
    if not rho[0] > 0.0:
        return 1.0
    rho = rho / rho[0]
    crossing = int(np.argmax(rho <= 0.0)) if np.any(rho <= 0.0) else n
    return float(1.0 + 2.0 * rho[1:crossing].sum())


def covariance_of(looks: Looks, fit: Fit, before: np.ndarray, weights: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Covariance of x: what errors that stay for a while do to this fit.

    The weights count as many looks for one as the errors last. That is what they are worth where the motion is as slow
    as the errors; where it turns through a good part of its reach meanwhile, an error pulls at other unknowns from look
    to look, and cancels. So the gradient's covariance is that of sums over windows of the errors' duration,
    C (Λ + Σ (Σ w J)ᵀ σ² (Σ w J) / duration) C, as of Newey and West 1987 with their triangle of weights.
    """
    C = np.linalg.inv(fit.information)
    J, r, least = fit.jacobian, np.hstack((fit.closure, fit.hinge)), _least(looks)
    weights = np.broadcast_to(weights, r.shape)
    arms = [3 + SIDES.index(side) for side in looks.layout.arms]
    gradient = before.copy()
    for condition, span in looks.spans():
        parts = [(list(range(condition.rows)), kept[span])]
        if isinstance(condition, Closure):
            parts += [(arms, np.ones(span.stop - span.start))] if arms else []
        for rows, share in parts:
            slope, w = J[span][:, rows], weights[span][:, rows]
            pull = w[:, :, None] * slope
            if not isinstance(condition, Closure):
                gradient += np.einsum("nki,nkj->ij", pull, slope)
                continue
            if not share.sum() > 0.0:
                continue
            # What the fit took out of the residuals is given back to their variance.
            size = np.sum(r[span][:, rows] ** 2, axis=1) + np.einsum("nki,ij,nkj->n", slope, C, slope, optimize=True)
            variance = max(float(share @ size) / (len(rows) * float(share.sum())), LEAST_VARIANCE)
            lasts = round(_correlated(r[span][:, rows] * share[:, None], least))
            summed = np.concatenate((np.zeros((1, *pull.shape[1:])), np.cumsum(pull, axis=0)))
            ends = np.arange(1, len(pull) + lasts)
            windows = summed[np.minimum(ends, len(pull))] - summed[np.maximum(ends - lasts, 0)]
            windows = windows.reshape(-1, C.shape[0])
            gradient += variance / lasts * windows.T @ windows
    return C @ gradient @ C


def taped(fit: Fit, layout: Layout, measured: Mapping[str, tuple[float, float]]) -> dict[str, Tape]:
    """Each measured length or distance, name → ([m], its standard deviation [m]), beside the solution without it."""
    C, found = np.linalg.inv(fit.information), {}
    rows = dict(zip(LENGTHS, range(K), strict=True)) | dict(
        zip(layout.gauges, range(layout.size)[layout.distances], strict=True)
    )
    for name, (metres, std) in measured.items():
        variance = C[rows[name], rows[name]]
        rest = 1.0 / variance - 1.0 / std**2  # information, what is left where the tape's is taken out
        expected = metres + (fit.x[rows[name]] - metres) / (variance * rest)
        found[name] = Tape(metres, float(expected), float(rest**-0.5), std)
    return found


def handed_on(layout: Layout, covariance: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
    """Lengths and mount errors of x's covariance, with their names: R_LS = exp(−ε) Rz(ψ) R_VS(start)."""
    rows = [row for name in layout.sensors for row in mount_rows(name)]
    take = np.zeros((K + len(rows), layout.size))
    take[:K, :K] = np.eye(K)
    for i in range(len(layout.sensors)):
        take[K + 3 * i, layout.tilt.start + 2 * i] = -1.0
        take[K + 3 * i + 1, layout.tilt.start + 2 * i + 1] = -1.0
        take[K + 3 * i + 2, layout.heading.start + i] = 1.0
    return (*LENGTHS, *rows), take @ covariance @ take.T


def learned_of(fit: Fit, layout: Layout, weights: np.ndarray, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Which share of what is known each look brought: C = C (Σ Jᵀ W J + Λ) C, over C, is a sum to 1."""
    unit = np.eye(layout.size)
    of = dict(zip(LENGTHS, unit[:K], strict=True))
    of |= {f"{s}_forearm + {s}_hand": of[f"{s}_forearm"] + of[f"{s}_hand"] for s in SIDES}
    for i, name in enumerate(layout.sensors):
        rows = (layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i)
        of |= dict(zip(mount_rows(name), unit[list(rows)], strict=True))
    T = np.array(list(of.values()))
    moved = fit.jacobian @ covariance @ T.T  # (n, 5, k)
    share = np.einsum("ni,nik->kn", weights, moved**2) / np.einsum("ki,ij,kj->k", T, covariance, T)[:, None]
    return dict(zip(of, share, strict=True))
