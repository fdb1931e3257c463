"""Tables of numbers: CSV and Parquet into polars, and their columns into float arrays.

A CSV has its columns separated by commas, semicolons or tabs; beside the last two decimals may have commas. Lines
before the names, a line of units after them, and names in two lines are read too: `read_layout` finds them.
"""

from __future__ import annotations

import contextlib
import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..errors import BadData, MissingFile, UnknownColumn, one_of
from .libraries import library_errors

FORMATS = (".csv", ".tsv", ".txt", ".parquet")
NO_VALUE = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None"]
# Characters of a line without values.
EMPTY = b",; \t\r\n"
# The names of a CSV stand within its first lines, or bytes.
MOST_PREAMBLE, PREAMBLE_BYTES = 100, 1 << 20
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?nan", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_UNITS = re.compile(
    r"[\[(]?(s|ms|[uµμ]s|ns|sec(onds?)?|m/\(?s(\^2|²|/s|\^2\))\)?|m/s\*\*2|m?g|deg(rees)?|rad|(deg|rad|°|dps)(/s(ec)?)?|"
    r"[unµμ]?T|gauss|°c|degrees celsius|k?pa|hz|m?v|%|n/?a|no_units|local_flux|-|1)[\])]?",
    re.IGNORECASE,
)


def read_table(path: Path) -> pl.DataFrame:
    """Read the table in a file of `FORMATS`, all but ``.parquet`` as a CSV, whose lines with ``#`` are comments.

    Raises
    ------
    MissingFile
        The file is missing, a folder, or of another format.
    BadData
        The file is damaged, or has rows of different lengths.
    """
    _check_table(path)
    if _is_parquet(path):
        with library_errors(path, "a Parquet file"):
            return pl.read_parquet(open_source(path))
    layout = read_layout(path)
    if layout.is_plain:
        table = _parse_csv(path, layout)
    else:
        with path.open("rb") as file:
            for _ in range(layout.head_lines):
                file.readline()
            table = _parse_csv(path, layout, layout.head + file.read())
    return table.head(table.height - _count_empty_end(path)) if table.height else table


def read_columns(table: pl.DataFrame, names: Sequence[str], file: str, place: str) -> np.ndarray:
    """Read columns of numbers as a C-contiguous float array (n, len(names)); empty cells are NaN.

    `file` and `place` (such as ``sensors.torso.gyro``) begin the error's text.

    Raises
    ------
    UnknownColumn
        A name is not in the table.
    BadData
        A column has other values than numbers, or its name occurs twice in the file.
    """
    numbers = [_read_numbers(table, name, file, place) for name in names]
    return np.ascontiguousarray(pl.DataFrame(numbers).to_numpy().reshape(table.height, len(names)))


def _make_column_error(name: str, names: list[str], file: str, place: str) -> UnknownColumn:
    return UnknownColumn(f"{place}: no column '{name}' in {Path(file).name}; {one_of(names, name)}")


def _read_numbers(table: pl.DataFrame, name: str, file: str, place: str) -> pl.Series:
    if name not in table.columns:
        raise _make_column_error(name, table.columns, file, place)
    if f"{name}_duplicated_0" in table.columns:
        raise BadData(f"{file}: column '{name}' stands there more than once; each column needs a name of its own")
    series = table[name]
    if series.dtype == pl.String:
        stripped = series.str.strip_chars()
        series = stripped.cast(pl.Float64, strict=False)
        bad = series.is_null() & stripped.is_not_null() & ~stripped.is_in(NO_VALUE)
        if bad.any():
            row = int(bad.arg_max() or 0)
            text = stripped[row]
            numeric = text.replace(",", ".", 1).replace("-", "").replace(".", "", 1).isdigit()
            right = f"write decimals with a point: {text.replace(',', '.', 1)}" if numeric else "it must be a number"
            raise BadData(f"{file}: column '{name}' holds text in row {row + 1}: '{text[:40]}'; {right}")
    elif not series.dtype.is_numeric() and series.dtype != pl.Null:
        content = "true and false" if series.dtype == pl.Boolean else f"values of type {series.dtype}"
        raise BadData(f"{file}: column '{name}' holds {content}; it must hold numbers")
    numbers = series.cast(pl.Float64)
    if numbers.is_infinite().any():
        row = int(numbers.is_infinite().arg_max() or 0)
        raise BadData(f"{file}: column '{name}' holds inf in row {row + 1}; it must be a number")
    return numbers.fill_null(float("nan")).rename(name)


def read_names(path: Path) -> tuple[list[str], dict[str, str]]:
    """Read the names of the columns of a table, and column → its unit, where a line of a CSV has them.

    Raises
    ------
    MissingFile, BadData
        As `read_table`.
    """
    _check_table(path)
    if _is_parquet(path):
        with library_errors(path, "a Parquet file"):
            return list(pl.read_parquet_schema(open_source(path))), {}
    layout = read_layout(path)
    return list(layout.names), dict(zip(layout.names, layout.units, strict=False))


# Checks of files ---------------------------------------------------------------------------------------------------


def open_source(path: Path) -> Path | bytes:
    """Return the file as a path, or its contents where the path is not UTF-8, which polars cannot open."""
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        return path.read_bytes()
    return path


def _is_parquet(path: Path) -> bool:
    return path.suffix.lower() == ".parquet"


def _check_table(path: Path) -> None:
    if path.is_dir():
        raise MissingFile(f"{path}: is a folder; a table is wanted here, {', '.join(FORMATS)}")
    if path.suffix.lower() not in FORMATS:
        raise MissingFile(f"{path}: '{path.suffix}' is not a known format; {one_of(FORMATS)}")
    if not path.is_file():
        beside = [p.name for p in path.parent.iterdir() if p.suffix.lower() in FORMATS] if path.parent.is_dir() else []
        raise MissingFile(f"{path}: no such file; {one_of(sorted(beside), path.name)}")


@dataclass(frozen=True)
class CsvLayout:
    """How a CSV is written.

    Parameters
    ----------
    names : of the columns
    separator : of the columns
    decimal_comma : decimals have a comma
    head_lines : lines up to the first row of values
    units : of the columns, where a line of them follows the names; empty: there is none
    is_plain : commas, points, and nothing but comments before one line of names
    """

    names: tuple[str, ...]
    separator: str
    decimal_comma: bool
    head_lines: int
    units: tuple[str, ...] = ()
    is_plain: bool = True

    @property
    def head(self) -> bytes:
        """The line of names as polars reads it before any rows."""
        cells = ('"' + name.replace('"', '""') + '"' for name in self.names)
        return (self.separator.join(cells) + "\n").encode()


def read_layout(path: Path) -> CsvLayout:
    """Find the separator, the decimal sign and the line of names of a CSV.

    The names are in the first line that is no comment. Where the first row of numbers has another number of cells,
    they are in the line right above that row, or above a line of units.

    Raises
    ------
    MissingFile, BadData
        The file is not readable; empty; not text.
    """
    try:
        with path.open("rb") as file:
            start = file.read(PREAMBLE_BYTES)
            raw = start.split(b"\n")[: -1 if file.read(1) else None] or [start]
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error
    lines = [(k, line) for k, line in enumerate(raw) if line.strip() and not line.startswith(b"#")][:MOST_PREAMBLE]
    if not lines:
        raise BadData(f"{path}: is empty; a line with the names of the columns and then numbers are needed")
    if b"\0" in lines[0][1]:
        raise BadData(f"{path}: is not a CSV in UTF-8: there are zero bytes in its first line; save it as UTF-8")
    try:
        text, unicode = [(k, line.decode("utf-8-sig").rstrip("\r\n")) for k, line in lines], True
    except UnicodeDecodeError:  # as spreadsheets of Windows write it
        text, unicode = [(k, line.decode("cp1252", errors="replace").rstrip("\r\n")) for k, line in lines], False
    stated = re.fullmatch(r'"?sep=(.|\\t)"?[;,\t]*', text[0][1])  # a hint for spreadsheets
    text = text[1:] if stated and len(text) > 1 else text
    separator = stated[1].replace("\\t", "\t") if stated else _find_separator([line for _, line in text])
    try:
        rows = [(k, next(csv.reader([line], delimiter=separator), [])) for k, line in text]
    except csv.Error as error:
        raise BadData(f"{path}: its line of names cannot be read: {error}; save it as CSV in UTF-8") from error
    names_at, units = _find_names([cells for _, cells in rows])
    names = _join_names([cells for _, cells in rows[slice(*names_at)]])
    first = rows[names_at[1]][0] + 1 if units else rows[names_at[1] - 1][0] + 1
    cells = [cell.strip() for _, row in rows[names_at[1] :] for cell in row]
    comma = separator != "," and any(_DECIMAL_COMMA.fullmatch(cell) for cell in cells)
    plain = separator == "," and unicode and not stated and names_at == (0, 1) and not units
    plain = plain and all(line.strip() for line in raw[:first])
    return CsvLayout(tuple(names), separator, comma, first, tuple(units), plain)


def _find_separator(lines: Sequence[str]) -> str:
    """Find the separator: semicolons or tabs where most lines have them, else commas."""
    return next((sign for sign in ";\t" if 2 * sum(sign in line for line in lines) > len(lines)), ",")


def _find_names(rows: Sequence[Sequence[str]]) -> tuple[tuple[int, int], list[str]]:
    """Find the lines of names, from and to, and the cells of the line of units after them."""
    numeric = next((k for k, cells in enumerate(rows) if k and _is_numeric(cells)), None)
    if numeric is None:
        return (0, 1), []
    width = len(rows[numeric])
    units = list(rows[numeric - 1]) if numeric > 1 and _is_units(rows[numeric - 1], width) else []
    last = numeric - 1 if units else numeric
    first = last - 1
    if first and len(rows[first]) == width == len(rows[first - 1]) and _repeats(rows[first]):
        first -= 1  # names in two lines: sensors above, their axes below
    if first and not units and first + 1 == last and len(rows[0]) == width <= 2 * sum(map(bool, rows[0])):
        return (0, 1), []  # text in the first rows
    return (first, last), units


def _repeats(cells: Sequence[str]) -> bool:
    """Whether names occur more than once: a line above says of which sensor they are."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    return len(set(filled)) < len(filled)


def _is_numeric(cells: Sequence[str]) -> bool:
    filled = [cell.strip() for cell in cells if cell.strip()]
    return len(filled) > 1 and 2 * sum(_NUMBER.fullmatch(cell) is not None for cell in filled) > len(filled)


def _is_units(cells: Sequence[str], width: int) -> bool:
    filled = [cell.strip() for cell in cells if cell.strip()]
    return len(cells) == width and bool(filled) and 2 * sum(map(bool, map(_UNITS.fullmatch, filled))) >= len(filled)


def _join_names(lines: Sequence[Sequence[str]]) -> list[str]:
    """Join the names of two lines, the upper one of which may name a sensor in the first of its columns alone."""
    if len(lines) == 1:
        return list(lines[0])
    upper, owners = "", []
    for cell in lines[0]:
        upper = cell.strip() or upper
        owners.append(upper)
    return [f"{owner} {name.strip()}".strip() for owner, name in zip(owners, lines[1], strict=True)]


def _parse_csv(path: Path, layout: CsvLayout, content: bytes = b"") -> pl.DataFrame:
    """Parse a CSV, or `content` of it that begins with the line of names."""
    source: Path | bytes = content or open_source(path)
    options: dict[str, Any] = {
        "null_values": NO_VALUE,
        "comment_prefix": "#",
        "separator": layout.separator,
        "decimal_comma": layout.decimal_comma,
        "encoding": "utf8" if layout.is_plain else "utf8-lossy",
    }
    names = layout.names
    numbers: dict[str, Any] = dict.fromkeys(names, pl.Float64)
    table = None
    if len(numbers) == len(names):
        # Most tables have numbers alone. Others are read below.
        with contextlib.suppress(pl.exceptions.PolarsError):
            table = pl.read_csv(source, schema=numbers, **options)
    try:
        if table is None:
            # Types are inferred from the whole file, so that an error can name text in any row.
            table = pl.read_csv(source, infer_schema_length=None, **options)
    except (pl.exceptions.PolarsError, OSError) as error:
        if "more fields" in str(error):
            _find_ragged(path, layout, content)
        if "utf-8" in str(error):
            raise BadData(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from error
        with library_errors(path, "a table"):
            raise
    if len(numbers) == table.width:
        table.columns = list(names)  # polars reads quotes within names in its own way
    # polars fills short rows silently.
    if table.width > 1 and table[table.columns[-1]].null_count():
        _find_ragged(path, layout, content)
    return table


def _count_empty_end(path: Path) -> int:
    """Count the lines without values at the end of a CSV, which editors and spreadsheets leave."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 2**16))
        lines = file.read().splitlines()
    return len(lines) - next((k for k in range(len(lines), 0, -1) if lines[k - 1].strip(EMPTY)), 0)


def _find_ragged(path: Path, layout: CsvLayout, content: bytes) -> None:
    """Raise an error on the first row of a CSV with other fields than its names; empty lines have no values."""
    width = len(layout.names)
    with io.BytesIO(content) if content else path.open("rb") as lines:
        text = io.TextIOWrapper(lines, encoding="utf-8-sig", errors="replace", newline="")
        rows = csv.reader((line for line in text if not line.startswith("#")), delimiter=layout.separator)
        for k, fields in enumerate(rows):
            if fields and len(fields) != width:
                raise BadData(f"{path}: row {k} has {len(fields)} fields, the line of names has {width}; mend the row")
