"""Heading correction from points that coincide (as the palms in a clasp phase) and axes of hinges (as the elbows).

The filters' tilt is good and their headings drift. δ_i(t) is the heading error of segment i, on the left in W:
R_WL,true = Rz(δ) R_WL. It is a random walk whose step variance is the growth of the filter's heading variance. Two
measurements observe it, both linear in δ:

- the gap in a later phase of a protocol's closure: g + Σ δ_i e_z × v_i = 0, with v_i the part of segment i in the way
  between the two points;
- the hinges of a calibrated subject: the segment below stays in the plane of its hinge, n · R_Oᵀ R_M e = 0, with e its
  long axis.

A forward pass and a Rauch-Tung-Striebel pass over knots of a few seconds give δ and its covariance. A heading error
common to all segments is unobservable.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..alignment import (
    PALM_SLIP_STD,
    SEGMENT_ATTITUDE_STD,
    SegmentOrientations,
    StartFrames,
    compute_start_heading_var,
)
from ..calibration import PROTOCOLS, load_protocol
from ..calibration.conditions import Part, StartPose, find_girdle_signs, find_parts
from ..errors import BadSession
from ..model import BodyModel, BodyTable, move_girdles
from ..model.girdle import PARAMETERS
from ..model.start_pose import orient_links
from ..recording import Recording
from ..subject import Subject

KNOT_S = 2.0  # [s] between knots of the random walk
SAMPLE_RATE_HZ = 8.0
# [s] Correlation time of residual errors other than those of headings: soft tissue and remaining errors of the mounts
# recur in every pose, so that a minute of joined hands gives three effective samples. Chosen on simulated people: with
# a shorter time, the headings of a good filter become worse.
CORRELATION_S = 20.0
REFERENCE_START_STD = np.deg2rad(0.5)  # [rad] of the heading that defines x, at the end of the start pose; assumption
UNKNOWN_DRIFT_PSD = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance: 3° in a minute; assumption
MIN_STEP_VARIANCE = 1e-10  # [rad²] of the random walk between two knots
OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
HINGE_HEADING_MARGIN = np.deg2rad(10.0)  # [rad] that headings may have drifted before a hinge row is an outlier


class HeadingCorrection(NamedTuple):
    """The correction of headings: residuals before and after, and the largest correction."""

    gap_rms_mm: tuple[float, float] | None  # in the phases of closures
    hinge_residual_rms_deg: Mapping[str, tuple[float, float]]  # joint → the segment below against its hinge's plane
    max_correction_deg: Mapping[str, float]  # segment → largest rotation about the vertical


class HeadingCorrector:
    """Corrects the headings of a recording in two passes over its chunks.

    First pass: `add_observations` of every chunk, then `solve`. Second pass: `correct` every chunk. The result does not
    depend on the chunks, because sums are formed knot by knot.

    Parameters
    ----------
    chunk : the first chunk
    segments : names of the measured segments
    start_end : [s] end of the start pose, after which headings drift
    model : the body with the subject's lengths

    Attributes
    ----------
    is_chain_complete : whether all segments between the points of the body's closures are measured, or both segments of
        a hinge where it has no closures; otherwise there is no correction
    has_observations : whether there is a hinge, or a phase of a closure that ends after the start pose
    """

    def __init__(
        self, chunk: Recording, segments: Collection[str], start_end: float, subject: Subject, model: BodyModel
    ) -> None:
        self._subject, self._start_end, self._model = subject, start_end, model
        self._start_frames = StartFrames(table=model.table)
        self._closures, of_body = _find_closures(chunk, segments, model)
        # A hinge axis is relative to the calibrated mounts and holds as long as they do.
        hinges = subject.hinges if not chunk.remounted else {}
        table = model.table
        self._hinges = {name: hinge for name, hinge in hinges.items() if {*_hinged(table, name)} <= set(segments)}
        self.is_chain_complete = bool(self._closures) or (not of_body and bool(self._hinges))
        used = {part.sensor for closure in self._closures for part in closure.parts}
        used |= {segment for name in self._hinges for segment in _hinged(table, name)}
        self._chain = tuple(name for name in table.segments if name in used)
        self.has_observations = bool(self._hinges) or any(
            end >= start_end for closure in self._closures for _, end in closure.intervals
        )
        self._stride = max(1, round(chunk.rate_hz / SAMPLE_RATE_HZ))
        self._information_weight = 1.0 / max(1.0, CORRELATION_S * chunk.rate_hz / self._stride)
        self._first_time: float | None = None  # [s] of the first decimated sample
        self._counts = [0, 0]  # samples so far in each pass
        self._open_knot: tuple[np.ndarray, dict[str, np.ndarray]] | None = None  # samples of the last knot
        self._sums: list[tuple[np.ndarray, np.ndarray]] = []  # information matrices and vectors of complete knots
        self._has_rows = False
        self._knot_variances: dict[str, list[np.ndarray]] = {}  # name → the filter's heading variance [rad²]
        self._recorded_knots = 0  # number of these variances
        self._last_variance: dict[str, tuple[float, float]] = {}  # name → time and variance of the last sample
        self._gaps = {stage: _RmsAccumulator() for stage in ("before", "after")}
        self._hinge_rms = {stage: {joint: _RmsAccumulator() for joint in self._hinges} for stage in ("before", "after")}
        self._max_correction_deg = dict.fromkeys(self._chain, 0.0)

    def add_observations(self, chunk: Recording, orientations: SegmentOrientations) -> None:
        """Add the observations of a chunk, in the first pass."""
        time, quats = self._decimate(chunk, orientations, 0)
        if len(time) and self._first_time is None:
            self._first_time = float(time[0])
        self._record_variances(chunk, orientations)
        if self._open_knot is not None:
            time = np.concatenate([self._open_knot[0], time])
            quats = {name: np.concatenate([self._open_knot[1][name], quat]) for name, quat in quats.items()}
        if not len(time):
            return
        knot = self._find_knots(time)
        complete = int(np.searchsorted(knot, knot[-1]))
        self._open_knot = time[complete:], {name: quat[complete:] for name, quat in quats.items()}
        if complete:
            self._sum_knots(time[:complete], {name: quat[:complete] for name, quat in quats.items()})

    def solve(self) -> bool:
        """Estimate the heading errors; return False where nothing observes them."""
        if self._open_knot is None or self._first_time is None:
            return False
        self._sum_knots(*self._open_knot)
        if not self._has_rows:
            return False
        information, information_vector = (np.concatenate(parts) for parts in zip(*self._sums, strict=True))
        knot_times = self._first_time + KNOT_S * (np.arange(len(information)) + 0.5)
        step_variances = np.full((len(knot_times), len(self._chain)), UNKNOWN_DRIFT_PSD * KNOT_S)
        for i, name in enumerate(self._chain):
            if name in self._knot_variances:
                variance_at_knots = np.concatenate(self._knot_variances[name])
                missing = len(knot_times) + 1 - len(variance_at_knots)
                variance_at_knots = np.concatenate([variance_at_knots, np.full(missing, self._last_variance[name][1])])
                step_variances[:, i] = np.maximum(np.diff(variance_at_knots), MIN_STEP_VARIANCE)
        start_stds = [
            REFERENCE_START_STD
            if name == self._model.table.reference
            else self._model.table.segments[name].repeat_std[2]
            for name in self._chain
        ]
        self._heading_errors, self._cov = _smooth_random_walk(
            information, information_vector, step_variances, np.array(start_stds)
        )
        self._knot_times = knot_times  # the errors are constant before the first and after the last
        return True

    def correct(self, chunk: Recording, orientations: SegmentOrientations) -> SegmentOrientations:
        """Return the chunk's orientations with corrected headings, in the second pass; adds its residuals."""
        corrected, covariance = dict(orientations.quat_WL), dict(orientations.covariance_W)
        for i, name in enumerate(self._chain):
            delta = np.interp(chunk.time, self._knot_times, self._heading_errors[:, i])
            R_delta = Rotation.from_rotvec(delta[:, None] * [0.0, 0.0, 1.0])
            corrected[name] = (R_delta * Rotation.from_quat(corrected[name])).as_quat()
            self._max_correction_deg[name] = max(self._max_correction_deg[name], float(np.degrees(np.abs(delta).max())))
            filter_cov = _compute_heading_covariance(orientations, name)
            if filter_cov is not None:
                variance = np.interp(chunk.time, self._knot_times, self._cov[:, i, i])
                with_heading, filter_var = filter_cov
                start = compute_start_heading_var(chunk, name, self._subject, self._start_frames)
                covariance[name] = _reduce_heading_covariance(
                    covariance[name], with_heading, filter_var + start, variance
                )
        result = replace(orientations, quat_WL=corrected, covariance_W=covariance)
        time, quats = self._decimate(chunk, result, 1)
        self._add_residuals("after", time, {name: Rotation.from_quat(quat) for name, quat in quats.items()})
        return result

    def summarize(self) -> HeadingCorrection:
        """Return the residuals and the largest correction of the chunks so far."""
        gaps, hinge_rms = self._gaps, self._hinge_rms
        return HeadingCorrection(
            gap_rms_mm=(1e3 * gaps["before"].value, 1e3 * gaps["after"].value) if gaps["before"].count else None,
            hinge_residual_rms_deg={
                joint: (
                    float(np.degrees(hinge_rms["before"][joint].value)),
                    float(np.degrees(hinge_rms["after"][joint].value)),
                )
                for joint in self._hinges
            },
            max_correction_deg=dict(self._max_correction_deg),
        )

    def _decimate(
        self, chunk: Recording, orientations: SegmentOrientations, pass_index: int
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return times (m,) [s] and orientations (m, 4) at `SAMPLE_RATE_HZ` after the start pose."""
        rows = np.arange(-self._counts[pass_index] % self._stride, len(chunk), self._stride)
        self._counts[pass_index] += len(chunk)
        rows = rows[chunk.time[rows] >= self._start_end]
        return chunk.time[rows], {name: orientations.quat_WL[name][rows] for name in self._chain}

    def _find_knots(self, time: np.ndarray) -> np.ndarray:
        """Return the knot (m,) of each time [s]."""
        return np.floor((time - self._first_time) / KNOT_S).astype(int)

    def _sum_knots(self, time: np.ndarray, quats: Mapping[str, np.ndarray]) -> None:
        """Add the information matrices and vectors of complete knots from their samples."""
        R = {name: Rotation.from_quat(quat) for name, quat in quats.items()}
        self._add_residuals("before", time, R)
        complete_knots = sum(len(matrices) for matrices, _ in self._sums)
        knot = self._find_knots(time) - complete_knots
        count, size = int(knot[-1]) + 1, len(self._chain)
        information, information_vector = np.zeros((count, size, size)), np.zeros((count, size))
        for row in (
            *(_build_gap_rows(R, self._model, self._subject, c, c.holds(time)) for c in self._closures),
            *(_build_hinge_rows(R, self._model, self._subject, joint) for joint in self._hinges),
        ):
            weight = self._information_weight * row.weight[:, None]
            np.add.at(information, knot[row.sample], np.einsum("na,nb->nab", weight * row.H, row.H))
            np.add.at(information_vector, knot[row.sample], -weight * row.H * row.r[:, None])
            self._has_rows |= len(row.sample) > 0
        self._sums.append((information, information_vector))

    def _add_residuals(self, stage: str, time: np.ndarray, R: Mapping[str, Rotation]) -> None:
        """Add the residuals of closures and hinges before or after the correction."""
        for closure in self._closures:
            closed = closure.holds(time)
            if closed.any():
                gap = closure.vectors(R, self._model).sum(axis=0)
                self._gaps[stage].add(np.sum(gap[closed] ** 2, axis=1))
        if len(time):
            for joint in self._hinges:
                self._hinge_rms[stage][joint].add(_compute_hinge_residual(R, self._model, self._subject, joint) ** 2)

    def _record_variances(self, chunk: Recording, orientations: SegmentOrientations) -> None:
        """Record the filters' heading variances at the end of the start pose and in the middles of the knots."""
        # The start pose may end in a chunk whose first used sample is in the next one.
        times = np.array([self._start_end] if self._recorded_knots == 0 else [])
        if self._first_time is not None:
            last = int(np.floor((chunk.time[-1] - self._first_time) / KNOT_S - 0.5))
            times = np.append(
                times, self._first_time + KNOT_S * (np.arange(max(0, self._recorded_knots - 1), last + 1) + 0.5)
            )
        times = times[times <= chunk.time[-1]]
        self._recorded_knots += len(times)
        for name in self._chain:
            filter_cov = _compute_heading_covariance(orientations, name)
            if filter_cov is None:
                continue
            variance = filter_cov[1]
            variance_times = chunk.time
            if name in self._last_variance:  # the interval between two chunks
                variance_times = np.concatenate([[self._last_variance[name][0]], variance_times])
                variance = np.concatenate([[self._last_variance[name][1]], variance])
            self._knot_variances.setdefault(name, []).append(np.interp(times, variance_times, variance))
            self._last_variance[name] = float(variance_times[-1]), float(variance[-1])


class _RmsAccumulator:
    """Root mean square of added squares."""

    def __init__(self) -> None:
        self.count, self._sum = 0, 0.0

    def add(self, squares: np.ndarray) -> None:
        self.count, self._sum = self.count + len(squares), self._sum + float(squares.sum())

    @property
    def value(self) -> float:
        return float(np.sqrt(self._sum / self.count)) if self.count else float("nan")


class _Rows(NamedTuple):
    """Scalar measurements 0 = r + H δ + e."""

    sample: np.ndarray  # (m,) its index
    r: np.ndarray  # (m,)
    H: np.ndarray  # (m, k), δ of the chain in its order
    weight: np.ndarray  # (m,) 1 / variance of e


class _Closure(NamedTuple):
    """Two points that coincide in some intervals [s]."""

    intervals: tuple[tuple[float, float], ...]
    parts: tuple[Part, ...]  # of the way from the second point to the first one, in frames that equal W at zero
    girdles: tuple[tuple[str, float], ...]  # that move its points, each with its sign
    neutral: StartPose

    def holds(self, time: np.ndarray) -> np.ndarray:
        """(n,) bool: which times [s] lie in an interval."""
        closed = np.zeros(len(time), dtype=bool)
        for begin, end in self.intervals:
            closed |= (time >= begin) & (time <= end)
        return closed

    def rotations(self, R: Mapping[str, Rotation]) -> list[Rotation]:
        """The orientation of each part."""
        neutral = [self.neutral.R_WK[part.sensor] for part in self.parts]
        return [
            R[part.sensor] if np.array_equal(R_0, np.eye(3)) else R[part.sensor] * Rotation.from_matrix(R_0).inv()
            for part, R_0 in zip(self.parts, neutral, strict=True)
        ]

    def vectors(self, R: Mapping[str, Rotation], model: BodyModel) -> np.ndarray:
        """The vectors (k, n, 3) [m] in W of the parts; their sum is the gap."""
        lengths = np.array(list(model.lengths.values()))
        turned = zip(self.rotations(R), self.parts, strict=True)
        vectors = np.array([rotation.apply(part.vector(lengths)) for rotation, part in turned])
        sensors = [part.sensor for part in self.parts]
        motions = move_girdles(model, R, [name for name, _ in self.girdles])
        for name, sign in self.girdles:
            on = model.table.girdles[name].on
            vectors[sensors.index(on)] += sign * R[on].apply(motions[name].displacement)
        return vectors


def _find_closures(
    recording: Recording, segments: Collection[str], model: BodyModel
) -> tuple[tuple[_Closure, ...], bool]:
    """The closures of points that coincide whose segments are all measured, and whether the body has any.

    They are those of the protocols; each holds in the phase of its name, which the recording may lack.
    """
    neutral = StartPose(orient_links(model, pin.neutral(model.pin)))
    closures, of_body, seen = [], False, set[tuple[str, tuple[str, ...]]]()
    for name in PROTOCOLS:
        for closure in load_protocol(name).closures:
            if closure.kind != "coincide" or not set(closure.points) <= set(model.table.points):
                continue
            if (closure.phase, closure.points) in seen:
                continue
            seen.add((closure.phase, closure.points))
            of_body = True
            first, last = closure.points
            try:
                parts = find_parts(model, neutral, segments, [(first, 1.0), (last, -1.0)])
            except BadSession:
                continue
            girdles = find_girdle_signs(model, [(first, 1.0), (last, -1.0)])
            closures.append(_Closure(tuple(recording.phases.get(closure.phase, ())), parts, girdles, neutral))
    return tuple(closures), of_body


def _hinged(table: BodyTable, joint: str) -> tuple[str, str]:
    """The two segments of a hinge."""
    hinge = table.hinges[joint]
    return hinge.on, hinge.moves


def _build_gap_rows(
    R: Mapping[str, Rotation], model: BodyModel, subject: Subject, closure: _Closure, closed: np.ndarray
) -> _Rows:
    """Build three whitened rows for each sample at which the points coincide, without outliers."""
    v = closure.vectors(R, model)[:, closed]
    n = v.shape[1]
    eye = np.eye(3)
    covariance = np.tile(PALM_SLIP_STD**2 * eye, (n, 1, 1))
    for link in v:
        covariance += SEGMENT_ATTITUDE_STD**2 * (
            np.sum(link**2, axis=1)[:, None, None] * eye - np.einsum("na,nb->nab", link, link)
        )
    by_length = zip(closure.rotations(R), closure.parts, strict=True)
    J = sum(rotation.as_matrix()[closed] @ np.array(part.by_length) for rotation, part in by_length)  # (n, 3, lengths)
    shape_cov, k = subject.shape_covariance(model.table), len(model.lengths)
    J = np.concatenate((J, np.zeros((n, 3, len(shape_cov) - k))), axis=2)
    R_closed = {name: rotation[closed] for name, rotation in R.items()}
    motions = move_girdles(model, R_closed, [name for name, _ in closure.girdles]) if n else {}
    for name, sign in closure.girdles if n else ():
        girdle, motion = model.table.girdles[name], motions[name]
        R_on = R_closed[girdle.on].as_matrix()
        columns = np.arange(len(PARAMETERS)) + k + len(PARAMETERS) * list(model.table.girdles).index(name)
        J[:, :, columns] += sign * R_on @ motion.jacobian
        covariance += (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
    covariance += J @ shape_cov @ np.swapaxes(J, 1, 2)
    names = list(R)
    H = np.zeros((n, 3, len(names)))
    for part, link in zip(closure.parts, v, strict=True):
        H[:, :, names.index(part.sensor)] += np.cross([0.0, 0.0, 1.0], link)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = np.einsum("nab,nb->na", whiten, r), whiten @ H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    sample = np.repeat(np.flatnonzero(closed)[is_inlier], 3)
    return _Rows(sample, r[is_inlier].ravel(), H[is_inlier].reshape(-1, len(names)), np.ones(len(sample)))


def _compute_hinge_residual(R: Mapping[str, Rotation], model: BodyModel, subject: Subject, joint: str) -> np.ndarray:
    """Compute the angle (n,) [rad] of the segment below out of the plane of its hinge."""
    on, moves = _hinged(model.table, joint)
    along_O = R[on].inv().apply(R[moves].apply(model.table.segments[moves].along))
    return along_O @ subject.hinges[joint].axis


def _build_hinge_rows(R: Mapping[str, Rotation], model: BodyModel, subject: Subject, joint: str) -> _Rows:
    """Build a row for each sample from a hinge, without outliers."""
    on, moves = _hinged(model.table, joint)
    r = _compute_hinge_residual(R, model, subject, joint)
    heading_derivative_W = np.cross([0.0, 0.0, 1.0], R[moves].apply(model.table.segments[moves].along))
    derivative = R[on].inv().apply(heading_derivative_W) @ subject.hinges[joint].axis
    H, names = np.zeros((len(r), len(R))), list(R)
    H[:, names.index(moves)], H[:, names.index(on)] = derivative, -derivative
    std = subject.hinges[joint].std
    is_inlier = np.abs(r) < OUTLIER_STDS * std + HINGE_HEADING_MARGIN
    sample = np.flatnonzero(is_inlier)
    return _Rows(sample, r[is_inlier], H[is_inlier], np.full(len(sample), std**-2))


def _compute_heading_covariance(orientations: SegmentOrientations, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the filter's covariance of the heading with each axis of W (n, 3), and its variance (n,), both [rad²].

    None: the filter has no covariance.
    """
    orientation = orientations.orientation.get(name)
    if orientation is None or orientation.attitude_cov is None:
        return None
    R_VS = Rotation.from_quat(orientation.quat_WS)  # its W is the sensor's own world V
    with_heading_V = R_VS.apply(np.einsum("nab,nb->na", orientation.attitude_cov, R_VS.inv().apply([0.0, 0.0, 1.0])))
    R_WV = Rotation.from_rotvec([0.0, 0.0, orientations.heading_offset[name]])
    return R_WV.apply(with_heading_V), with_heading_V[:, 2]


def _smooth_random_walk(
    information: np.ndarray, information_vector: np.ndarray, step_variances: np.ndarray, start_stds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth k random walks: return means (knots, k) and covariances (knots, k, k).

    Parameters
    ----------
    information : (knots, k, k)
    information_vector : (knots, k) information matrix times measured value
    step_variances : (knots, k) [rad²] of the step that ends at a knot
    start_stds : (k,) [rad] at the end of the start pose
    """
    n, size = information_vector.shape
    x, P = np.zeros(size), np.diag(start_stds**2)
    before, filtered = [], []
    for k in range(n):
        P = P + np.diag(step_variances[k])
        before.append((x, P))
        P = np.linalg.inv(np.linalg.inv(P) + information[k])
        x = x + P @ (information_vector[k] - information[k] @ x)
        filtered.append((x, P))
    means, covs = [x], [P]
    for k in range(n - 2, -1, -1):
        gain = filtered[k][1] @ np.linalg.inv(before[k + 1][1])
        x = filtered[k][0] + gain @ (x - before[k + 1][0])
        P = filtered[k][1] + gain @ (P - before[k + 1][1]) @ gain.T
        means.append(x)
        covs.append(P)
    return np.array(means[::-1]), np.array(covs[::-1])


def _reduce_heading_covariance(
    cov_W: np.ndarray, filter_W: np.ndarray, filter_var: np.ndarray, heading_var: np.ndarray
) -> np.ndarray:
    """Reduce the heading variance by filter and start pose in covariances (n, 3, 3) to at most `heading_var` (n,).

    Variance from other sources, such as a mount's heading, is not observed by joined hands and elbows: it stays.
    """
    std_ratio = np.sqrt(np.minimum(1.0, heading_var / filter_var))
    removed = (1.0 - std_ratio)[:, None] * filter_W
    reduced = cov_W.copy()
    reduced[:, 2, :2] -= removed[:, :2]
    reduced[:, :2, 2] -= removed[:, :2]
    reduced[:, 2, 2] -= (1.0 - std_ratio**2) * filter_var
    return reduced
