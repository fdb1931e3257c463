"""What is drawn of a body: the visuals of its links, and meshes of few enough triangles."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

MAX_TRIANGLES = 30_000  # of a whole robot
FINEST_CELL, CELL_GROWTH = 0.003, 1.4  # [m] size of the cells in which vertices are merged; factor until they suffice

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) [m], triangles (m, 3)


class Visual(NamedTuple):
    """A visual of a link; sizes as in URDF."""

    link: str
    kind: str  # "box" | "cylinder" | "sphere" | "mesh"
    size: tuple[float, ...]  # box: x, y, z; cylinder: radius, length along z; sphere: radius [m]; mesh: scale x, y, z
    quat_LV: np.ndarray  # (4,) xyzw, visual to link
    p_LV: np.ndarray  # (3,) [m]
    rgba: tuple[float, float, float, float]
    file: str | None = None  # of a mesh, as the URDF names it


def visuals(robot: Any) -> list[Visual]:
    """The visuals of all links that have a geometry."""
    colours = {m.name: m.color.rgba for m in robot.materials if m.color is not None}
    shapes = []
    for link in robot.links:
        for visual in link.visuals:
            geometry, origin = visual.geometry, np.eye(4) if visual.origin is None else visual.origin
            if geometry.box is not None:
                kind, size = "box", geometry.box.size
            elif geometry.cylinder is not None:
                kind, size = "cylinder", (geometry.cylinder.radius, geometry.cylinder.length)
            elif geometry.sphere is not None:
                kind, size = "sphere", (geometry.sphere.radius,)
            elif geometry.mesh is not None:
                kind, size = "mesh", np.ones(3) if geometry.mesh.scale is None else geometry.mesh.scale * np.ones(3)
            else:
                continue
            file = geometry.mesh.filename if kind == "mesh" else None
            rgba = np.array([0.7, 0.7, 0.7, 1.0])
            if visual.material is not None:
                own = visual.material.color
                rgba = own.rgba if own is not None else colours.get(visual.material.name, rgba)
            r, g, b, a = (float(v) for v in rgba)
            quat = Rotation.from_matrix(origin[:3, :3]).as_quat()
            sizes = tuple(float(v) for v in size)
            shapes.append(Visual(link.name, kind, sizes, quat, origin[:3, 3].copy(), (r, g, b, a), file))
    return shapes


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
