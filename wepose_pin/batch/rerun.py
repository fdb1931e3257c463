"""A result made again from what it says made it, beside what it was."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from ..errors import BadData, MissingFile, WeposeError
from ..readers.tables import read_table
from ..writers.provenance import code, file_hash, machine, read_made_by
from ..writers.result import versions
from .compare import differences
from .items import COMMAND, FAILED, item_of, make_into
from .storage import DONE, fetch
from .study import ITEMS, RESULTS, STUDY

# What is run because a record says so: commands that make a result and talk to nobody. A record may be a stranger's.
REMADE = ("track", "calibrate", "simulate", "retarget", "demo", "export")
_PAGES = ("report", "view")  # options that make pages, which are not compared


class Rerun(NamedTuple):
    """What came of making a result again."""

    command: str
    differences: list[str]  # a line each; empty: the same
    notes: list[str]  # what was not as it was, besides


def parts(result: Path) -> int:
    """How many results `rerun` makes again: of a study all items that were done."""
    return len(_done(result)[0]) if (result / STUDY).is_file() else 1


def rerun(
    result: Path, commands: Mapping[str, Callable[..., None]], step: Callable[[str], None] = lambda _: None
) -> Rerun:
    """Make a result again, in a place that is removed afterwards, and compare.

    Parameters
    ----------
    result : a folder, a study of wepose batch, an item of it or a part of one, or an exported file
    commands : name → what makes it, given its arguments and `out`
    step : told what is made next

    Raises
    ------
    MissingFile
        The result, or an input, is not there.
    BadData
        It does not say what made it, or an input has changed; or the command now refuses.
    """
    if (result / STUDY).is_file():
        return _study(result, commands, step)
    item = next((folder for folder in (result, result.parent) if (folder / DONE).is_file()), None)
    step(f"making {result.name} again")
    block = _of_item(item) if item is not None else read_made_by(result)
    command = str(block.get("command"))
    with tempfile.TemporaryDirectory(prefix="wepose-") as made:
        place = Path(made)
        if command == COMMAND:
            if item is None:
                raise BadData(f"{result}: is of an item of wepose batch, whose {DONE} is missing; name its folder")
            _check(item, block, place)
            folder = place / "item"
            folder.mkdir()
            make_into(folder, item_of(block))
            part = result.relative_to(item)
            found = differences(result, folder / part)
        elif command in REMADE and command in commands:
            _check(result, block, place)
            out = place / "made" / result.name
            out.parent.mkdir()
            first, options = _arguments(commands[command], block)
            try:
                with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                    commands[command](*first, **options, out=out)
            except (TypeError, AttributeError) as error:  # an option of another kind than the command writes
                raise BadData(f"{result}: made_by is damaged: wepose {command} cannot take it: {error}") from None
            except SystemExit as stop:  # of a calibration that is poor: its files are written
                if not out.exists():
                    raise BadData(f"{result}: wepose {command} ended with {stop.code} and wrote nothing") from None
            found = differences(result, out)
        else:
            raise BadData(f"{result}: made by '{command}', which cannot be made again one by one")
    return Rerun(command, found, _notes(block))


def _study(result: Path, commands: Mapping[str, Callable[..., None]], step: Callable[[str], None]) -> Rerun:
    """All items of a study that were done, one by one; one that cannot be made again is a difference."""
    names, failed = _done(result)
    found, notes = list[str](), dict[str, None]()
    for name in names:
        try:
            again = rerun(result / ITEMS / name, commands, step)
        except WeposeError as error:
            again = Rerun(COMMAND, [f"cannot be made again: {error}"], [])
        found += [f"{name}: {line}" for line in again.differences]
        notes |= dict.fromkeys(again.notes)
    if failed:
        notes[f"{failed} items had failed and are not made again"] = None
    return Rerun("batch", found, list(notes))


def _done(study: Path) -> tuple[list[str], int]:
    """Names of a study's items that are there, and how many are not."""
    try:
        table = read_table(study / RESULTS).select("item", "status")
    except (WeposeError, pl.exceptions.PolarsError):
        raise MissingFile(f"{study}: no {RESULTS} in it to go by; wepose batch goes on where it was stopped") from None
    names = table.filter(pl.col("status") != FAILED)["item"].to_list()
    return names, table.height - len(names)


def _of_item(folder: Path) -> dict[str, Any]:
    try:
        block = json.loads((folder / DONE).read_text(encoding="utf-8"))["made_by"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadData(f"{folder / DONE}: is damaged: {error}") from None
    if not isinstance(block, dict) or not isinstance(block.get("inputs"), dict):
        raise BadData(f"{folder / DONE}: made_by is damaged: a table with inputs is needed")
    return block


def _check(result: Path, block: Mapping[str, Any], place: Path) -> None:
    """Complain of inputs that are gone or not what they were."""
    for name, about in block["inputs"].items():
        try:
            url, before = str(about["path"]), dict(about["files"])
        except (KeyError, TypeError, ValueError):
            raise BadData(f"{result}: made_by is damaged: inputs.{name} needs path and files") from None
        truth = name == "session" and "evaluate" in block["options"].get("steps", ())
        path = fetch(url, place, truth)
        if not path.exists():
            raise MissingFile(f"{result}: its {name} is gone: {url}")
        top = path if path.is_dir() else path.parent
        for file, digest in before.items():
            if not (top / file).exists():
                raise MissingFile(f"{result}: of its {name}, {file} is gone: {top / file}")
            now = file_hash(top / file)
            if now != digest:
                raise BadData(
                    f"{result}: of its {name}, {top / file} has changed: SHA-256 was {digest[:12]}…, is {now[:12]}…"
                )


def _arguments(command: Callable[..., None], block: Mapping[str, Any]) -> tuple[list[Any], dict[str, Any]]:
    """Positional and named arguments of a command as they were given."""
    given = {name: tuple(v) if isinstance(v, list) else v for name, v in block["options"].items()}
    given |= {name: Path(about["path"]) for name, about in block["inputs"].items()}
    parameters = inspect.signature(command).parameters
    if unknown := sorted(set(given) - set(parameters)):
        raise BadData(f"made_by: wepose {block['command']} of this version has no option {', '.join(unknown)}")
    given |= {name: False for name in _PAGES if name in parameters}
    first = [name for name, each in parameters.items() if each.kind is each.POSITIONAL_ONLY]
    return [given[name] for name in first], {name: value for name, value in given.items() if name not in first}


def _notes(block: Mapping[str, Any]) -> list[str]:
    now, notes = code(), []
    if block.get("code") != now["code"]:
        was = f"{block.get('version')} ({block.get('commit') or 'commit not known'})"
        notes.append(f"made by wepose-pin {was}; this is {now['version']} ({now['commit'] or 'commit not known'})")
    if block.get("machine") not in (None, machine()):
        notes.append(f"made on {block['machine']}; this is {machine()}, which may round the last bits otherwise")
    packages = block.get("packages")
    changed = {name: of for name, of in versions().items() if isinstance(packages, dict) and packages.get(name) != of}
    if changed:
        notes.append(f"other versions now: {', '.join(f'{name} {of}' for name, of in changed.items())}")
    return notes
