"""TOML read with checks and written: each error names the place, the value and what would be right."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from wepose_pin.documents import parse_toml, read_toml, toml_key, toml_string, toml_strings
from wepose_pin.errors import BadModel, MissingFile


@pytest.mark.parametrize(
    "text", ["", "left arm", 'a"b\\c', "é α 漢", "line\nend\ttab", "\x00\x07\x7f\x80\u2028", "a.b"]
)
def test_what_is_written_is_read_back(text: str) -> None:
    line = f"{toml_key(text)} = {toml_strings([text, 'x'])}\nalone = {toml_string(text)}"
    if text != "alone":
        assert tomllib.loads(line) == {text: [text, "x"], "alone": text}


def test_a_lone_surrogate_is_written_as_a_question_mark() -> None:
    assert tomllib.loads(f"a = {toml_string('x' + chr(0xD800))}") == {"a": "x?"}


@pytest.mark.parametrize(
    ("write", "error", "message"),
    [
        (Path.exists, MissingFile, "no such file; a map is wanted here"),
        (lambda path: path.mkdir(), MissingFile, "is a folder; a map is wanted here"),
        (lambda path: path.write_bytes(b"a = '\xff'"), BadModel, "not valid TOML: "),
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
