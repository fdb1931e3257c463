"""Files of other systems as a reference for `wepose evaluate`: C3D, MVNX, and TRC, markers as OpenSim writes them.

A TRC has ``PathFileType``, a line of keys and one of values (``Units`` mm, cm or m), a line of names (one every third
cell), one of ``X1 Y1 Z1 …``, then rows ``frame time x y z …``, separated by tabs. Empty cells are missing markers.

Source: opensim-core, `TRCFileAdapter.cpp`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from ..data_tables import read_body
from ..errors import BadData, one_of
from ..libraries import check_file, library_errors
from .c3d import read_c3d
from .device import check_measured, read_first_lines
from .markers import MarkerTable, Reference, locate, read_marker_table
from .mvnx import read_mvnx_reference

SUFFIXES = (".c3d", ".trc", ".mvnx")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def is_reference(path: Path) -> bool:
    """Return whether a file is that of another system, by its name; not a table with the columns of pose.parquet."""
    return path.suffix.lower() in SUFFIXES


def read_reference(path: Path, markers: Path | None = None) -> Reference:
    """Read what another system measured; `markers`: a table of markers that goes before the shipped one.

    Raises
    ------
    MissingFile, BadData
        Not there; damaged; without what is needed.
    """
    check_file(path, "a C3D, TRC or MVNX")
    suffix = path.suffix.lower()
    if suffix == ".mvnx":
        return read_mvnx_reference(path)
    table = read_marker_table(markers)
    return _read_trc(path, table) if suffix == ".trc" else read_c3d(path, table)


def _read_trc(path: Path, table: MarkerTable) -> Reference:
    """Read the joints and segments that follow from the markers."""
    lines = read_first_lines(path, 5)
    if not lines[0].startswith("PathFileType"):
        raise BadData(f"{path}: is no TRC: its first line does not begin with PathFileType")
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = about.get("Units", "").strip().lower()
    if unit not in UNITS:
        raise BadData(f"{path}: Units '{about.get('Units', '')}'; {one_of(UNITS, unit)}")
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if not names or len(set(names)) < len(names):
        raise BadData(f"{path}: line 4 names {'no markers' if not names else 'a marker twice'}: {lines[3][:60]!r}")
    columns = [str(k) for k in range(2 + 3 * len(names))]
    with library_errors(path, "a TRC"):
        schema = dict.fromkeys([*columns, "end"], pl.String)  # a tab may end each row
        body = read_body(path, 5)
        cells = pl.read_csv(body, has_header=False, separator="\t", schema=schema, missing_columns="insert")
        cells = cells.select(pl.all().str.strip_chars().replace("", None)).drop_nulls("1")
        rows = cells.select(columns).cast(pl.Float64).to_numpy()
    if cells["end"].count():
        row = int(cells["end"].is_not_null().arg_max() or 0) + 1
        raise BadData(f"{path}: row {row} has more than the {len(columns)} cells of {len(names)} markers")
    if len(rows) < 2:
        raise BadData(f"{path}: {len(rows)} rows of markers; a recording has at least 2")
    if not np.all(np.diff(rows[:, 1]) > 0.0):
        raise BadData(f"{path}: the times of its rows do not increase")
    check_measured(path, rows[:, 2:], "a marker")
    points = UNITS[unit] * rows[:, 2:].reshape(len(rows), -1, 3)
    return locate(path, rows[:, 1], {name: points[:, k] for k, name in enumerate(names)}, table)
