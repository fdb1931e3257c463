"""wepose-pin: the pose of a person's upper body from wearable IMUs without magnetometers.

Conventions, everywhere:

- SI inside; a value in another unit carries a suffix (`angle_deg`, `rate_hz`).
- World W: z up, x forward (where the torso faces in the start pose), y left, origin midway between the hips.
  Segment L, sensor S, robot base B. `R_WS = R_WL @ R_LS`: inner letters cancel.
- `gyro_S` [rad/s] is the rate over the interval that ends at the sample; `accel_S` [m/s²] is +g up while static.
- Every segment frame equals W in the N-pose.
- Quaternions are xyzw, unit norm, named `quat_WS`; `q` is a Pinocchio configuration and nothing else.
- Perturbations stand on the right: `R_WS @ exp(dtheta_S)`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Loaded on first use, so that the command line answers at once.
_WHERE = {
    "CalibrationFailed": "errors",
    "ImuSensor": "recording",
    "OrientationSensor": "recording",
    "Pose": "kinematics",
    "Recording": "recording",
    "Sensor": "recording",
    "StaticTest": "filters.static",
    "Subject": "subject",
    "WeposeError": "errors",
    "WeposeWarning": "errors",
    "population_subject": "subject",
    "calibrate": "calibration",
    "estimate_orientation": "filters",
    "evaluate": "evaluation",
    "export": "writers.export",
    "joint_angles": "angles",
    "load_model": "model",
    "load_robot": "model.robot",
    "load_session": "readers",
    "load_subject": "subject",
    "retarget": "retargeting",
    "simulate": "simulation",
    "track": "tracking",
    "track_chain": "tracking",
}
__all__ = ["__version__", *sorted(_WHERE)]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'wepose_pin' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
