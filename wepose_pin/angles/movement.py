"""A session's angles for a paper: its repetitions, what each comes to, and two sessions compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from ..body.kinematics import Pose, find_samples
from ..errors import WrongOption, one_of
from ..filters.butterworth import low_pass
from ..recording import Intervals
from ..recording.gaps import find_runs
from ..rotations import unwrap_signs
from .curves import MeanCurve, compute_mean_curves
from .euler import round_to_turns, wrap
from .joints import AUTO, JOINTS, Angles, joint_angles
from .repetitions import Repetitions, find_repetitions
from .tables import compute_summary_std, summarize_joint

MEASURES = {"lowest": "deg", "highest": "deg", "range": "deg", "peak_rate": "deg_s"}  # units in a file
RANGE = 2  # place of the range among them
CONFIDENCE = 0.95  # of the interval of a difference
# A longer time step than this many usual ones ends a run: the samples on its two sides are filtered apart.
_LONGEST_STEP = 1.5
_SHORTEST_RUN = 10  # samples; a shorter run is not filtered


@dataclass(frozen=True)
class MovementOptions:
    """How the angles of a session are made and its repetitions found.

    Parameters
    ----------
    sequence : of the shoulder, one of `SHOULDER_SEQUENCES`, or `AUTO`
    cutoff_hz : of the low-pass (`smooth_pose`); None: none
    phase : takes each of its intervals as a repetition; None: repetitions are found
    main_angle, rising, cycles : of `find_repetitions`
    """

    sequence: str = AUTO
    cutoff_hz: float | None = None
    phase: str | None = None
    main_angle: str | None = None
    rising: bool | None = None
    cycles: bool = False


class JointMeasures(NamedTuple):
    """`MEASURES` of one joint in several spans; [rad], of `peak_rate` [rad/s]; NaN where not determined."""

    values: np.ndarray  # (s, 3 angles, 4)
    std: np.ndarray  # (s, 3, 4) as the pose states them
    near_lock: np.ndarray  # (s,) share of the samples
    gap: np.ndarray  # (s,) share of the samples

    def statistics(self, k: int) -> list[Statistics]:
        """Statistics of each of `MEASURES` of the k-th angle over the spans."""
        return [compute_statistics(self.values[:, k, m], self.std[:, k, m]) for m in range(len(MEASURES))]


@dataclass(frozen=True)
class Movement:
    """The angles of a session, or of the selected time of it.

    Parameters
    ----------
    name : of the session
    pose : low-passed as the angles are
    angles : of the pose
    phases : of the recording, as far as they lie in the time of the pose
    repetitions : found, or marked by a phase
    measures : joint → those of the repetitions
    curves : joint → its three mean curves; empty without repetitions
    cutoff_hz : of the low-pass; None: there is none
    """

    name: str
    pose: Pose
    angles: Angles
    phases: Mapping[str, Intervals]
    repetitions: Repetitions
    measures: Mapping[str, JointMeasures]
    curves: Mapping[str, tuple[MeanCurve, MeanCurve, MeanCurve]]
    cutoff_hz: float | None

    @property
    def sequence(self) -> str:
        """That of the shoulder's angles; empty: there is none."""
        return next((each.sequence for name, each in self.angles.joints.items() if not JOINTS[name].sequence), "")

    @property
    def duration(self) -> Statistics:
        """[s], of the repetitions."""
        seconds = np.diff(self.repetitions.spans, axis=1)[:, 0]
        return compute_statistics(seconds, np.full(len(seconds), np.nan))


def analyze_movement(name: str, pose: Pose, phases: Mapping[str, Intervals], options: MovementOptions) -> Movement:
    """Compute the angles of a session, find its repetitions and measure them.

    Parameters
    ----------
    phases : of the recording, [s]

    Raises
    ------
    WeposeError
        No joint has both of its segments; there is no such angle or phase; a cut-off that is not possible.
    """
    if options.cutoff_hz is not None:
        pose = smooth_pose(pose, options.cutoff_hz)
    angles = joint_angles(pose, options.sequence)
    inside = _select_inside(pose.time, phases)
    if options.phase is not None:
        repetitions = _take_marked(options.phase, phases, inside)
    else:
        repetitions = find_repetitions(angles, options.main_angle, options.rising, options.cycles)
    return Movement(
        name,
        pose,
        angles,
        inside,
        repetitions,
        measure_spans(pose, angles, repetitions.spans),
        compute_mean_curves(angles, repetitions.spans) if len(repetitions.spans) else {},
        options.cutoff_hz,
    )


def smooth_pose(pose: Pose, cutoff_hz: float) -> Pose:
    """Return the pose with orientations low-passed by a Butterworth filter of second order, forwards and backwards.

    Nothing is delayed; at `cutoff_hz` the two passes together halve the amplitude (−6 dB). Filtered are the components
    of the quaternions, which are normalised afterwards. Points, covariances and gaps stay.

    Raises
    ------
    WrongOption
        The cut-off is not above 0 and below 0.45 of the sampling rate.
    """
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 1.0
    if not 0.0 < cutoff_hz < 0.45 / step:
        raise WrongOption("low-pass-hz", f"{cutoff_hz:g}", f"above 0 and below {0.45 / step:.3g} Hz is needed here")
    even = np.concatenate([[True], np.diff(pose.time) < _LONGEST_STEP * step])
    quat_WL = {}
    for segment, quat in pose.quat_WL.items():
        smooth = quat.copy()
        for first, last in find_runs(np.isfinite(quat).all(axis=1)):
            starts = [first, *(first + 1 + np.flatnonzero(~even[first + 1 : last])), last]
            for a, b in pairwise(starts):
                if b - a >= _SHORTEST_RUN:
                    filtered = low_pass(unwrap_signs(quat[a:b]), cutoff_hz, 1.0 / step)
                    smooth[a:b] = filtered / np.linalg.norm(filtered, axis=1, keepdims=True)
        quat_WL[segment] = smooth
    return replace(pose, quat_WL=quat_WL, q=None)


def _select_inside(time: np.ndarray, phases: Mapping[str, Intervals]) -> dict[str, Intervals]:
    """The intervals that lie in a time (n,) [s], or exceed it by less than a sample."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    inside = {
        name: tuple((a, b) for a, b in spans if a > time[0] - step and b < time[-1] + step)
        for name, spans in phases.items()
    }
    return {name: spans for name, spans in inside.items() if spans}


def _take_marked(phase: str, phases: Mapping[str, Intervals], inside: Mapping[str, Intervals]) -> Repetitions:
    if not phases.get(phase):
        choices = one_of(phases, phase) if phases else "it has no phases; without --repetitions they are found"
        raise WrongOption("repetitions", phase, f"the recording has no such phase; {choices}")
    if phase not in inside:
        return Repetitions(
            np.empty((0, 2)), phase, reason=f"no interval of the phase {phase} lies in the selected time"
        )
    return Repetitions(np.array(inside[phase], dtype=float), phase)


def measure_spans(
    pose: Pose, angles: Angles, spans: Sequence[tuple[float, float]] | np.ndarray
) -> dict[str, JointMeasures]:
    """Joint → its measures in each span [s], both ends included.

    Raises
    ------
    BadData
        A span has no sample.
    """
    parts = [find_samples(pose.time, (float(begin), float(end))) for begin, end in spans]
    measures = {}
    for name, joint in angles.joints.items():
        summaries = [summarize_joint(pose.time, joint, part) for part in parts]
        rows = [np.column_stack([each.lowest, each.highest, each.range, each.peak_rate]) for each in summaries]
        values = np.array(rows).reshape(-1, 3, len(MEASURES))
        values[:, :, :2] -= _count_turns(values)[:, :, None]
        samples = np.array([each.samples for each in summaries], dtype=int).reshape(values.shape)
        std = compute_summary_std(pose, name, joint, samples)
        near_lock, gap = np.array([(each.near_lock, each.gap) for each in summaries]).reshape(-1, 2).T
        measures[name] = JointMeasures(values, std, near_lock, gap)
    return measures


def _count_turns(values: np.ndarray) -> np.ndarray:
    """Full turns [rad] (s, 3) by which spans are off the one that moves least, and this one off zero.

    Angles are continuous in time: a motion about the lock may return to a posture a full turn later.
    """
    middle = values[:, :, :2].mean(axis=2)
    turns = np.zeros_like(middle)
    for k in range(3):
        known = np.flatnonzero(np.isfinite(middle[:, k]))
        if len(known):
            least = middle[known[np.argmin(np.ptp(values[known, k, :2], axis=1))], k]
            turns[known, k] = round_to_turns(middle[known, k] - wrap(least))
    return turns


class Statistics(NamedTuple):
    """Values over repetitions; NaN where there are too few."""

    n: int
    mean: float
    sd: float  # with n − 1
    std: float  # stated for one repetition, root mean square


def compute_statistics(values: np.ndarray, std: np.ndarray) -> Statistics:
    """Mean and standard deviation of values (r,), NaN left out, and what is stated for them."""
    known = values[np.isfinite(values)]
    stated = std[np.isfinite(std) & np.isfinite(values)]
    return Statistics(
        len(known),
        float(known.mean()) if len(known) else float("nan"),
        float(known.std(ddof=1)) if len(known) > 1 else float("nan"),
        float(np.sqrt(np.mean(np.square(stated)))) if len(stated) else float("nan"),
    )


class Difference(NamedTuple):
    """Of two sessions, the second less the first."""

    value: float
    low: float  # of the interval of `CONFIDENCE` (Welch 1947), from the spread of the repetitions alone
    high: float
    std: float  # stated: of both sessions, as independent


def compare_statistics(first: Statistics, second: Statistics) -> Difference:
    """The difference of two means; the interval is NaN where a session has fewer than two repetitions."""
    value = second.mean - first.mean
    low = high = float("nan")
    if min(first.n, second.n) > 1:
        a, b = first.sd**2 / first.n, second.sd**2 / second.n
        half = 0.0
        if a + b > 0.0:
            freedom = (a + b) ** 2 / (a**2 / (first.n - 1) + b**2 / (second.n - 1))
            half = float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE)) * np.sqrt(a + b)
        low, high = value - half, value + half
    return Difference(value, low, high, float(np.hypot(first.std, second.std)))


def compare_measures(
    first: JointMeasures, second: JointMeasures, k: int
) -> list[tuple[Statistics, Statistics, Difference]]:
    """Of each of `MEASURES` of the k-th angle both sessions' statistics, after the full turns between these."""
    one, two = first.statistics(k), second.statistics(k)
    turns = np.nan_to_num(round_to_turns(0.5 * (two[0].mean + two[1].mean - one[0].mean - one[1].mean)))
    two[:2] = [each._replace(mean=float(each.mean - turns)) for each in two[:2]]  # lowest and highest
    return [(a, b, compare_statistics(a, b)) for a, b in zip(one, two, strict=True)]
