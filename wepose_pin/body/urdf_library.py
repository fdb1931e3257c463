"""yourdfpy without trimesh, by which it draws and we do not: all that trimesh imports takes half a second to load."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any

_TRIMESH = "trimesh"


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
