"""Agreement of two methods of measurement: Bland and Altman's limits, and the intraclass correlation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LIMITS = 1.96  # standard deviations of the differences, in which 95 % of them are where they are normal


class Agreement(NamedTuple):
    """Agreement of an angle with the reference's [deg], sample by sample (Bland and Altman 1986).

    The samples of a recording follow each other closely: limits and correlation describe this recording, and are no
    statistics of as many independent draws.
    """

    bias: float  # mean difference, estimated less true
    std: float  # of the differences
    lower: float  # limits of agreement, bias ± 1.96 std
    upper: float
    rmse: float
    icc: float  # ICC(A,1): two-way, absolute agreement, single measurement
    range: float  # of the reference, largest less smallest


def compute_agreement(estimated: np.ndarray, true: np.ndarray) -> Agreement:
    """Compute the agreement of n values (n,) [deg] with a reference's (n,)."""
    difference = estimated - true
    bias, std = float(difference.mean()), float(difference.std(ddof=1)) if len(difference) > 1 else np.nan
    rmse = float(np.sqrt(np.mean(difference**2)))
    icc = compute_icc(np.column_stack([estimated, true]))
    return Agreement(bias, std, bias - LIMITS * std, bias + LIMITS * std, rmse, icc, float(np.ptp(true)))


def compute_icc(ratings: np.ndarray) -> float:
    """Compute ICC(A,1) of n subjects by k raters (n, k): McGraw and Wong 1996, the ICC(2,1) of Shrout and Fleiss 1979.

    NaN where nothing varies.
    """
    n, k = ratings.shape
    if n < 2:
        return float("nan")
    mean = ratings.mean()
    rows = k * ((ratings.mean(axis=1) - mean) ** 2).sum() / (n - 1)
    columns = n * ((ratings.mean(axis=0) - mean) ** 2).sum() / (k - 1)
    rest = ratings - ratings.mean(axis=1, keepdims=True) - ratings.mean(axis=0) + mean
    error = (rest**2).sum() / ((n - 1) * (k - 1))
    spread = rows + (k - 1) * error + k * (columns - error) / n
    return float((rows - error) / spread) if spread > 0.0 else float("nan")
