"""The packages that read formats: how they are imported, and what they raise as one line of ours."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import polars as pl

from ..errors import BadData, WeposeError, how_to_install, native_stderr_muted, reason


def import_library(module: str, path: Path, kind: str) -> Any:
    """Import a module of an optional package, which reads `path`; its `kind` is such as "a C3D".

    Raises
    ------
    BadData
        It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise BadData(f"{path}: is {kind}, which needs {package}: {how_to_install(package)}") from None


@contextmanager
def library_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn what a library raises on a file that it cannot read into one line; `kind` is such as "a C3D".

    Raises
    ------
    BadData
        The library raised an error.
    """
    try:
        with native_stderr_muted():  # polars prints its panics, which are no Exception
            yield
    except WeposeError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        raise BadData(
            f"{path}: cannot be read as {kind}; it is damaged, cut off or another format: {reason(error)}"
        ) from error
