"""The report of a tracked recording: what was recorded, how far to trust it, what the person did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..diagnostics import INFO, Diagnostic, lines
from ..pose import deviation, spread
from ..recording import Recording, Sensor
from ..tracking import TrackedRecording
from .concerns import GRAVITY_OFF, heading_remedy, pose_diagnostics
from .decimation import Totals, totals_of
from .joints import joint_angles_section
from .measures import (
    Budget,
    Hand,
    Signal,
    between,
    elbow_of,
    from_start,
    hands_of,
    heading_budgets,
    largest,
    longest,
    stated_mounts,
    usual,
)
from .page import Page, Table
from .track_figures import headings_picture, noise_picture, paths_picture, reach_picture, timeline_picture
from .viewer import pose_html
from .words import degrees, intervals, listed, plain, versions, whole

TEMPLATE = "report/templates/track.html.j2"
FRAMES_A_SECOND = 20.0  # of the 3D view
MOST_FRAMES = 5000  # of the 3D view
LARGEST_VIEW = 3_000_000  # of a view that comes ready, in characters


def track_report(
    pose: TrackedRecording, *, view: str | None = None, totals: Totals | None = None, failures: list[str] | None = None
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Its size does not grow with the recording's length.

    Parameters
    ----------
    pose : of `track`
    view : the page of `pose_html` where it is made already, to be shown here unless it is large; None: it is made here
    totals : of a `pose` that `Decimator` made
    failures : takes a line for each section that cannot be made; the page says so in its place
    """
    recording = pose.recording
    assert recording is not None
    totals = totals or totals_of(pose)
    signals = totals.signals
    budgets = heading_budgets(pose)
    found = {side: elbow_of(pose.pose, side, pose.subject) for side in ("left", "right")}
    elbows = {side: elbow for side, elbow in found.items() if elbow is not None}
    hands = {
        name: hand._replace(peak_speed=totals.peak_speed[name])
        for name, hand in hands_of(pose.pose, recording.rate_hz).items()
    }
    page = Page(TEMPLATE, f"Motion of {recording.name or 'a recording'}", failures)
    page.add(
        "first",
        lambda: _first(pose_diagnostics(pose, signals, budgets, elbows, hands, totals.diagnostics)),
        name="What to look at",
    )
    page.add("short", lambda: _short(pose, totals, budgets), name="In short")
    page.add("recorded", lambda: _recorded(recording, totals), "What was recorded")
    page.add("noise", lambda: _noise(signals), "Noise and bias")
    page.add("drift", lambda: _drift(pose, budgets), "Drift of the headings")
    page.add("hands", lambda: _hands(pose, hands), "The hands")
    page.add("angles", lambda: joint_angles_section(pose), "Joint angles")
    page.add("view", lambda: _view(pose, view), "The motion in 3D")
    page.add("run", lambda: _run(pose), "What was run")
    return page.html(f"Motion of {recording.name}" if recording.name else "Motion")


# The sections: the values that the macros of the template take --------------------------------------------------------


def _first(diagnostics: Sequence[Diagnostic]) -> dict[str, Any]:
    grave = any(diagnostic.severity != INFO for diagnostic in diagnostics)
    kind = "poor" if grave else "note" if diagnostics else "pass"
    return {"kind": kind, "entries": lines(diagnostics, titled=True)}


def _short(pose: TrackedRecording, totals: Totals, budgets: Mapping[str, Budget]) -> dict[str, Any]:
    recording = pose.recording
    assert recording is not None
    since = from_start(pose)
    headings = {joint: float(np.degrees(largest(std[since]))) for joint, std in between(budgets).items()}
    stds = {name: spread(cov[since]) for name, cov in pose.pose.point_cov.items()}
    return {
        "duration": _duration(float(recording.time[-1] - recording.time[0])),
        "rate_hz": totals.rate_hz,
        "sensors": len(totals.signals),
        "worst": max(headings.items(), key=lambda item: item[1]) if headings else None,
        "hands": {name: 1e3 * usual(stds[name]) for name in ("left_hand", "right_hand") if name in stds},
        "lengths": plain(pose.subject.note or pose.subject.name),
        "shown": len(recording),
        "samples": totals.samples,
    }


def _recorded(recording: Recording, totals: Totals) -> dict[str, Any]:
    rows = [
        [
            plain(name),
            f"{np.degrees(signal.rate.max()):.0f} °/s",
            f"{signal.peak_accel:.0f} m/s²" if np.isfinite(signal.peak_accel) else "",
            _seconds(signal.cut, recording.rate_hz),
            _lost(recording.sensors[name], signal, recording.rate_hz),
            f"{100 * float(signal.rest.mean()):.0f} %" if signal.rest is not None else "not looked for",
            f"{longest(~signal.rest, recording.rate_hz):.0f} s" if signal.rest is not None else "",
        ]
        for name, signal in totals.signals.items()
    ]
    header = ["sensor", "fastest turn", "largest acceleration", "cut off", "lost", "at rest", "longest without rest"]
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


def _noise(signals: Mapping[str, Signal]) -> dict[str, Any] | None:
    rows = []
    for name, signal in signals.items():
        if signal.bias is not None:
            begin, end = (np.degrees(bias) for bias in signal.bias)
            rows.append([plain(name), _three(begin), _three(end), f"{signal.gravity:.3f} m/s²"])
    if not rows:
        return None
    header = ["sensor", "bias in the static phase, x / y / z [°/s]", "bias at the end [°/s]", "gravity"]
    return {"percent": 100 * GRAVITY_OFF, "picture": noise_picture(signals), "sensors": Table(header, rows)}


def _drift(pose: TrackedRecording, budgets: Mapping[str, Budget]) -> dict[str, Any]:
    recording = pose.recording
    assert recording is not None
    if not budgets:
        return {"method": pose.options.method if recording.imus else None, "known": False}
    since = from_start(pose)
    stds = {name: np.nan_to_num(np.where(since, budget.std, 0.0)) for name, budget in budgets.items()}
    worst = max(stds, key=lambda name: float(stds[name].max()))
    at = int(np.argmax(stds[worst]))
    growth = {name: budget.growth for name, budget in budgets.items() if np.isfinite(budget.growth)}
    fastest = max(growth, key=growth.__getitem__) if growth else None
    clasped = pose.correction is not None and pose.correction.clasp_mm is not None
    segments = [
        [
            plain(name),
            degrees(float(np.degrees(largest(budget.std[since])))),
            degrees(float(np.degrees(budget.std[-1]))),
            degrees(float(np.degrees(budget.filter_end))),
            f"{np.degrees(budget.growth):.2f} °/min" if np.isfinite(budget.growth) else "never in motion",
        ]
        for name, budget in budgets.items()
    ]
    joints = [
        [joint, degrees(float(np.degrees(usual(std[since])))), degrees(float(np.degrees(largest(std[since]))))]
        for joint, std in between(budgets).items()
    ]
    header = ["segment, ±", "largest", "at the end", "at the end, filter alone", "filter's growth, a minute of motion"]
    return {
        "method": pose.options.method,
        "known": True,
        "worst": (worst, float(np.degrees(stds[worst][at])), _duration(float(pose.time[at] - pose.time[0]))),
        "fastest": (fastest, float(np.degrees(growth[fastest]))) if fastest else None,
        "advice": heading_remedy(pose),
        "corrected": max(pose.correction.largest_deg.values(), default=0.0) if pose.correction is not None else None,
        "clasped": clasped,
        "without": [plain(name) for name in recording.sensors if name not in budgets],
        "before": _before(pose),
        "stated": stated_mounts(pose),
        "picture": headings_picture(
            recording.time,
            {name: np.degrees(budget.std) for name, budget in budgets.items()},
            recording.phases.get("clasp", ()) if clasped else (),
        ),
        "segments": Table(header, segments),
        "joints": Table(["joint, ±", "half of the time under", "largest"], joints) if joints else None,
    }


def _hands(pose: TrackedRecording, hands: Mapping[str, Hand]) -> dict[str, Any] | None:
    if not hands:
        return None
    since = from_start(pose)
    rows = []
    for name, hand in hands.items():
        low, high = np.nanpercentile(100 * hand.reach, [1.0, 99.0], axis=0)
        half, most = ("not known", "not known")
        if hand.std is not None:
            half, most = (f"± {whole(1e3 * of(hand.std[since]))} mm" for of in (usual, largest))
        ranges = [f"{whole(a)} to {whole(b)}" for a, b in zip(low, high, strict=True)]
        rows.append([plain(name), *ranges, f"{hand.peak_speed:.1f} m/s", half, most])
    header = ["", "forwards [cm]", "to the left [cm]", "above shoulders [cm]", "fastest", "usual ±", "largest ±"]
    lengths = pose.subject.lengths
    return {
        "rigid": [plain(name) for name in hands if name not in pose.quat_WL],
        "paths": paths_picture(hands, lengths["shoulder_width"], lengths["trunk"]),
        "reach": reach_picture(pose.time, hands),
        "ranges": Table(header, rows),
        "before": _before(pose),
    }


def _view(pose: TrackedRecording, view: str | None) -> dict[str, Any]:
    if view is not None and len(view) <= LARGEST_VIEW:
        return {"page": view, "fps": None}
    fps = min(FRAMES_A_SECOND, MOST_FRAMES / max(float(pose.time[-1] - pose.time[0]), 1e-3))
    page = pose_html(pose.model, pose.pose, phases=pose.recording.phases, title=pose.recording.name, fps=fps)
    return {"page": page, "fps": fps if fps < FRAMES_A_SECOND else None}


def _run(pose: TrackedRecording) -> dict[str, Any]:
    recording, subject = pose.recording, pose.subject
    assert recording is not None
    assert subject is not None
    lengths = ", ".join(f"{plain(name)} {1e3 * value:.0f} mm" for name, value in subject.lengths.items())
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("filter", pose.options.method if pose.segments.orientation else "none: measured orientations"),
        ("start pose", f"{recording.start_pose.replace('_', '-')}, {intervals([pose.segments.start])}"),
        ("static phase", intervals([pose.segments.still])),
        ("person", f"{subject.name}; {subject.note}" if subject.note else subject.name),
        ("lengths", lengths),
        ("mounts", "as the session states them" if stated_mounts(pose) else "as calibrated"),
        ("body model", pose.model.robot.name),
    ]
    if pose.q is not None:
        rows += [
            (
                f"{plain(name)} missed by",
                f"{np.degrees(np.sqrt(np.mean(angle**2))):.1f}° (the model's joints are too few or end too soon)",
            )
            for name, angle in deviation(pose.model, pose.q, pose.quat_WL).items()
        ]
    rows += [
        ("points", listed([plain(name) for name in pose.points]) or "none"),
        ("made with", versions()),
    ]
    return {"rows": rows}


# Words ----------------------------------------------------------------------------------------------------------------


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"


def _seconds(which: np.ndarray, rate_hz: float) -> str:
    return f"{np.count_nonzero(which) / rate_hz:.2f} s" if which.any() else "no"


def _lost(sensor: Sensor, signal: Signal, rate_hz: float) -> str:
    """Where long gaps were not allowed there are none."""
    return _seconds(signal.gap, rate_hz) if sensor.gap is not None else "no"


def _three(values: np.ndarray) -> str:
    return " / ".join(f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0.00" for value in values)


def _before(pose: TrackedRecording) -> str | None:
    """The time before the end of the start pose, over which uncertainties are not summed up; None where it is short."""
    seconds = float(pose.time[np.argmax(from_start(pose))] - pose.time[0])
    return _duration(seconds) if seconds >= 1.0 else None
