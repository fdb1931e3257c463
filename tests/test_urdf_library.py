"""yourdfpy comes without trimesh, which is there once it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

_AFTER = "assert type(trimesh).__name__ == 'module' and trimesh.transformations.identity_matrix().shape == (4, 4)\n"


@pytest.mark.parametrize(
    "code",
    [
        # A body is read, changed and written without it.
        "from wepose_pin.body import load_model\n"
        "load_model('whole_body').with_lengths({'trunk': 0.5}).urdf()\n"
        "assert not [name for name in sys.modules if name.split('.')[0] in ('trimesh', 'networkx')]\n"
        "import trimesh\n" + _AFTER,
        # yourdfpy's scenes find it.
        "from wepose_pin.assets import asset\n"
        "from wepose_pin.body import load_model\n"
        "load_model()\n"
        "import yourdfpy\n"
        "path = str(asset('urdf', 'upper_body.urdf'))\n"
        "scene = yourdfpy.URDF.load(path, build_scene_graph=True, load_meshes=False).scene\n"
        "import trimesh\n"
        "assert isinstance(scene, trimesh.Scene)\n" + _AFTER,
        # Whoever has it keeps it.
        "import trimesh\nbefore = trimesh\n"
        "from wepose_pin.body import load_model\n"
        "load_model()\n"
        "assert sys.modules['trimesh'] is before\n" + _AFTER,
    ],
)
def test_trimesh_is_imported_where_it_is_used(code: str) -> None:
    run = subprocess.run([sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
