"""What is installed: body models and calibration files, plug-ins, and packages that read formats.

Assets are those of the checkout where there is one, else of the wheel. What a package raises becomes one line of ours.
"""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from .errors import BadData, BadOption, MissingFile, WeposeError, native_stderr_muted, reason

_PACKAGE = Path(__file__).resolve().parent


def asset(folder: str, name: str) -> Path:
    """Path of `name` in ``urdf/`` or ``calibration/``."""
    path = _PACKAGE.parent / folder / name
    return path if path.is_file() else _PACKAGE / "_assets" / folder / name


@cache
def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Name → what distributions register as entry points ``wepose.GROUP``: "readers", "writers", "sources", "outputs".

    What this package brings is registered in the same way, in pyproject.toml. It stands first, and its names are taken.
    """
    registered = entry_points(group=f"wepose.{group}")
    own = {each.name: each for each in registered if each.value.startswith("wepose_pin.")}
    return own | {each.name: each for each in registered if each.name not in own}


@cache
def load_plugin(group: str, name: str) -> Any:
    """Load the object that is registered by this name; raise `BadOption` where it cannot be imported."""
    try:
        return find_plugins(group)[name].load()
    except (ImportError, AttributeError) as error:
        raise BadOption(f"plug-in {name} of wepose.{group} cannot be imported: {reason(error)}") from error


def check_file(path: Path, kind: str) -> None:
    """Raise `MissingFile` where `path` is no regular file; its `kind` is such as "a C3D"."""
    if not path.is_file():
        state = "is a folder" if path.is_dir() else "is no regular file" if path.exists() else "no such file"
        raise MissingFile(f"{path}: {state}; {kind} is needed here")


def import_library(module: str, path: Path | str, kind: str) -> Any:
    """Import a module of an optional package, which reads `path`, a `kind` such as "a C3D"; else raise `BadData`."""
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise BadData(f"{path}: is {kind}, which needs {package}: pip install {package}") from None


@contextmanager
def library_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn errors that are not ours, on a file that cannot be read, into one `BadData`; `kind` is such as "a C3D"."""
    import polars as pl

    try:
        with native_stderr_muted():  # polars prints its panics, which are no Exception
            yield
    except WeposeError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        raise BadData(
            f"{path}: cannot be read as {kind}; it is damaged, cut off or another format: {reason(error)}"
        ) from error
