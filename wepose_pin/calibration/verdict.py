"""Whether a calibration is good enough, what the motion left unseen, and what to do better, in a person's words.

Each finding is one number against two stated limits: up to the first it passes, up to the second it is poor, beyond it
fails; the verdict is the worst of them. What is uncertain is explained by what was measured of the motion: the upper
arms were hardly raised, the torso hardly leaned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ..subject import LENGTHS
from .advice import ADVICE, POSED
from .anatomy import E_Z, SIDES
from .lengths import Calibration
from .weighing import CONTRADICTED, TOUCHED

Grade = Literal["pass", "poor", "fail"]
GRADES: tuple[Grade, ...] = ("pass", "poor", "fail")
EFFECTIVE = "independent measurements"  # the unit of an effective sample size


class Limits(NamedTuple):
    """Up to `passes` a value passes, up to `poor` it is poor; from them on where `passes` is the larger one."""

    passes: float
    poor: float

    def grade(self, value: float) -> Grade:
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
SCALE = Limits(0.02, 0.08)  # relative; a tape has 1 %, an average person 5 %
# What the solution leaves over.
GAP = Limits(0.030, 0.060)  # [m] rms while the palms touch
APART = Limits(0.10, 0.60)  # share of looks
TILT = Limits(np.deg2rad(12.0), np.deg2rad(20.0))  # [rad] of a segment in the start pose; elbows hang 5 to 8 deg bent
UNUSUAL = Limits(4.0, 6.0)  # standard deviations of a length from the average person
TAPE = Limits(CONTRADICTED, 5.0)  # of a taped length from what the motion and the average person say of it
SAMPLES = Limits(6.0, 2.0)  # effective sample size, at least: some six independent ones carry a calibration
DOUBT = Limits(1.0, 1.0)  # of anatomy, see `anatomy`

# What moved less than this is said to be the cause of what is uncertain.
ENOUGH = {"elevation": 40.0, "sideways": 35.0, "elbow": 40.0, "lean": 8.0, "twist": 12.0}  # [deg]
ENOUGH_LOOKS = 12.0  # independent ones
# A direction counts as determined by the motion where that tells more than was known before.
SEEN = 1e-2  # information, in units of what was known before, below which a direction was not seen at all


class Finding(NamedTuple):
    """One number against its limits."""

    name: str
    grade: Grade
    value: float  # in `unit`, as its limits
    passes: float
    poor: float
    unit: str
    said: str  # what it is, in words
    why: str  # what moved too little for it; empty where nothing did
    do: str  # what would make it better

    @property
    def excess(self) -> float:
        """How many times the limit up to which it passes it is, or that limit is the value where it is a least one."""
        value, limit = (self.passes, self.value) if self.passes > self.poor else (self.value, self.passes)
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
class Verdict:
    """What to think of a calibration.

    Parameters
    ----------
    grade : the worst of all findings
    findings : in the order of the results; those that pass as well
    motion : what moved
    directions : of lengths and mounts jointly, best seen first
    rank, determined, unknowns : directions seen at all, told better than before, and all
    condition : largest over smallest standard deviation after the motion, each in units of that before
    """

    grade: Grade
    findings: tuple[Finding, ...]
    motion: Motion
    directions: tuple[Direction, ...]
    rank: int
    determined: int
    unknowns: int
    condition: float

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """What keeps it from passing, the worst first."""
        wanting = [finding for finding in self.findings if finding.grade != "pass"]
        return tuple(sorted(wanting, key=lambda f: (f.grade != "fail", -f.excess)))

    def in_words(self) -> list[str]:
        """What keeps it from passing, a line for each remedy."""
        lines: dict[str, list[Finding]] = {}
        for finding in self.reasons:
            lines.setdefault(finding.do or finding.said, []).append(finding)
        said = []
        for same in lines.values():
            worst = "fail" if any(f.grade == "fail" for f in same) else "poor"
            what = ", ".join(f.said for f in same)
            why = next((f": {f.why}" for f in same if f.why and f.why not in what), "")
            do = f"; {same[0].do}" if same[0].do else ""
            said.append(f"{worst}: {what}{why}{do}")
        return said


def judge(calibration: Calibration) -> Verdict:
    """The verdict on a calibration, with what was and was not seen."""
    motion = _motion(calibration)
    findings = _labels(calibration)
    if not calibration.labels.moved:  # of another arrangement of sensors nothing else means anything
        findings += [*_deviations(calibration, motion), *_left_over(calibration)]
    directions = _directions(calibration)
    after = np.array([1.0 / (1.0 + d.information) for d in directions])
    return Verdict(
        grade=max((f.grade for f in findings), key=GRADES.index),
        findings=tuple(findings),
        motion=motion,
        directions=directions,
        rank=sum(d.information > SEEN for d in directions),
        determined=sum(d.information > 1.0 for d in directions),
        unknowns=len(directions),
        condition=float(np.sqrt(after.max() / after.min())) if len(after) else float("nan"),
    )


def _finding(name: str, value: float, limits: Limits, unit: str, said: str, do: str, why: str = "") -> Finding:
    grade = limits.grade(value)
    return Finding(name, grade, float(value), float(limits.passes), float(limits.poor), unit, said, why, do)


def _labels(calibration: Calibration) -> list[Finding]:
    """Sensors that sit elsewhere than labelled, and mounts that cannot be."""
    labels = calibration.labels
    names = "the names of the sensors in the session, and that every strap held"
    found = [
        _finding(
            "anatomy",
            labels.doubt,
            DOUBT,
            "of the limit",
            labels.said() or "elbows bend forward, hands are before the body",
            "" if labels.moved else f"check {names}",
        )
    ]
    for text in calibration.contradicted:
        found.append(Finding("mount", "poor", 1.0, 0.0, 1.0, "contradicted", text, "", ""))
    return found


def _deviations(calibration: Calibration, motion: Motion) -> list[Finding]:
    subject = calibration.subject
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
    parts = {
        "upper_arms": (
            "upper-arm lengths",
            {s: std(f"{s}_upper_arm") for s in sides},
            ("sideways", "elevation", "elbow"),
        ),
        "forearms": (
            "forearm + hand lengths",
            {s: std(f"{s}_forearm", f"{s}_hand") for s in sides},
            ("sideways", "elbow", "elevation"),
        ),
        "shoulder_width": ("the shoulder width", {"": std("shoulder_width")}, ("sideways", "elevation")),
    }
    for name, (what, each, causes) in parts.items():
        if each and calibration.closure in ADVICE:  # without a closure lengths are the average person's
            side = max(each, key=lambda s: each[s])
            why, do = _cause(calibration, motion, causes, [side] if side else sides)
            if not side and ADVICE[calibration.closure].width:
                why, do = "", ADVICE[calibration.closure].width
            said = f"{what} ± {1e3 * each[side]:.0f} mm"
            found.append(_finding(name, each[side], LENGTH, "m", said, do, why))
    for segment in (s for s in subject.mounts if f"mounts.{s}.z" in subject.order):
        value = subject.std(f"mounts.{segment}.z")
        torso = segment == "torso"
        causes = ("lean", "twist", "sideways") if torso else ("sideways", "elevation", "elbow")
        own = [s for s in SIDES if segment.startswith(s)]
        why, do = _cause(calibration, motion, causes, own or sides)
        said = f"heading of the {segment.replace('_', ' ')} sensor ± {np.degrees(value):.1f} deg"
        limits = TORSO_HEADING if torso else HAND_HEADING if segment.endswith("hand") else ARM_HEADING
        if len(calibration.hinge_rms) < 2:
            limits = LONE_HEADING
        found.append(_finding(f"heading.{segment}", value, limits, "rad", said, do, why))
    whose = "" if calibration.subject.note.count("taped") else ": nothing was taped, it is the average person's"
    found.append(
        _finding(
            "scale",
            calibration.scale_std,
            SCALE,
            "relative",
            f"all lengths together ± {100 * calibration.scale_std:.1f} %{whose}",
            f"tape one length and give it, as in --measured {calibration.tape}",
        )
    )
    return found


def _cause(calibration: Calibration, motion: Motion, causes: tuple[str, ...], sides: list[str]) -> tuple[str, str]:
    """Why something is uncertain, as a clause, and what to do: what moved least of what it needs."""
    if calibration.closure not in ADVICE:
        return "", POSED

    def of(values: Mapping[str, Range]) -> float:
        return min((values[side].size for side in sides if side in values), default=np.nan)

    size = {
        "elevation": of(motion.elevation),
        "sideways": of(motion.sideways),
        "elbow": of(motion.elbow),
        "lean": motion.lean,
        "twist": motion.twist.size if motion.twist else np.nan,
    }
    advice = ADVICE[calibration.closure]
    seen = {name: size[name] for name in causes if np.isfinite(size[name])}
    least = min(seen, key=lambda name: seen[name] / ENOUGH[name], default="")
    if least and seen[least] < ENOUGH[least]:
        why, do = advice.moved[least]
        return why.format(seen[least]), do
    if calibration.independent < ENOUGH_LOOKS:
        return f"the motion is worth {calibration.independent:.0f} independent looks only", advice.longer
    return "", "move further and faster, through all of the reach"


def _left_over(calibration: Calibration) -> list[Finding]:
    closed = np.isfinite(calibration.gap)
    found = []
    if calibration.closure in ADVICE:
        advice = ADVICE[calibration.closure]
        gap, looks = calibration.rms_gap, calibration.independent
        share = float(np.mean(calibration.kept[closed] < TOUCHED))
        found += [
            _finding("gap", gap, GAP, "m", advice.gap.format(1e3 * gap), advice.closer),
            _finding(
                "motion",
                looks,
                SAMPLES,
                EFFECTIVE,
                f"the motion is worth {looks:.0f} independent looks only",
                advice.longer,
            ),
            _finding("apart", share, APART, "share", advice.apart.format(100 * share), advice.together),
        ]
    tilts = {name: float(np.linalg.norm(tilt)) for name, tilt in calibration.start_tilt.items()}
    if tilts:
        name = max(tilts, key=lambda n: tilts[n])
        found.append(
            _finding(
                "start_pose",
                tilts[name],
                TILT,
                "rad",
                f"the {name.replace('_', ' ')} was {np.degrees(tilts[name]):.0f} deg off in the start pose",
                "stand upright in the start pose, arms hanging straight down",
            )
        )
    for name, tape in calibration.tapes.items():
        found.append(
            _finding(
                f"tape.{name}",
                tape.off,
                TAPE,
                "std of what is known without it",
                tape.said(name),
                "measure it anew, and check --stature and --sex",
            )
        )
    if any(tape.off > TAPE.passes for tape in calibration.tapes.values()):
        return found  # all lengths have followed a tape that is wrong
    prior, subject = calibration.prior, calibration.subject
    z = {n: abs(subject.lengths[n] - prior.lengths[n]) / prior.std(n) for n in LENGTHS if n not in calibration.gauge}
    name = max(z, key=lambda n: z[n])
    found.append(
        _finding(
            "person",
            z[name],
            UNUSUAL,
            "std of the average person",
            f"{name} = {1e3 * subject.lengths[name]:.0f} mm is {z[name]:.1f} standard deviations from the average",
            "check --stature, the gauge and that every sensor sits where the session says",
        )
    )
    return found


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
UNSEEN = ("upper_arms", "forearms", "shoulder_width", "scale", "heading.")  # findings on what the motion left open


def document(calibration: Calibration, verdict: Verdict) -> dict[str, Any]:
    """What ``calibration.json`` holds; lengths [m], angles [deg], times [s]."""
    subject = calibration.subject
    stride = -(-len(calibration.time) // MOST_POINTS)
    some = slice(None, None, stride)
    return {
        "verdict": verdict.grade,
        "reasons": verdict.in_words(),
        "findings": verdict.findings,
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
            "unknowns": verdict.unknowns,
            "rank": verdict.rank,
            "determined": verdict.determined,
            "condition": _number(verdict.condition),
            "directions": verdict.directions,
        },
        "motion_deg": verdict.motion,
        "unseen": [f"{f.said}: {f.why}" if f.why else f.said for f in verdict.reasons if f.name.startswith(UNSEEN)],
        "labels": {
            "doubt": _number(calibration.labels.doubt),
            "said": calibration.labels.said(),
            "moved": dict(calibration.labels.moved),
        },
        "warnings": list(calibration.warnings),
    }


def apart(calibration: Calibration) -> list[tuple[float, float]]:
    """From when to when [s] the palms were apart."""
    gone = np.isfinite(calibration.gap) & (calibration.kept < TOUCHED)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], gone.view(np.int8), [0]))))
    time = calibration.time
    return [
        (round(float(time[a]), 3), round(float(time[b - 1]), 3)) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _number(value: float) -> float | None:
    """None where it is not finite, which JSON cannot say."""
    return float(value) if np.isfinite(value) else None
