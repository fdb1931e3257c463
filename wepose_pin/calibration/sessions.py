"""Several calibrations of one person: what an earlier one knew of lengths and shoulders, fused with a new one.

Most of a calibration's error comes again in the next one: soft tissue follows the joints, and the shoulders leave the
law in the same way. So the new one is solved on the population prior, and the two are fused by covariance intersection,
which holds whatever their errors have in common (Julier and Uhlmann 1997), but for the share of the errors that does
not recur.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..model import BodyTable
from ..model.girdle import PARAMETERS
from ..subject import Subject, girdle_rows

# Share of a calibration's variance that recurs: on simulated people nearly all of it does.
RECURRING = 0.9
SHARES = np.linspace(0.0, 1.0, 21).tolist()  # of the earlier one, of which the best is taken
LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible


def fuse_subjects(earlier: Subject, new: Subject, population: Subject, table: BodyTable) -> Subject:
    """The new subject with lengths and girdles of both; its mounts follow by their correlation.

    Parameters
    ----------
    population : the prior with which both were found
    """
    lengths = tuple(table.lengths)
    x1, x2 = (_shape(subject, table) for subject in (earlier, new))
    least = LEAST_STD**2 * np.eye(len(x1))
    C1, C2, C0 = (subject.shape_covariance(table) + least for subject in (earlier, new, population))
    K1, K2, K0 = (np.linalg.inv(C) for C in (C1, C2, C0))

    def intersect(share: float) -> np.ndarray:
        return np.linalg.inv(share * K1 + (1.0 - share) * K2)

    def spread(share: float) -> float:
        return float(np.trace(intersect(share)[: len(lengths), : len(lengths)]))

    share = min(SHARES, key=spread)
    C = intersect(share)
    x = C @ (share * K1 @ x1 + (1.0 - share) * K2 @ x2)
    # If nothing recurred: what the new one adds to its prior, which counts once.
    value, vector = np.linalg.eigh(K2 - K0)
    independent = np.linalg.inv(K1 + (vector * np.maximum(value, 0.0)) @ vector.T)
    C = RECURRING * C + (1.0 - RECURRING) * independent
    return _replace_shape(new, x, C, x2, C2, table)


def separate_mounts(earlier: Subject, population: Subject) -> Subject:
    """The population prior with the mounts of an earlier calibration."""
    rows = [row for row in earlier.order if row.startswith("mounts.")]
    at, n = [earlier.order.index(row) for row in rows], len(population.order)
    covariance = np.zeros((n + len(rows),) * 2)
    covariance[:n, :n] = population.covariance
    covariance[n:, n:] = earlier.covariance[np.ix_(at, at)]
    order = (*population.order, *rows)
    return replace(population, name=earlier.name, mounts=earlier.mounts, order=order, covariance=covariance)


def _shape(subject: Subject, table: BodyTable) -> np.ndarray:
    """Lengths and girdles' parameters (k + 7 g,)."""
    own = [subject.girdles.get(name, np.zeros(len(PARAMETERS))) for name in table.girdles]
    return np.concatenate(([subject.lengths[name] for name in table.lengths], *own))


def _replace_shape(
    subject: Subject, x: np.ndarray, C: np.ndarray, x_before: np.ndarray, C_before: np.ndarray, table: BodyTable
) -> Subject:
    """The subject with another shape `x` and its covariance; what is correlated with it follows."""
    order = (*table.lengths, *girdle_rows(table))
    missing = [row for row in order if row not in subject.order]
    covariance = np.zeros((len(subject.order) + len(missing),) * 2)
    n = len(subject.order)
    covariance[:n, :n] = subject.covariance
    rows = (*subject.order, *missing)
    at = [rows.index(row) for row in order]
    rest = [k for k in range(len(rows)) if k not in at]
    gain = covariance[np.ix_(rest, at)] @ np.linalg.inv(C_before)
    covariance[np.ix_(rest, rest)] += gain @ (C - C_before) @ gain.T
    covariance[np.ix_(rest, at)] = gain @ C
    covariance[np.ix_(at, rest)] = covariance[np.ix_(rest, at)].T
    covariance[np.ix_(at, at)] = C
    moved = dict(zip([rows[k] for k in rest], gain @ (x - x_before), strict=True))
    mounts = {
        segment: (
            Rotation.from_rotvec([moved.get(f"mounts.{segment}.{axis}", 0.0) for axis in "xyz"])
            * Rotation.from_quat(quat)
        ).as_quat()
        for segment, quat in subject.mounts.items()
    }
    k = len(table.lengths)
    girdles = x[k:].reshape(len(table.girdles), len(PARAMETERS))
    return replace(
        subject,
        lengths=dict(subject.lengths) | dict(zip(table.lengths, x[:k].tolist(), strict=True)),
        girdles=dict(zip(table.girdles, girdles, strict=True)),
        mounts=mounts,
        order=rows,
        covariance=covariance,
    )
