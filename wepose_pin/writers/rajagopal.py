"""Coordinates of Rajagopal's full-body model for OpenSim, from the orientations of segments.

Rajagopal et al. 2016, IEEE Trans. Biomed. Eng. 63:2068, doi 10.1109/TBME.2016.2586891; bodies, axes and their order
from its file of OpenSense's example, Rajagopal_2015.osim. Hamner's model of 2010 has the same. OpenSim's ground G is
x forward, y up, z right; the frame of every body is parallel to it in the anatomical position, where all coordinates
are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..model.chains import Chain, about, conjugate, multiply, solve
from ..recording import AXES


class Body(NamedTuple):
    """A body of the model: its name, and where its x, y, z point in our frame of the segment."""

    name: str
    axes: tuple[str, str, str]


# Of a forearm and a hand x is the side of the palm, which in the N-pose is the thigh's: they are pronated by 90° there.
_UPRIGHT, _RIGHT, _LEFT = ("+x", "+z", "-y"), ("+y", "+z", "+x"), ("-y", "+z", "-x")
BODIES = {
    "pelvis": Body("pelvis", _UPRIGHT),
    "torso": Body("torso", _UPRIGHT),
    "right_upper_arm": Body("humerus_r", _UPRIGHT),
    "right_forearm": Body("radius_r", _RIGHT),
    "right_hand": Body("hand_r", _RIGHT),
    "left_upper_arm": Body("humerus_l", _UPRIGHT),
    "left_forearm": Body("radius_l", _LEFT),
    "left_hand": Body("hand_l", _LEFT),
}
# Axes of a right arm's joints with two, in the body above; a left arm's are mirrored on the sagittal plane.
ELBOW = (np.array([0.22604696, 0.022269, 0.97386183]), np.array([0.05639803, 0.99840646, 0.001952]))
WRIST = (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
_MIRRORED = np.array([-1.0, -1.0, 1.0, 1.0])  # xyzw, z → −z
_STILL = np.array([0.0, 0.0, 0.0, 1.0])
_ROUNDS = 40  # Levenberg-Marquardt; about ten are the rule
_CLOSE = 1e-9  # [rad] of the last step


def _quat_LB(axes: tuple[str, str, str]) -> np.ndarray:
    return Rotation.from_matrix(np.column_stack([AXES[axis] for axis in axes])).as_quat()


def in_ground(p_W: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of W in G."""
    return np.column_stack([p_W[:, 0], p_W[:, 2], -p_W[:, 1]])


def orientations(quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Body → `quat_GB` (n, 4) xyzw, of the segments that are bodies of the model: all but the head."""
    quat_GW = conjugate(_quat_LB(_UPRIGHT))
    return {
        body.name: multiply(multiply(quat_GW, quat_WL[segment]), _quat_LB(body.axes))
        for segment, body in BODIES.items()
        if segment in quat_WL
    }


def coordinates(quat_GB: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Coordinate → (n,) [rad], followed over time; body → angle [rad], rms, by which the model misses it.

    Torso, pelvis and shoulders turn about z, x, y and reach every orientation. Elbow and wrist have two axes: of each
    arm the sum of the squared angles between the model's bodies and the measured ones is the least, as it is for
    OpenSense with equal weights. A pelvis without a sensor stands still and upright.
    """
    found: dict[str, np.ndarray] = {}
    missed: dict[str, float] = {}
    if "pelvis" in quat_GB:
        found |= _three(quat_GB["pelvis"], ("pelvis_tilt", "pelvis_list", "pelvis_rotation"))
    if "torso" in quat_GB:
        lumbar = multiply(conjugate(quat_GB.get("pelvis", _STILL)), quat_GB["torso"])
        found |= _three(lumbar, ("lumbar_extension", "lumbar_bending", "lumbar_rotation"))
    for side in "rl":
        arm = [name for body in ("humerus", "radius", "hand") if (name := f"{body}_{side}") in quat_GB]
        if not arm or arm[0] != f"humerus_{side}":
            continue
        mirror = _MIRRORED if side == "l" else 1.0
        quat = [quat_GB[name] * mirror for name in arm]
        if len(arm) == 3 or (len(arm) == 2 and arm[1] == f"radius_{side}"):
            quat[0], angles, left = _arm(quat)
            names = ("elbow_flex", "pro_sup", "wrist_flex", "wrist_dev")
            found |= {f"{name}_{side}": np.unwrap(value) for name, value in zip(names, angles, strict=False)}
            missed |= {name: float(np.sqrt(np.mean(angle**2))) for name, angle in zip(arm, left, strict=True)}
        if "torso" in quat_GB:
            shoulder = multiply(conjugate(quat_GB["torso"] * mirror), quat[0])
            found |= _three(shoulder, tuple(f"arm_{of}_{side}" for of in ("flex", "add", "rot")))
    return found, missed


def _three(quat: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    values = euler.follow(euler.decompose(quat, "ZXY"), "ZXY", NEAR_LOCK)
    return {name: values[:, k] for k, name in enumerate(names)}


def _arm(quat: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """The humerus (n, 4), the angles of elbow and wrist, and how far each body is off, all (n,) [rad].

    `quat`: orientations (n, 4) of humerus, radius and, where it is measured, hand.
    """
    joints = [tuple(axis / np.linalg.norm(axis) for axis in axes) for axes in (ELBOW, WRIST)[: len(quat) - 1]]
    axes = [axis for pair in joints for axis in pair]
    starts = [_two(pair, multiply(conjugate(a), b)) for pair, a, b in zip(joints, quat, quat[1:], strict=False)]
    angles = np.column_stack([value for pair in starts for value in pair])
    humerus = quat[0].copy()
    error, J = _errors(humerus, angles, axes, quat)
    damping = np.full(len(humerus), 1e-6)
    for _ in range(_ROUNDS):
        A = np.swapaxes(J, 1, 2) @ J
        A += damping[:, None, None] * np.eye(A.shape[1])
        step = -np.linalg.solve(A, np.swapaxes(J, 1, 2) @ error[:, :, None])[:, :, 0]
        half = 0.5 * step[:, :3]
        tried = multiply(humerus, np.column_stack([half, np.ones(len(half))]))
        tried /= np.linalg.norm(tried, axis=1)[:, None]
        new_error, new_J = _errors(tried, angles + step[:, 3:], axes, quat)
        better = np.square(new_error).sum(axis=1) < np.square(error).sum(axis=1)
        humerus[better], angles[better] = tried[better], (angles + step[:, 3:])[better]
        error[better], J[better] = new_error[better], new_J[better]
        damping = np.where(better, damping / 10.0, damping * 10.0).clip(1e-12, 1e6)
        if np.abs(step).max() < _CLOSE:
            break
    return humerus, list(angles.T), [np.linalg.norm(part, axis=1) for part in np.split(error, len(quat), axis=1)]


def _errors(
    humerus: np.ndarray, angles: np.ndarray, axes: list[np.ndarray], quat: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors (n, 3 m) from the m measured bodies to the model's, and how they change (n, 3 m, 3 + k).

    With a turn of the humerus on its right, and with the k angles. The change of a rotation vector is taken as that of
    the turn: the gradient of its square is exact so.
    """
    n = len(humerus)
    error, J = np.empty((n, 3 * len(quat))), np.zeros((n, 3 * len(quat), 3 + angles.shape[1]))
    body = humerus
    columns = np.tile(np.eye(3), (n, 1, 1))  # what moves the body, in its own axes: (n, 3, …)
    for m, measured in enumerate(quat):
        for k in (2 * m - 2, 2 * m - 1) if m else ():
            turn = about(axes[k], angles[:, k])
            body = multiply(body, turn)
            back = Rotation.from_quat(conjugate(turn)).as_matrix()
            columns = np.concatenate([back @ columns, np.tile(axes[k][:, None], (n, 1, 1))], axis=2)
        error[:, 3 * m : 3 * m + 3] = Rotation.from_quat(multiply(conjugate(measured), body)).as_rotvec()
        J[:, 3 * m : 3 * m + 3, : columns.shape[2]] = columns
    return error, J


def _two(axes: Sequence[np.ndarray], quat: np.ndarray) -> list[np.ndarray]:
    """Angles (n,) [rad] about two axes that come nearest to rotations (n, 4)."""
    chain = Chain(joints=(1, 2), above=0, axes=tuple(axes), place=(0, 0), quat=(_STILL, _STILL), quat_AL=_STILL)
    return solve(chain, quat)
