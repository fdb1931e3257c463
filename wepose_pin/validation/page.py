"""The pages of a validation run: one HTML file that opens offline, and Markdown with its figures beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..page import Block, Bullets, Heading, Picture, Table
from ..page import as_html as one_file
from ..page import markdown as as_markdown
from .document import Document
from .figures import pictures
from .findings import (
    ERRORS,
    OURS,
    TARGETS,
    WATERFALL,
    anywhere_lines,
    at_a_glance,
    beaten,
    order,
    target_line,
    targets,
    waterfall,
    waterfall_lines,
    worse,
)
from .tables import SHORT, SPLIT, Row, name_and_unit, paper_figures, summary
from .words import method_text, noise_text, words, world_text

TITLE = "How wrong the estimates are"
FOLDER = "validation"  # of the Markdown page's figures
GAINS = {"gain", "integral"}  # of the grid search: small numbers, three digits


def write_pages(folder: Path, document: Document) -> list[str]:
    """``validation.md`` with its figures in ``validation/``, and ``validation.html``.

    Returns
    -------
    list[str]
        A line for each figure that could not be drawn.
    """
    failures: list[str] = []
    blocks = page(document, failures)
    (folder / FOLDER).mkdir()
    for picture in (block for block in blocks if isinstance(block, Picture)):
        (folder / FOLDER / f"{picture.stem}.png").write_bytes(picture.png)
    (folder / "validation.md").write_text(markdown(blocks), encoding="utf-8")
    (folder / "validation.html").write_text(as_html(blocks), encoding="utf-8")
    return failures


def page(document: Document, failures: list[str] | None = None) -> list[Block]:
    """The page's content; every figure in it comes from the document. `failures` as of `figures.pictures`."""
    rows = summary(document.results)
    experiments = list(dict.fromkeys(row.experiment for row in rows))
    drawn: dict[str, list[Picture]] = {}
    for experiment, picture in pictures(document, failures):
        drawn.setdefault(experiment, []).append(picture)
    blocks: list[Block] = [Heading(TITLE, 1), *_head(document, experiments), *_in_short(document, rows)]
    if document.skipped:
        blocks += ["**Not scored, and in no figure below:**", Bullets([each.line() for each in document.skipped])]
    blocks += [Heading("How to read it"), *_reading(document, rows)]
    for experiment in experiments:
        of = [row for row in rows if row.experiment == experiment]
        trials = len({result.trial for result in document.results if result.experiment == experiment})
        blocks += [Heading(experiment[:1].upper() + experiment[1:])]
        blocks += _described(experiment, trials, document)
        blocks += [block for block in (experiment_table(of, True), table_note(of)) if block]
        said = [*order(of), *worse(of), *beaten(of, document.results, document.gains)]
        found = waterfall(document.results) if experiment == WATERFALL else None
        said += waterfall_lines(found) if found else []
        said += [target_line(target) for target in targets(of)] + anywhere_lines(of)
        blocks += [Bullets(said)] if said else []
        blocks += drawn.get(experiment, [])
    return blocks


def experiment_table(rows: Sequence[Row], whole: bool) -> Table:
    """An experiment's rows as text; `whole`: with the deviation between trials and all columns, the best in bold."""
    names = list(dict.fromkeys(name for row in rows for name in row.names()))
    if not whole:
        names = [name for name in names if name not in SHORT.values()]
    units = {name: name_and_unit(name) for name in names}
    experiment = rows[0].experiment
    papers = [paper_figures(experiment, row.method) for row in rows]
    compared = [name for name in names if any(name in paper for paper in papers)] if whole else []
    if len({str(paper.get(name)) for paper in papers[:1] for name in compared}) < len(compared):
        compared = []  # one figure for all columns
    best = {
        name: min(round(row.figures[name], 2) for row in rows if name in row.figures)
        for name in names
        if whole and len(rows) > 1 and name in ERRORS and experiment != WATERFALL
    }
    shared = {unit for _, unit in units.values()}
    header = ["on or off" if experiment == WATERFALL else "filter"]
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


def how_many(experiment: str, trials: int) -> str:
    """How many trials an experiment has, in words."""
    what = "kind of motion" if experiment == "gains" else "trial"
    return f"{trials} {what if trials == 1 else what.replace('kind', 'kinds') if ' ' in what else what + 's'}"


def unit_of(rows: Sequence[Row]) -> str:
    """The unit that all columns of a short table share; empty where they differ."""
    names = dict.fromkeys(name for row in rows for name in row.names() if name not in SHORT.values())
    units = {name_and_unit(name)[1] for name in names}
    return units.pop() if len(units) == 1 else ""


def table_note(rows: Sequence[Row]) -> str:
    """What the signs of the table mean."""
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
            "nees: normalised squared error of the hand, right are 3; in 1σ, in 2σ: share of the hand's errors within "
            "one and two stated standard deviations, right are 0.68 and 0.95"
        )
    if any(key in ERRORS for key in keys) and len(rows) > 1 and rows[0].experiment != WATERFALL:
        notes.append("bold: the smallest of a column")
    text = "; ".join(notes)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _cell(row: Row, name: str, whole: bool) -> str:
    if name not in row.figures:
        return ""
    text = f"{row.figures[name]:.3g}" if name in GAINS else f"{row.figures[name]:.2f}"
    text += f" ± {row.figures[f'{name} std']:.2f}" if f"{name} std" in row.figures else ""
    return text + (f" ({row.figures[f'{name} between']:.2f})" if whole and f"{name} between" in row.figures else "")


def _head(document: Document, experiments: Sequence[str]) -> list[Block]:
    recorded = any(words(name) and not world_text(name, document.worlds) for name in experiments)
    command = "wepose validate" + " --quick" * document.quick + " --data DIR" * recorded + " -o OUT"
    versions = ", ".join(f"{name} {number}" for name, number in document.versions.items())
    blocks: list[Block] = []
    if document.quick:
        blocks.append(
            "**A quick run: one or two trials of each experiment. These are not the figures to judge by; the full run "
            "is the same command without `--quick`.**"
        )
    return [
        *blocks,
        "What this software claims, measured: the experiments of Lisini Baldi et al., IEEE Sensors Journal 2019 "
        "([10.1109/JSEN.2019.2940612](https://doi.org/10.1109/JSEN.2019.2940612)), with simulated sensors and people, "
        "and real recordings with a truth. Where our figures are worse than the paper's, or another filter has a "
        f"smaller error than {OURS}, the paper's filter, it is said below.",
        f"Written by `wepose validate --from validation.json -o DIR` from what `{command}` measured; nothing in it is "
        "typed by hand. Seeds are fixed: the same versions give the same figures. "
        f"Made with {versions or 'versions that it does not state'}.",
    ]


def _in_short(document: Document, rows: Sequence[Row]) -> list[Block]:
    blocks: list[Block] = []
    found = targets(rows)
    if found:
        counted = list(dict.fromkeys(target.counted for target in found))
        lines = []
        for experiment in dict.fromkeys(target.experiment for target in found):
            of = {target.counted: target for target in found if target.experiment == experiment}
            said = [f"{of[c].value:.1f} mm, **{'met' if of[c].met else 'missed'}**" if c in of else "" for c in counted]
            lines.append([experiment, f"{TARGETS[experiment]:g} mm", *said])
        blocks += [
            "Targets: the mean error of the right hand, smekf.",
            Table(["experiment", "at most", *counted], lines),
        ]
    lines = []
    for experiment in dict.fromkeys(row.experiment for row in rows):
        cells = at_a_glance([row for row in rows if row.experiment == experiment], document.results)
        if cells is not None:
            lines.append([experiment, *cells])
    if lines:
        header = ["experiment", "the paper's order of filters is back in", "not in", "worse than the paper"]
        blocks += [
            "Beside the paper, and beside other filters (without differences within the scatter between the trials):",
            Table([*header, f"better than {OURS}"], lines),
        ]
    return [Heading("In short"), *blocks] if blocks else []


def _reading(document: Document, rows: Sequence[Row]) -> list[Block]:
    methods = list(dict.fromkeys(row.method for row in rows if row.experiment != WATERFALL))
    known = [(method, method_text(method, methods, document.gains)) for method in methods]
    blocks: list[Block] = [
        "The bias of the still phase is removed for every filter but for those as they come, and the tilt measured "
        "there is the start. The heading is aligned once, on a stretch that is not scored, and never fitted to the "
        "truth afterwards.",
        "A simulated figure that is better than the paper's does not say that this software is better than the "
        "paper's: the simulation lacks what the paper's sensors, people and Vicon added. It says what the method can "
        "do with the imperfections that were on.",
        *([noise_text(document.noise)] if document.noise else []),
    ]
    described = [f"`{method}`: {text}." for method, text in known if text]
    return [*blocks, Bullets(described)] if described else blocks


def _described(experiment: str, trials: int, document: Document) -> list[Block]:
    count = how_many(experiment, trials) + (" (quick run)" if document.quick else "")
    text = words(experiment)
    if text is None:
        return [f"{count}."]
    return [
        text.what.strip(),
        *world_text(experiment, document.worlds),
        Bullets([f"Stands beside: {text.beside.strip()}", f"Scored: {text.scored} {count[:1].upper()}{count[1:]}."]),
    ]


def markdown(blocks: Sequence[Block]) -> str:
    """The page as Markdown, its figures in a folder beside it."""
    return as_markdown(blocks, FOLDER)


def as_html(blocks: Sequence[Block]) -> str:
    """The page as one HTML file with its figures in it."""
    return one_file(blocks, f"wepose validate: {TITLE}")
