"""The quality of a calibration, and what the motion did not determine.

Each check is one number against two limits: up to the first it passes, up to the second it is poor, beyond it fails.
The quality is the worst of them. The cause of an uncertainty is the part of the motion that was too small: the upper
arms were hardly raised, the torso hardly leaned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import get_args

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ..body.subject import Quality
from ..body.table import MECHANISM, ROOT
from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, Severity, drop_consequences
from .anatomy import LEAST_ROTATION, diagnose_labels, measure_limbs, measure_rotation, reach_limbs
from .conditions import Loop, choose_variant, group_lengths, is_scale_observed
from .observability import MOST_OPEN, find_intervals, format_longest
from .result import (
    MIN_CONTACT,
    AngleRange,
    Calibration,
    CalibrationQuality,
    Check,
    MotionRange,
    QualityLimits,
)
from .weights import CONTRADICTED

QUALITIES: tuple[Quality, ...] = get_args(Quality)
SEVERITY: dict[Quality, Severity] = {"pass": INFO, "poor": WARNING, "fail": ERROR}

# One standard deviation of each result. A hand is off by about as much as its arm's lengths, and by up to 6 mm a
# degree of an arm's heading; the torso's heading moves it only as the torso leans. Soft tissue and the shoulder girdle
# move it by 30 mm an axis whatever the calibration (docs/people.md): a calibration passes that adds less than
# that, as one minute of a careful person's joined hands does on simulated people (lengths 9 to 12 mm, headings 3.0 to
# 3.6 deg).
LENGTH = QualityLimits(0.012, 0.020)  # [m] of an upper arm, of forearm + hand, of the shoulder width, the scale apart
ARM_HEADING = QualityLimits(np.deg2rad(4.0), np.deg2rad(7.0))  # [rad]
TORSO_HEADING = QualityLimits(np.deg2rad(5.0), np.deg2rad(7.0))  # [rad] beyond, tissue adds to it
HAND_HEADING = QualityLimits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] short links, seen little
LONE_HEADING = QualityLimits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] by poses, or by one arm
MOST_TILT = np.deg2rad(2.0)  # [rad] of a link that turns about the vertical alone, as its sensor measures it
# Relative. It may move a hand, 0.62 m from its shoulder, by half of what tissue and girdle do, 15 mm: 2.4 %. A taped
# arm gives 1.2 %, shoulder breadth with stature and sex 2.1 %, stature and sex alone 2.6 %, the population prior 5 %.
SCALE = QualityLimits(0.024, 0.08)
# Residuals of the solution.
# [m] rms while the palms touch: wrists bend, shoulders travel. Careful simulated people have 39 mm, give or take 5, and
# those with more are no farther off.
GAP = QualityLimits(0.055, 0.075)
OPEN_SHARE = QualityLimits(MOST_OPEN, 0.60)  # share of samples
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
    is_mechanism = problem.model.table.is_mechanism
    doubt = 0.0 if is_mechanism else limbs.doubt
    motion, checks = _measure_motion(calibration, limbs.flexion), list[Check]()
    if not is_mechanism:
        checks.append(_check(diagnose_labels(calibration, limbs.contradiction), DOUBT))
    for mount in problem.unused_mounts:
        checks.append(_check(mount, QualityLimits(float(mount.limit or 0.0), np.pi), quality="poor"))
    if not problem.protocol.closures:  # nothing tells which of them is wrong
        for phase, deviation in calibration.posed.items():
            checks.append(_check(Diagnostic("pose-contradicted", INFO, phase, deviation), POSED))
    if not calibration.exchanged:  # with exchanged sensors all other checks are meaningless
        checks += _check_lengths(calibration, motion) + _check_headings(calibration, motion)
        checks += _check_scale(calibration) + _check_residuals(calibration)
    if rotation < LEAST_ROTATION and not is_mechanism and any(check.quality == "fail" for check in checks):
        # All that fails follows from it.
        hardly_any = Diagnostic("motion-too-small", INFO, value=rotation, facts={"variant": "soft-tissue"})
        checks = [_check(hardly_any, ROTATION, quality="fail")]
    reasons = _reasons(checks)
    shown = drop_consequences((*reasons, *calibration.remarks))
    reasons = tuple(each for each in reasons if each in shown) or reasons
    return CalibrationQuality(
        quality=max((check.quality for check in checks), key=QUALITIES.index),
        checks=tuple(checks),
        reasons=reasons,
        further=tuple(each for each in shown if each.code not in {reason.code for reason in reasons}),
        motion=motion,
        information=_find_information(calibration),
        doubt=doubt,
    )


def _reasons(checks: list[Check]) -> tuple[Diagnostic, ...]:
    """Diagnostics that do not pass, the worst first; the cause of several once, in their place."""
    failing = [check for check in checks if check.quality != "pass"]
    failing.sort(key=lambda check: (check.quality != "fail", -check.excess))
    reasons: dict[tuple[str, str, float | str], Diagnostic] = {}
    for check in failing:
        each = check.cause or check.diagnostic
        reasons.setdefault((each.code, each.place, each.facts.get("variant", "")), each)
    return tuple(reasons.values())


def _check(
    diagnostic: Diagnostic, limits: QualityLimits, cause: Diagnostic | None = None, quality: Quality | None = None
) -> Check:
    """A check of the diagnostic's value; its severity is that of the quality."""
    value = float(diagnostic.value if diagnostic.value is not None else np.nan)
    quality = quality or limits.quality(value)
    severity = SEVERITY[quality]
    diagnostic = replace(diagnostic, severity=severity, value=value, limit=float(limits.passes))
    return Check(diagnostic, quality, limits, None if cause is None else replace(cause, severity=severity))


def _find_variant(calibration: Calibration) -> str:
    """The variant of texts: the kind of the closure, or "general"; empty without a closure."""
    problem = calibration.problem
    loops = [each.closure for each in problem.conditions if isinstance(each, Loop)]
    variants = {choose_variant(closure, problem.model.table) for closure in loops}
    return "general" if problem.model.table.is_mechanism or "general" in variants else problem.closure_kind


def _check_scale(calibration: Calibration) -> list[Check]:
    """The check of the scale, where no closure shows it."""
    problem = calibration.problem
    if is_scale_observed(problem.conditions):
        return []
    facts = {"measured": problem.measured_example}
    if not problem.scale_lengths:
        facts |= {"variant": "prior", "prior": problem.prior.note or problem.prior.name}
        facts |= {"protocol": problem.protocol.name}
    return [_check(Diagnostic("scale-uncertain", INFO, value=calibration.scale_std, facts=facts), SCALE)]


def _check_lengths(calibration: Calibration, motion: MotionRange) -> list[Check]:
    """Checks of the lengths that rotate together in a closure, the less certain side of each."""
    problem, subject = calibration.problem, calibration.subject
    table = problem.model.table
    # Lengths that begin at the root cancel in a closed chain, and are one with a point of W that is not known.
    names = [name for name, length in table.lengths.items() if not any(ROOT in part.start for part in length.stretches)]
    lengths, shape = np.array([subject.lengths[name] for name in names]), subject.lengths_covariance(names)
    # Errors of the scale change all lengths together; they have their own check.
    if len(names) > 1 and not is_scale_observed(problem.conditions):
        shape = shape - np.outer(lengths, lengths) / float(lengths @ np.linalg.solve(shape, lengths))
    stds, groups = {}, {}
    for sensor, group in group_lengths(problem.conditions, problem.model.lengths).items():
        groups[sensor] = tuple(name for name in group if name in names)
        take = np.isin(names, groups[sensor]).astype(float)
        stds[sensor] = float(np.sqrt(max(take @ shape @ take, 0.0)))
    checks = []
    for sensor in sorted(groups, key=lambda name: table.segments[name].spine):
        other = table.counterpart(sensor)
        right = table.side(sensor) == "right"
        if not groups[sensor] or (other in stds and (stds[other], right) > (stds[sensor], not right)):
            continue
        facts: dict[str, float | str] = {"variant": _find_variant(calibration)}
        uncertain = Diagnostic("length-uncertain", INFO, " + ".join(groups[sensor]), stds[sensor], facts=facts)
        spine = table.segments[sensor].spine
        causes = ("sideways", "elevation") if spine else ("sideways", "elevation", "bend")
        if not spine and not _starts_limb(calibration, sensor):
            causes = ("sideways", "bend", "elevation")
        known = spine and problem.closure_kind == "fixed_point"
        cause = None if known else _find_cause(calibration, motion, causes, table.side(sensor))
        checks.append(_check(uncertain, LENGTH, cause))
    return checks


def _check_headings(calibration: Calibration, motion: MotionRange) -> list[Check]:
    """Checks of the mounts' headings."""
    subject, table, checks = calibration.subject, calibration.problem.model.table, []
    for segment in subject.mounts:
        if segment not in table.segments or f"mounts.{segment}.z" not in subject.order:
            continue
        if table.is_mechanism and _turns_about_vertical(calibration, segment):
            continue  # the heading of its mount moves no point
        reference = segment == table.reference
        limits = HAND_HEADING if table.segments[segment].rigid_without_sensor else ARM_HEADING
        limits = TORSO_HEADING if reference else limits
        if len(calibration.hinge_rms) < 2:
            limits = LONE_HEADING
        if table.is_mechanism:
            limits = limits._replace(poor=np.pi)
        variant = MECHANISM if table.is_mechanism else _find_variant(calibration) or "poses"
        std = subject.std(f"mounts.{segment}.z")
        uncertain = Diagnostic("mount-heading-uncertain", INFO, segment, std, facts={"variant": variant})
        causes = ("lean", "twist", "sideways") if reference else ("sideways", "elevation", "bend")
        checks.append(_check(uncertain, limits, _find_cause(calibration, motion, causes, table.side(segment))))
    return checks


def _turns_about_vertical(calibration: Calibration, segment: str) -> bool:
    """Whether a segment turned about the vertical alone."""
    R_WL = Rotation.from_quat(calibration.quat_WL[segment])
    up = (R_WL * calibration.problem.start_rotation(segment).inv()).apply([0.0, 0.0, 1.0])
    return bool(np.all(up[:, 2] > np.cos(MOST_TILT)))


def _starts_limb(calibration: Calibration, segment: str) -> bool:
    """Whether a segment is the first of a limb."""
    model = calibration.problem.model
    above = model.parents[segment]
    return above is None or model.table.segments[above].spine


def _find_cause(calibration: Calibration, motion: MotionRange, causes: tuple[str, ...], side: str) -> Diagnostic | None:
    """The cause of an uncertainty: the smallest of the motions that it needs, or too short a motion."""
    if not calibration.problem.closure_kind:
        return None

    def size(values: Mapping[str, AngleRange]) -> float:
        return min((value.size for limb, value in values.items() if not side or limb == side), default=np.nan)

    sizes = {
        "elevation": size(motion.elevation),
        "sideways": size(motion.sideways),
        "bend": size(motion.bend),
        "lean": motion.lean,
        "twist": motion.twist.size if motion.twist else np.nan,
    }
    closure = _find_variant(calibration)
    angles = {name: float(np.deg2rad(sizes[name])) for name in causes if np.isfinite(sizes[name])}
    least = min(angles, key=lambda name: angles[name] / ENOUGH[name], default="")
    if least and angles[least] < ENOUGH[least]:
        facts = {"variant": f"{least} {closure}"}
        return Diagnostic("motion-too-small", WARNING, "", angles[least], float(ENOUGH[least]), facts)
    samples = calibration.effective_sample_size
    if samples < ENOUGH_SAMPLES:
        return Diagnostic("motion-too-small", WARNING, "", samples, ENOUGH_SAMPLES, {"variant": closure})
    return None


def _check_residuals(calibration: Calibration) -> list[Check]:
    """Checks of residuals, and of estimates against the prior."""
    problem, facts = calibration.problem, {"variant": _find_variant(calibration)}
    checks = []
    if problem.closure_kind:
        share = float(np.mean(calibration.contact[calibration.closed] < MIN_CONTACT))
        intervals = {"intervals": format_longest(find_open_intervals(calibration))}
        checks += [
            _check(Diagnostic("closure-gap-large", INFO, value=calibration.rms_gap, facts=facts), GAP),
            _check(Diagnostic("motion-too-small", INFO, value=calibration.effective_sample_size, facts=facts), SAMPLES),
            _check(Diagnostic("closure-open", INFO, value=share, facts=facts | intervals), OPEN_SHARE),
        ]
    tilts = {name: float(np.linalg.norm(offset.tilt)) for name, offset in calibration.subject.start_pose_offset.items()}
    if tilts:
        name = max(tilts, key=lambda n: tilts[n])
        checks.append(_check(Diagnostic("start-pose-off", INFO, name, tilts[name]), TILT))
    for name, length in calibration.measured_lengths.items():
        lengths: dict[str, float | str] = {"measured": length.metres, "expected": length.expected, "std": length.std}
        if calibration.formulation == "paper":
            lengths["variant"] = "paper"
        checks.append(_check(Diagnostic("length-contradicted", INFO, name, length.deviation, facts=lengths), MEASURED))
    if any(length.deviation > MEASURED.passes for length in calibration.measured_lengths.values()):
        return checks  # all lengths have followed a wrong measured one
    prior, subject = problem.prior, calibration.subject
    names = [name for name in problem.model.lengths if name not in problem.measured]
    z = {name: abs(subject.lengths[name] - prior.lengths[name]) / prior.std(name) for name in names}
    if not z:
        return checks
    name = max(z, key=lambda n: z[n])
    unusual: dict[str, float | str] = {
        "variant": MECHANISM if problem.model.table.is_mechanism else "estimated",
        "metres": float(subject.lengths[name]),
    }
    return [*checks, _check(Diagnostic("length-contradicted", INFO, name, z[name], facts=unusual), UNUSUAL)]


def _measure_motion(calibration: Calibration, flexion: Mapping[str, np.ndarray]) -> MotionRange:
    model = calibration.problem.model
    table = model.table
    rows = calibration.touching if calibration.touching.any() else np.ones(len(calibration.time), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    hinges = {hinge.on: joint for joint, hinge in table.hinges.items()}
    elevation, sideways, bend = {}, {}, {}
    reaches = reach_limbs(calibration, R)
    for limb in () if table.is_mechanism else table.limbs:  # its links hang in no common pose
        key, first = table.side(limb[0]) or limb[-1], table.points[limb[0]].link
        above, joint = model.parents.get(first), hinges.get(first, "")
        if above not in R or first not in R or limb[-1] not in reaches or (joint and joint not in flexion):
            continue
        base = R[above].inv()
        along = (base * R[first]).apply(table.segments[first].along)
        elevation[key] = _range(np.degrees(np.arccos(np.clip(-along[:, 2], -1.0, 1.0))))
        sideways[key] = _range(_azimuth(base.apply(reaches[limb[-1]])))
        if joint:
            bend[key] = _range(flexion[joint])
    lean, twist = float("nan"), None
    if table.reference in R and not table.is_mechanism:
        up = R[table.reference].apply([0.0, 0.0, 1.0])
        mean = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
        lean = float(np.degrees(np.percentile(np.arccos(np.clip(up @ mean, -1.0, 1.0)), 98)))
        twist = _range(_azimuth(R[table.reference].apply([1.0, 0.0, 0.0])))
    return MotionRange(elevation, sideways, bend, lean, twist)


def _azimuth(v: np.ndarray) -> np.ndarray:
    """Angles (n,) [deg] of v (n, 3) about z, from their mean."""
    turn = v[:, 0] + 1j * v[:, 1]
    mean = np.mean(turn)
    return np.degrees(np.angle(turn * np.conj(mean)) + np.angle(mean))


def _range(values: np.ndarray) -> AngleRange:
    return AngleRange(*(float(v) for v in np.percentile(values, (2, 98))))


def _find_information(calibration: Calibration) -> tuple[float, ...]:
    """Return the information of the motion in units of the prior's: of one covariance in the other."""
    # Without what the prior knows exactly.
    unknown = np.flatnonzero(np.diag(calibration.prior_covariance) > 0.0)
    scale = np.sqrt(np.diag(calibration.prior_covariance)[unknown])
    before = calibration.prior_covariance[np.ix_(unknown, unknown)] / np.outer(scale, scale)
    after = calibration.subject.covariance[np.ix_(unknown, unknown)] / np.outer(scale, scale)
    shares = eigh(after, before, eigvals_only=True) if len(unknown) else np.empty(0)
    return tuple(max(1.0 / float(share) - 1.0, 0.0) for share in shares)


def find_open_intervals(calibration: Calibration) -> list[tuple[float, float]]:
    """Intervals [s] in which the palms were apart."""
    mask = np.isfinite(calibration.gap) & (calibration.contact < MIN_CONTACT)
    return [(round(a, 3), round(b, 3)) for a, b in find_intervals(calibration.time, mask)]
