"""Segment orientations → configuration and pose of a body: exactly where its joints can, else as near as they come.

A segment on a spherical joint has its orientation: the joint takes the rotation relative to the measured segment above.
In a spine of several joints each place takes an equal share of the tilt, and the spherical joint nearest to the segment
takes what they leave, with it the turn about the vertical: a whole turn of the person does not twist the spine.

All else is one least-squares fit within the limits of the joints (`_Fit`): a limb that has fewer axes somewhere, with
all its segments; a spine without a spherical joint, with all that hangs on it; all joints of a mechanism. Girdles
follow the limbs.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..compilation import kernel
from ..errors import BadData, BadModel
from ..rotations import conjugate, exp, log, multiply, product, rotation_about, unwrap_signs
from .body import BodyModel
from .girdle import follow_law
from .kinematics import Pose, compute_joint_values, compute_link_poses, describe_girdle, find_columns, find_known_points
from .table import check_segments

_MEET_TOLERANCE = 1e-6  # [m] between joints of one place
_ROUNDS = 100  # of a fit; two to four are the rule from the frame before
_STEP = 1e-6  # [rad] at which a frame is fitted
_DAMPING, _MOST_DAMPING = 1e-7, 1e6  # the least; the greatest ends a search that finds nothing better
_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def solve_configuration(model: BodyModel, quat_WL: Mapping[str, np.ndarray]) -> np.ndarray:
    """Solve for `q` (n, nq) with the measured orientations, segment → (n, 4) xyzw, or the nearest configuration.

    An unmeasured segment is rigid with the one above. Joints with one axis stay within their limits.
    """
    return KinematicsSolver(model, quat_WL).solve(np.stack(list(quat_WL.values()), axis=1))


def compute_pose(model: BodyModel, time: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> Pose:
    """Compute the pose of `model` from segment orientations, as `solve_configuration` takes them."""
    solver = KinematicsSolver(model, quat_WL)
    return solver.solve_chunk(time, np.stack(list(quat_WL.values()), axis=1))


class KinematicsSolver:
    """Configurations and poses from orientations, chunk by chunk or one after another: each continues the last.

    Parameters
    ----------
    segments : the measured ones, in the order in which orientations come
    start : (nq,) the configuration of a mechanism before the first frame; None: all joints at zero

    Attributes
    ----------
    points : names of the known points
    data : Pinocchio's data of the last pose of `compute_points`
    """

    def __init__(self, model: BodyModel, segments: Collection[str], *, start: np.ndarray | None = None) -> None:
        if not segments:
            raise BadData("no segment has an orientation: a pose needs one")
        check_segments(model.table, segments, f"{model.pin.name}: ", BadModel)
        m, is_mechanism = model.pin, model.table.is_mechanism
        self._model, self.segments, self._neutral = model, tuple(segments), pin.neutral(m)
        self._last: np.ndarray | None = None  # (nq,) of the frame before
        fitted = _find_fitted(model, segments)
        joints = sorted({joint for name in fitted for joint in model.chains[name]})
        if is_mechanism:
            self._last, joints = self._neutral if start is None else start, list(range(1, m.njoints))
        self._fit = _Fit(model, fitted, self.segments, joints) if fitted else None
        exact = [name for name in self.segments if not is_mechanism and model.find_spherical(name) is not None]
        relations = [_relate(model, name, self.segments) for name in exact]
        self._bent = [relation for relation in relations if len(relation[3]) > 1]
        spherical = [
            (row, above, R.inv().as_quat(), (R_AL.inv() * R).as_quat(), m.idx_qs[joint])
            for row, above, R_AL, R_AJ, _ in relations
            for joint, R in R_AJ.items()
            if len(R_AJ) == 1
        ]
        self._spherical = tuple(np.array(column) for column in zip(*spherical, strict=True))
        self._girdles = [
            (describe_girdle(model, name, self.segments), np.array([m.idx_qs[m.getJointId(j)] for j in girdle.joints]))
            for name, girdle in model.table.girdles.items()
            if girdle.on in segments
        ]
        self.points, self.data = tuple(find_known_points(model, segments)), m.createData()
        self._frames = [model.point_frames[point] for point in self.points]
        self._views = [self.data.oMf[m.getFrameId(frame)].translation for frame in self._frames]
        self._last_quats: dict[str, np.ndarray] = {}

    def solve(self, quat_WL: np.ndarray) -> np.ndarray:
        """Solve for `q` (n, nq) of orientations (n, k, 4) xyzw; they continue the motion of the last call."""
        q = np.empty((len(quat_WL), len(self._neutral)))
        q[:] = self._neutral
        last = np.zeros_like(self._neutral) if self._last is None else self._last
        if self._spherical:
            _set_relative_rotations(quat_WL, *self._spherical, last, q)
        for relation in self._bent:
            _bend(self._model.pin, q, quat_WL, relation, last)
        if self._fit is not None:
            self._fit.run(q, quat_WL, self._last)
        for girdle, at in self._girdles:
            motion = np.empty((len(q), 7))
            follow_law(quat_WL, *girdle, motion)
            q[:, at] = motion[:, :3]
        self._last = q[-1].copy()
        return q

    def solve_chunk(self, time: np.ndarray, quat_WL: np.ndarray) -> Pose:
        """Compute the pose of the next chunk: `time` (n,) [s], orientations (n, k, 4) xyzw of the segments."""
        q, joints, columns = self.solve(quat_WL), {}, list(quat_WL.swapaxes(0, 1))
        is_mechanism = self._model.table.is_mechanism
        links = [*self._frames, *(self.segments if is_mechanism else ())]
        R_WL, p_W = compute_link_poses(self._model, q, links, rotations=is_mechanism)
        if is_mechanism:
            columns = [Rotation.from_matrix(R).as_quat() for R in R_WL[:, len(self._frames) :].swapaxes(0, 1)]
            joints = compute_joint_values(self._model.pin, q)
        points = {point: p_W[:, k] for k, point in enumerate(self.points)}
        named = zip(self.segments, columns, strict=True)
        quats = {name: unwrap_signs(quat, self._last_quats.get(name)) for name, quat in named}
        self._last_quats = {name: quat[-1].copy() for name, quat in quats.items()}
        return Pose(time, quats, points, q, joints=joints)

    def compute_points(self, quat_WL: np.ndarray) -> np.ndarray:
        """Compute the points (p, 3) [m] in W of the next pose, from `quat_WL` (k, 4) xyzw."""
        pin.framesForwardKinematics(self._model.pin, self.data, self.solve(quat_WL[None])[0])
        return np.array(self._views)

    def orient_segments(self, quat_WL: np.ndarray) -> np.ndarray:
        """Return the orientations (k, 4) xyzw of the last pose, from the measured `quat_WL`: as `Pose` has them."""
        if not self._model.table.is_mechanism:
            return quat_WL
        frames = [self.data.oMf[self._model.pin.getFrameId(segment)] for segment in self.segments]
        fitted = Rotation.from_matrix([frame.rotation for frame in frames]).as_quat()
        return np.where(np.einsum("ki,ki->k", fitted, quat_WL)[:, None] < 0.0, -fitted, fitted)


def _find_fitted(model: BodyModel, measured: Collection[str]) -> list[str]:
    """Find the fitted segments: all of a mechanism, of a limb with too few axes, and what hangs on such a spine."""
    if model.table.is_mechanism:
        return list(measured)
    limb: dict[str, str] = {}  # segment → the first of its limb; one of the spine is its own
    for name in model.chains:
        above = model.parents[name]
        spine = above is None or any(model.table.segments[each].spine for each in (name, above))
        limb[name] = name if spine or above is None else limb[above]
    inexact = {limb[name] for name in measured if model.chains[name] and model.find_spherical(name) is None}
    fitted: list[str] = []
    for name in model.chains:
        if name in measured and (limb[name] in inexact or model.parents[name] in fitted):
            fitted.append(name)
    return fitted


# How a segment L hangs on the measured segment A above, or on W: rows of L and A (-1: W) in orientations; R_AL, and
# R_AJ of its joints up to the spherical one, with all joints at zero; and in how many places these are.
_Relation = tuple[int, int, Rotation, dict[int, Rotation], int]


def _relate(model: BodyModel, segment: str, segments: Sequence[str]) -> _Relation:
    m, data, above = model.pin, model.pin.createData(), model.parents[segment]
    while above is not None and not (above in segments and model.chains[above]):
        above = model.parents[above]
    pin.forwardKinematics(m, data, pin.neutral(m))
    R_AW = np.eye(3) if above is None else model.neutral_rotations[above].T
    R_AL = Rotation.from_matrix(R_AW @ model.neutral_rotations[segment])
    last = model.find_spherical(segment) or 0
    joints = [joint for joint in model.chains[segment] if joint <= last]
    R_AJ = {joint: Rotation.from_matrix(R_AW @ data.oMi[joint].rotation) for joint in joints}
    steps = np.diff([data.oMi[joint].translation for joint in joints], axis=0)
    places = 1 + int(np.count_nonzero(np.linalg.norm(steps, axis=1) > _MEET_TOLERANCE))
    return segments.index(segment), -1 if above is None else segments.index(above), R_AL, R_AJ, places


def _bend(m: pin.Model, q: np.ndarray, quat_WL: np.ndarray, relation: _Relation, last: np.ndarray) -> None:
    """Write the joints' values into `q` (n, nq): an equal share of the tilt in each place, the rest in the last."""
    row, above, R_AL, R_AJ, places = relation
    R_WA, up = quat_WL[:, above] if above >= 0 else _IDENTITY, R_AL.apply([0.0, 0.0, 1.0])
    left = multiply(multiply(conjugate(R_WA), quat_WL[:, row]), R_AL.inv().as_quat())
    # The turn about the vertical before the tilt is taken off; upside down no turn is better than another.
    turn = np.column_stack([np.outer(left[:, :3] @ up, up), left[:, 3]])
    turn[np.linalg.norm(turn, axis=1) < 1e-9] = _IDENTITY
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    share = 1.0 / places * log(multiply(left, conjugate(turn)))  # (n, 3)
    for k, (joint, R) in enumerate(R_AJ.items(), start=1):
        at = m.idx_qs[joint]
        if m.nqs[joint] == 4:
            rotation = exp(share) if k < len(R_AJ) else left
            quat = multiply(multiply(R.inv().as_quat(), rotation), R.as_quat())
            q[:, at : at + 4] = unwrap_signs(quat, last[at : at + 4])
        else:
            axis = R.apply(m.joints[joint].extract().axis)
            q[:, at] = np.clip(share @ axis, m.lowerPositionLimit[at], m.upperPositionLimit[at])
            rotation = rotation_about(axis, q[:, at])
        left = multiply(conjugate(rotation), left)


@kernel
def _set_relative_rotations(quat, rows, above, left, right, at, last, q):  # type: ignore[no-untyped-def]
    """Write R_JA R_AW R_WL R_LJ of each joint into `q` (n, nq), from `quat` (n, k, 4) xyzw.

    `rows`, `above` are of L and A (-1: W) in `quat`, `left` R_JA and `right` R_LJ at zero, `at` its place in `q`. Each
    lies on one side with that of the row before, which for the first is `last` (nq,).
    """
    for j in range(len(rows)):
        for i in range(len(quat)):
            x, y, z, w = left[j, 0], left[j, 1], left[j, 2], left[j, 3]
            if above[j] >= 0:
                a = quat[i, above[j]]
                x, y, z, w = product(x, y, z, w, -a[0], -a[1], -a[2], a[3])
            b = quat[i, rows[j]]
            x, y, z, w = product(x, y, z, w, b[0], b[1], b[2], b[3])
            x, y, z, w = product(x, y, z, w, right[j, 0], right[j, 1], right[j, 2], right[j, 3])
            scale, k, before = 1.0 / np.sqrt(x * x + y * y + z * z + w * w), at[j], last if i == 0 else q[i - 1]
            if before[k] * x + before[k + 1] * y + before[k + 2] * z + before[k + 3] * w < 0.0:
                scale = -scale
            q[i, k], q[i, k + 1], q[i, k + 2], q[i, k + 3] = x * scale, y * scale, z * scale, w * scale


class _Fit:
    """Configurations in which links come nearest to orientations: the sum over the links of angle² is least.

    Gauss-Newton with Levenberg's damping on Pinocchio's Jacobian, each frame from the solution of the one before;
    spherical joints of a person begin where they follow exactly. Limits are kept by projection (Bertsekas 1982,
    "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control 20:221). Joints that
    the links do not determine move as little as possible from frame to frame.

    Parameters
    ----------
    links, joints : the fitted ones of the measured `segments`; those that may move
    """

    def __init__(self, body: BodyModel, links: Sequence[str], segments: Sequence[str], joints: Sequence[int]) -> None:
        m = body.pin
        self._rows = [segments.index(link) for link in links]
        self._model, self._data = m, m.createData()
        frames = [m.frames[m.getFrameId(link)] for link in links]
        # The joint's frame is compared in place of the link's, which is fixed to it: its rotation comes for nothing.
        self._R_LJ = np.array([frame.placement.rotation.T for frame in frames])
        self._views = [self._data.oMi[frame.parentJoint].rotation for frame in frames]
        self._columns = find_columns(m, joints)
        moves = np.zeros((len(links), m.nv), dtype=bool)
        for k, frame in enumerate(frames):
            moves[k, find_columns(m, m.supports[frame.parentJoint].tolist()[1:])] = True
        self._pull = moves[:, self._columns].astype(float).T  # (f, m): which links a column turns
        self._both = self._pull @ self._pull.T  # (f, f): how many links two columns both turn
        begin = [j for j in joints if body.table.is_mechanism or m.nqs[j] == 1]  # where they were in the frame before
        self._places = np.array([m.idx_qs[j] + k for j in begin for k in range(m.nqs[j])], dtype=int)
        bounded = [j for j in joints if m.nqs[j] == 1]
        self._at = np.array([m.idx_qs[joint] for joint in bounded], dtype=int)
        self._lower, self._upper = m.lowerPositionLimit[self._at], m.upperPositionLimit[self._at]
        self._bounded = np.searchsorted(self._columns, find_columns(m, bounded))

    def run(self, q: np.ndarray, quat_WL: np.ndarray, last: np.ndarray | None) -> None:
        """Write the joints that may move into `q` (n, nq), from `quat_WL` (n, k, 4) xyzw and the `last` frame (nq,)."""
        quat = quat_WL[:, self._rows].reshape(-1, 4)
        targets = Rotation.from_quat(quat).as_matrix().reshape(len(q), -1, 3, 3) @ self._R_LJ
        for k, R in enumerate(targets):
            if last is not None:
                q[k, self._places] = last[self._places]
            last = q[k] = self._solve(self._keep_limits(q[k].copy()), R)

    def _keep_limits(self, q: np.ndarray) -> np.ndarray:
        q[self._at] = np.clip(q[self._at], self._lower, self._upper)
        return q

    def _compare(self, q: np.ndarray, R_target: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute what is left: the sum of squared angles [rad²], and the rotation vectors (m, 3) in W."""
        pin.computeJointJacobians(self._model, self._data, q)
        e = np.array([pin.log3(R @ view.T) for R, view in zip(R_target, self._views, strict=True)])
        return float(np.sum(e * e)), e

    def _solve(self, q: np.ndarray, R_target: np.ndarray) -> np.ndarray:
        left, e = self._compare(q, R_target)
        damping, step = _DAMPING, np.zeros(self._model.nv)
        for _ in range(_ROUNDS):
            J = self._data.J.reshape(6, -1)[3:, self._columns]
            g = np.einsum("if,fi->f", J, self._pull @ e)  # downhill; exact, as log(R)ᵀ is its own under its Jacobian
            free = np.ones(len(g), dtype=bool)
            push, value = g[self._bounded], q[self._at]
            free[self._bounded] = ~((value <= self._lower) & (push < 0.0) | (value >= self._upper) & (push > 0.0))
            rows = np.flatnonzero(free)
            H = ((J.T @ J) * self._both)[np.ix_(rows, rows)]
            less = np.inf
            while less > left and damping <= _MOST_DAMPING:
                step[:] = 0.0
                step[self._columns[rows]] = np.linalg.solve(H + damping * np.eye(len(rows)), g[rows])
                tried = self._keep_limits(pin.integrate(self._model, q, step))
                less, new = self._compare(tried, R_target)
                damping *= 10.0
            if less > left:
                break
            q, left, e = tried, less, new
            damping = max(_DAMPING, 0.01 * damping)
            if np.abs(step).max() < _STEP:
                break
        return q


def compute_orientation_residuals(
    model: BodyModel, q: np.ndarray, quat_WL: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Compute segment → angle (n,) [rad] between its measured orientation and that of the model in `q`.

    Only for segments whose orientation the joints cannot reproduce exactly; for all of a mechanism.
    """
    fitted = _find_fitted(model, quat_WL)
    limited = [k for k in model.chains if k in quat_WL and (k in fitted or model.find_spherical(k) is None)]
    R_WL, _ = compute_link_poses(model, q, limited)
    return {
        segment: (Rotation.from_matrix(R_WL[:, k]).inv() * Rotation.from_quat(quat_WL[segment])).magnitude()
        for k, segment in enumerate(limited)
    }
