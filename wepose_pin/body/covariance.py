"""The covariance of a body's points, from those of its segments' orientations and of its shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadModel
from .body import BodyModel
from .girdle import PARAMETERS
from .lengths import UNIVERSE
from .links import find_carrier, find_known_points, move_girdles


def compute_point_covariances(
    model: BodyModel,
    quat_WL: Mapping[str, np.ndarray],
    segment_cov: Mapping[str, np.ndarray],
    shape_cov: np.ndarray,
    q: np.ndarray | None = None,
    heading_cov: Mapping[tuple[str, str], np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Compute the covariance (n, 3, 3) [m²] in W of the known points.

    Only of points for which every segment between root and point has a covariance. A point is the sum of vectors v that
    rotate with segments: an error δ of a segment's orientation moves the point by δ × v, errors of different sensors
    are independent but for their headings, errors of the lengths act along the vectors. A girdle adds the errors of its
    parameters and what leaves its law. The points of a mechanism move with the joints, which the fit takes from all
    orientations.

    Parameters
    ----------
    model : with its lengths
    segment_cov : segment → (n, 3, 3) [rad²] in W
    shape_cov : (k + 7 g, k + 7 g) of the model's lengths and then its girdles' parameters, in the order of the
        table, as `Subject.shape_covariance`; zeros: known exactly
    q : (n, nq) of a mechanism; without it its points have none
    heading_cov : two segments → (n,) [rad²], the covariance of their headings; a pair left out: independent
    """
    points, heading_cov = find_known_points(model, quat_WL), heading_cov or {}
    if model.table.is_mechanism:
        if not points or q is None or not set(quat_WL) <= set(segment_cov):
            return {}
        return _propagate_through_joints(model, q, segment_cov, shape_cov, points, heading_cov)
    covariances: dict[str, np.ndarray] = {}
    rotated: dict[tuple[int, ...], np.ndarray] = {}  # what points of a limb share is computed once
    for point, parts in _find_ways(model, quat_WL, points).items():
        own: dict[str, list[_Part]] = {}  # segment → the parts that rotate with it
        for part in parts:
            if part.segment is not None:
                own.setdefault(part.segment, []).append(part)
        if not parts or not set(own) <= set(segment_cov):
            continue
        columns = [column for part in parts for column in part.columns]
        J = np.concatenate([part.jacobian for part in parts], axis=2)
        # Sample by sample: the bits of one large product would depend on the number of samples.
        cov = J @ shape_cov[np.ix_(columns, columns)] @ J.swapaxes(1, 2)
        vectors = {segment: np.sum([part.vector for part in each], axis=0) for segment, each in own.items()}
        for segment, vector in vectors.items():
            key = tuple(id(part) for part in own[segment])
            if key not in rotated:
                skew = np.zeros((len(vector), 3, 3))  # [v]×
                skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = vector.T
                skew -= skew.swapaxes(1, 2).copy()
                rotated[key] = skew @ segment_cov[segment] @ skew.swapaxes(1, 2)
            cov += rotated[key]
        for part in parts:
            if part.residual is not None:
                cov += part.residual
        for (near, far), shared in heading_cov.items():
            if near in vectors and far in vectors:
                # A heading error ε moves the end of a vector by ε e_z × v.
                x, y, _ = vectors[near].T
                u, v, _ = vectors[far].T
                cross = -shared * (x * v + y * u)
                cov[:, 0, 0] += 2.0 * shared * y * v
                cov[:, 1, 1] += 2.0 * shared * x * u
                cov[:, 0, 1] += cross
                cov[:, 1, 0] += cross
        covariances[point] = cov
    return covariances


class _Part(NamedTuple):
    """A part of the way from the root to a point, which rotates with a measured segment."""

    segment: str | None  # None: rigid with the root
    vector: np.ndarray  # (n, 3) [m] in W
    columns: Sequence[int]  # of the shape's parameters that change it
    jacobian: np.ndarray  # (n, 3, c) of the vector by these
    residual: np.ndarray | None = None  # (n, 3, 3) [m²] in W by which it leaves what the shape says


def _find_ways(
    model: BodyModel, quat_WL: Mapping[str, np.ndarray], points: Sequence[str]
) -> dict[str, tuple[_Part, ...]]:
    """Find the parts of the ways to a person's points; none where one follows no measured segment."""
    R_WL = {name: Rotation.from_quat(quat).as_matrix() for name, quat in quat_WL.items()}
    lengths, neutral = np.array(list(model.lengths.values())), model.neutral_rotations
    n = len(next(iter(quat_WL.values())))
    known: dict[Any, _Part] = {}
    for name, motion in move_girdles(model, R_WL).items():
        girdle = model.table.girdles[name]
        first = len(lengths) + len(PARAMETERS) * list(model.table.girdles).index(name)
        R_on = R_WL[girdle.on]
        residual = (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
        vector = np.einsum("nij,nj->ni", R_on, motion.displacement)
        known[name] = _Part(girdle.on, vector, range(first, first + len(PARAMETERS)), R_on @ motion.jacobian, residual)
    ways: dict[str, tuple[_Part, ...]] = {}
    for point in points:
        keys: list[Any] = []
        for link, (by_length, constant) in model.reaches[point].items():
            keys.append((link, by_length.tobytes(), constant.tobytes()))
            carrier = None if link == UNIVERSE else find_carrier(model, link, R_WL)
            if keys[-1] in known or (carrier is None and link != UNIVERSE):
                continue
            R_WK = np.broadcast_to(np.eye(3), (n, 3, 3)) if carrier is None else R_WL[carrier]
            if carrier is not None and carrier != link:
                R_WK = R_WK @ (neutral[carrier].T @ neutral[link])
            columns = np.flatnonzero(by_length.any(axis=0)).tolist()
            vector = R_WK @ (by_length @ lengths + constant)
            known[keys[-1]] = _Part(carrier, vector, columns, R_WK @ by_length[:, columns])
        keys += model.point_girdles[point]
        ways[point] = tuple(known[key] for key in keys) if set(keys) <= set(known) else ()
    return ways


def _propagate_through_joints(
    model: BodyModel,
    q: np.ndarray,
    segment_cov: Mapping[str, np.ndarray],
    lengths_cov: np.ndarray,
    points: Sequence[str],
    heading_cov: Mapping[tuple[str, str], np.ndarray],
) -> dict[str, np.ndarray]:
    """Compute the covariances of a mechanism's points: errors δ of the orientations are errors J⁺ δ of the joints."""
    m, data, k = model.pin, model.pin.createData(), len(segment_cov)
    segments = [m.getFrameId(segment) for segment in segment_cov]
    frames = [m.getFrameId(model.point_frames[point]) for point in points]
    cov_W = np.stack(list(segment_cov.values()), axis=1)  # (n, k, 3, 3)
    shared, order = np.zeros((len(q), k, k)), list(segment_cov)
    for (near, far), cov in heading_cov.items():
        shared[:, order.index(near), order.index(far)] = shared[:, order.index(far), order.index(near)] = cov
    ways: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in points]  # views of R_WK, by the lengths
    try:
        reaches = model.reaches if lengths_cov.any() else {}
    except BadModel:  # a joint slides: the way of a point has no constant parts link by link
        return {}
    for way, point in zip(ways, points, strict=True):
        for link, part in reaches.get(point, {}).items():
            frame = data.oMf[m.getFrameId(link)] if m.existFrame(link) else data.oMi[m.getJointId(link)]
            way.append((frame.rotation, part.by_length))
    out = np.empty((len(points), len(q), 3, 3))
    for row, values in enumerate(np.ascontiguousarray(q)):
        pin.computeJointJacobians(m, data, values)
        pin.updateFramePlacements(m, data)
        J = np.concatenate([pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[3:] for frame in segments])
        inverse = np.linalg.pinv(J, rcond=1e-6)
        for i, frame in enumerate(frames):
            gain = pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3] @ inverse  # (3, 3 k)
            parts = gain.reshape(3, k, 3).swapaxes(0, 1)
            out[i, row] = np.sum(parts @ cov_W[row] @ parts.swapaxes(1, 2), axis=0)
            out[i, row] += parts[:, :, 2].T @ shared[row] @ parts[:, :, 2]
            if ways[i]:
                along = np.sum([R_WK @ by_length for R_WK, by_length in ways[i]], axis=0)
                out[i, row] += along @ lengths_cov @ along.T
    return dict(zip(points, out, strict=True))


def compute_axis_std(cov: np.ndarray) -> np.ndarray:
    """Compute the standard deviation (n,) per axis of covariances (n, 3, 3): root of the mean variance."""
    return np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3.0)
