"""Samples cut into knots, with what each knot takes from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..filters import Orientation
from ..filters.butterworth import BandPass
from ..observations.joint_accelerations import BAND_HZ, compute_sides
from ..recording import ImuSensor, OrientationSensor, Recording
from .heading_problem import FilterHeadings, HeadingProblem, Knot, find_stride
from .segment_orientations import SegmentOrientations, compute_heading_variance

E_Z = np.array([0.0, 0.0, 1.0])
Samples = tuple[np.ndarray, np.ndarray, np.ndarray]  # time (n,) [s], `quat_VS` (n, k, 4), `accel_S` (n, k, 3) [m/s²]


class KnotReader:
    """Cuts samples into knots of `size` samples and forms the observations of each.

    Parameters
    ----------
    orientations : of a chunk, with the mounts and heading offsets of the problem's segments
    """

    def __init__(self, orientations: SegmentOrientations, problem: HeadingProblem) -> None:
        names, R_WK, rate_hz = problem.names, problem.model.neutral_rotations, orientations.recording.rate_hz
        self._stride = find_stride(rate_hz)
        self.size = self._stride * problem.samples_per_knot
        k = len(names)
        mounts = np.array([orientations.quat_LS[name] for name in names])
        neutral = Rotation.from_matrix([R_WK[name] for name in names]).as_quat()  # L to L'
        self._quat_SL = rotations.conjugate(rotations.multiply(neutral, mounts))
        offsets = np.array([orientations.heading_offset[name] for name in names])
        self._quat_WV = rotations.rotation_about(E_Z, offsets)
        self._samples = np.zeros(self.size), np.zeros((self.size, k, 4)), np.zeros((self.size, k, 3))
        self.count = 0  # samples in the open knot
        self._accelerations = JointAccelerationFilter(k, rate_hz) if problem.pairs else None

    @property
    def remaining(self) -> int:
        """Number of samples that the open knot lacks."""
        return self.size - self.count

    def push(self, time: np.ndarray, quat_VS: np.ndarray, accel_S: np.ndarray) -> None:
        """Add at most `remaining` samples: (n,) [s], (n, k, 4) xyzw, (n, k, 3) [m/s²], NaN where lost."""
        rows = slice(self.count, self.count + len(time))
        for values, new in zip(self._samples, (time, quat_VS, accel_S), strict=True):
            values[rows] = new
        self.count += len(time)

    def take(self) -> Samples:
        """Return the samples of the open knot, and open the next one."""
        n, self.count = self.count, 0
        time, quat_VS, accel_S = self._samples
        return time[:n].copy(), quat_VS[:n].copy(), accel_S[:n].copy()

    def form(self, samples: Samples, filters: FilterHeadings) -> Knot:
        """Return the knot of samples from `take`, in the order of time; `filters` is at the last of them."""
        time, quat_VS, accel_S = samples
        rows = slice(0, len(time), self._stride)
        quat_WS = rotations.multiply(self._quat_WV, quat_VS)
        sides = np.zeros((0, accel_S.shape[1], 3, 8))
        if self._accelerations is not None:
            R_WS = Rotation.from_quat(quat_WS.reshape(-1, 4)).as_matrix().reshape(*quat_WS.shape[:2], 3, 3)
            sides = self._accelerations.push(R_WS, accel_S)[rows]
        lost = np.asarray(~np.isfinite(accel_S).all(axis=(0, 2)))
        return Knot(
            float(time[-1]), time[rows].copy(), rotations.multiply(quat_WS[rows], self._quat_SL), sides, filters, lost
        )


class JointAccelerationFilter:
    """The side B of each sensor at its joints, band-passed, from samples of all sensors; it runs on from call to call.

    Parameters
    ----------
    sensors : number of them
    """

    def __init__(self, sensors: int, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._band: BandPass | None = None
        self._last_R_WS, self._last_accel_S = np.zeros((2, sensors, 3, 3)), np.zeros((2, sensors, 3))

    def push(self, R_WS: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Return B (n, k, 3, 8), one sample late; where a sensor has lost samples it is of no use.

        Parameters
        ----------
        R_WS : (n, k, 3, 3)
        accel_S : (n, k, 3) [m/s²], NaN where lost
        """
        accel_S = np.concatenate([self._last_accel_S, accel_S])
        lost = ~np.isfinite(accel_S).all(axis=2)
        for i in np.flatnonzero(lost.any(axis=0)):
            accel_S[:, i] = accel_S[np.maximum.accumulate(np.where(lost[:, i], 0, np.arange(len(accel_S)))), i]
        if self._band is None:
            self._last_R_WS, accel_S[:2] = np.repeat(R_WS[:1], 2, axis=0), accel_S[2]
            steady = compute_sides(np.repeat(R_WS[:1], 3, axis=0), np.repeat(accel_S[2:3], 3, axis=0), self._rate_hz)
            self._band = BandPass(BAND_HZ, self._rate_hz, steady.ravel())
        R_WS = np.concatenate([self._last_R_WS, R_WS])
        self._last_R_WS, self._last_accel_S = R_WS[-2:], accel_S[-2:]
        B = compute_sides(R_WS, accel_S, self._rate_hz)
        return self._band.push(B.reshape(len(B), -1)).reshape(B.shape)


def stack_samples(orientations: SegmentOrientations, names: Sequence[str]) -> Samples:
    """Stack the samples of these segments' sensors."""
    chunk, quats = orientations.recording, []
    for name in names:
        sensor = chunk.sensors[name]
        filtered = sensor if isinstance(sensor, OrientationSensor) else orientations.orientation[name]
        quats.append(filtered.quat_VS)
    accel_S = np.stack([find_specific_force(chunk, name) for name in names], axis=1)
    return chunk.time, np.stack(quats, axis=1), accel_S


def find_specific_force(chunk: Recording, name: str) -> np.ndarray:
    """Return `accel_S` (n, 3) [m/s²] of a sensor, NaN where samples are lost; zeros of an `OrientationSensor`."""
    sensor = chunk.sensors[name]
    accel_S = sensor.accel_S if isinstance(sensor, ImuSensor) else np.zeros((len(chunk), 3))
    return accel_S if sensor.gap is None else np.where(sensor.gap[:, None], np.nan, accel_S)


def read_filter_headings(orientation: Mapping[str, Orientation], names: Sequence[str], row: int) -> FilterHeadings:
    """Read what the filters say of their headings at sample `row`."""
    values = np.full((len(names), len(FilterHeadings._fields)), np.nan)
    filtered = {i: orientation[name] for i, name in enumerate(names) if name in orientation}
    covs = {i: each.attitude_cov[row] for i, each in filtered.items() if each.attitude_cov is not None}
    if covs:
        quat_VS = np.stack([filtered[i].quat_VS[row] for i in covs])
        values[list(covs), 0] = compute_heading_variance(quat_VS, np.stack(list(covs.values())))
    for i, each in filtered.items():
        if each.about_vertical is not None:
            values[i, 1:] = each.about_vertical[row]
    return FilterHeadings(*values.T)
