"""Coordinates of Rajagopal's full-body model for OpenSim, from the orientations of segments.

Rajagopal et al. 2016, IEEE Trans. Biomed. Eng. 63:2068, doi 10.1109/TBME.2016.2586891; bodies and lengths stand in
``rajagopal.toml``, axes and their order are those of Rajagopal_2015.osim. OpenSim's ground G is x forward, y up, z
right; the frame of every body is parallel to it in the anatomical position, where all coordinates are zero.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..readers.opensim import PRONATION, R_GW, compute_n_pose
from ..rotations import conjugate, multiply, rotation_about

_MODEL = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
BODIES: Mapping[str, str] = _MODEL["bodies"]
LENGTHS: Mapping[str, Mapping[str, Any]] = _MODEL["lengths"]
# Axes of a right arm's elbow and wrist in the body above; a left arm's are mirrored on the sagittal plane.
_AXES = (0.22604696, 0.022269, 0.97386183), PRONATION, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
# Their coordinates, and the middle of each range [rad]: angles are given within half a turn of it. Followed over time,
# an elbow that was once bent as none can be might keep a full turn too much.
_MIDDLE = {"elbow_flex": np.radians(75.0), "pro_sup": np.radians(90.0), "wrist_flex": 0.0, "wrist_dev": 0.0}
_MIRRORED = np.array([-1.0, -1.0, 1.0, 1.0])  # xyzw, z → −z
_ROUNDS = 40  # Levenberg-Marquardt; about ten are the rule
_CLOSE = 1e-9  # [rad] of the last step


def in_ground(p_W: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) of W in G."""
    return np.column_stack([p_W[:, 0], p_W[:, 2], -p_W[:, 1]])


def orientations(quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute body → `quat_GB` (n, 4) xyzw, of the segments that are bodies of the model.

    The N-pose, palms to the thighs, is the model with 90° of `pro_sup` and zero of all others.
    """
    quat_GW = R_GW.as_quat()
    bodies = {}
    for segment, body in BODIES.items():
        if segment in quat_WL:
            moved = multiply(multiply(quat_GW, quat_WL[segment]), conjugate(quat_GW))
            bodies[body] = multiply(moved, compute_n_pose(body).as_quat())
    return bodies


def coordinates(quat_GB: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Compute coordinate → (n,) [rad], and body → angle [rad], rms, by which the model misses it.

    Torso, pelvis and shoulders turn about z, x, y, reach every orientation and are followed over time. Elbow and wrist
    have two axes: of each arm the sum of the squared angles between the model's bodies and the measured ones is the
    least, as it is for OpenSense with equal weights. A pelvis without a sensor stands still and upright.
    """
    columns: dict[str, np.ndarray] = {}
    residuals: dict[str, float] = {}

    def add(quat: np.ndarray, names: Sequence[str]) -> None:
        angles = euler.follow(euler.decompose(quat, "ZXY"), "ZXY", NEAR_LOCK)
        columns.update(zip(names, angles.T, strict=True))

    if "pelvis" in quat_GB:
        add(quat_GB["pelvis"], ("pelvis_tilt", "pelvis_list", "pelvis_rotation"))
    if "torso" in quat_GB:
        lumbar = multiply(conjugate(quat_GB.get("pelvis", np.array([0.0, 0.0, 0.0, 1.0]))), quat_GB["torso"])
        add(lumbar, ("lumbar_extension", "lumbar_bending", "lumbar_rotation"))
    for side in "rl":
        arm = [name for body in ("humerus", "radius", "hand") if (name := f"{body}_{side}") in quat_GB]
        if not arm or arm[0] != f"humerus_{side}":
            continue
        mirror = _MIRRORED if side == "l" else 1.0
        quat = [quat_GB[name] * mirror for name in arm]
        below: dict[str, np.ndarray] = {}
        if arm[1:2] == [f"radius_{side}"]:
            quat[0], angles, misses = _fit_arm(quat)
            below = {f"{name}_{side}": value for name, value in zip(_MIDDLE, angles, strict=False)}
            residuals |= {name: float(np.sqrt(np.mean(angle**2))) for name, angle in zip(arm, misses, strict=True)}
        if "torso" in quat_GB:
            shoulder = multiply(conjugate(quat_GB["torso"] * mirror), quat[0])
            add(shoulder, [f"{name}_{side}" for name in ("arm_flex", "arm_add", "arm_rot")])
        columns |= below
    return columns, residuals


def _fit_arm(quat: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Fit the humerus (n, 4), the angles of elbow and wrist, and how far each body is off, all (n,) [rad].

    `quat`: orientations (n, 4) of humerus, radius and, where it is measured, hand.
    """
    axes = [np.array(axis) / np.linalg.norm(axis) for axis in _AXES[: 2 * len(quat) - 2]]
    starts = [
        _solve_two_axes(axes[2 * k], axes[2 * k + 1], multiply(conjugate(quat[k]), quat[k + 1]))
        for k in range(len(quat) - 1)
    ]
    angles = np.column_stack([value for pair in starts for value in pair])
    humerus = quat[0].copy()
    error, J = _body_errors(humerus, angles, axes, quat)
    damping = np.full(len(humerus), 1e-6)
    for _ in range(_ROUNDS):
        A = np.swapaxes(J, 1, 2) @ J
        A += damping[:, None, None] * np.eye(A.shape[1])
        step = -np.linalg.solve(A, np.swapaxes(J, 1, 2) @ error[:, :, None])[:, :, 0]
        half = 0.5 * step[:, :3]
        tried = multiply(humerus, np.column_stack([half, np.ones(len(half))]))
        tried /= np.linalg.norm(tried, axis=1)[:, None]
        new_error, new_J = _body_errors(tried, angles + step[:, 3:], axes, quat)
        better = np.square(new_error).sum(axis=1) < np.square(error).sum(axis=1)
        humerus[better], angles[better] = tried[better], (angles + step[:, 3:])[better]
        error[better], J[better] = new_error[better], new_J[better]
        damping = np.where(better, damping / 10.0, damping * 10.0).clip(1e-12, 1e6)
        if np.abs(step).max() < _CLOSE:
            break
    middle = np.array(list(_MIDDLE.values())[: angles.shape[1]])
    angles -= 2.0 * np.pi * np.round((angles - middle) / (2.0 * np.pi))
    return humerus, list(angles.T), [np.linalg.norm(part, axis=1) for part in np.split(error, len(quat), axis=1)]


def _body_errors(
    humerus: np.ndarray, angles: np.ndarray, axes: list[np.ndarray], quat: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the rotation vectors (n, 3 m) from the m measured bodies to the model's, and their Jacobian.

    The Jacobian (n, 3 m, 3 + k) is by a turn of the humerus on its right and by the k angles. The change of a rotation
    vector is taken as that of the turn: the gradient of its square is exact so.
    """
    n = len(humerus)
    error, J = np.empty((n, 3 * len(quat))), np.zeros((n, 3 * len(quat), 3 + angles.shape[1]))
    body = humerus
    columns = np.tile(np.eye(3), (n, 1, 1))  # what moves the body, in its own axes: (n, 3, …)
    for m, measured in enumerate(quat):
        for k in (2 * m - 2, 2 * m - 1) if m else ():
            turn = rotation_about(axes[k], angles[:, k])
            body = multiply(body, turn)
            back = Rotation.from_quat(conjugate(turn)).as_matrix()
            columns = np.concatenate([back @ columns, np.tile(axes[k][:, None], (n, 1, 1))], axis=2)
        error[:, 3 * m : 3 * m + 3] = Rotation.from_quat(multiply(conjugate(measured), body)).as_rotvec()
        J[:, 3 * m : 3 * m + 3, : columns.shape[2]] = columns
    return error, J


def _solve_two_axes(a: np.ndarray, b: np.ndarray, quat: np.ndarray) -> list[np.ndarray]:
    """Compute the angles (n,) [rad] about two axes that come nearest to rotations (n, 4).

    The scalar product of the two quaternions is a cosine of half their difference and one of half their sum, summed.
    """
    v, w = quat[:, :3], quat[:, 3]
    m = v @ np.cross(a, b) - w * (a @ b)
    difference, total = np.arctan2(v @ (a - b), w + m), np.arctan2(v @ (a + b), w - m)
    return [total + difference, total - difference]
