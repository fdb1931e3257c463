"""Link lengths, mounts and headings from hands held together, or from another protocol.

`lengths` is the calibration from a recording to a subject. `protocols` describes what a person does, `problem` collects
inputs and samples, `chain` is the model's chains in CasADi, `least_squares` unknowns and residuals, `solver` the
problem and its solution by `nlpsol`, `priors` what is known before. `initial_headings` and `contact` give the initial
guess, `joints` adds what accelerations observe of headings, `sample_losses` finds the samples connected with the start
pose, `weights` weighs the samples, `alternatives` searches other minima, `anatomy` checks sensors and mounts. `paper`
is the published calibration of the lengths alone. `fusion` adds an earlier calibration of the person. `result` is what
comes of it, `observability` and `quality` assess it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .lengths import MEASURED_STD, calibrate
    from .paper import Formulation
    from .protocols import PROTOCOLS, Protocol, load_protocol
    from .quality import CalibrationQuality, Check, assess, document
    from .result import Calibration

# Loaded on first use: tracking takes protocols and conditions from here, and does not need CasADi.
_WHERE = {
    "MEASURED_STD": "lengths",
    "PROTOCOLS": "protocols",
    "Calibration": "result",
    "CalibrationQuality": "quality",
    "Check": "quality",
    "Formulation": "paper",
    "Protocol": "protocols",
    "assess": "quality",
    "calibrate": "lengths",
    "document": "quality",
    "load_protocol": "protocols",
}
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
    "document",
    "load_protocol",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'wepose_pin.calibration' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)
