"""The charts of a calibration's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .chart import Anchor, Chart, Key, Panel, Picture, category_rows
from .track_figures import TIME, body_views
from .words import capital, plus_minus, signed

CELL = 5.0  # [cm] of the map of the hands
SHADES = 6  # of the map of the hands: classes shade1 to shade6
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
    measured: float


class Sensor(NamedTuple):
    """A row of the sensors, all in degrees; NaN where something is not known."""

    label: str
    tilt_std: float
    heading_std: float
    drift_deg_min: float


class Hands(NamedTuple):
    """Places of the joined hands."""

    reach: np.ndarray  # (n, 3) [m] from the middle of the shoulders, in the torso's frame
    learned: np.ndarray  # (n,) [%] share of the information
    touched: np.ndarray  # (n,) bool
    shoulder_width: float  # [m]
    trunk: float  # [m]


def draw_lengths(rows: Sequence[Length]) -> Picture:
    """Each length beside the population prior, with intervals."""
    panel = Panel(x_label="longer than the population prior [mm]", right=110.0)
    for at, row in zip(category_rows(panel, [row.label for row in rows]), rows, strict=True):
        off, std, before = (1e3 * v for v in (row.value - row.prior, row.std, row.prior_std))
        if np.isfinite(before):
            panel.boxes((-before, before), (at - 0.31, at + 0.31), "band")
            panel.line(np.zeros(2), np.array([at - 0.31, at + 0.31]), "soft thin")
        if np.isfinite(std):
            panel.line(np.array([off - 2 * std, off + 2 * std]), np.full(2, at), "accent thin")
            panel.line(np.array([off - std, off + std]), np.full(2, at), "accent bold")
        panel.markers(off, at, "circle", "accent", size=5.0)
        if np.isfinite(row.measured):
            panel.markers(1e3 * (row.measured - row.prior), at + 0.3, "triangle", "ink hollow")
        panel.text(np.inf, at, plus_minus(1e3 * row.value, 1e3 * row.std, "mm", 0), dx=8.0)
    keys = [
        Key("estimated, ± 1 and 2 standard deviations", "accent", "circle"),
        Key("population prior, ± 1", "band", "box"),
    ]
    if any(np.isfinite(row.measured) for row in rows):
        keys.append(Key("measured", "ink hollow", "triangle"))
    return Picture(
        "lengths",
        "Lengths against the population prior's; to the right the estimates.",
        Chart([[panel]], [26.0 * len(rows) + 6.0], keys),
    )


def draw_sensors(rows: Sequence[Sensor], tilt_before_deg: float, drift_before: float) -> Picture:
    """The uncertainty of each mount, and the drift of its heading."""
    names = [row.label for row in rows]
    columns = [[row.tilt_std for row in rows], [row.heading_std for row in rows], [r.drift_deg_min for r in rows]]
    titles = ["tilt of the mount, ± [°]", "heading of the mount, ± [°]", "heading drift [°/min]"]
    panels: list[Panel] = []
    for k, (title, column) in enumerate(zip(titles, columns, strict=True)):
        before = (tilt_before_deg, 0.0, drift_before)[k]
        most = max([1e-3, before, *(abs(value) for value in column if np.isfinite(value))])
        panel = Panel(title, x=(-1.35 * most if k == 2 else 0.0, 1.25 * most), shown_y=not panels)
        if k == 2:
            panel.spans([(-before, before)], "band")
            panel.rule("ink thin", x=0.0)
        if k == 0:
            panel.rule("soft dashed", x=before)
        for at, value in zip(category_rows(panel, names), column, strict=True):
            if not np.isfinite(value):
                panel.text(0.0, at, "not known", "soft", dx=5.0)
                continue
            panel.boxes((min(value, 0.0), max(value, 0.0)), (at - 0.28, at + 0.28), "accent")
            left = value < 0.0
            text = signed(value) if k == 2 else f"{value:.1f}"
            panel.text(value, at, text, "halo", "end" if left else "start", dx=-5.0 if left else 5.0)
        panels.append(panel)
    keys = [Key("by the start pose alone", "soft dashed"), Key("drift that is usual, ± 1", "band", "box")]
    caption = "How well each sensor's mount is known (one standard deviation), and its drift."
    return Picture("sensors", caption, Chart([panels], [26.0 * len(rows) + 6.0], keys))


def draw_gap(
    time: np.ndarray,
    gap: np.ndarray,
    prior_gap: np.ndarray,
    apart: Sequence[tuple[float, float]],
    learned: Mapping[str, np.ndarray],
    label: str,
) -> Picture:
    """The gap before and after over time, and below how much each second showed.

    Parameters
    ----------
    apart : spans [s] in which the palms were apart
    learned : name → (n,) [%/s]
    label : what the gap is
    """
    touched = ~np.any([(time >= a) & (time <= b) for a, b in apart] or [np.zeros(len(time), bool)], axis=0)
    usual = np.concatenate([gap[touched], prior_gap[touched]] if touched.any() else [gap, prior_gap]) * 1e3
    most = 1.12 * max(float(np.max(usual, initial=0.0, where=np.isfinite(usual))), 1.0)
    ends = float(time[0]), float(time[-1])
    top = Panel(f"{label} [mm]", x=ends, y=(0.0, most))  # where the palms are apart the line may leave the picture
    top.spans(apart, "hatched")
    top.line(*broken(time, 1e3 * prior_gap), "before dashed")
    top.line(*broken(time, 1e3 * gap), "accent")
    keys = [Key("with the population prior's lengths", "before dashed"), Key("with the estimated lengths", "accent")]
    panels = [top]
    if learned:
        most = max(float(np.nanmax(values)) for values in learned.values())
        panels.append(Panel("learned [% per second]", x=ends, y=(0.0, 1.12 * max(most, 1e-6))))
        panels[1].spans(apart, "hatched")
        for (name, values), style in zip(learned.items(), _STYLES, strict=False):
            panels[1].line(*broken(time, values), style)
            keys.append(Key(f"learned about {name}", style))
        top.shown_x = False
    if apart:
        keys.append(Key("apart, left out", "hatched", "box"))
    panels[-1].x_label = TIME
    caption = capital(f"{'above: ' * bool(learned)}{label}, before and after.")
    if learned:
        caption += (
            f" Below: the share of the information that each second gave, over {SMOOTHED_S:g} s; where it is "
            "high the motion was informative."
        )
    return Picture("gap", caption, Chart([[panel] for panel in panels], [170.0, 120.0][: len(panels)], keys))


def draw_hands(hands: Hands, noun: str) -> Picture:
    """Where the hands were, and how much they showed there: from the front, from the right, from above."""
    reach = 100 * hands.reach
    views = body_views(50 * hands.shoulder_width, 100 * hands.trunk)
    cells = [_cells(reach[hands.touched][:, [x, y]], hands.learned[hands.touched]) for _, x, y in views]
    most = max([1e-9, *(float(total.max()) for _, total in cells)])
    for (panel, x, y), (corners, total) in zip(views, cells, strict=True):
        shade = np.ceil(SHADES * total / most).clip(1, SHADES)
        for k in range(1, SHADES + 1):
            at = corners[shade == k]
            panel.boxes(at[:, :1] + [0.0, CELL], at[:, 1:] + [0.0, CELL], f"shade{k}")
        panel.markers(reach[~hands.touched, x], reach[~hands.touched, y], "cross", "before crosses", size=3.0)
    keys = [Key(f"to {most * k / SHADES:.2g} %", f"shade{k}", "box") for k in range(1, SHADES + 1)]
    caption = f"Where {noun} went, seen from the torso; the darker, the more was learned in a cell of {CELL:g} cm."
    if not hands.touched.all():
        caption += " Crosses: apart."
    return Picture("hands", caption, Chart([[panel for panel, _, _ in views]], [260.0], keys))


def draw_posture(
    tilt: Mapping[str, np.ndarray], observed: Mapping[str, Sequence[bool]], lengths: Mapping[str, float]
) -> Picture:
    """The start pose from the front and from both sides, with its tilts drawn larger than they are.

    Parameters
    ----------
    tilt, observed : segment → (2,) [rad] about x and y; whether the motion showed anything about it
    """
    largest = max([1e-9, *(float(np.degrees(np.linalg.norm(t))) for t in tilt.values())])
    factor = int(np.clip(round(EXAGGERATED_DEG / largest), 1, MOST_EXAGGERATED))
    arms = [side for side in ("left", "right") if any(name.startswith(side) for name in tilt)]
    tilted, exact = (_stick(tilt, lengths, f) for f in (factor, 0))
    views = [("from the front", 1, arms), *((f"from the {side}", 0, [side]) for side in arms)]
    panels = []
    for title, across, sides in views:
        panel = Panel(title, x=(-48.0, 48.0), y=(-12.0, 100 * lengths["trunk"] + 36.0), equal=True, bare=True)
        panel.flip_x = title == "from the left"
        head = tilted["head"][1]
        panel.disc(100 * head[across], 100 * head[2], 9.5, "band")
        panel.line(*_ends(tilted["head"], across), "band limb")
        if across == 1:
            shoulders = [tilted["left_shoulder"][0], tilted["right_shoulder"][0]]
            panel.line(*_ends(shoulders, across), "other limb")
        for name in ("torso", *(f"{side}_{part}" for side in sides for part in ("upper_arm", "forearm"))):
            if name in tilt:
                about = 0 if across == 1 else 1
                panel.line(*_ends(tilted[name], across), f"{name.split('_')[0] if name != 'torso' else 'other'} limb")
                panel.line(*_ends(exact[name], across), "soft dotted")
                angle = float(np.degrees(tilt[name][about]))
                text = f"{abs(angle):.1f}° {direction(name, across, angle)}" if abs(angle) >= 0.05 else "0.0°"
                text = text if observed[name][about] else "not seen"
                middle = 100 * np.mean(tilted[name], axis=0)
                right = (middle[1] >= 0.0) if across == 1 else title == "from the right"
                anchor: Anchor = "start" if right else "end"
                if name == "torso":
                    panel.text(0.0, 0.0, f"torso {text}", "halo", "middle", dy=20.0)
                else:
                    panel.text(middle[across], middle[2], text, "halo", anchor, dx=14.0 if right else -14.0)
        panels.append(panel)
    keys = [*(Key(side, f"{side} bold") for side in arms), Key("exact pose", "soft dotted")]
    drawn = f"drawn {factor} times as large as they are" if factor > 1 else "as they are"
    caption = f"The start pose; tilts are {drawn}, the degrees are the true ones."
    return Picture("posture", caption, Chart([panels], [320.0], keys))


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
    """Smooth shares (n,) of the samples over `SMOOTHED_S`, to [%/s]."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    half = SMOOTHED_S / 2.0
    total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(share))))
    first, last = np.searchsorted(time, time - half), np.searchsorted(time, time + half, "right")
    return 100.0 * (total[last] - total[first]) / ((last - first) * step)


def broken(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line that breaks where time jumps."""
    if len(time) < 3:
        return time, values
    jumps = np.flatnonzero(np.diff(time) > 3.0 * np.median(np.diff(time))) + 1
    return np.insert(time, jumps, np.nan), np.insert(values.astype(float), jumps, np.nan)


_STYLES = ("ink", "second dashed", "third dotted")


def _ends(ends: Sequence[np.ndarray], across: int) -> tuple[np.ndarray, np.ndarray]:
    return 100 * np.array([end[across] for end in ends]), 100 * np.array([end[2] for end in ends])


def _cells(at: np.ndarray, learned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower left corners (m, 2) [cm] of a plane's cells in which the hands were, and what was learned in each."""
    corners, inverse = np.unique(np.floor(at / CELL), axis=0, return_inverse=True)
    return CELL * corners, np.bincount(inverse.ravel(), weights=learned)


def _stick(tilt: Mapping[str, np.ndarray], lengths: Mapping[str, float], factor: float) -> dict[str, list[np.ndarray]]:
    """Segment → its two ends [m], root of the trunk at zero, each tilt `factor` times as large; head and shoulders."""

    def turned(name: str, v: Sequence[float]) -> np.ndarray:
        return Rotation.from_rotvec([*(factor * tilt.get(name, np.zeros(2))), 0.0]).apply(v)

    top = turned("torso", [0.0, 0.0, lengths["trunk"]])
    ends = {"torso": [np.zeros(3), top], "head": [top, top + turned("torso", [0.0, 0.0, 0.2])]}
    for side, sign in (("left", 0.5), ("right", -0.5)):
        at = top + turned("torso", [0.0, sign * lengths["shoulder_width"], 0.0])
        ends[f"{side}_shoulder"] = [at, at]
        for part in ("upper_arm", "forearm"):
            name = f"{side}_{part}"
            ends[name] = [at, at + turned(name, [0.0, 0.0, -lengths[name]])]
            at = ends[name][1]
    return ends
