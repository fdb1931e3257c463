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
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..body import BodyModel
from ..body.links import find_carrier
from ..filters.butterworth import BandPass

BAND_HZ = (0.1, 1.5)  # what people move in
LEAST_RATE_HZ = 20.0  # of recordings that are used
# Where a sensor sits is known from its segment alone: in the middle, give or take this much on each axis; assumption.
LEVER_STD = 0.08  # [m]
LEVER_STD_OF_LENGTH = 0.3  # of the distance to the joint, on large bodies
# A heading may be feigned by this many times the rms of the coherent misfits that no heading explains, and by no more
# than a share of the rms misfit; found by simulated people who walk, run, throw and reach.
COHERENT_MARGIN, LARGEST_COHERENT_SHARE = 2.0, 0.5


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


class JointResidual(NamedTuple):
    """The misfit of m samples of a joint's specific force between its two sensors.

    Parameters
    ----------
    e : (m, 3) [m/s²] the far side less the near one, in the far one's W
    jacobian : (m, 3, 15) by the angle and by (r, ε, τ) of the near and of the far sensor
    force : (m, 3) [m/s²] of the joint by the near sensor, in the far one's W
    """

    e: np.ndarray
    jacobian: np.ndarray
    force: np.ndarray


def linearize_joint(
    near_B: np.ndarray, far_B: np.ndarray, angle: float, near: np.ndarray, far: np.ndarray
) -> JointResidual:
    """Compute the misfit of a joint and its Jacobian.

    Parameters
    ----------
    near_B, far_B : (m, 3, 8) of the two sensors, from `JointAccelerationFilter.push`
    angle : [rad] turns the near side about the vertical into the far one
    near, far : (7,) lever r [m], force ε [m/s²] and delay τ [s] of each sensor
    """
    c, s = np.cos(angle), np.sin(angle)
    turned_B = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ near_B
    force = turned_B[:, :, 0] + turned_B[:, :, 1:] @ near
    jacobian = np.empty((len(force), 3, 1 + len(near) + len(far)))
    jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 2, 0] = force[:, 1], -force[:, 0], 0.0
    jacobian[:, :, 1 : 1 + len(near)], jacobian[:, :, 1 + len(near) :] = -turned_B[:, :, 1:], far_B[:, :, 1:]
    return JointResidual(far_B[:, :, 0] + far_B[:, :, 1:] @ far - force, jacobian, force)


class JointMisfit(NamedTuple):
    """The recent misfit of a joint: sums over samples, in which older ones count less.

    Some of a misfit repeats with the motion, as that of soft tissue with the gait: it is coherent with the joint's
    force and does not average out. A heading explains one coherent misfit, which turns the force about the vertical.
    The other ones, which stretch it or mix it with the vertical, show how large coherent misfits are in this motion.

    Parameters
    ----------
    products : (3, 3) [m²/s⁴] Σ e fᵀ of the misfit e and the force f
    misfit, force : (3,) [m²/s⁴] Σ e², Σ f²
    samples : that count
    """

    products: np.ndarray = np.zeros((3, 3))
    misfit: np.ndarray = np.zeros(3)
    force: np.ndarray = np.zeros(3)
    samples: float = 0.0

    def add(self, residual: JointResidual, decay: float) -> JointMisfit:
        """Return the sums with the samples of a residual, the former ones times `decay`."""
        e, f = residual.e, residual.force
        return JointMisfit(
            decay * self.products + e.T @ f,
            decay * self.misfit + np.sum(e**2, axis=0),
            decay * self.force + np.sum(f**2, axis=0),
            decay * self.samples + len(e),
        )

    @property
    def variance(self) -> float:
        """[m²/s⁴] of the misfit, mean of the axes."""
        return float(self.misfit.sum() / (3.0 * self.samples)) if self.samples else 0.0

    def find_coherent_variance(self, correlated_samples: float) -> float:
        """Return the variance [rad²] of the heading that a coherent misfit can feign.

        `correlated_samples` are one observation; so many of them have coherent parts by chance.
        """
        horizontal = self.force[0] + self.force[1]
        if not horizontal:
            return 0.0
        E = self.products / horizontal
        mixed = E[:2, 2] * np.sqrt(horizontal / max(self.force[2], 1e-9 * horizontal))
        parts = np.array([E[0, 0] + E[1, 1], E[0, 0] - E[1, 1], E[0, 1] + E[1, 0], *mixed, *E[2, :2]])
        by_chance = self.variance / horizontal * correlated_samples / self.samples
        coherent = COHERENT_MARGIN**2 * max(float(np.mean(parts**2)) - by_chance, 0.0)
        return min(coherent, LARGEST_COHERENT_SHARE**2 * self.variance * 2.0 * self.samples / horizontal)


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
    """The side B of each sensor at its joints, band-passed, from samples of all sensors; it runs on from call to call.

    Parameters
    ----------
    sensors : number of them
    """

    def __init__(self, sensors: int, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._band: BandPass | None = None
        self._last = np.zeros((2, sensors, 3, 4))  # specific force in S and rotation of the last two samples
        self._force_S = np.zeros((sensors, 3))  # the last valid one

    def push(self, R_WS: np.ndarray, accel_S: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return B (m, k, 3, 8) of the chosen rows; where a sensor has lost samples it is of no use.

        Parameters
        ----------
        R_WS : (n, k, 3, 3)
        accel_S : (n, k, 3) [m/s²], NaN where lost
        """
        force_S = accel_S.copy()
        lost = ~np.isfinite(force_S).all(axis=2)
        for i in np.flatnonzero(lost.any(axis=0)):
            filled = np.concatenate([self._force_S[i][None], force_S[:, i]])
            last = np.maximum.accumulate(np.where(np.concatenate([[False], lost[:, i]]), 0, np.arange(len(filled))))
            force_S[:, i] = filled[last][1:]
        self._force_S = force_S[-1]
        signal = np.concatenate([force_S[..., None], R_WS], axis=3)  # (n, k, 3, 4)
        if self._band is None:
            self._last = np.repeat(signal[:1], 2, axis=0)
            steady = np.concatenate([R_WS[0] @ signal[0, ..., :1], 0.0 * R_WS[0], R_WS[0], signal[0, ..., :1] * 0.0], 2)
            self._band = BandPass(BAND_HZ, self._rate_hz, steady.ravel())
        long = np.concatenate([self._last, signal])
        self._last = long[-2:]
        R, change_S = long[1:-1, ..., 1:], 0.5 * self._rate_hz * (long[2:, ..., :1] - long[:-2, ..., :1])
        second = self._rate_hz**2 * (long[2:, ..., 1:] - 2.0 * R + long[:-2, ..., 1:])
        B = np.concatenate([R @ long[1:-1, ..., :1], -second, R, R @ change_S], axis=3)  # one sample late
        return self._band.push(B.reshape(len(B), -1)).reshape(B.shape)[rows]
