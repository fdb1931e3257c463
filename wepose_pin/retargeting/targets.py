"""Targets of the robot's hands: the person's arms, scaled, from the robot's own shoulders, inside its reach."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, interp1d
from scipy.spatial.transform import Rotation, Slerp

from ..body import BodyTable, Limb, load_table
from ..body.kinematics import Pose, compute_axis_std
from ..errors import BadData, WrongOption
from ..filters.butterworth import low_pass
from .robot import Arm, Robot

REACH_SHARE = 0.95  # of the robot's reach for a straight arm: its elbow stays flexed, far from the singularity
CLAMP_FROM, CLAMP_TO = 0.95, 0.99  # of the reach: between them a target is clamped smoothly
SMOOTHING_HZ = 6.0  # [Hz] voluntary motion of an arm is slower (Winter 2009, 2.2.3)
# [m] of the hand: full speed up to the first, slowest from the second. With mounts stated in the N-pose it is uncertain
# by some 0.09 m, with calibrated ones by 0.04; beyond that headings drift or sensors are lost.
STD_GOOD, STD_POOR = 0.10, 0.25
MAX_SLOWDOWN = 3.0  # times longer, where tracking is poor
WEIGHT_POOR = 0.1  # of the hand's tasks, where tracking is poor
JUMP_SPEED = 12.0  # [m/s] in the person's size: no hand is faster, so the tracking has jumped
JUMP_S = 0.25  # [s] bridged on each side of a jump
LINKS = 3  # of an arm: upper arm, forearm, hand


class HandTarget(NamedTuple):
    """Target of one hand in B, at one moment, or over time with (n, …) in each field."""

    position: np.ndarray  # (3,) [m], inside the reach
    velocity: np.ndarray  # (3,) [m/s]
    rotation: np.ndarray  # (3, 3)
    angular_velocity: np.ndarray  # (3,) [rad/s]
    swivel: np.ndarray  # (3,) [m] elbow swivel direction: perpendicular from the line shoulder-hand to the elbow
    weight: Any  # 0 to 1, from the uncertainty of the hand
    unclamped: Any = None  # (3,) [m] position before it was clamped to the reach; these two only over time
    lost: Any = None  # whether it was not measured, but bridged

    def sample(self, k: Any) -> HandTarget:
        """Return the target at sample `k`, or at several."""
        return HandTarget(*(values[k] for values in self))

    def differentiate(self, clock: np.ndarray) -> HandTarget:
        """Return the target over time with the velocities of its positions and rotations on `clock` [s]."""
        R = Rotation.from_matrix(self.rotation)
        between = (R[1:] * R[:-1].inv()).as_rotvec() / np.diff(clock)[:, None]
        angular_velocity = np.vstack([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
        velocity = np.gradient(self.position, clock, axis=0)
        return self._replace(velocity=velocity, angular_velocity=angular_velocity)

    def compute_step_targets(self, dt: float) -> HandTarget:
        """Return the target (n, …) of the step from each sample: positions amid it, velocities half a step after."""
        last = len(self.weight) - 1
        following, after = (np.minimum(np.arange(last + 1) + k, last) for k in (1, 2))
        velocity, angular_velocity = (
            0.5 * (rate[following] + rate[after]) for rate in (self.velocity, self.angular_velocity)
        )
        position = self.position + 0.5 * dt * self.velocity
        return self._replace(position=position, velocity=velocity, angular_velocity=angular_velocity)


@dataclass(frozen=True)
class ArmTargets:
    """Motion of the person's arms in B."""

    time: np.ndarray  # (n,) [s] of the recording
    hands: tuple[HandTarget, ...]  # over time, one an arm, in the order of `Robot.arms`
    slowdown: np.ndarray  # (n,) from 1: factor on the duration that poor tracking asks for
    scale: dict[str, float]  # side → metres of the robot for one metre of the person

    def resample(self, moments: np.ndarray, clock: np.ndarray) -> ArmTargets:
        """Return the targets at times `moments` [s] of the recording, with velocities on the robot's time `clock`."""
        time, inside = self.time, np.clip(moments, self.time[0], self.time[-1])
        hands = []
        for hand in self.hands:
            position, swivel, unclamped = (
                CubicSpline(time, values)(inside) for values in (hand.position, hand.swivel, hand.unclamped)
            )
            rotation = Slerp(time, Rotation.from_matrix(hand.rotation))(inside).as_matrix()
            weight = np.interp(moments, time, hand.weight)
            lost = np.interp(moments, time, hand.lost.astype(float)) > 0.5
            path = HandTarget(position, position, rotation, position, swivel, weight, unclamped, lost)
            hands.append(path.differentiate(clock))
        return replace(self, time=moments, hands=tuple(hands), slowdown=np.interp(moments, time, self.slowdown))


class ArmMotion(NamedTuple):
    """One arm of the person in B, scaled; at one moment or over time (n, …)."""

    offset: np.ndarray  # (3,) [m] shoulder to hand
    upper: np.ndarray  # (3,) [m] shoulder to elbow
    rotation: np.ndarray  # (3, 3) of the hand


def map_arm(robot: Robot, scale: float, quat_WT: np.ndarray, quat_WH: np.ndarray, points: np.ndarray) -> ArmMotion:
    """Map a person's arm to the robot: relative to its shoulder and to the segment that carries this, and scaled.

    So leaning and walking do not move the robot's base. Orientations are not scaled.

    Parameters
    ----------
    scale : metres of the robot for one of the person
    quat_WT, quat_WH : (…, 4) xyzw of the segment that carries the arm, and of the hand
    points : (4, …, 3) [m] in W: shoulder, elbow, wrist, hand
    """
    R_WT, R_WH = (Rotation.from_quat(quat).as_matrix() for quat in (quat_WT, quat_WH))
    R_BW = robot.R_BT @ np.swapaxes(R_WT, -1, -2)
    offset, upper = (scale * np.einsum("...ij,...j->...i", R_BW, points[k] - points[0]) for k in (3, 1))
    return ArmMotion(offset, upper, R_BW @ R_WH)


def find_person_arm(table: BodyTable, side: str) -> Limb:
    """Find the limb of a person that the robot's arm of this side follows: three segments on a base."""
    for tip, limb in table.drawn_limbs.items():
        if table.side(tip) == side and limb.base is not None and len(limb.segments) == len(limb.points) - 1 == LINKS:
            return limb
    raise BadData(
        f"the person's body has no {side} arm of {LINKS} segments from shoulder to palm with a counterpart on the "
        f"other side; track with `model` upper_body, which works even if sensors are missing"
    )


def find_hand_segment(limb: Limb, measured: Collection[str]) -> str:
    """The segment whose orientation a hand has: its own, or that above where the hand is not measured."""
    return limb.segments[-1] if limb.segments[-1] in measured else limb.segments[-2]


def check_person_arms(
    robot: Robot, segments: Collection[str], points: Collection[str] | None = None, table: BodyTable | None = None
) -> None:
    """Raise `BadData` where an arm that the robot follows is not among the segments and points (None: all)."""
    table = table or load_table()
    for arm in robot.arms:
        limb = find_person_arm(table, arm.side)
        needed = (str(limb.base), *limb.segments[:-1])
        missing = [name for name in needed if name not in segments]
        missing += [name for name in limb.points if points is not None and name not in points]
        if missing:
            base, upper, fore = (table.shared_name(name).replace("_", " ") for name in needed)
            other = "".join(f", or choose arm {side}" for side in robot.map.arms if side != arm.side)
            raise BadData(
                f"{robot.map.name}'s {arm.side} arm follows {', '.join(missing)}, which the sensors do not measure; an "
                f"arm needs sensors on {base}, {upper} and {fore}{other}"
            )


def compute_arm_targets(
    pose: Pose,
    robot: Robot,
    *,
    table: BodyTable | None = None,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
) -> ArmTargets:
    """Compute targets of the robot's hands for a person's pose, by `map_arm`; parameters as those of `retarget`.

    NaN, gaps and jumps are bridged and count as poor tracking.

    Raises
    ------
    BadData
        The pose lacks an arm of the robot, or holds nothing but NaN.
    WrongOption
        A scale or cut-off out of range.
    """
    if scale is not None and not 0.0 < scale < np.inf:
        raise WrongOption("scale", f"{scale:g}", "a number above 0 is needed")
    if not 0.0 <= smoothing_hz < np.inf:
        raise WrongOption("smoothing_hz", f"{smoothing_hz:g}", "0, which does not smooth, or more is needed")
    time = np.asarray(pose.time, dtype=float)
    if len(time) < 10:
        raise BadData(f"{len(time)} samples in the pose; a motion has at least 10")
    table = table or load_table()
    check_person_arms(robot, pose.quat_WL, pose.points, table)
    hands, scales, slowdown = [], {}, np.ones(len(time))
    for arm in robot.arms:
        limb = find_person_arm(table, arm.side)
        points = np.stack([pose.points[name] for name in limb.points])
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=2)
        if not np.isfinite(lengths).any(axis=1).all():
            raise BadData(f"the {arm.side} arm is not known anywhere in the pose: its points are missing")
        factor = scales[arm.side] = scale or compute_target_reach(robot, arm) / sum(np.nanmedian(lengths, axis=1))
        quat_WH = pose.quat_WL[find_hand_segment(limb, pose.quat_WL)]
        motion = map_arm(robot, factor, pose.quat_WL[str(limb.base)], quat_WH, points)
        known = ~_find_jumps(time, motion.offset / factor)
        for values in motion:
            known &= np.isfinite(values.reshape(len(time), -1)).all(axis=1)
        for segment in (str(limb.base), *limb.segments):
            known &= ~np.asarray(pose.gap.get(segment, False), dtype=bool)
        if known.sum() < 2:
            raise BadData(
                f"the {arm.side} arm is not known anywhere in the pose: its orientations are missing, or lost"
            )
        cov = pose.point_cov.get(limb.points[-1])
        std = np.zeros(len(time)) if cov is None else np.nan_to_num(compute_axis_std(cov), nan=STD_POOR)
        std = np.where(known, std, STD_POOR)
        hands.append(_smooth(time, motion, known, compute_weight(std), arm, smoothing_hz))
        slowdown = np.maximum(slowdown, 1.0 + (MAX_SLOWDOWN - 1.0) * (1.0 - hands[-1].weight))
    return ArmTargets(time, tuple(hands), slowdown, scales)


def compute_target_reach(robot: Robot, arm: Arm) -> float:
    """The distance [m] from the robot's shoulder to its hand that a straight arm of the person becomes."""
    return min(robot.map.arms[arm.side].reach or np.inf, REACH_SHARE * arm.reach)


def compute_weight(std: np.ndarray | float) -> np.ndarray:
    """Weight (…) of a hand's tasks, `WEIGHT_POOR` to 1, from its standard deviation [m]."""
    poorness = np.clip((std - STD_GOOD) / (STD_POOR - STD_GOOD), 0.0, 1.0)
    return np.asarray(1.0 - (1.0 - WEIGHT_POOR) * poorness**2 * (3.0 - 2.0 * poorness))


def clamp_to_reach(offset: np.ndarray, reach: float) -> np.ndarray:
    """Offsets (…, 3) from the shoulder, inside the reach: unchanged in a sphere, smoothly clamped beyond it."""
    inner, outer = CLAMP_FROM * reach, CLAMP_TO * reach
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    beyond = np.maximum(distance - inner, 0.0)
    clamped = np.minimum(distance, inner) + (outer - inner) * np.tanh(beyond / (outer - inner))
    return offset * clamped / np.maximum(distance, 1e-9)


def compute_swivel(upper: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Elbow swivel direction (…, 3) [m]: perpendicular from the line along `offset`, shoulder to hand, to the elbow.

    `upper` is the vector from shoulder to elbow.
    """
    axis = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    return upper - axis * np.sum(upper * axis, axis=-1, keepdims=True)


def _smooth(
    time: np.ndarray, motion: ArmMotion, known: np.ndarray, weight: np.ndarray, arm: Arm, smoothing_hz: float
) -> HandTarget:
    """The target of a hand over time: bridged, low-passed, clamped to the reach."""
    t = time[known]
    offset, upper = (
        interp1d(t, x[known], axis=0, fill_value=(x[known][0], x[known][-1]), bounds_error=False)(time)
        for x in (motion.offset, motion.upper)
    )
    R = Slerp(t, Rotation.from_matrix(motion.rotation[known]))(np.clip(time, t[0], t[-1])).as_matrix()
    rate_hz = (len(time) - 1) / (time[-1] - time[0])
    if 0.0 < smoothing_hz < 0.45 * rate_hz and len(time) > 30:
        offset, upper, R = (
            low_pass(x.reshape(len(time), -1), smoothing_hz, rate_hz).reshape(x.shape) for x in (offset, upper, R)
        )
        U, _, Vt = np.linalg.svd(R)  # the nearest rotations
        U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        R = U @ Vt
    width = max(1, int(0.2 * rate_hz))
    weight = np.convolve(np.pad(weight, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), "valid")
    position, unclamped = arm.shoulder + clamp_to_reach(offset, arm.reach), arm.shoulder + offset
    path = HandTarget(position, position, R, position, compute_swivel(upper, offset), weight, unclamped, ~known)
    return path.differentiate(time)  # fills in the velocities


def _find_jumps(time: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(n,) bool: samples around a step between offsets (n, 3) [m] that no hand makes."""
    speed = np.linalg.norm(np.diff(offset, axis=0), axis=1) / np.maximum(np.diff(time), 1e-9)
    near = np.zeros(len(time), dtype=bool)
    for k in np.flatnonzero(np.nan_to_num(speed) > JUMP_SPEED):
        near |= np.abs(time - 0.5 * (time[k] + time[k + 1])) < JUMP_S
    near[[0, -1]] = False
    return near
