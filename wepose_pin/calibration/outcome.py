"""`calibrate`: a recording to a subject, where the calibration does not fail."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from ..diagnostics import lines
from ..errors import CalibrationFailed, WeposeWarning
from ..filters import BEST
from ..model import BodyModel
from ..recording import Recording
from ..subject import Subject
from .lengths import MEASURED_STD, calibrate_lengths
from .paper import Formulation
from .protocols import Protocol
from .quality import assess


def calibrate(
    recording: Recording,
    *,
    measured: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    model: BodyModel | None = None,
    protocol: str | Protocol | None = None,
    method: str = BEST,
    measured_std: float = MEASURED_STD,
    formulation: Formulation = "full",
) -> Subject:
    """The subject of a hands-together recording, if the calibration does not fail. Parameters as `calibrate_lengths`.

    `calibrate_lengths` gives all results, and `assess` their quality.

    Raises
    ------
    CalibrationFailed
        Its quality is "fail"; the error holds the `calibration` and its `quality`.
    WeposeError
        As `calibrate_lengths`.

    Warns
    -----
    WeposeWarning
        Its quality is "poor": what is uncertain, and what to do.
    """
    calibration = calibrate_lengths(
        recording,
        measured=measured,
        prior=prior,
        model=model,
        protocol=protocol,
        method=method,
        measured_std=measured_std,
        formulation=formulation,
    )
    quality = assess(calibration)
    reasons = " ".join(line for _, line in lines(quality.reasons))
    text = f"{recording.where()}: the calibration's quality is '{quality.quality}'. {reasons}"
    if quality.quality == "fail":
        raise CalibrationFailed(
            f"{text} The subject all the same: this error's calibration.subject.", calibration, quality
        )
    if quality.quality == "poor":
        warnings.warn(text, WeposeWarning, stacklevel=2)
    return calibration.subject
