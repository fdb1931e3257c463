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
        row = describe(item) | _run(item, f"{place}/{item.name}", force)
    except Exception as error:
        message = str(error)
        if not isinstance(error, WeposeError):  # a bug of ours: other items continue, and the table says where it is
            last = traceback.extract_tb(error.__traceback__)[-1]
            message += f" ({Path(last.filename).name}:{last.lineno})"
        row = fail(item, type(error).__name__, message)
    return {"seconds": time.perf_counter() - begin} | row


def describe(item: Item) -> Row:
    """The columns that an item has before it runs."""
    return {"item": item.name, "session": item.session, "subject": item.subject}


def fail(item: Item, error: str, message: str) -> Row:
    """The row of an item that has failed."""
    return describe(item) | {"status": FAILED, "error": error, "message": " ".join(message.split())}


def _run(item: Item, target: str, force: bool) -> Row:
    begin = time.perf_counter()
    inputs = {"session": item.session} | ({"subject_file": item.subject_file} if item.subject_file else {})
    for step, options in item.steps.items():
        for name in ("model", "prior", "protocol", "robot"):
            if Path(str(options.get(name, ""))).is_file():
                inputs[f"{step}.{name}"] = str(options[name])
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        local: dict[str, Path] = {}
        hashes: dict[str, Mapping[str, str]] = {}
        for name, url in sorted(inputs.items()):
            with_truth = name == "session" and "evaluate" in item.steps  # the reference that it names
            local[name] = fetch(url, Path(fetched), with_truth)
            hashes[f"input {name}"] = file_hashes(local[name], with_truth)
        chosen = [list(item.steps.items()), item.person]
        key = json.loads(json.dumps({"code": code()["code"], "options": chosen, **hashes}))
        done: Any = None
        with contextlib.suppress(ValueError):  # a damaged file is none
            done = json.loads(read_bytes(f"{target}/{DONE_FILE}") or b"null")
        changed = [name for name in key if done and done["key"].get(name) != key[name]]
        if done and not changed:
            return done["row"] | {"status": DONE, "reused": True}
        if changed and not force:
            message = f"{target}: has other {', '.join(changed)}; --force runs it again, -o names another folder"
            return done["row"] | {"status": CHANGED, "error": ExistingOutput.__name__, "message": message}
        with create_folder(target) as folder:
            row = _run_steps(item, local["session"], local.get("subject_file"), folder)
            row["seconds"] = time.perf_counter() - begin
            text = json.dumps({"key": key, "row": row}, indent=1, ensure_ascii=False)
            (folder / DONE_FILE).write_text(text, encoding="utf-8")
    return row | {"status": DONE}


def _run_steps(item: Item, session: Path, subject: Path | None, folder: Path) -> Row:
    """Run the steps by the commands of their names, each into a folder of its name; column → value."""
    row: Row = {}
    places = {"session": str(session), "result": str(folder / "track"), "truth": str(session)}
    for step, options in item.steps.items():
        out, inputs = folder / step, [places[name] for name in STEPS[step]]
        if step == "calibrate":
            calibration = _run_command(step, inputs, {**options, **item.person, "out": out}).result
            row |= {"quality": calibration.quality.quality, "gap_mm": 1e3 * calibration.rms_gap}
            for name, value in calibration.subject.lengths.items():
                row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": 1e3 * calibration.subject.std(name)}
            subject = out
        elif step == "track":
            summary = _run_command(step, inputs, {**options, "out": out} | ({"subject": subject} if subject else {}))
            row |= {name: summary[name] for name in ("samples", "rate_hz", "duration_s")}
            row["diagnostics"] = len(summary["diagnostics"])
        elif step == "retarget":
            summary = _run_command(step, inputs, {**options, "out": out}).result
            row["trajectory_within_limits"] = summary["within_limits"]
            row["trajectory_self_collisions"] = summary["self_collisions"]["samples"]
        elif step == "export":
            row["export_diagnostics"] = _export(inputs, options, out)
        else:
            errors = _run_command(step, inputs, options)
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
    """Write all formats, each with those options that it has; the number of their diagnostics."""
    from ..writers.export import list_formats

    folder.mkdir()
    count = 0
    for format in options["formats"]:
        kind = list_formats()[format]
        file = folder / (f"motion.{format}" if kind.suffix is None else f"{format}{kind.suffix}")
        own = {name: value for name, value in options.items() if name in kind.options}
        count += len(_run_command("export", places, own | {"out": file, "format": format}).diagnostics)
    return count
