"""Trials as jobs: pure functions of their arguments, which run in parallel."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

from ..diagnostics import INFO, Diagnostic
from ..errors import WeposeError, reason


class Result(NamedTuple):
    """One filter in one trial."""

    experiment: str
    trial: str
    method: str  # a contender's label
    figures: dict[str, Any]
    series: dict[str, list[float]] = {}  # over time, for the figures; of the first trial only  # noqa: RUF012


class Skipped(NamedTuple):
    """A trial that could not be scored."""

    experiment: str
    trial: str
    reason: str

    def line(self) -> str:
        return f"{self.experiment}, {self.trial}: not scored: {self.reason}"

    def diagnostic(self) -> Diagnostic:
        place = f"{self.experiment}, {self.trial}"
        return Diagnostic("validation-part-skipped", INFO, place, facts={"reason": self.reason})


class Job(NamedTuple):
    """One trial of an experiment, for all contenders."""

    experiment: str
    trial: str
    function: Callable[..., list[Result]]
    arguments: tuple[Any, ...]

    def __call__(self) -> list[Result]:
        return self.function(self.experiment, self.trial, *self.arguments)


def run_jobs(jobs: Sequence[Job], workers: int | None = None) -> Iterator[list[Result] | Skipped]:
    """Run the jobs and iterate over their results in order, for any number of `workers` (None: one a core).

    A job that fails, for example on an unreadable recording, is reported and does not stop the others.
    """
    count = min(workers or os.cpu_count() or 1, len(jobs))
    if count <= 1:
        yield from map(_call, jobs)
        return
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        try:
            yield from pool.map(_call, jobs)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _call(job: Job) -> list[Result] | Skipped:
    try:
        return job()
    except WeposeError as error:
        return Skipped(job.experiment, job.trial, " ".join(str(error).split()))
    except Exception as error:
        return Skipped(job.experiment, job.trial, reason(error))
