"""How wrong a pose is against a reference, which may have a clock, a world and frames of its own."""

from __future__ import annotations

from .agreement import Agreement, compute_agreement, compute_icc
from .registration import Registration, register
from .scores import AttitudeError, Evaluation, PositionError, attitude_error, evaluate, uncertainty

__all__ = [
    "Agreement",
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
