"""Recording → orientation of each segment: filter, align by the start pose, correct headings as samples come.

Chunks and single samples go through the same compiled steps, so that a live session and its recording give
bit-identical quaternions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body import BodyModel
from ..body.mounts import (
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
from ..filters.phases import find_reference_phases
from ..filters.sensors import SensorFilters, find_start_orientations
from ..recording import ImuSensor, OrientationSensor, Recording, Sensor
from ..recording.arrivals import unpack_orientations
from ..rotations import product
from .heading_problem import CLASP, make_heading_problem
from .headings import E_Z, HeadingCorrection, HeadingCorrector
from .segment_orientations import (
    SegmentOrientations,
    TrackOptions,
    compute_heading_variance,
    compute_measured_covariance,
    compute_segment_covariance,
    compute_soft_tissue_covariances,
    correct_covariance,
)

RESET_S = 0.5  # [s] over which the orientation is averaged when headings are reset


class FilterOutput(NamedTuple):
    """What the filters of k sensors state after n samples; NaN where there is no filter, or it has no covariance."""

    quat_VS: np.ndarray  # (n, k, 4) xyzw, of measured orientations too
    attitude_cov: np.ndarray  # (n, k, 3, 3) [rad²]
    about_vertical: np.ndarray  # (n, k, 3) as in `FilterRun`

    def at(self, row: int) -> np.ndarray:
        """What the filters know of their headings after a sample (4, k), as in `HeadingFilter`."""
        variance = compute_heading_variance(self.quat_VS[row], self.attitude_cov[row])
        return np.vstack([variance, self.about_vertical[row].T])


class SegmentEstimator:
    """Orientation of each segment of a recording, chunk by chunk (`push`) or sample by sample (`step`): the same bits.

    The first chunk contains the phases `start` and `static`. A sensor with measured orientations has no filter; where
    it is lost its last one stands causally, else the reader has interpolated. The smoother takes the whole recording.

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

        Raises
        ------
        WeposeError
            In the first chunk: no mount is known for a sensor, or gravity contradicts it; a start phase with too few
            samples.
        """
        if not self.names:
            return self._begin(chunk)
        return self._place(chunk, self._filters.push(chunk))

    def _begin(self, first: Recording) -> SegmentOrientations:
        """Filter and align the first chunk."""
        collect_nominal_mounts(first, self._subject, self._start_pose)  # an error before anything is filtered
        self._phases = phases = find_reference_phases(first, sways=not self._start_pose.table.is_mechanism)
        self._filters = SensorFilters(
            phases.noises,
            method=self._options.method,
            static_test=self._options.static_test,
            start=first.span(phases.start),
        )
        orientation = self._filters.push(first)
        R_VS_start = find_start_orientations(first, orientation, phases.start)
        mounts, offsets, diagnostics = align_sensors(first, self._subject, R_VS_start, phases.start, self._start_pose)
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
        self._filter_headings: np.ndarray  # after the last chunk
        self._end_s: float  # [s] the same
        self.quat_WL = np.zeros((k, 4))
        self._uncorrected = np.zeros(k)
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
        begin = int(np.searchsorted(first.time, phases.start[1], side="right"))
        start = self._stack(first.cut(slice(0, begin)), {n: o.take(slice(0, begin)) for n, o in orientation.items()})
        time = float(first.time[0]) + begin / self.rate_hz
        self.headings = HeadingCorrector(problem, self._heading_offset.copy(), start.at(-1), time)
        if self._options.causal:
            self._variance = self.headings.variance
        return self._place(first, orientation, begin)

    @property
    def static(self) -> np.ndarray:
        """(k,) bool: static by the filter's test at the last step; false of measured orientations."""
        return self._of_all(self._filters.static, np.False_)

    @property
    def gyro_bias(self) -> np.ndarray:
        """(k, 3) [rad/s] after the last sample; NaN of measured orientations."""
        return self._of_all(self._filters.gyro_bias, np.nan, 3)

    def _of_all(self, values: np.ndarray | None, missing: float | np.bool_, *shape: int) -> np.ndarray:
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
                self.headings.close(self._read_filters().at(0))
        return self.quat_WL

    def _fade(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return what `_place_segments` fades in: from and to (k,) [rad], the next sample's number, their number."""
        return (self._uncorrected, self._uncorrected, 0, 1) if self.headings is None else self.headings.fade

    def _read_filters(self) -> FilterOutput:
        """Read what the filters state after the last step."""
        filters, quat_VS = self._filters, self._recent[self._oldest - 1].copy()
        attitude_cov = self._of_all(filters.attitude_cov, np.nan, 3, 3)
        return FilterOutput(quat_VS[None], attitude_cov[None], self._of_all(filters.about_vertical, np.nan, 3)[None])

    def _stack(self, chunk: Recording, orientation: Mapping[str, Orientation]) -> FilterOutput:
        """Stack what the filters state of a chunk."""
        n, k = len(chunk), len(self.names)
        output = FilterOutput(np.empty((n, k, 4)), np.full((n, k, 3, 3), np.nan), np.full((n, k, 3), np.nan))
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, ImuSensor):
                each = orientation[name]
                output.quat_VS[:, i] = each.quat_VS
                if each.attitude_cov is not None and each.about_vertical is not None:
                    output.attitude_cov[:, i], output.about_vertical[:, i] = each.attitude_cov, each.about_vertical
                continue
            output.quat_VS[:, i] = sensor.quat_VS
            if self._options.causal and sensor.gap is not None and sensor.gap.any():
                before = self._recent[self._oldest - 1, i] if len(self._recent) else sensor.quat_VS[0]
                known = np.concatenate([[True], ~sensor.gap])
                last = np.maximum.accumulate(np.where(known, np.arange(n + 1), 0))
                output.quat_VS[:, i] = np.concatenate([before[None], sensor.quat_VS])[last][1:]
        return output

    def _place(self, chunk: Recording, orientation: Mapping[str, Orientation], begin: int = 0) -> SegmentOrientations:
        """Return the segment orientations of a filtered chunk, whose headings are observed from sample `begin` on."""
        n, output = len(chunk), self._stack(chunk, orientation)
        quat_WL, variance = np.empty(output.quat_VS.shape), np.empty((n, *self._variance.shape))
        offset = np.empty((n, len(self.names)))
        size = max(1, round(RESET_S * self.rate_hz))
        history = np.concatenate([self._order_recent(), output.quat_VS])
        before = len(history) - n
        accel_S = np.stack([_find_specific_force(sensor) for sensor in chunk.sensors.values()], axis=1)
        clasped = np.zeros(n, dtype=bool)
        for interval in chunk.phases.get(CLASP, ()):
            clasped[chunk.span(interval)] = True
        resets = {tick for tick in chunk.resets if 0 <= tick < n and before}  # none before the start pose has ended
        for first, last in pairwise(sorted({0, *resets, min(begin, n), n})):
            if first in resets:
                self._reset(history[max(0, before + first - size) : before + first])
            while first < last:
                stop = last
                if self.headings is not None and first >= begin:
                    stop = min(last, first + self.headings.remaining)
                rows = slice(first, stop)
                placed = self._quat_WV, self._fade(), output.quat_VS[rows], self._quat_LS, self.quat_WL, quat_WL[rows]
                _place_segments(*placed)
                variance[rows], offset[rows] = self._variance, self._heading_offset
                if self.headings is not None and first >= begin:
                    if self.headings.push(output.quat_VS[rows], accel_S[rows], clasped[rows]):
                        self.headings.close(output.at(stop - 1), end=float(chunk.time[stop - 1]), record=True)
                    if self._options.causal:
                        self._variance = self.headings.variance
                first = stop
        self._recent, self._oldest, self._filter_headings = history[-size:], 0, output.at(-1)
        self._end_s, self._clasped = float(chunk.time[-1]), bool(clasped[-1])
        return SegmentOrientations(
            recording=chunk,
            options=self._options,
            quat_WL={name: quat_WL[:, i] for i, name in enumerate(self.names)},
            quat_LS=dict(zip(self.names, self._quat_LS, strict=True)),
            heading_offset=dict(zip(self.names, self._heading_offset.tolist(), strict=True)),
            orientation=orientation,
            covariance_W=self._find_covariances(chunk, output, quat_WL, offset, variance),
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

    def covariance_gradually(self) -> Iterator[np.ndarray | None]:
        """Compute the covariances (k, 3, 3) [rad²] of the segments in W after the last step; NaN where there is none.

        It does so in parts of less than half a millisecond; only the last one is not None. There may be steps between
        the parts: the result is that of the step before the first one.
        """
        output, offset, variance = self._read_filters(), self._heading_offset.copy(), np.array(self._variance)
        lost_s, covariance = self._lost / self.rate_hz, np.full((len(self.names), 3, 3), np.nan)
        quat_WL = {name: self.quat_WL[i : i + 1].copy() for i, name in enumerate(self.names)}
        soft = compute_soft_tissue_covariances(self._start_pose.table, quat_WL)
        yield None
        for i, name in enumerate(self.names):
            cov = self._find_covariance(i, output, lost_s[i : i + 1], offset[None, i], variance[None, :, i])
            if cov is not None:
                covariance[i] = (cov + soft[name])[0]
            yield None
        yield covariance

    def _find_covariances(
        self, chunk: Recording, output: FilterOutput, quat_WL: np.ndarray, offset: np.ndarray, variance: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return segment → covariance (n, 3, 3) [rad²] in W of a chunk; none of filters without one."""
        covariances: dict[str, np.ndarray] = {}
        soft: dict[str, np.ndarray] = {}
        samples = np.arange(len(chunk))
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            lost_s = np.zeros(len(chunk))
            if isinstance(sensor, OrientationSensor) and sensor.gap is not None:
                lost = samples - np.maximum.accumulate(np.where(sensor.gap, -1 - self._lost[i], samples))
                self._lost[i], lost_s = lost[-1], lost / self.rate_hz
            cov = self._find_covariance(i, output, lost_s, offset[:, i], variance[:, :, i])
            if cov is not None:
                by_name = {each: quat_WL[:, j] for j, each in enumerate(self.names)}
                soft = soft or compute_soft_tissue_covariances(self._start_pose.table, by_name)
                covariances[name] = cov + soft[name]
        return covariances

    def _find_covariance(
        self, i: int, output: FilterOutput, lost_s: np.ndarray, offset: np.ndarray, variance: np.ndarray
    ) -> np.ndarray | None:
        """Return the covariance (n, 3, 3) [rad²] of sensor i's segment in W, error on the left, without soft tissue.

        None: its filter has none. `lost_s` (n,) [s] is how long a measured orientation has been lost, `offset` (n,)
        [rad] its ψ, and `variance` (n, 3) [rad²] `HeadingCorrector.variance`.
        """
        name, quat_VS, attitude_cov = self.names[i], output.quat_VS[:, i], output.attitude_cov[:, i]
        if self._measured[i]:
            attitude_cov = compute_measured_covariance(lost_s)
        if np.isnan(attitude_cov[0, 0, 0]):
            return None
        if self._first.sensors[name].aligned:
            return attitude_cov
        quat_WS = rotations.multiply(rotations.rotation_about(E_Z, offset), quat_VS)
        R_LS = Rotation.from_quat(self._quat_LS[i])
        cov = compute_segment_covariance(
            self._first, name, self._subject, quat_WS, R_LS, attitude_cov, self._start_pose
        )
        if np.isnan(variance).any():
            return cov
        start_var = compute_start_heading_var(self._first, name, self._subject, self._start_pose)
        return correct_covariance(cov, (quat_VS, attitude_cov), offset, start_var, variance)

    def _order_recent(self) -> np.ndarray:
        return np.concatenate([self._recent[self._oldest :], self._recent[: self._oldest]])


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
