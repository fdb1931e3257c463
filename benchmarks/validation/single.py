"""The paper's experiments with one sensor in the hand: exact orientation and IMU data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin.rotations import compose, log, turn_about
from wepose_pin.simulation import IDEAL_PRESET, MTI_3, Imperfections, ImuNoise
from wepose_pin.simulation.imperfections import GRAVITY, Device, jitter_time
from wepose_pin.simulation.people import E_Z
from wepose_pin.simulation.signals import make_pulse

_DURATION_S = 60.0  # of a trial
_STENCIL_S = 1e-3
_GRID_HZ = 200.0  # sampling rate for the scaling of the motion to its peaks


class _Trial(NamedTuple):
    """An experiment of the paper."""

    stream: int  # of random numbers
    moving: tuple[float, float]  # [s]
    ramp: float  # [s]
    waves_hz: tuple[tuple[float, ...], tuple[float, ...]]  # of turns, of shakes
    peaks: tuple[tuple[float, float], tuple[float, float]]  # of rate [rad/s] and acceleration [m/s^2], drawn between


_DYNAMIC = _Trial(11, (5.0, 55.0), 1.5, ((0.15, 0.4, 0.8, 1.5), (0.6, 1.0, 1.5, 2.2)), ((6.0, 8.0), (15.0, 20.0)))
_DRIFT = _Trial(12, (25.0, 35.0), 1.0, ((0.5, 1.2, 2.2, 3.5), (2.0, 3.2, 4.5)), ((13.0, 15.0), (40.0, 50.0)))


@dataclass(frozen=True)
class SingleSensor:
    """One sensor that a hand moves.

    `gyro_S[k]` is the rate over (k−1, k], `accel_S[k]` the specific force at k; both with noise, bias and the sensor's
    imperfections.
    """

    time: np.ndarray  # (n,) [s], from 0
    rate_hz: float
    quat_WS: np.ndarray  # (n, 4) xyzw, exact; W is z up
    p_WS: np.ndarray  # (n, 3) [m], exact
    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s^2]
    gyro_bias: np.ndarray  # (n, 3) [rad/s], exact
    static: list[tuple[float, float]]  # [s], before and after the motion
    moving: tuple[float, float]  # [s]


class _HandMotion:
    """A static phase, a burst of rotation and translation, and a static phase in the first pose."""

    def __init__(self, rng: np.random.Generator, trial: _Trial) -> None:
        self.trial = trial
        peaks = tuple(rng.uniform(*peak) for peak in trial.peaks)
        self.R_W0 = Rotation.random(random_state=rng)
        # One frequency near each of these; slower waves are larger, so that all contribute to the rate.
        self.omega = [2.0 * np.pi * np.array(hz) * rng.uniform(0.85, 1.15, (3, len(hz))) for hz in trial.waves_hz]
        self.phase = [rng.uniform(0.0, 2.0 * np.pi, omega.shape) for omega in self.omega]
        # A hand's motion is uneven: its amplitude varies between a third and one.
        self.vigour = 2.0 * np.pi * rng.uniform(0.04, 0.12, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
        self.gain = [1.0, 1.0]
        # Peaks of rate [rad/s] and acceleration [m/s^2]. The rate is not linear in the angles: a few rounds.
        t = np.arange(*trial.moving, 1.0 / _GRID_HZ)
        h = _STENCIL_S
        for _ in range(6):
            turn = log(compose(self.orientation(t - h).inv(), self.orientation(t + h)).as_quat())
            self.gain[0] *= peaks[0] / float(np.linalg.norm(turn / (2.0 * h), axis=1).max())
            self.gain[1] *= peaks[1] / float(np.linalg.norm(self.acceleration(t), axis=1).max())

    def _waves(self, which: int, t: np.ndarray) -> np.ndarray:
        omega, phase = self.omega[which], self.phase[which]
        power = which + 1  # angles count by their rate, positions by their acceleration
        waves = np.sum(np.sin(omega * t[:, None, None] + phase) / omega**power, axis=2)
        swell, start = self.vigour
        vigour = 0.66 + 0.17 * np.sum(np.sin(swell * t[:, None] + start), axis=1)
        return self.gain[which] * (make_pulse(t, *self.trial.moving, self.trial.ramp) * vigour)[:, None] * waves

    def orientation(self, t: np.ndarray) -> Rotation:
        return compose(self.R_W0, turn_about("ZYX", self._waves(0, t)))

    def position(self, t: np.ndarray) -> np.ndarray:
        return self._waves(1, t)

    def acceleration(self, t: np.ndarray) -> np.ndarray:
        middle = self.position(t)
        far, near, near_after, far_after = (self.position(t + k * _STENCIL_S) - middle for k in (-2, -1, 1, 2))
        return (16.0 * (near + near_after) - (far + far_after)) / (12.0 * _STENCIL_S**2)


def simulate_paper_dynamic(
    seed: int,
    rate_hz: float = 100.0,
    *,
    noise: ImuNoise = MTI_3,
    imperfections: Imperfections = IDEAL_PRESET,
    trial: _Trial = _DYNAMIC,
) -> SingleSensor:
    """Simulate a trial of the paper's dynamic experiment: 5 s static, 50 s of free motion in the hand, 5 s static.

    Turns of 0.15 to 1.5 Hz with a peak of 6 to 8 rad/s, translation with a peak of 15 to 20 m/s^2, without pauses. Of
    `imperfections` those of a single sensor count: scale, misalignment, g-sensitivity, range, bits and jitter.
    """
    motion_rng, sensor_rng = np.random.default_rng([seed, trial.stream]).spawn(2)
    motion = _HandMotion(motion_rng, trial)
    noise_rng, device_rng, jitter_rng, warm_up_rng = sensor_rng.spawn(4)
    time = np.arange(int(np.floor(_DURATION_S * rate_hz)) + 1) / rate_hz
    own_time = jitter_time(jitter_rng, time, rate_hz, imperfections.clock_jitter)
    R_WS = motion.orientation(own_time)
    turned = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() / np.diff(own_time)[:, None]
    force_S = R_WS.inv().apply(motion.acceleration(own_time) + GRAVITY * E_Z)
    device = Device(device_rng, imperfections, warm_up_rng)
    rate_S = np.vstack((np.zeros(3), turned))
    readings = device.measure(rate_S, force_S, rate_hz, noise, noise_rng)
    quat_WS, p_WS = motion.orientation(time).as_quat(), motion.position(time)
    static = [(0.0, trial.moving[0]), (trial.moving[1], _DURATION_S)]
    measured = readings["gyro_S"], readings["accel_S"], readings["gyro_bias"]
    return SingleSensor(time, rate_hz, quat_WS, p_WS, *measured, static, trial.moving)


def simulate_paper_drift(seed: int, rate_hz: float = 1000.0, *, noise: ImuNoise = MTI_3) -> SingleSensor:
    """Simulate a trial of the paper's drift experiment: 25 s static, 10 s of fast shaking and rotating, 25 s static.

    Turns of 0.5 to 4 Hz with a peak of 13 to 15 rad/s, shaking of 2 to 5 Hz with a peak of 40 to 50 m/s^2.
    """
    return simulate_paper_dynamic(seed, rate_hz, noise=noise, trial=_DRIFT)
