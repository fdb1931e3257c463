"""The page of `wepose angles`: repetitions, mean curves, tables and definitions, as a paper has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..angles.curves import MeanCurve
from ..angles.definitions import define_angles
from ..angles.movement import (
    MEASURES,
    Movement,
    Statistics,
    compare_curves,
    compare_statistics,
    compute_statistics,
    measure_spans,
)
from .angle_figures import draw_curves, draw_repetitions
from .chart import Picture
from .page import Page, Table
from .words import capital, intervals, plain, signed, versions

TEMPLATE = "report/templates/angles.html.j2"
HEADINGS = ("lowest [°]", "highest [°]", "range [°]", "peak rate [°/s]")  # of MEASURES
CLEAR = 2.0  # standard deviations that the poses state; a smaller difference may be an error that a session shares


def draw_figures(movements: Sequence[Movement]) -> list[Picture]:
    """All figures, in the order of the page."""
    over_time = draw_repetitions(movements)
    return ([over_time] if over_time is not None else []) + draw_curves(movements)


def render_angles_page(
    movements: Sequence[Movement], pictures: Sequence[Picture], files: Sequence[str], failures: list[str] | None = None
) -> str:
    """Return the text of ``angles.html``, one page that opens offline and can be printed. It is deterministic.

    Parameters
    ----------
    pictures : of `draw_figures`
    files : that lie beside the page
    failures : gets a line for each section that cannot be made
    """
    names = " and ".join(movement.name for movement in movements)
    page = Page(TEMPLATE, f"Joint angles of {names}", failures)
    over_time = [picture for picture in pictures if picture.stem == "repetitions"]
    curves = [picture for picture in pictures if picture.stem != "repetitions"]
    page.add("sessions", lambda: {"table": _tabulate_sessions(movements), **_describe(movements)}, name="Sessions")
    if over_time or _list_reasons(movements):  # none where a phase marks them all
        page.add("repetitions", lambda: {"pictures": over_time, "reasons": _list_reasons(movements)}, "Repetitions")
    if curves:
        page.add("curves", lambda: {"pictures": curves}, "Mean curves")
        page.add("measures", lambda: {"table": _tabulate_measures(movements)}, "Means over the repetitions")
    if len([movement for movement in movements if movement.curves]) > 1:
        page.add("comparison", lambda: {"tables": _tabulate_comparisons(movements)}, "Sessions compared")
    page.add("phases", lambda: {"tables": _tabulate_phases(movements)}, "Phases")
    page.add("definitions", lambda: {"table": _tabulate_definitions(movements)}, "What the angles are")
    page.add("files", lambda: {"files": files, "versions": versions()}, "Files")
    return page.html(f"Joint angles of {names}")


# The sections: the values that the macros of the template take --------------------------------------------------------


def _describe(movements: Sequence[Movement]) -> dict[str, Any]:
    return {
        "cutoff_hz": movements[0].cutoff_hz,
        "stated": any(joint.std is not None for movement in movements for joint in movement.angles.joints.values()),
        "isotropic": any(movement.isotropic for movement in movements),
    }


def _tabulate_sessions(movements: Sequence[Movement]) -> Table:
    rows = []
    for movement in movements:
        time, repetitions = movement.angles.time, movement.repetitions
        lasting = compute_statistics(movement.durations, np.full(len(movement.durations), np.nan))
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


def _list_reasons(movements: Sequence[Movement]) -> list[str]:
    return [
        f"{movement.name}: no repetitions{_by(movement)}: {movement.repetitions.reason}."
        for movement in movements
        if movement.repetitions.reason
    ]


def _by(movement: Movement) -> str:
    return f" by {plain(movement.repetitions.source)}" if movement.repetitions.source else ""


def _tabulate_measures(movements: Sequence[Movement]) -> Table:
    rows = []
    for movement, joint, k, angle in _list_angles(movements):
        each = movement.measures[joint]
        cells = [
            _with_stated(compute_statistics(each.values[:, k, m], each.std[:, k, m])) for m in range(len(MEASURES))
        ]
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


def _tabulate_comparisons(movements: Sequence[Movement]) -> list[tuple[str, Table]]:
    """Title and table of each further session against the first."""
    first, *others = [movement for movement in movements if movement.curves]
    header = ["angle", *HEADINGS, "curve, rms [°]", "curve, largest [°]"]
    tables = []
    for other in others:
        rows = []
        for joint in (joint for joint in first.curves if joint in other.curves):
            for k, angle in enumerate(first.angles[joint].names):
                cells = [_difference(first, other, joint, k, m) for m in range(len(MEASURES))]
                cells += _curve_difference(first.curves[joint][k], other.curves[joint][k])
                rows.append([f"{plain(joint)}, {plain(angle)}", *cells])
        tables.append((f"{other.name} less {first.name}", Table(header, rows)))
    return tables


def _difference(first: Movement, other: Movement, joint: str, k: int, m: int) -> str:
    one, two = (
        compute_statistics(each.measures[joint].values[:, k, m], each.measures[joint].std[:, k, m])
        for each in (first, other)
    )
    difference = compare_statistics(one, two)
    if not np.isfinite(difference.value):
        return ""
    value, low, high = (signed(float(np.degrees(each))) for each in difference[:3])
    if not np.isfinite(difference.low):
        return value
    text = f"{value} ({low} to {high})"
    excludes_zero = difference.low > 0.0 or difference.high < 0.0
    return f"**{text}**" if excludes_zero and abs(difference.value) > CLEAR * np.nan_to_num(difference.std) else text


def _curve_difference(first: MeanCurve, other: MeanCurve) -> list[str]:
    curve = compare_curves(first, other)
    if not np.isfinite(curve.rms):
        return ["", ""]
    return [f"{np.degrees(curve.rms):.1f}", f"{signed(float(np.degrees(curve.largest)))} at {curve.percent:.0f} %"]


def _tabulate_phases(movements: Sequence[Movement]) -> list[tuple[str, Table]]:
    """Title and table of the whole time and of each interval of a phase."""
    tables = []
    for movement in movements:
        time = movement.angles.time
        parts = [("all of the time", (float(time[0]), float(time[-1])))]
        for name, spans in movement.phases.items():
            if name != movement.repetitions.source:
                many = len(spans) > 1
                parts += [(f"{plain(name)}{f' {k}' if many else ''}", span) for k, span in enumerate(spans, 1)]
        measures = measure_spans(movement.pose, movement.angles, [span for _, span in parts])
        for row, (name, span) in enumerate(parts):
            rows = [
                [f"{plain(joint)}, {plain(angle)}", *_span_cells(each.values[row, k], each.std[row, k])]
                for joint, each in measures.items()
                for k, angle in enumerate(movement.angles[joint].names)
            ]
            title = f"{capital(name)}, {intervals([span])}"
            tables.append((f"{movement.name}: {title}", Table(["angle", *HEADINGS], rows)))
    return tables


def _span_cells(values: np.ndarray, stds: np.ndarray) -> list[str]:
    """The measures of one angle in one span, ± as stated."""
    return [
        _pair(float(np.degrees(value)), float(np.degrees(std))) if np.isfinite(value) else ""
        for value, std in zip(values, stds, strict=True)
    ]


def _tabulate_definitions(movements: Sequence[Movement]) -> Table:
    definitions = dict.fromkeys(each for movement in movements for each in define_angles(movement.angles))
    return Table(
        ["joint", "rotation", "sequence", "axis", "angle", "positive"],
        [[plain(e.group), e.rotation, "-".join(e.sequence), e.axis, plain(e.angle), e.positive] for e in definitions],
    )
