"""Orientations and points at other times, interpolated between known samples; NaN beyond these and in long gaps."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

LONGEST_GAP_S = 0.1  # [s] between known samples, or twice their usual step, beyond which nothing is interpolated
_ROUNDING_S = 1e-9  # [s] by which equal times may differ


def sample_orientations(time: np.ndarray, quat: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return orientations (m, 4) of times (m,) [s] at other times (n,), interpolated on the rotation: (n, 4)."""
    good = np.isfinite(quat).all(axis=1)
    known, spanned = time[good], _is_spanned(time[good], at)
    sampled = np.full((len(at), 4), np.nan)
    if spanned.any():
        clipped = np.clip(at[spanned], known[0], known[-1])
        sampled[spanned] = Slerp(known, Rotation.from_quat(quat[good]))(clipped).as_quat()
    return sampled


def sample_points(time: np.ndarray, points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return points (m, 3) of times (m,) [s] at other times (n,), linear between samples: (n, 3)."""
    good = np.isfinite(points).all(axis=1)
    known, spanned = time[good], _is_spanned(time[good], at)
    sampled = np.full((len(at), 3), np.nan)
    if spanned.any():
        sampled[spanned] = np.column_stack([np.interp(at[spanned], known, axis) for axis in points[good].T])
    return sampled


def _is_spanned(known: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mask of the times between two known ones that are not far apart, or on one."""
    if len(known) < 2:
        return np.zeros(len(at), dtype=bool)
    after = np.clip(np.searchsorted(known, at - _ROUNDING_S), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, at + _ROUNDING_S, side="right") - 1, 0, len(known) - 1)
    spanned = (known[before] <= at + _ROUNDING_S) & (known[after] >= at - _ROUNDING_S)
    return spanned & (known[after] - known[before] <= max(LONGEST_GAP_S, 2.0 * float(np.median(np.diff(known)))))
