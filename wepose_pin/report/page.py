"""Pages: one Jinja2 template, filled section by section; each page is one HTML file that opens offline and prints."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from ..diagnostics import INFO, WARNING, Diagnostic, lines
from ..errors import reason
from ..writers.result import versions
from .words import Table

if TYPE_CHECKING:  # matplotlib loads only where a figure is drawn
    from .figures import ReportFigure

PACKAGE = Path(__file__).parent.parent  # templates are named by their path below it
MOST_FIGURES = 5  # of a page; tables have the rest


class Banner(NamedTuple):
    """What a reader must see first; `kind`: "pass", "poor", "fail" or "info"."""

    kind: str
    text: str
    entries: Sequence[tuple[str, str]] = ()  # severity and text


class Frame(NamedTuple):
    """A view of a motion in the page, for screens only."""

    page: str


Item: TypeAlias = "str | Banner | Table | Frame | ReportFigure"  # a text is a paragraph


def render_page(title: str, lead: Sequence[Item], sections: Mapping[str, Sequence[Item]]) -> str:
    """The whole page: `lead`, then heading → items, without those that have none; the same items give the same text."""
    shown = {heading: items for heading, items in {"": lead, **sections}.items() if items}
    scripts = any(isinstance(item, Frame) for items in shown.values() for item in items)
    return load_template("report/templates/page.html.j2").render(title=title, sections=shown, scripts=scripts)


def show_diagnostics(diagnostics: Sequence[Diagnostic], reliable: str, *, unusable: bool = False) -> Banner:
    """The banner of a page's diagnostics; `reliable` is what it says where there are none.

    `unusable`: it warns even without a diagnostic that does.
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
        autoescape=True,
        undefined=StrictUndefined,
        lstrip_blocks=True,
        trim_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters |= {
        "inline": inline,
        "kind": lambda item: type(item).__name__,
        "slug": lambda text: re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-"),
    }
    environment.globals["file"] = lambda name: Markup((PACKAGE / name).read_text(encoding="utf-8"))
    environment.globals["versions"] = lambda: ", ".join(f"{name} {number}" for name, number in versions().items())
    return environment


def inline(text: str) -> Markup:
    """`code` and **bold** of a text as HTML; all else in it is text."""
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text)))
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", marked))


def write_pages(folder: Path, pages: Mapping[str, Callable[[], str] | None]) -> list[Diagnostic]:
    """Write pages into the new folder of a result; return a diagnostic for each that cannot be made.

    `pages`: file name → what makes its text; None: it is not made.
    """
    diagnostics = []
    for name, make in pages.items():
        if make is None:
            continue
        try:
            (folder / name).write_text(make(), encoding="utf-8")
        except Exception as error:  # the result is complete without its pages
            (folder / name).unlink(missing_ok=True)
            facts = {"reason": f"cannot be made: {reason(error)}"}
            diagnostics.append(Diagnostic("output-incomplete", WARNING, name, facts=facts))
    return diagnostics
