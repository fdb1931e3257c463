"""Many recordings on Dask: a plan, its items each by itself, a table of results and a page over the study.

A result made again from its provenance, an item of a study among them.
"""

from __future__ import annotations

from .plan import Item, Plan, read_plan
from .reproduce import run_reproduce
from .study import Study, run_batch

__all__ = ["Item", "Plan", "Study", "read_plan", "run_batch", "run_reproduce"]
