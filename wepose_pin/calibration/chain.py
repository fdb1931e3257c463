"""The chain of both arms in CasADi: links from the right palm to the left one, quaternions xyzw as everywhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from ..subject import LENGTHS

SIDES = ("left", "right")
ARMS = tuple(f"{side}_{part}" for side in SIDES for part in ("upper_arm", "forearm", "hand"))
CHAIN = ("torso", *ARMS)


def palm_gap(lengths: Any, quat_WL: Mapping[str, Any]) -> Any:
    """Palm-to-palm vector (3,) [m] in W as a CasADi expression: left palm minus right palm.

    Parameters
    ----------
    lengths : (8,) CasADi, in the order of `LENGTHS` [m]
    quat_WL : segment → (4,) CasADi xyzw, for the torso and both upper arms, forearms, hands
    """
    return sum(links(lengths, quat_WL).values(), start=ca.SX.zeros(3))


def links(lengths: Any, quat_WL: Mapping[str, Any]) -> dict[str, Any]:
    """Segment → its part (3,) [m] of the way from the right palm to the left one, in W."""
    found = {"torso": rotate(quat_WL["torso"], ca.vertcat(0.0, lengths[LENGTHS.index("shoulder_width")], 0.0))}
    for name in ARMS:
        down = -lengths[LENGTHS.index(name)] if name.startswith("left") else lengths[LENGTHS.index(name)]
        found[name] = rotate(quat_WL[name], ca.vertcat(0.0, 0.0, down))
    return found


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
