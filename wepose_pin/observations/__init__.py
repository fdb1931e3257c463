"""What the segments of a body share: residuals that calibration and tracking both use, each written once.

Paths between points of the body and hinges are expressions in CasADi of segment orientations and of what is constant
about the person, so that CasADi gives their Jacobians. Here L' is the frame of a segment that equals W in the start
pose: of a person in the N-pose the segment's own frame L.

A point is the sum of the vectors of the links between it and the root (`BodyModel.reaches`). Each link rotates
with a segment that has a sensor, its own or the one above it with which it is rigid. Where points coincide, as joined
palms do, the path from one to the other is zero; its covariance weighs what is left of it. Girdles move the points.

The long axis of the segment below a hinge stays in the plane across the hinge's axis, within a range of angles. With n
the axis in the frame of the segment O above, and e the long axis of the segment M below, n · R_WOᵀ R_WM e = 0.

A sensor at r from a joint measures the joint's specific force and its own about it. In W, with uncorrected headings,

    f_joint = R_WS f_S − d²/dt² (R_WS r),

and both neighbours give the same, rotated about the vertical by the difference of their heading errors (Weygers and Kok
2020, IEEE Sensors Journal 20). A linear filter keeps that: it takes gravity's constant and what tissue shakes off both
sides. A force ε that is fixed in the sensor's frame is none of the joint's: gravity times a tilt that the orientation
filter has wrong, or the accelerometer's bias. In an even spin it turns with the sensor, as the joint's force does. An
accelerometer that averages over its sample is late by half of it against its gyroscope, by τ s. With a = (1, r, ε, τ)
each side is B a.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..body import BodyModel
from ..body.girdle import PARAMETERS, make_law
from ..body.kinematics import find_carrier
from ..body.mounts import StartPose
from ..body.soft_tissue import LEAST_TWIST_COSINE
from ..body.table import HingeJoint
from ..body.tree import UNIVERSE
from ..errors import BadSession
from ..rotations import product_terms

ZERO_LENGTH = 1e-12  # [m] below which a vector is zero; its derivatives by the lengths alike
BAND_HZ = (0.1, 1.5)  # what people move in
LEAST_RATE_HZ = 20.0  # of recordings that are used
# Where a sensor sits is known from its segment alone: in the middle, give or take this much on each axis; assumption.
LEVER_STD = 0.08  # [m]
LEVER_STD_OF_LENGTH = 0.3  # of the distance to the joint, on large bodies


# Quaternions xyzw -----------------------------------------------------------------------------------------------------


def product(a: Any, b: Any) -> Any:
    """Return ``a ⊗ b`` of quaternions (4,)."""
    return ca.vertcat(*product_terms(*ca.vertsplit(a), *ca.vertsplit(b)))  # type: ignore[no-untyped-call]


def rotate(quat: Any, v: Any) -> Any:
    """Return ``R v`` (3,) of a unit quaternion (4,) and a vector (3,)."""
    u, v = quat[:3], ca.vertcat(*v) if isinstance(v, tuple) else v
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def rotate_back(quat: Any, v: Any) -> Any:
    """Return ``Rᵀ v`` (3,) of a unit quaternion (4,) and a vector (3,)."""
    return rotate(ca.vertcat(-quat[:3], quat[3]), v)


def about_z(angle: Any) -> Any:
    """Return the unit quaternion (4,) of a rotation about z [rad]."""
    return ca.vertcat(0.0, 0.0, ca.sin(angle / 2.0), ca.cos(angle / 2.0))


def small_rotation(rotvec: Any) -> Any:
    """Return the unit quaternion (4,) of about `rotvec` (3,) [rad]: to third order of its size."""
    half = rotvec / 2.0
    return ca.vertcat(half, 1.0) / ca.sqrt(1.0 + ca.sumsqr(half))


def evaluate(function: ca.Function, *inputs: np.ndarray) -> list[np.ndarray]:
    """Return the outputs (n, …) of a function for inputs (n, m), or (m,) where one stands for all samples."""
    n = max(len(each) for each in inputs if each.ndim == 2)
    if not n:
        return [np.zeros((0, *function.size_out(i))) for i in range(function.n_out())]
    # CasADi's matrices are column by column, the samples side by side. Its own arrays would take five times as long.
    mapped = function.map(n)
    buffer, run = mapped.buffer()
    columns = [np.ascontiguousarray(np.broadcast_to(each, (n, each.shape[-1])), dtype=float) for each in inputs]
    outputs = [np.empty((n, *function.size_out(i)[::-1])) for i in range(function.n_out())]
    for i, values in enumerate(columns):
        buffer.set_arg(i, values.data)  # type: ignore[call-arg]
    for i, values in enumerate(outputs):
        buffer.set_res(i, values.data)  # type: ignore[call-arg]
    run()
    return [values.swapaxes(1, 2) for values in outputs]


# Paths ----------------------------------------------------------------------------------------------------------------


class PointPath:
    """The path from the root to a point, or between two points that coincide at times.

    Parameters
    ----------
    model, start : the body, with a person's lengths and girdles, and its start pose
    sensors : k segments with sensors
    points : each with the sign of its path from the root
    where : begins the text of errors

    Attributes
    ----------
    vectors : segment → (B (3, lengths), c (3,) [m]), the part B l + c of the path that rotates with it, in L'; that of
        `UNIVERSE` does not rotate. Segments are in the order of the table
    girdles : those that move the ends, each with the sign of its displacement

    Raises
    ------
    BadSession
        A link on the path has no sensor, and is not rigid with one that has.
    """

    def __init__(
        self,
        model: BodyModel,
        start: StartPose,
        sensors: Sequence[str],
        points: Collection[tuple[str, float]],
        where: str = "",
    ) -> None:
        self._model, self._start, self._sensors = model, start, sensors
        self.vectors: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.girdles: dict[str, float] = {}
        zero, links = (np.zeros((3, len(model.lengths))), np.zeros(3)), dict[str, tuple[np.ndarray, np.ndarray]]()
        for point, sign in points:
            for link, (by_length, constant) in model.reaches[point].items():
                B, c = links.get(link, zero)
                links[link] = B + sign * by_length, c + sign * constant
            for name in model.point_girdles[point]:
                self.girdles[name] = self.girdles.get(name, 0.0) + sign
        sums: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for link, vector in links.items():
            if not _is_zero(*vector):
                carrier = UNIVERSE if link == UNIVERSE else find_carrier(model, link, sensors)
                if carrier is None:
                    places = " and ".join(point for point, _ in points)
                    what = "sensors." if link in model.table.segments else "a segment with a sensor behind joint "
                    raise BadSession(
                        f"{where}{what}{link} is missing: without it the place of {places} is not known; add it, or "
                        f"use a protocol without that point, or another body (`model`)"
                    )
                (B, c), R = sums.get(carrier, zero), start.rotation(link)
                sums[carrier] = B + R @ vector[0], c + R @ vector[1]
        for carrier in sorted(sums, key=[UNIVERSE, *model.table.segments].index):
            if not _is_zero(*sums[carrier]):
                self.vectors[carrier] = sums[carrier]
        self.girdles = {name: sign for name, sign in self.girdles.items() if sign}

    @property
    def segments(self) -> list[str]:
        """Those whose vectors lie on the path."""
        return [segment for segment in self.vectors if segment != UNIVERSE]

    def express(
        self, quat_WL: Mapping[str, ca.SX], lengths: ca.SX, girdles: Mapping[str, ca.SX]
    ) -> tuple[ca.SX, dict[str, ca.SX]]:
        """Return the path (3,) [m] in W, and its vectors, segment → (3,) [m], without the girdles.

        Parameters
        ----------
        quat_WL : segment → (4,) xyzw of L'
        lengths : (k,) [m], in the order of the table
        girdles : of those with sensors on both their segments, a person's parameters (7,)
        """
        whole, vectors = ca.SX.zeros(3), {}
        for name, sign in self.girdles.items():
            if name in girdles:
                whole += sign * self._displace(name, quat_WL, girdles[name])
        for segment, (B, c) in self.vectors.items():
            vector = ca.sparsify(ca.DM(B)) @ lengths + ca.DM(c)
            if segment != UNIVERSE:
                vectors[segment] = vector = rotate(quat_WL[segment], vector)
            whole += vector
        return whole, vectors

    def _displace(self, name: str, quat_WL: Mapping[str, ca.SX], parameters: ca.SX) -> ca.SX:
        """Return the displacement (3,) [m] in W of the point that a girdle moves, by a person's parameters (7,)."""
        table, start = self._model.table, self._start
        girdle = table.girdles[name]
        R_on, scale = ca.DM(start.rotation(girdle.on)), girdle.find_scale(self._model.lengths)
        along_W = rotate(quat_WL[girdle.moves], start.turn(girdle.moves, table.segments[girdle.moves].along))
        along = R_on.T @ rotate_back(quat_WL[girdle.on], along_W)
        law = make_law(ca.sqrt, ca.arctan2, ca.fmin, ca.exp)
        *by_law, raised = law(girdle.law, *ca.vertsplit(along), scale)
        own = (1.0 + parameters[0]) * ca.vertcat(*by_law) + parameters[1:4] + raised * parameters[4:]
        return rotate(quat_WL[girdle.on], R_on @ own)

    def linearize(self, quat_WL: np.ndarray, headings: np.ndarray) -> tuple[np.ndarray, ...]:
        """Linearize the path, between two points their gap, of orientations (n, k, 4) at heading errors (k,) [rad].

        Returns
        -------
        gap : (n, 3) [m] in W
        H : (n, 3, k) [m/rad] its slope by the headings
        by_shape : (n, 3, m) by the lengths and the girdles' parameters, as in `Subject.shape_covariance`
        by_attitude : (n, 3, 3) [m²] its covariance by errors of 1 rad of each orientation about each axis
        off_law : (n, 3, 3) [m²] its covariance by shoulders that leave the law of their girdles
        """
        function, shape = self._linearization
        gap, *others = evaluate(function, quat_WL.reshape(len(quat_WL), -1), headings, shape)
        return gap[:, :, 0], *others

    @cached_property
    def _linearization(self) -> tuple[ca.Function, np.ndarray]:
        """The rows of a sample as a function of quaternions, headings and shape, and the person's shape."""
        model, table, k, n = self._model, self._model.table, len(self._sensors), len(self._model.lengths)
        own_shape = np.concatenate([list(model.lengths.values()), *map(model.girdle_parameters, table.girdles)])
        quat, headings, shape = ca.SX.sym("quat", 4 * k), ca.SX.sym("headings", k), ca.SX.sym("shape", len(own_shape))
        parameters = dict(zip(table.girdles, ca.vertsplit(shape[n:], len(PARAMETERS)), strict=True))
        quat_WL = {name: product(about_z(headings[i]), quat[4 * i : 4 * i + 4]) for i, name in enumerate(self._sensors)}
        girdles = {name: parameters[name] for name in find_girdles(model, self._sensors)}
        gap, vectors = self.express(quat_WL, shape[:n], girdles)
        off_law = ca.SX.zeros(3, 3)
        for name in self.girdles:
            girdle = table.girdles[name]
            for axis, std in zip(self._start.rotation(girdle.on).T, girdle.residual_std, strict=True):
                off = std * rotate(quat_WL[girdle.on], ca.DM(axis))
                off_law += off @ off.T
        by_attitude = express_covariance(vectors, 0.0, dict.fromkeys(vectors, 1.0))
        rows = [gap, ca.jacobian(gap, headings), ca.jacobian(gap, shape), by_attitude, off_law]
        outputs = [ca.densify(each) for each in rows]
        return ca.Function("rows", [quat, headings, shape], outputs, {"cse": True}), own_shape


def _is_zero(*vector: np.ndarray) -> bool:
    return all(bool(np.all(np.abs(part) <= ZERO_LENGTH)) for part in vector)


def find_girdles(model: BodyModel, sensors: Collection[str]) -> tuple[str, ...]:
    """Find the girdles of the body whose two segments both have sensors."""
    return tuple(name for name, girdle in model.table.girdles.items() if {girdle.on, girdle.moves} <= set(sensors))


def express_covariance(vectors: Mapping[str, ca.SX], slip: float, attitude_std: Mapping[str, float]) -> ca.SX:
    """Return the covariance (3, 3) [m²] of a path by errors of its orientations, and by points that slip.

    Parameters
    ----------
    vectors : as of `PointPath.express`
    slip : [m] one standard deviation, each axis, by which the points do not coincide
    attitude_std : segment → [rad] of its orientation about each axis
    """
    covariance = slip**2 * ca.SX.eye(3)
    for segment, v in vectors.items():
        # An error of variance σ² about each axis moves the end by a vector of this covariance.
        covariance += attitude_std[segment] ** 2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
    return covariance


# Hinges ---------------------------------------------------------------------------------------------------------------


def express_deviation(
    hinge: HingeJoint, quat_on: ca.SX, quat_moves: ca.SX, error: ca.SX, per_twist: ca.SX | float
) -> ca.SX:
    """Return the sine of the angle by which `moves` leaves the hinge's plane, beyond `per_twist` of its own twist.

    The axis is off by `error` (2,) [rad] along `across` and `tilted`.
    """
    along = rotate_back(quat_on, rotate(quat_moves, hinge.along))
    axis = ca.DM(hinge.axis) + ca.horzcat(ca.DM(hinge.across), ca.DM(hinge.tilted)) @ error
    return ca.dot(axis, along) / ca.norm_2(axis) - per_twist * express_twist(quat_on, quat_moves, hinge.along)


def express_twist(quat_on: ca.SX, quat_moves: ca.SX, along: Sequence[float]) -> ca.SX:
    """Return the sine of the twist of `moves` against `on` about its long axis `along` (3,)."""
    relative = product(ca.vertcat(-quat_on[:3], quat_on[3]), quat_moves)
    part, w = ca.dot(relative[:3], ca.DM(along)), relative[3]
    return 2.0 * part * w / ca.fmax(part**2 + w**2, LEAST_TWIST_COSINE)


def linearize_hinge(
    hinge: HingeJoint, quat_on: np.ndarray, quat_moves: np.ndarray, headings: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linearize a hinge of orientations (n, 4) at heading errors (2,) or (n, 2) [rad] of `moves` and `on`.

    Returns
    -------
    r : (n,) [rad] out of the hinge's plane
    H : (n, 4) its slope by the headings of `moves` and `on`, and by the axis along `across` and `tilted`
    excess : (n,) [rad] beyond the hinge's range
    """
    r, H, excess = evaluate(_linearization(hinge), quat_on, quat_moves, headings)
    return r[:, 0, 0], H[:, 0], excess[:, 0, 0]


@lru_cache(maxsize=128)
def _linearization(hinge: HingeJoint) -> ca.Function:
    """Return the rows of a sample as a function of both quaternions and both headings."""
    on, moves = ca.SX.sym("on", 4), ca.SX.sym("moves", 4)
    headings, error = ca.SX.sym("headings", 2), ca.SX.sym("error", 2)
    quat_on, quat_moves = product(about_z(headings[1]), on), product(about_z(headings[0]), moves)
    r = express_deviation(hinge, quat_on, quat_moves, error, hinge.per_twist)
    H = ca.jacobian(r, ca.vertcat(headings, error))
    r, H = ca.substitute([r, H], [error], [ca.DM.zeros(2)])
    along = rotate_back(quat_on, rotate(quat_moves, hinge.along))
    sine, cosine = -ca.dot(ca.DM(hinge.across), along), ca.dot(ca.DM(hinge.along_on), along)
    middle, half = 0.5 * (hinge.range[0] + hinge.range[1]), 0.5 * (hinge.range[1] - hinge.range[0])
    off = ca.atan2(sine, cosine) - middle
    off -= 2.0 * np.pi * ca.floor(off / (2.0 * np.pi) + 0.5)
    rows = [ca.densify(value) for value in (r, H, ca.fmax(ca.fabs(off) - half, 0.0))]
    return ca.Function("hinge", [on, moves, headings], rows, {"cse": True})


def find_hinges(model: BodyModel, start: StartPose, sensors: Collection[str]) -> tuple[HingeJoint, ...]:
    """Find the hinges of the body whose two segments both have sensors, with the axes of its table in L'."""
    segments = model.table.segments
    return tuple(
        hinge._replace(
            name=name,
            axis=start.turn(hinge.on, hinge.axis),
            along_on=start.turn(hinge.on, segments[hinge.on].along),
            along=start.turn(hinge.moves, segments[hinge.moves].along),
        )
        for name, hinge in model.table.hinges.items()
        if {hinge.on, hinge.moves} <= set(sensors)
    )


# Accelerations of joints ----------------------------------------------------------------------------------------------


def linearize_joint(
    near_B: np.ndarray, far_B: np.ndarray, angle: float, near: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the misfit of m samples of a joint's specific force between its two sensors, and its Jacobian.

    Parameters
    ----------
    near_B, far_B : (m, 3, 1 + p) sides of the two sensors, the first p + 1 columns of `compute_sides`, filtered alike
    angle : [rad] turns the near side about the vertical into the far one
    near, far : (p,) lever r [m], force ε [m/s²] and delay τ [s] of each sensor, or the lever alone

    Returns
    -------
    e : (m, 3) [m/s²] the far side less the near one, in the far one's W
    jacobian : (m, 3, 1 + 2 p) of e by the angle and by the parts of `near` and `far`
    force : (m, 3) [m/s²] of the joint by the near sensor, in the far one's W
    """
    c, s = np.cos(angle), np.sin(angle)
    turned_B = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ near_B
    force = turned_B[:, :, 0] + turned_B[:, :, 1:] @ near
    jacobian = np.empty((len(force), 3, 1 + len(near) + len(far)))
    jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 2, 0] = force[:, 1], -force[:, 0], 0.0
    jacobian[:, :, 1 : 1 + len(near)], jacobian[:, :, 1 + len(near) :] = -turned_B[:, :, 1:], far_B[:, :, 1:]
    return far_B[:, :, 0] + far_B[:, :, 1:] @ far - force, jacobian, force


def compute_sides(R_WS: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> np.ndarray:
    """Compute the side B (n − 2, k, 3, 8) of each sensor at its joints, of all samples but the first and the last one.

    Parameters
    ----------
    R_WS, accel_S : (n, k, 3, 3), (n, k, 3) [m/s²]
    """
    force_S, R = accel_S[..., None], R_WS[1:-1]
    change_S = 0.5 * rate_hz * (force_S[2:] - force_S[:-2])
    second = rate_hz**2 * (R_WS[2:] - 2.0 * R + R_WS[:-2])
    return np.concatenate([R @ force_S[1:-1], -second, R, R @ change_S], axis=3)


def find_neighbours(model: BodyModel, sensors: Collection[str]) -> list[tuple[str, str]]:
    """Find the segments with sensors that share a joint, the one nearer the root first; nothing moves between them."""
    pairs = []
    for far in model.table.segments:
        above = model.parents.get(far) if far in sensors else None
        near = None if above is None else find_carrier(model, above, tuple(sensors))
        if near is not None:
            pairs.append((near, far))
    return pairs


def find_joint_pairs(
    model: BodyModel, quat_LS: Mapping[str, np.ndarray]
) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray]:
    """Find the joints between two sensors, by the mounts (4,) xyzw of all sensors.

    Returns
    -------
    pairs : p pairs of segments with the sensors, the one nearer the root first
    levers : (p, 6) [m] usual ones from the joint to the near sensor and to the far one, each in its own S
    lever_std : (p,) [m] of each
    """
    data, pairs = model.pin.createData(), find_neighbours(model, quat_LS)
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    placement = {name: data.oMf[model.pin.getFrameId(name)] for name in (*model.parents, *model.point_frames.values())}
    spine = {name for name, segment in model.table.segments.items() if segment.spine}
    levers, std = np.empty((len(pairs), 6)), np.empty(len(pairs))
    for i, (near, far) in enumerate(pairs):
        joint_W = placement[near if far in spine else far].translation
        levers_W = [_locate_sensor(model, name, placement, spine) - joint_W for name in (near, far)]
        R_WS = [placement[name].rotation @ Rotation.from_quat(quat_LS[name]).as_matrix() for name in (near, far)]
        std[i] = max(LEVER_STD, LEVER_STD_OF_LENGTH * max(float(np.linalg.norm(lever)) for lever in levers_W))
        levers[i] = np.concatenate([R.T @ lever for R, lever in zip(R_WS, levers_W, strict=True)])
    return pairs, levers, std


def _locate_sensor(
    model: BodyModel, segment: str, placement: Mapping[str, pin.SE3], spine: Collection[str]
) -> np.ndarray:
    """Return the usual place (3,) [m] of a segment's sensor in W, all joints at zero: amid the segment's joints."""
    children = [name for name, above in model.parents.items() if above == segment and name not in spine]
    ends = [placement[name].translation for name in children]
    if segment in spine and ends:
        return np.asarray(np.mean(ends, axis=0))  # at the height of the shoulders, or of the hips
    if not ends:
        m = model.pin
        joint = m.frames[m.getFrameId(segment)].parentJoint
        links = model.point_frames.values()
        reached = [link for link in links if joint in m.supports[m.frames[m.getFrameId(link)].parentJoint]]
        ends = [placement[link].translation for link in reached]
    return np.asarray(np.mean([placement[segment].translation, *ends], axis=0))
