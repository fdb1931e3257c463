"""Local folders and, by fsspec, remote ones (``s3://``…): searched, fetched, written whole."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import BadData, BadOption, ExistingOutput, MissingFile, how_to_install
from ..writers.provenance import list_named_files

DONE_FILE = "done.json"  # written last: a folder without it is not complete


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

        # No cache of listings: a worker lives longer than they stay true.
        return fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise BadOption(f"{url}: {error}: {how_to_install('fsspec', 's3fs')}") from None
    except ValueError as error:
        raise BadOption(f"{url}: {error}") from None


@contextlib.contextmanager
def _translate_errors(url: str) -> Iterator[None]:
    """Errors of a remote store, which has many kinds of its own, as one line."""
    try:
        yield
    except (MissingFile, BadData, BadOption, ExistingOutput):
        raise
    except FileNotFoundError:
        raise MissingFile(f"{url}: no such file") from None
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingFile(f"{url}: cannot be reached: {reason[:300]}") from error


def find_urls(pattern: str) -> list[str]:
    """Files or folders that match a path or glob, sorted."""
    if not is_remote(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    with _translate_errors(pattern):
        system, path = _filesystem(pattern)
        return sorted(system.unstrip_protocol(match) for match in system.glob(path))


def read_bytes(url: str) -> bytes | None:
    """Contents of a file; None where there is none."""
    if not is_remote(url):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return Path(url).read_bytes()
        return None
    with _translate_errors(url):
        system, path = _filesystem(url)
        with contextlib.suppress(FileNotFoundError):
            return bytes(system.cat_file(path))
    return None


def write_bytes(url: str, content: bytes) -> None:
    """Write a file whole or not at all."""
    if is_remote(url):
        with _translate_errors(url):
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
    """Local path of a session, subject, model or table; a remote one is copied `into` a folder.

    Files that a session or a model's table names are copied too; they have to lie below its folder.

    Raises
    ------
    MissingFile
        A file is not there, or cannot be reached.
    BadData
        It names a file outside its folder.
    """
    if not is_remote(url):
        return Path(url)
    with _translate_errors(url):
        system, path = _filesystem(url)
        if system.isdir(path):
            path = f"{path.rstrip('/')}/session.toml"
        top, into = path.rpartition("/")[0], Path(tempfile.mkdtemp(dir=into))
        local = into / path.rpartition("/")[2]
        system.get_file(path, str(local))
    for name in list_named_files(local, truth):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise BadData(f"{url}: names '{name}', outside its own folder; only files below it are fetched")
        target = into / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with _translate_errors(f"{url}: {name}"):
            system.get(f"{top}/{name}", str(target), recursive=system.isdir(f"{top}/{name}"))
    return local


def read_stamps(url: str, truth: bool = False) -> dict[str, list[Any]] | None:
    """Sizes and times, or the store's tags, of an input's files: equal stamps mean that nothing has changed.

    None where a file is missing, or the store has no tags.
    """
    if is_remote(url):
        system, path = _filesystem(url)
        try:
            with _translate_errors(url), tempfile.TemporaryDirectory() as folder:
                if system.isdir(path):
                    path = f"{path.rstrip('/')}/session.toml"
                local = Path(folder) / path.rpartition("/")[2]
                if path.endswith(".toml"):
                    system.get_file(path, str(local))
                top = path.rpartition("/")[0]
                files = [
                    path,
                    *(f"{top}/{name}" for name in (list_named_files(local, truth) if local.exists() else ())),
                ]
                return {file: [info["size"], info["ETag"]] for file in files for info in [system.info(file)]}
        except (MissingFile, KeyError):
            return None
    place = Path(url)
    place = place / "session.toml" if place.is_dir() else place
    stamps = {}
    try:
        for file in (place, *(place.parent / name for name in list_named_files(place, truth))):
            for each in sorted(path for path in file.rglob("*") if path.is_file()) if file.is_dir() else [file]:
                status = each.stat()
                stamps[str(each)] = [status.st_size, status.st_mtime_ns]
    except OSError:
        return None
    return stamps


@contextlib.contextmanager
def create_folder(url: str) -> Iterator[Path]:
    """A temporary folder that becomes `url` when the block succeeds, and vanishes otherwise.

    `DONE_FILE` must be written last. A local folder is renamed into place; to a remote one files are copied, with
    `DONE_FILE` last. What was there before is removed.

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
            _upload(folder, url)
        else:
            folder.chmod(0o777 & ~_get_umask())  # mkdtemp's is for its owner alone
            _sync(folder)
            _replace(folder, place)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _replace(folder: Path, place: Path) -> None:
    if place.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        try:
            place.rename(old / "old")
        finally:
            shutil.rmtree(old, ignore_errors=True)
    try:
        folder.rename(place)
    except OSError:
        if not (place / DONE_FILE).is_file():  # else another worker has finished the same item
            raise


def _sync(folder: Path) -> None:
    """Write a folder to the disk, so that it outlives a power cut, before it gets its final name."""
    for path in (*folder.rglob("*"), folder):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _upload(folder: Path, url: str) -> None:
    with _translate_errors(url):
        system, path = _filesystem(url)
        if system.exists(path):
            with contextlib.suppress(FileNotFoundError):
                system.rm_file(f"{path}/{DONE_FILE}")  # first: the rest is then not complete
            system.rm(path, recursive=True)
        files = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
        for name in sorted(files, key=lambda name: name == DONE_FILE):
            system.put_file(str(folder / name), f"{path}/{name}")


def remove_leftovers(url: str, names: Sequence[str]) -> None:
    """Remove temporary folders that killed runs left."""
    if is_remote(url) or not Path(url).is_dir():
        return
    prefixes = {f".{name}" for name in names}
    for path in Path(url).glob(".*-*"):
        if path.is_dir() and path.name.rpartition("-")[0] in prefixes:
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def lock_folder(folder: str) -> Iterator[None]:
    """Lock a local folder for this process; the system releases it however the process ends.

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


def _get_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
