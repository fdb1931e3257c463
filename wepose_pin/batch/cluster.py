"""Items on Dask's workers: a cluster on this machine, or a running one."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from ..errors import BadOption, LostWorker, how_to_install
from ..filters.base import count_processors
from .isolation import run_isolated
from .items import build_failed_row, run_items
from .plan import Item
from .steps import Row

# [s] of a task: Dask needs some milliseconds for each (`python -m benchmarks batch` measures it), which is then less
# than a hundredth. Short items share a task.
TASK_S = 0.5
MAX_ITEMS = 500  # a task
TASKS_PER_THREAD = 2  # one runs, one waits
MAX_DEATHS = 1  # of workers at one task, after which each of its items runs in a process of its own
WAIT_S = 60.0  # without any worker, after which the run ends
POLL_S = 2.0  # between two looks at the workers
GONE = "the scheduler is gone; the same command goes on where it stopped"
# Workers share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_THREADED = "WEPOSE_THREADS NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"
_ONE_THREAD = dict.fromkeys(_THREADED.split(), "1")
SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": MAX_DEATHS,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Workers hold nothing that could be spilled, and one that pauses for lack of memory would never resume: at 95 % of
    # its share of the machine's memory it is replaced, and its items run again.
    **dict.fromkeys((f"distributed.worker.memory.{word}" for word in ("target", "spill", "pause")), False),
    # Ctrl-C in the terminal is for this process, which ends the workers.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD | {"DASK_LOGGING__DISTRIBUTED": "critical"},
}


@contextlib.contextmanager
def connect(scheduler: str | None = None, workers: int | None = None) -> Iterator[Any]:
    """A client of the scheduler at an address; without one, of workers started here, one a processor.

    These listen on 127.0.0.1 only, and talk by TLS with a certificate made for the run.

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
        remedy = how_to_install("dask", "distributed", "cryptography", "fsspec")
        raise BadOption(f"wepose batch: {error}: {remedy}") from None
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(SETTINGS))
        stack.callback(_restore_environment, dict(os.environ))
        if scheduler is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers or count_processors(),
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
        for name in ("distributed", "distributed.client"):  # they log tracebacks where we give one line
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


def _restore_environment(before: dict[str, str]) -> None:
    """Undo Dask's changes: it passes variables to its workers through this process."""
    for name in (*_ONE_THREAD, *SETTINGS["distributed.nanny.pre-spawn-environ"]):
        if name in before:
            os.environ[name] = before[name]
        else:
            os.environ.pop(name, None)


def run_on_cluster(
    client: Any, items: Sequence[Item], place: str, *, force: bool = False, code: str | None = None
) -> Iterator[list[Row]]:
    """Rows of the items, some at a time, in the order in which they are done.

    Dask replaces a worker that dies and runs its tasks again; items that were done stay. Dask blames the death on all
    tasks of the worker: after `MAX_DEATHS` each of their items runs in a process of its own, and only one that kills
    this process too fails, with `LostWorker`.

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
    isolated: set[Any] = set()
    item_s, workers = TASK_S, _Workers(client)
    while todo or suspects or running:
        workers.check()
        while (todo or suspects) and len(running) < TASKS_PER_THREAD * workers.threads:
            if suspects:
                task = [suspects.popleft()]
                future = client.submit(run_isolated, task[0], place, force, code, pure=False)
                isolated.add(future)
            else:
                size = max(1, min(MAX_ITEMS, int(TASK_S / item_s), len(todo) // (TASKS_PER_THREAD * workers.threads)))
                task = [todo.popleft() for _ in range(size)]
                future = client.submit(_run_timed, task, place, force, code, pure=False)
            running[future] = task
        for future in _wait_for_any(running):
            task, alone = running.pop(future), future in isolated
            isolated.discard(future)
            if future.status == "finished" and alone:
                yield [future.result()]
            elif future.status == "finished":
                seconds, rows = future.result()
                item_s = 0.5 * item_s + 0.5 * max(seconds / len(rows), 1e-4)
                todo.extendleft(reversed(task[len(rows) :]))
                yield rows
            elif future.status != "error":
                raise LostWorker(GONE)
            elif not isinstance(error := future.exception(), KilledWorker):
                raise error
            elif alone:
                message = f"workers died at it, the last {error.last_worker.address}"
                yield [build_failed_row(task[0], LostWorker.__name__, message)]
            else:
                suspects.extend(task)
            future.release()


class _Workers:
    """Number of threads of the workers, updated now and then."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.threads = 1
        self._checked = self._present = 0.0

    def check(self) -> None:
        """Raise LostWorker where the scheduler is gone, or has had no worker for long."""
        now = time.monotonic()
        if self._checked and now < self._checked + POLL_S:
            return
        try:
            threads = sum(self.client.nthreads().values())
        except OSError:
            raise LostWorker(GONE) from None
        self._present = now if threads or not self._checked else self._present
        self._checked, self.threads = now, max(1, threads)
        if now > self._present + WAIT_S:
            raise LostWorker(
                f"{self.client.scheduler.address}: has had no worker for {WAIT_S:g} s; start one, and the same command "
                "goes on where it stopped"
            )


def _wait_for_any(running: dict[Any, list[Item]]) -> list[Any]:
    """Tasks that have ended; none after `POLL_S` in which none has."""
    from distributed import wait

    with contextlib.suppress(TimeoutError, concurrent.futures.CancelledError):  # the latter: one of them is cancelled
        wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED")
    return [future for future in running if future.status != "pending"]


def _run_timed(items: list[Item], place: str, force: bool, code: str | None) -> tuple[float, list[Row]]:
    """Rows of as many items as begin within twice the time of a task, and the time they took."""
    begin = time.perf_counter()
    rows = run_items(items, place, force, code, until=begin + 2.0 * TASK_S)
    return time.perf_counter() - begin, rows
