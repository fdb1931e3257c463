"""The error budget: the contribution of each source of error to the standard deviation of each point.

The contributions add up in variance. They are independent of one another but for lengths and girdles, whose
correlation goes to the lengths, and the headings of segments, whose correlations go to the parts of the sensors, in
proportion to these.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..body.covariance import compute_point_covariances
from ..body.soft_tissue import correct_table
from .result import TrackResult
from .segment_orientations import compute_soft_tissue_covariances

PERIOD_S = 1.0  # [s] from one sample to the next
SOFT_TISSUE, SENSOR, LENGTHS, GIRDLES = "soft tissue", "sensor, mount, start pose", "lengths", "shoulder girdle"
CORRELATED = "what correlated headings add"


class ErrorBudget:
    """Accumulates the error budget of a recording, chunk by chunk."""

    def __init__(self) -> None:
        self._sums: dict[str, dict[str, float]] = {}  # point → part → sum over samples [m²], mean of the axes
        self._samples = self._received = 0

    def add(self, tracked: TrackResult) -> None:
        """Add a chunk; whatever the chunks, the samples are the same."""
        stride = max(1, round(PERIOD_S * tracked.recording.rate_hz))
        rows = np.arange(-self._received % stride, len(tracked.time), stride)
        self._received += len(tracked.time)
        pose, body = tracked.pose, tracked.model
        for known in (*pose.quat_WL.values(), *pose.segment_cov.values()):
            rows = rows[np.isfinite(known[rows].sum(axis=tuple(range(1, known.ndim))))]
        if body.table.is_mechanism or not pose.point_cov or not len(rows):
            return
        quat_WL = {name: quat[rows] for name, quat in pose.quat_WL.items()}
        total = {name: cov[rows] for name, cov in pose.segment_cov.items()}
        zero = {name: np.zeros_like(cov) for name, cov in total.items()}
        shape_cov = tracked.subject.shape_covariance(body.table)
        of_girdles = shape_cov.copy()
        k = len(body.lengths)
        of_girdles[:k], of_girdles[:, :k] = 0.0, 0.0

        def variances(segment_cov: Mapping[str, np.ndarray], shape: np.ndarray) -> dict[str, np.ndarray]:
            covs = compute_point_covariances(body, quat_WL, segment_cov, shape)
            return {point: np.trace(cov, axis1=1, axis2=2) / 3.0 for point, cov in covs.items()}

        exact = variances(zero, 0.0 * shape_cov)  # what leaves the law of the girdles
        with_girdles = variances(zero, of_girdles)
        parts = {GIRDLES: with_girdles, LENGTHS: _subtract(variances(zero, shape_cov), with_girdles)}
        soft = compute_soft_tissue_covariances(correct_table(body.table, body.tissue_means), quat_WL)
        for name in total:
            own_soft = variances({**zero, name: soft[name]}, 0.0 * shape_cov)
            both = variances({**zero, name: total[name]}, 0.0 * shape_cov)
            parts[f"{name}: {SOFT_TISSUE}"] = _subtract(own_soft, exact)
            parts[f"{name}: {SENSOR}"] = _subtract(both, own_soft)
        parts[CORRELATED] = {
            point: np.trace(pose.point_cov[point][rows], axis1=1, axis2=2) / 3.0 - independent
            for point, independent in variances(total, shape_cov).items()
        }
        for part, by_point in parts.items():
            for point, values in by_point.items():
                sums = self._sums.setdefault(point, {})
                sums[part] = sum(values.tolist(), sums.get(part, 0.0))  # one by one, whatever the chunks
        self._samples += len(rows)

    def summarize(self) -> dict[str, dict[str, float]]:
        """Point → part → its share of the standard deviation [m] per axis, root mean square; the largest first.

        Parts below a tenth of a millimetre are left out.
        """
        budget = {}
        for point, sums in self._sums.items():
            sensors = sum(value for part, value in sums.items() if part.endswith(SENSOR))
            ratio = 1.0 + sums[CORRELATED] / sensors if sensors else 1.0
            shares = {part: value * (ratio if part.endswith(SENSOR) else 1.0) for part, value in sums.items()}
            std = {part: float(np.sqrt(max(share, 0.0) / self._samples)) for part, share in shares.items()}
            ordered = sorted(std.items(), key=lambda item: -item[1])
            budget[point] = {part: value for part, value in ordered if value >= 1e-4 and part != CORRELATED}
        return budget


def _subtract(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {point: value - b[point] for point, value in a.items()}


def group_by_source(parts: Mapping[str, float]) -> dict[str, float]:
    """Source → its share of a point's standard deviation, of all segments together, and of all sources as "all"."""
    groups = dict.fromkeys((SOFT_TISSUE, SENSOR, LENGTHS, GIRDLES), 0.0)
    for part, std in parts.items():
        groups[part.rpartition(": ")[2]] += std**2
    return {source: float(np.sqrt(value)) for source, value in {**groups, "all": sum(groups.values())}.items()}
