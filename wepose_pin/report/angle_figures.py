"""The figures of `wepose angles`: the repetitions over time, and time-normalised curves, to be printed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..angles import group_sides
from ..angles.curves import PERCENT, MeanCurve
from ..angles.movement import Movement
from ..angles.repetitions import list_angles
from .chart import Chart, Key, Panel, Picture, envelope
from .track_figures import TIME
from .words import plain

# The lines of sessions, in their order.
COLOURS = ("accent", "before", "second", "third")
MOST_CURVES = 60  # of single repetitions that are drawn behind their mean
CURVE_HEIGHT = 150.0  # [px]


def session_style(k: int) -> str:
    """The style of the k-th session's line."""
    return f"{COLOURS[k % len(COLOURS)]}{' dashed' if k // len(COLOURS) % 2 else ''}"


def draw_repetitions(movements: Sequence[Movement]) -> Picture | None:
    """The angle by which repetitions were found over time, a row a session; None where a phase marks them in all."""
    rows = []
    for k, movement in enumerate(movements):
        repetitions = movement.repetitions
        if repetitions.source not in list_angles(movement.angles):
            continue
        joint, place = list_angles(movement.angles)[repetitions.source]
        each, time = movement.angles[joint], movement.angles.time
        n = f"n = {len(repetitions.spans)}" if len(repetitions.spans) else "no repetitions"
        title = f"{movement.name}: {plain(repetitions.source)} [°], {n}"
        panel = Panel(title, TIME, x=(float(time[0]), float(time[-1])))
        for parity, css in ((0, "phase"), (1, "band")):
            panel.spans(repetitions.spans[parity::2], css)
        panel.line(
            *envelope(time, np.degrees(np.where(each.hidden(place), np.nan, each.values[:, place]))), session_style(k)
        )
        rows.append([panel])
    if not rows:
        return None
    caption = "The main angle over time. Shaded, in turns: the repetitions."
    return Picture("repetitions", caption, Chart(rows, [120.0] * len(rows)))


def draw_curves(movements: Sequence[Movement]) -> list[Picture]:
    """A figure a joint: its three angles from 0 to 100 % of the repetition, left above right."""
    shown = [(k, movement) for k, movement in enumerate(movements) if movement.curves]
    if not shown:
        return []
    joints = dict.fromkeys(joint for _, movement in shown for joint in movement.curves)
    return [_draw_joint(shown, group, members) for group, members in group_sides(joints).items()]


def _draw_joint(shown: Sequence[tuple[int, Movement]], group: str, members: dict[str, str]) -> Picture:
    shown = [(k, movement) for k, movement in shown if set(members.values()) & set(movement.curves)]
    columns = [_find_limits(shown, list(members.values()), place) for place in range(3)]
    rows = []
    for side, joint in members.items():
        sessions = [(k, movement) for k, movement in shown if joint in movement.curves]
        label = "" if len(members) == 1 and side == joint else f"{side} "
        row = []
        first = sessions[0][1].angles[joint]
        sequence = "-".join(first.sequence)
        for place, name in enumerate(first.names):
            row.append(Panel(f"{label}{plain(name)} [°]", x=(0.0, 100.0), y=columns[place], shown_x=False))
            for k, movement in sessions:
                _draw_curve(row[-1], movement.curves[joint][place], session_style(k), alone=len(shown) == 1)
        rows.append(row)
    for panel in rows[-1]:
        panel.shown_x, panel.x_label = True, "repetition [%]"
    keys = [
        Key(f"{movement.name}, n = {len(movement.repetitions.spans)}", f"{session_style(k)} strong")
        for k, movement in shown
    ]
    caption = (
        f"The {plain(group)} over the repetition, sequence {sequence}, {_describe_filter(shown[0][1])}. "
        "Line: mean over n repetitions. Band: ± one standard deviation between repetitions."
    )
    if len(shown) == 1:
        caption += " Thin: the repetitions."
    return Picture(f"curves-{group}", caption, Chart(rows, [CURVE_HEIGHT] * len(rows), keys))


def _describe_filter(movement: Movement) -> str:
    cutoff = movement.cutoff_hz
    return "not low-passed" if cutoff is None else f"low-passed at {cutoff:g} Hz (half amplitude)"


def _find_limits(
    shown: Sequence[tuple[int, Movement]], joints: Sequence[str], place: int
) -> tuple[float, float] | None:
    """The same for both sides: all bands, and at least 10°."""
    curves = [movement.curves[joint][place] for _, movement in shown for joint in joints if joint in movement.curves]
    ends = np.degrees(np.concatenate([np.concatenate([each.mean - each.sd, each.mean + each.sd]) for each in curves]))
    if len(shown) == 1:
        drawn = [each.curves[:MOST_CURVES][:, np.isfinite(each.mean)] for each in curves]
        ends = np.concatenate([ends, np.degrees(np.concatenate([each.ravel() for each in drawn]))])
    ends = ends[np.isfinite(ends)]
    if not len(ends):
        return None
    low, high = float(ends.min()), float(ends.max())
    margin = max(0.05 * (high - low), 0.5 * (10.0 - (high - low)))
    return low - margin, high + margin


def _draw_curve(panel: Panel, curve: MeanCurve, css: str, *, alone: bool) -> None:
    mean, sd = np.degrees(curve.mean), np.degrees(curve.sd)
    if not np.isfinite(mean).any():
        panel.text(50.0, float(np.mean(panel.limits("y"))), "not determined (near gimbal lock)", "soft", "middle")
        return
    panel.band(PERCENT, mean - sd, mean + sd, f"{css} sd")
    if alone:
        for each in np.degrees(curve.curves[:MOST_CURVES]):
            panel.line(PERCENT, np.where(np.isfinite(mean), each, np.nan), "soft faint hair")
    panel.line(PERCENT, mean, f"{css} strong")
