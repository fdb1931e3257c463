"""Validation: errors in the paper's experiments on simulated sensors and people, and on real recordings.

All random numbers have fixed seeds. `contenders` holds the filters that are compared, `simulated` the paper's
experiments and two of ours on the sensor of `single` and on people, `real` the recordings, `gains` those of ncf and
gdc. An experiment that was run replaces its part of ``results.json``, and `page` writes docs/validation.md from that
file.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

from wepose_pin.errors import BadData, BadOption
from wepose_pin.writers.result import versions

from ..tables import Column, Section, Table
from . import real, simulated
from .experiment import Job, run_experiment
from .page import render_page

RESULTS = Path(__file__).parent / "results.json"
PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


def list_experiments(quick: bool = False, data: Path | None = None) -> dict[str, list[Job]]:
    """List the trials of each experiment; `data` is the folder of the real recordings."""
    return simulated.list_experiments(quick) | ({} if data is None else real.list_experiments(data, quick))


def sections(quick: bool, data: Path | None, only: str | None = None) -> list[Section]:
    """List the functions that run an experiment each; but for a quick run they write `RESULTS` and `PAGE`.

    Raises
    ------
    BadOption
        No experiment begins with `only`.
    """
    experiments = list_experiments(quick, data)
    chosen = {name: jobs for name, jobs in experiments.items() if name.startswith(only or "")}
    if not chosen:
        raise BadOption(f"--only {only}: no experiment begins so; there are: {', '.join(experiments)}")
    return [partial(_measure, name, jobs, not quick) for name, jobs in chosen.items()]


def _measure(name: str, jobs: list[Job], writes: bool) -> Table:
    summary = run_experiment(jobs)
    if not summary.rows:
        raise BadData(f"{name}: nothing could be scored; {'; '.join(summary.skipped.values())}")
    if writes:
        content = json.loads(RESULTS.read_text(encoding="utf-8"))
        content[name] = {**summary._asdict(), "versions": versions()}
        RESULTS.write_text(format_results(content), encoding="utf-8")
        PAGE.write_text(render_page(content), encoding="utf-8")
    figures = dict.fromkeys(figure for row in summary.rows.values() for figure in row)
    table = Table(f"{name}: means over {summary.trials} trials", tuple(Column(f, f, 2) for f in figures))
    for method, row in summary.rows.items():
        table.rows[method] = {figure: float(mean) for figure, (mean, *_) in row.items() if mean is not None}
    table.notes += [f"{trial}: not scored: {why}" for trial, why in summary.skipped.items()]
    return table


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
