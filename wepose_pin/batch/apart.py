"""One item in a process of its own, for those at which workers have died: what dies is then this process alone."""

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
from .items import Row, failed, make_items
from .plan import Item
from .storage import write_bytes

LOOK_S = 0.1  # between two looks at its memory
_WORDS = "from wepose_pin.batch.apart import _answer; _answer()"


def make_apart(item: Item, place: str, force: bool = False, same_code: str | None = None) -> Row:
    """The row of an item that is made in a process of its own, with the memory that the worker may have.

    Raises
    ------
    BadData
        The worker has another wepose-pin than `same_code`.
    """
    with tempfile.TemporaryDirectory(prefix="wepose-") as folder:
        answer = Path(folder) / "answer.json"
        process = subprocess.Popen(
            [sys.executable, "-c", _WORDS, answer],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                pickle.dump((item, place, force, same_code), process.stdin)
                process.stdin.flush()
            most = _watched(process)
        finally:
            process.kill()
            with contextlib.suppress(BrokenPipeError):
                process.communicate()
        if answer.exists():
            found: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
            if "refused" in found:
                raise BadData(found["refused"])
            return found
    ended = process.returncode
    how = f"killed by {signal.Signals(-ended).name}" if ended < 0 else f"ended with {ended}"
    why = "it is too much for a worker's memory" if most is None else f"its memory was {most / 1e6:.0f} MB"
    return failed(
        item, LostWorker.__name__, f"{item.session}: workers died at it; in a process of its own {how}; {why}"
    )


def _watched(process: subprocess.Popen[bytes]) -> float | None:
    """Most memory [bytes] it was seen to have when it has ended; None where it was ended for having too much."""
    import psutil  # type: ignore[import-untyped]  # comes with Dask

    limit, most = _limit(), 0.0
    while process.poll() is None:
        with contextlib.suppress(psutil.Error):
            most = max(most, psutil.Process(process.pid).memory_info().rss)
        if most > limit:
            process.kill()
            process.wait()
            return None
        time.sleep(LOOK_S)
    return most


def _limit() -> float:
    """Memory [bytes] that a worker may have; without a limit of its own, all."""
    from distributed import get_worker

    worker: Any = None
    with contextlib.suppress(ValueError):  # no worker: asked for by itself
        worker = get_worker()
    return getattr(getattr(worker, "memory_manager", None), "memory_limit", None) or float("inf")


def _answer() -> None:
    """In the process: make what is told through the pipe, and answer whole or not at all."""
    item, place, force, same_code = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_other_side, daemon=True).start()
    try:
        (row,) = make_items([item], place, force, same_code)
    except BadData as error:
        row = {"refused": str(error)}
    write_bytes(sys.argv[1], json.dumps(row).encode())


def _end_with_the_other_side() -> None:
    """A worker that dies closes the pipe: nobody waits for the answer any more."""
    sys.stdin.buffer.read()
    os._exit(1)
