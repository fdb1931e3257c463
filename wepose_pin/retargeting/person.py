"""What the robot's hands are to do: the person's arms, scaled, from the robot's own shoulders, inside its reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, interp1d
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation, Slerp

from ..errors import BadData, BadOption
from ..pose import Pose, spread
from .robot import Arm, Robot

REACH_SHARE = 0.95  # of the robot's reach for a straight arm: its elbow stays bent, far from where it locks
CLAMP_FROM, CLAMP_TO = 0.95, 0.99  # of the reach: between them a target is drawn in smoothly
SMOOTHING_HZ = 6.0  # what a person's arm does on purpose is slower (Winter 2009, 2.2.3)
STD_GOOD, STD_POOR = 0.04, 0.12  # [m] of the hand: full speed up to the one, slowest from the other on
SLOWEST = 3.0  # times longer, where tracking is poor
WEIGHT_POOR = 0.1  # of the hand's tasks, where tracking is poor
JUMP_SPEED = 12.0  # [m/s] faster than any hand in the person's own size: a jump of the tracking
JUMP_S = 0.25  # [s] on each side of a jump that is bridged


class ArmTarget(NamedTuple):
    """Where one hand is to be, in the robot's root; (n, …) over time."""

    position: np.ndarray  # (n, 3) [m], inside the reach
    velocity: np.ndarray  # (n, 3) [m/s]
    rotation: np.ndarray  # (n, 3, 3)
    rate: np.ndarray  # (n, 3) [rad/s]
    bend: np.ndarray  # (n, 3) [m] from the line shoulder-hand to the elbow
    wish: np.ndarray  # (n, 3) [m] the position before it was drawn into the reach
    weight: np.ndarray  # (n,) 0 to 1: how far tracking is to be trusted
    lost: np.ndarray  # (n,) bool: bridged, nothing was measured


@dataclass(frozen=True)
class Wish:
    """Motion of the person's arms in the robot's frame.

    Parameters
    ----------
    time : (n,) [s] of the recording
    arms : in the order of the robot's
    slow : (n,) from 1: how much longer poor tracking asks a moment to take
    scale : side → robot's metres for one of the person's
    """

    time: np.ndarray
    arms: tuple[ArmTarget, ...]
    slow: np.ndarray
    scale: dict[str, float]


def wish(pose: Pose, robot: Robot, *, scale: float | None = None, smoothing_hz: float = SMOOTHING_HZ) -> Wish:
    """What the person's arms ask of the robot's.

    Each hand is seen from its shoulder and turned with the torso: a person who leans or walks leaves the robot's base
    alone. Distances are scaled by the ratio of the reaches, orientations are not. What is NaN, lost or jumps is bridged
    and counts as poor.

    Parameters
    ----------
    scale : robot's metres for one of the person's; None: a straight arm becomes `robot_reach`
    smoothing_hz : of the zero-phase low-pass on what was measured; 0: none

    Raises
    ------
    BadData
        The pose has not the arms that the robot needs, or nothing in it is known.
    BadOption
        A scale or smoothing that is none.
    """
    if scale is not None and not 0.0 < scale < np.inf:
        raise BadOption(f"--scale {scale:g}: the robot's metres for one of the person's, above 0")
    if not 0.0 <= smoothing_hz < np.inf:
        raise BadOption(f"--smoothing-hz {smoothing_hz:g}: from 0 on, which is none")
    time = np.asarray(pose.time, dtype=float)
    if len(time) < 10:
        raise BadData(f"{len(time)} samples in the pose; a motion has at least 10")
    _needed(pose, robot)
    R_WT = Rotation.from_quat(pose.quat_WL["torso"])
    targets, scales, slow = [], {}, np.ones(len(time))
    for arm in robot.arms:
        side = arm.side
        points = {name: pose.points[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist", "hand")}
        parts = (
            points["elbow"] - points["shoulder"],
            points["wrist"] - points["elbow"],
            points["hand"] - points["wrist"],
        )
        if not all(np.isfinite(part).all(axis=1).any() for part in parts):
            raise BadData(f"the {side} arm is not known anywhere in the pose: its points are missing")
        length = sum(float(np.nanmedian(np.linalg.norm(part, axis=1))) for part in parts)
        by = scales[side] = scale or robot_reach(robot, arm) / length
        from_T = R_WT.inv()
        turn = Rotation.from_matrix(robot.R_BT)
        reach = by * (turn * from_T).apply(points["hand"] - points["shoulder"])
        upper = by * (turn * from_T).apply(points["elbow"] - points["shoulder"])
        segment = f"{side}_hand" if f"{side}_hand" in pose.quat_WL else f"{side}_forearm"
        rotation = turn * from_T * Rotation.from_quat(pose.quat_WL[segment])
        known = np.isfinite(reach).all(axis=1) & np.isfinite(upper).all(axis=1)
        known &= np.isfinite(rotation.as_quat()).all(axis=1) & ~_gaps(pose, side)
        known &= ~_jumps(time, reach / by)
        if known.sum() < 2:
            raise BadData(f"the {side} arm is not known anywhere in the pose: its orientations are missing, or lost")
        std = _std(pose, side, known)
        targets.append(_target(time, arm, reach, upper, rotation, known, std, smoothing_hz))
        slow = np.maximum(slow, 1.0 + (SLOWEST - 1.0) * (1.0 - targets[-1].weight))
    return Wish(time, tuple(targets), slow, scales)


def robot_reach(robot: Robot, arm: Arm) -> float:
    """[m] what a straight arm of the person becomes."""
    said = robot.map.arms[arm.side].reach
    return REACH_SHARE * arm.reach if said is None else min(said, REACH_SHARE * arm.reach)


def drawn_in(offset: np.ndarray, reach: float) -> np.ndarray:
    """Offsets (…, 3) from the shoulder inside the reach: unchanged in a sphere, beyond it drawn in smoothly."""
    inner, outer = CLAMP_FROM * reach, CLAMP_TO * reach
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    beyond = np.maximum(distance - inner, 0.0)
    kept = np.minimum(distance, inner) + (outer - inner) * np.tanh(beyond / (outer - inner))
    return offset * kept / np.maximum(distance, 1e-9)


def bend_of(upper: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(…, 3): from the line shoulder-hand, along `offset`, to the elbow at `upper`; its direction is the swivel."""
    axis = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    return upper - axis * np.sum(upper * axis, axis=-1, keepdims=True)


def resampled(wish: Wish, at: np.ndarray, clock: np.ndarray) -> Wish:
    """The wish at moments `at` [s] of its own time that pass at times `clock` [s] of the robot's."""
    arms = []
    for target in wish.arms:
        position, rotation = _at(wish.time, target.position, at), _turned(wish.time, target.rotation, at)
        arms.append(
            replace_rates(
                ArmTarget(
                    position,
                    position,
                    rotation,
                    position,
                    _at(wish.time, target.bend, at),
                    _at(wish.time, target.wish, at),
                    np.interp(at, wish.time, target.weight),
                    np.interp(at, wish.time, target.lost.astype(float)) > 0.5,
                ),
                clock,
            )
        )
    return replace(wish, time=at, arms=tuple(arms), slow=np.interp(at, wish.time, wish.slow))


def replace_rates(target: ArmTarget, clock: np.ndarray) -> ArmTarget:
    """The target with the velocities that its positions and rotations have on `clock` [s]."""
    velocity = np.gradient(target.position, clock, axis=0)
    R = Rotation.from_matrix(target.rotation)
    turned = (R[1:] * R[:-1].inv()).as_rotvec() / np.diff(clock)[:, None]
    rate = np.vstack([turned[:1], 0.5 * (turned[1:] + turned[:-1]), turned[-1:]])
    return target._replace(velocity=velocity, rate=rate)


def _needed(pose: Pose, robot: Robot) -> None:
    missing = {side: _missing(pose, side) for side in ("left", "right")}
    lacking = [arm.side for arm in robot.arms if missing[arm.side]]
    if not lacking:
        return
    said = "; ".join(f"the {side} arm is not in the pose: {', '.join(missing[side])} is missing" for side in lacking)
    other = next((side for side in robot.map.arms if not missing[side]), None)
    if other is not None:
        raise BadData(f"{said}; --arm {other} takes the other")
    have = next((side for side in missing if not missing[side]), None)
    raise BadData(
        f"{said}; {robot.map.name} has no arm for the {have} one, which is there"
        if have
        else f"{said}; an arm needs sensors on torso, upper arm and forearm"
    )


def _missing(pose: Pose, side: str) -> list[str]:
    """Segments and points of an arm that the pose has not."""
    segments = ("torso", f"{side}_upper_arm", f"{side}_forearm")
    points = tuple(f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "hand"))
    return [name for name in segments if name not in pose.quat_WL] + [n for n in points if n not in pose.points]


def _gaps(pose: Pose, side: str) -> np.ndarray:
    lost = np.zeros(len(pose.time), dtype=bool)
    for segment in ("torso", f"{side}_upper_arm", f"{side}_forearm", f"{side}_hand"):
        if segment in pose.gap:
            lost |= np.asarray(pose.gap[segment], dtype=bool)
    return lost


def _jumps(time: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Samples around a step that no hand makes."""
    speed = np.linalg.norm(np.diff(points, axis=0), axis=1) / np.maximum(np.diff(time), 1e-9)
    near = np.zeros(len(time), dtype=bool)
    for k in np.flatnonzero(np.nan_to_num(speed) > JUMP_SPEED):
        near |= np.abs(time - 0.5 * (time[k] + time[k + 1])) < JUMP_S
    near[[0, -1]] = False
    return near


def _std(pose: Pose, side: str, known: np.ndarray) -> np.ndarray:
    """[m] of the hand; poor where it is not known."""
    cov = pose.point_cov.get(f"{side}_hand")
    std = np.zeros(len(known)) if cov is None else np.nan_to_num(spread(cov), nan=STD_POOR)
    return np.where(known, std, STD_POOR)


def _target(
    time: np.ndarray,
    arm: Arm,
    reach: np.ndarray,
    upper: np.ndarray,
    rotation: Rotation,
    known: np.ndarray,
    std: np.ndarray,
    smoothing_hz: float,
) -> ArmTarget:
    t = time[known]
    reach, upper = (interp1d(t, x[known], axis=0, fill_value=(x[known][0], x[known][-1]), bounds_error=False)(time)
                    for x in (reach, upper))  # fmt: skip
    rotation = Slerp(t, rotation[known])(np.clip(time, t[0], t[-1]))
    rate_hz = (len(time) - 1) / (time[-1] - time[0])
    if 0.0 < smoothing_hz < 0.45 * rate_hz and len(time) > 30:
        low = butter(2, smoothing_hz, fs=rate_hz, output="sos")
        reach, upper = sosfiltfilt(low, reach, axis=0), sosfiltfilt(low, upper, axis=0)
        rotation = Rotation.from_matrix(_nearest(sosfiltfilt(low, rotation.as_matrix().reshape(-1, 9), axis=0)))
    grade = np.clip((std - STD_GOOD) / (STD_POOR - STD_GOOD), 0.0, 1.0)
    weight = 1.0 - (1.0 - WEIGHT_POOR) * grade**2 * (3.0 - 2.0 * grade)
    width = max(1, int(0.2 * rate_hz))
    weight = np.convolve(np.pad(weight, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), "valid")
    drawn = drawn_in(reach, arm.reach)
    target = ArmTarget(
        arm.shoulder + drawn, drawn, rotation.as_matrix(), drawn, bend_of(upper, reach), arm.shoulder + reach, weight,
        ~known,
    )  # fmt: skip
    return replace_rates(target, time)


def _nearest(matrices: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) nearest to (n, 9)."""
    U, _, Vt = np.linalg.svd(matrices.reshape(-1, 3, 3))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return U @ Vt


def _at(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return CubicSpline(time, values)(np.clip(at, time[0], time[-1]))


def _turned(time: np.ndarray, rotation: np.ndarray, at: np.ndarray) -> np.ndarray:
    return Slerp(time, Rotation.from_matrix(rotation))(np.clip(at, time[0], time[-1])).as_matrix()
