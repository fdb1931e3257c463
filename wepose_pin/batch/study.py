"""A study: the items of a plan on local processes or on a Dask scheduler, and the table of outcomes."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import NamedTuple

import polars as pl

from ..errors import BadOption, LostWorker, how_to_install, reason
from ..filters.base import count_processors
from .items import DONE, Row, fail, run_item
from .plan import Item, read_plan
from .storage import is_remote, open_study, write_bytes

RESULTS = "results.parquet"
CONNECT_S = 10.0  # for which a scheduler is waited for
# Columns of every row, before those of its steps.
_COMMON = dict.fromkeys(("item", "session", "subject", "status", "error", "message"), pl.String)
# Processes share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_ONE_THREAD = "WEPOSE_THREADS NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"
_DIED = "the process of this item, or of one beside it, died; it may lack memory"

# Called with the number of items that have a row, of those that are not done, and of all.
ItemProgress = Callable[[int, int, int], None]


class Study(NamedTuple):
    """What came of a plan."""

    table: pl.DataFrame  # a row an item, in the order of the plan
    reused: int  # items that were done before


def run_batch(
    plan_file: Path,
    out: str,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: ItemProgress = lambda *_: None,
) -> Study:
    """Run all items of a plan and write ``results.parquet``, in a folder or below a URL; options as those of `batch`.

    Items that were done before are reused where nothing has changed. A mistake in the plan or the place is a
    `WeposeError`; the errors of an item are in its row.
    """
    if workers is not None and scheduler is not None:
        raise BadOption(f"--workers {workers}: leave it out; the workers of --scheduler are running already")
    out = out.rstrip("/")
    place = f"{out}/items" if is_remote(out) else str(Path(out).absolute() / "items")
    plan = read_plan(plan_file, place)
    names = [item.name for items in plan for item in items]
    rows: dict[str, Row] = {}
    count = workers or count_processors()  # before the processes of items get one thread each
    with open_study(out), _one_thread():
        progress(0, 0, len(names))
        for items in plan:  # sessions need the calibrations
            if scheduler is None:
                run = _run_here(items, count, place, force)
            else:
                run = _run_on_scheduler(items, scheduler, place, force)
            with contextlib.closing(run) as done:
                for row in done:
                    rows[row["item"]] = row
                    progress(len(rows), sum(each["status"] != DONE for each in rows.values()), len(names))
        reused = sum(row.pop("reused", False) for row in rows.values())
        ordered = [dict.fromkeys(_COMMON) | rows[name] for name in names]
        table = pl.DataFrame(ordered, schema_overrides=_COMMON, infer_schema_length=None)
        content = io.BytesIO()
        table.write_parquet(content)
        write_bytes(f"{out}/{RESULTS}", content.getvalue())
    return Study(table, reused)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that start within the block have one thread each."""
    names = _ONE_THREAD.split()
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name in names:
            del os.environ[name]
        os.environ.update(before)


def _run_here(items: Sequence[Item], count: int, place: str, force: bool) -> Generator[Row]:
    """Rows of the items, in the order in which they are done, from processes of this machine.

    A process that dies takes those beside it along: their items fail, and the others go on in new processes.
    """
    todo, before = list(items), set(active_children())
    while todo:
        pool = ProcessPoolExecutor(min(count, len(todo)), get_context("spawn"), _prepare_process)
        try:
            futures = {pool.submit(run_item, item, place, force): item for item in todo}
            for future in as_completed(futures):
                if future.exception() is None:
                    todo.remove(futures[future])
                    yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(active_children()) - before:  # when stopped, an item may have minutes to go
                process.terminate()
        lost, todo = todo[:count], todo[count:]  # items begin in their order: the first of those left were running
        yield from (fail(item, LostWorker.__name__, f"{item.session}: {_DIED}") for item in lost)


def _run_on_scheduler(items: Sequence[Item], address: str, place: str, force: bool) -> Generator[Row]:
    """The same by the workers of a running Dask scheduler; `LostWorker` where it goes meanwhile."""
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        remedy = how_to_install("dask", "distributed")
        raise BadOption(f"wepose batch --scheduler: {error}: {remedy}") from None
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise BadOption(f"--scheduler {address}: no scheduler there, as in tcp://HOST:8786: {reason(error)}") from None
    with client, client.get_executor(pure=False) as executor:
        futures = {executor.submit(run_item, item, place, force): item for item in items}
        for future in as_completed(futures):
            try:
                row = future.result()
            except KilledWorker:  # after several workers died at it
                row = fail(futures[future], LostWorker.__name__, f"{futures[future].session}: {_DIED}")
            except CancelledError:
                raise LostWorker(
                    f"{address}: the scheduler is gone; the same command goes on where it stopped"
                ) from None
            yield row


def _prepare_process() -> None:
    """Ctrl-C in the terminal is for the parent; a process whose parent was killed ends itself."""

    def exit_with_parent() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()
