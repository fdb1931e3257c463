"""A session's angles for a paper: its repetitions, what each angle comes to in them, and the tables of it.

A table has a row an angle, in degrees; what is not determined is NaN.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..body.kinematics import Pose, find_samples
from ..errors import WrongOption, one_of
from ..filters.butterworth import low_pass
from ..recording import Intervals, find_runs
from ..rotations import unwrap_signs
from .euler import count_turns
from .joints import AUTO, JOINTS, Angles, JointAngles, compute_gradients, joint_angles
from .repetitions import PERCENT, MeanCurve, Repetitions, compute_mean_curves, find_repetitions, list_angles

# Rates are means over this time [s], to the nearest whole number of samples: noise of the orientation is divided by it,
# and a sine of 2 Hz reads 1.6% low, one of 5 Hz 10%.
RATE_WINDOW_S = 0.05
MEASURES = {"lowest": "deg", "highest": "deg", "range": "deg", "peak_rate": "deg_s"}  # units in a file
_SHORTEST_RUN = 10  # samples; a shorter run is not low-passed


@dataclass(frozen=True)
class Movement:
    """The angles of a session, or of the selected time of it."""

    name: str  # of the session
    pose: Pose  # low-passed as the angles are
    angles: Angles
    phases: Mapping[str, Intervals]  # of the recording, as far as they lie in the time of the pose
    repetitions: Repetitions  # found, or marked by a phase
    curves: Mapping[str, tuple[MeanCurve, ...]]  # joint → its three mean curves; empty of fewer than two repetitions
    cutoff_hz: float | None  # of the low-pass; None: there is none

    @property
    def sequence(self) -> str:
        """That of the shoulder's angles; empty: there is none."""
        return next((each.sequence for name, each in self.angles.joints.items() if not JOINTS[name].sequence), "")


def analyze_movement(
    name: str,
    pose: Pose,
    phases: Mapping[str, Intervals],
    *,
    sequence: str = AUTO,
    cutoff_hz: float | None = None,
    repetitions: str | None = None,
    rising: bool | None = None,
) -> Movement:
    """Compute the angles of a session, find its repetitions and measure them.

    The shoulder's angles are of `sequence`, as in `joint_angles`, and low-passed at `cutoff_hz` (`smooth_pose`; None:
    not). `repetitions` names a phase, each interval of which is one, or the angle by which they are found; None, and
    `rising`: as in `find_repetitions`. `WeposeError`: no joint has both of its segments; there is no such angle or
    phase; a cut-off that is not possible.
    """
    if cutoff_hz is not None:
        pose = smooth_pose(pose, cutoff_hz)
    angles = joint_angles(pose, sequence)
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 0.0
    begin, end = pose.time[0] - step, pose.time[-1] + step
    inside = {each: tuple((a, b) for a, b in spans if a > begin and b < end) for each, spans in phases.items()}
    if repetitions is not None and phases.get(repetitions):
        marked = inside[repetitions]
        reason = "" if marked else f"no interval of the phase {repetitions} lies in the selected time"
        occurrences = Repetitions(np.array(marked, dtype=float).reshape(-1, 2), repetitions, reason=reason)
    elif repetitions in (None, *(places := list_angles(angles))):
        occurrences = find_repetitions(angles, repetitions, rising)
    else:
        choices = one_of((*phases, *places), repetitions, 30)
        raise WrongOption("repetitions", repetitions, f"no such phase of the recording, and no such angle; {choices}")
    curves = compute_mean_curves(angles, occurrences.spans) if len(occurrences.spans) > 1 else {}
    return Movement(name, pose, angles, inside, occurrences, curves, cutoff_hz)


def smooth_pose(pose: Pose, cutoff_hz: float) -> Pose:
    """Return the pose with orientations low-passed by a Butterworth filter of second order, forwards and backwards.

    Nothing is delayed; at `cutoff_hz` the two passes together halve the amplitude (−6 dB). Filtered are the components
    of the quaternions, which are normalised afterwards. Points, covariances and gaps stay.
    """
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 1.0
    if not 0.0 < cutoff_hz < 0.45 / step:
        raise WrongOption("low_pass_hz", f"{cutoff_hz:g}", f"above 0 and below {0.45 / step:.3g} Hz is needed here")
    quat_WL = {segment: quat.copy() for segment, quat in pose.quat_WL.items()}
    for quat in quat_WL.values():
        for a, b in find_runs(np.isfinite(quat).all(axis=1)):
            if b - a >= _SHORTEST_RUN:
                filtered = low_pass(unwrap_signs(quat[a:b]), cutoff_hz, 1.0 / step)
                quat[a:b] = filtered / np.linalg.norm(filtered, axis=1, keepdims=True)
    return replace(pose, quat_WL=quat_WL, q=None)


# Range of motion and peak rates ---------------------------------------------------------------------------------------


class JointSummary(NamedTuple):
    """One joint over a recording; the three angles in the order of its `names`. NaN where no sample is left.

    Gaps count nowhere; what is near the lock counts in the lowest and highest of the second angle.
    """

    lowest: np.ndarray  # (3,) [rad]
    highest: np.ndarray  # (3,) [rad]
    peak_rate: np.ndarray  # (3,) [rad/s], the greatest absolute rate of the angle over `RATE_WINDOW_S`
    near_lock: float  # share of the samples
    gap: float  # share of the samples
    samples: np.ndarray  # (3, 4) int: of the lowest, the highest, begin and end of the fastest; −1 where there is none

    @property
    def range(self) -> np.ndarray:
        """Range of motion (3,) [rad]; there is no more than a full turn of it."""
        return np.minimum(self.highest - self.lowest, 2.0 * np.pi)


def summary(angles: Angles) -> dict[str, JointSummary]:
    """Range of motion and peak rates of every joint."""
    return {name: summarize_joint(angles.time, joint) for name, joint in angles.joints.items()}


def summarize_joint(time: np.ndarray, joint: JointAngles, part: slice = slice(None)) -> JointSummary:
    """Range of motion and peak rates of one joint in a part of the samples; `time` (n,) [s]."""
    time, values, gap, near_lock = time[part], joint.values[part], joint.gap[part], joint.near_lock[part]
    start = part.start or 0
    m = max(1, round(RATE_WINDOW_S / float(np.median(np.diff(time))))) if len(time) > 1 else 1
    span = time[m:] - time[:-m]
    lowest, highest, peak_rate = np.full((3, 3), np.nan)
    samples = np.full((3, 4), -1)
    bad = np.concatenate([[0], np.cumsum(gap | near_lock)])
    sound = np.flatnonzero(bad[m + 1 :] == bad[: -m - 1])  # none of the samples k … k + m is bad
    for k in range(3):
        usable = np.flatnonzero(~joint.hidden(k)[part])
        if len(usable):
            ends = usable[[values[usable, k].argmin(), values[usable, k].argmax()]]
            lowest[k], highest[k] = values[ends, k]
            samples[k, :2] = start + ends
        if len(sound):
            rates = np.abs(values[m:, k] - values[:-m, k])[sound] / span[sound]
            first = start + sound[rates.argmax()]
            samples[k, 2:] = first, first + m
            peak_rate[k] = rates.max()
    return JointSummary(lowest, highest, peak_rate, float(np.mean(near_lock)), float(np.mean(gap)), samples)


def compute_summary_std(pose: Pose, name: str, joint: JointAngles, samples: np.ndarray) -> np.ndarray:
    """Compute the standard deviations of a joint's summaries, to first order; NaN where nothing is stated.

    A range and a rate are of two samples. Their error is taken once as constant in W, as that of a heading, and once as
    constant in each segment, as that of a mount; the larger standard deviation of the two counts. `samples` (s, 3, 4)
    are those of `JointSummary` for each of s spans; of the same shape are the results: of the lowest, the highest and
    the range [rad], and of the peak rate [rad/s].
    """
    stds = np.full(samples.shape, np.nan)
    if joint.std is None:
        return stds
    for k in range(3):
        for column, ends in ((2, slice(0, 2)), (3, slice(2, 4))):
            known = np.flatnonzero(samples[:, k, ends.start] >= 0)
            pairs = samples[known, k, ends]
            stds[known, k, column] = _difference_std(pose, name, joint, k, pairs)
            if column == 2:
                stds[known, k, :2] = joint.std[pairs, k]
            else:
                stds[known, k, 3] /= pose.time[pairs[:, 1]] - pose.time[pairs[:, 0]]
    return stds


def _difference_std(pose: Pose, name: str, joint: JointAngles, k: int, pairs: np.ndarray) -> np.ndarray:
    """Standard deviations (m,) [rad] of the k-th angle at the second sample of each pair (m, 2) less the first."""
    rows = compute_gradients(pose, name, joint, pairs.ravel())[:, k].reshape(-1, 2, 1, 3)
    variances = np.zeros((2, len(pairs)))  # constant in W, in L
    # A common heading error does not rotate the joint.
    shared = pose.find_heading_cov(JOINTS[name].proximal, JOINTS[name].distal)[pairs]
    for segment in (JOINTS[name].proximal, JOINTS[name].distal):
        if segment == "world" or not len(pairs):
            continue
        cov_W = pose.segment_cov[segment][pairs]
        cov_W[..., 2, 2] -= np.minimum(shared, cov_W[..., 2, 2])
        R_WL = Rotation.from_quat(pose.quat_WL[segment][pairs.ravel()]).as_matrix().reshape(-1, 2, 3, 3)
        frames = (rows, cov_W), (rows @ R_WL, np.swapaxes(R_WL, 2, 3) @ cov_W @ R_WL)
        for variance, (gradient, cov) in zip(variances, frames, strict=True):
            difference = gradient[:, 1] - gradient[:, 0]
            variance += (difference @ cov.mean(axis=1) @ np.swapaxes(difference, 1, 2))[:, 0, 0]
    return np.asarray(np.sqrt(np.maximum(variances.max(axis=0), 0.0)))


# Tables ---------------------------------------------------------------------------------------------------------------


def angle_table(angles: Angles) -> pl.DataFrame:
    """The columns of a file.

    ``time`` [s]; for each joint ``<joint>_<angle>_deg`` of its three angles, such as ``right_elbow_flexion_deg``, and
    ``<joint>_<angle>_std_deg`` where known; ``<joint>_gimbal_deg``, ``<joint>_near_lock``, ``<joint>_gap``; and the
    rotation itself, ``<joint>_qx,_qy,_qz,_qw``.
    """
    table = {"time": angles.time}
    for name, joint in angles.joints.items():
        for k, angle in enumerate(joint.names):
            table[f"{name}_{angle}_deg"] = np.degrees(joint.values[:, k])
            if joint.std is not None:
                table[f"{name}_{angle}_std_deg"] = np.degrees(joint.std[:, k])
        table[f"{name}_gimbal_deg"] = np.degrees(joint.gimbal)
        table[f"{name}_near_lock"] = joint.near_lock
        table[f"{name}_gap"] = joint.gap
        table |= {f"{name}_{c}": joint.quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
    return pl.DataFrame(table)


def build_tables(movements: Sequence[Movement]) -> dict[str, pl.DataFrame]:
    """Build all tables, by the names of their files; one without rows is empty."""
    angles = [angle_table(each.angles).select(pl.lit(each.name).alias("session"), pl.all()) for each in movements]
    repetitions, phases = [], []
    for movement in movements:
        spans = enumerate(movement.repetitions.spans.tolist(), 1)
        about = [{"repetition": k, "from_s": a, "to_s": b, "duration_s": b - a} for k, (a, b) in spans]
        repetitions += [_tabulate_spans(movement, about)] if about else []
        selected = movement.angles.time[[0, -1]].tolist()
        named = [(name, *each) for name, spans in movement.phases.items() for each in enumerate(spans, 1)]
        listed = [("all", 1, selected), *named]
        about = [{"phase": name, "number": k, "from_s": a, "to_s": b} for name, k, (a, b) in listed]
        phases.append(_tabulate_spans(movement, about))
    return {
        "angles": pl.concat(angles, how="diagonal"),
        "sessions": _tabulate_sessions(movements),
        "repetitions": _concat(repetitions),
        "phases": _concat(phases),
        "summary": _summarize_repetitions(movements, _concat(repetitions)),
        "curves": _tabulate_curves(movements),
    }


def _concat(tables: Sequence[pl.DataFrame]) -> pl.DataFrame:
    return pl.concat(tables) if tables else pl.DataFrame()


def _tabulate_sessions(movements: Sequence[Movement]) -> pl.DataFrame:
    """Build a row a session: its time, how repetitions were found, their number and duration."""
    rows = []
    for movement in movements:
        time, repetitions = movement.angles.time, movement.repetitions
        seconds = np.diff(repetitions.spans, axis=1)
        rows.append(
            {
                "session": movement.name,
                "from_s": float(time[0]),
                "to_s": float(time[-1]),
                "low_pass_hz": movement.cutoff_hz,
                "repetitions_by": repetitions.source,
                "first": {None: "", True: "rising", False: "falling"}[repetitions.rising],
                "n": len(repetitions.spans),
                "duration_mean_s": float(seconds.mean()) if len(seconds) else float("nan"),
                "duration_sd_s": float(seconds.std(ddof=1)) if len(seconds) > 1 else float("nan"),
                "cmc": repetitions.cmc,
                "left_out": repetitions.left_out,
                "why_none": repetitions.reason,
            }
        )
    return pl.DataFrame(rows, schema_overrides={"low_pass_hz": pl.Float64})


def _tabulate_spans(movement: Movement, about: Sequence[Mapping[str, Any]]) -> pl.DataFrame:
    """Build a row an angle in each span, both ends included: what is known of it, `MEASURES`, each with its ±."""
    pose, rows = movement.pose, [list[dict[str, Any]]() for _ in about]
    parts = [find_samples(pose.time, (span["from_s"], span["to_s"])) for span in about]
    for name, joint in movement.angles.joints.items():
        summaries = [summarize_joint(pose.time, joint, part) for part in parts]
        values = np.array([np.column_stack([getattr(each, measure) for measure in MEASURES]) for each in summaries])
        values[:, :, :2] -= count_turns(values[:, :, :2].mean(axis=2))[:, :, None]
        stds = compute_summary_std(pose, name, joint, np.array([each.samples for each in summaries]))
        degrees = np.degrees(values), np.degrees(stds)
        for own, span, summary, value, std in zip(rows, about, summaries, *degrees, strict=True):
            for k, angle in enumerate(joint.names):
                row = {"session": movement.name, **span, "joint": name, "angle": angle, "sequence": joint.sequence}
                for m, (measure, unit) in enumerate(MEASURES.items()):
                    row |= {f"{measure}_{unit}": value[k, m], f"{measure}_std_{unit}": std[k, m]}
                own.append({**row, "near_lock": summary.near_lock, "gap": summary.gap})
    return pl.DataFrame([row for own in rows for row in own])


def _summarize_repetitions(movements: Sequence[Movement], repetitions: pl.DataFrame) -> pl.DataFrame:
    """Build a row an angle of each session: mean and deviation over repetitions, what is stated, and the CMC."""
    if not len(repetitions):
        return pl.DataFrame()
    columns = [pl.len().alias("repetitions")]
    for measure, unit in MEASURES.items():
        value = pl.col(f"{measure}_{unit}").fill_nan(None)
        std = pl.col(f"{measure}_std_{unit}").fill_nan(None).filter(value.is_not_null())
        columns.append(value.count().alias(f"{measure}_n"))
        columns += [value.mean().alias(f"{measure}_mean_{unit}"), value.std().alias(f"{measure}_sd_{unit}")]
        columns.append(std.pow(2).mean().sqrt().alias(f"{measure}_std_{unit}"))
    names = ("session", "joint", "angle", "sequence")
    cmc = [
        {"session": movement.name, "joint": joint, "angle": angle, "cmc": curve.cmc}
        for movement in movements
        for joint, curves in movement.curves.items()
        for angle, curve in zip(movement.angles[joint].names, curves, strict=True)
    ]
    table = repetitions.group_by(*names, maintain_order=True).agg(columns)
    schema = {**dict.fromkeys(names[:3], pl.String), "cmc": pl.Float64}
    table = table.join(pl.DataFrame(cmc, schema), on=names[:3], how="left", maintain_order="left")
    return table.fill_null(float("nan"))


def _tabulate_curves(movements: Sequence[Movement]) -> pl.DataFrame:
    """Build a row a percent of the repetition of each angle and session."""
    tables = []
    for movement in movements:
        for name, curves in movement.curves.items():
            for angle, curve in zip(movement.angles[name].names, curves, strict=True):
                about = {"session": movement.name, "joint": name, "angle": angle}
                degrees = {f"{part}_deg": np.degrees(getattr(curve, part)) for part in ("mean", "sd", "std")}
                table = pl.DataFrame({"percent": PERCENT, "n": curve.n} | degrees)
                tables.append(table.select(*(pl.lit(text).alias(key) for key, text in about.items()), pl.all()))
    return _concat(tables)
