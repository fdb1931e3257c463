"""Try seeds: ``python tests/random_recordings/run.py --seeds 0:3000 --jobs 2 -o DIR``.

One line of JSON a seed is added to DIR/seeds.jsonl; what is there already is not tried again. ``--seed 17 --keep DIR``
writes one case's files there and says what it holds. Exit code 1: an oracle failed.
"""

import argparse
import json
import multiprocessing
import os
import sys
import tomllib
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "tests")) if path not in sys.path]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def try_one(task: tuple[int, bool]) -> dict[str, Any]:
    """One seed's report as JSON; an error of the harness itself is a failure of the seed too."""
    from random_recordings.trial import try_seed

    seed, invariances_alone = task
    try:
        return try_seed(seed, None, invariances_alone).as_json()
    except Exception:
        failure = {"oracle": "the harness itself", "command": "", "message": traceback.format_exc()[-1500:]}
        return {"seed": seed, "failures": [failure], "commands": [], "recorded_s": 0.0}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:100", help="FROM:TO, or a list with commas")
    parser.add_argument("--seed", type=int, help="one seed, whose report is shown")
    parser.add_argument("--keep", type=Path, help="of --seed: write its files there")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--invariances", action="store_true", help="only the invariances, of each seed all that fit")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / ".random_recordings")
    options = parser.parse_args()
    if options.seed is not None:
        from random_recordings.trial import try_seed

        report = try_seed(options.seed, options.keep, options.invariances)
        print(json.dumps(report.as_json(), indent=1))
        return 1 if report.failures else 0
    first, _, last = options.seeds.partition(":")
    seeds = list(range(int(first), int(last))) if last else [int(seed) for seed in first.split(",")]
    if last:
        known = tomllib.loads(Path(__file__).with_name("regressions.toml").read_text(encoding="utf-8"))
        seeds = list(dict.fromkeys([*(entry["number"] for entry in known.get("seed", [])), *seeds]))
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "seeds.jsonl"
    reports = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    done = {report["seed"] for report in reports}
    tasks = [(seed, options.invariances) for seed in seeds if seed not in done]
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=200) as pool, file.open("a") as lines:
        for report in pool.imap_unordered(try_one, tasks):
            lines.write(json.dumps(report) + "\n")
            lines.flush()
            reports.append(report)
    reports = [report for report in reports if report["seed"] in set(seeds)]
    failures = [(report["seed"], failure) for report in reports for failure in report["failures"]]
    commands = Counter(f"{command}: {code}" for report in reports for command, code in report["commands"])
    print(f"{len(reports)} seeds, {sum(report['recorded_s'] for report in reports) / 3600.0:.1f} h of recorded time")
    print("commands by exit code:", ", ".join(f"{name} ({n})" for name, n in sorted(commands.items())))
    for seed, failure in sorted(failures, key=lambda each: (each[1]["oracle"], each[0])):
        print(f"seed {seed}: {failure['oracle']}: {' '.join(failure['message'].split())[:400]}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
