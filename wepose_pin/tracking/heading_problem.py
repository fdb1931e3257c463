"""The problem of the heading filter: what observes the headings, the noise of that, and the states.

δ (k,) [rad] are the heading errors of the k segments with sensors, on the left in W. Time is cut into intervals of
equal length, the knots. Headings are observed by joints between two sensors, by hinges and by closures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..body import BodyModel, GirdleMotion
from ..body.subject import Subject
from ..calibration.conditions import Part, StartPose
from ..filters import AboutVertical
from .joint_accelerations import JointPair


@dataclass(frozen=True)
class HeadingNoise:
    """Standard deviations, power spectral densities and correlation times of the heading filter.

    The defaults are those of a person.

    Parameters
    ----------
    drift_psd : [rad²/s] of the random walk of a heading in motion, in addition to its rate: scale errors, soft tissue
    rate_std : [rad/s] of the rate at which a heading drifts, by other causes than its gyroscope's bias
    rate_change_psd : [rad²/s³] of the random walk of that rate: a sensor warms up under its strap
    joint_std, girdle_std : [rad] of the heading error of a joint's acceleration, and of that of a joint on a girdle:
        soft tissue and a travelling shoulder follow the motion
    joint_correlation_s : [s] of these two
    acceleration_std : [m/s²] least misfit between the accelerations of a joint by its two sensors; the recent misfit
        where that is larger
    acceleration_correlation_s : [s] of the misfit
    force_std, force_correlation_s : [m/s²], [s] of an error of specific force that is fixed in the sensor's frame: the
        tilt error of an orientation filter in motion, a degree, times gravity
    twist_std, twist_correlation_s : [rad], [s] of the rotation of a sensor about its segment's long axis by soft tissue
    hinge_std, hinge_correlation_s : [rad], [s] of the other errors of the angle between a hinge's plane and the segment
        below
    axis_std, tilt_std : [rad] of a calibrated hinge's axis: its rotation about the long axis of the segment above, and
        about the direction across both
    range_std : [rad] of the limits of a hinge's range
    slip_std : [m] of the gap between palms in a clasp that was found: a cup may be between them
    closure_correlation_s : [s] of the residuals of a closure
    """

    drift_psd: float = float(np.deg2rad(0.12) ** 2)
    rate_std: float = float(np.deg2rad(0.05))
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
    rate_std=float(np.deg2rad(0.2)),
    joint_std=float(np.deg2rad(0.5)),
    girdle_std=float(np.deg2rad(0.5)),
    twist_std=float(np.deg2rad(0.5)),
    hinge_std=float(np.deg2rad(0.5)),
)


class HingeAxis(NamedTuple):
    """A hinge between two segments with sensors.

    Parameters
    ----------
    on, moves : indices of the segment above and of the one below
    axis, on_along : (3,) unit, the axis and the long axis of `on`, in the frame of `on`
    along : (3,) unit, the long axis of `moves`, in the frame of `moves`
    range : [rad] of the angle about the axis from the long axis of `on` to that of `moves`
    axis_std, tilt_std : [rad] as in `HeadingNoise`
    std : [rad] of the angle between the hinge's plane and the long axis of `moves`
    """

    joint: str
    on: int
    moves: int
    axis: np.ndarray
    on_along: np.ndarray
    along: np.ndarray
    range: tuple[float, float]
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
    girdles : those that move the ends; of each the name, the sign, and the index of the vector on whose segment it is
    """

    segments: np.ndarray
    vectors: np.ndarray
    by_length: np.ndarray
    girdles: tuple[tuple[str, float, int], ...]

    @classmethod
    def from_parts(
        cls,
        model: BodyModel,
        names: Sequence[str],
        parts: Sequence[Part],
        neutral: StartPose,
        girdles: Sequence[tuple[str, float]],
    ) -> Way:
        """Return the way of `parts`, whose frames equal W in the pose `neutral`; `names` are the segments."""
        parts = [part for part in parts if part.sensor in names]  # the others do not rotate
        lengths = np.array(list(model.lengths.values()))
        R_LW = [neutral.R_WK[part.sensor].T for part in parts]
        carriers = [part.sensor for part in parts]
        return cls(
            np.array([names.index(carrier) for carrier in carriers], dtype=int),
            np.array([R @ part.vector(lengths) for R, part in zip(R_LW, parts, strict=True)]).reshape(-1, 3),
            np.array([R @ np.array(part.by_length) for R, part in zip(R_LW, parts, strict=True)]),
            tuple((name, sign, carriers.index(model.table.girdles[name].on)) for name, sign in girdles),
        )

    def turn(self, R_WL: np.ndarray, motions: Mapping[str, GirdleMotion]) -> np.ndarray:
        """Return the vectors (p, n, 3) [m] in W, for orientations (k, n, 3, 3) and the motions of the girdles."""
        turned = np.asarray((R_WL[self.segments] @ self.vectors[:, None, :, None])[..., 0])
        for name, sign, i in self.girdles:
            turned[i] += sign * (R_WL[self.segments[i]] @ motions[name].displacement[:, :, None])[..., 0]
        return turned


class CoincidentPoints(NamedTuple):
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
    """What the orientation filters of k sensors know of their headings after a sample.

    Parameters
    ----------
    var : (k,) [rad²] of the heading; NaN: the filter has no covariance
    about_vertical : (k,) each
    """

    var: np.ndarray
    about_vertical: AboutVertical


class Knot(NamedTuple):
    """The observations of a knot, with uncorrected headings."""

    end: float  # [s]
    time: np.ndarray  # (m,) [s] of the samples
    quat_WL: np.ndarray  # (m, k, 4) xyzw
    sides: np.ndarray  # (m, k, 3, 8) of each sensor at its joints, as `JointAccelerationFilter.push`
    filters: FilterHeadings  # at the end
    lost: np.ndarray  # (k,) bool: the sensor has lost a sample


@dataclass(frozen=True)
class HeadingProblem:
    """What observes the headings of a recording, and how well they are known at the start.

    Parameters
    ----------
    names : segments, in the order of δ
    knot_s : [s] length of a knot
    drift_psd : (k,) [rad²/s] largest growth of a heading's variance apart from that by its rate
    rate_std : (k,) [rad/s] of the drift rates at the start: of the gyroscopes' biases, or of measured orientations
    start_var, mount_var : (k,) [rad²] of the headings at the end of the start pose, by the pose and by the mounts
    start : what the filters know at the end of the start pose; None: as at the end of the first knot
    delay_std : [s] by which an accelerometer is late against its gyroscope
    causal : headings are corrected as samples come; a short clasp then counts as one observation
    """

    names: tuple[str, ...]
    model: BodyModel
    subject: Subject
    pairs: tuple[JointPair, ...]
    hinges: tuple[HingeAxis, ...]
    closures: tuple[CoincidentPoints, ...]
    noise: HeadingNoise
    knot_s: float
    samples_per_knot: int
    drift_psd: np.ndarray
    rate_std: np.ndarray
    start_var: np.ndarray
    mount_var: np.ndarray
    delay_std: float
    start: FilterHeadings | None = None
    causal: bool = False

    @cached_property
    def shape_cov(self) -> np.ndarray:
        """The covariance of the lengths and of the girdles' parameters, as `Subject.shape_covariance`."""
        return self.subject.shape_covariance(self.model.table)

    @property
    def size(self) -> int:
        """Number of states."""
        return self.find_column("lever", 6 * len(self.pairs))

    @cached_property
    def start_columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The columns (k,) of the headings, of the mounts' errors and of those of the segments in the start pose."""
        segments = np.arange(len(self.names))
        return segments, self.find_column("mount", 0) + segments, self.find_column("start", 0) + segments

    def find_column(self, state: str, index: int) -> int:
        """Find the column of a state; `index` is that of its segment, joint or hinge.

        A force has 3 columns for each, so that `index` is 3 times that; the levers of a joint have 6.
        """
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
            "delay": 6 * k + j + 3 * h,
            "start": 7 * k + j + 3 * h,
            "lever": 8 * k + j + 3 * h,
        }
        return first[state] + index

    @cached_property
    def hinge_columns(self) -> list[np.ndarray]:
        """The columns of each hinge, in the order of `heading_observations.HingeRows.H`."""
        return [
            np.array([hinge.moves, hinge.on, *(self.find_column(state, i) for state in ("axis", "twist", "tilt"))])
            for i, hinge in enumerate(self.hinges)
        ]

    @cached_property
    def pair_columns(self) -> list[np.ndarray]:
        """The columns (17,) of each joint: headings of its segments, joint; lever, force and delay near and far."""
        columns = []
        for i, pair in enumerate(self.pairs):
            near, far = self.names.index(pair.near), self.names.index(pair.far)
            first = self.find_column("lever", 6 * i)
            sides = [
                np.concatenate((lever + np.arange(3), self.find_force_columns(at), [self.find_column("delay", at)]))
                for at, lever in ((near, first), (far, first + 3))
            ]
            columns.append(np.concatenate(([near, far, self.find_column("joint", i)], *sides)))
        return columns

    def find_lever_columns(self, pair: int) -> slice:
        first = self.find_column("lever", 6 * pair)
        return slice(first, first + 6)

    def find_force_columns(self, segment: int) -> np.ndarray:
        return self.find_column("force", 3 * segment) + np.arange(3)
