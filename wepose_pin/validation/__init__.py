"""Validation: errors of the estimates in the paper's experiments on simulated subjects and in real recordings.

All random numbers have fixed seeds: two runs give the same figures. `contenders` holds the filters that are compared,
`paper` the simulated experiments, `mounting` one of ours, `real` the recordings. `tables` summarizes results beside the
paper's figures, `document` is their file, and `page` writes the pages with `figures` and templates/validation.md.j2.
"""

from __future__ import annotations

from pathlib import Path

from . import gains, mounting, paper, real
from .contenders import Contender, list_contenders
from .document import Document, format_document, join_results, read_document
from .jobs import Job, Result, Skipped, run_jobs
from .tables import Row, summarize

__all__ = [
    "Contender",
    "Document",
    "Job",
    "Result",
    "Row",
    "Skipped",
    "format_document",
    "join_results",
    "list_contenders",
    "list_experiments",
    "read_document",
    "run_jobs",
    "summarize",
]


def list_experiments(quick: bool = False, data: Path | None = None, trials: int | None = None) -> dict[str, list[Job]]:
    """List the trials of each experiment, one job a trial.

    `data` is the folder of the real recordings; `trials`: at most so many of each simulated experiment.
    """
    jobs = paper.list_experiments(quick, trials) | mounting.list_experiments(quick, trials)
    if data is not None:
        jobs |= real.list_experiments(data, quick)
    if not quick:
        jobs |= gains.list_experiments(data)
    return jobs
