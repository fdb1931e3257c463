"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from .registration import Registration, register
from .scores import (
    AttitudeError,
    Evaluation,
    PositionError,
    angle_error,
    attitude_error,
    compute_icc,
    evaluate,
    uncertainty,
)

__all__ = [
    "AttitudeError",
    "Evaluation",
    "PositionError",
    "Registration",
    "angle_error",
    "attitude_error",
    "compute_icc",
    "evaluate",
    "register",
    "uncertainty",
]
