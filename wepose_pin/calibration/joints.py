"""Headings of two neighbours by the acceleration of the joint between them, which both sensors feel.

A sensor at r from a joint feels the joint's acceleration and its own about it: in the sensor's world V,

    a_joint = R_VS (f + K r),   K = −([ω̇]× + [ω]×²)

and the joint of the one is that of the other, turned by the difference of the two worlds' headings. r is a constant of
the strapping and found with the heading. Weygers and Kok 2020 (IEEE Sensors Journal 20) track joints so; here it tells
what the closure confuses: soft tissue that turns the torso's sensor sideways as it leans forwards looks to the closure
like a heading, while orientation and specific force of a sensor are the sensor's own, wherever the tissue takes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from ..filters.sensors import FilteredRecording
from ..recording import Recording
from .losses import connected, losses_of
from .problem import Layout
from .weighing import LEAST_CORRELATION_S

# Nearer the trunk first; of a hand with a sensor the wrist is the joint.
JOINTS = tuple(
    pair
    for side in ("left", "right")
    for pair in (
        ("torso", f"{side}_upper_arm"),
        (f"{side}_upper_arm", f"{side}_forearm"),
        (f"{side}_forearm", f"{side}_hand"),
    )
)
# What people move in, without gravity's constant and without what tissue shakes; of the rate, before it is derived.
BAND_HZ, RATE_HZ = (0.1, 1.5), 8.0
LOOKS_HZ = 10.0
LEAST_RATE_HZ, LEAST_S = 20.0, 20.0  # of recordings that are looked at
LEAST_LEVER = 1e-6  # [1/s⁴], keeps levers finite that nothing tells
LEAST_MISMATCH = 0.005  # [m/s²] below which no two sensors agree
STARTS, ROUNDS = 24, 20
# What lasts in the error: tissue that changes the lever as it goes, clocks a millisecond apart. On simulated people it
# is 1.1 deg at elbows and 1.6 at shoulders, where the residual alone says half of it.
SYSTEMATIC_STD = np.deg2rad(1.5)
UNTOLD_STD = np.deg2rad(20.0)  # beyond, it is not linear and tells nothing


class Coupling(NamedTuple):
    """How the world of one sensor is turned against that of its neighbour."""

    near: str
    far: str
    turn: float  # [rad] ψ of the near one less ψ of the far one, mean over the looks
    std: float  # [rad]
    since: float  # [s] from the start pose to the middle of the looks


def couplings(
    recording: Recording, found: FilteredRecording, names: Sequence[str], spans: Sequence[tuple[float, float]]
) -> list[Coupling]:
    """Of each joint between two raw sensors of `names`, by the motion in these spans [s]; none where that is little."""
    raw = [name for name in names if name in recording.imus]
    pairs = [pair for pair in JOINTS if set(pair) <= set(raw)]
    if recording.rate_hz < LEAST_RATE_HZ or not pairs:
        return []
    inside = np.zeros(len(recording), dtype=bool)
    for span in spans:
        inside[recording.span(span)] = True
    for name in raw:
        gap = recording.sensors[name].gap
        if gap is not None:
            inside &= ~gap
    at = np.flatnonzero(inside)
    at = at[connected(losses_of(recording, found.start, raw), at)]  # beyond a loss headings are others
    if len(at) < LEAST_S * recording.rate_hz:
        return []
    at = at[:: max(1, round(recording.rate_hz / LOOKS_HZ))]
    felt = {name: _felt(recording, found, name, at) for name in sorted({name for pair in pairs for name in pair})}
    since = float(np.mean(recording.time[at]) - found.start[1])
    told = []
    for near, far in pairs:
        turn, std = _turn(felt[near], felt[far])
        if std < UNTOLD_STD:
            told.append(Coupling(near, far, turn, float(np.hypot(std, SYSTEMATIC_STD)), since))
    return told


def coupled(
    center: np.ndarray, information: np.ndarray, layout: Layout, told: Sequence[Coupling], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centre and information of x with what the couplings say of headings and drift, whole turns as at `start`."""
    if not told:
        return center, information
    H, off = np.zeros((len(told), layout.size)), np.zeros(len(told))
    for row, coupling in enumerate(told):
        for name, sign in ((coupling.near, 1.0), (coupling.far, -1.0)):
            i = layout.sensors.index(name)
            H[row, layout.heading.start + i], H[row, layout.drift.start + i] = sign, sign * coupling.since
        off[row] = H[row] @ (start - center) + np.angle(np.exp(1j * (coupling.turn - H[row] @ start)))
    weight = np.array([coupling.std**-2 for coupling in told])
    after = information + H.T @ (weight[:, None] * H)
    return center + np.linalg.solve(after, H.T @ (weight * off)), after


def _felt(recording: Recording, found: FilteredRecording, name: str, at: np.ndarray) -> np.ndarray:
    """(n, 3, 4) in V: specific force, and what a lever of 1 m along each axis of the sensor adds to the joint's."""
    sensor, rate_hz = recording.imus[name], recording.rate_hz
    smooth = butter(2, min(RATE_HZ, 0.4 * rate_hz), fs=rate_hz, output="sos")
    gyro_S = sosfiltfilt(smooth, _whole(sensor.gyro_S), axis=0)
    turning_S = np.gradient(gyro_S, 1.0 / rate_hz, axis=0)
    columns = [_whole(sensor.accel_S)]
    columns += [-(np.cross(turning_S, axis) + np.cross(gyro_S, np.cross(gyro_S, axis))) for axis in np.eye(3)]
    band = butter(2, BAND_HZ, "band", fs=rate_hz, output="sos")
    return np.stack([sosfiltfilt(band, found.R_VS[name].apply(c), axis=0)[at] for c in columns], axis=2)


def _whole(values: np.ndarray) -> np.ndarray:
    """Samples (n, 3) with those that are missing on the line between their neighbours."""
    there = np.isfinite(values).all(axis=1)
    if there.all():
        return values
    at = np.arange(len(values))
    return np.column_stack([np.interp(at, at[there], column[there]) for column in values.T])


def _turn(near: np.ndarray, far: np.ndarray) -> tuple[float, float]:
    """The turn [rad] about z from the near sensor's world to the far one's, and its standard deviation."""
    tried = np.linspace(0.0, 2.0 * np.pi, STARTS, endpoint=False)
    turn = float(tried[int(np.argmin([np.sum(_mismatch(near, far, angle)[0] ** 2) for angle in tried]))])
    for _ in range(ROUNDS):
        r, J = _mismatch(near, far, turn)
        step = -float(J @ r) / max(float(J @ J), 1e-12)
        turn += step
        if abs(step) < 1e-6:
            break
    r, J = _mismatch(near, far, turn)
    variance = max(float(np.mean(r**2)), LEAST_MISMATCH**2) * LEAST_CORRELATION_S * LOOKS_HZ
    return turn, float(np.sqrt(variance / max(float(J @ J), 1e-12)))


def _mismatch(near: np.ndarray, far: np.ndarray, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Far less near acceleration of the joint (3 n,) with the best levers, and its slope by the turn as they follow."""
    c, s = np.cos(turn), np.sin(turn)
    near = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ near
    H = np.concatenate([far[:, :, 1:], -near[:, :, 1:]], axis=2).reshape(-1, 6)
    known = (far[:, :, 0] - near[:, :, 0]).ravel()
    normal = H.T @ H + LEAST_LEVER * len(H) * np.eye(6)
    levers = -np.linalg.solve(normal, H.T @ known)
    joint = near[:, :, 0] + near[:, :, 1:] @ levers[3:]
    slope = np.stack([joint[:, 1], -joint[:, 0], np.zeros(len(joint))], axis=1).ravel()
    return known + H @ levers, slope - H @ np.linalg.solve(normal, H.T @ slope)
