"""Trials as jobs, pure functions of their arguments, which run in parallel; the summary of an experiment."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import rotations
from wepose_pin.errors import WeposeError, reason

Figures = Mapping[str, Any]  # name with its unit → value; or value and deviation over time


class Result(NamedTuple):
    """One contender in one trial."""

    method: str  # a contender's label
    figures: Figures


class Job(NamedTuple):
    """One trial of an experiment, for all contenders."""

    name: str
    function: Callable[..., list[Result]]
    arguments: tuple[Any, ...]

    def run(self) -> list[Result] | str:
        """Return the results, or in one line why there are none: one bad trial does not stop the others."""
        try:
            return self.function(*self.arguments)
        except WeposeError as error:
            return " ".join(str(error).split())
        except Exception as error:
            return reason(error)


class Summary(NamedTuple):
    """An experiment: means over its trials."""

    trials: int
    rows: dict[str, dict[str, list[float | None]]]  # method → figure → mean, deviation over time, between trials
    skipped: dict[str, str]  # trial → why it has no result


def run_experiment(jobs: Sequence[Job], workers: int | None = None) -> Summary:
    """Run the trials of an experiment and summarize them; the same for any number of `workers` (None: one a core)."""
    count = min(workers or os.cpu_count() or 1, len(jobs))
    if count <= 1:
        outcomes = [job.run() for job in jobs]
    else:
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
            outcomes = list(pool.map(Job.run, jobs))
    skipped = {job.name: out for job, out in zip(jobs, outcomes, strict=True) if isinstance(out, str)}
    scored = [outcome for outcome in outcomes if not isinstance(outcome, str)]
    return Summary(len(scored), summarize([result for results in scored for result in results]), skipped)


def summarize(results: Sequence[Result]) -> dict[str, dict[str, list[float | None]]]:
    """Method → figure → mean over the trials, mean deviation over time, deviation between the trials."""
    rows: dict[str, dict[str, list[float | None]]] = {}
    for method in dict.fromkeys(result.method for result in results):
        of_method = [result.figures for result in results if result.method == method]
        rows[method] = {}
        for name in dict.fromkeys(name for figures in of_method for name in figures):
            pairs = [np.atleast_1d(figures[name]) for figures in of_method if name in figures]
            values = np.array([pair[0] for pair in pairs])
            # Of root mean squares the mean is that of all trials together.
            mean = np.sqrt(np.mean(values**2)) if " rms" in name else values.mean()
            std = np.mean([pair[1] for pair in pairs]) if len(pairs[0]) > 1 else None
            between = values.std(ddof=1) if len(values) > 1 else None
            rows[method][name] = [None if value is None else float(f"{value:.4g}") for value in (mean, std, between)]
    return rows


def align_rotation(R_VS: Rotation, R_WS: Rotation, where: np.ndarray) -> Rotation:
    """Rotate R_VS about the vertical so that its heading is that of R_WS at the samples `where`."""
    psi = rotations.heading((R_WS[where] * R_VS[where].inv()).mean().as_quat())
    return Rotation.from_rotvec([0.0, 0.0, float(psi)]) * R_VS
