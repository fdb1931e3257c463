"""What the user sees: lines, diagnostics, tables, a progress bar; without the control characters a file may hold."""

import contextlib
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..diagnostics import Diagnostic, lines
from ..errors import printable
from . import check_stopped

WIDTH = 98  # columns of running text
TABLE_WIDTH = 160  # rich would cut numbers off to fit a narrow terminal, which wraps by itself


class Outcome(NamedTuple):
    """What came of a command whose exit code says how good it is."""

    result: Any
    exit_code: int


def say(text: str) -> None:
    """A line on standard output."""
    print(_shown(text))


def say_paragraph(text: str, indent: str = "") -> None:
    """Running text, as reports have it, on standard output."""
    say(textwrap.fill(text.replace("**", ""), WIDTH, initial_indent=indent, subsequent_indent=indent * 2))


def print_diagnostics(diagnostics: Iterable[Diagnostic]) -> None:
    """A line each on standard error, the gravest first."""
    for severity, line in lines(diagnostics):
        print(f"{severity}: {_shown(line)}", file=sys.stderr)


def say_pages(folder: Path) -> None:
    """What each page of a result is and where it lies."""
    for title, name in (("Report", "report.html"), ("Page", "angles.html"), ("Motion", "view.html")):
        if (folder / name).is_file():
            say(f"{title}:  {folder / name}")


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table, as reports have it, unless it is empty; the first column is text, the others numbers."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    rows = list(rows)
    if not rows:
        return
    table = Table(box=box.SIMPLE_HEAD)
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="right" if k else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(escape(_shown(cell.replace("**", ""))) for cell in row))
    console = Console(width=TABLE_WIDTH)
    if title:
        console.print(escape(_shown(title)), style="bold", highlight=False)
    console.print(table)


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A bar that shows the current step and the share of the work that is done; none when not on a terminal.

    A signal ends the command.
    """
    if not sys.stderr.isatty():
        yield lambda _text, _fraction: check_stopped()
        check_stopped()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def show(text: str, fraction: float) -> None:
            check_stopped()
            bar.update(task, description=text, completed=fraction)

        yield show
        check_stopped()


def _shown(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))
