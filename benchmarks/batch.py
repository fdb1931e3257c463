"""What `wepose batch` costs: Dask's own share, a study on one worker and on two, and one whose worker is killed."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from wepose_pin.batch import run_batch
from wepose_pin.batch.cluster import TASK_S, connect
from wepose_pin.batch.storage import lock_folder, write_bytes
from wepose_pin.errors import ExistingOutput, NoSolution
from wepose_pin.jobs.batch import BatchJob
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session
from wepose_pin.writers.provenance import code

from .tables import Column, Section, Table

SESSIONS, FEW = 500, 12
TASKS, FEW_TASKS = 5000, 500
CLASP_S, CIRCLES = 20.0, 2
EFFICIENCY = 0.85  # of two workers, least
_TIMES = ("seconds", "memory_mb")  # columns that are not the same twice, with those of each step's seconds
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


def sections(quick: bool, sessions: int | None = None) -> dict[str, Section]:
    """Name → a function that measures it; `sessions`: their number in the study, in place of `SESSIONS` or `FEW`."""
    return {
        "scheduler": partial(_scheduler, FEW_TASKS if quick else TASKS),
        "study": partial(_study, sessions or (FEW if quick else SESSIONS)),
    }


def _scheduler(tasks: int) -> Table:
    """What a task that does nothing costs."""
    table = Table(
        "Dask's own cost: tasks that do nothing, two workers of this machine",
        (Column("tasks", "tasks", 0), Column("rate", "tasks a second", 0), Column("each", "each [ms]", 2)),
    )
    with connect(workers=2) as client:
        client.gather(client.map(abs, range(10), pure=False))
        begun = time.perf_counter()
        client.gather(client.map(abs, range(tasks), pure=False))
        seconds = time.perf_counter() - begun
    table.rows["one item a task"] = {"tasks": float(tasks), "rate": tasks / seconds, "each": 1e3 * seconds / tasks}
    table.notes.append(f"Items go together until a task takes {TASK_S:g} s: that keeps this cost near a hundredth.")
    return table


def _study(sessions: int) -> Table:
    """Calibrate, track, evaluate; the same rows whoever makes them."""
    with _folder(sessions) as folder:
        recorded_s = _data(folder, sessions)
        table = Table(
            f"A study of {sessions} simulated sessions of {recorded_s:.0f} s: calibrate, track, evaluate",
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
        first = _once(folder, "one", partial(_run, folder, workers=1))
        again = _once(folder, "again", partial(_again, folder))
        runs = {
            "one worker": (first, 1),
            "two workers": (_once(folder, "two", partial(_run, folder, workers=2)), 2),
            "two apart, one killed half-way": (_once(folder, "killed", partial(_killed, folder)), 2),
        }
        table.rows = {name: _figures(run, first, workers) for name, (run, workers) in runs.items()}
        table.rows["two apart, one killed half-way"]["efficiency"] = float("nan")
        table.rows["the first once more, all is done"] = {
            "done": again.reused,
            "whole": again.seconds,
            "rate": 60.0 * again.rate,
        }
    table.notes += [
        f"Limits: an efficiency of at least {EFFICIENCY:g}; every row as with one worker, none twice.",
        "A rate is from the first item to the last, without the start of the workers. It means something where "
        "nothing else runs on the machine.",
    ]
    return table


@contextmanager
def _folder(sessions: int) -> Iterator[Path]:
    """Where the benchmark works: kept when it is stopped, so that it goes on there, and removed at its end.

    Raises
    ------
    ExistingOutput
        Another benchmark works there, or it is somebody else's.
    """
    folder = Path(tempfile.gettempdir()) / f"wepose-benchmark-{os.getuid()}-{sessions}-{str(code()['code'])[:12]}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise ExistingOutput(f"{folder}: is somebody else's; TMPDIR names another place for it")
    with lock_folder(str(folder)):
        yield folder
        shutil.rmtree(folder)


def _data(folder: Path, sessions: int) -> float:
    """Sessions that are not there yet, and the plan; gives how long one is [s]."""
    write_bytes(str(folder / "plan.toml"), _PLAN.encode())
    missing = [seed for seed in range(1, sessions + 1) if not (folder / "data" / f"{seed:04d}").is_dir()]
    if missing:
        with connect(workers=2) as client:
            client.gather(client.map(_session, [str(folder)] * len(missing), missing))
    time = pl.read_parquet(folder / "data" / "0001" / "recording.parquet", columns=["time"])["time"]
    return float(time[-1] - time[0])


def _session(folder: str, seed: int) -> None:
    made = simulate(simulate_person(seed).lengths, seed=seed, clasp_s=CLASP_S, circles=CIRCLES)
    partial = Path(folder) / "partial" / f"{seed:04d}"
    partial.mkdir(parents=True, exist_ok=True)
    write_session(partial, made.recording(f"simulated-{seed}"), made.truth())
    (Path(folder) / "data").mkdir(exist_ok=True)
    partial.rename(Path(folder) / "data" / partial.name)


class _Run(NamedTuple):
    """One run of the study."""

    table: pl.DataFrame
    reused: int
    seconds: float  # of the whole run
    rate: float  # items a second from the first to the last


def _once(folder: Path, name: str, run: Callable[[Path], _Run]) -> _Run:
    """A run, or what an earlier call has kept of it; its items are removed, which are many."""
    kept, place = folder / f"{name}.json", folder / name
    if not kept.exists():
        if name != "again":
            shutil.rmtree(place, ignore_errors=True)  # of a benchmark that was stopped: a time is that of a whole run
        found = run(place)
        table = io.BytesIO()
        found.table.write_parquet(table)
        write_bytes(str(kept.with_suffix(".parquet")), table.getvalue())
        write_bytes(str(kept), json.dumps(found._replace(table=None)._asdict()).encode())  # type: ignore[arg-type]
        if name != "one":
            shutil.rmtree(place, ignore_errors=True)
    return _Run(**json.loads(kept.read_bytes()) | {"table": pl.read_parquet(kept.with_suffix(".parquet"))})


def _run(
    folder: Path,
    out: Path,
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
    study = run_batch(BatchJob(folder / "plan.toml", str(out), scheduler, workers), progress)
    (last, total), (first, before) = told[-1], next((entry for entry in told if entry[1]), told[-1])
    return _Run(study.table, study.reused, last - begun, (total - before) / max(last - first, 1e-9))


def _again(folder: Path, _: Path) -> _Run:
    """The first run's items once more: all are done already."""
    return _run(folder, folder / "one", workers=1)


def _killed(folder: Path, out: Path) -> _Run:
    with separate_cluster(folder) as (address, kill):
        return _run(folder, out, scheduler=address, half=kill)


def _figures(run: _Run, reference: _Run, workers: int) -> dict[str, float]:
    same = [name for name in reference.table.columns if name not in _TIMES and not name.endswith("_s")]
    rows = {row["item"]: row for row in reference.table.select(same).iter_rows(named=True)}
    ours = run.table.select([name for name in same if name in run.table.columns]).iter_rows(named=True)
    done = run.table.filter(pl.col("status") == "done")
    return {
        "done": float(done.height),
        "twice": float(run.table.height - run.table["item"].n_unique()),
        "right": float(sum(rows.get(row["item"]) == row for row in ours)),
        "whole": run.seconds,
        "rate": 60.0 * run.rate,
        "efficiency": run.rate / (workers * reference.rate),
        "memory": float(done["memory_mb"].max()) if done.height else float("nan"),  # type: ignore[arg-type]
    }


@contextmanager
def separate_cluster(folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """A scheduler and two workers, started by themselves: its address, and what kills one of the workers.

    Raises
    ------
    NoSolution
        The scheduler does not start.
    """
    here = "--host 127.0.0.1 --no-dashboard --dashboard-address 127.0.0.1:0".split()  # else the last listens to all
    started: list[subprocess.Popen[bytes]] = []

    def start(module: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *here, *words]
        with (folder / f"{module}.log").open("ab") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True))
        return started[-1]

    def kill(process: subprocess.Popen[bytes]) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # with the process that its nanny has started
        process.wait()

    told = folder / "scheduler.json"
    told.unlink(missing_ok=True)
    try:
        start("dask_scheduler", "--port", "0", "--scheduler-file", str(told))
        address = _address(told)
        workers = [start("dask_worker", address, "--nthreads", "1") for _ in range(2)]
        yield address, partial(kill, workers[0])
    finally:
        for process in reversed(started):
            kill(process)


def _address(told: Path) -> str:
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        with contextlib.suppress(OSError, ValueError):
            return str(json.loads(told.read_text(encoding="utf-8"))["address"])
        time.sleep(0.1)
    raise NoSolution(f"{told}: the scheduler does not start within a minute")
