"""What `wepose batch` costs: Dask's own share, a study on one worker and on two, and one whose worker is killed."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import polars as pl

from ..batch import run_study
from ..batch.cluster import TASK_S, connected
from ..errors import NoSolution
from ..simulation import simulate, simulated_person
from ..writers import write_session
from . import Column, Table

SESSIONS, FEW = 500, 12
TASKS, FEW_TASKS = 5000, 500
CLASP_S, CIRCLES = 20.0, 2
EFFICIENCY = 0.85  # of two workers, wanted
_APART = ("seconds", "memory_mb")  # columns that are not the same twice
_PLAN = """
name = "simulated"
[sessions]
files = ["data/*/session.toml"]
[steps.calibrate]
report = false
[steps.track]
view = false
report = false
[steps.evaluate]
"""


def study_sections(quick: bool) -> dict[str, Callable[[], Table]]:
    """Name → a function that measures it."""
    return {
        "scheduler": partial(_scheduler, FEW_TASKS if quick else TASKS),
        "study": partial(_study, FEW if quick else SESSIONS),
    }


def _scheduler(tasks: int) -> Table:
    """What a task that does nothing costs."""
    table = Table(
        "Dask's own cost: tasks that do nothing, two workers of this machine",
        (Column("tasks", "tasks", 0), Column("rate", "tasks a second", 0), Column("each", "each [ms]", 2)),
    )
    with connected(workers=2) as client:
        client.gather(client.map(abs, range(10), pure=False))
        begun = time.perf_counter()
        client.gather(client.map(abs, range(tasks), pure=False))
        seconds = time.perf_counter() - begun
    table.rows["one item a task"] = {"tasks": float(tasks), "rate": tasks / seconds, "each": 1e3 * seconds / tasks}
    table.notes.append(f"Items go together until a task takes {TASK_S:g} s: that keeps this cost near a hundredth.")
    return table


def _study(sessions: int) -> Table:
    """Calibrate, track, evaluate; the same rows whoever makes them."""
    table = Table(
        f"A study of {sessions} simulated sessions of {CLASP_S + 28:.0f} s: calibrate, track, evaluate",
        (
            Column("done", "done", 0),
            Column("twice", "twice", 0),
            Column("right", "as with one worker", 0),
            Column("whole", "whole run [s]", 1),
            Column("rate", "items a minute", 1),
            Column("efficiency", "efficiency", 2),
            Column("memory", "most memory a worker [MB]", 0),
        ),
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plan.toml").write_text(_PLAN, encoding="utf-8")
        with connected(workers=2) as client:
            client.gather(client.map(_session, [str(folder / "data")] * sessions, range(1, sessions + 1)))
        first = _run(folder, "one", workers=1)
        table.rows["one worker"] = _figures(first, first, 1)
        second = _run(folder, "two", workers=2)
        table.rows["two workers"] = _figures(second, first, 2)
        with _apart_from_us(folder) as (address, kill):
            killed = _run(folder, "killed", scheduler=address, half=kill)
        table.rows["two, one killed half-way"] = _figures(killed, first, 2) | {"efficiency": float("nan")}
    table.notes.append(f"Wanted: an efficiency of {EFFICIENCY:g}; every row as with one worker, none twice.")
    table.notes.append("A rate is from the first item to the last, without the start of the workers.")
    return table


def _session(folder: str, seed: int) -> None:
    made = simulate(simulated_person(seed).lengths, seed=seed, clasp_s=CLASP_S, circles=CIRCLES)
    place = Path(folder) / f"{seed:04d}"
    place.mkdir(parents=True)
    write_session(place, made.recording(f"simulated-{seed}"), made.truth())


class _Run:
    """One run of the study: its table, and when items were done."""

    def __init__(self, table: pl.DataFrame, begun: float, told: list[tuple[float, int]]) -> None:
        self.table = table
        self.seconds = told[-1][0] - begun
        first = next((entry for entry in told if entry[1]), told[-1])
        self.rate = (told[-1][1] - first[1]) / max(told[-1][0] - first[0], 1e-9)


def _run(
    folder: Path,
    name: str,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    half: Callable[[], None] | None = None,
) -> _Run:
    told: list[tuple[float, int]] = []
    waiting = half

    def progress(done: int, _failed: int, total: int) -> None:
        nonlocal waiting
        told.append((time.perf_counter(), done))
        if waiting is not None and done >= total / 2:
            waiting()
            waiting = None

    begun = time.perf_counter()
    study = run_study(folder / "plan.toml", str(folder / name), workers=workers, scheduler=scheduler, progress=progress)
    return _Run(study.table, begun, told)


def _figures(run: _Run, reference: _Run, workers: int) -> dict[str, float]:
    same = [name for name in reference.table.columns if name not in _APART and not name.endswith("_s")]
    ours = run.table.select([name for name in same if name in run.table.columns])
    right = sum(a == b for a, b in zip(ours.iter_rows(), reference.table.select(same).iter_rows(), strict=False))
    done = run.table.filter(pl.col("status") == "done")
    return {
        "done": float(done.height),
        "twice": float(run.table.height - run.table["item"].n_unique()),
        "right": float(right),
        "whole": run.seconds,
        "rate": 60.0 * run.rate,
        "efficiency": run.rate / (workers * reference.rate),
        "memory": float(done["memory_mb"].max()) if done.height else float("nan"),  # type: ignore[arg-type]
    }


@contextmanager
def _apart_from_us(folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """A scheduler and two workers, started by themselves: its address, and what kills one of the workers.

    Raises
    ------
    NoSolution
        The scheduler does not start.
    """
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "POLARS_MAX_THREADS"), "1")
    started: list[subprocess.Popen[bytes]] = []

    def start(module: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", "--host", "127.0.0.1", "--no-dashboard", *words]
        with (folder / f"{module}.log").open("ab") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | threads))
        return started[-1]

    told = folder / "scheduler.json"
    try:
        start("dask_scheduler", "--port", "0", "--scheduler-file", str(told))
        address = _address(told)
        workers = [start("dask_worker", address, "--nthreads", "1", "--no-nanny") for _ in range(2)]
        yield address, workers[0].kill
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def _address(told: Path) -> str:
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        with contextlib.suppress(OSError, ValueError):
            return str(json.loads(told.read_text(encoding="utf-8"))["address"])
        time.sleep(0.1)
    raise NoSolution(f"{told}: the scheduler does not start within a minute")
