"""What made a result: version, commit, options, inputs with their hashes; the block `made_by` beside what was made."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import subprocess
import tomllib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from .. import __version__
from ..assets import asset
from ..errors import BadData, MissingFile
from .result import versions

FORMAT = 1
ALONE = "made_by.json"  # beside results that have no JSON of their own
INSIDE = ("summary.json", "calibration.json")
# Of a result folder, what others are made from; pages and what was exported into it are not.
_RESULT = ("pose.parquet", "joints.parquet", "subject.toml", "subject.urdf")
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
    if not (_PACKAGE.parent / ".git").exists():  # a wheel; a repository further up is somebody else's
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


def made_by(
    command: str, given: Mapping[str, Any], *, truth: bool = False, inputs: Mapping[str, Path] | None = None
) -> dict[str, Any]:
    """The block of a result.

    Parameters
    ----------
    command : as on the command line
    given : its arguments and options by name; those that name existing files are inputs, the rest options (seeds too)
    truth : the reference that a session names was used as well
    inputs : more of them, where `given` does not name the files

    Raises
    ------
    MissingFile
        An input cannot be read.
    """
    named = {name: path for name, value in given.items() if (path := _as_input(name, value)) is not None}
    options = {name: value for name, value in given.items() if name not in (*named, *_NOT_OPTIONS)}
    return {
        "format": FORMAT,
        "command": command,
        **code(),
        "options": json.loads(json.dumps(options, default=str)),
        "inputs": {
            name: {"path": str(path.absolute()), "files": file_hashes(path, truth)}
            for name, path in {**named, **(inputs or {})}.items()
        },
        "packages": versions(),
        "machine": machine(),
    }


def _as_input(name: str, value: Any) -> Path | None:
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
    return {_name(file, top): file_hash(file) for file in files_of(path, truth)}


def files_of(path: Path, truth: bool = False) -> list[Path]:
    """The files that an input consists of."""
    if path.is_dir() and (path / "session.toml").is_file():
        path = path / "session.toml"
    if path.is_dir():
        return [path / name for name in _RESULT if (path / name).is_file()] or sorted(_all(path))
    # A map may name a URDF of example-robot-data, which lies elsewhere and has a version of its own.
    named = [path.parent / name for name in named_in(path, truth)]
    return [path, *(of for of in named if of.exists() or of.suffix != ".urdf"), *_beside(path)]


def _beside(path: Path) -> list[Path]:
    """What is read with a URDF because it lies there: the map of a robot, the table of a body."""
    tables = (path.with_suffix(".toml"), path.with_name("model.toml")) if path.suffix == ".urdf" else ()
    return [table for table in dict.fromkeys(tables) if table.is_file()]


def named_in(path: Path, truth: bool = False) -> list[str]:
    """Files and folders that a session, or a model's table, names, as they stand there."""
    if path.suffix != ".toml" or not path.is_file():  # a pipe would hold us up
        return []
    try:
        content = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return []  # whoever reads it says what is wrong with it
    data, sensors = content.get("data"), content.get("sensors")
    tables = [data, *(sensors.values() if isinstance(sensors, dict) else ())]
    names = [table.get("file") for table in tables if isinstance(table, dict)]
    names += [content.get("urdf"), data.get("truth") if truth and isinstance(data, dict) else None]
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
            told = "".join(f"{_name(file, path)} {file_hash(file)}\n" for file in sorted(_all(path)))
            return hashlib.sha256(told.encode()).hexdigest()
        if path.exists() and not path.is_file():
            raise MissingFile(f"{path}: is no regular file")
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error


def _all(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def _name(file: Path, top: Path) -> str:
    try:
        return file.relative_to(top).as_posix()
    except ValueError:
        return file.as_posix()


# Where it is kept ----------------------------------------------------------------------------------------------------


def beside(file: Path) -> Path:
    """``FILE.made_by.json``, where the block of a file stands."""
    return file.with_name(f"{file.name}.{ALONE}")


def write_made_by(folder: Path, block: Mapping[str, Any]) -> None:
    """``made_by.json`` in a folder."""
    (folder / ALONE).write_text(block_text(block), encoding="utf-8")


def block_text(block: Mapping[str, Any]) -> str:
    """A block as a file of its own holds it."""
    return json.dumps(block, indent=1, ensure_ascii=False) + "\n"


def read_made_by(result: Path) -> dict[str, Any]:
    """The block of a result folder, or of an exported file.

    Raises
    ------
    MissingFile
        There is no such result.
    BadData
        It does not say what made it, or is damaged.
    """
    if not result.exists():
        raise MissingFile(f"{result}: no such result; a folder, or an exported file, is wanted here")
    alone = result / ALONE if result.is_dir() else beside(result)
    places = [alone, *(result / name for name in INSIDE if result.is_dir())]
    for place in (place for place in places if place.is_file()):
        try:
            content = json.loads(place.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise BadData(f"{place}: is damaged, no JSON: {error}") from error
        block = content if place.name.endswith(ALONE) else content.get("made_by") if isinstance(content, dict) else None
        if block is None:
            continue
        if not isinstance(block, dict) or block.get("format") != FORMAT:
            raise BadData(f"{place}: made_by is not of format {FORMAT}; made by another version")
        if not all(isinstance(block.get(key), dict) for key in ("options", "inputs")):
            raise BadData(f"{place}: made_by is damaged: options and inputs, tables both, are needed")
        return block
    raise BadData(f"{result}: does not say what made it ({alone.name}, or made_by in {' or '.join(INSIDE)})")
