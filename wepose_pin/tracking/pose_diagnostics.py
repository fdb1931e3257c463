"""Diagnostics of a tracked recording: signals, headings, tips of limbs, hinges, subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic, render
from ..filters import STATIC_ONLY
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
LITTLE_STATIC, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
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
        *_diagnose_uncertainty(tracked, budgets, tips),
        *_diagnose_corrections(tracked),
        *_diagnose_start(tracked, budgets, tips),
        *_diagnose_hinges(tracked, measures.hinges),
    ]


def _diagnose_signals(tracked: TrackResult, signals: Mapping[str, Signal]) -> Iterator[Diagnostic]:
    recording = tracked.recording
    for name, signal in signals.items():
        if signal.cut.any():
            yield Diagnostic("signal-saturated", WARNING, name, np.count_nonzero(signal.cut) / recording.rate_hz)
    step = np.diff(recording.time) * recording.rate_hz
    if float(step.std()) > JITTER:
        yield Diagnostic("time-stamps-uneven", WARNING, "", float(step.std()), JITTER)
    start, end = tracked.segments.static_phase
    for name, signal in signals.items():
        share = signal.gravity / STANDARD_GRAVITY - 1.0
        if abs(share) > GRAVITY_OFF:
            at_rest = {"norm": signal.gravity, "start": start, "end": end}
            yield Diagnostic("accel-scale", INFO, name, share, GRAVITY_OFF, at_rest)
    for name, signal in signals.items():
        largest_bias = 0.0 if signal.bias is None else float(np.linalg.norm(signal.bias, axis=1).max())
        if largest_bias > BIAS_LARGE:
            yield Diagnostic("gyro-bias-large", INFO, name, largest_bias, BIAS_LARGE)
    for name, signal in signals.items():
        if signal.static is None:
            continue
        share, seconds = float(signal.static.mean()), longest_run_s(~signal.static, recording.rate_hz)
        if seconds > LONG_MOTION_S or share < LITTLE_STATIC:
            severity = WARNING if tracked.options.method in STATIC_ONLY else INFO
            yield Diagnostic("static-phases-rare", severity, name, share, LITTLE_STATIC, {"longest": seconds})


def _diagnose_uncertainty(
    tracked: TrackResult, budgets: Mapping[str, Budget], tips: Mapping[str, TipMotion]
) -> Iterator[Diagnostic]:
    """Headings that are uncertain, the most first; positions where no heading explains them."""
    variant = _choose_remedy(tracked)
    facts: dict[str, float | str] = {"variant": variant, "method": tracked.options.method}
    wide = _find_uncertain_headings(tracked, budgets)
    for joint in sorted(wide, key=wide.__getitem__, reverse=True):
        yield Diagnostic("heading-uncertain", WARNING, joint, wide[joint], HEADING, facts)
    if not wide:
        for name, std in _find_uncertain_tips(tracked, tips).items():
            yield Diagnostic(
                "heading-uncertain", WARNING, name, std, PLACE, {**facts, "variant": f"position {variant}"}
            )


def _diagnose_corrections(tracked: TrackResult) -> Iterator[Diagnostic]:
    if tracked.correction is None:
        return
    variant = {"variant": "stated"} if has_stated_mounts(tracked) else {}
    for name, turned_deg in tracked.correction.max_correction_deg.items():
        start_var = sum(find_start_variances(tracked.recording, name, tracked.subject, tracked.model))
        turned, limit = float(np.deg2rad(turned_deg)), max(TURNED, TURNED_STDS * np.sqrt(start_var))
        if turned > limit:
            yield Diagnostic("heading-corrected-far", WARNING, name, turned, float(limit), variant)


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


def _diagnose_start(
    tracked: TrackResult, budgets: Mapping[str, Budget], tips: Mapping[str, TipMotion]
) -> Iterator[Diagnostic]:
    """A late start pose, and headings or tips that are less certain before it than after it for long."""
    since, before = find_samples_after_start(tracked), tracked.time < tracked.segments.start[0]
    rate_hz, late = tracked.recording.rate_hz, float(tracked.segments.start[0] - tracked.time[0])

    def widest(stds: list[np.ndarray], limit: float) -> float:
        wide = [std[before & (std > max(limit, finite_max(std[since])))] for std in stds]
        return max((finite_max(std) for std in wide if len(std) / rate_hz > LASTING_S), default=0.0)

    heading = widest(list(compute_joint_heading_stds(budgets, tracked.model, "drift").values()), HEADING)
    position = widest([tip.std for tip in tips.values() if tip.std is not None], PLACE)
    facts: dict[str, float | str] = {}
    if heading:
        facts = {"variant": "heading", "heading": heading}
    elif position:
        facts = {"variant": "position", "position": position}
    if facts or late > LATE_START_S:
        yield Diagnostic("start-pose-late", INFO, "", late, LATE_START_S, facts)


def _choose_remedy(tracked: TrackResult) -> str:
    """The variant of the texts on drifting headings."""
    if tracked.options.open_loop:
        return "open-loop"
    if tracked.options.method in STATIC_ONLY:
        return "static-only"
    if tracked.correction is None:
        return "uncalibrated"
    return "" if tracked.recording.phases.get("clasp") else "no-clasp"


def describe_heading_remedy(tracked: TrackResult) -> str:
    """The advice on drifting headings."""
    facts = {"variant": _choose_remedy(tracked), "method": tracked.options.method}
    return render(Diagnostic("heading-uncertain", INFO, facts=facts)).do


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
            yield Diagnostic("hinge-implausible", WARNING, name, most, -extended, {**facts, "duration": seconds})
        folded = motion.bend > flexed
        if ends[1] < np.pi and np.count_nonzero(folded) / rate_hz > LASTING_S:
            yield Diagnostic(
                "hinge-implausible", WARNING, name, finite_max(motion.bend), flexed, {**facts, "variant": "overflexed"}
            )
        aside = (motion.bend > BENT) & (np.abs(motion.aside) > ASIDE)
        if np.count_nonzero(aside) / rate_hz > LASTING_S:
            most = float(np.abs(motion.aside[aside]).max())
            early, late = _median_of_halves(motion)
            halves: dict[str, float | str] = {"first_half": early, "second_half": late}
            halves["variant"] = "drifting" if abs(late - early) > APART else "sideways"
            yield Diagnostic("hinge-implausible", WARNING, name, most, float(ASIDE), facts | halves)


def _median_of_halves(motion: HingeMotion) -> tuple[float, float]:
    """Median [rad] by which the moving segment is out of plane while bent, in the first and the second half."""
    half = len(motion.bend) // 2
    parts = [motion.aside[rows][motion.bend[rows] > BENT] for rows in (slice(half), slice(half, None))]
    if not all(len(part) for part in parts):
        return 0.0, 0.0
    return float(np.median(parts[0])), float(np.median(parts[1]))
