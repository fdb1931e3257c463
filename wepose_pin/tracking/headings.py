"""Correction of headings by what neighbouring segments share: joint accelerations, hinges, their ranges, joined hands.

The filters' tilt is good and their headings drift. Time is cut into intervals of equal length, the knots, and
`heading_filter` estimates one error of each heading a knot; an error common to all segments is unobservable. Offline a
Rauch-Tung-Striebel pass backward follows. Causally what a knot shows is corrected in the next one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import (
    SegmentOrientations,
    StartFrames,
    compute_heading_variance,
    compute_start_heading_var,
    find_mount_covariance,
)
from ..body import BodyModel
from ..body.subject import Subject
from ..calibration import PROTOCOLS, load_protocol
from ..calibration.conditions import StartPose, find_girdle_signs, find_parts
from ..errors import BadSession
from ..filters import AboutVertical, Orientation
from ..recording import ImuSensor, OrientationSensor, Recording
from .heading_filter import HeadingFilter, StanceEstimator, smooth
from .heading_observations import correct_headings, linearize_hinge, move_all_girdles
from .heading_problem import (
    MECHANISM_NOISE,
    PERSON_NOISE,
    CoincidentPoints,
    FilterHeadings,
    HeadingProblem,
    HingeAxis,
    Knot,
    Way,
)
from .joint_accelerations import LEAST_RATE_HZ, JointAccelerationFilter, find_pairs

REFERENCE_START_STD = np.deg2rad(0.5)  # [rad] of the heading that defines x, at the end of the start pose; assumption
MEASURED_RATE_STD = np.deg2rad(0.1)  # [rad/s] at which a measured orientation drifts about the vertical; assumption
LEAST_MOUNT_VAR = np.deg2rad(0.01) ** 2  # [rad²] of a mount's heading, so that covariances can be inverted
# [s] between knots: causally what a knot observes is corrected by the end of the next one, offline each costs memory.
CAUSAL_KNOT_S, OFFLINE_KNOT_S = 0.5, 2.0
# Share of the next knot in which a knot is solved, in so many parts at even distances (a few more where it closes
# several gaps); over the rest its correction fades in.
SOLVE_SHARE, SOLVE_PARTS = 0.4, 20
SAMPLE_RATE_HZ = 8.0
# Standard deviation of the delay of an accelerometer against its gyroscope: half a sample, over which it averages, and
# what filters inside the chips differ by [s]; assumption.
AVERAGED_SAMPLES, CHIP_DELAY_STD = 0.5, 0.002
E_Z = np.array([0.0, 0.0, 1.0])


class HeadingCorrection(NamedTuple):
    """The correction of headings: what was observed, residuals before and after, and the largest correction."""

    gap_rms_mm: tuple[float, float] | None  # between points that coincide, before and after; None: in no phase
    hinge_residual_rms_deg: Mapping[str, tuple[float, float]]  # joint → segment below to its hinge's plane, the same
    max_correction_deg: Mapping[str, float]  # segment → largest rotation about the vertical
    joint_accelerations: tuple[str, ...] = ()  # segments whose joint to the one above has a sensor on either side
    hinges: tuple[str, ...] = ()  # joints that were observed as hinges
    found_clasps: tuple[tuple[float, float], ...] = ()  # [s] when the hands were found joined outside of a phase
    segments: tuple[str, ...] = ()  # of the k rows of `covariance`
    time: np.ndarray = np.zeros(0)  # (m,) [s] of the covariances
    covariance: np.ndarray = np.zeros((0, 0, 0))  # (m, k, k) [rad²] of the errors of the sensors' heading offsets
    segment_covariance: np.ndarray = np.zeros((0, 0, 0))  # (m, k, k) [rad²] of the segments' headings
    delay_s: float | None = None  # [s] after which a causal covariance is used; None: interpolated, offline

    def relative_std(self, near: str, far: str, time: np.ndarray) -> np.ndarray:
        """Return the standard deviation (n,) [rad] of the heading between two segments at these times [s]."""
        i, j = self.segments.index(near), self.segments.index(far)
        variance = self.covariance[:, i, i] + self.covariance[:, j, j] - 2.0 * self.covariance[:, i, j]
        return np.asarray(np.sqrt(np.interp(time, self.time, variance)))

    def correlate_segments(
        self, time: np.ndarray, segment_cov: Mapping[str, np.ndarray]
    ) -> dict[tuple[str, str], np.ndarray]:
        """Return two segments → the covariance (n,) [rad²] of their headings at these times [s].

        Neighbours share what one tells of the other. Where `segment_cov` (n, 3, 3) [rad²] in W, given for each segment,
        states less than the heading filter knew, the correlation stays and the covariance shrinks.
        """
        names = [name for name in self.segments if name in segment_cov]
        rows = [self.segments.index(name) for name in names]
        if not len(self.time):
            return {}
        scale = []
        for name, i in zip(names, rows, strict=True):
            variance = self._read(self.segment_covariance[:, i, i], time)
            with np.errstate(divide="ignore"):
                scale.append(np.sqrt(np.minimum(1.0, find_conditional_heading_variance(segment_cov[name]) / variance)))
        return {
            (names[a], names[b]): scale[a] * scale[b] * self._read(self.segment_covariance[:, rows[a], rows[b]], time)
            for a, b in combinations(range(len(names)), 2)
        }

    def _read(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Return what is known (n,) at these times [s] of `values` (m,) at the knots; causally 0 before the first."""
        if self.delay_s is None:
            return np.asarray(np.interp(time, self.time, values))
        return np.concatenate(([0.0], values))[np.searchsorted(self.time, time - self.delay_s, side="right")]


def find_stride(rate_hz: float) -> int:
    """Return the number of samples from one that the heading filter takes to the next, at `SAMPLE_RATE_HZ`."""
    return max(1, round(rate_hz / SAMPLE_RATE_HZ))


class KnotReader:
    """Cuts samples into knots of `size` samples and forms the observations of each.

    Parameters
    ----------
    quat_LS, heading_offset : mounts (k, 4) xyzw and ψ (k,) [rad] of the problem's segments
    rate_hz : of the samples
    """

    def __init__(
        self,
        quat_LS: np.ndarray,
        heading_offset: np.ndarray,
        rate_hz: float,
        problem: HeadingProblem,
    ) -> None:
        names = problem.names
        self._stride = find_stride(rate_hz)
        self.size = self._stride * problem.samples_per_knot
        k = len(names)
        self._quat_SL = rotations.conjugate(quat_LS)
        self._heading_offset = heading_offset
        self._time, self._quat_VS, self._accel_S = (
            np.zeros(self.size),
            np.zeros((self.size, k, 4)),
            np.zeros((self.size, k, 3)),
        )
        self.count = 0  # samples in the open knot
        self._accelerations = JointAccelerationFilter(k, rate_hz) if problem.pairs else None

    @property
    def remaining(self) -> int:
        """Number of samples that the open knot lacks."""
        return self.size - self.count

    def push(self, time: np.ndarray, quat_VS: np.ndarray, accel_S: np.ndarray) -> None:
        """Add at most `remaining` samples: (n,) [s], (n, k, 4) xyzw, (n, k, 3) [m/s²]."""
        rows = slice(self.count, self.count + len(time))
        self._time[rows], self._quat_VS[rows], self._accel_S[rows] = time, quat_VS, accel_S
        self.count += len(time)

    def close(self, filters: FilterHeadings) -> Knot:
        """Return the open knot and open the next one; `filters` is at its last sample."""
        return self.form(self.take(), filters)

    def take(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the samples of the open knot, time, `quat_VS` and `accel_S`, and open the next one."""
        n, self.count = self.count, 0
        return self._time[:n].copy(), self._quat_VS[:n].copy(), self._accel_S[:n].copy()

    def form(self, samples: tuple[np.ndarray, np.ndarray, np.ndarray], filters: FilterHeadings) -> Knot:
        """Return the knot of samples from `take`; knots must be formed in the order of time."""
        time, quat_VS, accel_S = samples
        n = len(time)
        rows = np.arange(0, n, self._stride)
        R_WS = correct_headings(quat_VS, self._heading_offset).swapaxes(0, 1)
        no_sides = np.zeros((0, accel_S.shape[1], 3, 8))
        sides = no_sides if self._accelerations is None else self._accelerations.push(R_WS, accel_S, rows)
        quat_WS = rotations.multiply(rotations.rotation_about(E_Z, self._heading_offset), quat_VS[rows])
        quat_WL = rotations.multiply(quat_WS, self._quat_SL)
        lost = np.asarray(~np.isfinite(accel_S).all(axis=(0, 2)))
        return Knot(float(time[n - 1]), time[rows].copy(), quat_WL, sides, filters, lost)


def make_heading_problem(
    recording: Recording, orientations: SegmentOrientations, subject: Subject, model: BodyModel, *, causal: bool
) -> HeadingProblem | None:
    """Return what observes the headings of these segments, and how well they are known at the start; None: nothing.

    Parameters
    ----------
    recording, orientations : the first chunk, or the one that ends with the start pose
    causal : headings are corrected as samples come; the phases of closures are not read but marked as they begin and
        end (`CausalHeadings.mark`)
    """
    names = tuple(orientations.quat_WL)
    raw = {name: orientations.quat_LS[name] for name in names if name in recording.imus}
    pairs = find_pairs(model, raw) if recording.rate_hz >= LEAST_RATE_HZ else ()
    hinges = _find_hinges(recording, names, subject, model)
    closures = _find_closures(None if causal else recording, names, model)
    closed = any(end >= orientations.start[1] for closure in closures for _, end in closure.intervals)
    if not (pairs or hinges or closed):
        return None
    noise = MECHANISM_NOISE if model.table.is_mechanism else PERSON_NOISE
    stride = find_stride(recording.rate_hz)
    samples = max(1, round((CAUSAL_KNOT_S if causal else OFFLINE_KNOT_S) * recording.rate_hz / stride))
    knot_s = samples * stride / recording.rate_hz
    drift_psd, rate_std = np.full(len(names), noise.drift_psd), np.full(len(names), MEASURED_RATE_STD)
    for i, name in enumerate(names):
        if name in orientations.orientation:  # a gyroscope's white noise may be more
            of_sensor = orientations.orientation[name].noise
            drift_psd[i] = max(noise.drift_psd, float(np.trace(of_sensor.gyro_cov)) / (3.0 * recording.rate_hz))
            rate_std[i] = np.sqrt(float(np.trace(of_sensor.gyro_bias_cov)) / 3.0)
    start_var, mount_var = np.array([find_start_variances(recording, name, subject, model) for name in names]).T
    return HeadingProblem(
        names,
        model,
        subject,
        pairs,
        hinges,
        closures,
        noise,
        knot_s,
        samples,
        drift_psd,
        rate_std,
        start_var,
        mount_var,
        AVERAGED_SAMPLES / recording.rate_hz + CHIP_DELAY_STD,
        causal=causal,
    )


def find_start_variances(recording: Recording, segment: str, subject: Subject, model: BodyModel) -> tuple[float, float]:
    """Find the variances [rad²] of a sensor's heading after the start pose: by the pose, and by the mount's heading."""
    table = model.table
    mount_cov = find_mount_covariance(recording, segment, subject)
    mount_var = LEAST_MOUNT_VAR if mount_cov is None else max(float(mount_cov[2, 2]), LEAST_MOUNT_VAR)
    if segment == table.reference:
        return float(REFERENCE_START_STD**2), mount_var
    return compute_start_heading_var(recording, segment, subject, StartFrames(table=table)), mount_var


def _find_hinges(
    recording: Recording, names: Sequence[str], subject: Subject, model: BodyModel
) -> tuple[HingeAxis, ...]:
    """Return the hinges between two segments with sensors, their axes calibrated or as the body's table has them."""
    table = model.table
    noise = MECHANISM_NOISE if table.is_mechanism else PERSON_NOISE
    # A calibrated axis is relative to the calibrated mounts and holds as long as they do.
    calibrated = {} if recording.remounted else subject.hinges
    hinges = []
    for joint, hinge in table.hinges.items():
        if not {hinge.on, hinge.moves} <= set(names):
            continue
        axis, std, axis_std, tilt_std = np.array(hinge.axis), hinge.softness, 0.0, hinge.tilt_std
        if joint in calibrated:
            axis, std = calibrated[joint].axis, calibrated[joint].std
            axis_std, tilt_std = noise.axis_std, noise.tilt_std
        elif table.is_mechanism:
            continue
        else:
            axis_std = float(np.hypot(hinge.common_std, hinge.mirror_std))
        along = np.array(table.segments[hinge.on].along)
        hinges.append(
            HingeAxis(
                joint,
                names.index(hinge.on),
                names.index(hinge.moves),
                axis,
                along,
                np.array(table.segments[hinge.moves].along),
                hinge.range,
                axis_std,
                tilt_std,
                max(std, noise.hinge_std),
            )
        )
    return tuple(hinges)


def _find_closures(
    recording: Recording | None, segments: Sequence[str], model: BodyModel
) -> tuple[CoincidentPoints, ...]:
    """Return the closures of the protocols in which points coincide and all segments between them have sensors.

    Each holds in the intervals of its phase, none where the recording lacks it. `recording` None: none are read.
    """
    neutral = StartPose(model.neutral_rotations)
    closures, taken = [], set[tuple[str, tuple[str, ...]]]()
    for name in PROTOCOLS:
        for closure in load_protocol(name).closures:
            if closure.kind != "coincide" or not set(closure.points) <= set(model.table.points):
                continue
            if (closure.phase, closure.points) in taken:
                continue
            taken.add((closure.phase, closure.points))
            first, last = closure.points
            try:
                gap, *ways = (
                    Way.from_parts(
                        model,
                        segments,
                        find_parts(model, neutral, segments, ends),
                        neutral,
                        find_girdle_signs(model, ends),
                    )
                    for ends in ([(first, 1.0), (last, -1.0)], [(first, 1.0)], [(last, 1.0)])
                )
            except BadSession:
                continue
            intervals = () if recording is None else tuple(recording.phases.get(closure.phase, ()))
            closures.append(CoincidentPoints(closure.phase, closure.points, intervals, gap, tuple(ways)))
    return tuple(closures)


class HeadingCorrector:
    """Corrects the headings of a recording in two passes over its chunks.

    First pass: `add_observations` of every chunk, then `solve`. Second pass: `correct` every chunk. The result does not
    depend on the chunks, because observations are summed knot by knot.

    Parameters
    ----------
    chunk, orientations : the first chunk
    problem : from `make_heading_problem`
    """

    def __init__(self, chunk: Recording, orientations: SegmentOrientations, problem: HeadingProblem) -> None:
        self._problem, self._start_end = problem, orientations.start[1]
        self._start_frames = StartFrames(table=problem.model.table)
        self._names, self._measured = problem.names, find_measured_headings(chunk, problem.names)
        mounts = np.array([orientations.quat_LS[name] for name in self._names])
        offsets = np.array([orientations.heading_offset[name] for name in self._names])
        self._reader = KnotReader(mounts, offsets, chunk.rate_hz, problem)
        self._knots: list[Knot] = []
        self._corrected_samples = 0  # of the second pass so far
        self._gaps = {stage: _RmsAccumulator() for stage in ("before", "after")}
        self._hinge_rms = {
            stage: {hinge.joint: _RmsAccumulator() for hinge in problem.hinges} for stage in ("before", "after")
        }
        self._max_correction_deg = dict.fromkeys(self._names, 0.0)

    def add_observations(self, chunk: Recording, orientations: SegmentOrientations) -> None:
        """Add the observations of a chunk, in the first pass."""
        first = int(np.searchsorted(chunk.time, self._start_end))
        if first == len(chunk):
            return
        quat_VS, accel_S = _stack_samples(chunk, orientations, self._names)
        if not (self._knots or self._reader.count):
            start = read_filter_headings(orientations.orientation, self._names, first)
            self._problem = replace(self._problem, start=start)
        begin = first
        while begin < len(chunk):
            end = min(len(chunk), begin + self._reader.remaining)
            self._reader.push(chunk.time[begin:end], quat_VS[begin:end], accel_S[begin:end])
            self._last_filters = read_filter_headings(orientations.orientation, self._names, end - 1)
            if not self._reader.remaining:
                self._knots.append(self._reader.close(self._last_filters))
            begin = end

    def solve(self) -> bool:
        """Estimate the heading errors; return False where nothing observes them."""
        if self._reader.count:
            self._knots.append(self._reader.close(self._last_filters))
        if not self._knots:
            return False
        self._smoothed, self._clasps = smooth(self._problem, self._knots)
        if self._measured.any() and not exceed_uncertainty(self._smoothed.errors, self._smoothed.covariance):
            self._smoothed.errors[:, self._measured] = 0.0
        ends = np.array([knot.end for knot in self._knots])
        begins = np.array([knot.time[0] for knot in self._knots])
        self._knot_times = 0.5 * (begins + ends)  # the errors are constant before the first and after the last
        self._knots = []
        return True

    def correct(self, chunk: Recording, orientations: SegmentOrientations) -> SegmentOrientations:
        """Return the chunk's orientations with corrected headings, in the second pass, and add up its residuals."""
        corrected, covariance = dict(orientations.quat_WL), dict(orientations.covariance_W)
        for i, name in enumerate(self._names):
            delta = np.interp(chunk.time, self._knot_times, self._smoothed.errors[:, i])
            corrected[name] = rotations.multiply(rotations.rotation_about(E_Z, delta), corrected[name])
            self._max_correction_deg[name] = max(self._max_correction_deg[name], float(np.degrees(np.abs(delta).max())))
            filter_cov = _compute_filter_covariance(orientations, name)
            if filter_cov is not None:
                with_heading, filter_var = filter_cov
                start_var = compute_start_heading_var(chunk, name, self._problem.subject, self._start_frames)
                before = filter_var + start_var
                variance = np.interp(chunk.time, self._knot_times, self._smoothed.segment_covariance[:, i, i])
                # The filter alone may know the heading better; to it a correction is an error of that size.
                variance = np.minimum(variance, before + delta**2)
                gap = chunk.sensors[name].gap
                if gap is not None:  # where the sensor is lost, neighbours do not tell where its segment is
                    variance = np.where(gap, np.maximum(variance, before), variance)
                covariance[name] = replace_heading_variance(covariance[name], with_heading, before, variance)
        result = replace(orientations, quat_WL=corrected, covariance_W=covariance)
        stride = find_stride(chunk.rate_hz)
        rows = np.arange(-self._corrected_samples % stride, len(chunk), stride)
        rows = rows[chunk.time[rows] >= self._start_end]
        self._corrected_samples += len(chunk)
        for stage, quats in (("before", orientations.quat_WL), ("after", corrected)):
            quat_WL = np.stack([quats[name][rows] for name in self._names], axis=1)
            self._add_residuals(stage, chunk.time[rows], correct_headings(quat_WL, np.zeros(len(self._names))))
        return result

    def summarize(self) -> HeadingCorrection:
        """Return what was observed, and residuals and the largest correction of the chunks corrected so far."""
        gaps, hinge_rms = self._gaps, self._hinge_rms
        return HeadingCorrection(
            gap_rms_mm=(1e3 * gaps["before"].value, 1e3 * gaps["after"].value) if gaps["before"].count else None,
            hinge_residual_rms_deg={
                hinge.joint: (
                    float(np.degrees(hinge_rms["before"][hinge.joint].value)),
                    float(np.degrees(hinge_rms["after"][hinge.joint].value)),
                )
                for hinge in self._problem.hinges
            },
            max_correction_deg=dict(self._max_correction_deg),
            joint_accelerations=tuple(pair.far for pair in self._problem.pairs),
            hinges=tuple(hinge.joint for hinge in self._problem.hinges),
            found_clasps=tuple(self._clasps),
            segments=self._names,
            time=self._knot_times,
            covariance=self._smoothed.covariance,
            segment_covariance=self._smoothed.segment_covariance,
        )

    def _add_residuals(self, stage: str, time: np.ndarray, R_WL: np.ndarray) -> None:
        """Add the residuals of closures and hinges, "before" or "after" the correction, of R_WL (k, n, 3, 3)."""
        problem = self._problem
        motions = move_all_girdles(problem, R_WL) if problem.closures else {}
        for closure in problem.closures:
            closed = closure.holds(time)
            if closed.any():
                gap = closure.gap.turn(R_WL, motions).sum(axis=0)
                self._gaps[stage].add(np.sum(gap[closed] ** 2, axis=1))
        if len(time):
            for hinge in problem.hinges:
                r = linearize_hinge(R_WL[hinge.on], R_WL[hinge.moves], hinge).r
                self._hinge_rms[stage][hinge.joint].add(r**2)


class CausalHeadings:
    """Corrects headings as samples come; what a knot observes is corrected by the end of the next one.

    When a knot is complete it is solved in parts, with samples between, so that no pose waits for long. From the sample
    `lead` of the next knot on, by which all parts are done, the correction fades in.

    Parameters
    ----------
    recording, orientations : up to the end of the start pose

    Attributes
    ----------
    offset : (k,) ψ [rad] to which corrections are added
    variance : (k,) [rad²] each after the last knot: variances of each segment's heading and of its filter's alone, and
        the squared correction of the headings since the start or the last reset
    """

    def __init__(self, recording: Recording, orientations: SegmentOrientations, problem: HeadingProblem) -> None:
        start = read_filter_headings(orientations.orientation, problem.names, len(recording) - 1)
        self._problem = problem = replace(problem, start=start)
        mounts = np.array([orientations.quat_LS[name] for name in problem.names])
        self.offset = np.array([orientations.heading_offset[name] for name in problem.names])
        self._reader = KnotReader(mounts, self.offset, recording.rate_hz, problem)
        self._filter, self._stance = HeadingFilter(problem), StanceEstimator(problem)
        self._rate_hz, self._samples = recording.rate_hz, 0
        self._start_end = float(recording.time[-1])
        self._lead = min(round(SOLVE_SHARE * self._reader.size), self._reader.size - 1)
        self._solving: Iterator[None] | None = None  # the last knot, until its correction is applied
        self._record = False
        self._begin, self._end, self._at_reset = np.zeros((3, len(problem.names)))
        self._measured = find_measured_headings(recording, problem.names)
        self._corrects_measured = False  # since a correction exceeded its uncertainty, or a reset
        self._knot_filters: FilterHeadings | None = None  # of the last complete knot
        self._var_at_knot = np.zeros(len(problem.names))  # [rad²] of the filters, at the last knot that is applied
        self._estimate = self._stance.estimate(self._filter.x, self._filter.P)
        self.variance = self._find_variances()
        self._max_correction = np.zeros(len(problem.names))
        self._marked: dict[str, list[tuple[int, int | None]]] = {}  # phase → first sample, and the one after the last
        self._history: list[tuple[float, np.ndarray, np.ndarray]] = []

    @property
    def phases(self) -> set[str]:
        """The names of the phases in which points coincide."""
        return {closure.phase for closure in self._problem.closures}

    @property
    def fade(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """How the correction fades in: from (k,) [rad], to (k,) [rad], number of the next sample, number of samples."""
        count = self._reader.count
        if count < self._lead:
            return self._end, self._end, 0, 1
        return self._begin, self._end, count - self._lead, self._reader.size - self._lead

    @property
    def remaining(self) -> int:
        """Number of samples that can be pushed at once: after them `fade` changes, or the knot is complete."""
        count = self._reader.count
        return (self._lead if count < self._lead else self._reader.size) - count

    def push(self, quat_VS: np.ndarray, accel_S: np.ndarray) -> bool:
        """Add up to `remaining` samples: (n, k, 4) xyzw, (n, k, 3) [m/s²], NaN where lost; return whether the knot is
        complete.
        """
        time = (self._samples + np.arange(len(quat_VS))) / self._rate_hz
        self._reader.push(time, quat_VS, accel_S)
        self._samples += len(quat_VS)
        if self._solving is not None:
            if self._reader.count >= self._lead:
                self._apply()
            elif self._reader.count % max(1, self._lead // SOLVE_PARTS) == 0:
                next(self._solving, None)
        return not self._reader.remaining

    def close(self, filters: FilterHeadings, *, record: bool = False) -> None:
        """Close a complete knot; `filters` is after its last sample; `record`: keep the covariance for `summarize`."""
        self._record, self._knot_filters = record, filters
        self._solving = self._solve(self._reader.take(), filters)
        if not self._lead:
            self._apply()

    def mark(self, phase: str, *, begins: bool) -> None:
        """Mark that a phase begins with the next sample, or has ended before it; its closures hold in between."""
        marked = self._marked.setdefault(phase, [])
        is_open = bool(marked) and marked[-1][1] is None
        if begins and not is_open:
            marked.append((self._samples, None))
        elif is_open and not begins:
            marked[-1] = marked[-1][0], self._samples
        else:
            return
        # Half a sample around the first and the last one.
        intervals = tuple(
            ((first - 0.5) / self._rate_hz, np.inf if last is None else (last - 0.5) / self._rate_hz)
            for first, last in marked
        )
        closures = tuple(
            closure._replace(intervals=intervals) if closure.phase == phase else closure
            for closure in self._problem.closures
        )
        self._problem = self._filter.problem = replace(self._problem, closures=closures)

    def _solve(self, samples: tuple[np.ndarray, np.ndarray, np.ndarray], filters: FilterHeadings) -> Iterator[None]:
        """Estimate the heading errors of a knot, a part at each step of the iterator."""
        knot = self._reader.form(samples, filters)
        yield
        yield from self._filter.step_gradually(knot)
        self._stance.assess(self._filter.x, self._filter.P)
        self._estimate = self._stance.estimate(self._filter.x, self._filter.P)
        if self._record:
            self._history.append((self._start_end + knot.end, *self._estimate[1:]))

    def _apply(self) -> None:
        """Finish the last knot; its correction fades in from the next sample on."""
        if self._solving is None or self._knot_filters is None:
            return
        for _ in self._solving:
            pass
        self._solving = None
        self._var_at_knot = np.nan_to_num(self._knot_filters.var)
        self._begin, self._end = self._end, self._estimate.errors.copy()
        if self._measured.any() and not self._corrects_measured:
            self._corrects_measured = exceed_uncertainty(self._end[None], self._estimate.covariance[None])
            self._end[self._measured] *= self._corrects_measured
        self._max_correction = np.maximum(self._max_correction, np.abs(self._end))
        self.variance = self._find_variances()

    def reset(self, heading_offset: np.ndarray) -> None:
        """Correct the headings to ψ (k,) [rad] at once, as the person shows them by standing in the start pose."""
        self._apply()
        error = heading_offset - self.offset
        error = error + 2.0 * np.pi * np.round((self._end - error) / (2.0 * np.pi))
        self._filter.reset(error)
        self._estimate = self._stance.estimate(self._filter.x, self._filter.P)
        self._corrects_measured = True
        self._begin = self._end = error
        self._at_reset = error
        self.variance = self._find_variances()

    def _find_variances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what `variance` is now."""
        return (
            np.diag(self._estimate.segment_covariance),
            self._var_at_knot,
            (self._end - self._at_reset) ** 2,
        )

    def summarize(self) -> HeadingCorrection:
        """Return what was observed and corrected so far, without residuals: they are not computed causally."""
        names = self._problem.names
        return HeadingCorrection(
            gap_rms_mm=None,
            hinge_residual_rms_deg={},
            max_correction_deg=dict(zip(names, np.degrees(self._max_correction).tolist(), strict=True)),
            joint_accelerations=tuple(pair.far for pair in self._problem.pairs),
            hinges=tuple(hinge.joint for hinge in self._problem.hinges),
            found_clasps=tuple((self._start_end + a, self._start_end + b) for a, b in self._filter.clasps),
            segments=names,
            time=np.array([time for time, _, _ in self._history]),
            covariance=np.array([cov for _, cov, _ in self._history]),
            segment_covariance=np.array([cov for _, _, cov in self._history]),
            delay_s=self._problem.knot_s,
        )


def find_measured_headings(recording: Recording, names: Sequence[str]) -> np.ndarray:
    """Find (k,) bool the segments whose sensors measure orientations."""
    return np.array([isinstance(recording.sensors[name], OrientationSensor) for name in names], dtype=bool)


def exceed_uncertainty(errors: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a combination of corrections exceeds its own standard deviation, at one of the knots.

    Otherwise measured orientations are used as they are: what corrects them is less than what is not known.

    Parameters
    ----------
    errors, covariance : (m, k) [rad], (m, k, k) [rad²] of all headings at the knots
    """
    weighted = np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    return bool((np.sum(errors * weighted, axis=1) > 1.0).any())


def _stack_samples(
    chunk: Recording, orientations: SegmentOrientations, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Stack `quat_VS` (n, k, 4) and `accel_S` (n, k, 3) [m/s²], NaN where a sensor is lost."""
    quats, accels = [], []
    for name in names:
        sensor = chunk.sensors[name]
        filtered = sensor if isinstance(sensor, OrientationSensor) else orientations.orientation[name]
        quats.append(filtered.quat_VS)
        accels.append(find_specific_force(chunk, name))
    return np.stack(quats, axis=1), np.stack(accels, axis=1)


def find_specific_force(chunk: Recording, name: str) -> np.ndarray:
    """Return `accel_S` (n, 3) [m/s²] of a sensor, NaN where samples are lost; zeros of an `OrientationSensor`."""
    sensor = chunk.sensors[name]
    accel_S = sensor.accel_S if isinstance(sensor, ImuSensor) else np.zeros((len(chunk), 3))
    return accel_S if sensor.gap is None else np.where(sensor.gap[:, None], np.nan, accel_S)


def read_filter_headings(orientation: Mapping[str, Orientation], names: Sequence[str], row: int) -> FilterHeadings:
    """Read what the filters say of their headings at sample `row`."""
    variance, about_vertical = np.full(len(names), np.nan), np.full((len(names), len(AboutVertical._fields)), np.nan)
    filtered = {i: orientation[name] for i, name in enumerate(names) if name in orientation}
    covs = {i: each.attitude_cov[row] for i, each in filtered.items() if each.attitude_cov is not None}
    if covs:
        quat_VS = np.stack([filtered[i].quat_VS[row] for i in covs])
        variance[list(covs)] = compute_heading_variance(quat_VS, np.stack(list(covs.values())))
    for i, each in filtered.items():
        if each.about_vertical is not None:
            about_vertical[i] = each.about_vertical[row]
    return FilterHeadings(variance, AboutVertical(*about_vertical.T))


class _RmsAccumulator:
    """The root mean square of residuals whose squares are added chunk by chunk."""

    def __init__(self) -> None:
        self.count, self._sum = 0, 0.0

    def add(self, squares: np.ndarray) -> None:
        self.count, self._sum = self.count + len(squares), self._sum + float(squares.sum())

    @property
    def value(self) -> float:
        return float(np.sqrt(self._sum / self.count)) if self.count else float("nan")


def _compute_filter_covariance(orientations: SegmentOrientations, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Compute the filter's covariance of the heading with each axis of W (n, 3), and its variance (n,), both [rad²].

    None: the filter has no covariance.
    """
    orientation = orientations.orientation.get(name)
    if orientation is None or orientation.attitude_cov is None:
        return None
    with_heading_V = compute_heading_covariance(Rotation.from_quat(orientation.quat_VS), orientation.attitude_cov)
    R_WV = Rotation.from_rotvec([0.0, 0.0, orientations.heading_offset[name]])
    return R_WV.apply(with_heading_V), with_heading_V[:, 2]


def compute_heading_covariance(R_VS: Rotation, attitude_cov: np.ndarray) -> np.ndarray:
    """Compute the covariance (n, 3) [rad²] of the heading with each axis of V, from that in S (n, 3, 3)."""
    return np.asarray(R_VS.apply(np.einsum("nab,nb->na", attitude_cov, R_VS.inv().apply([0.0, 0.0, 1.0]))))


def find_conditional_heading_variance(cov_W: np.ndarray) -> np.ndarray:
    """Find the variance (n,) [rad²] of the heading where the tilt is known, of covariances (n, 3, 3) [rad²] in W.

    As much of `cov_W` may be shared with other segments.
    """
    xx, xy, yy = cov_W[:, 0, 0], cov_W[:, 0, 1], cov_W[:, 1, 1]
    xz, yz, zz = cov_W[:, 0, 2], cov_W[:, 1, 2], cov_W[:, 2, 2]
    explained = (yy * xz**2 - 2.0 * xy * xz * yz + xx * yz**2) / (xx * yy - xy**2)
    return np.asarray(np.maximum(zz - explained, 0.0))


def replace_heading_variance(
    cov_W: np.ndarray, filter_W: np.ndarray, filter_var: np.ndarray, heading_var: np.ndarray
) -> np.ndarray:
    """Return the covariances (n, 3, 3) [rad²] with another variance of the heading from filter and start pose.

    Variance from other sources, such as a mount's heading, is not observed by what neighbours share: it stays.

    Parameters
    ----------
    cov_W : (n, 3, 3) of a segment in W
    filter_W : (n, 3) the filter's covariance of the heading with each axis of W
    filter_var, heading_var : (n,) the variance of the heading in `cov_W`, and the one that replaces it
    """
    std_ratio = np.sqrt(heading_var / filter_var)
    removed = (1.0 - std_ratio)[:, None] * filter_W
    replaced = cov_W.copy()
    replaced[:, 2, :2] -= removed[:, :2]
    replaced[:, :2, 2] -= removed[:, :2]
    replaced[:, 2, 2] += heading_var - filter_var
    return replaced
