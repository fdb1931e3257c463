"""A simulated subject, and what holds in every simulation whatever its imperfections: the physics of its sensors."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from wepose_pin import Simulation

G = 9.81
SIDES = ("left", "right")
SEGMENTS = ("torso", *(f"{side}_{part}" for side in SIDES for part in ("upper_arm", "forearm")))
# Left and right differ, so that a swap shows.
SUBJECT = {
    "trunk": 0.50,
    "shoulder_width": 0.385,
    "left_upper_arm": 0.301,
    "left_forearm": 0.252,
    "left_hand": 0.081,
    "right_upper_arm": 0.309,
    "right_forearm": 0.247,
    "right_hand": 0.078,
}


def within(sim: Simulation, *phases: str) -> np.ndarray:
    """Which samples (n,) lie in one of the phases."""
    spans = [span for phase in phases for span in sim.phases[phase]]
    return np.any([(sim.time >= a) & (sim.time <= b) for a, b in spans], axis=0)


def in_torso(sim: Simulation, vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(sim.quat_WL["torso"]).inv().apply(vectors)


def position_WS(sim: Simulation, segment: str) -> np.ndarray:
    """Position of the sensor (n, 3) [m], from the points of the truth."""
    side, _, part = segment.partition("_")
    origin = {"": 0.0, "upper_arm": sim.points.get(f"{side}_shoulder"), "forearm": sim.points.get(f"{side}_elbow")}
    return origin[part] + Rotation.from_quat(sim.quat_WL[segment]).apply(sim.p_LS[segment])


def multiply(rotvecs: np.ndarray) -> Rotation:
    """exp of the first times exp of the second …, of rotation vectors (n, 3), pair by pair."""
    R = Rotation.from_rotvec(rotvecs)
    while len(R) > 1:
        if len(R) % 2:
            R = Rotation.concatenate((R, Rotation.identity(1)))
        R = R[0::2] * R[1::2]
    return R[0]


def check_gyro(sim: Simulation, segment: str, R_WS: Rotation, seconds: float) -> None:
    """Rates, integrated, are the sensor's orientation, every five seconds."""
    R, block = R_WS[0], round(5.0 * sim.rate_hz)
    for k in range(0, round(seconds * sim.rate_hz), block):
        R = R * multiply(sim.gyro_S[segment][k + 1 : k + block + 1] / sim.rate_hz)
        assert (R.inv() * R_WS[k + block]).magnitude() < 1e-6


def check_accel(sim: Simulation, segment: str, R_WS: Rotation, start: float, stop: float) -> np.ndarray:
    """Specific force, integrated twice, is the path of the sensor; return by how far it goes along each axis [m]."""
    position, k = position_WS(sim, segment), (sim.time >= start) & (sim.time <= stop)
    t = sim.time[k]
    accel_W = R_WS[k].apply(sim.accel_S[segment][k]) - [0.0, 0.0, G]
    truth = CubicSpline(sim.time, position)
    integrated = truth(t[0]) + truth(t[0], 1) * (t - t[0])[:, None] + CubicSpline(t, accel_W).antiderivative(2)(t)
    assert np.abs(integrated - position[k]).max() < 1e-3
    return np.ptp(position[k], axis=0)
