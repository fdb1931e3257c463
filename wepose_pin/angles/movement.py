"""A session's angles for a paper: its repetitions, what each angle comes to in them, and the tables of it.

A table has a row an angle, in degrees; what is not determined is NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl
from scipy.special import stdtrit

from ..body.kinematics import Pose, find_samples
from ..errors import WrongOption, one_of
from ..filters.butterworth import low_pass
from ..recording import Intervals
from ..recording.gaps import find_runs
from ..rotations import unwrap_signs
from .euler import count_turns
from .joints import AUTO, JOINTS, Angles, joint_angles
from .repetitions import PERCENT, MeanCurve, Repetitions, compute_mean_curves, find_repetitions
from .tables import angle_table, compute_summary_std, summarize_joint

MEASURES = {"lowest": "deg", "highest": "deg", "range": "deg", "peak_rate": "deg_s"}  # units in a file
# A longer time step than this many usual ones ends a run: the samples on its two sides are filtered apart.
_LONGEST_STEP = 1.5
_SHORTEST_RUN = 10  # samples; a shorter run is not filtered


@dataclass(frozen=True)
class Movement:
    """The angles of a session, or of the selected time of it."""

    name: str  # of the session
    pose: Pose  # low-passed as the angles are
    angles: Angles
    phases: Mapping[str, Intervals]  # of the recording, as far as they lie in the time of the pose
    repetitions: Repetitions  # found, or marked by a phase
    curves: Mapping[str, tuple[MeanCurve, ...]]  # joint → its three mean curves; empty without repetitions
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
    phase: str | None = None,
    main_angle: str | None = None,
    rising: bool | None = None,
) -> Movement:
    """Compute the angles of a session, find its repetitions and measure them.

    The shoulder's angles are of `sequence`, as in `joint_angles`, and low-passed at `cutoff_hz` (`smooth_pose`; None:
    not). Each interval of `phase` is a repetition; None: they are found by `main_angle` and `rising`, as in
    `find_repetitions`. `WeposeError`: no joint has both of its segments; there is no such angle or phase; a cut-off
    that is not possible.
    """
    if cutoff_hz is not None:
        pose = smooth_pose(pose, cutoff_hz)
    angles = joint_angles(pose, sequence)
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 0.0
    begin, end = pose.time[0] - step, pose.time[-1] + step
    inside = {each: tuple((a, b) for a, b in spans if a > begin and b < end) for each, spans in phases.items()}
    if phase is None:
        repetitions = find_repetitions(angles, main_angle, rising)
    elif phases.get(phase):
        reason = "" if inside[phase] else f"no interval of the phase {phase} lies in the selected time"
        repetitions = Repetitions(np.array(inside[phase], dtype=float).reshape(-1, 2), phase, reason=reason)
    else:
        choices = one_of(phases, phase) if phases else "it has no phases; without --repetitions they are found"
        raise WrongOption("repetitions", phase, f"the recording has no such phase; {choices}")
    curves = compute_mean_curves(angles, repetitions.spans) if len(repetitions.spans) else {}
    return Movement(name, pose, angles, inside, repetitions, curves, cutoff_hz)


def smooth_pose(pose: Pose, cutoff_hz: float) -> Pose:
    """Return the pose with orientations low-passed by a Butterworth filter of second order, forwards and backwards.

    Nothing is delayed; at `cutoff_hz` the two passes together halve the amplitude (−6 dB). Filtered are the components
    of the quaternions, which are normalised afterwards. Points, covariances and gaps stay.
    """
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 1.0
    if not 0.0 < cutoff_hz < 0.45 / step:
        raise WrongOption("low-pass-hz", f"{cutoff_hz:g}", f"above 0 and below {0.45 / step:.3g} Hz is needed here")
    gaps = 1 + np.flatnonzero(np.diff(pose.time) >= _LONGEST_STEP * step)
    quat_WL = {}
    for segment, quat in pose.quat_WL.items():
        smooth = quat.copy()
        known = np.isfinite(quat).all(axis=1)
        for start, stop in zip([0, *gaps], [*gaps, len(quat)], strict=True):
            for a, b in find_runs(known[start:stop]):
                run = slice(start + a, start + b)
                if b - a >= _SHORTEST_RUN:
                    filtered = low_pass(unwrap_signs(quat[run]), cutoff_hz, 1.0 / step)
                    smooth[run] = filtered / np.linalg.norm(filtered, axis=1, keepdims=True)
        quat_WL[segment] = smooth
    return replace(pose, quat_WL=quat_WL, q=None)


# Tables ------------------------------------------------------------------------------------------------------------


def build_tables(movements: Sequence[Movement]) -> dict[str, pl.DataFrame]:
    """Build all tables, by the names of their files; one without rows is empty."""
    angles = [angle_table(each.angles).select(pl.lit(each.name).alias("session"), pl.all()) for each in movements]
    repeating = [each for each in movements if len(each.repetitions.spans)]
    repetitions = _concat([_tabulate_spans(each, _list_repetitions(each)) for each in repeating])
    summary = build_summary_table(movements, repetitions)
    return {
        "angles": pl.concat(angles, how="diagonal"),
        "sessions": build_session_table(movements),
        "repetitions": repetitions,
        "phases": _concat([_tabulate_spans(each, _list_phases(each)) for each in movements]),
        "summary": summary,
        "curves": build_curve_table(movements),
        "comparison": build_comparison_table(summary),
    }


def _concat(tables: Sequence[pl.DataFrame]) -> pl.DataFrame:
    return pl.concat(tables) if tables else pl.DataFrame()


def build_session_table(movements: Sequence[Movement]) -> pl.DataFrame:
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


def _list_phases(movement: Movement) -> list[dict[str, Any]]:
    """List all of the selected time, and each interval of a phase that lies in it."""
    time = movement.angles.time
    about = [{"phase": "all", "number": 1, "from_s": float(time[0]), "to_s": float(time[-1])}]
    for name, spans in movement.phases.items():
        about += [{"phase": name, "number": k, "from_s": a, "to_s": b} for k, (a, b) in enumerate(spans, 1)]
    return about


def _list_repetitions(movement: Movement) -> list[dict[str, Any]]:
    return [
        {"repetition": k, "from_s": begin, "to_s": end, "duration_s": end - begin}
        for k, (begin, end) in enumerate(movement.repetitions.spans.tolist(), 1)
    ]


def _tabulate_spans(movement: Movement, about: Sequence[Mapping[str, Any]]) -> pl.DataFrame:
    """Build a row an angle in each span, both ends included: what is known of it, `MEASURES`, each with its ±."""
    pose, rows = movement.pose, [list[dict[str, Any]]() for _ in about]
    parts = [find_samples(pose.time, (span["from_s"], span["to_s"])) for span in about]
    for name, joint in movement.angles.joints.items():
        summaries = [summarize_joint(pose.time, joint, part) for part in parts]
        values = np.array([np.column_stack([s.lowest, s.highest, s.range, s.peak_rate]) for s in summaries])
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


def build_summary_table(movements: Sequence[Movement], repetitions: pl.DataFrame) -> pl.DataFrame:
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
    table = repetitions.group_by(*names, maintain_order=True).agg(columns).fill_null(float("nan"))
    return table.join(pl.DataFrame(cmc), on=names[:3], maintain_order="left")


def build_curve_table(movements: Sequence[Movement]) -> pl.DataFrame:
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


def build_comparison_table(summary: pl.DataFrame) -> pl.DataFrame:
    """Compare each further session with the first, a row a measure of each angle that both have."""
    sessions = summary["session"].unique(maintain_order=True).to_list() if len(summary) else []
    rows: list[dict[str, Any]] = []
    for session in sessions[1:]:
        against, further = (summary.filter(pl.col("session") == each) for each in (sessions[0], session))
        for row in against.join(further, on=("joint", "angle"), maintain_order="left").iter_rows(named=True):
            about = {"session": session, "against": sessions[0], "joint": row["joint"], "angle": row["angle"]}
            for measure, unit in MEASURES.items():
                parts = ("n", f"mean_{unit}", f"sd_{unit}", f"std_{unit}")
                n, mean, sd, std = ([row[f"{measure}_{part}{end}"] for end in ("", "_right")] for part in parts)
                low, high = compute_interval((n[0], mean[0], sd[0]), (n[1], mean[1], sd[1]))
                values = {"first_n": n[0], "n": n[1], "first_mean": mean[0], "first_sd": sd[0], "mean": mean[1]}
                values |= {"sd": sd[1], "difference": mean[1] - mean[0], "ci95_low": low, "ci95_high": high}
                values["difference_std"] = float(np.hypot(*std))
                rows.append({**about, "measure": measure, "unit": unit.replace("_", "/"), **values})
    return pl.DataFrame(rows)


def compute_interval(first: tuple[int, float, float], second: tuple[int, float, float]) -> tuple[float, float]:
    """Compute the 95 % interval (Welch 1947) of a difference of means, by n, mean and standard deviation of each.

    It is from the spread of the values alone; NaN where there are fewer than two of either.
    """
    value = second[1] - first[1]
    if min(first[0], second[0]) < 2:
        return float("nan"), float("nan")
    a, b = first[2] ** 2 / first[0], second[2] ** 2 / second[0]
    half = 0.0
    if a + b > 0.0:
        freedom = (a + b) ** 2 / (a**2 / (first[0] - 1) + b**2 / (second[0] - 1))
        half = float(stdtrit(freedom, 0.975) * np.sqrt(a + b))
    return value - half, value + half
