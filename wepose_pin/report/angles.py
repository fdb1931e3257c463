"""The page of `wepose angles`: repetitions, mean curves and tables, as a paper has them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from ..angles import Angles, group_sides
from ..angles.movement import MEASURES, Movement
from ..angles.repetitions import PERCENT, list_angles
from ..recording import format_span
from . import figures as fig
from .figures import Figures, ReportFigure, styled
from .page import MOST_FIGURES, render_page
from .words import Table, number, plain, plus_minus

HEADINGS = ("lowest [°]", "highest [°]", "range [°]", "peak rate [°/s]")  # of MEASURES
MOST_CURVES = 60  # of single repetitions that are drawn behind their mean
SESSIONS: list[dict[str, Any]] = [  # lines of the sessions, in turn
    {"color": colour, "linestyle": dashes}
    for colour, dashes in zip(fig.SESSION_COLOURS, ("-", "--", ":", "-."), strict=True)
]
ADVICE = (
    "Name another angle by `--repetitions`, or a phase whose intervals are the repetitions, or a time by `--interval`."
)
CURVES = (
    "Each repetition from 0 to 100 % of its own time. Where fewer than half of the repetitions are determined, as near "
    "gimbal lock, a line is broken."
)
WHOLE_TIME = (
    "± is what the pose states. Samples in gaps count nowhere, those near gimbal lock only in the range of the second "
    "angle. `phases.csv` has the same for each phase, `angles.csv` all angles over time."
)


def render_angles_page(movements: Sequence[Movement], tables: Mapping[str, pl.DataFrame], figures: Figures) -> str:
    """Return the text of ``angles.html``, one page that opens offline and can be printed. It is deterministic.

    Parameters
    ----------
    tables : of `build_tables`
    figures : of `draw_figures`; the page shows the first of each kind, the folder has all of them
    """
    over_time = next(figure for name, figure in figures.items() if name.startswith("angles"))
    repetitions = [figures["repetitions"]] if "repetitions" in figures else []
    curves = [figure for name, figure in figures.items() if name.startswith("curves")]
    shown = curves[: MOST_FIGURES - 1 - len(repetitions)]
    missing = explain_missing(movements)
    return render_page(
        f"Joint angles of {' and '.join(movement.name for movement in movements)}",
        [_describe_reliance(tables["summary"]), tabulate_sessions(tables["sessions"]), _describe(movements)],
        {
            "Repetitions": [*missing, *repetitions],
            "Mean curves": [CURVES, *shown] if shown else [],
            "Means over the repetitions": [tabulate_means(tables["summary"])] if len(tables["summary"]) else [],
            "All of the time": [WHOLE_TIME, over_time, _tabulate_whole_time(tables["phases"])],
        },
    )


# Sections -------------------------------------------------------------------------------------------------------------


def explain_missing(movements: Sequence[Movement]) -> list[str]:
    """Why a session has no repetitions, of those that have none, and what to do."""
    return [
        f"{each.name}: no repetitions{f' by {source}' if (source := each.repetitions.source) else ''}: "
        f"{each.repetitions.reason}. {ADVICE}"
        for each in movements
        if each.repetitions.reason
    ]


def _describe_reliance(summary: pl.DataFrame) -> str:
    """Two sentences: what the pose states of a range, and how far the repetitions differ."""
    stated, between = {}, {}
    several = len(summary) and summary["session"].n_unique() > 1
    for row in summary.iter_rows(named=True):
        angle = _name(row) + (f" ({row['session']})" if several else "")
        if np.isfinite(row["range_std_deg"]):
            stated[angle] = row["range_std_deg"]
        if np.isfinite(row["range_sd_deg"]):
            between[angle] = row["range_sd_deg"]
    if not between:
        return "There are fewer than two repetitions, so this page has no mean curves."
    worst = max(between, key=between.__getitem__)
    varies = f"Between repetitions the range of {worst} varies most, by ± {between[worst]:.1f}°."
    if not stated:
        return f"The pose states no uncertainty of a single repetition. {varies}"
    best, least = min(stated, key=stated.__getitem__), max(stated, key=stated.__getitem__)
    known = f"{stated[best]:.1f}° ({best}) up to ± {stated[least]:.1f}° ({least})"
    return f"The range of one repetition is known to ± {known}. {varies}"


def _describe(movements: Sequence[Movement]) -> str:
    cutoff = movements[0].cutoff_hz
    filtered = f"low-passed at {cutoff:g} Hz (half the amplitude there)" if cutoff else "not low-passed"
    return (
        f"Orientations were {filtered}. ± between repetitions is one standard deviation. Without `wepose track "
        "--covariance` a pose states one number for all axes of a segment, and the ± of one angle is rough. "
        "docs/angles.md has the methods."
    )


def _name(row: Mapping[str, Any]) -> str:
    return f"{plain(row['joint'])}, {plain(row['angle'])}"


def tabulate_sessions(sessions: pl.DataFrame) -> Table:
    """Each session: how its repetitions were found, how many there are and how long they last."""
    rows = [
        [
            row["session"],
            format_span((row["from_s"], row["to_s"])),
            f"{plain(row['repetitions_by'])} {row['first']}".strip(),
            str(row["n"]),
            plus_minus(row["duration_mean_s"], row["duration_sd_s"], " s", 2) if row["n"] else "",
            number(row["cmc"], 2, unknown="") if row["n"] else "",
            str(row["left_out"] or ""),
        ]
        for row in sessions.iter_rows(named=True)
    ]
    return Table("", ["session", "time", "repetitions by", "n", "duration", "CMC", "left out"], rows)


def tabulate_means(summary: pl.DataFrame) -> Table:
    """Mean ± standard deviation between the repetitions of each angle, with what the pose states for one."""
    rows: dict[str, list[list[str]]] = {}  # angle → a row a session
    for row in summary.iter_rows(named=True):
        cells = []
        for measure, unit in MEASURES.items():
            mean, sd, std = (row[f"{measure}_{part}_{unit}"] for part in ("mean", "sd", "std"))
            stated = f" [{std:.1f}]" if np.isfinite(std) else ""
            cells.append(plus_minus(mean, sd) + stated if np.isfinite(mean) else "")
        rows.setdefault(_name(row), []).append([row["session"], *cells, number(row["cmc"], 2, unknown="")])
    title = "Mean ± standard deviation between the repetitions, in square brackets what the pose states for one"
    cells_by_angle = [[angle, *cells] for angle, sessions in rows.items() for cells in sessions]
    return Table(title, ["angle", "session", *HEADINGS, "CMC"], cells_by_angle)


def _tabulate_whole_time(phases: pl.DataFrame) -> Table:
    rows = []
    for row in phases.filter(pl.col("phase") == "all").iter_rows(named=True):
        values = [(row[f"{measure}_{unit}"], row[f"{measure}_std_{unit}"]) for measure, unit in MEASURES.items()]
        cells = [plus_minus(value, std) if np.isfinite(value) else "" for value, std in values]
        rows.append([_name(row), row["session"], *cells])
    return Table("", ["angle", "session", *HEADINGS], rows)


# Figures --------------------------------------------------------------------------------------------------------------


@styled
def draw_figures(movements: Sequence[Movement]) -> Figures:
    """Draw the repetitions over time, the mean curves of each kind of joint, and all angles over time."""
    figures = Figures()
    repeating = [(k, each) for k, each in enumerate(movements) if each.repetitions.source in list_angles(each.angles)]
    if repeating:  # a phase does not mark them in all
        figures["repetitions"] = _draw_repetitions(repeating)
    joints = dict.fromkeys(joint for movement in movements for joint in movement.curves)
    for group, members in group_sides(joints).items():
        sessions = [(k, each) for k, each in enumerate(movements) if set(members.values()) & set(each.curves)]
        figures[f"curves-{group}"] = _draw_curves(sessions, group, members)
    for k, movement in enumerate(movements, 1):
        name = f"angles-{k}" if len(movements) > 1 else "angles"
        figures[name] = draw_joint_angles(movement.angles, f"{movement.name}: joint angles over time.")
    return figures


def draw_joint_angles(angles: Angles, caption: str = "Joint angles over time.") -> ReportFigure:
    """Draw a row for each kind of joint, as the elbows, with its three angles."""
    panels: dict[str, dict[str, np.ndarray]] = {}
    styles: dict[str, dict[str, Any]] = {}
    for group, members in group_sides(angles.joints).items():
        for k, name in enumerate(angles[next(iter(members.values()))].names):
            lines = {side: np.where(angles[j].hidden(k), np.nan, angles[j].values[:, k]) for side, j in members.items()}
            panels[f"{plain(group)}: {plain(name)} [°]"] = {side: np.degrees(line) for side, line in lines.items()}
        styles |= {side: fig.line_style(side, side) for side in members}
    if any((joint.near_lock | joint.gap).any() for joint in angles.joints.values()):
        caption += " Lines break where samples are lost, and near gimbal lock, where an angle is not determined."
    return fig.draw_over_time(angles.time, panels, caption, styles, columns=3)


def _draw_repetitions(repeating: Sequence[tuple[int, Movement]]) -> ReportFigure:
    """The angle by which repetitions were found over time, a row a session."""
    shaded = " Shaded, in turns: the repetitions." * any(len(each.repetitions.spans) for _, each in repeating)
    figure = ReportFigure(f"The main angle over time.{shaded}", 1.5 * len(repeating))
    for ax, (k, movement) in zip(figure.grid(len(repeating))[:, 0], repeating, strict=True):
        spans, source = movement.repetitions.spans, movement.repetitions.source
        joint, place = list_angles(movement.angles)[source]
        ax.set_title(f"{movement.name}: {plain(source)} [°], {len(spans) or 'no'} repetitions")
        fig.shade(ax, spans[::2], "", fig.SHADE)
        fig.shade(ax, spans[1::2], "", fig.BAND)
        each = movement.angles[joint]
        values = np.degrees(np.where(each.hidden(place), np.nan, each.values[:, place]))
        ax.plot(*fig.envelope(movement.angles.time, values), **SESSIONS[k % len(SESSIONS)])
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def _draw_curves(sessions: Sequence[tuple[int, Movement]], group: str, members: dict[str, str]) -> ReportFigure:
    """A joint's three angles from 0 to 100 % of the repetition, left above right."""
    first = next(each.angles[joint] for _, each in sessions for joint in members.values() if joint in each.curves)
    alone = len(sessions) == 1
    figure = ReportFigure(
        f"The {plain(group)} over the repetition, sequence {'-'.join(first.sequence)}. Line: mean over n repetitions. "
        f"Band: ± one standard deviation between them.{' Thin: the repetitions.' * alone}",
        1.7 * len(members),
    )
    for row, joint in zip(figure.grid(len(members), 3, sharex=True, sharey="col"), members.values(), strict=True):
        for place, ax in enumerate(row):
            ax.set_title(f"{plain(joint)}: {plain(first.names[place])} [°]")
            ax.set_xlim(0.0, 100.0)
            for k, movement in [(k, each) for k, each in sessions if joint in each.curves]:
                style, curve = SESSIONS[k % len(SESSIONS)], movement.curves[joint][place]
                mean, sd = np.degrees(curve.mean), np.degrees(curve.sd)
                if not np.isfinite(mean).any():
                    ax.text(50.0, 0.0, "not determined (near gimbal lock)", ha="center", color=fig.SOFT)
                    continue
                ax.fill_between(PERCENT, mean - sd, mean + sd, color=style["color"], alpha=0.2, linewidth=0)
                if alone:
                    each = np.where(np.isfinite(mean), np.degrees(curve.curves[:MOST_CURVES]), np.nan)
                    ax.plot(PERCENT, each.T, color=fig.SOFT, linewidth=0.3)
                label = f"{movement.name}, n = {len(movement.repetitions.spans)}"
                ax.plot(PERCENT, mean, **style, linewidth=1.8, label=label)
    for ax in row:
        ax.set_xlabel("repetition [%]")
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.5 * (low + high) - 5.0), max(high, 0.5 * (low + high) + 5.0))  # at least 10° high
    figure.add_legend()
    return figure
