"""``wepose retarget``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..diagnostics import from_json
from ..jobs.retarget import RetargetJob, run_retarget
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .parser import Command


def run(job: RetargetJob) -> int:
    """Compute the trajectory; print the errors of the hands and the margins to the limits."""
    with progress_bar() as progress:
        outcome = run_retarget(job, progress)
    print_diagnostics([*map(from_json, outcome.summary["diagnostics"]), *outcome.page_failures])
    _print_arms(outcome.summary)
    _print_checks(outcome.summary)
    out = job.out
    say(f"Trajectory: {out / 'trajectory.parquet'}  {out / 'joint_trajectory.json'}  {out / 'summary.json'}")
    say_pages(out, {"Report": "report.html", "Motion": "view.html"})
    return 0 if outcome.runnable else 3


def _print_arms(summary: Mapping[str, Any]) -> None:
    """Errors of the hands, and their causes."""
    rows, reasons = [], []
    for side, arm in summary["arms"].items():
        inside, rotation, swivel, reachability = (
            arm[key] for key in ("hand_error_mm", "hand_error_deg", "swivel_error_deg", "reachability")
        )
        near = reachability["hand_error_where_reachable_mm"]
        rows.append(
            (
                side,
                f"{arm['scale']:.2f}",
                *((f"{error[key]:.1f}" if error else "") for error in (inside, near) for key in ("median", "p90")),
                f"{rotation['median']:.1f}",
                f"{swivel['median']:.0f}" if swivel else "",
                f"{100 * reachability['reachable_share']:.0f}",
            )
        )
        reasons.append((side, *(f"{100 * share:.1f}" for share in arm["error_attribution"].values())))
    slowdown = summary["slowdown"]
    hand = ("hand [mm] median", "90 %", "where reachable: median", "90 %")
    print_table(
        f"{summary['robot']}: {summary['duration_s']:.1f} s, of which {summary['approach_s']:.1f} s are the approach; "
        f"{summary['recorded_s']:.1f} s recorded" + (f", {slowdown:.2f} times as long" if slowdown is not None else ""),
        ("arm", "scale", *hand, "orientation [deg]", "elbow swivel [deg]", "reachable [%]"),
        rows,
    )
    title = "Hand more than 20 mm off [% of the time], by cause; what to do: docs/retargeting.md"
    print_table(title, ("arm", *arm["error_attribution"]), reasons)


def _print_checks(summary: Mapping[str, Any]) -> None:
    """Margins to the limits, self-collisions and the time of a step."""
    margins, collisions = summary["limit_margins"], summary["self_collisions"]
    say(
        f"Limits {'kept' if summary['within_limits'] else 'NOT KEPT'}: position {margins['position_rad']:.4f} rad, "
        f"velocity {100 * margins['velocity_share']:.1f} %, "
        f"acceleration {100 * margins['acceleration_share']:.1f} %, jerk {100 * margins['jerk_share']:.1f} % to spare"
    )
    if not collisions["pairs"]:
        say("Self-collision NOT CHECKED: no two shapes of the robot can meet, as its URDF has them")
    elif not collisions["samples"]:
        closest = collisions["min_hull_distance_mm"]
        say("No self-collision" + ("" if closest is None else f"; at the closest, {closest:.0f} mm between hulls"))
    braked = summary["steps"]["stopping_share"]
    if braked:
        say(f"Braked in {100 * braked:.2f} % of the steps, since no other kept all limits and left a way to stop")
    say(f"Solved in {summary['solve_ms']['p50']:.2f} ms (p50), {summary['solve_ms']['p99']:.2f} ms (p99) a step")


COMMAND = Command(
    RetargetJob,
    run,
    example="retarget result --robot panda_table -o panda",
    arguments=("result",),
    exit_codes="0 the trajectory keeps the robot's limits, has no self-collision (checked on what is written), and "
    "no hand stays off a target that it can reach; 3 one of these does not hold: the files are written, but no robot "
    "may run them; 2 invalid input, nothing is written.",
)
