"""What came of many seeds, as a page of text."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any


def summary_text(reports: list[dict[str, Any]]) -> str:
    """Commands by exit code, failures by oracle and by seed, invariances, the largest z without a warning."""
    hours = sum(report["recorded_s"] for report in reports) / 3600.0
    commands = Counter((command, code) for report in reports for command, code in report["commands"])
    lines = [
        "# Random recordings",
        "",
        f"{len(reports)} seeds, {hours:.1f} h of recorded time, {sum(commands.values())} commands, "
        f"{sum(bool(report['failures']) for report in reports)} seeds with failures",
        "",
    ]
    codes = sorted({code for _, code in commands})
    rows = [
        [name, *(str(commands.get((name, code), "")) for code in codes)]
        for name in sorted({name for name, _ in commands})
    ]
    lines += ["## Commands by exit code", "", *_table(["command", *map(str, codes)], rows)]
    lines += ["## Equal physics: largest deviation [deg]", "", *_invariances(reports)]
    lines += ["## Largest error over the stated one, √3 of the column", "", *_accuracy(reports)]
    by_oracle: dict[str, list[tuple[int, dict[str, str]]]] = defaultdict(list)
    for report in reports:
        for failure in report["failures"]:
            by_oracle[failure["oracle"]].append((report["seed"], failure))
    lines += ["## Failures", ""]
    for oracle, failures in sorted(by_oracle.items(), key=lambda item: -len(item[1])):
        lines += [f"### {oracle}: {len(failures)}", ""]
        lines += [
            f"- seed {seed}: {' '.join(failure['message'].split())[:400]}"
            for seed, failure in sorted(failures, key=lambda f: f[0])
        ]
        lines.append("")
    return "\n".join(lines) + "\n"


def _invariances(reports: list[dict[str, Any]]) -> list[str]:
    largest: dict[tuple[str, str], tuple[float, float, int, int]] = {}
    for seed_, deviation in ((report["seed"], each) for report in reports for each in report["deviations"]):
        key = deviation["invariance"], deviation["method"]
        degrees, z, seed, count = largest.get(key, (0.0, 0.0, seed_, 0))
        if deviation["degrees"] >= degrees:
            degrees, seed = deviation["degrees"], seed_
        largest[key] = degrees, max(z, deviation["z"]), seed, count + 1
    rows = [
        [name, method, str(count), f"{degrees:.3g}", f"{z:.2f}", str(seed)]
        for (name, method), (degrees, z, seed, count) in sorted(largest.items())
    ]
    return _table(["what differs", "method", "tried", "largest [deg]", "z", "seed"], rows)


def _accuracy(reports: list[dict[str, Any]]) -> list[str]:
    by_method: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for report in reports:
        if report["accuracy"]:
            by_method[report["accuracy"]["method"]].append(report["accuracy"] | {"seed": report["seed"]})
    rows = []
    for method, accuracies in sorted(by_method.items()):
        worst = max(accuracies, key=lambda a: a["z_unexcused"])
        warned = sum(bool(a["excuse"]) for a in accuracies)
        rows.append([method, str(len(accuracies)), f"{worst['z_unexcused']:.1f}", str(worst["seed"]), str(warned)])
    return _table(["method", "tracks", "largest z without a warning", "seed", "above 6 with a warning"], rows)


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *rows]] + [""]
