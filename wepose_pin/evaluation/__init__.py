"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from .registration import Registration, register
from .scores import (
    AttitudeError,
    Evaluation,
    PositionError,
    attitude_error,
    compute_agreement,
    compute_icc,
    evaluate,
    uncertainty,
)

__all__ = [
    "AttitudeError",
    "Evaluation",
    "PositionError",
    "Registration",
    "attitude_error",
    "compute_agreement",
    "compute_icc",
    "evaluate",
    "register",
    "uncertainty",
]
