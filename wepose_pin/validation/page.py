"""The pages of a validation run: Markdown with its charts in a folder, and one HTML file for offline use."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from ..report.chart import Picture
from ..report.page import Page, load_template
from .document import Document
from .figures import draw_pictures
from .tables import (
    compare_with_paper,
    describe_known,
    describe_table,
    make_experiment_table,
    make_gains_table,
    make_imperfections_table,
    make_noise_table,
    make_overview_table,
    make_targets_table,
    summarize,
)

TEMPLATE = "validation/templates/validation.md.j2"
TITLE = "How wrong the estimates are"
FOLDER = "validation"  # of the Markdown page's charts


def write_pages(folder: Path, document: Document) -> list[str]:
    """Write ``validation.md`` with its charts in ``validation/``, and ``validation.html``.

    Returns
    -------
    list[str]
        A line for each chart that could not be drawn.
    """
    failures: list[str] = []
    drawn = list(draw_pictures(document, failures))
    (folder / FOLDER).mkdir()
    chart: Any = load_template("report/templates/chart.svg.j2").module
    for _, picture in drawn:
        svg = chart.svg(picture, standalone=True)
        (folder / FOLDER / f"{picture.stem}.svg").write_text(svg.strip() + "\n", encoding="utf-8")
    text = render_markdown(document, drawn)
    (folder / "validation.md").write_text(text, encoding="utf-8")
    (folder / "validation.html").write_text(render_html(text, drawn, failures), encoding="utf-8")
    return failures


def render_markdown(document: Document, drawn: list[tuple[str, Picture]]) -> str:
    """Render the page as Markdown: the template's text with the document's tables and charts."""
    rows = summarize(document.results)
    experiments, shortened = {}, []
    for name in dict.fromkeys(row.experiment for row in rows):
        own_rows = [row for row in rows if row.experiment == name]
        trials = len({result.trial for result in document.results if result.experiment == name})
        planned = max(document.planned.get(name, 0), trials)
        if trials < planned:
            shortened.append(f"{name} {trials} of {planned}")
        experiments[name] = {
            "trials": trials,
            "planned": planned,
            "known": describe_known(name, document.presets),
            "table": make_experiment_table(own_rows, True),
            "note": describe_table(own_rows),
            "pictures": [picture for experiment, picture in drawn if experiment == name],
        }
    shortened += [f"{name} 0 of {number}" for name, number in document.planned.items() if name not in experiments]
    text = load_template(TEMPLATE).render(
        title=TITLE,
        folder=FOLDER,
        document=document,
        experiments=experiments,
        shortened=shortened,
        targets=make_targets_table(rows),
        overview=make_overview_table(rows),
        beside_paper=compare_with_paper(rows),
        noise=make_noise_table(document.noise),
        imperfections=make_imperfections_table(document.presets),
        gains=make_gains_table(document.gains),
    )
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def render_html(text: str, drawn: list[tuple[str, Picture]], failures: list[str] | None = None) -> str:
    """Render the page as one HTML file with its charts; `text` is the result of `render_markdown`."""
    chart: Any = load_template("report/templates/chart.svg.j2").module
    svgs = {f"{FOLDER}/{picture.stem}.svg": chart.svg(picture) for _, picture in drawn}
    rules = MarkdownIt("commonmark", {"html": False}).enable("table")
    rules.add_render_rule("image", lambda _, tokens, at, *__: svgs[tokens[at].attrs["src"]])
    rules.add_render_rule("table_open", lambda *_: '<div class="wide"><table>')
    rules.add_render_rule("table_close", lambda *_: "</table></div>")
    head, *sections = re.split(r"^## (.*)$", text.removeprefix(f"# {TITLE}"), flags=re.MULTILINE)
    page = Page("validation/templates/section.html.j2", TITLE, failures)
    page.add("section", lambda: {"html": Markup(rules.render(head))}, name="the beginning")
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        page.add("section", lambda body=body: {"html": Markup(rules.render(body))}, title)  # type: ignore[misc]
    return page.html(f"wepose validate: {TITLE}")
