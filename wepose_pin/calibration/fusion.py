"""Two calibrations of one person: what an earlier one knew of lengths and shoulders, fused with a new one.

Most of a calibration's error comes again in the next one: soft tissue follows the joints, and the shoulders leave the
law in the same way. So each is solved on the population prior, and they are fused by covariance intersection, which
holds whatever their errors have in common (Julier and Uhlmann 1997), but for the share of the errors that does not
recur.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from ..body import BodyTable
from ..body.girdle import PARAMETERS
from ..body.subject import Subject, girdle_rows

# Share of a calibration's variance that recurs: on simulated people nearly all of it does.
RECURRING = 0.9
ALIKE = 0.2  # relative variance that is given for alike shares of the two
LEAST_STD = 1e-6  # [m] keeps covariances of what is known exactly invertible


def fuse_calibrations(
    earlier: Subject,
    subject: Subject,
    population: Subject,
    measured: Mapping[str, tuple[float, float]],
    table: BodyTable,
) -> Subject:
    """The subject of a calibration with lengths and girdles of an earlier one too; its mounts follow by correlation.

    Parameters
    ----------
    population : the prior with which both were found
    measured : lengths that were measured beside it, name → value and standard deviation [m]
    """
    lengths = tuple(table.lengths)
    x = [_shape(each, table) for each in (earlier, subject)]
    least = LEAST_STD**2 * np.eye(len(x[0]))
    C = [each.shape_covariance(table) + least for each in (earlier, subject)]
    K, K0 = [np.linalg.inv(each) for each in C], np.linalg.inv(population.shape_covariance(table) + least)
    for name, (_, std) in measured.items():
        if name in lengths:
            K0[lengths.index(name), lengths.index(name)] += std**-2
    shares = _find_shares(K, len(lengths))
    intersection = np.linalg.inv(sum(share * each for share, each in zip(shares, K, strict=True)))
    mean = intersection @ sum(share * each @ own for share, each, own in zip(shares, K, x, strict=True))
    # If nothing recurred: what each adds to their prior, which counts once.
    information = K0.copy()
    for each in K:
        value, vector = np.linalg.eigh(each - K0)
        information += (vector * np.maximum(value, 0.0)) @ vector.T
    fused = RECURRING * intersection + (1.0 - RECURRING) * np.linalg.inv(information)
    return _replace_shape(subject, mean, fused, x[-1], C[-1], table)


def _find_shares(K: Sequence[np.ndarray], lengths: int) -> tuple[float, float]:
    """The shares of two informations in their weighted sum.

    The least of ln(variance of the lengths) + `ALIKE` Σ share ln(share), which is convex: two calibrations that know as
    much have nearly equal shares, so that what does not recur is averaged, and one that knows less has less.
    """

    def cost(share: float) -> float:
        C = np.linalg.inv(share * K[0] + (1.0 - share) * K[1])[:lengths, :lengths]
        return float(np.log(np.trace(C)) + ALIKE * (share * np.log(share) + (1.0 - share) * np.log(1.0 - share)))

    share = float(minimize_scalar(cost, bounds=(1e-9, 1.0 - 1e-9), method="bounded", options={"xatol": 1e-9}).x)
    return share, 1.0 - share


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
