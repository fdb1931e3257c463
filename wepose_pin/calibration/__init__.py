"""Link lengths, mounts and headings from hands held together, or from another protocol.

`protocols` says what holds in which phase, `chain` is the chain in CasADi, `problem` the least squares over all that is
not known, `known` what is known before, `start` finds headings without a guess, `joints` what accelerations tell of
them, `weighing` what the looks are worth, `lengths` is the calibration from a recording to a subject. `touching` and
`anatomy` guard it against hands apart and sensors exchanged; `observability` says what the motion does not show, and
`quality` what the calibration is worth.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from ..diagnostics import lines
from ..errors import CalibrationFailed, WeposeWarning
from ..filters import BEST
from ..recording import Recording
from ..subject import Subject
from .chain import ARMS, CHAIN, palm_gap, rotate
from .lengths import GAUGE_STD, Calibration, calibrate_lengths
from .protocols import PROTOCOLS, Protocol, load_protocol
from .quality import CalibrationQuality, Check, assess, document

__all__ = [
    "ARMS",
    "CHAIN",
    "GAUGE_STD",
    "PROTOCOLS",
    "Calibration",
    "CalibrationQuality",
    "Check",
    "Protocol",
    "assess",
    "calibrate",
    "calibrate_lengths",
    "document",
    "load_protocol",
    "palm_gap",
    "rotate",
]


def calibrate(
    recording: Recording,
    *,
    gauge: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    protocol: str | Protocol = "clasp",
    method: str = BEST,
    gauge_std: float = GAUGE_STD,
) -> Subject:
    """The subject of a hands-together recording, if the calibration does not fail. Parameters as `calibrate_lengths`.

    What else was found: `calibrate_lengths`, and `assess` for what it is worth.

    Raises
    ------
    CalibrationFailed
        Its quality is "fail"; the error has what was found all the same, in `calibration.subject`, and the `quality`.
    WeposeError
        As `calibrate_lengths`.

    Warns
    -----
    WeposeWarning
        Its quality is "poor": what is uncertain, and what to do better.
    """
    found = calibrate_lengths(
        recording, gauge=gauge, prior=prior, protocol=protocol, method=method, gauge_std=gauge_std
    )
    quality = assess(found)
    reasons = " ".join(line for _, line in lines(quality.reasons))
    text = f"{recording.where()}: the calibration's quality is '{quality.quality}'. {reasons}"
    if quality.quality == "fail":
        raise CalibrationFailed(f"{text} This error's calibration.subject has what was found.", found, quality)
    if quality.quality == "poor":
        warnings.warn(text, WeposeWarning, stacklevel=2)
    return found.subject
