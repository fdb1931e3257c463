"""The report of a tracked recording: what was recorded, how far to trust it, what the person did."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..page import Banner, Block, Bullets, Facts, Frame, Heading, Sections, Table, as_html
from ..pose import deviation, spread
from ..recording import Recording, Sensor
from ..tracking import TrackedPose
from ..viewer import pose_html
from .concerns import GRAVITY_OFF, Concern, concerns, hold
from .joints import joint_angle_section
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
from .thinned import Whole, whole_of
from .track_figures import (
    headings_picture,
    noise_picture,
    paths_picture,
    reach_picture,
    timeline_picture,
)
from .words import degrees, intervals, listed, plain, versions, whole

FRAMES_A_SECOND = 20.0  # of the 3D view
MOST_FRAMES = 5000  # of the 3D view
LARGEST_VIEW = 3_000_000  # of a view that comes ready, in characters


def track_report(
    pose: TrackedPose, *, view: str | None = None, whole: Whole | None = None, failures: list[str] | None = None
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Its size does not grow with the recording's length.

    Parameters
    ----------
    pose : of `track`
    view : the page of `pose_html` where it is made already, to be shown here unless it is large; None: it is made here
    whole : of a `pose` that `Thinner` thinned
    failures : takes a line for each section that cannot be made; the page says so in its place
    """
    recording = pose.recording
    assert recording is not None
    whole = whole or whole_of(pose)
    signals = whole.signals
    budgets = heading_budgets(pose)
    found = {side: elbow_of(pose, side, pose.subject) for side in ("left", "right")}
    elbows = {side: elbow for side, elbow in found.items() if elbow is not None}
    hands = {
        name: hand._replace(peak_speed=whole.peak_speed[name])
        for name, hand in hands_of(pose, recording.rate_hz).items()
    }
    thinned = (
        f"Times, angles and places are shown of {len(recording)} samples, one in "
        f"{whole.samples / len(recording):.0f}; extremes, rest and what was lost are of all."
    )
    sections = Sections(failures)
    blocks: list[Block] = [
        Heading(f"Motion of {recording.name or 'a recording'}", 1),
        *sections(
            "What to look at", lambda: [_looked_at(concerns(pose, signals, budgets, elbows, hands, whole.warnings))]
        ),
        *sections("In short", lambda: [Bullets(_in_short(pose, whole, budgets))]),
        *([thinned] if whole.samples > len(recording) else []),
        "± is one standard deviation throughout: two times out of three the truth lies within, 19 times out of 20 "
        "within twice as much.",
        *sections("What was recorded", lambda: _recorded(recording, whole)),
        *sections("Noise and bias", lambda: _noise(signals)),
        *sections("Drift of the headings", lambda: _drift(pose, budgets)),
        *sections("The hands", lambda: _hands(pose, hands)),
        *sections("Joint angles", lambda: joint_angle_section(pose)),
        *sections("The motion in 3D", lambda: _view(pose, view)),
        *sections("What was run", lambda: _run(pose)),
    ]
    return as_html(blocks, f"Motion of {recording.name}" if recording.name else "Motion")


# The sections ---------------------------------------------------------------------------------------------------------


def _looked_at(of: list[Concern]) -> Banner:
    grave = sum(concern.grave for concern in of)
    lines = [concern.line() for concern in of]
    if not of:
        return Banner(
            "pass", "**Nothing stands out.** Rates, ranges, rest, headings and elbows are as they should be.", []
        )
    if not grave:
        return Banner("note", "Good to use. What to know" if len(of) > 1 else "Good to use. One thing to know", lines)
    return Banner("poor", "**Look at this first,** before you use the figures below", lines)


def _in_short(pose: TrackedPose, whole: Whole, budgets: Mapping[str, Budget]) -> list[str]:
    recording = pose.recording
    assert recording is not None
    assert pose.subject is not None
    seconds = float(recording.time[-1] - recording.time[0])
    said = [f"**{_duration(seconds)}** at {whole.rate_hz:g} Hz from {len(whole.signals)} sensors."]
    since = from_start(pose)
    pairs = {joint: std[since] for joint, std in between(budgets).items()}
    if pairs:
        worst = max(pairs, key=lambda joint: largest(pairs[joint]))
        said.append(
            f"Headings: known at every joint to **± {np.degrees(largest(pairs[worst])):.1f}°** or better (worst: the "
            f"{worst}); tilt is held by gravity."
        )
    stds = {name: spread(cov[since]) for name, cov in pose.point_cov.items()}
    seen = [name for name in ("left_hand", "right_hand") if name in stds]
    if seen:
        half = listed([f"{plain(name)} ± {1e3 * usual(stds[name]):.0f} mm" for name in seen])
        said.append(f"Positions, each axis, counted from between the hips, half of the time better than: {half}.")
    said.append(f"Lengths: {plain(pose.subject.note or pose.subject.name)}.")
    return said


def _recorded(recording: Recording, whole: Whole) -> list[Block]:
    lines = []
    for name, signal in whole.signals.items():
        peak = f"{signal.peak_accel:.0f} m/s²" if np.isfinite(signal.peak_accel) else ""
        lines.append(
            [
                plain(name),
                f"{np.degrees(signal.rate.max()):.0f} °/s",
                peak,
                _seconds(signal.cut, recording.rate_hz),
                _lost(recording.sensors[name], signal, recording.rate_hz),
                f"{100 * float(signal.rest.mean()):.0f} %" if signal.rest is not None else "not looked for",
                f"{longest(~signal.rest, recording.rate_hz):.0f} s" if signal.rest is not None else "",
            ]
        )
    low, high = (f"{step:.2f}" for step in whole.steps_ms)
    text = (
        f"{whole.samples} samples at {whole.rate_hz:g} Hz, {recording.time[0]:.2f} to {recording.time[-1]:.2f} s "
        f"on the recording's clock, one every {low if low == high else f'{low} to {high}'} ms."
    )
    if recording.phases:
        text += " Phases: " + "; ".join(f"{name} {intervals(of)}" for name, of in recording.phases.items()) + "."
    header = ["sensor", "fastest turn", "largest acceleration", "cut off", "lost", "at rest", "longest without rest"]
    after = (
        "Acceleration is what the sensor feels, gravity included. Cut off: an axis stood at the end of its range; a "
        "turn that is cut off is missing in the orientation. At rest the gyroscope's bias shows, and nothing drifts."
    )
    picture = timeline_picture(recording.time, whole.signals, recording.phases)
    return [Heading("What was recorded"), text, picture, Table(header, lines), after]


def _noise(signals: Mapping[str, Signal]) -> list[Block]:
    rows = {name: signal for name, signal in signals.items() if signal.bias is not None}
    if not rows:
        return []
    lines = []
    for name, signal in rows.items():
        assert signal.bias is not None
        begin, end = (np.degrees(bias) for bias in signal.bias)
        lines.append([plain(name), _three(begin), _three(end), f"{signal.gravity:.3f} m/s²"])
    text = (
        "From the still phase: what the sensors show while nothing moves. The bias of a gyroscope is the rate that it "
        "shows at rest; it turns the heading unless it is known, and a tenth of a degree per second left over is six "
        f"degrees a minute. Gravity should measure 9.81 m/s², to {100 * GRAVITY_OFF:.0f} %."
    )
    header = ["sensor", "bias in the still phase, x / y / z [°/s]", "bias at the end [°/s]", "gravity"]
    return [Heading("Noise and bias"), text, noise_picture(signals), Table(header, lines)]


def _drift(pose: TrackedPose, budgets: Mapping[str, Budget]) -> list[Block]:
    title = Heading("Drift of the headings")
    since = from_start(pose)
    recording = pose.recording
    assert recording is not None
    if not budgets:
        ready = all(sensor.ready for sensor in recording.sensors.values())
        why = (
            "The device gave orientations without an uncertainty"
            if ready
            else f"The filter {pose.method} has no covariance"
        )
        return [title, f"{why}: what the headings may be off by is not known. amekf, smoother and smekf can tell."]
    text = [
        "Tilt is corrected by gravity all the time. The heading, the turn about the vertical, is measured by nothing: "
        "it is set in the start pose and from there on the sum of the gyroscope's errors.",
        _worst(pose, budgets),
    ]
    if pose.reset is not None:
        turned = max(pose.reset.largest_deg.values(), default=0.0)
        by = "The elbows' hinges" + (" and the joined hands" if pose.reset.clasp_mm is not None else "")
        text.append(
            f"{by} held the headings together: they were turned by up to {turned:.1f}°. What all segments share, such "
            f"as the heading of the whole person, this does not see."
        )
    without = [plain(name) for name in recording.sensors if name not in budgets]
    if without:
        text.append(f"Of {listed(without)} it is not known: ready orientations.")
    if before := _counted(pose):
        text.append(f"What is summed up here{before}.")
    text.append(
        "A mount that is stated and not calibrated counts as exact: a sensor turned by 5° about the vertical turns its "
        "segment by 5° more than is said here."
        if stated_mounts(pose)
        else "The mounts' own uncertainty is in it, and so it changes with the posture too."
    )
    lines = [
        [
            plain(name),
            degrees(float(np.degrees(largest(budget.std[since])))),
            degrees(float(np.degrees(budget.std[-1]))),
            degrees(float(np.degrees(budget.filter_end))),
            f"{np.degrees(budget.growth):.2f} °/min" if np.isfinite(budget.growth) else "never in motion",
        ]
        for name, budget in budgets.items()
    ]
    pairs = [
        [joint, degrees(float(np.degrees(usual(std)))), degrees(float(np.degrees(largest(std))))]
        for joint, std in ((joint, std[since]) for joint, std in between(budgets).items())
    ]
    picture = headings_picture(
        recording.time,
        {name: np.degrees(budget.std) for name, budget in budgets.items()},
        recording.phases.get("clasp", ()) if pose.reset is not None and pose.reset.clasp_mm is not None else (),
    )
    header = ["segment, ±", "largest", "at the end", "at the end, filter alone", "filter's growth, a minute of motion"]
    blocks: list[Block] = [title, " ".join(text), picture, Table(header, lines)]
    if pairs:
        blocks += [
            "Angles of a joint suffer from what its two segments are off against each other, here as if both erred on "
            "their own:",
            Table(["joint, ±", "half of the time under", "largest"], pairs),
        ]
    return blocks


def _counted(pose: TrackedPose) -> str:
    """A clause on the time that uncertainties are summed up over, where it is not all."""
    before = float(pose.time[np.argmax(from_start(pose))] - pose.time[0])
    return f" counts from the end of the start pose on, without the {_duration(before)} before" if before >= 1.0 else ""


def _worst(pose: TrackedPose, budgets: Mapping[str, Budget]) -> str:
    since = from_start(pose)
    stds = {name: np.where(since, budget.std, 0.0) for name, budget in budgets.items()}
    name = max(stds, key=lambda name: largest(stds[name]))
    std = np.nan_to_num(stds[name])
    at = int(np.argmax(std))
    said = f"**The {plain(name)}'s heading may be off by ± {np.degrees(std[at]):.1f}°**"
    said += f" {_duration(float(pose.time[at] - pose.time[0]))} after the beginning, the most of all."
    growing = {name: budget for name, budget in budgets.items() if np.isfinite(budget.growth)}
    if growing:
        fastest = max(growing, key=lambda name: growing[name].growth)
        said += (
            f" By drift alone it grows by up to **{np.degrees(growing[fastest].growth):.1f}° in a minute of motion** "
            f"(the {plain(fastest)}); in a rest it hardly grows. {hold(pose)}"
        )
    return said


def _hands(pose: TrackedPose, hands: Mapping[str, Hand]) -> list[Block]:
    if not hands:
        return []
    assert pose.subject is not None
    since = from_start(pose)
    lines = []
    for name, hand in hands.items():
        low, high = np.nanpercentile(100 * hand.reach, [1.0, 99.0], axis=0)
        half, most = ("not known", "not known")
        if hand.std is not None:
            half, most = (f"± {whole(1e3 * of(hand.std[since]))} mm" for of in (usual, largest))
        lines.append(
            [
                plain(name),
                *(f"{whole(a)} to {whole(b)}" for a, b in zip(low, high, strict=True)),
                f"{hand.peak_speed:.1f} m/s",
                half,
                most,
            ]
        )
    after = (
        "Ranges hold 98 % of the time; the fastest is over a tenth of a second. The ± is of one axis and counted from "
        "between the hips, so that the trunk's lean and length are in it."
    )
    if before := _counted(pose):
        after += f" The ±{before}."
    rigid = [plain(name) for name in hands if name not in pose.quat_WL]
    text = "Middle of the palm, from the middle of the shoulders along the torso's own axes."
    if rigid:
        text += f" Without a sensor on it a hand is taken as straight with its forearm: {listed(rigid)}."
    header = ["", "forwards [cm]", "to the left [cm]", "above shoulders [cm]", "fastest", "usual ±", "largest ±"]
    lengths = pose.subject.lengths
    return [
        Heading("The hands"),
        text,
        paths_picture(hands, lengths["shoulder_width"], lengths["trunk"]),
        reach_picture(pose.time, hands),
        Table(header, lines),
        after,
    ]


def _view(pose: TrackedPose, view: str | None) -> list[Block]:
    assert pose.model is not None
    assert pose.recording is not None
    caption = "Drag to turn, scroll to zoom, space to pause. `view.html` beside this page shows it larger."
    if view is None or len(view) > LARGEST_VIEW:
        fps = min(FRAMES_A_SECOND, MOST_FRAMES / max(float(pose.time[-1] - pose.time[0]), 1e-3))
        view = pose_html(pose.model, pose, phases=pose.recording.phases, title=pose.recording.name, fps=fps)
        if fps < FRAMES_A_SECOND:
            caption += f" Here thinned to {fps:.1f} pictures a second."
    return [Heading("The motion in 3D"), Frame("The motion in 3D", caption, view)]


def _run(pose: TrackedPose) -> list[Block]:
    recording, subject = pose.recording, pose.subject
    assert recording is not None
    assert subject is not None
    assert pose.segments is not None
    assert pose.model is not None
    mounts = "as the session states them" if stated_mounts(pose) else "as calibrated"
    lengths = ", ".join(f"{plain(name)} {1e3 * value:.0f} mm" for name, value in subject.lengths.items())
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("filter", pose.method if pose.segments.orientation else "none: ready orientations"),
        ("start pose", f"{recording.start_pose.replace('_', '-')}, {intervals([pose.segments.start])}"),
        ("still phase", intervals([pose.segments.still])),
        ("person", f"{subject.name}; {subject.note}" if subject.note else subject.name),
        ("lengths", lengths),
        ("mounts", mounts),
        ("body model", pose.model.robot.name),
        ("points", listed([plain(name) for name in pose.points]) or "none"),
        *(("while reading", note) for note in recording.notes),
        ("made with", versions()),
    ]
    if pose.q is not None:
        missed = deviation(pose.model, pose.q, pose.quat_WL)
        rows[8:8] = [
            (
                f"{plain(name)} missed by",
                f"{np.degrees(np.sqrt(np.mean(angle**2))):.1f}° (the model's joints are too few or end too soon)",
            )
            for name, angle in missed.items()
        ]
    return [Heading("What was run"), Facts(rows)]


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
