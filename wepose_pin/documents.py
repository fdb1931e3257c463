"""Reading of TOML with checks, writing of TOML, and atomic output of folders and files."""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeGuard, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from .arguments import Range, check_value, describe
from .errors import BadSession, ExistingOutput, MissingFile, WeposeError, one_of
from .libraries import check_file

R = TypeVar("R")
Finite = Annotated[float, Range(-1e300, closed=True, high=1e300)]


def read_toml(path: Path, what: str, error: type[WeposeError] = BadSession) -> dict[str, Any]:
    """Read a TOML file, which holds `what`; raise `MissingFile`, or where it is not TOML an `error`."""
    check_file(path, what)
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))  # some editors write a byte-order mark
    except OSError as failure:
        raise MissingFile(f"{path}: cannot be read: {failure.strerror}") from failure
    except (ValueError, RecursionError) as failure:
        raise error(f"{path}: not valid TOML: {' '.join(str(failure).split())}; {what} is needed here") from failure


@dataclass(frozen=True)
class TomlTable:
    """A TOML table with its place, which begins each error's text."""

    values: Mapping[str, Any]
    file: str  # or another beginning of an error's text
    place: str = ""  # its name in the file with a dot at the end, such as ``sensors.torso.``
    error: type[WeposeError] = BadSession  # the kind of error to raise

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        """Return file and place of a key, for the beginning of an error's text."""
        return f"{self.file}: {self.place}{key}"

    @property
    def where(self) -> str:
        """File and place of the table itself."""
        return self.at("").removesuffix(".")

    def allow(self, *known: str) -> None:
        """Refuse unknown keys."""
        for key in self.values:
            if key not in known:
                raise self.error(f"{self.at(key)} is not a known key; {one_of(known, key)}")

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> TomlTable:
        """Return the table of that name; an error without it and without `default`."""
        value = self.values.get(key, default)
        if not isinstance(value, Mapping):
            state = "is missing" if value is None else f"= {value!r} is not a table"
            raise self.error(f"{self.at(key)} {state}; a table [{self.place}{key}] is needed")
        return replace(self, values=value, place=f"{self.place}{key}.")

    def entries(self, key: str) -> list[TomlTable]:
        """Return the tables of a list ``[[key]]``; none where the key is missing."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(each, Mapping) for each in value):
            raise self.error(f"{self.at(key)} = {value!r} is no list of tables; write [[{self.place}{key}]]")
        return [replace(self, values=each, place=f"{self.place}{key} {k + 1}.") for k, each in enumerate(value)]

    def get(self, key: str, default: Any, hint: Any) -> Any:
        """Return a value that its annotation takes, no empty text; `default` where the key is missing."""
        value = self.values.get(key, default)
        if value is not None:
            check_value(self.at(key), value, hint, self.error)
        if value != default and "" in (value if isinstance(value, list) else [value]):
            raise self.error(f"{self.at(key)} is empty; write a text, or leave it out")
        return value

    def text(self, key: str, default: str | None) -> str | None:
        """Return a text that is not empty; `default` where the key is missing."""
        return self.get(key, default, str)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts, or the one that stands in its place; empty where the key is missing."""
        value = self.get(key, (), str | tuple[str, ...])
        return (value,) if isinstance(value, str) else tuple(value)

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """Return one of the choices."""
        choices, value = list(choices), self.text(key, default)
        if value not in choices:
            state = "is missing" if value is None else f"= '{value}' is not known"
            raise self.error(f"{self.at(key)} {state}; {one_of(choices, value)}")
        return value

    def names(self, key: str, count: int) -> list[str]:
        """Return a list of `count` different names of columns."""
        value = self.values.get(key)
        names = {name for name in value if isinstance(name, str)} if isinstance(value, list) else {}
        if not isinstance(value, list) or not len(value) == len(names) == count:
            state = "is missing" if value is None else f"= {value!r}"
            raise self.error(f"{self.at(key)} {state}; a list of {count} different column names is needed")
        return value


def is_number(value: Any, below: float = 1e300) -> TypeGuard[float]:
    """Return whether a value is a finite int or float smaller than `below`, and no boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < below


def format_value(value: Any) -> str:
    """Format a value for TOML; characters that cannot be encoded are replaced, a mapping is an inline table."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{toml_key(name)} = {format_value(each)}' for name, each in value.items())} }}"
    if isinstance(value, list | tuple):
        is_matrix = value and isinstance(value[0], list) and len(value[0]) > 3  # its rows stand one below the other
        separator = ",\n    " if is_matrix else ", "
        return f"[{separator.join(map(format_value, value))}]"
    sound = value.encode("utf-8", "replace").decode("utf-8") if isinstance(value, str) else value
    return json.dumps(sound, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_key(name: str) -> str:
    """Format a key for TOML: names of links and joints in a URDF may have any characters."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else format_value(name)


def format_toml(values: Mapping[str, Any], place: str = "") -> Iterator[str]:
    """Yield the lines of a TOML table: values, then tables of those by name."""
    for name, value in values.items():
        if not isinstance(value, Mapping):
            yield f"{toml_key(name)} = {format_value(value)}"
    for name, value in values.items():
        if isinstance(value, Mapping):
            heading = f"{place}{toml_key(name)}"
            if not value or any(not isinstance(each, Mapping) for each in value.values()):
                yield from ("", f"[{heading}]")
            yield from format_toml(value, f"{heading}.")


# Records -----------------------------------------------------------------------------------------------------------

_TO_SI = {"deg": math.pi / 180.0, "deg_min": math.pi / 180.0 / 60.0, "mm": 1e-3}  # of units in a file


@dataclass(frozen=True)
class Key:
    """How a field of a record is written in a TOML table, as in ``softness: Annotated[float, Key(unit="deg")]``.

    A field without it has a key of its own name; with None in its place the table has no such field. Fields are texts,
    numbers, flags, tuples of texts or of up to three numbers, arrays (k,) with `each`, NamedTuples, lists of those, and
    mappings of names to any of them, each a table. In place of a NamedTuple's table its first field alone may stand.
    """

    name: str = ""  # empty: that of the field, and the unit of a number, ``softness_deg``
    unit: str = ""  # of the file's numbers; of deg, deg_min and mm the field is in rad, rad/s and m
    least: float = -1e6  # limits of each number, in the file's unit
    most: float = 1e6
    of: str = ""  # what texts name; `read_record` is given the names that there are
    words: Mapping[str, Any] = field(default_factory=dict, hash=False)  # text in the file → value of the field
    each: tuple[str, ...] = ()  # the keys of an array's numbers; one that begins with "std" is at least 0
    unread: tuple[str, ...] = ()  # keys beside those, for whoever looks at the file
    digits: int | None = None  # decimals that are written; None: all that count


@cache
def _find_keys(kind: Callable[..., Any]) -> dict[str, tuple[Any, Key]]:
    """Return field → its type, without None, and its key."""
    keys = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        value_type, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if None in notes:
            continue
        key = next((note for note in notes if isinstance(note, Key)), Key())
        value_type = get_args(value_type)[0] if isinstance(value_type, UnionType) else value_type
        unit = "" if key.each else key.unit
        keys[name] = value_type, replace(key, name=key.name or "_".join(filter(None, (name, unit))))
    return keys


def read_record(
    kind: Callable[..., R],
    table: TomlTable,
    known: Mapping[str, Collection[str]] | None = None,
    base: Any = None,
    others: Collection[str] = (),
) -> R:
    """Read a NamedTuple, or a dataclass with a base, from a table; its errors are those of the table.

    Parameters
    ----------
    known : what texts name → the names that there are
    base : of the same kind, with the values of keys that the table lacks; None: the defaults
    others : further keys that the table may have
    """
    record: Any = kind if base is None else base
    values = dict(record._field_defaults if base is None else getattr(record, "_asdict", lambda: vars(base))())
    keys = _find_keys(kind)
    arrays = {name: key.each for name, (value_type, key) in keys.items() if get_origin(value_type) is not Mapping}
    table.allow(*(part for name, (_, key) in keys.items() for part in arrays.get(name) or (key.name,)), *others)
    for name, (value_type, key) in keys.items():
        if arrays.get(name) or table.values.get(key.name) is not None or name not in values:
            values[name] = _read_value(value_type, table, key, known or {}, values.get(name))
    return kind(**values)


def _read_value(hint: Any, table: TomlTable, key: Key, known: Mapping[str, Collection[str]], base: Any) -> Any:
    """Read the value of a key, of a type `hint`; `base` has what a table in its place lacks."""
    value, parts = table.values.get(key.name), get_args(hint)
    if hasattr(hint, "_fields"):
        if isinstance(value, str):
            table = replace(table, values={key.name: {next(iter(_find_keys(hint).values()))[1].name: value}})
        return read_record(hint, table.table(key.name), known, base)
    if get_origin(hint) is Mapping:
        entries, values = table.table(key.name), dict(base or {})
        for name in entries.values:
            own = entries.table(name) if key.each else entries
            if key.each:
                own.allow(*key.each, *key.unread)
            values[name] = _read_value(parts[1], own, replace(key, name=name), known, values.get(name))
        return values
    if key.each:
        least = {part: 0.0 if part.startswith("std") else key.least for part in key.each}
        keys = (replace(key, name=part, each=(), least=least[part]) for part in key.each)
        return np.array([_read_value(float, table, each, {}, None) for each in keys])
    names: Collection[str] = known[key.of] if key.of else key.words
    limits = Range(key.least, closed=True, high=key.most, unit=key.unit.replace("_", "/"))
    hint = str if key.words else Annotated[hint, limits] if float in (hint, *parts) else hint
    if value is None:
        needed = one_of(names) if names else f"{describe(hint)} is needed"
        raise table.error(f"{table.at(key.name)} is missing; {needed}")
    if isinstance(value, str) and str in parts and get_origin(hint) is tuple:
        value = [value]  # one name in place of a list
    replace(table, values={key.name: value}).get(key.name, None, hint)
    for text in value if isinstance(value, list) else [value]:
        if names and text not in names:
            raise table.error(f"{table.at(key.name)} = '{text}' is not known; {one_of(names, text)}")
    return key.words[str(value)] if key.words else _convert(value, key)


def _convert(value: Any, key: Key) -> Any:
    """Convert what stands in a file: numbers to SI, lists to tuples."""
    if isinstance(value, list):
        return tuple(_convert(each, key) for each in value)
    return value if isinstance(value, str | bool) else _TO_SI.get(key.unit, 1.0) * value


def format_record(record: Any) -> dict[str, Any]:
    """Return key → its value in a file, for `format_toml`; None, false and what is empty are left out."""
    values: dict[str, Any] = {}
    for name, (_, key) in _find_keys(record.__class__).items():
        value = getattr(record, name)
        if isinstance(value, np.ndarray):
            values |= _revert(value, key)
        elif value or isinstance(value, float):
            values[key.name] = _revert(value, key)
    return values


def _revert(value: Any, key: Key) -> Any:
    if isinstance(value, Mapping):
        return {name: _revert(each, key) for name, each in value.items()}
    if hasattr(value, "_fields"):
        return format_record(value)
    if isinstance(value, np.ndarray):
        return dict(zip(key.each, (_revert(float(each), key) for each in value), strict=True))
    if key.words:
        return next(word for word, meaning in key.words.items() if meaning == value)
    if isinstance(value, tuple):
        return tuple(_revert(each, key) for each in value)
    if isinstance(value, str | bool):
        return value
    digits = 6 if key.digits is None and key.unit in _TO_SI else key.digits
    value = float(value) / _TO_SI.get(key.unit, 1.0)
    return value if digits is None else round(value, digits)


# Atomic output -------------------------------------------------------------------------------------------------------


@contextmanager
def whole_folder(out: Path, force: bool = False, earlier: Sequence[str] = ()) -> Iterator[Path]:
    """Create a new folder to write into; its files move to `out` when the block succeeds, and are deleted otherwise.

    With `force`, files of the same name are replaced, other files that match the patterns `earlier` are deleted, and
    the rest stays. A killed process leaves at most a hidden folder, ``.NAME.partial-…``, beside `out`, or in an
    existing `out`; it is never read and can be deleted.

    Raise `ExistingOutput` where `out` is not empty and `force` is false, or it is no folder, or cannot be written.
    """
    prefix = f".{out.absolute().name}.partial-"
    _check_folder(out, force, prefix)
    # Inside an existing `out`: it may be a separate file system, or the only writable place.
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    try:
        own = tempfile.TemporaryDirectory(prefix=prefix, dir=existing, ignore_cleanup_errors=True)
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
    with own as folder, _name_output(out):
        partial = Path(folder) / "whole"  # with the user's usual permissions
        partial.mkdir()
        yield partial
        _check_folder(out, force, prefix)  # again: another run may have written there meanwhile
        targets = {path: out / path.relative_to(partial) for path in sorted(partial.rglob("*"))}
        for path, target in targets.items():
            if target.exists() and target.is_dir() != path.is_dir():
                raise ExistingOutput(f"{target}: is in the way; nothing was written, move it or name another folder")
        with ThreadPoolExecutor(1) as thread:  # in which no signal interrupts it
            thread.submit(_move_files, targets, partial, out, earlier).result()


def _move_files(targets: Mapping[Path, Path], partial: Path, out: Path, earlier: Sequence[str]) -> None:
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        partial.rename(out)
        return
    for path in {path for pattern in earlier for path in out.glob(pattern)} - {*targets.values()}:
        if not path.is_dir():
            path.unlink()
    for path, target in targets.items():
        target.mkdir(exist_ok=True) if path.is_dir() else path.replace(target)


def _check_folder(out: Path, force: bool, prefix: str) -> None:
    existing = next(path for path in (out.absolute(), *out.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise ExistingOutput(f"{out}: cannot be made: {existing} is a file; a folder is needed for the output")
    if not force and out.is_dir() and any(not path.name.startswith(prefix) for path in out.iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; `force=True` replaces its files, or name another folder")


@contextmanager
def whole_file(file: Path, force: bool = False) -> Iterator[Path]:
    """Create a path beside `file` to write to; it becomes `file` when the block succeeds, and is deleted otherwise.

    Raise `ExistingOutput` where `file` exists and `force` is false, or it cannot be written.
    """
    check_output(file, force)
    partial = file.with_name(f".{file.name}.partial")
    try:
        with _name_output(file):
            yield partial
            partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def check_output(file: Path, force: bool = False) -> None:
    """Raise `ExistingOutput` where `file` exists and `force` is false, or it cannot be a file."""
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise ExistingOutput(f"{file}: not a file that can be written; name a file in an existing folder")
    if file.exists() and not force:
        raise ExistingOutput(f"{file}: exists; `force=True` replaces it, or name another file")


@contextmanager
def _name_output(out: Path) -> Iterator[None]:
    """Name `out` in an error of the system, which names no file when the disk is full, or one that is deleted."""
    try:
        yield
    except Exception as error:
        # Those of polars and SQLite have a text but no number; that of a copy names its source first.
        number, text = getattr(error, "errno", None), getattr(error, "strerror", None) or str(error)
        files = f"{getattr(error, 'filename', None) or '.partial'} {getattr(error, 'filename2', None)}"
        if (number or re.search("os error|disk", text)) and ".partial" in files and not isinstance(error, WeposeError):
            raise OSError(number, text, str(out)) from error
        raise
