"""Which joints set a segment's orientation, and the values that bring it nearest to one that is given.

Between a segment and the one above it lie joints. The rotation that they have to make together is known from the
orientations; how they share it is decided here:

- a segment of a limb is set by the joints nearest to it, as many as make three axes; others above (a clavicle) rest;
- a segment of the spine is set by all joints in between: each place in the spine takes an equal share of the tilt;
- where one of them is spherical, it takes what the others leave, with it the turn about the segment's long axis (a
  whole turn of the person does not twist the spine): the segment follows exactly;
- one or two axes come as near as they can, in closed form; three and more by Levenberg-Marquardt.

Near means the smallest angle. Limits of joints are not looked at here; `follow` keeps those of hinges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadModel
from ..rotations import conjugate, exp, log, multiply, rotation_about
from .table import BodyTable

_MEET_TOLERANCE = 1e-6  # [m]
_ROUNDS = 60  # Levenberg-Marquardt; about 6 are the rule
_CLOSE = 1e-24  # [rad²]


class Chain(NamedTuple):
    """The joints that set a segment's orientation, from the root outwards.

    Their rotations are taken about axes in the frame above, all joints at zero: their product, in this order, is the
    segment's rotation out of zero there.
    """

    joints: tuple[int, ...]  # Pinocchio's; empty where the segment is rigid with the one above
    above: int  # the Pinocchio joint in whose moving frame the axes are given
    axes: tuple[np.ndarray | None, ...]  # (3,); None: a spherical joint
    place: tuple[int, ...]  # the same number for joints that meet in one point
    quat: tuple[np.ndarray, ...]  # (4,) xyzw, each joint's frame to the frame above, at zero
    quat_AL: np.ndarray  # (4,) xyzw, segment to the frame above, at zero

    @property
    def exact(self) -> bool:
        """Whether every orientation can be followed."""
        return any(axis is None for axis in self.axes)


def find_chains(model: pin.Model, table: BodyTable) -> dict[str, Chain]:
    """Segment → its chain, for segments that the model has, in the order of Pinocchio's joints.

    Raises
    ------
    BadModel
        A mimic joint lies between two segments.
    """
    frames = {name: model.frames[model.getFrameId(name)] for name in table.segments if model.existFrame(name)}
    at = _first_segments(frames)
    between = {segment: _joints_below(model, joint, set(at)) for joint, segment in at.items()}
    for segment, joints in between.items():
        for joint in joints:
            if "Mimic" in model.joints[joint].shortname():
                raise BadModel(
                    f"{model.name}: joint '{model.names[joint]}' mimics another and carries '{segment}'; it must be "
                    f"free or fixed for the segment to be followed"
                )
    # A joint that moves two segments at once rests.
    times = Counter(joint for joints in between.values() for joint in joints)
    by_segment = {}
    for segment, frame in sorted(frames.items(), key=lambda item: item[1].parentJoint):
        free = [j for j in between.get(segment, []) if times[j] == 1 and "Prismatic" not in model.joints[j].shortname()]
        if not table.segments[segment].spine:
            free = _take_nearest_three(model, free)
        by_segment[segment] = _chain(model, frame, free)
    return by_segment


def find_parents(model: pin.Model, table: BodyTable) -> dict[str, str | None]:
    """Segment → the segment above it, None for the first; of segments on one joint the later ones are on the first."""
    frames = {name: model.frames[model.getFrameId(name)] for name in table.segments if model.existFrame(name)}
    at = _first_segments(frames)
    parents: dict[str, str | None] = {}
    for segment, frame in frames.items():
        joint = frame.parentJoint
        if at[joint] != segment:
            parents[segment] = at[joint]
            continue
        above = [j for j in reversed(model.supports[joint].tolist()) if j != joint and j in at]
        parents[segment] = at[above[0]] if above else None
    return parents


def _first_segments(frames: Mapping[str, pin.Frame]) -> dict[int, str]:
    """Joint → the first of the segments that it carries; the others are rigid with that."""
    at: dict[int, str] = {}
    for segment, frame in frames.items():
        at.setdefault(frame.parentJoint, segment)
    return at


def solve(chain: Chain, quat: np.ndarray) -> list[np.ndarray]:
    """For each joint of the chain its angle (n,) [rad], or its rotation (n, 4) xyzw in its own frame if spherical.

    `quat` (n, 4) xyzw: the segment in the frame above, as it should be.
    """
    target = multiply(quat, conjugate(chain.quat_AL))
    if chain.exact:
        values = _split_rotation(chain, target)
    else:
        values = _hinges([axis for axis in chain.axes if axis is not None], target)
    return [
        multiply(conjugate(frame), multiply(value, frame)) if axis is None else value
        for axis, frame, value in zip(chain.axes, chain.quat, values, strict=True)
    ]


# Which joints -----------------------------------------------------------------------------------------------------


def _joints_below(model: pin.Model, joint: int, stops: set[int]) -> list[int]:
    """Joints from below the next one that carries a segment, or from the root, down to `joint`."""
    path = model.supports[joint].tolist()[1:]
    carrying = [k for k, above in enumerate(path[:-1]) if above in stops]
    return path[carrying[-1] + 1 :] if carrying else path


def _take_nearest_three(model: pin.Model, joints: list[int]) -> list[int]:
    """The joints nearest to the segment, as many as make three axes, or all."""
    axes = 0
    for k, joint in enumerate(reversed(joints)):
        axes += model.nvs[joint]
        if axes >= 3:
            return joints[len(joints) - 1 - k :]
    return joints


def axis_in_joint(model: pin.Model, joint: int) -> np.ndarray | None:
    """Axis (3,) of a joint in its own frame; None for a spherical one."""
    if model.nvs[joint] == 3:
        return None
    moved = model.joints[joint]
    data = moved.createData()  # of this joint alone: of the whole model it takes fifty times as long
    moved.calc(data, pin.neutral(model))
    return np.asarray(data.S)[3:].copy()


def _chain(model: pin.Model, frame: pin.Frame, free: list[int]) -> Chain:
    above = model.parents[free[0]] if free else frame.parentJoint
    supports = model.supports[frame.parentJoint].tolist()
    M, place = pin.SE3.Identity(), 0
    axes: list[np.ndarray | None] = []
    places, quats = [], []
    last = None
    for joint in supports[supports.index(above) + 1 :]:
        M = M * model.jointPlacements[joint]
        if joint not in free:
            continue
        axis = axis_in_joint(model, joint)
        if last is not None and np.linalg.norm(M.translation - last) > _MEET_TOLERANCE:
            place += 1
        last = M.translation.copy()
        axes.append(None if axis is None else M.rotation @ axis)
        places.append(place)
        quats.append(pin.Quaternion(M.rotation).coeffs().copy())
    quat_AL = pin.Quaternion(M.rotation @ frame.placement.rotation).coeffs().copy()
    return Chain(tuple(free), above, tuple(axes), tuple(places), tuple(quats), quat_AL)


# Values -----------------------------------------------------------------------------------------------------------


def _split_rotation(chain: Chain, target: np.ndarray) -> list[np.ndarray]:
    """Values of joints, one of them spherical, whose product is `target` (n, 4).

    Places share the tilt of the segment's long axis equally; the last spherical joint takes what the others leave.
    """
    free = max(k for k, axis in enumerate(chain.axes) if axis is None)
    places = chain.place[-1] + 1
    share = exp(log(_remove_heading(target, chain.quat_AL)) / places) if len(chain.axes) > 1 else target
    angles = [np.zeros(len(target)) for _ in chain.axes]
    for place in set(chain.place) - {chain.place[free]}:
        same_place = [k for k, at in enumerate(chain.place) if at == place]
        spherical = [k for k in same_place if chain.axes[k] is None]
        hinges = [(k, axis) for k in same_place if (axis := chain.axes[k]) is not None]
        if spherical:  # hinges in the same place rest
            angles[spherical[0]] = share
        else:
            for (k, _), value in zip(hinges, _hinges([axis for _, axis in hinges], share), strict=True):
                angles[k] = value
    before = after = np.array([0.0, 0.0, 0.0, 1.0])
    for k, (axis, value) in enumerate(zip(chain.axes, angles, strict=True)):
        if k != free:
            turn = value if axis is None else rotation_about(axis, value)
            before, after = (multiply(before, turn), after) if k < free else (before, multiply(after, turn))
    angles[free] = multiply(multiply(conjugate(before), target), conjugate(after))
    return angles


def _remove_heading(target: np.ndarray, quat_AL: np.ndarray) -> np.ndarray:
    """What is left of rotations (n, 4) when the turn about z of L at zero, that came before, is taken off."""
    up = Rotation.from_quat(quat_AL).apply([0.0, 0.0, 1.0])
    turn = np.column_stack([np.outer(target[:, :3] @ up, up), target[:, 3]])
    norm = np.linalg.norm(turn, axis=1)
    turn[norm < 1e-9] = [0.0, 0.0, 0.0, 1.0]  # upside down: no turn is better than another
    return multiply(target, conjugate(turn / np.maximum(norm, 1e-9)[:, None]))


def _hinges(axes: list[np.ndarray], target: np.ndarray) -> list[np.ndarray]:
    """Angles (n,) [rad] of hinges whose product comes nearest to `target` (n, 4)."""
    v, w = target[:, :3], target[:, 3]
    if not axes:
        return []
    if len(axes) == 1:
        return [_wrap_angle(2.0 * np.arctan2(v @ axes[0], w))]
    if len(axes) > 2:
        return _many_hinges(np.array(axes), target)
    # With half angles α, β the scalar product of the two quaternions is (cos α, sin α) m (cos β, sin β)ᵀ, that is
    # ½ [(m00 + m11) cos(α−β) + (m10 − m01) sin(α−β)] + ½ [(m00 − m11) cos(α+β) + (m10 + m01) sin(α+β)]:
    # each bracket has its largest value alone.
    a, b = axes
    m00, m01, m10, m11 = w, v @ b, v @ a, v @ np.cross(a, b) - w * (a @ b)
    difference = np.arctan2(m10 - m01, m00 + m11)
    total = np.arctan2(m10 + m01, m00 - m11)
    return [_wrap_angle(total + difference), _wrap_angle(total - difference)]


def _many_hinges(axes: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """The same for three and more hinges (k, 3), from zero by Levenberg-Marquardt, so with small angles."""
    n, k = len(target), len(axes)
    angles = np.zeros((n, k))
    damping = np.full(n, 1e-6)
    error, J = _error(axes, angles, target)
    for _ in range(_ROUNDS):
        open_rows = np.flatnonzero(np.einsum("ni,ni->n", error, error) > _CLOSE)
        if not len(open_rows):
            break
        e, Jo, lam = error[open_rows], J[open_rows], damping[open_rows]
        A = Jo @ np.swapaxes(Jo, 1, 2) + lam[:, None, None] * np.eye(3)
        step = np.einsum("nij,ni->nj", Jo, np.linalg.solve(A, e[:, :, None])[:, :, 0])
        tried = angles[open_rows] + step
        new_error, new_J = _error(axes, tried, target[open_rows])
        better = np.einsum("ni,ni->n", new_error, new_error) < np.einsum("ni,ni->n", e, e)
        rows = open_rows[better]
        angles[rows], error[rows], J[rows] = tried[better], new_error[better], new_J[better]
        damping[open_rows] = np.where(better, lam / 10.0, lam * 10.0).clip(1e-12, 1e6)
    return [_wrap_angle(angles[:, i]) for i in range(k)]


def _error(axes: np.ndarray, angles: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector (n, 3) that is left to `target`, and its Jacobian (n, 3, k), both in the frame above."""
    R = Rotation.identity(len(target))
    J = np.empty((len(target), 3, len(axes)))
    for i, axis in enumerate(axes):
        J[:, :, i] = R.apply(axis)
        R = R * Rotation.from_rotvec(angles[:, i, None] * axis)
    return (Rotation.from_quat(target) * R.inv()).as_rotvec(), J


def _wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Angles [rad] in (−pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
