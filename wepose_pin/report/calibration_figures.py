"""The charts of a calibration's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..kinematics import compute_pose
from ..model import ROOT, BodyModel, BodyTable
from .chart import Anchor, Chart, Key, Panel, Picture, category_rows
from .track_figures import TIME, body_views
from .words import capital, plain, plus_minus, signed

CELL = 5.0  # [cm] of the map of the hands
SHADES = 6  # of the map of the hands: classes shade1 to shade6
SMOOTHED_S = 2.0
HEAD_M = 0.2  # [m] from the middle of the shoulders to the head's
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


class Places(NamedTuple):
    """Places of the joined hands, or of what else a closure is of."""

    reach: np.ndarray  # (n, 3) [m] from the middle of the shoulders, in the torso's frame
    learned: np.ndarray  # (n,) [%] share of the information
    touched: np.ndarray  # (n,) bool
    width: float | None  # [m] of the shoulders
    trunk: float | None  # [m]
    origin: str  # "shoulders"
    base: str  # "torso"


def draw_lengths(rows: Sequence[Length]) -> Picture:
    """Each length beside the prior, with intervals."""
    panel = Panel(x_label="longer than the prior [mm]", right=110.0)
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
        Key("prior, ± 1", "band", "box"),
    ]
    if any(np.isfinite(row.measured) for row in rows):
        keys.append(Key("measured", "ink hollow", "triangle"))
    return Picture(
        "lengths",
        "Lengths against the prior's; to the right the estimates.",
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
    keys = [Key("with the prior's lengths", "before dashed"), Key("with the estimated lengths", "accent")]
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


def draw_places(places: Places, noun: str) -> Picture:
    """Where the points of a closure were, and how much they showed there: from the front, the right, above."""
    reach = 100 * places.reach
    views = body_views(places.width, places.trunk, places.origin)
    cells = [_cells(reach[places.touched][:, [x, y]], places.learned[places.touched]) for _, x, y in views]
    most = max([1e-9, *(float(total.max()) for _, total in cells)])
    for (panel, x, y), (corners, total) in zip(views, cells, strict=True):
        shade = np.ceil(SHADES * total / most).clip(1, SHADES)
        for k in range(1, SHADES + 1):
            at = corners[shade == k]
            panel.boxes(at[:, :1] + [0.0, CELL], at[:, 1:] + [0.0, CELL], f"shade{k}")
        panel.markers(reach[~places.touched, x], reach[~places.touched, y], "cross", "before crosses", size=3.0)
    keys = [Key(f"to {most * k / SHADES:.2g} %", f"shade{k}", "box") for k in range(1, SHADES + 1)]
    seen = f"Where {noun} went, seen from the {places.base}"
    caption = f"{seen}; the darker, the more was learned in a cell of {CELL:g} cm."
    if not places.touched.all():
        caption += " Crosses: apart."
    return Picture("places", caption, Chart([[panel for panel, _, _ in views]], [260.0], keys))


def draw_posture(tilt: Mapping[str, np.ndarray], observed: Mapping[str, Sequence[bool]], body: BodyModel) -> Picture:
    """The start pose from the front and from both sides, with its tilts drawn larger than they are.

    Parameters
    ----------
    tilt, observed : segment → (2,) [rad] about x and y; whether the motion showed anything about it
    body : with its lengths
    """
    largest = max([1e-9, *(float(np.degrees(np.linalg.norm(t))) for t in tilt.values())])
    factor = int(np.clip(round(EXAGGERATED_DEG / largest), 1, MOST_EXAGGERATED))
    table = body.table
    sides = [side for side in ("left", "right") if any(table.side(name) == side for name in tilt)]
    tilted, exact = (_stick(tilt, body, f) for f in (factor, 0))
    views = [("from the front", 1, sides), *((f"from the {side}", 0, [side]) for side in sides)]
    top = float(exact.trunk[1][2]) if exact.trunk is not None else 0.0
    lowest = min([0.0, *(end[2] for name, ends in tilted.segments.items() if name in tilt for end in ends)])
    low = -12.0 if 100 * lowest > -12.0 else 100 * lowest - 12.0
    panels = []
    for title, across, shown in views:
        panel = Panel(title, x=(-48.0, 48.0), y=(low, 100 * top + 36.0), equal=True, bare=True)
        panel.flip_x = title == "from the left"
        if tilted.head is not None:
            head = tilted.head[1]
            panel.disc(100 * head[across], 100 * head[2], 9.5, "band")
            panel.line(*_ends(tilted.head, across), "band limb")
        if across == 1:
            for line in tilted.girdles:
                panel.line(*_ends(line, across), "other limb")
        for name, ends in tilted.segments.items():
            if name in tilt and (not table.side(name) or table.side(name) in shown):
                about = 0 if across == 1 else 1
                panel.line(*_ends(ends, across), f"{table.side(name) or 'other'} limb")
                panel.line(*_ends(exact.segments[name], across), "soft dotted")
                angle = float(np.degrees(tilt[name][about]))
                text = f"{abs(angle):.1f}° {direction(table, name, across, angle)}" if abs(angle) >= 0.05 else "0.0°"
                text = text if observed[name][about] else "not seen"
                middle = 100 * np.mean(ends, axis=0)
                right = (middle[1] >= 0.0) if across == 1 else title == "from the right"
                anchor: Anchor = "start" if right else "end"
                if name == table.reference:
                    panel.text(0.0, 0.0, f"{plain(name)} {text}", "halo", "middle", dy=20.0)
                else:
                    panel.text(middle[across], middle[2], text, "halo", anchor, dx=14.0 if right else -14.0)
        panels.append(panel)
    keys = [*(Key(side, f"{side} bold") for side in sides), Key("exact pose", "soft dotted")]
    drawn = f"drawn {factor} times as large as they are" if factor > 1 else "as they are"
    caption = f"The start pose; tilts are {drawn}, the degrees are the true ones."
    return Picture("posture", caption, Chart([panels], [320.0], keys))


def direction(table: BodyTable, segment: str, across: int, angle: float) -> str:
    """Where a tilt takes the free end of a segment: a torso's upper one, an arm's lower one, a foot's front one.

    `across` 0: from the side, 1: from before.
    """
    positive, own = angle > 0.0, table.segments[segment]
    if abs(own.along[2]) < 0.5 and across == 0:
        return "downwards" if positive else "upwards"
    if own.spine or abs(own.along[2]) < 0.5:
        if across == 0:
            return "forwards" if positive else "backwards"
        return "to the right" if positive else "to the left"
    if across == 0:
        return "backwards" if positive else "forwards"
    if not table.side(segment):
        return "to the left" if positive else "to the right"
    return "outwards" if positive == (table.side(segment) == "left") else "inwards"


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


class _Stick(NamedTuple):
    """Lines between two ends (3,) [m], the root at zero; None: there is no such line."""

    trunk: list[np.ndarray] | None  # from the root to the middle of the shoulders
    head: list[np.ndarray] | None
    girdles: list[list[np.ndarray]]  # between the points at which limbs hang
    segments: dict[str, list[np.ndarray]]


def _stick(tilt: Mapping[str, np.ndarray], body: BodyModel, factor: float) -> _Stick:
    """The body in the start pose, each tilt `factor` times as large; segments without a tilt are exact."""
    table = body.table
    R = {name: Rotation.from_rotvec([*(factor * tilt.get(name, np.zeros(2))), 0.0]) for name in table.segments}
    posed = [name for name, segment in table.segments.items() if name in tilt or not segment.rigid_without_sensor]
    pose = compute_pose(body, np.zeros(1), {name: R[name].as_quat()[None] for name in posed})
    points = {name: place[0] for name, place in pose.points.items()}
    segments: dict[str, list[np.ndarray]] = {}
    trunk = head = None
    girdles: list[list[np.ndarray]] = []
    for limb in table.drawn_limbs.values():
        middle = np.mean([points[point] for point in limb.origin], axis=0)
        line = [points[point] for point in limb.origin]
        if len(line) > 1 and not any(np.array_equal(line, other) for other in girdles):
            girdles.append(line)
        if limb.base == table.reference and table.find_length(ROOT, *limb.origin) is not None:
            trunk = [np.zeros(3), middle]
            head = [middle, middle + R[table.reference].apply([0.0, 0.0, HEAD_M])]
            segments[table.reference] = trunk
    for limb in table.drawn_limbs.values():
        for segment, (start, end) in zip(limb.segments, pairwise(limb.points), strict=False):
            segments[segment] = [points[start], points[end]]
    return _Stick(trunk, head, girdles, segments)
