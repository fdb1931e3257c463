"""A study: the items of a plan on local processes or on a Dask scheduler, and the table of outcomes."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from ..errors import BadOption, LostWorker, how_to_install
from ..filters.base import count_processors
from ..writers.provenance import code
from .items import DONE, build_failed_row, run_item
from .plan import Item, Plan, read_plan
from .steps import Row
from .storage import is_remote, open_study, write_bytes

RESULTS = "results.parquet"
CONNECT_S = 10.0  # for which a scheduler is waited for
# Columns of every row, before those of its steps.
_COMMON = dict.fromkeys(("item", "session", "subject", "status", "error", "message"), pl.String)
# Processes share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_ONE_THREAD = "WEPOSE_THREADS NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"

# Called with the number of items that have a row, of those that are not done, and of all.
ItemProgress = Callable[[int, int, int], None]


class Study(NamedTuple):
    """What came of a plan."""

    plan: Plan
    table: pl.DataFrame  # a row an item, in the order of the plan
    reused: int  # items that were done before

    @property
    def exit_code(self) -> int:
        return 3 if (self.table["status"] != DONE).any() else 0


def run_batch(
    plan_file: Path,
    out: str,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: ItemProgress = lambda *_: None,
) -> Study:
    """Run all items of a plan and write ``results.parquet``, in a folder or below a URL.

    Items that were done before are reused where nothing has changed. Options as those of `batch`.

    Raises
    ------
    WeposeError
        Of the plan or the place. The errors of an item are in its row.
    """
    if workers is not None and (workers < 1 or scheduler is not None):
        why = "they run at the scheduler, which knows how many" if scheduler else "at least 1"
        raise BadOption(f"--workers {workers}: {why}")
    out = out.rstrip("/")
    place = f"{out}/items" if is_remote(out) else str(Path(out).absolute() / "items")
    plan = read_plan(plan_file, place)
    run = _run_here if scheduler is None else _run_on_scheduler
    with open_study(out):
        rows = _run_items(plan, partial(run, place=place, force=force, where=scheduler or workers), progress)
        table = build_table([rows[item.name] for item in plan.all_items])
        content = io.BytesIO()
        table.write_parquet(content)
        write_bytes(f"{out}/{RESULTS}", content.getvalue())
    return Study(plan, table, sum(bool(row.get("reused")) and row["status"] == DONE for row in rows.values()))


def _run_items(plan: Plan, run: Callable[[Sequence[Item]], Generator[Row]], progress: ItemProgress) -> dict[str, Row]:
    """Item → its row; calibrations of subjects first, since sessions need them."""
    rows: dict[str, Row] = {}
    total = len(plan.all_items)
    progress(0, 0, total)
    for items in (plan.calibrations, plan.items):
        with contextlib.closing(run(items)) as done:
            for row in done:
                rows[row["item"]] = row
                progress(len(rows), sum(each["status"] != DONE for each in rows.values()), total)
    return rows


def _run_here(items: Sequence[Item], place: str, force: bool, where: Any) -> Generator[Row]:
    """Rows of the items, in the order in which they are done, from processes of this machine.

    A process that dies takes those beside it along: their items fail, and the others go on in new processes.
    """
    todo, count = deque(items), min(where or count_processors(), max(len(items), 1))
    before = set(active_children())
    with _one_thread():
        while todo:
            pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_prepare_process)
            try:
                yield from _run_in_turn(pool, todo, count, place, force)
            except BrokenProcessPool:
                continue
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in set(active_children()) - before:  # when stopped, an item may have minutes to go
                    process.terminate()


def _run_on_scheduler(items: Sequence[Item], place: str, force: bool, where: Any) -> Generator[Row]:
    """The same by the workers of a running Dask scheduler; `LostWorker` where it goes meanwhile."""
    try:
        from distributed import Client
    except ImportError as error:
        remedy = how_to_install("dask", "distributed")
        raise BadOption(f"wepose batch --scheduler: {error}: {remedy}") from None
    try:
        client = Client(where, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise BadOption(f"--scheduler {where}: no scheduler there, as in tcp://HOST:8786: {reason}") from None
    with client, client.get_executor(pure=False) as executor:
        try:
            yield from _run_in_turn(executor, deque(items), len(items), place, force)
        except CancelledError:
            raise LostWorker(f"{where}: the scheduler is gone; the same command goes on where it stopped") from None


def _run_in_turn(executor: Executor, todo: deque[Item], most: int, place: str, force: bool) -> Iterator[Row]:
    """Rows of the items, at most so many at a time; those whose process died are `LostWorker`.

    Processes that die end it with `BrokenProcessPool`; `todo` has the items that were not begun.
    """
    running: dict[Future[Row], Item] = {}
    broken: BrokenProcessPool | None = None
    while running or (todo and broken is None):
        while todo and len(running) < most and broken is None:
            try:
                running[executor.submit(run_item, todo[0], place, force, code()["code"])] = todo[0]
                todo.popleft()
            except BrokenProcessPool as died:
                broken = died
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            item, error = running.pop(future), future.exception()
            if error is None:
                yield future.result()
                continue
            if isinstance(error, BrokenProcessPool):
                broken = error
            elif type(error).__name__ != "KilledWorker":  # Dask's, after several workers died at it
                raise error
            message = f"{item.session}: the process of this item, or of one beside it, died; it may lack memory"
            yield build_failed_row(item, LostWorker.__name__, message)
    if broken is not None:
        raise broken


def _prepare_process() -> None:
    """Ctrl-C in the terminal is for the parent; a process whose parent was killed ends itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """One thread a process, for those that are started meanwhile."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD.split()}
    os.environ.update(dict.fromkeys(before, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            os.environ.update({} if value is None else {name: value})


def build_table(rows: list[Row]) -> pl.DataFrame:
    """The table of outcomes: a row an item; null where an item lacks a value."""
    named = [dict.fromkeys(_COMMON) | {name: value for name, value in row.items() if name != "reused"} for row in rows]
    return pl.DataFrame(named, schema_overrides=_COMMON, infer_schema_length=None)
