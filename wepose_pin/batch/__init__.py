"""Many recordings on Dask: a plan, its items each by itself, a table of results and a page over the study."""

from __future__ import annotations

from .plan import Item, Plan, read_plan
from .study import Study, run_study

__all__ = ["Item", "Plan", "Study", "read_plan", "run_study"]
