"""Two calibrations of one person: what an earlier one knew of lengths and shoulders, fused with a new one.

Most of a calibration's error comes again in the next one: soft tissue follows the joints, and the shoulders leave the
law in the same way. So each is solved on the population prior, and they are fused by covariance intersection, which
holds whatever their errors have in common (Julier and Uhlmann 1997), but for the share of the errors that does not
recur.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..body import BodyTable
from ..body.girdle import PARAMETERS
from ..body.subject import Subject, girdle_rows

# Share of a calibration's variance that recurs: on simulated people nearly all of it does.
RECURRING = 0.9
LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible


def fuse_calibrations(
    earlier: Subject,
    subject: Subject,
    population: Subject,
    measured: Mapping[str, tuple[float, float]],
    table: BodyTable,
) -> Subject:
    """Return a subject with lengths and girdles of an earlier calibration too; its mounts follow by correlation.

    Parameters
    ----------
    population : the prior with which both were found
    measured : lengths that were measured beside it, name → value and standard deviation [m]
    """
    lengths, both = list(table.lengths), (earlier, subject)
    x = [
        np.concatenate(
            (
                [each.lengths[name] for name in lengths],
                *(each.girdles.get(name, np.zeros(len(PARAMETERS))) for name in table.girdles),
            )
        )
        for each in both
    ]
    least = LEAST_STD**2 * np.eye(len(x[0]))
    C = [each.shape_covariance(table) + least for each in both]
    K, K0 = np.linalg.inv(C), np.linalg.inv(population.shape_covariance(table) + least)
    for name, (_, std) in measured.items():
        if name in lengths:
            K0[lengths.index(name), lengths.index(name)] += std**-2
    # The share of each is the larger the less uncertain its lengths are (Niehsen 2002).
    variance = [float(np.trace(each[: len(lengths), : len(lengths)])) for each in C]
    shares = np.array(variance[::-1]) / sum(variance)
    intersection = np.linalg.inv(np.tensordot(shares, K, axes=1))
    mean = intersection @ sum(share * each @ own for share, each, own in zip(shares, K, x, strict=True))
    # If nothing recurred: what each adds to their prior, which counts once.
    information = K0.copy()
    for each in K:
        value, vector = np.linalg.eigh(each - K0)
        information += (vector * np.maximum(value, 0.0)) @ vector.T
    fused = RECURRING * intersection + (1.0 - RECURRING) * np.linalg.inv(information)
    return _replace_shape(subject, mean, fused, x[-1], C[-1], table)


def separate_mounts(earlier: Subject, population: Subject) -> Subject:
    """Return the population prior with the mounts of an earlier calibration."""
    rows = [row for row in earlier.order if row.startswith("mounts.")]
    at = [earlier.order.index(row) for row in rows]
    covariance = block_diag(population.covariance, earlier.covariance[np.ix_(at, at)])
    order = (*population.order, *rows)
    return replace(population, name=earlier.name, mounts=earlier.mounts, order=order, covariance=covariance)


def _replace_shape(
    subject: Subject, x: np.ndarray, C: np.ndarray, x_before: np.ndarray, C_before: np.ndarray, table: BodyTable
) -> Subject:
    """Return the subject with another shape `x` and its covariance; what is correlated with it follows."""
    order = (*table.lengths, *girdle_rows(table))
    missing = [row for row in order if row not in subject.order]
    rows, unknown = (*subject.order, *missing), np.zeros((len(missing), len(missing)))
    covariance = block_diag(subject.covariance, unknown)
    at = [rows.index(row) for row in order]
    rest = [k for k in range(len(rows)) if k not in at]
    gain = covariance[np.ix_(rest, at)] @ np.linalg.inv(C_before)
    covariance[np.ix_(rest, rest)] += gain @ (C - C_before) @ gain.T
    covariance[np.ix_(rest, at)] = gain @ C
    covariance[np.ix_(at, rest)] = covariance[np.ix_(rest, at)].T
    covariance[np.ix_(at, at)] = C
    moved = dict(zip([rows[k] for k in rest], gain @ (x - x_before), strict=True))
    mounts = {}
    for segment, quat in subject.mounts.items():
        turn = [moved.get(f"mounts.{segment}.{axis}", 0.0) for axis in "xyz"]
        mounts[segment] = (Rotation.from_rotvec(turn) * Rotation.from_quat(quat)).as_quat()
    k = len(table.lengths)
    return replace(
        subject,
        lengths=dict(subject.lengths) | dict(zip(table.lengths, x[:k].tolist(), strict=True)),
        girdles=dict(zip(table.girdles, x[k:].reshape(-1, len(PARAMETERS)), strict=True)),
        mounts=mounts,
        order=rows,
        covariance=covariance,
    )
