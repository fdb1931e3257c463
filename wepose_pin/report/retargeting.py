"""The report of a robot's trajectory: the hands and why they are off, the distance of its parts, joint limits."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..diagnostics import from_json
from ..retargeting import Trajectory
from ..retargeting.collision import CLEARANCE
from ..retargeting.files import CAUSES, FAR, find_error_causes
from . import figures as fig
from .figures import ReportFigure, styled
from .page import Frame, Item, render_page, show_diagnostics
from .words import Table, number, plain

CAUSE_COLOURS = (fig.ALARM, *fig.SESSION_COLOURS, fig.SOFT)  # of `CAUSES`


def render_retargeting_report(
    trajectory: Trajectory, summary: Mapping[str, Any], *, title: str = "", view: str | None = None
) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic.

    Parameters
    ----------
    summary : as in ``summary.json``
    title : what moves what, for the heading
    view : the page of `retarget_html`, embedded; None: left out
    """
    runnable = summary["within_limits"] and not summary["self_collisions"]["samples"]
    reliable = "**Limits kept, no self-collision,** nothing had to be slowed."
    return render_page(
        f"Motion of {title or 'a robot'}",
        [
            describe_reliance(trajectory, summary),
            show_diagnostics([*map(from_json, summary["diagnostics"])], reliable, unusable=not runnable),
            describe_run(summary),
        ],
        {
            "The hands against their targets": [draw_hands(trajectory), *tabulate_hands(summary)],
            "The robot's parts against each other": [_describe_distances(summary)],
            "The joints against their limits": _list_joints(trajectory, summary),
            "The motion in 3D": [] if view is None else [Frame(view)],
        },
    )


def _compute_hand_errors(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Side → (n,) [mm], the distance of the hand from its target."""
    return {
        arm.side: 1e3 * np.linalg.norm(trajectory.p_BH[i] - trajectory.targets[i].unclamped, axis=1)
        for i, arm in enumerate(trajectory.robot.arms)
    }


def describe_reliance(trajectory: Trajectory, summary: Mapping[str, Any]) -> str:
    """Two sentences: whether a robot may run it, and how well the hands follow."""
    contacts = summary["self_collisions"]["samples"]
    problems = ["leaves the robot's limits"] * (not summary["within_limits"])
    problems += [f"has self-collisions in {contacts} samples"] * bool(contacts)
    checked = "its checked parts do not collide" if summary["self_collisions"]["pairs"] else "no two parts can meet"
    errors = _compute_hand_errors(trajectory)
    worst = max(errors, key=lambda side: float(errors[side].max()))
    sample = int(np.argmax(errors[worst]))
    return (
        f"The trajectory {' and '.join(problems) or f'keeps all limits, and {checked}'}. At worst, at "
        f"{trajectory.time[sample]:.1f} s of the trajectory ({trajectory.recorded_time[sample]:.1f} s of the "
        f"recording), the {worst} hand is {errors[worst][sample]:.0f} mm off its target."
    )


def tabulate_hands(summary: Mapping[str, Any]) -> list[Table]:
    """Errors of the hands, and their causes."""
    arms, rows = summary["arms"], []
    for side, arm in arms.items():
        swivel = number(arm["swivel_error_deg"]["median"], 0) if arm["swivel_error_deg"] else ""
        error = arm["hand_error_everywhere_mm"]
        distances = [number(error[key], 1) if error else "" for key in ("median", "p90")]
        rows.append([side, f"{arm['scale']:.2f}", *distances, number(arm["hand_error_deg"]["median"], 1), swivel])
    causes = [[cause, *(f"{100.0 * arm['error_attribution'][cause]:.1f}" for arm in arms.values())] for cause in CAUSES]
    header = ["arm", "scale", "median", "90 %", "orientation [deg]", "elbow swivel [deg]"]
    title = f"Share of the time in which a hand is over {1e3 * FAR:g} mm off, by cause; the first that applies counts"
    return [
        Table("Distance of each hand from its target [mm]", header, rows),
        Table(title, ["cause", *(f"{side} [%]" for side in arms)], causes),
    ]


def _describe_distances(summary: Mapping[str, Any]) -> str:
    contacts = summary["self_collisions"]
    text = f"The parts, {contacts['pairs']} pairs of them, collide in {contacts['samples']} samples."
    if (least := contacts["min_hull_distance_mm"]) is not None:
        text += (
            f" The least distance of their convex hulls, which are larger, is {least:.1f} mm; the controller keeps "
            f"{1e3 * CLEARANCE:g} mm."
        )
    return text


def _list_joints(trajectory: Trajectory, summary: Mapping[str, Any]) -> list[Item]:
    robot = trajectory.robot
    limits, dt = robot.map.read_joint_limits(), float(trajectory.time[1] - trajectory.time[0])
    jerk = np.diff(trajectory.joint_acceleration, axis=0) / dt
    rows = []
    for j in (j for arm in robot.arms for j in arm.joints.tolist()):
        name, position, limit = robot.names[j], trajectory.joint_position[:, j], limits[robot.names[j]]
        factor, unit = (1e3, " mm") if limit.kind == "prismatic" else (180.0 / np.pi, "°")
        margin = factor * float(np.minimum(position - limit.lower, limit.upper - position).min())
        most = limit.velocity, robot.map.acceleration[name], robot.map.jerk[name]
        used = (
            np.abs(values[:, j]).max() for values in (trajectory.joint_velocity, trajectory.joint_acceleration, jerk)
        )
        shares = (f"{100.0 * value / end:.0f} % of {end:g}" for value, end in zip(used, most, strict=True))
        rows.append([plain(name), number(margin, 1, unit, unknown="no limit"), *shares])
    return [
        Table("", ["joint", "least distance to a position limit", "largest velocity", "acceleration", "jerk"], rows),
        f"Limits, in rad or m and s, are those of the robot's map, else of its URDF. {100 * robot.speed_scale:g} % of "
        f"those of velocity, acceleration and jerk are used (`--speed-scale`), and {robot.limit_margin:g} rad are left "
        f"to each position limit (`--limit-margin`). In {100 * summary['steps']['stopping_share']:.2f} % of the steps "
        "the robot braked, to keep all limits and a way to stop.",
    ]


def describe_run(summary: Mapping[str, Any]) -> str:
    """What was run, and how long it lasts."""
    slowed = f", {summary['slowdown']:.2f} times as long as recorded" if summary["slowdown"] is not None else ""
    return (
        f"{summary['robot']}: {summary['duration_s']:.1f} s at {summary['rate_hz']:g} Hz, of which "
        f"{summary['approach_s']:.1f} s are the approach{slowed}. {summary['description']}"
    ).strip()


# Figures --------------------------------------------------------------------------------------------------------------


@styled
def draw_hands(trajectory: Trajectory) -> ReportFigure:
    """The distance of each hand from its target, and below why it is far off."""
    time, errors = trajectory.time, _compute_hand_errors(trajectory)
    figure = fig.draw_over_time(
        time,
        {f"{side} hand, distance from its target [mm]": {side: error} for side, error in errors.items()},
        f"The dashed line: {1e3 * FAR:g} mm. The bar below: why a hand is farther off than that.",
        {side: {**fig.line_style(side, side), "label": None, "linestyle": "-"} for side in errors},
        spans=("approach", [(0.0, float(time[trajectory.approach_samples]))]),
    )
    for i, (ax, error) in enumerate(zip(figure.axes, errors.values(), strict=True)):
        most = 1.08 * max(float(error.max()), 2e3 * FAR)
        ax.set_ylim(-0.16 * most, most)
        ax.axhline(1e3 * FAR, color=fig.SOFT, linestyle="--", linewidth=0.8)
        cause = find_error_causes(trajectory, i)
        for k, (name, colour) in enumerate(zip(CAUSES, CAUSE_COLOURS, strict=True)):
            if (cause == k).any():
                bars = [(a, max(b - a, time[1] - time[0])) for a, b in fig.find_spans(time, cause == k)]
                ax.broken_barh(bars, (-0.13 * most, 0.1 * most), facecolor=colour, label=name)
    figure.add_legend()
    return figure
