"""Whether a calibration is good enough, and what the motion did not determine.

Each check is one number against two stated limits: up to the first it passes, up to the second it is poor, beyond it
fails; the quality is the worst of them. What is uncertain is explained by what was measured of the motion: the upper
arms were hardly raised, the torso hardly leaned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, Severity, as_json
from ..subject import LENGTHS
from .anatomy import E_Z, SIDES
from .lengths import Calibration
from .observability import MOST_OPEN, intervals_of, longest_intervals
from .weighing import CONTRADICTED, TOUCHED

Quality = Literal["pass", "poor", "fail"]
QUALITIES: tuple[Quality, ...] = ("pass", "poor", "fail")
SEVERITY: dict[Quality, Severity] = {"pass": INFO, "poor": WARNING, "fail": ERROR}


class Limits(NamedTuple):
    """Up to `passes` a value passes, up to `poor` it is poor; from them on where `passes` is the larger one."""

    passes: float
    poor: float

    def quality(self, value: float) -> Quality:
        """NaN is of what was not looked at, and passes."""
        sign = -1.0 if self.passes > self.poor else 1.0
        value, passes, poor = sign * value, sign * self.passes, sign * self.poor
        return "fail" if value > poor else "poor" if value > passes else "pass"


# One standard deviation of each result. A hand is off by about as much as its arm's lengths, and by up to 10 mm a
# degree of an arm's heading; the torso's heading moves it only as the torso leans.
LENGTH = Limits(0.010, 0.020)  # [m] of an upper arm, of forearm + hand, of the shoulder width, the scale apart
ARM_HEADING = Limits(np.deg2rad(3.0), np.deg2rad(6.0))  # [rad]
TORSO_HEADING = Limits(np.deg2rad(5.0), np.deg2rad(7.0))  # [rad]; beyond, soft tissue makes it worse than stated
HAND_HEADING = Limits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] short links, seen little
LONE_HEADING = Limits(np.deg2rad(8.0), np.deg2rad(15.0))  # [rad] by poses, or by one arm: no better is to be had
SCALE = Limits(0.02, 0.08)  # relative; a tape has 1 %, the population prior 5 %
# What the solution leaves over.
GAP = Limits(0.030, 0.060)  # [m] rms while the palms touch
APART = Limits(MOST_OPEN, 0.60)  # share of looks
TILT = Limits(np.deg2rad(12.0), np.deg2rad(20.0))  # [rad] of a segment in the start pose; elbows hang 5 to 8 deg bent
UNUSUAL = Limits(4.0, 6.0)  # standard deviations of a length from the population prior
MEASURED = Limits(CONTRADICTED, 5.0)  # of a measured length from what the motion and the prior say of it
SAMPLES = Limits(6.0, 2.0)  # effective sample size, at least: some six independent ones carry a calibration
DOUBT = Limits(1.0, 1.0)  # of anatomy, see `anatomy`

# What moved less than this [rad] is said to be the cause of what is uncertain.
ENOUGH = {
    "motion-elevation-small": np.deg2rad(40.0),
    "motion-sideways-small": np.deg2rad(35.0),
    "motion-elbow-small": np.deg2rad(40.0),
    "motion-lean-small": np.deg2rad(8.0),
    "motion-twist-small": np.deg2rad(12.0),
}
ENOUGH_SAMPLES = 12.0  # effective sample size
# A direction counts as determined by the motion where that tells more than was known before.
SEEN = 1e-2  # information, in units of what was known before, below which a direction was not seen at all


class Check(NamedTuple):
    """One number against its limits."""

    diagnostic: Diagnostic  # what is checked: its value, and as limit that up to which it passes
    quality: Quality
    limits: Limits
    cause: Diagnostic | None = None  # what moved too little for it

    @property
    def value(self) -> float:
        assert self.diagnostic.value is not None
        return self.diagnostic.value

    @property
    def excess(self) -> float:
        """How many times the limit up to which it passes it is, or that limit is the value where it is a least one."""
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
    """What moved while the chain was closed, as solved; keys are sides."""

    elevation: dict[str, Range]  # of the upper arm in the torso, 0 hanging, 90 level
    sideways: dict[str, Range]  # azimuth of the hand from its shoulder in the torso, positive left
    elbow: dict[str, Range]  # flexion, 0 straight
    lean: float  # [deg] of the torso's axis from its mean, 98th percentile
    twist: Range | None  # heading of the torso


class Direction(NamedTuple):
    """A combination of lengths and mounts, and how much the motion told of it."""

    information: float  # in units of what was known before: 0 nothing, 1 as much again
    of: dict[str, float]  # its largest parts, each in units of its standard deviation before


@dataclass(frozen=True)
class CalibrationQuality:
    """What a calibration is worth.

    Parameters
    ----------
    quality : the worst of all checks
    checks : in the order of the results; those that pass as well
    reasons : what keeps it from passing, the worst first, each followed by its cause
    further : what else the user should know
    motion : what moved
    directions : of lengths and mounts jointly, best seen first
    rank, determined, unknowns : directions seen at all, told better than before, and all
    condition : largest over smallest standard deviation after the motion, each in units of that before
    """

    quality: Quality
    checks: tuple[Check, ...]
    reasons: tuple[Diagnostic, ...]
    further: tuple[Diagnostic, ...]
    motion: Motion
    directions: tuple[Direction, ...]
    rank: int
    determined: int
    unknowns: int
    condition: float

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """All that a user should know of the calibration."""
        return (*self.reasons, *self.further)


def assess(calibration: Calibration) -> CalibrationQuality:
    """The quality of a calibration, with what was and was not seen."""
    motion = _motion(calibration)
    checks = _labels(calibration)
    if not calibration.labels.moved:  # of another arrangement of sensors nothing else means anything
        checks += [*_deviations(calibration, motion), *_left_over(calibration)]
    reasons = _reasons(checks)
    directions = _directions(calibration)
    after = np.array([1.0 / (1.0 + d.information) for d in directions])
    return CalibrationQuality(
        quality=max((check.quality for check in checks), key=QUALITIES.index),
        checks=tuple(checks),
        reasons=reasons,
        further=tuple(each for each in calibration.diagnostics if each.code not in {of.code for of in reasons}),
        motion=motion,
        directions=directions,
        rank=sum(d.information > SEEN for d in directions),
        determined=sum(d.information > 1.0 for d in directions),
        unknowns=len(directions),
        condition=float(np.sqrt(after.max() / after.min())) if len(after) else float("nan"),
    )


def _reasons(checks: list[Check]) -> tuple[Diagnostic, ...]:
    """What does not pass, the worst first; a cause once, behind the first that it explains."""
    found: list[Diagnostic] = []
    failing = [check for check in checks if check.quality != "pass"]
    for check in sorted(failing, key=lambda check: (check.quality != "fail", -check.excess)):
        found.append(check.diagnostic)
        if check.cause is not None and check.cause.code not in {each.code for each in found}:
            found.append(check.cause)
    return tuple(found)


def _check(
    diagnostic: Diagnostic, limits: Limits, cause: Diagnostic | None = None, quality: Quality | None = None
) -> Check:
    """A check of the diagnostic's value; its severity is that of the quality."""
    value = float(diagnostic.value if diagnostic.value is not None else np.nan)
    quality = quality or limits.quality(value)
    severity = SEVERITY[quality]
    diagnostic = replace(diagnostic, severity=severity, value=value, limit=float(limits.passes))
    return Check(diagnostic, quality, limits, None if cause is None else replace(cause, severity=severity))


def _labels(calibration: Calibration) -> list[Check]:
    """Sensors that sit elsewhere than labelled, and mounts that cannot be."""
    labels = calibration.labels
    found = [_check(labels.diagnostic(), DOUBT, labels.contradiction)]
    for mount in calibration.contradicted:
        found.append(_check(mount, Limits(float(mount.limit or 0.0), np.pi), quality="poor"))
    return found


def _deviations(calibration: Calibration, motion: Motion) -> list[Check]:
    subject, closure = calibration.subject, calibration.closure
    names = [name for name in LENGTHS if name != "trunk"]
    lengths = np.array([subject.lengths[name] for name in names])
    covariance = subject.lengths_covariance(names)
    # Errors of the scale change all lengths together; they are judged by themselves.
    common = 1.0 / float(lengths @ np.linalg.solve(covariance, lengths))
    shape = covariance - common * np.outer(lengths, lengths)

    def std(*of: str) -> float:
        take = np.array([float(name in of) for name in names])
        return float(np.sqrt(max(take @ shape @ take, 0.0)))

    sides = [side for side in SIDES if f"{side}_upper_arm" in subject.mounts]
    found = []
    if closure:  # without a closure lengths are the prior's
        upper_arms = {s: std(f"{s}_upper_arm") for s in sides}
        forearms = {s: std(f"{s}_forearm", f"{s}_hand") for s in sides}
        if sides:
            side = max(sides, key=lambda s: upper_arms[s])
            uncertain = Diagnostic("upper-arm-length-uncertain", INFO, f"{side}_upper_arm", upper_arms[side])
            cause = _cause(calibration, motion, ("sideways", "elevation", "elbow"), [side])
            found.append(_check(uncertain, LENGTH, cause))
            side = max(sides, key=lambda s: forearms[s])
            uncertain = Diagnostic("forearm-length-uncertain", INFO, f"{side}_forearm", forearms[side])
            cause = _cause(calibration, motion, ("sideways", "elbow", "elevation"), [side])
            found.append(_check(uncertain, LENGTH, cause))
        uncertain = Diagnostic(
            "shoulder-width-uncertain", INFO, "shoulder_width", std("shoulder_width"), facts={"variant": closure}
        )
        one_arm = closure == "fixed_point"
        cause = None if one_arm else _cause(calibration, motion, ("sideways", "elevation"), sides)
        found.append(_check(uncertain, LENGTH, cause))
    for segment in (s for s in subject.mounts if f"mounts.{s}.z" in subject.order):
        torso = segment == "torso"
        causes = ("lean", "twist", "sideways") if torso else ("sideways", "elevation", "elbow")
        own = [s for s in SIDES if segment.startswith(s)]
        cause = _cause(calibration, motion, causes, own or sides)
        limits = TORSO_HEADING if torso else HAND_HEADING if segment.endswith("hand") else ARM_HEADING
        if len(calibration.hinge_rms) < 2:
            limits = LONE_HEADING
        uncertain = Diagnostic(
            "mount-heading-uncertain",
            INFO,
            segment,
            subject.std(f"mounts.{segment}.z"),
            facts={"variant": closure or "poses"},
        )
        found.append(_check(uncertain, limits, cause))
    prior = calibration.prior
    facts: dict[str, float | str] = {"measured": calibration.tape}
    if calibration.scaling:
        scale = Diagnostic("scale-uncertain", INFO, value=calibration.scale_std, facts=facts)
    else:
        facts |= {"prior": prior.note or prior.name, "protocol": calibration.protocol}
        scale = Diagnostic("scale-from-prior", INFO, value=calibration.scale_std, facts=facts)
    return [*found, _check(scale, SCALE)]


def _cause(calibration: Calibration, motion: Motion, causes: tuple[str, ...], sides: list[str]) -> Diagnostic | None:
    """Why something is uncertain: what moved least of what it needs, or that the motion was short."""
    if not calibration.closure:
        return None

    def size(values: Mapping[str, Range]) -> float:
        return min((values[side].size for side in sides if side in values), default=np.nan)

    sizes = {
        "elevation": size(motion.elevation),
        "sideways": size(motion.sideways),
        "elbow": size(motion.elbow),
        "lean": motion.lean,
        "twist": motion.twist.size if motion.twist else np.nan,
    }
    facts = {"variant": calibration.closure}
    codes = {f"motion-{name}-small": np.deg2rad(sizes[name]) for name in causes if np.isfinite(sizes[name])}
    least = min(codes, key=lambda code: codes[code] / ENOUGH[code], default="")
    if least and codes[least] < ENOUGH[least]:
        return Diagnostic(least, WARNING, "", float(codes[least]), float(ENOUGH[least]), facts)
    if calibration.independent < ENOUGH_SAMPLES:
        return Diagnostic("motion-too-short", WARNING, "", calibration.independent, ENOUGH_SAMPLES, facts)
    return None


def _left_over(calibration: Calibration) -> list[Check]:
    closed, facts = np.isfinite(calibration.gap), {"variant": calibration.closure}
    found = []
    if calibration.closure:
        share = float(np.mean(calibration.kept[closed] < TOUCHED))
        intervals = {"intervals": longest_intervals(apart(calibration))}
        found += [
            _check(Diagnostic("closure-gap-large", INFO, value=calibration.rms_gap, facts=facts), GAP),
            _check(Diagnostic("motion-too-short", INFO, value=calibration.independent, facts=facts), SAMPLES),
            _check(Diagnostic("closure-open", INFO, value=share, facts=facts | intervals), APART),
        ]
    tilts = {name: float(np.linalg.norm(tilt)) for name, tilt in calibration.start_tilt.items()}
    if tilts:
        name = max(tilts, key=lambda n: tilts[n])
        found.append(_check(Diagnostic("start-pose-off", INFO, name, tilts[name]), TILT))
    for name, tape in calibration.tapes.items():
        lengths: dict[str, float | str] = {"measured": tape.metres, "expected": tape.expected, "std": tape.std}
        found.append(_check(Diagnostic("measured-length-contradicted", INFO, name, tape.off, facts=lengths), MEASURED))
    if any(tape.off > MEASURED.passes for tape in calibration.tapes.values()):
        return found  # all lengths have followed a measured one that is wrong
    prior, subject = calibration.prior, calibration.subject
    z = {n: abs(subject.lengths[n] - prior.lengths[n]) / prior.std(n) for n in LENGTHS if n not in calibration.gauge}
    name = max(z, key=lambda n: z[n])
    metres = {"metres": float(subject.lengths[name])}
    return [*found, _check(Diagnostic("length-unusual", INFO, name, z[name], facts=metres), UNUSUAL)]


def _motion(calibration: Calibration) -> Motion:
    closed = np.isfinite(calibration.gap) & (calibration.kept > TOUCHED)
    rows = closed if closed.any() else np.ones(len(calibration.time), dtype=bool)
    R = {name: Rotation.from_quat(quat[rows]) for name, quat in calibration.quat_WL.items()}
    length = calibration.subject.lengths
    elevation, sideways, lean, twist = {}, {}, float("nan"), None
    torso = R.get("torso", Rotation.identity(int(rows.sum())))
    for side in SIDES:
        if {f"{side}_upper_arm", f"{side}_forearm"} <= R.keys():
            upper = (torso.inv() * R[f"{side}_upper_arm"]).apply(-E_Z)
            fore = (torso.inv() * R[f"{side}_forearm"]).apply(-E_Z)
            elevation[side] = _range(np.degrees(np.arccos(np.clip(-upper[:, 2], -1.0, 1.0))))
            reach = length[f"{side}_upper_arm"] * upper + (length[f"{side}_forearm"] + length[f"{side}_hand"]) * fore
            sideways[side] = _range(_azimuth(reach))
    if "torso" in R:
        up = torso.apply(E_Z)
        mean = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
        lean = float(np.degrees(np.percentile(np.arccos(np.clip(up @ mean, -1.0, 1.0)), 98)))
        twist = _range(_azimuth(torso.apply([1.0, 0.0, 0.0])))
    return Motion(elevation, sideways, {s: _range(f) for s, f in calibration.arms().flexion.items()}, lean, twist)


def _azimuth(v: np.ndarray) -> np.ndarray:
    """Angles (n,) [deg] of v (n, 3) about z, from their mean."""
    turn = v[:, 0] + 1j * v[:, 1]
    mean = np.mean(turn)
    return np.degrees(np.angle(turn * np.conj(mean)) + np.angle(mean))


def _range(values: np.ndarray) -> Range:
    return Range(*(float(v) for v in np.percentile(values, (2, 98))))


def _directions(calibration: Calibration) -> tuple[Direction, ...]:
    """What the motion told, in units of what was known before: eigenvectors of one covariance in the other."""
    names = calibration.subject.order
    if calibration.before.shape != calibration.subject.covariance.shape:
        return ()
    scale = np.sqrt(np.diag(calibration.before))
    before = calibration.before / np.outer(scale, scale)
    after = calibration.subject.covariance / np.outer(scale, scale)
    shares, vectors = eigh(after, before)
    found = []
    for share, vector in zip(shares, vectors.T, strict=True):
        way = before @ vector  # along which x moves, where vector weighs it
        way = way / np.linalg.norm(way) * np.sign(way[np.argmax(np.abs(way))])
        largest = [k for k in np.argsort(-np.abs(way))[:4] if abs(way[k]) > 0.2]
        of = {names[k]: round(float(way[k]), 2) for k in largest}
        found.append(Direction(max(1.0 / float(share) - 1.0, 0.0), of))
    return tuple(found)


MOST_POINTS = 600  # of the residual over time


def document(calibration: Calibration, quality: CalibrationQuality) -> dict[str, Any]:
    """What ``calibration.json`` holds; lengths [m], times [s], angles as named, checks and diagnostics SI."""
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
        "gauge": dict(calibration.gauge),
        "scale_std": calibration.scale_std,
        "lengths": {n: {"value": v, "std": _number(subject.std(n))} for n, v in subject.lengths.items()},
        "mounts": {
            segment: {
                **{key: float(v) for key, v in zip(("qx", "qy", "qz", "qw"), quat, strict=True)},
                "std_deg": [_number(np.degrees(subject.std(f"mounts.{segment}.{axis}"))) for axis in "xyz"],
            }
            for segment, quat in subject.mounts.items()
        },
        "start_tilt_deg": {name: np.degrees(tilt) for name, tilt in calibration.start_tilt.items()},
        "heading_drift_deg_min": {name: 60.0 * np.degrees(rate) for name, rate in calibration.drift.items()},
        "hinge": {
            side: {"axis": axis, "rms_deg": _number(np.degrees(calibration.hinge_rms[side]))}
            for side, axis in calibration.hinge.items()
        },
        "gap_rms": {"after": _number(calibration.rms_gap), "before": _number(calibration.prior_rms_gap)},
        "gap": {
            "time": calibration.time[some].round(3),
            "after": [_number(v) for v in calibration.gap[some]],
            "before": [_number(v) for v in calibration.prior_gap[some]],
            "kept": calibration.kept[some].round(3),
        },
        "apart": apart(calibration),
        "independent_looks": calibration.independent,
        "conditioning": {
            "unknowns": quality.unknowns,
            "rank": quality.rank,
            "determined": quality.determined,
            "condition": _number(quality.condition),
            "directions": quality.directions,
        },
        "motion_deg": quality.motion,
        "labels": {"doubt": _number(calibration.labels.doubt), "moved": dict(calibration.labels.moved)},
    }


def apart(calibration: Calibration) -> list[tuple[float, float]]:
    """From when to when [s] the palms were apart."""
    gone = np.isfinite(calibration.gap) & (calibration.kept < TOUCHED)
    return [(round(a, 3), round(b, 3)) for a, b in intervals_of(calibration.time, gone)]


def _number(value: float) -> float | None:
    """None where it is not finite, which JSON cannot say."""
    return float(value) if np.isfinite(value) else None
