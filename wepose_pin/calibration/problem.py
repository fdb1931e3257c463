"""The least squares of a calibration: all that is not known, the residuals of one look, Gauss-Newton over all looks.

Of each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. With a start
pose that is held ε off the N-pose, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R_WL(t) = Rz(ψ + d τ + s) Q(t) Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))

with ψ the heading, d its drift since the start, s its steps where samples were lost since (`losses`), and A the
sensor's sag on its segment: soft tissue turns a sensor as gravity turns in the segment. The line between the shoulders
is the torso's y but for what collarbones and shoulder blades make of it while the arms are raised. Neither that nor d,
s, A and the hinges are handed on, but the covariance of lengths and mounts holds what they cost.

What a look sees is the condition of its protocol that holds then. Of a closure it is the gap, whitened by the
covariance that errors of the orientations and slipping palms give it, which makes it as homogeneous in the lengths as
the gap itself (see `lengths`), and of each elbow how far the forearm leaves the plane in which a hinge lets it turn. Of
a pose it is how far a segment is off its stated direction, of an axis how far it is off the level. Every look has the
same five rows: three of its condition and two elbows; those that do not apply are zero.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import ATTITUDE_STD
from ..errors import NoSolution
from ..subject import LENGTHS
from .chain import SIDES, about_z, inverse, links, product, rotate, small_turn
from .protocols import Closure, Condition, Direction, coefficients

HINGE_STD = np.deg2rad(2.0)  # [rad] of the forearm against the elbow's plane
K = len(LENGTHS)


class Layout(NamedTuple):
    """Where in x what stands: `sensors` of the chain in its order, how many unknown points, how many distances.

    `steps`: the sensor of each step of a heading.
    """

    sensors: tuple[str, ...]
    fixed: int = 0
    gauges: tuple[str, ...] = ()
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
    def sag(self) -> slice:
        """A (3, 3) of each sensor, column by column [rad]."""
        return slice(self.hinge.stop, self.hinge.stop + 9 * len(self.sensors))

    @property
    def shoulders(self) -> slice:
        """How far the line between the shoulders is turned about the torso's z [rad]."""
        return slice(self.sag.stop, self.sag.stop + 1)

    @property
    def points(self) -> slice:
        """Unknown points of W (3,) each [m]."""
        return slice(self.shoulders.stop, self.shoulders.stop + 3 * self.fixed)

    @property
    def distances(self) -> slice:
        """Of each gauge that is no length of the body [m]."""
        return slice(self.points.stop, self.points.stop + len(self.gauges))

    @property
    def step(self) -> slice:
        """Steps of headings [rad]."""
        return slice(self.distances.stop, self.distances.stop + len(self.steps))

    @property
    def size(self) -> int:
        return self.step.stop

    @property
    def rows(self) -> int:
        """Of a look's data."""
        return 4 * len(self.sensors) + len(self.steps) + 1

    @property
    def arms(self) -> tuple[str, ...]:
        """Sides whose elbow has a sensor above and below."""
        return tuple(s for s in SIDES if {f"{s}_upper_arm", f"{s}_forearm"} <= set(self.sensors))


class Fit(NamedTuple):
    """A solution of the least squares."""

    x: np.ndarray
    closure: np.ndarray  # (n, 3) whitened residuals of the gap
    hinge: np.ndarray  # (n, 2) of the elbows, in units of `HINGE_STD`
    gaps: np.ndarray  # (n, 3) [m]
    jacobian: np.ndarray  # (n, 5, m) of gap and hinge
    information: np.ndarray  # of x, prior included
    cost: float


class Looks(NamedTuple):
    """What the residuals see: n looks, each at what one condition says."""

    layout: Layout
    data: np.ndarray  # (rows, n): Q of each sensor xyzw, whether it is beyond each step, seconds since the start pose
    conditions: tuple[Condition, ...]
    of: np.ndarray  # (n,) which condition holds at each look, never falling
    step_std: np.ndarray = np.empty(0)  # [rad] of each step, before the motion

    def take(self, columns: np.ndarray) -> Looks:
        """Some of the looks: indices that grow, or bool (n,)."""
        return self._replace(data=self.data[:, columns], of=self.of[columns])

    @property
    def beyond(self) -> np.ndarray:
        """(steps, n) bool: which looks are beyond each step of a heading."""
        return self.data[4 * len(self.layout.sensors) : -1] > 0.5

    def stepped(self, x: np.ndarray) -> Looks:
        """The same looks with the steps of `x` taken into Q."""
        data = self.data.copy()
        for name, step, beyond in zip(self.layout.steps, x[self.layout.step], self.beyond, strict=True):
            i = 4 * self.layout.sensors.index(name)
            Q = Rotation.from_quat(data[i : i + 4, beyond].T)
            data[i : i + 4, beyond] = (Rotation.from_rotvec([0.0, 0.0, step]) * Q).as_quat().T
        data = np.delete(data, np.arange(4 * len(self.layout.sensors), len(data) - 1), axis=0)
        return self._replace(layout=self.layout._replace(steps=()), data=data, step_std=np.empty(0))

    def spans(self) -> list[tuple[Condition, slice]]:
        """Which looks belong to each condition; none of them may be empty."""
        edges = np.searchsorted(self.of, np.arange(len(self.conditions) + 1))
        return [(c, slice(int(edges[i]), int(edges[i + 1]))) for i, c in enumerate(self.conditions)]

    @property
    def closed(self) -> np.ndarray:
        """(n,) bool, looks at a closure."""
        return np.array([isinstance(c, Closure) for c in self.conditions], dtype=bool)[self.of]


def residuals(x: np.ndarray, looks: Looks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n, 5), their Jacobian (n, 5, len(x)), gaps (n, 3) [m]; the gap of what is no closure is zero."""
    found, point = [], 0
    for condition, span in looks.spans():
        n = span.stop - span.start
        r, J, gap = np.empty((n, 5)), np.empty((n, len(x), 5)), np.empty((n, 3))
        taken = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(looks.data[:, span].T, dtype=float)
        filled(_mapped(looks.layout, condition, point, n), taken, (r, J, gap))
        found.append((r, np.ascontiguousarray(J.swapaxes(1, 2)), gap))
        point += isinstance(condition, Closure) and condition.kind == "fixed_point"
    if len(found) == 1:
        return found[0]
    r, J, gap = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return r, J, gap


def filled(function: Any, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    """Evaluate a CasADi function from arrays into arrays, contiguous, an array's row each of CasADi's columns.

    CasADi's own matrices would cost as much again as the evaluation.
    """
    buffer, evaluate = function.buffer()
    for i, array in enumerate(arguments):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    evaluate()


def placed(x: np.ndarray, looks: Looks) -> np.ndarray:
    """The same x with each unknown point in the middle of where the body's point was seen."""
    if not looks.layout.fixed:
        return x
    x, gaps = x.copy(), residuals(x, looks)[2]
    fixed = [span for c, span in looks.spans() if isinstance(c, Closure) and c.kind == "fixed_point"]
    for i, span in enumerate(fixed):
        x[looks.layout.points][3 * i : 3 * i + 3] += gaps[span].mean(axis=0)
    return x


@lru_cache(maxsize=32)
def _mapped(layout: Layout, condition: Condition, point: int, n: int) -> Any:
    x, data = ca.MX.sym("x", layout.size), ca.MX.sym("data", layout.rows, n)
    r, J, gap = _look(layout, condition, point).map(n)(ca.repmat(x, 1, n), data)
    return ca.Function("looks", [x, data], [r, J, gap])


@lru_cache(maxsize=32)
def _look(layout: Layout, condition: Condition, point: int) -> Any:
    """One look: (x, data) → residuals (5), Jacobian (5, len(x)), gap (3)."""
    sensors = layout.sensors
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.rows)
    heading, tilt, drift, sag = x[layout.heading], x[layout.tilt], x[layout.drift], x[layout.sag]
    quat_WL = {}
    for i, name in enumerate(sensors):
        now = heading[i] + drift[i] * data[-1]
        for k, of in enumerate(layout.steps):
            if of == name:
                now += x[layout.step.start + k] * data[4 * len(sensors) + k]
        turned = product(about_z(now), data[4 * i : 4 * i + 4])
        turned = product(turned, about_z(-heading[i]))
        quat = product(turned, small_turn(ca.vertcat(tilt[2 * i], tilt[2 * i + 1], 0.0)))
        A = ca.reshape(sag[9 * i : 9 * i + 9], 3, 3)
        quat_WL[name] = product(quat, small_turn(A @ (rotate(inverse(quat), _UP) - _UP)))
    gap, elbows = ca.SX.zeros(3), ca.SX.zeros(2)
    if isinstance(condition, Closure):
        whitened, gap = _closed(layout, condition, x, quat_WL, point)
        elbows = _elbows(layout, x, quat_WL)
    elif isinstance(condition, Direction):
        along_T = rotate(inverse(quat_WL["torso"]), rotate(quat_WL[condition.segment], -_UP))
        whitened = (along_T - ca.DM(condition.direction)) / condition.std
    else:
        level = rotate(quat_WL[condition.segment], ca.vertcat(0.0, 1.0, 0.0))[2]
        whitened = ca.vertcat(level / condition.std, 0.0, 0.0)
    r = ca.cse(ca.vertcat(whitened, elbows))
    return ca.Function("look", [x, data], ca.cse([r, ca.densify(ca.jacobian(r, x)), ca.densify(gap)]))


_UP = ca.vertcat(0.0, 0.0, 1.0)


def carrier(segment: str, sensors: Collection[str]) -> str:
    """Whose sensor turns with the segment: a hand without a sensor is rigid with the forearm and shares its errors."""
    return segment if segment in sensors else segment.replace("hand", "forearm")


def _closed(layout: Layout, closure: Closure, x: Any, quat_WL: Mapping[str, Any], point: int) -> tuple[Any, Any]:
    """Whitened residual (3) and gap (3) [m] of a closure."""
    way = coefficients(closure)
    carried = {name: carrier(name, layout.sensors) for name in way}
    moved = {sensor: ca.SX.zeros(3) for sensor in layout.sensors if sensor in carried.values()}
    turned = {name: quat_WL[carried[name]] for name in way}
    if "torso" in turned:
        turned["torso"] = product(turned["torso"], about_z(x[layout.shoulders]))
    for name, vector in links(x[:K], turned, way).items():
        moved[carried[name]] += vector
    gap, covariance = ca.SX.zeros(3), closure.slip**2 * ca.SX.eye(3)
    for v in moved.values():
        gap += v
        # An error of variance σ² about each axis moves the end of v by a vector of covariance σ² (‖v‖² 1 − v vᵀ). This
        # sets the gap's weights among each other, not their size.
        covariance += ATTITUDE_STD**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
    if closure.kind == "distance":
        size = ca.norm_2(gap)
        off = size - x[layout.distances][layout.gauges.index(closure.gauge)]
        return ca.vertcat(off / ca.sqrt(gap.T @ covariance @ gap) * size, 0.0, 0.0), off * gap / size
    if closure.kind == "fixed_point":
        first = layout.points.start + 3 * point
        gap -= x[first : first + 3]
    return ca.solve(ca.chol(covariance).T, gap), gap


def _elbows(layout: Layout, x: Any, quat_WL: Mapping[str, Any]) -> Any:
    """How far each forearm leaves the plane of its hinge, (2) in units of `HINGE_STD`."""
    hinge, found = x[layout.hinge], []
    for i, side in enumerate(SIDES):
        if side not in layout.arms:
            found.append(ca.SX(0.0))
            continue
        forearm = rotate(inverse(quat_WL[f"{side}_upper_arm"]), rotate(quat_WL[f"{side}_forearm"], -_UP))
        axis = ca.vertcat(hinge[2 * i], 1.0, hinge[2 * i + 1])
        found.append(ca.dot(axis, forearm) / ca.norm_2(axis) / HINGE_STD)
    return ca.vertcat(*found)


def solve(
    looks: Looks,
    center: np.ndarray,
    prior: np.ndarray,
    weights: np.ndarray,
    start: np.ndarray | Fit,
    rounds: int = 60,
    strict: bool = True,
) -> Fit:
    """Minimiser of Σ w r² + (x − c)ᵀ Λ (x − c): Gauss-Newton, damped where a step does not lower the cost.

    Parameters
    ----------
    center, prior : c (m,) and Λ (m, m)
    weights : (n, 5) of the residuals
    start : x to begin with, or a fit of the same looks with other weights
    strict : without it what was reached in these rounds is given

    Raises
    ------
    NoSolution
        It did not converge.
    """
    if isinstance(start, Fit):
        x, r, J, gaps = start.x, np.hstack((start.closure, start.hinge)), start.jacobian, start.gaps
    else:
        x = start
        r, J, gaps = residuals(x, looks)
    off = x - center
    cost = float(np.sum(weights * r**2) + off @ prior @ off)
    damping = 1e-4
    for _ in range(rounds):
        WJ = (weights[:, :, None] * J).reshape(-1, J.shape[2])
        information = WJ.T @ J.reshape(-1, J.shape[2]) + prior
        gradient = WJ.T @ r.ravel() + prior @ (x - center)
        step = np.linalg.solve(information, gradient)
        # What is left to go, in standard deviations of the result.
        if gradient @ step < 1e-8:
            return Fit(x, r[:, :3], r[:, 3:], gaps, J, information, cost)
        while True:
            nearer = x - np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
            r_next, J_next, gaps_next = residuals(nearer, looks)
            off = nearer - center
            lower = float(np.sum(weights * r_next**2) + off @ prior @ off)
            if lower <= cost * (1.0 + 1e-12):
                break
            damping *= 8.0
            if damping > 1e8:
                break
        x, r, J, gaps, cost = nearer, r_next, J_next, gaps_next, min(lower, cost)
        damping = max(damping / 8.0, 1e-12)
    if gradient @ step < 0.05**2 or not strict:
        return Fit(x, r[:, :3], r[:, 3:], gaps, J, information, cost)
    raise NoSolution(
        f"the lengths did not converge ({np.sqrt(gradient @ step):.2g} standard deviations to go); check that the "
        f"hands do in the phase what the protocol says, and that every sensor sits where the session says"
    )
