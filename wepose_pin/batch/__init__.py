"""Many recordings: a plan, its items on local processes or on a Dask scheduler, a table of outcomes."""

from __future__ import annotations

from .plan import Item, Plan, read_plan
from .study import Study, run_batch

__all__ = ["Item", "Plan", "Study", "read_plan", "run_batch"]
