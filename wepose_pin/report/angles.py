"""The page of `wepose angles`: repetitions, mean curves and tables, as a paper has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..angles import Angles, JointAngles, group_sides
from ..angles.curves import PERCENT, MeanCurve
from ..angles.movement import (
    RANGE,
    Difference,
    Movement,
    Statistics,
    compare_measures,
    measure_spans,
)
from ..angles.repetitions import list_angles
from ..body.kinematics import Pose
from .figures import (
    BAND,
    SESSION_COLOURS,
    SHADE,
    SOFT,
    Figures,
    ReportFigure,
    draw_over_time,
    envelope,
    line_style,
    shade,
    styled,
)
from .page import MOST_FIGURES, Item, Page, Table
from .words import intervals, listed, plain, signed

HEADINGS = ("lowest [°]", "highest [°]", "range [°]", "peak rate [°/s]")  # of MEASURES
CLEAR = 2.0  # standard deviations that the poses state; a smaller difference may be an error that a session shares
MOST_OVER_TIME = 1  # figures of angles over time that the page shows
FULL_TURN = 2.0 * np.pi - 1e-9
MOST_CURVES = 60  # of single repetitions that are drawn behind their mean


def render_angles_page(movements: Sequence[Movement], figures: Figures, failures: list[str] | None = None) -> str:
    """Return the text of ``angles.html``, one page that opens offline and can be printed. It is deterministic.

    Parameters
    ----------
    figures : of `draw_figures`; the page shows the first of them
    failures : gets a line for each section that cannot be made
    """
    page = Page(f"Joint angles of {' and '.join(movement.name for movement in movements)}", failures)
    over_time = [figure for name, figure in figures.items() if name.startswith("angles")][:MOST_OVER_TIME]
    shown = {name: figure for name, figure in figures.items() if not name.startswith("angles")}
    others = [name for name in figures if name not in shown][MOST_OVER_TIME:]
    others += [*shown][MOST_FIGURES - len(over_time) :]
    shown = dict([*shown.items()][: MOST_FIGURES - len(over_time)])
    main_angle = [shown.pop("repetitions")] if "repetitions" in shown else []
    repetitions: list[Item] = [
        f"{movement.name}: no repetitions{_by(movement)}: {movement.repetitions.reason}."
        for movement in movements
        if movement.repetitions.reason
    ]
    repetitions += [*([ADVICE] if repetitions else []), *main_angle]
    page.add("What can be relied on", lambda: [_describe_reliance(movements)], heading=False)
    page.add("Sessions", lambda: [_tabulate_sessions(movements), _describe(movements)], heading=False)
    page.add("Repetitions", lambda: repetitions)
    if shown:
        rest = f" Beside this page: {listed([f'`{name}.svg`' for name in others])}." if others else ""
        page.add("Mean curves", lambda: [CURVES + rest, *shown.values()])
        page.add("Means over the repetitions", lambda: [MEANS, _tabulate_measures(movements)])
    if len([movement for movement in movements if movement.curves]) > 1:
        page.add("Sessions compared", lambda: [COMPARISON, *_tabulate_comparisons(movements)])
    page.add("All of the time", lambda: [WHOLE_TIME, *over_time, *_tabulate_whole_time(movements)])
    return page.html()


ADVICE = (
    "State another angle by `--main-angle`, a time by `--interval`, or mark repetitions as intervals of a phase and "
    "name it by `--repetitions`."
)
CURVES = (
    "Each repetition from 0 to 100 % of its own time. Where fewer than half of the repetitions are determined, as near "
    "gimbal lock, a line is broken."
)
MEANS = "Mean ± standard deviation between the repetitions, in square brackets what the pose states for one."
COMPARISON = (
    "Differences of means, with the 95 % interval from the spread between repetitions (Welch 1947). They are of one "
    "person: the interval says nothing of groups, nor of errors that a session shares. Bold: it excludes zero, and the "
    "difference is more than twice what the poses state (`difference_std` in comparison.csv)."
)
WHOLE_TIME = (
    "± is what the pose states. Samples in gaps count nowhere, those near gimbal lock only in the range of the second "
    "angle. `phases.csv` has the same for each phase, `angles.csv` all angles over time."
)


# Sections -------------------------------------------------------------------------------------------------------------


def _describe_reliance(movements: Sequence[Movement]) -> str:
    """Two sentences: what the pose states of a range, and how far the repetitions differ."""
    stated, between = {}, {}
    for movement, joint, k, angle in _list_angles(movements):
        each = movement.measures[joint].statistics(k)[RANGE]
        stated[angle] = float(np.degrees(each.std))
        between[f"{angle}{f' ({movement.name})' if len(movements) > 1 else ''}"] = float(np.degrees(each.sd))
    stated, between = ({name: v for name, v in each.items() if np.isfinite(v)} for each in (stated, between))
    if not between:
        return "No repetitions were found, so this page has no mean curves. The table covers the whole recording."
    worst = max(between, key=between.__getitem__)
    spread = f"Between repetitions the range of {worst} varies most, by ± {between[worst]:.1f}°."
    if not stated:
        return f"The pose states no uncertainty of a single repetition. {spread}"
    best, least = min(stated, key=stated.__getitem__), max(stated, key=stated.__getitem__)
    known = f"{stated[best]:.1f}° ({best}) up to ± {stated[least]:.1f}° ({least})"
    return f"The range of one repetition is known to ± {known}. {spread}"


def _describe(movements: Sequence[Movement]) -> str:
    cutoff = movements[0].cutoff_hz
    text = (
        f"Orientations were low-passed at {cutoff:g} Hz: a Butterworth filter of second order, forwards and backwards; "
        "at the cut-off the amplitude is half (−6 dB)."
        if cutoff
        else "Orientations were not low-passed."
    )
    text += " Rates are means over 0.05 s. ± between repetitions is one standard deviation, with n − 1."
    if any(_is_isotropic(movement.pose) for movement in movements):
        text += (
            " The poses state one number for all axes of a segment, so that their ± is rough for a single angle; "
            "`wepose track --covariance` writes all of it."
        )
    return (
        f"{text} CMC is the coefficient of multiple correlation of the curves (Kadaba et al. 1989), at most 1. Angles "
        "are after the International Society of Biomechanics, with the same signs left and right; `definitions.csv` "
        "has the axes."
    )


def _is_isotropic(pose: Pose) -> bool:
    """Whether the pose states one standard deviation a segment, and no covariance."""
    covariances = pose.segment_cov.values()
    return bool(covariances) and all(np.array_equal(cov, cov[:, :1, :1] * np.eye(3)) for cov in covariances)


def _tabulate_sessions(movements: Sequence[Movement]) -> Table:
    rows = []
    for movement in movements:
        time, repetitions = movement.angles.time, movement.repetitions
        lasting = movement.duration
        rows.append(
            [
                movement.name,
                intervals([(float(time[0]), float(time[-1]))]),
                plain(repetitions.source),
                str(len(repetitions.spans)),
                f"{_pair(lasting.mean, lasting.sd, 2)} s" if lasting.n else "",
                f"{repetitions.cmc:.2f}" if np.isfinite(repetitions.cmc) else "",
                str(repetitions.left_out or ""),
            ]
        )
    header = ["session", "time", "repetitions by", "n", "duration", "CMC", "left out"]
    return Table(header, rows)


def _by(movement: Movement) -> str:
    return f" by {plain(movement.repetitions.source)}" if movement.repetitions.source else ""


def _tabulate_measures(movements: Sequence[Movement]) -> Table:
    rows = []
    for movement, joint, k, angle in _list_angles(movements):
        cells = [_with_stated(each) for each in movement.measures[joint].statistics(k)]
        curve = movement.curves[joint][k]
        rows.append([angle, *_name(movements, movement), *cells, f"{curve.cmc:.2f}" if np.isfinite(curve.cmc) else ""])
    header = ["angle", *(["session"] if len(movements) > 1 else []), *HEADINGS, "CMC"]
    return Table(header, rows)


def _list_angles(movements: Sequence[Movement]) -> Iterator[tuple[Movement, str, int, str]]:
    """Session, joint, place and words of each angle that has curves; the sessions of one angle follow each other."""
    joints = dict.fromkeys(joint for movement in movements for joint in movement.curves)
    for joint in joints:
        for k in range(3):
            for movement in (movement for movement in movements if joint in movement.curves):
                yield movement, joint, k, f"{plain(joint)}, {plain(movement.angles[joint].names[k])}"


def _name(movements: Sequence[Movement], movement: Movement) -> list[str]:
    return [movement.name] if len(movements) > 1 else []


def _with_stated(each: Statistics) -> str:
    """Mean ± standard deviation, and what is stated in brackets."""
    if not each.n:
        return ""
    mean, sd, std = (float(np.degrees(value)) for value in (each.mean, each.sd, each.std))
    return f"{_pair(mean, sd)} [{std:.1f}]" if np.isfinite(std) else _pair(mean, sd)


def _pair(mean: float, sd: float, digits: int = 1) -> str:
    text = f"{round(mean, digits) + 0.0:.{digits}f}".replace("-", "−")
    return f"{text} ± {sd:.{digits}f}" if np.isfinite(sd) else text


def _tabulate_comparisons(movements: Sequence[Movement]) -> list[Table]:
    """A table of each further session against the first."""
    first, *others = [movement for movement in movements if movement.curves]
    header = ["angle", *HEADINGS]
    tables = []
    for other in others:
        rows = []
        for joint in (joint for joint in first.curves if joint in other.curves):
            for k, angle in enumerate(first.angles[joint].names):
                compared = compare_measures(first.measures[joint], other.measures[joint], k)
                cells = [_describe_difference(difference) for _, _, difference in compared]
                rows.append([f"{plain(joint)}, {plain(angle)}", *cells])
        tables.append(Table(header, rows, f"{other.name} less {first.name}"))
    return tables


def _describe_difference(difference: Difference) -> str:
    if not np.isfinite(difference.value):
        return ""
    value, low, high = (signed(float(np.degrees(each))) for each in difference[:3])
    if not np.isfinite(difference.low):
        return value
    text = f"{value} ({low} to {high})"
    excludes_zero = difference.low > 0.0 or difference.high < 0.0
    return f"**{text}**" if excludes_zero and abs(difference.value) > CLEAR * np.nan_to_num(difference.std) else text


def _tabulate_whole_time(movements: Sequence[Movement]) -> list[Table]:
    """A table of each session's whole time."""
    tables = []
    for movement in movements:
        span = (float(movement.angles.time[0]), float(movement.angles.time[-1]))
        rows = [
            [f"{plain(joint)}, {plain(angle)}", *_span_cells(each.values[0, k], each.std[0, k])]
            for joint, each in measure_spans(movement.pose, movement.angles, [span]).items()
            for k, angle in enumerate(movement.angles[joint].names)
        ]
        tables.append(Table(["angle", *HEADINGS], rows, f"{movement.name}, {intervals([span])}"))
    return tables


def _span_cells(values: np.ndarray, stds: np.ndarray) -> list[str]:
    """The measures of one angle in one span, ± as stated."""
    return [
        _pair(float(np.degrees(value)), float(np.degrees(std))) if np.isfinite(value) else ""
        for value, std in zip(values, stds, strict=True)
    ]


# Figures --------------------------------------------------------------------------------------------------------------


@styled
def draw_figures(movements: Sequence[Movement]) -> Figures:
    """Draw the repetitions over time, the mean curves of each kind of joint, and all angles over time."""
    figures = Figures()
    repeating = [(k, each) for k, each in enumerate(movements) if each.repetitions.source in list_angles(each.angles)]
    if repeating:  # a phase does not mark them in all
        figures["repetitions"] = _draw_repetitions(repeating)
    shown = [(k, movement) for k, movement in enumerate(movements) if movement.curves]
    joints = dict.fromkeys(joint for _, movement in shown for joint in movement.curves)
    for group, members in group_sides(joints).items():
        sessions = [(k, movement) for k, movement in shown if set(members.values()) & set(movement.curves)]
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
            lines = {side: np.degrees(_break_line(angles[joint], k)) for side, joint in members.items()}
            panels[f"{plain(group)}: {plain(name)} [°]"] = lines
        styles |= {side: line_style(side, side) for side in members}
    if any((joint.near_lock | joint.gap).any() for joint in angles.joints.values()):
        caption += " Lines break where samples are lost, and near gimbal lock, where an angle is not determined."
    return draw_over_time(angles.time, panels, caption, styles, columns=3)


def _break_line(joint: JointAngles, k: int) -> np.ndarray:
    """An angle with its line broken where it is not determined; within ± half a turn where it passed the lock."""
    hidden = joint.hidden(k)
    values = np.where(hidden, np.nan, joint.values[:, k])
    if hidden.all() or not joint.near_lock.any() or np.nanmax(values) - np.nanmin(values) < FULL_TURN:
        return values  # a real whole turn
    values = (values + np.pi) % FULL_TURN - np.pi
    values[1:][np.abs(np.diff(values)) > np.pi] = np.nan
    return values


def _session_style(k: int) -> dict[str, Any]:
    """The line of the k-th session."""
    return {"color": SESSION_COLOURS[k % len(SESSION_COLOURS)], "linestyle": ("-", "--", ":", "-.")[k % 4]}


def _draw_repetitions(repeating: Sequence[tuple[int, Movement]]) -> ReportFigure:
    """The angle by which repetitions were found over time, a row a session."""
    figure = ReportFigure("The main angle over time. Shaded, in turns: the repetitions.", 1.5 * len(repeating))
    for ax, (k, movement) in zip(figure.grid(len(repeating))[:, 0], repeating, strict=True):
        spans, source, time = movement.repetitions.spans, movement.repetitions.source, movement.angles.time
        joint, place = list_angles(movement.angles)[source]
        each = movement.angles[joint]
        n = f"n = {len(spans)}" if len(spans) else "no repetitions"
        ax.set_title(f"{movement.name}: {plain(source)} [°], {n}")
        shade(ax, spans[::2], "", SHADE)
        shade(ax, spans[1::2], "", BAND)
        values = np.degrees(np.where(each.hidden(place), np.nan, each.values[:, place]))
        ax.plot(*envelope(time, values), **_session_style(k))
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def _draw_curves(sessions: Sequence[tuple[int, Movement]], group: str, members: dict[str, str]) -> ReportFigure:
    """A joint's three angles from 0 to 100 % of the repetition, left above right."""
    first = next(each.angles[joint] for _, each in sessions for joint in members.values() if joint in each.curves)
    cutoff = sessions[0][1].cutoff_hz
    filtered = "not low-passed" if cutoff is None else f"low-passed at {cutoff:g} Hz (half amplitude)"
    figure = ReportFigure(
        f"The {plain(group)} over the repetition, sequence {'-'.join(first.sequence)}, {filtered}. Line: mean over n "
        f"repetitions. Band: ± one standard deviation between them.{' Thin: the repetitions.' * (len(sessions) == 1)}",
        1.7 * len(members),
    )
    for row, joint in zip(figure.grid(len(members), 3, sharex=True, sharey="col"), members.values(), strict=True):
        for place, ax in enumerate(row):
            ax.set_title(f"{plain(joint)}: {plain(first.names[place])} [°]")
            ax.set_xlim(0.0, 100.0)
            for k, movement in sessions:
                if joint in movement.curves:
                    label = f"{movement.name}, n = {len(movement.repetitions.spans)}"
                    _draw_curve(ax, movement.curves[joint][place], k, label, alone=len(sessions) == 1)
    for ax in row:
        ax.set_xlabel("repetition [%]")
        low, high = ax.get_ylim()
        room = max(0.5 * (10.0 - (high - low)), 0.0)  # at least 10° high
        ax.set_ylim(low - room, high + room)
    figure.add_legend()
    return figure


def _draw_curve(ax: Axes, curve: MeanCurve, k: int, label: str, *, alone: bool) -> None:
    mean, sd = np.degrees(curve.mean), np.degrees(curve.sd)
    if not np.isfinite(mean).any():
        ax.text(50.0, 0.0, "not determined (near gimbal lock)", ha="center", color=SOFT)
        return
    style = _session_style(k)
    ax.fill_between(PERCENT, mean - sd, mean + sd, color=style["color"], alpha=0.2, linewidth=0)
    if alone:
        each = np.where(np.isfinite(mean), np.degrees(curve.curves[:MOST_CURVES]), np.nan)
        ax.plot(PERCENT, each.T, color=SOFT, linewidth=0.3)
    ax.plot(PERCENT, mean, **style, linewidth=1.8, label=label)
