"""``calibration.json``: the verdict on a calibration, with everything that led to it."""

from __future__ import annotations

import json
from pathlib import Path

from ..calibration import Calibration, Verdict, document
from .result import as_json, versions


def write_calibration(folder: Path, calibration: Calibration, verdict: Verdict) -> None:
    """Write ``calibration.json`` into an existing folder."""
    content = as_json(document(calibration, verdict)) | {"versions": versions()}
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "calibration.json").write_text(text + "\n", encoding="utf-8")
