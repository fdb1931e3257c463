"""The figures of a calibration's report, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from scipy.spatial.transform import Rotation

from ..page import ACCENT, FONT, INK, LINE, SOFT, STYLE, Picture, capital, new_figure, png_of
from ..viewer import LEFT_COLOUR, OTHER_COLOUR, RIGHT_COLOUR
from .drawing import BAND, BEFORE, HATCHED, above, body, broken
from .words import plus_minus, signed

TELLING = LinearSegmentedColormap.from_list("telling", ["#dbe9f4", "#7fb0d3", ACCENT, "#0e2a40"])
CELL = 5.0  # [cm] of the map of the hands
SMOOTHED_S = 2.0
EXAGGERATED_DEG = 24.0  # the largest tilt is drawn about so large
MOST_EXAGGERATED = 6


class Length(NamedTuple):
    """A row of the lengths, all in m; NaN where something is not known."""

    label: str
    value: float
    std: float
    prior: float
    prior_std: float
    taped: float


class Sensor(NamedTuple):
    """A row of the sensors, all in degrees; NaN where something is not known."""

    label: str
    tilt_std: float
    heading_std: float
    drift_deg_min: float


class Hands(NamedTuple):
    """Where the joined hands were."""

    reach: np.ndarray  # (n, 3) [m] from the middle of the shoulders, in the torso's frame
    learned: np.ndarray  # (n,) [%] of what is known at the end
    touched: np.ndarray  # (n,) bool
    shoulder_width: float  # [m]
    trunk: float  # [m]


def lengths_picture(rows: Sequence[Length]) -> Picture:
    """Each length beside the average person's, with intervals."""
    with rc_context(STYLE):
        figure = new_figure(1.0 + 0.32 * len(rows))
        axes = figure.add_subplot()
        place = np.arange(len(rows))[::-1]
        reach = [0.0]
        for at, row in zip(place, rows, strict=True):
            off, std, before = (1e3 * v for v in (row.value - row.prior, row.std, row.prior_std))
            if np.isfinite(before):
                axes.barh(at, 2 * before, 0.62, -before, color=BAND)
                axes.plot([0.0, 0.0], [at - 0.31, at + 0.31], color=SOFT, linewidth=1.0)
            if np.isfinite(std):
                axes.plot([off - 2 * std, off + 2 * std], [at, at], color=ACCENT, linewidth=1.0)
                axes.plot([off - std, off + std], [at, at], color=ACCENT, linewidth=3.2, solid_capstyle="butt")
            axes.plot(off, at, "o", color=ACCENT, markersize=6, markeredgecolor="white", markeredgewidth=0.8)
            if np.isfinite(row.taped):
                taped = 1e3 * (row.taped - row.prior)
                axes.plot(taped, at + 0.24, "v", markersize=6, markerfacecolor="white", markeredgecolor=INK)
                reach.append(taped)
            reach += [v for v in (-before, before, off - 2 * std, off + 2 * std, off) if np.isfinite(v)]
            axes.annotate(
                plus_minus(1e3 * row.value, 1e3 * row.std, "mm", 0), (1.01, at), xycoords=("axes fraction", "data"),
                va="center",
            )  # fmt: skip
        margin = 0.04 * (max(reach) - min(reach)) + 1.0
        axes.set_xlim(min(reach) - margin, max(reach) + margin)
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_yticks(place, [row.label for row in rows])
        axes.set_xlabel("longer than the average person's [mm]")
        axes.grid(axis="x", color=LINE, linewidth=0.7)
        dot = Line2D(
            [], [], color=ACCENT, marker="o", linewidth=3.0, markeredgecolor="white", label="found, ± 1 and 2 std"
        )
        tape = Line2D([], [], linestyle="", marker="v", markerfacecolor="white", markeredgecolor=INK, label="taped")
        known = any(np.isfinite(row.taped) for row in rows)
        average = Patch(color=BAND, label="average person, ± 1 std")
        above(figure, [dot, average, *([tape] if known else [])])
        png = png_of(figure)
    return Picture("lengths", "Lengths against the average person's; to the right what was found.", png)


def sensors_picture(rows: Sequence[Sensor], tilt_before_deg: float, drift_before: float) -> Picture:
    """How well each mount is known, and how its heading drifted."""
    with rc_context(STYLE):
        figure = new_figure(0.95 + 0.3 * len(rows))
        panels: Sequence[Axes] = figure.subplots(1, 3, sharey=True)
        place = np.arange(len(rows))[::-1]
        columns = [[row.tilt_std for row in rows], [row.heading_std for row in rows], [r.drift_deg_min for r in rows]]
        titles = ["tilt of the mount, ± [deg]", "heading of the mount, ± [deg]", "heading drift [deg/min]"]
        for axes, column, title in zip(panels, columns, titles, strict=True):
            most = max([1e-3, *(abs(v) for v in column if np.isfinite(v))])
            drift = axes is panels[2]
            if drift:
                axes.axvspan(-drift_before, drift_before, color=BAND, zorder=0)
                axes.axvline(0.0, color=INK, linewidth=0.8)
                most = max(most, drift_before)
            if axes is panels[0]:
                axes.axvline(tilt_before_deg, color=SOFT, linewidth=1.2, linestyle=(0, (4, 2)))
                most = max(most, tilt_before_deg)
            for at, value in zip(place, column, strict=True):
                if not np.isfinite(value):
                    axes.annotate("not known", (0.0, at), (4, 0), textcoords="offset points", va="center", color=SOFT)
                    continue
                axes.barh(at, value, 0.56, color=ACCENT)
                text = signed(value) if drift else f"{value:.1f}"
                where: dict[str, Any] = {"ha": "right" if value < 0.0 else "left", "va": "center"}
                axes.annotate(text, (value, at), (-4 if value < 0.0 else 4, 0), textcoords="offset points", **where)
            axes.set_xlim(-1.35 * most if drift else 0.0, (1.35 if drift else 1.18) * most)
            axes.set_title(title)
            axes.grid(axis="x", color=LINE, linewidth=0.7)
        panels[0].set_yticks(place, [row.label for row in rows])
        panels[0].set_ylim(-0.6, len(rows) - 0.4)
        line = Line2D([], [], color=SOFT, linewidth=1.2, linestyle=(0, (4, 2)), label="by the start pose alone")
        above(figure, [line, Patch(color=BAND, label="drift that is usual, ± 1 std")])
        png = png_of(figure)
    return Picture("sensors", "How well each sensor's mount is known (one standard deviation), and its drift.", png)


def gap_picture(
    time: np.ndarray,
    gap: np.ndarray,
    prior_gap: np.ndarray,
    apart: Sequence[tuple[float, float]],
    told: Mapping[str, np.ndarray],
    label: str,
) -> Picture:
    """The gap before and after over time, and below how much each second told.

    Parameters
    ----------
    apart : spans [s] in which the palms were apart
    told : name → (n,) [%/s]
    label : what the gap is
    """
    with rc_context(STYLE):
        figure = new_figure(4.6 if told else 2.9)
        panels: Sequence[Axes]
        rows = 2 if told else 1
        panels = figure.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=[1.25, 1.0][:rows])[:, 0].tolist()
        top = panels[0]
        top.plot(*broken(time, 1e3 * prior_gap), color=BEFORE, linewidth=1.0, linestyle=(0, (4, 1.5)))
        top.plot(*broken(time, 1e3 * gap), color=ACCENT, linewidth=1.4)
        top.set_ylabel(f"{label} [mm]")
        shown = np.concatenate([gap, prior_gap]) * 1e3
        touched = ~np.any([(time >= a) & (time <= b) for a, b in apart] or [np.zeros(len(time), bool)], axis=0)
        usual = np.concatenate([gap[touched], prior_gap[touched]]) * 1e3 if touched.any() else shown
        usual = usual[np.isfinite(usual)]
        top.set_ylim(0.0, 1.12 * max(float(usual.max(initial=0.0)), 1.0))  # the palms apart may leave the picture
        handles: list[Any] = [
            Line2D([], [], color=BEFORE, linestyle=(0, (4, 1.5)), label="with the average person's lengths"),
            Line2D([], [], color=ACCENT, label="with the lengths found"),
        ]
        if told:
            for (name, values), style in zip(told.items(), _STYLES, strict=False):
                panels[1].plot(*broken(time, values), label=name, **style)
            panels[1].set_ylim(bottom=0.0)
            panels[1].set_ylabel("learned [% per second]")
            panels[1].legend(loc="upper right", ncols=len(told), frameon=False, handlelength=2.6)
            panels[1].margins(y=0.25)
        for axes in panels:
            for a, b in apart:
                axes.axvspan(a, b, **HATCHED, zorder=0)
            axes.grid(color=LINE, linewidth=0.7)
            axes.set_xlim(time[0], time[-1])
        if apart:
            handles.append(Patch(label="apart, left out", **HATCHED))
        panels[-1].set_xlabel("time in the recording [s]")
        above(figure, handles)
        png = png_of(figure)
    caption = capital(f"{'above: ' * bool(told)}{label}, before and after.")
    if told:
        caption += (
            f" Below: the share of what is known at the end that each second told, over {SMOOTHED_S:g} s; where it is "
            "high the motion was informative."
        )
    return Picture("gap", caption, png)


def hands_picture(hands: Hands, noun: str) -> Picture:
    """Where the hands were, and how much they told there: from the front, from the right, from above."""
    with rc_context(STYLE):
        figure = new_figure(3.5)
        panels: Sequence[Axes] = figure.subplots(1, 3)
        reach = 100 * hands.reach
        half, trunk = 50 * hands.shoulder_width, 100 * hands.trunk
        views = (("from the front", 1, 2), ("from the right", 0, 2), ("from above", 1, 0))
        drawn, most = [], 1e-9
        for axes, (title, across, up) in zip(panels, views, strict=True):
            body(axes, title, half, trunk)
            told, edges = _cells(reach[hands.touched][:, [across, up]], hands.learned[hands.touched])
            most = max(most, float(told.max()))
            drawn.append(axes.pcolormesh(*edges, told.T, cmap=TELLING, zorder=3))
            away = ~hands.touched
            axes.scatter(reach[away, across], reach[away, up], 14, BEFORE, marker="x", linewidths=0.9, zorder=4)
            axes.set_aspect("equal", "datalim")
            axes.set_title(title)
            axes.set_xlabel({0: "forwards [cm]", 1: "to the person's left [cm]"}[across])
            axes.set_ylabel({0: "forwards [cm]", 2: "above the shoulders [cm]"}[up])
            axes.grid(color=LINE, linewidth=0.7)
        norm = Normalize(0.0, most)
        for mesh in drawn:
            mesh.set_norm(norm)
        # From above as the person sees it: the left on the left.
        panels[2].invert_xaxis()
        bar = figure.colorbar(ScalarMappable(norm, TELLING), ax=list(panels), shrink=0.85, pad=0.01)
        bar.set_label(f"learned in a cell of {CELL:g} cm [%]")
        bar.outline.set_edgecolor(SOFT)
        png = png_of(figure)
    caption = f"Where {noun} went, seen from the torso; the darker, the more was learned there."
    if not hands.touched.all():
        caption += " Crosses: apart."
    return Picture("hands", caption, png)


def posture_picture(
    tilt: Mapping[str, np.ndarray], seen: Mapping[str, Sequence[bool]], lengths: Mapping[str, float]
) -> Picture:
    """The start pose from the front and from both sides, with its tilts drawn larger than they are.

    Parameters
    ----------
    tilt, seen : segment → (2,) [rad] about x and y; whether the motion told anything about it
    """
    largest = max([1e-9, *(float(np.degrees(np.linalg.norm(t))) for t in tilt.values())])
    factor = int(np.clip(round(EXAGGERATED_DEG / largest), 1, MOST_EXAGGERATED))
    with rc_context(STYLE):
        figure = new_figure(4.0)
        arms = [side for side in ("left", "right") if any(name.startswith(side) for name in tilt)]
        panels: Sequence[Axes] = figure.subplots(1, 1 + len(arms), squeeze=False)[0].tolist()
        held, meant = (_stick(tilt, lengths, f) for f in (factor, 0))
        views = [("from the front", 1, arms), *((f"from the {side}", 0, [side]) for side in arms)]
        for axes, (title, across, sides) in zip(panels, views, strict=True):
            head = held["torso"][1] + Rotation.from_rotvec([*(factor * tilt.get("torso", np.zeros(2))), 0.0]).apply(
                [0.0, 0.0, 0.2]
            )
            axes.add_patch(Circle((100 * head[across], 100 * head[2]), 9.5, facecolor="#e6eaef", edgecolor="none"))
            axes.plot(*_line([held["torso"][1], head], across), color="#e6eaef", linewidth=6.0, zorder=1)
            if across == 1:
                axes.plot(*_line([held["left_shoulder"][0], held["right_shoulder"][0]], across), **_limb(OTHER_COLOUR))
            for name in ("torso", *(f"{side}_{part}" for side in sides for part in ("upper_arm", "forearm"))):
                if name not in tilt:
                    continue
                colour = {"l": LEFT_COLOUR, "r": RIGHT_COLOUR}.get(name[0], OTHER_COLOUR)
                axes.plot(*_line(meant[name], across), color=SOFT, linewidth=1.0, linestyle=(0, (2, 2)), zorder=4)
                axes.plot(*_line(held[name], across), **_limb(colour))
                angle = float(np.degrees(tilt[name][0 if across == 1 else 1]))
                middle = 100 * np.mean(held[name], axis=0)
                right = (middle[1] >= 0.0) if across == 1 else title == "from the right"
                if name == "torso":
                    where: dict[str, Any] = {"xytext": (0, -9), "ha": "center", "va": "top"}
                    middle = np.zeros(3)
                else:
                    where = {"xytext": (11 if right else -11, 0), "ha": "left" if right else "right", "va": "center"}
                text = f"{abs(angle):.1f}° {direction(name, across, angle)}" if abs(angle) >= 0.05 else "0.0°"
                text = text if seen[name][0 if across == 1 else 1] else "not seen"
                axes.annotate(
                    f"torso {text}" if name == "torso" else text, (middle[across], middle[2]),
                    textcoords="offset points", fontsize=FONT - 0.5, zorder=6,
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0}, **where,
                )  # fmt: skip
            axes.set_title(title)
            axes.set_aspect("equal")
            axes.set_ylim(-12.0, 100 * lengths["trunk"] + 36.0)
            axes.set_xlim(-48.0, 48.0)
            if title == "from the left":
                axes.invert_xaxis()
            axes.set_axis_off()
        dotted = Line2D([], [], color=SOFT, linewidth=1.0, linestyle=(0, (2, 2)), label="as meant")
        colours = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR}
        limbs = [Line2D([], [], color=colours[side], linewidth=4.5, label=side) for side in arms]
        above(figure, [*limbs, dotted])
        png = png_of(figure)
    drawn = f"drawn {factor} times as large as they are" if factor > 1 else "as they are"
    return Picture("posture", f"How the start pose was held; tilts {drawn}, the degrees are the true ones.", png)


def direction(segment: str, across: int, angle: float) -> str:
    """Where a tilt takes the free end: the torso's upper, an arm's lower; `across` 0: from the side, 1: from before."""
    positive = angle > 0.0
    if segment == "torso":
        if across == 0:
            return "forwards" if positive else "backwards"
        return "to the right" if positive else "to the left"
    if across == 0:
        return "backwards" if positive else "forwards"
    return "outwards" if positive == segment.startswith("left") else "inwards"


def smoothed(time: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(n,) shares of each look → (n,) [%/s], over `SMOOTHED_S` around each look."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    half = SMOOTHED_S / 2.0
    total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(share))))
    first, last = np.searchsorted(time, time - half), np.searchsorted(time, time + half, "right")
    return 100.0 * (total[last] - total[first]) / ((last - first) * step)


_STYLES: tuple[dict[str, Any], ...] = (
    {"color": INK, "linewidth": 1.4},
    {"color": "#4b9a55", "linewidth": 1.4, "linestyle": (0, (5, 1.5))},
    {"color": "#a04c9c", "linewidth": 1.4, "linestyle": (0, (1.2, 1.2))},
)


def _limb(colour: str) -> dict[str, Any]:
    return {"color": colour, "linewidth": 5.0, "solid_capstyle": "round", "zorder": 3}


def _line(ends: Sequence[np.ndarray], across: int) -> tuple[list[float], list[float]]:
    return [100 * float(end[across]) for end in ends], [100 * float(end[2]) for end in ends]


def _cells(at: np.ndarray, learned: np.ndarray) -> tuple[np.ma.MaskedArray, tuple[np.ndarray, np.ndarray]]:
    """Learned in each cell of a plane, masked where the hands never were, and the cells' edges; `at` (n, 2) [cm]."""
    low, high = np.floor(at.min(axis=0) / CELL), np.floor(at.max(axis=0) / CELL) + 1
    across, up = (CELL * np.arange(a, b + 0.5) for a, b in zip(low, high, strict=True))
    count, _, _ = np.histogram2d(at[:, 0], at[:, 1], bins=[across, up])
    total, _, _ = np.histogram2d(at[:, 0], at[:, 1], bins=[across, up], weights=learned)
    return np.ma.masked_where(count == 0, total), (across, up)


def _stick(tilt: Mapping[str, np.ndarray], lengths: Mapping[str, float], factor: float) -> dict[str, list[np.ndarray]]:
    """Segment → its two ends [m], root of the trunk at zero, each tilt `factor` times as large; and the shoulders."""

    def turned(name: str, v: Sequence[float]) -> np.ndarray:
        return Rotation.from_rotvec([*(factor * tilt.get(name, np.zeros(2))), 0.0]).apply(v)

    top = turned("torso", [0.0, 0.0, lengths["trunk"]])
    ends = {"torso": [np.zeros(3), top]}
    for side, sign in (("left", 0.5), ("right", -0.5)):
        at = top + turned("torso", [0.0, sign * lengths["shoulder_width"], 0.0])
        ends[f"{side}_shoulder"] = [at, at]
        for part in ("upper_arm", "forearm"):
            name = f"{side}_{part}"
            ends[name] = [at, at + turned(name, [0.0, 0.0, -lengths[name]])]
            at = ends[name][1]
    return ends
