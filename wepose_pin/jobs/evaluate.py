"""``wepose evaluate``: a result against a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import BadOption, WrongOption
from . import Progress, no_progress

if TYPE_CHECKING:
    from ..evaluation import Evaluation


@dataclass(frozen=True)
class EvaluateJob:
    """Compare a result with a reference: attitude, drift, joint angles, positions, stated uncertainty.

    Prints for each segment the attitude error (roll, pitch, yaw about the axes of W), inclination, heading and total
    RMSE [deg] and the drift of the heading [deg/min]; for each joint the error of its angles [deg]; for each point the
    position error [mm], relative to the root and to the place where its limb begins, such as the middle of the
    shoulders; and whether the stated standard deviations are consistent with the errors. Writes nothing.

    A table with the columns of pose.parquet is compared as it is, without alignment. A file of another system (.c3d,
    .trc, .mvnx) is brought to the clock and the heading of the result first, by the first third of the result, which
    is then not scored. Prints the clock offset and the heading too, and the agreement of joint angles (Bland-Altman,
    ICC).

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` wrote.
    truth : TRUTH
        Table (.parquet or .csv) with the columns of pose.parquet, or a session that names one (data.truth); markers or
        rotations (.c3d), markers (.trc), an Xsens MVNX.
    interval : FROM TO
        Compare only this time of the recording, in seconds.
    phase : NAME
        Compare only this phase of the recording. Of a phase with several intervals NAME:2 is the second.
    align
        Bring a file of another system to the clock and the world of the result.
    fit : world|segments
        Fit this to the result, also of a table. world: clock, heading and place; segments: in addition a constant
        rotation of each segment's frame, for frames that are not those of docs/concepts.md.
    time_offset : SECONDS
        Add this to the times of the reference, instead of fitting the offset.
    markers : TOML
        Use this table of markers before the one of the package (docs/formats.md).
    """

    result: Path
    truth: Path
    interval: tuple[float, float] | None = None
    phase: str | None = None
    align: bool = True
    fit: Literal["world", "segments"] | None = None
    time_offset: float | None = None
    markers: Path | None = None

    def check(self) -> None:
        """Raise `BadOption` where the interval is none, or options contradict each other."""
        from ..recording import check_selection

        if not self.align and self.fit is not None:
            raise WrongOption("fit", self.fit, "nothing is fitted with --no-align; leave out one of the two")
        check_selection(self.interval, self.phase)


def run_evaluate(job: EvaluateJob, progress: Progress = no_progress) -> Evaluation:
    """The errors of a result; nothing is written.

    Raises
    ------
    WeposeError
        No result, no reference, or nothing that both have.
    """
    from ..evaluation import evaluate, register
    from ..kinematics import Pose, parse_pose_table
    from ..readers import load_session
    from ..readers.reference import is_reference, read_reference
    from ..readers.tables import read_table
    from ..recording import select_interval
    from ..writers import read_result
    from ..writers.result import read_phases

    job.check()
    progress("reading", 0.0)
    pose, model, summary = read_result(job.result)
    selected = select_interval(pose.time, read_phases(summary), job.interval, job.phase)
    truth: Path | None = job.truth
    if job.truth.suffix == ".toml" or job.truth.is_dir():
        truth = load_session(job.truth, gaps=True).truth
    if truth is None:
        raise BadOption(f"{job.truth}: data.truth is missing; the session names no reference to compare with")
    foreign = is_reference(truth)
    if job.markers is not None and not foreign:
        raise WrongOption("markers", str(job.markers), f"a .c3d or .trc as TRUTH; {truth.name} has no markers")
    if foreign:
        measured = read_reference(truth, job.markers)
        reference, up = Pose(measured.time, measured.quat_VT, measured.points), measured.up
        fit: str | None = job.fit or ("segments" if measured.own_frames else "world")
    else:
        reference, up, fit = parse_pose_table(read_table(truth), str(truth)), None, job.fit
    progress("comparing", 0.5)
    if not job.align or fit is None:
        if job.time_offset:
            reference = replace(reference, time=reference.time + job.time_offset)
        return evaluate(pose, reference, selected, model.table)
    reference, registration = register(pose, reference, up=up, frames=fit == "segments", offset_s=job.time_offset)
    first, last = registration.scored
    interval = selected or registration.scored
    scored = max(first, interval[0]), min(last, interval[1])
    if not scored[0] < scored[1]:
        raise WrongOption(
            "interval",
            f"{interval[0]:g} {interval[1]:g}",
            f"seconds after {first:.1f}, as those before align the reference; or --no-align",
        )
    errors = evaluate(pose, reference, scored, model.table)
    return replace(errors, registration=replace(registration, scored=scored))
