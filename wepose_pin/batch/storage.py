"""Local folders and, by fsspec, remote ones (``s3://``…): found, fetched, written whole."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import BadData, BadOption, ExistingOutput, MissingFile
from ..writers.provenance import named_in

DONE = "done.json"  # written last: a folder without it is not whole


def is_remote(url: str) -> bool:
    return "://" in url


def _filesystem(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path on it.

    Raises
    ------
    BadOption
        fsspec, or what it needs for this kind of URL, is not installed; or there is no such kind.
    """
    try:
        import fsspec

        # Listings are not kept: a worker lives longer than what it has listed stays true.
        return fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise BadOption(f"{url}: {error}; pip install 'wepose-pin[batch,s3]' brings fsspec and s3fs") from None
    except ValueError as error:
        raise BadOption(f"{url}: {error}") from None


@contextlib.contextmanager
def _named(url: str) -> Iterator[None]:
    """What goes wrong on the way to a remote place, as one line of ours.

    Clients of such stores have errors of many kinds of their own; none of them is in what we compute.
    """
    try:
        yield
    except (MissingFile, BadData, BadOption, ExistingOutput):
        raise
    except FileNotFoundError:
        raise MissingFile(f"{url}: no such file") from None
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingFile(f"{url}: cannot be reached: {reason[:300]}") from error


def find(pattern: str) -> list[str]:
    """Files or folders that a path or glob names, sorted."""
    if not is_remote(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    with _named(pattern):
        system, path = _filesystem(pattern)
        return sorted(system.unstrip_protocol(found) for found in system.glob(path))


def read_bytes(url: str) -> bytes | None:
    """A file's contents; None where there is none."""
    if not is_remote(url):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return Path(url).read_bytes()
        return None
    with _named(url):
        system, path = _filesystem(url)
        with contextlib.suppress(FileNotFoundError):
            return bytes(system.cat_file(path))
    return None


def write_bytes(url: str, content: bytes) -> None:
    """A file, whole or not at all."""
    if is_remote(url):
        with _named(url):
            system, path = _filesystem(url)
            system.pipe_file(path, content)
        return
    file = Path(url)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def fetch(url: str, into: Path, truth: bool = False) -> Path:
    """A session, subject, model or table as a local path: where it lies or, from elsewhere, `into` a folder.

    With a session or model's table come the files that it names, which have to lie below its folder.

    Raises
    ------
    MissingFile
        A file is not there, or cannot be reached.
    BadData
        A file is named that lies outside.
    """
    if not is_remote(url):
        return Path(url)
    with _named(url):
        system, path = _filesystem(url)
        if system.isdir(path):
            path = f"{path.rstrip('/')}/session.toml"
        top, into = path.rpartition("/")[0], Path(tempfile.mkdtemp(dir=into))
        local = into / path.rpartition("/")[2]
        system.get_file(path, str(local))
    for name in named_in(local, truth):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise BadData(f"{url}: names '{name}', outside its own folder; only files below it are fetched")
        target = into / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with _named(f"{url}: {name}"):
            system.get(f"{top}/{name}", str(target), recursive=system.isdir(f"{top}/{name}"))
    return local


def stamps(url: str, truth: bool = False) -> dict[str, list[Any]] | None:
    """What tells without reading whether the files of an input were touched: sizes and times, or the store's tags.

    None where something is missing, or more than its first file would have to be read to know.
    """
    if is_remote(url):
        system, path = _filesystem(url)
        try:
            with _named(url), tempfile.TemporaryDirectory() as folder:
                if system.isdir(path):
                    path = f"{path.rstrip('/')}/session.toml"
                local = Path(folder) / path.rpartition("/")[2]
                if path.endswith(".toml"):
                    system.get_file(path, str(local))
                top = path.rpartition("/")[0]
                files = [path, *(f"{top}/{name}" for name in (named_in(local, truth) if local.exists() else ()))]
                return {file: [info["size"], info["ETag"]] for file in files for info in [system.info(file)]}
        except (MissingFile, KeyError):
            return None
    place = Path(url)
    place = place / "session.toml" if place.is_dir() else place
    found = {}
    try:
        for file in (place, *(place.parent / name for name in named_in(place, truth))):
            for each in sorted(path for path in file.rglob("*") if path.is_file()) if file.is_dir() else [file]:
                about = each.stat()
                found[str(each)] = [about.st_size, about.st_mtime_ns]
    except OSError:
        return None
    return found


@contextlib.contextmanager
def new_folder(url: str) -> Iterator[Path]:
    """A folder to write into, which becomes `url` as a whole when the block ends well, and vanishes when it does not.

    `DONE` in it must be the last that is written. Locally the folder is renamed into place; elsewhere files are sent,
    `DONE` last. What was there before goes.

    Raises
    ------
    ExistingOutput
        It cannot be written.
    """
    place = Path(url)
    try:
        if not is_remote(url):
            place.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=None if is_remote(url) else place.parent))
    except OSError as error:
        raise ExistingOutput(f"{url}: cannot be written: {error.strerror}") from error
    try:
        yield folder
        if is_remote(url):
            _send(folder, url)
        else:
            folder.chmod(0o777 & ~_umask())  # mkdtemp's is for its owner alone
            _lasting(folder)
            _swap(folder, place)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _swap(folder: Path, place: Path) -> None:
    if place.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        try:
            place.rename(old / "old")
        finally:
            shutil.rmtree(old, ignore_errors=True)
    try:
        folder.rename(place)
    except OSError:
        if not (place / DONE).is_file():  # else a worker that was given up was faster, with the same
            raise


def _lasting(folder: Path) -> None:
    """What is in a folder outlives a power cut, before the folder gets the name by which it counts as done."""
    for path in (*folder.rglob("*"), folder):
        about = os.open(path, os.O_RDONLY)
        try:
            os.fsync(about)
        finally:
            os.close(about)


def _send(folder: Path, url: str) -> None:
    with _named(url):
        system, path = _filesystem(url)
        if system.exists(path):
            with contextlib.suppress(FileNotFoundError):
                system.rm_file(f"{path}/{DONE}")  # first: what follows is not whole
            system.rm(path, recursive=True)
        files = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
        for name in sorted(files, key=lambda name: name == DONE):
            system.put_file(str(folder / name), f"{path}/{name}")


def sweep(url: str, names: Sequence[str]) -> None:
    """Remove what killed runs left of these folders."""
    if is_remote(url) or not Path(url).is_dir():
        return
    prefixes = {f".{name}" for name in names}
    for path in Path(url).glob(".*-*"):
        if path.is_dir() and path.name.rpartition("-")[0] in prefixes:
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def only_one(folder: str) -> Iterator[None]:
    """Hold a local folder for this process; the system lets go of it however the process ends.

    Raises
    ------
    ExistingOutput
        Another process holds it.
    """
    if is_remote(folder):
        yield
        return
    import fcntl

    with (Path(folder) / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ExistingOutput(f"{folder}: another wepose batch writes there; wait for it, or name another") from None
        yield


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
