"""The unknowns x of a calibration and the residuals r of its samples; `least_squares` solves

    minimise  ½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c),   no length below `MIN_LENGTH`

with the weights w of its outer rounds. The prior c, Λ holds all that is known beside the samples: population, start
pose, mounts and measured lengths (`build_prior`), and accelerations of joints (`headings.add_couplings`).

For each sensor i the filter gives R_VS(t) in a world V of its own heading, and Q(t) = R_VS(t) R_VS(start)ᵀ. Here L is
the frame of its segment that equals W in the start pose (L' in `observations`). With a start pose that is ε off the
stated one, R_WL(start) = exp(ε), the mount is R_LS = exp(−ε) Rz(ψ) R_VS(start) and

    R(t) = Rz(ψ + d τ) Q(t) Rz(−ψ) exp(ε),    R_WL(t) = R exp(A (Rᵀ e_z − e_z))

with ψ the heading, d its drift over the time τ since the start, and A the rotation of a sensor on a foam, which gives
as the direction of gravity in the segment changes. Skin lags behind a bone that twists: a segment above a hinge has
turned further than its sensor about its long axis, by g times the sine of the twist that the sensor shows against the
segment above it. A forearm that pronates goes inwards: it leaves the plane of its hinge by c times the sine of its
twist against the upper arm. A segment's points may move, as the shoulders do by collarbones and shoulder blades while
the arms are raised (`body.girdle`). d, A, g, c and the hinges are nuisance parameters: the covariance of lengths and
mounts includes their effect.

Each sample belongs to one condition of the protocol. A closure gives the gap, whitened by the covariance that errors of
the orientations and slipping palms give it, and of each hinge the sine of the angle by which the segment that it moves
leaves its plane. The covariance depends on the lengths, so that scaling all lengths does not shrink the residual. A
`Direction` gives the deviation of a segment's long axis from it, an `Axis` how far the axis rises while the segment
bends. Each sample has the same residuals: three of its condition and one for each hinge; those that do not apply are
zero.
"""

import math
from collections.abc import Mapping
from functools import cached_property

import casadi as ca
import numpy as np

from ..body import BodyModel
from ..body.girdle import PARAMETERS
from ..body.mounts import find_start_pose
from ..body.subject import Subject
from ..errors import BadSubject
from ..observations import (
    ZERO_LENGTH,
    about_z,
    express_covariance,
    express_deviation,
    express_twist,
    find_girdles,
    find_hinges,
    product,
    rotate,
    rotate_back,
    small_rotation,
)
from ..recording import Recording
from .protocols import Axis, Closure, Condition, Direction, FreeMotion, Protocol

GAP_ROWS = 3  # residuals of a sample's condition
HINGE_STD = np.deg2rad(2.0)  # [rad] of a segment against its hinge's plane; the unit of these residuals
# [rad] of orientations, of which only ratios matter: arms 60 deg off hanging, as hands are joined before the chest, the
# trunk 15 deg off upright, as it leans with them (Gates 2016: 23 deg at most), and links where nothing is soft.
USUAL_ELEVATION, USUAL_LEAN, RIGID_ATTITUDE_STD = np.deg2rad((60.0, 15.0, 1.5))
# Standard deviations of the prior.
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
LEAST_FOAM_STD = 1e-4  # [rad/rad] about an axis about which a table states that no foam gives
LEAST_GIRDLE_STD = 1e-5  # [m] of a parameter that a table states as exact
POINT_STD = 3.0  # [m] of an unknown point of W

Gaussian = tuple[np.ndarray, np.ndarray]  # a normal distribution of x: mean (m,) and information (m, m)


# Unknowns -------------------------------------------------------------------------------------------------------------


class Layout:
    """The unknowns of a protocol on a body, each with its places in x (m,); raise as `Protocol.resolve`."""

    def __init__(self, protocol: Protocol, model: BodyModel, recording: Recording) -> None:
        self.protocol, self.model, table = protocol, model, model.table
        self.start_pose = find_start_pose(model, recording)
        self.conditions, self.paths = protocol.resolve(model, self.start_pose, recording)
        used = {segment for paths in self.paths.values() for path in paths for segment in path.segments}
        for condition in self.conditions:
            if isinstance(condition, FreeMotion):
                used |= set(recording.sensors)
            elif isinstance(condition, Direction | Axis):
                used |= {condition.segment, condition.reference if isinstance(condition, Direction) else ""}
        self.sensors = tuple(name for name in table.segments if name in used)  # their segments
        self.lengths = tuple(model.lengths)
        self.hinges = find_hinges(model, self.start_pose, self.sensors)
        self.girdles = find_girdles(model, self.sensors)
        tissues = {name: table.segments[name].soft_tissue for name in self.sensors}
        # Hinges that show how the segment above them twists against the one above that, both with sensors.
        twisting = [name for name, own in tissues.items() if own.per_twist and own.relative_to in self.sensors]
        self.twists = [hinge for hinge in self.hinges if hinge.on in twisting]
        # Hinges whose segment below leaves the plane by c times its twist.
        self.carried = [hinge.name for hinge in self.hinges if hinge.per_twist_std]
        self.soft = [name for name in self.sensors if any(table.segments[name].foam_std)]  # sensors on a foam
        self.attitude_std = dict[str, float]()  # [rad] of each orientation about an axis across its segment
        for name, tissue in tissues.items():
            tilt = USUAL_ELEVATION if tissue.relative_to else USUAL_LEAN
            growth = np.hypot(tilt * np.array(tissue.per_tilt), USUAL_ELEVATION * np.array(tissue.per_raised))
            std = float(np.sqrt(np.mean(np.square(tissue.std) + growth**2)))
            self.attitude_std[name] = std or RIGID_ATTITUDE_STD
        self.size = 0  # m

        def place(*shape: int) -> np.ndarray:
            """Return the places of the next unknowns."""
            begin, self.size = self.size, self.size + math.prod(shape)
            return np.arange(begin, self.size).reshape(shape)

        self.length = place(len(self.lengths))  # [m]
        self.heading = place(len(self.sensors))  # ψ [rad]
        self.tilt = place(len(self.sensors), 2)  # ε about x and y of L [rad]
        self.drift = place(len(self.sensors))  # d [rad/s]
        self.hinge = place(len(self.hinges), 2)  # of its axis along `across` and `tilted`
        self.foam = place(len(self.soft), 9)  # A [rad], column by column
        self.twist = place(len(self.twists))  # g
        self.carrying = place(len(self.carried))  # c
        self.girdle = place(len(self.girdles), len(PARAMETERS))  # `body.girdle.PARAMETERS`
        # Closure → the places of its fixed point of W, or the place of its plane's height [m].
        self.unknown = {closure: place(3) for closure in self.paths if closure.kind == "fixed_point"}
        self.unknown |= {closure: place() for closure in self.paths if closure.kind == "plane"}
        # Of a sample's data: Q of each sensor xyzw, the recorded place (3,) [m] in W where there is one, and the time.
        recorded = 3 * any(closure.kind == "recorded" for closure in self.paths)
        self.place = slice(4 * len(self.sensors), 4 * len(self.sensors) + recorded)
        self.residuals = GAP_ROWS + len(self.hinges)  # of a sample

    @cached_property
    def length_groups(self) -> dict[str, tuple[str, ...]]:
        """Sensor → the lengths that rotate with it in some closure, which observes sums of those in one direction."""
        groups: dict[str, dict[str, None]] = {}
        for segment, (B, _) in [each for paths in self.paths.values() for p in paths for each in p.vectors.items()]:
            moved = np.abs(B).max(axis=0) > ZERO_LENGTH
            names = [name for name, moves in zip(self.lengths, moved, strict=True) if moves]
            groups.setdefault(segment, {}).update(dict.fromkeys(names))
        return {sensor: tuple(names) for sensor, names in groups.items() if names}

    @property
    def lengths_in_closures(self) -> tuple[str, ...]:
        """The names of the lengths that some closure contains."""
        inside = {name for group in self.length_groups.values() for name in group}
        return tuple(name for name in self.lengths if name in inside)

    @property
    def scale_observed(self) -> bool:
        """Whether the closures determine the scale: by a recorded or known place, or by a link of known size."""
        known = [c.any() for paths in self.paths.values() for path in paths for _, c in path.vectors.values()]
        return any(known) or any(c.kind == "recorded" or c.at is not None for c in self.paths)

    @cached_property
    def functions(self) -> dict[Condition, tuple[ca.Function, ca.Function]]:
        """Condition → two functions of x (m,) and a sample's data (rows,).

        The first gives its residuals (k,) and its gap (3,) [m], zero without a closure; the second the Jacobian of the
        residuals, transposed (m, k).
        """
        return {condition: _express_residuals(self, condition) for condition in self.conditions}


# Residuals ------------------------------------------------------------------------------------------------------------


def _express_residuals(layout: Layout, condition: Condition) -> tuple[ca.Function, ca.Function]:
    x, data = ca.SX.sym("x", layout.size), ca.SX.sym("data", layout.place.stop + 1)
    quat_WL = _orient_segments(layout, x, data)
    r, gap, hinges = ca.SX.zeros(GAP_ROWS), ca.SX.zeros(3), ca.SX.zeros(len(layout.hinges))
    if isinstance(condition, Closure):
        r, gap = _express_closure(layout, condition, quat_WL, x, data[layout.place])
    elif isinstance(condition, Direction):
        along_W = rotate(quat_WL[condition.segment], condition.along)
        r = (rotate_back(quat_WL[condition.reference], along_W) - ca.DM(condition.direction)) / condition.std
    elif isinstance(condition, Axis):
        start = _start_rotation(layout, x, condition.segment)
        r[0] = (rotate(quat_WL[condition.segment], condition.axis) - rotate(start, condition.axis))[2] / condition.std
    if isinstance(condition, Closure | FreeMotion):
        carrying = dict(zip(layout.carried, ca.vertsplit(x[layout.carrying]), strict=True))
        for i, hinge in enumerate(layout.hinges):
            both, c = (quat_WL[hinge.on], quat_WL[hinge.moves]), carrying.get(hinge.name, hinge.per_twist)
            hinges[i] = express_deviation(hinge, *both, x[layout.hinge[i]], c) / HINGE_STD
    r = ca.cse(ca.vertcat(r, hinges))
    jacobian = ca.cse(ca.densify(ca.jacobian(r, x)).T)
    return ca.Function("residuals", [x, data], [r, ca.densify(gap)]), ca.Function("jacobian", [x, data], [jacobian])


def _orient_segments(layout: Layout, x: ca.SX, data: ca.SX) -> dict[str, ca.SX]:
    """Return `quat_WL` (4,) of each segment with a sensor, with foam and twist as above."""
    quat_WL, up = {}, ca.DM([0.0, 0.0, 1.0])
    for i, name in enumerate(layout.sensors):
        heading, drift = x[layout.heading[i]], x[layout.drift[i]]
        quat = product(about_z(heading + drift * data[-1]), data[4 * i : 4 * i + 4])
        quat = product(product(quat, about_z(-heading)), _start_rotation(layout, x, name))
        if name in layout.soft:
            A = ca.reshape(x[layout.foam[layout.soft.index(name)]], 3, 3)
            quat = product(quat, small_rotation(A @ (rotate_back(quat, up) - up)))
        quat_WL[name] = quat
    for hinge, lag in zip(layout.twists, ca.vertsplit(x[layout.twist]), strict=True):
        above = quat_WL[layout.model.table.segments[hinge.on].soft_tissue.relative_to]
        sine = express_twist(above, quat_WL[hinge.on], hinge.along_on)
        quat_WL[hinge.on] = product(quat_WL[hinge.on], small_rotation(lag * sine * ca.DM(hinge.along_on)))
    return quat_WL


def _start_rotation(layout: Layout, x: ca.SX, segment: str) -> ca.SX:
    """Return exp(ε) (4,) of a segment."""
    return small_rotation(ca.vertcat(x[layout.tilt[layout.sensors.index(segment)]], 0.0))


def _express_closure(
    layout: Layout, closure: Closure, quat_WL: Mapping[str, ca.SX], x: ca.SX, recorded: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the whitened residual (3,) and the gap (3,) [m]; `recorded` (3,) [m] is a recorded place."""
    girdles = {name: x[own] for name, own in zip(layout.girdles, layout.girdle, strict=True)}
    off, r = ca.SX.zeros(3), ca.SX.zeros(GAP_ROWS)
    for k, path in enumerate(layout.paths[closure]):
        gap, vectors = path.express(quat_WL, x[layout.length], girdles)
        covariance = express_covariance(vectors, closure.slip, layout.attitude_std)
        if closure.kind == "plane":
            off[k] = gap[2] - x[layout.unknown[closure]]
            r[k] = off[k] / ca.sqrt(covariance[2, 2])
            continue
        if closure.kind == "fixed_point":
            gap -= x[layout.unknown[closure]]
        elif closure.kind == "recorded":
            gap -= recorded
        off, r = gap, ca.solve(ca.chol(covariance).T, gap)
    return r, off


# Prior ----------------------------------------------------------------------------------------------------------------


def build_prior(
    layout: Layout, prior: Subject, measured: Mapping[str, tuple[float, float]], sensors: Mapping[str, Gaussian]
) -> Gaussian:
    """Return all that is known before the motion, as one Gaussian over x.

    Parameters
    ----------
    prior : lengths and girdles
    measured : name of a length → value and standard deviation [m]
    sensors : segment → what is known of its sensor's (ε_x, ε_y, ψ)

    It raises `BadSubject` where the prior has no positive definite covariance of its lengths.
    """
    table, information, mean = layout.model.table, np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    shape = np.concatenate((layout.length, layout.girdle.ravel()))
    mean[shape], information[np.ix_(shape, shape)] = _build_shape_prior(layout, prior, measured)
    for name, tilt, heading in zip(layout.sensors, layout.tilt, layout.heading, strict=True):
        rows = [*tilt, heading]
        mean[rows], information[np.ix_(rows, rows)] = sensors[name]
    information[layout.drift, layout.drift] = DRIFT_STD**-2
    for name, foam in zip(layout.soft, layout.foam, strict=True):
        information[foam, foam] = np.maximum(np.tile(table.segments[name].foam_std, 3), LEAST_FOAM_STD) ** -2.0
    for hinge, twist in zip(layout.twists, layout.twist, strict=True):
        information[twist, twist] = table.segments[hinge.on].soft_tissue.per_twist ** -2.0
    for name, c in zip(layout.carried, layout.carrying, strict=True):
        mean[c], information[c, c] = table.hinges[name].per_twist_mean, table.hinges[name].per_twist_std ** -2.0
    # Axes of hinges; those of a left and a right one are partly alike.
    hinges = {hinge.name: rows for hinge, rows in zip(layout.hinges, layout.hinge, strict=True)}
    for name, (across, tilted) in hinges.items():
        own, other = table.hinges[name], table.counterpart(name)
        mean[tilted], information[tilted, tilted] = own.tilt_mean, own.tilt_std**-2
        if other not in hinges:
            information[across, across] = 1.0 / (own.common_std**2 + own.mirror_std**2)
        elif table.side(name) == "left":
            pair = np.ix_((across, hinges[other][0]), (across, hinges[other][0]))
            information[pair] = 0.25 * own.common_std**-2 + 0.25 * own.mirror_std**-2 * np.array([[1, -1], [-1, 1]])
    for closure, places in layout.unknown.items():
        information[places, places] = (POINT_STD if closure.at is None else closure.at_std) ** -2
        mean[places] = closure.at or 0.0
    return mean, information


def _build_shape_prior(layout: Layout, prior: Subject, measured: Mapping[str, tuple[float, float]]) -> Gaussian:
    """Return lengths and girdles jointly: of the prior, else of the table, with measured lengths."""
    table, size, count = layout.model.table, len(PARAMETERS), len(layout.lengths)
    own = [prior.girdles.get(name, np.zeros(size)) for name in layout.girdles]
    begins = [count + size * list(table.girdles).index(name) for name in layout.girdles]
    rows = np.concatenate([np.arange(count), *(begin + np.arange(size) for begin in begins)])
    covariance = prior.shape_covariance(table)[np.ix_(rows, rows)]
    covariance[count:, count:] += LEAST_GIRDLE_STD**2 * np.eye(len(covariance) - count)
    if not set(layout.lengths) <= set(prior.order) or np.any(np.linalg.eigvalsh(covariance) <= 0.0):
        raise BadSubject(f"prior '{prior.name}': all its lengths need a covariance, and it must be positive definite")
    K = np.linalg.inv(covariance)
    target = K @ np.concatenate(([prior.lengths[name] for name in layout.lengths], *own))
    for name, (metres, std) in measured.items():
        i = layout.lengths.index(name)
        K[i, i] += std**-2
        target[i] += metres * std**-2
    return np.linalg.solve(K, target), K
