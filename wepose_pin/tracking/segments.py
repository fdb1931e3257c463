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
from ..body.mounts import align_sensors, collect_nominal_mounts, compute_heading_offset, compute_start_heading_var
from ..body.start_pose import N_POSE, StartPose
from ..body.subject import Subject
from ..compilation import kernel
from ..diagnostics import drop_consequences
from ..filters import AboutVertical, Orientation
from ..filters.phases import find_reference_phases
from ..filters.sensors import SensorFilters, find_start_orientations
from ..recording import ImuSensor, OrientationSensor, Recording
from ..recording.arrivals import unpack_orientations
from ..rotations import product
from .heading_problem import FilterHeadings, HeadingProblem
from .headings import CausalHeadings, correct_covariance
from .knots import find_specific_force, read_filter_headings
from .segment_orientations import (
    SegmentOrientations,
    TrackOptions,
    compute_heading_variance,
    compute_measured_covariance,
    compute_segment_covariance,
    compute_soft_tissue_covariances,
    count_lost_samples,
    join_segments,
)

RESET_S = 0.5  # [s] over which the orientation is averaged when headings are reset


class SegmentEstimator:
    """Orientation of each segment of a recording, chunk by chunk (`push`) or sample by sample (`step`): the same bits.

    The first chunk contains the phases `start` and `static`. Where it ends with the start pose, `correct_headings`
    switches on the causal correction; phases in which points coincide, and resets, count from then on. A sensor with
    measured orientations has no filter. The smoother takes the whole recording as one chunk.

    Parameters
    ----------
    subject : its calibrated mounts are used in place of those that the session states; None: the stated ones
    options : None: the default ones. While measured orientations are lost, the last one stands where `causal`; else
        they are interpolated, as the reader does
    start_pose : of the body; left out: the N-pose

    Attributes
    ----------
    names : the k segments; this and what follows from the first chunk on
    diagnostics : of the recording, its start pose and its mounts
    heading_offset : (k,) ψ [rad], heading of each sensor's world V in W at the start or the last reset
    headings : what corrects the headings; None: nothing does
    quat_WL : (k, 4) xyzw after the last sample; overwritten by the next one
    """

    def __init__(
        self,
        subject: Subject | None = None,
        options: TrackOptions | None = None,
        start_pose: StartPose = N_POSE,
    ) -> None:
        self._subject, self._options, self._start_pose = subject, options or TrackOptions(), start_pose
        self.names: tuple[str, ...] = ()
        self.headings: CausalHeadings | None = None

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
        resets = {tick for tick in chunk.resets if 0 <= tick < len(chunk)}
        marks = self._find_marks(chunk)
        parts = []
        for begin, end in pairwise(sorted({0, *resets, *marks, len(chunk)})):
            if begin in resets:
                self.reset_headings()
            for phase, begins in marks.get(begin, ()):
                self.mark_phase(phase, begins=begins)
            part = chunk.cut(slice(begin, end))
            parts.append(self._place_chunk(part, self._filters.push(part)))
        return parts[0] if len(parts) == 1 else join_segments(chunk, parts)

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
        mounts, headings, diagnostics = align_sensors(first, self._subject, R_VS_start, phases.start, self._start_pose)
        self.diagnostics = tuple(drop_consequences((*phases.diagnostics, *diagnostics)))
        self.names, self.rate_hz, self._first = tuple(first.sensors), first.rate_hz, first.cut(slice(0, 1))
        self._measured = np.array([isinstance(each, OrientationSensor) for each in first.sensors.values()], dtype=bool)
        self._lost = np.zeros(len(self.names), dtype=int)  # samples since a measured orientation
        self._quat_LS = np.array([mounts[name].as_quat() for name in self.names])
        self.heading_offset = np.array([headings[name] for name in self.names])
        self._quat_WV = _quat_about_z(self.heading_offset)
        self._recent = np.empty((0, len(self.names), 4))
        self._oldest = 0  # row of `_recent` with the oldest sample
        self.quat_WL = np.zeros((len(self.names), 4))
        self._uncorrected = np.zeros(len(self.names))
        # [rad²] `CausalHeadings.variance` at the last step; NaN: the heading's variance is that of its filter
        self._variance = (np.full(len(self.names), np.nan),) * 3
        return self._place_chunk(first, orientation)

    def correct_headings(self, problem: HeadingProblem, first: SegmentOrientations) -> None:
        """Correct headings from now on; `first` is of the first chunk, which ended with the start pose."""
        self.headings = CausalHeadings(first, problem)
        self._variance = self.headings.variance

    @property
    def static(self) -> np.ndarray:
        """(k,) bool: static by the filter's test at the last step; false of measured orientations."""
        static = np.zeros(len(self.names), dtype=np.bool_)
        static[~self._measured] = self._filters.static
        return static

    @property
    def gyro_bias(self) -> np.ndarray:
        """(k, 3) [rad/s] after the last sample; NaN of measured orientations."""
        bias = np.full((len(self.names), 3), np.nan)
        bias[~self._measured] = self._filters.gyro_bias
        return bias

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Add one sample, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost; return `quat_WL` (k, 4).

        Of a sensor with measured orientations they hold what `pack_orientations` gives.
        """
        if self._measured.any():
            accel_S = self._take_measured(gyro_S, accel_S)
        else:
            self._recent[self._oldest] = self._filters.step(gyro_S, accel_S)
        newest = self._recent[self._oldest : self._oldest + 1]
        _place_segments(self._quat_WV, self._correction(), newest, self._quat_LS, self.quat_WL, self.quat_WL[None])
        self._oldest = (self._oldest + 1) % len(self._recent)
        if self.headings is not None:
            self._variance = self.headings.variance  # of this sample, as in `_place`
            if self.headings.push(newest, accel_S[None]):
                self.headings.close(self._read_filter_headings())
        return self.quat_WL

    def _take_measured(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Add one sample of which some are measured; return `accel_S`, zero where there is none."""
        row, before, measured = self._recent[self._oldest], self._recent[self._oldest - 1], self._measured
        quat_VS = unpack_orientations(gyro_S, accel_S)
        lost = ~np.isfinite(quat_VS).all(axis=1)
        self._lost = np.where(lost & measured, self._lost + 1, 0)
        orientations = np.where(lost[:, None], before, quat_VS)
        if not measured.all():
            orientations[~measured] = self._filters.step(gyro_S[~measured], accel_S[~measured])
        row[:] = orientations
        return np.where((measured & ~lost)[:, None], 0.0, accel_S)

    def _correction(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return what `_place_segments` fades in: from and to (k,) [rad], the next sample's number, their number."""
        if self.headings is None:
            return self._uncorrected, self._uncorrected, 0, 1
        return self.headings.fade

    def _find_marks(self, chunk: Recording) -> dict[int, list[tuple[str, bool]]]:
        """Find sample → phases that begin (True) or have ended with it, of those that headings are corrected by."""
        marks: dict[int, list[tuple[str, bool]]] = {}
        for phase in () if self.headings is None else sorted(self.headings.phases):
            inside = np.zeros(len(chunk), dtype=bool)
            for interval in chunk.phases.get(phase, ()):
                inside[chunk.span(interval)] = True
            for sample in (0, *(np.flatnonzero(np.diff(inside)) + 1).tolist()):
                marks.setdefault(sample, []).append((phase, bool(inside[sample])))
        return marks

    def mark_phase(self, phase: str, *, begins: bool) -> None:
        """Mark that a phase, such as `clasp`, begins with the next sample, or has ended before it."""
        if self.headings is not None:
            self.headings.mark(phase, begins=begins)

    def _place_chunk(self, chunk: Recording, orientation: Mapping[str, Orientation]) -> SegmentOrientations:
        """Return the segment orientations of a filtered chunk without resets."""
        quat_VS = self._stack_orientations(chunk, orientation)
        quat_WL = np.empty(quat_VS.shape)
        variance = self._place(chunk, orientation, quat_VS, quat_WL)
        size = len(self._recent) or max(1, round(RESET_S * self.rate_hz))
        self._recent, self._oldest = np.concatenate([self._order_recent(), quat_VS[-size:]])[-size:], 0
        covs = {name: o.attitude_cov for name, o in orientation.items() if o.attitude_cov is not None}
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, OrientationSensor):
                lost = count_lost_samples(sensor, self._lost[i])
                covs[name], self._lost[i] = compute_measured_covariance(lost / self.rate_hz), lost[-1]
        by_name = {name: quat_WL[:, i] for i, name in enumerate(self.names)}
        soft = compute_soft_tissue_covariances(self._start_pose.table, by_name) if covs else {}
        return SegmentOrientations(
            recording=chunk,
            options=self._options,
            quat_WL=by_name,
            quat_LS=dict(zip(self.names, self._quat_LS, strict=True)),
            heading_offset=dict(zip(self.names, self.heading_offset.tolist(), strict=True)),
            orientation=orientation,
            covariance_W={
                name: self._covariance_W(i, quat_VS[:, i], covs[name], variance[:, :, i]) + soft[name]
                for i, name in enumerate(self.names)
                if name in covs
            },
            start=self._phases.start,
            static_phase=self._phases.static,
            diagnostics=self.diagnostics,
        )

    def _stack_orientations(self, chunk: Recording, orientation: Mapping[str, Orientation]) -> np.ndarray:
        """Stack `quat_VS` (n, k, 4) of all sensors."""
        columns = []
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, ImuSensor):
                columns.append(orientation[name].quat_VS)
                continue
            quat_VS = sensor.quat_VS
            if self._options.causal and sensor.gap is not None and sensor.gap.any():
                before = self._recent[self._oldest - 1, i] if len(self._recent) else quat_VS[0]
                known = np.concatenate([[True], ~sensor.gap])
                last = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
                quat_VS = np.concatenate([before[None], quat_VS])[last][1:]
            columns.append(quat_VS)
        return np.stack(columns, axis=1)

    def _place(
        self, chunk: Recording, orientation: Mapping[str, Orientation], quat_VS: np.ndarray, quat_WL: np.ndarray
    ) -> np.ndarray:
        """Fill `quat_WL` (n, k, 4), knot by knot; return `CausalHeadings.variance` (n, 3, k) [rad²] of each sample."""
        n = len(chunk)
        variance = np.tile(self._variance, (n, 1, 1))
        if self.headings is None:
            _place_segments(self._quat_WV, self._correction(), quat_VS, self._quat_LS, self.quat_WL, quat_WL)
            return variance
        accel_S = np.stack([find_specific_force(chunk, name) for name in self.names], axis=1)
        begin = 0
        while begin < n:
            end = min(n, begin + self.headings.remaining)
            rows = slice(begin, end)
            _place_segments(
                self._quat_WV, self._correction(), quat_VS[rows], self._quat_LS, self.quat_WL, quat_WL[rows]
            )
            variance[rows] = self.headings.variance
            if self.headings.push(quat_VS[rows], accel_S[rows]):
                self.headings.close(read_filter_headings(orientation, self.names, end - 1), record=True)
            begin = end
        return variance

    def reset_headings(self) -> None:
        """Reset the headings: the body has stood in the start pose again for `RESET_S`."""
        recent = self._order_recent()
        same_sign = recent * np.sign(np.einsum("nki,ki->nk", recent, recent[-1]))[:, :, None]
        mean = same_sign.sum(axis=0)
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        offset = np.zeros(len(self.names))
        for i in range(len(self.names)):
            R_WS_start = self._start_pose.to_world(self.names[i], Rotation.from_quat(self._quat_LS[i]))
            offset[i] = compute_heading_offset(Rotation.from_quat(mean[i]), R_WS_start)
        self.heading_offset = offset
        if self.headings is not None:
            self._quat_WV = _quat_about_z(self.headings.offset)
            self.headings.reset(offset)
            self._variance = self.headings.variance
            return
        self._quat_WV, var = _quat_about_z(offset), self.heading_var()
        if var is not None:  # as after the start pose: what the filters have added since is gone
            start_var = np.array([self._find_start_var(name) for name in self.names])
            self._variance = start_var, var, np.full(len(var), np.inf)

    def _find_start_var(self, name: str) -> float:
        return compute_start_heading_var(self._first, name, self._subject, self._start_pose)

    def heading_var(self) -> np.ndarray | None:
        """Return the variance (k,) [rad²] of each heading by its filter alone now, NaN without a filter.

        None: no filter has a covariance.
        """
        cov = self._filters.attitude_cov
        if cov is None:
            return None
        variance = np.full(len(self.names), np.nan)
        variance[~self._measured] = compute_heading_variance(self._filters.quat_VS, cov)
        return variance

    def _read_filter_headings(self) -> FilterHeadings:
        """Read what the filters say of their headings after a step."""
        var, about_vertical = self.heading_var(), np.full((len(self.names), len(AboutVertical._fields)), np.nan)
        if self._filters.about_vertical is not None:
            about_vertical[~self._measured] = self._filters.about_vertical
        return FilterHeadings(np.full(len(self.names), np.nan) if var is None else var, *about_vertical.T)

    def covariance(self) -> np.ndarray:
        """Return the covariances (k, 3, 3) [rad²] of the segments in W after the last step, mounts included.

        NaN where the filter has none.
        """
        return [covariance for covariance in self.covariance_gradually() if covariance is not None][-1]

    def covariance_gradually(self) -> Iterator[np.ndarray | None]:
        """Do as `covariance`, in parts of less than half a millisecond; only the last one is not None.

        There may be steps between the parts: the result is that of the step before the first one.
        """
        cov = np.full((len(self.names), 3, 3), np.nan)
        cov[self._measured] = compute_measured_covariance(self._lost[self._measured] / self.rate_hz)
        attitude_cov = self._filters.attitude_cov
        if attitude_cov is not None:
            cov[~self._measured] = attitude_cov
        if np.isfinite(cov).any():
            newest = self._recent[self._oldest - 1].copy()
            variance = np.array(self._variance)
            soft = compute_soft_tissue_covariances(
                self._start_pose.table, {name: self.quat_WL[i : i + 1] for i, name in enumerate(self.names)}
            )
            yield None
            for i, name in enumerate(self.names):
                parts = newest[i : i + 1], cov[i : i + 1], variance[None, :, i]
                cov[i] = (self._covariance_W(i, *parts) + soft[name])[0]
                yield None
        yield cov

    def _covariance_W(self, i: int, quat_VS: np.ndarray, attitude_cov: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3, 3) [rad²] of sensor i's segment, error on the left of `quat_WL`, in W.

        It lacks soft tissue. `variance` (n, 3) [rad²] is `CausalHeadings.variance` of the sensor.
        """
        if self._first.sensors[self.names[i]].aligned:
            return attitude_cov
        quat_WS = rotations.multiply(_quat_about_z(self.heading_offset[i : i + 1]), quat_VS)
        R_LS = Rotation.from_quat(self._quat_LS[i])
        cov = compute_segment_covariance(
            self._first, self.names[i], self._subject, quat_WS, R_LS, attitude_cov, self._start_pose
        )
        if np.isnan(variance).any():
            return cov
        start_var = self._find_start_var(self.names[i])
        return correct_covariance(cov, (quat_VS, attitude_cov), self.heading_offset[i], start_var, variance)

    def _order_recent(self) -> np.ndarray:
        return np.concatenate([self._recent[self._oldest :], self._recent[: self._oldest]])


def _quat_about_z(angle: np.ndarray) -> np.ndarray:
    """Return rotations (k, 4) xyzw about z by angles (k,) [rad]."""
    return rotations.exp(angle[:, None] * [0.0, 0.0, 1.0])


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
