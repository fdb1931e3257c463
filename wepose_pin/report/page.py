"""Pages: one Jinja2 template, filled section by section; each page is one HTML file that opens offline and prints."""

from __future__ import annotations

import base64
import contextlib
import json
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup, escape

from ..diagnostics import INFO, WARNING, Diagnostic, as_json, lines
from ..documents import whole_file
from ..errors import WeposeError, reason
from . import words

if TYPE_CHECKING:
    from .figures import ReportFigure

PACKAGE = Path(__file__).parent.parent  # templates are named by their path below it
MOST_FIGURES = 5  # of a page; tables have the rest


class Banner(NamedTuple):
    """What a reader must see first; `kind`: "pass", "poor", "fail" or "info"."""

    kind: str
    text: str
    entries: Sequence[tuple[str, str]] = ()  # severity and text
    macro: str = "banner"


class Table(NamedTuple):
    """A table; a cell may hold `code` and **bold**."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    macro: str = "table"

    @property
    def wordy(self) -> bool:
        """Whether cells are sentences: those are set to the left, and may break their lines."""
        return any(len(cell) > 40 for row in self.rows for cell in row)


class Facts(NamedTuple):
    """Names and values."""

    rows: Sequence[tuple[str, str]]
    macro: str = "facts"


class Frame(NamedTuple):
    """A view of a motion in the page, for screens only; `more` follows the caption."""

    page: str
    more: str = ""
    macro: str = "frame"


class _Picture(NamedTuple):
    """A figure as the address of an image, which no style of the page touches."""

    caption: str
    address: str
    macro: str = "picture"


Item: TypeAlias = "str | Banner | Table | Facts | Frame | ReportFigure"  # a text is a paragraph


class Page:
    """A page whose sections are made one by one: one that fails leaves a line in its place and takes nothing along.

    Parameters
    ----------
    title : the heading
    failures : takes a line for each section that cannot be made
    """

    def __init__(self, title: str, failures: list[str] | None = None) -> None:
        self._title = title
        self._failures = failures if failures is not None else []
        self._sections: list[tuple[str, list[object]]] = []

    def add(self, title: str, make: Callable[[], Iterable[Item] | None], heading: bool = True) -> None:
        """Append the items that `make` gives, in order; nothing where it gives None or none.

        Parameters
        ----------
        title : of the section
        heading : whether the page shows the title, and has it in its menu
        """
        try:
            items = [_prepare(item) for item in make() or ()]
        except Exception as error:
            failure = f"the section '{title}' cannot be made: {reason(error)}"
            self._failures.append(failure)
            text = f"**{words.capital(failure)}.** The rest of the page is complete."
            items, heading = [Banner("poor", text)], False
        if items:
            self._sections.append((title if heading else "", items))

    def html(self) -> str:
        """Return the whole page; the same sections give the same text."""
        scripts = any(isinstance(item, Frame) for _, items in self._sections for item in items)
        template = load_template("report/templates/page.html.j2")
        return template.render(title=self._title, sections=self._sections, scripts=scripts)


def _prepare(item: Item) -> object:
    from .figures import ReportFigure

    if not isinstance(item, ReportFigure):
        return item
    address = base64.b64encode(item.svg().encode()).decode("ascii")
    return _Picture(item.caption, f"data:image/svg+xml;base64,{address}")


def show_diagnostics(diagnostics: Sequence[Diagnostic], reliable: str, *, unusable: bool = False) -> Banner:
    """Return the banner of a page's diagnostics.

    Parameters
    ----------
    reliable : what it says where there are none
    unusable : whether it warns even without a diagnostic that does
    """
    entries = lines(diagnostics, titled=True)
    if unusable or any(diagnostic.severity != INFO for diagnostic in diagnostics):
        return Banner("poor", "**Read this first,** before you use the numbers below", entries)
    return Banner("info", "What to know", entries) if entries else Banner("pass", reliable)


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
        trim_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters |= {"inline": inline, "slug": words.slug}
    environment.globals["file"] = lambda name: Markup((PACKAGE / name).read_text(encoding="utf-8"))
    environment.globals["versions"] = words.versions
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
            facts = {"variant": "diagnostics", "reason": reason(error)}
            self.diagnostics.append(Diagnostic("output-incomplete", WARNING, file, facts=facts))


def page_incomplete(name: str, failure: str) -> Diagnostic:
    """A page, or a section of it, that cannot be made: why."""
    return Diagnostic("output-incomplete", WARNING, name, facts={"reason": failure})
