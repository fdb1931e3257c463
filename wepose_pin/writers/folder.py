"""Output folders and files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from ..errors import ExistingOutput

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
written: list[Path] = []  # the folders that appeared, for whoever is stopped and says what there is


@contextmanager
def whole_folder(out: Path, force: bool = False) -> Iterator[Path]:
    """A new folder to write into; its files move to `out` when the block ends well, and vanish when it does not.

    With `force`, files of the same name are replaced and all others stay. A process that is killed leaves at most a
    hidden folder, ``.NAME.partial-…``, beside `out`, or in it where it was there already; nobody looks into it, and it
    can be deleted. Where `out` was not there, it appears at once with all that is in it; else file by file, each whole.

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
    own: Path | None = None
    try:
        try:
            with _undisturbed():
                own = Path(tempfile.mkdtemp(prefix=_prefix(out), dir=existing))
            partial = own / "whole"  # which others may read, as far as the user lets them
            partial.mkdir()
        except OSError as error:
            raise ExistingOutput(f"{out}: cannot be written: {error.strerror}") from error
        with _full_told(out):
            yield partial
        with _undisturbed():
            _move(partial, out, force)
            written.append(out)
    finally:
        if own is not None:
            shutil.rmtree(own, ignore_errors=True)


@contextmanager
def whole_file(file: Path, force: bool = False) -> Iterator[Path]:
    """A path beside `file` to write to; what stands there becomes `file` when the block ends well, else vanishes.

    Raises
    ------
    ExistingOutput
        `file` is there and `force` is not given, or it cannot be written.
    """
    check_file(file, force)
    partial = file.with_name(f".{file.name}.partial")
    try:
        with _full_told(file):
            yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def check_file(file: Path, force: bool = False) -> None:
    """Raise `ExistingOutput` where `file` is there and `force` is not given, or it cannot be a file."""
    if file.exists() and not force:
        raise ExistingOutput(f"{file}: exists; --force replaces it, -o names another file")
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise ExistingOutput(f"{file}: not a file that can be written; -o names a file in an existing folder")


@contextmanager
def _full_told(out: Path) -> Iterator[None]:
    """A disk that is full in a line that names the output: the system's own error names no file, or an input."""
    try:
        yield
    except OSError as error:
        # polars gives the system's words and no number.
        if error.errno in _FULL or "No space left" in str(error):
            reason = error.strerror or str(error)
            raise ExistingOutput(f"{out}: cannot be written: {reason}; nothing was written") from error
        raise


def _move(partial: Path, out: Path, force: bool) -> None:
    made = sorted(partial.rglob("*"))
    _check(out, force)  # again: another run may have written there meanwhile
    for path in made:
        target = out / path.relative_to(partial)
        if target.exists() and target.is_dir() != path.is_dir():
            raise ExistingOutput(f"{target}: is in the way; nothing was written, move it or name another folder")
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # somebody made it just now
            partial.rename(out)
            return
        _check(out, force)
    for path in made:
        if path.is_dir():
            (out / path.relative_to(partial)).mkdir(parents=True, exist_ok=True)
    for path in made:
        if path.is_file():
            path.replace(out / path.relative_to(partial))


def _prefix(out: Path) -> str:
    return f".{out.absolute().name}.partial-"


def _check(out: Path, force: bool) -> None:
    if out.is_symlink() and not out.exists():
        raise ExistingOutput(f"{out}: is a link to nothing; name a folder")
    if out.exists() and not out.is_dir():
        raise ExistingOutput(f"{out}: is a file; a folder is wanted for the output")
    if not force and out.is_dir() and any(not p.name.startswith(_prefix(out)) for p in out.absolute().iterdir()):
        raise ExistingOutput(f"{out}: exists and is not empty; --force replaces its files, -o names another folder")


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Signals that stop a command wait until the block has ended; only the main thread has them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            if callable(before[number]):
                signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        for number, handler in before.items():
            if callable(handler):
                signal.signal(number, handler)
        for which, frame in came[:1]:
            handler = before[signal.Signals(which)]
            if callable(handler):
                handler(which, frame)
