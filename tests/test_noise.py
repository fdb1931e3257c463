"""Noise and bias of a static phase, and the most static window."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.errors import WeposeError
from wepose_pin.filters.noise import ACCEL_FLOOR, GYRO_FLOOR, estimate_noise
from wepose_pin.filters.phases import WINDOW_S, find_static_window
from wepose_pin.recording import ImuSensor, OrientationSensor, Recording

RATE = 100.0


def test_moments_are_the_samples() -> None:
    rng = np.random.default_rng(0)
    gyro = rng.normal(scale=1e-2, size=(4000, 3)) + [0.01, 0.02, -0.03]
    accel = rng.normal(scale=0.05, size=(4000, 3)) + [0.0, 0.0, 9.7]
    noise = estimate_noise(gyro, accel, RATE)
    np.testing.assert_allclose(noise.gyro_bias, gyro.mean(axis=0))
    np.testing.assert_allclose(noise.gyro_cov, np.cov(gyro.T))
    assert noise.gravity == pytest.approx(np.linalg.norm(accel, axis=1).mean())
    np.testing.assert_allclose(noise.accel_cov, np.cov(accel.T) / noise.gravity**2)
    # Of white noise the first differences have twice the covariance, and the mean has 1/n of it.
    np.testing.assert_allclose(noise.bias_step_cov, 2 * noise.gyro_cov, atol=2e-5)
    assert np.sqrt(np.trace(noise.gyro_bias_cov) / 3) == pytest.approx(1e-2 * np.sqrt(1 / 4000), rel=0.25)


@pytest.mark.parametrize("seconds", [0.6, 1.0, 1.9, 2.5, 4.0, 10.0])
def test_a_worn_sensor_s_bias_is_as_uncertain_as_sway_makes_it(seconds: float) -> None:
    """People who sway at 0.3 to 1 deg/s below 0.5 Hz: the mean rate of a phase is within its standard deviation."""
    z = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        time = np.arange(round(seconds * RATE)) / RATE
        omega, phase = 2.0 * np.pi * rng.uniform(0.1, 0.5, (3, 3, 1)), rng.uniform(0.0, 6.3, (3, 3, 1))
        sway = np.deg2rad(rng.uniform(0.3, 1.0)) * np.sqrt(2.0 / 3.0) * np.cos(omega * time + phase).sum(axis=1).T
        gyro = sway + rng.normal(scale=np.deg2rad(0.07), size=(len(time), 3))
        noise = estimate_noise(gyro, np.tile([0.0, 0.0, 9.8], (len(time), 1)), RATE, worn=True)
        z += list(noise.gyro_bias / np.sqrt(np.diag(noise.gyro_bias_cov)))
    print(f"{seconds} s: rms {np.sqrt(np.mean(np.square(z))):.2f}, largest {np.abs(z).max():.1f} standard deviations")
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 5.0


def test_a_steady_turn_is_not_the_quietest_window() -> None:
    rng = np.random.default_rng(5)
    n = 2000
    time = np.arange(n) / RATE
    sensors = {}
    for k, segment in enumerate(("torso", "left_forearm", "right_forearm")):
        gyro = rng.normal(scale=2e-3, size=(n, 3)) + np.deg2rad([0.3, -0.2, 0.4]) * (k + 1)
        gyro[:1000, 2] += np.deg2rad(20.0)  # a chair, very evenly
        gyro[1000:] += np.deg2rad(0.5) * np.sin(2.0 * time[1000:, None] + [0.0, 1.0, 2.0])  # standing, with sway
        sensors[segment] = ImuSensor(gyro_S=gyro, accel_S=rng.normal(scale=0.02, size=(n, 3)) + [0.0, 0.0, 9.8])
    first, _ = find_static_window(Recording("chair", time, RATE, sensors, {}))
    assert first >= 9.9


def test_a_quantised_signal_leaves_invertible_covariances() -> None:
    noise = estimate_noise(np.zeros((50, 3)), np.tile([0.0, 0.0, 9.8], (50, 1)), RATE)
    assert np.linalg.eigvalsh(noise.gyro_cov)[0] >= 0.99 * GYRO_FLOOR**2
    assert np.linalg.eigvalsh(noise.accel_cov)[0] >= 0.99 * ACCEL_FLOOR**2


def test_too_little_and_weightless_are_named() -> None:
    with pytest.raises(WeposeError, match="holds 5 samples"):
        estimate_noise(np.zeros((5, 3)), np.ones((5, 3)), RATE)
    with pytest.raises(WeposeError, match="no gravity"):
        estimate_noise(np.zeros((50, 3)), np.zeros((50, 3)), RATE)


@pytest.mark.parametrize("ready", [False, True])
def test_the_quietest_window_is_found(ready: bool) -> None:
    rng = np.random.default_rng(2)
    time = 100.0 + np.arange(3000) / RATE
    gyro = rng.normal(scale=0.3, size=(3000, 3))
    calm = slice(700, 950)
    gyro[calm] *= 0.01
    if ready:
        turned = np.concatenate([Rotation.from_rotvec(g / RATE).as_quat()[None] for g in gyro])
        rotation = [Rotation.identity()]
        for quat in turned:
            rotation.append(rotation[-1] * Rotation.from_quat(quat))
        sensor = OrientationSensor(quat_VS=Rotation.concatenate(rotation[1:]).as_quat())
    else:
        sensor = ImuSensor(gyro_S=gyro, accel_S=np.tile([0, 0, 9.8], (3000, 1)))
    first, last = find_static_window(Recording("r", time, RATE, {"torso": sensor}))
    assert first >= 106.95
    assert last <= 109.55
    assert last - first == pytest.approx(WINDOW_S, abs=0.02)
