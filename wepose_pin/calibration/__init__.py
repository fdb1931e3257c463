"""Link lengths, mounts and headings from a hands-together phase: the closed chain of both arms.

`chain` is the chain in CasADi, `problem` the least squares over all that is not known, `start` finds headings without a
guess, `lengths` is the calibration from a recording to a subject.
"""

from __future__ import annotations

from .chain import ARMS, CHAIN, palm_gap, rotate
from .lengths import GAUGE_STD, PROTOCOLS, Calibration, calibrate, calibrate_lengths

__all__ = [
    "ARMS",
    "CHAIN",
    "GAUGE_STD",
    "PROTOCOLS",
    "Calibration",
    "calibrate",
    "calibrate_lengths",
    "palm_gap",
    "rotate",
]
