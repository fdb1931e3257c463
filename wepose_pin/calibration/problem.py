"""The least squares of a calibration: all that is not known, the residuals of one look, Gauss-Newton over all looks.

Of each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. With a start
pose that is held ε off the N-pose, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R_WL(t) = Rz(ψ + d τ) Q(t) Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))

with ψ the heading, d its drift since the start, and A the sensor's sag on its segment: soft tissue turns a sensor as
gravity turns in the segment. Neither d nor A nor the hinges are handed on, but the covariance of lengths and mounts
holds what they cost.

Two residuals of a look: the palm gap, whitened by the covariance that errors of the orientations and slipping palms
give it, which makes it as homogeneous in the lengths as the gap itself (see `lengths`); and of each elbow how far the
forearm leaves the plane in which a hinge lets it turn.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..errors import NoSolution
from ..subject import LENGTHS
from .chain import CHAIN, SIDES, about_z, inverse, links, product, rotate, small_turn

ATTITUDE_STD = np.deg2rad(1.5)  # [rad] of a segment's orientation about each axis: sets the gap's weights, not its size
SLIP_STD = 0.005  # [m] of the palms against each other, each axis
HINGE_STD = np.deg2rad(2.0)  # [rad] of the forearm against the elbow's plane
K = len(LENGTHS)


class Layout(NamedTuple):
    """Where in x what stands; `sensors` are those of the chain, in its order."""

    sensors: tuple[str, ...]

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
    def size(self) -> int:
        return self.sag.stop


class Fit(NamedTuple):
    """A solution of the least squares."""

    x: np.ndarray
    closure: np.ndarray  # (n, 3) whitened residuals of the gap
    hinge: np.ndarray  # (n, 2) of the elbows, in units of `HINGE_STD`
    gaps: np.ndarray  # (n, 3) [m]
    information: np.ndarray  # of x, prior included
    cost: float


class Looks(NamedTuple):
    """What the residuals see: n looks at the chain."""

    layout: Layout
    data: np.ndarray  # (4 sensors + 1, n): Q of each sensor xyzw, seconds since the start pose


def residuals(x: np.ndarray, looks: Looks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n, 5), their Jacobian (n, 5, len(x)), gaps (n, 3) [m]."""
    n = looks.data.shape[1]
    r, J, gap = _mapped(looks.layout, n)(x, looks.data)
    jacobian = np.asarray(J).reshape(5, n, looks.layout.size).transpose(1, 0, 2)
    return np.asarray(r).T, jacobian, np.asarray(gap).T


@lru_cache(maxsize=8)
def _mapped(layout: Layout, n: int) -> Any:
    x, data = ca.MX.sym("x", layout.size), ca.MX.sym("data", 4 * len(layout.sensors) + 1, n)
    r, J, gap = _look(layout).map(n)(ca.repmat(x, 1, n), data)
    return ca.Function("looks", [x, data], [r, J, gap])


@lru_cache(maxsize=8)
def _look(layout: Layout) -> Any:
    """One look: (x, data) → residuals (5), Jacobian (5, len(x)), gap (3)."""
    sensors = layout.sensors
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", 4 * len(sensors) + 1)
    heading, tilt, drift = x[layout.heading], x[layout.tilt], x[layout.drift]
    hinge, sag = x[layout.hinge], x[layout.sag]
    up = ca.vertcat(0.0, 0.0, 1.0)
    quat_WL = {}
    for i, name in enumerate(sensors):
        turned = product(about_z(heading[i] + drift[i] * data[-1]), data[4 * i : 4 * i + 4])
        turned = product(turned, about_z(-heading[i]))
        quat = product(turned, small_turn(ca.vertcat(tilt[2 * i], tilt[2 * i + 1], 0.0)))
        A = ca.reshape(sag[9 * i : 9 * i + 9], 3, 3)
        quat_WL[name] = product(quat, small_turn(A @ (rotate(inverse(quat), up) - up)))
    # A link without a sensor of its own, a hand, is rigid with the forearm and shares its errors.
    carrier = {name: name if name in sensors else name.replace("hand", "forearm") for name in CHAIN}
    moved = {sensor: ca.SX.zeros(3) for sensor in sensors}
    for name, vector in links(x[:K], {name: quat_WL[carrier[name]] for name in CHAIN}).items():
        moved[carrier[name]] += vector
    gap, covariance = ca.SX.zeros(3), SLIP_STD**2 * ca.SX.eye(3)
    for v in moved.values():
        gap += v
        # An error of variance σ² about each axis moves the end of v by a vector of covariance σ² (‖v‖² 1 − v vᵀ).
        covariance += ATTITUDE_STD**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
    whitened = [ca.solve(ca.chol(covariance).T, gap)]
    for i, side in enumerate(SIDES):
        forearm = rotate(inverse(quat_WL[f"{side}_upper_arm"]), rotate(quat_WL[f"{side}_forearm"], -up))
        axis = ca.vertcat(hinge[2 * i], 1.0, hinge[2 * i + 1])
        whitened.append(ca.dot(axis, forearm) / ca.norm_2(axis) / HINGE_STD)
    r = ca.vertcat(*whitened)
    return ca.Function("look", [x, data], [r, ca.jacobian(r, x), gap])


def solve(
    looks: Looks, center: np.ndarray, prior: np.ndarray, weights: np.ndarray, start: np.ndarray, rounds: int = 60
) -> Fit:
    """Minimiser of Σ w r² + (x − c)ᵀ Λ (x − c): Gauss-Newton, damped where a step does not lower the cost.

    Parameters
    ----------
    center, prior : c (m,) and Λ (m, m)
    weights : (n, 5) of the residuals

    Raises
    ------
    NoSolution
        It did not converge.
    """
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
            return Fit(x, r[:, :3], r[:, 3:], gaps, information, cost)
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
    if gradient @ step < 0.05**2:
        return Fit(x, r[:, :3], r[:, 3:], gaps, information, cost)
    raise NoSolution(
        f"the lengths did not converge ({np.sqrt(gradient @ step):.2g} standard deviations to go); check that the "
        f"palms touch in the phase and that every sensor sits where the session says"
    )
