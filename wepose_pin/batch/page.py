"""``report.html`` of a study: failures by cause, distributions of values, outliers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import polars as pl

from ..report.chart import Chart, Panel, Picture
from ..report.page import Link, Page, Table
from .plan import Plan

TEMPLATE = "batch/templates/study.html.j2"
MAX_DEVIATIONS = 5.0  # robust standard deviations of a value that is no outlier: normal values hardly exceed 4
MIN_VALUES = 8  # among which there can be an outlier
MAX_ROWS = 2000  # of a table in the page; results.parquet has all
MAX_HISTOGRAMS = 12
# Columns shown first, by the ends of their names; others follow in the order in which steps give them.
_MAIN = ("gap_mm", "_error_mm")
_TEXT = ("item", "session", "subject", "status", "error", "message", "page", "quality")
_COST = ("seconds", "memory_mb")
_UNITS = {"mm": "mm", "deg": "deg", "hz": "Hz", "s": "s"}
_LABELS = {
    "seconds": "duration of the item [s]",
    "gap_mm": "gap of the closed chain [mm]",
    "memory_mb": "memory of the worker [MB]",
    "effective_sample_size": "effective sample size of the calibration",
    "static_share": "static share of the time",
}


class Outlier(NamedTuple):
    """A value far off those of the other items."""

    item: str
    column: str
    value: float
    median: float
    deviations: float  # from the median, in robust standard deviations


def build_study_page(plan: Plan, table: pl.DataFrame, failures: list[str] | None = None) -> str:
    """The page of a study; `table` as in ``results.parquet``, items' folders in ``items/`` beside it.

    `failures` receives a line for each section that cannot be made.
    """
    failed, done = table.filter(pl.col("status") != "done"), table.filter(pl.col("status") == "done")
    columns = _select_columns(done)
    page = Page(TEMPLATE, f"Study: {plan.name}", failures)
    page.add("status", lambda: {"done": done.height, "failed": failed.height}, name="Status")
    page.add("summary", lambda: {"rows": _list_facts(plan, table, done)}, name="Facts")
    page.add("failures", lambda: _group_failures(failed), "Not done, by cause")
    page.add("distributions", lambda: _summarize_values(done, columns), "Distributions")
    page.add("outliers", lambda: _list_outliers(done, columns), "Outliers")
    page.add("items", lambda: _list_items(table, columns), "All items")
    return page.html(f"{plan.name}: {table.height} items")


def find_outliers(done: pl.DataFrame, columns: Sequence[str]) -> list[Outlier]:
    """Values more than `MAX_DEVIATIONS` robust standard deviations (1.4826 MAD) from the median, farthest first."""
    outliers = []
    for column in columns:
        rows = done.select("item", column).drop_nulls().filter(pl.col(column).is_finite())
        values = rows[column].to_numpy()
        if len(values) < MIN_VALUES:
            continue
        median = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - median)))
        if spread <= 1e-9 * max(1.0, abs(median)):
            continue
        deviations = (values - median) / spread
        outliers += [
            Outlier(rows["item"][k], column, float(values[k]), median, float(deviations[k]))
            for k in map(int, np.flatnonzero(np.abs(deviations) > MAX_DEVIATIONS))
        ]
    return sorted(outliers, key=lambda outlier: -abs(outlier.deviations))


def _select_columns(done: pl.DataFrame) -> list[str]:
    known = [
        name
        for name in done.columns
        if name not in _TEXT and done[name].dtype.is_numeric() and done[name].drop_nulls().len()
    ]
    ends = [next((k for k, end in enumerate(_MAIN) if name.endswith(end)), len(_MAIN)) for name in known]
    first = [name for end, name in sorted(zip(ends, known, strict=True), key=lambda item: item[0]) if end < len(_MAIN)]
    timed = [name for name in known if name in _COST or (name.endswith("_s") and name != "duration_s")]
    return [*first, *(name for name in known if name not in (*first, *timed)), *timed]


def _list_facts(plan: Plan, table: pl.DataFrame, done: pl.DataFrame) -> list[tuple[str, str]]:
    steps = dict.fromkeys(step for item in plan.all_items for step in item.steps)
    subjects = table["subject"].drop_nulls().n_unique()
    facts = [("steps", ", ".join(steps)), ("sessions", str(len(plan.items)))]
    if subjects:
        facts.append(("subjects", str(subjects)))
    if "quality" in done.columns:
        counts = dict(done["quality"].drop_nulls().value_counts().iter_rows())
        text = ", ".join(f"{counts[quality]} {quality}" for quality in ("pass", "poor", "fail") if quality in counts)
        facts.append(("calibrations", text or "none"))
    if "duration_s" in done.columns:
        facts.append(("recorded", f"{float(done['duration_s'].sum()) / 3600.0:.2f} h"))
    facts.append(("processor time", f"{float(done['seconds'].sum()) / 60.0:.1f} min"))
    return facts


def _group_failures(failed: pl.DataFrame) -> dict[str, Any] | None:
    if failed.is_empty():
        return None
    causes = failed.group_by("error", maintain_order=True).agg(pl.len(), pl.col("message").first())
    causes = causes.sort("len", descending=True, maintain_order=True)
    items = [[row["item"], row["error"], _clean(row["message"])] for row in failed.head(MAX_ROWS).iter_rows(named=True)]
    rows = [[cause, str(count), _clean(text)] for cause, count, text in causes.iter_rows()]
    return {
        "causes": Table(["cause", "items", "first message"], rows),
        "items": Table(["item", "cause", "message"], items),
        "more": _count_more(failed.height),
    }


def _summarize_values(done: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any] | None:
    if done.height < 2 or not columns:
        return None
    rows = []
    for column in columns:
        values = _finite_values(done, column)
        quantiles = np.quantile(values, (0.5, 0.05, 0.95, 0.0, 1.0)) if len(values) else []
        cells = [f"{value:.4g}" for value in quantiles] or [""] * 5
        rows.append([_label(column), str(len(values)), *cells])
    header = ["value", "items", "median", "5 %", "95 %", "smallest", "largest"]
    varied = [column for column in columns if len(_finite_values(done, column)) > 1][:MAX_HISTOGRAMS]
    return {"picture": _draw_histograms(done, varied) if varied else None, "values": Table(header, rows)}


def _draw_histograms(done: pl.DataFrame, columns: Sequence[str]) -> Picture:
    panels = []
    for column in columns:
        values = _finite_values(done, column)
        median = float(np.median(values))
        ends = float(values.min()), float(values.max())
        if ends[1] - ends[0] <= 1e-9 * abs(median):  # one value, up to rounding, has no room for bins
            ends = median - max(0.5, 0.5 * abs(median)), median + max(0.5, 0.5 * abs(median))
        count, edges = np.histogram(values, bins=min(40, max(5, round(2 * len(values) ** 0.5))), range=ends)
        panel = Panel(_label(column), x=ends, y=(0.0, 1.05 * float(count.max())), grid="y")
        panel.boxes(np.column_stack([edges[:-1], edges[1:]]), np.column_stack([0 * count, count]), "accent")
        panel.rule("before bold", x=median)
        panels.append(panel)
    rows = [panels[k : k + 3] for k in range(0, len(panels), 3)]
    return Picture(
        "distributions", "Number of items by value; the line is the median.", Chart(rows, [90.0] * len(rows))
    )


def _list_outliers(done: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any] | None:
    outliers = find_outliers(done, columns)
    if not outliers:
        return None
    pages = dict(done.select("item", "page").iter_rows())
    rows = [
        [
            _link(outlier.item, pages[outlier.item]),
            _label(outlier.column),
            f"{outlier.value:.4g}",
            f"{outlier.median:.4g}",
            f"{outlier.deviations:+.1f}",
        ]
        for outlier in outliers[:MAX_ROWS]
    ]
    header = ["item", "value of", "value", "median", "robust deviations"]
    return {"deviations": MAX_DEVIATIONS, "outliers": Table(header, rows), "more": _count_more(len(outliers))}


def _list_items(table: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any]:
    shown = [*(name for name in ("quality",) if name in table.columns), *columns[:6]]
    shown += ["seconds"] if "seconds" not in shown else []
    header = ["item", *(["subject"] if table["subject"].drop_nulls().len() else []), "status"]
    rows = []
    for row in table.head(MAX_ROWS).iter_rows(named=True):
        cells = [*([row["subject"] or ""] if "subject" in header else []), row["status"]]
        rows.append([_link(row["item"], row["page"]), *cells, *(_cell(row[name]) for name in shown)])
    return {"items": Table([*header, *map(_label, shown)], rows), "more": _count_more(table.height)}


def _count_more(count: int) -> tuple[int, int] | None:
    return (MAX_ROWS, count) if count > MAX_ROWS else None


def _link(item: str, page: str | None) -> str | Link:
    """An item's name, with a link to its page where it has one."""
    return Link(item, f"items/{quote(item)}/{quote(page)}") if page else item


def _finite_values(done: pl.DataFrame, column: str) -> np.ndarray:
    values = done[column].drop_nulls().to_numpy()
    return values[np.isfinite(values)]


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value or "")


def _clean(text: str | None) -> str:
    """A message without marks for code and bold, of bounded length."""
    return (text or "").replace("`", "").replace("*", "")[:400]


def _label(column: str) -> str:
    """Label of a column: ``left_forearm_std_mm`` → "left forearm std [mm]"."""
    if column in _LABELS:
        return _LABELS[column]
    name, _, unit = column.rpartition("_")
    return f"{name.replace('_', ' ')} [{_UNITS[unit]}]" if name and unit in _UNITS else column.replace("_", " ")
