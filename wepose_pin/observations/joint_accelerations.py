"""Accelerations that two neighbouring sensors share at the joint between them.

A sensor at r from a joint measures the joint's specific force and its own about it. In W, with uncorrected headings,

    f_joint = R_WS f_S − d²/dt² (R_WS r),

and both neighbours give the same, rotated about the vertical by the difference of their heading errors (Weygers and Kok
2020, IEEE Sensors Journal 20). A linear filter keeps that: it takes gravity's constant and what tissue shakes off both
sides. A force ε that is fixed in the sensor's frame is none of the joint's: gravity times a tilt that the orientation
filter has wrong, or the accelerometer's bias. In an even spin it turns with the sensor, as the joint's force does. An
accelerometer that averages over its sample is late by half of it against its gyroscope, by τ s. With a = (1, r, ε, τ)
each side is B a.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..body import BodyModel
from ..body.kinematics import find_carrier

BAND_HZ = (0.1, 1.5)  # what people move in
LEAST_RATE_HZ = 20.0  # of recordings that are used
# Where a sensor sits is known from its segment alone: in the middle, give or take this much on each axis; assumption.
LEVER_STD = 0.08  # [m]
LEVER_STD_OF_LENGTH = 0.3  # of the distance to the joint, on large bodies


def linearize_joint(
    near_B: np.ndarray, far_B: np.ndarray, angle: float, near: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the misfit of m samples of a joint's specific force between its two sensors, and its Jacobian.

    Parameters
    ----------
    near_B, far_B : (m, 3, 1 + p) sides of the two sensors, the first p + 1 columns of `compute_sides`, filtered alike
    angle : [rad] turns the near side about the vertical into the far one
    near, far : (p,) lever r [m], force ε [m/s²] and delay τ [s] of each sensor, or the lever alone

    Returns
    -------
    e : (m, 3) [m/s²] the far side less the near one, in the far one's W
    jacobian : (m, 3, 1 + 2 p) of e by the angle and by the parts of `near` and `far`
    force : (m, 3) [m/s²] of the joint by the near sensor, in the far one's W
    """
    c, s = np.cos(angle), np.sin(angle)
    turned_B = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ near_B
    force = turned_B[:, :, 0] + turned_B[:, :, 1:] @ near
    jacobian = np.empty((len(force), 3, 1 + len(near) + len(far)))
    jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 2, 0] = force[:, 1], -force[:, 0], 0.0
    jacobian[:, :, 1 : 1 + len(near)], jacobian[:, :, 1 + len(near) :] = -turned_B[:, :, 1:], far_B[:, :, 1:]
    return far_B[:, :, 0] + far_B[:, :, 1:] @ far - force, jacobian, force


def compute_sides(R_WS: np.ndarray, accel_S: np.ndarray, rate_hz: float) -> np.ndarray:
    """Compute the side B (n − 2, k, 3, 8) of each sensor at its joints, of all samples but the first and the last one.

    Parameters
    ----------
    R_WS, accel_S : (n, k, 3, 3), (n, k, 3) [m/s²]
    """
    force_S, R = accel_S[..., None], R_WS[1:-1]
    change_S = 0.5 * rate_hz * (force_S[2:] - force_S[:-2])
    second = rate_hz**2 * (R_WS[2:] - 2.0 * R + R_WS[:-2])
    return np.concatenate([R @ force_S[1:-1], -second, R, R @ change_S], axis=3)


def find_neighbours(model: BodyModel, sensors: Collection[str]) -> list[tuple[str, str]]:
    """Find the segments with sensors that share a joint, the one nearer the root first; nothing moves between them."""
    pairs = []
    for far in model.table.segments:
        above = model.parents.get(far) if far in sensors else None
        near = None if above is None else find_carrier(model, above, tuple(sensors))
        if near is not None:
            pairs.append((near, far))
    return pairs


def find_joint_pairs(
    model: BodyModel, quat_LS: Mapping[str, np.ndarray]
) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray, np.ndarray]:
    """Find the joints between two sensors, by the mounts (4,) xyzw of all sensors.

    Returns
    -------
    pairs : p pairs of segments with the sensors, the one nearer the root first
    levers : (p, 6) [m] usual ones from the joint to the near sensor and to the far one, each in its own S
    lever_std : (p,) [m] of each
    travels : (p,) bool: the joint travels on the near segment, as a shoulder does
    """
    data, pairs = model.pin.createData(), find_neighbours(model, quat_LS)
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    placement = {name: data.oMf[model.pin.getFrameId(name)] for name in (*model.parents, *model.point_frames.values())}
    spine = {name for name, segment in model.table.segments.items() if segment.spine}
    levers, std = np.empty((len(pairs), 6)), np.empty(len(pairs))
    for i, (near, far) in enumerate(pairs):
        joint_W = placement[near if far in spine else far].translation
        levers_W = [_locate_sensor(model, name, placement, spine) - joint_W for name in (near, far)]
        R_WS = [placement[name].rotation @ Rotation.from_quat(quat_LS[name]).as_matrix() for name in (near, far)]
        std[i] = max(LEVER_STD, LEVER_STD_OF_LENGTH * max(float(np.linalg.norm(lever)) for lever in levers_W))
        levers[i] = np.concatenate([R.T @ lever for R, lever in zip(R_WS, levers_W, strict=True)])
    travels = np.array([near in spine and not model.table.is_mechanism for near, _ in pairs], dtype=bool)
    return pairs, levers, std, travels


def _locate_sensor(
    model: BodyModel, segment: str, placement: Mapping[str, pin.SE3], spine: Collection[str]
) -> np.ndarray:
    """Return the usual place (3,) [m] of a segment's sensor in W, all joints at zero: amid the segment's joints."""
    children = [name for name, above in model.parents.items() if above == segment and name not in spine]
    ends = [placement[name].translation for name in children]
    if segment in spine and ends:
        return np.asarray(np.mean(ends, axis=0))  # at the height of the shoulders, or of the hips
    if not ends:
        m = model.pin
        joint = m.frames[m.getFrameId(segment)].parentJoint
        links = model.point_frames.values()
        reached = [link for link in links if joint in m.supports[m.frames[m.getFrameId(link)].parentJoint]]
        ends = [placement[link].translation for link in reached]
    return np.asarray(np.mean([placement[segment].translation, *ends], axis=0))
