"""The quality of a calibration, and what the motion did not determine.

Each check is one number against two limits: up to the first it passes, up to the second it is poor, beyond it fails.
The quality is the worst of them. The cause of an uncertainty is the part of the motion that was too small: the upper
arms were hardly raised, the torso hardly leaned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, Severity, as_json
from ..errors import BadSession
from ..model.table import MECHANISM, ROOT
from ..subject import Quality
from .anatomy import LEAST_ROTATION
from .conditions import find_parts, group_lengths, is_scale_observed
from .observability import MOST_OPEN, find_intervals, format_longest
from .result import Calibration
from .weights import CONTRADICTED, MIN_CONTACT

QUALITIES: tuple[Quality, ...] = get_args(Quality)
SEVERITY: dict[Quality, Severity] = {"pass": INFO, "poor": WARNING, "fail": ERROR}


class Limits(NamedTuple):
    """Up to `passes` a value passes, up to `poor` it is poor; from them on where `passes` is the larger one."""

    passes: float
    poor: float

    def quality(self, value: float) -> Quality:
        """Pass, poor or fail; NaN, a value that was not computed, passes."""
        sign = -1.0 if self.passes > self.poor else 1.0
        value, passes, poor = sign * value, sign * self.passes, sign * self.poor
        return "fail" if value > poor else "poor" if value > passes else "pass"


# One standard deviation of each result. A hand is off by about as much as its arm's lengths, and by up to 6 mm a
# degree of an arm's heading; the torso's heading moves it only as the torso leans. Soft tissue and the shoulder girdle
# move it by 30 mm an axis whatever the calibration (docs/people.md): a calibration passes that adds less than
# that, as one minute of a careful person's joined hands does on simulated people (lengths 9 to 12 mm, headings 3.0 to
# 3.6 deg).
LENGTH = Limits(0.012, 0.020)  # [m] of an upper arm, of forearm + hand, of the shoulder width, the scale apart
ARM_HEADING = Limits(np.deg2rad(4.0), np.deg2rad(7.0))  # [rad]
TORSO_HEADING = Limits(np.deg2rad(5.0), np.deg2rad(7.0))  # [rad]; beyond, soft tissue makes it worse than stated
HAND_HEADING = Limits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] short links, seen little
LONE_HEADING = Limits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] by poses, or by one arm: the best that these reach
MOST_TILT = np.deg2rad(2.0)  # [rad] of a link that turns about the vertical alone, as its sensor measures it
# Relative. It may move a hand, 0.62 m from its shoulder, by half of what tissue and girdle do, 15 mm: 2.4 %. A taped
# arm gives 1.2 %, shoulder breadth with stature and sex 2.1 %, stature and sex alone 2.6 %, the population prior 5 %.
SCALE = Limits(0.024, 0.08)
# Residuals of the solution.
# [m] rms while the palms touch: wrists bend, shoulders travel. Careful simulated people have 39 mm, give or take 5, and
# those with more are no farther off.
GAP = Limits(0.055, 0.075)
OPEN_SHARE = Limits(MOST_OPEN, 0.60)  # share of samples
# [rad] of a segment in the start pose: forearms hang 13 deg outwards and 12 deg forwards, give or take 5 and 7
# (docs/people.md): 18 deg off in all, give or take 6.
TILT = Limits(np.deg2rad(35.0), np.deg2rad(45.0))
UNUSUAL = Limits(4.0, 6.0)  # standard deviations of a length from the population prior
POSED = Limits(CONTRADICTED, 8.0)  # of a pose or a bow that is used, from the estimate without it
MEASURED = Limits(CONTRADICTED, 5.0)  # of a measured length from the estimate without it
SAMPLES = Limits(6.0, 2.0)  # effective sample size, at least
ROTATION = Limits(LEAST_ROTATION, 0.0)  # [rad] of the segments, at least
DOUBT = Limits(1.0, 1.0)  # of anatomy, see `anatomy`

# A motion smaller than this [rad] is the cause of an uncertainty.
ENOUGH = {
    "motion-elevation-small": np.deg2rad(40.0),
    "motion-sideways-small": np.deg2rad(35.0),
    "motion-bend-small": np.deg2rad(40.0),
    "motion-lean-small": np.deg2rad(8.0),
    "motion-twist-small": np.deg2rad(12.0),
}
ENOUGH_SAMPLES = 12.0  # effective sample size that a minute of motion reaches
# A direction is determined by the motion where that gives more information than the prior.
MIN_INFORMATION = 1e-2  # of a direction, in units of the prior's, below which the motion does not show it


class Check(NamedTuple):
    """One number against its limits."""

    diagnostic: Diagnostic  # what is checked: its value, and as limit that up to which it passes
    quality: Quality
    limits: Limits
    cause: Diagnostic | None = None  # the motion that was too small

    @property
    def value(self) -> float:
        """Of the diagnostic; NaN where it has none."""
        return float("nan") if self.diagnostic.value is None else self.diagnostic.value

    @property
    def excess(self) -> float:
        """The ratio of value and limit, above 1 where it does not pass."""
        passes, poor = self.limits
        value, limit = (passes, self.value) if passes > poor else (self.value, passes)
        return value / max(limit, 1e-9)


class Range(NamedTuple):
    """From the 2nd to the 98th percentile [deg]."""

    low: float
    high: float

    @property
    def size(self) -> float:
        return self.high - self.low


class Motion(NamedTuple):
    """How far the body moved while the chain was closed; keys are limbs, by side or by their last point."""

    elevation: dict[str, Range]  # of the limb's first segment in the one above, 0 hanging, 90 level
    sideways: dict[str, Range]  # azimuth of the limb's end from its beginning in the segment above, positive left
    bend: dict[str, Range]  # flexion of its hinge, 0 straight
    lean: float  # [deg] of the first segment's axis from its mean, 98th percentile
    twist: Range | None  # heading of the first segment


class InformationDirection(NamedTuple):
    """A combination of lengths and mounts, and how much information the motion gives on it."""

    information: float  # in units of the prior's: 0 none, 1 as much again
    parts: dict[str, float]  # its largest parts, each in units of its standard deviation before


@dataclass(frozen=True)
class CalibrationQuality:
    """The quality of a calibration, and how the motion determined it.

    Parameters
    ----------
    quality : the worst of all checks
    checks : all of them, in the order of the results
    reasons : why it does not pass, the worst first, each followed by its cause
    further : what else the user should know
    motion : how far the body moved
    directions : of lengths and mounts jointly, best determined first
    rank, determined, unknowns : directions that the motion shows, determines better than the prior, and all
    condition : largest over smallest standard deviation after the motion, each in units of that before
    """

    quality: Quality
    checks: tuple[Check, ...]
    reasons: tuple[Diagnostic, ...]
    further: tuple[Diagnostic, ...]
    motion: Motion
    directions: tuple[InformationDirection, ...]
    rank: int
    determined: int
    unknowns: int
    condition: float

    def __repr__(self) -> str:
        failing = sum(check.quality != "pass" for check in self.checks)
        return f"CalibrationQuality({self.quality!r}: {failing} of {len(self.checks)} checks do not pass)"

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """All that a user should know of the calibration."""
        return (*self.reasons, *self.further)


def assess(calibration: Calibration) -> CalibrationQuality:
    """The quality of a calibration."""
    motion = _measure_motion(calibration)
    checks = _check_sensors(calibration)
    hardly_moved = _check_rotation(calibration)
    if hardly_moved is not None:  # all else follows from it
        checks = [hardly_moved]
    elif not calibration.labels.moved:  # with exchanged sensors all other checks are meaningless
        checks += [*_check_deviations(calibration, motion), *_check_residuals(calibration)]
    reasons = _reasons(checks)
    directions = _find_directions(calibration)
    after = np.array([1.0 / (1.0 + d.information) for d in directions])
    return CalibrationQuality(
        quality=max((check.quality for check in checks), key=QUALITIES.index),
        checks=tuple(checks),
        reasons=reasons,
        further=tuple(each for each in calibration.remarks if each.code not in {reason.code for reason in reasons}),
        motion=motion,
        directions=directions,
        rank=sum(d.information > MIN_INFORMATION for d in directions),
        determined=sum(d.information > 1.0 for d in directions),
        unknowns=len(directions),
        condition=float(np.sqrt(after.max() / after.min())) if len(after) else float("nan"),
    )


def _reasons(checks: list[Check]) -> tuple[Diagnostic, ...]:
    """Diagnostics that do not pass, the worst first; a cause once, behind the first that it explains."""
    reasons: list[Diagnostic] = []
    failing = [check for check in checks if check.quality != "pass"]
    for check in sorted(failing, key=lambda check: (check.quality != "fail", -check.excess)):
        if check.diagnostic.code in {check.cause.code for check in failing if check.cause is not None}:
            continue  # it is the cause of another
        reasons.append(check.diagnostic)
        if check.cause is not None and check.cause.code not in {each.code for each in reasons}:
            reasons.append(check.cause)
    return tuple(reasons)


def _check(
    diagnostic: Diagnostic, limits: Limits, cause: Diagnostic | None = None, quality: Quality | None = None
) -> Check:
    """A check of the diagnostic's value; its severity is that of the quality."""
    value = float(diagnostic.value if diagnostic.value is not None else np.nan)
    quality = quality or limits.quality(value)
    severity = SEVERITY[quality]
    diagnostic = replace(diagnostic, severity=severity, value=value, limit=float(limits.passes))
    return Check(diagnostic, quality, limits, None if cause is None else replace(cause, severity=severity))


def _check_sensors(calibration: Calibration) -> list[Check]:
    """Checks of labels and mounts."""
    labels = calibration.labels
    checks = []
    if not calibration.model.table.is_mechanism:
        checks.append(_check(labels.diagnostic(), DOUBT, labels.contradiction))
    for mount in calibration.unused_mounts:
        checks.append(_check(mount, Limits(float(mount.limit or 0.0), np.pi), quality="poor"))
    for phase, deviation in calibration.posed.items():
        checks.append(_check(Diagnostic("pose-contradicted", INFO, phase, deviation), POSED))
    return checks


def _check_rotation(calibration: Calibration) -> Check | None:
    """The check of a motion that is too small for anatomy to tell anything of it; None where there is no doubt."""
    if calibration.labels.doubt <= 1.0 or not calibration.rotation < LEAST_ROTATION:
        return None
    return _check(Diagnostic("motion-too-small", INFO, value=calibration.rotation), ROTATION, quality="fail")


def _check_deviations(calibration: Calibration, motion: Motion) -> list[Check]:
    """Checks of the standard deviations."""
    subject, closure = calibration.subject, calibration.closure
    table, model = calibration.model.table, calibration.model
    # Lengths that begin at the root cancel in a closed chain, and are one with a point of W that is not known.
    names = [name for name, length in table.lengths.items() if not any(ROOT in part.start for part in length.stretches)]
    lengths = np.array([subject.lengths[name] for name in names])
    covariance = subject.lengths_covariance(names)
    # Errors of the scale change all lengths together; they have their own check.
    shape, scale_observed = covariance, is_scale_observed(calibration.conditions)
    if len(names) > 1 and not scale_observed:
        common = 1.0 / float(lengths @ np.linalg.solve(covariance, lengths))
        shape = covariance - common * np.outer(lengths, lengths)

    def std(parts: tuple[str, ...]) -> float:
        take = np.array([float(name in parts) for name in names])
        return float(np.sqrt(max(take @ shape @ take, 0.0)))

    checks = []
    groups = group_lengths(calibration.conditions, model.lengths)
    groups = {sensor: tuple(name for name in group if name in names) for sensor, group in groups.items()}
    for sensor, group in sorted(groups.items(), key=lambda item: table.segments[item[0]].spine):
        other = table.counterpart(sensor)
        if not group or (other in groups and std(groups[other]) > std(group)):
            continue
        if other in groups and std(groups[other]) == std(group) and table.side(sensor) == "right":
            continue
        facts: dict[str, float | str] = {"variant": calibration.variant}
        uncertain = Diagnostic("length-uncertain", INFO, " + ".join(group), std(group), facts=facts)
        spine, first = table.segments[sensor].spine, _starts_limb(calibration, sensor)
        causes = (
            ("sideways", "elevation")
            if spine
            else ("sideways", "elevation", "bend")
            if first
            else ("sideways", "bend", "elevation")
        )
        cause = (
            None if spine and closure == "fixed_point" else _find_cause(calibration, motion, causes, table.side(sensor))
        )
        checks.append(_check(uncertain, LENGTH, cause))
    for segment in (s for s in subject.mounts if s in table.segments and f"mounts.{s}.z" in subject.order):
        if table.is_mechanism and _turns_about_vertical(calibration, segment):
            continue  # the heading of its mount moves no point
        reference = segment == table.reference
        causes = ("lean", "twist", "sideways") if reference else ("sideways", "elevation", "bend")
        cause = _find_cause(calibration, motion, causes, table.side(segment))
        limits = (
            TORSO_HEADING
            if reference
            else HAND_HEADING
            if table.segments[segment].rigid_without_sensor
            else ARM_HEADING
        )
        if len(calibration.hinge_rms) < 2:
            limits = LONE_HEADING
        if table.is_mechanism:
            limits = limits._replace(poor=np.pi)
        uncertain = Diagnostic(
            "mount-heading-uncertain",
            INFO,
            segment,
            subject.std(f"mounts.{segment}.z"),
            facts={"variant": MECHANISM if table.is_mechanism else calibration.variant or "poses"},
        )
        checks.append(_check(uncertain, limits, cause))
    if scale_observed:
        return checks
    prior = calibration.prior
    facts = {"measured": calibration.measured_example}
    if calibration.scale_lengths:
        scale = Diagnostic("scale-uncertain", INFO, value=calibration.scale_std, facts=facts)
    else:
        facts |= {"prior": prior.note or prior.name, "protocol": calibration.protocol}
        scale = Diagnostic("scale-from-prior", INFO, value=calibration.scale_std, facts=facts)
    return [*checks, _check(scale, SCALE)]


def _turns_about_vertical(calibration: Calibration, segment: str) -> bool:
    """Whether a segment turned about the vertical alone."""
    R_WL, R_start = Rotation.from_quat(calibration.quat_WL[segment]), calibration.start_pose.R_WK[segment]
    up = (R_WL * Rotation.from_matrix(R_start).inv()).apply([0.0, 0.0, 1.0])
    return bool(np.all(up[:, 2] > np.cos(MOST_TILT)))


def _starts_limb(calibration: Calibration, segment: str) -> bool:
    """Whether a segment is the first of a limb."""
    above = calibration.model.parents[segment]
    return above is None or calibration.model.table.segments[above].spine


def _find_cause(calibration: Calibration, motion: Motion, causes: tuple[str, ...], side: str) -> Diagnostic | None:
    """The cause of an uncertainty: the smallest of the motions that it needs, or too short a motion."""
    if not calibration.closure:
        return None

    def size(values: Mapping[str, Range]) -> float:
        return min((value.size for limb, value in values.items() if not side or limb == side), default=np.nan)

    sizes = {
        "elevation": size(motion.elevation),
        "sideways": size(motion.sideways),
        "bend": size(motion.bend),
        "lean": motion.lean,
        "twist": motion.twist.size if motion.twist else np.nan,
    }
    facts = {"variant": calibration.variant}
    codes = {f"motion-{name}-small": np.deg2rad(sizes[name]) for name in causes if np.isfinite(sizes[name])}
    least = min(codes, key=lambda code: codes[code] / ENOUGH[code], default="")
    if least and codes[least] < ENOUGH[least]:
        return Diagnostic(least, WARNING, "", float(codes[least]), float(ENOUGH[least]), facts)
    samples = calibration.effective_sample_size
    if samples < SAMPLES.passes:
        return Diagnostic("motion-too-short", WARNING, "", samples, SAMPLES.passes, facts)
    if samples < ENOUGH_SAMPLES:
        return Diagnostic("motion-short", WARNING, "", samples, ENOUGH_SAMPLES)
    return None


def _check_residuals(calibration: Calibration) -> list[Check]:
    """Checks of residuals, and of estimates against the prior."""
    closed, facts = np.isfinite(calibration.gap), {"variant": calibration.variant}
    checks = []
    if calibration.closure:
        share = float(np.mean(calibration.contact[closed] < MIN_CONTACT))
        intervals = {"intervals": format_longest(find_open_intervals(calibration))}
        checks += [
            _check(Diagnostic("closure-gap-large", INFO, value=calibration.rms_gap, facts=facts), GAP),
            _check(Diagnostic("motion-too-short", INFO, value=calibration.effective_sample_size, facts=facts), SAMPLES),
            _check(Diagnostic("closure-open", INFO, value=share, facts=facts | intervals), OPEN_SHARE),
        ]
    tilts = {name: float(np.linalg.norm(tilt)) for name, tilt in calibration.start_pose_offset.items()}
    if tilts:
        name = max(tilts, key=lambda n: tilts[n])
        checks.append(_check(Diagnostic("start-pose-off", INFO, name, tilts[name]), TILT))
    for name, length in calibration.measured_lengths.items():
        lengths: dict[str, float | str] = {"measured": length.metres, "expected": length.expected, "std": length.std}
        if calibration.formulation == "paper":
            lengths["variant"] = "paper"
        checks.append(
            _check(Diagnostic("measured-length-contradicted", INFO, name, length.deviation, facts=lengths), MEASURED)
        )
    if any(length.deviation > MEASURED.passes for length in calibration.measured_lengths.values()):
        return checks  # all lengths have followed a wrong measured one
    prior, subject = calibration.prior, calibration.subject
    names = [name for name in calibration.model.lengths if name not in calibration.measured]
    z = {name: abs(subject.lengths[name] - prior.lengths[name]) / prior.std(name) for name in names}
    if not z:
        return checks
    name = max(z, key=lambda n: z[n])
    unusual: dict[str, float | str] = {"metres": float(subject.lengths[name])}
    if calibration.model.table.is_mechanism:
        unusual["variant"] = MECHANISM
    return [*checks, _check(Diagnostic("length-unusual", INFO, name, z[name], facts=unusual), UNUSUAL)]


def _measure_motion(calibration: Calibration) -> Motion:
    closed = np.isfinite(calibration.gap) & (calibration.contact > MIN_CONTACT)
    rows = closed if closed.any() else np.ones(len(calibration.time), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    model, table, start = calibration.model, calibration.model.table, calibration.start_pose
    lengths = np.array([calibration.subject.lengths[name] for name in model.lengths])
    turned = {name: rotation * Rotation.from_matrix(start.R_WK[name]).inv() for name, rotation in R.items()}
    hinges = {hinge.on: joint for joint, hinge in table.hinges.items()}
    elevation, sideways, bend = {}, {}, {}
    flexion = calibration.limbs().flexion
    for limb in () if table.is_mechanism else table.limbs:  # its links hang in no common pose
        key, first = table.side(limb[0]) or limb[-1], table.points[limb[0]].link
        above = model.parents.get(first)
        joint = hinges.get(first, "")
        if above not in R or first not in R or (joint and joint not in flexion):
            continue
        try:
            parts = find_parts(model, start, R, [(limb[-1], 1.0), (limb[0], -1.0)])
        except BadSession:  # the limb's end is not known
            continue
        base = R[above].inv()
        along = (base * R[first]).apply(table.segments[first].along)
        elevation[key] = _range(np.degrees(np.arccos(np.clip(-along[:, 2], -1.0, 1.0))))
        sideways[key] = _range(_azimuth(base.apply(sum(turned[p.sensor].apply(p.vector(lengths)) for p in parts))))
        if joint:
            bend[key] = _range(flexion[joint])
    lean, twist = float("nan"), None
    if table.reference in R and not table.is_mechanism:
        up = R[table.reference].apply([0.0, 0.0, 1.0])
        mean = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
        lean = float(np.degrees(np.percentile(np.arccos(np.clip(up @ mean, -1.0, 1.0)), 98)))
        twist = _range(_azimuth(R[table.reference].apply([1.0, 0.0, 0.0])))
    return Motion(elevation, sideways, bend, lean, twist)


def _azimuth(v: np.ndarray) -> np.ndarray:
    """Angles (n,) [deg] of v (n, 3) about z, from their mean."""
    turn = v[:, 0] + 1j * v[:, 1]
    mean = np.mean(turn)
    return np.degrees(np.angle(turn * np.conj(mean)) + np.angle(mean))


def _range(values: np.ndarray) -> Range:
    return Range(*(float(v) for v in np.percentile(values, (2, 98))))


def _find_directions(calibration: Calibration) -> tuple[InformationDirection, ...]:
    """The information of the motion in units of the prior's: eigenvectors of one covariance in the other."""
    # Without what the prior knows exactly.
    unknown = np.flatnonzero(np.diag(calibration.prior_covariance) > 0.0)
    names = [calibration.subject.order[k] for k in unknown]
    if not names:
        return ()
    scale = np.sqrt(np.diag(calibration.prior_covariance)[unknown])
    before = calibration.prior_covariance[np.ix_(unknown, unknown)] / np.outer(scale, scale)
    after = calibration.subject.covariance[np.ix_(unknown, unknown)] / np.outer(scale, scale)
    shares, vectors = eigh(after, before)
    directions = []
    for share, vector in zip(shares, vectors.T, strict=True):
        way = before @ vector  # along which x moves, where vector weighs it
        way = way / np.linalg.norm(way) * np.sign(way[np.argmax(np.abs(way))])
        largest = [k for k in np.argsort(-np.abs(way))[:4] if abs(way[k]) > 0.2]
        parts = {names[k]: round(float(way[k]), 2) for k in largest}
        directions.append(InformationDirection(max(1.0 / float(share) - 1.0, 0.0), parts))
    return tuple(directions)


MOST_POINTS = 600  # of the residual over time


def document(calibration: Calibration, quality: CalibrationQuality) -> dict[str, Any]:
    """The content of ``calibration.json``; lengths [m], times [s], angles as named, checks and diagnostics SI."""
    subject = calibration.subject
    stride = -(-len(calibration.time) // MOST_POINTS)
    some = slice(None, None, stride)
    return {
        "quality": quality.quality,
        "diagnostics": [as_json(diagnostic) for diagnostic in quality.diagnostics],
        "checks": [
            {
                "code": check.diagnostic.code,
                "place": check.diagnostic.place,
                "quality": check.quality,
                "value": _number(check.value),
                "passes": check.limits.passes,
                "poor": check.limits.poor,
            }
            for check in quality.checks
        ],
        "protocol": calibration.protocol,
        "measured": dict(calibration.measured),
        "scale_std": _number(calibration.scale_std),
        "lengths": {n: {"value": v, "std": _number(subject.std(n))} for n, v in subject.lengths.items()},
        "mounts": {
            segment: {
                **{key: float(v) for key, v in zip(("qx", "qy", "qz", "qw"), quat, strict=True)},
                "std_deg": [_number(np.degrees(subject.std(f"mounts.{segment}.{axis}"))) for axis in "xyz"],
            }
            for segment, quat in subject.mounts.items()
        },
        "start_pose_offset_deg": {name: np.degrees(tilt) for name, tilt in calibration.start_pose_offset.items()},
        "heading_drift_deg_min": {name: 60.0 * np.degrees(rate) for name, rate in calibration.heading_drift.items()},
        "hinges": {
            joint: {"axis": axis, "rms_deg": _number(np.degrees(calibration.hinge_rms[joint]))}
            for joint, axis in calibration.hinge_axes.items()
        },
        "gap_rms": {"after": _number(calibration.rms_gap), "before": _number(calibration.prior_rms_gap)},
        "gap": {
            "time": calibration.time[some].round(3),
            "after": [_number(v) for v in calibration.gap[some]],
            "before": [_number(v) for v in calibration.prior_gap[some]],
            "contact": calibration.contact[some].round(3),
        },
        "open_intervals": find_open_intervals(calibration),
        "effective_sample_size": calibration.effective_sample_size,
        "conditioning": {
            "unknowns": quality.unknowns,
            "rank": quality.rank,
            "determined": quality.determined,
            "condition": _number(quality.condition),
            "directions": quality.directions,
        },
        "motion_deg": {**quality.motion._asdict(), "lean": _number(quality.motion.lean)},
        "labels": {"doubt": _number(calibration.labels.doubt), "moved": dict(calibration.labels.moved)},
    }


def find_open_intervals(calibration: Calibration) -> list[tuple[float, float]]:
    """Intervals [s] in which the palms were apart."""
    mask = np.isfinite(calibration.gap) & (calibration.contact < MIN_CONTACT)
    return [(round(a, 3), round(b, 3)) for a, b in find_intervals(calibration.time, mask)]


def _number(value: float) -> float | None:
    """None where it is not finite, which JSON cannot say."""
    return float(value) if np.isfinite(value) else None
