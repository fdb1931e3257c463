"""Segment orientations → the configuration of a body: exactly where its joints can, else as near as they come.

First every segment by itself, from the root outwards (`chains`). A spherical joint has done its work with that. Where a
segment of an arm hangs on fewer axes, or on hinges that have ends, what they cannot do is shared: `fit` over all
measured segments of that arm, in the frames in which something is missed or a limit passed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from .. import so3
from .body import BodyModel
from .chains import AXIAL, Chain, about, axis_in_joint, conjugate, multiply, solve
from .fit import fit, limits_of

_MISSED = 1e-9  # [rad] that is nothing


class Group(NamedTuple):
    """Segments that are fitted together, and the joints that set them."""

    segments: tuple[str, ...]
    joints: tuple[int, ...]


def groups(found: Mapping[str, Chain], measured: Mapping[str, np.ndarray]) -> list[Group]:
    """What has to be fitted: an arm, or a segment of the trunk, with a chain that cannot follow everything."""
    together: dict[str, list[str]] = {}
    for segment in found:
        if segment in measured:
            together.setdefault(segment if segment in AXIAL else segment.split("_")[0], []).append(segment)
    return [
        Group(tuple(segments), tuple(sorted({joint for segment in segments for joint in found[segment].joints})))
        for segments in together.values()
        if any(found[segment].joints and not found[segment].exact for segment in segments)
    ]


def follow(
    model: BodyModel,
    found: Mapping[str, Chain],
    quat_WL: Mapping[str, np.ndarray],
    *,
    limits: bool = True,
    weights: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Configuration `q` (n, nq) by the chains `found`; see `pose.configuration`."""
    kept: dict[int, np.ndarray] = {}
    q, quat_WJ = stepwise(model, found, quat_WL, kept)
    to_fit = groups(found, quat_WL)
    for group in sorted(to_fit, key=lambda group: group.segments[0] not in AXIAL):
        wanted = {segment: quat_WL[segment] for segment in group.segments}
        rows = np.flatnonzero(_astray(model, q, quat_WJ, wanted, group, limits))
        if not len(rows):
            continue
        wanted = {segment: quat[rows] for segment, quat in wanted.items()}
        q[rows] = fit(model.pin, wanted, group.joints, q[rows], weights=weights, limits=limits)
        for joint in group.joints:
            if model.pin.nqs[joint] == 4:
                first = model.pin.idx_qs[joint]
                q[:, first : first + 4] = so3.continuous(q[:, first : first + 4])
        if group.segments[0] in AXIAL:  # what hangs on it stands elsewhere now
            kept |= {joint: _value(model, q, joint) for joint in group.joints}
            q, quat_WJ = stepwise(model, found, quat_WL, kept)
    return q


def stepwise(
    model: BodyModel, found: Mapping[str, Chain], quat_WL: Mapping[str, np.ndarray], kept: Mapping[int, np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """`q` (n, nq) with every segment at the smallest angle from its orientation, from where the one above stands.

    Limits are not looked at. `kept`: joints whose value is known already. Second: orientations in W of the joints'
    moving frames, (n, 4) or (4,) xyzw each.
    """
    n = len(next(iter(quat_WL.values())))
    begins = {chain.joints[0]: segment for segment, chain in found.items() if chain.joints and segment in quat_WL}
    q = np.tile(pin.neutral(model.pin), (n, 1))
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    world = [identity]
    turns: dict[int, np.ndarray] = {}  # joint → its own rotation
    for joint in range(1, model.pin.njoints):
        above = model.pin.parents[joint]
        if joint in kept:
            turns[joint] = _set(model, q, joint, kept[joint])
        elif joint in begins:
            chain = found[begins[joint]]
            values = solve(chain, multiply(conjugate(world[chain.above]), quat_WL[begins[joint]]))
            for moved, value in zip(chain.joints, values, strict=True):
                turns[moved] = _set(model, q, moved, value)
        placement = pin.Quaternion(model.pin.jointPlacements[joint].rotation).coeffs()
        world.append(multiply(world[above], multiply(placement, turns.get(joint, identity))))
    return q, world


def _astray(
    model: BodyModel,
    q: np.ndarray,
    quat_WJ: list[np.ndarray],
    wanted: Mapping[str, np.ndarray],
    group: Group,
    limits: bool,
) -> np.ndarray:
    """(n,) bool: frames in which a segment is missed, or a limit passed."""
    astray = np.zeros(len(q), dtype=bool)
    for segment, quat in wanted.items():
        frame = model.pin.frames[model.pin.getFrameId(segment)]
        stands = multiply(quat_WJ[frame.parentJoint], pin.Quaternion(frame.placement.rotation).coeffs())
        astray |= np.linalg.norm(multiply(conjugate(stands), quat)[..., :3], axis=-1) > 0.5 * _MISSED
    if limits:
        at, lower, upper = limits_of(model.pin, group.joints)
        astray |= ((q[:, at] < lower) | (q[:, at] > upper)).any(axis=1)
    return astray


def _value(model: BodyModel, q: np.ndarray, joint: int) -> np.ndarray:
    """What `_set` takes: an angle (n,) [rad] or a rotation (n, 4)."""
    first, n = model.pin.idx_qs[joint], model.pin.nqs[joint]
    if n == 4:
        return q[:, first : first + 4].copy()
    return q[:, first].copy() if n == 1 else np.arctan2(q[:, first + 1], q[:, first])


def _set(model: BodyModel, q: np.ndarray, joint: int, value: np.ndarray) -> np.ndarray:
    """Write a joint's value into `q`: an angle (n,) [rad] or a rotation (n, 4); gives its rotation."""
    first = model.pin.idx_qs[joint]
    if value.ndim == 2:
        value = so3.continuous(value / np.linalg.norm(value, axis=1)[:, None])
        q[:, first : first + 4] = value
        return value
    if model.pin.nqs[joint] == 1:
        q[:, first] = value
    else:  # without limits: cosine and sine
        q[:, first], q[:, first + 1] = np.cos(value), np.sin(value)
    axis = axis_in_joint(model.pin, joint)
    assert axis is not None
    return about(axis, value)
