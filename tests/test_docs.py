"""What the pages for contributors name exists: rooms, modules, functions, files, commands, options, links."""

import ast
import re
import sys
import tomllib
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from keyword import kwlist
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from commands import options
from scipy.spatial.transform import Rotation

import wepose_pin
from wepose_pin.calibration import load_protocol
from wepose_pin.commands.options import COMMANDS
from wepose_pin.filters import TYPICAL
from wepose_pin.retargeting.maps import read_map

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("CONTRIBUTING.md", "docs/architecture.md", "docs/glossary.md", "docs/contributing.md")
NOTATION = {"p_WH"}  # examples of how frames are written, which no code needs to have
CONTRACT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"][0]
LAYERS = [room for layer in CONTRACT["layers"] for room in layer.split(" : ")]
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    return [body for kind, body in FENCE.findall(text_of(page)) if kind == language]


@cache
def known_words() -> frozenset[str]:
    """Names that the sources define, words of their strings, and keys of the project's own TOML files."""
    words: set[str] = set()
    for path in [path for folder in ("wepose_pin", "tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]:
        if path == Path(__file__):
            continue
        words.add(path.stem)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                words.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                words.add(node.id)
            elif isinstance(node, ast.arg):
                words.add(node.arg)
            elif isinstance(node, ast.alias):
                words.add(node.name)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) < 80:
                words |= {node.value, *re.findall(r"[\w.]+", node.value)}
    for path in [ROOT / "pyproject.toml", *(ROOT / "calibration").glob("*.toml"), ROOT / "wepose_pin/diagnostics.toml"]:
        words |= set(re.findall(r"^\W*([\w.-]+)", path.read_text(encoding="utf-8"), re.MULTILINE))
        words |= (
            set(re.findall(r"[\w.]+|\w+", path.read_text(encoding="utf-8"))) if path.name == "pyproject.toml" else set()
        )
    return frozenset(words)


def resolve(name: str) -> object:
    """The module or attribute of this dotted name, without ``wepose_pin.`` before it or with."""
    value: object = wepose_pin
    for part in name.removeprefix("wepose_pin.").split("."):
        if isinstance(value, ModuleType) and not hasattr(value, part):
            value = import_module(f"{value.__name__}.{part}")
        elif isinstance(value, type) and part in getattr(value, "__annotations__", {}):
            value = value.__annotations__[part]
        else:
            value = getattr(value, part)
    return value


@cache
def known_options() -> dict[str, frozenset[str]]:
    """Command → its options."""
    return {name: frozenset(f"--{option.replace('_', '-')}" for option in options(name)) for name in COMMANDS}


def missing(span: str) -> str:
    """What does not exist of that which stands in backticks; empty where all of it does."""
    words = span.split()
    if words[0] == "make":
        targets = set(re.findall(r"^([\w-]+):", text_of("Makefile"), re.MULTILINE))
        return " ".join({word for word in words[1:] if "=" not in word} - targets)
    if words[0] == "wepose":
        if len(words) == 1 or words[1].startswith("-") or words[1] == "X":
            return ""
        known = known_options().get(words[1], frozenset())
        return "" if known and {word for word in words if word.startswith("--")} <= known else span
    if words[0].startswith("--"):
        return "" if any(words[0] in known for known in [known_words(), *known_options().values()]) else span
    if span.startswith(".venv"):
        return "" if ".venv" in text_of("Makefile") else span
    if re.fullmatch(r"[\w.-]*/[\w./-]*", span):
        return "" if (ROOT / span).exists() else span
    span = re.sub(r"^wp\.", "wepose_pin.", span)
    if re.fullmatch(r"[A-Za-z_]\w*(\.\w+)+", span) and span.partition(".")[0] in {*LAYERS, "wepose_pin"}:
        try:
            resolve(span)
        except (ImportError, AttributeError):
            return "" if span in known_words() else span  # session.toml is a file, not a room's
        return ""
    if re.fullmatch(r"[\w.]+", span):
        known = span in {*known_words(), *LAYERS, *NOTATION, *kwlist} or (ROOT / span).exists()
        return "" if known else span
    return ""


@pytest.mark.parametrize("page", PAGES)
def test_what_stands_in_backticks_exists(page: str) -> None:
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", FENCE.sub("", text_of(page)))]
    assert len(spans) > 20
    assert [span for span in map(missing, spans) if span] == []


def test_every_room_is_in_the_architecture_and_its_picture() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", text_of("docs/architecture.md"), re.MULTILINE)
    assert rows == LAYERS[::-1], "the rooms from the ground up, as the contract in pyproject.toml has them"
    picture = text_of("docs/architecture.svg")
    assert [room for room in LAYERS if f">{room}<" not in picture] == []


# Examples of the recipes ---------------------------------------------------------------------------------------------


def example(path: str, folder: Path) -> Path:
    """The file of that path as docs/contributing.md shows it, in the folder."""
    language = {".py": "python", ".toml": "toml"}[Path(path).suffix]
    [block] = [block for block in blocks("docs/contributing.md", language) if block.startswith(f"# {path}\n")]
    file = folder / Path(path).name
    file.write_text(block, encoding="utf-8")
    return file


def example_module(path: str, folder: Path) -> ModuleType:
    spec = spec_from_file_location(path.removesuffix(".py").replace("/", "."), example(path, folder))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, spec.name, module)  # a dataclass looks for its module there
        spec.loader.exec_module(module)
    return module


def test_the_filter_of_the_recipe_follows_a_tilt(tmp_path: Path) -> None:
    """It takes single samples as it takes many."""
    module = example_module("wepose_pin/filters/levelled.py", tmp_path)
    accel = np.tile(Rotation.from_rotvec([0.5, 0.0, 0.0]).inv().apply([0.0, 0.0, 9.8]), (2000, 1))
    gyro, static = np.tile(TYPICAL.gyro_bias, (2000, 1)), np.zeros(2000, dtype=bool)
    start = np.array([0.0, 0.0, 0.0, 1.0])
    runs = []
    for size in (1, len(gyro)):
        records = module.LEVELLED.make_records(TYPICAL, 100.0, start, module.LevelledParams())
        quat, bias = np.empty((len(gyro), 4)), np.empty_like(gyro)
        for rows in (slice(k, k + size) for k in range(0, len(gyro), size)):
            module.LEVELLED.run(*records, gyro[rows], accel[rows], static[rows], quat[rows], bias[rows])
        runs.append(quat)
    np.testing.assert_array_equal(*runs)
    np.testing.assert_allclose(Rotation.from_quat(runs[0][-1]).as_rotvec(), [0.5, 0.0, 0.0], atol=2e-3)


def test_the_description_of_the_recipe_is_read(tmp_path: Path) -> None:
    file = tmp_path / "torso.csv"
    rows = "0;180;0;0;0;0;1000\n10;0;0;90;0;0;1000\n20;0;0;90;0;0;1000\n"
    file.write_text(f"serial: A17\nt_ms;wx;wy;wz;fx;fy;fz\n{rows}", encoding="utf-8")
    example("wepose_pin/readers/formats/acme.toml", tmp_path)
    (tmp_path / "session.toml").write_text('[data]\nfile = "torso.csv"\nformat = "acme.toml"\n[sensors.torso]\n')
    recording = wepose_pin.load_session(tmp_path)
    np.testing.assert_allclose(recording.time, [0.0, 0.01, 0.02])
    sensor = recording.sensors["torso"]
    np.testing.assert_allclose(sensor.gyro_S[:2], [[np.pi, 0, 0], [0, 0, np.pi / 2]])
    np.testing.assert_allclose(sensor.accel_S[:, 2], 9.80665)


def test_the_protocol_and_the_robot_of_the_recipes_are_read(tmp_path: Path) -> None:
    protocol = load_protocol(example("calibration/corner.toml", tmp_path))
    assert {condition.phase for condition in protocol.conditions} == {step.phase for step in protocol.steps} - {"start"}
    file = example("urdf/robots/xarm7.toml", tmp_path)
    file.write_text(re.sub(r"(?m)^srdf = .*\n", "", file.read_text(encoding="utf-8")), encoding="utf-8")
    robot = read_map(file, urdf=file)  # the URDF itself is example-robot-data's
    assert set(robot.rest) <= set(robot.arms["right"].joints)
