"""``calibration.json``: the quality of a calibration, with everything that led to it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..calibration import Calibration, CalibrationQuality, document
from .result import as_json, versions


def write_calibration(
    folder: Path, calibration: Calibration, quality: CalibrationQuality, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write ``calibration.json`` into an existing folder; `provenance` becomes part of it."""
    content = as_json(document(calibration, quality)) | {"versions": versions()}
    if provenance is not None:
        content["provenance"] = dict(provenance)
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "calibration.json").write_text(text + "\n", encoding="utf-8")
