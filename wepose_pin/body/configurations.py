"""Values of joints in configurations, and what orientations of links leave open of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin


def joint_values(model: pin.Model, q: np.ndarray, before: Mapping[str, float] | None = None) -> dict[str, np.ndarray]:
    """Joint → its value (n,) [rad or m] in configurations (n, nq); only joints of one axis.

    Values of a joint without end go on beyond half a turn, from that in `before`.
    """
    values = {}
    for joint in range(1, model.njoints):
        name, first = model.names[joint], model.idx_qs[joint]
        if model.nqs[joint] == 1:
            values[name] = q[:, first].copy()
        elif model.nvs[joint] == 1:
            angle = np.arctan2(q[:, first + 1], q[:, first])
            last = None if before is None else before.get(name)
            values[name] = np.unwrap(angle) if last is None else np.unwrap(np.concatenate([[last], angle]))[1:]
    return values


def find_generic_configuration(model: pin.Model) -> np.ndarray:
    """A configuration (nq,) within the limits in which no joints stand in line by chance."""
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(0.2, 0.9, model.nv) * rng.choice([-1.0, 1.0], model.nv))
    for joint in range(1, model.njoints):
        at = model.idx_qs[joint]
        if model.nqs[joint] == 1:
            low, high = model.lowerPositionLimit[at], model.upperPositionLimit[at]
            if not low <= q[at] <= high:
                low, high = max(low, -1.0), min(high, 1.0)
                q[at] = low + rng.uniform(0.2, 0.8) * (high - low)
    return q


def find_null_space(model: pin.Model, links: Sequence[str], q: np.ndarray) -> np.ndarray:
    """The motions (nv, k) of all joints in `q` (nq,) that turn none of `links`."""
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    J = np.concatenate(
        [pin.getFrameJacobian(model, data, model.getFrameId(link), pin.LOCAL_WORLD_ALIGNED)[3:] for link in links]
    )
    _, s, Vt = np.linalg.svd(J)
    return Vt[np.count_nonzero(s > 1e-6) :].T


def find_undetermined_joints(model: pin.Model, links: Sequence[str]) -> list[str]:
    """Names of joints whose value the orientations of `links` leave open, at least in part.

    Joints that stand in line for a moment do not count.
    """
    null = find_null_space(model, links, find_generic_configuration(model))
    share = np.linalg.norm(null, axis=1)
    return [
        model.names[j]
        for j in range(1, model.njoints)
        if np.any(share[model.idx_vs[j] : model.idx_vs[j] + model.nvs[j]] > 1e-3)
    ]


def find_determined_frames(model: pin.Model, links: Sequence[str], frames: Sequence[str]) -> list[str]:
    """Those of `frames` whose origin in W follows from the orientations of `links`."""
    q, data = find_generic_configuration(model), model.createData()
    null = find_null_space(model, links, q)
    pin.computeJointJacobians(model, data, q)
    determined = []
    for name in frames:
        J = pin.getFrameJacobian(model, data, model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED)[:3]
        if not np.any(np.abs(J @ null) > 1e-9):
            determined.append(name)
    return determined
