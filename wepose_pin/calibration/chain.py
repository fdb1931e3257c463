"""The chains of a body in CasADi: link by link from the root to each point, quaternions xyzw as everywhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np


def links(lengths: Any, quat_WL: Mapping[str, Any], way: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Link → its part (3,) [m] of a chain, in W; `way` holds the (3, k) of each link."""
    return {
        name: rotate(quat_WL[name], ca.vertcat(*(_combined(row, lengths) for row in rows)))
        for name, rows in way.items()
    }


def _combined(row: np.ndarray, lengths: Any) -> Any:
    """``row · lengths`` without the zeros of the row."""
    return sum((row[i] * lengths[i] for i in map(int, np.flatnonzero(row))), start=ca.SX(0.0))


def rotate(quat: Any, v: Any) -> Any:
    """``R v`` of a unit quaternion (4,) xyzw and a vector (3,), in CasADi."""
    u = quat[:3]
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def inverse(quat: Any) -> Any:
    """The unit quaternion (4,) xyzw of the inverse rotation, in CasADi."""
    return ca.vertcat(-quat[:3], quat[3])


def product(a: Any, b: Any) -> Any:
    """``a ⊗ b`` of quaternions (4,) xyzw, in CasADi."""
    return ca.vertcat(a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3]), a[3] * b[3] - ca.dot(a[:3], b[:3]))


def about_z(angle: Any) -> Any:
    """The unit quaternion (4,) xyzw of a turn about z [rad], in CasADi."""
    return ca.vertcat(0.0, 0.0, ca.sin(angle / 2.0), ca.cos(angle / 2.0))


def small_turn(rotvec: Any) -> Any:
    """The unit quaternion (4,) xyzw of a turn by about `rotvec` (3,) [rad], in CasADi: to third order of its size."""
    half = rotvec / 2.0
    return ca.vertcat(half, 1.0) / ca.sqrt(1.0 + ca.sumsqr(half))
