"""Pages: Jinja2 templates filled section by section; each page is one HTML file that opens offline and prints."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup, escape

from ..diagnostics import WARNING, Diagnostic, as_json
from ..documents import whole_file
from ..errors import WeposeError, reason
from . import words
from .chart import Picture, resolve_style

PACKAGE = Path(__file__).parent.parent  # templates are named by their path below it


class Table(NamedTuple):
    """A table; a cell may hold `code` and **bold**."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def wordy(self) -> bool:
        """Whether cells are sentences: those are set to the left, and may break their lines."""
        return any(len(cell) > 40 for row in self.rows for cell in row)


class Section(NamedTuple):
    """A part of a page, made; `title` is empty where it has no heading."""

    title: str
    html: str


class Page:
    """A page whose sections are made one by one: one that fails leaves a line in its place and takes nothing along.

    Parameters
    ----------
    template : holds a macro for each section
    title : the heading
    failures : takes a line for each section that cannot be made
    """

    def __init__(self, template: str, title: str, failures: list[str] | None = None) -> None:
        self._macros = load_template(template).module
        self._title = title
        self._failures = failures if failures is not None else []
        self._sections: list[Section] = []

    def add(self, macro: str, make: Callable[[], Mapping[str, Any] | None], title: str = "", name: str = "") -> None:
        """Append what a macro of the template makes of the values that `make` gives; nothing where it gives None.

        Parameters
        ----------
        title : the section's heading; without one the section stands in the menu of the page under none
        name : of the section in a failure, where it has no title
        """
        try:
            values = make()
            if values is not None:
                self._sections.append(Section(title, getattr(self._macros, macro)(**values)))
        except Exception as error:
            failure = f"the section '{title or name}' cannot be made: {reason(error)}"
            self._failures.append(failure)
            parts: Any = load_template("report/templates/parts.html.j2").module
            self._sections.append(Section("", parts.failure(words.capital(failure))))

    def html(self, window_title: str) -> str:
        """The whole page; the same sections give the same text."""
        scripts = any("<iframe" in section.html for section in self._sections)
        page = load_template("report/templates/page.html.j2")
        return page.render(title=self._title, window_title=window_title, sections=self._sections, scripts=scripts)


def render_standalone(picture: Picture) -> str:
    """The text of an SVG file of a chart, for any program that draws SVG."""
    chart: Any = load_template("report/templates/chart.svg.j2").module
    return resolve_style(str(chart.svg(picture, standalone=True)).strip()) + "\n"


def load_template(name: str) -> Template:
    """A template by its path below the package."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(PACKAGE),
        autoescape=select_autoescape(disabled_extensions=("md.j2",), default=True),
        undefined=StrictUndefined,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters |= {
        "inline": inline,
        "slug": words.slug,
        "plain": words.plain,
        "listed": words.listed,
        "capital": words.capital,
    }
    environment.globals["file"] = lambda name: Markup((PACKAGE / name).read_text(encoding="utf-8"))
    return environment


def inline(text: str) -> Markup:
    """`code` and **bold** of a text as HTML; all else in it is text."""
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text)))
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", marked))


class PageWriter:
    """Writes the pages of a result folder after its results have landed there, each whole or not at all.

    Pages of an earlier run under these names go first: they would show another motion.

    Parameters
    ----------
    folder : holds the result
    names : of all pages to come

    Attributes
    ----------
    diagnostics : pages, and sections of pages, that cannot be made
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.diagnostics: list[Diagnostic] = []
        self._folder = folder
        for name in names:
            with contextlib.suppress(OSError):
                (folder / name).unlink()

    def write(self, name: str, make: Callable[[list[str]], str]) -> str | None:
        """Write a page and give its text, None where it fails; `make` is given a list for what of it fails alone."""
        failures: list[str] = []
        text = None
        try:
            made = make(failures)
            with whole_file(self._folder / name, force=True) as partial:
                partial.write_text(made, encoding="utf-8")
            text = made
        except Exception as error:
            failures.append(f"cannot be made: {reason(error)}")
        self.diagnostics += [page_incomplete(name, failure) for failure in failures]
        return text

    def save_diagnostics(self, file: str) -> None:
        """Add them to the ``diagnostics`` of a JSON file of the result, if there are any."""
        if not self.diagnostics:
            return
        path = self._folder / file
        content = json.loads(path.read_text(encoding="utf-8"))
        content["diagnostics"] = [*content.get("diagnostics", []), *map(as_json, self.diagnostics)]
        try:
            with whole_file(path, force=True) as partial:
                partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        except (OSError, WeposeError) as error:  # a full disk, say: what is there stays as it was
            facts = {"reason": reason(error)}
            self.diagnostics.append(Diagnostic("diagnostics-not-saved", WARNING, file, facts=facts))


def page_incomplete(name: str, failure: str) -> Diagnostic:
    """A page, or a section of it, that cannot be made: why."""
    return Diagnostic("page-incomplete", WARNING, name, facts={"reason": failure})
