"""Joint torques of a motion by inverse dynamics: estimates, from the model's inertias and a smoothed configuration.

The base is fixed and nothing but gravity acts on the body: no ground, no load in the hands. Accelerations are second
derivatives of measured orientations, so the motion is low-passed first, forwards and backwards (−6 dB at the cut-off).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import polars as pl

from ..errors import BadData, BadModel, BadOption
from ..filters.butterworth import low_pass
from ..rotations import unwrap_signs
from ..tracking import TrackResult

CUTOFF_HZ = 6.0  # usual for the motion of limbs
_LEAST_MASS = 1e-6  # [kg]
_LEAST_SAMPLES = 11


@dataclass(frozen=True)
class Torques:
    """The torques of joints over time."""

    time: np.ndarray  # (n,) [s]
    torque: Mapping[str, np.ndarray]  # joint → (n, 1), of a spherical one (n, 3) along its frame [Nm]; prismatic: [N]
    q: np.ndarray  # (n, nq) smoothed configuration, from which the torques were made
    v: np.ndarray  # (n, nv) its derivative
    cutoff_hz: float  # of the smoothing
    mass: float  # [kg] of all that moves

    def summary(self) -> dict[str, Any]:
        """For ``summary.json``."""
        size = {name: np.linalg.norm(tau, axis=1) for name, tau in self.torque.items()}
        return {
            "note": "estimates: the model's inertias, fixed base, nothing in the hands, smoothed motion",
            "cutoff_hz": self.cutoff_hz,
            "mass_kg": round(self.mass, 3),
            "rms": {name: round(float(np.sqrt(np.mean(values**2))), 3) for name, values in size.items()},
            # Not the largest: that is where a fit jumped between two minima, or at an impact on a sensor.
            "95_percent_below": {name: round(float(np.quantile(values, 0.95)), 3) for name, values in size.items()},
        }


def joint_torques(
    model: pin.Model,
    time: np.ndarray,
    q: np.ndarray,
    cutoff_hz: float = CUTOFF_HZ,
    joints: Collection[int] | None = None,
) -> Torques:
    """Compute the torques of the joints that bear a mass, by `pin.rnea`.

    `model` has inertias in [kg], [kg m²], z up, as the `pin` of a `BodyModel`; `time` (n,) [s] is uniform, `q`
    (n, nq). `joints` are those that are asked for, by Pinocchio's number; None: all. `BadModel`: the model has no
    masses; `BadOption`: a cut-off that is not possible; `BadData`: too few samples to smooth.
    """
    mass = sum(inertia.mass for inertia in model.inertias[1:])
    if mass < _LEAST_MASS:
        raise BadModel(f"{model.name}: no moving link has a mass; torques need a URDF with <inertial>")
    if len(time) < _LEAST_SAMPLES:
        raise BadData(f"{len(time)} samples are too few for torques; at least {_LEAST_SAMPLES} are needed")
    rate_hz = (len(time) - 1) / float(time[-1] - time[0])
    if not 0.0 < cutoff_hz < 0.5 * rate_hz:
        raise BadOption(f"a cut-off of {cutoff_hz:g} Hz; above 0 and below half the rate, {0.5 * rate_hz:g} Hz")
    q = q.copy()
    for joint in range(1, model.njoints):  # signs of quaternions that do not jump, angles of hinges unwrapped
        first, n = model.idx_qs[joint], model.nqs[joint]
        if n == 4:
            q[:, first : first + 4] = unwrap_signs(q[:, first : first + 4])
        elif n == 1 and "Prismatic" not in model.joints[joint].shortname():
            q[:, first] = np.unwrap(q[:, first])
    # The motion is mirrored for a second beyond each end, where the filter's transient decays.
    q = low_pass(q, cutoff_hz, rate_hz, max(_LEAST_SAMPLES - 1, round(rate_hz)))
    q = np.array([pin.normalize(model, row) for row in q])
    # Central differences; the ends repeat.
    half = np.array([pin.difference(model, a, b) for a, b in pairwise(q)]) * rate_hz
    v = np.concatenate((half[:1], 0.5 * (half[1:] + half[:-1]), half[-1:]))
    a = np.pad(np.diff(half, axis=0) * rate_hz, ((1, 1), (0, 0)), mode="edge")
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    torque = {}
    for joint in range(1, model.njoints) if joints is None else sorted(joints):
        bears = sum(model.inertias[k].mass for k in model.subtrees[joint])
        if bears > _LEAST_MASS and "Mimic" not in model.joints[joint].shortname():
            first = model.idx_vs[joint]
            torque[model.names[joint]] = tau[:, first : first + model.nvs[joint]]
    return Torques(time, torque, q, v, cutoff_hz, mass)


def pose_torques(tracked: TrackResult, cutoff_hz: float = CUTOFF_HZ) -> Torques:
    """`joint_torques` of a person, of the joints that follow measured segments; of a mechanism, of all.

    Masses are the model's, stretched with the subject's lengths (`BodyModel.with_lengths`), not the person's.
    """
    model = tracked.model
    moved = {joint for name, chain in model.chains.items() if name in tracked.quat_WL for joint in chain}
    joints = None if model.table.is_mechanism else moved
    return joint_torques(model.pin, tracked.time, tracked.q, cutoff_hz, joints)


def torque_table(torques: Torques) -> pl.DataFrame:
    """The columns of ``torques.parquet``: ``time``; ``<joint>_nm``, of a spherical joint ``<joint>_x_nm``, _y, _z."""
    table = {"time": torques.time}
    for name, tau in torques.torque.items():
        axes = ("",) if tau.shape[1] == 1 else ("_x", "_y", "_z")
        table |= {f"{name}{axis}_nm": tau[:, k] for k, axis in enumerate(axes)}
    return pl.DataFrame(table)
