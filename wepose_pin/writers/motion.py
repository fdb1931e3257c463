"""The motion to export: a pose with its body, on even times where a format has only a rate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..body import BodyModel
from ..body.kinematics import Pose, compute_pose, find_usual_rate
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongOption

# Times count as even while none is off the even grid by more than this share of a step.
EVEN = 0.1
SLACK_S = 1e-6  # [s] by which times that are written with digits differ


@dataclass(frozen=True)
class Motion:
    """A result, read back."""

    pose: Pose
    model: BodyModel
    name: str  # of the recording
    where: str  # the result's folder, for error texts

    @property
    def rate_hz(self) -> float:
        """The rate of its usual time step."""
        return find_usual_rate(self.pose.time)


def make_times(time: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return even times (m,) [s] at this rate, from the first of the times (n,) to the last."""
    return np.asarray(time[0] + np.arange(int((time[-1] - time[0]) * rate_hz + SLACK_S) + 1) / rate_hz)


def is_even(time: np.ndarray) -> bool:
    """Return whether times (n,) are those of a constant rate."""
    grid = np.linspace(time[0], time[-1], len(time))
    return bool(np.abs(time - grid).max() * find_usual_rate(time) <= EVEN)


def check_rate(rate_hz: float) -> None:
    """Raise `WrongOption` where no recording has that rate."""
    if not 1.0 <= rate_hz <= 10000.0:
        raise WrongOption("rate-hz", f"{rate_hz:g}", "between 1 and 10000 samples a second")


def resample_evenly(motion: Motion) -> Motion:
    """Return the motion on even times."""
    return motion if is_even(motion.pose.time) else resample(motion, motion.rate_hz)


def resample(motion: Motion, rate_hz: float) -> Motion:
    """Return the motion at another rate: orientations by the shortest way between two samples, points from the body.

    No filter comes before: what is faster than half the new rate is folded.

    Raises
    ------
    BadData
        An orientation is not known.
    """
    check_complete(motion, "resampling")
    pose = motion.pose
    old = pose.time
    time = np.minimum(make_times(old, rate_hz), old[-1])
    after = np.clip(np.searchsorted(old, time, side="left"), 1, len(old) - 1)
    share = (time - old[after - 1]) / (old[after] - old[after - 1])

    def between(cov: np.ndarray) -> np.ndarray:
        w = share[:, None, None]
        return (1.0 - w) * cov[after - 1] + w * cov[after]

    quat_WL = {name: Slerp(old, Rotation.from_quat(quat))(time).as_quat() for name, quat in pose.quat_WL.items()}
    new = replace(
        compute_pose(motion.model, time, quat_WL),
        segment_cov={name: between(cov) for name, cov in pose.segment_cov.items()},
        point_cov={name: between(cov) for name, cov in pose.point_cov.items()},
        gap={
            name: (gap[after - 1] & (share < 1.0 - 1e-6)) | (gap[after] & (share > 1e-6))
            for name, gap in pose.gap.items()
        },
    )
    return replace(motion, pose=new)


def check_complete(motion: Motion, format_name: str) -> None:
    """Raise `BadData` where a sample of a segment has no orientation, which the format cannot leave out."""
    for segment, quat in motion.pose.quat_WL.items():
        lost = ~np.isfinite(quat).all(axis=1)
        if lost.any():
            raise BadData(
                f"{motion.where}: {segment} has no orientation in row {int(np.argmax(lost)) + 1} of pose.parquet; "
                f"{format_name} needs one in every row, csv and parquet do not"
            )


def diagnose_gaps(motion: Motion) -> list[Diagnostic]:
    """List the segments with gaps, where a format has no way to mark them."""
    gaps = {segment: int(np.count_nonzero(gap)) for segment, gap in motion.pose.gap.items()}
    unmarked = {"variant": "unmarked"}
    return [
        Diagnostic("samples-lost", WARNING, segment, count, facts=unmarked) for segment, count in gaps.items() if count
    ]


def find_measured_points(motion: Motion) -> dict[str, np.ndarray]:
    """Point → (n, 3) [m] in W, NaN where a segment on its way from the root was bridged over a gap.

    Raises
    ------
    BadData
        No point is known.
    """
    pose = motion.pose
    if not pose.points:
        first = motion.model.table.reference
        raise BadData(
            f"{motion.where}: no points in pose.parquet, for lack of a sensor on the {first}; this format needs them"
        )
    points = {}
    for point, p_W in pose.points.items():
        lost = [pose.gap[link] for link in motion.model.reaches[point] if link in pose.gap]
        points[point] = np.where(np.any(lost, axis=0)[:, None], np.nan, p_W) if lost else p_W
    return points
