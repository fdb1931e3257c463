"""Two folders of results held against each other, bit for bit, with a table of renames."""

from __future__ import annotations

import fnmatch
import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np


class WrongUsage(Exception):
    """One line that says what is wrong with what was given."""


class Difference(NamedTuple):
    """`size`: the largest deviation; infinite where shapes differ or a number became NaN."""

    key: str
    size: float
    text: str


@dataclass(frozen=True)
class Renames:
    """A table of renames (TOML).

    ``[renames]``: pattern of an old key → what it is now, regular expressions applied one after the other to any part
    of the key. ``[reasons]``: pattern of a key → why it differs, is missing or new; such keys are counted apart and are
    no reason to fail.
    """

    renames: Mapping[str, str] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)

    def new_key(self, key: str) -> str:
        for pattern, replacement in self.renames.items():
            key = re.sub(pattern, replacement, key)
        return key

    def reason(self, key: str) -> str:
        return next((reason for pattern, reason in self.reasons.items() if re.search(pattern, key)), "")


@dataclass
class Comparison:
    """TomlTable are those of the new folder, those of missing ones what they would be there."""

    equal: list[str] = field(default_factory=list)
    different: list[Difference] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    new: list[str] = field(default_factory=list)
    explained: Counter[str] = field(default_factory=Counter)  # reason → keys

    @property
    def same(self) -> bool:
        return not (self.different or self.missing or self.new)


def read_renames(path: Path | None) -> Renames:
    """The table of renames in a file; none without one."""
    if path is None:
        return Renames()
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise WrongUsage(f"{path}: {error}") from None
    unknown = [name for name in tables if name not in ("renames", "reasons")]
    if unknown:
        raise WrongUsage(f"{path}: [{unknown[0]}] is not known; there are [renames] and [reasons]")
    for name, table in tables.items():
        for pattern, value in table.items():
            try:
                re.sub(pattern, value if name == "renames" else "", "")
            except (re.error, TypeError) as error:
                raise WrongUsage(f"{path}: {name}: '{pattern}': {error}; a regular expression and a text") from None
    return Renames(tables.get("renames", {}), tables.get("reasons", {}))


class Folder:
    """Results that `save` wrote; arrays are read when they are asked for."""

    def __init__(self, folder: Path) -> None:
        files = sorted((folder / "results").glob("*.npz"))
        if not files:
            raise WrongUsage(f"{folder}: no results/*.npz in it; a folder that `save` wrote is wanted here")
        self._files = [np.load(file) for file in files]
        self._of = {key: file for file in self._files for key in file.files}

    def __iter__(self) -> Iterator[str]:
        return iter(self._of)

    def __getitem__(self, key: str) -> np.ndarray:
        array: np.ndarray = self._of[key][key]
        return array


def compare(old: Folder, new: Folder, renames: Renames, only: str = "*") -> Comparison:
    """What is equal, different, missing and new of the keys that match `only`."""
    found = Comparison()
    before: dict[str, str] = {}
    for key in old:
        now = renames.new_key(key)
        if now in before:
            raise WrongUsage(f"renames: {key} and {before[now]} both become {now}")
        before[now] = key
    there = set(new)
    for key in sorted(key for key in {*before, *there} if fnmatch.fnmatch(key, only)):
        reason = renames.reason(key)
        difference = None
        if key in before and key in there:
            difference = difference_of(key, old[before[key]], new[key])
            if difference is None:
                found.equal.append(key)
                continue
        if reason:
            found.explained[reason] += 1
        elif difference is not None:
            found.different.append(difference)
        else:
            (found.new if key in there else found.missing).append(key)
    return found


def difference_of(key: str, old: np.ndarray, new: np.ndarray) -> Difference | None:
    """How two arrays differ; None where all bits are the same."""
    if old.shape != new.shape:
        return Difference(key, np.inf, f"shape {old.shape} → {new.shape}")
    if old.tobytes() == new.tobytes():
        return None
    turned = int(np.sum(np.isnan(old) != np.isnan(new)))
    if turned:
        return Difference(key, np.inf, f"{turned} of {old.size} are NaN in one alone")
    differs = ~((old == new) | (np.isnan(old) & np.isnan(new)))
    size = float(np.nanmax(np.abs(np.subtract(new, old, where=differs, out=np.zeros_like(old))), initial=0.0))
    count = int(differs.sum())
    text = f"largest deviation {size:.3g}, {count} of {old.size}" if count else "a zero has another sign"
    return Difference(key, size, text)


def print_comparison(found: Comparison, most: int) -> None:
    """The counts, and up to `most` keys of each kind."""
    different = sorted(found.different, key=lambda each: -each.size)
    for title, lines in (
        ("different", [f"{each.key}: {each.text}" for each in different]),
        ("missing", found.missing),
        ("new", found.new),
    ):
        if lines:
            print(f"{title}:")
            print("\n".join(f"  {line}" for line in lines[:most]))
            if len(lines) > most:
                print(f"  and {len(lines) - most} more; by their beginnings:")
                for group, count in Counter("/".join(line.split("/")[:3]) for line in lines).most_common(most):
                    print(f"    {count:5d} {group}")
    for reason, count in found.explained.items():
        print(f"explained: {count} keys: {reason}")
    print(
        f"{len(found.equal)} keys equal, {len(found.different)} different, {len(found.missing)} missing, "
        f"{len(found.new)} new, {found.explained.total()} explained"
    )
