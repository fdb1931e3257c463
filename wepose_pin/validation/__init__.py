"""How wrong the estimates are: the paper's experiments on simulated subjects, and real recordings with a truth.

Everything is seeded: two runs give the same numbers. `contenders` are the filters as they are compared, `paper` the
simulated experiments, `mounting` one of ours, `real` the recordings, `tables` sums them up beside the paper's figures,
`document` is their file, `page` the pages, with `figures` and the fixed text in templates/validation.md.j2.
"""

from __future__ import annotations

from pathlib import Path

from . import gains, mounting, paper, real
from .contenders import Contender, contenders
from .document import Document, document_text, read_document
from .jobs import Job, Result, Skipped, run
from .tables import Row, summary

__all__ = [
    "Contender",
    "Document",
    "Job",
    "Result",
    "Row",
    "Skipped",
    "contenders",
    "document_text",
    "experiments",
    "read_document",
    "run",
    "summary",
]


def experiments(quick: bool = False, data: Path | None = None) -> dict[str, list[Job]]:
    """Name → its trials, a job each; `data`: the folder of the real recordings."""
    jobs = paper.experiments(quick) | mounting.experiments(quick)
    if data is not None:
        jobs |= real.experiments(data, quick)
    if not quick:
        jobs |= gains.experiments(data)
    return jobs
