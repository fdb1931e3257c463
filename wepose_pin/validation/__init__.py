"""How wrong the estimates are: the paper's experiments on simulated subjects, and real recordings with a truth.

Everything is seeded: two runs give the same numbers. `contenders` are the filters as they are compared, `paper` the
simulated experiments, `real` the recordings, `tables` sums them up beside the paper's figures.
"""

from __future__ import annotations

from pathlib import Path

from . import paper, real
from .contenders import Contender, contenders
from .jobs import Job, Result, run
from .tables import Row, summary

__all__ = ["Contender", "Job", "Result", "Row", "contenders", "experiments", "run", "summary"]


def experiments(quick: bool = False, data: Path | None = None) -> dict[str, list[Job]]:
    """Name → its trials, a job each; `data`: the folder of the real recordings."""
    found = paper.experiments(quick)
    if data is not None:
        found |= real.experiments(data, quick)
    return found
