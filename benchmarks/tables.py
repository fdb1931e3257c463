"""Tables of measured figures, and cases timed in turn."""

from __future__ import annotations

import gc
import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

Section = Callable[[], "Table"]


class Column(NamedTuple):
    """One figure of each row."""

    key: str
    header: str
    digits: int = 1


@dataclass
class Table:
    """What a section gives; a row's first cell is its name, its others lie under the columns' keys."""

    title: str
    columns: tuple[Column, ...]
    rows: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class Timing(NamedTuple):
    """Of one of several cases timed in turn."""

    median: float  # [s]
    ratio: float  # median over rounds of its time to the reference's; NaN without one


def time_in_turn(
    cases: Mapping[str, Callable[[], Any]], rounds: int, reference: str, clock: Callable[[], float] = time.thread_time
) -> dict[str, Timing]:
    """Each case timed once a round, after one unmeasured round.

    The thread's processor time by default: what else the machine does counts less.
    """
    times: dict[str, list[float]] = {name: [] for name in cases}
    enabled = gc.isenabled()
    gc.disable()
    try:
        for round_ in range(rounds + 1):
            for name, run in cases.items():
                begin = clock()
                run()
                if round_:
                    times[name].append(clock() - begin)
    finally:
        if enabled:
            gc.enable()
    reference_times = np.array(times.get(reference, [np.nan] * rounds))
    return {
        name: Timing(float(np.median(values)), float(np.median(np.array(values) / reference_times)))
        for name, values in times.items()
    }


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def is_installed(peer: str) -> bool:
    """Whether a peer is installed."""
    return importlib.util.find_spec(peer) is not None


def print_table(table: Table) -> None:
    """Print a table with its notes; what is NaN or missing is left empty."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as RichTable

    shown = RichTable(box=box.SIMPLE_HEAD)
    shown.add_column("", no_wrap=True)
    for column in table.columns:
        shown.add_column(escape(column.header), justify="right", no_wrap=True)
    for name, row in table.rows.items():
        values = [(row.get(column.key, np.nan), column.digits) for column in table.columns]
        shown.add_row(escape(name), *("" if np.isnan(value) else f"{value:.{digits}f}" for value, digits in values))
    console = Console(width=160)
    console.print(escape(table.title), style="bold", highlight=False)
    console.print(shown)
    print("\n".join([*table.notes, ""]))
