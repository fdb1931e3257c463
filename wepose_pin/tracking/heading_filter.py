"""A Kalman filter of heading errors over knots of a recording, and what observes them.

δ_i is the heading error of segment i, on the left in W: R_WL,true = Rz(δ) R_WL. It is a random walk whose step variance
is the growth of the orientation filter's heading variance, and a rate that changes slowly, by a bias that the
orientation filter has not found. The heading is that of the filter without its own corrections of the heading
(`undo_corrections`), so that it does not jump. Where the filter corrects its bias by Δb the rate changes by Δb, and
what it learned by that is an observation of the rate. Observed are differences of two or more as well:

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
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..alignment import PALM_SLIP_STD, SEGMENT_ATTITUDE_STD
from ..calibration.conditions import Part, StartPose
from ..compilation import kernel
from ..filters import AboutVertical
from ..model import BodyModel, GirdleMotion, move_girdles
from ..model.girdle import PARAMETERS
from ..subject import Subject
from .joint_accelerations import JointPair, JointSums

UNKNOWN_DRIFT_PSD = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance: 3° in a minute; assumption
MIN_DRIFT_PSD = 1e-10  # [rad²/s]
MIN_RATE_VAR = 1e-18  # [rad²/s²] so that it can be inverted
LEAST_INFORMATION = 1e-6  # relative to what a filter knew of its bias, below which a correction tells nothing
LEAP, USUAL_S = 10.0, 60.0  # times the largest gain of a filter's variance within so long [s], above which it leaps
OUTLIER_STDS = 5.0  # standard deviations above which a row is an outlier
HINGE_HEADING_MARGIN = np.deg2rad(10.0)  # [rad] that headings may have drifted before a hinge row is an outlier
_DIFFERENCE = np.array([[1.0, -1.0], [-1.0, 1.0]])
# Of the angle, levers and forces of a joint by their columns, and those columns that are no lever.
_BY_JOINT = np.zeros((13, 15))
_BY_JOINT[0, :3], _BY_JOINT[1:, 3:] = (1.0, -1.0, 1.0), np.eye(12)
_NO_LEVERS = np.array([0, 1, 2, 6, 7, 8, 12, 13, 14])
ITERATIONS = 2  # linearizations of an update


@dataclass(frozen=True)
class ClaspTest:
    """When points of a closure are found to coincide; lengths are rms over the time.

    With the lengths of the population or stated mounts the joined hands of simulated people seem up to 25 cm apart, and
    hands apart seem joined: clasps are found where all mounts between the points are calibrated.

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
    rate_std : [rad/s] drift of a heading by other causes than its gyroscope's bias
    rate_change_psd : [rad²/s³] of its random walk: a sensor warms up under its strap
    joint_std, girdle_std : [rad] by which the acceleration of a joint is off in heading, as tissue and a travelling
        shoulder follow the motion; it changes within `joint_correlation_s`
    acceleration_std : [m/s²] least misfit of two sides of a joint; the recent misfit where that is larger
    acceleration_correlation_s : [s] of the misfit
    force_std, force_correlation_s : [m/s²], [s] of a force that turns with a sensor: the tilt that an orientation
        filter has wrong in motion, a degree, times gravity
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
    force_std: float = float(np.deg2rad(1.0) * 9.81)
    force_correlation_s: float = 20.0
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
    """Vectors that turn with segments; their sum is the way from the root to a point, or from one point to another.

    Parameters
    ----------
    segments : (p,) index of each vector's segment
    vectors : (p, 3) [m] in the frames L of their segments
    by_length : (p, 3, lengths) their derivatives by the lengths of the model
    girdles : that move the ends: name, sign, index of the vector on whose segment the girdle is
    """

    segments: np.ndarray
    vectors: np.ndarray
    by_length: np.ndarray
    girdles: tuple[tuple[str, float, int], ...]

    @classmethod
    def of(
        cls,
        model: BodyModel,
        names: Sequence[str],
        parts: Sequence[Part],
        neutral: StartPose,
        girdles: Sequence[tuple[str, float]],
    ) -> Way:
        """Return the way of `parts`, which are in frames that equal W in `neutral`; `names` are the segments."""
        parts = [part for part in parts if part.sensor in names]  # what does not turn is left out
        lengths = np.array(list(model.lengths.values()))
        R_LK = [neutral.R_WK[part.sensor].T for part in parts]
        carriers = [part.sensor for part in parts]
        return cls(
            np.array([names.index(carrier) for carrier in carriers], dtype=int),
            np.array([R @ part.vector(lengths) for R, part in zip(R_LK, parts, strict=True)]).reshape(-1, 3),
            np.array([R @ np.array(part.by_length) for R, part in zip(R_LK, parts, strict=True)]),
            tuple((name, sign, carriers.index(model.table.girdles[name].on)) for name, sign in girdles),
        )

    def turn(self, R_WL: np.ndarray, motions: Mapping[str, GirdleMotion]) -> np.ndarray:
        """Return the vectors (p, n, 3) [m] in W, for orientations (k, n, 3, 3) and the motions of the girdles."""
        turned = np.asarray((R_WL[self.segments] @ self.vectors[:, None, :, None])[..., 0])
        for name, sign, i in self.girdles:
            turned[i] += sign * (R_WL[self.segments[i]] @ motions[name].displacement[:, :, None])[..., 0]
        return turned


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


class FilterHeadings(NamedTuple):
    """What the orientation filters of k sensors say of their headings after a sample.

    Parameters
    ----------
    var : (k,) [rad²]; NaN: the filter has no covariance
    about_vertical : of (k,) each
    """

    var: np.ndarray
    about_vertical: AboutVertical


class Knot(NamedTuple):
    """The observations of a knot, before headings are corrected."""

    end: float  # [s]
    time: np.ndarray  # (m,) [s] of the samples
    quat_WL: np.ndarray  # (m, k, 4) xyzw
    joints: tuple[JointSums | None, ...]
    filters: FilterHeadings  # at the end
    lost: np.ndarray  # (k,) bool, whether a sensor has lost a sample


class Step(NamedTuple):
    """A prediction; (k,) each.

    Parameters
    ----------
    drift : [rad] by which headings change as the orientation filters correct their biases within the knot
    heading_var : [rad²] that headings gain beside their rates
    rate : [rad/s] by which the orientation filters have corrected their biases about the vertical
    rate_var : [rad²/s²] that rates gain as their sensors turn another axis to the vertical
    information : [s²/rad²] that the filters' corrections brought about their biases
    prior_var : [rad²/s²] of these biases without them
    heading : [rad] by which the filters have corrected their headings
    unobserved, unobserved_rate : share of the variance of a heading and of its rate, as a filter alone would have them,
        that is left
    """

    drift: np.ndarray
    heading_var: np.ndarray
    rate: np.ndarray
    rate_var: np.ndarray
    information: np.ndarray
    prior_var: np.ndarray
    heading: np.ndarray
    unobserved: np.ndarray
    unobserved_rate: np.ndarray


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
    rate_std : (k,) [rad/s] of the gyroscopes' biases at the start
    start_var, mount_var : (k,) [rad²] of the headings at the end of the start pose, by the pose and by the mounts
    start : what the filters say at the end of the start pose; None: as at the end of the first knot
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
    rate_std: np.ndarray
    start_var: np.ndarray
    mount_var: np.ndarray
    start: FilterHeadings | None = None
    levers_at: np.ndarray | None = None
    causal: bool = False

    @cached_property
    def shape_cov(self) -> np.ndarray:
        """The covariance of the lengths and of the girdles' parameters, as `Subject.shape_covariance`."""
        return self.subject.shape_covariance(self.model.table)

    @property
    def size(self) -> int:
        levers = 0 if self.levers_at is not None else 6 * len(self.pairs)
        return self.kept + levers

    @property
    def kept(self) -> int:
        """Number of states without levers."""
        return self.column("force", 3 * len(self.names))

    def find_segment_variance(self, P: np.ndarray) -> np.ndarray:
        """Find the variance (k,) [rad²] of the segments' headings near the start pose, in the covariance of the state.

        δ begins at s − ε_z, by errors s of the start pose and ε_z of the mount, and grows by the drift; a segment that
        hangs is off by δ + ε_z.
        """
        k, first = len(self.names), self.column("mount", 0)
        mounts = slice(first, first + k)
        return np.asarray(np.diag(P)[:k] + np.diag(P)[mounts] + 2.0 * np.diag(P[:k, mounts]))

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
            "mount": 2 * k + j + 3 * h,
            "force": 3 * k + j + 3 * h,
        }
        return first[part] + index

    @cached_property
    def hinge_columns(self) -> list[np.ndarray]:
        """The columns of each hinge, in the order of `HingeRows.H`."""
        return [
            np.array([hinge.moves, hinge.on, *(self.column(part, i) for part in ("axis", "twist", "tilt"))])
            for i, hinge in enumerate(self.hinges)
        ]

    @cached_property
    def pair_columns(self) -> list[np.ndarray]:
        """The columns of each joint: headings of its segments, joint, near lever and force, far lever and force.

        Where levers are known, theirs are beyond the state.
        """
        columns = []
        for i, pair in enumerate(self.pairs):
            near, far = self.names.index(pair.near), self.names.index(pair.far)
            levers, forces = (
                np.arange(self.kept + 6 * i, self.kept + 6 * i + 6),
                (self.force_columns(near), self.force_columns(far)),
            )
            sides = (levers[:3], forces[0], levers[3:], forces[1])
            columns.append(np.concatenate(([near, far, self.column("joint", i)], *sides)))
        return columns

    def lever_columns(self, pair: int) -> slice:
        first = self.kept + 6 * pair
        return slice(first, first + 6)

    def force_columns(self, segment: int) -> np.ndarray:
        return self.column("force", 3 * segment) + np.arange(3)


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
        bias_std = problem.rate_std
        if problem.start is not None:
            known = np.sqrt(problem.start.about_vertical.rate_var)
            bias_std = np.where(np.isfinite(known), known, bias_std)
        std[k : 2 * k] = np.hypot(noise.rate_std, bias_std)
        decay = np.ones(problem.size)
        for i, pair in enumerate(problem.pairs):
            column = problem.column("joint", i)
            std[column] = noise.girdle_std if pair.travels else noise.joint_std
            decay[column] = np.exp(-problem.knot_s / noise.joint_correlation_s)
            if problem.levers_at is None:
                self.x[problem.lever_columns(i)], std[problem.lever_columns(i)] = pair.levers, pair.lever_std
        forces = slice(problem.column("force", 0), problem.column("force", 3 * k))
        std[forces], decay[forces] = noise.force_std, np.exp(-problem.knot_s / noise.force_correlation_s)
        for i, hinge in enumerate(problem.hinges):
            std[problem.column("axis", i)], std[problem.column("tilt", i)] = hinge.axis_std, hinge.tilt_std
            std[problem.column("twist", i)] = noise.twist_std
            decay[problem.column("twist", i)] = np.exp(-problem.knot_s / noise.twist_correlation_s)
        self.P = np.diag(std**2)
        self._set_start_covariance()
        self._decay, self._steady = decay, (1.0 - decay**2) * std**2
        self._misfit = np.full(len(problem.pairs), noise.acceleration_std**2)  # [m²/s⁴] recent mean of each axis
        self._last = problem.start
        self._last_up: np.ndarray | None = None  # (k, 3) the axis of each segment that was turned to the vertical
        self._lost_before = np.zeros(k, dtype=bool)  # whether a sensor has lost a sample in the last knot
        self._usual_gain = np.zeros(k)  # [rad²] of the orientation filter's variance in a knot, largest of late
        self._clasps = ClaspDetector(problem)
        self._closed_before = set[tuple[str, ...]]()  # points that coincided in the last knot
        self.clasps: list[tuple[float, float]] = []  # [s] when points were found to coincide

    def reset(self, headings: np.ndarray) -> None:
        """Set δ (k,) [rad] as known to within the start pose."""
        self.x[: len(headings)] = headings
        self._set_start_covariance()

    def _set_start_covariance(self) -> None:
        """Set the covariance of δ = s − ε_z and of the mounts' ε_z after a start pose."""
        k, problem = len(self.problem.names), self.problem
        headings = np.arange(k)
        mounts = problem.column("mount", 0) + headings
        both = np.concatenate([headings, mounts])
        self.P[both, :], self.P[:, both] = 0.0, 0.0
        self.P[headings, headings] = problem.start_var + problem.mount_var
        self.P[mounts, mounts] = problem.mount_var
        self.P[headings, mounts] = self.P[mounts, headings] = -problem.mount_var

    def step(self, knot: Knot) -> Step:
        """Predict to a knot and update by it; return what the prediction was."""
        step = self.find_step(knot)
        self.predict(step)
        self._learn_from_filters(step)
        for _ in self.update(knot):
            pass
        return step

    def step_gradually(self, knot: Knot) -> Iterator[None]:
        """Do as `step`, in parts of a millisecond or two; the state is valid after the last one."""
        step = self.find_step(knot)
        self.predict(step)
        self._learn_from_filters(step)
        yield
        yield from self.update(knot)

    def find_step(self, knot: Knot) -> Step:
        """Find what the headings have gained in a knot beside their rates, and what is left of these.

        The variance of the orientation filter includes its gyroscope's bias, which is a rate here: it counts up to
        `drift_psd`, and as a whole where samples were lost or the rate was cut off, which make it leap.
        """
        knot_s, k = self.problem.knot_s, len(self.problem.names)
        now, last = knot.filters, self._last or knot.filters
        self._last = now
        gained = np.maximum(now.var - last.var, MIN_DRIFT_PSD * knot_s)
        known = np.isfinite(gained)
        leaps = known & (knot.lost | (gained > LEAP * np.maximum(self._usual_gain, self.problem.drift_psd * knot_s)))
        self._usual_gain = np.maximum(self._usual_gain * np.exp(-knot_s / USUAL_S), np.where(known, gained, 0.0))
        limited = np.where(leaps, gained, np.minimum(gained, self.problem.drift_psd * knot_s))
        drift_var = np.where(known, limited, UNKNOWN_DRIFT_PSD * knot_s * np.ones(k))
        changes = [np.nan_to_num(a - b) for a, b in zip(now.about_vertical, last.about_vertical, strict=True)]
        change = AboutVertical(*changes)
        # The rate of the knot's begin is in the prediction; what was corrected since has added up from then on.
        drift = change.drift - np.nan_to_num(last.about_vertical.rate) * change.seconds
        unobserved = np.diag(self.P)[:k] / (np.nan_to_num(last.var) + self.problem.start_var + self.problem.mount_var)
        prior_var = self._find_prior_bias_var(now.about_vertical, last.about_vertical, change)
        rates, alone = np.diag(self.P)[k : 2 * k], prior_var + self.problem.noise.rate_std**2
        rate_var = self._find_turn(knot) * np.maximum(alone - rates, 0.0)
        shares = np.minimum(unobserved, 1.0), np.minimum(rates / alone, 1.0)
        learned = change.information, prior_var, change.heading, *shares
        return Step(drift, drift_var, change.rate, rate_var, *learned)

    def _find_prior_bias_var(self, now: AboutVertical, last: AboutVertical, change: AboutVertical) -> np.ndarray:
        """Find the variances (k,) [rad²/s²] of the biases about the present vertical without a knot's corrections.

        A sum of information that says less than the start, the knot before and the correction itself is rounding, or
        what aged in between.
        """
        most_var = np.fmax.reduce([now.rate_var, last.rate_var, self.problem.rate_std**2, 4.0 * change.rate**2])
        most_var = np.maximum(most_var, MIN_RATE_VAR)
        rate_var = np.maximum(now.rate_var, MIN_RATE_VAR)
        return np.nan_to_num(1.0 / np.maximum(1.0 / rate_var - change.information, 1.0 / most_var))

    def _find_bias_share(self, bias_var: np.ndarray) -> np.ndarray:
        """Find the share (k,) of the rates' variances that is the biases'; the rest are other causes of drift."""
        return bias_var / (bias_var + self.problem.noise.rate_std**2)

    def _find_turn(self, knot: Knot) -> np.ndarray:
        """Find the squared sines (k,) of the angles by which segments have turned another axis to the vertical.

        Zero up to 45°. It is the share of the bias about the new vertical that the one about the last does not tell.
        """
        k = len(self.problem.names)
        if not len(knot.quat_WL):
            return np.zeros(k)
        x, y, z, w = knot.quat_WL[-1].T
        up = np.stack([2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)], axis=1)
        last_up = up if self._last_up is None else self._last_up
        cosine = np.einsum("ki,ki->k", up, last_up)
        is_turned = np.abs(cosine) < np.sqrt(0.5)
        self._last_up = np.where(is_turned[:, None], up, last_up)
        return np.where(is_turned, 1.0 - cosine**2, 0.0)

    def advance(self, values: np.ndarray) -> np.ndarray:
        """Return F v of one knot for v (n,) or (n, m): what lasts decays, and headings turn at their rates."""
        k = len(self.problem.names)
        advanced = np.asarray((self._decay * values.T).T)
        advanced[:k] += self.problem.knot_s * values[k : 2 * k]
        return advanced

    def predict(self, step: Step) -> None:
        k = len(self.problem.names)
        self.x = self.advance(self.x)
        self.x[:k] += step.drift
        self.x[k : 2 * k] += step.rate
        self.P = self.advance(self.advance(self.P).T).T + np.diag(self._steady)
        self.P[np.arange(k), np.arange(k)] += step.heading_var
        rates = np.arange(k, 2 * k)
        self.P[rates, rates] += self.problem.noise.rate_change_psd * self.problem.knot_s + step.rate_var

    def _learn_from_filters(self, step: Step) -> None:
        """Update the rates by what the orientation filters have learned of their biases in a knot.

        A filter that knew its bias to the variance p and has corrected it by Δb with the information i has measured,
        with the variance 1/i, that the rate is now −Δb/(p i). A rate has other parts than the bias (`noise.rate_std`),
        of which that says nothing. What sets the filters' information is how the person moves where they take it for
        rest; that is common to the sensors, and all of them together know no more of it than one.

        The filter's correction of its heading, which was undone, follows from that as far as the heading was wrong by
        the bias about the present vertical. The rest is by a bias about an axis that was vertical before, or by the
        gyroscope's scale; it is believed as far as nothing else has observed the heading, and so with the rate.
        """
        k, shares = len(step.rate), self._find_bias_share(step.prior_var)
        before = self.x[: 2 * k]
        at = np.flatnonzero(step.information * step.prior_var > LEAST_INFORMATION)
        if len(at):
            rates, share, prior_var = k + at, shares[at], step.prior_var[at]
            correction, var = step.rate[at], 1.0 / step.information[at]
            innovation = -correction * var / prior_var - correction - share * (self.x[rates] - correction)
            by_state = share * self.P[:, rates]
            covariance = share[:, None] * by_state[rates] + np.diag((1.0 - share) * prior_var + var)
            covariance += (1.0 - 1.0 / len(at)) * np.sqrt(np.outer(var, var))
            gain = np.linalg.solve(covariance, by_state.T).T
            self.P = _symmetric(self.P - gain @ by_state.T)
            self.x = self.x + gain @ innovation
        rest = np.concatenate([step.heading - step.drift, -step.rate]) - (self.x[: 2 * k] - before)
        self.x = self.x.copy()
        self.x[: 2 * k] += np.concatenate([step.unobserved, step.unobserved_rate]) * rest

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
        for i, sums in enumerate(knot.joints):
            if sums is None or not sums.samples:
                continue
            near, far, joint = problem.pair_columns[i][:3]
            levers = problem.levers_at[i] if problem.levers_at is not None else x[problem.lever_columns(i)]
            near_force, far_force = x[problem.force_columns(near)], x[problem.force_columns(far)]
            near_side, far_side = np.concatenate((levers[:3], near_force)), np.concatenate((levers[3:], far_force))
            JJ, Je, cost = sums.linearize(x[near] - x[far] + x[joint], near_side, far_side)
            misfit = max(cost / (3.0 * sums.samples), self._misfit[i], problem.noise.acceleration_std**2)
            weight = 1.0 / (misfit * max(1.0, problem.noise.acceleration_correlation_s * rate))
            columns, G = problem.pair_columns[i], _BY_JOINT
            if problem.levers_at is not None:
                columns, G = columns[_NO_LEVERS], G[:, _NO_LEVERS]
            information[columns[:, None], columns] += weight * G.T @ JJ @ G
            vector[columns] += weight * G.T @ Je
            if last:
                share = 1.0 - np.exp(-problem.knot_s / 20.0)
                self._misfit[i] += share * (cost / (3.0 * sums.samples) - self._misfit[i])

    def _add_rows(self, knot: Knot, x: np.ndarray, information: np.ndarray, vector: np.ndarray) -> Iterator[None]:
        """Add the hinges and the closures that hold; yield between them."""
        problem = self.problem
        k, noise = len(problem.names), problem.noise
        rate = problem.samples_per_knot / problem.knot_s
        R = correct_headings(knot.quat_WL, x)
        # While a sensor is lost, and while its tilt comes back, its segment is where nobody knows.
        unsure = self._find_unsure(knot)
        for i, hinge in enumerate(problem.hinges):
            if unsure[hinge.on] or unsure[hinge.moves]:
                continue
            yield
            columns, samples = problem.hinge_columns[i], max(1.0, noise.hinge_correlation_s * rate)
            r, H, excess, slope = linearize_hinge(R[hinge.on], R[hinge.moves], hinge)
            r = r + H[:, 2:] @ x[columns[2:]]
            weight = (np.abs(r) < OUTLIER_STDS * hinge.std + HINGE_HEADING_MARGIN) / (hinge.std**2 * samples)
            information[columns[:, None], columns] += H.T @ (weight[:, None] * H)
            vector[columns] += H.T @ (weight * r)
            beyond = slope / (noise.range_std**2 * samples) * (excess != 0.0)
            information[columns[:2, None], columns[:2]] += beyond @ slope * _DIFFERENCE
            vector[columns[:2]] += beyond @ excess * _DIFFERENCE[0]
        for closure in problem.closures:
            closed = closure.holds(knot.time)
            if closed.any() and not unsure[closure.gap.segments].any():
                yield
                rows = build_gap_rows(R, problem, closure, closed)
                weight = rows.weight / self._find_correlation(closure.points, knot)
                information[:k, :k] += rows.H.T @ (weight[:, None] * rows.H)
                vector[:k] += rows.H.T @ (weight * rows.r)


@kernel
def undo_corrections(quat_VS, corrections, at_start):  # type: ignore[no-untyped-def]
    """Turn orientations (n, k, 4) xyzw in place by Rz(−c), c [rad] the corrections (n, k) since the start (k,)."""
    for n in range(len(quat_VS)):
        for k in range(quat_VS.shape[1]):
            angle = at_start[k] - corrections[n, k]
            s, c = np.sin(0.5 * angle), np.cos(0.5 * angle)
            x, y, z, w = quat_VS[n, k, 0], quat_VS[n, k, 1], quat_VS[n, k, 2], quat_VS[n, k, 3]
            quat_VS[n, k, 0], quat_VS[n, k, 1] = c * x - s * y, c * y + s * x
            quat_VS[n, k, 2], quat_VS[n, k, 3] = c * z + s * w, c * w - s * z


def correct_headings(quat_WL: np.ndarray, headings: np.ndarray) -> np.ndarray:
    """Return Rz(δ) R_WL (k, n, 3, 3) for orientations (n, k, 4) xyzw and headings δ (k,) or more [rad]."""
    R = np.empty((quat_WL.shape[1], len(quat_WL), 3, 3))
    _turn_about_vertical(quat_WL, headings, R)
    return R


@kernel
def _turn_about_vertical(quat_WL, headings, R):  # type: ignore[no-untyped-def]
    for k in range(len(R)):
        s, c = np.sin(headings[k]), np.cos(headings[k])
        for n in range(len(quat_WL)):
            x, y, z, w = quat_WL[n, k, 0], quat_WL[n, k, 1], quat_WL[n, k, 2], quat_WL[n, k, 3]
            xx, xy, xz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
            yx, yy, yz = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
            R[k, n, 0, 0], R[k, n, 0, 1], R[k, n, 0, 2] = c * xx - s * yx, c * xy - s * yy, c * xz - s * yz
            R[k, n, 1, 0], R[k, n, 1, 1], R[k, n, 1, 2] = s * xx + c * yx, s * xy + c * yy, s * xz + c * yz
            R[k, n, 2, 0], R[k, n, 2, 1] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
            R[k, n, 2, 2] = 1.0 - 2.0 * (x * x + y * y)


def _cross_vertical(v: np.ndarray) -> np.ndarray:
    """Return ``[0, 0, 1] × v`` of vectors (..., 3): how they change as they turn about the vertical."""
    turned = np.zeros(v.shape)
    turned[..., 0], turned[..., 1] = -v[..., 1], v[..., 0]
    return turned


class HingeRows(NamedTuple):
    """What n samples of two orientations tell of a hinge.

    Parameters
    ----------
    r : (n,) [rad] out of the hinge's plane
    H : (n, 5) its slope by the headings of `moves` and `on`, the axis about the long axis of `on`, tissue there, and
        the axis across
    excess : (n,) [rad] beyond the hinge's range, signed
    slope : (n,) of that by the heading of `moves`; by the heading of `on` it is the negative
    """

    r: np.ndarray
    H: np.ndarray
    excess: np.ndarray
    slope: np.ndarray


def linearize_hinge(R_on: np.ndarray, R_moves: np.ndarray, hinge: HingeAxis) -> HingeRows:
    """Linearize a hinge of orientations (n, 3, 3)."""
    n = len(R_on)
    rows = HingeRows(np.empty(n), np.empty((n, 5)), np.empty(n), np.empty(n))
    _linearize_hinge(R_on, R_moves, hinge.axis, hinge.on_along, hinge.along, hinge.range, *rows)
    return rows


@kernel
def _linearize_hinge(R_on, R_moves, axis, on_along, along, limits, r, H, excess, slope):  # type: ignore[no-untyped-def]
    nx, ny, nz = axis[0], axis[1], axis[2]
    ax, ay, az = on_along[0], on_along[1], on_along[2]
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax  # axis × long axis
    tx, ty, tz = by * nz - bz * ny, bz * nx - bx * nz, bx * ny - by * nx  # that × axis
    middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
    for i in range(len(R_on)):
        A, B = R_on[i], R_moves[i]
        # The long axis of `moves` in W, in the frame of `on`, and its slope there by the heading of `moves`.
        ux = B[0, 0] * along[0] + B[0, 1] * along[1] + B[0, 2] * along[2]
        uy = B[1, 0] * along[0] + B[1, 1] * along[1] + B[1, 2] * along[2]
        uz = B[2, 0] * along[0] + B[2, 1] * along[1] + B[2, 2] * along[2]
        vx = A[0, 0] * ux + A[1, 0] * uy + A[2, 0] * uz
        vy = A[0, 1] * ux + A[1, 1] * uy + A[2, 1] * uz
        vz = A[0, 2] * ux + A[1, 2] * uy + A[2, 2] * uz
        dx, dy, dz = A[1, 0] * ux - A[0, 0] * uy, A[1, 1] * ux - A[0, 1] * uy, A[1, 2] * ux - A[0, 2] * uy
        r[i] = vx * nx + vy * ny + vz * nz
        by_heading = dx * nx + dy * ny + dz * nz
        sine, cosine = vx * bx + vy * by + vz * bz, vx * ax + vy * ay + vz * az
        H[i, 0], H[i, 1], H[i, 2], H[i, 3] = by_heading, -by_heading, -sine, -sine
        H[i, 4] = -(vx * tx + vy * ty + vz * tz)
        off = np.arctan2(sine, cosine) - middle
        off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
        excess[i] = np.sign(off) * max(abs(off) - half, 0.0)
        by_sine, by_cosine = dx * bx + dy * by + dz * bz, dx * ax + dy * ay + dz * az
        slope[i] = (by_sine * cosine - by_cosine * sine) / max(sine * sine + cosine * cosine, 0.1)


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

    @staticmethod
    def _is_calibrated(closure: Closure, problem: HeadingProblem) -> bool:
        return all(problem.names[i] in problem.subject.mounts for i in closure.gap.segments)

    def find(self, knot: Knot, state: HeadingFilter) -> list[tuple[tuple[str, ...], Rows]]:
        """Return the points that coincide and the rows of the gap between them in the last knot."""
        problem, test = state.problem, self._test
        names, reference = problem.names, problem.model.table.reference
        if reference not in names or not any(self._is_calibrated(closure, problem) for closure in problem.closures):
            return []
        self._recent = [*self._recent, knot][-self._knots :]
        if len(self._recent) < self._knots and len(self._recent) * problem.knot_s < 0.8 * test.seconds:
            return []
        k, rate = len(names), problem.samples_per_knot / problem.knot_s
        quats = np.concatenate([each.quat_WL for each in self._recent])
        time = np.concatenate([each.time for each in self._recent])
        if len(time) < 2:
            return []
        R = correct_headings(quats, state.x)
        motions = move_all_girdles(problem, R)
        R_reference = R[names.index(reference)]
        found = []
        seen = set[tuple[str, ...]]()
        for closure in problem.closures:
            if closure.points in seen or closure.holds(knot.time).any() or not self._is_calibrated(closure, problem):
                continue
            seen.add(closure.points)
            paths = [(way.turn(R, motions).sum(axis=0)[:, None] @ R_reference)[:, 0] for way in closure.ways]
            speed = min(_find_rms(np.gradient(path, time, axis=0)) for path in paths)
            v = closure.gap.turn(R, motions)
            gap = v.sum(axis=0)
            if speed < test.speed or np.abs(gap[:, 2]).max() > test.height:
                continue
            H = np.zeros((len(time), 3, k))
            for i, link in zip(closure.gap.segments, v, strict=True):
                H[:, :, i] += _cross_vertical(link)
            # The headings that close the gap best, within their covariance.
            P, flat, r = state.P[:k, :k], H.reshape(-1, k), gap.ravel()
            weight = 1.0 / (problem.noise.slip_std**2 * max(1.0, test.seconds * rate))
            turn = -np.linalg.solve(np.eye(k) + P @ (weight * flat.T @ flat), P @ (weight * flat.T @ r))
            closed = gap + H @ turn
            change, length = _find_rms(closed - closed.mean(axis=0)), _find_rms(closed)
            drift = _find_rms(np.gradient(closed, time, axis=0))
            if length > test.gap or change > test.change or drift > test.speed_ratio * speed:
                continue
            joined = np.ones(len(knot.time), dtype=bool)
            rows = build_gap_rows(R[:, -len(knot.time) :], problem, closure, joined, problem.noise.slip_std)
            found.append((closure.points, rows))
        return found


def _symmetric(P: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (P + P.T))


def _find_rms(v: np.ndarray) -> float:
    """Return the rms length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(v**2, axis=1))))


def move_all_girdles(problem: HeadingProblem, R_WL: np.ndarray) -> dict[str, GirdleMotion]:
    """Return the motions of the girdles for orientations (k, n, 3, 3) of the problem's segments."""
    return move_girdles(problem.model, dict(zip(problem.names, R_WL, strict=True)))


def build_gap_rows(
    R_WL: np.ndarray,
    problem: HeadingProblem,
    closure: Closure,
    closed: np.ndarray,
    slip_std: float = PALM_SLIP_STD,
) -> Rows:
    """Build three whitened rows for each sample at which the points coincide, without outliers.

    Parameters
    ----------
    R_WL : (k, n, 3, 3) of the problem's segments
    closed : (n,) bool
    """
    model, gap, R = problem.model, closure.gap, R_WL[:, closed]
    motions = move_all_girdles(problem, R)
    v = gap.turn(R, motions)
    n, lengths = v.shape[1], len(model.lengths)
    squares = np.sum(v**2, axis=(0, 2))
    covariance = (slip_std**2 + SEGMENT_ATTITUDE_STD**2 * squares)[:, None, None] * np.eye(3)
    links = v.transpose(1, 2, 0)
    covariance -= SEGMENT_ATTITUDE_STD**2 * (links @ links.swapaxes(1, 2))
    shape_cov = problem.shape_cov
    J = np.zeros((n, 3, len(shape_cov)))
    J[:, :, :lengths] = (R[gap.segments] @ gap.by_length[:, None]).sum(axis=0)
    for name, sign, i in gap.girdles:
        girdle, motion, R_on = model.table.girdles[name], motions[name], R[gap.segments[i]]
        first = lengths + len(PARAMETERS) * list(model.table.girdles).index(name)
        J[:, :, first : first + len(PARAMETERS)] += sign * R_on @ motion.jacobian
        covariance += (R_on * motion.residual_covariance(girdle)[:, None, :]) @ R_on.swapaxes(1, 2)
    covariance += J @ shape_cov @ J.swapaxes(1, 2)
    H = np.zeros((n, 3, len(problem.names)))
    for i, link in zip(gap.segments, v, strict=True):
        H[:, :, i] += _cross_vertical(link)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = (whiten @ r[:, :, None])[..., 0], whiten @ H
    is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
    sample = np.repeat(np.flatnonzero(closed)[is_inlier], 3)
    return Rows(sample, r[is_inlier].ravel(), H[is_inlier].reshape(-1, len(problem.names)), np.ones(len(sample)))


class SmoothedHeadings(NamedTuple):
    """The headings at m knots.

    Parameters
    ----------
    errors, covariance : (m, k) [rad] and (m, k, k) [rad²] of δ
    segment_var : (m, k) [rad²] of the segments' headings, see `HeadingProblem.find_segment_variance`
    clasps : [s] when points were found to coincide
    """

    errors: np.ndarray
    covariance: np.ndarray
    segment_var: np.ndarray
    clasps: tuple[tuple[float, float], ...]


def smooth(problem: HeadingProblem, knots: Sequence[Knot]) -> SmoothedHeadings:
    """Filter and smooth the knots (Rauch, Tung, Striebel 1965)."""
    k = len(problem.names)
    forward = HeadingFilter(problem)
    filtered, steps = [], []
    for knot in knots:
        steps.append(forward.step(knot))
        filtered.append((forward.x, forward.P))
    x, P = filtered[-1]
    means, covs, segment_vars = [x[:k]], [P[:k, :k]], [problem.find_segment_variance(P)]
    for i in range(len(knots) - 2, -1, -1):
        forward.x, forward.P = filtered[i]
        forward.predict(steps[i + 1])
        gain = np.linalg.solve(forward.P, forward.advance(filtered[i][1])).T
        x = filtered[i][0] + gain @ (x - forward.x)
        P = _symmetric(filtered[i][1] + gain @ (P - forward.P) @ gain.T)
        means.append(x[:k])
        covs.append(P[:k, :k])
        segment_vars.append(problem.find_segment_variance(P))
    errors, covariance, segment_var = (np.array(each[::-1]) for each in (means, covs, segment_vars))
    return SmoothedHeadings(errors, covariance, segment_var, tuple(forward.clasps))
