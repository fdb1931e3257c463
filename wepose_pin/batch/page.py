"""``report.html`` over a study: what failed and why, how figures are distributed, which items stand apart."""

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
APART = 5.0  # robust deviations: of 10 000 normal figures not one is so far off
FEWEST = 8  # figures, of which one can stand apart
MOST_ROWS = 2000  # of a table in the page; results.parquet has all
MOST_PICTURES = 12
# What says most, first; others follow in the order in which steps give them.
_TELLING = ("gap_mm", "right_hand_arm_error_mm", "left_hand_arm_error_mm", "right_hand_error_mm", "left_hand_error_mm")
_TOLD = ("item", "session", "subject", "status", "error", "message", "page", "quality")
_COST = ("seconds", "memory_mb")
_UNITS = {"mm": "mm", "deg": "deg", "hz": "Hz", "s": "s"}
_WORDS = {
    "seconds": "time it took [s]",
    "gap_mm": "palm-to-palm gap [mm]",
    "memory_mb": "memory of the worker [MB]",
    "independent": "effective sample size of the calibration",
    "static_share": "share of time at rest",
}


class Apart(NamedTuple):
    """A figure far off the others'."""

    item: str
    column: str
    value: float
    median: float
    deviations: float  # robust standard deviations off the median


def study_page(plan: Plan, table: pl.DataFrame, failures: list[str] | None = None) -> str:
    """The page of a study; `table` as in ``results.parquet``, items' folders in ``items/`` beside it.

    `failures` takes a line for each section that cannot be made; the page says so in its place.
    """
    failed, done = table.filter(pl.col("status") != "done"), table.filter(pl.col("status") == "done")
    columns = _figures(done)
    page = Page(TEMPLATE, f"Study: {plan.name}", failures)
    page.add("verdict", lambda: {"done": done.height, "failed": failed.height}, name="The verdict")
    page.add("summary", lambda: {"rows": _facts(plan, table, done)}, name="Facts")
    page.add("failures", lambda: _failures(failed), "Not done, by cause")
    page.add("distributions", lambda: _distributions(done, columns), "Distributions")
    page.add("outliers", lambda: _outliers(done, columns), "Outliers")
    page.add("items", lambda: _items(table, columns), "All items")
    return page.html(f"{plan.name}: {table.height} items")


def apart(done: pl.DataFrame, columns: Sequence[str]) -> list[Apart]:
    """Figures that lie more than `APART` robust deviations (1.4826 times the median one) off, farthest first."""
    found = []
    for column in columns:
        some = done.select("item", column).drop_nulls().filter(pl.col(column).is_finite())
        values = some[column].to_numpy()
        if len(values) < FEWEST:
            continue
        median = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - median)))
        if spread <= 1e-9 * max(1.0, abs(median)):
            continue
        off = (values - median) / spread
        found += [
            Apart(some["item"][k], column, float(values[k]), median, float(off[k]))
            for k in map(int, np.flatnonzero(np.abs(off) > APART))
        ]
    return sorted(found, key=lambda each: -abs(each.deviations))


def _figures(done: pl.DataFrame) -> list[str]:
    known = [
        name
        for name in done.columns
        if name not in _TOLD and done[name].dtype.is_numeric() and done[name].drop_nulls().len()
    ]
    first = [name for name in _TELLING if name in known]
    timed = [name for name in known if name in _COST or (name.endswith("_s") and name != "duration_s")]
    return [*first, *(name for name in known if name not in (*first, *timed)), *timed]


def _facts(plan: Plan, table: pl.DataFrame, done: pl.DataFrame) -> list[tuple[str, str]]:
    steps = dict.fromkeys(step for item in (*plan.first, *plan.items) for step in item.steps)
    subjects = table["subject"].drop_nulls().n_unique()
    facts = [("steps", ", ".join(steps)), ("sessions", str(len(plan.items)))]
    if subjects:
        facts.append(("subjects", str(subjects)))
    if "quality" in done.columns:
        counts = dict(done["quality"].drop_nulls().value_counts().iter_rows())
        told = ", ".join(f"{counts[quality]} {quality}" for quality in ("pass", "poor", "fail") if quality in counts)
        facts.append(("calibrations", told or "none"))
    if "duration_s" in done.columns:
        facts.append(("recorded", f"{float(done['duration_s'].sum()) / 3600.0:.2f} h"))
    facts.append(("worked", f"{float(done['seconds'].sum()) / 60.0:.1f} min of one processor"))
    return facts


def _failures(failed: pl.DataFrame) -> dict[str, Any] | None:
    if failed.is_empty():
        return None
    causes = failed.group_by("error", maintain_order=True).agg(pl.len(), pl.col("message").first())
    causes = causes.sort("len", descending=True, maintain_order=True)
    items = [[row["item"], row["error"], _cut(row["message"])] for row in failed.head(MOST_ROWS).iter_rows(named=True)]
    rows = [[cause, str(count), _cut(text)] for cause, count, text in causes.iter_rows()]
    return {
        "causes": Table(["cause", "items", "the first of them"], rows),
        "items": Table(["item", "cause", "what was wrong"], items),
        "more": _more(failed.height),
    }


def _distributions(done: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any] | None:
    if done.height < 2 or not columns:
        return None
    rows = []
    for column in columns:
        values = _values(done, column)
        told = [f"{value:.4g}" for value in np.quantile(values, (0.5, 0.05, 0.95, 0.0, 1.0))] if len(values) else []
        rows.append([_in_words(column), str(len(values)), *(told or [""] * 5)])
    header = ["figure", "items", "median", "5 %", "95 %", "least", "greatest"]
    pictured = [column for column in columns if len(_values(done, column)) > 1][:MOST_PICTURES]
    return {"picture": _histograms(done, pictured) if pictured else None, "figures": Table(header, rows)}


def _histograms(done: pl.DataFrame, columns: Sequence[str]) -> Picture:
    panels = []
    for column in columns:
        values = _values(done, column)
        median = float(np.median(values))
        ends = float(values.min()), float(values.max())
        if ends[1] - ends[0] <= 1e-9 * abs(median):  # all one value, up to rounding: no bins fit in between
            ends = median - max(0.5, 0.5 * abs(median)), median + max(0.5, 0.5 * abs(median))
        count, edges = np.histogram(values, bins=min(40, max(5, round(2 * len(values) ** 0.5))), range=ends)
        panel = Panel(_in_words(column), x=ends, y=(0.0, 1.05 * float(count.max())), grid="y")
        panel.boxes(np.column_stack([edges[:-1], edges[1:]]), np.column_stack([0 * count, count]), "accent")
        panel.rule("before bold", x=median)
        panels.append(panel)
    rows = [panels[k : k + 3] for k in range(0, len(panels), 3)]
    return Picture("distributions", "Items by figure; the line is the median.", Chart(rows, [90.0] * len(rows)))


def _outliers(done: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any] | None:
    found = apart(done, columns)
    if not found:
        return None
    pages = dict(done.select("item", "page").iter_rows())
    rows = [
        [
            _link(each.item, pages[each.item]),
            _in_words(each.column),
            f"{each.value:.4g}",
            f"{each.median:.4g}",
            f"{each.deviations:+.1f}",
        ]
        for each in found[:MOST_ROWS]
    ]
    header = ["item", "figure", "value", "median", "deviations off"]
    return {"deviations": APART, "outliers": Table(header, rows), "more": _more(len(found))}


def _items(table: pl.DataFrame, columns: Sequence[str]) -> dict[str, Any]:
    shown = [*(name for name in ("quality",) if name in table.columns), *columns[:6]]
    shown += ["seconds"] if "seconds" not in shown else []
    header = ["item", *(["subject"] if table["subject"].drop_nulls().len() else []), "status"]
    rows = []
    for row in table.head(MOST_ROWS).iter_rows(named=True):
        cells = [*([row["subject"] or ""] if "subject" in header else []), row["status"]]
        rows.append([_link(row["item"], row["page"]), *cells, *(_cell(row[name]) for name in shown)])
    return {"items": Table([*header, *map(_in_words, shown)], rows), "more": _more(table.height)}


def _more(count: int) -> tuple[int, int] | None:
    return (MOST_ROWS, count) if count > MOST_ROWS else None


def _link(item: str, page: str | None) -> str | Link:
    """An item's name, which leads to its own page where it has one."""
    return Link(item, f"items/{quote(item)}/{quote(page)}") if page else item


def _values(done: pl.DataFrame, column: str) -> np.ndarray:
    values = done[column].drop_nulls().to_numpy()
    return values[np.isfinite(values)]


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value or "")


def _cut(text: str | None) -> str:
    """A message as plain text, of bounded length: nothing in it is marked."""
    return (text or "").replace("`", "").replace("*", "")[:400]


def _in_words(column: str) -> str:
    """A column's name as a reader wants it: ``left_forearm_std_mm`` → "left forearm std [mm]"."""
    if column in _WORDS:
        return _WORDS[column]
    name, _, unit = column.rpartition("_")
    return f"{name.replace('_', ' ')} [{_UNITS[unit]}]" if name and unit in _UNITS else column.replace("_", " ")
