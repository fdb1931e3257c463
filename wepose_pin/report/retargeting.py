"""The report of a robot's trajectory: the hands and why they are off, distances of the robot's parts, joint limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..diagnostics import INFO, from_json, lines
from ..retargeting import Trajectory
from ..retargeting.collision import CLEARANCE, NEAR
from ..retargeting.error_attribution import CAUSES, FAR, find_error_causes
from .chart import Chart, Key, Panel, Picture, envelope
from .page import Page, Table
from .track_figures import find_times
from .words import plain, versions, whole

TEMPLATE = "report/templates/retargeting.html.j2"
TIME = "time of the robot [s]"
CAUSE_STYLES = ("other", "soft", "third", "before", "accent", "second")  # of `CAUSES`
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
    heading = f"Motion of {title}" if title else "Motion of a robot"
    page = Page(TEMPLATE, heading, failures)
    page.add("first", lambda: _build_diagnostics_section(summary), name="Diagnostics")
    page.add("short", lambda: _build_summary_section(summary), name="In short")
    page.add("hands", lambda: _build_hands_section(trajectory, summary), "The hands against their targets")
    page.add("distances", lambda: _build_distances_section(trajectory, summary), "The robot's parts against each other")
    page.add("joints", lambda: _build_joints_section(trajectory), "The joints against their limits")
    page.add("view", lambda: {"page": view} if view is not None else None, "The motion in 3D")
    page.add("run", lambda: _build_run_section(summary), "What was run")
    return page.html(heading)


def _build_diagnostics_section(summary: Mapping[str, Any]) -> dict[str, Any]:
    diagnostics = [from_json(entry) for entry in summary["diagnostics"]]
    has_warning = any(diagnostic.severity != INFO for diagnostic in diagnostics)
    runnable = summary["within_limits"] and not summary["self_collisions"]["samples"]
    return {"has_warning": has_warning or not runnable, "entries": lines(diagnostics, titled=True)}


def _build_summary_section(summary: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "summary": summary,
        "braked_percent": 100.0 * summary["steps"]["stopping_share"],
        "arms": {side: arm["hand_error_mm"] for side, arm in summary["arms"].items()},
    }


def _build_hands_section(trajectory: Trajectory, summary: Mapping[str, Any]) -> dict[str, Any]:
    robot, time = trajectory.robot, trajectory.time
    ends = (float(time[0]), float(time[-1]))
    rows, present = [], set[int]()
    approach = (0.0, float(time[trajectory.approach_samples]))
    for i, arm in enumerate(robot.arms):
        error = 1e3 * np.linalg.norm(trajectory.run.hand[i] - trajectory.targets[i].unclamped, axis=1)
        cause = find_error_causes(trajectory, i)
        most = 1.08 * max(float(error.max()), 2e3 * FAR)
        panel = Panel(f"{arm.side} hand, distance from its target [mm]", x=ends, y=(-0.14 * most, most), shown_x=False)
        panel.spans([approach], "phase")
        panel.rule("soft dashed thin", y=1e3 * FAR)
        panel.line(*envelope(time, error), arm.side)
        for k, style in enumerate(CAUSE_STYLES):
            if (cause == k).any():
                present.add(k)
                panel.boxes(find_times(time, cause == k), (-0.12 * most, -0.02 * most), style)
        rows.append(panel)
    rows[-1].shown_x, rows[-1].x_label = True, TIME
    keys = [Key(CAUSES[k], CAUSE_STYLES[k], "box") for k in sorted(present)] + [Key("approach", "phase", "box")]
    caption = f"The line: {1e3 * FAR:g} mm. The bar below: why a hand is farther off than that."
    header = ["", "median [mm]", "90 %", "99 %", *(f"{cause} [%]" for cause in CAUSES)]
    table = [
        [
            side,
            *(whole(arm["hand_error_everywhere_mm"][key]) for key in ("median", "p90", "p99")),
            *(f"{100.0 * share:.1f}" for share in arm["error_attribution"].values()),
        ]
        for side, arm in summary["arms"].items()
    ]
    picture = Picture("hands", caption, Chart([[row] for row in rows], [130.0] * len(rows), keys))
    return {"picture": picture, "hands": Table(header, table)}


def _build_distances_section(trajectory: Trajectory, summary: Mapping[str, Any]) -> dict[str, Any]:
    run, time = trajectory.run, trajectory.time
    panel = Panel(x=(float(time[0]), float(time[-1])), y=(0.0, 1e3 * NEAR), x_label=TIME)
    panel.title = "closest convex hulls [mm]"
    panel.rule("before dashed thin", y=1e3 * CLEARANCE)
    distance = np.where(np.isfinite(run.hull_distance), 1e3 * run.hull_distance, np.nan)
    panel.line(*envelope(time, distance), "ink")
    panel.spans(find_times(time, run.stopping), "third")
    keys = [Key("clearance", "before dashed")] + [Key("braked", "third", "box")] * bool(run.stopping.any())
    rows = []
    for pair in np.unique(run.nearest_pair[run.nearest_pair >= 0]).tolist():
        own = np.flatnonzero(run.nearest_pair == pair)
        least = own[np.argmin(run.hull_distance[own])]
        share = 100.0 * len(own) / len(time)
        rows.append((float(run.hull_distance[least]), trajectory.collision.name_pair(pair), float(time[least]), share))
    table = [[name, f"{1e3 * d:.1f}", f"{t:.1f}", f"{share:.0f}"] for d, name, t, share in sorted(rows)[:PAIRS]]
    header = ["pair", "least distance [mm]", "at [s]", "closest pair for [% of the time]"]
    caption = "The smallest distance between two parts of the robot, or of one and its table."
    return {
        "picture": Picture("distances", caption, Chart([[panel]], [130.0], keys)),
        "pairs": Table(header, table) if table else None,
        "contacts": summary["self_collisions"]["samples"],
        "checked": summary["self_collisions"]["pairs"],
    }


def _build_joints_section(trajectory: Trajectory) -> dict[str, Any]:
    robot, run, time = trajectory.robot, trajectory.run, trajectory.time
    limits, dt = robot.map.read_joint_limits(), float(time[1] - time[0])
    jerk = np.abs(np.diff(run.joint_acceleration, axis=0)) / dt
    pictures, rows = [], []
    for arm in robot.arms:
        panels = []
        for j in arm.joints.tolist():
            name = robot.names[j]
            limit, slides = limits[name], limits[name].kind == "prismatic"
            factor, unit = (1e3, "mm") if slides else (180.0 / np.pi, "°")
            values = factor * run.joint_position[:, j]
            panel = Panel(f"{plain(name)} [{unit}]", x=(float(time[0]), float(time[-1])), shown_x=False)
            panel.line(*envelope(time, values), arm.side)
            low, high = limit.lower, limit.upper
            for end, used in ((low, robot.lower[j]), (high, robot.upper[j])):
                if np.isfinite(end):
                    panel.rule("before thin", y=factor * end)
                    panel.rule("before dashed thin", y=factor * float(used))
            if np.isfinite([low, high]).all():
                room = 0.06 * factor * (high - low)
                panel.y = (factor * low - room, factor * high + room)
            panels.append(panel)
            margin = factor * float(np.minimum(run.joint_position[:, j] - low, high - run.joint_position[:, j]).min())
            rows.append(
                [
                    plain(name),
                    f"{margin:.1f} {unit}" if np.isfinite(margin) else "no limit",
                    _format_share(np.abs(run.joint_velocity[:, j]).max(), limit.velocity),
                    _format_share(np.abs(run.joint_acceleration[:, j]).max(), robot.map.acceleration[name]),
                    _format_share(jerk[:, j].max(), robot.map.jerk[name]),
                ]
            )
        panels[-1].shown_x, panels[-1].x_label = True, TIME
        keys = [Key("limit", "before"), Key("limit less its margin", "before dashed")]
        caption = f"The joints of the {arm.side} arm."
        chart = Chart([[panel] for panel in panels], [62.0] * len(panels), keys)
        pictures.append(Picture(f"joints-{arm.side}", caption, chart))
    header = ["joint", "least distance to a position limit", "largest velocity", "acceleration", "jerk"]
    return {"pictures": pictures, "joints": Table(header, rows), "margins": robot.margins}


def _format_share(value: float, limit: float) -> str:
    return f"{100.0 * value / limit:.0f} % of {limit:g}"


def _build_run_section(summary: Mapping[str, Any]) -> dict[str, Any]:
    rows = [
        ("robot", f"{summary['robot']}, {summary['urdf']}"),
        ("mount and limits", summary["description"] or "as the map has them"),
        ("rate", f"{summary['rate_hz']:g} Hz"),
        ("of the limits", f"{100.0 * summary['speed_scale']:g} % of velocity, acceleration and jerk"),
        ("steps near a singularity", f"{100.0 * summary['steps']['singular_share']:.1f} %"),
        ("made with", versions()),
    ]
    return {"rows": rows}
