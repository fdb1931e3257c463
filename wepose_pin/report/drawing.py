"""What the reports' figures share: colours, lines that break, envelopes of long signals, a body behind the hands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ..viewer import LEFT_COLOUR, OTHER_COLOUR, RIGHT_COLOUR

BEFORE = "#d9772b"
BAND = "#dfe4ea"  # what was known before
HATCHED: dict[str, Any] = {"facecolor": "#f1f3f6", "edgecolor": "#9aa5b3", "hatch": "////", "linewidth": 0.0}
COLUMNS = 1200  # of an envelope: more than a figure has pixels to tell apart


def envelope(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line of at most 2 `COLUMNS` points that looks like the whole: the least and the largest value of each column.

    Parameters
    ----------
    time, values : (n,); NaN in `values` breaks the line
    """
    if len(time) <= 2 * COLUMNS:
        return time, values
    edges = np.linspace(0, len(time), COLUMNS + 1).astype(int)[:-1]
    known = np.isfinite(values)
    # A column that holds anything shows it; one that holds nothing breaks the line.
    low = np.minimum.reduceat(np.where(known, values, np.inf), edges)
    high = np.maximum.reduceat(np.where(known, values, -np.inf), edges)
    empty = ~np.logical_or.reduceat(known, edges)
    low[empty] = high[empty] = np.nan
    return np.repeat(time[edges], 2), np.column_stack([low, high]).ravel()


def broken(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line that breaks where time jumps."""
    if len(time) < 3:
        return time, values
    jumps = np.flatnonzero(np.diff(time) > 3.0 * np.median(np.diff(time))) + 1
    return np.insert(time, jumps, np.nan), np.insert(values.astype(float), jumps, np.nan)


def line_of(segment: str) -> dict[str, Any]:
    """How a segment's line looks, told apart without colour too: side by colour, part by dashes."""
    if segment.startswith(("left_", "right_")):
        colour = LEFT_COLOUR if segment.startswith("left_") else RIGHT_COLOUR
        dashes: Any = {"upper_arm": "-", "forearm": (0, (5, 1.5)), "hand": (0, (1.2, 1.2))}.get(
            segment.split("_", 1)[1], "-"
        )
        return {"color": colour, "linestyle": dashes, "linewidth": 1.4}
    dashes = {"pelvis": (0, (5, 1.5)), "head": (0, (1.2, 1.2))}.get(segment, "-")
    return {"color": OTHER_COLOUR, "linestyle": dashes, "linewidth": 1.4}


def above(figure: Figure, handles: Sequence[Any], columns: int | None = None) -> None:
    """The legend, above the panels."""
    figure.legend(
        handles=handles, loc="outside upper right", ncols=columns or len(handles), frameon=False, handlelength=2.4
    )


def body(axes: Axes, view: str, half: float, trunk: float) -> None:
    """Head, shoulders and trunk behind the hands [cm]; origin between the shoulders."""
    pale: dict[str, Any] = {"color": BAND, "linewidth": 6.0, "solid_capstyle": "round", "zorder": 1}
    across = "right" not in view
    axes.add_patch(Circle((0.0, 0.0 if "above" in view else 20.0), 10.0, color=BAND, zorder=1))
    if across:
        axes.plot([-half, half], [0.0, 0.0], **pale)
    if "above" not in view:
        axes.plot([0.0, 0.0], [0.0, -trunk], **pale)
