"""The tables of `Movement`: a row an angle, in degrees; what is not determined is NaN."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from .curves import PERCENT
from .joints import Angles, group_sides
from .movement import MEASURES, JointMeasures, Movement, compare_measures, measure_spans
from .tables import angle_table

SOURCE = (
    "Wu et al. 2005 (J Biomech 38:981-992) for thorax, shoulder, elbow and wrist, "
    "Wu et al. 2002 (J Biomech 35:543-548) for pelvis, hip and ankle, "
    "Grood and Suntay 1983 (J Biomech Eng 105:136-144) for the knee"
)

# Joint without its side → the distal segment in the proximal one.
ROTATIONS = {
    "thorax": "thorax in W",
    "shoulder": "upper arm in thorax",
    "elbow": "forearm in upper arm",
    "wrist": "hand in forearm",
    "pelvis_in_world": "pelvis in W",
    "hip": "thigh in pelvis",
    "knee": "shank in thigh",
    "ankle": "foot in shank",
}
# Joint without its side and angle → where the angle is positive.
POSITIVE = {
    ("thorax", "extension"): "leaning back (a bow is negative)",
    ("thorax", "lateral_flexion_right"): "leaning to the right",
    ("thorax", "axial_rotation_left"): "turned to the left",
    ("shoulder", "plane_of_elevation"): "0° out to the side, 90° forward, −90° backward",
    ("shoulder", "elevation"): "on the far side of the plane of elevation; −90° is horizontal in that plane",
    ("shoulder", "internal_rotation"): "inward",
    ("shoulder", "adduction"): "arm towards the body (abduction is negative)",
    ("shoulder", "flexion"): "arm forward",
    ("elbow", "flexion"): "bent",
    ("elbow", "carrying_angle"): "forearm towards the body; the carrying angle of a straight arm is negative",
    ("elbow", "pronation"): "0° palm forward (supinated), 90° thumb forward, 180° palm back",
    ("wrist", "flexion"): "towards the palm",
    ("wrist", "ulnar_deviation"): "towards the little finger",
    ("wrist", "pronation"): "as in the forearm",
    ("pelvis_in_world", "posterior_tilt"): "tilted back (an anterior tilt is negative)",
    ("pelvis_in_world", "obliquity_right_down"): "the right side down",
    ("pelvis_in_world", "axial_rotation_left"): "turned to the left",
    ("hip", "flexion"): "thigh forward",
    ("hip", "adduction"): "thigh towards the other (abduction is negative)",
    ("hip", "internal_rotation"): "inward",
    ("knee", "flexion"): "bent",
    ("knee", "adduction"): "ankle towards the other (bow legs, varus)",
    ("knee", "external_rotation"): "toes outward",
    ("ankle", "dorsiflexion"): "toes up (plantar flexion is negative)",
    ("ankle", "inversion"): "sole inward",
    ("ankle", "internal_rotation"): "toes inward",
}


class Definition(NamedTuple):
    """One angle of the joints of a group, left and right alike."""

    group: str  # the joint without its side
    rotation: str  # as "forearm in upper arm"
    sequence: str
    axis: str  # of the sequence
    angle: str
    positive: str


def define_angles(sessions: Iterable[Angles]) -> list[Definition]:
    """Return the definition of each angle that there is in a session, once."""
    definitions: dict[Definition, None] = {}
    for angles in sessions:
        for group, members in group_sides(angles.joints).items():
            joint = angles[next(iter(members.values()))]
            for axis, name in zip(joint.sequence, joint.names, strict=True):
                definition = Definition(group, ROTATIONS[group], joint.sequence, axis, name, POSITIVE[group, name])
                definitions[definition] = None
    return list(definitions)


def build_definition_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """What each angle is: sequence, axis, where it is positive, and the source."""
    definitions = define_angles(movement.angles for movement in movements)
    return pl.DataFrame([{**each._asdict(), "source": SOURCE} for each in definitions]).rename({"group": "joint"})


def build_angle_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row a sample of each session: its angles as `angle_table` has them."""
    tables = [angle_table(each.angles).select(pl.lit(each.name).alias("session"), pl.all()) for each in movements]
    return pl.concat(tables, how="diagonal")


def build_session_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row a session: its time, how repetitions were found, their number and duration."""
    rows = []
    for movement in movements:
        time, repetitions = movement.angles.time, movement.repetitions
        rows.append(
            {
                "session": movement.name,
                "from_s": float(time[0]),
                "to_s": float(time[-1]),
                "low_pass_hz": movement.cutoff_hz,
                "repetitions_by": repetitions.source,
                "first": {None: "", True: "rising", False: "falling"}[repetitions.rising],
                "n": len(repetitions.spans),
                "duration_mean_s": movement.duration.mean,
                "duration_sd_s": movement.duration.sd,
                "cmc": repetitions.cmc,
                "left_out": repetitions.left_out,
                "why_none": repetitions.reason,
            }
        )
    return pl.DataFrame(rows, schema_overrides={"low_pass_hz": pl.Float64})


def build_phase_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle in all of the selected time, and in each interval of a phase that lies in it."""
    rows: list[dict[str, Any]] = []
    for movement in movements:
        time = movement.angles.time
        parts = [("all", 1, (float(time[0]), float(time[-1])))]
        parts += [(name, k, span) for name, spans in movement.phases.items() for k, span in enumerate(spans, 1)]
        measures = measure_spans(movement.pose, movement.angles, [span for _, _, span in parts])
        for row, (name, k, (begin, end)) in enumerate(parts):
            about = {"session": movement.name, "phase": name, "number": k, "from_s": begin, "to_s": end}
            rows += [{**about, **angle} for angle in _list_measures(movement, measures, row)]
    return pl.DataFrame(rows)


def build_repetition_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle in each repetition."""
    rows: list[dict[str, Any]] = []
    for movement in movements:
        for row, (begin, end) in enumerate(movement.repetitions.spans.tolist()):
            about = {"session": movement.name, "repetition": row + 1, "from_s": begin, "to_s": end}
            about["duration_s"] = end - begin
            rows += [{**about, **angle} for angle in _list_measures(movement, movement.measures, row)]
    return pl.DataFrame(rows)


def _list_measures(movement: Movement, measures: Mapping[str, JointMeasures], row: int) -> Iterator[dict[str, Any]]:
    for name, joint in movement.angles.joints.items():
        joint_measures = measures[name]
        for k, angle in enumerate(joint.names):
            cells: dict[str, Any] = {"joint": name, "angle": angle, "sequence": joint.sequence}
            values, stds = np.degrees(joint_measures.values[row, k]), np.degrees(joint_measures.std[row, k])
            for (measure, unit), value, std in zip(MEASURES.items(), values.tolist(), stds.tolist(), strict=True):
                cells |= {f"{measure}_{unit}": value, f"{measure}_std_{unit}": std}
            yield {**cells, "near_lock": float(joint_measures.near_lock[row]), "gap": float(joint_measures.gap[row])}


def build_summary_table(movements: Sequence[Movement]) -> pl.DataFrame:
    """A row an angle of each session: mean and standard deviation over repetitions, what is stated, and the CMC."""
    rows = []
    for movement in (movement for movement in movements if movement.curves):
        for name, joint in movement.angles.joints.items():
            for k, angle in enumerate(joint.names):
                cells: dict[str, Any] = {"session": movement.name, "joint": name, "angle": angle}
                cells |= {"sequence": joint.sequence, "repetitions": len(movement.repetitions.spans)}
                for (measure, unit), each in zip(MEASURES.items(), movement.measures[name].statistics(k), strict=True):
                    cells |= {f"{measure}_n": each.n} if measure in ("range", "peak_rate") else {}
                    for part in ("mean", "sd", "std"):
                        cells[f"{measure}_{part}_{unit}"] = float(np.degrees(getattr(each, part)))
                rows.append({**cells, "cmc": movement.curves[name][k].cmc})
    return pl.DataFrame(rows)


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
    rows: list[dict[str, Any]] = []
    repeated = [movement for movement in movements if movement.curves]
    for movement in repeated[1:]:
        first = repeated[0]
        for name in (name for name in first.curves if name in movement.curves):
            for k, angle in enumerate(first.angles[name].names):
                about = {"session": movement.name, "against": first.name, "joint": name, "angle": angle}
                compared = compare_measures(first.measures[name], movement.measures[name], k)
                for (measure, unit), (one, two, difference) in zip(MEASURES.items(), compared, strict=True):
                    numbers = {"first_mean": one.mean, "first_sd": one.sd, "mean": two.mean, "sd": two.sd}
                    numbers |= {"difference": difference.value, "ci95_low": difference.low}
                    numbers |= {"ci95_high": difference.high, "difference_std": difference.std}
                    about_n = {"measure": measure, "unit": unit.replace("_", "/"), "first_n": one.n, "n": two.n}
                    rows.append({**about, **about_n, **{key: float(np.degrees(v)) for key, v in numbers.items()}})
    return pl.DataFrame(rows)
