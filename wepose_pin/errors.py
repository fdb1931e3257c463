"""The errors a user can cause; every one is a `WeposeError` whose text is one line.

The text names the file, the place in it, the value found and what would be right, and has arguments in backticks. The
command line prints it with its options in place of arguments and exits with 2; from Python it is an ordinary exception.
"""

import contextlib
import os
import threading
from collections.abc import Iterable, Iterator, Mapping
from difflib import SequenceMatcher
from typing import TypeVar

T = TypeVar("T")

LONGEST, END = 2000, 500  # letters of an error's text, and of its end, which says what would be right
ALIKE = 0.6  # likeness of two names, from which on one may be meant by the other


class WeposeError(Exception):
    """Wrong input, in one line that names the place, the value and what would be right.

    It is the base of all errors that this package raises on purpose. `BadOption` is a `ValueError` too, and a name that
    a result does not have is a `KeyError`.
    """

    def __str__(self) -> str:
        text = printable(Exception.__str__(self))  # not that of KeyError, which is a repr
        return text if len(text) <= LONGEST else f"{text[: LONGEST - END]} … {text[-END:]}"


class MissingFile(WeposeError):
    """A file or folder that is named is not there, or cannot be read."""


class ExistingOutput(WeposeError):
    """The output exists already and `force` was not given."""


class BadSession(WeposeError):
    """`session.toml` lacks a key, has one too many, or a value of the wrong kind."""


class UnknownKey(WeposeError, KeyError):
    """A result has nothing of this name."""


class Named(dict[str, T]):
    """Values by name, of a `kind` such as "point"; an unknown name raises `UnknownKey`, which lists the known ones."""

    def __init__(self, kind: str, values: Mapping[str, T]) -> None:
        super().__init__(values)
        self.kind = kind

    def __missing__(self, name: str) -> T:
        raise UnknownKey(f"no {self.kind} '{name}'; {one_of(self, name)}")


class BadData(WeposeError):
    """The data cannot be a recording: no such column, text, NaN, time that goes back, lengths that differ."""


class WrongUnit(BadData):
    """Numbers of another unit: what shows it, what would fit in a session's [data], and what else can be wrong."""

    def __init__(self, finding: str, key: str = "", unit: str = "", otherwise: str = "") -> None:
        super().__init__(f'{finding}; data.{key} = "{unit}" would fit{otherwise}')
        self.finding, self.key, self.unit = finding, key, unit


class MissingRate(BadData):
    """A file whose samples have no times does not state its rate."""


class BadPhase(WeposeError):
    """A phase is missing, empty, or outside the recording."""


class BadSubject(WeposeError):
    """`subject.toml` is malformed, or lacks what the work at hand needs."""


class BadModel(WeposeError):
    """A URDF that cannot be read, or that is not the body this work needs."""


class BadOption(WeposeError, ValueError):
    """An option or argument is not of the kind that is needed, or outside what it may be."""


class WrongOption(BadOption):
    """An argument whose value is not possible, by its name in Python."""

    def __init__(self, name: str, value: object, needed: str) -> None:
        super().__init__(f"`{name}` {value}: {needed}")
        self.name, self.value, self.needed = name, value, needed


class BadSource(WeposeError):
    """A live source cannot be opened: no port, no stream, no device that answers."""


class BadPlan(WeposeError):
    """A plan of many recordings lacks something, or its table does."""


class LostWorker(WeposeError):
    """Workers died at an item, again and again: too little memory, say."""


class WeposeWarning(UserWarning):
    """A result that can be used, but is less certain than it could be; the text says why, and what to do."""


class NoSolution(WeposeError):
    """A problem that was well posed by its form has no solution on these data."""


def printable(text: str) -> str:
    """The text in one line, control characters escaped: what a file holds must not steer a terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


_muting = threading.RLock()


@contextlib.contextmanager
def native_stderr_muted() -> Iterator[None]:
    """What libraries in C++ and Rust print on stderr meanwhile is dropped: their errors are told in a line of ours."""
    with _muting, contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # there is none
            stderr = os.dup(2)
            stack.callback(os.close, stderr)
            stack.callback(os.dup2, stderr, 2)
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
        yield


def reason(error: Exception) -> str:
    """Kind and text of an error, in one line of bounded length."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__


def one_of(names: Iterable[str], value: str | None = None, most: int = 12) -> str:
    """The choices for an error's end: ``a, b, c``, of more than `most` those nearest to `value`, and a guess."""
    choices = list(names)

    def simplify(name: str) -> str:
        return name.lower().replace("-", "_").replace(" ", "_")

    likeness = {name: SequenceMatcher(None, simplify(value or ""), simplify(name)).ratio() for name in choices}
    nearest = sorted(choices, key=lambda name: -likeness[name])
    shown = nearest if value and len(choices) > most else choices
    listed = ", ".join(shown[:most]) + (f", … ({len(choices)} in all)" if len(choices) > most else "")
    guess = f"did you mean '{nearest[0]}'? " if value and choices and likeness[nearest[0]] >= ALIKE else ""
    return f"{guess}there is: {listed or 'none'}"
