"""What one sensor measured, as `ImuSensor` or `OrientationSensor`, and how it is mounted on its segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..documents import TomlTable

# The sensor axes that a mount can be stated with.
AXES = {sign + axis: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, axis in enumerate("xyz")}


def mount_from_axes(up: str, forward: str) -> np.ndarray:
    """`quat_LS` (4,) xyzw of the sensor axes that point up and forward in the start pose, as in ``"+x", "-z"``.

    The rows of R_LS are the segment's axes in the sensor.
    """
    up_S, forward_S = AXES[up], AXES[forward]
    return Rotation.from_matrix([forward_S, np.cross(up_S, forward_S), up_S]).as_quat()


def read_axes(table: TomlTable, up: str | None = None, forward: str | None = None) -> tuple[str, str]:
    """The two axis names in a table with the keys `up` and `forward`; defaults for what is missing."""
    up, forward = table.choice("up", AXES, up), table.choice("forward", AXES, forward)
    if abs(AXES[up] @ AXES[forward]) > 0.5:
        raise table.error(f"{table.at('forward')} = '{forward}' is parallel to up = '{up}'; name two different axes")
    return up, forward


def axes_from_mount(quat_LS: np.ndarray) -> tuple[str, str]:
    """The two axis names, up and forward, that `mount_from_axes` gives this mount for, or the nearest mount of all."""
    R_LS = Rotation.from_quat(quat_LS)
    pairs = [(up, forward) for up in AXES for forward in AXES if AXES[up] @ AXES[forward] == 0.0]
    return min(pairs, key=lambda pair: (R_LS * Rotation.from_quat(mount_from_axes(*pair)).inv()).magnitude())


@dataclass(frozen=True)
class ImuSensor:
    """A gyroscope and an accelerometer.

    Parameters
    ----------
    gyro_S : (n, 3) [rad/s], the rate over the interval that ends at the sample
    accel_S : (n, 3) [m/s²], specific force, +g up of a static sensor
    stated_quat_LS : (4,) xyzw, the mount as the session states it, sensor to segment; None where it says nothing
    gap : (n,) bool, true where samples were lost for longer than is bridged in silence, or the sensor was frozen; None
        where neither can be
    gyro_range : [rad/s] from which on an axis of gyro is cut off; infinite where that is not known
    """

    gyro_S: np.ndarray
    accel_S: np.ndarray
    stated_quat_LS: np.ndarray | None = None
    gap: np.ndarray | None = None
    gyro_range: float = np.inf

    @property
    def aligned(self) -> bool:
        """Not its segment's own orientation: it has none."""
        return False

    def part(self, samples: slice | np.ndarray) -> ImuSensor:
        """The sensor at these samples."""
        gap = None if self.gap is None else self.gap[samples]
        return replace(self, gyro_S=self.gyro_S[samples], accel_S=self.accel_S[samples], gap=gap)


@dataclass(frozen=True)
class OrientationSensor:
    """A device that gives measured orientations: it fuses by itself, and the filters are passed over.

    Parameters
    ----------
    quat_WS : (n, 4) xyzw, sensor to a world of its own whose z points up
    stated_quat_LS, gap : as of `ImuSensor`
    aligned : `quat_WS` is the segment's own orientation, in a world that is common to all that are aligned: only where
        that world's x points is taken from the start pose
    """

    quat_WS: np.ndarray
    stated_quat_LS: np.ndarray | None = None
    gap: np.ndarray | None = None
    aligned: bool = False

    def part(self, samples: slice | np.ndarray) -> OrientationSensor:
        """The sensor at these samples."""
        return replace(self, quat_WS=self.quat_WS[samples], gap=None if self.gap is None else self.gap[samples])


Sensor = ImuSensor | OrientationSensor


def join_parts(parts: Sequence[Sensor]) -> Sensor:
    """One sensor of its consecutive parts; mount and range are the last one's."""
    gaps = [part.gap for part in parts if part.gap is not None]
    gap = np.concatenate(gaps) if len(gaps) == len(parts) else None
    if isinstance(parts[-1], ImuSensor):
        imus = [part for part in parts if isinstance(part, ImuSensor)]
        gyro_S, accel_S = np.concatenate([s.gyro_S for s in imus]), np.concatenate([s.accel_S for s in imus])
        return replace(imus[-1], gyro_S=gyro_S, accel_S=accel_S, gap=gap)
    fused = [part for part in parts if isinstance(part, OrientationSensor)]
    return replace(fused[-1], quat_WS=np.concatenate([s.quat_WS for s in fused]), gap=gap)


def angular_rate(sensor: Sensor, rate_hz: float) -> np.ndarray:
    """(n, 3) [rad/s] in S, the rate over the interval that ends at the sample; of orientations the first repeats."""
    if isinstance(sensor, ImuSensor):
        return sensor.gyro_S
    R = Rotation.from_quat(sensor.quat_WS)
    rate = (R[:-1].inv() * R[1:]).as_rotvec() * rate_hz
    return np.concatenate([rate[:1], rate])
