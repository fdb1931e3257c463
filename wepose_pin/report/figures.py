"""Figures by matplotlib, as objects: no pyplot, no state that other code could see."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..documents import whole_folder
from ..errors import Named
from ..recording import find_runs
from .words import plain

WIDTH_IN = 9.2
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = 0.62, 0.12, 0.28, 0.5  # margins of a figure
LEGEND_COLUMNS = 6
COLUMNS = 450  # of a line: its least and largest value in each
COLOURS = {"left": "#d9772b", "right": "#24618f", "other": "#3d4a59"}
SESSION_COLOURS = ("#24618f", "#d9772b", "#3d7a4c", "#8a5a9e")
DASHES = {  # by the place among the lines of a side
    "left": ("-", (0, (1, 1)), (0, (8, 2, 2, 2))),
    "right": ((0, (4, 1.5)), (0, (5, 1, 1, 1)), (0, (10, 3))),
    "other": ("-", (0, (2, 1)), (0, (6, 1))),
}
SHADE, BAND, SOFT, ALARM = "#e9eef4", "#cdd9e5", "#8794a3", "#b23a48"
STYLE = mpl.rc_params_from_file(Path(__file__).with_name("wepose.mplstyle"), use_default_template=False)
Spans = Iterable[Sequence[float]] | np.ndarray
styled = mpl.rc_context(STYLE)  # decorates what draws in the style of the reports, whatever the caller's rcParams


class ReportFigure(Figure):
    """A matplotlib figure with a caption; a notebook shows it. `height_in`: without margins and legend."""

    def __init__(self, caption: str, height_in: float) -> None:
        super().__init__(figsize=(WIDTH_IN, height_in + TOP_IN + BOTTOM_IN))
        self.caption = caption

    def grid(self, rows: int = 1, columns: int = 1, left_in: float = LEFT_IN, **options: Any) -> np.ndarray:
        """(rows, columns) axes."""
        _, height = self.get_size_inches()
        places = {
            "left": left_in / WIDTH_IN,
            "right": 1.0 - RIGHT_IN / WIDTH_IN,
            "bottom": BOTTOM_IN / height,
            "top": 1.0 - TOP_IN / height,
            "wspace": 0.24,
            "hspace": (0.42 if "sharex" in options else 0.6) * rows / (height - TOP_IN - BOTTOM_IN),
        }
        axes: np.ndarray = self.subplots(rows, columns, squeeze=False, gridspec_kw=places, **options)
        for ax in axes.ravel():
            ax.xaxis.set_major_locator(MaxNLocator(8 if columns == 1 else 5))
            ax.yaxis.set_major_locator(MaxNLocator(4 if rows > 1 else 5))
        return axes

    def add_legend(self) -> None:
        """One legend above the plots, each label once."""
        entries: dict[str, Any] = {}
        for ax in self.axes:
            for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
                entries.setdefault(label, handle)
        if not entries:
            return
        width, height = self.get_size_inches()
        taller = height + 0.22 * -(-len(entries) // LEGEND_COLUMNS)
        self.set_size_inches(width, taller)
        for ax in self.axes:
            x, y, w, h = ax.get_position().bounds
            ax.set_position((x, y * height / taller, w, h * height / taller))
        look = {"ncols": LEGEND_COLUMNS, "borderaxespad": 0.1, "handlelength": 2.2, "columnspacing": 1.6}
        self.legend(list(entries.values()), list(entries), loc="upper left", bbox_to_anchor=(0.01, 1.0), **look)

    @styled
    def svg(self) -> str:
        """Return an SVG file as text; equal figures give equal text."""
        file = StringIO()
        self.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
        return file.getvalue()

    def address(self) -> str:
        """The figure as the address of an image, which no style of a page touches."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg().encode()).decode('ascii')}"

    def _repr_svg_(self) -> str:
        return self.svg()


class Figures(Named[ReportFigure]):
    """matplotlib figures by name, which can be changed before they are saved; a notebook shows all of them."""

    def __init__(self) -> None:
        super().__init__("figure", {})

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"

    def _repr_html_(self) -> str:
        return "\n".join(figure.svg().partition("?>")[2] for figure in self.values())

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write each figure to ``<name>.svg`` in a folder and return it; `ExistingOutput` as `whole_folder`."""
        with whole_folder(Path(folder), force) as partial:
            for name, figure in self.items():
                (partial / f"{name}.svg").write_text(figure.svg(), encoding="utf-8")
        return Path(folder)


def envelope(time: np.ndarray, values: np.ndarray, most: int = COLUMNS) -> tuple[np.ndarray, np.ndarray]:
    """A line with the same picture: the least and the largest value of each of at most so many columns.

    Parameters
    ----------
    time, values : (n,); NaN in `values` breaks the line
    """
    if len(time) <= 2 * most:
        return time, values
    size = -(-len(time) // most)
    columns = np.full((-(-len(time) // size), size), np.nan)
    columns.ravel()[: len(values)] = values
    known = np.isfinite(columns)
    low, high = np.where(known, columns, np.inf).argmin(axis=1), np.where(known, columns, -np.inf).argmax(axis=1)
    # A column that holds anything shows it; one that holds nothing breaks the line.
    at = size * np.arange(len(columns))[:, None] + np.sort(np.column_stack([low, high]), axis=1)
    return time[at.ravel()], values[at.ravel()]


def find_spans(time: np.ndarray, which: np.ndarray) -> np.ndarray:
    """(m, 2) [s], runs of true values, in steps of a column, so that m has a bound."""
    starts = np.arange(0, len(time), max(1, len(time) // (2 * COLUMNS)))
    ends = np.append(starts[1:], len(time)) - 1
    runs = find_runs(np.logical_or.reduceat(which, starts))
    return np.array([(time[starts[a]], time[ends[b - 1]]) for a, b in runs]).reshape(-1, 2)


def shade(ax: Axes, spans: Spans, label: str, colour: str = SHADE, **options: Any) -> None:
    """Shade spans [s] over the height of a plot, or over `ymin` to `ymax` of it."""
    for k, (begin, end) in enumerate(spans):
        ax.axvspan(begin, end, color=colour, linewidth=0, zorder=0.5, label=label if k == 0 else None, **options)


def line_style(label: str, side: str | None, rank: int = 0) -> dict[str, Any]:
    """A line's style: colour by side, and dashes, so that lines differ without their colour too."""
    side = side if side in DASHES else "other"
    return {"color": COLOURS[side], "linestyle": DASHES[side][rank % 3], "label": plain(label)}


@styled
def draw_over_time(
    time: np.ndarray,
    panels: Mapping[str, Mapping[str, np.ndarray]],
    caption: str,
    styles: Mapping[str, dict[str, Any]],
    columns: int = 1,
    spans: tuple[str, Spans] = ("", ()),
) -> ReportFigure:
    """A plot for each title, row by row, with its lines by name; NaN breaks a line.

    Parameters
    ----------
    panels : title → name of a line → values (n,)
    styles : of each line, of `line_style`
    spans : label and spans [s] that are shaded
    """
    rows = -(-len(panels) // columns)
    figure = ReportFigure(caption, 2.2 if len(panels) == 1 else 1.25 * rows)
    axes = figure.grid(rows, columns, sharex=True)
    for ax, (title, lines) in zip(axes.ravel(), panels.items(), strict=False):
        ax.set_title(title)
        shade(ax, spans[1], spans[0])
        for name, values in lines.items():
            ax.plot(*envelope(time, values, COLUMNS // columns), **styles[name])
    for ax in axes.ravel()[len(panels) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
        ax.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
    if len(styles) > 1:
        figure.add_legend()
    return figure
