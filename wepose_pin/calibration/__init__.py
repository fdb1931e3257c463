"""Link lengths, mounts and headings from hands held together, or from another protocol.

`protocols` says what holds in which phase, `chain` is the chain in CasADi, `problem` the least squares over all that is
not known, `known` what is known before, `start` finds headings without a guess, `joints` what accelerations tell of
them, `weighing` what the looks are worth, `lengths` is the calibration from a recording to a subject. `touching` and
`anatomy` guard it against hands apart and sensors exchanged; `verdict` says what it is worth, in words of `remarks` and
`advice`.
"""

from __future__ import annotations

from .chain import ARMS, CHAIN, palm_gap, rotate
from .lengths import GAUGE_STD, Calibration, calibrate, calibrate_lengths
from .protocols import PROTOCOLS, Protocol, load_protocol
from .verdict import Finding, Verdict, document, judge

__all__ = [
    "ARMS",
    "CHAIN",
    "GAUGE_STD",
    "PROTOCOLS",
    "Calibration",
    "Finding",
    "Protocol",
    "Verdict",
    "calibrate",
    "calibrate_lengths",
    "document",
    "judge",
    "load_protocol",
    "palm_gap",
    "rotate",
]
