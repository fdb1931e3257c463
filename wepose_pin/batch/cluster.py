"""Items over Dask's workers: a cluster of this machine, or any that runs elsewhere; one module that knows of Dask."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from ..errors import BadOption, LostWorker
from ..filters.base import processors
from .apart import make_apart
from .items import Row, failed, make_items
from .plan import Item

# A task costs Dask some milliseconds (`python -m benchmarks batch` measures it): one that takes half a second keeps
# that under a hundredth. Items that take less go together.
TASK_S = 0.5
MOST = 500  # items a task
AHEAD = 2  # tasks a worker: one runs, one waits
DEATHS = 1  # of workers at one task, after which each of its items is made in a process of its own
WAIT_S = 60.0  # without any worker, after which the run ends
GONE = "the scheduler is gone; the same command goes on where it stopped"
LOOK_S = 2.0  # between two looks at which workers there are
# Workers share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_THREADED = "WEPOSE_THREADS NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"
_ONE_THREAD = dict.fromkeys(_THREADED.split(), "1")
SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": DEATHS,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Nothing lies on workers that could be spilled, and one that has paused for want of memory would never go on: at
    # 95 % of its share of the machine's memory it is ended and replaced, and its items run again.
    **dict.fromkeys((f"distributed.worker.memory.{word}" for word in ("target", "spill", "pause")), False),
    # A terminal's Ctrl-C is for us, who end them.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
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
        for name in ("distributed", "distributed.client"):  # which say by tracebacks what we say by a line
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
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

    A worker that dies is replaced by Dask and its tasks run again, which leaves what they had done. Dask blames its
    death on all tasks that lay there: after `DEATHS` each of their items is made in a process of its own, and only one
    that kills this one too is given up, by the name of `LostWorker`.

    Raises
    ------
    BadData
        A worker has another wepose-pin than `code`.
    LostWorker
        The scheduler is gone, or has no worker any more.
    """
    from distributed.scheduler import KilledWorker

    todo, suspects = deque(items), deque[Item]()
    running: dict[Any, list[Item]] = {}
    apart: set[Any] = set()
    each, seen = TASK_S, _Workers(client)
    while todo or suspects or running:
        seen.look()
        while (todo or suspects) and len(running) < AHEAD * seen.threads:
            if suspects:
                some = [suspects.popleft()]
                future = client.submit(make_apart, some[0], place, force, code, pure=False)
                apart.add(future)
            else:
                size = max(1, min(MOST, int(TASK_S / each), len(todo) // (AHEAD * seen.threads)))
                some = [todo.popleft() for _ in range(size)]
                future = client.submit(_timed, some, place, force, code, pure=False)
            running[future] = some
        for future in _ended(running):
            some, alone = running.pop(future), future in apart
            apart.discard(future)
            if future.status == "finished" and alone:
                yield [future.result()]
            elif future.status == "finished":
                seconds, rows = future.result()
                each = 0.5 * each + 0.5 * max(seconds / len(rows), 1e-4)
                todo.extendleft(reversed(some[len(rows) :]))
                yield rows
            elif future.status != "error":
                raise LostWorker(GONE)
            elif not isinstance(error := future.exception(), KilledWorker):
                raise error
            elif alone:
                yield [
                    failed(some[0], LostWorker.__name__, f"workers died at it, the last {error.last_worker.address}")
                ]
            else:
                suspects.extend(some)
            future.release()


class _Workers:
    """How many threads the workers have together, looked up now and then."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.threads = 1
        self._looked = self._there = 0.0

    def look(self) -> None:
        """Raise LostWorker where the scheduler is gone, or there has been no worker for long."""
        now = time.monotonic()
        if self._looked and now < self._looked + LOOK_S:
            return
        try:
            found = sum(self.client.nthreads().values())
        except OSError:
            raise LostWorker(GONE) from None
        self._there = now if found or not self._looked else self._there
        self._looked, self.threads = now, max(1, found)
        if now > self._there + WAIT_S:
            raise LostWorker(
                f"{self.client.scheduler.address}: has had no worker for {WAIT_S:g} s; start one, and the same command "
                "goes on where it stopped"
            )


def _ended(running: dict[Any, list[Item]]) -> list[Any]:
    """Tasks that have ended; none after a while in which none has."""
    from distributed import wait

    with contextlib.suppress(
        TimeoutError, concurrent.futures.CancelledError
    ):  # the latter where one of them is cancelled
        wait(list(running), timeout=LOOK_S, return_when="FIRST_COMPLETED")
    return [future for future in running if future.status != "pending"]


def _timed(items: list[Item], place: str, force: bool, code: str | None) -> tuple[float, list[Row]]:
    """Rows of as many items as are made in twice the time that a task should take, and the time they took."""
    begun = time.perf_counter()
    rows = make_items(items, place, force, code, until=begun + 2.0 * TASK_S)
    return time.perf_counter() - begun, rows
