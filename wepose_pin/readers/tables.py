"""Tables of numbers: CSV and Parquet into polars, columns into float arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl

from ..errors import BadData, MissingFile, UnknownColumn, one_of

FORMATS = (".csv", ".parquet")


def read_table(path: Path) -> pl.DataFrame:
    """The table in a ``.csv`` or ``.parquet`` file.

    Raises
    ------
    MissingFile
        Not there, or of another format.
    BadData
        Not readable as what its ending says.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file")
    if path.suffix.lower() not in FORMATS:
        raise MissingFile(f"{path}: '{path.suffix}' is not a known format; {one_of(FORMATS)}")
    try:
        if path.suffix.lower() == ".parquet":
            return pl.read_parquet(path)
        # Columns are typed over the whole file, so that text deep down is found as text and can be named below.
        return pl.read_csv(path, infer_schema_length=None, null_values=["", "nan", "NaN", "NA"])
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise BadData(f"{path}: cannot be read as a table: {reason}") from error


def columns(table: pl.DataFrame, names: Sequence[str], file: str, place: str) -> np.ndarray:
    """Columns of numbers as a C-contiguous float array (n, len(names)); empty cells are NaN.

    `file` and `place` (such as ``sensors.torso.gyro``) begin the error's text.

    Raises
    ------
    UnknownColumn
        A name is not in the table.
    BadData
        A column holds text.
    """
    for name in names:
        if name not in table.columns:
            raise UnknownColumn(f"{place}: no column '{name}' in {file}; {one_of(table.columns, name)}")
        series = table[name]
        if not series.dtype.is_numeric() and series.dtype != pl.Null:
            text = series.cast(pl.String)
            bad = text.str.strip_chars().cast(pl.Float64, strict=False).is_null() & text.is_not_null()
            row = int(bad.arg_max() or 0)
            raise BadData(f"{file}: column '{name}' holds text in row {row + 1}: '{text[row]}'; it must be a number")
    selected = table.select(pl.col(names).cast(pl.Float64).fill_null(float("nan")))
    return np.ascontiguousarray(selected.to_numpy())
