"""Rotations: exp and log, quaternion order at the edges, tilt and heading.

Quaternions are xyzw, unit norm, as in Pinocchio and SciPy. Work on arrays goes through SciPy's `Rotation`; the
functions compiled with numba are the per-sample steps of the filters, which cannot.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from math import factorial
from typing import Any

import numpy as np
from numba import njit
from numba.core.event import Event, Listener, register
from numba.core.options import DefaultOptions
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

# No fastmath: the same bits from a batch, from a sample at a time and from a bank of sensors need strict IEEE steps.
# The numpy error model spares each division a branch; nogil lets several sensors run in threads.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# What allocates nothing needs no reference counts; numba leaves some in, atomic ones, several a sample. Its option has
# no public name: where it is gone, kernels are slower and as right.
_BARE = _OPTIONS | ({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {})


class _SayOnce(Listener):  # type: ignore[misc]
    """One line on a terminal when the first of our functions is compiled, since that takes seconds; never again."""

    said = False

    def on_start(self, event: Event) -> None:
        if self.said or not event.data["dispatcher"].py_func.__module__.startswith("wepose_pin."):
            return
        self.said = True
        if sys.stderr.isatty():
            print("compiling for this machine: some ten seconds, kept for the next time …", file=sys.stderr, flush=True)

    def on_end(self, event: Event) -> None:
        pass


register("numba:compile", _SayOnce())


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    try:
        dispatcher = njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor a home can be written to
        return njit(**options)(function)
    cache = getattr(dispatcher, "_cache", None)
    if cache is not None:  # a full disk is no reason to fail: it compiles again the next time
        cache.save_overload = _unless_full(cache.save_overload)
    return dispatcher


def _unless_full(save: Callable[..., None]) -> Callable[..., None]:
    def try_to_save(*args: Any) -> None:
        with contextlib.suppress(OSError):
            save(*args)

    return try_to_save


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by numba, and kept for the next start where there is a place to keep it."""
    return _cached(function, _OPTIONS)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`compiled` for a function that makes no array, only fills those it is given: no reference counting in it."""
    return _cached(function, _BARE | {"forceinline": True})


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """A piece of kernels and of nothing else, always a part of its caller's code; it makes no array."""
    return njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_BARE)(function)


# Below this half angle [rad] polynomials replace sine and cosine; the first terms left out are under 1e-18 there.
SERIES_HALF_ANGLE = 0.5
S0, S1, S2, S3, S4, S5, S6, S7 = (0.5 * (-1) ** k / factorial(2 * k + 1) for k in range(8))  # ½ sin(h)/h in h²
C0, C1, C2, C3, C4, C5, C6, C7 = ((-1) ** k / factorial(2 * k) for k in range(8))  # cos(h) in h²


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


def continuous(quat: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """The same rotations (n, 4) with signs chosen such that neighbours lie on one side (for files and plots).

    The first keeps its sign, or takes that of `before` (4,).
    """
    jumps = np.sign(np.einsum("ni,ni->n", quat[1:], quat[:-1]))
    first = 1.0 if before is None else np.sign(quat[0] @ before)
    signs = np.concatenate([[first], jumps])
    signs[signs == 0.0] = 1.0
    return quat * np.cumprod(signs)[:, None]


@kernel
def rotate_by_vector(quat, x, y, z):  # type: ignore[no-untyped-def]
    """In place: ``quat ← quat ⊗ exp([x, y, z])``, renormalised. `quat` (4,) or more, its first four xyzw; vector [rad].

    Sine and cosine of a sample's turn are power series in the square of the half angle: no call, no square root.
    """
    h1 = 0.25 * (x * x + y * y + z * z)
    if h1 < SERIES_HALF_ANGLE * SERIES_HALF_ANGLE:
        h2 = h1 * h1
        h4 = h2 * h2
        s = (S0 + S1 * h1 + h2 * (S2 + S3 * h1)) + h4 * (S4 + S5 * h1 + h2 * (S6 + S7 * h1))
        c = (C0 + C1 * h1 + h2 * (C2 + C3 * h1)) + h4 * (C4 + C5 * h1 + h2 * (C6 + C7 * h1))
    else:
        half = np.sqrt(h1)
        s = 0.5 * np.sin(half) / half
        c = np.cos(half)
    ex, ey, ez = s * x, s * y, s * z
    qx, qy, qz, qw = quat[0], quat[1], quat[2], quat[3]
    rx = qw * ex + qx * c + qy * ez - qz * ey
    ry = qw * ey - qx * ez + qy * c + qz * ex
    rz = qw * ez + qx * ey - qy * ex + qz * c
    rw = qw * c - qx * ex - qy * ey - qz * ez
    square = rx * rx + ry * ry + rz * rz + rw * rw
    # Of an almost unit quaternion 1/norm is 1 − (square − 1)/2, to 3/8 (square − 1)².
    scale = 1.5 - 0.5 * square if abs(square - 1.0) < 1e-8 else 1.0 / np.sqrt(square)
    quat[0], quat[1], quat[2], quat[3] = rx * scale, ry * scale, rz * scale, rw * scale


@kernel
def up_in_sensor(quat):  # type: ignore[no-untyped-def]
    """``R_WSᵀ e_z``: the vertical in sensor coordinates, as three floats. `quat` (4,) or more: its first four, xyzw."""
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
