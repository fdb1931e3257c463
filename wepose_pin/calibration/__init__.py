"""Link lengths, mounts and headings from hands held together, or from another protocol.

`procedure` is the calibration from a recording to a subject, step by step. `protocols` describes what a person does,
`conditions` what follows for a body, `problem` collects inputs and samples. `equations` has the unknowns, the residuals
in CasADi and the prior, `least_squares` the solution by `nlpsol`. `initial_headings` searches headings without an
initial guess, and `couplings` has what accelerations observe of them. `weights` weighs the samples. `solution` makes a
`result`, and `quality` assesses it. `paper` is the published calibration of the lengths alone.
"""

from .paper import Formulation
from .procedure import MEASURED_STD, calibrate
from .protocols import PROTOCOLS, Protocol, load_protocol
from .quality import assess
from .result import Calibration, CalibrationQuality, Check

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
