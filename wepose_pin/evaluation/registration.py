"""Registration of a reference to a pose: clock, world and frames, from seconds that are not scored.

The first third of the pose's time is for that, the rest is scored. The offset of the clocks is where the speeds of what
both have correlate best: rates of segments, which no choice of world or frame changes.
The reference's world is upright, so only its heading is fitted; which of its axes is up, where its format does not say
so, is what the fit comes nearest to. Frames of segments are a constant rotation each, fitted where it is asked for:
what is scored is then without any constant error of mounts and frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import correlate
from scipy.spatial.transform import Rotation

from ..body.kinematics import Pose
from ..errors import BadData
from ..recording import AXES
from ..recording.clocks import interpolate
from ..rotations import conjugate, multiply

FITTED = 1.0 / 3.0  # share of the time that is not scored
SHORTEST_S = 2.0  # [s] of it
STEP_S = 0.02  # [s] of the speeds that are correlated
TURN_S = 0.1  # [s] over which a speed is taken
LEAST_CORRELATION = 0.5
UPRIGHT = np.cos(np.radians(30.0))  # of the axis that is up to the vertical
LONGEST_GAP_S = 0.1  # [s] between known samples, or twice their usual step, beyond which nothing is interpolated
_ROUNDING_S = 1e-9  # [s] by which equal times may differ


@dataclass(frozen=True)
class Registration:
    """How a reference was brought to a pose."""

    offset_s: float  # added to the reference's times
    correlation: float  # of the speeds at that offset; NaN: the offset was stated
    up: str  # the axis of the reference's world that is up
    heading_deg: float  # by which its world was then rotated about the vertical
    shift_m: tuple[float, float, float]  # x, y, z by which its points were moved
    fitted: tuple[float, float]  # from, to [s], of the pose; as the next
    scored: tuple[float, float]
    frames_deg: Mapping[str, float] = field(default_factory=dict)  # segment → constant rotation of its frame, if fitted


def register(
    pose: Pose, truth: Pose, *, up: str | None = None, frames: bool = False, offset_s: float | None = None
) -> tuple[Pose, Registration]:
    """Bring a reference to the clock and world of a pose; return it with what was fitted.

    `up` is the axis of the reference's world that is up, as "+z", `offset_s` [s] is added to its times; None: found.
    `frames`: fit a constant rotation of each segment's frame. `BadData`: nothing in common; too little motion; no axis
    of the reference's world is up.
    """
    segments = [name for name in pose.quat_WL if _is_known(truth.quat_WL.get(name))]
    names = [name for name in pose.points if _is_known(truth.points.get(name))]
    if not segments:
        raise BadData(
            "pose and reference have no segment in common, whose orientation is needed to align them; give markers a "
            "[segments] table (`markers`), or take `fit` none where the reference is on our clock and in our world"
        )
    pose = replace(pose, quat_WL={segment: pose.quat_WL[segment] for segment in segments})
    common = replace(truth, quat_WL={segment: truth.quat_WL[segment] for segment in segments})
    begin, end = float(pose.time[0]), float(pose.time[-1])
    fit_end, correlation = begin + FITTED * (end - begin), float("nan")
    needed = f"a third of them aligns the reference and is not scored: {3.0 * SHORTEST_S:g} s are needed, or `fit` none"
    if fit_end - begin < SHORTEST_S:
        raise BadData(f"the pose lasts {end - begin:.1f} s; {needed}")
    if offset_s is None:
        offset_s, correlation = _find_offset(pose, common, (begin, fit_end))
    truth, common = (replace(each, time=truth.time + offset_s) for each in (truth, common))
    first, last = max(begin, float(truth.time[0])), min(end, float(truth.time[-1]))
    fit_end = max(fit_end, first + FITTED * (last - first))
    if fit_end - first < SHORTEST_S or last - fit_end < SHORTEST_S:
        raise BadData(f"pose and reference share {max(0.0, last - first):.1f} s; {needed}")
    time = pose.time[(pose.time >= first) & (pose.time <= fit_end)]
    R_WV, axis, heading = _find_world(pose, common, time, up, frames)
    quat_WT = {name: multiply(R_WV.as_quat(), quat_VT) for name, quat_VT in truth.quat_WL.items()}
    turned: dict[str, float] = {}
    for name in segments if frames else ():
        R_WL, R_WT = _sample_both(pose, replace(truth, quat_WL=quat_WT), name, time)
        if len(R_WL):
            R_TL = (R_WT.inv() * R_WL).mean()
            quat_WT[name] = multiply(quat_WT[name], R_TL.as_quat())
            turned[name] = float(np.degrees(R_TL.magnitude()))
    points = {name: p_V @ R_WV.as_matrix().T for name, p_V in truth.points.items()}
    off = [sample(pose.time, pose.points[name], time) - sample(truth.time, points[name], time) for name in names]
    apart = np.mean(off, axis=0)[np.isfinite(off).all(axis=(0, 2))] if names else np.empty((0, 3))
    x, y, z = np.median(apart, axis=0).tolist() if len(apart) else (0.0, 0.0, 0.0)
    points = {name: p + (x, y, z) for name, p in points.items()}
    spans = (first, float(fit_end)), (float(fit_end), last)
    registration = Registration(offset_s, correlation, axis, heading, (x, y, z), *spans, turned)
    return replace(truth, quat_WL=quat_WT, points=points), registration


def _is_known(values: np.ndarray | None) -> bool:
    return values is not None and bool(np.isfinite(values).all(axis=1).sum() > 1)


def _sample_both(pose: Pose, truth: Pose, segment: str, time: np.ndarray) -> tuple[Rotation, Rotation]:
    """Sample the orientations of a segment in both at those of the times (n,) [s] at which both are known."""
    ours, theirs = (sample(each.time, each.quat_WL[segment], time) for each in (pose, truth))
    known = np.isfinite(ours + theirs).all(axis=1)
    return Rotation.from_quat(ours[known]), Rotation.from_quat(theirs[known])


def _find_offset(pose: Pose, truth: Pose, fitted: tuple[float, float]) -> tuple[float, float]:
    """Find the offset [s] to add to the reference's times, and the correlation of the speeds at it."""
    ours = _compute_speeds(pose, *fitted)
    theirs = _compute_speeds(truth, float(truth.time[0]), float(truth.time[-1]))
    least = max(SHORTEST_S / STEP_S, 0.5 * ours.shape[1])
    scores = np.array([_correlate(a, b, least) for a, b in zip(ours, theirs, strict=True)])
    weights = np.isfinite(scores)
    score = np.where(weights, scores, 0.0).sum(axis=0) / np.maximum(weights.sum(axis=0), 1)
    best = int(np.argmax(score))
    if score[best] < LEAST_CORRELATION:
        raise BadData(
            f"no offset of the clocks fits in the first {fitted[1] - fitted[0]:.0f} s of the pose: speeds correlate by "
            f"{score[best]:.2f} at best; state it as `time_offset`, or is it another recording?"
        )
    lag = (best - (ours.shape[1] - 1)) * STEP_S  # of ours in theirs
    coarse = fitted[0] - (float(truth.time[0]) + lag)

    def compute_loss(offset: float) -> float:
        """1 less the mean correlation, without the samples' steps."""
        correlations = []
        for a, b in zip(ours, _compute_speeds(truth, fitted[0] - offset, fitted[1] - offset), strict=True):
            n = min(len(a), len(b))
            both = np.isfinite(a[:n]) & np.isfinite(b[:n])
            moved = both.sum() > 2 and min(a[:n][both].std(), b[:n][both].std()) > 0.0
            correlations.append(np.corrcoef(a[:n][both], b[:n][both])[0, 1] if moved else 0.0)
        return 1.0 - float(np.mean(correlations))

    minimum = minimize_scalar(compute_loss, bounds=(coarse - STEP_S, coarse + STEP_S), options={"xatol": 1e-4})
    return float(minimum.x), 1.0 - float(minimum.fun)


def _compute_speeds(pose: Pose, begin: float, end: float) -> np.ndarray:
    """Compute the speeds (k, n) [rad/s] of segments every `STEP_S`; NaN: unknown."""
    grid = begin + STEP_S * np.arange(int((end - begin) / STEP_S) + 1)
    ends = grid - 0.5 * TURN_S, grid + 0.5 * TURN_S
    speeds = []
    for quat in pose.quat_WL.values():
        before, after = (sample(pose.time, quat, time) for time in ends)
        cos = np.abs(np.sum(before * after, axis=1))
        sin = np.linalg.norm(multiply(conjugate(before), after)[:, :3], axis=1)
        speeds.append(2.0 * np.arctan2(sin, cos) / TURN_S)
    return np.array(speeds)


def _correlate(a: np.ndarray, b: np.ndarray, least: float) -> np.ndarray:
    """Correlate a (n,) with b (m,) at all lags (n + m − 1,), over what both know; NaN where that is too little."""
    at_lags = partial(correlate, mode="full", method="fft")
    known = [np.isfinite(x).astype(float) for x in (b, a)]
    centred = [np.nan_to_num(x - np.sum(np.nan_to_num(x)) / max(np.isfinite(x).sum(), 1)) for x in (b, a)]
    power = np.sqrt(np.maximum(at_lags(known[0], centred[1] ** 2) * at_lags(centred[0] ** 2, known[1]), 0.0))
    enough = (at_lags(*known) >= least - 0.5) & (power > max(1e-9 * float(power.max()), 1e-6))
    return np.where(enough, at_lags(*centred) / np.where(enough, power, 1.0), np.nan)


# World -------------------------------------------------------------------------------------------------------------


def _find_world(pose: Pose, truth: Pose, time: np.ndarray, up: str | None, frames: bool) -> tuple[Rotation, str, float]:
    """Find the rotation of the reference's world to W, the axis that is up, and the heading [deg]."""
    cross = np.zeros((3, 3))  # the sum of (what W sees) (what V sees)ᵀ
    for name in pose.quat_WL:
        R_WL, R_VT = _sample_both(pose, truth, name, time)
        if len(R_WL) < 2:
            continue
        if frames:  # turns in the world do not depend on the frame
            n = max(1, round(0.5 / float(np.median(np.diff(time)))))
            turns = [(R[n:] * R[:-n].inv()).as_rotvec() for R in (R_WL, R_VT)]
            cross += turns[0].T @ turns[1] / len(time)
        else:
            cross += np.einsum("nij,nkj->ik", R_WL.as_matrix(), R_VT.as_matrix()) / len(time)
    left, sizes, right = np.linalg.svd(cross)
    if sizes[1] < 1e-6 * max(sizes[0], 1e-300):
        raise BadData("the reference cannot be aligned: in the seconds for that all segments turn about one axis alone")
    full = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    if up is None:
        up = max(AXES, key=lambda axis: float(full[2] @ AXES[axis]))
        if full[2] @ AXES[up] < UPRIGHT:
            raise BadData(
                f"no axis of the reference's world is up: {up} is nearest; where its segments' frames are not ours, "
                "`fit` segments fits them too"
            )
    axis_V = np.asarray(AXES[up])
    across = np.cross(axis_V, AXES["+z"])
    upside_down = np.array([np.pi, 0.0, 0.0]) if axis_V[2] < 0.0 else np.zeros(3)
    R_UV = Rotation.from_rotvec(0.5 * np.pi * across if across.any() else upside_down)
    level = cross @ R_UV.as_matrix().T
    heading = float(np.arctan2(level[1, 0] - level[0, 1], level[0, 0] + level[1, 1]))
    return Rotation.from_euler("z", heading) * R_UV, up, float(np.degrees(heading))


# Sampling --------------------------------------------------------------------------------------------------------


def sample(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return orientations (m, 4), or points (m, 3), of times (m,) [s] at other times (n,), interpolated.

    It is on the rotation, or linear; NaN where no known ones are near.
    """
    good = np.isfinite(values).all(axis=1)
    known, spanned = time[good], _is_spanned(time[good], at)
    sampled = np.full((len(at), values.shape[1]), np.nan)
    if spanned.any():
        sampled[spanned] = interpolate(known, values[good], at[spanned])
    return sampled


def _is_spanned(known: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mask of the times between two known ones that are not far apart, or on one."""
    if len(known) < 2:
        return np.zeros(len(at), dtype=bool)
    after = np.clip(np.searchsorted(known, at - _ROUNDING_S), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, at + _ROUNDING_S, side="right") - 1, 0, len(known) - 1)
    spanned = (known[before] <= at + _ROUNDING_S) & (known[after] >= at - _ROUNDING_S)
    return spanned & (known[after] - known[before] <= max(LONGEST_GAP_S, 2.0 * float(np.median(np.diff(known)))))
