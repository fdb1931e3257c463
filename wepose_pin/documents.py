"""TOML read with checks and written; output folders and files that appear whole or not at all.

The checks are ours: msgspec's errors name the kind that was expected, and neither the value that was found, nor the
choices, nor which of several tables (`$.sensors[...]`); a user needs all three.
"""

from __future__ import annotations

import contextlib
import errno
import json
import re
import shutil
import signal
import tempfile
import threading
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, TypeGuard

from .errors import BadSession, ExistingOutput, MissingFile, WeposeError, one_of

# Reading -----------------------------------------------------------------------------------------------------------


def read_toml(path: Path, what: str, error: type[WeposeError] = BadSession) -> dict[str, Any]:
    """The contents of a TOML file; `what` is wanted there, for the error's text.

    Raises
    ------
    MissingFile
        Not there, or not readable as text.
    WeposeError
        Not TOML; of the kind `error`.
    """
    if path.exists() and not path.is_file():
        raise MissingFile(f"{path}: is {'a folder' if path.is_dir() else 'no regular file'}; {what} is wanted here")
    try:
        return parse_toml(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise MissingFile(f"{path}: no such file; {what} is wanted here") from None
    except OSError as failure:
        raise MissingFile(f"{path}: cannot be read: {failure.strerror}") from failure
    except UnicodeDecodeError as failure:
        raise MissingFile(f"{path}: is not UTF-8 text (byte {failure.start}); {what} is wanted here") from failure
    except ValueError as failure:
        raise error(f"{path}: not valid TOML: {' '.join(str(failure).split())}") from failure


def parse_toml(text: str) -> dict[str, Any]:
    """The contents of a TOML text; raises ValueError, whatever is wrong with it."""
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # which some editors put before
    except RecursionError:
        raise ValueError("tables or lists within each other to no end") from None


@dataclass(frozen=True)
class TomlTable:
    """A TOML table with its place, so that each error says where in which file the trouble is.

    Parameters
    ----------
    values : what it holds
    file : the file, or what else begins an error's text
    place : its name in the file with a dot at the end, such as ``sensors.torso.``
    error : the kind of error that is raised
    """

    values: Mapping[str, Any]
    file: str
    place: str = ""
    error: type[WeposeError] = BadSession

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        """File and place of a key, for the beginning of an error's text."""
        return f"{self.file}: {self.place}{key}"

    @property
    def where(self) -> str:
        """File and place of the table itself."""
        return self.at("").removesuffix(".")

    def allow(self, *known: str, renamed: Mapping[str, str] | None = None) -> None:
        """Refuse keys that are not known; `renamed` says what to write in place of those of an earlier version."""
        for key in self.values:
            if renamed and key in renamed:
                raise self.error(f"{self.at(key)} {renamed[key]}")
            if key not in known:
                raise self.error(f"{self.at(key)} is not a known key; {one_of(known, key)}")

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> TomlTable:
        """The table of that name; an error where there is none and no `default`."""
        value = self.values.get(key, default)
        if value is None:
            raise self.error(f"{self.at(key)} is missing; a table [{self.place}{key}] is needed{self._closest(key)}")
        if not isinstance(value, Mapping):
            raise self.error(f"{self.at(key)} = {value!r} is not a table; write [{self.place}{key}]")
        return replace(self, values=value, place=f"{self.place}{key}.")

    def tables(self, names: Collection[str], kind: str) -> dict[str, TomlTable]:
        """Name → table of all that it holds; a name that is none of `names` is not a `kind`."""
        for name in self.values:
            if name not in names:
                raise self.error(f"{self.at(name)} is not a {kind}; {one_of(names, name)}")
        return {name: self.table(name) for name in self.values}

    def text(self, key: str, default: str | None) -> str | None:
        """A text that is not empty; `default` where the key is missing."""
        value = self.values.get(key, default)
        if value is not None and (not isinstance(value, str) or not value):
            raise self.error(f"{self.at(key)} = {value!r} is not a text; write it in quotes")
        return value

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """One of the choices."""
        choices = list(choices)
        value = self.text(key, default)
        if value is None:
            raise self.error(f"{self.at(key)} is missing; {one_of(choices)}")
        if value not in choices:
            raise self.error(f"{self.at(key)} = '{value}' is not known; {one_of(choices, value)}")
        return value

    def flag(self, key: str) -> bool:
        """True or false; false where the key is missing."""
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            raise self.error(f"{self.at(key)} = {value!r} is neither true nor false")
        return value

    def number(self, key: str, default: float | None, positive: bool = False) -> float | None:
        """A finite number; `default` where the key is missing."""
        value = self.values.get(key, default)
        if value is None:
            return None
        if not is_number(value):
            raise self.error(f"{self.at(key)} = {_shown(value)} is not a number")
        if positive and value <= 0:
            raise self.error(f"{self.at(key)} = {value!r} must be greater than 0")
        return float(value)

    def numbers(self, *names: str, most: float = 1e6) -> list[float]:
        """The finite numbers of these keys, all of which are needed; a standard deviation is not negative."""
        values: list[float] = []
        for name in names:
            value = self.values.get(name)
            if not is_number(value) or abs(value) > most or (name.startswith("std") and value < 0.0):
                found = f"{name} = {_shown(value)}" if name in self else f"no {name}"
                raise self.error(
                    f"{self.where} has {found}; it needs {', '.join(names)}: numbers up to {most:g}, std from 0 on"
                )
            values.append(float(value))
        return values

    def names(self, key: str, count: int) -> list[str]:
        """A list of so many different names of columns."""
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != count or not all(isinstance(v, str) for v in value):
            found = "missing" if value is None else _shown(value)
            closest = self._closest(key) if value is None else ""
            raise self.error(f"{self.at(key)} is {found}; a list of {count} column names is needed{closest}")
        if len(set(value)) < count:
            raise self.error(f"{self.at(key)} names a column twice: {_shown(value)}; {count} different ones are needed")
        return value

    def _closest(self, key: str) -> str:
        """For a missing key: what stands in its place, where that is close."""
        found = one_of(self.values, key)
        return f"; {found}" if found.startswith("did") else ""


def is_number(value: Any, below: float = 1e300) -> TypeGuard[float]:
    """A finite int or float smaller than `below`; a boolean is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < below


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


# Writing -----------------------------------------------------------------------------------------------------------


def toml_string(text: str) -> str:
    """A text as TOML has it: as JSON, but for what cannot be encoded and for DEL, which TOML wants escaped."""
    sound = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(sound, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_strings(texts: Iterable[str]) -> str:
    """A list of texts as TOML has it."""
    return f"[{', '.join(map(toml_string, texts))}]"


def toml_key(name: str) -> str:
    """A key as TOML has it: links and joints of a URDF may be called anything."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_string(name)


# Whole or not at all -------------------------------------------------------------------------------------------------

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
written: list[Path] = []  # the folders that appeared, for whoever is stopped and says what there is


@contextmanager
def whole_folder(out: Path, force: bool = False) -> Iterator[Path]:
    """A new folder to write into; its files move to `out` when the block ends well, and vanish when it does not.

    With `force`, files of the same name are replaced and all others stay. A process that is killed leaves at most a
    hidden folder, ``.NAME.partial-…``, beside `out`, or in it where it was there already; nobody looks into it, and it
    can be deleted. Where `out` was not there, it appears at once with all that is in it; else file by file, each whole.

    Raises
    ------
    ExistingOutput
        `out` holds something and `force` is not given, or it is no folder, or cannot be written.
    """
    _check(out, force)
    # Inside `out` where it exists: it may be a file system of its own, or the only place that can be written to.
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    if not existing.is_dir():
        raise ExistingOutput(f"{out}: cannot be made: {existing} is a file")
    own: Path | None = None
    try:
        try:
            with _undisturbed():
                own = Path(tempfile.mkdtemp(prefix=_prefix(out), dir=existing))
            partial = own / "whole"  # which others may read, as far as the user lets them
            partial.mkdir()
        except OSError as error:
            raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
        with _full_told(out):
            yield partial
        with _undisturbed():
            _move(partial, out, force)
            written.append(out)
    finally:
        if own is not None:
            shutil.rmtree(own, ignore_errors=True)


@contextmanager
def whole_file(file: Path, force: bool = False) -> Iterator[Path]:
    """A path beside `file` to write to; what stands there becomes `file` when the block ends well, else vanishes.

    Raises
    ------
    ExistingOutput
        `file` is there and `force` is not given, or it cannot be written.
    """
    check_file(file, force)
    partial = file.with_name(f".{file.name}.partial")
    try:
        with _full_told(file):
            yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def check_file(file: Path, force: bool = False) -> None:
    """Raise `ExistingOutput` where `file` is there and `force` is not given, or it cannot be a file."""
    if file.exists() and not force:
        raise ExistingOutput(f"{file}: exists; --force replaces it, -o names another file")
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise ExistingOutput(f"{file}: not a file that can be written; -o names a file in an existing folder")


@contextmanager
def _full_told(out: Path) -> Iterator[None]:
    """A disk that is full in a line that names the output: the system's own error names no file, or an input."""
    try:
        yield
    except OSError as error:
        # polars gives the system's words and no number.
        if error.errno in _FULL or "No space left" in str(error):
            reason = error.strerror or str(error)
            raise ExistingOutput(f"{out}: cannot be written: {reason}; nothing was written") from error
        raise


def _move(partial: Path, out: Path, force: bool) -> None:
    made = sorted(partial.rglob("*"))
    _check(out, force)  # again: another run may have written there meanwhile
    for path in made:
        target = out / path.relative_to(partial)
        if target.exists() and target.is_dir() != path.is_dir():
            raise ExistingOutput(f"{target}: is in the way; nothing was written, move it or name another folder")
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # somebody made it just now
            partial.rename(out)
            return
        _check(out, force)
    for path in made:
        if path.is_dir():
            (out / path.relative_to(partial)).mkdir(parents=True, exist_ok=True)
    for path in made:
        if path.is_file():
            path.replace(out / path.relative_to(partial))


def _prefix(out: Path) -> str:
    return f".{out.absolute().name}.partial-"


def _check(out: Path, force: bool) -> None:
    if out.is_symlink() and not out.exists():
        raise ExistingOutput(f"{out}: is a link to nothing; name a folder")
    if out.exists() and not out.is_dir():
        raise ExistingOutput(f"{out}: is a file; a folder is wanted for the output")
    if not force and out.is_dir() and any(not p.name.startswith(_prefix(out)) for p in out.absolute().iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; --force replaces its files, -o names another folder")


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Signals that stop a command wait until the block has ended; only the main thread has them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            if callable(before[number]):
                signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        for number, handler in before.items():
            if callable(handler):
                signal.signal(number, handler)
        for which, frame in came[:1]:
            handler = before[signal.Signals(which)]
            if callable(handler):
                handler(which, frame)
