"""Registration of a reference to a sensor: clock, body frame and world, from an interval that is not scored.

No filter takes part: the gyroscope is integrated over the stretch, so what is found is the same for all that are
compared. Only the heading, which each filter has of its own, is left to `experiment.align_rotation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation, Slerp

from wepose_pin import rotations
from wepose_pin.errors import BadData

from ..trials import Referenced

LARGEST_OFFSET_S = 0.3  # of the clocks
# Rotations are compared over this time: long against errors of foam and a flexing arm, short against gyroscope drift.
TURN_S = 0.5
_LARGEST_TURN = 2.8  # [rad] beyond it the axis of a rotation may flip
_LEAST_TURN = 0.02  # [rad], [rad/s] least rms rotation about a second axis, and least rms rate, for a registration


class Registration(NamedTuple):
    """The registration of a reference to a sensor, with its residuals."""

    offset_s: float  # the sensor's clock at the reference's zero [s]
    quat_BS: np.ndarray  # (4,) xyzw, sensor to the reference's body
    quat_WV: np.ndarray  # (4,) xyzw, the reference's world to a level one, without heading
    gyro_bias: np.ndarray  # (3,) [rad/s]
    correlation: float  # of the magnitudes of the two rates, at that offset
    residual_deg: float  # rms of the integrated gyroscope's orientation against the reference's, over the interval

    @property
    def tilt_deg(self) -> float:
        """Tilt [deg] of the reference's world."""
        return float(np.degrees(Rotation.from_quat(self.quat_WV).magnitude()))


def register_sensors(
    sensors: Sequence[Referenced], stretch: tuple[float, float], irregular: bool = False
) -> list[Registration]:
    """Register sensors that share a clock and a reference, from the interval `stretch` [s] of the reference.

    One offset of the clocks: where the correlations of ‖gyro‖ with the body's rate have their greatest sum;
    `irregular`: the reference's times are not even, which rates do not survive, and the offset is that at which the
    integrated gyroscope follows the body best. A mount
    each: the rotation that brings the sensor's turns over half a second to the body's (Wahba's problem, on rotation
    vectors), refined, together with the gyroscope's bias where there is no static phase, such that the integrated
    gyroscope follows the body over the whole stretch. One tilt of the reference's world: specific force, turned by the
    integrated gyroscope and averaged over the stretch with a window without jumps (what comes and goes cancels), each
    sensor as heavy as it follows.

    Raises
    ------
    BadData
        The stretch is too short or holds too little motion.
    """
    spans = [_Span(sensor, stretch) for sensor in sensors]
    offset, within = 0.0, LARGEST_OFFSET_S
    for step in (4e-3, 0.25e-3):  # [s]
        offsets = offset + np.arange(-round(within / step), round(within / step) + 1) * step
        correlations = np.array([[span.correlation(each) for each in offsets] for span in spans])
        best = int(np.argmax(correlations.sum(axis=0)))
        offset, within = float(offsets[best]), step
    if abs(offset) > LARGEST_OFFSET_S - 4e-3:
        raise BadData(f"{sensors[0].name}: no offset of the clocks within {LARGEST_OFFSET_S:g} s fits the reference")
    if irregular:
        offset = _fit_offset(spans)
        correlations, best = np.array([[span.correlation(offset)] for span in spans]), 0
    fits = [span.fit(offset) for span in spans]
    up_V = np.array([span.up(offset, fit) for span, fit in zip(spans, fits, strict=True)])
    quat_WV = rotations.quat_from_gravity(np.array([fit.rms for fit in fits]) ** -2.0 @ up_V)
    return [
        Registration(offset, fit.R_BS.as_quat(), quat_WV, fit.bias, float(row[best]), float(np.degrees(fit.rms)))
        for fit, row in zip(fits, correlations, strict=True)
    ]


def _fit_offset(spans: Sequence[_Span]) -> float:
    """Find the offset [s] of the clocks at which the integrated gyroscopes follow their bodies best."""

    def score(offset: float) -> float:
        return sum(span.fit(offset).rms ** 2 for span in spans)

    step = 0.02  # [s]
    coarse = min(np.arange(-0.5 * LARGEST_OFFSET_S, 0.5 * LARGEST_OFFSET_S + step, step), key=score)
    return float(minimize_scalar(score, bounds=(coarse - step, coarse + step), options={"xatol": 1e-4}).x)


class _Fit(NamedTuple):
    R_BS: Rotation
    bias: np.ndarray  # (3,) [rad/s]
    rms: float  # [rad]


class _Span:
    """A sensor and its reference over the interval."""

    def __init__(self, sensor: Referenced, stretch: tuple[float, float]) -> None:
        self.sensor = sensor
        beyond = stretch[1] + 2.0 * LARGEST_OFFSET_S
        self.samples = slice(0, min(len(sensor.gyro_S), int(beyond * sensor.rate_hz)))
        self.clock = np.arange(self.samples.stop) / sensor.rate_hz
        self.known_bias = bool(sensor.static.stop)
        self.bias = sensor.gyro_S[sensor.static].mean(axis=0) if self.known_bias else np.zeros(3)
        self.angle = np.cumsum(sensor.gyro_S[self.samples], axis=0) / sensor.rate_hz  # its differences are mean rates
        inside = (sensor.time >= stretch[0]) & (sensor.time <= stretch[1])
        inside &= (sensor.time >= LARGEST_OFFSET_S) & (sensor.time <= self.clock[-1] - LARGEST_OFFSET_S)
        self.seen = np.flatnonzero(inside & np.isfinite(sensor.quat_VB).all(axis=1))
        if len(self.seen) < 10:
            raise BadData(
                f"{sensor.name}: the reference saw {len(self.seen)} samples within {stretch} s; 10 are needed"
            )
        self.R_VB = Rotation.from_quat(sensor.quat_VB[self.seen])
        self.first = self.seen[np.isin(self.seen + 1, self.seen)]
        self.interval = sensor.time[self.first + 1] - sensor.time[self.first]
        self.rate = np.linalg.norm(self._rotation_vectors(self.first, 1), axis=1) / self.interval
        if self.rate.std() < _LEAST_TURN:
            raise BadData(f"{sensor.name}: its body does not turn in the stretch that is to align it, {stretch} s")

    def _rotation_vectors(self, first: np.ndarray, n: int) -> np.ndarray:
        """Compute rotation vectors (k, 3) of the body from `first` to n samples later, in its frame."""
        begin, end = (Rotation.from_quat(self.sensor.quat_VB[k]) for k in (first, first + n))
        return (begin.inv() * end).as_rotvec()

    def correlation(self, offset: float) -> float:
        """Compute the correlation of the magnitudes of the sensor's rate and the body's."""
        begin, end = (
            np.column_stack([np.interp(self.sensor.time[k] + offset, self.clock, angle) for angle in self.angle.T])
            for k in (self.first, self.first + 1)
        )
        return float(np.corrcoef(np.linalg.norm(end - begin, axis=1) / self.interval, self.rate)[0, 1])

    def integrate(self, bias: np.ndarray) -> Rotation:
        """Integrate the rate to R_IS of all samples; I is the sensor's frame at the beginning."""
        rate = self.sensor.gyro_S[self.samples] - bias
        return Rotation.from_quat(rotations.integrate(np.ascontiguousarray(rate / self.sensor.rate_hz))[1:])

    def mount(self, offset: float) -> Rotation:
        """Estimate R_BS from rotations over `TURN_S`."""
        n = max(1, round(TURN_S / float(np.median(np.diff(self.sensor.time)))))
        first = self.seen[np.isin(self.seen + n, self.seen)]
        if len(first) < 10:
            raise BadData(f"{self.sensor.name}: the reference is not seen for {TURN_S:g} s on end in the stretch")
        at = Slerp(self.clock, self.integrate(self.bias))
        begin, end = (at(self.sensor.time[k] + offset) for k in (first, first + n))
        true, turned = self._rotation_vectors(first, n), (begin.inv() * end).as_rotvec()
        use = np.maximum(np.linalg.norm(true, axis=1), np.linalg.norm(turned, axis=1)) < _LARGEST_TURN
        true, turned = true[use], turned[use]
        if len(true) < 10 or np.linalg.svd(true, compute_uv=False)[1] < _LEAST_TURN * np.sqrt(len(true)):
            raise BadData(f"{self.sensor.name}: its body turns about one axis only in the stretch that is to align it")
        return Rotation.align_vectors(true, turned)[0]

    def fit(self, offset: float) -> _Fit:
        """Fit the mount, and an unknown bias, so that the integrated gyroscope follows the body."""
        R_BS, time = self.mount(offset), self.sensor.time[self.seen] + offset

        def off(x: np.ndarray) -> np.ndarray:
            turned = Slerp(self.clock, self.integrate(self.bias + x[3:] if len(x) > 3 else self.bias))(time)
            R_VI = self.R_VB * R_BS * Rotation.from_rotvec(x[:3]) * turned.inv()
            return (R_VI.mean().inv() * R_VI).as_rotvec().ravel()

        solution = least_squares(off, np.zeros(3 if self.known_bias else 6))
        bias = self.bias if self.known_bias else self.bias + solution.x[3:]
        rms = float(np.sqrt(2.0 * solution.cost / len(time)))
        return _Fit(R_BS * Rotation.from_rotvec(solution.x[:3]), bias, rms)

    def up(self, offset: float, fit: _Fit) -> np.ndarray:
        """Estimate the vertical (3,) in the reference's world."""
        time, R_IS = self.sensor.time[self.seen] + offset, self.integrate(fit.bias)
        R_VI = (self.R_VB * fit.R_BS * Slerp(self.clock, R_IS)(time).inv()).mean()
        within = (self.clock >= time[0]) & (self.clock <= time[-1])
        force_V = (R_VI * R_IS[within]).apply(self.sensor.accel_S[self.samples][within])
        up = np.hanning(len(force_V)) @ force_V
        return up / np.linalg.norm(up)
