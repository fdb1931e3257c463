"""Correction of headings by what neighbouring segments share: joint accelerations, hinges, their ranges, joined hands.

The filters' tilt is good and their headings drift. Time is cut into intervals of equal length, the knots, and
`heading_filter` estimates one error of each heading a knot; an error common to all segments is unobservable. Offline a
Rauch-Tung-Striebel pass backward follows. Causally what a knot shows is corrected in the next one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body.mounts import compute_start_heading_var
from ..body.start_pose import StartPose
from ..observations.hinges import linearize_hinge
from ..recording import Intervals, OrientationSensor
from .heading_filter import HeadingFilter, HeadingSmoother, estimate_headings, find_care, mask_intervals
from .heading_problem import FilterHeadings, HeadingProblem
from .knots import E_Z, KnotReader, Samples, read_filter_headings, stack_samples
from .segment_orientations import SegmentOrientations

# Share of the next knot in which a knot is solved, in so many parts at even distances (a few more where it closes
# several gaps); over the rest its correction fades in.
SOLVE_SHARE, SOLVE_PARTS = 0.4, 20


@dataclass(frozen=True)
class HeadingCorrection:
    """The correction of the headings of k segments at m knots, and what was observed."""

    problem: HeadingProblem
    time: np.ndarray  # (m,) [s] of the knots
    errors: np.ndarray  # (m, k) [rad] that are corrected, on the left in W
    covariance: np.ndarray  # (m, k, k) [rad²] of the errors of the sensors' heading offsets
    segment_covariance: np.ndarray  # (m, k, k) [rad²] of the segments' headings
    found_clasps: Intervals = ()  # [s] when the hands were found joined outside of a phase
    gap_rms_mm: tuple[float, float] | None = None  # between points that coincide, before and after; None: in no phase
    # Hinge → the segment below to its plane, before and after.
    hinge_residual_rms_deg: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    delay_s: float | None = None  # [s] after which a causal covariance is used; None: interpolated, offline

    @property
    def segments(self) -> tuple[str, ...]:
        return self.problem.names

    @property
    def joint_accelerations(self) -> tuple[str, ...]:
        """Segments whose joint to the one above has a sensor on either side."""
        return tuple(pair.far for pair in self.problem.pairs)

    @property
    def hinges(self) -> tuple[str, ...]:
        """Joints that were observed as hinges."""
        return tuple(hinge.name for hinge in self.problem.hinges)

    @property
    def max_correction_deg(self) -> dict[str, float]:
        """Segment → largest rotation about the vertical."""
        largest = np.degrees(np.max(np.abs(self.errors), axis=0, initial=0.0))
        return dict(zip(self.segments, largest.tolist(), strict=True))

    def correct(self, orientations: SegmentOrientations) -> SegmentOrientations:
        """Return a chunk's orientations with corrected headings, of a correction that is interpolated between knots."""
        chunk, subject = orientations.recording, self.problem.subject
        start_pose = StartPose(table=self.problem.model.table)
        corrected, covariance = dict(orientations.quat_WL), dict(orientations.covariance_W)
        errors = interpolate(chunk.time, self.time, self.errors)
        for i, name in enumerate(self.segments):
            delta = errors[:, i]
            corrected[name] = rotations.multiply(rotations.rotation_about(E_Z, delta), corrected[name])
            filtered = orientations.orientation.get(name)
            if filtered is not None and filtered.attitude_cov is not None:
                known = np.interp(chunk.time, self.time, self.segment_covariance[:, i, i])
                covariance[name] = correct_covariance(
                    covariance[name],
                    (filtered.quat_VS, filtered.attitude_cov),
                    orientations.heading_offset[name],
                    compute_start_heading_var(chunk, name, subject, start_pose),
                    np.stack([known, np.full(len(delta), np.inf), delta**2], axis=1),
                    chunk.sensors[name].gap,
                )
        return replace(orientations, quat_WL=corrected, covariance_W=covariance)

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
            # As much as the heading is uncertain where the tilt is known may be shared with other segments.
            own = np.linalg.det(segment_cov[name]) / np.linalg.det(segment_cov[name][:, :2, :2])
            with np.errstate(divide="ignore"):
                scale.append(np.sqrt(np.clip(own / variance, 0.0, 1.0)))
        return {
            (names[a], names[b]): scale[a] * scale[b] * self._read(self.segment_covariance[:, rows[a], rows[b]], time)
            for a, b in combinations(range(len(names)), 2)
        }

    def _read(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Return what is known (n,) at these times [s] of `values` (m,) at the knots; causally 0 before the first."""
        if self.delay_s is None:
            return np.asarray(np.interp(time, self.time, values))
        return np.concatenate(([0.0], values))[np.searchsorted(self.time, time - self.delay_s, side="right")]


class HeadingCorrector:
    """Finds the correction of the headings of a recording in two passes over its chunks.

    First pass: `add_observations` of every chunk, then `solve`. Second pass: `HeadingCorrection.correct` of each. The
    result does not depend on the chunks, because observations are summed knot by knot.

    Parameters
    ----------
    orientations : of the first chunk
    problem : from `make_heading_problem`
    """

    def __init__(self, orientations: SegmentOrientations, problem: HeadingProblem) -> None:
        self._problem, self._start_end = problem, orientations.start[1]
        self._measured = find_measured_headings(orientations)
        self._reader = KnotReader(orientations, problem)
        self._smoother: HeadingSmoother | None = None  # from the first knot on
        self._samples: list[tuple[np.ndarray, np.ndarray]] = []  # time and orientations of each knot

    def add_observations(self, orientations: SegmentOrientations) -> None:
        """Add the observations of a chunk, in the first pass."""
        chunk, names = orientations.recording, self._problem.names
        begin = int(np.searchsorted(chunk.time, self._start_end))
        if begin == len(chunk):
            return
        samples = stack_samples(orientations, names)
        if self._smoother is None:
            start = read_filter_headings(orientations.orientation, names, begin)
            self._problem = replace(self._problem, start=start)
            self._smoother = HeadingSmoother(self._problem)
        while begin < len(chunk):
            end = min(len(chunk), begin + self._reader.remaining)
            self._reader.push(*(values[begin:end] for values in samples))
            self._last_filters = read_filter_headings(orientations.orientation, names, end - 1)
            if not self._reader.remaining:
                self._close_knot(self._smoother)
            begin = end

    def _close_knot(self, smoother: HeadingSmoother) -> None:
        knot = self._reader.form(self._reader.take(), self._last_filters)
        smoother.add(knot)
        self._samples.append((knot.time, knot.quat_WL))

    def solve(self) -> HeadingCorrection | None:
        """Estimate the heading errors; return None where nothing observes them."""
        problem, smoother = self._problem, self._smoother
        if smoother is None:
            return None
        if self._reader.count:
            self._close_knot(smoother)
        knot_times, smoothed, clasps = smoother.smooth()
        if self._measured.any() and not exceed_uncertainty(smoothed.errors, smoothed.covariance):
            smoothed.errors[:, self._measured] = 0.0
        # The errors are constant before the first and after the last.
        time, quat_WL = (np.concatenate(values) for values in zip(*self._samples, strict=True))
        self._samples, self._smoother = [], None
        gap, hinges = measure_residuals(problem, time, quat_WL, np.zeros(quat_WL.shape[:2]))
        corrections = interpolate(time, knot_times, smoothed.errors)
        gap_after, hinges_after = measure_residuals(problem, time, quat_WL, corrections)
        return HeadingCorrection(
            problem,
            knot_times,
            *smoothed,
            tuple(clasps),
            None if gap is None or gap_after is None else (gap, gap_after),
            {joint: (rms, hinges_after[joint]) for joint, rms in hinges.items()},
        )


def interpolate(time: np.ndarray, knot_times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what is between the knots (n, k) of `values` (m, k) at them."""
    return np.stack([np.interp(time, knot_times, column) for column in values.T], axis=1)


def measure_residuals(
    problem: HeadingProblem, time: np.ndarray, quat_WL: np.ndarray, headings: np.ndarray
) -> tuple[float | None, dict[str, float]]:
    """Return the rms gap [mm] between points that coincide, None in no phase, and hinge → rms deviation [deg].

    Parameters
    ----------
    time, quat_WL, headings : (n,) [s], (n, k, 4) xyzw of L', (n, k) [rad] by which they are corrected
    """
    squares = []
    for phase, points in problem.closures.items():
        inside = mask_intervals(time, problem.phases[phase])
        if inside.any():
            squares.append(np.sum(points.linearize(quat_WL[inside], headings[inside]).gap ** 2, axis=1))
    gap = 1e3 * float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else None
    rms = {}
    for hinge in problem.hinges:
        moves, on = (problem.names.index(name) for name in (hinge.moves, hinge.on))
        r = linearize_hinge(hinge, quat_WL[:, on], quat_WL[:, moves], headings[:, [moves, on]]).r
        rms[hinge.name] = float(np.degrees(np.sqrt(np.mean(r**2))))
    return gap, rms


class CausalHeadings:
    """Corrects headings as samples come; what a knot observes is corrected by the end of the next one.

    When a knot is complete it is solved in parts, with samples between, so that no pose waits for long. From the sample
    `lead` of the next knot on, by which all parts are done, the correction fades in.

    Parameters
    ----------
    orientations : up to the end of the start pose

    Attributes
    ----------
    offset : (k,) ψ [rad] to which corrections are added
    variance : (k,) [rad²] each after the last knot: variances of each segment's heading and of its filter's alone, and
        the squared correction of the headings since the start or the last reset
    """

    def __init__(self, orientations: SegmentOrientations, problem: HeadingProblem) -> None:
        recording = orientations.recording
        start = read_filter_headings(orientations.orientation, problem.names, len(recording) - 1)
        self._problem = problem = replace(problem, start=start)
        self.offset = np.array([orientations.heading_offset[name] for name in problem.names])
        self._reader = KnotReader(orientations, problem)
        self._filter = HeadingFilter(problem)
        self._care = find_care(problem, self._filter.x, self._filter.P)
        self._rate_hz, self._samples = recording.rate_hz, 0
        self._start_end = float(recording.time[-1])
        self._lead = min(round(SOLVE_SHARE * self._reader.size), self._reader.size - 1)
        self._solving: Iterator[None] | None = None  # the last knot, until its correction is applied
        self._record = False
        self._begin, self._end, self._at_reset = np.zeros((3, len(problem.names)))
        self._measured = find_measured_headings(orientations)
        self._corrects_measured = False  # since a correction exceeded its uncertainty, or a reset
        self._var_at_knot = np.zeros(len(problem.names))  # [rad²] of the filters, at the last knot that is solved
        self._knot_end = 0.0  # [s] of that knot
        self._update_estimate()
        self.variance = self._find_variances()
        self._marked: dict[str, list[tuple[int, int | None]]] = {}  # phase → first sample, and the one after the last
        self._history: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []  # of knots, as the correction

    @property
    def phases(self) -> set[str]:
        """The names of the phases in which points coincide."""
        return set(self._problem.closures)

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
        self._record = record
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
        self._filter.phases[phase] = tuple(
            ((first - 0.5) / self._rate_hz, np.inf if last is None else (last - 0.5) / self._rate_hz)
            for first, last in marked
        )

    def _solve(self, samples: Samples, filters: FilterHeadings) -> Iterator[None]:
        """Estimate the heading errors of a knot, a part at each step of the iterator."""
        knot = self._reader.form(samples, filters)
        yield
        self._filter.predict(self._filter.find_change(knot))
        yield
        yield from self._filter.update(knot)
        self._care = find_care(self._problem, self._filter.x, self._filter.P)
        self._update_estimate()
        self._var_at_knot, self._knot_end = np.nan_to_num(filters.var), knot.end

    def _update_estimate(self) -> None:
        self._estimate = estimate_headings(self._problem, self._filter.x, self._filter.P, self._care)

    def _apply(self) -> None:
        """Finish the last knot; its correction fades in from the next sample on."""
        if self._solving is None:
            return
        for _ in self._solving:
            pass
        self._solving = None
        self._begin, self._end = self._end, self._estimate.errors.copy()
        if self._measured.any() and not self._corrects_measured:
            self._corrects_measured = exceed_uncertainty(self._end[None], self._estimate.covariance[None])
            self._end[self._measured] *= self._corrects_measured
        if self._record:
            self._history.append((self._start_end + self._knot_end, self._end, *self._estimate[1:]))
        self.variance = self._find_variances()

    def reset(self, heading_offset: np.ndarray) -> None:
        """Correct the headings to ψ (k,) [rad] at once, as the person shows them by standing in the start pose."""
        self._apply()
        error = heading_offset - self.offset
        error = error + 2.0 * np.pi * np.round((self._end - error) / (2.0 * np.pi))
        self._filter.reset(error)
        self._update_estimate()
        self._corrects_measured = True
        self._begin = self._end = error
        self._at_reset = error
        self.variance = self._find_variances()

    def _find_variances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what `variance` is now."""
        return np.diag(self._estimate.segment_covariance), self._var_at_knot, (self._end - self._at_reset) ** 2

    def summarize(self) -> HeadingCorrection:
        """Return what was observed and corrected so far, without residuals: they are not computed causally."""
        k, history = len(self._problem.names), self._history
        return HeadingCorrection(
            self._problem,
            np.array([time for time, *_ in history]),
            np.array([errors for _, errors, _, _ in history]).reshape(-1, k),
            np.array([cov for _, _, cov, _ in history]).reshape(-1, k, k),
            np.array([cov for _, _, _, cov in history]).reshape(-1, k, k),
            tuple((self._start_end + a, self._start_end + b) for a, b in self._filter.clasps),
            delay_s=self._problem.knot_s,
        )


def find_measured_headings(orientations: SegmentOrientations) -> np.ndarray:
    """Find (k,) bool the segments whose sensors measure orientations."""
    sensors = orientations.recording.sensors
    return np.array([isinstance(sensors[name], OrientationSensor) for name in orientations.quat_WL], dtype=bool)


def exceed_uncertainty(errors: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a combination of corrections exceeds its own standard deviation, at one of the knots.

    Otherwise measured orientations are used as they are: what corrects them is less than what is not known.

    Parameters
    ----------
    errors, covariance : (m, k) [rad], (m, k, k) [rad²] of all headings at the knots
    """
    weighted = np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    return bool((np.sum(errors * weighted, axis=1) > 1.0).any())


def correct_covariance(
    cov_W: np.ndarray,
    filtered: tuple[np.ndarray, np.ndarray],
    heading_offset: float,
    start_var: float,
    variance: np.ndarray,
    lost: np.ndarray | None = None,
) -> np.ndarray:
    """Return the covariances (n, 3, 3) [rad²] of a segment in W, `cov_W`, with the variance of its corrected heading.

    Variance from other sources, such as a mount's heading, is not observed by what neighbours share: it stays.

    Parameters
    ----------
    filtered : of the sensor's filter, `quat_VS` (n, 4) xyzw and the covariance (n, 3, 3) [rad²] of its error, in S
    heading_offset, start_var : ψ [rad], and its variance [rad²] by the start pose
    variance : (n, 3) [rad²] as `CausalHeadings.variance`
    lost : (n,) bool: the sensor is lost, and neighbours do not tell where its segment is
    """
    R_VS, attitude_cov = Rotation.from_quat(filtered[0]), filtered[1]
    with_heading_V = R_VS.apply(np.einsum("nab,nb->na", attitude_cov, R_VS.inv().apply(E_Z)))  # with each axis
    alone = with_heading_V[:, 2] + start_var
    known, at_knot, correction = variance.T
    # The filter alone may know the heading better; to it a correction is an error of that size.
    corrected = np.minimum(known + np.maximum(with_heading_V[:, 2] - at_knot, 0.0), alone + correction)
    if lost is not None:
        corrected = np.where(lost, np.maximum(corrected, alone), corrected)
    with_heading_W = Rotation.from_rotvec([0.0, 0.0, heading_offset]).apply(with_heading_V)
    removed = (1.0 - np.sqrt(corrected / alone))[:, None] * with_heading_W
    replaced = cov_W.copy()
    replaced[:, 2, :2] -= removed[:, :2]
    replaced[:, :2, 2] -= removed[:, :2]
    replaced[:, 2, 2] += corrected - alone
    return replaced
