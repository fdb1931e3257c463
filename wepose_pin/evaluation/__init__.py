"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from __future__ import annotations

from .agreement import Agreement, compute_agreement, compute_icc
from .registration import Registration, register
from .scores import (
    AngleError,
    AttitudeError,
    Evaluation,
    PositionError,
    Uncertainty,
    attitude_error,
    evaluate,
    position_error,
    uncertainty,
)

__all__ = [
    "Agreement",
    "AngleError",
    "AttitudeError",
    "Evaluation",
    "PositionError",
    "Registration",
    "Uncertainty",
    "attitude_error",
    "compute_agreement",
    "compute_icc",
    "evaluate",
    "position_error",
    "register",
    "uncertainty",
]
