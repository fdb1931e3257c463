"""The charts of a tracked recording's report; the size of none grows with the recording's length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..recording.gaps import find_runs
from .chart import WIDTH, Chart, Key, Panel, Picture, category_rows, envelope
from .measures import Hand, Signal, finite_max
from .words import plain

TIME = "time in the recording [s]"
PATH_POINTS = 3000
Spans = Sequence[tuple[float, float]]


def draw_timeline(time: np.ndarray, signals: Mapping[str, Signal], phases: Mapping[str, Spans]) -> Picture:
    """Each sensor over time: how fast it rotated, where it was static, lost, or cut off by its range."""
    ends = _ends(time)
    most = 1.08 * max(1.0, max(float(np.degrees(signal.rate.max())) for signal in signals.values()))
    rows = []
    if phases:
        rows.append(Panel(x=ends, y=(0.0, 1.0), bare=True))
        for spans in phases.values():
            rows[0].spans(spans, "phase")
        _name_phases(rows[0], phases, ends)
    legend = [Key("rotation [°/s]", "soft", "box")]
    legend += [Key("static", "ink", "box")] if any(_any(signal.static) for signal in signals.values()) else []
    legend += [Key("phase", "phase", "box")] if phases else []
    legend += [Key("lost and bridged", "hatched", "box")] if any(_any(s.gap) for s in signals.values()) else []
    legend += [Key("cut off by the range", "before", "triangle")] if any(_any(s.cut) for s in signals.values()) else []
    for name, signal in signals.items():
        panel = Panel(plain(name), x=ends, y=(-0.15 * most, most), shown_x=False, grid="")
        panel.y_ticks = [(0.0, "0"), (_round_below(most), f"{_round_below(most):g}")]
        for spans in phases.values():
            panel.spans(spans, "phase")
        panel.area(*envelope(time, np.degrees(signal.rate)), line_style(name).split()[0])
        if signal.static is not None:
            panel.boxes(_times(time, signal.static), (-0.13 * most, 0.0), "ink")
        panel.spans(_times(time, signal.gap), "hatched")
        if signal.cut.any():
            first = _times(time, signal.cut)[:, 0]
            panel.markers(first, 0.9 * most, "triangle", "before", size=5.0)
        rows.append(panel)
    rows[-1].shown_x, rows[-1].x_label = True, TIME
    heights = [18.0] * bool(phases) + [38.0] * len(signals)
    caption = "How fast each sensor rotated, on one scale. Bars under the zero line: static by the filter's test."
    return Picture("timeline", caption, Chart([[row] for row in rows], heights, legend))


def draw_noise(signals: Mapping[str, Signal]) -> Picture:
    """Noise and bias of each sensor that has them."""
    rows = {plain(name): signal for name, signal in signals.items() if signal.bias is not None}
    panels: list[Panel] = []
    for title, values in (
        ("gyroscope's noise [°/s]", [float(np.degrees(signal.gyro_noise)) for signal in rows.values()]),
        ("accelerometer's noise [m/s²]", [signal.accel_noise for signal in rows.values()]),
    ):
        panel = Panel(title, x=(0.0, 1.25 * max(1e-6, *values)), shown_y=not panels)
        for at, value in zip(category_rows(panel, list(rows)), values, strict=True):
            panel.boxes((0.0, value), (at - 0.28, at + 0.28), "accent")
            panel.text(value, at, f"{value:.3f}", dx=5.0)
        panels.append(panel)
    biases = np.array(
        [np.degrees(np.linalg.norm(signal.bias, axis=1)) for signal in rows.values() if signal.bias is not None]
    )
    panel = Panel("gyroscope's bias [°/s]", x=(0.0, 1.12 * max(1e-6, float(biases.max()))), shown_y=False)
    for at, (begin, end) in zip(category_rows(panel, list(rows)), biases, strict=True):
        panel.line(np.array([begin, end]), np.full(2, at), "accent")
        panel.markers(begin, at, "circle", "accent hollow")
        panel.markers(end, at, "diamond", "accent")
    panels.append(panel)
    keys = [Key("bias in the static phase", "accent hollow", "circle"), Key("bias at the end", "accent", "diamond")]
    caption = (
        "Noise of one axis in the static phase (a person's sway counts as noise there), and the size of the bias of "
        "the three axes together: as measured in the static phase, and as the filter knew it at the end."
    )
    return Picture("noise", caption, Chart([panels], [26.0 * len(rows) + 6.0], keys))


def draw_headings(time: np.ndarray, std_deg: Mapping[str, np.ndarray], clasps: Spans) -> Picture:
    """What each segment's heading may be off by, over time; `clasps`: spans of joined hands [s]."""
    most = 1.06 * max(0.1, *(finite_max(values) for values in std_deg.values()))
    panel = Panel("heading, ± [°]", TIME, x=_ends(time), y=(0.0, most))
    panel.spans(clasps, "phase")
    for name, values in std_deg.items():
        panel.line(*envelope(time, values), line_style(name))
    keys = [Key(plain(name), line_style(name)) for name in std_deg]
    keys += [Key("hands joined", "phase", "box")] if clasps else []
    caption = "What each segment's heading may be off by: one standard deviation."
    return Picture("headings", caption, Chart([[panel]], [230.0], keys))


def draw_paths(hands: Mapping[str, Hand], shoulder_width: float, trunk: float) -> Picture:
    """Where the hands went, seen from the torso: from the front, from the right, from above."""
    panels = []
    for panel, across, up in body_views(50.0 * shoulder_width, 100.0 * trunk):
        for name, hand in hands.items():
            at = 100.0 * hand.reach[:: max(1, len(hand.reach) // PATH_POINTS)][:, [across, up]]
            side = line_style(name).split()[0]
            panel.line(at[:, 0], at[:, 1], f"{side} faint")
            panel.markers(at[0, 0], at[0, 1], "circle" if side == "left" else "square", side)
        panels.append(panel)
    keys = [
        Key(f"{plain(name)}, mark: beginning", line_style(name).split()[0], "square" if "right" in name else "circle")
        for name in hands
    ]
    return Picture(
        "paths",
        "Where the hands went, seen from the torso, which is taken as upright and facing ahead.",
        Chart([panels], [260.0], keys),
    )


def body_views(half: float, trunk: float) -> list[tuple[Panel, int, int]]:
    """Panels with head, shoulders and trunk [cm], origin between the shoulders, and the axes that each shows.

    Parameters
    ----------
    half, trunk : half of the shoulders' width, the trunk's length [cm]
    """
    labels = ("forwards [cm]", "to the person's left [cm]", "above the shoulders [cm]")
    views = []
    for view, across, up in (("from the front", 1, 2), ("from the right", 0, 2), ("from above", 1, 0)):
        panel = Panel(f"{view}: {labels[up]}", labels[across], equal=True, flip_x=view == "from above")
        panel.disc(0.0, 0.0 if up == 0 else 20.0, 10.0, "band")
        if across == 1:
            panel.line(np.array([-half, half]), np.zeros(2), "band limb")
        if up == 2:
            panel.line(np.zeros(2), np.array([0.0, -trunk]), "band limb")
        views.append((panel, across, up))
    return views


def draw_reach(time: np.ndarray, hands: Mapping[str, Hand]) -> Picture:
    """The hands over time, along the torso's axes."""
    panels = {
        label: {name: 100.0 * hand.reach[:, k] for name, hand in hands.items()}
        for k, label in enumerate(("forwards [cm]", "to the left [cm]", "above the shoulders [cm]"))
    }
    caption = "The hands over time, from the middle of the shoulders along the torso's axes."
    return draw_over_time(time, panels, "reach", caption)


def draw_over_time(
    time: np.ndarray, panels: Mapping[str, Mapping[str, np.ndarray]], stem: str, caption: str
) -> Picture:
    """A panel for each title, with its lines by name: left in full, right dashed; NaN breaks a line."""
    rows = []
    for title, lines in panels.items():
        panel = Panel(title, x=_ends(time), shown_x=False)
        panel.rule("soft thin", y=0.0)
        for name, values in lines.items():
            panel.line(*envelope(time, values), _side(name))
        rows.append([panel])
    rows[-1][0].shown_x, rows[-1][0].x_label = True, TIME
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    keys = [Key(plain(name), _side(name)) for name in names] if len(names) > 1 else []
    return Picture(stem, caption, Chart(rows, [105.0] * len(rows), keys))


def line_style(segment: str) -> str:
    """The style of a segment's line: the side by colour, the part by dashes."""
    side, _, part = segment.partition("_") if segment.startswith(("left_", "right_")) else ("other", "", segment)
    return (
        f"{side} {'dashed' if part in ('forearm', 'pelvis') else 'dotted' if part in ('hand', 'palm', 'head') else ''}"
    )


def _side(name: str) -> str:
    side = {"l": "left", "r": "right"}.get(name[:1], "other")
    return f"{side} dashed" if side == "right" else side


def _name_phases(panel: Panel, phases: Mapping[str, Spans], ends: tuple[float, float]) -> None:
    """Names of the phases where there is room, those of long ones first."""
    letter = 7.5 / WIDTH * (ends[1] - ends[0])
    occupied: list[tuple[float, float]] = []
    for _, a, name in sorted((a - b, a, name) for name, spans in phases.items() for a, b in spans):
        end = a + letter * (len(name) + 0.5)
        if ends[0] <= a and end < ends[1] + 4 * letter and all(end <= begin or a >= stop for begin, stop in occupied):
            panel.text(a, 0.5, name, dx=3.0)
            occupied.append((a, end))


def _ends(time: np.ndarray) -> tuple[float, float]:
    return float(time[0]), float(time[-1])


def _any(which: np.ndarray | None) -> bool:
    return which is not None and bool(which.any())


def _times(time: np.ndarray, which: np.ndarray) -> np.ndarray:
    """(m, 2) [s]: runs of true values, those nearer to each other than a pixel made one, so that their number has a
    bound.
    """
    least = max(1, len(time) // 1500)
    merged: list[list[int]] = []
    for a, b in find_runs(which):
        if merged and a - merged[-1][1] < least:
            merged[-1][1] = b
        else:
            merged.append([a, b])
    return np.array([(time[a], time[b - 1]) for a, b in merged]).reshape(-1, 2)


def _round_below(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(k for k in (1, 2, 5) if k * power <= value) * power)
