"""The unknowns of a calibration and the residuals of its samples, with their Jacobian; `solver` minimises them.

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
leaves its plane. The covariance depends on the lengths, so that scaling all lengths does not shrink the residual (see
`lengths`). A stated pose (`Pointing`) gives the deviation of a segment from its direction, an axis (`Level`) how far it
rises while the segment bends. Each sample has the same residuals: three of its condition and one a hinge; those that do
not apply are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..model.girdle import PARAMETERS, displace
from ..model.reaches import UNIVERSE
from .blocks import Program, evaluate, make_program
from .chain import about_z, inverse, product, rotate, small_turn
from .conditions import Constraint, GirdleTerm, HingeUnknown, Loop, Moving, Part, Pointing

HINGE_STD = np.deg2rad(2.0)  # [rad] of a segment against its hinge's plane; the unit of these residuals
GAP_ROWS = 3  # residuals of a sample's condition


@dataclass(frozen=True)
class Layout:
    """The places of the unknowns in their vector x, and of the data of a sample; the properties are slices of them.

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

    @cached_property
    def soft(self) -> tuple[str, ...]:
        """Sensors with a soft-tissue artefact."""
        return tuple(name for name in self.sensors if name not in self.rigid)

    @cached_property
    def length(self) -> slice:
        """The lengths [m]."""
        return slice(0, len(self.lengths))

    @cached_property
    def heading(self) -> slice:
        """ψ [rad] of each sensor."""
        return slice(self.length.stop, self.length.stop + len(self.sensors))

    @cached_property
    def tilt(self) -> slice:
        """ε about x, y of L [rad] of each sensor: how far its segment is off the start pose."""
        return slice(self.heading.stop, self.heading.stop + 2 * len(self.sensors))

    @cached_property
    def drift(self) -> slice:
        """d [rad/s] of each sensor's heading."""
        return slice(self.tilt.stop, self.tilt.stop + len(self.sensors))

    @cached_property
    def hinge(self) -> slice:
        """Two numbers a hinge: the displacements of its axis, of length 1, along `across` and `tilted`."""
        return slice(self.drift.stop, self.drift.stop + 2 * len(self.hinges))

    @cached_property
    def soft_tissue(self) -> slice:
        """A (3, 3) of each of the `soft` sensors, column by column [rad]."""
        return slice(self.hinge.stop, self.hinge.stop + 9 * len(self.soft))

    @cached_property
    def girdle(self) -> slice:
        """`model.girdle.PARAMETERS` of each girdle: a share of its law, then [m]."""
        return slice(self.soft_tissue.stop, self.soft_tissue.stop + len(PARAMETERS) * len(self.girdles))

    @cached_property
    def points(self) -> slice:
        """Unknown points of W (3,) each [m]."""
        return slice(self.girdle.stop, self.girdle.stop + 3 * self.fixed)

    @cached_property
    def heights(self) -> slice:
        """Heights of level planes in W [m]."""
        return slice(self.points.stop, self.points.stop + self.planes)

    @cached_property
    def size(self) -> int:
        return self.heights.stop

    @cached_property
    def rows(self) -> int:
        """Number of values that a sample has."""
        return self.place.stop + 1

    @cached_property
    def place(self) -> slice:
        """Of a sample's data: the recorded place (3,) [m] in W."""
        return slice(4 * len(self.sensors), 4 * len(self.sensors) + 3 * self.recorded)

    @cached_property
    def residuals(self) -> int:
        """Number of residuals of a sample."""
        return GAP_ROWS + len(self.hinges)


class Gaussian(NamedTuple):
    """A normal distribution of x, of m unknowns."""

    mean: np.ndarray  # (m,)
    information: np.ndarray  # (m, m), the inverse of the covariance


@dataclass(frozen=True)
class Observations:
    """n samples, each of one condition."""

    layout: Layout
    data: np.ndarray  # (rows, n): Q of each sensor xyzw, `Layout.place`, [s] since the start pose
    conditions: tuple[Constraint, ...]
    condition_index: np.ndarray  # (n,) number of each sample's condition, in ascending order

    def __len__(self) -> int:
        return self.data.shape[1]

    def take(self, columns: np.ndarray) -> Observations:
        """Return some of the samples: ascending numbers, or bool (n,)."""
        return replace(self, data=self.data[:, columns], condition_index=self.condition_index[columns])

    def spans(self) -> list[tuple[Constraint, slice]]:
        """Return each condition with the slice of its samples."""
        edges = np.searchsorted(self.condition_index, np.arange(len(self.conditions) + 1))
        return [(c, slice(int(edges[i]), int(edges[i + 1]))) for i, c in enumerate(self.conditions)]

    @property
    def closed(self) -> np.ndarray:
        """(n,) bool: samples of a closure."""
        return np.array([isinstance(c, Loop) for c in self.conditions], dtype=bool)[self.condition_index]

    @property
    def bending(self) -> np.ndarray:
        """(n,) bool: samples of a closure or of free motion, which have the residuals of hinges."""
        return np.array([isinstance(c, Loop | Moving) for c in self.conditions], dtype=bool)[self.condition_index]


def residuals(x: np.ndarray, observations: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the residuals (n, k), their Jacobian (n, k, len(x)), and the gaps (n, 3) [m], zero without a closure."""
    parts, k = [], observations.layout.residuals
    for (condition, span), place in zip(observations.spans(), _unknown_places(observations.conditions), strict=True):
        program = _residual_program(observations.layout, condition, place)
        r, J, gap = evaluate(program, x, observations.data[:, span])
        parts.append((r, J.reshape(-1, k, len(x)), gap))
    if len(parts) == 1:
        return parts[0]
    r, J, gap = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return r, J, gap


def _unknown_places(conditions: Sequence[Constraint]) -> list[int]:
    """Return of each condition the number of its unknown point, or of its plane's height, among those of its kind."""
    places, counts = [], {"fixed_point": 0, "plane": 0}
    for condition in conditions:
        kind = condition.kind if isinstance(condition, Loop) else ""
        places.append(counts.get(kind, 0))
        if kind in counts:
            counts[kind] += 1
    return places


def place_points(x: np.ndarray, observations: Observations) -> np.ndarray:
    """Return x with each unknown fixed point and height at the mean of the body's points that lie on it."""
    layout = observations.layout
    if not layout.fixed and not layout.planes:
        return x
    x, gaps = x.copy(), residuals(x, observations)[2]
    points, heights = layout.points, layout.heights
    for (condition, span), place in zip(observations.spans(), _unknown_places(observations.conditions), strict=True):
        if isinstance(condition, Loop) and condition.kind == "fixed_point" and condition.closure.at is None:
            x[points][3 * place : 3 * place + 3] += gaps[span].mean(axis=0)
        elif isinstance(condition, Loop) and condition.kind == "plane":
            x[heights][place] += gaps[span, : condition.rows].mean()
    return x


@lru_cache(maxsize=32)
def _residual_program(layout: Layout, condition: Constraint, place: int) -> Program:
    return make_program(_residual_function(layout, condition, place))


def _residual_function(layout: Layout, condition: Constraint, place: int) -> Any:
    """Return the CasADi function of a sample: (x, data) → residuals (k), transposed Jacobian (len(x), k), gap (3)."""
    sensors = layout.sensors
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.rows)
    heading, tilt, drift, soft_tissue = x[layout.heading], x[layout.tilt], x[layout.drift], x[layout.soft_tissue]
    quat_WL = {}
    for i, name in enumerate(sensors):
        now = heading[i] + drift[i] * data[-1]
        turned = product(about_z(now), data[4 * i : 4 * i + 4])
        turned = product(turned, about_z(-heading[i]))
        quat = product(turned, small_turn(ca.vertcat(tilt[2 * i], tilt[2 * i + 1], 0.0)))
        if name in layout.soft:
            k = 9 * layout.soft.index(name)
            A = ca.reshape(soft_tissue[k : k + 9], 3, 3)
            quat = product(quat, small_turn(A @ (rotate(inverse(quat), _UP) - _UP)))
        quat_WL[name] = quat
    gap, hinges = ca.SX.zeros(3), ca.SX.zeros(len(layout.hinges))
    if isinstance(condition, Loop):
        whitened, gap = _closure_residual(layout, condition, x, quat_WL, place, data[layout.place])
        hinges = _hinge_residuals(layout, x, quat_WL)
    elif isinstance(condition, Moving):
        whitened, hinges = ca.SX.zeros(3), _hinge_residuals(layout, x, quat_WL)
    elif isinstance(condition, Pointing):
        along = rotate(
            inverse(quat_WL[condition.reference]), rotate(quat_WL[condition.segment], ca.DM(condition.along))
        )
        whitened = (along - ca.DM(condition.direction)) / condition.std
    else:
        i, axis = sensors.index(condition.segment), ca.DM(condition.axis)
        before = rotate(small_turn(ca.vertcat(tilt[2 * i], tilt[2 * i + 1], 0.0)), axis)
        rise = rotate(quat_WL[condition.segment], axis)[2] - before[2]
        whitened = ca.vertcat(rise / condition.std, 0.0, 0.0)
    r = ca.cse(ca.vertcat(whitened, hinges))
    return ca.Function("sample", [x, data], ca.cse([r, ca.densify(ca.jacobian(r, x)).T, ca.densify(gap)]))


_UP = ca.vertcat(0.0, 0.0, 1.0)


def orient_parts(layout: Layout, x: Any, quat_WL: Mapping[str, Any], parts: Sequence[Part]) -> list[tuple[str, Any]]:
    """Return sensor and vector (3,) [m] in W of each part of a way between points, in CasADi."""
    lengths, vectors = x[layout.length], []
    for part in parts:
        rows = [
            sum((row[i] * lengths[i] for i in map(int, np.flatnonzero(row))), start=ca.SX(c))
            for row, c in zip(np.array(part.by_length), part.constant, strict=True)
        ]
        vector = ca.vertcat(*rows)
        vectors.append((part.sensor, vector if part.sensor == UNIVERSE else rotate(quat_WL[part.sensor], vector)))
    return vectors


def _displace_girdle(layout: Layout, x: Any, quat_WL: Mapping[str, Any], k: int) -> Any:
    """Return the displacement (3,) [m] in W of the point that the k-th girdle moves, in CasADi."""
    term = layout.girdles[k]
    R_on, law = ca.DM(np.reshape(term.R_on, (3, 3))), term.law
    along = R_on.T @ rotate(inverse(quat_WL[law.on]), rotate(quat_WL[law.moves], ca.DM(term.along)))
    by_law, raised = displace(law, (along[0], along[1], along[2]), term.scale, ca)
    own = x[layout.girdle][len(PARAMETERS) * k : len(PARAMETERS) * (k + 1)]
    return rotate(quat_WL[law.on], R_on @ ((1.0 + own[0]) * ca.vertcat(*by_law) + own[1:4] + raised * own[4:]))


def _closure_residual(
    layout: Layout, loop: Loop, x: Any, quat_WL: Mapping[str, Any], place: int, recorded: Any
) -> tuple[Any, Any]:
    """Return the whitened residual (3) and the gap (3) [m] of a closure, in CasADi.

    `place` is the number of its unknown point or plane, `recorded` (3) [m] the sample's recorded place.
    """
    gaps, covariances = [], []
    names = [term.name for term in layout.girdles]
    for way, girdles in zip(loop.ways, loop.girdles, strict=True):
        gap, covariance = ca.SX.zeros(3), loop.closure.slip**2 * ca.SX.eye(3)
        for name, sign in girdles:
            if name in names:
                gap += sign * _displace_girdle(layout, x, quat_WL, names.index(name))
        for sensor, v in orient_parts(layout, x, quat_WL, way):
            gap += v
            if sensor != UNIVERSE:
                covariance += _spread(layout, sensor, v)
        gaps.append(gap)
        covariances.append(covariance)
    if loop.kind == "plane":
        off = [gap[2] - x[layout.heights][place] for gap in gaps]
        rows = [d / ca.sqrt(covariance[2, 2]) for d, covariance in zip(off, covariances, strict=True)]
        missing = GAP_ROWS - len(off)
        return ca.vertcat(*rows, *[0.0] * missing), ca.vertcat(*off, *[0.0] * missing)
    [gap], [covariance] = gaps, covariances
    if loop.kind == "fixed_point":
        first = layout.points.start + 3 * place
        gap -= x[first : first + 3]
    elif loop.kind == "recorded":
        gap -= recorded
    return ca.solve(ca.chol(covariance).T, gap), gap


def _spread(layout: Layout, sensor: str, v: Any) -> Any:
    """Return the covariance (3, 3) [m²] that errors of its sensor give the end of a part v (3,) [m], in CasADi.

    An error of variance σ² about each axis moves the end by a vector of covariance σ² (‖v‖² 1 − v vᵀ). Only the ratios
    of these weights matter.
    """
    std = layout.attitude_std[layout.sensors.index(sensor)]
    return std**2 * (ca.sumsqr(v) * ca.SX.eye(3) - v @ v.T)


def _hinge_residuals(layout: Layout, x: Any, quat_WL: Mapping[str, Any]) -> Any:
    """Return the angles by which segments leave the planes of their hinges, in units of `HINGE_STD`, in CasADi."""
    unknown, residual = x[layout.hinge], []
    for i, hinge in enumerate(layout.hinges):
        along = rotate(inverse(quat_WL[hinge.on]), rotate(quat_WL[hinge.moves], ca.DM(hinge.along)))
        axis = ca.DM(hinge.axis) + unknown[2 * i] * ca.DM(hinge.across) + unknown[2 * i + 1] * ca.DM(hinge.tilted)
        residual.append(ca.dot(axis, along) / ca.norm_2(axis) / HINGE_STD)
    return ca.vertcat(*residual)
