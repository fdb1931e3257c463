"""The tables of `Movement`: a row an angle, in degrees; what is not determined is NaN."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from scipy.special import stdtrit

from .curves import PERCENT
from .joints import JOINTS, SHOULDER_SEQUENCES, describe_joint, group_sides
from .movement import MEASURES, Movement, measure_spans
from .tables import angle_table

SOURCE = (
    "Wu et al. 2005 (J Biomech 38:981-992) for thorax, shoulder, elbow and wrist, "
    "Wu et al. 2002 (J Biomech 35:543-548) for pelvis, hip and ankle, "
    "Grood and Suntay 1983 (J Biomech Eng 105:136-144) for the knee"
)


def build_definition_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """What each angle is: sequence, axis, where it is positive, and the source; left and right alike."""
    rows: dict[tuple[str, ...], None] = {}
    for movement in movements:
        for group, members in group_sides(movement.angles.joints).items():
            name = next(iter(members.values()))
            joint, rotation = movement.angles[name], describe_joint(name)
            positive = JOINTS[name].angles or SHOULDER_SEQUENCES[joint.sequence]
            for axis, angle in zip(joint.sequence, joint.names, strict=True):
                rows[group, rotation, joint.sequence, axis, angle, positive[angle], SOURCE] = None
    names = ["joint", "rotation", "sequence", "axis", "angle", "positive", "source"]
    return pl.DataFrame(list(rows), schema=names, orient="row")


def build_angle_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row a sample of each session: its angles as `angle_table` has them."""
    tables = [angle_table(each.angles).select(pl.lit(each.name).alias("session"), pl.all()) for each in movements]
    return pl.concat(tables, how="diagonal")


def build_session_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row a session: its time, how repetitions were found, their number and duration."""
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


def build_phase_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle in all of the selected time, and in each interval of a phase that lies in it."""
    tables = []
    for movement in movements:
        time = movement.angles.time
        parts = [("all", 1, (float(time[0]), float(time[-1])))]
        parts += [(name, k, span) for name, spans in movement.phases.items() for k, span in enumerate(spans, 1)]
        about = [
            {"session": movement.name, "phase": name, "number": k, "from_s": begin, "to_s": end}
            for name, k, (begin, end) in parts
        ]
        measures = measure_spans(movement.pose, movement.angles, [span for _, _, span in parts])
        tables.append(_put_first(about, measures))
    return pl.concat(tables)


def build_repetition_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle in each repetition."""
    tables = []
    for movement in (movement for movement in movements if len(movement.measures)):
        about = [
            {
                **{"session": movement.name, "repetition": k, "from_s": begin, "to_s": end},
                "duration_s": end - begin,
            }
            for k, (begin, end) in enumerate(movement.repetitions.spans.tolist(), 1)
        ]
        tables.append(_put_first(about, movement.measures))
    return pl.concat(tables) if tables else pl.DataFrame()


def _put_first(about: Sequence[Mapping[str, Any]], measures: pl.DataFrame) -> pl.DataFrame:
    """Put what is known of each span before its measures."""
    spans = pl.DataFrame(about).with_row_index("span").cast({"span": pl.Int64})
    return spans.join(measures, on="span", maintain_order="left_right").drop("span")


def build_summary_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle of each session: mean and standard deviation over repetitions, what is stated, and the CMC."""
    repetitions = build_repetition_table(movements)
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
    """A row a percent of the repetition of each angle and session."""
    tables = []
    for movement in movements:
        for name, curves in movement.curves.items():
            for angle, curve in zip(movement.angles[name].names, curves, strict=True):
                about = {"session": movement.name, "joint": name, "angle": angle}
                columns = {key: pl.Series([text]).new_from_index(0, len(PERCENT)) for key, text in about.items()}
                columns |= {"percent": pl.Series(PERCENT), "n": pl.Series(curve.n)}
                columns |= {
                    f"{part}_deg": pl.Series(np.degrees(getattr(curve, part))) for part in ("mean", "sd", "std")
                }
                tables.append(pl.DataFrame(columns))
    return pl.concat(tables) if tables else pl.DataFrame()


def build_comparison_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """Each further session against the first, a row a measure of each angle that both have."""
    summary = build_summary_table(movements)
    sessions = summary["session"].unique(maintain_order=True).to_list() if len(summary) else []
    rows: list[dict[str, Any]] = []
    for session in sessions[1:]:
        against, further = (summary.filter(pl.col("session") == each) for each in (sessions[0], session))
        for row in against.join(further, on=("joint", "angle"), maintain_order="left").iter_rows(named=True):
            # Angles of a session may be a full turn on.
            shift = sum(row[f"{end}_mean_deg_right"] - row[f"{end}_mean_deg"] for end in ("lowest", "highest"))
            turns = float(np.nan_to_num(360.0 * np.round(0.5 * shift / 360.0)))
            for measure, unit in MEASURES.items():
                parts = ("n", f"mean_{unit}", f"sd_{unit}", f"std_{unit}")
                first = [row[f"{measure}_{part}"] for part in parts]
                second = [row[f"{measure}_{part}_right"] for part in parts]
                second[1] -= turns if measure in ("lowest", "highest") else 0.0
                low, high = compute_interval((first[0], first[1], first[2]), (second[0], second[1], second[2]))
                rows.append(
                    {
                        **{"session": session, "against": sessions[0], "joint": row["joint"], "angle": row["angle"]},
                        **{"measure": measure, "unit": unit.replace("_", "/"), "first_n": first[0], "n": second[0]},
                        **{"first_mean": first[1], "first_sd": first[2], "mean": second[1], "sd": second[2]},
                        **{"difference": second[1] - first[1], "ci95_low": low, "ci95_high": high},
                        "difference_std": float(np.hypot(first[3], second[3])),
                    }
                )
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
