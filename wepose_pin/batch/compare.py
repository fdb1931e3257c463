"""Whether two results are the same: tables by their numbers, records by their values, all else by its bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..readers.tables import read_table
from .storage import DONE

# Pages are made from the tables beside them; provenance holds where inputs lie.
_PAGES = (".html", ".png")
_APART = ("provenance", "versions", "session", "solve_ms")  # keys of records that say where, by what, and how fast
_MOST = 5  # differences told of a file


def differences(before: Path, after: Path) -> list[str]:
    """A line each: files that are missing, new, or differ, and in what. Empty: the same."""
    if not before.is_dir():
        return [] if before.read_bytes() == after.read_bytes() else _differ(before, after, before.name)
    names = {side: {path.relative_to(side).as_posix() for path in _files(side)} for side in (before, after)}
    lines = [f"{name}: is not made any more" for name in sorted(names[before] - names[after])]
    lines += [f"{name}: is missing, or new" for name in sorted(names[after] - names[before])]
    for name in sorted(names[before] & names[after]):
        lines += _differ(before / name, after / name, name)
    return lines


def _files(folder: Path) -> Iterator[Path]:
    """All that is compared; pages, provenance and what others put beside are not."""
    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if (
            path.is_file()
            and not hidden
            and path.suffix not in _PAGES
            and not path.name.endswith(("provenance.json", DONE))
        ):
            yield path


def _differ(before: Path, after: Path, name: str) -> list[str]:
    if before.read_bytes() == after.read_bytes():
        return []
    if before.suffix == ".parquet":
        return _tables(read_table(before), read_table(after), name)
    if before.suffix == ".json":
        found = list(_values(_record(before), _record(after), ""))
        return _few([f"{name}: {line}" for line in found], name)
    lines = [path.read_text(encoding="utf-8", errors="replace").splitlines() for path in (before, after)]
    first = next((k for k, (a, b) in enumerate(zip(*lines, strict=False), 1) if a != b), min(map(len, lines)) + 1)
    return [f"{name}: differs from line {first} on"]


def _tables(before: pl.DataFrame, after: pl.DataFrame, name: str) -> list[str]:
    """Exactly: NaN equals NaN, and nothing else but what it is."""
    if before.equals(after) and before.schema == after.schema:
        return []
    if before.height != after.height:
        return [f"{name}: {before.height} rows before, {after.height} now"]
    lines = [
        f"{name}: column {column} is not made any more" for column in before.columns if column not in after.columns
    ]
    lines += [f"{name}: column {column} is new" for column in after.columns if column not in before.columns]
    for column in [column for column in before.columns if column in after.columns]:
        a, b = before[column], after[column]
        rows, most = int(a.ne_missing(b).sum()), ""
        if a.dtype != b.dtype:
            lines.append(f"{name}: column {column} was {a.dtype}, is {b.dtype}")
        elif not a.equals(b, null_equal=True):
            if a.dtype.is_float():
                most = f", by {np.nanmax(np.abs(a.to_numpy() - b.to_numpy())):.3g} at most"
            lines.append(f"{name}: column {column} differs in {rows} of {before.height} rows{most}")
    return _few(lines or [f"{name}: columns stand in another order"], name)


def _record(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _values(before: Any, after: Any, place: str) -> Iterator[str]:
    """Keys at which two records differ."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in [*before, *(key for key in after if key not in before)]:
            at = f"{place}.{key}" if place else key
            if key in _APART and not place:
                continue
            if key not in before or key not in after:
                yield f"{at} is {'not there any more' if key in before else 'new'}"
            else:
                yield from _values(before[key], after[key], at)
    elif before != after and not (before != before and after != after):
        yield f"{place} was {_short(before)}, is {_short(after)}"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _few(lines: list[str], name: str) -> list[str]:
    return lines if len(lines) <= _MOST else [*lines[:_MOST], f"{name}: and {len(lines) - _MOST} more"]
