"""Link lengths, mounts and headings from hands held together, or from another protocol.

`procedure` is the calibration from a recording to a subject, step by step. `protocols` describes what a person does,
and `problem` collects inputs and samples. `equations` has the unknowns, the residuals in CasADi and the prior.
`headings` searches headings without an initial guess. `least_squares` weighs the samples and solves the problem by
`nlpsol`; `result` is what it makes, and how good that is. `paper` is the published calibration of the lengths alone.
"""

from .paper import Formulation
from .procedure import MEASURED_STD, calibrate
from .protocols import PROTOCOLS, Protocol, load_protocol
from .result import Calibration, CalibrationQuality, Check, assess
