"""TRC, markers as OpenSim and Motion Analysis write them: a reference for `wepose evaluate`.

``PathFileType``, a line of keys and one of values (``Units`` mm, cm or m), a line of names (one every third cell), one
of ``X1 Y1 Z1 …``, then rows ``frame time x y z …``, separated by tabs. Empty cells are missing markers.

Source: opensim-core, `TRCFileAdapter.cpp`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import BadData, one_of
from .device import check_measured, read_first_lines
from .markers import MarkerTable, Reference, locate

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def read_trc(path: Path, table: MarkerTable) -> Reference:
    """Read the joints and segments that follow from the markers.

    Raises
    ------
    MissingFile, BadData
        Not there; no TRC; an unknown unit; rows of another length; no marker that the table knows.
    """
    lines = read_first_lines(path, 6)
    if not lines[0].startswith("PathFileType"):
        raise BadData(f"{path}: is no TRC: its first line does not begin with PathFileType")
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = about.get("Units", "").strip().lower()
    if unit not in UNITS:
        raise BadData(f"{path}: Units '{about.get('Units', '')}'; {one_of(UNITS, unit)}")
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if not names or len(set(names)) < len(names):
        raise BadData(f"{path}: line 4 names {'no markers' if not names else 'a marker twice'}: {lines[3][:60]!r}")
    body = path.read_text(encoding="utf-8", errors="replace").splitlines()[5:]
    width = 2 + 3 * len(names)
    values = []
    for k, line in enumerate(body, 6):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.removesuffix("\t").split("\t")]
        if cells[-1] and len(cells) < width and (len(cells) - 2) % 3:
            raise BadData(f"{path}: line {k} ends within a marker, after {len(cells)} of {width} cells; it was cut off")
        cells += [""] * (width - len(cells))
        try:
            values.append([float(cell) if cell else np.nan for cell in cells[:width]])
        except ValueError:
            raise BadData(f"{path}: line {k} holds something else than numbers: '{line[:40]}'") from None
        if any(cells[width:]):
            raise BadData(f"{path}: line {k} has {len(cells)} cells; {width} are needed for {len(names)} markers")
    if len(values) < 2:
        raise BadData(f"{path}: {len(values)} rows of markers; a recording has at least 2")
    rows = np.array(values)
    if not np.all(np.diff(rows[:, 1]) > 0.0):
        raise BadData(f"{path}: the times of its rows do not increase")
    check_measured(path, np.nan_to_num(rows[:, 2:]), "a marker")
    points = UNITS[unit] * rows[:, 2:].reshape(len(rows), -1, 3)
    return locate(path, rows[:, 1], {name: points[:, k] for k, name in enumerate(names)}, table)
