"""Soft tissue turns a sensor on its segment: a person's means, which are corrected, and what varies beyond them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..compilation import kernel
from ..rotations import product, rotate_by_vector
from .table import ZERO, BodyTable

# Least squared cosine of half the angle between long axes at which the twist between them counts in full.
LEAST_TWIST_COSINE = 0.1
# Of simulated people: the angle [rad] by which a forearm leaves the plane of its elbow, geometric mean, and how far its
# logarithm scatters. The logarithm of a person's size of soft tissue has a standard deviation among people, assumption.
USUAL_HINGE_STD, HINGE_LOG_STD = np.deg2rad(5.3), 0.25
SCATTER_LOG_STD = 0.5


class TissueMean(NamedTuple):
    """What a segment has turned beyond its sensor, in the mean of one person; about the segment's axes."""

    share: float  # of the means that the table states for tilt and raised arms
    lag: float  # [rad/rad] per angle of twist that the sensor shows
    start: float = 0.0  # [rad] about z in the start pose
    start_std: float = 0.0  # [rad] one standard deviation of `start`
    scatter: float = 1.0  # size of what varies beyond the means, as a share of that among all people


def estimate_scatter(hinge_stds: Collection[float]) -> float:
    """Estimate `TissueMean.scatter` of the angles [rad] by which segments leave their hinges, by empirical Bayes."""
    if not hinge_stds:
        return 1.0
    weight = SCATTER_LOG_STD**2 / (SCATTER_LOG_STD**2 + HINGE_LOG_STD**2)
    return float(np.exp(weight * np.mean(np.log(np.array([*hinge_stds]) / USUAL_HINGE_STD))))


def correct_table(table: BodyTable, means: Mapping[str, TissueMean]) -> BodyTable:
    """Return the table with the standard deviations of soft tissue that remain beyond a person's means."""
    segments = dict(table.segments)
    for name, mean in means.items():
        segment, tissue = segments[name], segments[name].soft_tissue
        terms = (tissue.std, ZERO), (tissue.per_tilt, tissue.mean_per_tilt), (tissue.per_raised, tissue.mean_per_raised)
        std, per_tilt, per_raised = (
            tuple(mean.scatter * np.sqrt(np.maximum(np.square(std) - np.square(own), 0.0))) for std, own in terms
        )
        per_twist = mean.scatter * np.sqrt(max(tissue.per_twist**2 - tissue.mean_per_twist**2, 0.0))
        segments[name] = segment._replace(
            soft_tissue=tissue._replace(std=std, per_tilt=per_tilt, per_twist=per_twist, per_raised=per_raised),
            start_std=(*segment.start_std[:2], mean.start_std),
        )
    return replace(table, segments=segments)


class SoftTissueCorrection:
    """Corrects the orientations of segments by the means of a person's soft tissue, sample by sample.

    Parameters
    ----------
    segments : those with a sensor, in the order of the columns of orientations
    """

    def __init__(self, table: BodyTable, means: Mapping[str, TissueMean], segments: Sequence[str]) -> None:
        columns = {name: k for k, name in enumerate(segments)}
        names = [name for name in table.segments if name in columns and name in means]
        tissues = [table.segments[name].soft_tissue for name in names]
        share = np.array([means[name].share for name in names])[:, None]
        raised = np.reshape([[segment in each.raised for segment in segments] for each in tissues], (-1, len(segments)))
        self._terms = (
            np.array([columns[name] for name in names], dtype=np.int64),
            np.array([columns.get(table.segments[name].soft_tissue.relative_to, -1) for name in segments], np.int64),
            np.array([table.segments[name].along for name in segments]),
            share * np.array([tissue.mean_per_tilt for tissue in tissues]).reshape(-1, 3),
            raised / np.maximum(1, raised.sum(axis=1, keepdims=True)),
            share * np.array([tissue.mean_per_raised for tissue in tissues]).reshape(-1, 3),
            np.array([means[name].lag for name in names]),
            np.array([means[name].start for name in names]),
        )

    def correct_segments(self, quat_WL: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Return segment → orientations (n, 4) xyzw, of all segments, as `correct`."""
        quats = self.correct(np.stack(list(quat_WL.values()), axis=1))
        return {name: np.ascontiguousarray(quats[:, k]) for k, name in enumerate(quat_WL)}

    def correct(self, quat_WL: np.ndarray) -> np.ndarray:
        """Return the orientations (..., k, 4) xyzw of the segments from those that their sensors show."""
        corrected = quat_WL.copy()
        _correct(corrected.reshape(-1, *quat_WL.shape[-2:]), *self._terms)
        return corrected


@kernel
def _relate(quat, k, below):  # type: ignore[no-untyped-def]
    """Return the orientation of segment k against the one below it, four floats."""
    if below < 0:
        return quat[k, 0], quat[k, 1], quat[k, 2], quat[k, 3]
    b = quat[below]
    return product(-b[0], -b[1], -b[2], b[3], quat[k, 0], quat[k, 1], quat[k, 2], quat[k, 3])


@kernel
def _correct(quats, columns, below, along, per_tilt, raised, per_raised, lag, start):  # type: ignore[no-untyped-def]
    for n in range(len(quats)):
        quat = quats[n]
        for i in range(len(columns)):
            k = columns[i]
            elevation = 0.0
            for j in range(len(along)):
                if raised[i, j] > 0.0:
                    x, y, z, w = _relate(quat, j, below[j])
                    t = x * along[j, 0] + y * along[j, 1] + z * along[j, 2]
                    elevation += raised[i, j] * 2.0 * np.arccos(np.sqrt(min(1.0, t * t + w * w)))
            x, y, z, w = _relate(quat, k, below[k])
            ax, ay, az = along[k, 0], along[k, 1], along[k, 2]
            t = x * ax + y * ay + z * az
            twist = 2.0 * t * w / max(t * t + w * w, LEAST_TWIST_COSINE)
            # The long axis before the tilt, in the segment, less its part along the axis.
            ux, uy, uz = (
                2.0 * (t * x - w * (y * az - z * ay)),
                2.0 * (t * y - w * (z * ax - x * az)),
                2.0 * (t * z - w * (x * ay - y * ax)),
            )
            angle = lag[i] * twist
            rotate_by_vector(
                quat[k],
                per_tilt[i, 0] * (uy * az - uz * ay) + per_raised[i, 0] * elevation + angle * ax,
                per_tilt[i, 1] * (uz * ax - ux * az) + per_raised[i, 1] * elevation + angle * ay,
                per_tilt[i, 2] * (ux * ay - uy * ax) + per_raised[i, 2] * elevation + angle * az + start[i],
            )
