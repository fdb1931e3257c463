"""The figures of a tracked recording's report, as PNG; none grows with the recording's length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..page import ACCENT, INK, LINE, SOFT, STYLE, Picture, new_figure, png_of
from ..recording.gaps import runs
from ..viewer import LEFT_COLOUR, OTHER_COLOUR, RIGHT_COLOUR
from .drawing import BEFORE, HATCHED, above, body, envelope, line_of
from .measures import Hand, Signal, largest
from .words import plain

PHASE: dict[str, Any] = {"facecolor": "#f6ecc8", "linewidth": 0.0}
PATH_POINTS = 20000


class Angle(NamedTuple):
    """An angle over time."""

    label: str
    values: np.ndarray  # (n,) [deg]; NaN breaks the line


def timeline_picture(
    time: np.ndarray, signals: Mapping[str, Signal], phases: Mapping[str, Sequence[tuple[float, float]]]
) -> Picture:
    """What each sensor did when: how fast it turned, where it was at rest, what was lost or cut off."""
    with rc_context(STYLE):
        figure = new_figure(0.95 + 0.5 * len(signals))
        panels: Sequence[Axes] = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0].tolist()
        most = 1.08 * max(1.0, max(float(np.degrees(signal.rate.max())) for signal in signals.values()))
        marked = {"rest": False, "gap": False, "cut": False}
        for axes, (name, signal) in zip(panels, signals.items(), strict=True):
            for spans in phases.values():
                for a, b in spans:
                    axes.axvspan(a, b, **PHASE, zorder=0)
            at, rate = envelope(time, np.degrees(signal.rate))
            axes.fill_between(at, 0.0, rate, color=line_of(name)["color"], linewidth=0.4)
            if signal.rest is not None and signal.rest.any():
                marked["rest"] = True
                bars = [(time[a], time[b - 1] - time[a]) for a, b in _merged(signal.rest, len(time))]
                axes.broken_barh(bars, (-0.13 * most, 0.13 * most), color=INK, linewidth=0.0)
            for a, b in _merged(signal.gap, len(time)):
                marked["gap"] = True
                axes.axvspan(time[a], time[b - 1], **HATCHED, zorder=4)
            if signal.cut.any():
                marked["cut"] = True
                first = [a for a, _ in _merged(signal.cut, len(time))]
                axes.plot(
                    time[first], np.full(len(first), 0.9 * most), "v", color=BEFORE, markeredgecolor=INK, zorder=5
                )
            axes.set_ylim(-0.15 * most, most)
            axes.set_ylabel(plain(name), rotation=0, ha="right", va="center")
            axes.set_yticks([0.0, _round_below(most)])
            axes.set_xlim(time[0], time[-1])
            axes.grid(axis="x", color=LINE, linewidth=0.7)
        _name_phases(panels[0], phases, time)
        panels[-1].set_xlabel("time in the recording [s]")
        handles: list[Any] = [Patch(color=SOFT, label="turning [deg/s]")]
        handles += [Patch(color=INK, label="at rest")] if marked["rest"] else []
        handles += [Patch(label="phase", **PHASE)] if phases else []
        handles += [Patch(label="lost and bridged", **HATCHED)] if marked["gap"] else []
        if marked["cut"]:
            cut: dict[str, Any] = {"marker": "v", "color": BEFORE, "markeredgecolor": INK}
            handles.append(Line2D([], [], linestyle="", label="cut off by the range", **cut))
        above(figure, handles)
        png = png_of(figure)
    caption = "How fast each sensor turned, all on one scale. Dark bars on the zero line: at rest by the filter's test."
    return Picture("timeline", caption, png)


def noise_picture(signals: Mapping[str, Signal]) -> Picture:
    """Noise and bias of each sensor that has them."""
    rows = {name: signal for name, signal in signals.items() if signal.bias is not None}
    with rc_context(STYLE):
        figure = new_figure(0.95 + 0.3 * len(rows))
        panels: Sequence[Axes] = figure.subplots(1, 3, sharey=True)
        place = np.arange(len(rows))[::-1]
        columns = (
            ("gyroscope's noise [deg/s]", [np.degrees(s.gyro_noise) for s in rows.values()], 3),
            ("accelerometer's noise [m/s²]", [s.accel_noise for s in rows.values()], 3),
        )
        for axes, (title, column, digits) in zip(panels, columns, strict=False):
            for at, value in zip(place, column, strict=True):
                axes.barh(at, value, 0.56, color=ACCENT)
                axes.annotate(
                    f"{value:.{digits}f}", (value, at), (4, 0), textcoords="offset points", va="center", ha="left"
                )
            axes.set_xlim(0.0, 1.4 * max(1e-6, *column))
            axes.set_title(title)
        biases = [
            np.degrees(np.linalg.norm(signal.bias, axis=1)) for signal in rows.values() if signal.bias is not None
        ]
        for at, (begin, end) in zip(place, biases, strict=True):
            panels[2].plot([begin, end], [at, at], color=ACCENT, linewidth=1.2)
            panels[2].plot(begin, at, "o", markersize=6.5, markerfacecolor="white", markeredgecolor=ACCENT)
            panels[2].plot(end, at, "D", markersize=4.5, color=ACCENT)
        panels[2].set_xlim(0.0, 1.12 * max(1e-6, *(float(b.max()) for b in biases)))
        panels[2].set_title("gyroscope's bias [deg/s]")
        for axes in panels:
            axes.grid(axis="x", color=LINE, linewidth=0.7)
        panels[0].set_yticks(place, [plain(name) for name in rows])
        panels[0].set_ylim(-0.6, len(rows) - 0.4)
        dot: dict[str, Any] = {"linestyle": "", "markeredgecolor": ACCENT}
        handles = [
            Line2D([], [], marker="o", markerfacecolor="white", markersize=6.5, label="bias in the still phase", **dot),
            Line2D([], [], marker="D", markersize=4.5, color=ACCENT, label="bias at the end", **dot),
        ]
        above(figure, handles)
        png = png_of(figure)
    caption = (
        "Noise of one axis in the still phase (a person's sway counts as noise there), and the size of the bias of the "
        "three axes together: as measured in the still phase, and as the filter knew it at the end."
    )
    return Picture("noise", caption, png)


def headings_picture(
    time: np.ndarray, std_deg: Mapping[str, np.ndarray], held: Sequence[tuple[float, float]]
) -> Picture:
    """What each segment's heading may be off by, over time; `held`: spans of joined hands [s]."""
    with rc_context(STYLE):
        figure = new_figure(3.2)
        axes = figure.add_subplot()
        for a, b in held:
            axes.axvspan(a, b, **PHASE, zorder=0)
        for name, values in std_deg.items():
            axes.plot(*envelope(time, values), **line_of(name))
        axes.set_xlim(time[0], time[-1])
        axes.set_ylim(0.0, 1.06 * max(0.1, *(largest(values) for values in std_deg.values())))
        axes.set_xlabel("time in the recording [s]")
        axes.set_ylabel("heading, ± [deg]")
        axes.grid(color=LINE, linewidth=0.7)
        handles: list[Any] = [Line2D([], [], label=plain(name), **line_of(name)) for name in std_deg]
        handles += [Patch(label="hands joined", **PHASE)] if held else []
        above(figure, handles, min(len(handles), 5))
        png = png_of(figure)
    return Picture("headings", "What each segment's heading may be off by: one standard deviation.", png)


def paths_picture(hands: Mapping[str, Hand], shoulder_width: float, trunk: float) -> Picture:
    """Where the hands went, seen from the torso: from the front, from the right, from above."""
    with rc_context(STYLE):
        figure = new_figure(3.5)
        panels: Sequence[Axes] = figure.subplots(1, 3)
        for axes, (title, across, up) in zip(
            panels, (("from the front", 1, 2), ("from the right", 0, 2), ("from above", 1, 0)), strict=True
        ):
            body(axes, title, 50 * shoulder_width, 100 * trunk)
            for name, hand in hands.items():
                stride = max(1, len(hand.reach) // PATH_POINTS)
                at = 100 * hand.reach[::stride][:, [across, up]]
                width = float(np.clip(0.9 * (3000 / len(at)) ** 0.4, 0.35, 0.9))
                axes.plot(at[:, 0], at[:, 1], color=_colour(name), linewidth=width, alpha=0.75, zorder=3)
                axes.plot(*at[0], "o" if name.startswith("left") else "s", color=_colour(name), markersize=6,
                          markeredgecolor="white", zorder=5)  # fmt: skip
            axes.set_aspect("equal", "datalim")
            axes.set_title(title)
            axes.set_xlabel({0: "forwards [cm]", 1: "to the person's left [cm]"}[across])
            axes.set_ylabel({0: "forwards [cm]", 2: "above the shoulders [cm]"}[up])
            axes.grid(color=LINE, linewidth=0.7)
        panels[2].invert_xaxis()  # as the person sees it: the left on the left
        above(figure, [
            Line2D([], [], color=_colour(name), marker="o" if name.startswith("left") else "s", markeredgecolor="white",
                   label=f"{plain(name)}, mark: beginning")
            for name in hands
        ])  # fmt: skip
        png = png_of(figure)
    return Picture(
        "paths", "Where the hands went, seen from the torso, which is taken as upright and facing ahead.", png
    )


def reach_picture(time: np.ndarray, hands: Mapping[str, Hand]) -> Picture:
    """The hands over time, along the torso's axes."""
    with rc_context(STYLE):
        figure = new_figure(4.2)
        panels: Sequence[Axes] = figure.subplots(3, 1, sharex=True)
        labels = ("forwards [cm]", "to the left [cm]", "above the\nshoulders [cm]")
        for k, (axes, label) in enumerate(zip(panels, labels, strict=True)):
            axes.axhline(0.0, color=SOFT, linewidth=0.7)
            for name, hand in hands.items():
                axes.plot(*envelope(time, 100 * hand.reach[:, k]), **_two(name))
            axes.set_ylabel(label)
            axes.grid(color=LINE, linewidth=0.7)
            axes.set_xlim(time[0], time[-1])
        panels[-1].set_xlabel("time in the recording [s]")
        figure.align_ylabels(list(panels))
        above(figure, [Line2D([], [], label=plain(name), **_two(name)) for name in hands])
        png = png_of(figure)
    return Picture("reach", "The hands over time, from the middle of the shoulders along the torso's axes.", png)


def angles_picture(time: np.ndarray, angles: Mapping[str, Sequence[Angle]], stem: str, caption: str) -> Picture:
    """A panel an angle, left and right in it; `angles`: what the axis says → the lines."""
    with rc_context(STYLE):
        figure = new_figure(0.9 + 1.5 * len(angles))
        panels: Sequence[Axes] = figure.subplots(len(angles), 1, sharex=True, squeeze=False)[:, 0].tolist()
        lines: dict[str, dict[str, Any]] = {}
        for axes, (label, of) in zip(panels, angles.items(), strict=True):
            axes.axhline(0.0, color=SOFT, linewidth=0.7)
            for angle in of:
                lines[angle.label] = _two(angle.label)
                axes.plot(*envelope(time, angle.values), **lines[angle.label])
            axes.set_ylabel(fill(label, 15, break_long_words=False))
            axes.grid(color=LINE, linewidth=0.7)
            axes.set_xlim(time[0], time[-1])
        panels[-1].set_xlabel("time in the recording [s]")
        figure.align_ylabels(panels)
        if len(lines) > 1:
            above(figure, [Line2D([], [], label=label, **style) for label, style in lines.items()])
        png = png_of(figure)
    return Picture(stem, caption, png)


def _colour(name: str) -> str:
    return {"l": LEFT_COLOUR, "r": RIGHT_COLOUR}.get(name[:1], OTHER_COLOUR)


def _two(name: str) -> dict[str, Any]:
    """Left in full, right in dashes: told apart without colour too."""
    return {"color": _colour(name), "linestyle": (0, (5, 1.5)) if name.startswith("right") else "-", "linewidth": 1.2}


def _merged(which: np.ndarray, n: int) -> list[tuple[int, int]]:
    """Runs of true values, those nearer to each other than a pixel made one, so that their number has a bound."""
    least = max(1, n // 1500)
    merged: list[tuple[int, int]] = []
    for a, b in runs(which):
        if merged and a - merged[-1][1] < least:
            merged[-1] = (merged[-1][0], b)
        else:
            merged.append((a, b))
    return merged


def _round_below(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(k for k in (1, 2, 5) if k * power <= value) * power)


def _name_phases(axes: Axes, phases: Mapping[str, Sequence[tuple[float, float]]], time: np.ndarray) -> None:
    """Names of the phases above the panels where there is room, those of long ones first."""
    letter = 0.0095 * float(time[-1] - time[0])
    taken: list[tuple[float, float]] = []
    for _, a, name in sorted((a - b, a, name) for name, spans in phases.items() for a, b in spans):
        end = a + letter * (len(name) + 0.5)
        if end < time[-1] + 4 * letter and all(end <= begin or a >= stop for begin, stop in taken):
            axes.annotate(name, (a, 1.0), (0, 2), xycoords=("data", "axes fraction"), textcoords="offset points")
            taken.append((a, end))
