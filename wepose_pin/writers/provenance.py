"""The provenance of a result, with hashes of inputs and code; and folders that may hold an earlier result or inputs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import shutil
import subprocess
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from .. import __version__
from ..body.table import MODEL_TABLE
from ..documents import whole_folder
from ..errors import ExistingOutput
from ..libraries import asset, check_file, library_errors
from .result import JOINTS, versions

FORMAT = 1
CALL = "wepose_pin.track"  # in place of a command, of a result that `TrackResult.save` wrote
INSIDE = ("summary.json", "calibration.json")  # files of a result that hold its provenance
# Of a result folder, what others are made from; pages and what was exported into it are not.
_RESULT = ("pose.parquet", "joints.parquet", "subject.toml", "subject.urdf", "model.toml")
_PACKAGE = Path(__file__).resolve().parent.parent


@lru_cache(maxsize=1)
def code() -> dict[str, str | None]:
    """Return version, commit where it is known (`+`: files were changed since), and the hash of code and data."""
    digest, commit = hashlib.sha256(), ""
    for folder in (_PACKAGE, asset("urdf", "upper_body.urdf").parent, asset("calibration", "clasp.toml").parent):
        files = (path.relative_to(folder) for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".urdf"))
        for file in sorted(file for file in files if file.parts[0] != "_assets"):  # a wheel has the data in the package
            digest.update(file.as_posix().encode() + b"\0" + (folder / file).read_bytes() + b"\0")
    if (_PACKAGE.parent / ".git").exists() and shutil.which("git"):  # no wheel
        words = ["git", "-C", str(_PACKAGE.parent), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
        commit = subprocess.run(words, capture_output=True, text=True).stdout.strip()
    return {"version": __version__, "commit": commit or None, "code": digest.hexdigest()}


def collect_provenance(command: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Collect the provenance of what a command, or `CALL`, makes; of its options those that name files are inputs."""
    inputs, options = dict[str, Any](), dict[str, Any]()
    for name, value in ((name, value) for name, value in values.items() if name not in ("out", "force")):
        several = value if isinstance(value, tuple) else (value,)
        # A text may name a file, as that of --protocol.
        named = (isinstance(each, Path) or str(each).endswith((".toml", ".urdf")) for each in several)
        if not several or not all(named) or not all(Path(each).exists() for each in several):
            options[name] = value
            continue
        for k, path in enumerate(map(Path, several)):
            key = f"{name}.{k}" if isinstance(value, tuple) else name
            inputs[key] = {"path": str(path.absolute()), "files": file_hashes(path)}
    return {
        "format": FORMAT,
        "command": command,
        **code(),
        "options": json.loads(json.dumps(options, default=str)),
        "inputs": inputs,
        "packages": versions(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def file_hashes(path: Path, truth: bool = False) -> dict[str, str]:
    """Compute SHA-256 of all that an input consists of (`list_files`), by its name relative to the input's folder."""
    top = path if path.is_dir() else path.parent
    hashes = {}
    for file in list_files(path, truth):
        name = file.relative_to(top) if file.is_relative_to(top) else file
        check_file(file, "an input")
        with library_errors(file, "an input"), file.open("rb") as opened:
            hashes[name.as_posix()] = hashlib.file_digest(opened, "sha256").hexdigest()
    return hashes


def list_files(path: Path, truth: bool = False) -> list[Path]:
    """List the files that an input consists of, each followed by those that it needs: that it names or is read with."""
    if (path / "session.toml").is_file():
        path = path / "session.toml"
    if path.is_dir():
        return [path / name for name in _RESULT if (path / name).is_file()] or _list_folder(path)
    files = [path]
    for file in files:
        needed = [file.parent / name for name in list_named_files(file, truth)]
        if file.suffix == ".urdf":  # the map of a robot, or the table of a body, is read where it lies beside
            needed += [table for table in (file.with_suffix(".toml"), file.with_name("model.toml")) if table.is_file()]
        for each in needed:
            # A map may name a URDF of example-robot-data, which lies elsewhere and has a version of its own.
            new = _list_folder(each) if each.is_dir() else [each] if each.exists() or each.suffix != ".urdf" else []
            files += [file for file in new if file not in files]
    return files


def _list_folder(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def list_named_files(path: Path, truth: bool = False) -> list[str]:
    """List the files and folders that a session, or a model's table, names, as they stand there."""
    if path.suffix != ".toml" or not path.is_file():  # a pipe would block
        return []
    names, tables = set[str](), list[Mapping[str, Any]]()
    with contextlib.suppress(OSError, ValueError, RecursionError):  # its reader reports what is wrong
        tables.append(tomllib.loads(path.read_bytes().decode("utf-8-sig")))
    for table in tables:
        for key, value in table.items():
            if isinstance(value, dict):
                tables.append(value)
            elif isinstance(value, str) and (
                key in ("urdf", "file", *(("truth",) if truth else ()))
                or (key == "format" and value.endswith(".toml"))
                or (key == "model" and (path.parent / value).is_file())  # a body of the package is part of the code
            ):
                names.add(value)
    return sorted(names - {""})


def write_provenance(folder: Path, provenance: Mapping[str, Any]) -> None:
    """Write a provenance as a file of its own into a folder."""
    text = json.dumps(provenance, indent=1, ensure_ascii=False)
    # "backslashreplace": of a path that is not in UTF-8.
    (folder / "provenance.json").write_text(f"{text}\n", encoding="utf-8", errors="backslashreplace")


# Folders that hold an earlier result, or files of the user ---------------------------------------------------------


@contextmanager
def result_folder(out: Path, force: bool, pages: Sequence[str] = ()) -> Iterator[Path]:
    """`whole_folder` of a result; files of an earlier one are deleted if they are `pages` or read with a result.

    `ExistingOutput` is raised where a file of the user's would be read with the result, or an input be replaced.
    """
    inputs = {file.resolve() for file in list_files(out, truth=True)} if (out / "session.toml").is_file() else set()
    stale = [name for name in (MODEL_TABLE, JOINTS) if (out / name).exists()]
    if stale and not any((out / name).is_file() for name in INSIDE):
        why = "is of no earlier result, and would be read with the new one"
        raise ExistingOutput(f"{out / stale[0]}: {why}; rename it, or name another folder by -o")
    stale = [name for name in stale if (out / name).resolve() not in inputs]
    with whole_folder(out, force, (*stale, *pages)) as folder:
        yield folder
        for name in sorted(file.name for file in folder.iterdir()):
            if (out / name).resolve() in inputs:
                why = f"is an input of {out / 'session.toml'}, and would be replaced"
                raise ExistingOutput(f"{out / name}: {why}; name another folder by -o")
