"""The unknowns of a calibration and the residuals of its samples, with their Jacobian; `solver` minimises them.

For each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. With a
start pose that is ε off the N-pose, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R_WL(t) = Rz(ψ + d τ + s) Q(t) Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))

with ψ the heading, d its drift since the start, s its steps where samples were lost since (`losses`), and A the
soft-tissue artefact: soft tissue rotates a sensor as the direction of gravity in the segment changes. The line between
the shoulders is the torso's y except for a rotation by collarbones and shoulder blades while the arms are raised. That
rotation, d, s, A and the hinges are nuisance parameters: the covariance of lengths and mounts includes their effect.

A sample is one of the protocol's condition that holds then. A closure gives the gap, whitened by the covariance that
errors of the orientations and slipping palms give it, which makes it as homogeneous in the lengths as the gap itself
(see `lengths`), and of each elbow by how much the forearm leaves the plane of its hinge. A pose gives the deviation of
a segment from its stated direction, an axis its deviation from the level. Each sample has the same five residuals:
three of its condition and two elbows; those that do not apply are zero.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import SEGMENT_ATTITUDE_STD
from .chain import LENGTHS, SIDES, about_z, inverse, links, product, rotate, small_turn
from .protocols import Closure, Condition, Direction, coefficients

HINGE_STD = np.deg2rad(2.0)  # [rad] of the forearm against the elbow's plane
K = len(LENGTHS)


class Layout(NamedTuple):
    """The places of the unknowns in x.

    Parameters
    ----------
    sensors : of the chain, in its order
    fixed : how many unknown points
    distance_names : of the unknown distances outside the body
    steps : the sensor of each heading step
    """

    sensors: tuple[str, ...]
    fixed: int = 0
    distance_names: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()

    @property
    def heading(self) -> slice:
        """ψ [rad] of each sensor."""
        return slice(K, K + len(self.sensors))

    @property
    def tilt(self) -> slice:
        """ε about x, y of L [rad] of each sensor: how far its segment is off the start pose."""
        return slice(self.heading.stop, self.heading.stop + 2 * len(self.sensors))

    @property
    def drift(self) -> slice:
        """d [rad/s] of each sensor's heading."""
        return slice(self.tilt.stop, self.tilt.stop + len(self.sensors))

    @property
    def hinge(self) -> slice:
        """Of each elbow's axis (x, 1, z) in the upper arm's frame: x, z, left then right."""
        return slice(self.drift.stop, self.drift.stop + 4)

    @property
    def soft_tissue(self) -> slice:
        """A (3, 3) of each sensor, column by column [rad]."""
        return slice(self.hinge.stop, self.hinge.stop + 9 * len(self.sensors))

    @property
    def shoulders(self) -> slice:
        """Rotation of the line between the shoulders about the torso's z [rad]."""
        return slice(self.soft_tissue.stop, self.soft_tissue.stop + 1)

    @property
    def points(self) -> slice:
        """Unknown points of W (3,) each [m]."""
        return slice(self.shoulders.stop, self.shoulders.stop + 3 * self.fixed)

    @property
    def distances(self) -> slice:
        """Distances outside the body [m]."""
        return slice(self.points.stop, self.points.stop + len(self.distance_names))

    @property
    def step(self) -> slice:
        """Steps of headings [rad]."""
        return slice(self.distances.stop, self.distances.stop + len(self.steps))

    @property
    def size(self) -> int:
        return self.step.stop

    @property
    def rows(self) -> int:
        """Length of a sample's data."""
        return 4 * len(self.sensors) + len(self.steps) + 1

    @property
    def arms(self) -> tuple[str, ...]:
        """Sides whose elbow has a sensor above and below."""
        return tuple(s for s in SIDES if {f"{s}_upper_arm", f"{s}_forearm"} <= set(self.sensors))


class Gaussian(NamedTuple):
    """A Gaussian over x."""

    mean: np.ndarray  # (m,)
    information: np.ndarray  # (m, m)


@dataclass(frozen=True)
class Observations:
    """n samples, each of one condition."""

    layout: Layout
    data: np.ndarray  # (rows, n): Q of each sensor xyzw, whether it is beyond each step, [s] since the start pose
    conditions: tuple[Condition, ...]
    condition_index: np.ndarray  # (n,) of each sample's condition, never falling
    step_std: np.ndarray = field(default_factory=lambda: np.empty(0))  # [rad] of each step, before the motion

    def __len__(self) -> int:
        return self.data.shape[1]

    def take(self, columns: np.ndarray) -> Observations:
        """Some of the samples: growing indices, or bool (n,)."""
        return replace(self, data=self.data[:, columns], condition_index=self.condition_index[columns])

    @property
    def beyond(self) -> np.ndarray:
        """(steps, n) bool: which samples are beyond each heading step."""
        return self.data[4 * len(self.layout.sensors) : -1] > 0.5

    def apply_steps(self, x: np.ndarray) -> Observations:
        """The same samples with the heading steps of `x` applied to Q."""
        data = self.data.copy()
        for name, step, beyond in zip(self.layout.steps, x[self.layout.step], self.beyond, strict=True):
            i = 4 * self.layout.sensors.index(name)
            Q = Rotation.from_quat(data[i : i + 4, beyond].T)
            data[i : i + 4, beyond] = (Rotation.from_rotvec([0.0, 0.0, step]) * Q).as_quat().T
        data = np.delete(data, np.arange(4 * len(self.layout.sensors), len(data) - 1), axis=0)
        return replace(self, layout=self.layout._replace(steps=()), data=data, step_std=np.empty(0))

    def spans(self) -> list[tuple[Condition, slice]]:
        """Each condition with its samples; none may be empty."""
        edges = np.searchsorted(self.condition_index, np.arange(len(self.conditions) + 1))
        return [(c, slice(int(edges[i]), int(edges[i + 1]))) for i, c in enumerate(self.conditions)]

    @property
    def closed(self) -> np.ndarray:
        """(n,) bool: samples of a closure."""
        return np.array([isinstance(c, Closure) for c in self.conditions], dtype=bool)[self.condition_index]


def residuals(x: np.ndarray, observations: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n, 5), their Jacobian (n, 5, len(x)), gaps (n, 3) [m], which are zero without a closure."""
    parts, point = [], 0
    for condition, span in observations.spans():
        n = span.stop - span.start
        r, J, gap = np.empty((n, 5)), np.empty((n, len(x), 5)), np.empty((n, 3))
        inputs = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(observations.data[:, span].T, dtype=float)
        evaluate_into(_mapped_residuals(observations.layout, condition, point, n), inputs, (r, J, gap))
        parts.append((r, np.ascontiguousarray(J.swapaxes(1, 2)), gap))
        point += isinstance(condition, Closure) and condition.kind == "fixed_point"
    if len(parts) == 1:
        return parts[0]
    r, J, gap = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return r, J, gap


def evaluate_into(function: Any, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    """Evaluate a CasADi function from contiguous arrays into others; a row of an array is a column of CasADi's.

    CasADi's own matrices would double the time.
    """
    buffer, evaluate = function.buffer()
    for i, array in enumerate(arguments):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    evaluate()


def place_points(x: np.ndarray, observations: Observations) -> np.ndarray:
    """The same x with each unknown point at the mean of the body's point."""
    if not observations.layout.fixed:
        return x
    x, gaps = x.copy(), residuals(x, observations)[2]
    fixed = [span for c, span in observations.spans() if isinstance(c, Closure) and c.kind == "fixed_point"]
    for i, span in enumerate(fixed):
        x[observations.layout.points][3 * i : 3 * i + 3] += gaps[span].mean(axis=0)
    return x


@lru_cache(maxsize=32)
def _mapped_residuals(layout: Layout, condition: Condition, point: int, n: int) -> Any:
    x, data = ca.MX.sym("x", layout.size), ca.MX.sym("data", layout.rows, n)
    r, J, gap = _residual_function(layout, condition, point).map(n)(ca.repmat(x, 1, n), data)
    return ca.Function("samples", [x, data], [r, J, gap])


@lru_cache(maxsize=32)
def _residual_function(layout: Layout, condition: Condition, point: int) -> Any:
    """CasADi function of a sample: (x, data) → residuals (5), Jacobian (5, len(x)), gap (3)."""
    sensors = layout.sensors
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.rows)
    heading, tilt, drift, soft_tissue = x[layout.heading], x[layout.tilt], x[layout.drift], x[layout.soft_tissue]
    quat_WL = {}
    for i, name in enumerate(sensors):
        now = heading[i] + drift[i] * data[-1]
        for k, sensor in enumerate(layout.steps):
            if sensor == name:
                now += x[layout.step.start + k] * data[4 * len(sensors) + k]
        turned = product(about_z(now), data[4 * i : 4 * i + 4])
        turned = product(turned, about_z(-heading[i]))
        quat = product(turned, small_turn(ca.vertcat(tilt[2 * i], tilt[2 * i + 1], 0.0)))
        A = ca.reshape(soft_tissue[9 * i : 9 * i + 9], 3, 3)
        quat_WL[name] = product(quat, small_turn(A @ (rotate(inverse(quat), _UP) - _UP)))
    gap, elbows = ca.SX.zeros(3), ca.SX.zeros(2)
    if isinstance(condition, Closure):
        whitened, gap = _closure_residual(layout, condition, x, quat_WL, point)
        elbows = _hinge_residuals(layout, x, quat_WL)
    elif isinstance(condition, Direction):
        along_T = rotate(inverse(quat_WL["torso"]), rotate(quat_WL[condition.segment], -_UP))
        whitened = (along_T - ca.DM(condition.direction)) / condition.std
    else:
        level = rotate(quat_WL[condition.segment], ca.vertcat(0.0, 1.0, 0.0))[2]
        whitened = ca.vertcat(level / condition.std, 0.0, 0.0)
    r = ca.cse(ca.vertcat(whitened, elbows))
    return ca.Function("sample", [x, data], ca.cse([r, ca.densify(ca.jacobian(r, x)), ca.densify(gap)]))


_UP = ca.vertcat(0.0, 0.0, 1.0)


def sensor_of(segment: str, sensors: Collection[str]) -> str:
    """The segment whose sensor measures this one: a hand without a sensor is rigid with its forearm."""
    return segment if segment in sensors else segment.replace("hand", "forearm")


def _closure_residual(
    layout: Layout, closure: Closure, x: Any, quat_WL: Mapping[str, Any], point: int
) -> tuple[Any, Any]:
    """Whitened residual (3) and gap (3) [m] of a closure."""
    way = coefficients(closure)
    carried = {name: sensor_of(name, layout.sensors) for name in way}
    moved = {sensor: ca.SX.zeros(3) for sensor in layout.sensors if sensor in carried.values()}
    turned = {name: quat_WL[carried[name]] for name in way}
    if "torso" in turned:
        turned["torso"] = product(turned["torso"], about_z(x[layout.shoulders]))
    for name, vector in links(x[:K], turned, way).items():
        moved[carried[name]] += vector
    gap, covariance = ca.SX.zeros(3), closure.slip**2 * ca.SX.eye(3)
    for v in moved.values():
        gap += v
        # An error of variance σ² about each axis moves the end of v by a vector of covariance σ² (‖v‖² 1 − v vᵀ). Only
        # the ratios of these weights matter here.
        covariance += SEGMENT_ATTITUDE_STD**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
    if closure.kind == "distance":
        size = ca.norm_2(gap)
        off = size - x[layout.distances][layout.distance_names.index(closure.distance)]
        return ca.vertcat(off / ca.sqrt(gap.T @ covariance @ gap) * size, 0.0, 0.0), off * gap / size
    if closure.kind == "fixed_point":
        first = layout.points.start + 3 * point
        gap -= x[first : first + 3]
    return ca.solve(ca.chol(covariance).T, gap), gap


def _hinge_residuals(layout: Layout, x: Any, quat_WL: Mapping[str, Any]) -> Any:
    """By how much each forearm leaves the plane of its hinge, (2) in units of `HINGE_STD`."""
    hinge, residual = x[layout.hinge], []
    for i, side in enumerate(SIDES):
        if side not in layout.arms:
            residual.append(ca.SX(0.0))
            continue
        forearm = rotate(inverse(quat_WL[f"{side}_upper_arm"]), rotate(quat_WL[f"{side}_forearm"], -_UP))
        axis = ca.vertcat(hinge[2 * i], 1.0, hinge[2 * i + 1])
        residual.append(ca.dot(axis, forearm) / ca.norm_2(axis) / HINGE_STD)
    return ca.vertcat(*residual)
