"""Quaternions xyzw in CasADi, and functions of them for many samples."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ..rotations import product_terms


def product(a: Any, b: Any) -> Any:
    """Return ``a ⊗ b`` of quaternions (4,)."""
    return ca.vertcat(*product_terms(*ca.vertsplit(a), *ca.vertsplit(b)))  # type: ignore[no-untyped-call]


def rotate(quat: Any, v: Any) -> Any:
    """Return ``R v`` (3,) of a unit quaternion (4,) and a vector (3,)."""
    u, v = quat[:3], ca.vertcat(*v) if isinstance(v, tuple) else v
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def rotate_back(quat: Any, v: Any) -> Any:
    """Return ``Rᵀ v`` (3,) of a unit quaternion (4,) and a vector (3,)."""
    return rotate(ca.vertcat(-quat[:3], quat[3]), v)


def about_z(angle: Any) -> Any:
    """Return the unit quaternion (4,) of a rotation about z [rad]."""
    return ca.vertcat(0.0, 0.0, ca.sin(angle / 2.0), ca.cos(angle / 2.0))


def small_rotation(rotvec: Any) -> Any:
    """Return the unit quaternion (4,) of about `rotvec` (3,) [rad]: to third order of its size."""
    half = rotvec / 2.0
    return ca.vertcat(half, 1.0) / ca.sqrt(1.0 + ca.sumsqr(half))


def evaluate(function: ca.Function, *inputs: np.ndarray) -> list[np.ndarray]:
    """Return the outputs (n, …) of a function for inputs (n, m), or (m,) where one stands for all samples."""
    n = max(len(each) for each in inputs if each.ndim == 2)
    if not n:
        return [np.zeros((0, *function.size_out(i))) for i in range(function.n_out())]
    # CasADi's matrices are column by column, the samples side by side. Its own arrays would take five times as long.
    mapped = function.map(n)
    buffer, run = mapped.buffer()
    columns = [np.ascontiguousarray(np.broadcast_to(each, (n, each.shape[-1])), dtype=float) for each in inputs]
    outputs = [np.empty((n, *function.size_out(i)[::-1])) for i in range(function.n_out())]
    for i, values in enumerate(columns):
        buffer.set_arg(i, values.data)  # type: ignore[call-arg]
    for i, values in enumerate(outputs):
        buffer.set_res(i, values.data)  # type: ignore[call-arg]
    run()
    return [values.swapaxes(1, 2) for values in outputs]
