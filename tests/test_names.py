"""Only the table of a body names its segments, points, lengths and hinges: no other string of the package does."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import wepose_pin
from wepose_pin.model import load_table

PACKAGE = Path(wepose_pin.__file__).parent
TABLE = load_table("whole_body")  # the upper body's names and those of legs
NAMES = {*TABLE.segments, *TABLE.points, *TABLE.lengths, *TABLE.hinges}
PARTS = {TABLE.shared_name(name) for name in NAMES if TABLE.side(name)}
# A name on its own, or a part of one, from which a name is built: "left_palm_x", f"{side}_forearm", "left_".
BUILT = re.compile(rf"(left|right)_({'|'.join(PARTS)})|^_({'|'.join(PARTS)})$|(^|\W)(left|right)_$")

# Files that may name them, and why.
ALLOWED = {
    "angles/definitions.py": "definitions of joint angles",
    "angles/joints.py": "definitions of joint angles",
    "live/figure.py": "the figure of formats that have a person",
    "live/sources/packets.py": "the numbers of a format",
    "live/sources/slimevr.py": "the numbers of a format",
    "live/vmc_output.py": "the names of a format",
    "report/words.py": "a plural of English",
    "readers/mvnx.py": "the names of a format",
    "readers/opensim.py": "the names of a format",
    "writers/bvh.py": "the names of a format",
    "writers/gmr.py": "the names of a format",
    "writers/osim.py": "the names of a format",
    "writers/rajagopal.py": "the names of a format",
    "writers/standing.py": "the figure of formats that have a person",
    "retargeting/maps.py": "the keys of a robot's map",
    "simulation/activities.py": "a simulated activity",
    "simulation/arm_tasks.py": "a simulated activity",
    "simulation/motion.py": "a simulated activity",
    "simulation/people.py": "a simulated person",
    "simulation/sequence.py": "a simulated activity",
    "simulation/soft_tissue.py": "a simulated person",
    "simulation/subject.py": "a simulated activity",
    "simulation/tasks.py": "a simulated activity",
    "validation/paper.py": "figures of simulated activities",
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
    """Line and text of each string that is a name of a body of the package, or from which one is built."""
    return [(line, string) for line, string in find_strings(text) if string in NAMES | PARTS or BUILT.search(string)]


FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}


@pytest.mark.parametrize("file", [name for name in FILES if name not in ALLOWED])
def test_no_name_of_a_body(file: str) -> None:
    assert find_names(FILES[file].read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("file", ALLOWED)
def test_a_file_that_is_allowed_still_needs_it(file: str) -> None:
    assert find_names(FILES[file].read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "text",
    [
        '"torso"',
        '"shoulder_width"',
        '"left_palm_x"',
        'f"{side}_forearm"',
        'side + "_hand"',
        '("upper_arm",)',
        'f"left_{x}"',
    ],
)
def test_it_finds(text: str) -> None:
    assert find_names(f"x = {text}")


@pytest.mark.parametrize("text", ['"left"', '"on_the_other_hand"', '"handle"', '"the torso leans"', '"torso-fixed"'])
def test_it_leaves(text: str) -> None:
    assert not find_names(f'"""torso"""\nx = {text}')
