"""Means over trials beside the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
PAPER_DRIFT = {"ncf": "drifts in yaw", "gdc": "little in yaw", "smekf": "negligible"}  # the worst first
PAPER_HAND = {"ncf": (17.71, 10.75), "gdc": (17.96, 10.82), "smekf": (12.05, 6.20)}

AXES = ("roll", "pitch", "yaw")
SPLIT = ("inclination_rmse", "heading_rmse", "total_rmse", "mean_angle")
HAND = {"hand_mm": "hand", "hand_from_shoulders_mm": "from shoulders"}
SHORT = {
    f"hand_uncertainty {key}": f"hand {name}"
    for key, name in (("nees", "nees"), ("within_1", "in 1σ"), ("within_2", "in 2σ"))
}
DEGREES = {*AXES, *(name.replace("_", " ") for name in SPLIT)}
_RMS = ("_rms", "_rms_mm", "_rms_deg")
UNITS = {"_deg_min": "deg/min", "_deg_s": "deg/s", "_deg": "deg", "_percent": "%", "_mm": "mm", "_s": "s"}


class Row(NamedTuple):
    """One contender in one experiment: means over its trials.

    `figures`: "name"; beside it, where there is one, "name std": the mean deviation over time, and "name between": the
    deviation between the trials.
    """

    experiment: str
    method: str
    figures: dict[str, float]
    paper: str  # the paper's own figures, as text; empty where it has none

    def names(self) -> list[str]:
        """Figures without what stands beside them."""
        return [name for name in self.figures if not name.endswith((" std", " between"))]


def summary(results: Sequence[Result]) -> list[Row]:
    """A row a contender and experiment, in the order in which they came."""
    rows = []
    for experiment in dict.fromkeys(result.experiment for result in results):
        for method in dict.fromkeys(result.method for result in results if result.experiment == experiment):
            of = [figures(r) for r in results if r.experiment == experiment and r.method == method]
            rows.append(Row(experiment, method, _mean(of), paper_text(experiment, method)))
    return rows


def figures(result: Result) -> dict[str, float]:
    """What a table shows of one trial: name → value, "name std" → its deviation over time where there is one."""
    experiment, found = result.experiment, result.figures
    if experiment.startswith("dynamic"):
        return _flat({name: found[name] for name in AXES if name in found})
    if all(name in found for name in SPLIT[:3]):
        return _flat({name.replace("_", " "): found[name] for name in SPLIT if name in found})
    return {
        SHORT.get(name, name): value for name, value in _flat({HAND.get(k, k): v for k, v in found.items()}).items()
    }


def paper_figures(experiment: str, method: str) -> dict[str, tuple[float, float]]:
    """Name → the paper's mean and deviation; a filter's second row ("ncf as it comes") stands beside the same."""
    filter_ = method.split()[0]
    if experiment.startswith("dynamic"):
        rate = 1000 if "1 kHz" in experiment else 100
        return dict(zip(AXES, PAPER_DYNAMIC.get((filter_, rate), ()), strict=False))
    if experiment.startswith("upper body") and filter_ in PAPER_HAND:
        return dict.fromkeys(HAND.values(), PAPER_HAND[filter_])  # it does not say from where it counts
    return {}


def paper_text(experiment: str, method: str) -> str:
    """The paper's figures in a few words; empty where it has none."""
    if experiment == "drift":
        return PAPER_DRIFT.get(method.split()[0], "")
    found = paper_figures(experiment, method).values()
    texts = list(dict.fromkeys(f"{mean:.2f} ± {std:.2f}" for mean, std in found))
    return texts[0] if len(texts) == 1 else "  ".join(text.replace(" ", "") for text in texts)


def name_and_unit(name: str) -> tuple[str, str]:
    """A figure's name as a reader wants it, and its unit; empty where it has none."""
    if name in DEGREES:
        return name, "deg"
    if name in HAND.values():
        return {"hand": "hand from root"}.get(name, f"hand {name}"), "mm"
    for ending, unit in UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " "), unit
    return name.replace("_", " "), ""


def _flat(found: Mapping[str, Any], above: str = "") -> dict[str, float]:
    flat: dict[str, float] = {}
    for key, value in found.items():
        name = f"{above} {key}".strip()
        if isinstance(value, Mapping) and {"mean", "std"} <= set(value):
            flat |= {name: value["mean"], f"{name} std": value["std"]}
        elif isinstance(value, Mapping):
            flat |= _flat(value, name)
        elif isinstance(value, list | tuple) and len(value) == 2:
            flat |= {name: value[0], f"{name} std": value[1]}
        elif isinstance(value, int | float | np.number):
            flat[name] = float(value)
    return {name: float(value) for name, value in flat.items() if value is not None and np.isfinite(value)}


def _mean(trials: Sequence[Mapping[str, float]]) -> dict[str, float]:
    mean: dict[str, float] = {}
    for name in dict.fromkeys(name for trial in trials for name in trial):
        values = [trial[name] for trial in trials if name in trial]
        # Of root mean squares the mean is that of all trials together.
        mean[name] = float(np.sqrt(np.mean(np.square(values))) if name.endswith(_RMS) else np.mean(values))
        if len(values) > 1 and not name.endswith(" std"):
            mean[f"{name} between"] = float(np.std(values, ddof=1))
    return mean
