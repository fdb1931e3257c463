"""``wepose retarget``: a person's arms → a robot's joint trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ..diagnostics import Diagnostic
from . import Arms, Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..kinematics import Pose
    from ..retargeting import Trajectory

PAGES = {"view.html": "view", "report.html": "report"}  # page → option


@dataclass(frozen=True)
class RetargetJob:
    """Retarget a person's arms to a robot: a joint trajectory within its limits, without self-collision.

    Robots by name: panda and ur5, both also on a table (panda_table, ur5_table), so101, baxter, tiago_dual, talos, g1,
    alex (from the package example-robot-data). Any other by its URDF with a robot map beside it, a TOML that says which
    links are shoulder, elbow and hand (docs/robot-maps.md).

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` wrote.
    robot : NAME|FILE
        Move this robot: one of the names above, a URDF with a robot map beside it (ARM.urdf, ARM.toml), or the robot
        map itself.
    out : DIR
        Write trajectory.parquet and .csv, joint_trajectory.json, summary.json, view.html and report.html to
        this folder.
    arm
        Move only this arm of the robot, or both. Without it all arms that the robot has.
    rate_hz : HZ
        Sample the trajectory at this rate, 10 to 2000 Hz: that of the robot's own controller.
    task
        Follow the position of the person's hands, their orientation, or both.
    scale : FACTOR
        Scale the distance from shoulder to hand by this factor. Without it the ratio of the reach of the robot's arm to
        the length of the person's (docs/retargeting.md).
    smoothing_hz : HZ
        Low-pass filter the person's motion at this frequency; 0 does not filter it.
    speed_scale : SHARE
        Use this share of the robot's limits of velocity, acceleration and jerk, above 0, up to 1.
    limit_margin : RAD
        Keep this distance from the position limits, in radians; from those of a prismatic joint a tenth of it,
        in metres.
    interval : FROM TO
        Follow only this time of the recording, in seconds.
    phase : NAME
        Follow only this phase of the recording. Of a phase with several intervals NAME:2 is the second.
    strict
        Refuse a motion that is too fast for the robot, instead of slowing it down.
    view
        Write view.html, the animation of the robot beside the person.
    report
        Write report.html, which shows the errors of the hands with their causes, distances and joint limits.
    force
        Replace the files of an earlier run in DIR.
    """

    result: Path
    robot: str
    out: Path
    arm: Arms | None = None
    rate_hz: float = 100.0
    task: Literal["both", "position", "orientation"] = "both"
    scale: float | None = None
    smoothing_hz: float = 6.0
    speed_scale: float = 0.9
    limit_margin: float = 0.05
    interval: tuple[float, float] | None = None
    phase: str | None = None
    strict: bool = False
    view: bool = True
    report: bool = True
    force: bool = False

    def check(self) -> None:
        """Raise `WeposeError` where there is no such robot, or a number is out of its range."""
        from ..recording import check_selection
        from ..retargeting import LimitMargins, find_map
        from ..retargeting.targets import check_scale_and_smoothing
        from ..retargeting.trajectory import check_rate

        check_selection(self.interval, self.phase)
        check_rate(self.rate_hz)
        check_scale_and_smoothing(self.scale, self.smoothing_hz)
        LimitMargins(self.speed_scale, self.limit_margin).check()
        find_map(self.robot)


class RetargetOutcome(NamedTuple):
    """What came of a `RetargetJob`."""

    summary: Mapping[str, Any]  # as in summary.json, page failures apart
    page_failures: list[Diagnostic]
    duration_s: float

    @property
    def runnable(self) -> bool:
        """Whether a robot may run it: limits kept, no self-collision, no hand off a target that it can reach."""
        summary = self.summary
        return bool(summary["within_limits"]) and not (
            summary["self_collisions"]["samples"] or summary["missed_targets"]
        )


def run_retarget(job: RetargetJob, progress: Progress = no_progress) -> RetargetOutcome:
    """Compute a trajectory, check it and write its folder, whole or not at all; its page follows.

    Raises
    ------
    WeposeError
        No result, no such robot, an arm without sensors; with `strict` a motion that is too fast.
    """
    import json

    from .. import retargeting
    from ..documents import whole_folder
    from ..report.page import PageWriter
    from ..report.retargeting import render_retargeting_report
    from ..report.viewer import retarget_html
    from ..retargeting.trajectory import STAGES
    from ..writers import read_result
    from ..writers.joint_motion import REPETITIONS
    from ..writers.provenance import collect_provenance
    from ..writers.result import as_json, read_phases

    job.check()
    with whole_folder(job.out, job.force) as folder:
        progress("reading", 0.0)
        pose, body, about = read_result(job.result, job.interval, job.phase)
        trajectory = retargeting.retarget(
            pose,
            job.robot,
            arm=job.arm,
            task=job.task,
            rate_hz=job.rate_hz,
            scale=job.scale,
            smoothing_hz=job.smoothing_hz,
            speed_scale=job.speed_scale,
            limit_margin=job.limit_margin,
            strict=job.strict,
            table=body.table,
            progress=lambda text, fraction: progress(text, 0.48 * (fraction + STAGES.index(text))),
        )
        robot = trajectory.robot
        progress("checking", 0.96)
        check = retargeting.check_limits(retargeting.build_table(trajectory), robot.map)
        collisions = retargeting.find_self_collisions(robot, trajectory.time, trajectory.joint_position)
        progress("writing", 0.98)
        retargeting.write_trajectory(folder, trajectory)
        summary = as_json(retargeting.summarize(trajectory, check, collisions))
        summary |= {
            "recording": str(about.get("recording") or job.result.name),
            "recorded_phases": {name: list(map(list, spans)) for name, spans in read_phases(about).items()},
            REPETITIONS: _find_repetitions(pose, trajectory),
        }
        text = json.dumps({**summary, "provenance": collect_provenance("retarget", field_values(job))}, indent=2)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    progress("making the pages", 0.99)
    title = f"{about.get('recording') or job.result.name} on {robot.map.name}"
    writer = PageWriter(job.out, [name for name, wanted in PAGES.items() if getattr(job, wanted)])
    page = None
    if job.view:
        page = writer.write("view.html", lambda _: retarget_html(body, pose, trajectory, title=title))
    if job.report:
        writer.write(
            "report.html",
            lambda failures: render_retargeting_report(trajectory, summary, title=title, view=page, failures=failures),
        )
    writer.save_diagnostics("summary.json")
    return RetargetOutcome(summary, writer.diagnostics, float(trajectory.time[-1]))


def _find_repetitions(pose: Pose, trajectory: Trajectory) -> dict[str, Any]:
    """The repetitions of the arms that a robot follows, by which angle, when [s].

    They are those that `wepose angles` finds; where no angle repeats, the movements of the hands between rests.
    """
    from dataclasses import replace

    from ..angles import joint_angles
    from ..angles.repetitions import find_movements, find_repetitions

    angles, targets = joint_angles(pose), trajectory.arm_targets
    sides = tuple(arm.side for arm in trajectory.robot.arms)
    of_arms = {name: each for name, each in angles.joints.items() if name.startswith(sides)}
    repetitions = find_repetitions(replace(angles, joints=of_arms))
    source, spans, reason = repetitions.source, repetitions.spans, repetitions.reason
    if not len(spans):
        spans = find_movements(targets.time, *(hand.position for hand in targets.hands))
        source, reason = ("hands between rests", "") if len(spans) else (source, reason)
    return {"source": source, "spans": spans.tolist(), "reason": reason}
