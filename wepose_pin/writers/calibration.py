"""``calibration.json``: the quality of a calibration, with everything that led to it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration import Calibration
from ..diagnostics import as_json as diagnostic_as_json
from .result import as_json, versions, write_subject

MOST_POINTS = 600  # of the residual over time


def write_calibration(folder: Path, calibration: Calibration, provenance: Mapping[str, Any]) -> None:
    """Write the subject and ``calibration.json``, with the provenance, into an existing folder."""
    write_subject(folder, calibration.subject, calibration.subject.shape(calibration.problem.model))
    content = {**as_json(_document(calibration)), "versions": versions(), "provenance": dict(provenance)}
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "calibration.json").write_text(text + "\n", encoding="utf-8")


def _document(calibration: Calibration) -> dict[str, Any]:
    """The content of ``calibration.json``; lengths [m], times [s], angles as named, checks and diagnostics SI."""
    subject, quality = calibration.subject, calibration.quality
    some = slice(None, None, -(-len(calibration.time) // MOST_POINTS))
    return {
        "quality": quality.quality,
        "diagnostics": [diagnostic_as_json(diagnostic) for diagnostic in quality.diagnostics],
        "checks": [
            {"code": check.diagnostic.code, "place": check.diagnostic.place, "quality": check.quality}
            | {"value": _number(check.value), "passes": check.passes, "poor": check.poor}
            for check in quality.checks
        ],
        "protocol": calibration.problem.protocol.name,
        "measured": {name: metres for name, (metres, _) in calibration.problem.measured.items()},
        "scale_std": _number(calibration.scale_std),
        "lengths": {n: {"value": v, "std": _number(subject.std(n))} for n, v in subject.lengths.items()},
        "mounts": {
            segment: {
                **{key: float(v) for key, v in zip(("qx", "qy", "qz", "qw"), quat, strict=True)},
                "std_deg": [_number(np.degrees(subject.std(f"mounts.{segment}.{axis}"))) for axis in "xyz"],
            }
            for segment, quat in subject.mounts.items()
        },
        "start_pose_offset_deg": {name: np.degrees(offset[:2]) for name, offset in subject.start_pose_offset.items()},
        "heading_drift_deg_min": {name: 60.0 * np.degrees(drift[0]) for name, drift in subject.heading_drift.items()},
        "hinges": {
            joint: {"axis": subject.hinges[joint].axis, "rms_deg": _number(np.degrees(rms))}
            for joint, rms in calibration.hinge_rms.items()
        },
        "gap_rms": {"after": _number(calibration.rms_gap), "before": _number(calibration.prior_rms_gap)},
        "gap": {
            "time": calibration.time[some].round(3),
            "after": [_number(v) for v in calibration.gap[some]],
            "before": [_number(v) for v in calibration.prior_gap[some]],
            "contact": calibration.contact[some].round(3),
        },
        "open_intervals": calibration.open_intervals,
        "effective_sample_size": calibration.effective_sample_size,
        "moved": dict(calibration.exchanged),
    }


def _number(value: float) -> float | None:
    """None where it is not finite, which JSON cannot say."""
    return float(value) if np.isfinite(value) else None
