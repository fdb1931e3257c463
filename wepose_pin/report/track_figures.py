"""The charts of a tracked recording's report; the size of none grows with the recording's length."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..model import ROOT, BodyTable
from ..recording.gaps import find_runs
from ..tracking.measures import Signal, TipMotion, finite_max
from .chart import WIDTH, Chart, Key, Panel, Picture, category_rows, envelope
from .words import listed, plain, plural

TIME = "time in the recording [s]"
PATH_POINTS = 3000
Spans = Sequence[tuple[float, float]]


def draw_timeline(
    time: np.ndarray, signals: Mapping[str, Signal], phases: Mapping[str, Spans], styles: Mapping[str, str]
) -> Picture:
    """Each sensor over time: how fast it rotated, where it was static, lost, or cut off by its range.

    `styles`: of each sensor's line, of `line_style`.
    """
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
        panel.area(*envelope(time, np.degrees(signal.rate)), styles[name].split()[0])
        if signal.static is not None:
            panel.boxes(find_times(time, signal.static), (-0.13 * most, 0.0), "ink")
        panel.spans(find_times(time, signal.gap), "hatched")
        if signal.cut.any():
            first = find_times(time, signal.cut)[:, 0]
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


def draw_headings(
    time: np.ndarray, std_deg: Mapping[str, np.ndarray], clasps: Spans, styles: Mapping[str, str]
) -> Picture:
    """What each segment's heading may be off by, over time; `clasps`: spans of joined hands [s], `styles`: of lines."""
    most = 1.06 * max(0.1, *(finite_max(values) for values in std_deg.values()))
    panel = Panel("heading, ± [°]", TIME, x=_ends(time), y=(0.0, most))
    panel.spans(clasps, "phase")
    for name, values in std_deg.items():
        panel.line(*envelope(time, values), styles[name])
    keys = [Key(plain(name), styles[name]) for name in std_deg]
    keys += [Key("hands joined", "phase", "box")] if clasps else []
    caption = "What each segment's heading may be off by: one standard deviation."
    return Picture("headings", caption, Chart([[panel]], [230.0], keys))


class TipGroup(NamedTuple):
    """Points whose paths are drawn together, for their limbs hang on the same points.

    Parameters
    ----------
    tips : point → its motion
    nouns : what the points are on, as "hands"
    origin, start : what the limbs hang at, as "shoulders", and where a reach begins, as "the middle of the shoulders"
    base : the segment there; empty: the root
    width, trunk : [m] between the points at which they hang, and from the root to their middle; None: no such length
    """

    tips: Mapping[str, TipMotion]
    nouns: str
    origin: str
    start: str
    base: str
    width: float | None
    trunk: float | None

    @property
    def frame(self) -> str:
        """Whose axes its coordinates are along, in words."""
        return f"the {self.base}'s axes" if self.base else "the axes of W"


def group_tips(tips: Mapping[str, TipMotion], table: BodyTable, lengths: Mapping[str, float]) -> list[TipGroup]:
    """The tips by the points at which their limbs hang; `lengths` [m] are the person's."""
    by_origin: dict[tuple[str, ...], list[str]] = {}
    limbs = table.drawn_limbs
    for name in tips:
        by_origin.setdefault(limbs[name].origin, []).append(name)
    groups = []
    for origin, names in by_origin.items():
        width, trunk = (lengths.get(table.find_length(*points) or "") for points in (origin, (ROOT, *origin)))
        nouns = (table.shared_name((limbs[name].segments or (name,))[-1]) for name in names)
        hangs_at = plain(table.shared_name(origin[0]))
        hangs_at, start = (plural(hangs_at), "the middle of the ") if len(origin) > 1 else (hangs_at, "the ")
        groups.append(
            TipGroup(
                {name: tips[name] for name in names},
                listed([plural(plain(noun)) for noun in dict.fromkeys(nouns)]),
                hangs_at,
                start + hangs_at,
                plain(limbs[names[0]].base or ""),
                width,
                trunk,
            )
        )
    return groups


def draw_paths(group: TipGroup, sides: Mapping[str, str], stem: str) -> Picture:
    """Where the tips went, seen from the body: from the front, from the right, from above.

    `sides`: of each tip, as the first word of `line_style`.
    """
    panels = []
    for panel, across, up in body_views(group.width, group.trunk, group.origin):
        for name, tip in group.tips.items():
            at = 100.0 * tip.reach[:: max(1, len(tip.reach) // PATH_POINTS)][:, [across, up]]
            panel.line(at[:, 0], at[:, 1], f"{sides[name]} faint")
            panel.markers(at[0, 0], at[0, 1], "square" if sides[name] == "right" else "circle", sides[name])
        panels.append(panel)
    keys = [
        Key(f"{plain(name)}, mark: beginning", sides[name], "square" if sides[name] == "right" else "circle")
        for name in group.tips
    ]
    seen = f", seen from the {group.base}, which is taken as upright and facing ahead" if group.base else ""
    return Picture(stem, f"Where the {group.nouns} went{seen}.", Chart([panels], [260.0], keys))


def body_views(width: float | None, trunk: float | None, origin: str) -> list[tuple[Panel, int, int]]:
    """Panels with head, shoulders and trunk [cm], and the axes that each shows; zero is between the shoulders.

    Parameters
    ----------
    width, trunk : [m] of the shoulders, or of what else the limbs hang at, and from there to the root; None: not drawn
    origin : what the limbs hang at, as "shoulders"
    """
    labels = ("forwards [cm]", "to the person's left [cm]", f"above the {origin} [cm]")
    views = []
    for view, across, up in (("from the front", 1, 2), ("from the right", 0, 2), ("from above", 1, 0)):
        panel = Panel(f"{view}: {labels[up]}", labels[across], equal=True, flip_x=view == "from above")
        if trunk is not None:
            panel.disc(0.0, 0.0 if up == 0 else 20.0, 10.0, "band")
        if across == 1 and width is not None:
            panel.line(np.array([-50.0, 50.0]) * width, np.zeros(2), "band limb")
        if up == 2 and trunk is not None:
            panel.line(np.zeros(2), np.array([0.0, -100.0 * trunk]), "band limb")
        views.append((panel, across, up))
    return views


def draw_reach(time: np.ndarray, group: TipGroup, sides: Mapping[str, str], stem: str) -> Picture:
    """The tips over time, along the axes of the segment on which their limbs hang."""
    panels = {
        label: {name: 100.0 * tip.reach[:, k] for name, tip in group.tips.items()}
        for k, label in enumerate(("forwards [cm]", "to the left [cm]", f"above the {group.origin} [cm]"))
    }
    caption = f"The {group.nouns} over time, from {group.start} along {group.frame}."
    return draw_over_time(time, panels, stem, caption, sides)


def draw_over_time(
    time: np.ndarray,
    panels: Mapping[str, Mapping[str, np.ndarray]],
    stem: str,
    caption: str,
    sides: Mapping[str, str],
) -> Picture:
    """A panel for each title, with its lines by name: left in full, right dashed; NaN breaks a line.

    `sides`: of each line, "left", "right", or another that is neither.
    """
    styles = {name: {"left": "left", "right": "right dashed"}.get(side, "other") for name, side in sides.items()}
    rows = []
    for title, lines in panels.items():
        panel = Panel(title, x=_ends(time), shown_x=False)
        panel.rule("soft thin", y=0.0)
        for name, values in lines.items():
            panel.line(*envelope(time, values), styles[name])
        rows.append([panel])
    rows[-1][0].shown_x, rows[-1][0].x_label = True, TIME
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    keys = [Key(plain(name), styles[name]) for name in names] if len(names) > 1 else []
    return Picture(stem, caption, Chart(rows, [105.0] * len(rows), keys))


def line_style(name: str, table: BodyTable) -> str:
    """The style of a segment's line: the side by colour, its place among the segments of that side by dashes."""
    side = table.side(name)
    members = [segment for segment in table.segments if table.side(segment) == side]
    rank = members.index(name) if name in members else 0
    return f"{side or 'other'} {('', 'dashed', 'dotted')[rank % 3]}"


def find_sides(names: Iterable[str], table: BodyTable) -> dict[str, str]:
    """Name → its side as a style: "left", "right" or "other"."""
    return {name: table.side(name) or "other" for name in names}


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


def find_times(time: np.ndarray, which: np.ndarray) -> np.ndarray:
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
