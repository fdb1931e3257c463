"""Tables of numbers: CSV and Parquet into polars, and their columns into float arrays.

A CSV has its columns separated by commas, semicolons or tabs; beside the last two decimals may have commas. Lines
before the names and a line of units after them are read too: `read_layout` finds them.
"""

import contextlib
import csv
import io
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from .errors import BadData, MissingFile, one_of
from .libraries import library_errors

FORMATS = (".csv", ".tsv", ".txt", ".parquet")
LARGEST_NUMBER = 1e30  # that is a measurement in some unit; squares of smaller numbers are finite
FIRST_BYTES = 1 << 20  # in which the first lines of a file stand
NO_VALUE = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None"]
MOST_PREAMBLE, MOST_COMMENTS = 100, 2000  # first lines of a CSV in which its names stand, and comments before them
NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?nan", re.IGNORECASE)
_UNITS = re.compile(
    r"[\[(]?(s|ms|[uµμ]s|ns|sec(onds?)?|m/\(?s(\^2|²|/s|\^2\))\)?|m/s\*\*2|m?g|deg(rees)?|rad|(deg|rad|°|dps)(/s(ec)?)?|"
    r"[unµμ]?T|gauss|°c|degrees celsius|k?pa|hz|m?v|%|n/?a|no_units|local_flux|-|1)[\])]?",
    re.IGNORECASE,
)


def read_table(path: Path) -> pl.DataFrame:
    """Read the table in a file of `FORMATS`, all but ``.parquet`` as a CSV, whose lines with ``#`` are comments.

    Raise `MissingFile` where there is no such table, `BadData` where it is damaged or has rows of different lengths.
    """
    if _is_parquet(path):
        with library_errors(path, "a Parquet file"), path.open("rb") as file:  # of a path polars takes [ for a pattern
            return pl.read_parquet(file)
    layout = read_layout(path)
    body, names = read_body(path, layout.head_lines), layout.names
    earlier = [names[:k].count(name) for k, name in enumerate(names)]
    names = [f"{name}_duplicated_{n - 1}" if n else name for n, name in zip(earlier, names, strict=True)]
    table = parse_rows(path, body, names, layout.separator)
    filled = table.select(pl.any_horizontal(pl.all().is_not_null())).to_series().arg_true()
    table = table.head(int(filled[-1]) + 1 if len(filled) else 0)  # spreadsheets leave lines without values at the end
    # polars fills short rows silently.
    if table.width > 1 and table[table.columns[-1]].null_count():
        _find_ragged(path, body, len(names), layout.separator)
    return table


def read_first_lines(path: Path, most: int = 100) -> list[str]:
    """Read the first lines of a text in UTF-8, or as Windows writes it; empty ones follow the end of the file."""
    try:
        with path.open("rb") as file:
            lines = [line.rstrip(b"\r") for line in file.read(FIRST_BYTES).split(b"\n", most)[:most]]
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error
    lines += [b""] * (most - len(lines))
    try:
        return [line.decode("utf-8-sig") for line in lines]
    except UnicodeDecodeError:
        return [line.decode("cp1252", errors="replace") for line in lines]


def read_body(path: Path, head_lines: int) -> bytes:
    """Read what follows the first lines of a file."""
    with path.open("rb") as file:
        for _ in range(head_lines):
            file.readline()
        return file.read()


def read_names(path: Path) -> tuple[list[str], dict[str, str]]:
    """Read the names of a table's columns, and the units of those that have one in a line of a CSV."""
    if _is_parquet(path):
        with library_errors(path, "a Parquet file"), path.open("rb") as file:
            return list(pl.read_parquet_schema(file)), {}
    layout = read_layout(path)
    return list(layout.names), dict(zip(layout.names, layout.units, strict=False))


def parse_rows(path: Path, body: bytes, names: Sequence[str], separator: str, *, lenient: bool = False) -> pl.DataFrame:
    """Parse the rows of a CSV: columns are numbers, or text where a cell is none; null without a value.

    Decimals may have commas where these separate no columns. `lenient`: cells beyond the names are left out, else they
    raise `BadData`, as a damaged table does.
    """

    def parse(texts: Collection[str], decimal_comma: bool = False, n_rows: int | None = None) -> pl.DataFrame:
        return pl.read_csv(
            body,
            has_header=False,
            schema={name: pl.String if name in texts else pl.Float64 for name in names},
            separator=separator,
            decimal_comma=decimal_comma,
            n_rows=n_rows,
            null_values=NO_VALUE,
            comment_prefix="#" if b"#" in body else None,  # to look for comments takes a third longer
            encoding="utf8-lossy",
            raise_if_empty=False,
            missing_columns="insert",
            truncate_ragged_lines=lenient,
        )

    point = pl.all().str.replace(r"^([-+]?\d*),(\d*)", "$1.$2") if separator != "," else pl.all()
    try:
        first = parse(names, n_rows=MOST_PREAMBLE).with_columns(point)
        numbers = first.with_columns(pl.all().str.strip_chars().cast(pl.Float64, strict=False))
        texts = [name for name in names if numbers[name].null_count() > first[name].null_count()]
        for decimal_comma in (False, True) if separator != "," else (False,):
            with contextlib.suppress(pl.exceptions.PolarsError):
                return parse(texts, decimal_comma)
        return parse(names).with_columns(point)  # an error can name the text in a later row
    except pl.exceptions.PolarsError:
        if not lenient:
            _find_ragged(path, body, len(names), separator)
        with library_errors(path, "a table"):
            raise


def _find_ragged(path: Path, body: bytes, width: int, separator: str) -> None:
    """Raise an error on the first row that has another number of fields; empty lines have no values."""
    text = io.TextIOWrapper(io.BytesIO(body), encoding="utf-8", errors="replace", newline="")
    for k, fields in enumerate(csv.reader((line for line in text if not line.startswith("#")), delimiter=separator), 1):
        if fields and len(fields) != width:
            raise BadData(f"{path}: row {k} has {len(fields)} fields, the line of names has {width}; mend the row")


def read_columns(table: pl.DataFrame, names: Sequence[str], file: str, place: str) -> np.ndarray:
    """Read columns of numbers as a C-contiguous float array (n, len(names)); empty cells are NaN.

    Raise `BadData` where a name is not in the table or occurs twice, or a column has other values than numbers; `file`
    and `place` (such as ``sensors.torso.gyro``) begin the text.
    """
    columns = []
    for name in names:
        if name not in table.columns:
            raise BadData(f"{place}: no column '{name}' in {Path(file).name}; {one_of(table.columns, name)}")
        if f"{name}_duplicated_0" in table.columns:
            raise BadData(f"{file}: column '{name}' stands there more than once; each column needs a name of its own")
        series, holds = table[name], f"{file}: column '{name}' holds"
        if series.dtype == pl.String:
            stripped = series.str.strip_chars()
            series = stripped.cast(pl.Float64, strict=False)
            bad = series.is_null() & stripped.is_not_null() & ~stripped.is_in(NO_VALUE)
            if bad.any():
                text = stripped[row := int(bad.arg_max() or 0)]
                numeric = re.fullmatch(r"-?(\d+,\d*|,\d+)", text)
                right = f"write decimals with a point: {text.replace(',', '.')}" if numeric else "it must be a number"
                raise BadData(f"{holds} text in row {row + 1}: '{text[:40]}'; {right}")
        elif not series.dtype.is_numeric() and series.dtype != pl.Null:
            raise BadData(f"{holds} values of type {series.dtype}; it must hold numbers")
        numbers = series.cast(pl.Float64)
        if (too_large := numbers.fill_nan(None).abs() > LARGEST_NUMBER).any():  # NaN would be the largest
            row = int(too_large.arg_max() or 0)
            raise BadData(f"{holds} {numbers[row]:.3g} in row {row + 1}; no device measures as much")
        columns.append(numbers.fill_null(float("nan")).rename(name))
    return np.ascontiguousarray(pl.DataFrame(columns).to_numpy().reshape(table.height, len(names)))


def read_times(table: pl.DataFrame, name: str, file: str, place: str) -> np.ndarray:
    """Read a column of times (n,) as `read_columns` does; of dates, also as texts: seconds since 1970."""
    with contextlib.suppress(pl.exceptions.PolarsError):
        times = table[name]
        if times.dtype == pl.String:
            times = times.str.strip_chars().str.to_datetime(time_unit="us", time_zone="UTC")
        if times.dtype == pl.Datetime:
            table = table.with_columns(1e-6 * times.dt.epoch("us"))
    return read_columns(table, [name], file, place)[:, 0]


def _is_parquet(path: Path) -> bool:
    """Return whether a file is Parquet, else it is a CSV; raise `MissingFile` where it is no table."""
    if path.is_dir():
        raise MissingFile(f"{path}: is a folder; a table is needed here, {', '.join(FORMATS)}")
    if not path.is_file():
        beside = [p.name for p in path.parent.iterdir() if p.suffix.lower() in FORMATS] if path.parent.is_dir() else []
        raise MissingFile(f"{path}: no such file; {one_of(sorted(beside), path.name)}")
    if path.suffix.lower() not in FORMATS:
        raise MissingFile(f"{path}: '{path.suffix}' is not a known format; {one_of(FORMATS)}")
    return path.suffix.lower() == ".parquet"


class CsvLayout(NamedTuple):
    """How a CSV is written."""

    names: list[str]  # of the columns
    units: list[str]  # of the columns, where a line of them follows the names; empty: there is none
    separator: str
    head_lines: int  # lines up to the first row of values


def read_layout(path: Path) -> CsvLayout:
    """Find the separator and the line of names of a CSV.

    The names are in the first line that is no comment. Where the first row of numbers has another number of cells,
    they are in the line right above that row, or above a line of units. Raise `BadData` where the file is empty or no
    text.
    """
    lines = enumerate(read_first_lines(path, MOST_COMMENTS))
    text = [(k, line) for k, line in lines if line.strip() and not line.startswith("#")][:MOST_PREAMBLE]
    if not text:
        raise BadData(f"{path}: is empty; a line with the names of the columns and then numbers are needed")
    if "\0" in text[0][1]:
        raise BadData(f"{path}: is not a CSV in UTF-8: there are zero bytes in its first line; save it as UTF-8")
    # Semicolons or tabs where most lines have them, else commas.
    separator = next((sign for sign in ";\t" if 2 * sum(sign in line for _, line in text) > len(text)), ",")
    with library_errors(path, "a CSV"):
        rows = [next(csv.reader([line], delimiter=separator), []) for _, line in text]
    filled = [[cell.strip() for cell in cells if cell.strip()] for cells in rows]

    def share(k: int, pattern: re.Pattern[str]) -> float:
        return sum(map(bool, map(pattern.fullmatch, filled[k]))) / max(len(filled[k]), 1)

    numeric = next((k for k in range(1, len(rows)) if len(filled[k]) > 1 and share(k, NUMBER) > 0.5), 1)
    width, above, units = len(rows[min(numeric, len(rows) - 1)]), numeric - 1, list[str]()
    if above and len(rows[above]) == width and share(above, _UNITS) >= 0.5:
        units = rows[above]
    elif len(rows[0]) == width <= 2 * len(filled[0]):  # text in the first rows
        above = 0
    return CsvLayout(rows[above - bool(units)], units, separator, text[above][0] + 1)
