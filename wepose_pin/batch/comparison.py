"""Comparison of two results: tables by their numbers, records by their values, other files by their bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..readers.tables import read_table
from .storage import DONE_FILE

_PAGES = (".html", ".png")  # follow from the tables beside them
_IGNORED_KEYS = ("provenance", "versions", "session", "solve_ms")  # where, by what and how fast a record was made
_MAX_LINES = 5  # of a file


def find_differences(before: Path, after: Path) -> list[str]:
    """A line for each file that is missing, new or different. Empty: the results are equal."""
    if not before.is_dir():
        return [] if before.read_bytes() == after.read_bytes() else _compare_files(before, after, before.name)
    names = {
        folder: {path.relative_to(folder).as_posix() for path in _list_files(folder)} for folder in (before, after)
    }
    lines = [f"{name}: is not made any more" for name in sorted(names[before] - names[after])]
    lines += [f"{name}: is missing, or new" for name in sorted(names[after] - names[before])]
    for name in sorted(names[before] & names[after]):
        lines += _compare_files(before / name, after / name, name)
    return lines


def _list_files(folder: Path) -> Iterator[Path]:
    """Files that are compared: neither pages nor provenance nor hidden files."""
    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        ignored = path.suffix in _PAGES or path.name.endswith(("provenance.json", DONE_FILE))
        if path.is_file() and not hidden and not ignored:
            yield path


def _compare_files(before: Path, after: Path, name: str) -> list[str]:
    if before.read_bytes() == after.read_bytes():
        return []
    if before.suffix == ".parquet":
        lines = _compare_tables(read_table(before), read_table(after))
    elif before.suffix == ".json":
        old, new = (json.loads(path.read_text(encoding="utf-8")) for path in (before, after))
        lines = list(_compare_values(old, new, ""))
    else:
        texts = [path.read_text(encoding="utf-8", errors="replace").splitlines() for path in (before, after)]
        pairs = enumerate(zip(*texts, strict=False), 1)
        lines = [f"differs from line {next((k for k, (a, b) in pairs if a != b), min(map(len, texts)) + 1)} on"]
    more = [f"and {len(lines) - _MAX_LINES} more"] if len(lines) > _MAX_LINES else []
    return [f"{name}: {line}" for line in lines[:_MAX_LINES] + more]


def _compare_tables(before: pl.DataFrame, after: pl.DataFrame) -> list[str]:
    """Exact comparison; NaN equals NaN."""
    if before.equals(after) and before.schema == after.schema:
        return []
    if before.height != after.height:
        return [f"{before.height} rows before, {after.height} now"]
    lines = [f"column {column} is not made any more" for column in before.columns if column not in after.columns]
    lines += [f"column {column} is new" for column in after.columns if column not in before.columns]
    for column in [column for column in before.columns if column in after.columns]:
        a, b = before[column], after[column]
        if a.dtype != b.dtype:
            lines.append(f"column {column} was {a.dtype}, is {b.dtype}")
        elif not a.equals(b, null_equal=True):
            size = f", by {np.nanmax(np.abs(a.to_numpy() - b.to_numpy())):.3g} at most" if a.dtype.is_float() else ""
            lines.append(f"column {column} differs in {int(a.ne_missing(b).sum())} of {before.height} rows{size}")
    return lines or ["columns stand in another order"]


def _compare_values(before: Any, after: Any, place: str) -> Iterator[str]:
    """A line for each key at which two records differ."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*before, *after]):
            path = f"{place}.{key}" if place else key
            if key in _IGNORED_KEYS and not place:
                continue
            if key not in before or key not in after:
                yield f"{path} is {'not there any more' if key in before else 'new'}"
            else:
                yield from _compare_values(before[key], after[key], path)
    elif before != after and not (before != before and after != after):
        yield f"{place} was {_shorten(before)}, is {_shorten(after)}"


def _shorten(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"
