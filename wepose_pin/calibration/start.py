"""Headings without a guess: the closure is linear in lengths times headings.

A hanging segment's direction in its sensor's start world is v(t) = Q(t)(−e_z), and L Rz(ψ) v is linear in
(L cos ψ, L sin ψ, L). So R_torso(t) s + Σ ± L_i Rz(ψ_i) v_i(t) = 0, with s the line between the shoulders at the start,
has its least-squares solution in the smallest singular vector.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .problem import Looks


def headings(looks: Looks) -> np.ndarray:
    """ψ [rad] of each sensor of the chain, from its world to W, whose y is the line of the shoulders at the start."""
    sensors, data = looks.layout.sensors, looks.data
    Q = [Rotation.from_quat(data[4 * i : 4 * i + 4].T) for i in range(len(sensors))]
    columns = [Q[0].as_matrix()]
    for name, R in zip(sensors[1:], Q[1:], strict=True):
        v = R.apply([0.0, 0.0, -1.0 if name.startswith("left") else 1.0])
        zero = np.zeros(len(v))
        columns.append(
            np.stack(
                (
                    np.column_stack((v[:, 0], v[:, 1], zero)),
                    np.column_stack((-v[:, 1], v[:, 0], zero)),
                    np.column_stack((zero, zero, v[:, 2])),
                ),
                axis=2,
            )
        )
    A = np.concatenate(columns, axis=2).reshape(-1, 3 * len(sensors))
    z = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(-1, 3)
    if z[1:, 2].sum() < 0.0:  # lengths are positive; their mirror image solves it as well
        z = -z
    torso = -np.arctan2(-z[0, 0], z[0, 1])  # turns s to y
    return np.array([torso, *(np.arctan2(z[1:, 1], z[1:, 0]) + torso)])
