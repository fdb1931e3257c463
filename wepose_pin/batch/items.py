"""One item of a study: its steps run in a new folder, which appears whole or not at all; what is done stays."""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import BadData, ExistingOutput, WeposeError
from ..writers.provenance import code, file_hashes
from .plan import Item
from .steps import Row, run_steps
from .storage import DONE_FILE, create_folder, fetch, read_bytes

DONE, FAILED, CHANGED = "done", "failed", "changed"  # status of an item


def run_item(item: Item, place: str, force: bool = False, same_code: str | None = None) -> Row:
    """Run an item unless it is done, into a folder below `place`; its row of the table, errors included.

    `force`: run it again where its inputs, options or code have changed; otherwise it is `CHANGED`.

    Raises
    ------
    BadData
        This worker has other code than the caller, whose hash is `same_code`.
    """
    own = code()
    if same_code not in (None, own["code"]):
        raise BadData(
            f"a worker has another wepose-pin than this one: version {own['version']}, commit "
            f"{own['commit'] or 'not known'}; install the same everywhere"
        )
    begin = time.perf_counter()
    try:
        row = _run(item, f"{place}/{item.name}", force)
        return {"item": item.name, "session": item.session, "subject": item.subject} | row
    except WeposeError as error:
        row = build_failed_row(item, type(error).__name__, " ".join(str(error).split()))
    except Exception as error:  # a bug of ours: other items continue, and the table says where it is
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{' '.join(str(error).split())} ({Path(last.filename).name}:{last.lineno})"
        row = build_failed_row(item, type(error).__name__, text)
    return row | {"seconds": time.perf_counter() - begin}


def build_failed_row(item: Item, error: str, message: str) -> Row:
    """The row of an item that has failed."""
    about = {"item": item.name, "session": item.session, "subject": item.subject}
    return about | {"status": FAILED, "error": error, "message": message}


def _run(item: Item, target: str, force: bool) -> Row:
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        inputs = _list_inputs(item)
        evaluated = "evaluate" in item.steps  # with the reference that the session names
        local = {name: fetch(url, Path(fetched), evaluated and name == "session") for name, url in inputs.items()}
        key = json.loads(json.dumps(_make_key(item, local)))
        done = _read_done(target)
        if done is not None:
            changed = [name for name in key if done["key"].get(name) != key[name]]
            if not changed:
                return done["row"] | {"status": DONE, "reused": True}
            if not force:
                message = f"{target}: has other {', '.join(changed)}; --force runs it again, -o names another folder"
                status = {"status": CHANGED, "error": ExistingOutput.__name__, "message": message, "reused": True}
                return done["row"] | status
        with create_folder(target) as folder:
            row = run_steps(item, local["session"], local.get("subject_file"), folder)
            row |= {"seconds": time.perf_counter() - begin}
            text = json.dumps({"key": key, "row": row}, indent=1, ensure_ascii=False)
            (folder / DONE_FILE).write_text(text, encoding="utf-8")
    return row | {"status": DONE, "reused": False}


def _list_inputs(item: Item) -> dict[str, str]:
    """Name → path or URL of what an item is made from."""
    named = {"session": item.session, "subject_file": item.subject_file}
    for step, options in item.steps.items():
        for name in ("model", "prior", "protocol", "robot"):
            value = options.get(name)
            if isinstance(value, str) and Path(value).is_file():
                named[f"{step}.{name}"] = value
    return {name: url for name, url in named.items() if url is not None}


def _make_key(item: Item, local: Mapping[str, Path]) -> dict[str, Any]:
    """What makes an item: code, options, and the SHA-256 of each input."""
    truth = "evaluate" in item.steps
    return {
        "code": code()["code"],
        "options": [list(item.steps.items()), item.person],
        **{f"input {name}": file_hashes(path, truth and name == "session") for name, path in sorted(local.items())},
    }


def _read_done(target: str) -> dict[str, Any] | None:
    """Contents of `done.json`; None where the folder is not complete."""
    content = read_bytes(f"{target}/{DONE_FILE}")
    try:
        done = json.loads(content or b"")
    except ValueError:
        return None
    return done if isinstance(done, dict) and {dict} == {type(done.get(name)) for name in ("key", "row")} else None
