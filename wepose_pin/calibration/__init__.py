"""Link lengths, mounts and headings from hands held together, or from another protocol.

`procedure` is the calibration from a recording to a subject, step by step. `protocols` describes what a person does,
`conditions` what follows for a body, `problem` collects inputs and samples. `equations` has the unknowns and residuals
in CasADi, `priors` what is known before, `least_squares` the problem and its solution by `nlpsol`. `initial_headings`
and `contact` give the initial guess, `joints` adds what accelerations observe of headings, `sample_losses` finds the
samples connected with the start pose, `weights` weighs the samples, `alternatives` searches other minima. `solution`
makes of it a `result`, which `anatomy`, `observability` and `quality` assess. `paper` is the published calibration of
the lengths alone. `fusion` adds an earlier calibration of the person.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .paper import Formulation
    from .procedure import MEASURED_STD, calibrate
    from .protocols import PROTOCOLS, Protocol, load_protocol
    from .quality import assess
    from .result import Calibration, CalibrationQuality, Check

# Loaded on first use: tracking takes protocols and conditions from here, and does not need CasADi.
_WHERE = {
    "MEASURED_STD": "procedure",
    "PROTOCOLS": "protocols",
    "Calibration": "result",
    "CalibrationQuality": "result",
    "Check": "result",
    "Formulation": "paper",
    "Protocol": "protocols",
    "assess": "quality",
    "calibrate": "procedure",
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
    "load_protocol",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'wepose_pin.calibration' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)
