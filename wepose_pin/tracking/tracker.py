"""`Tracker`: recording and subject → pose, chunk by chunk or sample by sample: filter, align, correct headings, solve.

Chunks and single samples go through the same compiled steps, so that a live session and its recording give
bit-identical quaternions.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..arguments import check_names
from ..body import BodyModel
from ..body.body import load_sensed_model
from ..body.configuration import KinematicsSolver
from ..body.kinematics import compute_point_covariances
from ..body.mounts import (
    MEASURED_ORIENTATION_STD,
    align_sensors,
    collect_nominal_mounts,
    compute_heading_offset,
    find_start_pose,
)
from ..body.soft_tissue import make_correction
from ..body.subject import Subject, population_subject
from ..body.table import check_segments
from ..compilation import kernel
from ..diagnostics import drop_consequences
from ..errors import BadOption, BadPhase, BadSession
from ..filters import BEST, METHODS, OFFLINE, Orientation, SensorFilters, average_start, collect_orientations
from ..filters.base import HEADING, HOLD_S, LOST_RATE_STD, MOST_LOST_STD
from ..filters.phases import BEGINNING_S, find_reference_phases
from ..filters.static import StaticTest
from ..recording import ImuSensor, Recording, Sensor, join_recordings
from ..recording.arrivals import unpack_orientations
from ..recording.clocks import LONGEST_GAP_S
from ..rotations import product
from .heading_filter import CLASP, HeadingFilter
from .headings import E_Z, HeadingCorrection, HeadingCorrector
from .result import TrackResult
from .segment_orientations import (
    SegmentOrientations,
    compute_heading_variance,
    compute_segment_covariance,
    compute_soft_tissue_covariance,
)
from .start_pose import START_POSE_HOLD_S, split_start_pose

CHUNK_S = 600.0  # of `track_chunks`
SHORTEST_S = 2.0  # of a chunk: a filter's first window has to fit
RESET_S = 0.5  # [s] over which the orientation is averaged when headings are reset
# What the filters of a chunk state, and of its n samples and k segments: `quat_VS` (n, k, 4) and the attitude's
# covariance as in `Tracker._stack`, `quat_WL` (n, k, 4), ψ (n, k) [rad], `HeadingCorrector.variance` (n, 3, k), and
# the time (n, k) [s] since a sample that was measured.
_Placed = tuple[Mapping[str, Orientation], tuple[np.ndarray, ...]]


class Tracker:
    """Tracks the body of a recording that comes in chunks; the whole recording may be one chunk.

    `push` returns the pose of a chunk where nothing later changes it: of a causal tracker, and where nothing observes
    headings. Other chunks are returned by `smooth`, after the heading correction has seen all of them: the tracker
    keeps their samples and filters them again, so that its memory holds the results of one chunk. After its start pose
    a causal tracker takes single samples as well, by `step`, with the same bits.

    All chunks of a recording carry its phases; `start` and `static` are in the first, unless the tracker is causal. The
    smoother takes the whole recording as one chunk; the results of other filters do not depend on the chunks. A sensor
    with measured orientations has no filter; where it is lost its last one stands causally, else the reader has
    interpolated.

    Parameters
    ----------
    subject : lengths and mounts; None: the population prior and the mounts that the session states
    model : a body, its file, or the name of a body of the package, scaled to the subject's lengths; None: the one that
        the recording names, else the upper body. Without a subject a model that is given or named keeps its own lengths
    method, static_test, open_loop, causal : as in `track`

    Attributes
    ----------
    options : the last five by their names
    names : the k segments; this and what follows from the first chunk on, of a causal tracker from its start pose on
    diagnostics : of the recording, its start pose and its mounts
    quat_WL : (k, 4) xyzw after the last sample; overwritten by the next one
    static : (k,) bool: static by the filter's test at the last step; false of measured orientations
    gyro_bias : (k, 3) [rad/s] after the last sample; NaN of measured orientations
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        model: BodyModel | str | Path | None = None,
        method: str = BEST,
        static_test: StaticTest | None = None,
        open_loop: bool = False,
        causal: bool = False,
    ) -> None:
        check_names("method", [method], METHODS)
        if causal and method in OFFLINE:
            raise BadOption(f"method '{method}' needs the whole recording; 'amekf' looks at nothing ahead")
        self.options = {"method": method, "static_test": static_test, "open_loop": open_loop}
        self.options |= {"causal": causal}
        self._method, self._static_test, self._causal = method, static_test, causal
        self._subject, self._model, self._observes_headings = subject, model, not open_loop
        self._where = ""  # begins an error's text; empty before the first chunk
        self._kinematics: KinematicsSolver | None = None
        self.names: tuple[str, ...] = ()
        self._headings: HeadingCorrector | None = None
        # Chunks that wait: causally for the end of the start pose, joined; offline for the headings.
        self._chunks: list[Recording] = []
        self._only: _Placed | None = None  # of the first chunk, while it is the only one

    def push(self, chunk: Recording) -> TrackResult | None:
        """Add the next chunk; return it with its pose; None: `smooth` returns it, or the start pose has not ended.

        It raises `WeposeError` where the recording, the subject or the model lacks something that is needed.
        """
        if not self._where:
            self._fit_body(chunk)
        is_first, self._where = not self.names, f"{chunk.where()}: "
        if chunk.resets and not (self._causal and self._observes_headings):
            chunk = replace(chunk, resets=())
        if not is_first and self._method in OFFLINE:
            raise BadOption(f"method '{self._method}' takes the whole recording as one chunk")
        if is_first and self._causal:
            self._chunks = [join_recordings(self._chunks[0], chunk) if self._chunks else chunk]
            parts = split_start_pose(self._chunks[0])
            if parts is None:
                return None
            start, chunk = parts
            self._chunks = []
            self._place(start)
        if not len(chunk):
            return None
        placed = self._place(chunk)
        if self._headings is None or self._causal:
            return self._solve_pose(chunk, placed, None if self._headings is None else self._headings.collect())
        self._chunks.append(chunk)
        self._only = placed if is_first else None
        return None

    def smooth(self) -> Iterator[TrackResult]:
        """Iterate over the chunks that `push` did not return, after the last one has been pushed.

        It raises `BadPhase` where a causal tracker was given no start pose, or nothing after it.
        """
        if self._causal and self._kinematics is None:
            if self._chunks and not self._chunks[0].phases.get("start"):
                raise BadPhase(
                    f"{self._where}no start pose of {START_POSE_HOLD_S:g} s without motion; state the seconds of the "
                    f"start pose, [phases] start = [[from, to]]"
                )
            raise BadPhase(f"{self._where}phases.start ends with the recording; nothing is left to track")
        if self._causal or self._headings is None:
            return
        correction = self._headings.smooth(self._filter_headings, self._end_s)
        self._headings, self._observes_headings = None, False
        if self._only is None:
            self.names = ()  # the filters begin again
        for chunk in self._chunks:
            yield self._solve_pose(chunk, self._only or self._place(chunk), correction)

    def _fit_body(self, first: Recording) -> None:
        """Find the body of a recording, with the subject's lengths, and its segment frames in the start pose.

        The body is the chosen one, else the one that the recording names, else the upper body. Without a subject the
        lengths are those of the population prior, or of a chosen model its own.
        """
        where, chosen, subject = first.where(), self._model or first.model or None, self._subject
        body = chosen if isinstance(chosen, BodyModel) else load_sensed_model(chosen, first.sensors, where)
        check_segments(body.table, first.sensors, f"{where}: sensors.", BadSession)
        start_pose = find_start_pose(body, first)
        person = subject or population_subject(body=body)
        person.check_body(body.table)
        if subject is None and chosen is not None:  # a chosen model has its person's lengths
            person = replace(person, name=body.robot.name, lengths=body.lengths, note="lengths of the model")
        self._person, self._body = person, person.shape(body, remounted=first.remounted)
        table = self._body.personal_table
        self._start_pose = replace(start_pose, table=table)

    # Orientations of segments ----------------------------------------------------------------------------------------

    def _begin(self, first: Recording) -> Mapping[str, Orientation]:
        """Filter and align the first chunk."""
        collect_nominal_mounts(first, self._subject, self._start_pose)  # an error before anything is filtered
        sways = not self._body.table.is_mechanism
        self._start, self._static_phase, noises, diagnostics = find_reference_phases(first, sways)
        self._filters = SensorFilters(
            noises,
            method=self._method,
            static_test=self._static_test,
            start=first.span(self._start),
            drifts=bool(self.options["open_loop"]),
        )
        orientation = self._filters.push(first)
        R_VS_start = average_start(first, collect_orientations(first, orientation), self._start)
        mounts, offsets, of_mounts, share = align_sensors(
            first, self._subject, R_VS_start, self._start, self._start_pose
        )
        self._start_pose = replace(self._start_pose, repeat_share=share)
        self.diagnostics = tuple(drop_consequences((*diagnostics, *of_mounts)))
        self.names, self._rate_hz, self._first = tuple(first.sensors), first.rate_hz, first.cut(slice(0, 1))
        k = len(self.names)
        self._measured = np.array([name not in first.imus for name in self.names])
        self._lost = np.zeros(k, dtype=int)  # samples since one that was measured
        self._quat_LS = np.array([mounts[name].as_quat() for name in self.names])
        # (k,) ψ [rad], heading of each sensor's world V in W at the start or the last reset
        self._heading_offset = np.array([offsets[name] for name in self.names])
        self._quat_WV = rotations.rotation_about(E_Z, self._heading_offset)
        # `quat_VS` (k, 4) of the last `RESET_S`
        self._recent = deque[np.ndarray](maxlen=max(1, round(RESET_S * first.rate_hz)))
        self.quat_WL = np.zeros((k, 4))
        # [rad²] `HeadingCorrector.variance` at the last step; NaN: the heading's variance is that of its filter
        self._variance = np.full((3, k), np.nan)
        return orientation

    def _place(self, chunk: Recording) -> _Placed:
        """Filter a chunk and place its segments, with headings that are corrected causally."""
        is_first, begin = not self.names, 0
        orientation = self._begin(chunk) if is_first else self._filters.push(chunk)
        n, states = len(chunk), self._stack(chunk, orientation)
        quat_VS, attitude_cov = states[:2]
        if is_first and self._observes_headings and not any(each.aligned for each in chunk.sensors.values()):
            begin = int(np.searchsorted(chunk.time, self._start[1], side="right"))  # first sample after the start pose
            known = _describe_headings(*(values[:begin] for values in states))
            noises = {name: each.noise for name, each in orientation.items()}
            mounts = dict(zip(self.names, self._quat_LS, strict=True))
            heading_filter = HeadingFilter(
                chunk,
                mounts,
                noises,
                self._person,
                self._body,
                known,
                self._start_pose.repeat_share,
                causal=self._causal,
            )
            if heading_filter.is_observed:
                self._headings = HeadingCorrector(heading_filter, self._heading_offset.copy())
                self._variance = self._headings.variance if self._causal else self._variance
        quat_WL, offset = np.empty(quat_VS.shape), np.empty(quat_VS.shape[:2])
        variance = np.empty((*offset.shape, 3))
        before, size = len(self._recent), self._recent.maxlen or 1
        history = np.concatenate([np.reshape(self._recent, (-1, *quat_VS.shape[1:])), quat_VS])
        accel_S = np.stack([_find_specific_force(sensor) for sensor in chunk.sensors.values()], axis=1)
        clasped = np.zeros(n, dtype=bool)
        for interval in chunk.phases.get(CLASP, ()):
            clasped[chunk.span(interval)] = True
        resets = {tick for tick in chunk.resets if 0 <= tick < n and before}  # none before the start pose has ended
        for first, last in pairwise(sorted({0, *resets, min(begin, n), n})):
            if first in resets:
                self._reset(history[max(0, before + first - size) : before + first])
            headings = self._headings if first >= begin else None
            while first < last:
                stop = last if headings is None else min(last, first + headings.remaining)
                rows = slice(first, stop)
                self._place_samples(quat_VS[rows], quat_WL[rows])
                offset[rows], variance[rows] = self._heading_offset, self._variance.T
                if headings is not None:
                    if headings.push(quat_VS[rows], accel_S[rows], clasped[rows]):
                        knot_end = _describe_headings(*(values[rows] for values in states))
                        headings.close(knot_end, float(chunk.time[stop - 1]))
                    if self._causal:
                        self._variance = headings.variance
                first = stop
        self._recent.extend(history[-size:].copy())
        # What the filters know after the last chunk, when it ended, and whether the palms were joined.
        self._filter_headings = _describe_headings(*states)
        self._end_s, self._clasped = float(chunk.time[-1]), bool(clasped[-1])
        lost, samples = np.zeros((n, len(self.names)), dtype=int), np.arange(n)
        for i, sensor in enumerate(chunk.sensors.values()):
            if sensor.gap is not None:
                lost[:, i] = samples - np.maximum.accumulate(np.where(sensor.gap, -1 - self._lost[i], samples))
        self._lost = lost[-1]
        return orientation, (quat_VS, attitude_cov, quat_WL, offset, variance, lost / self._rate_hz)

    def _place_samples(self, quat_VS: np.ndarray, quat_WL: np.ndarray) -> None:
        """Fill `quat_WL` (n, k, 4) of the segments by the sensors' `quat_VS` (n, k, 4)."""
        nothing = np.zeros(len(self.names))
        fade = (nothing, nothing, 0, 1) if self._headings is None else self._headings.fade
        _place_segments(self._quat_WV, fade, quat_VS, self._quat_LS, self.quat_WL, quat_WL)

    def _stack(
        self, chunk: Recording, orientation: Mapping[str, Orientation]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stack what the filters state of a chunk: `quat_VS` (n, k, 4) xyzw, of measured orientations too, the
        attitude's covariance (n, k, 3, 3) [rad²], and `Orientation.about_vertical` (n, k, 3); NaN where there is none.
        """
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
            if self._causal and sensor.gap is not None and sensor.gap.any():
                before = self._recent[-1][i] if self._recent else sensor.quat_VS[0]
                known = np.concatenate([[True], ~sensor.gap])
                last = np.maximum.accumulate(np.where(known, np.arange(n + 1), 0))
                quat_VS[:, i] = np.concatenate([before[None], sensor.quat_VS])[last][1:]
        return quat_VS, attitude_cov, about_vertical

    def _find_covariance(self, i: int, placed: tuple[np.ndarray, ...]) -> np.ndarray | None:
        """Return the covariance (n, 3, 3) [rad²] of sensor i's segment in W, error on the left; None: there is none.

        `placed` is that of `_place`.
        """
        name, (quat_VS, attitude_cov, _, offset, variance, lost_s) = self.names[i], (own[:, i] for own in placed)
        if self._measured[i]:
            # It grows by the motion that may have been missed, as that of the filters.
            missed_std = np.minimum(MOST_LOST_STD, LOST_RATE_STD * lost_s**2 / (lost_s + HOLD_S))
            attitude_cov = (MEASURED_ORIENTATION_STD**2 + missed_std**2)[:, None, None] * np.eye(3)
        if np.isnan(attitude_cov[0, 0, 0]):
            return None
        quat_WL = {each: placed[2][:, k] for k, each in enumerate(self.names)}
        soft = compute_soft_tissue_covariance(self._start_pose.table, quat_WL, name)
        if self._first.sensors[name].aligned:
            return np.asarray(attitude_cov + soft)
        mounting, R_LS = (self._first, name, self._subject, self._start_pose), Rotation.from_quat(self._quat_LS[i])
        lost = lost_s > LONGEST_GAP_S
        return compute_segment_covariance(mounting, R_LS, (quat_VS, attitude_cov), offset, variance, lost) + soft

    def _solve_pose(self, chunk: Recording, placed: _Placed, correction: HeadingCorrection | None) -> TrackResult:
        """Return a chunk with its pose; the correction of a causal tracker is in its headings."""
        orientation, values = placed
        quat_WL, body, covariances = values[2], self._body, {}
        is_smoothed = correction is not None and not self._causal
        if correction is not None and is_smoothed:
            filtered = np.zeros(quat_WL.shape[:2])
            for name, each in orientation.items():
                if each.about_vertical is not None:
                    filtered[:, self.names.index(name)] = each.about_vertical[:, HEADING]
            delta, known = correction.interpolate(chunk.time, filtered)
            variance = np.stack([known, np.full(known.shape, np.inf), delta**2], axis=2)
            variance[:, self._measured] = np.nan
            quat_WL = rotations.multiply(rotations.rotation_about(E_Z, delta), quat_WL)
            values = *values[:2], quat_WL, values[3], variance, values[5]
        for i, name in enumerate(self.names):
            cov = self._find_covariance(i, values)
            if cov is not None:
                covariances[name] = cov
        segments = SegmentOrientations(
            recording=chunk,
            options=self.options,
            quat_WL={name: quat_WL[:, i] for i, name in enumerate(self.names)},
            quat_LS=dict(zip(self.names, self._quat_LS, strict=True)),
            heading_offset=dict(zip(self.names, self._heading_offset.tolist(), strict=True)),
            orientation=orientation,
            start=self._start,
            static_phase=self._static_phase,
            diagnostics=self.diagnostics,
        )
        if self._kinematics is None:
            start = self._start_pose.q
            self._kinematics = KinematicsSolver(body, self.names, start=start)
        pose = self._kinematics.solve_chunk(chunk.time, make_correction(body, self.names)(quat_WL))
        shape_cov = self._person.shape_covariance(body.table)
        shared = {} if correction is None else correction.correlate_segments(chunk.time, covariances)
        point_cov = compute_point_covariances(body, pose.quat_WL, covariances, shape_cov, pose.q, shared)
        gap = {name: sensor.gap for name, sensor in chunk.sensors.items() if sensor.gap is not None}
        pose = replace(pose, segment_cov=covariances, heading_cov=shared, point_cov=point_cov, gap=gap)
        return TrackResult(chunk.name, pose, body, self._person, chunk.phases, segments, correction)

    # Single samples --------------------------------------------------------------------------------------------------

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Add one sample, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost; return `quat_WL` (k, 4).

        Of a sensor with measured orientations they hold what `pack_orientations` gives. The orientations are without
        the correction by soft tissue and by the body's joints.
        """
        quat_VS, lost = np.empty(self.quat_WL.shape), ~np.isfinite(gyro_S).all(axis=1)
        self._lost = np.where(lost, self._lost + 1, 0)
        if self._measured.any():
            measured = unpack_orientations(gyro_S, accel_S)
            quat_VS[:] = np.where(lost[:, None], self._recent[-1], measured)
            if not self._measured.all():
                quat_VS[~self._measured] = self._filters.step(gyro_S[~self._measured], accel_S[~self._measured])
            accel_S = np.where((self._measured & ~lost)[:, None], 0.0, accel_S)
        else:
            quat_VS[:] = self._filters.step(gyro_S, accel_S)
        self._recent.append(quat_VS)
        self._place_samples(quat_VS[None], self.quat_WL[None])
        if self._headings is not None:
            self._variance = self._headings.variance  # of this sample, as in `_place`
            if self._headings.push(quat_VS[None], accel_S[None], self._clasped):
                self._headings.close(_describe_headings(*self._read_filters()))
        return self.quat_WL

    def compute_covariance(self, i: int) -> np.ndarray:
        """Compute the covariance (3, 3) [rad²] of the i-th segment in W after the last step; NaN: there is none."""
        quat_VS, attitude_cov, _ = self._read_filters()
        now = self.quat_WL, self._heading_offset, np.transpose(self._variance), self._lost / self._rate_hz
        covariance = self._find_covariance(i, (quat_VS, attitude_cov, *(values[None] for values in now)))
        return np.full((3, 3), np.nan) if covariance is None else covariance[0]

    def mark_phase(self, phase: str, *, begins: bool) -> None:
        """Mark that a phase begins with the next sample, or has ended before it; of `CLASP` it tells headings."""
        if phase == CLASP:
            self._clasped = begins

    def reset_headings(self) -> None:
        """Reset the headings: the body has stood in the start pose again for `RESET_S`."""
        self._reset(np.array(self._recent))

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

    def _read_filters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read what the filters state after the last step, as `_stack` of n = 1 sample."""
        attitude_cov = self._extend(self._filters.attitude_cov, np.nan, 3, 3)
        return self._recent[-1][None], attitude_cov[None], self._extend(self._filters.about_vertical, np.nan, 3)[None]

    def _reset(self, recent: np.ndarray) -> None:
        """Reset the headings by recent orientations (m, k, 4)."""
        for i, name in enumerate(self.names):
            R_WS_start = self._start_pose.to_world(name, Rotation.from_quat(self._quat_LS[i]))
            self._heading_offset[i] = compute_heading_offset(Rotation.from_quat(recent[:, i]).mean(), R_WS_start)
        if self._headings is None:
            self._quat_WV = rotations.rotation_about(E_Z, self._heading_offset)
            self._start_pose = replace(self._start_pose, repeat_share=1.0)
        else:
            self._headings.reset(self._heading_offset)
            self._variance = self._headings.variance


def track_chunks(
    tracker: Tracker, recording: Recording, chunk_s: float = CHUNK_S, progress: Callable[[float], None] = lambda _: None
) -> Iterator[TrackResult]:
    """Iterate over a recording's chunks with their poses: results of a day that are too long for memory.

    The `tracker` is a new one, and errors are its own. Chunks last `chunk_s` [s], the first one as much longer as the
    phases `start` and `static` need, and the smoother's as long as the recording. `progress` is called with the share
    that is done.
    """
    begin, end = float(recording.time[0]), float(recording.time[-1])
    spans = [recording.phases[phase][0] for phase in ("start", "static") if recording.phases.get(phase)]
    first_s = max(last for _, last in spans) - begin + SHORTEST_S if spans else BEGINNING_S
    chunk_s = min(end - begin + 1.0, np.inf if tracker.options["method"] in OFFLINE else max(chunk_s, SHORTEST_S))
    for chunk in recording.chunks(chunk_s, first_s):
        tracked = tracker.push(chunk)
        progress(0.5 * (float(chunk.time[-1]) - begin) / (end - begin))
        if tracked is not None:
            yield tracked
    for tracked in tracker.smooth():
        progress(0.5 + 0.5 * (float(tracked.time[-1]) - begin) / (end - begin))
        yield tracked


def _describe_headings(quat_VS: np.ndarray, attitude_cov: np.ndarray, about_vertical: np.ndarray) -> np.ndarray:
    """Return what the filters know of their headings after the last sample (5, k), as in `HeadingFilter`."""
    heading_var = compute_heading_variance(quat_VS[-1], attitude_cov[-1])
    return np.vstack([heading_var, about_vertical[-1].T, np.trace(attitude_cov[-1], axis1=1, axis2=2) - heading_var])


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
