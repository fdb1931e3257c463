"""A plan from beginning to end: items on workers, the table of results, the page."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from ..diagnostics import Diagnostic
from ..errors import ExistingOutput, reason
from ..jobs.batch import BatchJob
from ..report.page import page_incomplete
from ..writers.provenance import code, collect_provenance
from .cluster import connected, made
from .items import FAILED, MADE, Row, failed
from .page import study_page
from .plan import Item, Plan, read_plan
from .storage import is_remote, only_one, read_bytes, sweep, write_bytes

ITEMS, RESULTS, REPORT, STUDY = "items", "results.parquet", "report.html", "study.json"
# What every row has, before the figures of its steps.
_FIRST = {
    **dict.fromkeys(("item", "session", "subject", "status", "error", "message", "page"), pl.String),
    "seconds": pl.Float64,
}


# Told how many items there are rows of, how many of these are not done, and how many items there are.
ItemProgress = Callable[[int, int, int], None]


class Study(NamedTuple):
    """What came of a plan."""

    plan: Plan
    table: pl.DataFrame  # a row an item, in the order of the plan
    kept: int  # items that were done before
    diagnostics: list[Diagnostic]  # of the page, where it or a part of it cannot be made


def run_batch(job: BatchJob, progress: ItemProgress = lambda *_: None) -> Study:
    """Make all items of a plan, and ``results.parquet`` and ``report.html`` over them, in a folder or below a URL.

    What was done before, by the same plan or another, is left as it is where nothing that makes it has changed.

    Raises
    ------
    WeposeError
        Of the plan or the place. What is wrong with an item stands in its row.
    """
    job.check()
    path, out = job.plan, job.out.rstrip("/")
    place = f"{out}/{ITEMS}" if is_remote(out) else str(Path(out).absolute() / ITEMS)
    plan = read_plan(path, place)
    _claim(out, path)
    with only_one(out):
        everything = (*plan.first, *plan.items)
        names = [item.name for item in everything]
        sweep(place, names)
        rows = _rows(plan, place, job, progress)
        sweep(place, names)
        table = table_of([rows[item.name] for item in everything])
        content = io.BytesIO()
        table.write_parquet(content)
        write_bytes(f"{out}/{RESULTS}", content.getvalue())
        failures: list[str] = []
        try:
            write_bytes(f"{out}/{REPORT}", study_page(plan, table, failures).encode())
        except Exception as error:
            failures.append(f"cannot be made: {reason(error)}")
    kept = sum(bool(row.get("kept")) and row["status"] == MADE for row in rows.values())
    return Study(plan, table, kept, [page_incomplete(REPORT, failure) for failure in failures])


def _claim(out: str, path: Path) -> None:
    """Mark the place as a study's; what is another's stays untouched."""
    if read_bytes(f"{out}/{STUDY}") is None:
        here = Path(out)
        ours = (f".{STUDY}.partial",)  # of a run that was killed at its very beginning
        if not is_remote(out) and here.exists() and (not here.is_dir() or {p.name for p in here.iterdir()} - {*ours}):
            raise ExistingOutput(f"{out}: is there and no study of wepose batch; name another folder")
    try:
        text = json.dumps(collect_provenance("batch", {"plan": path}), indent=1, ensure_ascii=False)
        write_bytes(f"{out}/{STUDY}", text.encode())
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error


def _rows(plan: Plan, place: str, job: BatchJob, progress: ItemProgress) -> dict[str, Row]:
    """Item → its row; subjects first, since sessions wait for them."""
    total = len(plan.first) + len(plan.items)
    rows: dict[str, Row] = {}
    progress(0, 0, total)
    with connected(job.scheduler, job.workers) as client:
        for items in (plan.first, plan.items):
            ready = []
            for item in items:
                cause = _cause(item, plan, rows)
                if cause is None:
                    ready.append(item)
                else:
                    rows[item.name] = cause
            for some in made(client, ready, place, force=job.force, code=code()["code"]):
                rows |= {row["item"]: row for row in some}
                progress(len(rows), sum(row["status"] != MADE for row in rows.values()), total)
    return rows


def _cause(item: Item, plan: Plan, rows: dict[str, Row]) -> Row | None:
    """The row of a session whose subject's calibration has failed; None where it has not."""
    needed = {first.subject: rows.get(first.name) for first in plan.first}
    before = needed.get(item.subject) if "calibrate" not in item.steps else None
    if before is None or before["status"] != FAILED:
        return None
    message = f"{item.session}: its subject '{item.subject}' has no calibration, see item {before['item']}"
    return failed(item, before["error"], message)


def table_of(rows: list[Row]) -> pl.DataFrame:
    """The table of results: a row an item; figures that an item has not are null."""
    names = dict.fromkeys(name for row in rows for name in row if name not in (*_FIRST, "kept"))
    schema: dict[str, Any] = _FIRST | {
        name: pl.String if any(isinstance(row.get(name), str) for row in rows) else pl.Float64 for name in names
    }
    return pl.DataFrame({name: [_cell(row.get(name)) for row in rows] for name in schema}, schema=schema, strict=False)


def _cell(value: Any) -> Any:
    return float(value) if isinstance(value, int) else value
