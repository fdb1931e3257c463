"""Steps of an item: each runs the command of its name and gives columns of the table."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..commands.command_line import parse
from ..writers.result import as_json
from .plan import STEPS, Item, write_words

Row = dict[str, Any]


def run_steps(item: Item, session: Path, subject: Path | None, folder: Path) -> Row:
    """Run the steps into folders of their names, each with the results of those before; column → value.

    `session`, `subject`: local copies of what the item names.

    Raises
    ------
    WeposeError
        What the recording, the subject or an option lacks.
    """
    row: Row = {}
    places = {"session": str(session), "result": str(folder / "track"), "truth": str(session)}
    for step, options in item.steps.items():
        out = folder / step
        given = [places[name] for name in STEPS[step]]
        if step == "calibrate":
            row |= _describe_calibration(_run(step, given, {**options, **item.person, "out": out}).calibration)
            subject = out
        elif step == "track":
            known = {} if subject is None else {"subject": subject}
            tracked = _run(step, given, {**options, **known, "out": out})
            row |= {name: tracked.summary[name] for name in ("samples", "rate_hz", "duration_s")}
            row["diagnostics"] = len(tracked.summary["diagnostics"]) + len(tracked.page_failures)
        elif step == "retarget":
            summary = _run(step, given, {**options, "out": out}).summary
            row["trajectory_within_limits"] = summary["within_limits"]
            row["trajectory_self_collisions"] = summary["self_collisions"]["samples"]
        elif step == "export":
            row["export_diagnostics"] = _export(given, options, out)
        else:
            row |= _evaluate(given, options, out)
    return row


def _run(step: str, places: list[str], options: Mapping[str, Any]) -> Any:
    """What the command of a step returns; what it prints is dropped."""
    command, bound = parse(write_words(step, places, options))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return command(*bound.args, **bound.kwargs)


def _describe_calibration(calibration: Any) -> Row:
    subject = calibration.subject
    row = {"quality": calibration.quality.quality, "gap_mm": _finite(1e3 * calibration.rms_gap)}
    for name, value in subject.lengths.items():
        row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": _finite(1e3 * subject.std(name))}
    return row


def _export(places: list[str], options: Mapping[str, Any], folder: Path) -> int:
    """Write all formats; the number of their diagnostics."""
    from ..writers.export import list_formats

    folder.mkdir()
    count = 0
    for format in options["formats"]:
        kind = list_formats()[format]
        file = folder / (f"motion.{format}" if kind.suffix is None else f"{format}{kind.suffix}")
        # What is given for another of the formats is left out.
        others = {"formats": True, **{name: name not in kind.options for name in ("names", "osim_model", "rate_hz")}}
        own = {name: value for name, value in options.items() if not others.get(name)}
        count += len(_run("export", places, own | {"out": file, "format": format}).diagnostics)
    return count


def _evaluate(places: list[str], options: Mapping[str, Any], out: Path) -> Row:
    errors = _run("evaluate", places, options)
    out.mkdir()
    text = json.dumps(as_json(asdict(errors)), indent=2)
    (out / "errors.json").write_text(text + "\n", encoding="utf-8")
    row = {f"{point}_limb_error_mm": error.mean for point, error in errors.position_on_limb.items()}
    row |= {f"{point}_error_mm": error.mean for point, error in errors.position.items()}
    return row | {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
