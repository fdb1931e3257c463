"""What there is to observe headings by: joints, hinges, closures, what disturbs them, and the states of the filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..calibration.conditions import Part, StartPose
from ..filters import AboutVertical
from ..model import BodyModel, GirdleMotion
from ..subject import Subject
from .joint_accelerations import JointPair, JointSums


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
