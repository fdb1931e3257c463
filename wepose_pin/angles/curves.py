"""Time-normalised curves: each repetition from 0 to 100 % of its time; their mean, deviation and likeness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .euler import count_turns
from .joints import Angles

POINTS = 101  # 0, 1, … 100 %
PERCENT = np.linspace(0.0, 100.0, POINTS)


class MeanCurve(NamedTuple):
    """The curves of one angle over repetitions; NaN where fewer than two, or half of them, are determined."""

    curves: np.ndarray  # (r, POINTS) [rad], NaN where a repetition is not determined
    mean: np.ndarray  # (POINTS,) [rad]
    sd: np.ndarray  # (POINTS,) [rad], between repetitions, with r − 1
    std: np.ndarray  # (POINTS,) [rad], what the pose states for one repetition, root mean square
    n: np.ndarray  # (POINTS,) repetitions that are determined
    cmc: float  # `compute_cmc`


def normalize_time(time: np.ndarray, values: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Return values (n, k) at `POINTS` even times of each span (r, 2) [s], linear between samples: (r, POINTS, k)."""
    curves = np.empty((len(spans), POINTS, values.shape[1]))
    for row, (begin, end) in zip(curves, spans, strict=True):
        at = begin + (end - begin) * PERCENT / 100.0
        for k in range(values.shape[1]):
            row[:, k] = np.interp(at, time, values[:, k])
    return curves


def compute_cmc(curves: np.ndarray) -> float:
    """Return the coefficient of multiple correlation of curves (r, p) of one session, 1 where they are equal.

    Kadaba et al. 1989, "Repeatability of kinematic, kinetic, and electromyographic data in normal adult gait", Journal
    of Orthopaedic Research 7:849–860, its adjusted coefficient within a day. 0 where the curves differ from each other
    by as much as they move; NaN of fewer than two curves, or without a point that all have.
    """
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    r, p = curves.shape
    if r < 2 or p < 2:
        return float("nan")
    within = np.square(curves - curves.mean(axis=0)).sum() / (p * (r - 1))
    total = np.square(curves - curves.mean()).sum() / (r * p - 1)
    return float(np.sqrt(max(0.0, 1.0 - within / total))) if total > 0.0 else float("nan")


def compute_mean_curves(angles: Angles, spans: np.ndarray) -> Mapping[str, tuple[MeanCurve, MeanCurve, MeanCurve]]:
    """Joint → the curves of its three angles over the repetitions `spans` (r, 2) [s]."""
    curves = {}
    for name, joint in angles.joints.items():
        hidden = np.column_stack([joint.hidden(k) for k in range(3)])
        values = normalize_time(angles.time, np.where(hidden, np.nan, joint.values), spans)
        variances = np.full_like(values, np.nan)
        if joint.std is not None:
            variances = normalize_time(angles.time, np.where(hidden, np.nan, joint.std**2), spans)
        one, two, three = (_mean_curve(values[:, :, k], variances[:, :, k]) for k in range(3))
        curves[name] = one, two, three
    return curves


def _mean_curve(curves: np.ndarray, variances: np.ndarray) -> MeanCurve:
    known = np.isfinite(curves)
    means = np.where(known, curves, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    curves = curves - count_turns(means)[:, None]
    n = known.sum(axis=0)
    enough = (n >= 2) & (2 * n >= len(curves))
    mean = np.where(known, curves, 0.0).sum(axis=0) / np.maximum(n, 1)
    sd = np.sqrt(np.where(known, np.square(curves - mean), 0.0).sum(axis=0) / np.maximum(n - 1, 1))
    std = np.sqrt(np.where(known, variances, 0.0).sum(axis=0) / np.maximum(n, 1))
    mean, sd, std = (np.where(enough, each, np.nan) for each in (mean, sd, std))
    return MeanCurve(curves, mean, sd, std, n, compute_cmc(curves))
