"""One item of a study: its steps run in a new folder, which appears whole or not at all; what is done stays."""

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
from typing import Any, NamedTuple

from ..errors import BadData, ExistingOutput, WeposeError
from ..writers.provenance import code, collect_provenance, file_hashes
from .plan import Anthropometrics, Item
from .steps import ItemFiles, ItemSteps, Row
from .storage import DONE_FILE, create_folder, fetch, is_remote, read_bytes, read_stamps

COMMAND = "batch item"
DONE, FAILED, CHANGED = "done", "failed", "changed"  # status of an item
PAGES = ("report.html", "view.html")  # to which a row of the study links


def run_items(
    items: Sequence[Item], place: str, force: bool = False, same_code: str | None = None, until: float = math.inf
) -> list[Row]:
    """A row an item, in their order, errors included; runs on a worker.

    Parameters
    ----------
    place : folder or URL of the items' folders
    force : run items again whose inputs, options or code have changed; otherwise they are `CHANGED`
    same_code : hash of the caller's code; a worker with other code refuses
    until : of `time.perf_counter`, after which no further item begins; rows are then fewer than items

    Raises
    ------
    BadData
        This worker has other code than the caller.
    """
    # Workers share the machine: a second thread would take the processor of another worker.
    os.environ.setdefault("WEPOSE_THREADS", "1")
    own = code()
    if same_code not in (None, own["code"]):
        raise BadData(
            f"a worker has another wepose-pin than this one: version {own['version']}, commit "
            f"{own['commit'] or 'not known'}; install the same everywhere"
        )
    rows: list[Row] = []
    for item in items:
        if rows and time.perf_counter() > until:
            break
        rows.append(_run_caught(item, place, force))
    return rows


def build_failed_row(item: Item, error: str, message: str) -> Row:
    """The row of an item that has failed."""
    return _describe_item(item) | {"status": FAILED, "error": error, "message": message}


def _describe_item(item: Item) -> Row:
    return {"item": item.name, "session": item.session, "subject": item.subject}


def _run_caught(item: Item, place: str, force: bool) -> Row:
    begin = time.perf_counter()
    try:
        return _describe_item(item) | run_item(item, place, force)
    except WeposeError as error:
        row = build_failed_row(item, type(error).__name__, " ".join(str(error).split()))
    except MemoryError:
        row = build_failed_row(item, "MemoryError", f"{item.session}: not enough memory for it on this worker")
    except Exception as error:  # a bug of ours: other items continue, and the table says where it is
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = " ".join(str(error).split())
        row = build_failed_row(item, type(error).__name__, f"{text} ({Path(last.filename).name}:{last.lineno})")
    return row | {"seconds": time.perf_counter() - begin}


def run_item(item: Item, place: str, force: bool = False) -> Row:
    """Make an item's folder, unless it is done, and return its columns of the table.

    An item that was made from other inputs, options or code stays as it is, `CHANGED`, unless `force`.

    Raises
    ------
    WeposeError
        Of any of its steps.
    """
    target = f"{place}/{item.name}"
    key = compute_key(item)
    done = _read_done(target)
    if done is not None:
        change = _find_change(item, key, done)
        if change is None:
            return done["row"] | {"status": DONE, "reused": True}
        if not force:
            message = f"{target}: was made from {change}; --force makes it again, -o names another folder"
            changed = {"status": CHANGED, "error": ExistingOutput.__name__, "message": message, "reused": True}
            return done["row"] | changed
    begin = time.perf_counter()
    with create_folder(target) as folder:
        stamps = _read_all_stamps(item)  # before the inputs are read: the next run sees what changes meanwhile
        row, provenance = run_steps(folder, item)
        row |= {"seconds": time.perf_counter() - begin, "memory_mb": _measure_peak_memory()}
        content = {"key": key, "provenance": provenance, "stamps": stamps, "row": row}
        (folder / DONE_FILE).write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")
    return row | {"status": DONE, "reused": False}


def run_steps(folder: Path, item: Item) -> tuple[Row, dict[str, Any]]:
    """Run the item's steps into an existing folder; its columns of the table, and its provenance.

    Raises
    ------
    WeposeError
        Of any of its steps.
    """
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        local = {source.name: source.fetch(Path(fetched)) for source in _list_inputs(item)}
        provenance = _collect_provenance(item, local)
        files = ItemFiles(folder, local["session"], local.get("subject_file"), local.get("truth"))
        steps, row, durations = ItemSteps(files, item.anthropometrics, provenance), Row(), Row()
        for step, options in item.steps.items():
            begin = time.perf_counter()
            row |= steps.run(step, options)
            durations[f"{step}_s"] = time.perf_counter() - begin
    pages = [f"{step}/{page}" for step in reversed(list(item.steps)) for page in PAGES]
    page = next((page for page in pages if (folder / page).is_file()), None)
    return row | {"page": page} | durations, provenance


def _measure_peak_memory() -> float:
    """Largest memory [MB] that this process has had."""
    with contextlib.suppress(OSError, StopIteration, ValueError):  # Linux's rusage includes the parent's, too
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def compute_key(item: Item) -> str:
    """Hash of the steps, options, anthropometrics and code of an item; its inputs have their own hashes."""
    content = {"steps": list(item.steps.items()), "body": asdict(item.anthropometrics), **code()}
    content.pop("commit")  # the hash of the code says more
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_item(provenance: Mapping[str, Any]) -> Item:
    """The item that a provenance describes.

    Raises
    ------
    BadData
        It describes something else, or is damaged.
    """
    try:
        options = provenance["options"]
        paths = {name: entry["path"] for name, entry in provenance["inputs"].items()}
        steps = {
            step: {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
            for step, own in options["steps"].items()
        }
        known = {name: paths.get(name) for name in ("subject_file", "truth")}
        person = Anthropometrics(**options["body"])
        return Item(options["name"], paths["session"], steps, options["subject"], **known, anthropometrics=person)
    except (KeyError, TypeError, AttributeError) as error:
        raise BadData(f"provenance: not that of a batch's item: {type(error).__name__} {error}") from None


class _Input(NamedTuple):
    """A file or folder from which an item is made; `truth`: with the reference that a session names."""

    name: str
    url: str
    truth: bool

    def fetch(self, folder: Path) -> Path:
        return fetch(self.url, folder, self.truth)


def _list_inputs(item: Item) -> list[_Input]:
    named = {"session": item.session, "subject_file": item.subject_file, "truth": item.truth}
    for step, options in item.steps.items():
        for name in ("model", "protocol", "robot"):
            value = options.get(name)
            if isinstance(value, str) and Path(value).is_file():
                named[f"{step}.{name}"] = value
    evaluated = "evaluate" in item.steps
    return [_Input(name, url, evaluated and name == "session") for name, url in named.items() if url is not None]


def _collect_provenance(item: Item, local: Mapping[str, Path]) -> dict[str, Any]:
    """Provenance with the places of the inputs themselves, not of local copies."""
    options = {"name": item.name, "subject": item.subject, "body": asdict(item.anthropometrics)}
    provenance = collect_provenance(COMMAND, options | {"steps": dict(item.steps)})
    provenance["inputs"] = {
        source.name: {
            "path": source.url if is_remote(source.url) else str(Path(source.url).absolute()),
            "files": file_hashes(local[source.name], source.truth),
        }
        for source in _list_inputs(item)
    }
    return provenance


def _read_all_stamps(item: Item) -> dict[str, Any]:
    return {source.name: read_stamps(source.url, source.truth) for source in _list_inputs(item)}


def _read_done(target: str) -> dict[str, Any] | None:
    """Contents of `done.json`; None where the folder is not complete."""
    content = read_bytes(f"{target}/{DONE_FILE}")
    if content is None:
        return None
    try:
        done = json.loads(content)
    except ValueError:
        return None
    whole = isinstance(done, dict) and all(isinstance(done.get(key), dict) for key in ("provenance", "stamps", "row"))
    return done if whole else None


def _find_change(item: Item, key: str, done: Mapping[str, Any]) -> str | None:
    """What has changed since an item was done; None: nothing."""
    was, now = done["provenance"], code()
    if was.get("code") != now["code"]:
        return f"other code, version {was.get('version')}" + (f" ({was['commit']})" if was.get("commit") else "")
    if done.get("key") != key:
        return "other options"
    inputs = _list_inputs(item)
    if {source.name: source.url for source in inputs} != {name: was["inputs"][name]["path"] for name in was["inputs"]}:
        return "other inputs"
    stamps = json.loads(json.dumps(_read_all_stamps(item)))
    if stamps == done["stamps"] and None not in stamps.values():
        return None
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        for source in inputs:
            if file_hashes(source.fetch(Path(fetched)), source.truth) != was["inputs"][source.name]["files"]:
                return f"another {source.name.replace('_', ' ')}: {source.url} has changed since"
    return None
