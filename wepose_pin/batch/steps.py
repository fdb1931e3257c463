"""Steps of an item: each runs the job of the command of its name and gives columns of the table."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..jobs.calibrate import CalibrateJob, run_calibrate
from ..jobs.evaluate import EvaluateJob, run_evaluate
from ..jobs.export import ExportJob, run_export
from ..jobs.fields import build_job
from ..jobs.retarget import RetargetJob, run_retarget
from ..jobs.track import TrackJob, run_track
from ..writers.result import as_json
from .plan import Item

Row = dict[str, Any]
_WITH_MODEL = ("sto", "scale")  # formats that take OpenSim's model


def run_steps(item: Item, session: Path, subject: Path | None, folder: Path) -> Row:
    """Run the steps into folders of their names, each with the results of those before; column → value.

    `session`, `subject`: local copies of what the item names.

    Raises
    ------
    WeposeError
        What the recording, the subject or an option lacks.
    """
    row: Row = {}
    for step, options in item.steps.items():
        values = {**options, "out": folder / step, "result": folder / "track"}
        if step == "calibrate":
            row |= _calibrate({**options, **item.person, "session": session, "out": folder / step})
            subject = folder / step
        elif step == "track":
            row |= _track({**options, "session": session, "subject": subject, "out": folder / step})
        elif step == "retarget":
            outcome = run_retarget(build_job(RetargetJob, values))
            row["trajectory_within_limits"] = outcome.summary["within_limits"]
            row["trajectory_self_collisions"] = outcome.summary["self_collisions"]["samples"]
        elif step == "export":
            row["export_diagnostics"] = _export(values)
        else:
            row |= _evaluate({**options, "result": folder / "track", "truth": session}, folder / step)
    return row


def _calibrate(values: Row) -> Row:
    outcome = run_calibrate(build_job(CalibrateJob, values))
    subject = outcome.calibration.subject
    row = {"quality": outcome.quality.quality, "gap_mm": _finite(1e3 * outcome.calibration.rms_gap)}
    for name, value in subject.lengths.items():
        row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": _finite(1e3 * subject.std(name))}
    return row


def _track(values: Row) -> Row:
    outcome = run_track(build_job(TrackJob, values))
    row = {name: outcome.summary[name] for name in ("samples", "rate_hz", "duration_s")}
    return row | {"diagnostics": len(outcome.summary["diagnostics"]) + len(outcome.page_failures)}


def _export(values: Row) -> int:
    """Write all formats; the number of their diagnostics."""
    from ..writers.export import SUFFIXES, WITHOUT_MOTION

    folder = values["out"]
    folder.mkdir()
    count = 0
    for format in values.pop("formats"):
        file = folder / (f"{format}{SUFFIXES[format]}" if format in SUFFIXES else f"motion.{format}")
        # What is given for another of the formats is left out.
        others = {"names": format != "mot", "osim_model": format not in _WITH_MODEL}
        others["rate_hz"] = format in WITHOUT_MOTION
        own = {name: value for name, value in values.items() if not others.get(name)}
        count += len(run_export(build_job(ExportJob, own | {"out": file, "format": format})).diagnostics)
    return count


def _evaluate(values: Row, out: Path) -> Row:
    errors = run_evaluate(build_job(EvaluateJob, values))
    out.mkdir()
    text = json.dumps(as_json(asdict(errors)), indent=2)
    (out / "errors.json").write_text(text + "\n", encoding="utf-8")
    row = {f"{point}_limb_error_mm": error.mean for point, error in errors.position_on_limb.items()}
    row |= {f"{point}_error_mm": error.mean for point, error in errors.position.items()}
    return row | {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
