"""The figures of a validation run, as PNG: errors over time, bars, paths, what adds millimetres, trial by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ..page import ACCENT, FONT, INK, LINE, SOFT, STYLE, Picture, capital, new_figure, png_of, reason, stem
from .document import Document
from .findings import FROM, OURS, TARGETS, WATERFALL, Waterfall, waterfall
from .jobs import Result
from .tables import AXES, HAND, SPLIT, Row, figures, name_and_unit, paper_figures, summary
from .words import AS_IT_COMES

COLOURS = {
    "smekf": ACCENT,
    "amekf": "#3fa7c9",
    "smoother": "#16324a",
    "ncf": "#d9772b",
    "gdc": "#4b9a55",
    "vqf": "#a04c9c",
    "offline vqf": "#d08bc4",
    "imufusion": "#8a6a3c",
}
OTHERS = ("#b23a48", "#6c757d", "#7a9e1f", "#5f4bb6")
TRUTH: dict[str, Any] = {"color": INK, "linestyle": (0, (2, 1.5))}
THEIRS: dict[str, Any] = {"facecolor": "white", "edgecolor": SOFT, "hatch": "//////"}  # the paper's bars
WINDOWS = 60  # of the running root mean square, over a curve's time


def pictures(document: Document, failures: list[str] | None = None) -> Iterator[tuple[str, Picture]]:
    """Experiment and figure, in the order of the page; what cannot be drawn from the results is left out.

    `failures` takes a line for each figure whose drawing fails.
    """
    rows = summary(document.results)
    for experiment in dict.fromkeys(row.experiment for row in rows):
        of = [row for row in rows if row.experiment == experiment]
        results = [result for result in document.results if result.experiment == experiment]
        for draw in (_waterfall, _bars, _trials, _over_time, _paths):
            try:
                with rc_context(STYLE):
                    drawn = draw(experiment, of, results)
                    if drawn is None:
                        continue
                    kind, caption, figure = drawn
                    picture = Picture(f"{stem(experiment)}-{kind}", caption, png_of(figure))
            except Exception as error:
                if failures is not None:
                    what = draw.__name__.strip("_").replace("_", " ")
                    failures.append(f"{experiment}: the figure of {what} cannot be drawn: {reason(error)}")
                continue
            yield experiment, picture


_Drawn = tuple[str, str, Figure] | None


def _bars(experiment: str, rows: Sequence[Row], results: Sequence[Result]) -> _Drawn:
    """A bar a filter and figure, the paper's grey and hatched below it."""
    wanted = [AXES, tuple(HAND.values())]
    if len({result.trial for result in results}) == 1:
        wanted.append(tuple(name.replace("_", " ") for name in SPLIT[:3]))
    names: tuple[str, ...] | None
    names = next((names for names in wanted if all(name in row.figures for row in rows for name in names)), None)
    if names is None or experiment == WATERFALL:
        return None
    paper = {row.method: paper_figures(experiment, row.method) for row in rows if row.method in COLOURS}
    figure = new_figure(0.9 + 0.34 * len(rows))
    panels: Sequence[Axes] = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    place = np.arange(len(rows))[::-1]
    for axes, name in zip(panels, names, strict=True):
        bars = []
        for at, row in zip(place, rows, strict=True):
            beside = paper.get(row.method, {}).get(name)
            height, up = (0.36, 0.19) if beside else (0.5, 0.0)
            mean, std = row.figures[name], row.figures.get(f"{name} std")
            _bar(axes, at + up, mean, std, height, color=_colour(row.method))
            bars.append((at + up, mean, mean + (std or 0.0)))
            if beside:
                _bar(axes, at - up, beside[0], beside[1], height, **THEIRS)
                bars.append((at - up, beside[0], sum(beside)))
        shown, unit = name_and_unit(name)
        shown = FROM.get(name, shown)
        axes.set_title(f"{shown} [{unit}]" if unit else shown)
        limit = TARGETS.get(experiment) if name in FROM else None
        _clip(axes, bars, max([limit or 0.0, *(sum(of[name]) for of in paper.values() if name in of)]))
        if limit is not None:
            axes.axvline(limit, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
            axes.annotate(
                f"at most {limit:g}", (limit, 1.0), (3, -2), xycoords=("data", "axes fraction"), va="top",
                textcoords="offset points", fontsize=FONT - 1.5, color=INK,
            )  # fmt: skip
        axes.grid(axis="x", color=LINE, linewidth=0.7)
    panels[0].set_yticks(place, [row.method for row in rows])
    panels[0].set_ylim(-0.6, len(rows) - 0.4 + (0.35 if experiment in TARGETS else 0.0))
    caption = f"{capital(experiment)}: {'error' if names not in wanted[:2] else 'mean error'}"
    caption += ", whiskers: one standard deviation over time" if f"{names[0]} std" in rows[0].figures else ""
    if any(paper.values()):
        _key(figure, [("ours", {"color": ACCENT}), ("the paper", THEIRS)])
        caption += "; hatched: the paper's"
    return "bars", f"{caption}.", figure


def _trials(experiment: str, rows: Sequence[Row], results: Sequence[Result]) -> _Drawn:
    """A dot a filter and trial, for recordings whose error is split into inclination, heading and total."""
    names = [name.replace("_", " ") for name in SPLIT[:3]]
    trials = list(dict.fromkeys(result.trial for result in results))
    if len(trials) < 2 or not all(name in row.figures for row in rows for name in names):
        return None
    figure = new_figure(1.3 + 0.3 * len(trials))
    panels: Sequence[Axes] = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    place = {trial: -k for k, trial in enumerate(trials)}
    for axes, name in zip(panels, names, strict=True):
        shown = [(r.method, place[r.trial], figures(r).get(name)) for r in results]
        values = np.array([value for _, _, value in shown if value is not None])
        wide = values.min() > 0.0 and values.max() > 12.0 * values.min()
        for k, method in reversed(list(enumerate(row.method for row in rows))):  # ours on top
            beside = 0.6 * (0.5 - (k + 0.5) / len(rows))  # equal errors do not hide each other
            x, y = zip(*[(v, at + beside) for label, at, v in shown if label == method and v is not None], strict=True)
            size = 40 if method == OURS else 19
            axes.scatter(
                x, y, size, _colour(method), marker=_marker(method), linewidths=0.4, edgecolors="white", zorder=3
            )
        if wide:
            axes.set_xlim(values.min() / 1.3, values.max() * 1.3)
            _log(axes, "x")
        else:
            axes.set_xlim(left=0.0)
        axes.set_title(f"{name} [deg]")
        axes.grid(axis="both", color=LINE, linewidth=0.7)
    panels[0].set_yticks(list(place.values()), [trial.replace("_", " ") for trial in trials])
    panels[0].tick_params(axis="y", labelsize=FONT - 1.5)
    panels[0].set_ylim(-len(trials) + 0.4, 0.6)
    _legend(figure, [row.method for row in rows], dots=True)
    return "trials", f"{capital(experiment)}: root mean square error of each trial, a dot a filter.", figure


def _over_time(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> _Drawn:
    """The error of the first trial, a line a filter."""
    trial = next((r.trial for r in results if r.series), "")
    kept = {r.method: r.series for r in results if r.series and r.trial == trial}
    name = next((n for n in ("total_deg", "error_mm", "heading_deg") if all(n in of for of in kept.values())), None)
    if not kept or name is None:
        return None
    curves = {}
    window = 0.0
    for method, series in kept.items():
        time, error = (np.array(series[key], dtype=float) for key in ("time", name))
        over = max(len(time) // WINDOWS, 1)
        window = float(time[min(over, len(time) - 1)] - time[0])
        curves[method] = time, _running_rms(error, over)
    high = {method: float(np.nanpercentile(error, 95)) for method, (_, error) in curves.items()}
    figure = new_figure(3.5)
    axes = figure.add_subplot()
    for method in sorted(curves, key=lambda method: method == OURS):
        time, error = curves[method]
        axes.plot(
            time, error, color=_colour(method), linestyle=_dashes(method), linewidth=1.8 if method == OURS else 1.1
        )
    log = max(high.values()) > 5.0 * max(min(high.values()), 1e-9)
    if log:
        most = max(float(np.nanmax(error)) for _, error in curves.values())
        least = min(float(np.nanmedian(error)) for _, error in curves.values())
        axes.set_ylim(max(0.4 * least, 1e-4 * most), 1.5 * most)
        _log(axes, "y")
    else:
        axes.set_ylim(bottom=0.0)
    longest = max((time for time, _ in curves.values()), key=len)
    axes.set_xlim(longest[0], longest[-1])
    unit = {"total_deg": "total error [deg]", "heading_deg": "heading error, absolute [deg]"}.get(name, "error [mm]")
    axes.set_xlabel("time [s]")
    axes.set_ylabel(unit)
    axes.grid(color=LINE, linewidth=0.7)
    _legend(figure, sorted(curves, key=lambda method: -high[method]))
    caption = f"{capital(experiment)}, trial {trial}: {unit.split(' [')[0]} over time"
    caption += f", root mean square over {window:.2g} s" + (", logarithmic scale" if log else "")
    return "over-time", f"{caption}; the filters in the order of their errors, the largest first.", figure


def _paths(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> _Drawn:
    """The hand's path against the truth, from behind and from above, of smekf and of the worse of NCF and GDC."""
    needed = [f"{true}{axis}_mm" for true in ("", "true_") for axis in "xyz"]
    trial = next((r.trial for r in results if r.series), "")
    kept = {r.method: r.series for r in results if r.trial == trial and all(name in r.series for name in needed)}
    if not kept:
        return None
    first = OURS if OURS in kept else next(iter(kept))
    off = {m: [np.subtract(s[f"{axis}_mm"], s[f"true_{axis}_mm"]) for axis in "xyz"] for m, s in kept.items()}
    plain: list[str] = [m for m in ("ncf", "gdc") if m in kept] or [m for m in kept if m != first]
    others = sorted((m for m in plain if m != first), key=lambda m: float(np.mean(np.square(off[m]))))[-1:]
    figure = new_figure(4.1)
    panels: Sequence[Axes] = figure.subplots(1, 2)
    for axes, up, title in zip(panels, "zx", ("from behind", "from above"), strict=True):
        for method in [*others, first]:
            series = kept[method]
            axes.plot(series["y_mm"], series[f"{up}_mm"], color=_colour(method), linewidth=1.2)
        axes.plot(kept[first]["true_y_mm"], kept[first][f"true_{up}_mm"], linewidth=1.2, **TRUTH)
        axes.set_aspect("equal", "datalim")
        axes.invert_xaxis()  # y is to the left
        axes.set_title(title)
        axes.set_xlabel("y, to the left [mm]")
        axes.set_ylabel({"z": "z, upwards [mm]", "x": "x, forwards [mm]"}[up])
        axes.grid(color=LINE, linewidth=0.7)
    _key(figure, [*((m, {"color": _colour(m)}) for m in [first, *others]), ("truth", TRUTH)], lines=True)
    caption = f"{capital(experiment)}, trial {trial}: the path of the right hand, in W, root of the trunk at zero"
    return "path", f"{caption}; {' and '.join([first, *others])} against the truth.", figure


def _waterfall(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> _Drawn:
    """What each imperfection adds to the hand's error."""
    found: Waterfall | None = waterfall(results)
    if experiment != WATERFALL or found is None:
        return None
    ends = [("all on", found.full), *((part.name, part.added) for part in found.parts)]
    ends += [("with none of them on", found.empty)] if found.empty else []
    ends += [(f"more: {part.name}", part.added) for part in found.more]
    names = list(found.full)
    figure = new_figure(0.9 + 0.32 * len(ends))
    panels: Sequence[Axes] = figure.subplots(1, len(names), sharey=True, sharex=True, squeeze=False)[0]
    place = np.arange(len(ends))[::-1]
    for axes, name in zip(panels, names, strict=True):
        for at, (label, of) in zip(place, ends, strict=True):
            value = of.get(name)
            if value is None:
                continue
            end = label in ("all on", "with none of them on")
            more = label.startswith("more: ")
            style: dict[str, Any] = {"color": INK if end else "#b23a48" if more else ACCENT}
            if value < 0.0:
                style = {"color": "white", "edgecolor": ACCENT, "hatch": "//////"}
            axes.barh(at, value, 0.62, **style)
            text = f"{value:.1f}".replace("-", "−")
            where: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": FONT - 1}
            axes.annotate(text, (max(value, 0.0), at), (4, 0), **where)
        axes.axvline(0.0, color=INK, linewidth=0.8)
        axes.margins(x=0.12)
        axes.set_title(f"{FROM[name]} [mm]")
        axes.grid(axis="x", color=LINE, linewidth=0.7)
    panels[0].set_yticks(place, [label for label, _ in ends])
    caption = (
        "Where the millimetres come from: root mean square error of the hand with all imperfections on, and what each "
        "of them adds: √(all on² − without it²). Parts that are independent add up in quadrature, not in a sum"
    )
    if any(value < 0.0 for part in found.parts for value in part.added.values()):
        caption += "; hatched, to the left: the error grows without it"
    if found.more:
        caption += "; red: what would come on top"
    return "waterfall", f"{caption}.", figure


# How they look ------------------------------------------------------------------------------------------------------


def _running_rms(error: np.ndarray, over: int) -> np.ndarray:
    """(n,) → (n,): root mean square of `over` samples around each; what is missing stays missing."""
    known = np.isfinite(error)
    kernel = np.ones(over)
    total = np.convolve(np.where(known, error, 0.0) ** 2, kernel, "same")
    count = np.convolve(known.astype(float), kernel, "same")
    return np.where(known, np.sqrt(total / np.maximum(count, 1.0)), np.nan)


def _bar(axes: Axes, at: float, mean: float, std: float | None, height: float, **style: Any) -> None:
    axes.barh(at, mean, height, linewidth=0.8, **style)
    if std is not None:
        axes.errorbar(mean, at, xerr=[[0.0], [std]], color=INK, elinewidth=0.9, capsize=2.0, capthick=0.9)


def _clip(axes: Axes, bars: Sequence[tuple[float, float, float]], least: float) -> None:
    """Ends the axis before bars (place, mean, with whisker) that dwarf the others, and writes what they are."""
    reach = np.array([whole for _, _, whole in bars])
    most = 3.0 * float(np.percentile(reach, 75))
    end = float(reach.max())
    if end > most:
        end = 1.25 * float(reach[reach <= most].max())
    end = 1.06 * max(end, 1.1 * least)
    axes.set_xlim(0.0, end)
    for at, mean, _ in bars:
        if mean > end:
            inside = {"facecolor": "white", "edgecolor": "none", "pad": 1.2}
            axes.text(0.99 * end, at, f"{mean:.1f} →", ha="right", va="center", fontsize=FONT - 1.5, bbox=inside)


def _log(axes: Axes, which: str) -> None:
    """A logarithmic axis whose numbers are plain ones."""
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high > 30.0 * low else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _key(figure: Figure, entries: Sequence[tuple[str, dict[str, Any]]], lines: bool = False) -> None:
    """A legend in one line above the panels."""
    handles = [Line2D([], [], label=n, linewidth=1.6, **s) if lines else Patch(label=n, **s) for n, s in entries]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), frameon=False, handlelength=2.2)


def _legend(figure: Figure, methods: Sequence[str], dots: bool = False) -> None:
    """The filters: lines to the right of the panels, in the order given, or dots above them."""
    if not dots:
        handles = [Line2D([], [], label=m, color=_colour(m), linestyle=_dashes(m), linewidth=1.8) for m in methods]
        figure.legend(handles=handles, loc="outside right upper", frameon=False, handlelength=2.4, labelspacing=0.7)
        return
    handles = [
        Line2D([], [], label=m, color=_colour(m), marker=_marker(m), markersize=7 if m == OURS else 5, linestyle="")
        for m in methods
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=min(len(handles), 6), frameon=False)


def _colour(method: str) -> str:
    """A filter's colour, the same in every figure; lighter where it is as it comes."""
    name = method.removesuffix(AS_IT_COMES)
    colour = COLOURS.get(name) or OTHERS[sum(map(ord, name)) % len(OTHERS)]
    if name == method:
        return colour
    red, green, blue = (1.0 - 0.55 * (1.0 - part) for part in to_rgb(colour))
    return to_hex((red, green, blue))


def _dashes(method: str) -> Any:
    return (0, (4, 1.6)) if method.endswith(AS_IT_COMES) or method.startswith("offline") else "-"


def _marker(method: str) -> str:
    return "D" if method.endswith(AS_IT_COMES) else "o"
