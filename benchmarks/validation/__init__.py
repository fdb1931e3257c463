"""Validation: errors in the paper's experiments on simulated sensors and people, and on real recordings.

All random numbers have fixed seeds. `contenders` holds the filters that are compared, `simulated` the paper's
experiments and two of ours, `real` the recordings, `gains` the search of the gains of ncf and gdc. An experiment that
was run replaces its part of ``results.json``, and `page` writes docs/validation.md from that file.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

from wepose_pin.errors import BadData, BadOption
from wepose_pin.writers.result import versions

from ..tables import Column, Section, Table
from . import gains, real, simulated
from .experiment import Job, Summary, run_experiment
from .page import render_page

RESULTS = Path(__file__).parent / "results.json"
PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


def list_experiments(quick: bool = False, data: Path | None = None) -> dict[str, list[Job]]:
    """List the trials of each experiment; `data` is the folder of the real recordings."""
    jobs = simulated.list_experiments(quick)
    if data is not None:
        jobs |= real.list_experiments(data, quick)
    return jobs if quick else jobs | gains.list_experiments(data)


def sections(
    quick: bool, data: Path | None, only: str | None, results: Path | None = None, page: Path | None = None
) -> dict[str, Section]:
    """Name → a function that runs the experiment; but for a quick run it writes `results` and `page`.

    Raises
    ------
    BadOption
        No experiment begins with `only`.
    """
    experiments = list_experiments(quick, data)
    chosen = {name: jobs for name, jobs in experiments.items() if name.startswith(only or "")}
    if not chosen:
        raise BadOption(f"--only {only}: no experiment begins so; there are: {', '.join(experiments)}")
    files = None if quick else (results or RESULTS, page or PAGE)
    return {name: partial(_measure, name, jobs, files) for name, jobs in chosen.items()}


def _measure(name: str, jobs: list[Job], files: tuple[Path, Path] | None) -> Table:
    summary = run_experiment(jobs)
    if not summary.rows:
        raise BadData(f"{name}: nothing could be scored; {'; '.join(summary.skipped.values())}")
    if files is not None:
        results, page = files
        content = json.loads(results.read_text(encoding="utf-8")) if results.is_file() else {}
        content[name] = {**summary._asdict(), "versions": versions()}
        results.write_text(format_results(content), encoding="utf-8")
        page.write_text(render_page(content), encoding="utf-8")
    return _make_table(name, summary)


def format_results(content: dict[str, dict[str, object]]) -> str:
    """Format the results as JSON, a line a row, without a time stamp: two runs give the same file."""
    parts = []
    for name, experiment in content.items():
        head = {key: value for key, value in experiment.items() if key != "rows"}
        rows = ",\n".join(
            f"   {json.dumps(method, ensure_ascii=False)}: {json.dumps(row, ensure_ascii=False)}"
            for method, row in dict(experiment["rows"]).items()  # type: ignore[call-overload]
        )
        text = json.dumps(head, ensure_ascii=False)[:-1]
        parts.append(f' {json.dumps(name)}: {text}, "rows": {{\n{rows}\n }}}}')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _make_table(name: str, summary: Summary) -> Table:
    figures = dict.fromkeys(figure for row in summary.rows.values() for figure in row)
    table = Table(f"{name}: means over {summary.trials} trials", tuple(Column(f, f, 2) for f in figures))
    for method, row in summary.rows.items():
        table.rows[method] = {figure: float(mean) for figure, (mean, *_) in row.items() if mean is not None}
    table.notes += [f"{trial}: not scored: {why}" for trial, why in summary.skipped.items()]
    return table
