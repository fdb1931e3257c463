"""What the user sees: lines, diagnostics, tables, a progress bar; without the control characters a file may hold."""

from __future__ import annotations

import contextlib
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..diagnostics import Diagnostic, lines
from ..errors import printable
from .stopping import check_stopped

if TYPE_CHECKING:
    from ..body.subject import Subject
    from ..evaluation import PositionError

WIDTH = 98  # columns of running text
TABLE_WIDTH = 160  # rich would cut numbers off to fit a narrow terminal, which wraps by itself


def say(text: str) -> None:
    """A line on standard output."""
    print(_shown(text))


def say_indented(text: str) -> None:
    """A paragraph, two columns in."""
    say(textwrap.fill(text, WIDTH, initial_indent="  ", subsequent_indent="    "))


def print_diagnostics(diagnostics: Iterable[Diagnostic]) -> None:
    """A line each on standard error, the gravest first."""
    for severity, line in lines(diagnostics):
        print(f"{severity}: {_shown(line)}", file=sys.stderr)


def say_pages(folder: Path, pages: Mapping[str, str]) -> None:
    """What each page is and where it lies; nothing of those that could not be made."""
    for title, name in pages.items():
        if (folder / name).is_file():
            say(f"{title}:  {folder / name}")


def print_lengths(
    title: str,
    subject: Subject,
    prior: Subject,
    measured: Collection[str],
    truth: Mapping[str, float] | None = None,
    prior_name: str = "population prior",
) -> None:
    """Each length with its standard deviation beside the prior's, and the truth where it is known."""
    rows = []
    for name, value in subject.lengths.items():
        true = [] if truth is None else [f"{1e3 * truth[name]:.1f}"]
        before = f"{1e3 * prior.lengths[name]:.1f} ± {1e3 * prior.std(name):.1f}"
        cells = f"{1e3 * value:.1f}", f"± {1e3 * subject.std(name):.1f}", before
        rows.append((name, *true, *cells, "measured" if name in measured else ""))
    columns = [] if truth is None else ["true"]
    print_table(title, ("length [mm]", *columns, "estimated", "std", prior_name, ""), rows)


def mean_std(error: PositionError) -> str:
    """``mean ± std`` [mm]."""
    return f"{error.mean:.1f} ± {error.std:.1f}"


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table; the first column is text, the others numbers."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="left" if k == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(_shown, row))
    console = Console(width=TABLE_WIDTH)
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
