"""The report of a tracked recording: the recording, the uncertainty of the result, the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..diagnostics import INFO, Diagnostic, lines
from ..kinematics import compute_axis_std, compute_orientation_residuals
from ..model import BodyTable
from ..recording import Recording, Sensor
from ..tracking import TrackedRecording, TrackSummary
from ..tracking.error_budget import ErrorBudget, group_by_source
from ..tracking.measures import (
    Budget,
    Measures,
    Signal,
    TipMotion,
    compute_joint_heading_stds,
    find_samples_after_start,
    finite_max,
    finite_median,
    has_stated_mounts,
    longest_run_s,
)
from ..tracking.pose_diagnostics import GRAVITY_OFF, describe_heading_remedy
from .joints import build_joint_angles_section
from .page import Page, Table
from .track_figures import (
    draw_headings,
    draw_noise,
    draw_paths,
    draw_reach,
    draw_timeline,
    find_sides,
    group_tips,
    line_style,
)
from .viewer import pose_html
from .words import capital, degrees, intervals, listed, plain, plural, versions, whole

TEMPLATE = "report/templates/track.html.j2"
FRAMES_A_SECOND = 20.0  # of the 3D view
MOST_FRAMES = 5000  # of the 3D view
LARGEST_VIEW = 3_000_000  # characters of a given view that the report embeds


def render_track_report(summary: TrackSummary, *, view: str | None = None, failures: list[str] | None = None) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic.

    Its size does not grow with the recording's length.

    Parameters
    ----------
    summary : of `summarize`
    view : the page of `pose_html`, embedded up to `LARGEST_VIEW`; None: a view is made here
    failures : gets a line for each section that cannot be made; the page has the line in place of the section
    """
    tracked, measures = summary.decimator.decimated
    table, signals, budgets = tracked.model.table, measures.signals, measures.budgets
    page = Page(TEMPLATE, f"Motion of {tracked.recording.name or 'a recording'}", failures)
    page.add("first", lambda: _build_diagnostics_section(summary.diagnostics, table), name="Diagnostics")
    page.add("short", lambda: _build_summary_section(tracked, measures), name="In short")
    page.add("recorded", lambda: _build_recorded_section(tracked.recording, measures, table), "What was recorded")
    page.add("noise", lambda: _build_noise_section(signals), "Noise and bias")
    page.add("drift", lambda: _build_drift_section(tracked, budgets), "Drift of the headings")
    page.add("tips", lambda: _build_tips_section(tracked, measures.tips), f"The {_name_tips(table)}")
    page.add("budget", lambda: _build_error_budget_section(tracked), "What the ± of the points is made of")
    page.add("angles", lambda: build_joint_angles_section(tracked), "Joint angles")
    page.add("view", lambda: _build_view_section(tracked, view), "The motion in 3D")
    page.add("run", lambda: _build_run_section(tracked), "What was run")
    return page.html(f"Motion of {tracked.recording.name}" if tracked.recording.name else "Motion")


# The sections: the values that the macros of the template take --------------------------------------------------------


def _build_diagnostics_section(diagnostics: Sequence[Diagnostic], table: BodyTable) -> dict[str, Any]:
    has_warning = any(diagnostic.severity != INFO for diagnostic in diagnostics)
    checked = listed(["Rates", "ranges", "static phases", "headings", *_name_hinges(table)])
    return {"has_warning": has_warning, "entries": lines(diagnostics, titled=True), "checked": checked}


def _build_summary_section(tracked: TrackedRecording, measures: Measures) -> dict[str, Any]:
    recording = tracked.recording
    after_start = find_samples_after_start(tracked)
    headings = {
        plain(joint): float(np.degrees(finite_max(std[after_start])))
        for joint, std in compute_joint_heading_stds(measures.budgets, tracked.model).items()
    }
    stds = {name: compute_axis_std(cov[after_start]) for name, cov in tracked.pose.point_cov.items()}
    return {
        "duration": _format_duration(float(recording.time[-1] - recording.time[0])),
        "rate_hz": measures.rate_hz,
        "sensors": len(measures.signals),
        "worst": max(headings.items(), key=lambda item: item[1]) if headings else None,
        "tips": {name: 1e3 * finite_median(stds[name]) for name in tracked.model.table.paths if name in stds},
        "root": _name_root(tracked.model.table),
        "lengths": plain(tracked.subject.note or tracked.subject.name),
        "shown_samples": len(recording),
        "samples": measures.samples,
    }


def _build_recorded_section(recording: Recording, measures: Measures, table: BodyTable) -> dict[str, Any]:
    rows = [
        [
            plain(name),
            f"{np.degrees(signal.rate.max()):.0f} °/s",
            f"{signal.peak_accel:.0f} m/s²" if np.isfinite(signal.peak_accel) else "",
            _format_seconds(signal.cut, recording.rate_hz),
            _format_lost(recording.sensors[name], signal, recording.rate_hz),
            f"{100 * float(signal.static.mean()):.0f} %" if signal.static is not None else "not measured",
            f"{longest_run_s(~signal.static, recording.rate_hz):.0f} s" if signal.static is not None else "",
        ]
        for name, signal in measures.signals.items()
    ]
    header = [
        "sensor",
        "fastest rotation",
        "largest acceleration",
        "saturated",
        "lost",
        "static",
        "longest motion without static phase",
    ]
    low, high = (f"{step:.2f}" for step in measures.steps_ms)
    return {
        "samples": measures.samples,
        "rate_hz": measures.rate_hz,
        "begin": recording.time[0],
        "end": recording.time[-1],
        "step": low if low == high else f"{low} to {high}",
        "phases": [f"{name} {intervals(spans)}" for name, spans in recording.phases.items()],
        "picture": draw_timeline(
            recording.time,
            measures.signals,
            recording.phases,
            {name: line_style(name, table) for name in measures.signals},
        ),
        "sensors": Table(header, rows),
    }


def _build_noise_section(signals: Mapping[str, Signal]) -> dict[str, Any] | None:
    rows = []
    for name, signal in signals.items():
        if signal.bias is not None:
            begin, end = (np.degrees(bias) for bias in signal.bias)
            rows.append([plain(name), _format_axes(begin), _format_axes(end), f"{signal.gravity:.3f} m/s²"])
    if not rows:
        return None
    header = ["sensor", "bias in the static phase, x / y / z [°/s]", "bias at the end [°/s]", "gravity"]
    return {"percent": 100 * GRAVITY_OFF, "picture": draw_noise(signals), "sensors": Table(header, rows)}


def _build_drift_section(tracked: TrackedRecording, budgets: Mapping[str, Budget]) -> dict[str, Any]:
    recording = tracked.recording
    if not budgets:
        return {"method": tracked.options.method if recording.imus else None, "has_covariance": False}
    after_start = find_samples_after_start(tracked)
    stds = {name: np.nan_to_num(np.where(after_start, budget.std, 0.0)) for name, budget in budgets.items()}
    worst = max(stds, key=lambda name: float(stds[name].max()))
    worst_sample = int(np.argmax(stds[worst]))
    growth = {name: budget.growth for name, budget in budgets.items() if np.isfinite(budget.growth)}
    fastest = max(growth, key=growth.__getitem__) if growth else None
    correction = tracked.correction
    has_clasp = correction is not None and (correction.gap_rms_mm is not None or bool(correction.found_clasps))
    has_accelerations = correction is not None and bool(correction.joint_accelerations)
    segments = [
        [
            plain(name),
            degrees(float(np.degrees(finite_max(budget.std[after_start])))),
            degrees(float(np.degrees(budget.std[-1]))),
            degrees(float(np.degrees(budget.filter_end))),
            f"{np.degrees(budget.growth):.2f} °/min" if np.isfinite(budget.growth) else "never in motion",
        ]
        for name, budget in budgets.items()
    ]
    joints = [
        [
            plain(joint),
            degrees(float(np.degrees(finite_median(std[after_start])))),
            degrees(float(np.degrees(finite_max(std[after_start])))),
        ]
        for joint, std in compute_joint_heading_stds(budgets, tracked.model).items()
    ]
    header = [
        "segment, ±",
        "largest",
        "at the end",
        "at the end, filter alone",
        "growth per minute of motion, filter alone",
    ]
    return {
        "method": tracked.options.method,
        "has_covariance": True,
        "worst": (
            worst,
            float(np.degrees(stds[worst][worst_sample])),
            _format_duration(float(tracked.time[worst_sample] - tracked.time[0])),
        ),
        "fastest": (fastest, float(np.degrees(growth[fastest]))) if fastest else None,
        "remedy": describe_heading_remedy(tracked),
        "corrected": max(tracked.correction.max_correction_deg.values(), default=0.0)
        if tracked.correction is not None
        else None,
        "correctors": listed(
            [
                *["accelerations of the joints"] * has_accelerations,
                *(f"{name}' hinges" for name in _name_hinges(tracked.model.table)),
                *["the joined hands"] * has_clasp,
            ]
        ),
        "segments_without_covariance": [plain(name) for name in recording.sensors if name not in budgets],
        "time_before_start": _format_time_before(tracked),
        "has_stated_mounts": has_stated_mounts(tracked),
        "picture": draw_headings(
            recording.time,
            {name: np.degrees(budget.std) for name, budget in budgets.items()},
            recording.phases.get("clasp", ()) if has_clasp else (),
            {name: line_style(name, tracked.model.table) for name in budgets},
        ),
        "segments": Table(header, segments),
        "joints": Table(["joint, ±", "median", "largest"], joints) if joints else None,
    }


def _build_tips_section(tracked: TrackedRecording, tips: Mapping[str, TipMotion]) -> dict[str, Any] | None:
    if not tips:
        return None
    table, after_start = tracked.model.table, find_samples_after_start(tracked)
    sides, limbs = find_sides(tips, table), table.drawn_limbs
    header = ["", "forwards [cm]", "to the left [cm]"]
    groups, rigid = [], dict[str, list[str]]()
    for k, group in enumerate(group_tips(tips, table, tracked.subject.lengths)):
        rows = []
        for name, tip in group.tips.items():
            low, high = np.nanpercentile(100 * tip.reach, [1.0, 99.0], axis=0)
            usual, largest = ("not known", "not known")
            if tip.std is not None:
                usual, largest = (
                    f"± {whole(1e3 * statistic(tip.std[after_start]))} mm" for statistic in (finite_median, finite_max)
                )
            ranges = [f"{whole(a)} to {whole(b)}" for a, b in zip(low, high, strict=True)]
            rows.append([plain(name), *ranges, f"{tip.peak_speed:.1f} m/s", usual, largest])
            segments = limbs[name].segments
            if len(segments) > 1 and segments[-1] not in tracked.quat_WL:
                end, above = (plain(table.shared_name(segment)) for segment in (segments[-1], segments[-2]))
                rigid.setdefault(f"A {end} without a sensor is assumed rigid with its {above}", []).append(plain(name))
        number = f"-{k + 1}" if k else ""
        groups.append(
            {
                "points": capital(listed([plain(name) for name in group.tips])),
                "start": group.start,
                "frame": group.frame,
                "paths": draw_paths(group, sides, f"paths{number}"),
                "reach": draw_reach(tracked.time, group, sides, f"reach{number}"),
                "ranges": Table(
                    [*header, f"above {group.origin} [cm]", "highest speed", "median ±", "largest ±"], rows
                ),
            }
        )
    return {
        "groups": groups,
        "rigid": [f"{text}: {listed(names)}." for text, names in rigid.items()],
        "root": _name_root(table),
        "time_before_start": _format_time_before(tracked),
    }


def _build_error_budget_section(tracked: TrackedRecording) -> dict[str, Any] | None:
    budget = ErrorBudget()
    budget.add(tracked)
    rows = {point: group_by_source(parts) for point, parts in budget.summarize().items()}
    if not rows:
        return None
    header = ["", *(f"{source} [mm]" for source in next(iter(rows.values())))]
    return {
        "points": Table(
            header, [[plain(point), *(whole(1e3 * v) for v in row.values())] for point, row in rows.items()]
        )
    }


def _build_view_section(tracked: TrackedRecording, view: str | None) -> dict[str, Any]:
    if view is not None and len(view) <= LARGEST_VIEW:
        return {"page": view, "fps": None}
    fps = min(FRAMES_A_SECOND, MOST_FRAMES / max(float(tracked.time[-1] - tracked.time[0]), 1e-3))
    page = pose_html(
        tracked.model, tracked.pose, phases=tracked.recording.phases, title=tracked.recording.name, fps=fps
    )
    return {"page": page, "fps": fps if fps < FRAMES_A_SECOND else None}


def _build_run_section(tracked: TrackedRecording) -> dict[str, Any]:
    recording, subject = tracked.recording, tracked.subject
    lengths = ", ".join(f"{plain(name)} {1e3 * value:.0f} mm" for name, value in subject.lengths.items())
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("filter", tracked.options.method if tracked.segments.orientation else "none: measured orientations"),
        ("start pose", f"{recording.start_pose.replace('_', '-')}, {intervals([tracked.segments.start])}"),
        ("static phase", intervals([tracked.segments.static_phase])),
        ("person", f"{subject.name}; {subject.note}" if subject.note else subject.name),
        ("lengths", lengths),
        ("mounts", "as the session states them" if has_stated_mounts(tracked) else "as calibrated"),
        ("body model", tracked.model.robot.name),
    ]
    if tracked.q is not None:
        rows += [
            (
                f"{plain(name)}, orientation residual",
                f"{np.degrees(np.sqrt(np.mean(angle**2))):.1f}° (the joints have too few axes, or reach their limits)",
            )
            for name, angle in compute_orientation_residuals(tracked.model, tracked.q, tracked.quat_WL).items()
        ]
    rows += [
        ("points", listed([plain(name) for name in tracked.points]) or "none"),
        ("made with", versions()),
    ]
    return {"rows": rows}


# Words ----------------------------------------------------------------------------------------------------------------


def _name_tips(table: BodyTable) -> str:
    """Return what the points whose path is drawn are on, as "hands"."""
    ends = ((limb.segments or (name,))[-1] for name, limb in table.drawn_limbs.items())
    return listed([plural(name) for name in dict.fromkeys(plain(table.shared_name(end)) for end in ends)])


def _name_hinges(table: BodyTable) -> list[str]:
    """Return the joints that are hinges, as "elbows"."""
    return [plural(name) for name in dict.fromkeys(plain(table.shared_name(hinge)) for hinge in table.hinges)]


def _name_root(table: BodyTable) -> str:
    """Return what the origin of W is."""
    return "the root" if table.is_mechanism else "the middle of the hips"


def _format_duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"


def _format_seconds(mask: np.ndarray, rate_hz: float) -> str:
    return f"{np.count_nonzero(mask) / rate_hz:.2f} s" if mask.any() else "0 s"


def _format_lost(sensor: Sensor, signal: Signal, rate_hz: float) -> str:
    """Return the time of long gaps; 0 s where they were not allowed."""
    return _format_seconds(signal.gap, rate_hz) if sensor.gap is not None else "0 s"


def _format_axes(values: np.ndarray) -> str:
    return " / ".join(f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0.00" for value in values)


def _format_time_before(tracked: TrackedRecording) -> str | None:
    """Return the time before the end of the start pose, which the summaries leave out; None where it is below 1 s."""
    seconds = float(tracked.time[np.argmax(find_samples_after_start(tracked))] - tracked.time[0])
    return _format_duration(seconds) if seconds >= 1.0 else None
