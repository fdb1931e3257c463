"""Headings of two neighbours by the acceleration of the joint between them, which both sensors measure.

The levers of the two sensors are constant and estimated with the heading (`observations.joint_accelerations`). Here it
separates what the closure confuses: soft tissue that rotates the torso's sensor sideways as the torso leans forwards
has the same effect on the closure as a heading, but none on a joint's acceleration, since orientation and specific
force are the sensor's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..filters.butterworth import band_pass
from ..filters.sensors import FilteredRecording
from ..observations.joint_accelerations import BAND_HZ, LEAST_RATE_HZ, compute_sides, linearize_joint
from ..recording import Recording
from .conditions import find_connected, find_samples, mask_measured
from .equations import Gaussian, Layout

SAMPLES_HZ = 10.0
# Errors of orientations are slow: two samples closer than this [s] are never independent, however white the residual
# of one phase is. Chosen on simulated people, whose joint errors it brings within the covariance.
LEAST_CORRELATION_S = 3.0
LEAST_S = 20.0  # of motion that is used
LEAST_LEVER = 1e-6  # [1/s⁴], keeps unobserved levers finite
LEAST_MISMATCH = 0.005  # [m/s²] below which no two sensors agree
STARTS, ROUNDS = 24, 20
DISTANT = np.deg2rad(30.0)  # [rad] from the best heading, from where on others count as other explanations
# What lasts in the error: tissue that changes the lever as it goes, clocks a millisecond apart. On simulated people it
# is 1.1 deg at elbows and 1.6 at shoulders, where the residual alone gives half of it.
SYSTEMATIC_STD = np.deg2rad(1.5)
MAX_STD = np.deg2rad(20.0)  # above it the problem is not linear


class Coupling(NamedTuple):
    """The heading of one sensor's world relative to that of its neighbour."""

    near: str
    far: str
    heading: float  # [rad] ψ of the near one less ψ of the far one, mean over the samples
    std: float  # [rad]
    elapsed_s: float  # from the start pose to the mean time of the samples


def estimate_couplings(
    recording: Recording,
    filtered: FilteredRecording,
    pairs: Sequence[tuple[str, str]],
    spans: Sequence[tuple[float, float]],
) -> list[Coupling]:
    """Of each joint between two IMUs, from the motion in these spans [s]; none where there is too little.

    `pairs` are of neighbouring segments, the one nearer the root first.
    """
    pairs = [pair for pair in pairs if set(pair) <= set(recording.imus)]
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    samples, connected = find_samples(recording, spans), find_connected(recording, filtered.start, names)[0]
    samples = samples[mask_measured(recording, names, samples) & connected[samples]]
    if not pairs or recording.rate_hz < LEAST_RATE_HZ or len(samples) < LEAST_S * recording.rate_hz:
        return []
    samples = samples[:: max(1, round(recording.rate_hz / SAMPLES_HZ))]
    sides = {name: compute_joint_sides(recording, filtered, name)[samples] for name in names}
    elapsed_s = float(np.mean(recording.time[samples]) - filtered.start[1])
    couplings = []
    for near, far in pairs:
        heading, std = estimate_heading(sides[near], sides[far])
        if std < MAX_STD:
            couplings.append(Coupling(near, far, heading, float(np.hypot(std, SYSTEMATIC_STD)), elapsed_s))
    return couplings


def add_couplings(prior: Gaussian, layout: Layout, couplings: Sequence[Coupling], start: np.ndarray) -> Gaussian:
    """The prior of x with the headings and drifts of the couplings, whole turns as at `start`."""
    if not couplings:
        return prior
    H, off = np.zeros((len(couplings), layout.size)), np.zeros(len(couplings))
    mean, information = prior
    for row, coupling in enumerate(couplings):
        for name, sign in ((coupling.near, 1.0), (coupling.far, -1.0)):
            i = layout.sensors.index(name)
            H[row, layout.heading[i]], H[row, layout.drift[i]] = sign, sign * coupling.elapsed_s
        off[row] = H[row] @ (start - mean) + np.angle(np.exp(1j * (coupling.heading - H[row] @ start)))
    weight = np.array([coupling.std**-2 for coupling in couplings])
    information = information + H.T @ (weight[:, None] * H)
    return mean + np.linalg.solve(information, H.T @ (weight * off)), information


def compute_joint_sides(recording: Recording, filtered: FilteredRecording, name: str) -> np.ndarray:
    """(n, 3, 4) in V, band-passed: specific force, and what a lever of 1 m along each axis adds to the joint's."""
    accel_S, at = recording.imus[name].accel_S, np.arange(len(recording))
    finite = np.isfinite(accel_S).all(axis=1)
    if not finite.all():
        accel_S = np.column_stack([np.interp(at, at[finite], axis[finite]) for axis in accel_S.T])
    R_VS = filtered.R_VS[name].as_matrix()
    sides = compute_sides(R_VS[:, None], accel_S[:, None], recording.rate_hz)[:, 0, :, :4]
    return band_pass(np.concatenate([sides[:1], sides, sides[-1:]]), BAND_HZ, recording.rate_hz)


def estimate_heading(near: np.ndarray, far: np.ndarray) -> tuple[float, float]:
    """The rotation [rad] about z from the near sensor's world to the far one's, by their sides, and its std."""
    starts = np.linspace(0.0, 2.0 * np.pi, STARTS, endpoint=False)
    costs = np.array([np.sum(_fit_levers(near, far, angle)[0] ** 2) for angle in starts])
    heading = float(starts[int(np.argmin(costs))])
    for _ in range(ROUNDS):
        r, J = _fit_levers(near, far, heading)
        step = -float(J @ r) / max(float(J @ J), 1e-12)
        heading += step
        if abs(step) < 1e-6:
            break
    r, J = _fit_levers(near, far, heading)
    variance = max(float(np.mean(r**2)), LEAST_MISMATCH**2) * LEAST_CORRELATION_S * SAMPLES_HZ
    std = float(np.sqrt(variance / max(float(J @ J), 1e-12)))
    # Where little moves, a heading half a turn away explains it nearly as well: the whole circle's variance counts.
    off = np.angle(np.exp(1j * (starts - heading)))
    distant = np.abs(off) > DISTANT
    mass = np.exp(-0.5 * np.maximum(costs[distant] - float(r @ r), 0.0) / variance) * (2.0 * np.pi / STARTS)
    total = np.sqrt(2.0 * np.pi) * std + mass.sum()
    return heading, float(np.sqrt(((total - mass.sum()) * std**2 + mass @ off[distant] ** 2) / total))


def _fit_levers(near: np.ndarray, far: np.ndarray, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Misfit (3 n,) of the joint with the best levers, and its derivative by the heading."""
    e, jacobian, _ = linearize_joint(near, far, heading, np.zeros(3), np.zeros(3))
    H = jacobian[:, :, 1:].reshape(-1, 6)
    normal = H.T @ H + LEAST_LEVER * len(H) * np.eye(6)
    levers = -np.linalg.solve(normal, H.T @ e.ravel())
    e, jacobian, _ = linearize_joint(near, far, heading, levers[:3], levers[3:])
    slope = jacobian[:, :, 0].ravel()
    return e.ravel(), slope - H @ np.linalg.solve(normal, H.T @ slope)
