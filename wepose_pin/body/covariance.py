"""The covariance of a body's points, from those of its segments' orientations and of its shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from .body import BodyModel
from .girdle import PARAMETERS
from .lengths import UNIVERSE, LinkVector
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
    covariances: dict[str, np.ndarray] = {}
    points = find_known_points(model, quat_WL)
    if model.table.is_mechanism:
        if not points or q is None or not set(quat_WL) <= set(segment_cov):
            return covariances
        return _propagate_through_joints(model, q, segment_cov, shape_cov, points, heading_cov or {})
    find_parts = _WayParts(model, quat_WL)
    rotated: dict[tuple[Any, ...], np.ndarray] = {}  # what points of a limb share is computed once
    for point in points:
        parts = find_parts(point)
        if not parts or not all(part.segment is None or part.segment in segment_cov for part in parts.values()):
            continue
        columns = [column for part in parts.values() for column in part.columns]
        J = np.concatenate([part.jacobian for part in parts.values()], axis=2)
        # Sample by sample: the bits of one large product would depend on the number of samples.
        cov = J @ shape_cov[np.ix_(columns, columns)] @ J.swapaxes(1, 2)
        vectors: dict[str, np.ndarray] = {}
        for segment in {part.segment: None for part in parts.values() if part.segment is not None}:
            own = [key for key, part in parts.items() if part.segment == segment]
            vectors[segment] = np.sum([parts[key].vector for key in own], axis=0)
            if (segment, *own) not in rotated:
                skew = _build_skew_matrices(vectors[segment])
                rotated[segment, *own] = skew @ segment_cov[segment] @ skew.swapaxes(1, 2)
            cov += rotated[segment, *own]
        for part in parts.values():
            if part.residual is not None:
                cov += part.residual
        for (near, far), shared in (heading_cov or {}).items():
            if near in vectors and far in vectors:
                _add_shared_heading(cov, vectors[near], vectors[far], shared)
        covariances[point] = cov
    return covariances


class _Part(NamedTuple):
    """A part of the way from the root to a point, which rotates with a measured segment."""

    segment: str | None  # None: rigid with the root
    vector: np.ndarray  # (n, 3) [m] in W
    columns: Sequence[int]  # of the shape's parameters that change it
    jacobian: np.ndarray  # (n, 3, c) of the vector by these
    residual: np.ndarray | None = None  # (n, 3, 3) [m²] in W by which it leaves what the shape says


class _WayParts:
    """The parts of the ways to a person's points; equal parts of several points are one."""

    def __init__(self, model: BodyModel, quat_WL: Mapping[str, np.ndarray]) -> None:
        self._model, self._lengths = model, np.array(list(model.lengths.values()))
        self._R_WL = {name: Rotation.from_quat(quat).as_matrix() for name, quat in quat_WL.items()}
        self._motions = move_girdles(model, self._R_WL)
        self._parts: dict[tuple[Any, ...], _Part] = {}

    def __call__(self, point: str) -> dict[tuple[Any, ...], _Part]:
        """Return the parts of the way to a point; empty where a link on it follows no measured segment."""
        keys: list[tuple[Any, ...]] = []
        for link, part in self._model.reaches[point].items():
            carrier = None if link == UNIVERSE else find_carrier(self._model, link, self._R_WL)
            if carrier is None and link != UNIVERSE:
                return {}
            keys.append((link, part.by_length.tobytes(), part.constant.tobytes()))
            if keys[-1] not in self._parts:
                self._parts[keys[-1]] = self._express_link(link, part, carrier)
        for name in self._model.point_girdles[point]:
            if name not in self._motions:
                return {}
            keys.append((name,))
            if keys[-1] not in self._parts:
                self._parts[keys[-1]] = self._express_girdle(name)
        return {key: self._parts[key] for key in keys}

    def _express_link(self, link: str, part: LinkVector, carrier: str | None) -> _Part:
        columns = np.flatnonzero(part.by_length.any(axis=0))
        R_WK = np.broadcast_to(np.eye(3), (len(next(iter(self._R_WL.values()))), 3, 3))
        if carrier is not None:
            R_WK = self._R_WL[carrier]
            R_CK = self._model.neutral_rotations[carrier].T @ self._model.neutral_rotations[link]
            if not np.allclose(R_CK, np.eye(3), atol=1e-12):
                R_WK = R_WK @ R_CK
        vector = R_WK @ (part.by_length @ self._lengths + part.constant)
        return _Part(carrier, vector, columns.tolist(), R_WK @ part.by_length[:, columns])

    def _express_girdle(self, name: str) -> _Part:
        girdle, motion = self._model.table.girdles[name], self._motions[name]
        first = len(self._lengths) + len(PARAMETERS) * list(self._model.table.girdles).index(name)
        R_on = self._R_WL[girdle.on]
        vector = np.einsum("nij,nj->ni", R_on, motion.displacement)
        residual = (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
        return _Part(girdle.on, vector, range(first, first + len(PARAMETERS)), R_on @ motion.jacobian, residual)


def _propagate_through_joints(
    model: BodyModel,
    q: np.ndarray,
    segment_cov: Mapping[str, np.ndarray],
    lengths_cov: np.ndarray,
    points: Sequence[str],
    heading_cov: Mapping[tuple[str, str], np.ndarray],
) -> dict[str, np.ndarray]:
    """Compute the covariances of a mechanism's points in `q` (n, nq), as `compute_point_covariances`.

    The fit turns errors δ of the orientations into errors J⁺ δ of the joints, with J the Jacobian of all orientations.
    """
    m, data, k = model.pin, model.pin.createData(), len(segment_cov)
    if lengths_cov.any() and _slides(model):
        return {}
    segments = [m.getFrameId(segment) for segment in segment_cov]
    frames = [m.getFrameId(model.point_frames[point]) for point in points]
    cov_W = np.stack(list(segment_cov.values()), axis=1)  # (n, k, 3, 3)
    shared, order = np.zeros((len(q), k, k)), list(segment_cov)
    for (near, far), cov in heading_cov.items():
        shared[:, order.index(near), order.index(far)] = shared[:, order.index(far), order.index(near)] = cov
    by_length = [_find_length_vectors(model, data, point) if lengths_cov.any() else [] for point in points]
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
            if by_length[i]:
                along = sum(R_WK @ part for R_WK, part in by_length[i])
                out[i, row] += along @ lengths_cov @ along.T
    return dict(zip(points, out, strict=True))


def _slides(model: BodyModel) -> bool:
    """Whether a joint that slides moves some point: its way has no constant parts link by link."""
    frames = [model.pin.frames[model.pin.getFrameId(link)] for link in model.point_frames.values()]
    above = {joint for frame in frames for joint in model.pin.supports[frame.parentJoint]}
    return any(model.pin.joints[joint].shortname().startswith("JointModelP") for joint in above if joint)


def _find_length_vectors(model: BodyModel, data: pin.Data, point: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Find the links whose part of the way to a point depends on lengths: a view of their rotation, and the part."""
    m = model.pin
    return [
        (
            data.oMf[m.getFrameId(link)].rotation if m.existFrame(link) else data.oMi[m.getJointId(link)].rotation,
            part.by_length,
        )
        for link, part in model.reaches[point].items()
        if part.by_length.any()
    ]


def _add_shared_heading(cov: np.ndarray, near: np.ndarray, far: np.ndarray, shared: np.ndarray) -> None:
    """Add to `cov` (n, 3, 3) [m²] that the headings of two vectors (n, 3) [m] in W covary by `shared` (n,) [rad²].

    A heading error ε moves the end of a vector by ε e_z × v.
    """
    cross = -shared * (near[:, 1] * far[:, 0] + near[:, 0] * far[:, 1])
    cov[:, 0, 0] += 2.0 * shared * near[:, 1] * far[:, 1]
    cov[:, 1, 1] += 2.0 * shared * near[:, 0] * far[:, 0]
    cov[:, 0, 1] += cross
    cov[:, 1, 0] += cross


def _build_skew_matrices(v: np.ndarray) -> np.ndarray:
    """Build the matrices [v]× (n, 3, 3) of vectors (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - out.swapaxes(1, 2)


def compute_axis_std(cov: np.ndarray) -> np.ndarray:
    """Compute the standard deviation (n,) per axis of covariances (n, 3, 3): root of the mean variance."""
    return np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3.0)
