"""Local paths and, by fsspec, URLs: searched, fetched, written whole."""

from __future__ import annotations

import contextlib
import fcntl
import glob
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..documents import whole_file
from ..errors import BadData, BadOption, ExistingOutput, MissingFile, WeposeError, reason
from ..writers.provenance import list_named_files

DONE_FILE = "done.json"  # written last: a folder without it is not complete


def is_remote(url: str) -> bool:
    return "://" in url


@contextlib.contextmanager
def _open_filesystem(url: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL and the path on it; errors of a store, which has many kinds of its own, as one line."""
    try:
        import fsspec
    except ImportError as error:
        raise BadOption(f"{url}: {error}: pip install fsspec") from None
    try:
        yield fsspec.core.url_to_fs(url, use_listings_cache=False)  # a worker lives longer than listings stay true
    except WeposeError:
        raise
    except Exception as error:
        raise MissingFile(f"{url}: cannot be reached: {reason(error)}") from error


def find_urls(pattern: str) -> list[str]:
    """Files or folders that match a path or glob, sorted."""
    if not is_remote(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    with _open_filesystem(pattern) as (system, path):
        return sorted(system.unstrip_protocol(match) for match in system.glob(path))


def read_bytes(url: str) -> bytes | None:
    """Contents of a file; None where there is none."""
    if not is_remote(url):
        return Path(url).read_bytes() if Path(url).is_file() else None
    with _open_filesystem(url) as (system, path):
        return bytes(system.cat_file(path)) if system.exists(path) else None


def write_bytes(url: str, content: bytes) -> None:
    """Write a file whole or not at all."""
    if is_remote(url):
        with _open_filesystem(url) as (system, path):
            system.pipe_file(path, content)
        return
    with whole_file(Path(url), force=True) as partial:
        partial.write_bytes(content)


@contextlib.contextmanager
def open_study(url: str) -> Iterator[None]:
    """Make the folder of a study, and hold it for this process; leftovers of killed runs are removed.

    `ExistingOutput`: it holds something else, cannot be made, or another run holds it.
    """
    if is_remote(url):
        yield
        return
    place, items = Path(url), Path(url) / "items"
    if place.exists() and not items.is_dir() and not (place.is_dir() and not any(place.iterdir())):
        raise ExistingOutput(f"{url}: is there and no study of wepose batch; name another folder")
    try:
        items.mkdir(parents=True, exist_ok=True)
        lock = (place / ".lock").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the system however this process ends
    except BlockingIOError:
        raise ExistingOutput(f"{url}: another wepose batch writes there; wait for it, or name another") from None
    except OSError as error:
        raise ExistingOutput(f"{url}: cannot be written: {error.strerror}") from error
    with lock:
        for path in items.glob(".*-*"):
            shutil.rmtree(path, ignore_errors=True)
        yield


def fetch(url: str, into: Path, truth: bool = False) -> Path:
    """Local path of a session or another file; a remote one is copied `into` a folder, with the files that it names."""
    if not is_remote(url):
        return Path(url)
    with _open_filesystem(url) as (system, path):
        if system.isdir(path):
            path = f"{path.rstrip('/')}/session.toml"
        top, into = path.rpartition("/")[0], Path(tempfile.mkdtemp(dir=into))
        local = into / path.rpartition("/")[2]
        system.get_file(path, str(local))
        for name in list_named_files(local, truth):
            if not (into / name).resolve().is_relative_to(into.resolve()):
                raise BadData(f"{url}: names '{name}', outside its own folder; only files below it are fetched")
            system.get(f"{top}/{name}", str(into / name), recursive=True)
    return local


@contextlib.contextmanager
def create_folder(url: str) -> Iterator[Path]:
    """A temporary folder that becomes `url` when the block succeeds, and vanishes otherwise.

    A local folder is renamed into place; to a remote one files are copied, with `DONE_FILE` last. What was there
    before is removed.
    """
    place = Path(url)
    folder = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=None if is_remote(url) else place.parent))
    try:
        yield folder
        if not is_remote(url):
            shutil.rmtree(place, ignore_errors=True)
            folder.chmod(place.parent.stat().st_mode)  # mkdtemp's is for its owner alone
            folder.rename(place)
            return
        with _open_filesystem(url) as (system, path):
            if system.exists(path):
                system.rm(path, recursive=True)
            done = (folder / DONE_FILE).read_bytes()
            (folder / DONE_FILE).unlink()
            system.put(f"{folder}/", f"{path}/", recursive=True)
            system.pipe_file(f"{path}/{DONE_FILE}", done)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
