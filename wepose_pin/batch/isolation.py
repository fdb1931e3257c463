"""One item in a process of its own, for items at which workers have died: it takes no worker along."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from ..errors import BadData, LostWorker
from .items import build_failed_row, run_items
from .plan import Item
from .steps import Row
from .storage import write_bytes

POLL_S = 0.1  # between two looks at the memory of the process
_PROGRAM = "from wepose_pin.batch.isolation import _run_child; _run_child()"


def run_isolated(item: Item, place: str, force: bool = False, same_code: str | None = None) -> Row:
    """The row of an item that runs in a process of its own, with the memory limit of the worker.

    Raises
    ------
    BadData
        The worker has another wepose-pin than `same_code`.
    """
    with tempfile.TemporaryDirectory(prefix="wepose-") as folder:
        answer = Path(folder) / "answer.json"
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, answer],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            with contextlib.suppress(BrokenPipeError):
                if process.stdin is not None:
                    pickle.dump((item, place, force, same_code), process.stdin)
                    process.stdin.flush()
            memory = _watch_memory(process)
        finally:
            process.kill()
            with contextlib.suppress(BrokenPipeError):
                process.communicate()
        if answer.exists():
            row: Row = json.loads(answer.read_text(encoding="utf-8"))
            if "refused" in row:
                raise BadData(row["refused"])
            return row
    code = process.returncode
    ending = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
    cause = "it is too much for a worker's memory" if memory is None else f"its memory was {memory / 1e6:.0f} MB"
    message = f"{item.session}: workers died at it; in a process of its own {ending}; {cause}"
    return build_failed_row(item, LostWorker.__name__, message)


def _watch_memory(process: subprocess.Popen[bytes]) -> float | None:
    """Largest memory [bytes] of a process until it ended; None where it exceeded the limit and was killed."""
    import psutil  # type: ignore[import-untyped]  # comes with Dask

    limit, largest = _get_memory_limit(), 0.0
    while process.poll() is None:
        with contextlib.suppress(psutil.Error):
            largest = max(largest, psutil.Process(process.pid).memory_info().rss)
        if largest > limit:
            process.kill()
            process.wait()
            return None
        time.sleep(POLL_S)
    return largest


def _get_memory_limit() -> float:
    """[bytes] of this worker; infinite without one."""
    from distributed import get_worker

    worker: Any = None
    with contextlib.suppress(ValueError):  # not on a worker
        worker = get_worker()
    return getattr(getattr(worker, "memory_manager", None), "memory_limit", None) or float("inf")


def _run_child() -> None:
    """In the process: run the item that comes through the pipe, and write its row whole or not at all."""
    item, place, force, same_code = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        (row,) = run_items([item], place, force, same_code)
    except BadData as error:
        row = {"refused": str(error)}
    write_bytes(sys.argv[1], json.dumps(row).encode())


def _exit_with_parent() -> None:
    """A worker that dies closes the pipe: then nobody waits for the row."""
    sys.stdin.buffer.read()
    os._exit(1)
