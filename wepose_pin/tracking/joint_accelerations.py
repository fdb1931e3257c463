"""Accelerations that two neighbouring sensors share at the joint between them, summed knot by knot.

A sensor at r from a joint measures the joint's specific force and its own about it. In W, with uncorrected headings,

    f_joint = R_WS f_S − d²/dt² (R_WS r),

and both neighbours give the same, rotated about the vertical by the difference of their heading errors (Weygers and Kok
2020, IEEE Sensors Journal 20). A linear filter keeps that: it takes gravity's constant and what tissue shakes off both
sides. A force ε that is fixed in the sensor's frame is none of the joint's: gravity times a tilt that the orientation
filter has wrong, or the accelerometer's bias. In an even spin it turns with the sensor, as the joint's force does. With
a = (1, r, ε) each side is B a, so that the misfit of any heading, levers and ε follows from a few 7 × 7 sums.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..filters.butterworth import BandPass
from ..kinematics import find_carrier
from ..model import BodyModel

BAND_HZ = (0.1, 1.5)  # what people move in
LEAST_RATE_HZ = 20.0  # of recordings that are used
# Where a sensor sits is known from its segment alone: in the middle, give or take this much on each axis; assumption.
LEVER_STD = 0.08  # [m]
LEVER_STD_OF_LENGTH = 0.3  # of the distance to the joint, on large bodies


class JointPair(NamedTuple):
    """Two sensors at one joint.

    Parameters
    ----------
    near, far : segments, the one nearer the root first
    levers : (6,) [m] from the joint to the near sensor and to the far one, each in its own frame S; usual values
    lever_std : [m] of each
    travels : whether the joint travels on the near segment, as a shoulder does
    """

    near: str
    far: str
    levers: np.ndarray
    lever_std: float
    travels: bool


class JointSums(NamedTuple):
    """Sums over samples of two sensors at a joint; x, y, z are rows of B (3, 7), n and f the near and the far one."""

    samples: int
    near_xy: np.ndarray  # (7, 7) Σ nx nxᵀ + ny nyᵀ
    near_z: np.ndarray  # Σ nz nzᵀ
    near_turn: np.ndarray  # Σ nx nyᵀ − ny nxᵀ
    far: np.ndarray  # Σ fᵀ f
    cos: np.ndarray  # Σ fx nxᵀ + fy nyᵀ
    sin: np.ndarray  # Σ fy nxᵀ − fx nyᵀ
    up: np.ndarray  # Σ fz nzᵀ

    def linearize(self, angle: float, near: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return JᵀJ (13, 13), Jᵀe (13,) and eᵀe of the misfit e, by the angle [rad], near and far side.

        Parameters
        ----------
        angle : turns the near side about the vertical into the far one
        near, far : (6,) lever r [m] and force ε [m/s²] of each sensor
        """
        near, far = np.concatenate(([1.0], near)), np.concatenate(([1.0], far))
        side = len(near) - 1
        c, s = np.cos(angle), np.sin(angle)
        cross, slope = c * self.cos + s * self.sin + self.up, c * self.sin - s * self.cos
        all_near = self.near_xy + self.near_z
        information = np.empty((1 + 2 * side, 1 + 2 * side))
        nears, fars = slice(1, 1 + side), slice(1 + side, None)
        information[0, 0] = near @ self.near_xy @ near
        information[0, nears] = information[nears, 0] = (near @ self.near_turn)[1:]
        information[0, fars] = information[fars, 0] = -(slope @ near)[1:]
        information[nears, nears], information[fars, fars] = all_near[1:, 1:], self.far[1:, 1:]
        information[fars, nears] = -cross[1:, 1:]
        information[nears, fars] = information[fars, nears].T
        gradient = np.concatenate(
            (
                [-far @ slope @ near],
                (all_near @ near - cross.T @ far)[1:],
                (self.far @ far - cross @ near)[1:],
            )
        )
        cost = far @ self.far @ far + near @ all_near @ near - 2.0 * far @ cross @ near
        return information, gradient, max(float(cost), 0.0)


def find_pairs(model: BodyModel, sensors: Mapping[str, np.ndarray]) -> tuple[JointPair, ...]:
    """Find the joints between two sensors, segment → mount `quat_LS` (4,), with nothing that moves between them."""
    data = model.pin.createData()
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    placement = {name: data.oMf[model.pin.getFrameId(name)] for name in model.parents}
    joints = {name: _find_joints(model, name, placement) for name in sensors}
    pairs = []
    for far in model.table.segments:
        above = model.parents.get(far) if far in sensors else None
        near = None if above is None else find_carrier(model, above, tuple(sensors))
        if near is None:
            continue
        joint_W = placement[far].translation if far not in _spine(model) else placement[near].translation
        levers, distances = [], []
        for segment in (near, far):
            lever_W = np.mean(joints[segment], axis=0) - joint_W
            R_WS = placement[segment].rotation @ Rotation.from_quat(sensors[segment]).as_matrix()
            levers.append(R_WS.T @ lever_W)
            distances.append(float(np.linalg.norm(lever_W)))
        std = max(LEVER_STD, LEVER_STD_OF_LENGTH * max(distances))
        travels = not model.table.is_mechanism and near in _spine(model)
        pairs.append(JointPair(near, far, np.concatenate(levers), std, travels))
    return tuple(pairs)


def _spine(model: BodyModel) -> Collection[str]:
    return {name for name, segment in model.table.segments.items() if segment.spine}


def _find_joints(model: BodyModel, segment: str, placement: Mapping[str, pin.SE3]) -> np.ndarray:
    """Places (n, 3) [m] in W, all joints at zero, between which a segment's sensor sits."""
    children = [name for name, above in model.parents.items() if above == segment and name not in _spine(model)]
    ends = [placement[name].translation for name in children if name in placement]
    if segment in _spine(model) and ends:
        return np.array(ends)  # at the height of the shoulders, or of the hips
    if not ends:
        at = model.pin.frames[model.pin.getFrameId(segment)].parentJoint
        frames = {point: model.pin.frames[model.pin.getFrameId(link)] for point, link in model.point_frames.items()}
        reached = [point for point, frame in frames.items() if at in model.pin.supports[frame.parentJoint]]
        ends = [sum_reach(model, point) for point in reached]
    return np.array([placement[segment].translation, *ends])


def sum_reach(model: BodyModel, point: str) -> np.ndarray:
    """Place (3,) [m] of a point in W, all joints at zero."""
    data = model.pin.createData()
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    return np.array(data.oMf[model.pin.getFrameId(model.point_frames[point])].translation)


class JointAccelerationFilter:
    """The two sides of each joint, low-passed, from samples of all sensors; it runs on from call to call.

    Parameters
    ----------
    names : segments, in the order of the samples
    """

    def __init__(self, names: Sequence[str], pairs: Sequence[JointPair], rate_hz: float) -> None:
        self._columns = [(names.index(pair.near), names.index(pair.far)) for pair in pairs]
        self._used = sorted({i for columns in self._columns for i in columns})
        self._rate_hz = rate_hz
        self._band: BandPass | None = None
        self._last: np.ndarray | None = None  # (3, k, 3, 4) the last three samples: force, rotation
        self._force = np.zeros((len(names), 3))  # last valid one

    def push(self, R_WS: np.ndarray, accel_S: np.ndarray, rows: np.ndarray) -> tuple[JointSums | None, ...]:
        """Return the sums over the chosen rows, joint by joint; None where a sensor has lost a sample.

        Parameters
        ----------
        R_WS : (n, k, 3, 3)
        accel_S : (n, k, 3) [m/s²], NaN where lost
        """
        if not self._columns:
            return ()
        used = self._used
        force = np.einsum("nkij,nkj->nki", R_WS[:, used], accel_S[:, used])
        lost = ~np.isfinite(force).all(axis=2)
        for i in np.flatnonzero(lost.any(axis=0)):
            filled = np.concatenate([self._force[used[i]][None], force[:, i]])
            last = np.maximum.accumulate(np.where(np.concatenate([[False], lost[:, i]]), 0, np.arange(len(filled))))
            force[:, i] = filled[last][1:]
        self._force[used] = force[-1]
        signal = np.concatenate([force[..., None], R_WS[:, used]], axis=3)  # (n, used, 3, 4)
        if self._last is None or self._band is None:
            self._last = np.repeat(signal[:1], 2, axis=0)
            steady = np.concatenate([signal[0, ..., :1], np.zeros((len(used), 3, 3)), signal[0, ..., 1:]], axis=2)
            self._band = BandPass(BAND_HZ, self._rate_hz, steady.ravel())
        long = np.concatenate([self._last, signal])
        self._last = long[-2:]
        second = self._rate_hz**2 * (long[2:, ..., 1:] - 2.0 * long[1:-1, ..., 1:] + long[:-2, ..., 1:])
        sides = np.concatenate([long[1:-1, ..., :1], -second, long[1:-1, ..., 1:]], axis=3)  # B, one sample late
        B = self._band.push(sides.reshape(len(sides), -1)).reshape(sides.shape)[rows]
        return tuple(
            None
            if lost[:, used.index(near)].any() or lost[:, used.index(far)].any()
            else _sum_products(B[:, used.index(near)], B[:, used.index(far)])
            for near, far in self._columns
        )


def _sum_products(near: np.ndarray, far: np.ndarray) -> JointSums:
    """The sums of the sides (n, 3, 7) of a joint."""
    (nx, ny, nz), (fx, fy, fz) = np.moveaxis(near, 1, 0), np.moveaxis(far, 1, 0)
    turn = nx.T @ ny
    return JointSums(
        len(near),
        nx.T @ nx + ny.T @ ny,
        nz.T @ nz,
        turn - turn.T,
        fx.T @ fx + fy.T @ fy + fz.T @ fz,
        fx.T @ nx + fy.T @ ny,
        fy.T @ nx - fx.T @ ny,
        fz.T @ nz,
    )
