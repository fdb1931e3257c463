"""URDF files: read by yourdfpy, with the meshes that they name."""

import importlib
import importlib.util
import re
import sys
from html import escape, unescape
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadModel, reason
from ..libraries import check_file

EXAMPLE_DATA = Path("share") / "example-robot-data" / "robots"


def read_urdf(path: Path) -> Any:
    """The URDF as yourdfpy has it; each joint, shape and inertia states its origin (4, 4)."""
    check_file(path, "a URDF")
    try:
        # yourdfpy's parser mends broken XML in silence, and reads what entities name, on disk too.
        ElementTree.parse(path)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise BadModel(f"{path}: is no complete XML file, as a URDF is: {error}") from error
    try:
        robot = import_yourdfpy().URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy and lxml raise many kinds
        cause = f"an element lacks the attribute {error}" if isinstance(error, KeyError) else reason(error)
        raise BadModel(f"{path}: cannot be read as a URDF: {cause}") from error
    shapes = [shape for link in robot.links for shape in (*link.visuals, *link.collisions)]
    for shape in shapes:
        mesh = None if shape.geometry is None else shape.geometry.mesh
        if mesh is not None and mesh.filename:
            mesh.filename = str(find_mesh(mesh.filename, path) or mesh.filename)
    inertials = [link.inertial for link in robot.links if link.inertial is not None]
    for part in (*robot.joints, *shapes, *inertials):
        part.origin = np.eye(4) if part.origin is None else part.origin
    materials = [visual.material for link in robot.links for visual in link.visuals if visual.material is not None]
    for material in [*robot.materials, *materials]:
        if material.texture is not None and material.texture.filename is None:
            material.texture = None  # <texture/>: yourdfpy cannot write what it read there
    return robot


def import_yourdfpy() -> Any:
    """Import yourdfpy; trimesh, which takes half a second, is imported once its scenes are used."""
    spec = importlib.util.find_spec("trimesh")
    if "yourdfpy" in sys.modules or "trimesh" in sys.modules or spec is None:
        return importlib.import_module("yourdfpy")
    stub: Any = ModuleType("trimesh")
    stub.Scene = stub.Trimesh = object  # in annotations
    stub.__path__ = list(spec.submodule_search_locations or ())  # of trimesh.transformations, which needs NumPy alone
    sys.modules["trimesh"] = stub
    try:
        return importlib.import_module("yourdfpy")
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "trimesh"]:
            del sys.modules[name]
        del stub.Scene, stub.Trimesh
        stub.__getattr__ = lambda name: getattr(importlib.import_module("trimesh"), name)


def package_folders(urdf: Path) -> list[str]:
    """Folders in which ``package://`` paths of a URDF are looked up."""
    folders = [str(folder) for folder in urdf.absolute().parents]
    data = find_example_data()
    return folders if data is None else [*folders, str(data), str(data.parent), str(data.parent.parent)]


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file of a mesh as a URDF names it; None where there is none."""
    path = name.removeprefix("file://").removeprefix("package://")
    files = (Path(folder) / path for folder in package_folders(urdf))
    return next((file.resolve() for file in files if file.is_file()), None)


def resolve_meshes(urdf: Path) -> str:
    """The text of a URDF in which meshes that are found have absolute paths: it stays whole in another folder."""

    def resolve(match: re.Match[str]) -> str:
        mesh = find_mesh(unescape(match[2]), urdf)
        return match[0] if mesh is None else f"{match[1]}{escape(str(mesh))}{match[3]}"

    text = urdf.read_text(encoding="utf-8", errors="replace")
    return re.sub(r'(<mesh\b[^>]*?\bfilename\s*=\s*["\'])(.*?)(["\'])', resolve, text)


def find_example_data() -> Path | None:
    """The folder with the robots of example-robot-data; None where it is not installed."""
    roots = (prefix for root in map(Path, sys.path) for prefix in (root / "cmeel.prefix", root.parent.parent.parent))
    return next((root / EXAMPLE_DATA for root in roots if (root / EXAMPLE_DATA).is_dir()), None)


MAX_TRIANGLES = 30_000  # of a whole robot
FINEST_CELL, CELL_GROWTH = 0.003, 1.4  # [m] size of the cells in which vertices are merged; factor until they suffice

ROD_RADIUS = 0.02  # [m] of what is drawn of a body without shapes; shorter rods are not drawn

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) [m], triangles (m, 3)


class Visual(NamedTuple):
    """A visual of a link; sizes as in URDF."""

    link: str
    kind: str  # "box" | "cylinder" | "sphere"
    size: tuple[float, ...]  # box: x, y, z; cylinder: radius, length along z; sphere: radius [m]
    quat_LV: np.ndarray  # (4,) xyzw, visual to link
    p_LV: np.ndarray  # (3,) [m]
    rgba: tuple[float, float, float, float]


def list_visuals(robot: Any) -> list[Visual]:
    """List the visuals of all links that are boxes, cylinders or spheres; if there are none, rods between joints."""
    colours, visuals = {m.name: m.color.rgba for m in robot.materials if m.color is not None}, []
    for name, visual in ((link.name, visual) for link in robot.links for visual in link.visuals):
        box, cylinder, sphere = visual.geometry.box, visual.geometry.cylinder, visual.geometry.sphere
        if box is not None:
            kind, size = "box", box.size
        elif cylinder is not None:
            kind, size = "cylinder", (cylinder.radius, cylinder.length)
        elif sphere is not None:
            kind, size = "sphere", (sphere.radius,)
        else:
            continue
        rgba = (0.7, 0.7, 0.7, 1.0)
        if (material := visual.material) is not None:
            rgba = material.color.rgba if material.color is not None else colours.get(material.name, rgba)
        r, g, b, a = (float(v) for v in rgba)
        quat, p_LV = Rotation.from_matrix(visual.origin[:3, :3]).as_quat(), visual.origin[:3, 3].copy()
        visuals.append(Visual(name, kind, tuple(float(v) for v in size), quat, p_LV, (r, g, b, a)))
    return visuals or _list_rods(robot)


def _list_rods(robot: Any) -> list[Visual]:
    """List a rod from the origin of each link to each joint below it."""
    rods = []
    for joint in robot.joints:
        way = joint.origin[:3, 3]
        if ROD_RADIUS < (length := float(np.linalg.norm(way))) < np.inf:
            quat = Rotation.align_vectors(way[None] / length, [[0.0, 0.0, 1.0]])[0].as_quat()
            rods.append(Visual(joint.parent, "cylinder", (ROD_RADIUS, length), quat, 0.5 * way, (0.7, 0.7, 0.7, 1.0)))
    return rods


def reduce_triangles(meshes: list[Mesh], cell: float = FINEST_CELL) -> list[Mesh]:
    """Merge vertices that are near each other until all meshes together have at most `MAX_TRIANGLES`."""
    reduced = [_simplify(*mesh, cell) for mesh in meshes]
    too_many = sum(len(triangles) for _, triangles in reduced) > MAX_TRIANGLES
    return reduce_triangles(meshes, cell * CELL_GROWTH) if too_many else reduced


def triangulate(geometry: Any) -> Mesh:
    """Vertices and triangles of a mesh, box, cylinder or sphere."""
    import trimesh

    if hasattr(geometry, "num_tris") and hasattr(geometry, "tri_indices"):
        triangles = [[t[0], t[1], t[2]] for t in map(geometry.tri_indices, range(geometry.num_tris))]
        return np.asarray(geometry.vertices(), dtype=float), np.array(triangles, dtype=int).reshape(-1, 3)
    kind = type(geometry).__name__
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
    cells = np.round(vertices / cell).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    mean = np.stack([np.bincount(index, vertices[:, k]) for k in range(3)], axis=1) / count[:, None]
    corners = index[triangles]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return mean, corners[np.sort(first)]
