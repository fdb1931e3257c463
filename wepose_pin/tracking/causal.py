"""Causal segment orientations from the end of the start pose on, sample by sample or chunk by chunk.

Both use the same compiled steps, so that a live session and its recording give bit-identical quaternions. The start
pose is filtered when it has ended; later samples change no earlier result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import (
    N_POSE,
    SegmentOrientations,
    StartFrames,
    align_sensors,
    check_mounts,
    compute_heading_offset,
    compute_heading_variance,
    compute_measured_covariance,
    compute_segment_covariance,
    compute_soft_tissue_covariances,
    compute_start_heading_var,
    count_lost_samples,
    join_segments,
    orient_segments,
)
from ..compilation import kernel
from ..errors import BadPhase
from ..filters import BEST, AboutVertical, Orientation
from ..filters.bank import LiveBank, OneByOne, create_bank
from ..filters.sensors import SensorFilters, combine_chunk
from ..filters.static import StaticTest
from ..recording import ImuSensor, OrientationSensor, Recording, join_recordings
from ..recording.arrivals import list_numbers, unpack_orientations
from ..rotations import product
from ..subject import Subject
from .heading_observations import undo_corrections
from .heading_problem import FilterHeadings, HeadingProblem
from .headings import (
    CausalHeadings,
    compute_heading_covariance,
    find_specific_force,
    read_filter_headings,
    replace_heading_variance,
    stack_heading_corrections,
)
from .segments import Oriented
from .start_pose import START_POSE_HOLD_S, StartPoseDetector, TickRates, cut_start_pose

# From the recording of the start pose and its orientations: what observes headings; None: nothing.
MakeProblem = Callable[[Recording, SegmentOrientations], HeadingProblem | None]

RESET_S = 0.5  # [s] over which the orientation is averaged when headings are reset


class CausalEstimator:
    """Segment orientations from the end of the start pose on, chunk by chunk (`push`) or sample by sample (`step`).

    It finds the start pose: `phases.start`, or the first `START_POSE_HOLD_S` in which nothing moves. From there on a
    `CausalSegmentEstimator` does the work. Headings are reset at each of `Recording.resets`. An estimator that was
    stepped takes no more chunks.

    Parameters
    ----------
    subject : lengths and mounts; None for the session's stated mounts
    start_frames : of the body; left out: the N-pose
    make_problem : called after the start pose, see `headings.make_heading_problem`; None: headings are not corrected
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        start_frames: StartFrames = N_POSE,
        method: str = BEST,
        static_test: StaticTest | None = None,
        make_problem: MakeProblem | None = None,
    ) -> None:
        self._subject, self._start_frames, self._method, self._static_test = subject, start_frames, method, static_test
        self._make_problem = make_problem
        self._received: Recording | None = None  # samples up to the end of the start pose
        self._start_detector: StartPoseDetector | None = None
        self._rates: TickRates | None = None
        self._segment_estimator: CausalSegmentEstimator | None = None
        self._tracked = False

    @property
    def segment_estimator(self) -> CausalSegmentEstimator:
        """The estimator of the segment orientations after the start pose, for single samples.

        Raises
        ------
        BadPhase
            The start pose has not ended.
        """
        if self._segment_estimator is None:
            raise BadPhase("the start pose has not ended: push a recording that includes it")
        return self._segment_estimator

    @property
    def headings(self) -> CausalHeadings | None:
        """What corrects the headings; None: nothing does, or the start pose has not ended."""
        return None if self._segment_estimator is None else self._segment_estimator.headings

    def push(self, chunk: Recording) -> Oriented | None:
        """Add a chunk; return its part after the start pose with its segment orientations; None: there is no such part.

        Raises
        ------
        WeposeError
            A sensor without a known mount; as `SensorFilters`.
        """
        if self._segment_estimator is None:
            chunk = self._find_start(chunk)
        if self._segment_estimator is None or not len(chunk):
            return None
        self._tracked = True
        return chunk, self._segment_estimator.run(chunk)

    def finish(self) -> None:
        """Check that something was tracked.

        Raises
        ------
        BadPhase
            There was no start pose, or nothing after it.
        """
        if self._tracked:
            return
        recording = self._received
        if self._segment_estimator is None and self._start_detector is not None and recording is not None:
            raise BadPhase(
                f"{recording.where()}: no start pose of {START_POSE_HOLD_S:g} s without motion "
                f"({self._start_detector.held_s:.1f} s at its end); state the seconds of the start pose, "
                f"[phases] start = [[from, to]]"
            )
        where = "" if recording is None else f"{recording.where()}: "
        raise BadPhase(f"{where}phases.start ends with the recording; nothing is left to track")

    def _find_start(self, chunk: Recording) -> Recording:
        """Return the part of a chunk after the start pose; the whole chunk while the start pose has not ended."""
        received = chunk if self._received is None else join_recordings(self._received, chunk)
        self._received = received
        if received.phases.get("start"):
            interval = received.phases["start"][0]
            if received.time[-1] < interval[1] - 1e-9:
                return chunk
            last = received.span(interval).stop
        else:
            if self._start_detector is None or self._rates is None:
                self._start_detector = StartPoseDetector(received.rate_hz, len(received.sensors))
                self._rates = TickRates(find_measured(received), received.rate_hz)
            for gyro_S, accel_S in zip(*stack_ticks(chunk), strict=True):
                if self._start_detector.push(self._rates.push(gyro_S, accel_S)) == "ready":
                    break
            else:
                return chunk
            interval = float(received.time[self._start_detector.begin]), float(received.time[self._start_detector.end])
            last = self._start_detector.end + 1
        start = replace(cut_start_pose(received, interval), start_is_guessed=not received.phases.get("start"))
        self._segment_estimator = CausalSegmentEstimator(
            start,
            self._subject,
            start_frames=self._start_frames,
            method=self._method,
            static_test=self._static_test,
            make_problem=self._make_problem,
        )
        return received.cut(slice(last, len(received)))


def find_measured(recording: Recording) -> np.ndarray:
    """Find (k,) bool the sensors with measured orientations."""
    return np.array([isinstance(sensor, OrientationSensor) for sensor in recording.sensors.values()], dtype=np.bool_)


def stack_ticks(chunk: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Stack the six numbers of all sensors as ticks have them, (n, k, 3) each, orientations packed; bridged in gaps."""
    numbers = [list_numbers(sensor) for sensor in chunk.sensors.values()]
    gyro_S, accel_S = (np.stack(column, axis=1) for column in zip(*numbers, strict=True))
    return gyro_S, accel_S


class CausalSegmentEstimator:
    """Estimates segment orientations after a start pose; k sensors in the order of `names`.

    A sensor with measured orientations has no filter; while it is lost, its last orientation stands.

    Parameters
    ----------
    start_recording : a recording that ends with its start pose, `phases.start`
    subject : lengths and mounts; None for the session's stated mounts
    start_frames : of the body; left out: the N-pose
    make_problem : called after the start pose, see `headings.make_heading_problem`; None: headings are not corrected

    Attributes
    ----------
    start : `SegmentOrientations` of the start pose: mounts, headings, diagnostics
    heading_offset : (k,) ψ [rad], heading of each sensor's world V in W at the start or the last reset
    headings : what corrects the headings; None: nothing does
    quat_WL, static, gyro_bias : (k, 4) xyzw, (k,), (k, 3) [rad/s] after the last step; overwritten by the next
    """

    def __init__(
        self,
        start_recording: Recording,
        subject: Subject | None = None,
        *,
        start_frames: StartFrames = N_POSE,
        method: str = BEST,
        static_test: StaticTest | None = None,
        make_problem: MakeProblem | None = None,
    ) -> None:
        check_mounts(start_recording, subject, start_frames)
        self._filters = SensorFilters(start_recording, method=method, static_test=static_test, sways=start_frames.sways)
        orientation = self._filters.push(start_recording)
        filtered = combine_chunk(self._filters, start_recording, orientation)
        alignment = align_sensors(start_recording, subject, filtered, start_frames)
        self.start = orient_segments(start_recording, alignment, orientation, subject, start_frames)
        self.names = tuple(start_recording.sensors)
        self.rate_hz = start_recording.rate_hz
        self._measured = find_measured(start_recording)
        self._lost = np.zeros(len(self.names), dtype=int)  # samples since a measured orientation
        self._all_measured, self._any_measured = bool(self._measured.all()), bool(self._measured.any())
        self._bank: LiveBank | OneByOne | None = None
        if not self._all_measured:
            started = [orientation[name] for name in self.names if name in orientation]
            self._bank = create_bank(
                [filtered.filter for filtered in started if filtered.filter is not None],
                [filtered.detector for filtered in started if filtered.detector is not None],
            )
        self._start_recording, self._subject, self._start_frames = start_recording, subject, start_frames
        self._quat_LS = np.array([self.start.quat_LS[name] for name in self.names])
        self.heading_offset = np.array([self.start.heading_offset[name] for name in self.names])
        self._quat_WV = _quat_about_z(self.heading_offset)
        self._recent = np.empty((0, len(self.names), 4))
        self._recent = self._stack_orientations(start_recording, orientation)[
            -max(1, round(RESET_S * self.rate_hz)) :
        ].copy()
        self._oldest = 0  # row of `_recent` with the oldest sample
        self.quat_WL = np.zeros((len(self.names), 4))
        self._uncorrected = np.zeros(len(self.names))
        self._filter_corrections = np.zeros((1, len(self.names)))  # [rad] of the last step, contiguous as in `_run`
        _place_segments(
            self._quat_WV,
            (self._uncorrected, self._uncorrected, 0, 1),
            self._recent[-1:],
            self._quat_LS,
            self.quat_WL,
            self.quat_WL[None].copy(),
        )
        problem = None if make_problem is None else make_problem(start_recording, self.start)
        self.headings = None if problem is None else CausalHeadings(start_recording, self.start, problem)
        unknown = np.full(len(self.names), np.nan)
        self._variance = (unknown,) * 3 if self.headings is None else self.headings.variance  # of the last step
        self._run_var = self.heading_var()  # (k,) [rad²] of each heading by its filter alone, after the last run
        self._var_at_reset: np.ndarray | None = None  # (k,) [rad²] of heading that a reset took away

    @property
    def static(self) -> np.ndarray:
        static = np.zeros(len(self.names), dtype=np.bool_)
        if self._bank is not None:
            static[~self._measured] = self._bank.static
        return static

    @property
    def gyro_bias(self) -> np.ndarray:
        bias = np.full((len(self.names), 3), np.nan)
        if self._bank is not None:
            bias[~self._measured] = self._bank.gyro_bias
        return bias

    def _stack_orientations(self, chunk: Recording, orientation: Mapping[str, Orientation]) -> np.ndarray:
        """Stack `quat_VS` (n, k, 4) of all sensors; in a gap that was measured last stands."""
        columns = []
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, ImuSensor):
                columns.append(orientation[name].quat_WS)
                continue
            quat_VS = sensor.quat_WS
            if sensor.gap is not None and sensor.gap.any():
                before = self._recent[self._oldest - 1, i] if len(self._recent) else quat_VS[0]
                known = np.concatenate([[True], ~sensor.gap])
                last = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
                quat_VS = np.concatenate([before[None], quat_VS])[last][1:]
            columns.append(quat_VS)
        return np.stack(columns, axis=1)

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Add one sample, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost; return `quat_WL` (k, 4).

        Of a sensor with measured orientations they hold what `pack_orientations` gives.
        """
        if self._any_measured:
            accel_S = self._take_measured(gyro_S, accel_S)
        elif self._bank is not None:
            self._recent[self._oldest] = self._bank.update(gyro_S, accel_S)
        newest = self._recent[self._oldest : self._oldest + 1]
        if self.headings is not None and self._bank is not None and self._bank.about_vertical is not None:
            self._filter_corrections[0, ~self._measured] = self._bank.about_vertical[:, 0]
            undo_corrections(newest, self._filter_corrections, self.headings.at_start)
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
        if self._bank is not None:
            orientations[~measured] = self._bank.update(gyro_S[~measured], accel_S[~measured])
        row[:] = orientations
        return np.where((measured & ~lost)[:, None], 0.0, accel_S)

    def _correction(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return what `_place_segments` fades in: from and to (k,) [rad], the next sample's number, their number."""
        if self.headings is None:
            return self._uncorrected, self._uncorrected, 0, 1
        return self.headings.fade

    def run(self, chunk: Recording) -> SegmentOrientations:
        """Return the segment orientations of a chunk, bit-identical with as many steps."""
        resets = {tick for tick in chunk.resets if 0 <= tick < len(chunk)}
        marks = self._find_marks(chunk)
        parts = []
        for begin, end in pairwise(sorted({0, *resets, *marks, len(chunk)})):
            if begin in resets:
                self.reset_headings(self._run_var)
            for phase, begins in marks.get(begin, ()):
                self.mark_phase(phase, begins=begins)
            parts.append(self._run(chunk.cut(slice(begin, end))))
        return parts[0] if len(parts) == 1 else join_segments(parts)

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

    def _run(self, chunk: Recording) -> SegmentOrientations:
        """Return the segment orientations of a chunk without resets."""
        orientation = self._filters.push(chunk)
        quat_VS = self._stack_orientations(chunk, orientation)
        if self.headings is not None:
            corrections = stack_heading_corrections(orientation, self.names, len(chunk))
            undo_corrections(quat_VS, corrections, self.headings.at_start)
        quat_WL = np.empty(quat_VS.shape)
        variance = self._place(chunk, orientation, quat_VS, quat_WL)
        self._recent = np.concatenate([self._order_recent(), quat_VS])[-len(self._recent) :].copy()
        self._oldest = 0
        covariance_W = {}
        covs = {name: o.attitude_cov for name, o in orientation.items() if o.attitude_cov is not None}
        if covs:
            self._run_var = read_filter_headings(orientation, self.names, len(chunk) - 1).var
        for i, (name, sensor) in enumerate(chunk.sensors.items()):
            if isinstance(sensor, OrientationSensor):
                lost = count_lost_samples(sensor, self._lost[i])
                covs[name], self._lost[i] = compute_measured_covariance(lost / self.rate_hz), lost[-1]
        if covs:
            soft = compute_soft_tissue_covariances(
                self._start_frames.table, {name: quat_WL[:, i] for i, name in enumerate(self.names)}
            )
            covariance_W = {
                name: self._covariance_W(i, quat_VS[:, i], covs[name], variance[:, :, i]) + soft[name]
                for i, name in enumerate(self.names)
                if name in covs
            }
        return replace(
            self.start,
            time=chunk.time,
            quat_WL={name: quat_WL[:, i] for i, name in enumerate(self.names)},
            heading_offset={name: float(self.heading_offset[i]) for i, name in enumerate(self.names)},
            orientation=orientation,
            covariance_W=covariance_W,
        )

    def _place(
        self, chunk: Recording, orientation: Mapping[str, Orientation], quat_VS: np.ndarray, quat_WL: np.ndarray
    ) -> np.ndarray:
        """Fill `quat_WL` (n, k, 4), knot by knot; return `CausalHeadings.variance` (n, 3, k) [rad²] of each sample.

        It is NaN where headings are not corrected.
        """
        n = len(chunk)
        variance = np.full((n, 3, len(self.names)), np.nan)
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

    def reset_headings(self, heading_var: np.ndarray | None = None) -> None:
        """Reset the headings: the body has stood in the start pose again for `RESET_S`.

        Parameters
        ----------
        heading_var : (k,) [rad²] the filters' variance of the heading up to the reset; None for that of the last step
        """
        recent = self._order_recent()
        same_sign = recent * np.sign(np.einsum("nki,ki->nk", recent, recent[-1]))[:, :, None]
        mean = same_sign.sum(axis=0)
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        offset = np.zeros(len(self.names))
        for i in range(len(self.names)):
            R_WS_start = self._start_frames.to_world(self.names[i], Rotation.from_quat(self._quat_LS[i]))
            offset[i] = compute_heading_offset(Rotation.from_quat(mean[i]), R_WS_start)
        self.heading_offset = offset
        if self.headings is not None:
            self._quat_WV = _quat_about_z(self.headings.offset)
            self.headings.reset(offset)
            self._variance = self.headings.variance
            return
        self._quat_WV = _quat_about_z(offset)
        self._var_at_reset = heading_var if heading_var is not None else self.heading_var()

    def heading_var(self) -> np.ndarray | None:
        """Return the variance (k,) [rad²] of each heading by its filter alone after a step, NaN without a filter.

        None: no filter has a covariance.
        """
        cov = None if self._bank is None else self._bank.attitude_cov
        if self._bank is None or cov is None:
            return None
        variance = np.full(len(self.names), np.nan)
        variance[~self._measured] = compute_heading_variance(self._bank.quat_WS, cov)
        return variance

    def _read_filter_headings(self) -> FilterHeadings:
        """Read what the filters say of their headings after a step."""
        var, about_vertical = self.heading_var(), np.full((len(self.names), len(AboutVertical._fields)), np.nan)
        filtered = None if self._bank is None else self._bank.about_vertical
        if filtered is not None:
            about_vertical[~self._measured] = filtered
        return FilterHeadings(
            np.full(len(self.names), np.nan) if var is None else var, AboutVertical(*about_vertical.T)
        )

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
        filtered = None if self._bank is None else self._bank.attitude_cov
        if filtered is not None:
            cov[~self._measured] = filtered
        if np.isfinite(cov).any():
            newest = self._recent[self._oldest - 1].copy()
            variance = np.array(self._variance)
            soft = compute_soft_tissue_covariances(
                self._start_frames.table, {name: self.quat_WL[i : i + 1] for i, name in enumerate(self.names)}
            )
            yield None
            for i, name in enumerate(self.names):
                parts = newest[i : i + 1], cov[i : i + 1], variance[None, :, i]
                cov[i] = (self._covariance_W(i, *parts) + soft[name])[0]
                yield None
        yield cov

    def _covariance_W(self, i: int, quat_VS: np.ndarray, attitude_cov: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3, 3) [rad²] of sensor i's segment, error on the left of `quat_WL`, in W.

        `variance` (n, 3) [rad²] is `CausalHeadings.variance` of the sensor.

        As `alignment.compute_segment_covariance`; after a reset the heading's error is that of the start pose and the
        drift since.
        """
        if self._start_recording.sensors[self.names[i]].aligned:
            return attitude_cov
        quat_WS = rotations.multiply(_quat_about_z(self.heading_offset[i : i + 1]), quat_VS)
        R_LS = Rotation.from_quat(self._quat_LS[i])
        cov = compute_segment_covariance(
            self._start_recording, self.names[i], self._subject, quat_WS, R_LS, attitude_cov, self._start_frames
        )
        if self.headings is not None:
            R_VS = Rotation.from_quat(quat_VS)
            R_WV = Rotation.from_rotvec([0.0, 0.0, self.heading_offset[i]])
            with_heading = compute_heading_covariance(R_VS, attitude_cov)
            start = compute_start_heading_var(self._start_recording, self.names[i], self._subject, self._start_frames)
            var = with_heading[:, 2]
            grown = np.maximum(var - variance[:, 1], 0.0)
            # The filter alone may know the heading better; to it a correction is an error of that size.
            corrected = np.minimum(variance[:, 0] + grown, var + start + variance[:, 2])
            cov = replace_heading_variance(cov, R_WV.apply(with_heading), var + start, corrected)
        if self._var_at_reset is not None and np.isfinite(self._var_at_reset[i]):
            var = compute_heading_variance(quat_VS, attitude_cov)
            grown = np.maximum(0.0, var - self._var_at_reset[i])
            # The mount's part of the heading stays: the reset has set that of the start pose alone.
            of_mount = np.maximum(cov[:, 2, 2] - var, 0.0)
            start_var = self._start_frames.repeat_std(self.names[i])[2] ** 2
            std_ratio = np.sqrt((of_mount + grown + start_var) / cov[:, 2, 2])
            cov[:, 2, :] *= std_ratio[:, None]
            cov[:, :, 2] *= std_ratio[:, None]
        return cov

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
