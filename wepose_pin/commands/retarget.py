"""``wepose retarget``: a person's arms → a robot's joint trajectory."""

from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from ..diagnostics import from_json
from . import options as opt
from .options import described_by
from .output import Outcome, print_diagnostics, print_table, progress_bar, say, say_pages, say_paragraph


@described_by("retargeting/trajectory.py:retarget")
def retarget(
    result: Path,
    /,
    *,
    robot: opt.RobotName,
    out: opt.Out,
    arm: opt.Arms | None = None,
    rate_hz: opt.RobotHz = 100.0,
    interval: opt.Interval | None = None,
    phase: opt.PhaseName | None = None,
    view: bool = True,
    report: bool = True,
    force: opt.Force = False,
    task: Annotated[Literal["both", "position", "orientation"], opt.MORE] = "both",
    scale: Annotated[opt.Factor | None, opt.MORE] = None,
    smoothing_hz: Annotated[opt.Hz, opt.MORE] = 6.0,
    speed_scale: Annotated[opt.Share | None, opt.MORE] = None,
    limit_margin: Annotated[opt.Radians | None, opt.MORE] = None,
) -> Outcome:  # of what summary.json holds
    """Retarget a person's arms to a robot: a joint trajectory within its limits, without self-collision.

    Robots by name: panda, panda_table, ur5, ur5_table, so101, baxter, tiago_dual, talos, g1. For any other
    robot give its URDF, with a robot map beside it: a TOML that names shoulder, elbow and hand (docs/robot-maps.md).

    Exit code: 0 the trajectory keeps the robot's limits and has no self-collision (checked on what is written); 3 one
    of these does not hold: the files are written, but no robot may run them; 2 invalid input, nothing is written.

    Example: wepose retarget result --robot panda_table -o panda

    Parameters
    ----------
    result
        Folder that `wepose track` wrote.
    out
        Write trajectory.parquet and .csv, joint_trajectory.json, summary.json, view.html, report.html to this folder.
    view
        Write view.html, the animation of the robot beside the person.
    report
        Write report.html, which shows the errors of the hands with their causes, distances and joint limits.
    """
    options = dict(locals())
    import json

    from .. import retargeting
    from ..report import retargeting as report_room
    from ..report.page import write_pages
    from ..report.viewer import retarget_html
    from ..retargeting.trajectory import STAGES
    from ..writers import load_result, select_pose
    from ..writers.result import as_json, collect_provenance, result_folder

    names = ("robot", "arm", "task", "rate_hz", "scale", "smoothing_hz", "speed_scale", "limit_margin")
    chosen: dict[str, Any] = {name: options[name] for name in names}
    with progress_bar() as progress, result_folder(out, force, "retarget") as folder:
        progress("reading", 0.0)
        tracked = load_result(result)
        pose, body, name = select_pose(tracked, interval, phase), tracked.model, tracked.name
        trajectory = retargeting.retarget(
            pose,
            table=body.table,
            progress=lambda text, fraction: progress(text, 0.48 * (fraction + STAGES.index(text))),
            **chosen,
        )
        progress("checking", 0.96)
        check = retargeting.check_limits(retargeting.build_table(trajectory), trajectory.robot.map)
        collisions = retargeting.find_self_collisions(trajectory.robot, trajectory.time, trajectory.joint_position)
        progress("writing", 0.98)
        retargeting.write_trajectory(folder, trajectory)
        summary = as_json(retargeting.summarize(trajectory, check, collisions))
        phases = {name: list(map(list, spans)) for name, spans in tracked.phases.items()}
        summary |= {"recording": name, "recorded_phases": phases}
        text = json.dumps({**summary, "provenance": collect_provenance("retarget", options)}, indent=2)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
        progress("making the pages", 0.99)
        title = f"{name} on {trajectory.robot.map.name}"

        @cache
        def make_view() -> str:
            return retarget_html(body, pose, trajectory, title=title)

        def make_report() -> str:
            page = make_view() if view else None
            return report_room.render_retargeting_report(trajectory, summary, title=title, view=page)

        pages = {"view.html": make_view if view else None, "report.html": make_report if report else None}
        failures = write_pages(folder, pages)
    print_diagnostics([*map(from_json, summary["diagnostics"]), *failures])
    for table in report_room.tabulate_hands(summary):
        print_table(*table)
    for text in (report_room.describe_run(summary), report_room.describe_reliance(trajectory, summary)):
        say_paragraph(text)
    say(f"Trajectory: {out / 'trajectory.parquet'}  {out / 'joint_trajectory.json'}  {out / 'summary.json'}")
    say_pages(out)
    runnable = summary["within_limits"] and not summary["self_collisions"]["samples"]
    return Outcome(summary, 0 if runnable else 3)
