"""Trials as jobs: each is a function of its arguments and nothing else, so that they run side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple


class Result(NamedTuple):
    """One filter in one trial."""

    experiment: str
    trial: str
    method: str  # a contender's label
    figures: dict[str, Any]
    series: dict[str, list[float]] = {}  # over time, for the figures; of the first trial only  # noqa: RUF012


class Job(NamedTuple):
    """One trial of an experiment, for all contenders."""

    experiment: str
    trial: str
    function: Callable[..., list[Result]]
    arguments: tuple[Any, ...]

    def __call__(self) -> list[Result]:
        return self.function(self.experiment, self.trial, *self.arguments)


def run(jobs: Sequence[Job], workers: int | None = None) -> Iterator[list[Result]]:
    """Results of each job in the order of the jobs, whatever the number of `workers` (None: one a core)."""
    count = min(workers or os.cpu_count() or 1, len(jobs))
    if count <= 1:
        yield from (job() for job in jobs)
        return
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        try:
            yield from pool.map(_called, jobs)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _called(job: Job) -> list[Result]:
    return job()
