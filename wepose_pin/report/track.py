"""The report of a tracked recording: what was recorded, how far to trust it, what the person did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..diagnostics import INFO, Diagnostic, lines
from ..kinematics import compute_axis_std, compute_orientation_residuals
from ..recording import Recording, Sensor
from ..tracking import TrackedRecording
from .decimation import Totals, compute_totals
from .joints import joint_angles_section
from .measures import (
    Budget,
    Hand,
    Measures,
    Signal,
    finite_max,
    finite_median,
    heading_budgets,
    joint_heading_stds,
    longest_run_s,
    mask_from_start,
    measure_elbow,
    measure_hands,
    stated_mounts,
)
from .page import Page, Table
from .track_diagnostics import GRAVITY_OFF, diagnose_pose, heading_remedy
from .track_figures import headings_picture, noise_picture, paths_picture, reach_picture, timeline_picture
from .viewer import pose_html
from .words import degrees, intervals, listed, plain, versions, whole

TEMPLATE = "report/templates/track.html.j2"
FRAMES_A_SECOND = 20.0  # of the 3D view
MOST_FRAMES = 5000  # of the 3D view
LARGEST_VIEW = 3_000_000  # of a view that comes ready, in characters


def track_report(
    tracked: TrackedRecording,
    *,
    view: str | None = None,
    totals: Totals | None = None,
    failures: list[str] | None = None,
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Its size does not grow with the recording's length.

    Parameters
    ----------
    tracked : of `track`
    view : the page of `pose_html` where it exists, shown here unless it is large; None: it is made here
    totals : of a `tracked` that `Decimator` made
    failures : takes a line for each section that cannot be made; the page has the line in its place
    """
    recording = tracked.recording
    totals = totals or compute_totals(tracked)
    signals = totals.signals
    budgets = heading_budgets(tracked)
    sides = {side: measure_elbow(tracked.pose, side, tracked.subject) for side in ("left", "right")}
    elbows = {side: elbow for side, elbow in sides.items() if elbow is not None}
    hands = {
        name: hand._replace(peak_speed=totals.peak_speed[name])
        for name, hand in measure_hands(tracked.pose, recording.rate_hz).items()
    }
    measures = Measures(signals, budgets, elbows, hands)
    page = Page(TEMPLATE, f"Motion of {recording.name or 'a recording'}", failures)
    page.add(
        "first",
        lambda: _diagnostics_section(diagnose_pose(tracked, measures, totals.diagnostics)),
        name="What to look at",
    )
    page.add("short", lambda: _summary_section(tracked, totals, budgets), name="In short")
    page.add("recorded", lambda: _recorded_section(recording, totals), "What was recorded")
    page.add("noise", lambda: _noise_section(signals), "Noise and bias")
    page.add("drift", lambda: _drift_section(tracked, budgets), "Drift of the headings")
    page.add("hands", lambda: _hands_section(tracked, hands), "The hands")
    page.add("angles", lambda: joint_angles_section(tracked), "Joint angles")
    page.add("view", lambda: _view_section(tracked, view), "The motion in 3D")
    page.add("run", lambda: _run_section(tracked), "What was run")
    return page.html(f"Motion of {recording.name}" if recording.name else "Motion")


# The sections: the values that the macros of the template take --------------------------------------------------------


def _diagnostics_section(diagnostics: Sequence[Diagnostic]) -> dict[str, Any]:
    grave = any(diagnostic.severity != INFO for diagnostic in diagnostics)
    kind = "poor" if grave else "note" if diagnostics else "pass"
    return {"kind": kind, "entries": lines(diagnostics, titled=True)}


def _summary_section(tracked: TrackedRecording, totals: Totals, budgets: Mapping[str, Budget]) -> dict[str, Any]:
    recording = tracked.recording
    since = mask_from_start(tracked)
    headings = {joint: float(np.degrees(finite_max(std[since]))) for joint, std in joint_heading_stds(budgets).items()}
    stds = {name: compute_axis_std(cov[since]) for name, cov in tracked.pose.point_cov.items()}
    return {
        "duration": _format_duration(float(recording.time[-1] - recording.time[0])),
        "rate_hz": totals.rate_hz,
        "sensors": len(totals.signals),
        "worst": max(headings.items(), key=lambda item: item[1]) if headings else None,
        "hands": {name: 1e3 * finite_median(stds[name]) for name in ("left_palm", "right_palm") if name in stds},
        "lengths": plain(tracked.subject.note or tracked.subject.name),
        "shown": len(recording),
        "samples": totals.samples,
    }


def _recorded_section(recording: Recording, totals: Totals) -> dict[str, Any]:
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
        for name, signal in totals.signals.items()
    ]
    header = [
        "sensor",
        "fastest rotation",
        "largest acceleration",
        "cut off",
        "lost",
        "static",
        "longest without static phase",
    ]
    low, high = (f"{step:.2f}" for step in totals.steps_ms)
    return {
        "samples": totals.samples,
        "rate_hz": totals.rate_hz,
        "begin": recording.time[0],
        "end": recording.time[-1],
        "step": low if low == high else f"{low} to {high}",
        "phases": [f"{name} {intervals(spans)}" for name, spans in recording.phases.items()],
        "picture": timeline_picture(recording.time, totals.signals, recording.phases),
        "sensors": Table(header, rows),
    }


def _noise_section(signals: Mapping[str, Signal]) -> dict[str, Any] | None:
    rows = []
    for name, signal in signals.items():
        if signal.bias is not None:
            begin, end = (np.degrees(bias) for bias in signal.bias)
            rows.append([plain(name), _format_axes(begin), _format_axes(end), f"{signal.gravity:.3f} m/s²"])
    if not rows:
        return None
    header = ["sensor", "bias in the static phase, x / y / z [°/s]", "bias at the end [°/s]", "gravity"]
    return {"percent": 100 * GRAVITY_OFF, "picture": noise_picture(signals), "sensors": Table(header, rows)}


def _drift_section(tracked: TrackedRecording, budgets: Mapping[str, Budget]) -> dict[str, Any]:
    recording = tracked.recording
    if not budgets:
        return {"method": tracked.options.method if recording.imus else None, "known": False}
    since = mask_from_start(tracked)
    stds = {name: np.nan_to_num(np.where(since, budget.std, 0.0)) for name, budget in budgets.items()}
    worst = max(stds, key=lambda name: float(stds[name].max()))
    at = int(np.argmax(stds[worst]))
    growth = {name: budget.growth for name, budget in budgets.items() if np.isfinite(budget.growth)}
    fastest = max(growth, key=growth.__getitem__) if growth else None
    clasped = tracked.correction is not None and tracked.correction.palm_gap_rms_mm is not None
    segments = [
        [
            plain(name),
            degrees(float(np.degrees(finite_max(budget.std[since])))),
            degrees(float(np.degrees(budget.std[-1]))),
            degrees(float(np.degrees(budget.filter_end))),
            f"{np.degrees(budget.growth):.2f} °/min" if np.isfinite(budget.growth) else "never in motion",
        ]
        for name, budget in budgets.items()
    ]
    joints = [
        [
            joint,
            degrees(float(np.degrees(finite_median(std[since])))),
            degrees(float(np.degrees(finite_max(std[since])))),
        ]
        for joint, std in joint_heading_stds(budgets).items()
    ]
    header = ["segment, ±", "largest", "at the end", "at the end, filter alone", "filter's growth, a minute of motion"]
    return {
        "method": tracked.options.method,
        "known": True,
        "worst": (
            worst,
            float(np.degrees(stds[worst][at])),
            _format_duration(float(tracked.time[at] - tracked.time[0])),
        ),
        "fastest": (fastest, float(np.degrees(growth[fastest]))) if fastest else None,
        "advice": heading_remedy(tracked),
        "corrected": max(tracked.correction.max_correction_deg.values(), default=0.0)
        if tracked.correction is not None
        else None,
        "clasped": clasped,
        "without": [plain(name) for name in recording.sensors if name not in budgets],
        "before": _format_time_before(tracked),
        "stated": stated_mounts(tracked),
        "picture": headings_picture(
            recording.time,
            {name: np.degrees(budget.std) for name, budget in budgets.items()},
            recording.phases.get("clasp", ()) if clasped else (),
        ),
        "segments": Table(header, segments),
        "joints": Table(["joint, ±", "half of the time under", "largest"], joints) if joints else None,
    }


def _hands_section(tracked: TrackedRecording, hands: Mapping[str, Hand]) -> dict[str, Any] | None:
    if not hands:
        return None
    since = mask_from_start(tracked)
    rows = []
    for name, hand in hands.items():
        low, high = np.nanpercentile(100 * hand.reach, [1.0, 99.0], axis=0)
        half, most = ("not known", "not known")
        if hand.std is not None:
            half, most = (f"± {whole(1e3 * of(hand.std[since]))} mm" for of in (finite_median, finite_max))
        ranges = [f"{whole(a)} to {whole(b)}" for a, b in zip(low, high, strict=True)]
        rows.append([plain(name), *ranges, f"{hand.peak_speed:.1f} m/s", half, most])
    header = ["", "forwards [cm]", "to the left [cm]", "above shoulders [cm]", "fastest", "usual ±", "largest ±"]
    lengths = tracked.subject.lengths
    return {
        "rigid": [plain(name) for name in hands if name not in tracked.quat_WL],
        "paths": paths_picture(hands, lengths["shoulder_width"], lengths["trunk"]),
        "reach": reach_picture(tracked.time, hands),
        "ranges": Table(header, rows),
        "before": _format_time_before(tracked),
    }


def _view_section(tracked: TrackedRecording, view: str | None) -> dict[str, Any]:
    if view is not None and len(view) <= LARGEST_VIEW:
        return {"page": view, "fps": None}
    fps = min(FRAMES_A_SECOND, MOST_FRAMES / max(float(tracked.time[-1] - tracked.time[0]), 1e-3))
    page = pose_html(
        tracked.model, tracked.pose, phases=tracked.recording.phases, title=tracked.recording.name, fps=fps
    )
    return {"page": page, "fps": fps if fps < FRAMES_A_SECOND else None}


def _run_section(tracked: TrackedRecording) -> dict[str, Any]:
    recording, subject = tracked.recording, tracked.subject
    lengths = ", ".join(f"{plain(name)} {1e3 * value:.0f} mm" for name, value in subject.lengths.items())
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("filter", tracked.options.method if tracked.segments.orientation else "none: measured orientations"),
        ("start pose", f"{recording.start_pose.replace('_', '-')}, {intervals([tracked.segments.start])}"),
        ("static phase", intervals([tracked.segments.static_phase])),
        ("person", f"{subject.name}; {subject.note}" if subject.note else subject.name),
        ("lengths", lengths),
        ("mounts", "as the session states them" if stated_mounts(tracked) else "as calibrated"),
        ("body model", tracked.model.robot.name),
    ]
    if tracked.q is not None:
        rows += [
            (
                f"{plain(name)}, orientation residual",
                f"{np.degrees(np.sqrt(np.mean(angle**2))):.1f}° (the model's joints are too few or end too soon)",
            )
            for name, angle in compute_orientation_residuals(tracked.model, tracked.q, tracked.quat_WL).items()
        ]
    rows += [
        ("points", listed([plain(name) for name in tracked.points]) or "none"),
        ("made with", versions()),
    ]
    return {"rows": rows}


# Words ----------------------------------------------------------------------------------------------------------------


def _format_duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"


def _format_seconds(which: np.ndarray, rate_hz: float) -> str:
    return f"{np.count_nonzero(which) / rate_hz:.2f} s" if which.any() else "no"


def _format_lost(sensor: Sensor, signal: Signal, rate_hz: float) -> str:
    """Where long gaps were not allowed there are none."""
    return _format_seconds(signal.gap, rate_hz) if sensor.gap is not None else "no"


def _format_axes(values: np.ndarray) -> str:
    return " / ".join(f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0.00" for value in values)


def _format_time_before(tracked: TrackedRecording) -> str | None:
    """The time before the end of the start pose, over which uncertainties are not summed up; None where it is short."""
    seconds = float(tracked.time[np.argmax(mask_from_start(tracked))] - tracked.time[0])
    return _format_duration(seconds) if seconds >= 1.0 else None
