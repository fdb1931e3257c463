"""`Pose`, the segments and points of a body over time, with its table; and its links by forward kinematics.

Where links are, which of them follow from the measured segments, and how well.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import permutations
from typing import Any

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from ..arguments import EACH_TIME, check_array, check_fields, check_names
from ..errors import BadData, BadModel, one_of
from ..recording import check_time, format_span
from .body import BodyModel
from .girdle import MEAN_RAISED, PARAMETERS, follow_law
from .tree import UNIVERSE

MAX_POSE_NORM_DEVIATION = 1e-3  # of a quaternion in a `Pose` from 1
MAX_TABLE_NORM_DEVIATION = 1e-2  # the same in a table: a file may have few decimals
LARGEST_IN_TABLE = 1e6  # of a position, also in mm, or a standard deviation; more is damage
# Columns of a quaternion, a position and a covariance in a table.
_QUAT, _XYZ = ("qx", "qy", "qz", "qw"), ("x", "y", "z")
_ENTRIES = {f"cov_{'xyz'[i]}{'xyz'[j]}": (i, j) for i in range(3) for j in range(i, 3)}
# [rad²] about each axis with which a vector v is off by 2 |v|, which is the most; about one axis alone by √2 |v|, as a
# vector whose direction about it may be any.
_MOST_VARIANCE = 2.0
_DETERMINED = 1e-9  # [m/rad or rad/rad] by which open motions may move what is determined: rounding
_OPEN = 1e-3  # share of an open motion from which a joint counts as undetermined
_SINGULAR = 1e-6  # singular value of a Jacobian, below which a motion is open


@dataclass(frozen=True)
class Pose:
    """The pose of a body over time, in W.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw, segment frame L to W; only segments that are known. Of a person it is the measured
        orientation, of a mechanism the nearest that its joints can take
    points : point → (n, 3) [m] in W, whose origin is the root: of a person midway between the hips; only points that
        are known
    q : (n, nq) configuration of the Pinocchio model, in which a segment without a sensor is rigid with the one above;
        None for a pose from a table
    segment_cov : segment → (n, 3, 3) [rad²], covariance of the error rotation vector in W (on the left of `quat_WL`);
        empty where none is known
    point_cov : point → (n, 3, 3) [m²], covariance of the position in W
    heading_cov : two segments → (n,) [rad²], covariance of their headings; only where it is known
    gap : segment → (n,) bool, true where its sensor lost samples for longer than 50 ms; only segments with such gaps
    joints : joint of one axis → (n,) [rad or m], of a mechanism alone
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    q: np.ndarray | None = None
    segment_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    point_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    gap: Mapping[str, np.ndarray] = field(default_factory=dict)
    joints: Mapping[str, np.ndarray] = field(default_factory=dict)
    heading_cov: Mapping[tuple[str, str], np.ndarray] = field(default_factory=dict)

    def find_heading_cov(self, *segments: str) -> np.ndarray:
        """Return the covariance (n,) [rad²] of two segments' headings; zero where it is not known."""
        known = (shared for pair, shared in self.heading_cov.items() if {*pair} == {*segments})
        return next(known, np.zeros(len(self.time)))

    def __repr__(self) -> str:
        return f"Pose({len(self.time)} samples; {len(self.quat_WL)} segments, {len(self.points)} points)"

    def cut(self, span: slice | np.ndarray) -> Pose:
        """Return the pose of a span of samples, or of samples by their numbers."""
        series = ("quat_WL", "points", "segment_cov", "point_cov", "gap", "joints", "heading_cov")
        parts = {name: {key: rows[span] for key, rows in getattr(self, name).items()} for name in series}
        return replace(self, time=self.time[span], q=None if self.q is None else self.q[span], **parts)

    def check(self) -> Pose:
        """Check all fields and return the pose; NaN stands for missing values. Raise `BadOption` or `BadData`."""
        where, n = "pose: ", np.size(self.time)
        check_fields(self, where)
        check_array(f"{where}time", self.time, (n,), kind="missing")
        if not n:
            raise BadData(f"{where}time has no samples")
        check_time("pose", self.time)
        for name, known, shape, unit in (
            ("quat_WL", self.quat_WL, (n, 4), MAX_POSE_NORM_DEVIATION),
            ("points", self.points, (n, 3), np.inf),
            ("segment_cov", self.quat_WL, (n, 3, 3), np.inf),
            ("point_cov", self.points, (n, 3, 3), np.inf),
            ("gap", self.quat_WL, (n,), np.inf),
            ("joints", self.joints, (n,), np.inf),
        ):
            check_names(f"{where}{name}", getattr(self, name), tuple(known))
            for key, values in getattr(self, name).items():
                kind = "flag" if name == "gap" else "missing"
                check_array(f"{where}{name}.{key}", values, shape, EACH_TIME, kind=kind, unit=unit)
        return self


def join_poses(parts: Sequence[Pose]) -> Pose:
    """Join the samples of consecutive poses of one body."""
    if len(parts) == 1:
        return parts[0]

    def join(values: Sequence[Any]) -> Any:
        if isinstance(values[0], Mapping):
            return {name: np.concatenate([arrays[name] for arrays in values]) for name in values[0]}
        return None if values[0] is None else np.concatenate(values)

    return Pose(*(join([getattr(part, entry.name) for part in parts]) for entry in fields(Pose)))


def find_usual_rate(time: np.ndarray) -> float:
    """Return one over the usual step of times (n,) [s], to six digits; NaN of one sample."""
    return float(f"{1.0 / np.median(np.diff(time)):.6g}") if len(time) > 1 else float("nan")


def find_samples(time: np.ndarray, interval: tuple[float, float]) -> slice:
    """Return the samples of times (n,) [s] within an interval [s], both ends included; `BadData`: there is none."""
    first, last = (int(k) for k in np.searchsorted(time, [interval[0] - 1e-9, interval[1] + 1e-9]))
    if first == last:
        raise BadData(f"the interval {format_span(interval)} has no sample")
    return slice(first, last)


def build_pose_table(pose: Pose, covariance: bool = False) -> pl.DataFrame:
    """Build the table of ``pose.parquet``.

    ``time``; ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`) and ``<segment>_std`` [rad]; ``<point>_x,_y,_z`` [m] in W and
    ``<point>_std`` [m]; with `covariance` ``<name>_cov_xx,_xy,_xz,_yy,_yz,_zz`` of each and
    ``<segment>_<segment>_heading_cov`` [rad²] as well; ``<segment>_gap``.
    A standard deviation is that of one axis, the mean over the three (`compute_axis_std`).
    """
    table = {"time": pose.time}
    for series, components, covariances in (
        (pose.quat_WL, _QUAT, pose.segment_cov),
        (pose.points, _XYZ, pose.point_cov),
    ):
        for name, values in series.items():
            table |= {f"{name}_{component}": values[:, k] for k, component in enumerate(components)}
            if name in covariances:
                table[f"{name}_std"] = compute_axis_std(covariances[name])
                if covariance:
                    table |= {f"{name}_{entry}": covariances[name][:, i, j] for entry, (i, j) in _ENTRIES.items()}
    if covariance:
        table |= {f"{a}_{b}_heading_cov": shared for (a, b), shared in pose.heading_cov.items()}
    return pl.DataFrame(table | {f"{segment}_gap": gap for segment, gap in pose.gap.items()})


def parse_pose_table(table: pl.DataFrame, file: str) -> Pose:
    """Parse a `Pose` from a table as of `build_pose_table`; segments and points may be missing.

    Raise `BadData` where time is missing or does not increase, with neither orientations nor points, on a text, on a
    number that is none of a pose, or on a quaternion that is not of unit norm.
    """
    if "time" not in table.columns:
        raise BadData(f"{file}: no column 'time'; a table as in pose.parquet is needed; {one_of(table.columns)}")
    try:
        numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in table.columns}
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{file}: a column holds text: {str(error).splitlines()[0]}") from error
    time = numbers["time"]
    if not (len(time) and np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise BadData(f"{file}: time does not increase from row to row; seconds that do are needed, in one row or more")

    def collect(*components: str) -> dict[str, np.ndarray]:
        """Collect name → its columns (n, k), where all of them are there."""
        names = [name.removesuffix(f"_{components[0]}") for name in numbers if name.endswith(f"_{components[0]}")]
        columns = {name: [f"{name}_{component}" for component in components] for name in names}
        complete = {name: own for name, own in columns.items() if set(own) <= set(numbers)}
        for column in (column for own in complete.values() for column in own):
            if (wrong := np.abs(numbers[column]) > LARGEST_IN_TABLE).any():
                number, row = numbers[column][wrong][0], int(np.argmax(wrong)) + 1
                raise BadData(f"{file}: column '{column}' holds {number:.3g} in row {row}; the file is damaged")
        return {name: np.column_stack([numbers[column] for column in own]) for name, own in complete.items()}

    quat_WL, points = collect(*_QUAT), collect(*_XYZ)
    for name, quat in quat_WL.items():
        norm = np.linalg.norm(quat, axis=1)
        if np.any(np.abs(norm - 1.0) > MAX_TABLE_NORM_DEVIATION):
            raise BadData(f"{file}: {name}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
        quat_WL[name] = quat / norm[:, None]
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as <segment>_qx … or <point>_x … are needed")
    covariances = {name: std[:, :, None] ** 2 * np.eye(3) for name, std in collect("std").items()}
    for name, entries in collect(*_ENTRIES).items():
        cov = covariances[name] = np.empty((len(time), 3, 3))
        for column, (i, j) in zip(entries.T, _ENTRIES.values(), strict=True):
            cov[:, i, j] = cov[:, j, i] = column
    segment_cov, point_cov = (
        {name: covariances[name] for name in series if name in covariances} for series in (quat_WL, points)
    )
    gap = {name: numbers[f"{name}_gap"] > 0.0 for name in quat_WL if f"{name}_gap" in numbers}
    pairs = {(a, b): f"{a}_{b}_heading_cov" for a, b in permutations(segment_cov, 2)}
    shared = {pair: numbers[column] for pair, column in pairs.items() if column in numbers}
    return Pose(time, quat_WL, points, segment_cov=segment_cov, point_cov=point_cov, gap=gap, heading_cov=shared)


# Links -----------------------------------------------------------------------------------------------------------


def compute_link_poses(
    model: BodyModel, q: np.ndarray, links: Sequence[str], *, rotations: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Compute rotations (n, m, 3, 3), empty without `rotations`, and positions (n, m, 3) [m] of links in W."""
    data = model.pin.createData()
    frames = [model.pin.getFrameId(link) for link in links]
    # Views of Pinocchio's memory: reading data.oMf[f] for each row costs more than the kinematics.
    p_view = [data.oMf[frame].translation for frame in frames]
    R_view = [data.oMf[frame].rotation for frame in frames] if rotations else []
    R, p = np.empty((len(q), len(R_view), 3, 3)), np.empty((len(q), len(frames), 3))
    for k, row in enumerate(np.ascontiguousarray(q)):
        pin.framesForwardKinematics(model.pin, data, row)
        for i, view in enumerate(p_view):
            p[k, i] = view
        for i, view in enumerate(R_view):
            R[k, i] = view
    return R, p


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
    points, stated = find_known_points(model, quat_WL), segment_cov
    segment_cov = {name: _limit_variance(cov) for name, cov in stated.items()}
    least = np.finfo(float).tiny
    # Of each heading's standard deviation, the share that the limit leaves.
    left = {name: np.sqrt(cov[:, 2, 2] / np.maximum(stated[name][:, 2, 2], least)) for name, cov in segment_cov.items()}
    heading_cov = {(a, b): left[a] * left[b] * cov for (a, b), cov in (heading_cov or {}).items()}
    if model.table.is_mechanism:
        if not points or q is None or not set(quat_WL) <= set(segment_cov):
            return {}
        lengths_cov = shape_cov[: len(model.lengths), : len(model.lengths)]
        return _propagate_through_joints(model, q, segment_cov, lengths_cov, points, heading_cov)
    R_WL = {name: Rotation.from_quat(quat).as_matrix() for name, quat in quat_WL.items()} | {UNIVERSE: np.eye(3)}
    table, neutral, n = model.table, model.neutral_rotations, len(next(iter(quat_WL.values())))
    lengths, girdles = np.array(list(model.lengths.values())), list(table.girdles)
    moved = {name: move_girdle(model, name, quat_WL) for name in girdles if table.girdles[name].on in R_WL}
    covariances: dict[str, np.ndarray] = {}
    for point in points:
        names, links = model.point_girdles[point], model.reaches[point]
        carriers = {link: find_carrier(model, link, R_WL) for link in links}
        if None in carriers.values() or not set(names) <= set(moved) or not (links or names):
            continue
        vectors: dict[str, np.ndarray] = {}  # segment → the sum of what rotates with it, (n, 3) [m] in W
        by_lengths = [by_length for by_length, _ in links.values()]
        own = np.flatnonzero(np.concatenate([np.zeros((1, len(lengths))), *by_lengths]).any(axis=0))
        columns, J, off_law = own.tolist(), np.zeros((n, 3, len(own))), np.zeros((n, 3, 3))
        for link, (by_length, constant) in links.items():
            carrier = str(carriers[link])
            R_WK = R_WL[carrier]
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
        skews: dict[str, np.ndarray] = {}  # segment → [v]×
        for segment, vector in vectors.items():
            skew = np.zeros((n, 3, 3))
            skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = vector.T
            skews[segment] = skew = skew - skew.swapaxes(1, 2)
            cov -= skew @ segment_cov[segment] @ skew  # [v]×ᵀ = −[v]×
        for (near, far), shared in heading_cov.items():  # of errors about z
            if near in skews and far in skews:
                outer = shared[:, None, None] * skews[near][:, :, 2, None] * skews[far][:, None, :, 2]
                cov += outer + outer.swapaxes(1, 2)
        covariances[point] = cov + off_law
    return covariances


def _limit_variance(cov: np.ndarray) -> np.ndarray:
    """Limit covariances (n, 3, 3) [rad²] to `_MOST_VARIANCE` about each axis."""
    wide = np.trace(cov, axis1=1, axis2=2) > _MOST_VARIANCE
    if not wide.any():
        return cov
    values, vectors = np.linalg.eigh(cov[wide])
    limited = cov.copy()
    limited[wide] = (vectors * np.minimum(values, _MOST_VARIANCE)[:, None, :]) @ vectors.swapaxes(1, 2)
    return limited


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
    cov_W = np.zeros((len(q), 3 * k, 3 * k))
    for i, cov in enumerate(segment_cov.values()):
        cov_W[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = cov
    for headings, cov in heading_cov.items():
        near, far = (3 * order.index(name) + 2 for name in headings)
        cov_W[:, near, far] = cov_W[:, far, near] = cov
    try:
        reaches = model.reaches if lengths_cov.any() else {}
    except BadModel:  # a joint slides: the way of a point has no constant parts link by link
        return {}
    views = {frame.name: data.oMf[k].rotation for k, frame in enumerate(m.frames)}  # of R_WK
    views |= {joint: data.oMi[k].rotation for k, joint in enumerate(m.names) if joint not in views}
    out = np.empty((len(points), len(q), 3, 3))
    for row, values in enumerate(np.ascontiguousarray(q)):
        pin.computeJointJacobians(m, data, values)
        pin.updateFramePlacements(m, data)
        J = np.concatenate([pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[3:] for frame in segments])
        inverse = np.linalg.pinv(J, rcond=1e-6)
        for i, frame in enumerate(frames):
            gain = pin.getFrameJacobian(m, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3] @ inverse  # (3, 3 k)
            out[i, row] = gain @ cov_W[row] @ gain.T
            if way := reaches.get(points[i]):
                along = np.sum([views[link] @ by_length for link, (by_length, _) in way.items()], axis=0)
                out[i, row] += along @ lengths_cov @ along.T
    return dict(zip(points, out, strict=True))


def compute_axis_std(cov: np.ndarray) -> np.ndarray:
    """Compute the standard deviation (n,) per axis of covariances (n, 3, 3): root of the mean variance."""
    return np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3.0)
