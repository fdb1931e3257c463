"""The mount of a second sensor on a segment, from the first one's orientation of the segment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..filters.sensors import filter_recording
from ..recording import Recording
from ..subject import Subject, mount_rows
from .result import Calibration

HEADINGS = 72  # tried at first
ROUNDS = 20  # of halving the step between them


def add_second_mounts(calibration: Calibration, recording: Recording, method: str) -> Calibration:
    """The calibration with the mounts of second sensors, each under its own name.

    The second sensor's heading ψ is that at which Rz(ψ) R_VS, its orientation in W, differs from the segment's by a
    rotation that changes least: its mount. Its covariance is that of the first sensor's mount, and what the two sensors
    differ by.
    """
    second = {name: own for name, own in recording.doubled.items() if name in calibration.quat_WL}
    if not second:
        return calibration
    sensors = {segment: doubled.sensor for segment, doubled in second.items()}
    filtered = filter_recording(replace(recording, sensors=sensors, doubled={}), method=method)
    rows = np.searchsorted(recording.time, calibration.time - 1e-6).clip(0, len(recording) - 1)
    mounts, covariances = {}, {}
    for segment, doubled in second.items():
        R_WL = Rotation.from_quat(calibration.quat_WL[segment])
        mounts[doubled.name], difference = _estimate_mount(R_WL, filtered.R_VS[segment][rows])
        first = calibration.subject.mount_covariance(segment)
        own = difference**2 * np.eye(3)
        covariances[doubled.name] = own if first is None else first + own
    names = {doubled.name: segment for segment, doubled in second.items()}
    subject = _add(calibration.subject, mounts, covariances)
    return replace(calibration, subject=replace(subject, doubled={**subject.doubled, **names}))


def _estimate_mount(R_WL: Rotation, R_VS: Rotation) -> tuple[np.ndarray, float]:
    """Mount `quat_LS` (4,) xyzw, and the root mean square [rad] by which the two sensors differ about each axis."""

    def fit(heading: float) -> tuple[float, Rotation]:
        """The spread of the mounts over all samples, and their mean."""
        R_LS = R_WL.inv() * Rotation.from_rotvec([0.0, 0.0, heading]) * R_VS
        mean = R_LS.mean()
        return float(np.sqrt(np.mean((R_LS * mean.inv()).magnitude() ** 2) / 3.0)), mean

    headings = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
    best = float(min(headings, key=lambda heading: fit(heading)[0]))
    step = 2.0 * np.pi / HEADINGS
    for _ in range(ROUNDS):
        best = min((best - step, best, best + step), key=lambda heading: fit(heading)[0])
        step /= 2.0
    spread, mean = fit(best)
    return mean.as_quat(), spread


def _add(subject: Subject, mounts: Mapping[str, np.ndarray], covariances: Mapping[str, np.ndarray]) -> Subject:
    return replace(
        subject,
        mounts={**subject.mounts, **mounts},
        order=(*subject.order, *(row for name in mounts for row in mount_rows(name))),
        covariance=block_diag(subject.covariance, *covariances.values()),
    )
