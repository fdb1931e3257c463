"""What a target of fuzzing is, and how an input is tried on it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from wepose_pin.errors import WeposeError


class Target(NamedTuple):
    """One reader.

    Parameters
    ----------
    seeds : well-formed inputs
    run : takes a folder and an input; raises `WeposeError` on what it does not take
    words : what inputs are made of, for a fuzzer that knows nothing of the format
    module : of the package, where its code is
    """

    name: str
    seeds: Callable[[], list[bytes]]
    run: Callable[[Path, bytes], object]
    words: tuple[bytes, ...] = ()
    module: str = ""


class NotOneLine(AssertionError):
    """An error's text that is no line for a user."""


def try_one(target: Target, folder: Path, data: bytes) -> WeposeError | None:
    """Give the input to the target: what it was refused for, None if it was taken; all else is a finding and raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="meshcat|zmq")  # as they are imported
        try:
            target.run(folder, data)
        except WeposeError as error:
            text = str(error)
            if not text or not text.isprintable() or len(text) > 4000:
                raise NotOneLine(repr(text)[:400]) from error
            return error
    return None


def file(name: str, read: Callable[[Path], object]) -> Callable[[Path, bytes], object]:
    """The target that reads the input as a file of this name."""

    def run(folder: Path, data: bytes) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return run
