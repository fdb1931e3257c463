"""Orientation of one sensor from its gyroscope and accelerometer, by each filter.

The sensor lies still for two seconds, rotates by 90 deg about the vertical and back, and rests again. The errors are
drawn in errors.svg.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin.filters import METHODS

rate_hz = 100.0
time = np.arange(0.0, 10.0, 1.0 / rate_hz)
angle = np.deg2rad(90.0) * 0.5 * (1.0 - np.cos(np.pi * np.clip((time - 2.0) / 3.0, 0.0, 2.0)))
true_WS = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))

rng = np.random.default_rng(0)
gyro_S = np.column_stack([np.zeros((len(time), 2)), np.gradient(angle, time)])  # [rad/s]
gyro_S += np.deg2rad([0.2, -0.1, 0.3]) + rng.normal(scale=0.001, size=gyro_S.shape)  # bias and noise
accel_S = np.tile([0.0, 0.0, 9.81], (len(time), 1)) + rng.normal(scale=0.01, size=gyro_S.shape)  # [m/s²], +g up

figure, axes = plt.subplots(figsize=(7.0, 3.0), layout="constrained")
for method in METHODS:
    o = wp.estimate_orientation(gyro_S, accel_S, rate_hz, method=method, static=(0.0, 1.9))
    error_deg = np.degrees((true_WS.inv() * Rotation.from_quat(o.quat_VS)).magnitude())
    print(f"{method:6s} largest error {error_deg.max():.2f} deg, static {100 * o.static.mean():.0f} % of the time")
    axes.plot(time, error_deg, label=method)
axes.set(xlabel="time [s]", ylabel="error of orientation [deg]")
axes.legend(ncols=len(METHODS))
figure.savefig("errors.svg")
