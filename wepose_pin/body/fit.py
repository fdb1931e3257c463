"""The configuration in which links come nearest to the orientations they should have, within the joints' limits.

Frame by frame the sum over the links of angle² is made smallest: Gauss-Newton with Levenberg's damping on
Pinocchio's Jacobian, each frame from the solution of the one before. Limits are kept by projection: a joint at its
limit that the gradient pushes outward takes no part in the step, and what a step carries over a limit ends on it
(Bertsekas 1982, "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control 20:221).

Joints that the known links do not determine move as little as possible from frame to frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

_ROUNDS = 100  # two to four are the rule from the frame before
_STEP = 1e-6  # [rad] at which a frame is solved
_DAMPING = 1e-7  # the least; the greatest ends a search that finds nothing better
_MOST_DAMPING = 1e6
_WORTH_ANOTHER_START = np.deg2rad(1.0) ** 2  # [rad²] left, from which the other start is looked at


class Limits(NamedTuple):
    """Limits of the joints that have one axis: where they stand in q, and what they are."""

    at: np.ndarray  # (k,) places in q
    lower: np.ndarray  # (k,) [rad]
    upper: np.ndarray  # (k,) [rad]


def joint_limits(model: pin.Model, joints: Sequence[int]) -> Limits:
    """Of those of `joints` that have one axis and an end to it; spherical joints and continuous ones have none."""
    at = np.array([model.idx_qs[joint] for joint in joints if model.nqs[joint] == 1], dtype=int)
    return Limits(at, model.lowerPositionLimit[at], model.upperPositionLimit[at])


class Fit:
    """Configurations in which links come nearest to orientations; what does not change from frame to frame.

    Parameters
    ----------
    joints : those that may move
    limits : keep the limits of joints with one axis
    """

    def __init__(self, model: pin.Model, links: Sequence[str], joints: Sequence[int], limits: bool) -> None:
        self.model, self.data = model, model.createData()
        frames = [model.frames[model.getFrameId(link)] for link in links]
        # The joint's frame is compared in place of the link's, which is fixed to it: its rotation comes for nothing.
        self._R_LJ = np.array([frame.placement.rotation.T for frame in frames])
        self._views = [self.data.oMi[frame.parentJoint].rotation for frame in frames]
        self.columns = np.concatenate([model.idx_vs[j] + np.arange(model.nvs[j]) for j in joints])
        moves = np.zeros((len(links), model.nv), dtype=bool)
        for k, frame in enumerate(frames):
            for j in model.supports[frame.parentJoint]:
                moves[k, model.idx_vs[j] : model.idx_vs[j] + model.nvs[j]] = j > 0
        self._pull = moves[:, self.columns].astype(float).T  # (f, m): which links a column turns
        self._both = self._pull @ self._pull.T  # (f, f): how many links two columns both turn
        self._ones = np.ones(len(links))
        self._free_q = np.concatenate([model.idx_qs[j] + np.arange(model.nqs[j]) for j in joints])
        bounded = [j for j in joints if model.nqs[j] == 1] if limits else []
        self.limits = joint_limits(model, bounded)
        column = {int(c): k for k, c in enumerate(self.columns)}
        self._bounded = np.array([column[model.idx_vs[j]] for j in bounded], dtype=int)

    def run(self, quat_WL: Mapping[str, np.ndarray], start: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """Configurations (n, nq) for `quat_WL`, link → (n, 4) xyzw in the model's universe.

        Parameters
        ----------
        start : (n, nq), where a frame may start in place of the one before; (1, nq): where the first starts. Joints
            that may not move keep their values of it
        before : (nq,) where the first frame starts; None: at `start`
        """
        targets = np.stack([Rotation.from_quat(quat).as_matrix() for quat in quat_WL.values()], axis=1) @ self._R_LJ
        n = len(targets)
        own = len(start) == n
        out = np.empty((n, self.model.nq))
        q = self._within((start[0] if before is None else before).copy())
        for k, R in enumerate(targets):
            other = start[k] if own else start[0]
            before, q = q, other.copy()
            q[self._free_q] = before[self._free_q]
            q, left = self._solve(q, R)
            if own and left > _WORTH_ANOTHER_START:
                # What was nearest before may have become the shallower of two valleys.
                other = self._within(other.copy())
                if self._left(other, R)[0] < left:
                    q, _ = self._solve(other, R)
            out[k] = q
        return out

    def _within(self, q: np.ndarray) -> np.ndarray:
        at, lower, upper = self.limits
        q[at] = np.clip(q[at], lower, upper)
        return q

    def _left(self, q: np.ndarray, R_target: np.ndarray) -> tuple[float, np.ndarray]:
        """What is left: the sum of squared angles [rad²], and the rotation vectors (m, 3) in W."""
        pin.computeJointJacobians(self.model, self.data, q)
        e = np.array([pin.log3(R @ view.T) for R, view in zip(R_target, self._views, strict=True)])
        return float(self._ones @ np.einsum("mi,mi->m", e, e)), e

    def _solve(self, q: np.ndarray, R_target: np.ndarray) -> tuple[np.ndarray, float]:
        at, lower, upper = self.limits
        left, e = self._left(q, R_target)
        damping = _DAMPING
        step = np.zeros(self.model.nv)
        for _ in range(_ROUNDS):
            J = self.data.J[3:, self.columns]
            g = np.einsum("if,fi->f", J, self._pull @ e)  # downhill; exact, as log(R)ᵀ is its own under its Jacobian
            free = np.ones(len(g), dtype=bool)
            push, value = g[self._bounded], q[at]
            free[self._bounded] = ~((value <= lower) & (push < 0.0) | (value >= upper) & (push > 0.0))
            H = (J.T @ J) * self._both
            rows = np.flatnonzero(free)
            H = H[np.ix_(rows, rows)]
            while True:
                step[:] = 0.0
                step[self.columns[rows]] = np.linalg.solve(H + damping * np.eye(len(rows)), g[rows])
                tried = self._within(pin.integrate(self.model, q, step))
                less, new = self._left(tried, R_target)
                if less <= left or damping >= _MOST_DAMPING:
                    break
                damping *= 10.0
            if less > left:
                self._left(q, R_target)
                break
            q, left, e = tried, less, new
            damping = max(_DAMPING, 0.1 * damping)
            if np.abs(step).max() < _STEP:
                break
        return q, left
