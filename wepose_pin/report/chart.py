"""Charts as inline SVG: numbers become paths here, templates/chart.svg.j2 writes them, static/chart.css styles them.

Written here and not by matplotlib, which needs half a second to be imported and as much again for a few charts: those
of the reports are lines, bars and markers, and as SVG they follow the page's light and dark colours and stay sharp.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

WIDTH = 920.0  # [px] of every chart
COLUMNS = 700  # of an envelope: about a column a pixel
_UNITS_A_PIXEL = 10  # of the integers that paths are made of
_EDGE = 0.05  # [px] by which a rounded tick may lie beyond its axis
_LETTER = 6.5  # [px] mean width of a letter
_LINE = 17.0  # [px] height of a line of text
_ROW_GAP = 8.0  # [px] between two rows of panels
_MARKERS = {  # about their centre, of size 1
    "circle": "m-{0} 0a{0} {0} 0 1 0 {1} 0a{0} {0} 0 1 0-{1} 0z",
    "square": "m-{0}-{0}h{1}v{1}h-{1}z",
    "diamond": "m0-{0}l{0} {0}-{0} {0}-{0}-{0}z",
    "triangle": "m0 {0}l-{0}-{1}h{1}z",
    "cross": "m-{0}-{0}l{1} {1}m-{1} 0l{1}-{1}",
}
Marker = Literal["circle", "square", "diamond", "triangle", "cross"]
Anchor = Literal["start", "middle", "end"]
Limits = tuple[float, float]
Tick = tuple[float, str]


class Key(NamedTuple):
    """An entry of the legend; `shape`: "line", "box" or a marker."""

    label: str
    css: str
    shape: str = "line"
    colour: str = ""  # where the class gives none


class Picture(NamedTuple):
    """A chart with its caption; `stem` names its file where it has one of its own."""

    stem: str
    caption: str
    chart: Chart


@dataclass(frozen=True)
class Mark:
    """Something drawn in a panel, in data coordinates; an infinite coordinate is the panel's edge."""

    kind: Literal["line", "area", "band", "box", "disc"] | Marker
    css: str
    x: np.ndarray  # (n,); of boxes (n, 2)
    y: np.ndarray
    size: float = 4.0  # [px] of a marker; a disc's radius in data units
    colour: str = ""  # where the class gives none
    counts: bool = True  # for limits that are taken from the data


@dataclass(frozen=True)
class Text:
    """Words at a point; `dx`, `dy` [px] from there, y downwards."""

    x: float
    y: float
    text: str
    css: str = ""
    anchor: Anchor = "start"
    dx: float = 0.0
    dy: float = 0.0


@dataclass
class Panel:
    """One plot of a chart.

    Parameters
    ----------
    x, y : limits; None: those of the data
    x_ticks, y_ticks : None: round numbers; a list of value and label otherwise
    grid : lines across at the ticks of "x", of "y", of both
    equal : one unit is as long in x as in y; the limits give way
    flip_x : larger values to the left
    log_x, log_y : a logarithmic axis
    shown_x, shown_y : with labels at the ticks, and not only the grid
    bare : without axes
    right : [px] kept free to the right of it
    """

    title: str = ""
    x_label: str = ""
    x: Limits | None = None
    y: Limits | None = None
    x_ticks: Sequence[Tick] | None = None
    y_ticks: Sequence[Tick] | None = None
    grid: str = "xy"
    equal: bool = False
    flip_x: bool = False
    log_x: bool = False
    log_y: bool = False
    shown_x: bool = True
    shown_y: bool = True
    bare: bool = False
    right: float = 12.0
    marks: list[Mark] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)

    def line(self, x: np.ndarray, y: np.ndarray, css: str, *, colour: str = "") -> None:
        """A line through points (n,); NaN breaks it."""
        self.marks.append(Mark("line", css, np.asarray(x, float), np.asarray(y, float), colour=colour))

    def area(self, x: np.ndarray, y: np.ndarray, css: str) -> None:
        """The area between a line and zero."""
        self.marks.append(Mark("area", css, np.asarray(x, float), np.asarray(y, float)))

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, css: str) -> None:
        """The area between two lines through points (n,); NaN breaks it."""
        known = np.isfinite(low) & np.isfinite(high)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False]))))
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            xs, ys = (np.concatenate([there[a:b], back[a:b][::-1]]) for there, back in ((x, x), (low, high)))
            self.marks.append(Mark("band", css, xs, ys))

    def boxes(self, x: object, y: object, css: str, *, colour: str = "", counts: bool = True) -> None:
        """Boxes from x[:, 0] to x[:, 1] and y[:, 0] to y[:, 1]."""
        x, y = np.broadcast_arrays(np.atleast_2d(np.asarray(x, float)), np.atleast_2d(np.asarray(y, float)))
        if len(x):
            self.marks.append(Mark("box", css, x, y, colour=colour, counts=counts))

    def spans(self, spans: Sequence[Limits] | np.ndarray, css: str) -> None:
        """Boxes over the whole height."""
        if len(spans):
            self.boxes(np.array(spans, float), (-np.inf, np.inf), css, counts=False)

    def rule(self, css: str, *, x: float | None = None, y: float | None = None) -> None:
        """A line across the panel."""
        across = np.array([-np.inf, np.inf])
        self.marks.append(
            Mark("line", css, across if x is None else np.full(2, x), across if y is None else np.full(2, y))
        )

    def markers(self, x: object, y: object, shape: Marker, css: str, *, size: float = 4.0, colour: str = "") -> None:
        """A marker at each point; `size` [px] is half of its width."""
        xs, ys = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float)))
        if len(xs):
            self.marks.append(Mark(shape, css, xs, ys, size, colour=colour))

    def disc(self, x: float, y: float, radius: float, css: str) -> None:
        self.marks.append(Mark("disc", css, np.array([x]), np.array([y]), radius))

    def text(self, x: float, y: float, text: str, css: str = "", anchor: Anchor = "start", *,
             dx: float = 0.0, dy: float = 4.0) -> None:  # fmt: skip
        self.texts.append(Text(x, y, text, css, anchor, dx, dy))

    def limits(self, axis: Literal["x", "y"]) -> Limits:
        """Those given, or those of the marks and 5 % more."""
        interval = self.x if axis == "x" else self.y
        if interval is not None:
            return interval if interval[1] > interval[0] else (interval[0] - 0.5, interval[0] + 0.5)
        values = np.concatenate(
            [[np.nan]]
            + [
                np.add.outer([-m.size, m.size], getattr(m, axis)).ravel()
                if m.kind == "disc"
                else getattr(m, axis).ravel()
                for m in self.marks
                if m.counts
            ]
        )
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if self.log_x if axis == "x" else self.log_y:
            return low / 1.3, high * 1.3
        margin = 0.05 * (high - low) or 0.5
        return low - margin, high + margin


class DrawnMark(NamedTuple):
    d: str
    css: str
    colour: str


class DrawnText(NamedTuple):
    x: float
    y: float
    text: str
    css: str
    anchor: str


@dataclass(frozen=True)
class DrawnPanel:
    """A panel in pixels from its upper left corner; paths in tenths of them."""

    left: float
    top: float
    width: float
    height: float
    bare: bool
    grid: str
    marks: list[DrawnMark]
    texts: list[DrawnText]


class DrawnKey(NamedTuple):
    x: float
    y: float
    label: str
    css: str
    d: str
    colour: str


@dataclass
class Chart:
    """Panels in rows.

    Parameters
    ----------
    rows : of panels; those of one row are equally wide and share its height
    heights : [px] of the rows, axes and titles apart
    legend : above the panels
    """

    rows: Sequence[Sequence[Panel]]
    heights: Sequence[float]
    legend: Sequence[Key] = ()

    def drawn(self) -> tuple[float, list[DrawnPanel], list[DrawnKey]]:
        """Height [px], panels and legend, as the template takes them."""
        keys, top = self._drawn_legend()
        panels: list[DrawnPanel] = []
        rows = list(zip(self.rows, self.heights, strict=True))
        columns = range(max(map(len, self.rows)))
        left = [max(_room_left(row[k], height) for row, height in rows if k < len(row)) for k in columns]
        width = (WIDTH - sum(left) - max(sum(panel.right for panel in row) for row in self.rows)) / len(left)
        for row, height in rows:
            top += _ROW_GAP if panels else 0.0
            top += _LINE if any(panel.title for panel in row) else 5.0
            x = 0.0
            for panel, room in zip(row, left, strict=False):
                panels.append(_drawn_panel(panel, x + room, top, width, height))
                x += room + width + panel.right
            framed = [panel for panel in row if not panel.bare]
            top += height + 3.0 + _LINE * any(p.shown_x for p in framed) + _LINE * any(p.x_label for p in framed)
        return top, panels, keys

    def _drawn_legend(self) -> tuple[list[DrawnKey], float]:
        """The legend, lines set to the right, and where it ends."""
        lines: list[list[tuple[Key, float]]] = [[]]
        for key in self.legend:
            width = 36.0 + 14.0 + _LETTER * len(key.label)
            if lines[-1] and sum(w for _, w in lines[-1]) + width > WIDTH:
                lines.append([])
            lines[-1].append((key, width))
        drawn = []
        for k, line in enumerate(lines):
            x, y = WIDTH - sum(width for _, width in line), 14.0 + (_LINE + 2.0) * k
            for key, width in line:
                d = {"line": "M40-40H300", "box": "M60-90H280V10H60z"}.get(key.shape)
                d = d or "M170-40" + _marker(key.shape, 4.5)
                css = f"{_CLASSES.get(key.shape, 'marker')} {key.css}"
                drawn.append(DrawnKey(round(x, 1), y - 14.0, key.label, css, d, key.colour))
                x += width
        return drawn, (_LINE + 2.0) * len(lines) + 3.0 if self.legend else 0.0


def resolve_style(svg: str) -> str:
    """A standalone chart for programs that know less of CSS, as Inkscape, librsvg and LaTeX's converters.

    Variables become their light colours. Paths, whose units are tenths of a pixel, have strokes in these units in place
    of ones that do not scale.
    """
    start, end = svg.index("<style>"), svg.index("</style>")
    style = svg[start:end].partition("@media")[0].replace(" vector-effect: non-scaling-stroke;", "")
    colours = dict(re.findall(r"(--\w+): (#\w+);", style))
    style = re.sub(r"--\w+: #\w+;\s*", "", style)
    style = re.sub(r"var\((--\w+)\)", lambda match: colours[match[1]], style)
    lines = [line if _UNSCALED.match(line) else _STROKE.sub(_scale_stroke, line) for line in style.split("\n")]
    return svg[:start] + "\n".join(lines) + svg[end:]


_UNSCALED = re.compile(r"\.chart (text|\.grid|\.axes|\.hatch )")
_STROKE = re.compile(r"(stroke-(?:width|dasharray): )([\d. px]+)")


def _scale_stroke(match: re.Match[str]) -> str:
    numbers = " ".join(f"{_UNITS_A_PIXEL * float(number):g}" for number in re.findall(r"[\d.]+", match[2]))
    return match[1] + numbers


def envelope(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line of at most 2 `COLUMNS` points with the same picture: the least and the largest value of each column.

    Parameters
    ----------
    time, values : (n,); NaN in `values` breaks the line
    """
    if len(time) <= 2 * COLUMNS:
        return time, values
    size = -(-len(time) // COLUMNS)
    columns = np.full((-(-len(time) // size), size), np.nan)
    columns.ravel()[: len(values)] = values
    known = np.isfinite(columns)
    low, high = np.where(known, columns, np.inf).argmin(axis=1), np.where(known, columns, -np.inf).argmax(axis=1)
    # A column that holds anything shows it; one that holds nothing breaks the line.
    at = size * np.arange(len(columns))[:, None] + np.sort(np.column_stack([low, high]), axis=1)
    return time[at.ravel()], values[at.ravel()]


def round_ticks(low: float, high: float, most: int) -> list[Tick]:
    """At most about `most` round numbers, at 1, 2 or 5 times a power of ten, between `low` and `high`."""
    raw = (high - low) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= 0.8 * raw)
    values = step * np.arange(np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6) + 1.0)
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return [(float(value), f"{value + 0.0:.{digits}f}".replace("-", "−")) for value in values]


def log_ticks(low: float, high: float) -> list[Tick]:
    """Round numbers on a logarithmic axis."""
    factors = (1.0, 3.0) if high > 30.0 * low else (1.0, 2.0, 5.0)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    values = [factor * 10.0**power for power in powers for factor in factors]
    return [(value, f"{value:g}") for value in values if low <= value <= high]


def category_rows(panel: Panel, names: Sequence[str]) -> list[float]:
    """Make the panel's y axis one of names, the first on top; gives their places."""
    places = [float(len(names) - 1 - k) for k in range(len(names))]
    panel.y, panel.y_ticks, panel.grid = (-0.6, len(names) - 0.4), list(zip(places, names, strict=True)), "x"
    return places


# From data to pixels --------------------------------------------------------------------------------------------------


def _room_left(panel: Panel, height: float) -> float:
    """[px] that the labels at the ticks of y take."""
    if panel.bare or not panel.shown_y:
        return 12.0
    ticks = panel.y_ticks
    if ticks is None:
        ticks = _ticks(panel, "y", *panel.limits("y"), height)
    return 14.0 + _LETTER * panel.equal + _LETTER * max((len(label) for _, label in ticks), default=0)


def _ticks(panel: Panel, axis: Literal["x", "y"], low: float, high: float, length: float) -> Sequence[Tick]:
    ticks = panel.x_ticks if axis == "x" else panel.y_ticks
    if ticks is not None:
        return ticks
    if panel.log_x if axis == "x" else panel.log_y:
        return log_ticks(low, high)
    return round_ticks(low, high, max(2, int(length / (60.0 if axis == "x" else 28.0))))


def _drawn_panel(panel: Panel, left: float, top: float, width: float, height: float) -> DrawnPanel:
    (x0, x1), (y0, y1) = panel.limits("x"), panel.limits("y")
    if panel.equal:
        scale = max((x1 - x0) / width, (y1 - y0) / height)
        x0, x1 = (0.5 * (x0 + x1) + sign * 0.5 * scale * width for sign in (-1, 1))
        y0, y1 = (0.5 * (y0 + y1) + sign * 0.5 * scale * height for sign in (-1, 1))

    def at_x(x: np.ndarray | float) -> np.ndarray:
        share = _share(np.asarray(x, float), x0, x1, panel.log_x)
        return width * (1.0 - share if panel.flip_x else share)

    def at_y(y: np.ndarray | float) -> np.ndarray:
        return height * (1.0 - _share(np.asarray(y, float), y0, y1, panel.log_y))

    marks = []
    for mark in panel.marks:
        d = _path(mark, at_x(mark.x), at_y(mark.y), float(at_y(0.0)) if mark.kind == "area" else 0.0, width / (x1 - x0))
        if d:
            marks.append(DrawnMark(d, f"{_CLASSES.get(mark.kind, 'marker')} {mark.css}", mark.colour))
    texts = []
    for text in panel.texts:
        x, y = float(at_x(text.x)) + text.dx, float(at_y(text.y)) + text.dy
        texts.append(DrawnText(round(x, 1), round(y, 1), text.text, text.css, text.anchor))
    if panel.title:
        texts.append(DrawnText(0.0, -6.0, panel.title, "title", "start"))
    grid = ""
    if not panel.bare:
        x_ticks, y_ticks = _ticks(panel, "x", x0, x1, width), _ticks(panel, "y", y0, y1, height)
        for value, label in x_ticks:
            x = round(float(at_x(value)), 1)
            if 0.0 <= x <= width + _EDGE:
                texts += [DrawnText(x, height + 15.0, label, "tick", "middle")] if panel.shown_x else []
                grid += f"M{x:g} 0v{height:g}" if "x" in panel.grid else ""
        for value, label in y_ticks:
            y = round(float(at_y(value)), 1)
            if 0.0 <= y <= height + _EDGE:
                texts += [DrawnText(-7.0, y + 4.0, label, "tick", "end")] if panel.shown_y else []
                grid += f"M0 {y:g}h{width:.1f}" if "y" in panel.grid else ""
        if panel.x_label:
            below = height + 15.0 + _LINE * panel.shown_x
            texts.append(DrawnText(round(0.5 * width, 1), below, panel.x_label, "", "middle"))
    return DrawnPanel(round(left, 1), top, round(width, 1), height, panel.bare, grid, marks, texts)


_CLASSES = {"line": "line", "area": "area", "band": "area", "box": "area", "disc": "area"}


def _share(values: np.ndarray, low: float, high: float, log: bool) -> np.ndarray:
    """Where values lie between the limits, 0 to 1; far outside it is enough to be outside."""
    if log:
        values, low, high = np.log(np.maximum(values, 1e-300)), np.log(low), np.log(high)
    edges = np.where(values == np.inf, 1.0, 0.0)
    return np.clip(np.where(np.isinf(values), edges, (values - low) / (high - low)), -3.0, 4.0)


def _path(mark: Mark, x: np.ndarray, y: np.ndarray, zero: float, scale: float) -> str:
    if mark.kind == "band":
        return "".join(_runs(x, y, None)) + "z"
    if mark.kind in ("line", "area"):
        return "".join(_runs(x, y, zero if mark.kind == "area" else None))
    xs, ys = (np.rint(_UNITS_A_PIXEL * values) for values in (x, y))
    known = np.isfinite(xs).reshape(len(xs), -1).all(axis=1) & np.isfinite(ys).reshape(len(ys), -1).all(axis=1)
    corners = np.column_stack([xs[known], ys[known]]).astype(int).tolist()
    if mark.kind == "box":
        return "".join(f"M{a} {c}H{b}V{d}H{a}z" for a, b, c, d in corners)
    marker = _marker("circle", mark.size * scale) if mark.kind == "disc" else _marker(mark.kind, mark.size)
    return "".join(f"M{a} {b}{marker}" for a, b in corners)


def _marker(shape: str, size: float) -> str:
    r = round(_UNITS_A_PIXEL * size)
    return _MARKERS[shape].format(r, 2 * r)


def _runs(x: np.ndarray, y: np.ndarray, zero: float | None) -> list[str]:
    """A path for each stretch without NaN, in steps of tenths of a pixel; closed at `zero` where that is given."""
    known = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False]))))
    points = np.rint(_UNITS_A_PIXEL * np.column_stack([np.where(known, x, 0.0), np.where(known, y, 0.0)])).astype(int)
    paths = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        steps = np.diff(points[a:b], axis=0)
        steps = steps[steps.any(axis=1)]
        path = f"M{points[a, 0]} {points[a, 1]}l" + (" ".join(map(str, steps.ravel().tolist())) or "0 0")
        paths.append(path if zero is None else f"{path}V{round(_UNITS_A_PIXEL * zero)}H{points[a, 0]}z")
    return paths
