"""Segment orientations → the configuration of a body: exactly where its joints can, else as near as they come.

First every segment by itself, from the root outwards (`chains`). A spherical joint has done its work with that. Where a
segment of a limb hangs on fewer axes, or on hinges that have ends, what they cannot do is shared: `Fit` over all
measured segments of that limb, in the frames in which an orientation is not reached or a limit passed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from .. import rotations
from ..rotations import conjugate, multiply, rotation_about
from .body import BodyModel
from .chains import axis_in_joint, solve
from .fit import Fit, Limits

_MAX_RESIDUAL = 1e-9  # [rad] that is nothing


class Group(NamedTuple):
    """Segments that are fitted together, and the joints that set them."""

    segments: tuple[str, ...]
    joints: tuple[int, ...]


def find_groups(model: BodyModel, measured: Collection[str]) -> list[Group]:
    """What has to be fitted, the spine first: a limb, or a segment of the spine, that cannot follow everything."""
    parents, segments = model.parents, model.table.segments

    def limb(segment: str) -> str:
        """The first segment of the limb."""
        above = parents[segment]
        return segment if above is None or segments[segment].spine or segments[above].spine else limb(above)

    together: dict[str, list[str]] = {}
    for segment in model.chains:
        if segment in measured:
            together.setdefault(limb(segment), []).append(segment)
    groups = [
        Group(tuple(names), tuple(sorted({joint for name in names for joint in model.chains[name].joints})))
        for names in together.values()
        if any(model.chains[name].joints and not model.chains[name].exact for name in names)
    ]
    return sorted(groups, key=lambda group: not segments[group.segments[0]].spine)


class OrientationIk:
    """Configurations that follow orientations; what does not change from call to call is looked up once.

    Parameters
    ----------
    segments : the measured ones
    limits : as in `kinematics.solve_configuration`
    """

    def __init__(
        self,
        model: BodyModel,
        segments: Collection[str],
        *,
        limits: bool = True,
    ) -> None:
        self.model, self.chains, self._table = model.pin, model.chains, model.table
        to_fit = find_groups(model, segments)
        self._fits = [(group, Fit(self.model, group.segments, group.joints, limits)) for group in to_fit]
        self._begins = {
            chain.joints[0]: name for name, chain in self.chains.items() if chain.joints and name in segments
        }
        self._neutral = pin.neutral(self.model)
        self._placements = [pin.Quaternion(placement.rotation).coeffs() for placement in self.model.jointPlacements]
        frames = [self.model.frames[self.model.getFrameId(name)] for group in to_fit for name in group.segments]
        self._stands = {frame.name: (frame.parentJoint, pin.Quaternion(frame.placement.rotation)) for frame in frames}
        axes = {j: axis_in_joint(self.model, j) for j in range(1, self.model.njoints) if self.model.nvs[j] == 1}
        self._axes = {joint: axis for joint, axis in axes.items() if axis is not None}
        self._solved: dict[int, np.ndarray] = {}  # which fit → the last q that it found

    def run(
        self, quat_WL: Mapping[str, np.ndarray], before: np.ndarray | None = None, *, warm_start: bool = False
    ) -> np.ndarray:
        """`q` (n, nq) by segment → (n, 4) xyzw.

        `before` (nq,): the frame before the first; `warm_start`: the frames continue the motion of the last run.
        """
        kept: dict[int, np.ndarray] = {}
        q, quat_WJ = self.stepwise(quat_WL, kept)
        for nth, (group, fit) in enumerate(self._fits):
            rows = np.flatnonzero(self._find_unreached(q, quat_WJ, quat_WL, group, fit.limits))
            if not len(rows):
                continue
            begin = self._solved.get(nth) if warm_start else before
            q[rows] = fit.run({segment: quat_WL[segment][rows] for segment in group.segments}, q[rows], begin)
            self._solved[nth] = q[rows[-1]].copy()
            for joint in group.joints:
                if self.model.nqs[joint] == 4:
                    first = self.model.idx_qs[joint]
                    q[:, first : first + 4] = rotations.unwrap_signs(q[:, first : first + 4])
            if self._table.segments[group.segments[0]].spine:  # what hangs on it stands elsewhere now
                kept |= {joint: _value(self.model, q, joint) for joint in group.joints}
                q, quat_WJ = self.stepwise(quat_WL, kept)
        return q

    def stepwise(
        self, quat_WL: Mapping[str, np.ndarray], kept: Mapping[int, np.ndarray]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """`q` (n, nq) with every segment at the smallest angle from its orientation, from where the one above stands.

        Limits are not looked at. `kept`: joints whose value is known already. Second: orientations in W of the joints'
        moving frames, (n, 4) or (4,) xyzw each.
        """
        n = len(next(iter(quat_WL.values())))
        q = np.tile(self._neutral, (n, 1))
        world = [np.array([0.0, 0.0, 0.0, 1.0])]
        turns: dict[int, np.ndarray] = {}  # joint → its own rotation
        for joint in range(1, self.model.njoints):
            above = self.model.parents[joint]
            if joint in kept:
                turns[joint] = self._write_joint(q, joint, kept[joint])
            elif joint in self._begins:
                chain = self.chains[self._begins[joint]]
                target = quat_WL[self._begins[joint]]
                values = solve(chain, multiply(conjugate(world[chain.above]), target))
                for moved, value in zip(chain.joints, values, strict=True):
                    turns[moved] = self._write_joint(q, moved, value)
            turned = self._placements[joint]
            world.append(multiply(world[above], multiply(turned, turns[joint]) if joint in turns else turned))
        return q, world

    def _find_unreached(
        self, q: np.ndarray, quat_WJ: list[np.ndarray], quat_WL: Mapping[str, np.ndarray], group: Group, ends: Limits
    ) -> np.ndarray:
        """(n,) bool: frames in which an orientation is not reached, or a limit passed."""
        astray = np.zeros(len(q), dtype=bool)
        for segment in group.segments:
            joint, quat_JL = self._stands[segment]
            stands = multiply(quat_WJ[joint], quat_JL.coeffs())
            residual = multiply(conjugate(stands), quat_WL[segment])
            astray |= np.linalg.norm(residual[..., :3], axis=-1) > 0.5 * _MAX_RESIDUAL
        return astray | ((q[:, ends.at] < ends.lower) | (q[:, ends.at] > ends.upper)).any(axis=1)

    def _write_joint(self, q: np.ndarray, joint: int, value: np.ndarray) -> np.ndarray:
        """Write a joint's value into `q`: an angle (n,) [rad] or a rotation (n, 4); gives its rotation."""
        first = self.model.idx_qs[joint]
        if value.ndim == 2:
            value = rotations.unwrap_signs(value / np.linalg.norm(value, axis=1)[:, None])
            q[:, first : first + 4] = value
            return value
        if self.model.nqs[joint] == 1:
            q[:, first] = value
        else:  # without limits: cosine and sine
            q[:, first], q[:, first + 1] = np.cos(value), np.sin(value)
        return rotation_about(self._axes[joint], value)


def _value(model: pin.Model, q: np.ndarray, joint: int) -> np.ndarray:
    """What `OrientationIk._write_joint` takes: an angle (n,) [rad] or a rotation (n, 4)."""
    first, n = model.idx_qs[joint], model.nqs[joint]
    if n == 4:
        return q[:, first : first + 4].copy()
    return q[:, first].copy() if n == 1 else np.arctan2(q[:, first + 1], q[:, first])
