"""What the pages for contributors name exists: rooms, modules, functions, files, commands, options, links."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from keyword import kwlist
from pathlib import Path
from types import ModuleType

import pytest

import wepose_pin
from wepose_pin.cli import COMMANDS, find_command
from wepose_pin.jobs.fields import field_types

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("CONTRIBUTING.md", "docs/architecture.md", "docs/recipes.md")
NOTATION = {"p_WH"}  # examples of how frames are written, which no code needs to have
LAYERS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"][0][
    "layers"
]
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    return [body for kind, body in FENCE.findall(text_of(page)) if kind == language]


def code_spans(page: str) -> list[str]:
    """What stands in backticks outside of code blocks."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", FENCE.sub("", text_of(page)))]


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
        words |= set(re.findall(r"\w+", path.read_text(encoding="utf-8"))) if path.name == "pyproject.toml" else set()
    return frozenset(words)


def resolve(name: str) -> object:
    """The module or attribute of this dotted name, without ``wepose_pin.`` before it or with."""
    found: object = wepose_pin
    for part in name.removeprefix("wepose_pin.").split("."):
        if isinstance(found, ModuleType) and not hasattr(found, part):
            found = import_module(f"{found.__name__}.{part}")
        elif isinstance(found, type) and part in getattr(found, "__annotations__", {}):
            found = found.__annotations__[part]
        else:
            found = getattr(found, part)
    return found


@cache
def options() -> dict[str, frozenset[str]]:
    """Command → its options."""
    switches = {name: field_types(find_command(name).job) for name in COMMANDS}
    return {name: frozenset(f"--{field.replace('_', '-')}" for field in fields) for name, fields in switches.items()}


def missing(span: str) -> str:
    """What does not exist of that which stands in backticks; empty where all of it does."""
    words = span.split()
    if words[0] == "make":
        targets = set(re.findall(r"^([\w-]+):", text_of("Makefile"), re.MULTILINE))
        return " ".join({word for word in words[1:] if "=" not in word} - targets)
    if words[0] == "wepose":
        if len(words) == 1 or words[1].startswith("-") or words[1] == "X":
            return ""
        known = options().get(words[1], frozenset())
        return "" if known and {word for word in words if word.startswith("--")} <= known else span
    if words[0].startswith("--"):
        return "" if any(words[0] in known for known in [known_words(), *options().values()]) else span
    if span.startswith(".venv"):
        return "" if ".venv" in text_of("Makefile") else span
    if re.fullmatch(r"[\w.-]*/[\w./-]*", span):
        return "" if (ROOT / span).exists() else span
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
    spans = code_spans(page)
    assert len(spans) > 20
    assert [span for span in map(missing, spans) if span] == []


@pytest.mark.parametrize(
    "span",
    [
        "make tests",
        "wepose trakc",
        "wepose track --subjects",
        "--gauges",
        "docs/architektur.md",
        "tracking.Trakker",
        "tracking.Tracker.pushed",
        "NoSuchClass",
        "no_such_name",
        "diagnostic.toml",
    ],
)
def test_what_does_not_exist_is_noticed(span: str) -> None:
    assert missing(span)


def test_every_room_is_in_the_architecture_and_its_picture() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", text_of("docs/architecture.md"), re.MULTILINE)
    assert rows == LAYERS[::-1], "the rooms from the ground up, as the contract in pyproject.toml has them"
    picture = text_of("docs/architecture.svg")
    assert [room for room in LAYERS if f">{room}<" not in picture] == []


def imported(block: str) -> Iterator[tuple[str, str]]:
    """Module and name of each import from the project in a block, which may say its path in its first line."""
    path = re.match(r"# (\S+)\.py\n", block)
    package = path[1].split("/")[:-1] if path else []
    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            if module.startswith("wepose_pin"):
                yield from ((module, alias.name) for alias in node.names)


def test_examples_of_recipes_parse_and_import_what_is_there() -> None:
    names = []
    for block in blocks("docs/recipes.md", "python"):
        if block.startswith(" "):  # lines for the middle of a function or table
            continue
        names += list(imported(block))
    for module, name in names:
        assert hasattr(import_module(module), name), f"{module}.{name}"
    assert len(names) > 10
    for block in blocks("docs/recipes.md", "toml"):
        assert tomllib.loads(block)


def test_commands_of_recipes_name_what_is_there() -> None:
    text = "".join(block for page in PAGES for block in blocks(page, ""))
    tests = set(re.findall(r"tests/\w+\.py", text))
    assert len(tests) > 5
    assert [path for path in tests if not (ROOT / path).is_file()] == []
    commands = set(re.findall(r"^wepose (\w+)|&& wepose (\w+)", text, re.MULTILINE))
    assert {a or b for a, b in commands} <= set(COMMANDS)
    for module in set(re.findall(r"python -m ([\w.]+)", text)) - {"pytest"}:
        assert import_module(module)


PAGES_WITH_LINKS = [path.relative_to(ROOT).as_posix() for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))]


@pytest.mark.parametrize("page", PAGES_WITH_LINKS)
def test_links_lead_somewhere(page: str) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text_of(page)))
    files = [target.partition("#")[0] for target in targets if "://" not in target]
    assert [file for file in files if file and not (ROOT / page).parent.joinpath(file).exists()] == []


def test_the_readme_leads_to_the_pages_for_contributors() -> None:
    for page in ("CONTRIBUTING.md", "docs/architecture.md", "docs/glossary.md", "docs/recipes.md"):
        assert f"]({page})" in text_of("README.md"), page
