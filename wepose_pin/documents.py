"""Reading of TOML with checks, writing of TOML, and atomic output of folders and files."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from numbers import Real
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeGuard, TypeVar, get_args, get_origin, get_type_hints

from .errors import BadSession, ExistingOutput, MissingFile, WeposeError, one_of

R = TypeVar("R")

# Reading -----------------------------------------------------------------------------------------------------------


def read_toml(path: Path, what: str, error: type[WeposeError] = BadSession) -> dict[str, Any]:
    """Read a TOML file; `what` names the expected contents in an error's text.

    Raises
    ------
    MissingFile
        The file is missing, or cannot be read.
    WeposeError
        It is not TOML; an error of the kind `error`.
    """
    if not path.is_file():
        state = "is a folder" if path.is_dir() else "is no regular file" if path.exists() else "no such file"
        raise MissingFile(f"{path}: {state}; {what} is wanted here")
    try:
        return parse_toml(path.read_bytes().decode("utf-8-sig"))
    except OSError as failure:
        raise MissingFile(f"{path}: cannot be read: {failure.strerror}") from failure
    except ValueError as failure:
        raise error(f"{path}: not valid TOML: {' '.join(str(failure).split())}; {what} is wanted here") from failure


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text; any error is a ValueError."""
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # some editors write a byte-order mark
    except RecursionError:
        raise ValueError("tables or lists within each other to no end") from None


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

    def allow(self, *known: str, renamed: Mapping[str, str] | None = None) -> None:
        """Refuse unknown keys; `renamed` has the advice for keys of an earlier version."""
        for key in self.values:
            if renamed and key in renamed:
                raise self.error(f"{self.at(key)} {renamed[key]}")
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

    def text(self, key: str, default: str | None) -> str | None:
        """Return a text that is not empty; `default` where the key is missing."""
        value = self.values.get(key, default)
        if value is not None and (not isinstance(value, str) or not value):
            raise self.error(f"{self.at(key)} = {value!r} is not a text; write it in quotes")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts, or the one that stands in its place; empty where the key is missing."""
        value = self.values.get(key) or ()
        value = (value,) if isinstance(value, str) else value
        if not isinstance(value, list | tuple) or not all(isinstance(each, str) for each in value):
            raise self.error(f"{self.at(key)} = {value!r}; a name is wanted, or a list of names")
        return tuple(value)

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """Return one of the choices."""
        choices, value = list(choices), self.text(key, default)
        if value not in choices:
            state = "is missing" if value is None else f"= '{value}' is not known"
            raise self.error(f"{self.at(key)} {state}; {one_of(choices, value)}")
        return value

    def flag(self, key: str) -> bool:
        """Return true or false; false where the key is missing."""
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            raise self.error(f"{self.at(key)} = {value!r} is neither true nor false")
        return value

    def number(self, key: str, default: float | None) -> float | None:
        """Return a finite number; `default` where the key is missing."""
        value = self.values.get(key, default)
        if value is None:
            return None
        if not is_number(value):
            raise self.error(f"{self.at(key)} = {_format_value(value)} is not a number")
        return float(value)

    def names(self, key: str, count: int) -> list[str]:
        """Return a list of `count` different names of columns."""
        value = self.values.get(key)
        names = [name for name in value if isinstance(name, str)] if isinstance(value, list) else []
        if names != value or len(names) != count or len(set(names)) < count:
            state = "is missing" if value is None else f"= {_format_value(value)}"
            raise self.error(f"{self.at(key)} {state}; a list of {count} different column names is needed")
        return names


def is_number(value: Any, below: float = 1e300) -> TypeGuard[float]:
    """Return whether a value is a finite int or float smaller than `below`, and no boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < below


def _format_value(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


# Writing -----------------------------------------------------------------------------------------------------------


def toml_string(text: str) -> str:
    """Format a text for TOML: as JSON, with characters replaced that cannot be encoded, and DEL escaped."""
    sound = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(sound, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_strings(texts: Iterable[str]) -> str:
    """Format a list of texts for TOML."""
    return f"[{', '.join(map(toml_string, texts))}]"


def toml_key(name: str) -> str:
    """Format a key for TOML: names of links and joints in a URDF may have any characters."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_string(name)


# Records -----------------------------------------------------------------------------------------------------------

_COUNTS = ("", "a number", "two numbers", "three numbers")
# Unit in a file → to SI, and back.
_UNITS: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "deg": (math.radians, math.degrees),
    "deg_min": (lambda value: math.radians(value) / 60.0, lambda value: 60.0 * math.degrees(value)),
    "mm": (lambda value: 1e-3 * value, lambda value: 1e3 * value),
}


@dataclass(frozen=True)
class Key:
    """How a field of a record is written in a TOML table, as in ``softness: Annotated[float, Key(unit="deg")]``.

    A field without it has a key of its own name; with None in its place the table has no such field. Fields are texts,
    numbers, flags, tuples of texts or of up to three numbers, arrays (k,) with `each`, NamedTuples, lists of those, and
    mappings of names to any of them, each a table. In place of a NamedTuple's table its first field alone may stand.
    """

    name: str = ""  # empty: that of the field and the unit, ``softness_deg``
    unit: str = ""  # of the file's numbers; of deg, deg_min and mm the field is in rad, rad/s and m
    least: float = -1e6  # limits of each number, in the file's unit
    most: float = 1e6
    of: str = ""  # what texts name; `read_record` is given the names that there are
    words: Mapping[str, Any] = field(default_factory=dict, hash=False)  # text in the file → value of the field
    omit_zero: bool = False  # zeros are not written
    each: tuple[str, ...] = ()  # the keys of an array's numbers
    unread: tuple[str, ...] = ()  # keys beside those, in tables of arrays, written for whoever looks at the file
    digits: int | None = None  # decimals that are written; None: all that count
    comment: str = ""  # behind the heading of a table


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
        keys[name] = value_type, replace(key, name=key.name or "_".join(filter(None, (name, key.unit))))
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
        if arrays.get(name) or table.values.get(key.name) is not None:
            values[name] = _read_value(value_type, table, key, known or {}, values.get(name))
        elif name not in values:
            raise table.error(f"{table.at(key.name)} is missing; {_describe(value_type, key, known or {})} needed")
    return kind(**values)


def _describe(value_type: Any, key: Key, known: Mapping[str, Collection[str]], value: Any = None) -> str:
    """Describe what is right in place of `value`, with its verb, as "two numbers [mm] from 0 to 90 are"."""
    parts = get_args(value_type) or (value_type,)
    if parts[0] is not float:
        choices = f" ({one_of(known.get(key.of, key.words))})" if key.of or key.words else ""
        one = "a table" if hasattr(value_type, "_fields") else "a list of names" if ... in parts else "a text"
        return "three names are" if len(parts) == 3 else f"{one}{choices} is"
    unit = f" [{key.unit.replace('_', '/')}]" if key.unit else ""
    limits = f" from {key.least:g}{f' to {key.most:g}' if key.most < 1e6 else ' on'}" if key.least > -1e6 else ""
    numbers = [each for each in (value if isinstance(value, list | tuple) else (value,)) if is_number(each)]
    if any(each > key.most or (each < key.least and not limits) for each in numbers):
        limits = f" from {key.least:g} to {key.most:g}"
    return f"{_COUNTS[len(parts)]}{unit}{limits} {'are' if len(parts) > 1 else 'is'}"


def _read_value(value_type: Any, table: TomlTable, key: Key, known: Mapping[str, Collection[str]], base: Any) -> Any:
    value, parts = table.values.get(key.name), get_args(value_type)
    if hasattr(value_type, "_fields"):
        if isinstance(value, str):
            table = replace(table, values={key.name: {next(iter(_find_keys(value_type).values()))[1].name: value}})
        return read_record(value_type, table.table(key.name), known, base)
    if get_origin(value_type) is Mapping:
        entries = table.table(key.name)
        if key.each:
            for entry in map(entries.table, entries.values):
                entry.allow(*key.each, *key.unread)
            return {name: _read_value(parts[1], entries.table(name), key, known, None) for name in entries.values}
        return {**(base or {})} | {
            name: _read_value(parts[1], entries, replace(key, name=name), known, (base or {}).get(name))
            for name in entries.values
        }
    if key.each:
        import numpy as np  # not for whoever reads none

        return np.array([_read_value(float, table, replace(key, name=part, each=()), {}, None) for part in key.each])
    if key.words:
        return key.words[table.choice(key.name, key.words)]
    if get_origin(value_type) is Literal:
        return table.choice(key.name, filter(None, parts))
    if value_type is bool:
        return table.flag(key.name)
    if value_type is str:
        return table.choice(key.name, known[key.of]) if key.of else table.text(key.name, None)
    if str in parts:
        texts = table.texts(key.name)
        for text in texts if key.of else ():
            if text not in known[key.of]:
                raise table.error(f"{table.at(key.name)}: '{text}' is not known; {one_of(known[key.of], text)}")
        if ... in parts or len(texts) == len(parts):
            return texts
    elif ... in parts and isinstance(value, list):  # of lists
        rows = (replace(table, values={key.name: row}) for row in value)
        return tuple(_read_value(parts[0], row, key, known, None) for row in rows)
    elif parts or value_type is float:
        numbers = value if parts and isinstance(value, list | tuple) else [value]
        each = [_to_si(key, number) for number in numbers if is_number(number) and key.least <= number <= key.most]
        if len(each) == len(numbers) == max(len(parts), 1):
            return tuple(each) if parts else each[0]
    state = f" = {_format_value(value)};" if key.name in table else " is missing;"
    raise table.error(f"{table.at(key.name)}{state} {_describe(value_type, key, known, value)} needed")


def _to_si(key: Key, value: float) -> float:
    return _UNITS[key.unit][0](value) if key.unit in _UNITS else float(value)


def format_record(record: Any, unread: Mapping[str, Sequence[str]] | None = None) -> list[str]:
    """Return the lines of a record in a TOML file, tables last; None, false and what is empty are left out.

    `unread` : heading of a table → lines beside those of its fields.
    """
    lines, tables = [], []
    for name, (value_type, key) in _find_keys(record.__class__).items():
        value, comment = getattr(record, name), f"   # {key.comment}" if key.comment else ""
        if isinstance(value, Mapping):
            if value or float in get_args(value_type):
                tables += _format_mapping(key, value, comment, unread or {})
        elif key.each:
            lines += _format_each(key, value)
        elif not (value is None or value is False or (isinstance(value, str | tuple) and not value)) and (
            not key.omit_zero or any(value)
        ):
            lines.append(f"{key.name} = {_format_field(key, value)}{comment}")
    return lines + tables


def _format_mapping(
    key: Key, values: Mapping[str, Any], comment: str, unread: Mapping[str, Sequence[str]]
) -> list[str]:
    if all(isinstance(value, Real | str) for value in values.values()):
        numbers = {name: value if isinstance(value, str) else float(value) for name, value in values.items()}
        own = [f"{toml_key(name)} = {_format_field(key, value)}" for name, value in numbers.items()]
        return ["", f"[{key.name}]{comment}", *own]
    lines = []
    for name, value in values.items():
        heading = f"{key.name}.{toml_key(name)}"
        if isinstance(value, Mapping):
            lines += _format_mapping(replace(key, name=heading), value, comment, unread)
        else:
            own = _format_each(key, value) if key.each else format_record(value)
            lines += ["", f"[{heading}]{comment}", *own, *unread.get(heading, ())]
    return lines


def _format_each(key: Key, values: Iterable[float]) -> list[str]:
    return [f"{part} = {_format_field(key, float(value))}" for part, value in zip(key.each, values, strict=True)]


def _format_field(key: Key, value: Any) -> str:
    if key.words:
        return toml_string(next(word for word, meaning in key.words.items() if meaning == value))
    if hasattr(value, "_fields"):
        return f"{{ {', '.join(format_record(value))} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(_format_field(key, each) for each in value)}]"
    if isinstance(value, float) and key.unit in _UNITS:
        value = round(_UNITS[key.unit][1](value), 6 if key.digits is None else key.digits)
    if isinstance(value, float) and key.digits is not None:
        return f"{value:.{key.digits}f}"
    return toml_string(value) if isinstance(value, str) else _format_value(value)


# Atomic output -------------------------------------------------------------------------------------------------------

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
written: list[Path] = []  # complete output folders, for the message of a command that is interrupted


@contextmanager
def whole_folder(out: Path, force: bool = False) -> Iterator[Path]:
    """Create a new folder to write into; its files move to `out` when the block succeeds, and are deleted otherwise.

    With `force`, files of the same name are replaced and all others stay. A killed process leaves at most a hidden
    folder, ``.NAME.partial-…``, beside `out`, or in an existing `out`; it is never read and can be deleted. A new `out`
    appears at once with all its files; in an existing one they appear one by one, each complete.

    Raises
    ------
    ExistingOutput
        `out` is not empty and `force` is false, or it is no folder, or cannot be written.
    """
    prefix = f".{out.absolute().name}.partial-"
    _check_folder(out, force, prefix)
    # Inside an existing `out`: it may be a separate file system, or the only writable place.
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    try:
        own = Path(tempfile.mkdtemp(prefix=prefix, dir=existing))
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
    try:
        partial = own / "whole"  # with the user's usual permissions
        partial.mkdir()
        with _report_full_disk(out):
            yield partial
        _check_folder(out, force, prefix)  # again: another run may have written there meanwhile
        if out.exists():
            targets = {path: out / path.relative_to(partial) for path in sorted(partial.rglob("*"))}
            for path, target in targets.items():
                if target.exists() and target.is_dir() != path.is_dir():
                    raise ExistingOutput(
                        f"{target}: is in the way; nothing was written, move it or name another folder"
                    )
            for path, target in targets.items():
                target.mkdir(exist_ok=True) if path.is_dir() else path.replace(target)
        else:
            out.parent.mkdir(parents=True, exist_ok=True)
            partial.rename(out)
        written.append(out)
    finally:
        shutil.rmtree(own, ignore_errors=True)


def _check_folder(out: Path, force: bool, prefix: str) -> None:
    existing = next(path for path in (out.absolute(), *out.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise ExistingOutput(f"{out}: cannot be made: {existing} is a file; a folder is wanted for the output")
    if not force and out.is_dir() and any(not path.name.startswith(prefix) for path in out.iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; --force replaces its files, -o names another folder")


@contextmanager
def whole_file(file: Path, force: bool = False) -> Iterator[Path]:
    """Create a path beside `file` to write to; it becomes `file` when the block succeeds, and is deleted otherwise.

    Raises
    ------
    ExistingOutput
        `file` exists and `force` is false, or it cannot be written.
    """
    check_file(file, force)
    partial = file.with_name(f".{file.name}.partial")
    try:
        with _report_full_disk(file):
            yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def check_file(file: Path, force: bool = False) -> None:
    """Raise `ExistingOutput` where `file` exists and `force` is false, or it cannot be a file."""
    if file.exists() and not force:
        raise ExistingOutput(f"{file}: exists; --force replaces it, -o names another file")
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise ExistingOutput(f"{file}: not a file that can be written; -o names a file in an existing folder")


@contextmanager
def _report_full_disk(out: Path) -> Iterator[None]:
    """Raise an error that names the output when the disk is full; the system's error names no file, or an input."""
    try:
        yield
    except OSError as error:
        # An error of polars has the system's text but no number.
        if error.errno in _FULL or any(os.strerror(number) in str(error) for number in _FULL):
            why = error.strerror or str(error)
            raise ExistingOutput(f"{out}: cannot be written: {why}; nothing was written") from error
        raise
