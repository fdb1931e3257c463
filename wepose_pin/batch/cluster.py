"""Items over Dask's workers: a cluster of this machine, or any that runs elsewhere; one module that knows of Dask."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from ..errors import BadOption, LostWorker
from ..filters.base import processors
from .items import Row, make_items
from .plan import Item

# A task costs Dask some milliseconds (`wepose bench --batch` measures it): one that takes half a second keeps that
# under a hundredth. Items that take less go together.
TASK_S = 0.5
MOST = 500  # items a task: what a worker that dies has to look through again
AHEAD = 2  # tasks a worker: one runs, one waits
DEATHS = 3  # of workers at one task, after which it is not tried again
WAIT_S = 60.0
# Workers share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_THREADED = "WEPOSE_THREADS NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"
_ONE_THREAD = dict.fromkeys(_THREADED.split(), "1")
SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": DEATHS,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD | {"DASK_LOGGING__DISTRIBUTED": "critical"},
}


@contextlib.contextmanager
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator[Any]:
    """A client of the scheduler at an address; without one, of workers started here, one a processor.

    Those listen on 127.0.0.1 only, and talk by TLS with a certificate made for the run, which lets no one else in.

    Raises
    ------
    BadOption
        Dask is not installed, there is no scheduler, or it has no workers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.security import Security
    except ImportError as error:
        raise BadOption(f"{error}; pip install 'wepose-pin[batch]' brings what wepose batch needs") from None
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(SETTINGS))
        stack.callback(_leave_environment, dict(os.environ))
        if scheduler is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers or processors(),
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    security=Security.temporary(),
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                    silence_logs=logging.CRITICAL,
                )
            )
            yield stack.enter_context(Client(cluster))
            return
        try:
            client = stack.enter_context(Client(scheduler, timeout=10.0))
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split())
            raise BadOption(f"--scheduler {scheduler}: no scheduler there, as in tcp://HOST:8786: {reason}") from None
        try:
            client.wait_for_workers(1, timeout=WAIT_S)
        except TimeoutError:
            raise BadOption(
                f"--scheduler {scheduler}: has no worker after {WAIT_S:g} s; start one: dask worker {scheduler}"
            ) from None
        yield client


def _leave_environment(before: dict[str, str]) -> None:
    """As it was: Dask gives its workers theirs by way of this process's."""
    for name in (*_ONE_THREAD, *SETTINGS["distributed.nanny.pre-spawn-environ"]):
        if name in before:
            os.environ[name] = before[name]
        else:
            os.environ.pop(name, None)


def made(
    client: Any, items: Sequence[Item], place: str, *, force: bool = False, code: str | None = None
) -> Iterator[list[Row]]:
    """Rows of the items as they are made, some at a time, in the order in which they are done.

    A worker that dies is replaced by Dask and its items run again, which leaves what they had done; after `DEATHS` an
    item is given up by the name of `LostWorker`.

    Raises
    ------
    BadData
        A worker has another wepose-pin than `code`.
    LostWorker
        The scheduler is gone.
    """
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    todo, alone = deque(items), deque[Item]()
    running: dict[Any, list[Item]] = {}
    finished = as_completed()
    each, counted, threads = TASK_S, 0.0, 1
    while todo or alone or running:
        if time.monotonic() > counted + 1.0:
            threads, counted = max(1, sum(client.nthreads().values())), time.monotonic()
        while (todo or alone) and len(running) < AHEAD * threads:
            size = 1 if alone else max(1, min(MOST, int(TASK_S / each), len(todo) // (AHEAD * threads)))
            some = [alone.popleft()] if alone else [todo.popleft() for _ in range(size)]
            future = client.submit(_timed, some, place, force, code, pure=False)
            running[future] = some
            finished.add(future)
        future = next(finished)
        some = running.pop(future)
        if future.status == "finished":
            seconds, rows = future.result()
            each = 0.5 * each + 0.5 * max(seconds / len(some), 1e-4)
            yield rows
        elif future.status == "error" and isinstance(error := future.exception(), KilledWorker):
            if len(some) > 1:  # which of them it was
                alone.extend(some)
            else:
                yield [_lost(some[0], error)]
        elif future.status == "error":
            raise future.exception()
        else:
            raise LostWorker("the scheduler is gone; the same command goes on where it stopped")
        future.release()


def _timed(items: list[Item], place: str, force: bool, code: str | None) -> tuple[float, list[Row]]:
    begun = time.perf_counter()
    rows = make_items(items, place, force, code)
    return time.perf_counter() - begun, rows


def _lost(item: Item, error: Any) -> Row:
    message = (
        f"{item.session}: {DEATHS + 1} workers died at it, the last at {error.last_worker.address}; too little memory?"
    )
    row: Row = {"item": item.name, "session": item.session, "subject": item.subject, "status": "failed"}
    return row | {"error": LostWorker.__name__, "message": message}
