"""Link lengths, mounts and headings from hands held together, or from another protocol.

`lengths` is the calibration from a recording to a subject. `protocols` describes what a person does, `problem` collects
inputs and samples, `chain` is the model's chains in CasADi, `least_squares` unknowns and residuals, `solver` the
problem and its solution by `nlpsol`, `priors` what is known before. `initial_headings` and `contact` give the start,
`joints` adds what accelerations show of headings, `losses` what lost samples change, `weights` weighs the samples,
`alternatives` searches other minima, `anatomy` checks sensors and mounts. `paper` is the published calibration of the
lengths alone. `result` is the outcome, `observability` and `quality` assess it.
"""

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
from .protocols import PROTOCOLS, Protocol, load_protocol
from .quality import CalibrationQuality, Check, assess, document
from .result import Calibration

__all__ = [
    "MEASURED_STD",
    "PROTOCOLS",
    "Calibration",
    "CalibrationQuality",
    "Check",
    "Formulation",
    "Protocol",
    "assess",
    "calibrate",
    "calibrate_lengths",
    "document",
    "load_protocol",
]


def calibrate(
    recording: Recording,
    *,
    measured: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    model: BodyModel | None = None,
    protocol: str | Protocol = "clasp",
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
