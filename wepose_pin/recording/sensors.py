"""What a sensor measured: `ImuSensor` or `OrientationSensor`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .. import rotations

# Names of signed sensor axes.
AXES = {sign + axis: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, axis in enumerate("xyz")}


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
    aligned = False  # measured orientations alone can be

    def __repr__(self) -> str:
        return f"ImuSensor({len(self.gyro_S)} samples)"

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


def compute_rate(sensor: Sensor, rate_hz: float) -> np.ndarray:
    """Compute the rate (n, 3) [rad/s] in S over the interval that ends at each sample.

    Of measured orientations the first rate is a copy of the second.
    """
    if isinstance(sensor, ImuSensor):
        return sensor.gyro_S
    rate = rotations.compute_turns(sensor.quat_VS) * rate_hz
    return np.concatenate([rate[:1], rate])
