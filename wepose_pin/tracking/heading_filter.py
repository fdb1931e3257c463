"""A Kalman filter of heading errors over knots of a recording, and what observes them.

δ_i is the heading error of segment i, on the left in W: R_WL,true = Rz(δ) R_WL. It is a random walk whose step variance
is the growth of the orientation filter's heading variance, and a rate that changes slowly, by a bias that the
orientation filter has not found. Observed are differences of two or more:

- the acceleration of a joint, which two sensors measure (`joint_accelerations`), with their levers as unknowns;
- a hinge: the segment below stays in the plane across its axis, n · R_Oᵀ R_M e = 0, with e its long axis;
- ranges of motion: the hinge bends within its range;
- two points that coincide (`Closure`): palms in a phase `clasp`, or in a clasp that was found.

What tissue, tilted axes and travelling joints add is correlated over seconds to the whole recording. It is part of the
state, so that a long recording does not average it away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..calibration.conditions import Part, StartPose
from ..model import BodyModel, move_girdles
from ..model.girdle import PARAMETERS
from ..subject import Subject
from .joint_accelerations import JointPair, JointSums

E_Z = np.array([0.0, 0.0, 1.0])
UNKNOWN_DRIFT_PSD = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance: 3° in a minute; assumption
MIN_DRIFT_PSD = 1e-10  # [rad²/s]
LEAP, USUAL_S = 10.0, 60.0  # times the largest gain of a filter's variance within so long [s], above which it leaps
OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
HINGE_HEADING_MARGIN = np.deg2rad(10.0)  # [rad] that headings may have drifted before a hinge row is an outlier
ITERATIONS = 2  # linearizations of an update


@dataclass(frozen=True)
class ClaspTest:
    """When points of a closure are found to coincide; lengths are rms over the time.

    With the lengths of the population the joined hands of simulated people seem up to 25 cm apart, and are not found.

    Parameters
    ----------
    seconds : [s] for which they do
    gap : [m] most between them, once the headings have closed it as far as their uncertainty lets them
    change : [m] most around the mean of that gap
    height : [m] most of the gap's vertical part
    speed : [m/s] least of each of them in the frame of the reference segment
    speed_ratio : most of the gap's rate against that
    """

    seconds: float = 2.0
    gap: float = 0.06
    change: float = 0.03
    height: float = 0.12
    speed: float = 0.08
    speed_ratio: float = 0.3


OFFLINE_CLASP = ClaspTest()
# Over the shorter time of a clasp of two seconds tissue moves the gap by more of the hands' speed.
CAUSAL_CLASP = ClaspTest(change=0.04, gap=0.08, speed_ratio=0.8)


@dataclass(frozen=True)
class HeadingNoise:
    """What disturbs headings and their observations; standard deviations, of a person unless said otherwise.

    Parameters
    ----------
    drift_psd : [rad²/s] of a heading in motion, beside a rate that changes slowly: scale errors, tissue's wobble
    rate_std : [rad/s] drift of a heading, at the start
    rate_change_psd : [rad²/s³] of its random walk: a sensor warms up under its strap
    joint_std, girdle_std : [rad] by which the acceleration of a joint is off in heading, as tissue and a travelling
        shoulder follow the motion; it changes within `joint_correlation_s`
    acceleration_std : [m/s²] least misfit of two sides of a joint; the recent misfit where that is larger
    acceleration_correlation_s : [s] of the misfit
    twist_std, twist_correlation_s : [rad], [s] by which tissue turns a sensor about its segment's long axis
    hinge_std, hinge_correlation_s : [rad], [s] by which the segment below leaves the plane of a hinge otherwise
    axis_std, tilt_std : [rad] of a calibrated hinge's axis about the long axis of its segment, and across
    range_std : [rad] of a hinge's range
    slip_std : [m] between palms of a clasp that was found: a cup may be between them
    closure_correlation_s : [s] of residuals of a closure
    """

    drift_psd: float = float(np.deg2rad(0.12) ** 2)
    rate_std: float = float(np.deg2rad(0.1))
    rate_change_psd: float = float(np.deg2rad(0.1) ** 2 / 900.0)
    joint_std: float = float(np.deg2rad(0.5))
    girdle_std: float = float(np.deg2rad(0.9))
    joint_correlation_s: float = 60.0
    acceleration_std: float = 0.07
    acceleration_correlation_s: float = 0.4
    twist_std: float = float(np.deg2rad(7.0))
    twist_correlation_s: float = 4.0
    hinge_std: float = float(np.deg2rad(4.0))
    hinge_correlation_s: float = 5.0
    axis_std: float = float(np.deg2rad(5.0))
    tilt_std: float = float(np.deg2rad(2.0))
    range_std: float = float(np.deg2rad(10.0))
    slip_std: float = 0.03
    closure_correlation_s: float = 20.0


PERSON_NOISE = HeadingNoise()
MECHANISM_NOISE = HeadingNoise(
    joint_std=float(np.deg2rad(0.5)),
    girdle_std=float(np.deg2rad(0.5)),
    twist_std=float(np.deg2rad(0.5)),
    hinge_std=float(np.deg2rad(0.5)),
)


class HingeAxis(NamedTuple):
    """A hinge of two measured segments; vectors in the frame of `on`, `along` in that of `moves`; stds in [rad]."""

    joint: str
    on: int
    moves: int
    axis: np.ndarray
    on_along: np.ndarray
    along: np.ndarray
    range: tuple[float, float]  # [rad] of the angle from the long axis of `on` about the axis
    axis_std: float
    tilt_std: float
    std: float


class Way(NamedTuple):
    """The way from the root to a point, or from one point to another."""

    parts: tuple[Part, ...]  # in frames that equal W at zero
    girdles: tuple[tuple[str, float], ...]  # that move its ends, each with its sign
    neutral: StartPose

    def rotations(self, R: Mapping[str, Rotation]) -> list[Rotation]:
        """The orientation of each part."""
        neutral = [self.neutral.R_WK[part.sensor] for part in self.parts]
        return [
            R[part.sensor] if np.array_equal(R_0, np.eye(3)) else R[part.sensor] * Rotation.from_matrix(R_0).inv()
            for part, R_0 in zip(self.parts, neutral, strict=True)
        ]

    def vectors(self, R: Mapping[str, Rotation], model: BodyModel) -> np.ndarray:
        """The vectors (k, n, 3) [m] in W of the parts; their sum is the way."""
        lengths = np.array(list(model.lengths.values()))
        turned = zip(self.rotations(R), self.parts, strict=True)
        vectors = np.array([rotation.apply(part.vector(lengths)) for rotation, part in turned])
        sensors = [part.sensor for part in self.parts]
        motions = move_girdles(model, R, [name for name, _ in self.girdles])
        for name, sign in self.girdles:
            on = model.table.girdles[name].on
            vectors[sensors.index(on)] += sign * R[on].apply(motions[name].displacement)
        return vectors


class Closure(NamedTuple):
    """Two points that coincide in some intervals [s], those of a phase."""

    phase: str
    points: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    gap: Way  # from the second point to the first one
    ways: tuple[Way, ...]  # from the root to each of the points

    def holds(self, time: np.ndarray) -> np.ndarray:
        """(n,) bool: which times [s] lie in an interval."""
        closed = np.zeros(len(time), dtype=bool)
        for begin, end in self.intervals:
            closed |= (time >= begin) & (time <= end)
        return closed


class Knot(NamedTuple):
    """The observations of a knot, before headings are corrected."""

    end: float  # [s]
    time: np.ndarray  # (m,) [s] of the samples
    quat_WL: np.ndarray  # (m, k, 4) xyzw
    joints: tuple[JointSums | None, ...]
    heading_var: np.ndarray  # (k,) [rad²] of each orientation filter at the end; NaN: it has none
    lost: np.ndarray  # (k,) bool, whether a sensor has lost a sample


class Rows(NamedTuple):
    """Scalar measurements 0 = r + H δ + e."""

    sample: np.ndarray  # (m,) its index
    r: np.ndarray  # (m,)
    H: np.ndarray  # (m, k), δ of the segments in their order
    weight: np.ndarray  # (m,) 1 / variance of e


@dataclass(frozen=True)
class HeadingProblem:
    """What there is to observe headings by.

    Parameters
    ----------
    names : segments, in the order of δ
    drift_psd : (k,) [rad²/s] most that a heading gains by what is not a rate that changes slowly
    start_var, mount_var : (k,) [rad²] of the headings at the end of the start pose, by the pose and by the mounts
    levers_at : (pairs, 6) [m] where levers are known; None: they are unknowns
    causal : headings are corrected as samples come; a short clasp then counts as one observation
    """

    names: tuple[str, ...]
    model: BodyModel
    subject: Subject
    pairs: tuple[JointPair, ...]
    hinges: tuple[HingeAxis, ...]
    closures: tuple[Closure, ...]
    noise: HeadingNoise
    knot_s: float
    samples_per_knot: int
    drift_psd: np.ndarray
    start_var: np.ndarray
    mount_var: np.ndarray
    levers_at: np.ndarray | None = None
    causal: bool = False

    @property
    def size(self) -> int:
        levers = 0 if self.levers_at is not None else 6 * len(self.pairs)
        return 2 * len(self.names) + len(self.pairs) + 3 * len(self.hinges) + levers

    @property
    def kept(self) -> int:
        """Number of states without levers."""
        return 2 * len(self.names) + len(self.pairs) + 3 * len(self.hinges)

    def find_segment_variance(self, index: int, variance: Any) -> Any:
        """Find the variance [rad²] of a segment's heading near the start pose, from that of its sensor's world.

        δ begins at s − ε_z, by errors s of the start pose and ε_z of the mount; a segment that hangs is off by δ + ε_z.
        """
        start_var, mount_var = self.start_var[index], self.mount_var[index]
        share = mount_var / max(start_var + mount_var, 1e-12)
        return (1.0 - share) ** 2 * variance + share * start_var

    def column(self, part: str, index: int) -> int:
        """Return the column of a state."""
        k, j, h = len(self.names), len(self.pairs), len(self.hinges)
        first = {
            "heading": 0,
            "rate": k,
            "joint": 2 * k,
            "axis": 2 * k + j,
            "twist": 2 * k + j + h,
            "tilt": 2 * k + j + 2 * h,
        }
        return first[part] + index

    def lever_columns(self, pair: int) -> slice:
        first = self.kept + 6 * pair
        return slice(first, first + 6)


class HeadingFilter:
    """The state and its covariance, knot by knot.

    Attributes
    ----------
    x, P : (n,), (n, n); the first k are δ [rad]
    """

    def __init__(self, problem: HeadingProblem) -> None:
        self.problem = problem
        noise, k = problem.noise, len(problem.names)
        self.x, std = np.zeros(problem.size), np.zeros(problem.size)
        std[:k] = np.sqrt(problem.start_var + problem.mount_var)
        std[k : 2 * k] = noise.rate_std
        decay = np.ones(problem.size)
        for i, pair in enumerate(problem.pairs):
            column = problem.column("joint", i)
            std[column] = noise.girdle_std if pair.travels else noise.joint_std
            decay[column] = np.exp(-problem.knot_s / noise.joint_correlation_s)
            if problem.levers_at is None:
                self.x[problem.lever_columns(i)], std[problem.lever_columns(i)] = pair.levers, pair.lever_std
        for i, hinge in enumerate(problem.hinges):
            std[problem.column("axis", i)], std[problem.column("tilt", i)] = hinge.axis_std, hinge.tilt_std
            std[problem.column("twist", i)] = noise.twist_std
            decay[problem.column("twist", i)] = np.exp(-problem.knot_s / noise.twist_correlation_s)
        self.P = np.diag(std**2)
        self._decay, self._steady = decay, (1.0 - decay**2) * std**2
        self._misfit = np.full(len(problem.pairs), noise.acceleration_std**2)  # [m²/s⁴] recent mean of each axis
        self._last_var: np.ndarray | None = None
        self._lost_before = np.zeros(k, dtype=bool)  # whether a sensor has lost a sample in the last knot
        self._usual_gain = np.zeros(k)  # [rad²] of the orientation filter's variance in a knot, largest of late
        self._clasps = ClaspDetector(problem)
        self._closed_before = set[tuple[str, ...]]()  # points that coincided in the last knot
        self.clasps: list[tuple[float, float]] = []  # [s] when points were found to coincide

    def reset(self, headings: np.ndarray) -> None:
        """Set δ (k,) [rad] as known to within the start pose."""
        k = len(headings)
        self.x[:k] = headings
        self.P[:k, :], self.P[:, :k] = 0.0, 0.0
        self.P[np.arange(k), np.arange(k)] = self.problem.start_var + self.problem.mount_var

    def step(self, knot: Knot) -> np.ndarray:
        """Predict to a knot and update by it; return the step variance (k,) [rad²] that was added."""
        step_var = self.find_step_variance(knot)
        self.predict(step_var)
        for _ in self.update(knot):
            pass
        return step_var

    def step_gradually(self, knot: Knot) -> Iterator[None]:
        """Do as `step`, in parts of a millisecond or two; the state is valid after the last one."""
        self.predict(self.find_step_variance(knot))
        yield
        yield from self.update(knot)

    def find_step_variance(self, knot: Knot) -> np.ndarray:
        """Find the variance (k,) [rad²] that the headings have gained in a knot beside their rates.

        That of the orientation filter includes its gyroscope's bias, which is a rate here: it counts up to `drift_psd`,
        and as a whole where samples were lost or the rate was cut off, which make it leap.
        """
        knot_s, k = self.problem.knot_s, len(self.problem.names)
        if self._last_var is None:
            self._last_var = knot.heading_var
        gained = np.maximum(knot.heading_var - self._last_var, MIN_DRIFT_PSD * knot_s)
        self._last_var = knot.heading_var
        known = np.isfinite(gained)
        leaps = known & (knot.lost | (gained > LEAP * np.maximum(self._usual_gain, self.problem.drift_psd * knot_s)))
        self._usual_gain = np.maximum(self._usual_gain * np.exp(-knot_s / USUAL_S), np.where(known, gained, 0.0))
        limited = np.where(leaps, gained, np.minimum(gained, self.problem.drift_psd * knot_s))
        return np.where(known, limited, UNKNOWN_DRIFT_PSD * knot_s * np.ones(k))

    def transition(self) -> np.ndarray:
        """Return F (n, n) of one knot."""
        k = len(self.problem.names)
        F = np.diag(self._decay)
        F[:k, k : 2 * k] = self.problem.knot_s * np.eye(k)
        return F

    def predict(self, step_var: np.ndarray) -> None:
        k, F = len(self.problem.names), self.transition()
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + np.diag(self._steady)
        self.P[np.arange(k), np.arange(k)] += step_var
        rates = np.arange(k, 2 * k)
        self.P[rates, rates] += self.problem.noise.rate_change_psd * self.problem.knot_s

    def update(self, knot: Knot) -> Iterator[None]:
        """Update by a knot's observations, then by the points that are found to coincide in it; yield between parts."""
        before, P = self.x, self.P
        x, information = before, np.zeros_like(P)
        for iteration in range(ITERATIONS):
            information, vector = np.zeros_like(P), np.zeros(len(x))
            self._add_joints(knot, x, information, vector, last=iteration == ITERATIONS - 1)
            yield
            yield from self._add_rows(knot, x, information, vector)
            x = self._fuse(x, information, vector)
            yield
        self.x = x
        self.P = _symmetric(np.linalg.solve(np.eye(len(x)) + P @ information, P))
        yield
        found = self._clasps.find(knot, self)
        yield
        unsure = self._find_unsure(knot)
        self._lost_before = knot.lost
        closed = {closure.points for closure in self.problem.closures if closure.holds(knot.time).any()}
        for points, rows in () if unsure.any() else found:
            closed.add(points)
            k = len(self.problem.names)
            information, vector = np.zeros_like(P), np.zeros(len(x))
            weight = rows.weight / self._find_correlation(points, knot)
            information[:k, :k] = rows.H.T @ (weight[:, None] * rows.H)
            vector[:k] = rows.H.T @ (weight * rows.r)
            self.x = self._fuse(self.x, information, vector)
            self.P = _symmetric(np.linalg.solve(np.eye(len(x)) + self.P @ information, self.P))
            begin = float(knot.time[0])
            if self.clasps and begin - self.clasps[-1][1] < 1.5 * self.problem.knot_s:
                begin = self.clasps.pop()[0]
            self.clasps.append((begin, knot.end))
            yield
        self._closed_before = closed

    def _find_correlation(self, points: tuple[str, ...], knot: Knot) -> float:
        """Find the number of samples of a closure that count as one observation.

        Causally all of a clasp's first knot: a clasp may be shorter than its residuals are correlated.
        """
        rate = self.problem.samples_per_knot / self.problem.knot_s
        if self.problem.causal and points not in self._closed_before:
            return float(len(knot.time))
        return max(1.0, self.problem.noise.closure_correlation_s * rate)

    def _find_unsure(self, knot: Knot) -> np.ndarray:
        """Find (k,) bool the sensors that are lost or were in the last knot."""
        return knot.lost | self._lost_before

    def _fuse(self, x: np.ndarray, information: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Minimize (y − before)ᵀ P⁻¹ (y − before) + (y − x)ᵀ Λ (y − x) + 2 vectorᵀ (y − x) over y."""
        right = self.P @ (information @ (x - self.x) - vector)
        return np.asarray(self.x + np.linalg.solve(np.eye(len(x)) + self.P @ information, right))

    def _add_joints(
        self, knot: Knot, x: np.ndarray, information: np.ndarray, vector: np.ndarray, *, last: bool
    ) -> None:
        problem = self.problem
        rate = problem.samples_per_knot / problem.knot_s
        names = problem.names
        for i, (pair, sums) in enumerate(zip(problem.pairs, knot.joints, strict=True)):
            if sums is None or not sums.samples:
                continue
            near, far, joint = names.index(pair.near), names.index(pair.far), problem.column("joint", i)
            levers = problem.levers_at[i] if problem.levers_at is not None else x[problem.lever_columns(i)]
            JJ, Je, cost = sums.linearize(x[near] - x[far] + x[joint], levers)
            misfit = max(cost / (3.0 * sums.samples), self._misfit[i], problem.noise.acceleration_std**2)
            weight = 1.0 / (misfit * max(1.0, problem.noise.acceleration_correlation_s * rate))
            columns = np.array([near, far, joint])
            signs = np.array([1.0, -1.0, 1.0])
            if problem.levers_at is None:
                at = np.arange(problem.size)[problem.lever_columns(i)]
                columns = np.concatenate([columns, at])
                G = np.zeros((7, 9))
                G[0, :3], G[1:, 3:] = signs, np.eye(6)
            else:
                G, JJ, Je = signs[None], JJ[:1, :1], Je[:1]
            information[np.ix_(columns, columns)] += weight * G.T @ JJ @ G
            vector[columns] += weight * G.T @ Je
            if last:
                share = 1.0 - np.exp(-problem.knot_s / 20.0)
                self._misfit[i] += share * (cost / (3.0 * sums.samples) - self._misfit[i])

    def _add_rows(self, knot: Knot, x: np.ndarray, information: np.ndarray, vector: np.ndarray) -> Iterator[None]:
        """Add the hinges and the closures that hold; yield between them."""
        problem = self.problem
        k, noise = len(problem.names), problem.noise
        rate = problem.samples_per_knot / problem.knot_s
        R = self.correct(knot, x)
        # While a sensor is lost, and while its tilt comes back, its segment is where nobody knows.
        unsure = self._find_unsure(knot)
        for i, hinge in enumerate(problem.hinges):
            if unsure[hinge.on] or unsure[hinge.moves]:
                continue
            yield
            self._add_range(R, hinge, information, vector)
            columns = [hinge.moves, hinge.on] + [problem.column(part, i) for part in ("axis", "twist", "tilt")]
            r, H = linearize_hinge(R[hinge.on], R[hinge.moves], hinge)
            r = r + H[:, 2:] @ x[columns[2:]]
            inlier = np.abs(r) < OUTLIER_STDS * hinge.std + HINGE_HEADING_MARGIN
            weight = inlier / (hinge.std**2 * max(1.0, noise.hinge_correlation_s * rate))
            information[np.ix_(columns, columns)] += H.T @ (weight[:, None] * H)
            vector[columns] += H.T @ (weight * r)
        named = dict(zip(problem.names, R, strict=True))
        for closure in problem.closures:
            closed = closure.holds(knot.time)
            used = [problem.names.index(part.sensor) for part in closure.gap.parts if part.sensor in problem.names]
            if closed.any() and not unsure[used].any():
                yield
                rows = build_gap_rows(named, problem.model, problem.subject, closure, closed)
                weight = rows.weight / self._find_correlation(closure.points, knot)
                information[:k, :k] += rows.H.T @ (weight[:, None] * rows.H)
                vector[:k] += rows.H.T @ (weight * rows.r)

    def _add_range(self, R: Sequence[Rotation], hinge: HingeAxis, information: np.ndarray, vector: np.ndarray) -> None:
        """Add the samples at which a hinge is bent beyond its range."""
        noise = self.problem.noise
        excess, slope = linearize_range(R[hinge.on], R[hinge.moves], hinge)
        rate = self.problem.samples_per_knot / self.problem.knot_s
        weight = (excess != 0.0) / (noise.range_std**2 * max(1.0, noise.hinge_correlation_s * rate))
        columns, H = [hinge.moves, hinge.on], np.stack([slope, -slope], axis=1)
        information[np.ix_(columns, columns)] += H.T @ (weight[:, None] * H)
        vector[columns] += H.T @ (weight * excess)

    def correct(self, knot: Knot, x: np.ndarray) -> list[Rotation]:
        """Return the corrected orientations of the samples, segment by segment."""
        return [
            Rotation.from_rotvec(x[i] * E_Z) * Rotation.from_quat(knot.quat_WL[:, i])
            for i in range(len(self.problem.names))
        ]


def linearize_hinge(R_on: Rotation, R_moves: Rotation, hinge: HingeAxis) -> tuple[np.ndarray, np.ndarray]:
    """Angle (n,) [rad] out of the hinge's plane, and its slope (n, 5).

    By the headings of `moves` and `on`, the axis about the long axis of `on`, tissue there, and the axis across.
    """
    n, a = hinge.axis, hinge.on_along
    along_W = R_moves.apply(hinge.along)
    v = R_on.inv().apply(along_W)
    by_heading = R_on.inv().apply(np.cross(E_Z, along_W)) @ n
    by_twist = -np.cross(a, v) @ n
    by_tilt = -np.cross(np.cross(a, n), v) @ n
    return v @ n, np.stack([by_heading, -by_heading, by_twist, by_twist, by_tilt], axis=1)


def linearize_range(R_on: Rotation, R_moves: Rotation, hinge: HingeAxis) -> tuple[np.ndarray, np.ndarray]:
    """Angle (n,) [rad] beyond a hinge's range, signed, and its slope (n,) by the heading of `moves`."""
    n, a = hinge.axis, hinge.on_along
    along_W = R_moves.apply(hinge.along)
    v, dv = R_on.inv().apply(along_W), R_on.inv().apply(np.cross(E_Z, along_W))
    b = np.cross(n, a)
    sine, cosine = v @ b, v @ a
    angle = np.arctan2(sine, cosine)
    low, high = hinge.range
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    off = np.angle(np.exp(1j * (angle - middle)))
    excess = np.sign(off) * np.maximum(np.abs(off) - half, 0.0)
    slope = ((dv @ b) * cosine - (dv @ a) * sine) / np.maximum(sine**2 + cosine**2, 0.1)
    return excess, slope


class ClaspDetector:
    """Finds the knots in which two points of a closure stay together while both move.

    The gap between them, once the headings have closed it as far as their uncertainty lets them, is short and constant,
    and its rate is small beside those of the points in the frame of the reference segment.
    """

    def __init__(self, problem: HeadingProblem) -> None:
        # Of a clasp of that many seconds so many knots are whole, whenever it begins.
        self._test = CAUSAL_CLASP if problem.causal else OFFLINE_CLASP
        self._knots = max(2, int(self._test.seconds / problem.knot_s) - 1)
        self._recent: list[Knot] = []

    def find(self, knot: Knot, state: HeadingFilter) -> list[tuple[tuple[str, ...], Rows]]:
        """Return the points that coincide and the rows of the gap between them in the last knot."""
        problem, test = state.problem, self._test
        names, reference = problem.names, problem.model.table.reference
        if not problem.closures or reference not in names:
            return []
        self._recent = [*self._recent, knot][-self._knots :]
        if len(self._recent) < self._knots and len(self._recent) * problem.knot_s < 0.8 * test.seconds:
            return []
        k, rate = len(names), problem.samples_per_knot / problem.knot_s
        quats = np.concatenate([each.quat_WL for each in self._recent])
        time = np.concatenate([each.time for each in self._recent])
        if len(time) < 2:
            return []
        R = {
            name: Rotation.from_rotvec(state.x[i] * E_Z) * Rotation.from_quat(quats[:, i])
            for i, name in enumerate(names)
        }
        found = []
        seen = set[tuple[str, ...]]()
        for closure in problem.closures:
            if closure.points in seen or closure.holds(knot.time).any():
                continue
            seen.add(closure.points)
            points = R[reference].inv().apply
            paths = [points(path) for path in (way.vectors(R, problem.model).sum(axis=0) for way in closure.ways)]
            speed = min(float(np.sqrt(np.mean(np.sum(np.gradient(p, time, axis=0) ** 2, axis=1)))) for p in paths)
            v = closure.gap.vectors(R, problem.model)
            gap = v.sum(axis=0)
            if speed < test.speed or np.abs(gap[:, 2]).max() > test.height:
                continue
            H = np.zeros((len(time), 3, k))
            for part, link in zip(closure.gap.parts, v, strict=True):
                H[:, :, names.index(part.sensor)] += np.cross(E_Z, link)
            # The headings that close the gap best, within their covariance.
            P, flat, r = state.P[:k, :k], H.reshape(-1, k), gap.ravel()
            weight = 1.0 / (problem.noise.slip_std**2 * max(1.0, test.seconds * rate))
            turn = -np.linalg.solve(np.eye(k) + P @ (weight * flat.T @ flat), P @ (weight * flat.T @ r))
            closed = gap + H @ turn
            change = np.sqrt(np.mean(np.sum((closed - closed.mean(axis=0)) ** 2, axis=1)))
            drift = np.sqrt(np.mean(np.sum(np.gradient(closed, time, axis=0) ** 2, axis=1)))
            length = np.sqrt(np.mean(np.sum(closed**2, axis=1)))
            if length > test.gap or change > test.change or drift > test.speed_ratio * speed:
                continue
            named = {name: R[name][-len(knot.time) :] for name in names}
            joined = np.ones(len(knot.time), dtype=bool)
            slip_std = problem.noise.slip_std
            rows = build_gap_rows(named, problem.model, problem.subject, closure, joined, slip_std)
            found.append((closure.points, rows))
        return found


def _symmetric(P: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (P + P.T))


def build_gap_rows(
    R: Mapping[str, Rotation],
    model: BodyModel,
    subject: Subject,
    closure: Closure,
    closed: np.ndarray,
    slip_std: float = PALM_SLIP_STD,
) -> Rows:
    """Build three whitened rows for each sample at which the points coincide, without outliers."""
    v = closure.gap.vectors(R, model)[:, closed]
    n = v.shape[1]
    eye = np.eye(3)
    covariance = np.tile(slip_std**2 * eye, (n, 1, 1))
    for link in v:
        covariance += SEGMENT_ATTITUDE_STD**2 * (
            np.sum(link**2, axis=1)[:, None, None] * eye - np.einsum("na,nb->nab", link, link)
        )
    by_length = zip(closure.gap.rotations(R), closure.gap.parts, strict=True)
    J = sum(rotation.as_matrix()[closed] @ np.array(part.by_length) for rotation, part in by_length)  # (n, 3, lengths)
    shape_cov, k = subject.shape_covariance(model.table), len(model.lengths)
    J = np.concatenate((J, np.zeros((n, 3, len(shape_cov) - k))), axis=2)
    R_closed = {name: rotation[closed] for name, rotation in R.items()}
    girdles = closure.gap.girdles if n else ()
    motions = move_girdles(model, R_closed, [name for name, _ in girdles])
    for name, sign in girdles:
        girdle, motion = model.table.girdles[name], motions[name]
        R_on = R_closed[girdle.on].as_matrix()
        columns = np.arange(len(PARAMETERS)) + k + len(PARAMETERS) * list(model.table.girdles).index(name)
        J[:, :, columns] += sign * R_on @ motion.jacobian
        covariance += (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
    covariance += J @ shape_cov @ np.swapaxes(J, 1, 2)
    names = list(R)
    H = np.zeros((n, 3, len(names)))
    for part, link in zip(closure.gap.parts, v, strict=True):
        H[:, :, names.index(part.sensor)] += np.cross(E_Z, link)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = np.einsum("nab,nb->na", whiten, r), whiten @ H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    sample = np.repeat(np.flatnonzero(closed)[is_inlier], 3)
    return Rows(sample, r[is_inlier].ravel(), H[is_inlier].reshape(-1, len(names)), np.ones(len(sample)))


def smooth(
    problem: HeadingProblem, knots: Sequence[Knot]
) -> tuple[np.ndarray, np.ndarray, tuple[tuple[float, float], ...]]:
    """Filter and smooth the knots: means (m, k) and covariances (m, k, k) of δ, and the clasps [s] that were found.

    Rauch, Tung, Striebel 1965.
    """
    k = len(problem.names)
    forward = HeadingFilter(problem)
    filtered, steps = [], []
    for knot in knots:
        steps.append(forward.step(knot))
        filtered.append((forward.x, forward.P))
    F = forward.transition()
    x, P = filtered[-1]
    means, covs = [x[:k]], [P[:k, :k]]
    for i in range(len(knots) - 2, -1, -1):
        forward.x, forward.P = filtered[i]
        forward.predict(steps[i + 1])
        gain = np.linalg.solve(forward.P, F @ filtered[i][1]).T
        x = filtered[i][0] + gain @ (x - forward.x)
        P = _symmetric(filtered[i][1] + gain @ (P - forward.P) @ gain.T)
        means.append(x[:k])
        covs.append(P[:k, :k])
    return np.array(means[::-1]), np.array(covs[::-1]), tuple(forward.clasps)
