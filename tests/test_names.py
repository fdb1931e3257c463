"""Only the table of a body names its segments, points, lengths and hinges: no other string of the package does."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import wepose_pin

PACKAGE = Path(wepose_pin.__file__).parent
TABLE = wepose_pin.load_model("whole_body").table  # the upper body's names and those of legs
NAMES = {*TABLE.segments, *TABLE.points, *TABLE.lengths, *TABLE.hinges}
PARTS = {TABLE.shared_name(name) for name in NAMES if TABLE.side(name)}
# A name on its own, or a part of one, from which a name is built: "left_palm_x", f"{side}_forearm", "%s_hand", "left_".
BUILT = re.compile(rf"(left|right)_({'|'.join(PARTS)})|(^|[}}s])_({'|'.join(PARTS)})(_|$)|(^|\W)(left|right)_$")
# A name among others that are joined without a space: "mounts.torso", "lengths[trunk]".
JOINED = re.compile(rf"[.\[/=:]({'|'.join(NAMES | PARTS)})\b(?!-)|\b({'|'.join(NAMES | PARTS)})[.\[/=:]\S")
# As a keyword, a variable or a field: dict(shoulder_width=0.4), and in pages and scripts.
IDENTIFIER = re.compile(rf"(left|right)_({'|'.join(PARTS)})|\b({'|'.join(name for name in NAMES if '_' in name)})\b")

# Files and folders that may name them, and why.
ALLOWED = {
    "angles/joints.py": "definitions of joint angles",
    "report/words.py": "a plural of English",
    "readers/mvnx.py": "the names of a format",
    "writers/motion_capture.py": "the names of a format",
    "writers/opensim.py": "the names of a format",
    "retargeting/maps.py": "the keys of a robot's map",
    "simulation/": "simulated people and activities",
}


def find_strings(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each string and each piece of an f-string, docstrings left out."""
    tree = ast.parse(text)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.lineno, node.value


def find_names(text: str) -> list[tuple[int, str]]:
    """Line and text of each string or identifier that names a body of the package, or from which a name is built."""
    strings = [(line, string) for line, string in find_strings(text) if is_name(string)]
    return strings + [(line, name) for line, name in find_identifiers(text) if IDENTIFIER.fullmatch(name)]


def is_name(string: str) -> bool:
    joined = not re.search(r"\s", string) and JOINED.search(string)
    return bool(string in NAMES | PARTS or BUILT.search(string) or joined)


def find_identifiers(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each variable, field, argument and keyword."""
    for node in ast.walk(ast.parse(text)):
        for kind, field in ((ast.Name, "id"), (ast.Attribute, "attr"), (ast.arg, "arg"), (ast.keyword, "arg")):
            if isinstance(node, kind) and getattr(node, field):
                yield node.lineno, getattr(node, field)


FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}


def covers(allowed: str, file: str) -> bool:
    return file == allowed or (allowed.endswith("/") and file.startswith(allowed))


@pytest.mark.parametrize("file", [name for name in FILES if not any(covers(each, name) for each in ALLOWED)])
def test_no_name_of_a_body(file: str) -> None:
    assert find_names(FILES[file].read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("allowed", ALLOWED)
def test_what_is_allowed_still_needs_it(allowed: str) -> None:
    assert any(find_names(path.read_text(encoding="utf-8")) for name, path in FILES.items() if covers(allowed, name))
