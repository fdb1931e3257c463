"""`Pose`: segment orientations → configuration of the Pinocchio model → forward kinematics → points; and its table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from . import rotations
from .arguments import check_array, check_covariance, check_fields, check_finite, check_names, check_unit
from .compilation import kernel
from .errors import BadData, BadModel, one_of
from .model import POINTS, BodyModel, chains
from .model.orientation_ik import OrientationIk, groups
from .recording import EACH_TIME, SEGMENTS, check_time
from .rotations import product
from .subject import LENGTHS

_LARGEST_NUMBER = 1e12  # beyond this a number in a table is no time [s] and no place [m]


@dataclass(frozen=True)
class Pose:
    """The pose of the upper body over time, in W.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw; only segments that are known
    points : point → (n, 3) [m] in W; only points that are known
    q : (n, nq) configuration of the Pinocchio model; unmeasured segments are rigid with the one above; None where the
        pose came from a table
    segment_cov : segment → (n, 3, 3) [rad²], covariance of the orientation's error in W (on the left of `quat_WL`)
    point_cov : point → (n, 3, 3) [m²], in W
    gap : segment → (n,) bool, true where its sensor gave nothing and a long gap was bridged; empty where that was not
        allowed
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    q: np.ndarray | None = None
    segment_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    point_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    gap: Mapping[str, np.ndarray] = field(default_factory=dict)

    def check(self) -> Pose:
        """The same pose, if all its fields are valid. NaN stands for missing values.

        Raises
        ------
        BadOption, BadData
            A field that is not of its kind; a segment or point that is not known; shapes that differ; time that goes
            back; quaternions that are no unit ones; covariances that are none.
        """
        where = "pose: "
        check_fields(self, where, Pose)
        n = np.size(self.time)
        check_array(f"{where}time", self.time, (n,))
        if not n:
            raise BadData(f"{where}time has no samples")
        check_time("pose", self.time)
        for name, known, shape in (
            ("quat_WL", SEGMENTS, (n, 4)),
            ("points", POINTS, (n, 3)),
            ("segment_cov", SEGMENTS, (n, 3, 3)),
            ("point_cov", POINTS, (n, 3, 3)),
        ):
            check_names(f"{where}{name}", getattr(self, name), tuple(known))
            for key, values in getattr(self, name).items():
                place = f"{where}{name}.{key}"
                check_array(place, values, shape, rows=EACH_TIME)
                check_finite(place, values, missing=True)
                if name == "quat_WL":
                    check_unit(place, values, 1e-3)
                elif shape == (n, 3, 3):
                    check_covariance(place, values)
        check_names(f"{where}gap", self.gap, SEGMENTS)
        for segment, gap in self.gap.items():
            check_array(f"{where}gap.{segment}", gap, (n,), "b", EACH_TIME)
        return self


def compute_pose(model: BodyModel, time: np.ndarray, quat_WL: Mapping[str, np.ndarray], *, limits: bool = True) -> Pose:
    """The pose of `model` with measured segment orientations `quat_WL`, segment → (n, 4) xyzw; see `configuration`."""
    return KinematicsSolver(model, quat_WL, limits=limits).pose(time, quat_WL)


class KinematicsSolver:
    """`compute_pose` chunk by chunk: each begins where the one before ended.

    Raises
    ------
    BadData, BadModel
        As `configuration`.
    """

    def __init__(self, model: BodyModel, segments: Collection[str], *, limits: bool = True) -> None:
        if not segments:
            raise BadData("no segment has an orientation: a pose needs one")
        self._model, self._ik = model, _make_ik(model, segments, limits)
        self._points = [point for point in find_known_points(segments) if model.pin.existFrame(POINTS[point])]
        self._last: dict[str, np.ndarray] = {}

    def pose(self, time: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> Pose:
        """The pose of the next chunk: `time` (n,) [s], segment → (n, 4) xyzw."""
        q = self._ik.run(quat_WL, go_on=True)
        _, p_W = forward_kinematics(self._model, q, [POINTS[point] for point in self._points], rotations=False)
        points = {point: p_W[:, k] for k, point in enumerate(self._points)}
        quats = {name: rotations.unwrap_signs(quat, self._last.get(name)) for name, quat in quat_WL.items()}
        self._last = {name: quat[-1].copy() for name, quat in quats.items()}
        return Pose(time, quats, points, q)


def find_known_points(segments: Iterable[str]) -> list[str]:
    """Points that follow from the measured segments; a hand without a sensor is rigid with its forearm."""
    have = set(segments)
    known = []
    for point in POINTS:
        side, part = point.split("_", 1)
        needs = {
            "shoulder": ["torso"],
            "elbow": ["torso", f"{side}_upper_arm"],
            "wrist": ["torso", f"{side}_upper_arm", f"{side}_forearm"],
            "palm": ["torso", f"{side}_upper_arm", f"{side}_forearm"],
        }[part]
        if have.issuperset(needs):
            known.append(point)
    return known


def find_known_links(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Links whose place follows from the measured segments: those, and links that are rigid with them.

    A hand without a sensor is rigid with the forearm, head and pelvis with the torso. An upper arm or forearm without
    a sensor is unknown, with all links below it.
    """
    have = set(segments)
    guessed = {
        joint
        for segment, chain in chains(model.pin).items()
        if segment not in have and not segment.endswith(("hand", "head", "pelvis"))
        for joint in chain.joints
    }
    known_joint = {0: True}
    for joint in range(1, model.pin.njoints):
        known_joint[joint] = known_joint[model.pin.parents[joint]] and joint not in guessed
    return [frame.name for frame in model.pin.frames[1:] if known_joint[frame.parentJoint]]


def configuration(
    model: BodyModel,
    quat_WL: Mapping[str, np.ndarray],
    *,
    limits: bool = True,
    weights: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Configuration `q` (n, nq) in which the segments have their measured orientations, or come nearest to them.

    Segments on spherical joints have their orientations exactly. In an arm with fewer axes the sum of the segments'
    squared angles to their measured orientations is least; `orientation_residuals` gives these angles. Segments without
    an orientation are rigid with the one above. `wepose_pin.model.chains` says which joints move.

    Parameters
    ----------
    limits : keep the limits of joints with one axis; those of spherical joints are not kept
    weights : segment → weight of its squared angle within its arm; 1 where not named

    Raises
    ------
    BadModel
        The model has no link for a measured segment.
    """
    if not quat_WL:
        raise BadData("no segment has an orientation: a pose needs one")
    return _make_ik(model, quat_WL, limits, weights).run(quat_WL)


def _make_ik(
    model: BodyModel, segments: Collection[str], limits: bool = True, weights: Mapping[str, float] | None = None
) -> OrientationIk:
    """Raises `BadModel` where the model has no link for a segment."""
    links = chains(model.pin)
    for segment in segments:
        if segment not in links:
            raise BadModel(f"{model.pin.name}: the model has no link for segment '{segment}'; {one_of(links, segment)}")
    return OrientationIk(model, links, segments, limits=limits, weights=weights)


def orientation_residuals(model: BodyModel, q: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Segment → angle (n,) [rad] between its measured orientation and that of the model in `q`.

    Only segments that the joints may not reach: behind one or two axes, in an arm with such, or rigid with another.
    """
    links = chains(model.pin)
    fitted = {segment for group in groups(links, quat_WL) for segment in group.segments}
    limited = [name for name, chain in links.items() if name in quat_WL and (name in fitted or not chain.exact)]
    R_WL, _ = forward_kinematics(model, q, limited)
    is_at = {segment: Rotation.from_matrix(R_WL[:, k]) for k, segment in enumerate(limited)}
    return {segment: (is_at[segment].inv() * Rotation.from_quat(quat_WL[segment])).magnitude() for segment in limited}


def forward_kinematics(
    model: BodyModel, q: np.ndarray, links: list[str], *, rotations: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, m, 3, 3), empty without `rotations`, and positions (n, m, 3) [m] of links in W, by Pinocchio."""
    data = model.pin.createData()
    frames = [model.pin.getFrameId(link) for link in links]
    # Views into Pinocchio's memory: reading data.oMf[f] anew costs more than the kinematics.
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
    """Points of one pose after another; what does not change is looked up once, a fit begins at the pose before.

    Parameters
    ----------
    model : the body
    segments : the measured ones, in the order of the rows that `points_of` takes

    Attributes
    ----------
    points : names of the points that are known
    data : Pinocchio's, of the last pose

    Raises
    ------
    BadModel
        The model has no link for a measured segment.
    """

    def __init__(self, model: BodyModel, segments: Sequence[str]) -> None:
        self.segments = tuple(segments)
        self.points = tuple(p for p in find_known_points(self.segments) if model.pin.existFrame(POINTS[p]))
        self._model, self.data, self._q = model, model.pin.createData(), pin.neutral(model.pin)
        self._views = [self.data.oMf[model.pin.getFrameId(POINTS[point])].translation for point in self.points]
        self._joints = self._spherical()
        self._ik = None if self._joints is not None else _make_ik(model, self.segments)
        self._before: np.ndarray | None = None

    def _spherical(self) -> list[tuple[int, int, int]] | None:
        """Of each measured segment its place in q, its row and that of the one above (−1: W); None: not so simple."""
        links, joints = chains(self._model.pin), []
        rows: dict[int, int] = {}  # Pinocchio joint → row of the segment whose orientation its frame has
        identity = np.array([0.0, 0.0, 0.0, 1.0])
        for joint in range(1, self._model.pin.njoints):
            above = rows.get(self._model.pin.parents[joint], -1)
            rows[joint] = above
            if not np.allclose(self._model.pin.jointPlacements[joint].rotation, np.eye(3), atol=1e-15):
                return None
            for segment, chain in links.items():
                if segment not in self.segments or joint not in chain.joints:
                    continue
                spherical = len(chain.axes) == 1 and chain.axes[0] is None
                if not spherical or not all(np.allclose(q, identity) for q in (*chain.quat, chain.quat_AL)):
                    return None
                row = self.segments.index(segment)
                joints.append((self._model.pin.idx_qs[joint], row, above))
                rows[joint] = row
        return joints if len(joints) == len(self.segments) else None

    def points_of(self, quat_WL: np.ndarray) -> np.ndarray:
        """(p, 3) [m] in W, of `quat_WL` (k, 4) xyzw."""
        if self._ik is not None:
            rows = {segment: quat_WL[i : i + 1] for i, segment in enumerate(self.segments)}
            self._q = self._before = self._ik.run(rows, self._before)[0]
        for at, row, above in self._joints or ():
            relative(quat_WL, row, above, self._q, at)
        pin.framesForwardKinematics(self._model.pin, self.data, self._q)
        return np.array(self._views)


@kernel
def relative(quat, row, above, q, at):  # type: ignore[no-untyped-def]
    """``q[at : at + 4]``: rotation of row `row` of `quat` (k, 4) xyzw in the frame of row `above`; −1: in W."""
    bx, by, bz, bw = quat[row, 0], quat[row, 1], quat[row, 2], quat[row, 3]
    ax, ay, az, aw = 0.0, 0.0, 0.0, 1.0
    if above >= 0:
        ax, ay, az, aw = -quat[above, 0], -quat[above, 1], -quat[above, 2], quat[above, 3]
    x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    q[at], q[at + 1], q[at + 2], q[at + 3] = x * scale, y * scale, z * scale, w * scale


def placements(model: BodyModel, q: np.ndarray, links: Iterable[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Link → (`quat_WL` (n, 4) xyzw, `p_WL` (n, 3) [m]), for drawing the body."""
    links = list(links)
    R, p = forward_kinematics(model, q, links)
    quat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(len(q), len(links), 4)
    return {link: (rotations.unwrap_signs(quat[:, k]), p[:, k]) for k, link in enumerate(links)}


# Confidence --------------------------------------------------------------------------------------------------------


def point_covariance(
    points: Mapping[str, np.ndarray],
    quat_WL: Mapping[str, np.ndarray],
    segment_cov: Mapping[str, np.ndarray],
    lengths_cov: np.ndarray,
) -> dict[str, np.ndarray]:
    """Covariance (n, 3, 3) [m²] in W of each point whose way from the root has covariances all along.

    The way to a point is a sum of vectors v that are turned by segments: an error δ of a segment's orientation moves
    the point by δ × v, errors of different sensors are independent, errors of the lengths act along the vectors.

    Parameters
    ----------
    points : point → (n, 3) [m], with all points on the way
    segment_cov : segment → (n, 3, 3) [rad²] in W
    lengths_cov : (8, 8) [m²] in the order of `LENGTHS`; zeros: known exactly
    """
    covariances: dict[str, np.ndarray] = {}
    if "torso" not in segment_cov:
        return covariances
    R_torso = Rotation.from_quat(quat_WL["torso"]).as_matrix()
    for side, sign in (("left", 0.5), ("right", -0.5)):
        hand = f"{side}_hand" if f"{side}_hand" in quat_WL else f"{side}_forearm"
        way = (  # point, the segment that turns the last vector, the length along it
            ("shoulder", "torso", ""),
            ("elbow", f"{side}_upper_arm", f"{side}_upper_arm"),
            ("wrist", f"{side}_forearm", f"{side}_forearm"),
            ("palm", hand, f"{side}_hand"),
        )
        vectors: dict[str, np.ndarray] = {}
        along = np.zeros((len(R_torso), 3, len(LENGTHS)))
        before = np.zeros((len(R_torso), 3))
        for point, segment, length in way:
            p = points.get(f"{side}_{point}")
            if p is None or segment not in segment_cov:
                break
            v = p - before
            vectors[segment] = vectors.get(segment, 0.0) + v
            if length:
                along[:, :, LENGTHS.index(length)] = v / np.linalg.norm(v, axis=1, keepdims=True)
            else:
                along[:, :, LENGTHS.index("trunk")] = R_torso[:, :, 2]
                along[:, :, LENGTHS.index("shoulder_width")] = sign * R_torso[:, :, 1]
            cov = along @ lengths_cov @ along.swapaxes(1, 2)
            for mover, vector in vectors.items():
                lever = _hats(vector)
                cov = cov + lever @ segment_cov[mover] @ lever.swapaxes(1, 2)
            covariances[f"{side}_{point}"] = cov
            before = p
    return covariances


def _hats(v: np.ndarray) -> np.ndarray:
    """[v]× (n, 3, 3) of vectors (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - out.swapaxes(1, 2)


def axis_std(cov: np.ndarray) -> np.ndarray:
    """One standard deviation (n,) of covariances (n, 3, 3): the root of the mean variance of the three axes."""
    return np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3.0)


# The table of pose.parquet and truth.parquet -----------------------------------------------------------------------


def pose_table(pose: Pose, covariance: bool = False) -> pl.DataFrame:
    """The columns of ``pose.parquet``.

    ``time``; ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`) and ``<segment>_std`` [rad]; ``<point>_x,_y,_z`` [m] in W and
    ``<point>_std`` [m]; with `covariance` ``<name>_cov_xx,_xy,_xz,_yy,_yz,_zz`` of each as well; ``<segment>_gap``.
    A standard deviation is that of one axis, the mean over the three (`axis_std`).
    """
    table = {"time": pose.time}
    for segment, quat in pose.quat_WL.items():
        table |= {f"{segment}_{c}": quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
        if segment in pose.segment_cov:
            table |= _confidence_columns(segment, pose.segment_cov[segment], covariance)
    for point, p in pose.points.items():
        table |= {f"{point}_{c}": p[:, k] for k, c in enumerate("xyz")}
        if point in pose.point_cov:
            table |= _confidence_columns(point, pose.point_cov[point], covariance)
    table |= {f"{segment}_gap": gap for segment, gap in pose.gap.items()}
    return pl.DataFrame(table)


def _confidence_columns(name: str, cov: np.ndarray, entries: bool) -> dict[str, np.ndarray]:
    columns = {f"{name}_std": axis_std(cov)}
    if entries:
        columns |= {f"{name}_cov_{'xyz'[i]}{'xyz'[j]}": cov[:, i, j] for i in range(3) for j in range(i, 3)}
    return columns


def pose_from_table(table: pl.DataFrame, file: str) -> Pose:
    """A `Pose` from such a table; segments and points that are not in it are not in the pose.

    Raises
    ------
    BadData
        No time, or nothing known beside it, or numbers that are no rotation.
    """
    if "time" not in table.columns:
        raise BadData(f"{file}: no column 'time'; a table as in pose.parquet is needed; {one_of(table.columns)}")
    try:
        numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in table.columns}
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{file}: a column holds text: {str(error).splitlines()[0]}") from error
    _check_numbers(numbers, file)
    quat_WL, points = {}, {}
    for segment in SEGMENTS:
        names = [f"{segment}_{c}" for c in ("qx", "qy", "qz", "qw")]
        if all(name in numbers for name in names):
            quat = np.column_stack([numbers[name] for name in names])
            norm = np.linalg.norm(quat, axis=1)
            if np.any(np.abs(norm - 1.0) > 1e-2):
                raise BadData(f"{file}: {segment}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
            quat_WL[segment] = quat / norm[:, None]
    for point in POINTS:
        names = [f"{point}_{c}" for c in "xyz"]
        if all(name in numbers for name in names):
            points[point] = np.column_stack([numbers[name] for name in names])
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as torso_qx … or left_palm_x … are needed")
    segment_cov = {name: _covariances(numbers, name) for name in quat_WL}
    point_cov = {name: _covariances(numbers, name) for name in points}
    gap = {name: numbers[f"{name}_gap"] > 0.0 for name in SEGMENTS if f"{name}_gap" in numbers}
    return Pose(
        numbers["time"],
        quat_WL,
        points,
        segment_cov={name: cov for name, cov in segment_cov.items() if cov is not None},
        point_cov={name: cov for name, cov in point_cov.items() if cov is not None},
        gap=gap,
    )


def _check_numbers(numbers: Mapping[str, np.ndarray], file: str) -> None:
    """Times that grow, and nothing beyond what a body can do; NaN is what is not known."""
    time = numbers["time"]
    if not len(time):
        raise BadData(f"{file}: no rows; a pose has at least one")
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise BadData(f"{file}: time does not grow from row to row; seconds that do are needed")
    for name, values in numbers.items():
        if name != "time" and not name.startswith((*SEGMENTS, *POINTS)):
            continue
        too_large = np.abs(values) > _LARGEST_NUMBER
        if too_large.any():
            row = int(np.argmax(too_large))
            raise BadData(f"{file}: {name} is {values[row]:g} in row {row + 1}; no pose has such a number")


def _covariances(numbers: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """Covariances (n, 3, 3) from a table: its entries, else those of the standard deviation, the same on all axes."""
    entries = {(i, j): f"{name}_cov_{'xyz'[i]}{'xyz'[j]}" for i in range(3) for j in range(i, 3)}
    if all(column in numbers for column in entries.values()):
        cov = np.empty((len(numbers["time"]), 3, 3))
        for (i, j), column in entries.items():
            cov[:, i, j] = cov[:, j, i] = numbers[column]
        return cov
    if f"{name}_std" in numbers:
        return numbers[f"{name}_std"][:, None, None] ** 2 * np.eye(3)
    return None
