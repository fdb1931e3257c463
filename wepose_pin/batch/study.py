"""A study: the items of a plan on workers, the table of results, the page."""

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
from .cluster import connect, run_on_cluster
from .items import DONE, FAILED, build_failed_row
from .page import build_study_page
from .plan import Item, Plan, read_plan
from .steps import Row
from .storage import is_remote, lock_folder, read_bytes, remove_leftovers, write_bytes

ITEMS, RESULTS, REPORT, STUDY = "items", "results.parquet", "report.html", "study.json"
# Columns of every row, before those of its steps.
_COMMON = {
    **dict.fromkeys(("item", "session", "subject", "status", "error", "message", "page"), pl.String),
    "seconds": pl.Float64,
}


# Called with the number of items that have a row, of those that are not done, and of all.
ItemProgress = Callable[[int, int, int], None]


class Study(NamedTuple):
    """Outcome of a plan."""

    plan: Plan
    table: pl.DataFrame  # a row an item, in the order of the plan
    reused: int  # items that were done before
    diagnostics: list[Diagnostic]  # of the page


def run_batch(job: BatchJob, progress: ItemProgress = lambda *_: None) -> Study:
    """Run all items of a plan and write ``results.parquet`` and ``report.html``, in a folder or below a URL.

    Items that were done before, by the same plan or another, are reused where nothing has changed.

    Raises
    ------
    WeposeError
        Of the plan or the place. The errors of an item are in its row.
    """
    job.check()
    path, out = job.plan, job.out.rstrip("/")
    place = f"{out}/{ITEMS}" if is_remote(out) else str(Path(out).absolute() / ITEMS)
    plan = read_plan(path, place)
    _claim_folder(out, path)
    with lock_folder(out):
        names = [item.name for item in plan.all_items]
        remove_leftovers(place, names)
        rows = _run_items(plan, place, job, progress)
        remove_leftovers(place, names)
        table = build_table([rows[name] for name in names])
        content = io.BytesIO()
        table.write_parquet(content)
        write_bytes(f"{out}/{RESULTS}", content.getvalue())
        failures: list[str] = []
        try:
            write_bytes(f"{out}/{REPORT}", build_study_page(plan, table, failures).encode())
        except Exception as error:
            failures.append(f"cannot be made: {reason(error)}")
    reused = sum(bool(row.get("reused")) and row["status"] == DONE for row in rows.values())
    return Study(plan, table, reused, [page_incomplete(REPORT, failure) for failure in failures])


def _claim_folder(out: str, path: Path) -> None:
    """Mark the place as a study; raise `ExistingOutput` where it holds something else."""
    if read_bytes(f"{out}/{STUDY}") is None:
        here, partial = Path(out), f".{STUDY}.partial"  # of a run that was killed at its very beginning
        if not is_remote(out) and here.exists() and (not here.is_dir() or {p.name for p in here.iterdir()} - {partial}):
            raise ExistingOutput(f"{out}: is there and no study of wepose batch; name another folder")
    try:
        text = json.dumps(collect_provenance("batch", {"plan": path}), indent=1, ensure_ascii=False)
        write_bytes(f"{out}/{STUDY}", text.encode())
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error


def _run_items(plan: Plan, place: str, job: BatchJob, progress: ItemProgress) -> dict[str, Row]:
    """Item → its row; calibrations of subjects first, since sessions need them."""
    total = len(plan.all_items)
    rows: dict[str, Row] = {}
    progress(0, 0, total)
    with connect(job.scheduler, job.workers) as client:
        for items in (plan.calibrations, plan.items):
            ready = []
            for item in items:
                failed = _find_failed_calibration(item, plan, rows)
                if failed is None:
                    ready.append(item)
                else:
                    rows[item.name] = failed
            for some in run_on_cluster(client, ready, place, force=job.force, code=code()["code"]):
                rows |= {row["item"]: row for row in some}
                progress(len(rows), sum(row["status"] != DONE for row in rows.values()), total)
    return rows


def _find_failed_calibration(item: Item, plan: Plan, rows: dict[str, Row]) -> Row | None:
    """The row of a session whose subject's calibration has failed; None where it has not."""
    rows_of = {calibration.subject: rows.get(calibration.name) for calibration in plan.calibrations}
    row = rows_of.get(item.subject) if "calibrate" not in item.steps else None
    if row is None or row["status"] != FAILED:
        return None
    message = f"{item.session}: its subject '{item.subject}' has no calibration, see item {row['item']}"
    return build_failed_row(item, row["error"], message)


def build_table(rows: list[Row]) -> pl.DataFrame:
    """The table of results: a row an item; null where an item lacks a value."""
    names = dict.fromkeys(name for row in rows for name in row if name not in (*_COMMON, "reused"))
    schema: dict[str, Any] = _COMMON | {
        name: pl.String if any(isinstance(row.get(name), str) for row in rows) else pl.Float64 for name in names
    }
    return pl.DataFrame({name: [_cell(row.get(name)) for row in rows] for name in schema}, schema=schema, strict=False)


def _cell(value: Any) -> Any:
    return float(value) if isinstance(value, int) else value
