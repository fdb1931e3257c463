"""Meshes that a URDF names: where they are looked up, as triangles, few enough to be drawn."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, unescape

import numpy as np

EXAMPLE_DATA = Path("share") / "example-robot-data" / "robots"
MAX_TRIANGLES = 30_000  # of a whole robot
FINEST_CELL, CELL_GROWTH = 0.003, 1.4  # [m] size of the cells in which vertices are merged; factor until they suffice

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) [m], triangles (m, 3)


def package_folders(urdf: Path) -> list[str]:
    """Folders in which ``package://`` paths of a URDF are looked up."""
    folders = [str(folder) for folder in urdf.absolute().parents]
    data = find_example_data()
    return folders if data is None else [*folders, str(data), str(data.parent), str(data.parent.parent)]


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file of a mesh as a URDF names it; None where there is none."""
    path = name.removeprefix("file://").removeprefix("package://")
    for folder in package_folders(urdf):
        if (Path(folder) / path).is_file():
            return (Path(folder) / path).resolve()
    return None


def resolve_meshes(urdf: Path) -> str:
    """The text of a URDF in which meshes that are found have absolute paths: it stays whole in another folder."""

    def resolve(match: re.Match[str]) -> str:
        mesh = find_mesh(unescape(match[2]), urdf)
        return match[0] if mesh is None else f"{match[1]}{escape(str(mesh), {chr(34): '&quot;'})}{match[3]}"

    text = urdf.read_text(encoding="utf-8", errors="replace")
    return re.sub(r'(<mesh\b[^>]*?\bfilename\s*=\s*["\'])(.*?)(["\'])', resolve, text)


def find_example_data() -> Path | None:
    """The folder with the robots of example-robot-data; None where it is not installed."""
    for root in map(Path, sys.path):
        for prefix in (root / "cmeel.prefix", root.parent.parent.parent):
            if (prefix / EXAMPLE_DATA).is_dir():
                return prefix / EXAMPLE_DATA
    return None


def reduce_triangles(meshes: list[Mesh]) -> list[Mesh]:
    """Merge vertices that are near each other until all meshes together have at most `MAX_TRIANGLES`."""
    cell = FINEST_CELL
    while True:
        reduced = [_simplify(*mesh, cell) for mesh in meshes]
        if sum(len(triangles) for _, triangles in reduced) <= MAX_TRIANGLES:
            return reduced
        cell *= CELL_GROWTH


def triangulate(geometry: Any) -> Mesh:
    """Vertices and triangles of a mesh, box, cylinder or sphere."""
    import trimesh

    kind = type(geometry).__name__
    if hasattr(geometry, "num_tris") and hasattr(geometry, "tri_indices"):
        triangles = np.array(
            [[t[0], t[1], t[2]] for t in map(geometry.tri_indices, range(geometry.num_tris))], dtype=int
        )
        return np.asarray(geometry.vertices(), dtype=float), triangles.reshape(-1, 3)
    if kind == "Box":
        mesh = trimesh.creation.box(2.0 * np.asarray(geometry.halfSide).ravel())
    elif kind == "Cylinder":
        mesh = trimesh.creation.cylinder(geometry.radius, 2.0 * geometry.halfLength, sections=24)
    elif kind == "Sphere":
        mesh = trimesh.creation.icosphere(2, geometry.radius)
    else:
        return np.empty((0, 3)), np.empty((0, 3), dtype=int)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _simplify(vertices: np.ndarray, triangles: np.ndarray, cell: float) -> Mesh:
    """Merge the vertices of one cell into their mean; drop triangles that lose a corner."""
    _, index, count = np.unique(
        np.round(vertices / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    index = index.ravel()
    mean = np.stack([np.bincount(index, vertices[:, k]) for k in range(3)], axis=1) / count[:, None]
    corners = index[triangles]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    corners = corners[whole]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return mean, corners[np.sort(first)]
