"""The packages that read formats: how they are imported, and what they raise as one line of ours."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import polars as pl

from .errors import BadData, MissingFile, WeposeError, how_to_install, native_stderr_muted, reason


def check_file(path: Path, kind: str) -> None:
    """Raise `MissingFile` where `path` is no regular file; its `kind` is such as "a C3D"."""
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "is no regular file" if path.exists() else "no such file"
        raise MissingFile(f"{path}: {found}; {kind} is wanted here")


def import_library(module: str, path: Path, kind: str) -> Any:
    """Import a module of an optional package, which reads `path`, a `kind` such as "a C3D"; else raise `BadData`."""
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise BadData(f"{path}: is {kind}, which needs {package}: {how_to_install(package)}") from None


@contextmanager
def library_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn errors that are not ours, on a file that cannot be read, into one `BadData`; `kind` is such as "a C3D"."""
    try:
        with native_stderr_muted():  # polars prints its panics, which are no Exception
            yield
    except WeposeError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        raise BadData(
            f"{path}: cannot be read as {kind}; it is damaged, cut off or another format: {reason(error)}"
        ) from error
