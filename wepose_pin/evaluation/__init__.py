"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from .registration import register as register
from .scores import AttitudeError as AttitudeError
from .scores import Evaluation as Evaluation
from .scores import attitude_error as attitude_error
from .scores import evaluate as evaluate
