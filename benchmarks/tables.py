"""Tables of measured figures, and cases timed in turn."""

from __future__ import annotations

import contextlib
import gc
import importlib.metadata
import importlib.util
import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wepose_pin.errors import BadData

Section = Callable[[], "Table"]


class Column(NamedTuple):
    """One figure of each row."""

    key: str
    header: str
    digits: int = 1
    compared: bool = False  # a ratio, fit to be compared with another run's


@dataclass
class Table:
    """What a section gives; a row's first cell is its name, its others lie under the columns' keys."""

    title: str
    columns: tuple[Column, ...]
    rows: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def known_rows(self) -> dict[str, dict[str, float]]:
        """The rows without figures that are NaN."""
        return {name: {key: value for key, value in row.items() if value == value} for name, row in self.rows.items()}


class Timing(NamedTuple):
    """Of one of several cases timed in turn."""

    median: float  # [s]
    spread: float  # [s] between the quartiles
    ratio: float  # median over rounds of its time to the reference's; NaN without one


def time_in_turn(
    cases: Mapping[str, Callable[[], Any]],
    rounds: int,
    reference: str,
    clock: Callable[[], float] = time.thread_time,
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
    timings = {}
    for name, values in times.items():
        low, middle, high = np.percentile(values, [25, 50, 75])
        ratio = float(np.median(np.array(values) / reference_times))
        timings[name] = Timing(float(middle), float(high - low), ratio)
    return timings


def is_installed(peer: str) -> bool:
    """Whether a peer is installed."""
    return importlib.util.find_spec(peer) is not None


# Files -------------------------------------------------------------------------------------------------------------


def document(tables: Mapping[str, Table], quick: bool) -> dict[str, Any]:
    """What ``--save`` writes: figures with where, when and with which packages they were measured."""
    versions = {"python": platform.python_version()}
    for name in ("wepose-pin", "pin", "casadi", "numpy", "scipy", "numba", "polars", "dask", "vqf", "imufusion"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {"processor": _processor(), "system": platform.platform(), "processors": os.cpu_count()},
        "versions": versions,
        "quick": quick,
        "sections": {name: asdict(table) | {"rows": table.known_rows()} for name, table in tables.items()},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def read_document(path: Path) -> dict[str, Any]:
    """What an earlier ``--save`` wrote.

    Raises
    ------
    BadData
        Not there, or not such a file.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        found["sections"].items()
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise BadData(f"--compare {path}: is no file that --save wrote: {error!r}") from None
    return dict(found)


def ratio_before(before: Mapping[str, Any], section: str, name: str, key: str) -> float:
    """A ratio of an earlier run; NaN where it has none."""
    row = before["sections"].get(section, {}).get("rows", {}).get(name, {})
    return float(row.get(key, float("nan")))


# Terminal ----------------------------------------------------------------------------------------------------------


def print_table(section: str, table: Table, before: Mapping[str, Any] | None) -> None:
    """A table with its notes; with `before`, an earlier document, each ratio's change beside it."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as RichTable

    shown = RichTable(box=box.SIMPLE_HEAD)
    shown.add_column("", no_wrap=True)
    for column in table.columns:
        shown.add_column(escape(column.header), justify="right", no_wrap=True)
        if before is not None and column.compared:
            shown.add_column("before/now", justify="right", no_wrap=True)
    for name, row in table.rows.items():
        cells = [escape(name)]
        for column in table.columns:
            value = row.get(column.key, float("nan"))
            cells.append(f"{value:.{column.digits}f}" if value == value else "")
            if before is not None and column.compared:
                change = ratio_before(before, section, name, column.key) / value if value else float("nan")
                cells.append(f"{change:.2f}" if change == change else "")
        shown.add_row(*cells)
    console = Console(width=160)
    console.print(escape(table.title), style="bold", highlight=False)
    console.print(shown)
    print("\n".join([*table.notes, ""]))
