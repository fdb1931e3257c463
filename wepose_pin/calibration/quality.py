"""The quality of a calibration.

Each check is one number against two limits: up to the first it passes, up to the second it is poor, beyond it fails.
The quality is the worst of them. The cause of an uncertainty is the part of the motion that was too small: the upper
arms were hardly raised, the torso hardly leaned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.subject import Quality
from ..body.table import ROOT
from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, Severity, drop_consequences
from ..recording import format_span, format_time
from .anatomy import LEAST_ROTATION, diagnose_labels, measure_limbs, measure_rotation, reach_limbs
from .conditions import group_lengths, is_scale_observed
from .result import MIN_CONTACT, Calibration, CalibrationQuality, Check, QualityLimits
from .weights import CONTRADICTED

QUALITIES: tuple[Quality, ...] = get_args(Quality)
SEVERITY: dict[Quality, Severity] = {"pass": INFO, "poor": WARNING, "fail": ERROR}
MOST_INTERVALS = 3  # of an open closure that are named, the longest

# One standard deviation of each result. A hand is off by about as much as its arm's lengths, and by up to 6 mm a
# degree of an arm's heading; the torso's heading moves it only as the torso leans. Soft tissue and the shoulder girdle
# move it by 30 mm an axis whatever the calibration (docs/people.md): a calibration passes that adds less than
# that, as one minute of a careful person's joined hands does on simulated people (lengths 9 to 12 mm, headings 3.4 to
# 4.1 deg).
LENGTH = QualityLimits(0.012, 0.020)  # [m] of an upper arm, of forearm + hand, of the shoulder width, the scale apart
ARM_HEADING = QualityLimits(np.deg2rad(4.5), np.deg2rad(7.0))  # [rad]
TORSO_HEADING = QualityLimits(np.deg2rad(5.5), np.deg2rad(7.0))  # [rad] beyond, tissue adds to it
OTHER_HEADING = QualityLimits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] of a hand, or by poses, or by one arm
# Relative. It may move a hand, 0.62 m from its shoulder, by half of what tissue and girdle do, 15 mm: 2.4 %. A taped
# arm gives 1.2 %, shoulder breadth with stature and sex 2.1 %, stature and sex alone 2.6 %, the population prior 5 %.
SCALE = QualityLimits(0.024, 0.08)
# Residuals of the solution.
# [m] rms while the palms touch: wrists bend, shoulders travel. Careful simulated people have 39 mm, give or take 5, and
# those with more are no farther off.
GAP = QualityLimits(0.055, 0.075)
OPEN_SHARE = QualityLimits(0.10, 0.60)  # share of samples
# [rad] of a segment in the start pose: forearms hang 13 deg outwards and 12 deg forwards, give or take 5 and 7
# (docs/people.md): 18 deg off in all, give or take 6.
TILT = QualityLimits(np.deg2rad(35.0), np.deg2rad(45.0))
UNUSUAL = QualityLimits(4.0, 6.0)  # standard deviations of a length from the population prior
POSED = QualityLimits(CONTRADICTED, 8.0)  # of a pose or a bow that is used, from the estimate without it
MEASURED = QualityLimits(CONTRADICTED, 5.0)  # of a measured length from the estimate without it
SAMPLES = QualityLimits(6.0, 2.0)  # effective sample size, at least
ROTATION = QualityLimits(LEAST_ROTATION, 0.0)  # [rad] of the segments, at least
DOUBT = QualityLimits(1.0, 1.0)  # of anatomy, see `anatomy`

# A motion smaller than this [rad] is the cause of an uncertainty.
ENOUGH = {
    "elevation": np.deg2rad(40.0),
    "sideways": np.deg2rad(35.0),
    "bend": np.deg2rad(40.0),
    "lean": np.deg2rad(8.0),
    "twist": np.deg2rad(12.0),
}
ENOUGH_SAMPLES = 12.0  # effective sample size that a minute of motion reaches


def assess(calibration: Calibration) -> CalibrationQuality:
    """Return the quality of a calibration."""
    problem, limbs, rotation = calibration.problem, measure_limbs(calibration), measure_rotation(calibration)
    is_mechanism, checks = problem.model.table.is_mechanism, list[Check]()
    if not is_mechanism:
        checks.append(_check(diagnose_labels(calibration, limbs.contradiction), DOUBT))
    for mount in problem.unused_mounts:
        checks.append(_check(mount, QualityLimits(float(mount.limit or 0.0), np.pi), quality="poor"))
    if not problem.protocol.closures:  # nothing tells which of them is wrong
        for phase, deviation in calibration.posed.items():
            checks.append(_check(Diagnostic("pose-contradicted", INFO, phase, deviation), POSED))
    if not calibration.exchanged:  # with exchanged sensors all other checks are meaningless
        motion = _measure_motion(calibration, limbs.flexion)
        checks += _check_lengths(calibration, motion) + _check_headings(calibration, motion)
        checks += _check_residuals(calibration)
    if rotation < LEAST_ROTATION and not is_mechanism and any(check.quality == "fail" for check in checks):
        # All that fails follows from it.
        hardly_any = Diagnostic("motion-too-small", INFO, value=rotation, facts={"variant": "soft-tissue"})
        checks = [_check(hardly_any, ROTATION, quality="fail")]
    # What does not pass, the worst first; the cause of several once.
    failing = [check for check in checks if check.quality != "pass"]
    failing.sort(key=lambda check: (check.quality != "fail", -check.excess))
    by_text: dict[tuple[str, str, float | str], Diagnostic] = {}
    for check in failing:
        each = check.cause or check.diagnostic
        by_text.setdefault((each.code, each.place, each.facts.get("variant", "")), each)
    reasons = tuple(by_text.values())
    shown = drop_consequences((*reasons, *calibration.remarks))
    reasons = tuple(each for each in reasons if each in shown) or reasons
    return CalibrationQuality(
        quality=max((check.quality for check in checks), key=QUALITIES.index),
        checks=tuple(checks),
        reasons=reasons,
        further=tuple(each for each in shown if each.code not in {reason.code for reason in reasons}),
    )


def _check(
    diagnostic: Diagnostic, limits: QualityLimits, cause: Diagnostic | None = None, quality: Quality | None = None
) -> Check:
    """A check of the diagnostic's value; its severity is that of the quality."""
    value = float(diagnostic.value if diagnostic.value is not None else np.nan)
    quality = quality or limits.quality(value)
    severity = SEVERITY[quality]
    diagnostic = replace(diagnostic, severity=severity, value=value, limit=float(limits.passes))
    return Check(diagnostic, quality, limits, None if cause is None else replace(cause, severity=severity))


def _check_lengths(calibration: Calibration, motion: Mapping[str, float]) -> list[Check]:
    """Checks of the lengths that rotate together in a closure, and of the scale where no closure shows it."""
    problem, subject, checks = calibration.problem, calibration.subject, list[Check]()
    table, scale_observed = problem.model.table, is_scale_observed(problem.conditions)
    # Lengths that begin at the root cancel in a closed chain, and are one with a point of W that is not known.
    names = [name for name, length in table.lengths.items() if ROOT not in length.start]
    lengths, shape = np.array([subject.lengths[name] for name in names]), subject.lengths_covariance(names)
    if len(names) > 1 and not scale_observed:  # errors of the scale change all lengths together
        shape = shape - np.outer(lengths, lengths) / float(lengths @ np.linalg.solve(shape, lengths))
    for sensor, group in group_lengths(problem.conditions, problem.model.lengths).items():
        summed = [name for name in group if name in names]
        if summed:
            take = np.isin(names, summed).astype(float)
            std = float(np.sqrt(max(take @ shape @ take, 0.0)))
            uncertain = Diagnostic("length-uncertain", INFO, " + ".join(summed), std)
            checks.append(_check(uncertain, LENGTH, _find_cause(calibration, motion, table.segments[sensor].spine)))
    if not scale_observed:
        facts = {"measured": problem.measured_example}
        if not problem.scale_lengths:
            facts |= {"variant": "prior", "prior": problem.prior.note or problem.prior.name}
            facts |= {"protocol": problem.protocol.name}
        checks.append(_check(Diagnostic("scale-uncertain", INFO, value=calibration.scale_std, facts=facts), SCALE))
    for name, length in calibration.measured_lengths.items():
        measured: dict[str, float | str] = {"measured": length.metres, "expected": length.expected, "std": length.std}
        if calibration.formulation == "paper":
            measured["variant"] = "paper"
        contradicted = Diagnostic("length-contradicted", INFO, name, length.deviation, facts=measured)
        checks.append(_check(contradicted, MEASURED))
    prior = problem.prior
    if table.is_mechanism or any(check.quality != "pass" for check in checks if check.limits == MEASURED):
        return checks  # all lengths have followed a wrong measured one
    others = [name for name in subject.lengths if name not in problem.measured]
    if others:
        z = {name: abs(subject.lengths[name] - prior.lengths[name]) / prior.std(name) for name in others}
        name = max(z, key=lambda n: z[n])
        unusual: dict[str, float | str] = {"variant": "estimated", "metres": float(subject.lengths[name])}
        checks.append(_check(Diagnostic("length-contradicted", INFO, name, z[name], facts=unusual), UNUSUAL))
    return checks


def _check_headings(calibration: Calibration, motion: Mapping[str, float]) -> list[Check]:
    """Checks of the mounts' headings; of a mechanism, its lengths alone tell."""
    subject, table, checks = calibration.subject, calibration.problem.model.table, list[Check]()
    for segment in () if table.is_mechanism else subject.mounts:
        if f"mounts.{segment}.z" in subject.order:
            spine = segment == table.reference
            limits = TORSO_HEADING if spine else ARM_HEADING
            if table.segments[segment].rigid_without_sensor or len(calibration.hinge_rms) < 2:
                limits = OTHER_HEADING
            facts = {} if calibration.problem.protocol.closures else {"variant": "poses"}
            std = subject.std(f"mounts.{segment}.z")
            uncertain = Diagnostic("mount-heading-uncertain", INFO, segment, std, facts=facts)
            checks.append(_check(uncertain, limits, _find_cause(calibration, motion, spine)))
    return checks


def _check_residuals(calibration: Calibration) -> list[Check]:
    """Checks of the closure and of the start pose."""
    checks, tilts = list[Check](), calibration.subject.start_pose_offset
    if calibration.problem.protocol.closures:
        share = float(np.mean(calibration.contact[calibration.closed] < MIN_CONTACT))
        facts = {"intervals": format_longest(find_open_intervals(calibration))}
        checks += [
            _check(Diagnostic("closure-gap-large", INFO, value=calibration.rms_gap), GAP),
            _check(Diagnostic("motion-too-small", INFO, value=calibration.effective_sample_size), SAMPLES),
            _check(Diagnostic("closure-open", INFO, value=share, facts=facts), OPEN_SHARE),
        ]
    if tilts:
        name = max(tilts, key=lambda n: float(np.linalg.norm(tilts[n].tilt)))
        checks.append(_check(Diagnostic("start-pose-off", INFO, name, float(np.linalg.norm(tilts[name].tilt))), TILT))
    return checks


def _find_cause(calibration: Calibration, motion: Mapping[str, float], spine: bool) -> Diagnostic | None:
    """The cause of an uncertainty: the smallest of the motions that it needs, or too short a motion."""
    if not calibration.problem.protocol.closures:
        return None
    parts = [name for name in (("lean", "twist") if spine else ("sideways", "elevation", "bend")) if name in motion]
    least = min(parts, key=lambda name: motion[name] / ENOUGH[name], default="")
    if least and motion[least] < ENOUGH[least]:
        return Diagnostic("motion-too-small", WARNING, "", motion[least], float(ENOUGH[least]), {"variant": least})
    if calibration.effective_sample_size < ENOUGH_SAMPLES:
        return Diagnostic("motion-too-small", WARNING, "", calibration.effective_sample_size, ENOUGH_SAMPLES)
    return None


def _measure_motion(calibration: Calibration, flexion: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return how far the body moved [rad] while the chain was closed, as `ENOUGH`; the least of its limbs."""
    model, table = calibration.problem.model, calibration.problem.model.table
    if table.is_mechanism:  # its links hang in no common pose
        return {}
    rows = calibration.touching if calibration.touching.any() else np.ones(len(calibration.time), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    sizes: dict[str, list[float]] = {name: [] for name in ENOUGH}
    reaches = reach_limbs(calibration, R)
    for first, *_, last in table.draw.limbs:
        segment = table.points[first].link
        above = model.parents.get(segment)
        if above in R and segment in R and last in reaches:
            base = R[above].inv()
            along = (base * R[segment]).apply(table.segments[segment].along)
            sizes["elevation"].append(_range(np.arccos(np.clip(-along[:, 2], -1.0, 1.0))))
            sizes["sideways"].append(_turn(base.apply(reaches[last])))
    sizes["bend"] = [_range(angle) for angle in flexion.values()]
    if table.reference in R:
        up = R[table.reference].apply([0.0, 0.0, 1.0])
        mean = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
        sizes["lean"].append(float(np.percentile(np.arccos(np.clip(up @ mean, -1.0, 1.0)), 98)))
        sizes["twist"].append(_turn(R[table.reference].apply([1.0, 0.0, 0.0])))
    return {name: min(each) for name, each in sizes.items() if each}


def _turn(v: np.ndarray) -> float:
    """Range [rad] of the angles of v (n, 3) about z."""
    turn = v[:, 0] + 1j * v[:, 1]
    return _range(np.angle(turn * np.conj(np.mean(turn))))


def _range(values: np.ndarray) -> float:
    """From the 2nd to the 98th percentile."""
    return float(np.ptp(np.percentile(values, (2, 98))))


def find_open_intervals(calibration: Calibration) -> list[tuple[float, float]]:
    """Intervals [s] in which the palms were apart."""
    mask = np.isfinite(calibration.gap) & (calibration.contact < MIN_CONTACT)
    return [(round(a, 3), round(b, 3)) for a, b in find_intervals(calibration.time, mask)]


def find_intervals(time: np.ndarray, mask: np.ndarray) -> list[tuple[float, float]]:
    """Intervals [s] in which `mask` (n,) bool holds, at times (n,) [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0]))))
    return [(float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def format_longest(intervals: Sequence[tuple[float, float]]) -> str:
    """The text of the longest intervals [s], in the order of time."""
    longest = sorted(intervals, key=lambda interval: interval[0] - interval[1])[:MOST_INTERVALS]
    rounded = [(round(a, 1) + 0.0, round(b, 1) + 0.0) for a, b in sorted(longest)]  # without a negative zero
    return ", ".join(f"{format_time(a)} s" if a == b else format_span((a, b)) for a, b in rounded)
