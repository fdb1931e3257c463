"""Steps of an item: each runs the job of the command of its name and returns columns of the table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..jobs.calibrate import CalibrateJob, run_calibrate
from ..jobs.evaluate import EvaluateJob, run_evaluate
from ..jobs.export import ExportJob, run_export
from ..jobs.fields import build_job
from ..jobs.retarget import RetargetJob, run_retarget
from ..jobs.track import TrackJob, run_track
from ..tracking import TrackedRecording
from ..writers.result import as_json
from .plan import Anthropometrics

Row = dict[str, Any]


class ItemFiles(NamedTuple):
    """Local files that an item's steps read, and the folder that they write to."""

    folder: Path
    session: Path
    subject: Path | None
    truth: Path | None


class ItemSteps:
    """The steps of one item, in order; each uses the results of those before.

    Parameters
    ----------
    provenance : of the results
    """

    def __init__(self, files: ItemFiles, person: Anthropometrics, provenance: Mapping[str, Any]) -> None:
        self._files, self._person, self._provenance = files, asdict(person), provenance
        self._subject = files.subject
        self._tracked: TrackedRecording | None = None

    def run(self, step: str, options: Mapping[str, Any]) -> Row:
        """Run a step into the folder of its name; column → value of the table.

        Raises
        ------
        WeposeError
            What the recording, the subject or an option lacks.
        """
        row: Row = getattr(self, f"_{step}")(self._files.folder / step, dict(options))
        return row

    def _calibrate(self, out: Path, options: Row) -> Row:
        job = build_job(CalibrateJob, options | self._person | {"session": self._files.session, "out": out})
        outcome = run_calibrate(job, provenance=self._provenance)
        self._subject = out
        calibration = outcome.calibration
        row = {
            "quality": outcome.quality.quality,
            "gap_mm": _finite(1e3 * calibration.rms_gap),
            "effective_sample_size": calibration.effective_sample_size,
        }
        for name, value in calibration.subject.lengths.items():
            row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": _finite(1e3 * calibration.subject.std(name))}
        return row

    def _track(self, out: Path, options: Row) -> Row:
        job = build_job(TrackJob, options | {"session": self._files.session, "out": out, "subject": self._subject})
        outcome = run_track(job, provenance=self._provenance)
        self._tracked, summary = outcome.tracked, outcome.summary
        static = [own["static_share"] for own in summary.get("sensors", {}).values() if "static_share" in own]
        return {
            "samples": summary["samples"],
            "rate_hz": summary["rate_hz"],
            "duration_s": summary["duration_s"],
            "sensors": len(summary.get("sensors", ())),
            "static_share": float(np.mean(static)) if static else None,
            "diagnostics": len(summary["diagnostics"]) + len(outcome.page_failures),
        }

    def _retarget(self, out: Path, options: Row) -> Row:
        job = build_job(RetargetJob, options | {"result": self._files.folder / "track", "out": out})
        outcome = run_retarget(job, provenance=self._provenance)
        return {
            "trajectory_s": outcome.duration_s,
            "trajectory_within_limits": outcome.summary["within_limits"],
            "trajectory_self_collisions": outcome.summary["self_collisions"]["samples"],
        }

    def _export(self, out: Path, options: Row) -> Row:
        from ..writers.export import SUFFIXES, WITHOUT_MOTION

        out.mkdir()
        formats, diagnostics = options.pop("formats"), 0
        for format in formats:
            file = out / (f"{format}{SUFFIXES[format]}" if format in SUFFIXES else f"motion.{format}")
            unused = {} if format == "mot" else {"names": None}
            unused |= {"rate_hz": None} if format in WITHOUT_MOTION else {}
            unused |= {} if format in ("sto", "scale") else {"osim_model": None}
            result = {"result": self._files.folder / "track", "out": file, "format": format}
            written = run_export(build_job(ExportJob, options | unused | result), provenance={})
            diagnostics += len(written.diagnostics)
        return {"export_diagnostics": diagnostics}

    def _evaluate(self, out: Path, options: Row) -> Row:
        tracked = self._tracked
        truth = self._files.truth or (tracked.recording.truth if tracked is not None else None) or self._files.session
        job = build_job(EvaluateJob, options | {"result": self._files.folder / "track", "truth": truth})
        errors = run_evaluate(job, tracked=tracked)
        out.mkdir()
        text = json.dumps(as_json(asdict(errors)), indent=2)
        (out / "errors.json").write_text(text + "\n", encoding="utf-8")
        tips = tracked.model.table.paths if tracked is not None else ()
        points = sorted(errors.position, key=lambda point: point not in tips)  # those first whose path is drawn
        row: Row = {}
        for point in points:
            if point in errors.position_on_limb:
                row[f"{point}_limb_error_mm"] = errors.position_on_limb[point].mean
            row[f"{point}_error_mm"] = errors.position[point].mean
        row |= {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}
        return row


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
