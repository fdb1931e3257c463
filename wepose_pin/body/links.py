"""Where links are: forward kinematics by Pinocchio, and which of them follow from the measured segments."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..rotations import unwrap_signs
from .body import BodyModel
from .girdle import MEAN_RAISED, GirdleMotion, displace, find_girdle_scale

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


def move_girdles(
    model: BodyModel, R_WL: Mapping[str, np.ndarray], names: Iterable[str] | None = None
) -> dict[str, GirdleMotion]:
    """Compute girdle → its motion, of those that hang on a measured segment.

    Parameters
    ----------
    R_WL : segment → orientations (n, 3, 3)
    names : of girdles; None: all of the body
    """
    motions = {}
    for name in model.table.girdles if names is None else names:
        girdle, parameters = model.table.girdles[name], model.girdle_parameters(name)
        if girdle.on not in R_WL:
            continue
        n = len(R_WL[girdle.on])
        if girdle.moves not in R_WL:
            raised = np.full(n, MEAN_RAISED)
            motions[name] = GirdleMotion(np.tile(parameters[1:4], (n, 1)), np.zeros((n, 3)), raised, False)
            continue
        # Sums of columns: a product of matrices may have other last bits for one orientation than for many.
        x, y, z = model.table.segments[girdle.moves].along
        columns = R_WL[girdle.moves].transpose(2, 1, 0)
        along_W = x * columns[0] + y * columns[1] + z * columns[2]
        along = sum(rows * part for rows, part in zip(R_WL[girdle.on].transpose(1, 2, 0), along_W, strict=True))
        law, s = displace(girdle, along, find_girdle_scale(girdle, model.lengths), np)
        by_law = np.column_stack(law)
        displacement = (1.0 + parameters[0]) * by_law + parameters[1:4] + s[:, None] * parameters[4:]
        motions[name] = GirdleMotion(displacement, by_law, np.asarray(s), True)
    return motions


def find_carrier(model: BodyModel, link: str, measured: Collection[str]) -> str | None:
    """Find the measured segment with which a link rotates: itself, or above it where it is rigid; None: no such."""
    segment: str | None = link
    while segment is not None and segment not in measured:
        own = model.table.segments.get(segment)
        segment = model.parents[segment] if own is not None and own.rigid_without_sensor else None
    return segment


# Which follow from orientations -----------------------------------------------------------------------------------


def find_known_points(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the points that follow from the measured segments: those that no open motion moves."""
    points = model.point_frames
    moved = _find_open_motions(model, list(segments), list(points.values()))[1][:, :3]
    return [point for point, J in zip(points, moved, strict=True) if not np.any(np.abs(J) > _DETERMINED)]


def find_known_links(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the links whose pose follows from the measured segments; of a mechanism those that carry measured ones."""
    m, segments = model.pin, list(segments)
    links = [frame.name for frame in m.frames[1:]]
    if model.table.is_mechanism:
        carriers = {m.frames[m.getFrameId(segment)].parentJoint for segment in segments}
        above = {0}.union(*(m.supports[carrier].tolist() for carrier in carriers))
        return [link for link in links if m.frames[m.getFrameId(link)].parentJoint in above]
    moved = _find_open_motions(model, segments, links)[1]
    return [link for link, J in zip(links, moved, strict=True) if not np.any(np.abs(J) > _DETERMINED)]


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
        chains = {
            name: chain
            for name, chain in model.chains.items()
            if name in segments or not model.table.segments[name].rigid_without_sensor
        }
        free = {
            j
            for name, chain in chains.items()
            for j in chain.joints
            if name not in segments or chain.spherical in (None, j)
        }
    columns = find_columns(m, sorted(free))
    q = pin.integrate(m, pin.neutral(m), rng.uniform(0.2, 0.9, m.nv) * rng.choice([-1.0, 1.0], m.nv))
    data = m.createData()
    pin.computeJointJacobians(m, data, q)
    pin.updateFramePlacements(m, data)

    def compute_jacobians(names: Sequence[str]) -> np.ndarray:
        frames = [m.getFrameId(name) for name in names]
        J = [pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED) for frame in frames]
        return np.reshape(J, (len(frames), 6, m.nv))[:, :, columns]

    _, s, Vt = np.linalg.svd(compute_jacobians(segments)[:, 3:].reshape(3 * len(segments), -1))
    open_motions = np.zeros((m.nv, len(columns) - np.count_nonzero(s > _SINGULAR)))
    open_motions[columns] = Vt[np.count_nonzero(s > _SINGULAR) :].T
    return open_motions, compute_jacobians(links) @ open_motions[columns]


def find_columns(m: pin.Model, joints: Iterable[int]) -> np.ndarray:
    """Find where joints stand in a velocity (nv,)."""
    return np.array([m.idx_vs[joint] + k for joint in joints for k in range(m.nvs[joint])], dtype=int)


def compute_joint_values(m: pin.Model, q: np.ndarray) -> dict[str, np.ndarray]:
    """Compute joint → its value (n,) [rad or m] in configurations (n, nq); only joints of one axis."""
    return {m.names[joint]: q[:, m.idx_qs[joint]].copy() for joint in range(1, m.njoints) if m.nqs[joint] == 1}
