"""Two calibrations of one person: what an earlier one knew of lengths and shoulders, fused with a new one.

Most of a calibration's error comes again in the next one: soft tissue follows the joints, and the shoulders leave the
law in the same way. So each is solved on the population prior, and they are fused by covariance intersection, which
holds whatever their errors have in common (Julier and Uhlmann 1997).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..body import BodyTable
from ..body.girdle import PARAMETERS
from ..body.subject import Subject, girdle_rows

LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible


def separate_mounts(earlier: Subject, population: Subject) -> Subject:
    """Return the population prior with the mounts of an earlier calibration."""
    rows = [row for row in earlier.order if row.startswith("mounts.")]
    at = [earlier.order.index(row) for row in rows]
    covariance = block_diag(population.covariance, earlier.covariance[np.ix_(at, at)])
    order = (*population.order, *rows)
    return replace(population, name=earlier.name, mounts=earlier.mounts, order=order, covariance=covariance)


def fuse_calibrations(earlier: Subject, subject: Subject, table: BodyTable) -> Subject:
    """Return the subject with lengths and girdles of an earlier calibration too; its mounts follow by correlation."""
    shape_rows, still = (*table.lengths, *girdle_rows(table)), np.zeros(len(PARAMETERS))
    x, C = [], []
    for each in (earlier, subject):
        own = [each.girdles.get(name, still) for name in table.girdles]
        x.append(np.concatenate(([each.lengths[name] for name in table.lengths], *own)))
        C.append(each.shape_covariance(table) + LEAST_STD**2 * np.eye(len(shape_rows)))
    # The share of each is the larger the less uncertain its lengths are (Niehsen 2002).
    k = len(table.lengths)
    variance = np.array([np.trace(each[:k, :k]) for each in C])
    shares, K = variance[::-1] / variance.sum(), np.linalg.inv(C)
    fused = np.linalg.inv(np.tensordot(shares, K, axes=1))
    mean = fused @ sum(share * each @ own for share, each, own in zip(shares, K, x, strict=True))

    missing = [row for row in shape_rows if row not in subject.order]
    order = [*subject.order, *missing]
    covariance = block_diag(subject.covariance, np.zeros((len(missing), len(missing))))
    at = [order.index(row) for row in shape_rows]
    rest = [i for i in range(len(order)) if i not in at]
    gain = covariance[np.ix_(rest, at)] @ K[1]
    covariance[np.ix_(rest, rest)] += gain @ (fused - C[1]) @ gain.T
    covariance[np.ix_(rest, at)] = gain @ fused
    covariance[np.ix_(at, rest)] = covariance[np.ix_(rest, at)].T
    covariance[np.ix_(at, at)] = fused
    moved = dict(zip([order[i] for i in rest], gain @ (mean - x[1]), strict=True))
    mounts = {}
    for segment, quat in subject.mounts.items():
        turn = [moved.get(f"mounts.{segment}.{axis}", 0.0) for axis in "xyz"]
        mounts[segment] = (Rotation.from_rotvec(turn) * Rotation.from_quat(quat)).as_quat()
    return replace(
        subject,
        lengths=dict(subject.lengths) | dict(zip(table.lengths, mean[:k].tolist(), strict=True)),
        girdles=dict(zip(table.girdles, mean[k:].reshape(-1, len(PARAMETERS)), strict=True)),
        mounts=mounts,
        order=tuple(order),
        covariance=covariance,
    )
