"""Try seeds: ``python tests/random_recordings/run.py --seeds 0:3000 --jobs 2 -o DIR``.

One line of JSON a seed is added to DIR/seeds.jsonl; what is there already is not tried again. At the end, and with
``--report`` at once, a summary: commands by exit code, failing seeds, the table of invariances, the largest error over
what is stated. ``--seed 17 --keep DIR`` writes one case's files there and says what it holds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tomllib
import traceback
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "tests")) if path not in sys.path]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from random_recordings.summary import summary_text  # noqa: E402


def try_one(task: tuple[int, bool, bool]) -> dict[str, Any]:
    """One seed's report as JSON; an error of the harness itself is a failure of the seed too."""
    from random_recordings.trial import try_seed

    seed, as_process, invariances_alone = task
    try:
        return try_seed(seed, None, as_process, invariances_alone).as_json()
    except Exception:
        failure = {"oracle": "the harness itself", "command": "", "message": traceback.format_exc()[-1500:]}
        return {
            "seed": seed,
            "about": "",
            "failures": [failure],
            "commands": [],
            "accuracy": {},
            "deviations": [],
            "recorded_s": 0.0,
            "seconds": 0.0,
        }


def run_seeds(seeds: list[int], out: Path, jobs: int, as_process: bool, invariances_alone: bool) -> None:
    """Try those seeds that have no line yet."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "seeds.jsonl"
    done = {report["seed"] for report in read_reports(file)}
    tasks = [(seed, as_process, invariances_alone) for seed in seeds if seed not in done]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=200) as pool, file.open("a") as lines:
        for k, report in enumerate(pool.imap_unordered(try_one, tasks), 1):
            lines.write(json.dumps(report) + "\n")
            lines.flush()
            for failure in report["failures"]:
                print(f"seed {report['seed']}: {failure['oracle']}: {failure['message'][:300]}", flush=True)
            if k % 50 == 0:
                print(f"{k} of {len(tasks)}", file=sys.stderr, flush=True)


def read_reports(file: Path) -> list[dict[str, Any]]:
    """The lines that are whole."""
    reports = []
    for line in file.read_text().splitlines() if file.exists() else []:
        try:
            reports.append(json.loads(line))
        except ValueError:
            continue
    return reports


def failed_once() -> list[int]:
    """Seeds that run for ever."""
    values = tomllib.loads((Path(__file__).parent / "regressions.toml").read_text(encoding="utf-8"))
    return [entry["number"] for entry in values.get("seed", [])]


def main() -> int:
    """Run, and say what came of it: exit code 1 where an oracle failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:100", help="FROM:TO, or a list with commas")
    parser.add_argument("--seed", type=int, help="one seed, whose failures are shown")
    parser.add_argument("--keep", type=Path, help="of --seed: write its files there")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--as-process", action="store_true", help="every command in a process of its own, as a user does"
    )
    parser.add_argument("--invariances", action="store_true", help="only the invariances, of each seed all that fit")
    parser.add_argument("--report", action="store_true", help="only say what DIR holds")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / ".random_recordings")
    options = parser.parse_args()
    if options.seed is not None:
        from random_recordings.trial import try_seed

        report = try_seed(options.seed, options.keep, options.as_process, options.invariances)
        print(json.dumps(report.as_json(), indent=1))
        return 1 if report.failures else 0
    first, _, last = options.seeds.partition(":")
    seeds = list(range(int(first), int(last))) if last else [int(seed) for seed in first.split(",")]
    if last:
        seeds = list(dict.fromkeys([*failed_once(), *seeds]))
    if not options.report:
        run_seeds(seeds, options.out, options.jobs, options.as_process, options.invariances)
    reports = [report for report in read_reports(options.out / "seeds.jsonl") if report["seed"] in set(seeds)]
    text = summary_text(reports)
    (options.out / "summary.md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if any(report["failures"] for report in reports) else 0


if __name__ == "__main__":
    sys.exit(main())
