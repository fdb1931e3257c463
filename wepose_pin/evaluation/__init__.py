"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from .registration import register
from .scores import AttitudeError, Evaluation, attitude_error, evaluate
