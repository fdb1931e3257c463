"""`save`: the recordings, then all tasks in processes of their own, their arrays as one file a task."""

from __future__ import annotations

import fnmatch
import json
import platform
import tempfile
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import adapter
from .comparison import WrongUsage
from .inputs import write_inputs
from .tasks import Failed, Missing, Places, Task, tasks


class Report(NamedTuple):
    """What became of a task: its number of keys, or why there are none; [s] of its processor time, without children."""

    name: str
    seconds: float
    keys: int = 0
    missing: str = ""
    failed: str = ""


def run_task(name: str, out: Path, data: Path | None) -> Report:
    """Run a task and store its arrays, in a process of the pool."""
    task = next(task for task in tasks() if task.name == name)
    begin = time.process_time()
    with tempfile.TemporaryDirectory(prefix="work-", dir=out) as work:
        try:
            arrays = task.run(Places(out / "inputs", data, Path(work)))
        except Missing as error:
            return Report(name, time.process_time() - begin, missing=str(error))
        except Failed as error:
            return Report(name, time.process_time() - begin, failed=str(error))
        except Exception:
            return Report(name, time.process_time() - begin, failed=traceback.format_exc())
    np.savez(out / "results" / f"{name.replace('/', '__')}.npz", **arrays)  # type: ignore[arg-type]  # numpy takes any name
    return Report(name, time.process_time() - begin, len(arrays))


def save(out: Path, inputs: Path | None, data: Path | None, only: str, jobs: int) -> int:
    """Store all results in `out`; the exit code."""
    chosen = [task for task in tasks() if fnmatch.fnmatch(task.name, only)]
    if not chosen:
        raise WrongUsage(f"--only {only}: matches none of {', '.join(task.name for task in tasks())}")
    if out.exists():
        raise WrongUsage(f"{out}: exists; name a new folder")
    if inputs is not None and not inputs.is_dir():
        raise WrongUsage(f"--inputs {inputs}: no such folder; the inputs/ of a folder that `save` wrote")
    begin = time.perf_counter()
    (out / "results").mkdir(parents=True)
    if inputs is None:
        write_inputs(out / "inputs", data)
    else:
        adapter.copy_inputs(inputs, out / "inputs")
    print(f"{time.perf_counter() - begin:5.0f} s  inputs", flush=True)
    reports = list(_run(chosen, out, data, jobs))
    print(f"{sum(each.keys for each in reports)} keys in {time.perf_counter() - begin:.0f} s: {out}")
    for each in reports:
        if each.missing:
            print(f"skipped: {each.name}: {each.missing}")
        if each.failed:
            print(f"FAILED: {each.name}: {each.failed}")
    about = {"python": platform.python_version(), "tasks": [each._asdict() for each in reports]}
    (out / "run.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return int(any(each.failed for each in reports))


def _run(chosen: list[Task], out: Path, data: Path | None, jobs: int) -> list[Report]:
    reports, begin = [], time.perf_counter()
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(run_task, task.name, out, data) for task in chosen]
        for done in as_completed(running):
            reports.append(done.result())
            last = reports[-1]
            state = "skipped" if last.missing else "FAILED" if last.failed else f"{last.keys} keys"
            print(
                f"{time.perf_counter() - begin:5.0f} s  {last.name}: {state}, {last.seconds:.1f} s of processor",
                flush=True,
            )
    return reports
