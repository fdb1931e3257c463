"""Diagnostics of a tracked recording: signals, headings, tips of limbs, hinges, subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic, render
from ..filters import STATIC_ONLY
from ..recording import OrientationSensor
from ..recording.limits import STANDARD_GRAVITY
from .heading_problem import find_start_variances
from .measures import (
    BENT,
    Budget,
    HingeMotion,
    Measures,
    Signal,
    TipMotion,
    compute_joint_heading_stds,
    find_flexion_sign,
    find_samples_after_start,
    finite_max,
    has_stated_mounts,
    longest_run_s,
)
from .result import TrackResult

GRAVITY_OFF = 0.02
BIAS_LARGE = np.deg2rad(1.5)  # [rad/s], three times what is usual from the factory
BIAS_MOVED = np.deg2rad(0.3)  # [rad/s]
LITTLE_STATIC, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
LOST = 0.01  # share of samples
JITTER = 0.2  # of a step, one standard deviation
HEADING = np.deg2rad(10.0)  # one standard deviation of the drift between the segments of a joint
PLACE = 0.1  # [m], one standard deviation of a tip: what 10 deg of heading do at the end of an arm
# Correction of a heading: beyond this, and beyond so many standard deviations of what start pose and mount leave open.
# In four walks of the preset `people`, whose start poses are as people hold them, it is at most 2.1 of them.
TURNED, TURNED_STDS = np.deg2rad(10.0), 2.5
# Beyond the range of a hinge while it extends, and before its end while it flexes, where flesh meets flesh. Of an elbow
# 20 and 160 deg: in the start pose a hanging one is bent by 5 to 15 deg; few open by more than 10 deg beyond straight.
RANGE_MARGIN = np.deg2rad(5.0)
ASIDE = np.deg2rad(30.0)
APART = np.deg2rad(15.0)  # between the halves of a recording
LASTING_S = 1.0


def diagnose_pose(tracked: TrackResult, measures: Measures) -> list[Diagnostic]:
    """The diagnostics of the motion; `measures` are the recording's."""
    budgets, tips = measures.budgets, measures.tips
    return [
        *_diagnose_signals(tracked, measures.signals),
        *_diagnose_headings(tracked, budgets),
        *_diagnose_tips(tracked, tips),
        *_diagnose_method(tracked, budgets, tips),
        *_diagnose_time_before_start(tracked, budgets, tips),
        *_diagnose_hinges(tracked, measures.hinges),
        *_diagnose_subject(tracked),
    ]


def _diagnose_signals(tracked: TrackResult, signals: Mapping[str, Signal]) -> Iterator[Diagnostic]:
    recording = tracked.recording
    for name, signal in signals.items():
        if signal.cut.any():
            yield Diagnostic("signal-saturated", WARNING, name, np.count_nonzero(signal.cut) / recording.rate_hz)
    for name, signal in signals.items():
        if signal.gap.mean() > LOST:
            yield Diagnostic("samples-lost", WARNING, name, float(signal.gap.mean()), LOST)
    step = np.diff(recording.time) * recording.rate_hz
    if float(step.std()) > JITTER:
        yield Diagnostic("time-stamps-uneven", WARNING, "", float(step.std()), JITTER)
    start, end = tracked.segments.static_phase
    for name, signal in signals.items():
        share = signal.gravity / STANDARD_GRAVITY - 1.0
        if abs(share) > GRAVITY_OFF:
            at_rest = {"norm": signal.gravity, "start": start, "end": end}
            yield Diagnostic("accel-scale", INFO, name, share, GRAVITY_OFF, at_rest)
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
        if signal.static is None:
            continue
        share, seconds = float(signal.static.mean()), longest_run_s(~signal.static, recording.rate_hz)
        if seconds > LONG_MOTION_S or share < LITTLE_STATIC:
            severity = WARNING if tracked.options.method in STATIC_ONLY else INFO
            yield Diagnostic("static-phases-rare", severity, name, share, LITTLE_STATIC, {"longest": seconds})
    late = tracked.segments.start[0] - float(recording.time[0])
    if late > LATE_START_S:
        yield Diagnostic("start-pose-late", INFO, "", late, LATE_START_S)


def _diagnose_headings(tracked: TrackResult, budgets: Mapping[str, Budget]) -> Iterator[Diagnostic]:
    wide = _find_uncertain_headings(tracked, budgets)
    for joint in sorted(wide, key=wide.__getitem__, reverse=True):
        yield Diagnostic("heading-uncertain", WARNING, joint, wide[joint], HEADING, _remedy_variant(tracked))
    if tracked.correction is not None:
        variant = {"variant": "stated"} if has_stated_mounts(tracked) else {}
        for name, turned_deg in tracked.correction.max_correction_deg.items():
            start_var = sum(find_start_variances(tracked.recording, name, tracked.subject, tracked.model))
            turned, limit = float(np.deg2rad(turned_deg)), max(TURNED, TURNED_STDS * np.sqrt(start_var))
            if turned > limit:
                yield Diagnostic("heading-corrected-far", WARNING, name, turned, float(limit), variant)


def _diagnose_tips(tracked: TrackResult, tips: Mapping[str, TipMotion]) -> Iterator[Diagnostic]:
    for name, std in _find_uncertain_tips(tracked, tips).items():
        yield Diagnostic("position-uncertain", WARNING, name, std, PLACE, _remedy_variant(tracked))


def _diagnose_method(
    tracked: TrackResult, budgets: Mapping[str, Budget], tips: Mapping[str, TipMotion]
) -> Iterator[Diagnostic]:
    if tracked.options.method in STATIC_ONLY and (
        _find_uncertain_headings(tracked, budgets) or _find_uncertain_tips(tracked, tips)
    ):
        yield Diagnostic("method-needs-static", WARNING, facts={"method": tracked.options.method})


def _find_uncertain_headings(tracked: TrackResult, budgets: Mapping[str, Budget]) -> dict[str, float]:
    """Joint → uncertainty [rad] of the heading between its segments by drift, of those beyond the limit."""
    since = find_samples_after_start(tracked)
    return {
        joint: most
        for joint, std in compute_joint_heading_stds(budgets, tracked.model, "drift").items()
        if (most := finite_max(std[since])) > HEADING
    }


def _find_uncertain_tips(tracked: TrackResult, tips: Mapping[str, TipMotion]) -> dict[str, float]:
    """Point → uncertainty [m], of those beyond the limit."""
    since = find_samples_after_start(tracked)
    stds = {name: finite_max(tip.std[since]) for name, tip in tips.items() if tip.std is not None}
    return {name: most for name, most in stds.items() if most > PLACE}


def _diagnose_time_before_start(
    tracked: TrackResult, budgets: Mapping[str, Budget], tips: Mapping[str, TipMotion]
) -> Iterator[Diagnostic]:
    """Headings and tips that are less certain before the start pose than after it, longer than filters converge."""
    since, before = find_samples_after_start(tracked), tracked.time < tracked.segments.start[0]
    rate_hz = tracked.recording.rate_hz
    facts = {"before": float(tracked.segments.start[0] - tracked.time[0])}

    def widest(stds: list[np.ndarray], limit: float) -> float:
        wide = [std[before & (std > max(limit, finite_max(std[since])))] for std in stds]
        return max((finite_max(std) for std in wide if len(std) / rate_hz > LASTING_S), default=0.0)

    heading = widest(list(compute_joint_heading_stds(budgets, tracked.model, "drift").values()), HEADING)
    if heading:
        yield Diagnostic("heading-uncertain-before-start", INFO, "", heading, HEADING, facts)
    position = widest([tip.std for tip in tips.values() if tip.std is not None], PLACE)
    if position:
        yield Diagnostic("position-uncertain-before-start", INFO, "", position, PLACE, facts)


def _remedy_variant(tracked: TrackResult) -> dict[str, str]:
    """The variant of the texts on drifting headings."""
    if tracked.options.open_loop:
        return {"variant": "open-loop"}
    if tracked.correction is None:
        return {"variant": "uncalibrated"}
    return {} if tracked.recording and tracked.recording.phases.get("clasp") else {"variant": "no-clasp"}


def describe_heading_remedy(tracked: TrackResult) -> str:
    """The advice on drifting headings."""
    return render(Diagnostic("heading-uncertain", INFO, facts=_remedy_variant(tracked))).do


def _diagnose_hinges(tracked: TrackResult, hinges: Mapping[str, HingeMotion]) -> Iterator[Diagnostic]:
    rate_hz, table = tracked.recording.rate_hz, tracked.model.table
    for name, motion in hinges.items():
        hinge = table.hinges[name]
        ends = sorted(find_flexion_sign(hinge) * end for end in hinge.range)
        extended, flexed = float(ends[0] - RANGE_MARGIN), float(ends[1] - RANGE_MARGIN)
        in_plane = np.abs(motion.aside) < np.deg2rad(45.0)
        back = in_plane & (motion.flexion < extended) & (motion.bend < np.deg2rad(90.0))
        seconds = np.count_nonzero(back) / rate_hz
        facts: dict[str, float | str] = {
            "joint": table.shared_name(name),
            "above": table.shared_name(hinge.on),
            "below": table.shared_name(hinge.moves),
        }
        if seconds > LASTING_S:
            most = float(-motion.flexion[back].min())
            yield Diagnostic("hinge-hyperextended", WARNING, name, most, -extended, {**facts, "duration": seconds})
        folded = motion.bend > flexed
        if ends[1] < np.pi and np.count_nonzero(folded) / rate_hz > LASTING_S:
            yield Diagnostic("hinge-overflexed", WARNING, name, finite_max(motion.bend), flexed, facts)
        aside = (motion.bend > BENT) & (np.abs(motion.aside) > ASIDE)
        if np.count_nonzero(aside) / rate_hz > LASTING_S:
            most = float(np.abs(motion.aside[aside]).max())
            early, late = _median_of_halves(motion)
            halves: dict[str, float | str] = {"first_half": early, "second_half": late}
            variant = {"variant": "drifting"} if abs(late - early) > APART else {}
            yield Diagnostic(
                "hinge-out-of-plane", WARNING, hinge.moves, most, float(ASIDE), {**facts, **halves, **variant}
            )


def _median_of_halves(motion: HingeMotion) -> tuple[float, float]:
    """Median [rad] by which the moving segment is out of plane while bent, in the first and the second half."""
    half = len(motion.bend) // 2
    parts = [motion.aside[rows][motion.bend[rows] > BENT] for rows in (slice(half), slice(half, None))]
    if not all(len(part) for part in parts):
        return 0.0, 0.0
    return float(np.median(parts[0])), float(np.median(parts[1]))


def _diagnose_subject(tracked: TrackResult) -> Iterator[Diagnostic]:
    if tracked.subject.name == "population":
        yield Diagnostic("population-lengths", INFO)
    measured = [name for name, sensor in tracked.recording.sensors.items() if isinstance(sensor, OrientationSensor)]
    if measured:
        yield Diagnostic("measured-orientations", INFO, facts={"segments": ", ".join(measured)})
    if tracked.recording.remounted and tracked.subject.mounts:
        yield Diagnostic("sensors-remounted", INFO)
