"""`Calibration`: the result of a calibration, and its quality.

Each check is one number against two limits: up to the first it passes, up to the second it is poor, beyond it fails.
The quality is the worst of them. The cause of an uncertainty is a motion that was too small: of the limbs, or of the
torso.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.subject import Quality, Subject
from ..body.table import ROOT
from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, Severity, drop_consequences, notebook_html, render
from ..recording import find_runs, format_span
from .least_squares import CONTRADICTED, MIN_CONTACT, MeasuredLength
from .problem import CalibrationProblem

QUALITIES: tuple[Quality, ...] = get_args(Quality)
SEVERITY: dict[Quality, Severity] = {"pass": INFO, "poor": WARNING, "fail": ERROR}
MOST_INTERVALS = 3  # of an open closure that are named, the longest

# One standard deviation of each result. A hand is off by about as much as its arm's lengths, and by up to 6 mm a
# degree of an arm's heading; the torso's heading moves it only as the torso leans. Soft tissue and the shoulder girdle
# move it by 30 mm an axis whatever the calibration (docs/people.md): a calibration passes that adds less than
# that, as one minute of a careful person's joined hands does on simulated people (lengths 9 to 12 mm, headings 3.4 to
# 4.1 deg).
LENGTH = 0.012, 0.020  # [m] of an upper arm, of forearm + hand, of the shoulder width, the scale apart
ARM_HEADING = np.deg2rad(4.5), np.deg2rad(7.0)  # [rad]
TORSO_HEADING = np.deg2rad(5.5), np.deg2rad(7.0)  # [rad] beyond, tissue adds to it
OTHER_HEADING = np.deg2rad(8.0), np.deg2rad(15.0)  # [rad] of a hand, or by poses, or by one arm
# Relative. It may move a hand, 0.62 m from its shoulder, by half of what tissue and girdle do, 15 mm: 2.4 %. A taped
# arm gives 1.2 %, shoulder breadth with stature and sex 2.1 %, stature and sex alone 2.6 %, the population prior 5 %.
SCALE = 0.024, 0.08
# Limits of a person's limbs, with soft tissue and headings some degrees off.
BACKWARD = 0.15  # share of samples out of a hinge's range
SIDEWAYS = np.deg2rad(14.0)  # [rad] rms of a segment off the plane in which it bends
OPEN = 0.06  # [m] rms of the gap
# [rad] by which segments turn at least, `measure_rotations`. Soft tissue alone gives people 4 deg, a minute of joined
# hands 36 to 39 deg.
LEAST_ROTATION = np.deg2rad(8.0)
# Residuals of the solution.
# [m] rms while the palms touch: wrists bend, shoulders travel. Careful simulated people have 39 mm, give or take 5, and
# those with more are no farther off.
GAP = 0.055, 0.075
APART = 0.15  # [m] rms of the gap, from which on nothing was joined
OPEN_SHARE = 0.10, 0.60  # share of samples
# [rad] of a segment in the start pose: forearms hang 13 deg outwards and 12 deg forwards, give or take 5 and 7
# (docs/people.md): 18 deg off in all, give or take 6.
TILT = np.deg2rad(35.0), np.deg2rad(45.0)
UNUSUAL = 4.0, 6.0  # standard deviations of a length from the population prior
POSED = CONTRADICTED, 8.0  # of a pose or a bow that is used, from the estimate without it
MEASURED = CONTRADICTED, 5.0  # of a measured length from the estimate without it
SAMPLES = 6.0, 2.0  # effective sample size, at least
ROTATION = LEAST_ROTATION, 0.0  # [rad] of the segments, at least
DOUBT = 1.0, 1.0  # of the limbs' motion, `measure_doubt`
# A motion smaller than this is the cause of an uncertainty: rms angle [rad] of the torso, or of the segment of a limb
# that turned least; effective sample size, of which a minute reaches 18.
ENOUGH_SPINE, ENOUGH_LIMBS = np.deg2rad(8.0), np.deg2rad(20.0)
ENOUGH_SAMPLES = 12.0


class Check(NamedTuple):
    """One number against its limits, which are lower ones where `passes` is the larger of them."""

    diagnostic: Diagnostic  # what is checked: its value, and `passes` as limit
    quality: Quality
    value: float
    passes: float  # up to which it passes
    poor: float  # up to which it is poor
    cause: Diagnostic | None  # the motion that was too small

    @property
    def excess(self) -> float:
        """The ratio of value and limit, above 1 where it does not pass."""
        value, limit = (self.passes, self.value) if self.passes > self.poor else (self.value, self.passes)
        return value / max(limit, 1e-9)


@dataclass(frozen=True)
class CalibrationQuality:
    """The quality of a calibration: its checks, and what the user should know."""

    quality: Quality = "fail"  # the worst of all checks
    checks: tuple[Check, ...] = ()  # all of them, in the order of the results
    reasons: tuple[Diagnostic, ...] = ()  # why it does not pass, the worst first, each followed by its cause
    further: tuple[Diagnostic, ...] = ()  # what else the user should know

    def __repr__(self) -> str:
        failing = sum(check.quality != "pass" for check in self.checks)
        return f"CalibrationQuality({self.quality!r}: {failing} of {len(self.checks)} checks do not pass)"

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """All that a user should know of the calibration."""
        return (*self.reasons, *self.further)


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` returns: the calibrated subject, the quality of the calibration and its diagnostics.

    It prints itself in one line, with what to do first where it does not pass. Most users need `subject`, `quality` and
    `diagnostics`; the rest is for reports. The least squares takes n samples of the recording, about 8 a second. The
    gap is the residual of the closure: the vector between the palms of joined hands, or what another protocol closes.
    """

    problem: CalibrationProblem  # that was solved, without what is not used
    subject: Subject  # calibrated
    effective_sample_size: float  # of the gap
    scale_std: float  # relative standard deviation of the common scale of all lengths; NaN: contradicted
    remarks: tuple[Diagnostic, ...]  # what is worth knowing, without what the quality says
    time: np.ndarray  # (n,) [s] of the samples
    gap: np.ndarray  # (n,) [m] size of the gap as estimated; NaN outside of closures
    contact: np.ndarray  # (n,) weight of each sample's gap, near 0 where the palms are apart
    quat_WL: Mapping[str, np.ndarray]  # segment → (n, 4) xyzw at each sample, as tracking gives it
    measured_lengths: Mapping[str, MeasuredLength]  # beside the estimates without them
    hinge_rms: Mapping[str, float] = field(default_factory=dict)  # joint → [rad] of the segment below off its plane
    exchanged: Mapping[str, str] = field(default_factory=dict)  # segment → label of the sensor on it, where they differ
    posed: Mapping[str, float] = field(default_factory=dict)  # phase of poses → standard deviations off all else
    formulation: str = "full"  # or "paper"
    quality: CalibrationQuality = field(default_factory=CalibrationQuality)

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know: the reasons of its quality first, then the remarks."""
        return self.quality.diagnostics

    @property
    def closed(self) -> np.ndarray:
        """(n,) bool: samples of a closure."""
        return np.isfinite(self.gap)

    @property
    def touching(self) -> np.ndarray:
        """(n,) bool: samples at which the palms touch."""
        return self.closed & (self.contact > MIN_CONTACT)

    @property
    def open_share(self) -> float:
        """The share of a closure's samples at which the palms were apart; 0 without a closure."""
        return float(np.mean(self.contact[self.closed] < MIN_CONTACT)) if self.closed.any() else 0.0

    @property
    def open_intervals(self) -> list[tuple[float, float]]:
        """Intervals [s] in which the palms were apart."""
        runs = find_runs(self.closed & (self.contact < MIN_CONTACT))
        return [(round(float(self.time[a]), 3), round(float(self.time[b - 1]), 3)) for a, b in runs]

    @property
    def rms_gap(self) -> float:
        """[m] root mean square of the gap's length, where the hands are joined; NaN without a closure."""
        return float(np.sqrt(np.mean(self.gap[self.touching] ** 2))) if self.touching.any() else np.nan

    def __repr__(self) -> str:
        stds = [1e3 * std for name in self.subject.lengths if np.isfinite(std := self.subject.std(name))]
        lengths = f"{len(self.subject.lengths)} lengths"
        lengths += f" ± {min(stds):.0f} to {max(stds):.0f} mm" if stds else ""
        remedy = f"; first: {render(self.quality.reasons[0])['do']}" if self.quality.reasons else ""
        return f"Calibration({self.subject.name!r}: {self.quality.quality}; {lengths}{remedy})"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics)


# Quality --------------------------------------------------------------------------------------------------------------


def assess(calibration: Calibration) -> CalibrationQuality:
    """Return the quality of a calibration."""
    problem, rotations = calibration.problem, measure_rotations(calibration)
    is_mechanism, checks = problem.model.table.is_mechanism, list[Check]()
    if not is_mechanism:
        checks.append(_check_labels(calibration))
    for mount in problem.unused_mounts:
        limits = float(mount.limit or 0.0), np.pi
        checks.append(_check(mount.code, float(mount.value or 0.0), limits, mount.place, mount.facts))
    if not problem.protocol.closures:  # nothing tells which of them is wrong
        checks += [_check("pose-contradicted", off, POSED, phase) for phase, off in calibration.posed.items()]
    if not calibration.exchanged:  # with exchanged sensors all other checks are meaningless
        checks += _check_results(calibration, rotations)
    rotation = float(np.median([*rotations.values()])) if rotations and not is_mechanism else np.inf
    if rotation < LEAST_ROTATION and any(check.quality == "fail" for check in checks):
        # All that fails follows from it.
        checks = [_check("motion-too-small", rotation, ROTATION, facts={"variant": "soft-tissue"}, quality="fail")]
    if calibration.rms_gap > APART and not calibration.exchanged:
        still = [check for check in checks if check.diagnostic.code == "motion-too-small"]
        checks = [_check("closure-gap-large", calibration.rms_gap, GAP, facts={"variant": "apart"}), *still]
    # What does not pass, the worst first; the cause of several once.
    failing = [check for check in checks if check.quality != "pass"]
    failing.sort(key=lambda check: (check.quality != "fail", -check.excess))
    by_text: dict[tuple[str, str, float | str], Diagnostic] = {}
    for each in [check.cause or check.diagnostic for check in failing]:
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
    code: str,
    value: float,
    limits: tuple[float, float],
    place: str = "",
    facts: Mapping[str, float | str] | None = None,
    cause: Diagnostic | None = None,
    quality: Quality | None = None,
) -> Check:
    """Check a value; NaN, a value that was not computed, passes. `facts` are those of the diagnostic."""
    passes, poor = limits
    sign = -1.0 if passes > poor else 1.0
    quality = quality or ("fail" if sign * value > sign * poor else "poor" if sign * value > sign * passes else "pass")
    diagnostic = Diagnostic(code, SEVERITY[quality], place, value, float(passes), facts or {})
    cause = None if cause is None else replace(cause, severity=SEVERITY[quality])
    return Check(diagnostic, quality, value, *limits, cause)


def _check_labels(calibration: Calibration) -> Check:
    """Check that sensors sit on the segments of their labels, and that the limbs move as a person's."""
    (doubt, joint), order = measure_doubt(calibration), list(calibration.problem.model.table.segments)
    pairs = sorted({tuple(sorted(pair, key=order.index)) for pair in calibration.exchanged.items()})
    if not pairs:
        return _check("limb-motion-implausible", doubt, DOUBT, joint)
    place = ", ".join(f"{a} and {b}" for a, b in pairs)
    return _check("sensors-exchanged", doubt, DOUBT, place, {"variant": "sides"} if len(pairs) > 1 else None)


def _check_results(calibration: Calibration, rotations: Mapping[str, float]) -> Iterator[Check]:
    """Check lengths and scale, headings of mounts, closures and the start pose."""
    problem, subject, contradicted = calibration.problem, calibration.subject, False
    layout, table, prior = problem.layout, problem.model.table, problem.prior
    # Lengths that begin at the root cancel in a closed chain, and are one with a point of W that is not known.
    names = [name for name, length in table.lengths.items() if ROOT not in length.start]
    lengths, shape = np.array([subject.lengths[name] for name in names]), subject.lengths_covariance(names)
    if len(names) > 1 and not layout.scale_observed:  # errors of the scale change all lengths together
        shape = shape - np.outer(lengths, lengths) / float(lengths @ np.linalg.solve(shape, lengths))
    for sensor, group in layout.length_groups.items():
        if summed := [name for name in group if name in names]:
            take = np.isin(names, summed).astype(float)
            std = float(np.sqrt(max(take @ shape @ take, 0.0)))
            cause = _find_cause(calibration, rotations, table.segments[sensor].spine)
            yield _check("length-uncertain", std, LENGTH, " + ".join(summed), cause=cause)
    if not layout.scale_observed:
        yield _check("scale-uncertain", calibration.scale_std, SCALE, facts={"measured": problem.measured_example})
    for name, own in calibration.measured_lengths.items():
        facts = {"measured": own.metres, "expected": own.expected, "std": own.std}
        yield (check := _check("length-contradicted", own.deviation, MEASURED, name, facts))
        contradicted |= check.quality != "pass"
    others = [name for name in subject.lengths if name not in problem.measured]
    if others and not contradicted and not table.is_mechanism:  # all lengths follow a wrong measured one
        z = {name: abs(subject.lengths[name] - prior.lengths[name]) / prior.std(name) for name in others}
        name = max(z, key=lambda n: z[n])
        estimated: dict[str, float | str] = {"variant": "estimated", "metres": float(subject.lengths[name])}
        yield _check("length-contradicted", z[name], UNUSUAL, name, estimated)
    for segment in () if table.is_mechanism else subject.mounts:  # of a mechanism its lengths alone tell
        if f"mounts.{segment}.z" in subject.order:
            spine = segment == table.reference
            limits = TORSO_HEADING if spine else ARM_HEADING
            if table.segments[segment].rigid_without_sensor or len(calibration.hinge_rms) < 2:
                limits = OTHER_HEADING
            std, cause = subject.std(f"mounts.{segment}.z"), _find_cause(calibration, rotations, spine)
            yield _check("mount-heading-uncertain", std, limits, segment, cause=cause)
    if problem.protocol.closures:
        yield _check("closure-gap-large", calibration.rms_gap, GAP)
        yield _check("motion-too-small", calibration.effective_sample_size, SAMPLES)
        yield _check(
            "closure-open",
            calibration.open_share,
            OPEN_SHARE,
            "",
            {"intervals": format_longest(calibration.open_intervals)},
        )
    tilts = {name: float(np.linalg.norm(own[:2])) for name, own in subject.start_pose_offset.items()}
    if tilts:
        name = max(tilts, key=tilts.__getitem__)
        yield _check("start-pose-off", tilts[name], TILT, name)


def _find_cause(calibration: Calibration, rotations: Mapping[str, float], spine: bool) -> Diagnostic | None:
    """The cause of an uncertainty: too small a motion of the torso or of the limbs, or too short a motion."""
    if not rotations:
        return None
    table = calibration.problem.model.table
    limbs = [name for name in calibration.problem.layout.length_groups if not table.segments[name].spine]
    variant, enough = ("spine", ENOUGH_SPINE) if spine else ("limbs", ENOUGH_LIMBS)
    own = [rotations[name] for name in ([table.reference] if spine else limbs) if name in rotations]
    if own and min(own) < enough and not table.is_mechanism:
        return Diagnostic("motion-too-small", WARNING, "", min(own), float(enough), {"variant": variant})
    if (size := calibration.effective_sample_size) < ENOUGH_SAMPLES:
        return Diagnostic("motion-too-small", WARNING, "", size, facts={"variant": "cause"})
    return None


def format_longest(intervals: Sequence[tuple[float, float]]) -> str:
    """The text of the longest intervals [s], in the order of time."""
    longest = sorted(intervals, key=lambda interval: interval[0] - interval[1])[:MOST_INTERVALS]
    return ", ".join(format_span(np.round(interval, 1) + 0.0) for interval in sorted(longest))  # no negative zero


def measure_rotations(calibration: Calibration) -> dict[str, float]:
    """Segment → how far it turned [rad] while the closure held, the rms angle from its mean; empty without one."""
    if not calibration.closed.any():
        return {}
    R = {name: Rotation.from_quat(quat[calibration.closed]) for name, quat in calibration.quat_WL.items()}
    return {name: float(np.sqrt(np.mean((each.mean().inv() * each).magnitude() ** 2))) for name, each in R.items()}


def measure_doubt(calibration: Calibration) -> tuple[float, str]:
    """Return the largest ratio of the limbs' motion to a limit, above 1 where a person cannot move so, and its joint.

    It is that while the closure held; without a closure, that of all samples. The gap has no joint.
    """
    table, closed = calibration.problem.model.table, calibration.closed
    samples, doubts = np.ones(len(closed), dtype=bool), [(0.0, "")]
    if closed.any():
        samples = calibration.touching
        gap = np.sqrt(np.average(calibration.gap[closed] ** 2, weights=calibration.contact[closed]))
        doubts.append((float(gap) / OPEN, ""))
    R = {name: Rotation.from_quat(quat[samples]) for name, quat in calibration.quat_WL.items()}
    for joint, hinge in table.hinges.items():
        if hinge.on in R and hinge.moves in R:
            straight, axis = np.array(table.segments[hinge.on].along), np.array(hinge.axis)
            along = (R[hinge.on].inv() * R[hinge.moves]).apply(table.segments[hinge.moves].along)
            angle = np.arctan2(np.cross(straight, along) @ axis, along @ straight)
            low, high = hinge.range
            off_plane = np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along))
            doubts.append((float(np.mean((angle < low) | (angle > high))) / BACKWARD, joint))
            doubts.append((float(off_plane) / SIDEWAYS, joint))
    doubt, joint = max(doubts, key=lambda each: each[0])
    return float(doubt), joint
