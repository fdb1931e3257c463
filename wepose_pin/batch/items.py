"""One item, made whole or not at all: its steps in a new folder, `done.json` last, what is done left as it is."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import resource
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..errors import BadData, ExistingOutput, WeposeError
from ..writers.provenance import code, collect_provenance, file_hashes
from .plan import Item
from .steps import ItemFiles, ItemSteps
from .storage import DONE, fetch, is_remote, new_folder, read_bytes, stamps

COMMAND = "batch item"
MADE, FAILED, CHANGED = "done", "failed", "changed"  # what an item's status may be
PAGES = ("report.html", "view.html")  # what a row of the study leads to
Row = dict[str, Any]


def make_items(
    items: Sequence[Item], place: str, force: bool = False, same_code: str | None = None, until: float = math.inf
) -> list[Row]:
    """A row an item, in their order; errors become rows too. What a worker is asked for.

    Parameters
    ----------
    place : folder or URL that holds the items' folders
    force : make what was made from other inputs, options or version again; without it such an item is `CHANGED`
    same_code : the hash of the code that asks; a worker with another refuses
    until : of `time.perf_counter`: no item is begun after that but the first; rows are then fewer than items

    Raises
    ------
    BadData
        This is not the code that asks.
    """
    # Workers share the machine: a second thread in one would take the processor of the other.
    os.environ.setdefault("WEPOSE_THREADS", "1")
    mine = code()["code"]
    if same_code not in (None, mine):
        raise BadData(
            f"a worker has another wepose-pin than this one: version {code()['version']}, commit "
            f"{code()['commit'] or 'not known'}; install the same everywhere"
        )
    rows: list[Row] = []
    for item in items:
        if rows and time.perf_counter() > until:
            break
        rows.append(_row(item, place, force))
    return rows


def failed(item: Item, error: str, message: str) -> Row:
    """The row of an item that has failed, and why."""
    row: Row = {"item": item.name, "session": item.session, "subject": item.subject, "status": FAILED}
    return row | {"error": error, "message": message}


def _row(item: Item, place: str, force: bool) -> Row:
    begun = time.perf_counter()
    try:
        return {"item": item.name, "session": item.session, "subject": item.subject} | make_item(item, place, force)
    except WeposeError as error:
        row = failed(item, type(error).__name__, " ".join(str(error).split()))
    except MemoryError:
        row = failed(item, "MemoryError", f"{item.session}: not enough memory for it on this worker")
    except Exception as error:  # ours to mend: the others go on, and the table says where it was
        last = traceback.extract_tb(error.__traceback__)[-1]
        what = " ".join(str(error).split())
        row = failed(item, type(error).__name__, f"{what} ({Path(last.filename).name}:{last.lineno})")
    return row | {"seconds": time.perf_counter() - begun}


def make_item(item: Item, place: str, force: bool = False) -> Row:
    """Make an item's folder, unless it is there already, and give its columns of the table.

    One that was made from other inputs, options or version is left and keeps its figures, as `CHANGED`, unless `force`.

    Raises
    ------
    WeposeError
        Of any of its steps.
    """
    target = f"{place}/{item.name}"
    key = key_of(item)
    done = _done(target)
    if done is not None:
        changed = _changed(item, key, done)
        if changed is None:
            return done["row"] | {"status": MADE, "kept": True}
        if not force:
            message = f"{target}: was made from {changed}; --force makes it again, -o names another folder"
            return done["row"] | {"status": CHANGED, "error": ExistingOutput.__name__, "message": message, "kept": True}
    begun = time.perf_counter()
    with new_folder(target) as folder:
        stamped = _stamps(item)  # before anything is read: what changes meanwhile is seen the next time
        row, provenance = make_into(folder, item)
        row |= {"seconds": time.perf_counter() - begun, "memory_mb": _most_memory()}
        content = {"key": key, "provenance": provenance, "stamps": stamped, "row": row}
        (folder / DONE).write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")
    return row | {"status": MADE, "kept": False}


def make_into(folder: Path, item: Item) -> tuple[Row, dict[str, Any]]:
    """The item's steps into an existing folder: its columns of the table, and its provenance.

    Raises
    ------
    WeposeError
        Of any of its steps.
    """
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        local = {
            name: fetch(url, Path(fetched), name == "session" and "evaluate" in item.steps)
            for name, url in _inputs(item).items()
        }
        provenance = _provenance(item, local)
        files = ItemFiles(folder, local["session"], local.get("subject_file"), local.get("truth"))
        steps, row, took = ItemSteps(files, item.body, provenance), Row(), Row()
        for step, options in item.steps.items():
            begun = time.perf_counter()
            row |= steps.run(step, options)
            took[f"{step}_s"] = time.perf_counter() - begun
    pages = [f"{step}/{page}" for step in reversed(list(item.steps)) for page in PAGES]
    return row | {"page": next((page for page in pages if (folder / page).is_file()), None)} | took, provenance


def _most_memory() -> float:
    """Most memory [MB] that this process ever had."""
    with contextlib.suppress(
        OSError, StopIteration, ValueError
    ):  # Linux's rusage counts that of whoever started us, too
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def key_of(item: Item) -> str:
    """Hash of what makes an item but its inputs' contents: steps, options, person, code."""
    told = {"steps": list(item.steps.items()), "body": asdict(item.body), **code()}
    told.pop("commit")  # says less than the hash of the code
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def item_of(provenance: Mapping[str, Any]) -> Item:
    """The item that a provenance tells of.

    Raises
    ------
    BadData
        It is of something else, or damaged.
    """
    from .plan import Body

    try:
        about = provenance["options"]
        paths = {name: entry["path"] for name, entry in provenance["inputs"].items()}
        steps = {
            step: {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
            for step, options in about["steps"].items()
        }
        known = {name: paths.get(name) for name in ("subject_file", "truth")}
        return Item(about["name"], paths["session"], steps, about["subject"], **known, body=Body(**about["body"]))
    except (KeyError, TypeError, AttributeError) as error:
        raise BadData(f"provenance: not that of a batch's item: {type(error).__name__} {error}") from None


def _inputs(item: Item) -> dict[str, str]:
    """Name → path or URL of what the item is made from."""
    named = {"session": item.session, "subject_file": item.subject_file, "truth": item.truth}
    for step, options in item.steps.items():
        for name in ("model", "protocol", "robot"):
            value = options.get(name)
            if isinstance(value, str) and Path(value).is_file():
                named[f"{step}.{name}"] = value
    return {name: url for name, url in named.items() if url is not None}


def _provenance(item: Item, local: Mapping[str, Path]) -> dict[str, Any]:
    """Inputs are named by where they lie, not by where they were fetched to."""
    truth = "evaluate" in item.steps
    options = {"name": item.name, "subject": item.subject, "body": asdict(item.body), "steps": dict(item.steps)}
    provenance = collect_provenance(COMMAND, options)
    provenance["inputs"] = {
        name: {
            "path": url if is_remote(url) else str(Path(url).absolute()),
            "files": file_hashes(local[name], truth and name == "session"),
        }
        for name, url in _inputs(item).items()
    }
    return provenance


def _stamps(item: Item) -> dict[str, Any]:
    truth = "evaluate" in item.steps
    return {name: stamps(url, truth and name == "session") for name, url in _inputs(item).items()}


def _done(target: str) -> dict[str, Any] | None:
    """What `done.json` says; None where the folder is not whole."""
    content = read_bytes(f"{target}/{DONE}")
    if content is None:
        return None
    try:
        done = json.loads(content)
    except ValueError:
        return None
    whole = isinstance(done, dict) and all(isinstance(done.get(key), dict) for key in ("provenance", "stamps", "row"))
    return done if whole else None


def _changed(item: Item, key: str, done: Mapping[str, Any]) -> str | None:
    """What has changed since an item was done; None: nothing."""
    was, now = done["provenance"], code()
    if was.get("code") != now["code"]:
        return f"other code, version {was.get('version')}" + (f" ({was['commit']})" if was.get("commit") else "")
    if done.get("key") != key:
        return "other options"
    inputs = _inputs(item)
    if inputs != {name: entry["path"] for name, entry in was["inputs"].items()}:
        return "other inputs"
    found = json.loads(json.dumps(_stamps(item)))
    if found == done["stamps"] and None not in found.values():
        return None
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        truth = "evaluate" in item.steps
        for name, url in inputs.items():
            of_session = truth and name == "session"
            if file_hashes(fetch(url, Path(fetched), of_session), of_session) != was["inputs"][name]["files"]:
                return f"another {name.replace('_', ' ')}: {url} has changed since"
    return None
