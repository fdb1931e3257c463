"""One item of a study: its steps run in a new folder, which appears whole or not at all; what is done stays."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..commands.command_line import parse
from ..errors import ExistingOutput, WeposeError
from ..writers.provenance import code, file_hashes
from ..writers.result import as_json
from .plan import STEPS, Item, write_words
from .storage import DONE_FILE, create_folder, fetch, read_bytes

Row = dict[str, Any]  # of the table: column → value
DONE, FAILED, CHANGED = "done", "failed", "changed"  # status of an item


def run_item(item: Item, place: str, force: bool = False) -> Row:
    """Run an item unless it is done, into a folder below `place`; its row of the table, errors included.

    `force`: run it again where its inputs, options or code have changed; otherwise it is `CHANGED`.
    """
    begin = time.perf_counter()
    try:
        row = _run(item, f"{place}/{item.name}", force)
    except WeposeError as error:
        row = fail(type(error).__name__, str(error))
    except Exception as error:  # a bug of ours: other items continue, and the table says where it is
        last = traceback.extract_tb(error.__traceback__)[-1]
        row = fail(type(error).__name__, f"{error} ({Path(last.filename).name}:{last.lineno})")
    return {**describe(item), "seconds": time.perf_counter() - begin, **row}


def describe(item: Item) -> Row:
    """The columns that an item has before it runs."""
    return {"item": item.name, "session": item.session, "subject": item.subject}


def fail(error: str, message: str) -> Row:
    """The columns of an item that has failed."""
    return {"status": FAILED, "error": error, "message": " ".join(message.split())}


def _run(item: Item, target: str, force: bool) -> Row:
    begin, evaluates = time.perf_counter(), "evaluate" in item.steps
    inputs = {"session": item.session, "subject_file": item.subject_file}
    for step, options in item.steps.items():
        files = {name: options.get(name) for name in ("model", "prior", "protocol", "robot")}
        inputs |= {f"{step}.{name}": str(file) for name, file in files.items() if file and Path(file).is_file()}
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        # With `evaluate`, a session includes the reference that it names.
        local = {
            name: fetch(url, Path(fetched), evaluates and name == "session") for name, url in inputs.items() if url
        }
        hashes = {
            f"input {name}": file_hashes(path, evaluates and name == "session") for name, path in sorted(local.items())
        }
        key = {"code": code()["code"], "options": [list(item.steps.items()), item.person], **hashes}
        key = json.loads(json.dumps(key))
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


def _read_done(target: str) -> Any:
    """Contents of `DONE_FILE`; None where it is missing or damaged."""
    with contextlib.suppress(ValueError):
        return json.loads(read_bytes(f"{target}/{DONE_FILE}") or b"null")
    return None


def run_steps(item: Item, session: Path, subject: Path | None, folder: Path) -> Row:
    """Run the steps by the commands of their names, each into a folder of its name; column → value.

    `session`, `subject`: local copies of what the item names.
    """
    row: Row = {}
    places = {"session": str(session), "result": str(folder / "track"), "truth": str(session)}
    for step, options in item.steps.items():
        out, given = folder / step, [places[name] for name in STEPS[step]]
        if step == "calibrate":
            calibration = _run_command(step, given, {**options, **item.person, "out": out}).calibration
            row |= {"quality": calibration.quality.quality, "gap_mm": 1e3 * calibration.rms_gap}
            for name, value in calibration.subject.lengths.items():
                row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": 1e3 * calibration.subject.std(name)}
            subject = out
        elif step == "track":
            known = {} if subject is None else {"subject": subject}
            tracked = _run_command(step, given, {**options, **known, "out": out})
            row |= {name: tracked.summary[name] for name in ("samples", "rate_hz", "duration_s")}
            row["diagnostics"] = len(tracked.summary["diagnostics"]) + len(tracked.page_failures)
        elif step == "retarget":
            summary = _run_command(step, given, {**options, "out": out}).summary
            row["trajectory_within_limits"] = summary["within_limits"]
            row["trajectory_self_collisions"] = summary["self_collisions"]["samples"]
        elif step == "export":
            row["export_diagnostics"] = _export(given, options, out)
        else:
            errors = _run_command("evaluate", given, options)
            out.mkdir()
            text = json.dumps(as_json(asdict(errors)), indent=2)
            (out / "errors.json").write_text(text + "\n", encoding="utf-8")
            row |= {f"{point}_limb_error_mm": error.mean for point, error in errors.position_on_limb.items()}
            row |= {f"{point}_error_mm": error.mean for point, error in errors.position.items()}
            row |= {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}
    return {name: None if isinstance(value, float) and not np.isfinite(value) else value for name, value in row.items()}


def _run_command(step: str, places: list[str], options: Mapping[str, Any]) -> Any:
    """What the command of a step returns; what it prints is dropped."""
    command, bound = parse(write_words(step, places, options))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return command(*bound.args, **bound.kwargs)


def _export(places: list[str], options: Mapping[str, Any], folder: Path) -> int:
    """Write all formats; the number of their diagnostics."""
    from ..writers.export import list_formats

    folder.mkdir()
    count, formats = 0, options["formats"]
    for format in [formats] if isinstance(formats, str) else formats:
        kind = list_formats()[format]
        file = folder / (f"motion.{format}" if kind.suffix is None else f"{format}{kind.suffix}")
        # What is given for another of the formats is left out.
        others = {"formats": True, **{name: name not in kind.options for name in ("names", "osim_model", "rate_hz")}}
        own = {name: value for name, value in options.items() if not others.get(name)}
        count += len(_run_command("export", places, own | {"out": file, "format": format}).diagnostics)
    return count
