"""Means over trials beside the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .jobs import Result

# Lisini Baldi 2019: roll, pitch, yaw [deg] as mean ± std by rate [Hz]; right hand [mm].
PAPER_DYNAMIC = {
    ("ncf", 100): ((2.23, 2.25), (2.70, 2.90), (2.42, 2.62)),
    ("gdc", 100): ((1.38, 1.37), (2.28, 2.43), (2.11, 2.24)),
    ("smekf", 100): ((1.10, 1.30), (1.46, 1.71), (1.35, 1.62)),
    ("ncf", 1000): ((1.89, 1.41), (1.93, 2.09), (2.05, 2.03)),
    ("gdc", 1000): ((0.96, 0.81), (1.48, 1.43), (1.57, 1.50)),
    ("smekf", 1000): ((0.71, 0.79), (0.73, 0.75), (0.86, 0.82)),
}
PAPER_DRIFT = {"ncf": "drifts in yaw", "gdc": "little in yaw", "smekf": "negligible"}
PAPER_HAND = {"ncf": (17.71, 10.75), "gdc": (17.96, 10.82), "smekf": (12.05, 6.20)}


class Row(NamedTuple):
    """One contender in one experiment: means over its trials."""

    experiment: str
    method: str
    figures: dict[str, float]  # "name", and "name std" beside it where there is one: deviation over time
    paper: str  # the paper's own figures, as text; empty where it has none


def summary(results: Sequence[Result]) -> list[Row]:
    """A row a contender and experiment, in the order in which they came."""
    rows = []
    for experiment in dict.fromkeys(result.experiment for result in results):
        for method in dict.fromkeys(result.method for result in results if result.experiment == experiment):
            of = [r.figures for r in results if r.experiment == experiment and r.method == method]
            rows.append(Row(experiment, method, *_mean(experiment, method, of)))
    return rows


def _mean(experiment: str, method: str, figures: list[dict[str, Any]]) -> tuple[dict[str, float], str]:
    def over(*path: Any) -> float:
        values = []
        for figure in figures:
            value: Any = figure
            for key in path:
                value = value[key]
            values.append(value)
        return float(np.mean(values))

    filter_ = method.split()[0]
    if experiment.startswith("dynamic"):
        paper = PAPER_DYNAMIC.get((filter_, 1000 if "1 kHz" in experiment else 100), ())
        mean = {f"{name}{' std' * k}": over(name, k) for name in ("roll", "pitch", "yaw") for k in (0, 1)}
        return mean, "  ".join(f"{m:.2f} ± {s:.2f}" for m, s in paper)
    if experiment == "drift":
        return {name: over(name) for name in figures[0]}, PAPER_DRIFT.get(filter_, "")
    if experiment.startswith("upper body"):
        mean = {"hand": over("hand_mm", "mean"), "hand std": over("hand_mm", "std")}
        mean |= {"from shoulders": over("hand_from_shoulders_mm", "mean")}
        mean |= {"from shoulders std": over("hand_from_shoulders_mm", "std")}
        return mean, "{:.2f} ± {:.2f}".format(*PAPER_HAND[filter_]) if filter_ in PAPER_HAND else ""
    names = ("inclination_rmse", "heading_rmse", "total_rmse", "mean_angle")
    return {name.replace("_", " "): over(name) for name in names}, ""
