"""Output folders that appear whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import ExistingOutput


@contextmanager
def whole_folder(out: Path, force: bool = False) -> Iterator[Path]:
    """A new folder to write into; its files move to `out` when the block ends well, and vanish when it does not.

    With `force`, files of the same name are replaced and all others stay.

    Raises
    ------
    ExistingOutput
        `out` holds something and `force` is not given, or it is no folder, or cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise ExistingOutput(f"{out}: is a file; a folder is wanted for the output")
    if not force and out.is_dir() and any(out.iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; --force replaces its files, -o names another folder")
    above = next(folder for folder in out.absolute().parents if folder.is_dir())
    try:
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=above))
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
    try:
        yield partial
        for path in sorted(partial.rglob("*")):
            target = out / path.relative_to(partial)
            if path.is_dir():
                target.mkdir(parents=True, exist_ok=True)
        out.mkdir(parents=True, exist_ok=True)
        for path in sorted(partial.rglob("*")):
            if path.is_file():
                path.replace(out / path.relative_to(partial))
    finally:
        shutil.rmtree(partial, ignore_errors=True)
