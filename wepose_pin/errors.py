"""The errors a user can cause; every one is a `WeposeError` whose text is one line.

The text names the file, the place in it, the value found and what would be right. The command line prints it and
exits with 2; from Python it is an ordinary exception.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class WeposeError(Exception):
    """Wrong input; the base of all errors this package raises on purpose."""


class MissingFile(WeposeError):
    """A file or folder that is named is not there, or cannot be read."""


class ExistingOutput(WeposeError):
    """The output exists already and `--force` was not given."""


class BadSession(WeposeError):
    """`session.toml` lacks a key, has one too many, or a value of the wrong kind."""


class UnknownColumn(WeposeError):
    """A column that the session names is not in the data."""


class BadData(WeposeError):
    """The recorded numbers cannot be a recording: text, NaN, time that goes back, lengths that differ."""


class BadPhase(WeposeError):
    """A phase is missing, empty, or outside the recording."""


class BadSubject(WeposeError):
    """`subject.toml` is malformed, or lacks what the work at hand needs."""


class BadModel(WeposeError):
    """A URDF that cannot be read, or that is not the body this work needs."""


class BadOption(WeposeError):
    """An option's value is outside what it may be."""


class BadSource(WeposeError):
    """A live source cannot be opened: no port, no stream, no device that answers."""


class NoSolution(WeposeError):
    """A problem that was well posed by its form has no solution on these data."""


def one_of(names: Iterable[str], found: str | None = None, most: int = 12) -> str:
    """The choices for an error's end: ``a, b, c`` with the closest to `found` named first."""
    choices = list(names)
    listed = ", ".join(choices[:most]) + (", …" if len(choices) > most else "")
    close = get_close_matches(found, choices, n=1) if found else []
    return f"did you mean '{close[0]}'? there is: {listed}" if close else f"there is: {listed or 'none'}"
