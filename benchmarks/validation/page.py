"""docs/validation.md: the template's text with a table of each experiment, the paper's own figures beside ours."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from .contenders import DEFAULT, OURS

TEMPLATE = Path(__file__).with_name("validation.md.j2")
# Lisini Baldi 2019: roll, pitch, yaw [deg] as mean ± std by rate; right hand [mm].
PAPER_DYNAMIC = {
    ("ncf", "100 Hz"): ((2.23, 2.25), (2.70, 2.90), (2.42, 2.62)),
    ("gdc", "100 Hz"): ((1.38, 1.37), (2.28, 2.43), (2.11, 2.24)),
    ("smekf", "100 Hz"): ((1.10, 1.30), (1.46, 1.71), (1.35, 1.62)),
    ("ncf", "1 kHz"): ((1.89, 1.41), (1.93, 2.09), (2.05, 2.03)),
    ("gdc", "1 kHz"): ((0.96, 0.81), (1.48, 1.43), (1.57, 1.50)),
    ("smekf", "1 kHz"): ((0.71, 0.79), (0.73, 0.75), (0.86, 0.82)),
}
PAPER_DRIFT = {"ncf": "drifts in yaw", "gdc": "little in yaw", "smekf": "negligible"}  # in its words
PAPER_HAND = {"ncf": (17.71, 10.75), "gdc": (17.96, 10.82), "smekf": (12.05, 6.20)}
AXES = ("roll [deg]", "pitch [deg]", "yaw [deg]")
HAND = ("hand from shoulders [mm]", "hand from root [mm]")  # the paper does not state the origin
# Of the table at the beginning: experiment, figure.
IN_SHORT = (
    *((f"dynamic {rate}", axis) for rate in ("100 Hz", "1 kHz") for axis in AXES),
    ("drift", "drift [deg/min]"),
    *((f"upper body, {preset}", HAND[0]) for preset in ("ideal", "mild", "people")),
    ("arbitrary sensor mounting, people", HAND[0]),
    *((name, "total [deg]") for name in ("BROAD", "the authors' trial", "RING, rigid mounts", "UR5")),
)

Content = Mapping[str, Mapping[str, Any]]  # experiment → "trials", "rows", "skipped", "versions"


def find_paper_figures(experiment: str, method: str) -> dict[str, tuple[float, float]]:
    """Find the paper's figures: name → mean and deviation; all rows of a filter have the same."""
    filter_ = method.partition(", ")[0].removesuffix("_published")
    if experiment.startswith("dynamic "):
        figures = PAPER_DYNAMIC.get((filter_, experiment.removeprefix("dynamic ")), ())
        return dict(zip(AXES, figures, strict=False))
    if experiment.startswith("upper body") and filter_ in PAPER_HAND:
        return dict.fromkeys(HAND, PAPER_HAND[filter_])
    return {}


def format_paper(experiment: str, method: str) -> str:
    """Format the paper's figures; empty: it has none."""
    if experiment == "drift":
        return PAPER_DRIFT.get(method.partition(", ")[0].removesuffix("_published"), "")
    values = find_paper_figures(experiment, method).values()
    return ", ".join(dict.fromkeys(f"{mean:.2f}±{std:.2f}" for mean, std in values))


def render_page(content: Content) -> str:
    """Render the page; a section whose experiments were not run is left out."""

    def table(figures: Sequence[str], *experiments: str, trials: bool = True) -> str:
        """A table: a row a method, a column a figure of each experiment, and the paper's own; below it the trials."""
        own = [name for name in experiments if name in content]
        methods = dict.fromkeys(method for name in own for method in content[name]["rows"])
        pairs = [(name, figure) for name in own for figure in figures]
        header = ["", *(_name_column(name, figure, len(own) > 1, len(figures) > 1) for name, figure in pairs)]
        papers = [format_paper(own[0], method) if figures[0] in (*AXES, *HAND) else "" for method in methods]
        header += ["the paper"] * any(papers)
        rows = []
        for method, paper in zip(methods, papers, strict=True):
            cells = [_format(content[name]["rows"].get(method, {}).get(figure)) for name, figure in pairs]
            rows.append([method, *cells, *([paper] if any(papers) else [])])
        return "\n".join([_format_table(header, rows), "", *(_describe_trials(content, own) if trials else ())])

    def in_short() -> str:
        rows = []
        for name, figure in IN_SHORT:
            if name in content:
                own = content[name]["rows"]
                best = min(own, key=lambda method: own[method][figure][0] or 0.0)
                paper = find_paper_figures(name, OURS).get(figure)
                means = [_format(own[method][figure], alone=True) for method in (OURS, DEFAULT, best)]
                rows.append([f"{name}: {figure}", f"{paper[0]:.2f}" if paper else "", *means[:2], f"{means[2]} {best}"])
        return _format_table(["mean error", "the paper's smekf", OURS, DEFAULT, "best"], rows)

    def has(*experiments: str) -> bool:
        return any(name in content for name in experiments)

    environment = Environment(undefined=StrictUndefined, lstrip_blocks=True, autoescape=False)
    versions = dict.fromkeys(
        ", ".join(f"{package} {version}" for package, version in experiment["versions"].items())
        for experiment in content.values()
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    text = template.render(table=table, in_short=in_short, has=has, versions=list(versions))
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def _name_column(experiment: str, figure: str, several: bool, figures: bool) -> str:
    short = experiment.removeprefix("upper body, ").removeprefix("arbitrary sensor mounting, ")
    short = short.removeprefix("error budget, ").removeprefix("RING, ").removeprefix("link lengths, ")
    return f"{short}: {figure}" if several and figures else short if several else figure


def _describe_trials(content: Content, experiments: Sequence[str]) -> list[str]:
    trials = {name: content[name]["trials"] for name in experiments}
    counts = set(trials.values())
    text = ", ".join(f"{name}: {count}" for name, count in trials.items()) + " trials"
    if len(counts) == 1:
        text = "1 trial" if counts == {1} else f"{counts.pop()} trials"
    skipped = [f"{n}, {trial}: {why}" for n in experiments for trial, why in content[n]["skipped"].items()]
    return [f"{text}." + "".join(f" Without a result: {line}." for line in skipped)]


def _format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def _format(value: Sequence[float | None] | None, alone: bool = False) -> str:
    """Mean ± over time (between the trials)."""
    mean, std, between = value or (None, None, None)
    if mean is None:
        return ""
    text = f"{mean:.2f}" if not 0.0 < abs(mean) < 0.01 else f"{mean:.2g}"
    if alone:
        return text
    return text + (f"±{std:.2f}" if std is not None else "") + (f" ({between:.2f})" if between is not None else "")
