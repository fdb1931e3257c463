"""``wepose evaluate``: a result against a reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import BadOption, WrongOption
from . import Progress, no_progress

if TYPE_CHECKING:
    from ..evaluation import Evaluation
    from ..tracking import TrackedRecording


@dataclass(frozen=True)
class EvaluateJob:
    """Compare a result with a reference: attitude, drift, joint angles, positions, stated uncertainty.

    Prints for each segment the attitude error (roll, pitch, yaw about the axes of W), inclination, heading and total
    RMSE [deg] and the drift of the heading [deg/min]; for each joint the error of its angles [deg]; for each point the
    position error [mm], relative to the root and to where its limb hangs, as the middle of the shoulders; and whether
    the stated standard deviations are consistent with the errors. Headings are compared as they are, without alignment.
    Nothing is written.

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` wrote.
    truth : TRUTH
        Table (.parquet or .csv) with the columns of pose.parquet, or a session that names one (data.truth).
    interval : FROM TO
        Compare only from this to this time, in seconds.
    """

    result: Path
    truth: Path
    interval: tuple[float, float] | None = None

    def check(self) -> None:
        """Raise `BadOption` where the interval is none."""
        if self.interval is not None and not self.interval[0] < self.interval[1]:
            begin, end = self.interval
            needed = "two times in seconds are needed, the earlier one first"
            raise WrongOption("interval", f"{begin:g} {end:g}", needed)


def run_evaluate(
    job: EvaluateJob, progress: Progress = no_progress, tracked: TrackedRecording | None = None
) -> Evaluation:
    """The errors of a result; nothing is written.

    Parameters
    ----------
    tracked : the result with its covariances, where it is at hand; None: as the folder holds it

    Raises
    ------
    WeposeError
        No result, no reference, or nothing that both have.
    """
    from ..evaluation import evaluate
    from ..kinematics import parse_pose_table
    from ..readers import load_session
    from ..readers.tables import read_table
    from ..writers import read_result

    job.check()
    progress("reading", 0.0)
    if tracked is not None:
        pose, table = tracked.pose, tracked.model.table
    else:
        pose, model, _ = read_result(job.result)
        table = model.table
    truth: Path | None = job.truth
    if job.truth.suffix == ".toml" or job.truth.is_dir():
        truth = load_session(job.truth, gaps=True).truth
    if truth is None:
        raise BadOption(f"{job.truth}: data.truth is missing; the session names no reference to compare with")
    reference = parse_pose_table(read_table(truth), str(truth))
    progress("comparing", 0.5)
    return evaluate(pose, reference, job.interval, table)
