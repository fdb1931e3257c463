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
from ..readers.opensim import PRONATION, R_GW, compute_n_pose
from ..rotations import conjugate, multiply, rotation_about

# Segment → body. The model has no head of its own.
BODIES = {
    "pelvis": "pelvis",
    "torso": "torso",
    "right_upper_arm": "humerus_r",
    "right_forearm": "radius_r",
    "right_hand": "hand_r",
    "left_upper_arm": "humerus_l",
    "left_forearm": "radius_l",
    "left_hand": "hand_l",
    "right_thigh": "femur_r",
    "right_shank": "tibia_r",
    "right_foot": "calcn_r",
    "left_thigh": "femur_l",
    "left_shank": "tibia_l",
    "left_foot": "calcn_l",
}
# Axes of a right arm's joints with two, in the body above; a left arm's are mirrored on the sagittal plane.
_X, _Y, _Z = np.eye(3)
ELBOW = (np.array([0.22604696, 0.022269, 0.97386183]), PRONATION)
WRIST = (_Z, _X)


class Span(NamedTuple):
    """A length of the subject in the model: between joint centres, all coordinates at zero."""

    generic: float  # [m] in the generic model
    bodies: tuple[str, ...]  # those that scale with it
    axes: str = "xyz"  # along which they do


def _limb_spans(side: str, s: str) -> dict[str, Span]:
    return {
        f"{side}_upper_arm": Span(0.2867352, (f"humerus_{s}",)),  # humerus to ulna
        f"{side}_forearm": Span(0.2524715, (f"ulna_{s}", f"radius_{s}")),  # ulna to hand
        f"{side}_hand": Span(0.0680950, (f"hand_{s}",)),  # wrist to the hand's mass centre, taken for the palm
        f"{side}_thigh": Span(0.4080495, (f"femur_{s}", f"patella_{s}")),  # femur to tibia
        f"{side}_shank": Span(0.3964726, (f"tibia_{s}",)),  # tibia to talus
        f"{side}_foot": Span(0.1375515, (f"talus_{s}", f"calcn_{s}", f"toes_{s}")),  # talus to toes
    }


# Length → where it is in the model.
SPANS = {
    "trunk": Span(0.5330898, ("pelvis", "torso"), "xy"),  # middle of the femora to middle of the humeri
    "shoulder_width": Span(0.34, ("torso",), "z"),
    "hip_width": Span(0.15452, ("pelvis",), "z"),
    **_limb_spans("left", "l"),
    **_limb_spans("right", "r"),
}


class Joint(NamedTuple):
    """A joint of the model."""

    parent: str  # body
    coordinates: tuple[str, ...]
    axes: tuple[np.ndarray, ...]  # of the coordinates, in the parent, at zero


def _arm_joints(side: str) -> dict[str, Joint]:
    mirror = np.array([-1.0, -1.0, 1.0]) if side == "l" else np.ones(3)  # of axes on the sagittal plane

    def joint(parent: str, names: Sequence[str], axes: Sequence[np.ndarray]) -> Joint:
        return Joint(parent, tuple(f"{name}_{side}" for name in names), tuple(mirror * axis for axis in axes))

    return {
        f"humerus_{side}": joint("torso", ("arm_flex", "arm_add", "arm_rot"), (_Z, _X, _Y)),
        f"ulna_{side}": joint(f"humerus_{side}", ("elbow_flex",), ELBOW[:1]),
        f"radius_{side}": joint(f"ulna_{side}", ("pro_sup",), ELBOW[1:]),
        f"hand_{side}": joint(f"radius_{side}", ("wrist_flex", "wrist_dev"), WRIST),
    }


# Body → the joint that moves it.
JOINTS = {
    "pelvis": Joint("ground", ("pelvis_tilt", "pelvis_list", "pelvis_rotation"), (_Z, _X, _Y)),
    "torso": Joint("pelvis", ("lumbar_extension", "lumbar_bending", "lumbar_rotation"), (_Z, _X, _Y)),
    **_arm_joints("r"),
    **_arm_joints("l"),
}
# Of each of these joints' angles the middle of its range [rad]: they are given within half a turn of it. Followed over
# time, an elbow that was once bent as none can be might keep a full turn too much.
_MIDDLE = {"elbow_flex": np.radians(75.0), "pro_sup": np.radians(90.0), "wrist_flex": 0.0, "wrist_dev": 0.0}
_MIRRORED = np.array([-1.0, -1.0, 1.0, 1.0])  # xyzw, z → −z
_STILL = np.array([0.0, 0.0, 0.0, 1.0])
_QUAT_GW = R_GW.as_quat()
_ROUNDS = 40  # Levenberg-Marquardt; about ten are the rule
_CLOSE = 1e-9  # [rad] of the last step


def in_ground(p_W: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of W in G."""
    return np.column_stack([p_W[:, 0], p_W[:, 2], -p_W[:, 1]])


def orientations(quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Body → `quat_GB` (n, 4) xyzw, of the segments that are bodies of the model.

    Who stands in the N-pose, palms to the thighs, is the model with 90° of `pro_sup` and zero of all others.
    """
    bodies = {}
    for segment, body in BODIES.items():
        if segment in quat_WL:
            moved = multiply(multiply(_QUAT_GW, quat_WL[segment]), conjugate(_QUAT_GW))
            bodies[body] = multiply(moved, compute_n_pose(body).as_quat())
    return bodies


def coordinates(quat_GB: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Coordinate → (n,) [rad]; body → angle [rad], rms, by which the model misses it.

    Torso, pelvis and shoulders turn about z, x, y, reach every orientation and are followed over time. Elbow and wrist
    have two axes: of each arm the sum of the squared angles between the model's bodies and the measured ones is the
    least, as it is for OpenSense with equal weights. A pelvis without a sensor stands still and upright.
    """
    columns: dict[str, np.ndarray] = {}
    residuals: dict[str, float] = {}
    if "pelvis" in quat_GB:
        columns |= _solve_three_axes(quat_GB["pelvis"], JOINTS["pelvis"].coordinates)
    if "torso" in quat_GB:
        lumbar = multiply(conjugate(quat_GB.get("pelvis", _STILL)), quat_GB["torso"])
        columns |= _solve_three_axes(lumbar, JOINTS["torso"].coordinates)
    for side in "rl":
        arm = [name for body in ("humerus", "radius", "hand") if (name := f"{body}_{side}") in quat_GB]
        if not arm or arm[0] != f"humerus_{side}":
            continue
        mirror = _MIRRORED if side == "l" else 1.0
        quat = [quat_GB[name] * mirror for name in arm]
        below: dict[str, np.ndarray] = {}
        if arm[1:2] == [f"radius_{side}"]:
            quat[0], angles, left = _arm(quat)
            below = {f"{name}_{side}": value for name, value in zip(_MIDDLE, angles, strict=False)}
            residuals |= {name: float(np.sqrt(np.mean(angle**2))) for name, angle in zip(arm, left, strict=True)}
        if "torso" in quat_GB:
            shoulder = multiply(conjugate(quat_GB["torso"] * mirror), quat[0])
            columns |= _solve_three_axes(shoulder, JOINTS[f"humerus_{side}"].coordinates)
        columns |= below
    return columns, residuals


def _solve_three_axes(quat: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    values = euler.follow(euler.decompose(quat, "ZXY"), "ZXY", NEAR_LOCK)
    return {name: values[:, k] for k, name in enumerate(names)}


def _arm(quat: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """The humerus (n, 4), the angles of elbow and wrist, and how far each body is off, all (n,) [rad].

    `quat`: orientations (n, 4) of humerus, radius and, where it is measured, hand.
    """
    joints = [tuple(axis / np.linalg.norm(axis) for axis in axes) for axes in (ELBOW, WRIST)[: len(quat) - 1]]
    axes = [axis for pair in joints for axis in pair]
    starts = [
        _solve_two_axes(pair, multiply(conjugate(a), b)) for pair, a, b in zip(joints, quat, quat[1:], strict=False)
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
            turn = rotation_about(axes[k], angles[:, k])
            body = multiply(body, turn)
            back = Rotation.from_quat(conjugate(turn)).as_matrix()
            columns = np.concatenate([back @ columns, np.tile(axes[k][:, None], (n, 1, 1))], axis=2)
        error[:, 3 * m : 3 * m + 3] = Rotation.from_quat(multiply(conjugate(measured), body)).as_rotvec()
        J[:, 3 * m : 3 * m + 3, : columns.shape[2]] = columns
    return error, J


def _solve_two_axes(axes: Sequence[np.ndarray], quat: np.ndarray) -> list[np.ndarray]:
    """Angles (n,) [rad] about two axes that come nearest to rotations (n, 4).

    The scalar product of the two quaternions is a cosine of half their difference and one of half their sum, summed.
    """
    (a, b), v, w = axes, quat[:, :3], quat[:, 3]
    m = v @ np.cross(a, b) - w * (a @ b)
    difference, total = np.arctan2(v @ (a - b), w + m), np.arctan2(v @ (a + b), w - m)
    return [total + difference, total - difference]
