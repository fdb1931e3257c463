"""What to look at before one believes a tracked recording, as diagnostics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic, gravest_first, merge, render
from ..recording import OrientationSensor
from ..recording.limits import STANDARD_GRAVITY
from ..tracking import TrackedRecording
from .measures import BENT, Budget, Elbow, Hand, Signal, between, from_start, largest, longest

GRAVITY_OFF = 0.02
BIAS_LARGE = np.deg2rad(1.5)  # [rad/s], three times what is usual from the factory
BIAS_MOVED = np.deg2rad(0.3)  # [rad/s]
LITTLE_REST, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
LOST = 0.01  # share of samples
JITTER = 0.2  # of a step, one standard deviation
HEADING = np.deg2rad(10.0)  # one standard deviation, between the segments of a joint
PLACE = 0.1  # [m], one standard deviation of a hand: what 10 deg of heading do at the end of an arm
TURNED = np.deg2rad(10.0)  # by which elbows and joined hands corrected a heading
# An elbow: what the start pose calls straight is bent by some 5 to 15 deg, and few elbows open by more than 10 beyond.
BACKWARD, FOLDED = np.deg2rad(-20.0), np.deg2rad(160.0)
ASIDE = np.deg2rad(30.0)
APART = np.deg2rad(15.0)  # between the halves of a recording
LASTING_S = 1.0


def pose_diagnostics(
    pose: TrackedRecording,
    signals: Mapping[str, Signal],
    budgets: Mapping[str, Budget],
    elbows: Mapping[str, Elbow],
    hands: Mapping[str, Hand],
    known: Sequence[Diagnostic],
) -> list[Diagnostic]:
    """What stands out, the gravest first; `known` are those of the pose's summary."""
    found = [
        *_of_signals(pose, signals),
        *_of_headings(pose, budgets),
        *_of_hands(pose, hands),
        *_of_method(pose, budgets, hands),
        *_of_the_time_before(pose, budgets, hands),
        *_of_elbows(pose.recording.rate_hz, elbows),
        *_of_subject(pose),
    ]
    return gravest_first(merge(known, found))


def _of_signals(pose: TrackedRecording, signals: Mapping[str, Signal]) -> Iterator[Diagnostic]:
    recording = pose.recording
    assert recording is not None
    for name, signal in signals.items():
        if signal.cut.any():
            yield Diagnostic("signal-saturated", WARNING, name, np.count_nonzero(signal.cut) / recording.rate_hz)
    for name, signal in signals.items():
        if signal.gap.mean() > LOST:
            yield Diagnostic("samples-lost", WARNING, name, float(signal.gap.mean()), LOST)
    step = np.diff(recording.time) * recording.rate_hz
    if float(step.std()) > JITTER:
        yield Diagnostic("time-stamps-uneven", WARNING, "", float(step.std()), JITTER)
    start, end = pose.segments.still
    for name, signal in signals.items():
        share = signal.gravity / STANDARD_GRAVITY - 1.0
        if abs(share) > GRAVITY_OFF:
            at_rest = {"share": share, "start": start, "end": end}
            yield Diagnostic("accel-scale", INFO, name, signal.gravity, GRAVITY_OFF, at_rest)
    biases = {name: signal.bias for name, signal in signals.items() if signal.bias is not None}
    for name, bias in biases.items():
        largest_bias = float(np.linalg.norm(bias, axis=1).max())
        if largest_bias > BIAS_LARGE:
            yield Diagnostic("gyro-bias-large", INFO, name, largest_bias, BIAS_LARGE)
    for name, (first, last) in biases.items():
        change = float(np.linalg.norm(last - first))
        if change > BIAS_MOVED:
            yield Diagnostic("gyro-bias-changed", INFO, name, change, BIAS_MOVED)
    for name, signal in signals.items():
        if signal.rest is None:
            continue
        share, seconds = float(signal.rest.mean()), longest(~signal.rest, recording.rate_hz)
        if seconds > LONG_MOTION_S or share < LITTLE_REST:
            severity = WARNING if pose.options.method == "smekf" else INFO
            yield Diagnostic("static-phases-rare", severity, name, share, LITTLE_REST, {"longest": seconds})
    late = pose.segments.start[0] - float(recording.time[0])
    if late > LATE_START_S:
        yield Diagnostic("start-pose-late", INFO, "", late, LATE_START_S)


def _of_headings(pose: TrackedRecording, budgets: Mapping[str, Budget]) -> Iterator[Diagnostic]:
    wide = _uncertain_headings(pose, budgets)
    for joint in sorted(wide, key=wide.__getitem__, reverse=True):
        place = joint.replace(" ", "_")
        yield Diagnostic("heading-uncertain", WARNING, place, wide[joint], HEADING, _remedy(pose))
    if pose.correction is not None:
        for name, turned in pose.correction.largest_deg.items():
            if np.deg2rad(turned) > TURNED:
                yield Diagnostic("heading-corrected-far", WARNING, name, np.deg2rad(turned), TURNED)


def _of_hands(pose: TrackedRecording, hands: Mapping[str, Hand]) -> Iterator[Diagnostic]:
    for name, std in _uncertain_hands(pose, hands).items():
        yield Diagnostic("position-uncertain", WARNING, name, std, PLACE, _remedy(pose))


def _of_method(
    pose: TrackedRecording, budgets: Mapping[str, Budget], hands: Mapping[str, Hand]
) -> Iterator[Diagnostic]:
    if pose.options.method == "smekf" and (_uncertain_headings(pose, budgets) or _uncertain_hands(pose, hands)):
        yield Diagnostic("method-needs-static", WARNING, facts={"method": pose.options.method})


def _uncertain_headings(pose: TrackedRecording, budgets: Mapping[str, Budget]) -> dict[str, float]:
    """Joint → [rad] by which the headings of its segments may be off against each other, of those beyond the limit."""
    since = from_start(pose)
    return {joint: most for joint, std in between(budgets).items() if (most := largest(std[since])) > HEADING}


def _uncertain_hands(pose: TrackedRecording, hands: Mapping[str, Hand]) -> dict[str, float]:
    """Hand → [m] by which it may be off, of those beyond the limit."""
    since = from_start(pose)
    stds = {name: largest(hand.std[since]) for name, hand in hands.items() if hand.std is not None}
    return {name: most for name, most in stds.items() if most > PLACE}


def _of_the_time_before(
    pose: TrackedRecording, budgets: Mapping[str, Budget], hands: Mapping[str, Hand]
) -> Iterator[Diagnostic]:
    """What is less certain before the start pose than ever after it, for longer than filters take to begin."""
    since, before = from_start(pose), pose.time < pose.segments.start[0]
    rate_hz = pose.recording.rate_hz
    facts = {"before": float(pose.segments.start[0] - pose.time[0])}

    def widest(stds: list[np.ndarray], limit: float) -> float:
        wide = [std[before & (std > max(limit, largest(std[since])))] for std in stds]
        return max((largest(std) for std in wide if len(std) / rate_hz > LASTING_S), default=0.0)

    heading = widest(list(between(budgets).values()), HEADING)
    if heading:
        yield Diagnostic("heading-uncertain-before-start", INFO, "", heading, HEADING, facts)
    hand = widest([hand.std for hand in hands.values() if hand.std is not None], PLACE)
    if hand:
        yield Diagnostic("position-uncertain-before-start", INFO, "", hand, PLACE, facts)


def _remedy(pose: TrackedRecording) -> dict[str, str]:
    """Which variant of the texts says what to do about headings that drift."""
    if pose.correction is None:
        return {"variant": "uncalibrated"}
    return {} if pose.recording and pose.recording.phases.get("clasp") else {"variant": "no-clasp"}


def heading_remedy(pose: TrackedRecording) -> str:
    """What to do about headings that drift."""
    return render(Diagnostic("heading-uncertain", INFO, facts=_remedy(pose))).do


def _of_elbows(rate_hz: float, elbows: Mapping[str, Elbow]) -> Iterator[Diagnostic]:
    for side, elbow in elbows.items():
        in_plane = np.abs(elbow.aside) < np.deg2rad(45.0)
        back = in_plane & (elbow.forward < BACKWARD) & (elbow.bend < np.deg2rad(90.0))
        seconds = np.count_nonzero(back) / rate_hz
        if seconds > LASTING_S:
            most = float(-elbow.forward[back].min())
            facts = {"duration": seconds}
            yield Diagnostic("elbow-hyperextended", WARNING, f"{side}_elbow", most, float(-BACKWARD), facts)
        folded = elbow.bend > FOLDED
        if np.count_nonzero(folded) / rate_hz > LASTING_S:
            yield Diagnostic("elbow-overflexed", WARNING, f"{side}_elbow", largest(elbow.bend), float(FOLDED))
        aside = (elbow.bend > BENT) & (np.abs(elbow.aside) > ASIDE)
        if np.count_nonzero(aside) / rate_hz > LASTING_S:
            most = float(np.abs(elbow.aside[aside]).max())
            early, late = _halves(elbow)
            halves: dict[str, float | str] = {"first_half": early, "second_half": late}
            if abs(late - early) > APART:
                halves["variant"] = "drifting"
            yield Diagnostic("forearm-out-of-plane", WARNING, f"{side}_forearm", most, float(ASIDE), halves)


def _halves(elbow: Elbow) -> tuple[float, float]:
    """Median [rad] by which the bent forearm is out of plane, in the first and the second half."""
    half = len(elbow.bend) // 2
    parts = [elbow.aside[of][elbow.bend[of] > BENT] for of in (slice(half), slice(half, None))]
    if not all(len(part) for part in parts):
        return 0.0, 0.0
    return float(np.median(parts[0])), float(np.median(parts[1]))


def _of_subject(pose: TrackedRecording) -> Iterator[Diagnostic]:
    if pose.subject.name == "average":
        yield Diagnostic("population-lengths", INFO)
    measured = [name for name, sensor in pose.recording.sensors.items() if isinstance(sensor, OrientationSensor)]
    if measured:
        yield Diagnostic("measured-orientations", INFO, facts={"segments": ", ".join(measured)})
    if pose.recording.remounted and pose.subject.mounts:
        yield Diagnostic("sensors-remounted", INFO)
