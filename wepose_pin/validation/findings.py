"""What the figures say, in sentences made from them: the paper's order, what is worse, what beats smekf, targets."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from .jobs import Result
from .tables import DEGREES, HAND, PAPER_DRIFT, PAPER_HAND, Row, figures, name_and_unit, paper_figures

OURS = "smekf"
TARGETS = {"upper body, realistic": 18.0, "upper body, MTi-3 noise alone": 12.0}  # [mm], at most
WATERFALL = "where the millimetres come from"
ANYWHERE = "sensors strapped on anywhere"
WANTED = {  # of amekf there, from and to
    "lengths_rms_mm": (0.0, 8.0),
    "headings_rms_deg": (0.0, 2.0),
    "hand": (0.0, 18.0),
    "errors_by_std_rms": (0.7, 1.5),
}
FULL, EMPTY = "all on", "nothing on"  # the waterfall's ends
MORE = " as stated"  # ends the name of what is known in the waterfall and is not here: it adds
TILT = {"roll", "pitch", "inclination rmse"}
HEADING = {"yaw", "heading rmse", "drift_deg_min"}
ERRORS = {*DEGREES, *HAND.values(), "drift_deg_min"}  # figures of which less is better
JUDGED = ERRORS - {"mean angle"}  # it says what the total says
FROM = {"hand": "from the root", "from shoulders": "from the middle of the shoulders"}

_SIGNS = {"deg": "°", "mm": " mm", "deg/min": "°/min"}


class Target(NamedTuple):
    """What the hand's error must not exceed, and what it is."""

    experiment: str
    counted: str  # from where
    limit: float  # [mm]
    value: float  # [mm]

    @property
    def met(self) -> bool:
        return self.value <= self.limit


class Part(NamedTuple):
    """What one imperfection adds to the hand's error: all on less this one off, as root of the mean squares [mm].

    Below zero: the error grows without it.
    """

    name: str
    added: dict[str, float]  # "hand", "from shoulders"


class Waterfall(NamedTuple):
    """Root-mean-square errors of the hand [mm] with all imperfections and with none, and what each adds."""

    full: dict[str, float]
    empty: dict[str, float]
    parts: list[Part]  # the largest first
    more: list[Part]  # what is not in it, and what that would add


def targets(rows: Sequence[Row]) -> list[Target]:
    """smekf's hand errors against their limits, as far as they were measured."""
    return [
        Target(row.experiment, FROM[name], TARGETS[row.experiment], row.figures[name])
        for row in rows
        if row.experiment in TARGETS and row.method == OURS
        for name in FROM
        if name in row.figures
    ]


def anywhere_lines(rows: Sequence[Row]) -> list[str]:
    """What was wanted of sensors strapped on anywhere, and what it is, for amekf."""
    said = []
    for row in rows:
        if row.experiment == ANYWHERE and row.method == "amekf":
            for name, (least, most) in WANTED.items():
                if name in row.figures:
                    value, (text, unit) = row.figures[name], name_and_unit(name)
                    limits = f"at most {most:g}" if least == 0.0 else f"{least:g} to {most:g}"
                    met = "met" if least <= value <= most else "missed"
                    said.append(f"{_plain(name) if name in HAND.values() else text}: {value:.2f} {unit}".rstrip())
                    said[-1] += f", {limits} wanted: {met}."
    return said


def target_line(target: Target) -> str:
    """One sentence on a target."""
    value, limit = f"{target.value:.1f}", f"{target.limit:g}"
    if float(value) == target.limit and not target.met:  # 18.04 is not "18.0 mm, missed"
        value = f"{target.value:.2f}"
    return (
        f"{target.experiment}, {target.counted}: {value} mm, at most {limit} mm wanted: "
        f"{'met' if target.met else 'missed'}."
    )


class Order(NamedTuple):
    """One figure of the paper's three filters."""

    name: str
    paper: list[str]  # the filters, the best first
    values: dict[str, float]  # ours, as shown

    @property
    def comes_back(self) -> bool:
        return all(self.values[a] <= self.values[b] for a, b in pairwise(self.paper))


class Gain(NamedTuple):
    """Where another filter has a smaller error than smekf."""

    name: str
    method: str
    value: float
    trials: int
    won: int
    sure: bool  # the mean difference over the trials is above two of its standard errors, or there is but one trial


def orders(rows: Sequence[Row]) -> list[Order]:
    """The figures of one experiment of whose order over the three filters the paper says something."""
    found = []
    by_method = {row.method: row for row in rows}
    for name in rows[0].names() if rows else []:
        methods = _paper_order(rows, name)
        if len(methods) > 1 and all(name in by_method[method].figures for method in methods):
            values = {method: round(by_method[method].figures[name], 2) for method in methods}
            found.append(Order(name, methods, values))
    return found


def order(rows: Sequence[Row]) -> list[str]:
    """Where the paper's order of the three filters comes back in one experiment's `rows`, and where not."""
    came_back: dict[str, list[str]] = {}
    others = []
    for found in orders(rows):
        paper = " before ".join(found.paper)
        if found.comes_back:
            came_back.setdefault(paper, []).append(_said(found.name))
            continue
        ours = sorted(found.paper, key=lambda method: found.values[method])
        listed = ", ".join(f"{method} {_value(found.name, found.values[method])}" for method in ours)
        text = f"{_capital(_said(found.name))} the paper's order, {paper}, does not come back: {listed}"
        others.append(f"{text}; {ours[0]} is first in both." if ours[0] == found.paper[0] else f"{text}.")
    return [
        f"The paper's order of the filters, {paper}, comes back {_and(names)}." for paper, names in came_back.items()
    ] + others


def worse_figures(rows: Sequence[Row]) -> list[tuple[str, str, float, float]] | None:
    """Filter, figure ("roll", "roll std"), ours and the paper's, where ours is worse; None: there is no such figure.

    A filter's second row ("ncf as it comes") is not compared.
    """
    listed, compared = [], False
    for row in rows:
        if row.method not in PAPER_HAND:
            continue
        for name, paper in paper_figures(row.experiment, row.method).items():
            for key, theirs in zip((name, f"{name} std"), paper, strict=True):
                value = round(row.figures.get(key, np.nan), 2)
                compared |= key in row.figures
                if value > theirs:
                    listed.append((row.method, key, value, theirs))
    return listed if compared else None


def worse(rows: Sequence[Row]) -> list[str]:
    """Where our figures are worse than the paper's: one sentence, or that none is; nothing where the paper has none."""
    found = worse_figures(rows)
    if not found:
        return [] if found is None else ["No figure is worse than the paper's."]
    listed = []
    for method, key, value, theirs in found:
        name = key.removesuffix(" std")
        over = "" if name == key else ", deviation over time,"
        listed.append(f"{method} {_plain(name)}{over} {_value(name, value)} against {_value(name, theirs)}")
    return [f"Worse than the paper: {'; '.join(listed)}."]


def gains(rows: Sequence[Row], results: Sequence[Result]) -> list[Gain] | None:
    """Where other filters have a smaller error than smekf in one experiment; None: nothing can be compared."""
    by_method = {row.method: row for row in rows}
    if OURS not in by_method or len(by_method) < 2 or not set(by_method[OURS].names()) & JUDGED:
        return None
    ours = by_method[OURS].figures
    found = []
    for name in (name for name in by_method[OURS].names() if name in JUDGED):
        for method, row in by_method.items():
            if name not in row.figures or round(row.figures[name], 2) >= round(ours[name], 2):
                continue
            less = _less(results, rows[0].experiment, method, name)
            scatter = 2.0 * float(np.std(less, ddof=1)) / len(less) ** 0.5 if len(less) > 1 else 0.0
            sure = bool(np.mean(less) > scatter)
            found.append(Gain(name, method, row.figures[name], len(less), int(np.sum(less > 0.0)), sure))
    return found


def beaten(
    rows: Sequence[Row], results: Sequence[Result], gains_set: Mapping[str, Mapping[str, Any]] | None = None
) -> list[str]:
    """Where another filter does better than smekf, in how many trials, and why that is so.

    `gains_set`: setting → "ncf", "gdc" → gains by name, as `Document.gains`.
    """
    found = gains(rows, results)
    if not found:
        return [] if found is None else [f"No other filter has a smaller error than {OURS} here."]
    ours = next(row.figures for row in rows if row.method == OURS)
    sentences = []
    for name, sure in dict.fromkeys((gain.name, gain.sure) for gain in sorted(found, key=lambda gain: not gain.sure)):
        listed = ", ".join(
            f"{gain.method} {_value(name, gain.value)}"
            + (f" (in {gain.won} of {gain.trials} trials)" if gain.trials > 1 else "")
            for gain in found
            if (gain.name, gain.sure) == (name, sure)
        )
        within = "" if sure else ", but within the scatter between the trials"
        sentences.append(f"Better than {OURS} {_said(name)} ({_value(name, ours[name])}){within}: {listed}.")
    experiment = rows[0].experiment
    certain = [gain for gain in found if gain.sure]
    tuned = (gains_set or {}).get(setting_of(experiment), {})
    without = [method for method, of in tuned.items() if not any(of.values())]
    sentences += _why(experiment, {g.name for g in certain if not (g.name in TILT and g.method in without)})
    sentences += [
        f"The grid search left {method} no correction here, its gain is 0: from the measured start it integrates the "
        "gyroscope alone. What it wins is won by its start and its bias, not by correcting."
        for method in without
        if any(gain.method == method for gain in certain)
    ]
    return sentences


def at_a_glance(rows: Sequence[Row], results: Sequence[Result]) -> list[str] | None:
    """One experiment beside the paper and beside other filters, in a few cells; None: nothing can be compared.

    The figures in which the paper's order comes back, those in which not, what is worse than the paper's, and the
    filters that are surely better than smekf.
    """
    order_found, worse_found, gains_found = orders(rows), worse_figures(rows), gains(rows, results)
    if not order_found and worse_found is None and gains_found is None:
        return None

    def listed(names: Sequence[str]) -> str:
        return ", ".join(_short(name) for name in dict.fromkeys(names)) or "none"

    back = listed([found.name for found in order_found if found.comes_back]) if order_found else ""
    not_so = listed([found.name for found in order_found if not found.comes_back]) if order_found else ""
    by_method: dict[str, list[str]] = {}
    spread: set[tuple[str, str]] = set()
    for method, key, _, _ in worse_found or []:
        name = key.removesuffix(" std")
        if name != key and name not in by_method.get(method, []):
            spread.add((method, name))
        by_method.setdefault(method, []).append(name)
    worse_text = "; ".join(
        f"{method}: "
        + ", ".join(_short(name) + " (± only)" * ((method, name) in spread) for name in dict.fromkeys(names))
        for method, names in by_method.items()
    )
    better: dict[str, list[str]] = {}
    for gain in gains_found or []:
        if gain.sure:
            better.setdefault(gain.method, []).append(gain.name)
    same: dict[str, list[str]] = {}
    for method, names in better.items():
        same.setdefault(listed(names), []).append(method)
    better_text = "; ".join(f"{', '.join(methods)}: {names}" for names, methods in same.items())
    return [
        back,
        not_so,
        "" if worse_found is None else worse_text or "none",
        "" if gains_found is None else better_text or "none",
    ]


def setting_of(experiment: str) -> str:
    """Which gains of NCF and GDC an experiment was run with: a key of `gains.STATED`."""
    if experiment.startswith("dynamic"):
        return experiment.replace("dynamic", "simulated")
    if experiment == "drift":
        return "simulated 1 kHz"
    if experiment.startswith("upper body"):
        return ", ".join(experiment.split(", ")[:2])
    return "BROAD"


def _why(experiment: str, names: Collection[str]) -> list[str]:
    reasons = []
    if set(names) & TILT and experiment == "drift":
        reasons.append(
            "Why: this is scored at rest after the motion. What differs is how soon and how closely each filter "
            "follows the accelerometer's vertical, whose bias no filter sees."
        )
    elif set(names) & TILT:
        reasons.append(
            f"Why: {OURS} corrects its tilt only while the sensor rests. Over motion without rest it integrates the "
            "gyroscope, and what is left of bias, scale error and noise adds up until the next rest. The others "
            "correct at every sample; on long motion that pays if their gains are set fairly."
        )
    if set(names) & HEADING:
        reasons.append(
            "Of the heading: gravity does not show it to any filter. What differs is the gyroscope bias that each goes "
            "on with, and how far its corrections of the tilt turn the heading as well."
        )
    if set(names) & set(HAND.values()):
        reasons.append(
            f"Why: with the hands joined the arms move for a minute without rest, where {OURS} corrects nothing. Its "
            "calibration carries what the gyroscopes add up in that time; the others correct at every sample."
        )
    return reasons


def _less(results: Sequence[Result], experiment: str, method: str, name: str) -> np.ndarray:
    """Of each trial that both have: how much less than smekf's the error of `method` is."""
    ours, theirs = (_by_trial(results, experiment, label) for label in (OURS, method))
    both = [trial for trial in ours if name in ours[trial] and name in theirs.get(trial, {})]
    return np.array([ours[trial][name] - theirs[trial][name] for trial in both])


def waterfall(results: Sequence[Result]) -> Waterfall | None:
    """What each imperfection adds to the hand's error; None without a run that has all of them on."""
    rms: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(result.method for result in results if result.experiment == WATERFALL):
        of = [r.figures for r in results if r.experiment == WATERFALL and r.method == method]
        rms[method] = {
            name: float(np.sqrt(np.mean([figure[key]["rmse"] ** 2 for figure in of])))
            for key, name in HAND.items()
            if all(isinstance(figure.get(key), dict) and figure[key].get("rmse") is not None for figure in of)
        }
    if not rms.get(FULL):
        return None
    parts, more = [], []
    for method, without in rms.items():
        if method in (FULL, EMPTY) or not without:
            continue
        added = {name: rms[FULL][name] ** 2 - without[name] ** 2 for name in without if name in rms[FULL]}
        if method.endswith(MORE):
            more.append(Part(method, {name: -_root(square) for name, square in added.items()}))
        else:
            parts.append(Part(_part(method), {name: _root(square) for name, square in added.items()}))
    parts.sort(key=lambda part: -next(iter(part.added.values()), 0.0))
    return Waterfall(rms[FULL], rms.get(EMPTY, {}), parts, more)


def _root(square: float) -> float:
    return float(np.copysign(np.sqrt(abs(square)), square))


def waterfall_lines(found: Waterfall) -> list[str]:
    """The waterfall in sentences."""
    sentences = []
    for name, whole in found.full.items():
        parts = [(part.name, part.added[name]) for part in found.parts if name in part.added]
        if not parts:
            continue
        largest = sorted(parts, key=lambda part: -part[1])[:3]
        listed = ", ".join(f"{added:.1f} mm ({label})" for label, added in largest if added >= 0.05)
        less = [label for label, added in parts if added <= -0.05]
        rest = f" With none on {found.empty[name]:.1f} mm are left." if name in found.empty else ""
        text = f"{_capital(FROM[name])}: {whole:.1f} mm (root mean square) with all on. "
        text += f"The largest parts: {listed}." if listed else "None of the parts makes it smaller by being off."
        text += f" The error grows without: {', '.join(less)}." if less else ""
        text += "".join(f" {_capital(p.name)} would add {p.added[name]:.1f} mm." for p in found.more if name in p.added)
        sentences.append(text + rest)
    return sentences


def _by_trial(results: Sequence[Result], experiment: str, method: str) -> dict[str, dict[str, float]]:
    return {r.trial: figures(r) for r in results if r.experiment == experiment and r.method == method}


def _paper_order(rows: Sequence[Row], name: str) -> list[str]:
    """The paper's filters among `rows`, the best first; empty where the paper says nothing of `name`."""
    present = [row.method for row in rows if row.method in PAPER_HAND]
    experiment = rows[0].experiment
    if experiment == "drift":
        return [method for method in reversed(PAPER_DRIFT) if method in present] if name in HEADING else []
    of = {method: paper_figures(experiment, method) for method in present}
    return sorted((m for m in present if name in of[m]), key=lambda method: of[method][name][0])


def _part(method: str) -> str:
    """What is switched off: "soft tissue off", "lengths known" → "soft tissue", "lengths"."""
    name = method.removesuffix(" off").removesuffix(" known").removesuffix(" exact")
    return {"orientations": "orientation filter", "clocks exact, none lost": "clocks, lost samples"}.get(name, name)


def _short(name: str) -> str:
    return {"hand": "root", "from shoulders": "shoulders"}.get(name, name_and_unit(name)[0].removesuffix(" rmse"))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _value(name: str, value: float) -> str:
    unit = name_and_unit(name)[1]
    return f"{value:.2f}{_SIGNS.get(unit, f' {unit}' if unit else '')}"


def _plain(name: str) -> str:
    return {"hand": "hand from the root", "from shoulders": "hand from the shoulders"}.get(name, name_and_unit(name)[0])


def _said(name: str) -> str:
    return FROM.get(name) or f"in {name_and_unit(name)[0]}"


def _and(names: Sequence[str]) -> str:
    if len(names) > 1 and all(name.startswith("in ") for name in names):
        names = [names[0], *(name.removeprefix("in ") for name in names[1:])]
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]
