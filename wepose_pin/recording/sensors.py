"""Measurements of one sensor, as `ImuSensor` or `OrientationSensor`, and its mount on the segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..documents import TomlTable

# Names of sensor axes in a stated mount.
AXES = {sign + axis: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, axis in enumerate("xyz")}


def compute_mount(up: str, forward: str) -> np.ndarray:
    """Compute `quat_LS` (4,) xyzw from the sensor axes that point up and forward in the start pose, as ``"+x", "-z"``.

    The rows of R_LS are the segment's axes in the sensor.
    """
    up_S, forward_S = AXES[up], AXES[forward]
    return Rotation.from_matrix([forward_S, np.cross(up_S, forward_S), up_S]).as_quat()


def read_axes(table: TomlTable, up: str | None = None, forward: str | None = None) -> tuple[str, str]:
    """Read the two axis names from a table with the keys `up` and `forward`; missing keys take the defaults."""
    up, forward = table.choice("up", AXES, up), table.choice("forward", AXES, forward)
    if abs(AXES[up] @ AXES[forward]) > 0.5:
        raise table.error(f"{table.at('forward')} = '{forward}' is parallel to up = '{up}'; name two different axes")
    return up, forward


def find_mount_axes(quat_LS: np.ndarray) -> tuple[str, str]:
    """Find the axis names, up and forward, whose mount by `compute_mount` is nearest to this one."""
    R_LS = Rotation.from_quat(quat_LS)
    pairs = [(up, forward) for up in AXES for forward in AXES if AXES[up] @ AXES[forward] == 0.0]
    return min(pairs, key=lambda pair: (R_LS * Rotation.from_quat(compute_mount(*pair)).inv()).magnitude())


@dataclass(frozen=True)
class ImuSensor:
    """The measurements of a gyroscope and an accelerometer, n samples in the sensor's frame S.

    Parameters
    ----------
    gyro_S : (n, 3) [rad/s], the rate over the interval that ends at the sample
    accel_S : (n, 3) [m/s²], specific force: a static sensor measures g, upward
    stated_quat_LS : (4,) xyzw, the mount that the session states: sensor frame S to segment frame L; None: not stated
    gap : (n,) bool, true where samples were lost for longer than 50 ms, or repeat one value, and were interpolated;
        None: there are none
    gyro_range : [rad/s] at which an axis of gyro saturates; infinite: not known
    """

    gyro_S: np.ndarray
    accel_S: np.ndarray
    stated_quat_LS: np.ndarray | None = None
    gap: np.ndarray | None = None
    gyro_range: float = np.inf

    def __repr__(self) -> str:
        return f"ImuSensor({len(self.gyro_S)} samples)"

    @property
    def aligned(self) -> bool:
        """False, always: `OrientationSensor.aligned` is of measured orientations alone."""
        return False

    def part(self, samples: slice | np.ndarray) -> ImuSensor:
        """Return the sensor at these samples."""
        gap = None if self.gap is None else self.gap[samples]
        return replace(self, gyro_S=self.gyro_S[samples], accel_S=self.accel_S[samples], gap=gap)


@dataclass(frozen=True)
class OrientationSensor:
    """The orientations that a device measured, n samples; they are used as they are, without a filter of this package.

    Parameters
    ----------
    quat_VS : (n, 4) xyzw, sensor frame S to a world V of the device's own: its z points up, its heading is arbitrary
    stated_quat_LS, gap : as in `ImuSensor`
    aligned : `quat_VS` is the orientation of the segment, not of the sensor, in a world that all aligned sensors
        share; the start pose gives the heading of that world
    """

    quat_VS: np.ndarray
    stated_quat_LS: np.ndarray | None = None
    gap: np.ndarray | None = None
    aligned: bool = False

    def __repr__(self) -> str:
        return f"OrientationSensor({len(self.quat_VS)} samples)"

    def part(self, samples: slice | np.ndarray) -> OrientationSensor:
        """Return the sensor at these samples."""
        return replace(self, quat_VS=self.quat_VS[samples], gap=None if self.gap is None else self.gap[samples])


Sensor = ImuSensor | OrientationSensor


def join_sensors(parts: Sequence[Sensor]) -> Sensor:
    """Join consecutive parts of one sensor; mount and range are those of the last part."""
    signals = ("gyro_S", "accel_S") if isinstance(parts[-1], ImuSensor) else ("quat_VS",)
    names = (*signals, "gap") if all(part.gap is not None for part in parts) else signals
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[-1], **{"gap": None} | joined)


def compute_rate(sensor: Sensor, rate_hz: float) -> np.ndarray:
    """Compute the rate (n, 3) [rad/s] in S over the interval that ends at each sample.

    Of measured orientations the first rate is a copy of the second.
    """
    if isinstance(sensor, ImuSensor):
        return sensor.gyro_S
    rate = rotations.compute_turns(sensor.quat_VS) * rate_hz
    return np.concatenate([rate[:1], rate])
