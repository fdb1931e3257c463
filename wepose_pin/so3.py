"""Rotations: exp and log, quaternion order at the edges, tilt and heading.

Quaternions are xyzw, unit norm, as in Pinocchio and SciPy. Work on arrays goes through SciPy's `Rotation`; the
functions compiled with numba are the per-sample steps of the filters, which cannot.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by numba, and kept for the next start where there is a place to keep it."""
    try:
        return njit(cache=True)(function)
    except RuntimeError:  # neither the package's folder nor a home can be written to
        return njit(function)


# Below this angle [rad] the half-angle series replaces sin(x)/x; its first left-out term is under 1e-17 there.
SMALL_ANGLE = 1e-4


def xyzw_from_wxyz(quat_wxyz: ArrayLike) -> np.ndarray:
    """Reorder quaternions (..., 4) from scalar first to scalar last."""
    return np.roll(np.asarray(quat_wxyz, dtype=float), -1, axis=-1)


def wxyz_from_xyzw(quat_xyzw: ArrayLike) -> np.ndarray:
    """Reorder quaternions (..., 4) from scalar last to scalar first."""
    return np.roll(np.asarray(quat_xyzw, dtype=float), 1, axis=-1)


def exp(rotvec: ArrayLike) -> np.ndarray:
    """Quaternion (..., 4) xyzw of the rotation vector (..., 3) [rad]."""
    return Rotation.from_rotvec(np.asarray(rotvec, dtype=float)).as_quat()


def log(quat: ArrayLike) -> np.ndarray:
    """Rotation vector (..., 3) [rad], at most pi long, of the quaternion (..., 4) xyzw."""
    return Rotation.from_quat(np.asarray(quat, dtype=float)).as_rotvec()


def tilt(accel_S: ArrayLike) -> np.ndarray:
    """Orientation `quat_WS` (4,) of a sensor at rest with zero heading: the shortest rotation of accel onto +z of W.

    Zero heading means no twist about the vertical; that is defined for every mount but the one exactly upside down,
    where the half turn about x is taken.

    Raises
    ------
    ValueError
        `accel_S` is zero.
    """
    accel = np.asarray(accel_S, dtype=float)
    norm = np.linalg.norm(accel)
    if not norm > 0.0:
        raise ValueError("tilt of a zero acceleration is undefined")
    up_S = accel / norm
    quat = np.array([up_S[1], -up_S[0], 0.0, 1.0 + up_S[2]])
    if np.linalg.norm(quat) < 1e-8:
        return np.array([1.0, 0.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)


def heading(quat_WV: ArrayLike) -> np.ndarray:
    """Twist [rad] of rotations (..., 4) about the vertical, in [−pi, pi]: what is left when the tilt is taken off."""
    quat = np.asarray(quat_WV, dtype=float)
    return np.angle(np.exp(2j * np.arctan2(quat[..., 2], quat[..., 3])))


def continuous(quat: np.ndarray) -> np.ndarray:
    """The same rotations (n, 4) with signs chosen such that neighbours lie on one side (for files and plots)."""
    jumps = np.sign(np.einsum("ni,ni->n", quat[1:], quat[:-1]))
    jumps[jumps == 0.0] = 1.0
    return quat * np.concatenate([[1.0], np.cumprod(jumps)])[:, None]


@compiled
def rotate_by_vector(quat, x, y, z):  # type: ignore[no-untyped-def]
    """In place: ``quat ← quat ⊗ exp([x, y, z])``, renormalised. `quat` (4,) xyzw, vector [rad]."""
    half = 0.5 * np.sqrt(x * x + y * y + z * z)
    if half < SMALL_ANGLE:
        s = 0.5 * (1.0 - half * half / 6.0)
        c = 1.0 - half * half / 2.0
    else:
        s = 0.5 * np.sin(half) / half
        c = np.cos(half)
    ex, ey, ez = s * x, s * y, s * z
    qx, qy, qz, qw = quat[0], quat[1], quat[2], quat[3]
    rx = qw * ex + qx * c + qy * ez - qz * ey
    ry = qw * ey - qx * ez + qy * c + qz * ex
    rz = qw * ez + qx * ey - qy * ex + qz * c
    rw = qw * c - qx * ex - qy * ey - qz * ez
    norm = np.sqrt(rx * rx + ry * ry + rz * rz + rw * rw)
    quat[0], quat[1], quat[2], quat[3] = rx / norm, ry / norm, rz / norm, rw / norm


@compiled
def up_in_sensor(quat):  # type: ignore[no-untyped-def]
    """``R_WSᵀ e_z``: the vertical in sensor coordinates, as three floats."""
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@compiled
def integrate(rotvec):  # type: ignore[no-untyped-def]
    """Orientations (n + 1, 4) xyzw from the identity on, each turned by the next of `rotvec` (n, 3) [rad]."""
    quat = np.array([0.0, 0.0, 0.0, 1.0])
    out = np.empty((len(rotvec) + 1, 4))
    out[0] = quat
    for k in range(len(rotvec)):
        rotate_by_vector(quat, rotvec[k, 0], rotvec[k, 1], rotvec[k, 2])
        out[k + 1] = quat
    return out
