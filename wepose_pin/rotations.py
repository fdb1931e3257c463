"""Quaternion algebra for arrays and for compiled kernels; `calibration.equations` has what CasADi needs beside it.

Quaternions are xyzw, unit norm, as in Pinocchio and SciPy. Functions on arrays come first. The kernels below them are
the per-sample steps of filters and of live tracking: they work on numbers and on the first four entries of a row, and
keep their order of operations, so that results stay bit-identical.
"""

from functools import reduce
from math import factorial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from .compilation import compiled, fma, inlined, kernel


def xyzw_from_wxyz(quat_wxyz: ArrayLike) -> np.ndarray:
    """Reorder quaternions (..., 4) from scalar first to scalar last."""
    return np.roll(np.asarray(quat_wxyz, dtype=float), -1, axis=-1)


def product_terms(ax, ay, az, aw, bx, by, bz, bw):  # type: ignore[no-untyped-def]
    """``a ⊗ b`` of the components of two quaternions, numbers, arrays or symbols, as four."""
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


product = inlined(product_terms)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions (..., 4) xyzw; on 60 000 ten times as fast as SciPy's."""
    parts = product_terms(*(quat[..., k] for quat in (a, b) for k in range(4)))  # type: ignore[no-untyped-call]
    out = np.empty((*parts[0].shape, 4))  # `np.stack` takes half of the time of a few
    out[..., 0], out[..., 1], out[..., 2], out[..., 3] = parts
    return out


def conjugate(quat: np.ndarray) -> np.ndarray:
    """Inverse rotations (..., 4) xyzw."""
    return quat * np.array([-1.0, -1.0, -1.0, 1.0])


def rotation_about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (n, 4) xyzw about one axis (3,) by angles (n,) [rad]."""
    half = np.asarray(angle)[..., None] / 2.0
    return np.concatenate([np.sin(half) * axis, np.cos(half)], axis=-1)


def exp(rotvec: ArrayLike) -> np.ndarray:
    """Quaternion (..., 4) xyzw of the rotation vector (..., 3) [rad]."""
    return Rotation.from_rotvec(np.asarray(rotvec, dtype=float)).as_quat()


def log(quat: ArrayLike) -> np.ndarray:
    """Rotation vector (..., 3) [rad], at most pi long, of the unit quaternion (..., 4) xyzw."""
    quat = np.asarray(quat, dtype=float)
    v, w = quat[..., :3], quat[..., 3:]
    sine = np.sqrt(np.sum(v * v, axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(np.where(w < 0.0, -sine, sine), np.abs(w))
    return np.asarray(v * np.divide(angle, sine, out=np.full(sine.shape, 2.0), where=sine > 0.0))


def compose(*factors: Rotation) -> Rotation:
    """``factors[0] * factors[1] * …``, which SciPy takes thirty times as long for where they are many."""
    return Rotation.from_quat(reduce(multiply, (each.as_quat() for each in factors)))


def turn_about(axes: str, angles: np.ndarray) -> Rotation:
    """Turns (n) about own axes one after the other, such as ``"XYX"``, by angles (n, k) [rad], made for many."""
    turns = [rotation_about(np.eye(3)["XYZ".index(axis)], angle) for axis, angle in zip(axes, angles.T, strict=True)]
    return Rotation.from_quat(reduce(multiply, turns))


def quat_from_gravity(accel_S: ArrayLike) -> np.ndarray:
    """Orientation `quat_VS` (4,) of a static sensor with zero heading: the shortest rotation of accel onto +z of V.

    Zero heading means no twist about the vertical; that is defined for every mount but the one exactly upside down,
    where the half turn about x is taken. `ValueError`: `accel_S` is zero.
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


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] within half a turn."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def unwrap_signs(quat: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """The same rotations (n, 4) with signs by which neighbours lie on one side, and the first with `before` (4,)."""
    earlier = np.concatenate([quat[:1] if before is None else before[None], quat[:-1]])
    signs = np.where(np.einsum("ni,ni->n", quat, earlier) < 0.0, -1.0, 1.0)
    return quat * np.cumprod(signs)[:, None]


# Below this half angle [rad] polynomials replace sine and cosine; the first terms left out are under 1e-18 there.
SERIES_HALF_ANGLE = 0.5
S0, S1, S2, S3, S4, S5, S6, S7 = (0.5 * (-1) ** k / factorial(2 * k + 1) for k in range(8))  # ½ sin(h)/h in h²
C0, C1, C2, C3, C4, C5, C6, C7 = ((-1) ** k / factorial(2 * k) for k in range(8))  # cos(h) in h²


@inlined
def half_angle_terms(h1):  # type: ignore[no-untyped-def]
    """½ sin(h)/h and cos(h) of h² = `h1`. A sample's are power series: no call, no square root, no division."""
    if h1 < SERIES_HALF_ANGLE * SERIES_HALF_ANGLE:
        h2 = h1 * h1
        h4 = h2 * h2
        s = fma(h4, fma(h2, fma(S7, h1, S6), fma(S5, h1, S4)), fma(h2, fma(S3, h1, S2), fma(S1, h1, S0)))
        c = fma(h4, fma(h2, fma(C7, h1, C6), fma(C5, h1, C4)), fma(h2, fma(C3, h1, C2), fma(C1, h1, C0)))
        return s, c
    half = np.sqrt(h1)
    return 0.5 * np.sin(half) / half, np.cos(half)


@kernel
def rotate_by_vector(quat, x, y, z):  # type: ignore[no-untyped-def]
    """In place: ``quat ← quat ⊗ exp([x, y, z])``, renormalised to first order: but for rounding it is unit.

    `quat` (4,) or more: its first four, xyzw; x, y, z [rad]
    """
    s, ew = half_angle_terms(0.25 * (x * x + y * y + z * z))
    # 1/√ of its length before, to first order; that after the product would be waited for
    norm = 1.5 - 0.5 * ((quat[0] * quat[0] + quat[1] * quat[1]) + (quat[2] * quat[2] + quat[3] * quat[3]))
    rx, ry, rz, rw = product(quat[0], quat[1], quat[2], quat[3], s * x, s * y, s * z, ew)
    quat[0], quat[1], quat[2], quat[3] = rx * norm, ry * norm, rz * norm, rw * norm


@inlined
def rotate_by_world_vector(quat, x, y, z):  # type: ignore[no-untyped-def]
    """In place: ``quat ← exp([x, y, z]) ⊗ quat``, renormalised as there; the vector is in W [rad]."""
    s, ew = half_angle_terms(0.25 * (x * x + y * y + z * z))
    norm = 1.5 - 0.5 * ((quat[0] * quat[0] + quat[1] * quat[1]) + (quat[2] * quat[2] + quat[3] * quat[3]))
    rx, ry, rz, rw = product(s * x, s * y, s * z, ew, quat[0], quat[1], quat[2], quat[3])
    quat[0], quat[1], quat[2], quat[3] = rx * norm, ry * norm, rz * norm, rw * norm


@kernel
def fill_matrix(quat, R):  # type: ignore[no-untyped-def]
    """`R` (3, 3) of `quat` (4,) xyzw."""
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    x2, y2, z2 = 2.0 * x, 2.0 * y, 2.0 * z
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - y * y2 - z * z2, x * y2 - w * z2, x * z2 + w * y2
    R[1, 0], R[1, 1], R[1, 2] = x * y2 + w * z2, 1.0 - x * x2 - z * z2, y * z2 - w * x2
    R[2, 0], R[2, 1], R[2, 2] = x * z2 - w * y2, y * z2 + w * x2, 1.0 - x * x2 - y * y2


@kernel
def up_in_sensor(quat):  # type: ignore[no-untyped-def]
    """``R_VSᵀ e_z``: the vertical in sensor coordinates, as three floats. `quat` (4,) or more: its first four, xyzw."""
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


def compute_turns(quat: np.ndarray) -> np.ndarray:
    """Rotation vectors (n − 1, 3) [rad], in the rotating frame, between neighbours of orientations (n, 4) xyzw."""
    return log(multiply(conjugate(quat[:-1]), quat[1:]))


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


@compiled
def unroll(rotvec, vectors):  # type: ignore[no-untyped-def]
    """Vectors (n, 3), each turned by all of `rotvec` (n, 3) [rad] up to its own; one that is no number is no turn."""
    quat, R, out = np.array([0.0, 0.0, 0.0, 1.0]), np.empty((3, 3)), np.empty((len(vectors), 3))
    for k in range(len(vectors)):
        x, y, z = rotvec[k, 0], rotvec[k, 1], rotvec[k, 2]
        if np.isfinite(x + y + z):
            rotate_by_vector(quat, x, y, z)
        fill_matrix(quat, R)
        for i in range(3):
            out[k, i] = R[i, 0] * vectors[k, 0] + R[i, 1] * vectors[k, 1] + R[i, 2] * vectors[k, 2]
    return out
