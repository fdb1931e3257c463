"""Two sensors on one segment: each is filtered and aligned by itself, and both are used.

The segment's orientation lies between the two, nearer to the one with the smaller covariance. Their errors by soft
tissue are partly alike, so that two sensors are not taken as more certain than one: the covariance is the mean of both,
with their difference added. How far they differ is a diagnostic.

Headings are corrected by what neighbours share with the first sensor. So the second one's heading follows the first
one's, by their mean difference of the last `FOLLOW_S`, and its own drift is not in the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import SegmentOrientations
from ..compilation import kernel
from ..diagnostics import INFO, WARNING, Diagnostic
from ..recording import Recording
from ..subject import Subject, mount_rows
from .segments import Oriented

MOST_DIFFERENCE = float(np.deg2rad(8.0))  # [rad] rms by which soft tissue lets two sensors differ; assumption
# [s] over which the difference of headings is averaged: long beside soft tissue, short beside a gyroscope's drift
FOLLOW_S = 30.0
UNSTATED_STD = float(np.deg2rad(1.0))  # [rad] of a sensor whose filter has no covariance
E_Z = np.array([0.0, 0.0, 1.0])

Known = tuple[np.ndarray, np.ndarray | None]  # (n, 4) xyzw, and its covariance (n, 3, 3) in W, None: not known


class Estimator(Protocol):
    """Estimates the segment orientations of one sensor a segment: `SegmentEstimator` or `CausalEstimator`."""

    def push(self, chunk: Recording) -> list[Oriented]: ...

    def finish(self) -> list[Oriented]: ...


class DoubledEstimator:
    """Orientation of each segment of a recording some of whose segments bear two sensors; used as `SegmentEstimator`.

    Parameters
    ----------
    first, second : the estimators of recordings with one sensor a segment
    names : segment → name of its second sensor
    follow : the second sensor's heading follows the first one's, which is corrected
    """

    def __init__(self, first: Estimator, second: Estimator, names: Mapping[str, str], *, follow: bool) -> None:
        self.first, self._second, self._names, self._follow = first, second, names, follow
        self._heading = dict.fromkeys(names, 0.0)  # [rad] mean difference at the last sample
        self._squares = dict.fromkeys(names, 0.0)  # [rad²] sums of the differences
        self._samples = 0

    def push(self, chunk: Recording) -> list[Oriented]:
        """Take a chunk; as `SegmentEstimator.push`."""
        second = replace(chunk, sensors={segment: doubled.sensor for segment, doubled in chunk.doubled.items()})
        return self._fuse(self.first.push(chunk), self._second.push(second))

    def finish(self) -> list[Oriented]:
        """Return the samples that are left after the last chunk; as `SegmentEstimator.finish`."""
        return self._fuse(self.first.finish(), self._second.finish())

    def _fuse(self, first: list[Oriented], second: list[Oriented]) -> list[Oriented]:
        fused = []
        for (chunk, a), (_, b) in zip(first, second, strict=True):
            quat_WL, covariance = dict(a.quat_WL), dict(a.covariance_W)
            diagnostics = []
            self._samples += len(chunk)
            for segment, name in self._names.items():
                of_a = (a.quat_WL[segment], a.covariance_W.get(segment))
                of_b = (b.quat_WL[segment], b.covariance_W.get(segment))
                if self._follow:
                    of_b = self._follow_heading(segment, of_a, of_b, chunk.rate_hz)
                quat_WL[segment], cov, angle = fuse_orientations(of_a, of_b)
                if cov is not None:
                    covariance[segment] = cov
                self._squares[segment] += float(np.sum(angle**2))
                rms = float(np.sqrt(self._squares[segment] / self._samples))
                severity = WARNING if rms > MOST_DIFFERENCE else INFO
                facts = {"sensor": name}
                diagnostics.append(Diagnostic("sensors-differ", severity, segment, rms, MOST_DIFFERENCE, facts))
            both: SegmentOrientations = replace(
                a, quat_WL=quat_WL, covariance_W=covariance, diagnostics=(*a.diagnostics, *diagnostics)
            )
            fused.append((chunk, both))
        return fused

    def _follow_heading(self, segment: str, a: Known, b: Known, rate_hz: float) -> Known:
        """Return b with the mean heading of a, and with the variance of a's heading."""
        (quat_a, cov_a), (quat_b, cov_b) = a, b
        share = 1.0 - np.exp(-1.0 / (FOLLOW_S * rate_hz))
        difference = rotations.heading(rotations.multiply(quat_b, rotations.conjugate(quat_a)))
        mean = np.empty(len(difference))
        self._heading[segment] = _average_angle(difference, share, self._heading[segment], mean)
        quat = rotations.multiply(rotations.rotation_about(E_Z, -mean), quat_b)
        if cov_a is None or cov_b is None:
            return quat, cov_b
        to_heading_of_a = np.ones((len(cov_b), 3))
        to_heading_of_a[:, 2] = np.sqrt(cov_a[:, 2, 2] / np.maximum(cov_b[:, 2, 2], 1e-12))
        return quat, to_heading_of_a[:, :, None] * cov_b * to_heading_of_a[:, None, :]


@kernel
def _average_angle(angle, share, mean, means):  # type: ignore[no-untyped-def]
    """Fill `means` (n,) with the exponential mean of angles (n,) [rad] since `mean` without NaN; return the last."""
    for n in range(len(angle)):
        off = angle[n] - mean
        if np.isfinite(off):
            mean += share * (off - 2.0 * np.pi * np.round(off / (2.0 * np.pi)))
        means[n] = mean
    return mean


def fuse_orientations(a: Known, b: Known) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Return the orientation (n, 4) xyzw between two, its covariance (n, 3, 3), and the angle (n,) [rad] between them.

    Parameters
    ----------
    a, b : `quat_WL` (n, 4) xyzw, and its covariance (n, 3, 3) [rad²] in W, None where it is not known
    """
    (quat_a, cov_a), (quat_b, cov_b) = a, b
    R_a = Rotation.from_quat(quat_a)
    difference = (Rotation.from_quat(quat_b) * R_a.inv()).as_rotvec()  # in W, from a to b
    var_a, var_b = (
        np.full(len(quat_a), UNSTATED_STD**2) if cov is None else np.trace(cov, axis1=1, axis2=2) / 3.0
        for cov in (cov_a, cov_b)
    )
    share = var_a / np.maximum(var_a + var_b, 1e-12)  # of b
    quat = (Rotation.from_rotvec(share[:, None] * difference) * R_a).as_quat()
    covariance = None
    if cov_a is not None and cov_b is not None:
        w = share[:, None, None]
        outer = np.einsum("ni,nj->nij", difference, difference)
        covariance = (1.0 - w) * cov_a + w * cov_b + w * (1.0 - w) * outer
    return quat, covariance, np.linalg.norm(difference, axis=1)


def rename_mounts(subject: Subject | None, names: Mapping[str, str]) -> Subject | None:
    """Return the subject with the mounts of the second sensors in place of the first ones, under their segments."""
    if subject is None:
        return None
    new = {
        row: own
        for segment, name in names.items()
        for row, own in zip(mount_rows(name), mount_rows(segment), strict=True)
    }
    mounts = {segment: subject.mounts[name] for segment, name in names.items() if name in subject.mounts}
    kept = [k for k, row in enumerate(subject.order) if row in subject.lengths or row in new]
    return replace(
        subject,
        mounts=mounts,
        order=tuple(new.get(subject.order[k], subject.order[k]) for k in kept),
        covariance=subject.covariance[np.ix_(kept, kept)],
        doubled={},
        start_pose_offset={},
        heading_drift={},
        hinges={},
    )
