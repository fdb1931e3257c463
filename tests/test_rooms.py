"""The rooms import only from rooms above them, lazy imports included: the contract stands in pyproject.toml."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import wepose_pin

ROOT = Path(__file__).parents[1]


def test_a_room_imports_only_from_above(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    code = pytest.importorskip("importlinter.cli").lint_imports(
        config_filename=str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True
    )
    assert code == 0, capsys.readouterr().out


def test_the_facade_knows_where_everything_is() -> None:
    for name in wepose_pin.__all__:
        assert getattr(wepose_pin, name) is not None
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = wepose_pin.nothing_of_the_kind


def test_editors_see_every_public_name() -> None:
    tree = ast.parse(Path(wepose_pin.__file__).read_text(encoding="utf-8"))
    [block] = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {each.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for each in node.names}
    assert seen == wepose_pin._WHERE


def test_help_loads_no_heavy_room() -> None:
    code = (
        "import sys, wepose_pin.commands as c\n"
        "try:\n    c.main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'pinocchio', 'numba', 'yourdfpy', 'casadi', 'polars', 'meshcat', 'matplotlib'}\n"
        "print(sorted(set(sys.modules) & heavy))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "[]"
