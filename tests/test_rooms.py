"""The rooms import only from rooms above them, lazy imports included (DESIGN.md, Layout)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import wepose_pin

PACKAGE = Path(wepose_pin.__file__).parent
ORDER = (
    "errors diagnostics arguments compilation rotations assets recording readers subject filters model alignment pose "
    "calibration tracking simulation evaluation angles writers retargeting report live validation jobs batch cli"
).split()
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "_assets" not in path.parts)


def imported_rooms(source: str, package: list[str]) -> set[str]:
    """Rooms that a module of `package` (its path below wepose_pin, without its own name) imports, anywhere in it."""
    rooms = set()
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ["wepose_pin", *package][: 1 + len(package) - (node.level - 1)] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            names = [stem, *(f"{stem}.{alias.name}" for alias in node.names)]
        for name in names:
            parts = name.split(".")
            if parts[0] == "wepose_pin" and len(parts) > 1 and parts[1] in ORDER:
                rooms.add(parts[1])
    return rooms


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_from_above(path: Path) -> None:
    relative = path.relative_to(PACKAGE).with_suffix("")
    room = relative.parts[0]
    if room in ("__init__", "__main__"):
        pytest.skip("the façade names rooms and imports none before they are asked for")
    assert room in ORDER, f"{room} is no room of the design"
    for other in imported_rooms(path.read_text(encoding="utf-8"), list(relative.parts[:-1])):
        assert other == room or ORDER.index(other) < ORDER.index(room), f"{room} imports {other}, which stands below it"


def test_the_walk_sees_lazy_and_relative_imports() -> None:
    source = "def f():\n    from ..report import x\n    import wepose_pin.cli\n    from .. import batch\n"
    assert imported_rooms(source, ["filters"]) == {"report", "cli", "batch"}
    assert imported_rooms("from .subject import X\nfrom . import rotations", []) == {"subject", "rotations"}


def test_the_facade_knows_where_everything_is() -> None:
    for name in wepose_pin.__all__:
        assert getattr(wepose_pin, name) is not None
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = wepose_pin.nothing_of_the_kind


def test_help_loads_no_heavy_room() -> None:
    code = (
        "import sys, wepose_pin.cli as c\n"
        "try:\n    c.main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print(sorted(set(sys.modules) & {'numpy', 'pinocchio', 'numba', 'yourdfpy', 'casadi', 'polars', 'meshcat'}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "[]"
