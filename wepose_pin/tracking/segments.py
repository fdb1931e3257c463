"""Recording → orientation of each segment: filter, align by the start pose, correct headings as samples come.

Chunks and single samples go through the same compiled steps, so that a live session and its recording give
bit-identical quaternions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body import BodyModel
from ..body.mounts import (
    MEASURED_ORIENTATION_STD,
    N_POSE,
    StartPose,
    align_sensors,
    collect_nominal_mounts,
    compute_heading_offset,
    compute_start_heading_var,
)
from ..body.subject import Subject
from ..compilation import kernel
from ..diagnostics import drop_consequences
from ..filters import Orientation
from ..filters.base import HOLD_S, LOST_RATE_STD
from ..filters.phases import find_reference_phases
from ..filters.sensors import SensorFilters, find_start_orientations
from ..recording import ImuSensor, Recording, Sensor
from ..recording.arrivals import unpack_orientations
from ..rotations import product
from .heading_problem import CLASP, make_heading_problem
from .headings import E_Z, HeadingCorrection, HeadingCorrector
from .segment_orientations import (
    SegmentOrientations,
    TrackOptions,
    compute_heading_variance,
    compute_segment_covariance,
    compute_soft_tissue_covariances,
    correct_covariance,
)

RESET_S = 0.5  # [s] over which the orientation is averaged when headings are reset


class SegmentEstimator:
    """Orientation of each segment of a recording, chunk by chunk (`push`) or sample by sample (`step`): the same bits.

    The first chunk contains the phases `start` and `static`. A sensor with measured orientations has no filter; where
    it is lost its last one stands causally, else the reader has interpolated. The smoother takes the whole recording.

    What the filters of the k sensors state after n samples is `quat_VS` (n, k, 4) xyzw, of measured orientations too,
    the attitude's covariance (n, k, 3, 3) [rad²] and `about_vertical` (n, k, 3) as in `Orientation`; NaN where there is
    no filter, or it has no covariance.

    Parameters
    ----------
    subject : its calibrated mounts are used in place of those that the session states; None: the stated ones
    options : None: the default ones
    start_pose : of the body; left out: the N-pose
    heading_body : the person and the body by which headings are observed from the end of the start pose on; None:
        they are not

    Attributes
    ----------
    names : the k segments; this and what follows from the first chunk on
    diagnostics : of the recording, its start pose and its mounts
    headings : what corrects the headings, causally at once; None: nothing does
    quat_WL : (k, 4) xyzw after the last sample; overwritten by the next one
    static : (k,) bool: static by the filter's test at the last step; false of measured orientations
    gyro_bias : (k, 3) [rad/s] after the last sample; NaN of measured orientations
    """

    def __init__(
        self,
        subject: Subject | None = None,
        options: TrackOptions | None = None,
        start_pose: StartPose = N_POSE,
        heading_body: tuple[Subject, BodyModel] | None = None,
    ) -> None:
        self._subject, self._options, self._start_pose = subject, options or TrackOptions(), start_pose
        self._heading_body = heading_body
        self.names: tuple[str, ...] = ()
        self.headings: HeadingCorrector | None = None

    def push(self, chunk: Recording) -> SegmentOrientations:
        """Return the segment orientations of a chunk, bit-identical with as many steps.

        The first one raises `WeposeError` where a mount is not known or gravity contradicts it, or the start is short.
        """
        return self._place(chunk, self._filters.push(chunk)) if self.names else self._begin(chunk)

    def _begin(self, first: Recording) -> SegmentOrientations:
        """Filter and align the first chunk."""
        collect_nominal_mounts(first, self._subject, self._start_pose)  # an error before anything is filtered
        self._phases = phases = find_reference_phases(first, sways=not self._start_pose.table.is_mechanism)
        method, test, start = self._options.method, self._options.static_test, phases.start
        self._filters = SensorFilters(phases.noises, method=method, static_test=test, start=first.span(start))
        orientation = self._filters.push(first)
        R_VS_start = find_start_orientations(first, orientation, start)
        mounts, offsets, diagnostics = align_sensors(first, self._subject, R_VS_start, start, self._start_pose)
        self.diagnostics = tuple(drop_consequences((*phases.diagnostics, *diagnostics)))
        self.names, self.rate_hz, self._first = tuple(first.sensors), first.rate_hz, first.cut(slice(0, 1))
        k = len(self.names)
        self._measured = np.array([name not in first.imus for name in self.names])
        self._lost = np.zeros(k, dtype=int)  # samples since a measured orientation
        self._quat_LS = np.array([mounts[name].as_quat() for name in self.names])
        # (k,) ψ [rad], heading of each sensor's world V in W at the start or the last reset
        self._heading_offset = np.array([offsets[name] for name in self.names])
        self._quat_WV = rotations.rotation_about(E_Z, self._heading_offset)
        self._recent = np.empty((0, k, 4))  # orientations of the last `RESET_S`
        self._oldest = 0  # row of `_recent` with the oldest sample
        self.quat_WL = np.zeros((k, 4))
        # [rad²] `HeadingCorrector.variance` at the last step; NaN: the heading's variance is that of its filter
        self._variance = np.full((3, k), np.nan)
        problem = None
        if self._heading_body is not None and not any(sensor.aligned for sensor in first.sensors.values()):
            quat_LS = dict(zip(self.names, self._quat_LS, strict=True))
            problem = make_heading_problem(
                first, quat_LS, phases.noises, *self._heading_body, causal=self._options.causal
            )
        if problem is None:
            return self._place(first, orientation)
        # Headings are observed from the first sample after the start pose on.
        begin = int(np.searchsorted(first.time, start[1], side="right"))
        rows = slice(0, begin)
        before = self._stack(first.cut(rows), {name: each.take(rows) for name, each in orientation.items()})
        time = float(first.time[0]) + begin / self.rate_hz
        self.headings = HeadingCorrector(problem, self._heading_offset.copy(), _describe_headings(*before), time)
        if self._options.causal:
            self._variance = self.headings.variance
        return self._place(first, orientation, begin)

    @property
    def static(self) -> np.ndarray:
        return self._extend(self._filters.static, np.False_)

    @property
    def gyro_bias(self) -> np.ndarray:
        return self._extend(self._filters.gyro_bias, np.nan, 3)

    def _extend(self, values: np.ndarray | None, missing: float | np.bool_, *shape: int) -> np.ndarray:
        """Return values (k, *shape) of all sensors from those of the filters; `missing` where there is none."""
        all_values = np.full((len(self.names), *shape), missing)
        if values is not None:
            all_values[~self._measured] = values
        return all_values

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Add one sample, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost; return `quat_WL` (k, 4).

        Of a sensor with measured orientations they hold what `pack_orientations` gives.
        """
        row = self._recent[self._oldest]
        if self._measured.any():
            quat_VS = unpack_orientations(gyro_S, accel_S)
            lost = ~np.isfinite(quat_VS).all(axis=1)
            self._lost = np.where(lost & self._measured, self._lost + 1, 0)
            row[:] = np.where(lost[:, None], self._recent[self._oldest - 1], quat_VS)
            if not self._measured.all():
                row[~self._measured] = self._filters.step(gyro_S[~self._measured], accel_S[~self._measured])
            accel_S = np.where((self._measured & ~lost)[:, None], 0.0, accel_S)
        else:
            row[:] = self._filters.step(gyro_S, accel_S)
        _place_segments(self._quat_WV, self._fade(), row[None], self._quat_LS, self.quat_WL, self.quat_WL[None])
        self._oldest = (self._oldest + 1) % len(self._recent)
        if self.headings is not None:
            self._variance = self.headings.variance  # of this sample, as in `_place`
            if self.headings.push(row[None], accel_S[None], self._clasped):
                self.headings.close(_describe_headings(*self._read_filters()))
        return self.quat_WL

    def _fade(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return what `_place_segments` fades in, as `HeadingCorrector.fade`."""
        if self.headings is not None:
            return self.headings.fade
        nothing = np.zeros(len(self.names))
        return nothing, nothing, 0, 1

    def _read_filters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read what the filters state after the last step, of n = 1 sample."""
        quat_VS = self._recent[self._oldest - 1].copy()
        attitude_cov = self._extend(self._filters.attitude_cov, np.nan, 3, 3)
        return quat_VS[None], attitude_cov[None], self._extend(self._filters.about_vertical, np.nan, 3)[None]

    def _stack(
        self, chunk: Recording, orientation: Mapping[str, Orientation]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stack what the filters state of a chunk."""
        n, k = len(chunk), len(self.names)
        quat_VS, attitude_cov = np.empty((n, k, 4)), np.full((n, k, 3, 3), np.nan)
        about_vertical = np.full((n, k, 3), np.nan)
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, ImuSensor):
                each = orientation[name]
                quat_VS[:, i] = each.quat_VS
                if each.attitude_cov is not None and each.about_vertical is not None:
                    attitude_cov[:, i], about_vertical[:, i] = each.attitude_cov, each.about_vertical
                continue
            quat_VS[:, i] = sensor.quat_VS
            if self._options.causal and sensor.gap is not None and sensor.gap.any():
                before = self._recent[self._oldest - 1, i] if len(self._recent) else sensor.quat_VS[0]
                known = np.concatenate([[True], ~sensor.gap])
                last = np.maximum.accumulate(np.where(known, np.arange(n + 1), 0))
                quat_VS[:, i] = np.concatenate([before[None], sensor.quat_VS])[last][1:]
        return quat_VS, attitude_cov, about_vertical

    def _place(self, chunk: Recording, orientation: Mapping[str, Orientation], begin: int = 0) -> SegmentOrientations:
        """Return the segment orientations of a filtered chunk, whose headings are observed from sample `begin` on."""
        n, (quat_VS, attitude_cov, about_vertical) = len(chunk), self._stack(chunk, orientation)
        quat_WL, variance = np.empty(quat_VS.shape), np.empty((n, *self._variance.shape))
        offset = np.empty((n, len(self.names)))
        size = max(1, round(RESET_S * self.rate_hz))
        history = np.concatenate([self._order_recent(), quat_VS])
        before = len(history) - n
        accel_S = np.stack([_find_specific_force(sensor) for sensor in chunk.sensors.values()], axis=1)
        clasped = np.zeros(n, dtype=bool)
        for interval in chunk.phases.get(CLASP, ()):
            clasped[chunk.span(interval)] = True
        resets = {tick for tick in chunk.resets if 0 <= tick < n and before}  # none before the start pose has ended
        for first, last in pairwise(sorted({0, *resets, min(begin, n), n})):
            if first in resets:
                self._reset(history[max(0, before + first - size) : before + first])
            headings = self.headings if first >= begin else None
            while first < last:
                stop = last if headings is None else min(last, first + headings.remaining)
                rows = slice(first, stop)
                placed = self._quat_WV, self._fade(), quat_VS[rows], self._quat_LS, self.quat_WL, quat_WL[rows]
                _place_segments(*placed)
                variance[rows], offset[rows] = self._variance, self._heading_offset
                if headings is not None:
                    if headings.push(quat_VS[rows], accel_S[rows], clasped[rows]):
                        knot_end = _describe_headings(quat_VS[rows], attitude_cov[rows], about_vertical[rows])
                        headings.close(knot_end, end=float(chunk.time[stop - 1]), record=True)
                    if self._options.causal:
                        self._variance = headings.variance
                first = stop
        self._recent, self._oldest = history[-size:], 0
        # What the filters know after the last chunk, when it ended, and whether the palms were joined.
        self._filter_headings = _describe_headings(quat_VS, attitude_cov, about_vertical)
        self._end_s, self._clasped = float(chunk.time[-1]), bool(clasped[-1])
        by_name, covariances = {name: quat_WL[:, i] for i, name in enumerate(self.names)}, {}
        soft = compute_soft_tissue_covariances(self._start_pose.table, by_name)
        samples = np.arange(n)
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            filtered, lost = (quat_VS[:, i], attitude_cov[:, i]), np.zeros(n, dtype=int)
            if self._measured[i] and sensor.gap is not None:
                lost = samples - np.maximum.accumulate(np.where(sensor.gap, -1 - self._lost[i], samples))
            self._lost[i] = lost[-1]
            cov = self._find_covariance(i, filtered, lost / self.rate_hz, offset[:, i], variance[:, :, i])
            if cov is not None:
                covariances[name] = cov + soft[name]
        return SegmentOrientations(
            recording=chunk,
            options=self._options,
            quat_WL=by_name,
            quat_LS=dict(zip(self.names, self._quat_LS, strict=True)),
            heading_offset=dict(zip(self.names, self._heading_offset.tolist(), strict=True)),
            orientation=orientation,
            covariance_W=covariances,
            start=self._phases.start,
            static_phase=self._phases.static,
            diagnostics=self.diagnostics,
        )

    def smooth_headings(self) -> HeadingCorrection | None:
        """Return the correction of the headings after the last chunk; None: nothing observes them."""
        return None if self.headings is None else self.headings.smooth(self._filter_headings, self._end_s)

    def mark_phase(self, phase: str, *, begins: bool) -> None:
        """Mark that a phase begins with the next sample, or has ended before it; of `CLASP` it tells headings."""
        if phase == CLASP:
            self._clasped = begins

    def reset_headings(self) -> None:
        """Reset the headings: the body has stood in the start pose again for `RESET_S`."""
        self._reset(self._order_recent())

    def _reset(self, recent: np.ndarray) -> None:
        """Reset the headings by recent orientations (m, k, 4)."""
        same_sign = recent * np.sign(np.einsum("nki,ki->nk", recent, recent[-1]))[:, :, None]
        mean = same_sign.sum(axis=0)
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        for i, name in enumerate(self.names):
            R_WS_start = self._start_pose.to_world(name, Rotation.from_quat(self._quat_LS[i]))
            self._heading_offset[i] = compute_heading_offset(Rotation.from_quat(mean[i]), R_WS_start)
        if self.headings is None:
            self._quat_WV = rotations.rotation_about(E_Z, self._heading_offset)
        else:
            self.headings.reset(self._heading_offset)
            self._variance = self.headings.variance

    def _order_recent(self) -> np.ndarray:
        return np.concatenate([self._recent[self._oldest :], self._recent[: self._oldest]])

    def covariance_gradually(self) -> Iterator[np.ndarray | None]:
        """Compute the covariances (k, 3, 3) [rad²] of the segments in W after the last step; NaN where there is none.

        It does so in parts of less than half a millisecond; only the last one is not None. There may be steps between
        the parts: the result is that of the step before the first one.
        """
        (quat_VS, attitude_cov, _), offset = self._read_filters(), self._heading_offset.copy()
        variance, lost_s = np.array(self._variance), self._lost / self.rate_hz
        covariance = np.full((len(self.names), 3, 3), np.nan)
        quat_WL = {name: self.quat_WL[i : i + 1].copy() for i, name in enumerate(self.names)}
        soft = compute_soft_tissue_covariances(self._start_pose.table, quat_WL)
        yield None
        for i, name in enumerate(self.names):
            filtered = quat_VS[:, i], attitude_cov[:, i]
            cov = self._find_covariance(i, filtered, lost_s[i : i + 1], offset[None, i], variance[None, :, i])
            if cov is not None:
                covariance[i] = (cov + soft[name])[0]
            yield None
        yield covariance

    def _find_covariance(
        self,
        i: int,
        filtered: tuple[np.ndarray, np.ndarray],
        lost_s: np.ndarray,
        offset: np.ndarray,
        variance: np.ndarray,
    ) -> np.ndarray | None:
        """Return the covariance (n, 3, 3) [rad²] of sensor i's segment in W, error on the left, without soft tissue.

        None: its filter has none. `filtered` is `quat_VS` (n, 4) xyzw and the attitude's covariance (n, 3, 3) [rad²],
        `lost_s` (n,) [s] since a measured orientation, `offset` (n,) [rad] ψ, and `variance` (n, 3) [rad²] that of
        `HeadingCorrector`.
        """
        name, (quat_VS, attitude_cov) = self.names[i], filtered
        if self._measured[i]:
            # It grows by the motion that may have been missed, as that of the filters.
            missed_std = np.minimum(np.pi, LOST_RATE_STD * lost_s**2 / (lost_s + HOLD_S))
            attitude_cov = (MEASURED_ORIENTATION_STD**2 + missed_std**2)[:, None, None] * np.eye(3)
        if np.isnan(attitude_cov[0, 0, 0]):
            return None
        if self._first.sensors[name].aligned:
            return attitude_cov
        quat_WS = rotations.multiply(rotations.rotation_about(E_Z, offset), quat_VS)
        R_LS = Rotation.from_quat(self._quat_LS[i])
        mounting = self._first, name, self._subject, self._start_pose
        cov = compute_segment_covariance(mounting, quat_WS, R_LS, attitude_cov)
        if np.isnan(variance).any():
            return cov
        return correct_covariance(cov, (quat_VS, attitude_cov), offset, compute_start_heading_var(*mounting), variance)


def _describe_headings(quat_VS: np.ndarray, attitude_cov: np.ndarray, about_vertical: np.ndarray) -> np.ndarray:
    """Return what the filters know of their headings after the last sample (4, k), as in `HeadingFilter`."""
    return np.vstack([compute_heading_variance(quat_VS[-1], attitude_cov[-1]), about_vertical[-1].T])


def _find_specific_force(sensor: Sensor) -> np.ndarray:
    """Return `accel_S` (n, 3) [m/s²] of a sensor, NaN where samples are lost; zeros of an `OrientationSensor`."""
    accel_S = sensor.accel_S if isinstance(sensor, ImuSensor) else np.zeros((len(sensor.quat_VS), 3))
    return accel_S if sensor.gap is None else np.where(sensor.gap[:, None], np.nan, accel_S)


@kernel
def _place_segments(quat_WV, correction, quat_VS, quat_LS, last, out):  # type: ignore[no-untyped-def]
    """Fill `out` (n, k, 4) with ``Rz(δ) ⊗ quat_WV ⊗ quat_VS ⊗ quat_LS⁻¹`` of n ticks; signs continue `last` (k, 4).

    `correction` is δ before and after a knot, (k,) each, the first tick's number in it and its number of ticks.
    """
    begin, end, first, count = correction
    for n in range(len(quat_VS)):
        for k in range(len(quat_WV)):
            ax, ay, az, aw = quat_WV[k, 0], quat_WV[k, 1], quat_WV[k, 2], quat_WV[k, 3]
            delta = begin[k] + (end[k] - begin[k]) * (first + n + 1) / count
            if delta != 0.0:
                s, c = np.sin(0.5 * delta), np.cos(0.5 * delta)
                az, aw = az * c + aw * s, aw * c - az * s
            bx, by, bz, bw = quat_VS[n, k, 0], quat_VS[n, k, 1], quat_VS[n, k, 2], quat_VS[n, k, 3]
            x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
            rx, ry, rz, rw = product(x, y, z, w, -quat_LS[k, 0], -quat_LS[k, 1], -quat_LS[k, 2], quat_LS[k, 3])
            sign = 1.0
            if rx * last[k, 0] + ry * last[k, 1] + rz * last[k, 2] + rw * last[k, 3] < 0.0:
                sign = -1.0
            last[k, 0], last[k, 1], last[k, 2], last[k, 3] = sign * rx, sign * ry, sign * rz, sign * rw
            out[n, k, 0], out[n, k, 1], out[n, k, 2], out[n, k, 3] = last[k, 0], last[k, 1], last[k, 2], last[k, 3]
