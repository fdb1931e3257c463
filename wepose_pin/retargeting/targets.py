"""Targets of the robot's hands: the person's arms, scaled, from the robot's own shoulders, inside its reach."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, interp1d
from scipy.spatial.transform import Rotation, Slerp

from ..errors import BadData, WrongOption
from ..filters.butterworth import low_pass
from ..kinematics import Pose, compute_axis_std
from ..model import BodyTable, Limb, load_table
from .maps import SIDES
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


class HandPath(NamedTuple):
    """Target of one hand over time, in B; arrays (n, …)."""

    position: np.ndarray  # (n, 3) [m], inside the reach
    velocity: np.ndarray  # (n, 3) [m/s]
    rotation: np.ndarray  # (n, 3, 3)
    angular_velocity: np.ndarray  # (n, 3) [rad/s]
    swivel: np.ndarray  # (n, 3) [m] elbow swivel direction: perpendicular from the line shoulder-hand to the elbow
    unclamped: np.ndarray  # (n, 3) [m] position before it was clamped to the reach
    weight: np.ndarray  # (n,) 0 to 1, from the uncertainty of the hand
    lost: np.ndarray  # (n,) bool: not measured, bridged


@dataclass(frozen=True)
class ArmTargets:
    """Motion of the person's arms in B.

    Parameters
    ----------
    time : (n,) [s] of the recording
    hands : one path an arm, in the order of `Robot.arms`
    slowdown : (n,) from 1: factor on the duration that poor tracking asks for
    scale : side → metres of the robot for one metre of the person
    """

    time: np.ndarray
    hands: tuple[HandPath, ...]
    slowdown: np.ndarray
    scale: dict[str, float]


def find_person_arm(table: BodyTable, side: str) -> Limb:
    """The limb of a person that the robot's arm of this side ("left" or "right") follows: the first one of that side.

    Raises
    ------
    BadData
        The body has none with three segments on a base: upper arm, forearm, hand.
    """
    for tip, limb in table.drawn_limbs.items():
        if table.side(tip) == side and limb.base is not None and len(limb.segments) == len(limb.points) - 1 == LINKS:
            return limb
    raise BadData(f"{table.name} has no {side} arm of {LINKS} segments, as shoulder, elbow, wrist and palm bound them")


def compute_arm_targets(
    pose: Pose,
    robot: Robot,
    *,
    table: BodyTable | None = None,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
) -> ArmTargets:
    """Targets of the robot's hands for a person's pose.

    Each hand is taken relative to its shoulder and to the segment that carries this, so leaning and walking do not move
    the robot's base. Distances are scaled by the ratio of the reaches, orientations are not. NaN, gaps and jumps are
    bridged and count as poor tracking.

    Parameters
    ----------
    table : of the person's body; None: the upper body
    scale : metres of the robot for one of the person; None: a straight arm becomes `compute_target_reach`
    smoothing_hz : cut-off of the zero-phase low-pass; 0: none

    Raises
    ------
    BadData
        The pose lacks an arm of the robot, or holds nothing but NaN.
    WrongOption
        A scale or cut-off out of range.
    """
    check_scale_and_smoothing(scale, smoothing_hz)
    time = np.asarray(pose.time, dtype=float)
    if len(time) < 10:
        raise BadData(f"{len(time)} samples in the pose; a motion has at least 10")
    table = table or load_table()
    _check_arms(pose, robot, table)
    R_BT = Rotation.from_matrix(robot.R_BT)  # T: the segment that carries the arms
    hands, scales, slowdown = [], {}, np.ones(len(time))
    for arm in robot.arms:
        side, limb = arm.side, find_person_arm(table, arm.side)
        shoulder, elbow, wrist, hand = (pose.points[name] for name in limb.points)
        R_TW = Rotation.from_quat(pose.quat_WL[str(limb.base)]).inv()
        links = (elbow - shoulder, wrist - elbow, hand - wrist)
        if not all(np.isfinite(link).all(axis=1).any() for link in links):
            raise BadData(f"the {side} arm is not known anywhere in the pose: its points are missing")
        length = sum(float(np.nanmedian(np.linalg.norm(link, axis=1))) for link in links)
        factor = scales[side] = scale or compute_target_reach(robot, arm) / length
        offset = factor * (R_BT * R_TW).apply(hand - shoulder)
        upper = factor * (R_BT * R_TW).apply(elbow - shoulder)
        rotation = R_BT * R_TW * Rotation.from_quat(pose.quat_WL[find_hand_segment(limb, pose.quat_WL)])
        known = np.isfinite(offset).all(axis=1) & np.isfinite(upper).all(axis=1)
        known &= np.isfinite(rotation.as_quat()).all(axis=1) & ~_find_gaps(pose, limb)
        known &= ~_find_jumps(time, offset / factor)
        if known.sum() < 2:
            raise BadData(f"the {side} arm is not known anywhere in the pose: its orientations are missing, or lost")
        measured = _MeasuredArm(time, offset, upper, rotation, known, _hand_std(pose, limb, known))
        hands.append(_smooth(measured, arm, smoothing_hz))
        slowdown = np.maximum(slowdown, 1.0 + (MAX_SLOWDOWN - 1.0) * (1.0 - hands[-1].weight))
    return ArmTargets(time, tuple(hands), slowdown, scales)


def check_scale_and_smoothing(scale: float | None, smoothing_hz: float) -> None:
    """Raise `WrongOption` for a scale or cut-off out of range."""
    if scale is not None and not 0.0 < scale < np.inf:
        raise WrongOption("scale", f"{scale:g}", "a number above 0 is needed")
    if not 0.0 <= smoothing_hz < np.inf:
        raise WrongOption("smoothing-hz", f"{smoothing_hz:g}", "0, which does not smooth, or more is needed")


def compute_target_reach(robot: Robot, arm: Arm) -> float:
    """The distance [m] from the robot's shoulder to its hand that a straight arm of the person becomes."""
    reach = robot.map.arms[arm.side].reach
    return REACH_SHARE * arm.reach if reach is None else min(reach, REACH_SHARE * arm.reach)


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


def resample_targets(targets: ArmTargets, moments: np.ndarray, clock: np.ndarray) -> ArmTargets:
    """The targets at the times `moments` [s] of the recording, with velocities on the robot's time `clock` [s]."""
    time, inside = targets.time, np.clip(moments, targets.time[0], targets.time[-1])
    hands = []
    for hand in targets.hands:
        position, swivel, unclamped = (
            CubicSpline(time, values)(inside) for values in (hand.position, hand.swivel, hand.unclamped)
        )
        rotation = Slerp(time, Rotation.from_matrix(hand.rotation))(inside).as_matrix()
        weight = np.interp(moments, time, hand.weight)
        lost = np.interp(moments, time, hand.lost.astype(float)) > 0.5
        path = HandPath(position, position, rotation, position, swivel, unclamped, weight, lost)  # without velocities
        hands.append(differentiate(path, clock))
    return replace(targets, time=moments, hands=tuple(hands), slowdown=np.interp(moments, time, targets.slowdown))


def differentiate(path: HandPath, clock: np.ndarray) -> HandPath:
    """The path with the velocities of its positions and rotations on `clock` [s]."""
    R = Rotation.from_matrix(path.rotation)
    between = (R[1:] * R[:-1].inv()).as_rotvec() / np.diff(clock)[:, None]
    angular_velocity = np.vstack([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    return path._replace(velocity=np.gradient(path.position, clock, axis=0), angular_velocity=angular_velocity)


class _MeasuredArm(NamedTuple):
    """One arm of the person in B, scaled."""

    time: np.ndarray  # (n,) [s]
    offset: np.ndarray  # (n, 3) [m] shoulder to hand
    upper: np.ndarray  # (n, 3) [m] shoulder to elbow
    rotation: Rotation  # (n,) of the hand
    known: np.ndarray  # (n,) bool
    std: np.ndarray  # (n,) [m] of the hand


def _smooth(measured: _MeasuredArm, arm: Arm, smoothing_hz: float) -> HandPath:
    """The path of a hand: bridged, low-passed, clamped to the reach."""
    time, known = measured.time, measured.known
    t = time[known]
    offset, upper = (
        interp1d(t, x[known], axis=0, fill_value=(x[known][0], x[known][-1]), bounds_error=False)(time)
        for x in (measured.offset, measured.upper)
    )
    rotation = Slerp(t, measured.rotation[known])(np.clip(time, t[0], t[-1]))
    rate_hz = (len(time) - 1) / (time[-1] - time[0])
    if 0.0 < smoothing_hz < 0.45 * rate_hz and len(time) > 30:
        offset, upper, matrices = (
            low_pass(values, smoothing_hz, rate_hz) for values in (offset, upper, rotation.as_matrix().reshape(-1, 9))
        )
        rotation = Rotation.from_matrix(_nearest_rotations(matrices))
    poorness = np.clip((measured.std - STD_GOOD) / (STD_POOR - STD_GOOD), 0.0, 1.0)
    weight = 1.0 - (1.0 - WEIGHT_POOR) * poorness**2 * (3.0 - 2.0 * poorness)
    width = max(1, int(0.2 * rate_hz))
    weight = np.convolve(np.pad(weight, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), "valid")
    position, unclamped = arm.shoulder + clamp_to_reach(offset, arm.reach), arm.shoulder + offset
    swivel = compute_swivel(upper, offset)
    path = HandPath(position, position, rotation.as_matrix(), position, swivel, unclamped, weight, ~known)
    return differentiate(path, time)  # fills in the velocities


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) nearest to matrices (n, 9)."""
    U, _, Vt = np.linalg.svd(matrices.reshape(-1, 3, 3))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return U @ Vt


def find_hand_segment(limb: Limb, measured: Collection[str]) -> str:
    """The segment whose orientation a hand has: its own, or that above where the hand is not measured."""
    return limb.segments[-1] if limb.segments[-1] in measured else limb.segments[-2]


def list_needed_segments(limb: Limb) -> tuple[str, ...]:
    """The segments that must be measured for an arm to be followed, from the body on."""
    return (str(limb.base), *limb.segments[:-1])


def _check_arms(pose: Pose, robot: Robot, table: BodyTable) -> None:
    """Raise `BadData` where the pose lacks an arm of the robot's."""
    followed = {arm.side for arm in robot.arms}
    sides = [side for side in SIDES if side in followed or side in {table.side(tip) for tip in table.drawn_limbs}]
    limbs = {side: find_person_arm(table, side) for side in sides}
    missing = {side: _missing_names(pose, limb) for side, limb in limbs.items()}
    lacking = [arm.side for arm in robot.arms if missing[arm.side]]
    if not lacking:
        return
    text = "; ".join(f"the {side} arm is not in the pose: {', '.join(missing[side])} is missing" for side in lacking)
    usable = next((side for side in robot.map.arms if not missing[side]), None)
    if usable is not None:
        raise BadData(f"{text}; --arm {usable} takes the other")
    present = next((side for side in missing if not missing[side]), None)
    if present is not None:
        raise BadData(f"{text}; {robot.map.name} has no arm for the {present} one, which is there")
    needed = [table.shared_name(name).replace("_", " ") for name in list_needed_segments(limbs[lacking[0]])]
    raise BadData(f"{text}; an arm needs sensors on {', '.join(needed[:-1])} and {needed[-1]}")


def _missing_names(pose: Pose, limb: Limb) -> list[str]:
    """Segments and points of an arm that the pose lacks."""
    segments = [name for name in list_needed_segments(limb) if name not in pose.quat_WL]
    return segments + [name for name in limb.points if name not in pose.points]


def _find_gaps(pose: Pose, limb: Limb) -> np.ndarray:
    """(n,) bool: a sensor of the arm has a gap."""
    gaps = np.zeros(len(pose.time), dtype=bool)
    for segment in (str(limb.base), *limb.segments):
        if segment in pose.gap:
            gaps |= np.asarray(pose.gap[segment], dtype=bool)
    return gaps


def _find_jumps(time: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(n,) bool: samples around a step between offsets (n, 3) [m] that no hand makes."""
    speed = np.linalg.norm(np.diff(offset, axis=0), axis=1) / np.maximum(np.diff(time), 1e-9)
    near = np.zeros(len(time), dtype=bool)
    for k in np.flatnonzero(np.nan_to_num(speed) > JUMP_SPEED):
        near |= np.abs(time - 0.5 * (time[k] + time[k + 1])) < JUMP_S
    near[[0, -1]] = False
    return near


def _hand_std(pose: Pose, limb: Limb, known: np.ndarray) -> np.ndarray:
    """(n,) [m] of the hand; poor where it is not known."""
    cov = pose.point_cov.get(limb.tip)
    std = np.zeros(len(known)) if cov is None else np.nan_to_num(compute_axis_std(cov), nan=STD_POOR)
    return np.where(known, std, STD_POOR)
