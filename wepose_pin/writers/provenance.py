"""The provenance of a result: the job that made it as data, hashes of its inputs, code, packages and machine."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import subprocess
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from .. import __version__
from ..assets import asset
from ..documents import parse_toml
from ..errors import MissingFile
from .result import versions

FORMAT = 1
CALL = "wepose_pin.track"  # in place of a command, of a result that `TrackResult.save` wrote
ALONE = "provenance.json"  # beside results that have no JSON of their own
INSIDE = ("summary.json", "calibration.json")
# Of a result folder, what others are made from; pages and what was exported into it are not.
_RESULT = ("pose.parquet", "joints.parquet", "subject.toml", "subject.urdf", "model.toml")
_NOT_OPTIONS = ("out", "force")
_PACKAGE = Path(__file__).resolve().parent.parent


@lru_cache(maxsize=1)
def code() -> dict[str, str | None]:
    """Version, commit where it is known (`+` where files were changed since), hash of the code and data that ran."""
    digest = hashlib.sha256()
    for folder in (_PACKAGE, asset("urdf", "upper_body.urdf").parent, asset("calibration", "clasp.toml").parent):
        files = (path.relative_to(folder) for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".urdf"))
        for file in sorted(file for file in files if file.parts[0] != "_assets"):  # a wheel has the data in the package
            digest.update(file.as_posix().encode() + b"\0" + (folder / file).read_bytes() + b"\0")
    return {"version": __version__, "commit": _commit(), "code": digest.hexdigest()}


@lru_cache(maxsize=1)
def machine() -> str:
    """System and processor: another kind of processor may round the last bits otherwise."""
    name = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{platform.system()} {platform.machine()}" + (f", {name}" if name else "")


def _commit() -> str | None:
    if not (_PACKAGE.parent / ".git").exists():  # a wheel; a repository further up is another one
        return None
    try:
        described = subprocess.run(
            ["git", "-C", str(_PACKAGE.parent), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=10.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip()


def collect_provenance(command: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance of what a command makes.

    Parameters
    ----------
    command : as on the command line, or `CALL`
    values : the fields of its job; those that name existing files are inputs, the others options, seeds among them

    Raises
    ------
    MissingFile
        An input cannot be read.
    """
    inputs = {name: path for name, value in values.items() if (path := _input_path(name, value)) is not None}
    several = {name: value for name, value in values.items() if isinstance(value, tuple) and value}
    several = {name: value for name, value in several.items() if all(isinstance(each, Path) for each in value)}
    inputs |= {f"{name}.{i}": path for name, paths in several.items() for i, path in enumerate(paths)}
    options = {name: value for name, value in values.items() if name not in (*inputs, *several, *_NOT_OPTIONS)}
    return {
        "format": FORMAT,
        "command": command,
        **code(),
        "options": json.loads(json.dumps(options, default=str)),
        "inputs": {name: {"path": str(path.absolute()), "files": file_hashes(path)} for name, path in inputs.items()},
        "packages": versions(),
        "machine": machine(),
    }


def _input_path(name: str, value: Any) -> Path | None:
    """The path that an option names, if it is that of something read."""
    if name in _NOT_OPTIONS or not isinstance(value, str | Path):
        return None
    if isinstance(value, str) and not value.endswith((".toml", ".urdf")):  # text that may name a file, as --protocol
        return None
    return Path(value) if Path(value).exists() else None


def file_hashes(path: Path, truth: bool = False) -> dict[str, str]:
    """SHA-256 of all that an input consists of, by its name relative to the input's folder.

    Of a session or a model's table the files that it names too; of a URDF the tables beside it that are read with it;
    of a result what others are made from.

    Raises
    ------
    MissingFile
        One is not there, or cannot be read.
    """
    top = path if path.is_dir() else path.parent
    return {_relative_name(file, top): file_hash(file) for file in list_files(path, truth)}


def list_files(path: Path, truth: bool = False) -> list[Path]:
    """List the files that an input consists of, each followed by those that it needs."""
    if (path / "session.toml").is_file():
        path = path / "session.toml"
    if path.is_dir():
        return [path / name for name in _RESULT if (path / name).is_file()] or sorted(_list_all(path))
    files = [path]
    for file in files:
        needed = [file.parent / name for name in list_named_files(file, truth)]
        if file.suffix == ".urdf":  # the map of a robot, or the table of a body, is read where it lies beside
            needed += [table for table in (file.with_suffix(".toml"), file.with_name("model.toml")) if table.is_file()]
        # A map may name a URDF of example-robot-data, which lies elsewhere and has a version of its own.
        files += [each for each in needed if each not in files and (each.exists() or each.suffix != ".urdf")]
    return files


def list_named_files(path: Path, truth: bool = False) -> list[str]:
    """List the files and folders that a session, or a model's table, names, as they stand there."""
    if path.suffix != ".toml" or not path.is_file():  # a pipe would hold us up
        return []
    try:
        content = parse_toml(path.read_bytes().decode("utf-8"))
    except (OSError, ValueError):
        return []  # its reader reports what is wrong
    data, sensors, model = content.get("data"), content.get("sensors"), content.get("model")
    tables = [data, *(sensors.values() if isinstance(sensors, dict) else ())]
    tables = [table for table in tables if isinstance(table, dict)]
    formats = [name for table in tables if str(name := table.get("format")).endswith(".toml")]
    # A body of the package is part of the code.
    bodies = [model] if isinstance(model, str) and (path.parent / model).is_file() else []
    truths = [data.get("truth")] if truth and isinstance(data, dict) else []
    names = [*(table.get("file") for table in tables), *formats, *bodies, content.get("urdf"), *truths]
    return sorted({name for name in names if isinstance(name, str) and name})


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of all in a folder.

    Raises
    ------
    MissingFile
        It is not there, or cannot be read.
    """
    try:
        if path.is_dir():
            listing = "".join(f"{_relative_name(file, path)} {file_hash(file)}\n" for file in sorted(_list_all(path)))
            return hashlib.sha256(listing.encode()).hexdigest()
        if path.exists() and not path.is_file():
            raise MissingFile(f"{path}: is no regular file")
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error


def _list_all(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def _relative_name(file: Path, top: Path) -> str:
    try:
        return file.relative_to(top).as_posix()
    except ValueError:
        return file.as_posix()


# Where it is kept ----------------------------------------------------------------------------------------------------


def provenance_file(file: Path) -> Path:
    """``FILE.provenance.json``, where the provenance of a file stands."""
    return file.with_name(f"{file.name}.{ALONE}")


def write_provenance(folder: Path, provenance: Mapping[str, Any]) -> None:
    """``provenance.json`` in a folder."""
    (folder / ALONE).write_text(provenance_text(provenance), encoding="utf-8")


def provenance_text(provenance: Mapping[str, Any]) -> str:
    """A provenance as a file of its own holds it."""
    return json.dumps(provenance, indent=1, ensure_ascii=False) + "\n"
