"""`Sensor`: what one sensor measured, and which way it is mounted on its segment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SEGMENTS = (
    "torso",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    "pelvis",
    "head",
    "left_hand",
    "right_hand",
)

# The sensor axes that a mount can be stated with.
AXES = {sign + axis: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, axis in enumerate("xyz")}


def mount_from_axes(up: str, forward: str) -> np.ndarray:
    """`quat_LS` (4,) xyzw of the sensor axes that point up and forward in the start pose, as in ``"+x", "-z"``.

    The rows of R_LS are the segment's axes in the sensor.
    """
    up_S, forward_S = AXES[up], AXES[forward]
    return Rotation.from_matrix([forward_S, np.cross(up_S, forward_S), up_S]).as_quat()


def axes_from_mount(quat_LS: np.ndarray) -> tuple[str, str]:
    """The two axis names, up and forward, that `mount_from_axes` gives this mount for, or the nearest mount of all."""
    R_LS = Rotation.from_quat(quat_LS)
    pairs = [(up, forward) for up in AXES for forward in AXES if AXES[up] @ AXES[forward] == 0.0]
    return min(pairs, key=lambda pair: (R_LS * Rotation.from_quat(mount_from_axes(*pair)).inv()).magnitude())


@dataclass(frozen=True)
class Sensor:
    """One sensor: either `gyro_S` and `accel_S`, or `quat_WS` from a device that fuses by itself.

    Parameters
    ----------
    gyro_S : (n, 3) [rad/s], the rate over the interval that ends at the sample; None for ready orientations
    accel_S : (n, 3) [m/s²], specific force, +g up at rest; None for ready orientations
    quat_WS : (n, 4) xyzw, sensor to a world of its own whose z points up; None for raw sensors
    stated_quat_LS : (4,) xyzw, the mount as the session states it, sensor to segment; None where it says nothing
    gap : (n,) bool, true where samples were lost for longer than is bridged in silence, or the sensor was frozen; None
        where neither can be
    gyro_range : [rad/s] from which on an axis of gyro is cut off; infinite where that is not known
    aligned : `quat_WS` is the segment's own orientation, in a world that is common to all that are aligned: only where
        that world's x points is taken from the start pose
    """

    gyro_S: np.ndarray | None = None
    accel_S: np.ndarray | None = None
    quat_WS: np.ndarray | None = None
    stated_quat_LS: np.ndarray | None = None
    gap: np.ndarray | None = None
    aligned: bool = False
    gyro_range: float = np.inf

    @property
    def ready(self) -> bool:
        """The sensor came with orientations."""
        return self.quat_WS is not None
