"""The charts of a validation run: errors over time, bars, paths, the error budget, trial by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import reason
from ..report.chart import Chart, Key, Marker, Panel, Picture, category_rows
from ..report.words import capital, slug
from .document import Document
from .jobs import Result
from .tables import (
    AS_COMMANDED,
    AS_PUBLISHED,
    AXES,
    DEFAULTS,
    ERROR_BUDGET,
    FROM,
    HAND,
    LENGTHS_ALONE,
    OPEN_LOOP,
    OURS,
    PROTOCOL,
    SPLIT,
    TARGETS,
    WITH_TRUNK,
    Row,
    collect_figures,
    compute_error_budget,
    find_paper_figures,
    split_unit,
    summarize,
)

COLOURS = {
    "smekf": "#24618f",
    AS_PUBLISHED: "#5b87ab",
    WITH_TRUNK: "#3d7199",
    LENGTHS_ALONE: "#7a9fbe",
    OPEN_LOOP: "#a9c1d5",
    PROTOCOL: "#1b3a57",
    "amekf": "#3fa7c9",
    AS_COMMANDED: "#8fcbe0",
    "smoother": "#2f4a66",
    "ncf": "#d9772b",
    "gdc": "#4b9a55",
    "vqf": "#a04c9c",
    "offline vqf": "#d08bc4",
    "imufusion": "#8a6a3c",
}
OTHERS = ("#b23a48", "#6c757d", "#7a9e1f", "#5f4bb6")
WINDOWS = 60  # of the running root mean square, over a curve's time


def draw_pictures(document: Document, failures: list[str] | None = None) -> Iterator[tuple[str, Picture]]:
    """Draw the charts, each with its experiment, in the order of the page; without those that lack results.

    `failures` takes a line for each chart whose drawing fails.
    """
    rows = summarize(document.results)
    for experiment in dict.fromkeys(row.experiment for row in rows):
        own_rows = [row for row in rows if row.experiment == experiment]
        results = [result for result in document.results if result.experiment == experiment]
        for draw in (_budget, _bars, _trials, _over_time, _path):
            try:
                picture = draw(experiment, own_rows, results)
            except Exception as error:
                if failures is not None:
                    kind = draw.__name__.strip("_").replace("_", " ")
                    failures.append(f"{experiment}: the figure of {kind} cannot be drawn: {reason(error)}")
                continue
            if picture is not None:
                yield experiment, picture._replace(stem=f"{slug(experiment)}-{picture.stem}")


def _bars(experiment: str, rows: Sequence[Row], results: Sequence[Result]) -> Picture | None:
    """Draw a bar for each filter and figure, with the paper's hatched below it."""
    quantities = [AXES, tuple(HAND.values())]
    if len({result.trial for result in results}) == 1:
        quantities.append(tuple(name.replace("_", " ") for name in SPLIT[:3]))
    names = next((names for names in quantities if all(name in row.figures for row in rows for name in names)), None)
    if names is None or experiment.startswith(ERROR_BUDGET):
        return None
    paper = {row.method: find_paper_figures(experiment, row.method) for row in rows if row.method in COLOURS}
    limits = {target.name: target.most for target in TARGETS.get(experiment, ())}
    methods = [row.method for row in rows]
    panels: list[Panel] = []
    for name in names:
        title, unit = split_unit(name)
        panel = Panel(f"{FROM.get(name, title)} [{unit}]", shown_y=not panels)
        bars = []  # place, mean, with whisker
        for at, row in zip(category_rows(panel, methods), rows, strict=True):
            reference = paper.get(row.method, {}).get(name)
            half, up = (0.18, 0.19) if reference else (0.25, 0.0)
            both = [(at + up, row.figures[name], row.figures.get(f"{name} std", 0.0), _colour(row.method), "")]
            both += [(at - up, *reference, "", "hatched outlined soft")] if reference else []
            for place, mean, std, colour, css in both:
                panel.boxes((0.0, mean), (place - half, place + half), css, colour=colour)
                panel.line(np.array([mean, mean + std]), np.full(2, place), "ink thin")
                bars.append((place, mean, mean + std))
        limit = limits.get(name, 0.0)
        panel.x = (
            0.0,
            _end_of_bars(bars, max([limit, *(sum(figures[name]) for figures in paper.values() if name in figures)])),
        )
        for place, mean, _ in bars:
            if mean > panel.x[1]:  # beyond the scale: text
                panel.text(panel.x[1], place, f"{mean:.1f} →", "halo", "end", dx=-3.0)
        if limit:
            panel.rule("ink dashed", x=limit)
        panels.append(panel)
    caption = f"{capital(experiment)}: {'error' if names not in quantities[:2] else 'mean error'}"
    caption += ", whiskers: one standard deviation over time" if f"{names[0]} std" in rows[0].figures else ""
    keys = []
    if any(paper.values()):
        keys += [Key("ours", "accent", "box"), Key("the paper", "hatched outlined soft", "box")]
        caption += "; hatched: the paper's"
    keys += [Key("target", "ink dashed")] if set(limits) & set(names) else []
    return Picture("bars", f"{caption}.", Chart([panels], [30.0 * len(rows)], keys))


def _trials(experiment: str, rows: Sequence[Row], results: Sequence[Result]) -> Picture | None:
    """Draw a marker for each filter and trial, where the error is split into inclination, heading and total."""
    names = [name.replace("_", " ") for name in SPLIT[:3]]
    trials = list(dict.fromkeys(result.trial for result in results))
    if len(trials) < 2 or not all(name in row.figures for row in rows for name in names):
        return None
    panels: list[Panel] = []
    for name in names:
        panel = Panel(f"{name} [°]", shown_y=not panels)
        places = category_rows(panel, [trial.replace("_", " ") for trial in trials])
        place = dict(zip(trials, places, strict=True))
        points = [
            (r.method, place[r.trial], value) for r in results if (value := collect_figures(r).get(name)) is not None
        ]
        values = np.array([value for _, _, value in points])
        panel.grid = "xy"
        panel.log_x = bool(values.min() > 0.0 and values.max() > 12.0 * values.min())
        panel.x = None if panel.log_x else (0.0, 1.05 * float(values.max()))
        for k, method in reversed(list(enumerate(row.method for row in rows))):  # ours on top
            offset = 0.6 * (0.5 - (k + 0.5) / len(rows))  # equal errors do not hide each other
            at = np.array([(value, at + offset) for label, at, value in points if label == method]).reshape(-1, 2)
            size = 4.5 if method == OURS else 3.2
            panel.markers(at[:, 0], at[:, 1], _marker(method), "", size=size, colour=_colour(method))
        panels.append(panel)
    caption = f"{capital(experiment)}: root mean square error of each trial, a marker a filter."
    keys = [Key(row.method, "", _marker(row.method), colour=_colour(row.method)) for row in rows]
    return Picture("trials", caption, Chart([panels], [26.0 * len(trials) + 10.0], keys))


def _over_time(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> Picture | None:
    """Draw the error of the first trial over time, one line a filter."""
    trial = next((r.trial for r in results if r.series), "")
    series = {r.method: r.series for r in results if r.series and r.trial == trial}
    name = next(
        (n for n in ("total_deg", "error_mm", "heading_deg") if all(n in own_series for own_series in series.values())),
        None,
    )
    if not series or name is None:
        return None
    curves = {}
    window = 0.0
    for method, own_series in series.items():
        time, error = (np.array(own_series[key], dtype=float) for key in ("time", name))
        over = max(len(time) // WINDOWS, 1)
        window = float(time[min(over, len(time) - 1)] - time[0])
        curves[method] = time, _running_rms(error, over)
    high = {method: float(np.nanpercentile(error, 95)) for method, (_, error) in curves.items()}
    longest = max((time for time, _ in curves.values()), key=len)
    title = {"total_deg": "total error [°]", "heading_deg": "heading error, absolute [°]"}.get(name, "error [mm]")
    panel = Panel(title, "time [s]", x=(float(longest[0]), float(longest[-1])))
    panel.log_y = max(high.values()) > 5.0 * max(min(high.values()), 1e-9)
    most = max(float(np.nanmax(error)) for _, error in curves.values())
    least = min(float(np.nanmedian(error)) for _, error in curves.values())
    panel.y = (max(0.4 * least, 1e-4 * most), 1.5 * most) if panel.log_y else (0.0, 1.05 * most)
    for method in sorted(curves, key=lambda method: method == OURS):
        panel.line(*curves[method], _style(method), colour=_colour(method))
    caption = f"{capital(experiment)}, trial {trial}: {title.split(' [')[0]} over time"
    caption += f", root mean square over {window:.2g} s" + (", logarithmic scale" if panel.log_y else "")
    keys = [Key(m, _style(m), colour=_colour(m)) for m in sorted(curves, key=lambda method: -high[method])]
    caption += "; the filters in the order of their errors, the largest first."
    return Picture("over-time", caption, Chart([[panel]], [250.0], keys))


def _path(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> Picture | None:
    """Draw the hand's path and the truth, from behind and from above, of smekf and of the worse of NCF and GDC."""
    needed = [f"{true}{axis}_mm" for true in ("", "true_") for axis in "xyz"]
    trial = next((r.trial for r in results if r.series), "")
    series = {r.method: r.series for r in results if r.trial == trial and all(name in r.series for name in needed)}
    if not series:
        return None
    first = OURS if OURS in series else next(iter(series))
    off = {m: [np.subtract(s[f"{axis}_mm"], s[f"true_{axis}_mm"]) for axis in "xyz"] for m, s in series.items()}
    plain: list[str] = [m for m in ("ncf", "gdc") if m in series] or [m for m in series if m != first]
    others = sorted((m for m in plain if m != first), key=lambda m: float(np.mean(np.square(off[m]))))[-1:]
    panels: list[Panel] = []
    for up, title in (("z", "from behind: z, upwards [mm]"), ("x", "from above: x, forwards [mm]")):
        panel = Panel(title, "y, to the left [mm]", equal=True, flip_x=True)
        for method in [*others, first]:
            path = {key: np.array(series[method][key], float) for key in needed}
            panel.line(path["y_mm"], path[f"{up}_mm"], "", colour=_colour(method))
        panel.line(path["true_y_mm"], path[f"true_{up}_mm"], "ink dotted")
        panels.append(panel)
    keys = [*(Key(m, "", colour=_colour(m)) for m in [first, *others]), Key("truth", "ink dotted")]
    caption = f"{capital(experiment)}, trial {trial}: the path of the right hand, in W, root of the trunk at zero"
    caption += f"; {' and '.join([first, *others])} against the truth."
    return Picture("path", caption, Chart([panels], [330.0], keys))


def _budget(experiment: str, _: Sequence[Row], results: Sequence[Result]) -> Picture | None:
    """Draw the error budget of the hand."""
    budget = compute_error_budget(results)
    if budget is None:
        return None
    lines = [("all on", budget.full, "ink"), *((part.name, part.added, "accent") for part in budget.parts)]
    lines += [(f"more: {part.name}", part.added, "before") for part in budget.more]
    names = [line[0] for line in lines]
    values = [line[1].get(name, 0.0) for line in lines for name in budget.full]
    panels: list[Panel] = []
    for name in budget.full:
        ends = min(0.0, 1.05 * min(values)), 1.15 * max(values)
        panel = Panel(f"{FROM[name]} [mm]", x=ends, shown_y=not panels)
        for at, (__, figures, css) in zip(category_rows(panel, names), lines, strict=True):
            value = figures.get(name)
            if value is not None:
                ends = min(value, 0.0), max(value, 0.0)
                panel.boxes(ends, (at - 0.31, at + 0.31), css if value >= 0.0 else "hatched outlined soft")
                panel.text(ends[1], at, f"{value:.1f}".replace("-", "−"), dx=5.0)
        panel.rule("ink thin", x=0.0)
        panels.append(panel)
    caption = (
        f"{capital(experiment)}: root mean square error of the hand with all imperfections on, and what each of them "
        f"adds: √(all on² − without it²). Parts that are independent add up in quadrature, not in a sum"
    )
    if any(value < 0.0 for part in budget.parts for value in part.added.values()):
        caption += "; hatched, to the left: the error grows without it"
    if budget.more:
        caption += "; orange: what would come on top"
    return Picture("parts", f"{caption}.", Chart([panels], [28.0 * len(lines) + 6.0]))


# Style ----------------------------------------------------------------------------------------------------------------


def _running_rms(error: np.ndarray, over: int) -> np.ndarray:
    """Compute the root mean square (n,) of `over` samples around each sample; NaN stay NaN."""
    known = np.isfinite(error)
    kernel = np.ones(over)
    total = np.convolve(np.where(known, error, 0.0) ** 2, kernel, "same")
    count = np.convolve(known.astype(float), kernel, "same")
    return np.where(known, np.sqrt(total / np.maximum(count, 1.0)), np.nan)


def _end_of_bars(bars: Sequence[tuple[float, float, float]], least: float) -> float:
    """Find the end of the axis, before bars (place, mean, with whisker) that are much longer than the others."""
    reach = np.array([whole for _, _, whole in bars])
    most = 3.0 * float(np.percentile(reach, 75))
    end = float(reach.max())
    if end > most:
        end = 1.25 * float(reach[reach <= most].max())
    return 1.06 * max(end, 1.1 * least, 1e-9)


def _colour(method: str) -> str:
    """Choose a filter's colour, the same in every chart; lighter with default gains."""
    name = method.removesuffix(DEFAULTS)
    colour = COLOURS.get(name) or OTHERS[sum(map(ord, name)) % len(OTHERS)]
    if name == method:
        return colour
    parts = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return "#" + "".join(f"{round(255 - 0.55 * (255 - part)):02x}" for part in parts)


def _style(method: str) -> str:
    dashed = "dashed" if method.endswith(DEFAULTS) or method.startswith("offline") else ""
    return f"{dashed} {'' if method == OURS else 'thin'}"


def _marker(method: str) -> Marker:
    return "diamond" if method.endswith(DEFAULTS) else "circle"
