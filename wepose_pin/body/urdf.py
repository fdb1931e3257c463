"""URDF files: read by yourdfpy, with the meshes that they name."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape, unescape

from ..errors import BadModel, MissingFile

EXAMPLE_DATA = Path("share") / "example-robot-data" / "robots"
_TRIMESH = "trimesh"


def read_urdf(path: Path) -> Any:
    """The URDF as yourdfpy has it."""
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; a URDF is wanted here")
    try:
        # yourdfpy's parser mends broken XML in silence, and reads what entities name, on disk too.
        _check_xml(path)
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise BadModel(f"{path}: is no complete XML file, as a URDF is: {error}") from error
    try:
        robot = import_yourdfpy().URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy and lxml raise many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if isinstance(error, KeyError):
            reason = f"an element lacks the attribute {reason}"
        raise BadModel(f"{path}: cannot be read as a URDF: {reason}") from error
    for shape in (shape for link in robot.links for shape in (*link.visuals, *link.collisions)):
        mesh = None if shape.geometry is None else shape.geometry.mesh
        if mesh is not None and mesh.filename:
            mesh.filename = str(find_mesh(mesh.filename, path) or mesh.filename)
    materials = [visual.material for link in robot.links for visual in link.visuals if visual.material is not None]
    for material in [*robot.materials, *materials]:
        if material.texture is not None and material.texture.filename is None:
            material.texture = None  # <texture/>: yourdfpy cannot write what it read there
    return robot


def _check_xml(path: Path) -> None:
    def refuse(name: str, *_: object) -> None:
        raise BadModel(f"{path}: declares an entity, '{name}', which no URDF needs; write out what it stands for")

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse
    with path.open("rb") as file:
        parser.ParseFile(file)


# The library -------------------------------------------------------------------------------------------------------


class _LateTrimesh(ModuleType):
    """In place of trimesh in yourdfpy: its names are those of trimesh, which is imported when one is used."""

    in_use = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(importlib.import_module(_TRIMESH), name) if self.in_use else object  # in an annotation


def import_yourdfpy() -> Any:
    """Import yourdfpy; trimesh is imported once its scenes are used."""
    spec = importlib.util.find_spec(_TRIMESH)
    if "yourdfpy" in sys.modules or _TRIMESH in sys.modules or spec is None:
        return importlib.import_module("yourdfpy")
    late = _LateTrimesh(_TRIMESH)
    late.__path__ = list(spec.submodule_search_locations or ())  # of trimesh.transformations, which needs NumPy alone
    sys.modules[_TRIMESH] = late
    try:
        return importlib.import_module("yourdfpy")
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] == _TRIMESH]:
            del sys.modules[name]
        late.in_use = True


# Meshes ------------------------------------------------------------------------------------------------------------


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
