"""Files of other systems as a reference for `wepose evaluate`."""

from __future__ import annotations

from pathlib import Path

from ..libraries import check_file
from .c3d import read_c3d
from .markers import Reference, read_marker_table
from .mvnx import read_mvnx_reference
from .trc import read_trc

SUFFIXES = (".c3d", ".trc", ".mvnx")


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
    return read_trc(path, table) if suffix == ".trc" else read_c3d(path, table)
