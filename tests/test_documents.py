"""TOML read with checks and written: each error names the place, the value and what would be right."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from wepose_pin.documents import TomlTable, is_number, parse_toml, read_toml, toml_key, toml_string, toml_strings
from wepose_pin.errors import BadModel, BadSession, BadSubject, MissingFile


@pytest.mark.parametrize(
    "text", ["", "left arm", 'a"b\\c', "é α 漢", "line\nend\ttab", "\x00\x07\x7f\x80\u2028", "a.b"]
)
def test_what_is_written_is_read_back(text: str) -> None:
    line = f"{toml_key(text)} = {toml_strings([text, 'x'])}\nalone = {toml_string(text)}"
    if text != "alone":
        assert tomllib.loads(line) == {text: [text, "x"], "alone": text}


def test_a_lone_surrogate_is_written_as_a_question_mark() -> None:
    assert tomllib.loads(f"a = {toml_string('x' + chr(0xD800))}") == {"a": "x?"}


TABLE = """
name = ""
pose = "n_pos"
left = 3
rate = "fast"
below = -1
on = "yes"
columns = ["x", "x", "y"]
two = ["x", "y"]
[sensors]
torso = 3
[arms.lef]
[std]
rate = 1.0
std = -1.0
"""
WRONG: dict[str, tuple[Callable[[TomlTable], object], str]] = {
    "unknown": (lambda t: t.allow("nme", "pose"), "f.toml: name is not a known key; did you mean 'nme'"),
    "renamed": (lambda t: t.allow(renamed={"name": "is called title now"}), "f.toml: name is called title now"),
    "no table": (lambda t: t.table("limits"), "f.toml: limits is missing; a table [limits] is needed"),
    "close": (lambda t: t.table("arm"), "f.toml: arm is missing; a table [arm] is needed; did you mean 'arms'"),
    "not a table": (lambda t: t.table("left"), "f.toml: left = 3 is not a table; write [left]"),
    "entry": (lambda t: t.table("sensors").tables(["torso"], "segment"), "sensors.torso = 3 is not a table"),
    "name": (lambda t: t.table("arms").tables(["left"], "side"), "arms.lef is not a side; did you mean 'left'"),
    "empty text": (lambda t: t.text("name", None), "f.toml: name = '' is not a text; write it in quotes"),
    "choice": (lambda t: t.choice("pose", ["n_pose"]), "pose = 'n_pos' is not known; did you mean 'n_pose'"),
    "no choice": (lambda t: t.choice("unit", ["g", "kg"]), "f.toml: unit is missing; there is: g, kg"),
    "flag": (lambda t: t.flag("on"), "f.toml: on = 'yes' is neither true nor false"),
    "number": (lambda t: t.number("rate", None), "f.toml: rate = 'fast' is not a number"),
    "positive": (lambda t: t.number("below", None, positive=True), "f.toml: below = -1 must be greater than 0"),
    "missing number": (
        lambda t: t.table("std").numbers("rate", "drift"),
        "f.toml: std has no drift; it needs rate",
    ),
    "negative std": (lambda t: t.table("std").numbers("rate", "std"), "f.toml: std has std = -1.0; it needs rate, std"),
    "large": (
        lambda t: t.table("std").numbers("rate", most=0.5),
        "rate = 1.0; it needs rate: numbers up to 0.5",
    ),
    "twice": (lambda t: t.names("columns", 3), "f.toml: columns names a column twice: ['x', 'x', 'y']"),
    "too few": (lambda t: t.names("two", 3), "f.toml: two is ['x', 'y']; a list of 3 column names is needed"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("error", [BadSession, BadSubject])
def test_what_is_wrong_is_named_with_its_place(case: str, error: type[BadSession] | type[BadSubject]) -> None:
    check, message = WRONG[case]
    with pytest.raises(error) as caught:
        check(TomlTable(parse_toml(TABLE), "f.toml", error=error))
    assert message in str(caught.value)


def test_what_is_right_comes_through() -> None:
    table = TomlTable(parse_toml("a = 2\nb = true\nc = 'x'\n[d.e]\nstd = 0.5"), "f.toml")
    assert (table.number("a", None), table.number("z", 1.5), table.flag("b"), table.flag("z")) == (
        2.0,
        1.5,
        True,
        False,
    )
    assert (table.choice("c", "xy"), table.text("z", None), table.choice("z", "xy", "y")) == ("x", None, "y")
    (e,) = table.table("d").tables(["e"], "letter").values()
    assert e.numbers("std") == [0.5]
    assert (e.where, e.at("std")) == ("f.toml: d.e", "f.toml: d.e.std")


@pytest.mark.parametrize(
    ("write", "error", "message"),
    [
        (Path.exists, MissingFile, "no such file; a map is wanted here"),
        (lambda path: path.mkdir(), MissingFile, "is a folder; a map is wanted here"),
        (lambda path: path.write_bytes(b"a = '\xff'"), MissingFile, "is not UTF-8 text (byte 5)"),
        (lambda path: path.write_text("a = "), BadModel, "not valid TOML: "),
        (lambda path: path.write_text("a = " + 20_000 * "["), BadModel, "not valid TOML: "),
    ],
)
def test_files_that_cannot_be_read(
    tmp_path: Path, write: Callable[[Path], object], error: type[Exception], message: str
) -> None:
    path = tmp_path / "map.toml"
    write(path)
    with pytest.raises(error) as caught:
        read_toml(path, "a map", BadModel)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_toml(tmp_path / "a.toml", "a map") == {"a": 1}
    assert parse_toml("\ufeffa = 1") == {"a": 1}


def test_what_counts_as_a_number() -> None:
    assert [v for v in (1, 2.5, True, "1", float("nan"), float("inf"), 10**400, None) if is_number(v)] == [1, 2.5]
