"""The unknowns x of a calibration and the residuals r of its samples; `least_squares` solves

    minimise  ½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c),   no length below `MIN_LENGTH`

with the prior c, Λ of `priors` and the weights w of `weights`.

For each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. Here L is
the frame of its segment that equals W in the start pose (L' in `conditions`). With a start pose that is ε off the
stated one, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R_WL(t) = Rz(ψ + d τ) Q(t) Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))

with ψ the heading, d its drift since the start, and A the soft-tissue artefact: soft tissue rotates a sensor as the
direction of gravity in the segment changes. A segment's points may move, as the shoulders do by collarbones and
shoulder blades while the arms are raised (`model.girdle`). d, A and the hinges are nuisance parameters: the covariance
of lengths and mounts includes their effect.

Each sample belongs to one condition of the protocol. A closure (`Loop`) gives the gap, whitened by the covariance that
errors of the orientations and slipping palms give it, and of each hinge the angle by which the segment that it moves
leaves its plane. The covariance depends on the lengths, so that scaling all lengths does not shrink the residual. A
stated pose (`Pointing`) gives the deviation of a segment from its direction, an axis (`Level`) how far it rises while
the segment bends. Each sample has the same residuals: three of its condition and one a hinge; those that do not apply
are zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ..body.girdle import PARAMETERS, displace
from ..body.reaches import UNIVERSE
from ..rotations import product_terms
from .conditions import Constraint, GirdleTerm, HingeUnknown, Level, Loop, Moving, Part, Pointing

HINGE_STD = np.deg2rad(2.0)  # [rad] of a segment against its hinge's plane; the unit of these residuals
GAP_ROWS = 3  # residuals of a sample's condition


@dataclass(frozen=True)
class Layout:
    """The unknowns, each with its places in x, and the data of a sample.

    Parameters
    ----------
    lengths : names, in the order of the table
    sensors : names of their segments, in the order of the table
    hinges, girdles : between segments of these sensors
    fixed : number of unknown fixed points
    planes : number of level planes of unknown height
    recorded : the samples have a recorded place
    rigid : sensors without a soft-tissue artefact
    attitude_std : [rad] of each sensor's orientation about an axis across its segment; only the ratios matter
    """

    lengths: tuple[str, ...]
    sensors: tuple[str, ...]
    hinges: tuple[HingeUnknown, ...] = ()
    girdles: tuple[GirdleTerm, ...] = ()
    fixed: int = 0
    planes: int = 0
    recorded: bool = False
    rigid: tuple[str, ...] = ()
    attitude_std: tuple[float, ...] = ()

    length: np.ndarray = field(init=False, compare=False)  # (lengths,) [m]
    heading: np.ndarray = field(init=False, compare=False)  # (sensors,) ψ [rad]
    tilt: np.ndarray = field(init=False, compare=False)  # (sensors, 2) ε about x and y of L [rad]
    drift: np.ndarray = field(init=False, compare=False)  # (sensors,) d [rad/s]
    hinge: np.ndarray = field(init=False, compare=False)  # (hinges, 2) of its axis along `across` and `tilted`
    soft_tissue: np.ndarray = field(init=False, compare=False)  # (soft, 9) A [rad], column by column
    girdle: np.ndarray = field(init=False, compare=False)  # (girdles, 7) `model.girdle.PARAMETERS`
    point: np.ndarray = field(init=False, compare=False)  # (fixed, 3) of W [m]
    height: np.ndarray = field(init=False, compare=False)  # (planes,) of W [m]
    size: int = field(init=False, compare=False)  # of x

    def __post_init__(self) -> None:
        sensors, begin = len(self.sensors), 0
        for name, shape in {
            "length": (len(self.lengths),),
            "heading": (sensors,),
            "tilt": (sensors, 2),
            "drift": (sensors,),
            "hinge": (len(self.hinges), 2),
            "soft_tissue": (len(self.soft), 9),
            "girdle": (len(self.girdles), len(PARAMETERS)),
            "point": (self.fixed, 3),
            "height": (self.planes,),
        }.items():
            places = begin + np.arange(np.prod(shape, dtype=int)).reshape(shape)
            object.__setattr__(self, name, places)
            begin += places.size
        object.__setattr__(self, "size", begin)

    @cached_property
    def soft(self) -> tuple[str, ...]:
        """Sensors with a soft-tissue artefact."""
        return tuple(name for name in self.sensors if name not in self.rigid)

    @property
    def place(self) -> slice:
        """Of a sample's data: the recorded place (3,) [m] in W."""
        return slice(4 * len(self.sensors), 4 * len(self.sensors) + 3 * self.recorded)

    @property
    def rows(self) -> int:
        """Number of values that a sample has."""
        return self.place.stop + 1

    @property
    def residuals(self) -> int:
        """Number of residuals of a sample."""
        return GAP_ROWS + len(self.hinges)


@lru_cache(maxsize=32)
def sample_functions(layout: Layout, condition: Constraint) -> tuple[ca.Function, ca.Function]:
    """Return two functions of x (m,) and a sample's data (rows,).

    The first gives its residuals (k,) and its gap (3,) [m], zero without a closure; the second the Jacobian of the
    residuals, transposed (m, k).
    """
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.rows)
    quat_WL = _orient_segments(layout, x, data)
    r, gap, hinges = ca.SX.zeros(GAP_ROWS), ca.SX.zeros(3), ca.SX.zeros(len(layout.hinges))
    if isinstance(condition, Loop):
        r, gap = _closure_residual(layout, condition, x, quat_WL, data[layout.place])
    elif isinstance(condition, Pointing):
        along_W = rotate(quat_WL[condition.segment], condition.along)
        r = (rotate(inverse(quat_WL[condition.reference]), along_W) - ca.DM(condition.direction)) / condition.std
    elif isinstance(condition, Level):
        before = rotate(_start_rotation(layout, x, condition.segment), condition.axis)
        r[0] = (rotate(quat_WL[condition.segment], condition.axis) - before)[2] / condition.std
    if isinstance(condition, Loop | Moving):
        hinges = _hinge_residuals(layout, x, quat_WL)
    r = ca.cse(ca.vertcat(r, hinges))
    jacobian = ca.cse(ca.densify(ca.jacobian(r, x)).T)
    return ca.Function("residuals", [x, data], [r, ca.densify(gap)]), ca.Function("jacobian", [x, data], [jacobian])


def _orient_segments(layout: Layout, x: ca.SX, data: ca.SX) -> dict[str, ca.SX]:
    """Return `quat_WL` (4,) of each segment with a sensor: Rz(ψ + d τ) Q Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))."""
    quat_WL, up = {}, ca.DM([0.0, 0.0, 1.0])
    for i, name in enumerate(layout.sensors):
        heading, drift = x[layout.heading[i]], x[layout.drift[i]]
        quat = product(_about_z(heading + drift * data[-1]), data[4 * i : 4 * i + 4])
        quat = product(product(quat, _about_z(-heading)), _start_rotation(layout, x, name))
        if name in layout.soft:
            A = ca.reshape(x[layout.soft_tissue[layout.soft.index(name)]], 3, 3)
            quat = product(quat, _small_rotation(A @ (rotate(inverse(quat), up) - up)))
        quat_WL[name] = quat
    return quat_WL


def _start_rotation(layout: Layout, x: ca.SX, segment: str) -> ca.SX:
    """Return exp(ε) (4,) of a segment."""
    tilt = x[layout.tilt[layout.sensors.index(segment)]]
    return _small_rotation(ca.vertcat(tilt, 0.0))


def _closure_residual(
    layout: Layout, loop: Loop, x: ca.SX, quat_WL: Mapping[str, ca.SX], recorded: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the whitened residual (3,) and the gap (3,) [m] of a closure; `recorded` (3,) [m] is a recorded place."""
    gaps, covariances, names = [], [], [term.name for term in layout.girdles]
    for way, girdles in zip(loop.ways, loop.girdles, strict=True):
        gap, covariance = ca.SX.zeros(3), loop.closure.slip**2 * ca.SX.eye(3)
        for name, sign in girdles:
            if name in names:
                gap += sign * _displace_girdle(layout, x, quat_WL, names.index(name))
        for part in way:
            v = _express_part(layout, x, quat_WL, part)
            gap += v
            if part.sensor != UNIVERSE:
                # An error of variance σ² about each axis moves the end by a vector of this covariance.
                std = layout.attitude_std[layout.sensors.index(part.sensor)]
                covariance += std**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)
        gaps.append(gap)
        covariances.append(covariance)
    if loop.kind == "plane":
        off, r = ca.SX.zeros(3), ca.SX.zeros(GAP_ROWS)
        for k, (gap, covariance) in enumerate(zip(gaps, covariances, strict=True)):
            off[k] = gap[2] - x[layout.height[loop.unknown]]
            r[k] = off[k] / ca.sqrt(covariance[2, 2])
        return r, off
    [gap], [covariance] = gaps, covariances
    if loop.kind == "fixed_point":
        gap -= x[layout.point[loop.unknown]]
    elif loop.kind == "recorded":
        gap -= recorded
    return ca.solve(ca.chol(covariance).T, gap), gap


def _express_part(layout: Layout, x: ca.SX, quat_WL: Mapping[str, ca.SX], part: Part) -> ca.SX:
    """Return a part of a way between points in W (3,) [m]."""
    vector = ca.sparsify(ca.DM(np.array(part.by_length))) @ x[layout.length] + ca.DM(part.constant)
    return vector if part.sensor == UNIVERSE else rotate(quat_WL[part.sensor], vector)


def _displace_girdle(layout: Layout, x: ca.SX, quat_WL: Mapping[str, ca.SX], k: int) -> ca.SX:
    """Return the displacement (3,) [m] in W of the point that the k-th girdle moves."""
    term, own = layout.girdles[k], x[layout.girdle[k]]
    R_on, law = ca.DM(np.reshape(term.R_on, (3, 3))), term.law
    along = R_on.T @ rotate(inverse(quat_WL[law.on]), rotate(quat_WL[law.moves], term.along))
    by_law, raised = displace(law, ca.vertsplit(along), term.scale, ca)
    return rotate(quat_WL[law.on], R_on @ ((1.0 + own[0]) * ca.vertcat(*by_law) + own[1:4] + raised * own[4:]))


def _hinge_residuals(layout: Layout, x: ca.SX, quat_WL: Mapping[str, ca.SX]) -> ca.SX:
    """Return the angles (hinges,) by which segments leave the planes of their hinges, in units of `HINGE_STD`."""
    residuals = []
    for hinge, places in zip(layout.hinges, layout.hinge, strict=True):
        along = rotate(inverse(quat_WL[hinge.on]), rotate(quat_WL[hinge.moves], hinge.along))
        axis = ca.DM(hinge.axis) + ca.horzcat(ca.DM(hinge.across), ca.DM(hinge.tilted)) @ x[places]
        residuals.append(ca.dot(axis, along) / ca.norm_2(axis) / HINGE_STD)
    return ca.vertcat(*residuals)


def product(a: Any, b: Any) -> Any:
    """Return ``a ⊗ b`` of quaternions (4,) xyzw, in CasADi."""
    return ca.vertcat(*product_terms(*ca.vertsplit(a), *ca.vertsplit(b)))  # type: ignore[no-untyped-call]


def inverse(quat: Any) -> Any:
    """Return the unit quaternion (4,) xyzw of the inverse rotation, in CasADi."""
    return ca.vertcat(-quat[:3], quat[3])


def rotate(quat: Any, v: Any) -> Any:
    """Return ``R v`` of a unit quaternion (4,) xyzw and a vector (3,), in CasADi."""
    u, v = quat[:3], ca.vertcat(*v) if isinstance(v, tuple) else v
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def _about_z(angle: Any) -> Any:
    """Return the unit quaternion (4,) xyzw of a rotation about z [rad], in CasADi."""
    return ca.vertcat(0.0, 0.0, ca.sin(angle / 2.0), ca.cos(angle / 2.0))


def _small_rotation(rotvec: Any) -> Any:
    """Return the unit quaternion (4,) xyzw of about `rotvec` (3,) [rad], in CasADi: to third order of its size."""
    half = rotvec / 2.0
    return ca.vertcat(half, 1.0) / ca.sqrt(1.0 + ca.sumsqr(half))
