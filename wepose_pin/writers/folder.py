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
    _check(out, force)
    # Inside `out` where it exists: it may be a file system of its own, or the only place that can be written to.
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    if not existing.is_dir():
        raise ExistingOutput(f"{out}: cannot be made: {existing} is a file")
    try:
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=existing))
    except OSError as error:
        raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
    try:
        yield partial
        made = sorted(partial.rglob("*"))
        _check(out, force, partial)  # again: another run may have written there meanwhile
        for path in made:
            target = out / path.relative_to(partial)
            if target.exists() and target.is_dir() != path.is_dir():
                raise ExistingOutput(f"{target}: is in the way; nothing was written, move it or name another folder")
        for path in made:
            if path.is_dir():
                (out / path.relative_to(partial)).mkdir(parents=True, exist_ok=True)
        out.mkdir(parents=True, exist_ok=True)
        for path in made:
            if path.is_file():
                path.replace(out / path.relative_to(partial))
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check(out: Path, force: bool, partial: Path | None = None) -> None:
    if out.is_symlink() and not out.exists():
        raise ExistingOutput(f"{out}: is a link to nothing; name a folder")
    if out.exists() and not out.is_dir():
        raise ExistingOutput(f"{out}: is a file; a folder is wanted for the output")
    if not force and out.is_dir() and any(path != partial for path in out.absolute().iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; --force replaces its files, -o names another folder")
