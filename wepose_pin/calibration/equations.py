"""The unknowns x of a calibration and the residuals r of its samples; `least_squares` solves

    minimise  ½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c),   no length below `MIN_LENGTH`

with the prior c, Λ of `priors` and the weights w of `weights`.

For each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. Here L is
the frame of its segment that equals W in the start pose (L' in `observations`). With a start pose that is ε off the
stated one, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R_WL(t) = Rz(ψ + d τ) Q(t) Rz(−ψ) exp(ε) exp(A (R_WLᵀ e_z − e_z))

with ψ the heading, d its drift since the start, and A the rotation of a sensor on a foam, which gives as the direction
of gravity in the segment changes. Skin lags behind a bone that twists: a segment above a hinge has turned about its
long axis by g times the twist that its sensor shows. A segment's points may move, as the shoulders do by collarbones
and shoulder blades while the arms are raised (`body.girdle`). d, A, g and the hinges are nuisance parameters: the
covariance of lengths and mounts includes their effect.

Each sample belongs to one condition of the protocol. A closure (`Loop`) gives the gap, whitened by the covariance that
errors of the orientations and slipping palms give it, and of each hinge the angle by which the segment that it moves
leaves its plane. The covariance depends on the lengths, so that scaling all lengths does not shrink the residual. A
stated pose (`Pointing`) gives the deviation of a segment from its direction, an axis (`Level`) how far it rises while
the segment bends. Each sample has the same residuals: three of its condition and one a hinge; those that do not apply
are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from ..body import BodyTable
from ..body.girdle import PARAMETERS
from ..body.soft_tissue import LEAST_TWIST_COSINE
from ..body.table import Vector
from ..observations.expressions import (
    GirdleTerm,
    HingePlane,
    about_z,
    express_covariance,
    express_path,
    product,
    rotate_back,
    small_rotation,
)
from .conditions import Constraint, Level, Loop, Pointing
from .protocols import FreeMotion

HINGE_STD = np.deg2rad(2.0)  # [rad] of a segment against its hinge's plane; the unit of these residuals
GAP_ROWS = 3  # residuals of a sample's condition


# A segment's rotation about its long axis (3,) in L', against the segment above, both with a sensor: the segment, the
# one above, the axis, and how far sensors lag behind it, one standard deviation [rad/rad] per angle that they show.
Twist = tuple[str, str, Vector, float]


def find_twists(table: BodyTable, hinges: Sequence[HingePlane], sensors: Sequence[str]) -> tuple[Twist, ...]:
    """Find the twists that hinges show: of the segments above them."""
    tissues = [(hinge, table.segments[hinge.on].soft_tissue) for hinge in hinges]
    return tuple(
        (hinge.on, tissue.relative_to, hinge.along_on, tissue.per_twist)
        for hinge, tissue in tissues
        if tissue.per_twist and tissue.relative_to in sensors
    )


@dataclass(frozen=True)
class Layout:
    """The unknowns, each with its places in x, and the data of a sample."""

    lengths: tuple[str, ...]  # names, in the order of the table
    sensors: tuple[str, ...]  # their segments, in the order of the table
    hinges: tuple[HingePlane, ...] = ()  # between segments of these sensors
    girdles: tuple[GirdleTerm, ...] = ()
    twists: tuple[Twist, ...] = ()  # of the segments above the hinges
    fixed: int = 0  # number of fixed points
    planes: int = 0  # number of level planes of unknown height
    recorded: bool = False  # the samples have a recorded place
    attitude_std: tuple[float, ...] = ()  # [rad] of each orientation about an axis across its segment; ratios matter
    soft: tuple[str, ...] = ()  # sensors on a foam

    # The places of each unknown in x, and their number; set below.
    length = heading = tilt = drift = hinge = foam = twist = girdle = point = height = np.empty(0, dtype=int)
    size = 0

    def __post_init__(self) -> None:
        sensors, begin = len(self.sensors), 0
        shapes = {
            "length": (len(self.lengths),),  # [m]
            "heading": (sensors,),  # ψ [rad]
            "tilt": (sensors, 2),  # ε about x and y of L [rad]
            "drift": (sensors,),  # d [rad/s]
            "hinge": (len(self.hinges), 2),  # of its axis along `across` and `tilted`
            "foam": (len(self.soft), 9),  # A [rad], column by column
            "twist": (len(self.twists),),  # g
            "girdle": (len(self.girdles), len(PARAMETERS)),  # `body.girdle.PARAMETERS`
            "point": (self.fixed, 3),  # of W [m]
            "height": (self.planes,),  # of W [m]
        }
        for name, shape in shapes.items():
            places = begin + np.arange(np.prod(shape, dtype=int)).reshape(shape)
            object.__setattr__(self, name, places)
            begin += places.size
        object.__setattr__(self, "size", begin)

    @property
    def place(self) -> slice:
        """Of a sample's data: the recorded place (3,) [m] in W."""
        return slice(4 * len(self.sensors), 4 * len(self.sensors) + 3 * self.recorded)

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
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.place.stop + 1)
    quat_WL = _orient_segments(layout, x, data)
    r, gap, hinges = ca.SX.zeros(GAP_ROWS), ca.SX.zeros(3), ca.SX.zeros(len(layout.hinges))
    if isinstance(condition, Loop):
        r, gap = _closure_residual(layout, condition, quat_WL, x, data[layout.place])
    elif isinstance(condition, Pointing):
        r = condition.residual(quat_WL)
    elif isinstance(condition, Level):
        r[0] = condition.residual(quat_WL, _start_rotation(layout, x, condition.segment))
    if isinstance(condition, Loop | FreeMotion):
        for i, hinge in enumerate(layout.hinges):
            error = x[layout.hinge[i]]
            hinges[i] = hinge.deviation(quat_WL[hinge.on], quat_WL[hinge.moves], error) / HINGE_STD
    r = ca.cse(ca.vertcat(r, hinges))
    jacobian = ca.cse(ca.densify(ca.jacobian(r, x)).T)
    return ca.Function("residuals", [x, data], [r, ca.densify(gap)]), ca.Function("jacobian", [x, data], [jacobian])


def _orient_segments(layout: Layout, x: ca.SX, data: ca.SX) -> dict[str, ca.SX]:
    """Return `quat_WL` (4,) of each segment with a sensor: by foam, and the twists by g, as above."""
    quat_WL, up = {}, ca.DM([0.0, 0.0, 1.0])
    for i, name in enumerate(layout.sensors):
        heading, drift = x[layout.heading[i]], x[layout.drift[i]]
        quat = product(about_z(heading + drift * data[-1]), data[4 * i : 4 * i + 4])
        quat = product(product(quat, about_z(-heading)), _start_rotation(layout, x, name))
        if name in layout.soft:
            A = ca.reshape(x[layout.foam[layout.soft.index(name)]], 3, 3)
            quat = product(quat, small_rotation(A @ (rotate_back(quat, up) - up)))
        quat_WL[name] = quat
    for (name, above, along, _), lag in zip(layout.twists, ca.vertsplit(x[layout.twist]), strict=True):
        relative = product(ca.vertcat(-quat_WL[above][:3], quat_WL[above][3]), quat_WL[name])
        part, w = ca.dot(relative[:3], ca.DM(along)), relative[3]
        sine = 2.0 * part * w / ca.fmax(part**2 + w**2, LEAST_TWIST_COSINE)
        quat_WL[name] = product(quat_WL[name], small_rotation(lag * sine * ca.DM(along)))
    return quat_WL


def _start_rotation(layout: Layout, x: ca.SX, segment: str) -> ca.SX:
    """Return exp(ε) (4,) of a segment."""
    tilt = x[layout.tilt[layout.sensors.index(segment)]]
    return small_rotation(ca.vertcat(tilt, 0.0))


def _closure_residual(
    layout: Layout, loop: Loop, quat_WL: Mapping[str, ca.SX], x: ca.SX, recorded: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the whitened residual (3,) and the gap (3,) [m] of a closure; `recorded` (3,) [m] is a recorded place."""
    attitude_std = dict(zip(layout.sensors, layout.attitude_std, strict=True))
    girdles = {g.name: (g, x[own]) for g, own in zip(layout.girdles, layout.girdle, strict=True)}
    gaps, covariances = [], []
    for path in loop.paths:
        gap, vectors = express_path(path, quat_WL, x[layout.length], girdles)
        gaps.append(gap)
        covariances.append(express_covariance(vectors, loop.closure.slip, attitude_std))
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
