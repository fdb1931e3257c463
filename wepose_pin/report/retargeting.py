"""The report of a robot's trajectory: the hands and why they are off, distances of the robot's parts, joint limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..diagnostics import from_json
from ..retargeting import Trajectory
from ..retargeting.collision import CLEARANCE, NEAR
from ..retargeting.error_attribution import CAUSES, FAR, find_error_causes
from .figures import (
    ALARM,
    COLOURS,
    SESSION_COLOURS,
    SOFT,
    ReportFigure,
    draw_over_time,
    envelope,
    find_spans,
    line_style,
    shade,
    styled,
)
from .page import Facts, Frame, Item, Page, Table, show_diagnostics
from .words import plain, whole

CAUSE_COLOURS = (ALARM, *SESSION_COLOURS, SOFT, COLOURS["other"])  # of `CAUSES`
PAIRS = 8  # that are listed, the closest ones


def render_retargeting_report(
    trajectory: Trajectory,
    summary: Mapping[str, Any],
    *,
    title: str = "",
    view: str | None = None,
    failures: list[str] | None = None,
) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic.

    Parameters
    ----------
    summary : as in ``summary.json``
    title : what moves what, for the heading
    view : the page of `retarget_html`, embedded; None: left out
    failures : gets a line for each section that cannot be made; the page has the line in place of the section
    """
    page = Page(f"Motion of {title or 'a robot'}", failures)
    page.add("What can be relied on", lambda: [_describe_reliance(trajectory, summary)], heading=False)
    page.add("Diagnostics", lambda: _list_diagnostics(summary), heading=False)
    page.add("The hands against their targets", lambda: _list_hands(trajectory, summary))
    page.add("The robot's parts against each other", lambda: _list_distances(trajectory, summary))
    page.add("The joints against their limits", lambda: _list_joints(trajectory, summary))
    ghosts = " Translucent: the targets of the hands."
    page.add("The motion in 3D", lambda: [] if view is None else [Frame(view, ghosts)])
    page.add("What was run", lambda: _list_run(summary))
    return page.html()


def _compute_hand_errors(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Side → (n,) [mm], the distance of the hand from its target."""
    return {
        arm.side: 1e3 * np.linalg.norm(trajectory.run.hand[i] - trajectory.targets[i].unclamped, axis=1)
        for i, arm in enumerate(trajectory.robot.arms)
    }


def _describe_reliance(trajectory: Trajectory, summary: Mapping[str, Any]) -> str:
    """Two sentences: whether a robot may run it, and how well the hands follow."""
    contacts = summary["self_collisions"]["samples"]
    problems = ["leaves the robot's limits"] * (not summary["within_limits"])
    problems += [f"has self-collisions in {contacts} samples"] * bool(contacts)
    text = f"The trajectory {' and '.join(problems) or 'keeps all limits, and its checked parts do not collide'}."
    errors = _compute_hand_errors(trajectory)
    worst = max(errors, key=lambda side: float(errors[side].max()))
    sample = int(np.argmax(errors[worst]))
    inside = [
        f"the {side} hand {arm['hand_error_mm']['median']:.1f} mm off its target (median)"
        for side, arm in summary["arms"].items()
        if arm["hand_error_mm"]
    ]
    follows = f"Within reach {' and '.join(inside)}; at" if inside else "At"
    return (
        f"{text} {follows} worst, at {trajectory.time[sample]:.1f} s, the {worst} hand is "
        f"{errors[worst][sample]:.0f} mm off."
    )


def _list_diagnostics(summary: Mapping[str, Any]) -> list[Item]:
    diagnostics = [from_json(entry) for entry in summary["diagnostics"]]
    runnable = summary["within_limits"] and not summary["self_collisions"]["samples"]
    reliable = "**Limits kept, no self-collision,** nothing had to be slowed."
    return [show_diagnostics(diagnostics, reliable, unusable=not runnable)]


def _describe_limits(summary: Mapping[str, Any]) -> str:
    unused = summary["limit_margins"]
    return (
        f"Never used: {100 * unused['velocity_share']:.1f} % of the velocity limits, "
        f"{100 * unused['acceleration_share']:.1f} % of those of acceleration, {100 * unused['jerk_share']:.1f} % of "
        f"those of jerk; {unused['position_rad']:.3f} rad to the nearest position limit. In "
        f"{100 * summary['steps']['stopping_share']:.2f} % of the steps the robot braked: no other kept all limits and "
        "left it a way to stop."
    )


def _list_hands(trajectory: Trajectory, summary: Mapping[str, Any]) -> list[Item]:
    arms = summary["arms"]
    errors = [
        [side, *(whole(arm["hand_error_everywhere_mm"][key]) for key in ("median", "p90", "p99"))]
        for side, arm in arms.items()
    ]
    causes = [[cause, *(f"{100.0 * arm['error_attribution'][cause]:.1f}" for arm in arms.values())] for cause in CAUSES]
    return [
        draw_hands(trajectory),
        Table(["side", "median [mm]", "90 %", "99 %"], errors),
        f"Share of the time in which a hand is over {1e3 * FAR:g} mm off, by cause; the first that applies counts:",
        Table(["cause", *(f"{side} [%]" for side in arms)], causes),
    ]


def _list_distances(trajectory: Trajectory, summary: Mapping[str, Any]) -> list[Item]:
    run, time, contacts = trajectory.run, trajectory.time, summary["self_collisions"]
    rows = []
    for pair in np.unique(run.report.nearest_pair[run.report.nearest_pair >= 0]).tolist():
        own = np.flatnonzero(run.report.nearest_pair == pair)
        least = own[np.argmin(run.report.hull_distance[own])]
        share = 100.0 * len(own) / len(time)
        rows.append(
            (float(run.report.hull_distance[least]), trajectory.collision.name_pair(pair), float(time[least]), share)
        )
    cells = [[name, f"{1e3 * d:.1f}", f"{t:.1f}", f"{share:.0f}"] for d, name, t, share in sorted(rows)[:PAIRS]]
    header = ["pair", "least distance [mm]", "at [s]", "closest pair for [% of the time]"]
    return [
        draw_distances(trajectory),
        *([Table(header, cells)] if cells else []),
        "Distances are those of convex hulls, which are larger than the parts. The parts themselves, "
        f"{contacts['pairs']} pairs of them, collide in {contacts['samples']} samples.",
    ]


def _list_joints(trajectory: Trajectory, summary: Mapping[str, Any]) -> list[Item]:
    robot, run = trajectory.robot, trajectory.run
    limits, dt = robot.map.read_joint_limits(), float(trajectory.time[1] - trajectory.time[0])
    jerk = np.abs(np.diff(run.joint_acceleration, axis=0)) / dt
    rows = []
    for j in (j for arm in robot.arms for j in arm.joints.tolist()):
        name, position = robot.names[j], run.joint_position[:, j]
        limit, (factor, unit) = limits[name], _choose_unit(limits[name].kind)
        margin = factor * float(np.minimum(position - limit.lower, limit.upper - position).min())
        rows.append(
            [
                plain(name),
                f"{margin:.1f} {unit}" if np.isfinite(margin) else "no limit",
                _format_share(np.abs(run.joint_velocity[:, j]).max(), limit.velocity),
                _format_share(np.abs(run.joint_acceleration[:, j]).max(), robot.map.acceleration[name]),
                _format_share(jerk[:, j].max(), robot.map.jerk[name]),
            ]
        )
    margins = robot.margins
    return [
        draw_joints(trajectory),
        Table(["joint", "least distance to a position limit", "largest velocity", "acceleration", "jerk"], rows),
        _describe_limits(summary),
        f"Limits are those of the robot's map, else of its URDF. {100 * margins.speed_scale:g} % of those of velocity, "
        f"acceleration and jerk are used (`--speed-scale`), and {margins.limit_margin:g} rad are left to each position "
        "limit (`--limit-margin`).",
    ]


def _choose_unit(kind: str) -> tuple[float, str]:
    return (1e3, "mm") if kind == "prismatic" else (180.0 / np.pi, "°")


def _format_share(value: float, limit: float) -> str:
    return f"{100.0 * value / limit:.0f} % of {limit:g}"


def _list_run(summary: Mapping[str, Any]) -> list[Item]:
    slowed = f"; {summary['slowdown']:.2f} times as long as recorded" if summary["slowdown"] is not None else ""
    return [
        Facts(
            [
                ("robot", f"{summary['robot']}, {summary['urdf']}"),
                ("mount and limits", summary["description"] or "as the map has them"),
                ("rate", f"{summary['rate_hz']:g} Hz"),
                ("recorded", f"{summary['recorded_s']:.1f} s"),
                (
                    "lasts",
                    f"{summary['duration_s']:.1f} s, of which {summary['approach_s']:.1f} s are the approach{slowed}",
                ),
                ("steps near a singularity", f"{100.0 * summary['steps']['singular_share']:.1f} %"),
            ]
        )
    ]


# Figures --------------------------------------------------------------------------------------------------------------


def _list_approach(trajectory: Trajectory) -> tuple[str, list[tuple[float, float]]]:
    return "approach", [(0.0, float(trajectory.time[trajectory.approach_samples]))]


@styled
def draw_hands(trajectory: Trajectory) -> ReportFigure:
    """The distance of each hand from its target, and below why it is far off."""
    time, errors = trajectory.time, _compute_hand_errors(trajectory)
    figure = draw_over_time(
        time,
        {f"{side} hand, distance from its target [mm]": {side: error} for side, error in errors.items()},
        f"The dashed line: {1e3 * FAR:g} mm. The bar below: why a hand is farther off than that.",
        {side: {**line_style(side, side), "label": None, "linestyle": "-"} for side in errors},
        spans=_list_approach(trajectory),
    )
    for i, (ax, error) in enumerate(zip(figure.axes, errors.values(), strict=True)):
        most = 1.08 * max(float(error.max()), 2e3 * FAR)
        ax.set_ylim(-0.16 * most, most)
        ax.axhline(1e3 * FAR, color=SOFT, linestyle="--", linewidth=0.8)
        cause = find_error_causes(trajectory, i)
        for k, (name, colour) in enumerate(zip(CAUSES, CAUSE_COLOURS, strict=True)):
            if (cause == k).any():
                bars = [(a, max(b - a, time[1] - time[0])) for a, b in find_spans(time, cause == k)]
                ax.broken_barh(bars, (-0.13 * most, 0.1 * most), facecolor=colour, label=name)
    figure.add_legend()
    return figure


@styled
def draw_distances(trajectory: Trajectory) -> ReportFigure:
    """The smallest distance between two parts of the robot, or of one and its table."""
    run, time = trajectory.run, trajectory.time
    distance = np.where(np.isfinite(run.report.hull_distance), 1e3 * run.report.hull_distance, np.nan)
    title = "closest convex hulls [mm]"
    caption = "The smallest distance between two parts of the robot, or of one and its table."
    figure = draw_over_time(time, {title: {title: distance}}, caption, {title: {"color": "black"}})
    [ax] = figure.axes
    ax.set_ylim(0.0, 1e3 * NEAR)
    ax.axhline(1e3 * CLEARANCE, color=COLOURS["left"], linestyle="--", label="clearance")
    shade(ax, find_spans(time, run.report.stopping), "braked", COLOURS["right"], alpha=0.4)
    figure.add_legend()
    return figure


@styled
def draw_joints(trajectory: Trajectory) -> ReportFigure:
    """Each joint over time between its limits; a column an arm."""
    robot, time, limits = trajectory.robot, trajectory.time, trajectory.robot.map.read_joint_limits()
    rows = max(len(arm.joints) for arm in robot.arms)
    figure = ReportFigure("The joints over time. Lines across: limits, dashed: less their margins.", 0.85 * rows)
    axes = figure.grid(rows, len(robot.arms), sharex=True)
    for column, arm in zip(axes.T, robot.arms, strict=True):
        for ax in column[len(arm.joints) :]:
            ax.set_visible(False)
        for ax, j in zip(column, arm.joints.tolist(), strict=False):
            limit = limits[robot.names[j]]
            factor, unit = _choose_unit(limit.kind)
            ax.set_title(f"{plain(robot.names[j])} [{unit}]")
            at, values = envelope(time, factor * trajectory.run.joint_position[:, j])
            ax.plot(at, values, color=COLOURS.get(arm.side, "black"))
            for end, used in ((limit.lower, robot.lower[j]), (limit.upper, robot.upper[j])):
                if np.isfinite(end):
                    ax.axhline(factor * end, color=SOFT, linewidth=0.9)
                    ax.axhline(factor * float(used), color=SOFT, linewidth=0.8, linestyle="--")
        column[-1].set_xlabel("time of the robot [s]")
        column[-1].set_xlim(time[0], time[-1])
    return figure
