"""Hours of recorded time through `batch`: ``python tests/random_recordings/soak.py --hours 24 --workers 2 -o soak``.

Long recordings of ordinary activities are made, then tracked by one run of `batch`; every two seconds the memory of the
process tree (resident, each process's and the sum) and its open files are read from /proc. At the end it says whether
they are flat: the highest sum of the last third against that of the middle one, the first being the start; and by how
much what each worker has between its items grows with each of them. With `--seed` all recordings are the same one, so
that only what stays can differ.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "tests")) if path not in sys.path]

EVERY_S = 2.0
# What memory and files may grow by from the middle third to the last, and be called flat. Each third holds recordings
# of each rate; which of them meet in the workers is chance.
MEMORY_GROWTH, FILES_GROWTH = 0.10, 5
SURE = 3.0  # standard errors above which a worker's growth is no chance
PAGE = os.sysconf("SC_PAGE_SIZE")


def make_session(task: tuple[int, float, Path]) -> float:
    """Write one long recording; its duration [s]."""
    from random_recordings import adapter
    from random_recordings.cases import draw_case
    from random_recordings.recordings import record

    seed, seconds, folder = task
    case = draw_case(seed, seconds)
    case.layout.suffix = ".parquet"
    for name in case.worn:  # nothing is calibrated here
        if case.worn[name].axes is None:
            return 0.0
    adapter.write_session(folder / f"recording-{seed:04d}", record(case), case.layout)
    return case.duration


def tree(pid: int) -> list[int]:
    """The process and all that it started, of those that are there."""
    pids, at = [pid], 0
    while at < len(pids):
        for task in Path(f"/proc/{pids[at]}/task").glob("*"):
            try:
                pids += [int(child) for child in (task / "children").read_text().split()]
            except OSError:
                continue
        at += 1
    return pids


def measured(pid: int) -> dict[str, Any]:
    """Resident memory [MB] of each process, of all and of the largest, open files."""
    sizes, files = {}, 0
    for process in tree(pid):
        try:
            sizes[str(process)] = int(Path(f"/proc/{process}/statm").read_text().split()[1]) * PAGE / 1e6
            files += len(os.listdir(f"/proc/{process}/fd"))
        except OSError:
            continue
    total, largest = sum(sizes.values()), max(sizes.values(), default=0.0)
    return {"sizes": sizes, "memory_mb": total, "largest_mb": largest, "files": files}


def soak(out: Path, workers: int, pages: bool) -> tuple[int, list[dict[str, Any]]]:
    """Run the batch and watch it."""
    from random_recordings import adapter

    plan = out / "plan.toml"
    adapter.write_plan(plan, "recording-*/session.toml", "amekf", pages)
    begin = time.monotonic()
    with (out / "batch.log").open("w") as log:
        process = subprocess.Popen(
            adapter.batch_process(plan, out / "study", workers),
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        )
        series = []
        while process.poll() is None:
            done = sum(1 for _ in (out / "study").glob("items/*/done.json"))
            series.append({"seconds": round(time.monotonic() - begin, 1), "items": done} | measured(process.pid))
            time.sleep(EVERY_S)
    return process.returncode, series


def verdict(series: list[dict[str, Any]]) -> list[str]:
    """Whether memory and files are flat, by the highest and the median of the last third and the middle one."""
    third = len(series) // 3
    if not third:
        return ["too short to say"]
    middle, last = series[third : 2 * third], series[2 * third :]
    lines = []
    for key, name in (("memory_mb", "memory [MB]"), ("largest_mb", "largest process [MB]"), ("files", "open files")):
        for which, of in (("highest", max), ("median", statistics.median)):
            before, after = (of([row[key] for row in rows]) for rows in (middle, last))
            most = before + FILES_GROWTH if key == "files" else before * (1.0 + MEMORY_GROWTH)
            said = "GROWS" if after > most else "flat"
            lines.append(f"{name}, {which}: {before:.0f} in the middle third, {after:.0f} in the last: {said}")
    return lines


def growth(series: list[dict[str, Any]], workers: int) -> list[str]:
    """Of each worker the memory that stays between its items, and its growth with each item [MB] with standard error.

    What stays is the least memory while `2 workers` items were done, in which each worker has finished one; the first
    half of the items, in which caches fill, does not count.
    """
    lines, first = [], series[-1]["items"] // 2
    lifetimes = {pid: sum(pid in row["sizes"] for row in series) for row in series for pid in row["sizes"]}
    steady = [pid for pid, rows in lifetimes.items() if rows > len(series) / 2]
    largest = sorted(steady, key=lambda pid: -statistics.median(row["sizes"].get(pid, 0.0) for row in series))
    for pid in largest[:workers]:
        least: dict[int, float] = {}
        for row in series:
            if pid in row["sizes"] and row["items"] >= first:
                window = row["items"] // (2 * workers)
                least[window] = min(least.get(window, np.inf), row["sizes"][pid])
        items = 2.0 * np.array(sorted(least))[1:-1]  # of this worker; the windows at the ends are not whole
        memory = np.array([least[window] for window in sorted(least)])[1:-1]
        if len(items) < 4:
            lines.append(f"worker {pid}: too few items to say by how much it grows")
            continue
        off = items - items.mean()
        slope = off @ memory / (off @ off)
        residual = memory - memory.mean() - slope * off
        error = np.sqrt(residual @ residual / (len(items) - 2) / (off @ off))
        grows = slope > SURE * error and slope * np.ptp(items) > MEMORY_GROWTH * memory.mean()
        lines.append(
            f"worker {pid}: {memory[0]:.0f} MB stay after {items[0]:.0f} items, {memory[-1]:.0f} MB after "
            f"{items[-1]:.0f}; {slope:+.2f} ± {error:.2f} MB an item: {'GROWS' if grows else 'flat'}"
        )
    return lines


def main() -> int:
    """Make recordings, run them, say what came of it; exit code 1 where something grows or an item failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="of recorded time")
    parser.add_argument("--each", type=float, default=0.5, help="hours a recording")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, help="the same recording all the time")
    parser.add_argument("--pages", action="store_true", help="with view.html and report.html of each")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    count = round(options.hours / options.each)
    seeds = range(count) if options.seed is None else [options.seed]
    tasks = [(seed, 3600.0 * options.each, options.out) for seed in seeds]
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        recorded = sum(pool.imap_unordered(make_session, tasks))
    if options.seed is not None:
        made_once = options.out / f"recording-{options.seed:04d}"
        for k in range(count):
            shutil.copytree(made_once, options.out / f"recording-{options.seed:04d}-{k:04d}", copy_function=os.link)
        shutil.rmtree(made_once)
        recorded *= count
    made = time.monotonic() - begin
    code, series = soak(options.out, options.workers, options.pages)
    (options.out / "series.json").write_text(json.dumps(series) + "\n")
    lines = [
        f"{recorded / 3600.0:.1f} h of recorded time, made in {made:.0f} s",
        f"batch: exit code {code} after {series[-1]['seconds']:.0f} s",
    ]
    lines += verdict(series) + growth(series, options.workers)
    (options.out / "soak.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    return 1 if code or any("GROWS" in line for line in lines) else 0


if __name__ == "__main__":
    sys.exit(main())
