"""`Pose`: segment orientations → configuration of the Pinocchio model → forward kinematics → points; and its table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from .. import rotations
from ..arguments import (
    check_array,
    check_covariance,
    check_fields,
    check_finite,
    check_names,
    check_unit,
    format_object,
)
from ..compilation import kernel
from ..errors import BadData, BadModel, Named, one_of
from ..recording import EACH_TIME, check_time, format_span
from ..rotations import product
from . import BodyModel
from .configurations import find_determined_frames, joint_values
from .fit import Fit
from .girdle import PARAMETERS, SCALARS, displace, find_girdle_scale, move_girdles
from .orientation_ik import OrientationIk, find_groups
from .reaches import UNIVERSE
from .subject import Subject

_ON_JOINT = 1e-12  # [m] from a joint's origin, below which the joint does not move a point
_MAX_TABLE_VALUE = 1e12  # beyond this a number in a table is no time [s] and no position [m]
MAX_POSE_NORM_DEVIATION = 1e-3  # of a quaternion in a `Pose` from 1
MAX_TABLE_NORM_DEVIATION = 1e-2  # of a quaternion in a table from 1: a file may have few decimals


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

    def __repr__(self) -> str:
        return format_object(
            self, lambda: f"{len(self.time)} samples; {len(self.quat_WL)} segments, {len(self.points)} points"
        )

    def cut(self, span: slice | np.ndarray) -> Pose:
        """Return the pose of a span of samples, or of samples by their numbers."""
        series = ("quat_WL", "points", "segment_cov", "point_cov", "gap", "joints")
        parts = {name: {key: rows[span] for key, rows in getattr(self, name).items()} for name in series}
        return replace(self, time=self.time[span], q=None if self.q is None else self.q[span], **parts)

    def check(self) -> Pose:
        """Check all fields and return the pose. NaN stands for missing values.

        Raises
        ------
        BadOption, BadData
            A field of a wrong type; a wrong shape; time that does not increase; a
            quaternion without unit norm; a covariance that is not symmetric and positive.
        """
        where = "pose: "
        check_fields(self, where, Pose)
        n = np.size(self.time)
        check_array(f"{where}time", self.time, (n,))
        if not n:
            raise BadData(f"{where}time has no samples")
        check_time("pose", self.time)
        for name, known, shape in (
            ("quat_WL", self.quat_WL, (n, 4)),
            ("points", self.points, (n, 3)),
            ("segment_cov", self.quat_WL, (n, 3, 3)),
            ("point_cov", self.points, (n, 3, 3)),
            ("joints", self.joints, (n,)),
        ):
            check_names(f"{where}{name}", getattr(self, name), tuple(known))
            for key, values in getattr(self, name).items():
                place = f"{where}{name}.{key}"
                check_array(place, values, shape, rows=EACH_TIME)
                check_finite(place, values, missing=True)
                if name == "quat_WL":
                    check_unit(place, values, MAX_POSE_NORM_DEVIATION)
                elif shape == (n, 3, 3):
                    check_covariance(place, values)
        check_names(f"{where}gap", self.gap, tuple(self.quat_WL))
        for segment, gap in self.gap.items():
            check_array(f"{where}gap.{segment}", gap, (n,), "b", EACH_TIME)
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


@dataclass(frozen=True, repr=False)
class PosedBody:
    """A body and its pose over time.

    Parameters
    ----------
    name : of the recording, as titles and files state it
    model : the body with the subject's lengths
    subject : lengths and mounts as used
    """

    name: str
    pose: Pose
    model: BodyModel
    subject: Subject

    def __repr__(self) -> str:
        parts = f"{len(self.time)} samples; {len(self.quat_WL)} segments, {len(self.points)} points"
        return f"{type(self).__name__}({self.name!r}: {parts})"

    @property
    def time(self) -> np.ndarray:
        """(n,) [s]."""
        return self.pose.time

    @property
    def rate_hz(self) -> float:
        """One over the usual time step, to six digits; NaN of one sample."""
        return float(f"{1.0 / np.median(np.diff(self.time)):.6g}") if len(self.time) > 1 else float("nan")

    @property
    def quat_WL(self) -> Mapping[str, np.ndarray]:
        """Segment → (n, 4) xyzw."""
        return Named("segment", self.pose.quat_WL)

    @property
    def points(self) -> Mapping[str, np.ndarray]:
        """Point → (n, 3) [m] in W."""
        return Named("point", self.pose.points)

    @property
    def joints(self) -> Mapping[str, np.ndarray]:
        """Joint of one axis → its values (n,) [rad or m]; of a mechanism."""
        return Named("joint", self.pose.joints)

    @cached_property
    def q(self) -> np.ndarray:
        """(n, nq) configuration of `model`."""
        return solve_configuration(self.model, self.quat_WL) if self.pose.q is None else self.pose.q

    def check(self) -> PosedBody:
        """Check the pose (`Pose.check`) and return the posed body."""
        self.pose.check()
        return self


def find_samples(time: np.ndarray, interval: tuple[float, float]) -> slice:
    """Return the samples of times (n,) [s] within an interval [s], both ends included.

    Raises
    ------
    BadData
        There is none.
    """
    first, last = (int(k) for k in np.searchsorted(time, [interval[0] - 1e-9, interval[1] + 1e-9]))
    if first == last:
        raise BadData(f"the interval {format_span(interval)} has no sample")
    return slice(first, last)


def compute_pose(model: BodyModel, time: np.ndarray, quat_WL: Mapping[str, np.ndarray], *, limits: bool = True) -> Pose:
    """Compute the pose of `model` from segment orientations `quat_WL`, segment → (n, 4) xyzw: `solve_configuration`."""
    return KinematicsSolver(model, quat_WL, limits=limits).solve_chunk(time, quat_WL)


class KinematicsSolver:
    """`compute_pose` chunk by chunk: its state carries over from one chunk to the next.

    Parameters
    ----------
    start : (nq,) the configuration of a mechanism before the first frame; None: all joints at zero

    Raises
    ------
    BadData, BadModel
        As `solve_configuration`.
    """

    def __init__(
        self, model: BodyModel, segments: Collection[str], *, limits: bool = True, start: np.ndarray | None = None
    ) -> None:
        self._model, self._ik = model, _make_ik(model, segments, limits, start=start)
        self._points = find_known_points(model, segments)
        self._last_quats: dict[str, np.ndarray] = {}
        self._last_joints: dict[str, float] = {}

    def solve_chunk(self, time: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> Pose:
        """Compute the pose of the next chunk: `time` (n,) [s], segment → (n, 4) xyzw."""
        q = self._ik.run(quat_WL, warm_start=True)
        _write_girdles(self._model, q, quat_WL)
        frames, joints = [self._model.point_frames[point] for point in self._points], {}
        if self._model.table.is_mechanism:
            R_WL, p_W = compute_link_poses(self._model, q, [*frames, *quat_WL])
            quat_WL = {
                name: Rotation.from_matrix(R_WL[:, k]).as_quat() for k, name in enumerate(quat_WL, start=len(frames))
            }
            joints = joint_values(self._model.pin, q, self._last_joints)
            self._last_joints = {name: float(values[-1]) for name, values in joints.items()}
        else:
            _, p_W = compute_link_poses(self._model, q, frames, rotations=False)
        points = {point: p_W[:, k] for k, point in enumerate(self._points)}
        quats = {name: rotations.unwrap_signs(quat, self._last_quats.get(name)) for name, quat in quat_WL.items()}
        self._last_quats = {name: quat[-1].copy() for name, quat in quats.items()}
        return Pose(time, quats, points, q, joints=joints)


def find_known_points(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the points that follow from the measured segments: those on known joints, and on joints that move below.

    Of a mechanism those that no joint moves which the orientations leave open.
    """
    if model.table.is_mechanism:
        frames = model.point_frames
        determined = set(find_determined_frames(model.pin, list(segments), list(frames.values())))
        return [point for point, link in frames.items() if link in determined]
    known_joint, points = _find_known_joints(model, segments), []
    for point, link in model.point_frames.items():
        frame = model.pin.frames[model.pin.getFrameId(link)]
        joint, offset = frame.parentJoint, frame.placement.translation
        while joint and np.abs(offset).max() < _ON_JOINT:  # the joint does not move it
            joint, offset = model.pin.parents[joint], model.pin.jointPlacements[joint].translation
        if known_joint[joint]:
            points.append(point)
    return points


def find_known_links(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Find the links whose pose follows from the measured segments: those, and links that are rigid with them."""
    known_joint = _find_known_joints(model, segments)
    return [frame.name for frame in model.pin.frames[1:] if known_joint[frame.parentJoint]]


def _find_known_joints(model: BodyModel, segments: Iterable[str]) -> list[bool]:
    """Whether the placement of each Pinocchio joint follows from the measured segments.

    Without a sensor a segment is rigid with the one above where the table says so, else it is unknown with all below
    it, but for what is measured and hangs in the point about which it rotates: hips without a torso. Of a mechanism all
    joints above a measured link are known.
    """
    measured, m = set(segments), model.pin
    if model.table.is_mechanism:
        carrying = {m.frames[m.getFrameId(segment)].parentJoint for segment in measured}
        return [any(joint in m.supports[carrier] for carrier in carrying) or not joint for joint in range(m.njoints)]
    unmeasured_joints = {
        joint
        for segment, chain in model.chains.items()
        if segment not in measured and not model.table.segments[segment].rigid_without_sensor
        for joint in chain.joints
    }
    own_joint = {
        chain.joints[0]
        for segment, chain in model.chains.items()
        if segment in measured and chain.exact and len(chain.joints) == 1
    }
    placed, rotated = [True], [True]
    for joint in range(1, m.njoints):
        parent, offset = m.parents[joint], m.jointPlacements[joint].translation
        placed.append(placed[parent] and (rotated[parent] or np.abs(offset).max() < _ON_JOINT))
        rotated.append(joint in own_joint or (rotated[parent] and joint not in unmeasured_joints))
    return [position and rotation for position, rotation in zip(placed, rotated, strict=True)]


def solve_configuration(
    model: BodyModel,
    quat_WL: Mapping[str, np.ndarray],
    *,
    limits: bool = True,
) -> np.ndarray:
    """Solve for the configuration `q` (n, nq) with the measured orientations, or the nearest one.

    Of a mechanism all joints are fitted at once, each frame from the one before. Of a person: Segments on spherical
    joints have their orientations exactly. For limbs with fewer axes the sum of the segments' squared angles to their
    measured orientations is minimised; `compute_orientation_residuals` returns these angles. An unmeasured segment is
    rigid with its parent segment. `wepose_pin.body.chains` finds the moving joints.

    Parameters
    ----------
    limits : keep the limits of joints with one axis; those of spherical joints are not kept

    Raises
    ------
    BadModel
        The model has no link for a measured segment.
    """
    q = _make_ik(model, quat_WL, limits).run(quat_WL)
    _write_girdles(model, q, quat_WL)
    return q


def _write_girdles(model: BodyModel, q: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> None:
    """Write the joints of the girdles into `q` (n, nq): they follow the limbs."""
    R_WL = {name: Rotation.from_quat(quat_WL[name]).as_matrix() for name in _girdle_segments(model) if name in quat_WL}
    for name, motion in move_girdles(model, R_WL).items():
        for joint, values in zip(model.table.girdles[name].joints, motion.displacement.T, strict=True):
            q[:, model.pin.idx_qs[model.pin.getJointId(joint)]] = values


def _girdle_segments(model: BodyModel) -> set[str]:
    return {segment for girdle in model.table.girdles.values() for segment in (girdle.on, girdle.moves)}


class _MechanismIk:
    """Configurations of a mechanism that follow orientations: all joints at once, each frame from the one before.

    Parameters
    ----------
    start : (nq,) the configuration before the first frame
    """

    def __init__(self, model: BodyModel, segments: Collection[str], limits: bool, start: np.ndarray) -> None:
        self._segments, self._last = list(segments), start
        joints = [joint for joint in range(1, model.pin.njoints) if model.pin.nvs[joint]]  # a mimic joint has none
        self._fit = Fit(model.pin, self._segments, joints, limits)

    def run(self, quat_WL: Mapping[str, np.ndarray], *_: object, **__: object) -> np.ndarray:
        """`q` (n, nq) by segment → (n, 4) xyzw; the frames always continue the motion of the last run."""
        q = self._fit.run({segment: quat_WL[segment] for segment in self._segments}, self._last[None])
        self._last = q[-1].copy()
        return q


def _make_ik(
    model: BodyModel,
    segments: Collection[str],
    limits: bool = True,
    start: np.ndarray | None = None,
) -> OrientationIk | _MechanismIk:
    """Return the inverse kinematics of these segments; `BadData` without any, `BadModel` where one has no link."""
    if not segments:
        raise BadData("no segment has an orientation: a pose needs one")
    model.table.check_segments(segments, f"{model.pin.name}: ", BadModel)
    if model.table.is_mechanism:
        return _MechanismIk(model, segments, limits, pin.neutral(model.pin) if start is None else start)
    return OrientationIk(model, segments, limits=limits)


def compute_orientation_residuals(
    model: BodyModel, q: np.ndarray, quat_WL: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Compute segment → angle (n,) [rad] between its measured orientation and that of the model in `q`.

    Only for segments whose orientation the joints cannot reproduce exactly; for all of a mechanism.
    """
    if model.table.is_mechanism:
        limited = list(quat_WL)
    else:
        fitted = {segment for group in find_groups(model, quat_WL) for segment in group.segments}
        limited = [
            name for name, chain in model.chains.items() if name in quat_WL and (name in fitted or not chain.exact)
        ]
    if not limited:
        return {}
    R_WL, _ = compute_link_poses(model, q, limited)
    R_model = {segment: Rotation.from_matrix(R_WL[:, k]) for k, segment in enumerate(limited)}
    return {segment: (R_model[segment].inv() * Rotation.from_quat(quat_WL[segment])).magnitude() for segment in limited}


def compute_link_poses(
    model: BodyModel, q: np.ndarray, links: list[str], *, rotations: bool = True
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


class LiveKinematics:
    """Points of one pose after another, live: constants are looked up once, and each fit starts at the last pose.

    Parameters
    ----------
    model : the body
    segments : the measured segments, in the order of the rows that `compute_points` takes
    start : (nq,) the configuration of a mechanism before the first pose; None: all joints at zero

    Attributes
    ----------
    points : names of the known points
    data : Pinocchio's data of the last pose

    Raises
    ------
    BadModel
        The model has no link for a measured segment.
    """

    def __init__(self, model: BodyModel, segments: Sequence[str], start: np.ndarray | None = None) -> None:
        self.segments = tuple(segments)
        self.points = tuple(find_known_points(model, self.segments))
        self._model, self.data, self._q = model, model.pin.createData(), pin.neutral(model.pin)
        frames = [model.pin.getFrameId(model.point_frames[point]) for point in self.points]
        self._views = [self.data.oMf[frame].translation for frame in frames]
        self._spherical_joints = None if model.table.is_mechanism else self._match_spherical_joints()
        self._ik = None if self._spherical_joints is not None else _make_ik(model, self.segments, start=start)
        self._previous_q: np.ndarray | None = None
        self._girdles = [
            _LiveGirdle(model, name, self.segments)
            for name, girdle in model.table.girdles.items()
            if girdle.on in self.segments
        ]

    def _match_spherical_joints(self) -> list[tuple[int, int, int]] | None:
        """Return for each measured segment its index in q, its row, and the row of its measured parent (−1: W).

        None if a measured segment is not on a spherical joint of its own.
        """
        m, identity, joints = self._model.pin, np.array([0.0, 0.0, 0.0, 1.0]), []
        if not all(np.allclose(placement.rotation, np.eye(3), atol=1e-15) for placement in m.jointPlacements):
            return None
        rows = {segment: row for row, segment in enumerate(self.segments)}
        for segment, chain in self._model.chains.items():
            if segment not in rows:
                continue
            spherical = len(chain.axes) == 1 and chain.axes[0] is None
            if not spherical or not all(np.allclose(q, identity) for q in (*chain.quat, chain.quat_AL)):
                return None
            above = self._model.parents[segment]
            while above is not None and above not in rows:
                above = self._model.parents[above]
            joints.append((m.idx_qs[chain.joints[0]], rows[segment], -1 if above is None else rows[above]))
        return joints if len(joints) == len(self.segments) else None

    def compute_points(self, quat_WL: np.ndarray) -> np.ndarray:
        """Compute the points (p, 3) [m] in W from `quat_WL` (k, 4) xyzw."""
        if self._ik is not None:
            rows = {segment: quat_WL[i : i + 1] for i, segment in enumerate(self.segments)}
            self._q = self._previous_q = self._ik.run(rows, self._previous_q)[0]
        for q_index, row, parent_row in self._spherical_joints or ():
            set_relative_rotation(quat_WL, row, parent_row, self._q, q_index)
        for girdle in self._girdles:
            girdle.place(quat_WL, self._q)
        pin.framesForwardKinematics(self._model.pin, self.data, self._q)
        return np.array(self._views)

    def orient_segments(self, quat_WL: np.ndarray) -> np.ndarray:
        """Return the orientations (k, 4) xyzw of the last pose, from the measured `quat_WL`: as `Pose` has them."""
        if not self._model.table.is_mechanism:
            return quat_WL
        frames = [self.data.oMf[self._model.pin.getFrameId(segment)] for segment in self.segments]
        fitted = Rotation.from_matrix([frame.rotation for frame in frames]).as_quat()
        return np.where(np.einsum("ki,ki->k", fitted, quat_WL)[:, None] < 0.0, -fitted, fitted)


class _LiveGirdle:
    """A girdle whose joints are set for one pose after another."""

    def __init__(self, model: BodyModel, name: str, segments: Sequence[str]) -> None:
        self._girdle = girdle = model.table.girdles[name]
        self._on = segments.index(girdle.on)
        self._moves = segments.index(girdle.moves) if girdle.moves in segments else None
        self._along = np.array(model.table.segments[girdle.moves].along)
        self._scale = find_girdle_scale(girdle, model.lengths)
        self._parameters = tuple(model.girdle_parameters(name).tolist())
        self._at = [model.pin.idx_qs[model.pin.getJointId(joint)] for joint in girdle.joints]

    def place(self, quat_WL: np.ndarray, q: np.ndarray) -> None:
        """Set the joints in `q` (nq,) as `_write_girdles`, from `quat_WL` (k, 4) xyzw."""
        law, s = (0.0, 0.0, 0.0), 0.0
        if self._moves is not None:
            along = turn_relatively(quat_WL, self._moves, self._on, self._along)
            law, s = displace(self._girdle, along, self._scale, SCALARS)
        share, rest, raised = 1.0 + self._parameters[0], self._parameters[1:4], self._parameters[4:]
        for i, by_law, at_rest, at_raised in zip(self._at, law, rest, raised, strict=True):
            q[i] = share * by_law + at_rest + s * at_raised


@kernel
def turn_relatively(quat, row, parent_row, v):  # type: ignore[no-untyped-def]
    """A vector `v` (3,) of row `row` of `quat` (k, 4) xyzw in the frame of row `parent_row`, as three floats."""
    bx, by, bz, bw = quat[row, 0], quat[row, 1], quat[row, 2], quat[row, 3]
    ax, ay, az, aw = -quat[parent_row, 0], -quat[parent_row, 1], -quat[parent_row, 2], quat[parent_row, 3]
    x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
    tx, ty, tz, tw = product(x, y, z, w, v[0], v[1], v[2], 0.0)
    rx, ry, rz, _ = product(tx, ty, tz, tw, -x, -y, -z, w)
    scale = 1.0 / (x * x + y * y + z * z + w * w)
    return rx * scale, ry * scale, rz * scale


@kernel
def set_relative_rotation(quat, row, parent_row, q, q_index):  # type: ignore[no-untyped-def]
    """Set ``q[q_index : q_index + 4]`` to row `row` of `quat` (k, 4) xyzw relative to `parent_row`; −1: to W."""
    bx, by, bz, bw = quat[row, 0], quat[row, 1], quat[row, 2], quat[row, 3]
    ax, ay, az, aw = 0.0, 0.0, 0.0, 1.0
    if parent_row >= 0:
        ax, ay, az, aw = -quat[parent_row, 0], -quat[parent_row, 1], -quat[parent_row, 2], quat[parent_row, 3]
    x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    q[q_index], q[q_index + 1], q[q_index + 2], q[q_index + 3] = x * scale, y * scale, z * scale, w * scale


def compute_link_placements(
    model: BodyModel, q: np.ndarray, links: Iterable[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compute link → (`quat_WL` (n, 4) xyzw, `p_WL` (n, 3) [m]), for drawing the body."""
    links = list(links)
    R, p = compute_link_poses(model, q, links)
    quat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(len(q), len(links), 4)
    return {link: (rotations.unwrap_signs(quat[:, k]), p[:, k]) for k, link in enumerate(links)}


# Uncertainty -------------------------------------------------------------------------------------------------------


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
    lengths = np.array(list(model.lengths.values()))
    girdles = list(model.table.girdles)
    known = {name: Rotation.from_quat(quat_WL[name]).as_matrix() for name in _girdle_segments(model) if name in quat_WL}
    motions = move_girdles(model, known)
    R_WK: dict[str, np.ndarray] = {}
    carriers = {
        link: carrier
        for link in dict.fromkeys(link for way in model.reaches.values() for link in way)
        if (carrier := find_carrier(model, link, quat_WL)) is not None
    }
    for link, carrier in carriers.items():
        if carrier in segment_cov:
            R_CK = model.neutral_rotations[carrier].T @ model.neutral_rotations[link]
            R_WK[link] = Rotation.from_quat(quat_WL[carrier]).as_matrix()
            if not np.allclose(R_CK, np.eye(3), atol=1e-12):
                R_WK[link] = R_WK[link] @ R_CK
    for point in points:
        way = model.reaches[point]
        if not way or not all(link in R_WK or link == UNIVERSE for link in way):
            continue
        vectors: dict[str, np.ndarray] = {}
        n = len(next(iter(quat_WL.values())))
        shape_jacobian = np.zeros((n, 3, len(shape_cov)))
        for link, part in way.items():
            if link == UNIVERSE:
                shape_jacobian[:, :, : len(lengths)] += part.by_length
                continue
            carrier = carriers[link]
            vectors[carrier] = vectors.get(carrier, 0.0) + R_WK[link] @ (part.by_length @ lengths + part.constant)
            shape_jacobian[:, :, : len(lengths)] += R_WK[link] @ part.by_length
        residual = np.zeros((n, 3, 3))
        for name in model.point_girdles[point]:
            girdle, motion = model.table.girdles[name], motions[name]
            first = len(lengths) + len(PARAMETERS) * girdles.index(name)
            R_on = known[girdle.on]
            vectors[girdle.on] = vectors.get(girdle.on, 0.0) + np.einsum("nij,nj->ni", R_on, motion.displacement)
            shape_jacobian[:, :, first : first + len(PARAMETERS)] += R_on @ motion.jacobian
            residual += (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
        cov = shape_jacobian @ shape_cov @ shape_jacobian.swapaxes(1, 2) + residual
        for moving_segment, vector in vectors.items():
            skew = _build_skew_matrices(vector)
            cov = cov + skew @ segment_cov[moving_segment] @ skew.swapaxes(1, 2)
        for (near, far), shared in (heading_cov or {}).items():
            if near in vectors and far in vectors:
                _add_shared_heading(cov, vectors[near], vectors[far], shared)
        covariances[point] = cov
    return covariances


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


def find_carrier(model: BodyModel, link: str, measured: Collection[str]) -> str | None:
    """Find the measured segment with which a link rotates: itself, or above it where it is rigid; None: no such."""
    segment: str | None = link
    while segment is not None and segment not in measured:
        own = model.table.segments.get(segment)
        segment = model.parents[segment] if own is not None and own.rigid_without_sensor else None
    return segment


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


# The table of pose.parquet and truth.parquet -----------------------------------------------------------------------


def build_pose_table(pose: Pose, covariance: bool = False) -> pl.DataFrame:
    """Build the table of ``pose.parquet``.

    ``time``; ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`) and ``<segment>_std`` [rad]; ``<point>_x,_y,_z`` [m] in W and
    ``<point>_std`` [m]; with `covariance` ``<name>_cov_xx,_xy,_xz,_yy,_yz,_zz`` of each as well; ``<segment>_gap``.
    A standard deviation is that of one axis, the mean over the three (`compute_axis_std`).
    """
    table = {"time": pose.time}
    for segment, quat in pose.quat_WL.items():
        table |= {f"{segment}_{c}": quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
        if segment in pose.segment_cov:
            table |= _build_uncertainty_columns(segment, pose.segment_cov[segment], covariance)
    for point, p in pose.points.items():
        table |= {f"{point}_{c}": p[:, k] for k, c in enumerate("xyz")}
        if point in pose.point_cov:
            table |= _build_uncertainty_columns(point, pose.point_cov[point], covariance)
    table |= {f"{segment}_gap": gap for segment, gap in pose.gap.items()}
    return pl.DataFrame(table)


def _build_uncertainty_columns(name: str, cov: np.ndarray, entries: bool) -> dict[str, np.ndarray]:
    columns = {f"{name}_std": compute_axis_std(cov)}
    if entries:
        columns |= {f"{name}_cov_{'xyz'[i]}{'xyz'[j]}": cov[:, i, j] for i in range(3) for j in range(i, 3)}
    return columns


def parse_pose_table(table: pl.DataFrame, file: str) -> Pose:
    """Parse a `Pose` from a table as of `build_pose_table`; segments and points may be missing.

    Raises
    ------
    BadData
        No column of time; neither orientations nor points; a text; a quaternion that is not of unit norm; a number
        beyond `_MAX_TABLE_VALUE`.
    """
    if "time" not in table.columns:
        raise BadData(f"{file}: no column 'time'; a table as in pose.parquet is needed; {one_of(table.columns)}")
    try:
        numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in table.columns}
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{file}: a column holds text: {str(error).splitlines()[0]}") from error
    segments = [name for name in _stems(numbers, "_qx") if {f"{name}_{c}" for c in ("qy", "qz", "qw")} <= set(numbers)]
    places = [name for name in _stems(numbers, "_x") if {f"{name}_{c}" for c in "yz"} <= set(numbers)]
    _check_numbers(numbers, file, (*segments, *places))
    quat_WL, points = {}, {}
    for segment in segments:
        quat = np.column_stack([numbers[f"{segment}_{c}"] for c in ("qx", "qy", "qz", "qw")])
        norm = np.linalg.norm(quat, axis=1)
        if np.any(np.abs(norm - 1.0) > MAX_TABLE_NORM_DEVIATION):
            raise BadData(f"{file}: {segment}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
        quat_WL[segment] = quat / norm[:, None]
    for point in places:
        points[point] = np.column_stack([numbers[f"{point}_{c}"] for c in "xyz"])
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as <segment>_qx … or <point>_x … are needed")
    segment_cov = {name: _parse_covariances(numbers, name) for name in quat_WL}
    point_cov = {name: _parse_covariances(numbers, name) for name in points}
    gap = {name: numbers[f"{name}_gap"] > 0.0 for name in quat_WL if f"{name}_gap" in numbers}
    return Pose(
        numbers["time"],
        quat_WL,
        points,
        segment_cov={name: cov for name, cov in segment_cov.items() if cov is not None},
        point_cov={name: cov for name, cov in point_cov.items() if cov is not None},
        gap=gap,
    )


def _stems(numbers: Mapping[str, np.ndarray], ending: str) -> list[str]:
    """Return the beginnings of the columns that end so."""
    return [name.removesuffix(ending) for name in numbers if name.endswith(ending)]


def _check_numbers(numbers: Mapping[str, np.ndarray], file: str, names: tuple[str, ...]) -> None:
    """Raise `BadData` where time does not increase or a number is beyond `_MAX_TABLE_VALUE`; NaN means not known."""
    time = numbers["time"]
    if not len(time):
        raise BadData(f"{file}: no rows; a pose has at least one")
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise BadData(f"{file}: time does not increase from row to row; seconds that do are needed")
    for name, values in numbers.items():
        if name != "time" and not name.startswith(names):
            continue
        too_large = np.abs(values) > _MAX_TABLE_VALUE
        if too_large.any():
            row = int(np.argmax(too_large))
            raise BadData(f"{file}: {name} is {values[row]:g} in row {row + 1}; no pose has such a number")


def _parse_covariances(numbers: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """Parse covariances (n, 3, 3) of a table: its entries, else the standard deviation on all axes; None: neither."""
    entries = {(i, j): f"{name}_cov_{'xyz'[i]}{'xyz'[j]}" for i in range(3) for j in range(i, 3)}
    if all(column in numbers for column in entries.values()):
        cov = np.empty((len(numbers["time"]), 3, 3))
        for (i, j), column in entries.items():
            cov[:, i, j] = cov[:, j, i] = numbers[column]
        return cov
    if f"{name}_std" in numbers:
        return numbers[f"{name}_std"][:, None, None] ** 2 * np.eye(3)
    return None
