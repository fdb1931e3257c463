"""A TOML file with its place kept, so that each error can say where in it the trouble is."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import BadSession, MissingFile, one_of

# Endings of files that hold the data themselves.
DATA = (".csv", ".parquet", ".txt", ".mat", ".h5", ".hdf5", ".mvnx", ".sto", ".wepose")


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The contents of a TOML file; `what` is wanted there, for the error's text.

    Raises
    ------
    MissingFile
        Not there, or not readable as text.
    BadSession
        Not TOML.
    """
    if path.suffix.lower() in DATA:
        raise BadSession(
            f"{path}: is a table of data by its name; {what} is wanted here, which names the table (`wepose info "
            f"{path.name} --write` writes one)"
        )
    if path.exists() and not path.is_file():
        raise MissingFile(f"{path}: is {'a folder' if path.is_dir() else 'no regular file'}; {what} is wanted here")
    try:
        return parsed_toml(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise MissingFile(f"{path}: no such file; {what} is wanted here") from None
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise MissingFile(f"{path}: is not UTF-8 text (byte {error.start}); {what} is wanted here") from error
    except ValueError as error:
        raise BadSession(f"{path}: not valid TOML: {' '.join(str(error).split())}") from error


def parsed_toml(text: str) -> dict[str, Any]:
    """The contents of a TOML text; raises ValueError, whatever is wrong with it."""
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # which some editors put before
    except RecursionError:
        raise ValueError("tables or lists within each other to no end") from None


@dataclass(frozen=True)
class Keys:
    """A TOML table, the file it is in, and its place there with a dot at the end, such as ``sensors.torso.``."""

    values: Mapping[str, Any]
    file: str
    place: str = ""

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        return f"{self.file}: {self.place}{key}"

    def allow(self, *known: str, renamed: Mapping[str, str] | None = None) -> None:
        """Refuse keys that are not known; `renamed` says what to write in place of those of an earlier version."""
        for key in self.values:
            if renamed and key in renamed:
                raise BadSession(f"{self.at(key)} {renamed[key]}")
            if key not in known:
                raise BadSession(f"{self.at(key)} is not a known key; {one_of(known, key)}")

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> Keys:
        value = self.values.get(key, default)
        if value is None:
            raise BadSession(f"{self.at(key)} is missing; a table [{self.place}{key}] is needed{self._close(key)}")
        if not isinstance(value, dict):
            raise BadSession(f"{self.at(key)} = {value!r} is not a table; write [{self.place}{key}]")
        return Keys(value, self.file, f"{self.place}{key}.")

    def text(self, key: str, default: str | None) -> str | None:
        value = self.values.get(key, default)
        if value is not None and (not isinstance(value, str) or not value):
            raise BadSession(f"{self.at(key)} = {value!r} is not a text; write it in quotes")
        return value

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        choices = list(choices)
        value = self.text(key, default)
        if value is None:
            raise BadSession(f"{self.at(key)} is missing; {one_of(choices)}")
        if value not in choices:
            raise BadSession(f"{self.at(key)} = '{value}' is not known; {one_of(choices, value)}")
        return value

    def flag(self, key: str) -> bool:
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            raise BadSession(f"{self.at(key)} = {value!r} is neither true nor false")
        return value

    def number(self, key: str, default: float | None, positive: bool = False) -> float | None:
        value = self.values.get(key, default)
        if value is None:
            return None
        if not is_number(value):
            raise BadSession(f"{self.at(key)} = {_toml(value)} is not a number")
        if positive and value <= 0:
            raise BadSession(f"{self.at(key)} = {value!r} must be greater than 0")
        return float(value)

    def names(self, key: str, count: int) -> list[str]:
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != count or not all(isinstance(v, str) for v in value):
            found = "missing" if value is None else _toml(value)
            close = self._close(key) if value is None else ""
            raise BadSession(f"{self.at(key)} is {found}; a list of {count} column names is needed{close}")
        if len(set(value)) < count:
            raise BadSession(f"{self.at(key)} names a column twice: {_toml(value)}; {count} different ones are needed")
        return value

    def _close(self, key: str) -> str:
        """For a missing key: what stands in its place, where that is close."""
        found = one_of(self.values, key)
        return f"; {found}" if found.startswith("did") else ""


def is_number(value: Any, below: float = 1e300) -> bool:
    """A finite int or float smaller than `below`; a boolean is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < below


def _toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)
