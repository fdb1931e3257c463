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
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import NamedTuple

import polars as pl

from ..errors import BadOption, LostWorker, how_to_install, reason
from ..filters.base import count_processors
from .items import DONE, Row, describe, fail, run_item
from .plan import Item, Plan, read_plan
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
    rows: dict[str, Row] = {}
    with open_study(out):
        progress(0, 0, len(plan.all_items))
        for items in (plan.calibrations, plan.items):  # sessions need the calibrations
            if scheduler is None:
                run = _run_here(items, workers or count_processors(), place, force)
            else:
                run = _run_on_scheduler(items, scheduler, place, force)
            with contextlib.closing(run) as done:
                for row in done:
                    rows[row["item"]] = row
                    progress(len(rows), sum(each["status"] != DONE for each in rows.values()), len(plan.all_items))
        named = [dict.fromkeys(_COMMON) | rows[item.name] for item in plan.all_items]
        reused = sum(bool(row.pop("reused", False)) and row["status"] == DONE for row in named)
        table = pl.DataFrame(named, schema_overrides=_COMMON, infer_schema_length=None)
        content = io.BytesIO()
        table.write_parquet(content)
        write_bytes(f"{out}/{RESULTS}", content.getvalue())
    return Study(plan, table, reused)


def _run_here(items: Sequence[Item], count: int, place: str, force: bool) -> Generator[Row]:
    """Rows of the items, in the order in which they are done, from processes of this machine.

    A process that dies takes those beside it along: their items fail, and the others go on in new processes.
    """
    todo, count = deque(items), min(count, max(len(items), 1))
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


def _run_on_scheduler(items: Sequence[Item], address: str, place: str, force: bool) -> Generator[Row]:
    """The same by the workers of a running Dask scheduler; `LostWorker` where it goes meanwhile."""
    try:
        from distributed import Client
    except ImportError as error:
        remedy = how_to_install("dask", "distributed")
        raise BadOption(f"wepose batch --scheduler: {error}: {remedy}") from None
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise BadOption(f"--scheduler {address}: no scheduler there, as in tcp://HOST:8786: {reason(error)}") from None
    with client, client.get_executor(pure=False) as executor:
        try:
            yield from _run_in_turn(executor, deque(items), len(items), place, force)
        except CancelledError:
            raise LostWorker(f"{address}: the scheduler is gone; the same command goes on where it stopped") from None


def _run_in_turn(executor: Executor, todo: deque[Item], most: int, place: str, force: bool) -> Iterator[Row]:
    """Rows of the items, at most so many at a time; those whose process died are `LostWorker`.

    Processes that die end it with `BrokenProcessPool`; `todo` has the items that were not begun.
    """
    running: dict[Future[Row], Item] = {}
    broken: BrokenProcessPool | None = None
    while running or (todo and broken is None):
        while todo and len(running) < most and broken is None:
            try:
                running[executor.submit(run_item, todo[0], place, force)] = todo[0]
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
            yield describe(item) | fail(LostWorker.__name__, message)
    if broken is not None:
        raise broken


def _prepare_process() -> None:
    """Ctrl-C in the terminal is for the parent; a process whose parent was killed ends itself."""

    def exit_with_parent() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()


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
