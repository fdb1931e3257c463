"""Means over trials and the paper's figures, and the tables of the pages and the command."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..report.page import Table
from ..simulation import GRAVITY
from .jobs import Result

OURS = "smekf"  # the paper's filter
DEFAULT = "amekf"  # the default of the commands
DEFAULTS = ", default gains"  # suffix of the label of a filter's second row
PUBLISHED = "smekf_published"
AS_PUBLISHED = f"{OURS}, as published"  # the label of `PUBLISHED`
WITH_TRUNK = f"{OURS}, trunk measured"  # beside the shoulder width
DEFAULT_WITH_TRUNK = f"{DEFAULT}, trunk measured"
AS_COMMANDED = f"{DEFAULT}, mounts as stated"  # by the session, to the next axis, and the start pose
ORIENTATIONS_ALONE = f"{DEFAULT}, orientations alone"  # without joint accelerations and covariance, as others enter
CAUSAL = f"{DEFAULT}, causal"  # tracked as live, with past samples only
LENGTHS_ALONE = f"{OURS}, lengths alone"  # calibrated in the paper's formulation
OPEN_LOOP = f"{OURS}, open loop"  # tracked without heading correction
PROTOCOL = f"{OURS}, the paper's protocol"  # both, and mounts by the session and the start pose
# Rows that are no filters of their own.
VARIANTS = (
    *(AS_PUBLISHED, WITH_TRUNK, DEFAULT_WITH_TRUNK, AS_COMMANDED, ORIENTATIONS_ALONE, CAUSAL),
    *(LENGTHS_ALONE, OPEN_LOOP, PROTOCOL),
)
# Experiments; those of people have one of each preset: "upper body, mild".
UPPER_BODY = "upper body"
ERROR_BUDGET = "error budget"
ARBITRARY_MOUNTING = "arbitrary sensor mounting"

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
HAND = {"hand_from_shoulders_mm": "from shoulders", "hand_mm": "from root"}
SHORT = {
    f"hand_uncertainty {key}": f"hand {name}"
    for key, name in (("nees", "nees"), ("within_1", "in 1σ"), ("within_2", "in 2σ"))
}
FROM = {"from shoulders": "from the middle of the shoulders", "from root": "from the root"}
DEGREES = {*AXES, *(name.replace("_", " ") for name in SPLIT)}
ERRORS = {*DEGREES, *HAND.values(), "drift_deg_min"}  # figures for which less is better


class Target(NamedTuple):
    """A target of the project for a mean error: at least and at most."""

    method: str
    name: str
    least: float
    most: float


TARGETS: dict[str, tuple[Target, ...]] = {
    f"{UPPER_BODY}, ideal": (
        Target(OURS, "from shoulders", 0.0, 12.0),
        Target(OURS, "from root", 0.0, 12.0),
        Target(WITH_TRUNK, "from root", 0.0, 12.0),
    ),
    f"{UPPER_BODY}, mild": (
        Target(OURS, "from shoulders", 0.0, 18.0),
        Target(OURS, "from root", 0.0, 18.0),
        Target(WITH_TRUNK, "from root", 0.0, 18.0),
    ),
    f"{ARBITRARY_MOUNTING}, mild": (
        Target(DEFAULT, "lengths_rms_mm", 0.0, 8.0),
        Target(DEFAULT, "headings_rms_deg", 0.0, 2.0),
        Target(DEFAULT, "errors_by_std_rms", 0.7, 1.5),
        Target(DEFAULT, "from shoulders", 0.0, 18.0),
        Target(DEFAULT, "from root", 0.0, 18.0),
        Target(DEFAULT_WITH_TRUNK, "from root", 0.0, 18.0),
    ),
}
# Field of `Imperfections` → words, factor to the unit, unit.
_IMPERFECTIONS = {
    "soft_tissue_deg": ("soft-tissue artefact: rotation of a sensor, rms", 1.0, "°"),
    "palm_slip": ("slip of the palms in the clasp, rms", 1e3, " mm"),
    "tissue_gain": ("soft tissue that follows the joints, of the literature's", 100.0, " %"),
    "tissue_random": ("soft tissue, its random part, of the literature's", 100.0, " %"),
    "wobble_deg": ("wobble of a sensor under acceleration", 1.0, "° per g"),
    "upper_arm_place": ("the upper arm's sensor, from the shoulder; –: half-way", 100.0, " % of the length"),
    "forearm_place": ("the forearm's sensor, from the elbow; –: half-way", 100.0, " % of the length"),
    "breath_deg": ("breath, pitch of the sensor on the sternum, rms", 1.0, "°"),
    "creep_deg": ("creep of a strap after 10 min, about each axis", 1.0, "°"),
    "strap_slip_deg": ("slip of a strap, once in 200 min", 1.0, "°"),
    "shoulder_wander": ("shoulder centres that wander, at 90° of elevation", 1e3, " mm"),
    "girdle": ("shoulder centres follow the arm, of the literature's", 100.0, " %"),
    "girdle_person": ("what a person's shoulders do differently, of the literature's", 100.0, " %"),
    "girdle_wander": ("shrugs and reaching, of the literature's", 100.0, " %"),
    "girdle_hysteresis": ("girdle: lead of raising over lowering", 100.0, " %"),
    "girdle_rest": ("a person's shoulders at rest, of the literature's", 100.0, " %"),
    "carrying_angle": ("carrying angle of the elbow, of the literature's", 100.0, " %"),
    "elbow_abduction_deg": ("elbow off a hinge, rms", 1.0, "°"),
    "wrist_flexion_deg": ("wrists bent in the clasp, rms", 1.0, "°"),
    "wrist_deviation_deg": ("wrists deviated in the clasp, rms", 1.0, "°"),
    "handle_slip": ("slip of the hands on a handle, rms", 1e3, " mm"),
    "start_pose": ("start pose as people hold it, of the literature's", 100.0, " %"),
    "start_heading_deg": ("torso's heading off the feet's in the start pose", 1.0, "°"),
    "start_elbow_deg": ("elbows bent in the start pose", 1.0, "°"),
    "start_segment_deg": ("arm segments off the start pose, rms", 1.0, "°"),
    "sway_deg_s": ("sway while standing, rms", 1.0, "°/s"),
    "sway_tilt_deg": ("sway while standing, slow tilt, rms", 1.0, "°"),
    "gyro_scale": ("gyroscope scale", 100.0, " %"),
    "accel_scale": ("accelerometer scale", 100.0, " %"),
    "misalignment_deg": ("misaligned axes", 1.0, "°"),
    "g_sensitivity_deg_s": ("g-sensitivity", 1.0, "°/s per g"),
    "gyro_range_deg_s": ("gyroscope range", 1.0, "°/s"),
    "accel_range_g": ("accelerometer range", 1.0, " g"),
    "bits": ("quantisation", 1.0, " bits"),
    "gyro_warm_up_deg_s": ("change of the gyroscope's bias in 15 min, at most", 1.0, "°/s"),
    "clock_jitter": ("clock jitter", 1e3, " ms"),
    "clock_offset": ("clocks apart", 1e3, " ms"),
    "clock_drift_ppm": ("rate of a clock", 1.0, " ppm"),
    "dropped": ("samples lost", 100.0, " %"),
}
# Field of `ImuNoise` → words, factor to the unit, unit.
_NOISE = {
    "gyro_density": ("gyroscope, noise density", math.degrees(1.0), "°/s/√Hz"),
    "gyro_bias_std": ("gyroscope, turn-on bias", math.degrees(1.0), "°/s"),
    "gyro_bias_instability": ("gyroscope, in-run bias", math.degrees(3600.0), "°/h"),
    "accel_density": ("accelerometer, noise density", 1e6 / GRAVITY, " µg/√Hz"),
    "accel_bias_std": ("accelerometer, turn-on bias", 1e3 / GRAVITY, " mg"),
    "accel_bias_instability": ("accelerometer, in-run bias", 1e3 / GRAVITY, " mg"),
}
_RMS = ("_rms", "_rms_mm", "_rms_deg")
GAINS = {"gain", "integral"}  # of the grid search: small numbers, three digits
UNITS = {"_deg_min": "deg/min", "_deg_s": "deg/s", "_deg": "deg", "_percent": "%", "_mm": "mm", "_s": "s"}


class Row(NamedTuple):
    """One contender in one experiment: means over its trials.

    `figures` has "name", and where they exist "name std", the mean deviation over time, and "name between", the
    deviation between the trials.
    """

    experiment: str
    method: str
    figures: dict[str, float]
    paper: str  # the paper's figures as text; empty: none

    def names(self) -> list[str]:
        """Return the names of figures, without their deviations."""
        return [name for name in self.figures if not name.endswith((" std", " between"))]


def summarize(results: Sequence[Result]) -> list[Row]:
    """Summarize results: one row for each contender and experiment, in their order."""
    rows = []
    for experiment in dict.fromkeys(result.experiment for result in results):
        for method in dict.fromkeys(result.method for result in results if result.experiment == experiment):
            figures = [collect_figures(r) for r in results if r.experiment == experiment and r.method == method]
            rows.append(Row(experiment, method, _mean(figures), format_paper(experiment, method)))
    return rows


def collect_figures(result: Result) -> dict[str, float]:
    """Collect the figures of one trial: name → value, "name std" → its deviation over time where it exists."""
    experiment, values = result.experiment, result.figures
    if experiment.startswith("dynamic"):
        return _flat({name: values[name] for name in AXES if name in values})
    if all(name in values for name in SPLIT[:3]):
        return _flat({name.replace("_", " "): values[name] for name in SPLIT if name in values})
    return {
        SHORT.get(name, name): value for name, value in _flat({HAND.get(k, k): v for k, v in values.items()}).items()
    }


def find_paper_figures(experiment: str, method: str) -> dict[str, tuple[float, float]]:
    """Find the paper's figures: name → mean and deviation; all rows of a filter have the same."""
    filter_ = method.partition(", ")[0]
    if experiment.startswith("dynamic"):
        rate = 1000 if "1 kHz" in experiment else 100
        return dict(zip(AXES, PAPER_DYNAMIC.get((filter_, rate), ()), strict=False))
    if experiment.startswith(UPPER_BODY) and filter_ in PAPER_HAND:
        return dict.fromkeys(HAND.values(), PAPER_HAND[filter_])  # the paper does not state the origin
    return {}


def format_paper(experiment: str, method: str) -> str:
    """Format the paper's figures; empty: it has none."""
    if experiment == "drift":
        return PAPER_DRIFT.get(method.partition(", ")[0], "")
    values = find_paper_figures(experiment, method).values()
    texts = list(dict.fromkeys(f"{mean:.2f} ± {std:.2f}" for mean, std in values))
    return texts[0] if len(texts) == 1 else "  ".join(text.replace(" ", "") for text in texts)


def split_unit(name: str) -> tuple[str, str]:
    """Split a figure's name into a name for readers and its unit, which may be empty."""
    if name in DEGREES:
        return name, "deg"
    if name in HAND.values():
        return f"hand {name}", "mm"
    for ending, unit in UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " "), unit
    return name.replace("_", " "), ""


# Tables ---------------------------------------------------------------------------------------------------------------


def make_experiment_table(rows: Sequence[Row], whole: bool) -> Table:
    """Make the table of an experiment; `whole`: with deviations between trials and all columns, the best in bold."""
    names = list(dict.fromkeys(name for row in rows for name in row.names()))
    if not whole:
        names = [name for name in names if name not in SHORT.values()]
    units = {name: split_unit(name) for name in names}
    experiment = rows[0].experiment
    papers = [find_paper_figures(experiment, row.method) for row in rows]
    compared = [name for name in names if any(name in paper for paper in papers)] if whole else []
    if len({str(paper.get(name)) for paper in papers[:1] for name in compared}) < len(compared):
        compared = []  # one figure for all columns
    best = {
        name: min(round(row.figures[name], 2) for row in rows if name in row.figures)
        for name in names
        if whole and len(rows) > 1 and name in ERRORS and not experiment.startswith(ERROR_BUDGET)
    }
    shared = {unit for _, unit in units.values()}
    header = ["on or off" if experiment.startswith(ERROR_BUDGET) else "filter"]
    header += [f"{text} [{unit}]" if unit and (whole or len(shared) > 1) else text for text, unit in units.values()]
    texts = not compared and any(row.paper for row in rows)
    header += [f"paper: {units[name][0]}" for name in compared] + (["the paper"] if texts else [])
    cells = []
    for row, paper in zip(rows, papers, strict=True):
        line = [row.method]
        for name in names:
            text = _cell(row, name, whole)
            line.append(f"**{text}**" if text and name in best and round(row.figures[name], 2) <= best[name] else text)
        line += ["{:.2f} ± {:.2f}".format(*paper[name]) if name in paper else "" for name in compared]
        cells.append(line + ([row.paper] if texts else []))
    return Table(header, cells)


def find_shared_unit(rows: Sequence[Row]) -> str:
    """Find the unit that all columns of a short table share; empty: they differ."""
    names = dict.fromkeys(name for row in rows for name in row.names() if name not in SHORT.values())
    units = {split_unit(name)[1] for name in names}
    return units.pop() if len(units) == 1 else ""


def make_targets_table(rows: Sequence[Row]) -> Table:
    """Make the table of the project's targets for the measured figures."""
    cells = []
    for experiment, targets in TARGETS.items():
        for method, name, least, most in targets:
            for row in rows:
                if (row.experiment, row.method) == (experiment, method) and name in row.figures:
                    value, (text, unit) = row.figures[name], split_unit(name)
                    target = f"at most {most:g} {unit}" if least == 0.0 else f"{least:g} to {most:g} {unit}"
                    met = "met" if least <= value <= most else "**missed**"
                    cells.append([row.experiment, method, text, f"{value:.2f} {unit}".strip(), target.strip(), met])
    return Table(["experiment", "row", "figure", "value", "target", ""], cells)


class PaperComparison(NamedTuple):
    """Our mean errors beside those of the paper's that are of the same filter."""

    figures: int  # that have one of the paper's
    larger: Table


def compare_with_paper(rows: Sequence[Row]) -> PaperComparison:
    """Compare all rows with the paper's figures, and list those that are larger."""
    figures, cells = 0, []
    for row in rows:
        for name, (mean, _) in find_paper_figures(row.experiment, row.method).items():
            if name in row.figures:
                figures += 1
                if round(row.figures[name], 2) > mean:
                    text, unit = split_unit(name)
                    cells.append(
                        [row.experiment, row.method, f"{text} [{unit}]", f"{row.figures[name]:.2f}", f"{mean:.2f}"]
                    )
    return PaperComparison(figures, Table(["experiment", "row", "mean error", "ours", "the paper's"], cells))


def make_overview_table(rows: Sequence[Row]) -> Table:
    """Make the overview: smekf, the paper's smekf and the best of all filters; bold where ours exceeds the paper's."""
    cells = []
    for experiment in dict.fromkeys(row.experiment for row in rows if not row.experiment.startswith(ERROR_BUDGET)):
        figures = {row.method: row.figures for row in rows if row.experiment == experiment}
        paper = find_paper_figures(experiment, OURS)
        for name in (name for name in figures.get(OURS, {}) if name in ERRORS and name != "mean angle"):
            ours, (text, unit) = figures[OURS][name], split_unit(name)
            filters = {m: values[name] for m, values in figures.items() if name in values and m not in VARIANTS}
            ranks = {m: (round(value, 2), m != OURS) for m, value in filters.items()}
            best = min(ranks, key=ranks.__getitem__)
            shown = f"{ours:.2f}"
            if name in paper and round(ours, 2) > paper[name][0]:
                shown = f"**{shown}**"
            theirs = f"{paper[name][0]:.2f}" if name in paper else ""
            cells.append([experiment, f"{text} [{unit}]", shown, theirs, f"{figures[best][name]:.2f}", best])
    return Table(["experiment", "mean error", "smekf", "the paper's smekf", "best", "by"], cells)


def make_imperfections_table(presets: Mapping[str, Mapping[str, Any]]) -> Table:
    """Make the table of the imperfections of each preset; those that none of them has are left out.

    `presets` as in `Document`.
    """
    by_preset = {label: preset.get("imperfections", {}) for label, preset in presets.items()}
    named = dict.fromkeys([*_IMPERFECTIONS, *(name for imperfections in by_preset.values() for name in imperfections)])
    cells = []
    for name in named:
        words, factor, unit = _IMPERFECTIONS.get(name, (name.replace("_", " "), 1.0, ""))
        sizes = [_size(imperfections.get(name), factor, unit) for imperfections in by_preset.values()]
        if any(size != "–" for size in sizes):
            cells.append([words, *sizes])
    return Table(["imperfection", *presets], cells)


def make_noise_table(noise: Mapping[str, float]) -> Table:
    """Make the table of the simulated sensors' noise in the units of data sheets."""
    cells = [
        [words, f"{factor * noise[name]:.3g}{unit}"] for name, (words, factor, unit) in _NOISE.items() if name in noise
    ]
    return Table(["Xsens MTi-3", "one standard deviation"], cells)


def make_gains_table(gains: Mapping[str, Mapping[str, Any]]) -> Table:
    """Make the table of the gains of ncf and gdc in each setting."""
    cells = [
        [setting, *(", ".join(f"{k} {v:.3g}" for k, v in own_gains.get(name, {}).items()) for name in ("ncf", "gdc"))]
        for setting, own_gains in gains.items()
    ]
    return Table(["setting", "ncf", "gdc"], cells)


def describe_known(experiment: str, presets: Mapping[str, Mapping[str, Any]]) -> str:
    """Describe what was measured beforehand, or known, in an experiment; `presets` as in `Document`."""
    off = presets.get(experiment.rpartition(", ")[2], {}).get("measured_std")
    off_text = f", off by {1e3 * off:g} mm (one standard deviation)" if isinstance(off, int | float) else ""
    still = (
        "noise, gyroscope bias and tilt, from {} (default gains: their bias starts at zero); the heading, aligned there"
    )
    lengths = f"the shoulder width between the joint centres{off_text}; stature to 1 cm, and sex"
    bias = (
        "noise, gyroscope bias and tilt of each sensor, from the start pose (default gains: their bias starts at zero)"
    )
    trunk = "The trunk is measured too, off by as much, in the row that says so, and in no other"
    ten = "clocks, frames, tilt of the truth's world and the heading, on the first 10 s, which are not scored"
    for name, text in {
        "dynamic": still.format("the 5 s before the motion"),
        "drift": still.format("the 25 s before the motion"),
        UPPER_BODY: f"{lengths}; how each sensor is mounted, exactly (but in the rows of stated mounts and of the "
        f"paper's protocol); {bias}. {trunk}",
        ARBITRARY_MOUNTING: f"{lengths}; {bias}. Nothing of the mounts. {trunk}",
        ERROR_BUDGET: f"{lengths}; how each sensor is mounted, exactly, but in one row; {bias}. {trunk}",
        "BROAD": still.format("the 25 to 44 s before the motion"),
        "the authors' trial": "clocks, frames and the heading, on the half that is not scored (5 to 11 s with 11 to "
        "17.3 s, and 11 to 17.3 s with all before); noise, gyroscope bias and tilt, from 0.05 to 0.9 s (default gains: "
        "their bias starts at zero)",
        "RING, link lengths": f"the optical path of the tip, to which the lengths are fitted; {ten}, as is the bias",
        "RING": f"{ten}" + (", as is the gyroscope's bias" if "bias unknown" not in experiment else "; no bias"),
        "UR5": f"{ten}; noise, gyroscope bias and tilt, from the 0.6 to 4 s before the motion",
        "gains": "the truth of the trials on which the gains are searched, which are not scored with them",
    }.items():
        if experiment.startswith(name):
            return f"{text}."
    return ""


def describe_table(rows: Sequence[Row]) -> str:
    """Explain the signs of the table."""
    keys = [key for row in rows for key in row.figures]
    notes = []
    if any(key.endswith(" std") for key in keys):
        notes.append("± is one standard deviation over time, averaged over the trials, as is the mean")
    if any(key.endswith(" between") for key in keys):
        notes.append("in brackets one standard deviation between the trials")
    if any(name.replace("_", " ") in keys for name in SPLIT):
        notes.append("RMSE: root mean square error of a trial, averaged over the trials")
    if set(SHORT.values()) & set(keys):
        notes.append(
            "nees: normalised squared error of the hand from the root, right are 3; in 1σ, in 2σ: share of its errors "
            "of one axis within one and two stated standard deviations, right are 0.68 and 0.95"
        )
    if any(key in ERRORS for key in keys) and len(rows) > 1 and not rows[0].experiment.startswith(ERROR_BUDGET):
        notes.append("bold: the smallest of a column")
    text = "; ".join(notes)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


class Part(NamedTuple):
    """A part of the hand's error from one imperfection: all on less this one off, as root of the mean squares [mm].

    Below zero: the error grows without it.
    """

    name: str
    added: dict[str, float]  # by the values of `HAND`


class ErrorBudget(NamedTuple):
    """Root-mean-square errors of the hand [mm] with all imperfections, and the part of each."""

    full: dict[str, float]
    parts: list[Part]  # largest first
    more: list[Part]  # imperfections that are not in the total, with their additional error


def compute_error_budget(results: Sequence[Result]) -> ErrorBudget | None:
    """Compute the part of each imperfection in the hand's error, from the results of one preset.

    None without a run with all of them.
    """
    rms: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(result.method for result in results if result.experiment.startswith(ERROR_BUDGET)):
        figures = [r.figures for r in results if r.method == method]
        rms[method] = {
            name: float(np.sqrt(np.mean([figure[key]["rmse"] ** 2 for figure in figures])))
            for key, name in HAND.items()
            if all(isinstance(figure.get(key), dict) and figure[key].get("rmse") is not None for figure in figures)
        }
    full = rms.pop("all on", None)
    if not full:
        return None
    parts, more = [], []
    for method, without in rms.items():
        squares = {name: full[name] ** 2 - without[name] ** 2 for name in without if name in full}
        added = {name: float(np.copysign(np.sqrt(abs(square)), square)) for name, square in squares.items()}
        if method.endswith(" as stated"):  # known in the budget
            more.append(Part(method, {name: -value for name, value in added.items()}))
        elif added:
            parts.append(Part(_name_part(method), added))
    parts.sort(key=lambda part: -next(iter(part.added.values())))
    return ErrorBudget(full, parts, more)


def _name_part(method: str) -> str:
    """Name the part of a method's label: "soft tissue off", "lengths known" → "soft tissue", "lengths"."""
    return {
        "orientations exact": "orientation filter",
        "clocks exact, none lost": "clocks, lost samples",
        "trunk measured": "trunk not measured",
        "wrists straight": "wrists",
        "elbows as hinges": "elbows",
    }.get(method, method.removesuffix(" off").removesuffix(" exact"))


def _cell(row: Row, name: str, whole: bool) -> str:
    if name not in row.figures:
        return ""
    text = f"{row.figures[name]:.3g}" if name in GAINS else f"{row.figures[name]:.2f}"
    text += f" ± {row.figures[f'{name} std']:.2f}" if f"{name} std" in row.figures else ""
    return text + (f" ({row.figures[f'{name} between']:.2f})" if whole and f"{name} between" in row.figures else "")


def _size(value: Any, factor: float, unit: str) -> str:
    """Format a size in its unit; "–" for none, as for an infinite range."""
    return f"{factor * value:.4g}{unit}" if isinstance(value, int | float) and value else "–"


# Figures of trials ----------------------------------------------------------------------------------------------------


def _flat(values: Mapping[str, Any], above: str = "") -> dict[str, float]:
    flat: dict[str, float] = {}
    for key, value in values.items():
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
