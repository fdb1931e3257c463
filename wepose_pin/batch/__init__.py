"""Many recordings on Dask: a plan, its items, a table and a page of results."""

from __future__ import annotations

from .plan import Item, Plan, read_plan
from .study import Study, run_batch

__all__ = ["Item", "Plan", "Study", "read_plan", "run_batch"]
