"""Where links are: forward kinematics by Pinocchio, which of them follow from the measured segments, and how well."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadModel
from ..rotations import unwrap_signs
from .body import BodyModel
from .girdle import MEAN_RAISED, PARAMETERS, follow_law
from .tree import UNIVERSE

_DETERMINED = 1e-9  # [m/rad or rad/rad] by which open motions may move what is determined: rounding
_OPEN = 1e-3  # share of an open motion from which a joint counts as undetermined
_SINGULAR = 1e-6  # singular value of a Jacobian, below which a motion is open


def compute_link_poses(
    model: BodyModel, q: np.ndarray, links: Sequence[str], *, rotations: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Compute rotations (n, m, 3, 3), empty without `rotations`, and positions (n, m, 3) [m] of links in W."""
    data = model.pin.createData()
    frames = [model.pin.getFrameId(link) for link in links]
    # Views of Pinocchio's memory: reading data.oMf[f] for each row costs more than the kinematics.
    p_view = [data.oMf[frame].translation for frame in frames]
    R_view = [data.oMf[frame].rotation for frame in frames] if rotations else []
    R = np.empty((len(q), len(R_view), 3, 3))
    p = np.empty((len(q), len(frames), 3))
    for k, row in enumerate(np.ascontiguousarray(q)):
        pin.framesForwardKinematics(model.pin, data, row)
        for i, view in enumerate(p_view):
            p[k, i] = view
        for i, view in enumerate(R_view):
            R[k, i] = view
    return R, p


def compute_link_placements(
    model: BodyModel, q: np.ndarray, links: Iterable[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compute link → (`quat_WL` (n, 4) xyzw, `p_WL` (n, 3) [m]), for drawing the body."""
    links = list(links)
    R, p = compute_link_poses(model, q, links)
    quat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(len(q), len(links), 4)
    return {link: (unwrap_signs(quat[:, k]), p[:, k]) for k, link in enumerate(links)}


def describe_girdle(model: BodyModel, name: str, segments: Sequence[str]) -> tuple[Any, ...]:
    """Return what `follow_law` needs of a girdle, from `on` to `own`, with orientations of these segments."""
    girdle = model.table.girdles[name]
    moves = segments.index(girdle.moves) if girdle.moves in segments else -1
    along = np.array(model.table.segments[girdle.moves].along)
    scale, own = girdle.find_scale(model.lengths), model.girdle_parameters(name)
    return segments.index(girdle.on), moves, along, girdle.law, scale, own


def move_girdle(
    model: BodyModel, name: str, quat_WL: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute how a girdle moves on a segment with orientations, segment → (n, 4) xyzw.

    Returns
    -------
    displacement : (n, 3) [m] in the frame of `on`
    jacobian : (n, 3, 7) of it by `PARAMETERS`
    residual : (n, 3) [m²] in the frame of `on`, the variance by which the point leaves law and parameters
    """
    girdle, quat = model.table.girdles[name], np.stack(list(quat_WL.values()), axis=1)
    motion, is_known = np.empty((len(quat), 7)), girdle.moves in quat_WL
    follow_law(quat, *describe_girdle(model, name, list(quat_WL)), motion)
    raised = motion[:, 6] if is_known else np.full(len(quat), MEAN_RAISED)
    eye = np.tile(np.eye(3), (len(quat), 1, 1))
    jacobian = np.concatenate((motion[:, 3:6, None], eye, raised[:, None, None] * eye), axis=2)
    residual = np.tile(np.square(girdle.residual_std), (len(quat), 1))
    if not is_known:  # what the law would have said is not known either
        residual += raised[:, None] ** 2 * np.square((girdle.back[1], girdle.middle[0], girdle.up[0]))
    return motion[:, :3], jacobian, residual


def find_carrier(model: BodyModel, link: str, measured: Collection[str]) -> str | None:
    """Find the measured segment with which a link rotates: itself, or above it where it is rigid; None: no such."""
    segment: str | None = link
    while segment is not None and segment not in measured:
        own = model.table.segments.get(segment)
        segment = model.parents[segment] if own is not None and own.rigid_without_sensor else None
    return segment


def find_known_points(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the points that follow from the measured segments: those that no open motion moves."""
    moved = _find_open_motions(model, list(segments), list(model.point_frames.values()))[1][:, :3]
    return [point for point, J in zip(model.point_frames, moved, strict=True) if np.abs(J).max(initial=0) < _DETERMINED]


def find_known_links(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the links whose pose follows from the measured segments; of a mechanism those that carry measured ones."""
    m, segments, links = model.pin, list(segments), [frame.name for frame in model.pin.frames[1:]]
    if model.table.is_mechanism:
        carriers = {m.frames[m.getFrameId(segment)].parentJoint for segment in segments}
        above = {0}.union(*(m.supports[carrier].tolist() for carrier in carriers))
        return [link for link in links if m.frames[m.getFrameId(link)].parentJoint in above]
    moved = _find_open_motions(model, segments, links)[1]
    return [link for link, J in zip(links, moved, strict=True) if np.abs(J).max(initial=0.0) < _DETERMINED]


def find_undetermined_joints(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the joints whose value the orientations of segments leave open, at least in part."""
    m = model.pin
    share = np.linalg.norm(_find_open_motions(model, list(segments), [])[0], axis=1)
    return [m.names[j] for j in range(1, m.njoints) if np.any(share[m.idx_vs[j] : m.idx_vs[j] + m.nvs[j]] > _OPEN)]


def _find_open_motions(
    model: BodyModel, segments: Sequence[str], links: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the motions (nv, k) that rotate no measured segment, and by how much they move and rotate links (m, 6, k).

    Of a person a segment without a sensor is rigid with the one above where the table says so, else its joints are
    open, and joints that set no segment rest. In the configuration no joints stand in line by chance.
    """
    m, rng, free = model.pin, np.random.default_rng(0), set(range(1, model.pin.njoints))
    if not model.table.is_mechanism:
        free = {
            joint
            for name, joints in model.chains.items()
            for joint in joints
            if (model.find_spherical(name) in (None, joint) if name in segments else name in model.table.needed)
        }
    columns = find_columns(m, sorted(free))
    q = pin.integrate(m, pin.neutral(m), rng.uniform(0.2, 0.9, m.nv) * rng.choice([-1.0, 1.0], m.nv))
    data = m.createData()
    pin.computeJointJacobians(m, data, q)
    pin.updateFramePlacements(m, data)

    def compute_jacobians(names: Sequence[str]) -> np.ndarray:
        J = [pin.getFrameJacobian(m, data, m.getFrameId(name), pin.LOCAL_WORLD_ALIGNED) for name in names]
        return np.reshape(J, (len(names), 6, m.nv))[:, :, columns]

    _, s, Vt = np.linalg.svd(compute_jacobians(segments)[:, 3:].reshape(3 * len(segments), -1))
    rank = np.count_nonzero(s > _SINGULAR)
    open_motions = np.zeros((m.nv, len(columns) - rank))
    open_motions[columns] = Vt[rank:].T
    return open_motions, compute_jacobians(links) @ open_motions[columns]


def find_columns(m: pin.Model, joints: Iterable[int]) -> np.ndarray:
    """Find where joints stand in a velocity (nv,)."""
    return np.array([m.idx_vs[joint] + k for joint in joints for k in range(m.nvs[joint])], dtype=int)


def compute_joint_values(m: pin.Model, q: np.ndarray) -> dict[str, np.ndarray]:
    """Compute joint → its value (n,) [rad or m] in configurations (n, nq); only joints of one axis."""
    return {m.names[joint]: q[:, m.idx_qs[joint]].copy() for joint in range(1, m.njoints) if m.nqs[joint] == 1}


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
    R_WL = {name: Rotation.from_quat(quat).as_matrix() for name, quat in quat_WL.items()}
    table, neutral, n = model.table, model.neutral_rotations, len(next(iter(quat_WL.values())))
    lengths, girdles = np.array(list(model.lengths.values())), list(table.girdles)
    moved = {name: move_girdle(model, name, quat_WL) for name in girdles if table.girdles[name].on in R_WL}
    covariances: dict[str, np.ndarray] = {}
    for point in points:
        names, links = model.point_girdles[point], model.reaches[point]
        carriers = {link: UNIVERSE if link == UNIVERSE else find_carrier(model, link, R_WL) or "" for link in links}
        if "" in carriers.values() or not set(names) <= set(moved) or not (links or names):
            continue
        vectors: dict[str, np.ndarray] = {}  # segment → the sum of what rotates with it, (n, 3) [m] in W
        by_lengths = [by_length for by_length, _ in links.values()]
        own = np.flatnonzero(np.concatenate([np.zeros((1, len(lengths))), *by_lengths]).any(axis=0))
        columns, J, off_law = own.tolist(), np.zeros((n, 3, len(own))), np.zeros((n, 3, 3))
        for link, (by_length, constant) in links.items():
            carrier = carriers[link]
            R_WK = np.eye(3) if carrier == UNIVERSE else R_WL[carrier]
            if carrier != link:
                R_WK = R_WK @ (neutral[carrier].T @ neutral[link])
            J += R_WK @ by_length[:, own]
            if carrier != UNIVERSE:
                vectors[carrier] = vectors.get(carrier, 0.0) + R_WK @ (by_length @ lengths + constant)
        for name in names:
            on, first = table.girdles[name].on, len(lengths) + len(PARAMETERS) * girdles.index(name)
            (displacement, jacobian, residual), R_on = moved[name], R_WL[on]
            columns += range(first, first + len(PARAMETERS))
            J = np.concatenate([J, R_on @ jacobian], axis=2)
            vectors[on] = vectors.get(on, 0.0) + np.einsum("nij,nj->ni", R_on, displacement)
            off_law += (R_on * residual[:, None, :]) @ R_on.swapaxes(1, 2)
        if not set(vectors) <= set(segment_cov):
            continue
        # Sample by sample: the bits of one large product would depend on the number of samples.
        cov = J @ shape_cov[np.ix_(columns, columns)] @ J.swapaxes(1, 2)
        for segment, vector in vectors.items():
            skew = np.zeros((n, 3, 3))  # [v]×
            skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = vector.T
            skew = skew - skew.swapaxes(1, 2)
            cov += skew @ segment_cov[segment] @ skew.swapaxes(1, 2)
        for (near, far), shared in heading_cov.items():
            if near in vectors and far in vectors:
                # A heading error ε moves the end of a vector by ε e_z × v.
                a, b = (np.stack([-vectors[name][:, 1], vectors[name][:, 0]], axis=1) for name in (near, far))
                outer = shared[:, None, None] * a[:, :, None] * b[:, None, :]
                cov[:, :2, :2] += outer + outer.swapaxes(1, 2)
        covariances[point] = cov + off_law
    return covariances


def _propagate_through_joints(
    model: BodyModel,
    q: np.ndarray,
    segment_cov: Mapping[str, np.ndarray],
    lengths_cov: np.ndarray,
    points: Sequence[str],
    heading_cov: Mapping[tuple[str, str], np.ndarray],
) -> dict[str, np.ndarray]:
    """Compute the covariances of a mechanism's points: errors δ of the orientations are errors J⁺ δ of the joints."""
    m, data, order = model.pin, model.pin.createData(), list(segment_cov)
    segments, k = [m.getFrameId(segment) for segment in order], len(order)
    frames = [m.getFrameId(model.point_frames[point]) for point in points]
    cov_W = np.stack(list(segment_cov.values()), axis=1)  # (n, k, 3, 3)
    shared = np.zeros((len(q), k, k))
    for (near, far), cov in heading_cov.items():
        shared[:, order.index(near), order.index(far)] = shared[:, order.index(far), order.index(near)] = cov
    try:
        reaches = model.reaches if lengths_cov.any() else {}
    except BadModel:  # a joint slides: the way of a point has no constant parts link by link
        return {}
    ways: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in points]  # views of R_WK, by the lengths
    for way, point in zip(ways, points, strict=True):
        for link, (by_length, _) in reaches.get(point, {}).items():
            frame = data.oMf[m.getFrameId(link)] if m.existFrame(link) else data.oMi[m.getJointId(link)]
            way.append((frame.rotation, by_length))
    out = np.empty((len(points), len(q), 3, 3))
    for row, values in enumerate(np.ascontiguousarray(q)):
        pin.computeJointJacobians(m, data, values)
        pin.updateFramePlacements(m, data)
        J = np.concatenate([pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[3:] for frame in segments])
        inverse = np.linalg.pinv(J, rcond=1e-6)
        for i, frame in enumerate(frames):
            gain = pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3] @ inverse  # (3, 3 k)
            parts = gain.reshape(3, k, 3).swapaxes(0, 1)
            along = np.sum([R_WK @ by_length for R_WK, by_length in ways[i]], axis=0) if ways[i] else np.zeros((3, 0))
            out[i, row] = np.sum(parts @ cov_W[row] @ parts.swapaxes(1, 2), axis=0)
            out[i, row] += parts[:, :, 2].T @ shared[row] @ parts[:, :, 2]
            out[i, row] += along @ lengths_cov[: along.shape[1], : along.shape[1]] @ along.T
    return dict(zip(points, out, strict=True))


def compute_axis_std(cov: np.ndarray) -> np.ndarray:
    """Compute the standard deviation (n,) per axis of covariances (n, 3, 3): root of the mean variance."""
    return np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3.0)
