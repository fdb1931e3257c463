"""`TrackSummary`: what a tracked recording is worth saying in ``summary.json``, to the user and on its pages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..body.kinematics import Pose, join_poses
from ..diagnostics import INFO, WARNING, Diagnostic, as_json, drop_consequences, gravest_first, merge
from ..filters import STATIC_ONLY, Orientation, join_orientations
from ..recording import Recording
from ..recording.gaps import find_runs
from .heading_problem import find_start_variances
from .measures import (
    PEAK_OVER_S,
    Signal,
    TipMotion,
    compute_error_budget,
    compute_heading_stds,
    compute_joint_heading_stds,
    find_samples_after_start,
    finite_max,
    longest_run_s,
    measure_hinge,
    measure_signal,
    measure_tips,
)
from .result import TrackResult

MOST_SAMPLES = 50_000  # that pages show; a longer recording is decimated to fewer than twice as many
# Limits of the diagnostics
MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment
BIAS_LARGE = np.deg2rad(1.5)  # [rad/s], three times what is usual from the factory
LITTLE_STATIC, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
HEADING = np.deg2rad(10.0)  # one standard deviation of the drift between the segments of a joint
# Correction of a heading: beyond this, and beyond so many standard deviations of what start pose and mount leave open.
# In four walks of the preset `people`, whose start poses are as people hold them, it is at most 2.1 of them.
TURNED, TURNED_STDS = np.deg2rad(10.0), 2.5
# Beyond the range of a hinge while it extends: in the start pose a hanging elbow is bent by 5 to 15 deg.
RANGE_MARGIN = np.deg2rad(5.0)
BENT, ASIDE = np.deg2rad(20.0), float(np.deg2rad(30.0))  # a hinge that is bent so far shows the plane in which it bends
LASTING_S = 1.0


@dataclass(frozen=True)
class TrackSummary:
    """The summary of a tracked recording: what ``summary.json``, the user and the pages are told."""

    content: dict[str, Any]  # of ``summary.json``: inputs, options and results
    diagnostics: tuple[Diagnostic, ...]  # what the user should know, the gravest first; `content` has them too
    tracked: TrackResult  # the samples that pages show, as if the recording had been so slow
    samples: int  # of the recording
    rate_hz: float  # of its samples
    steps_ms: tuple[float, float]  # shortest and longest step between samples
    signals: Mapping[str, Signal]  # of each sensor
    headings: Mapping[str, np.ndarray]  # segment → (n,) [rad] one standard deviation, where the filter has a covariance
    tips: Mapping[str, TipMotion]  # of each point whose path is drawn
    error_budget: Mapping[str, Mapping[str, float]]  # as `compute_error_budget`


def summarize(tracked: TrackResult) -> TrackSummary:
    """The summary of a recording that was tracked as a whole."""
    accumulator = SummaryAccumulator(tracked.recording)
    accumulator.add(tracked)
    return accumulator.finish()


class SummaryAccumulator:
    """The summary of a recording that is tracked in chunks, each added as it comes.

    Parameters
    ----------
    recording : the whole one

    Attributes
    ----------
    last : the last chunk
    """

    last: TrackResult

    def __init__(self, recording: Recording) -> None:
        self._recording, self._every = recording, max(1, len(recording) // MOST_SAMPLES)
        self._samples = 0
        self._poses: list[Pose] = []  # decimated, as the orientations
        self._orientations: dict[str, list[Orientation]] = {}
        self._static: dict[str, list[np.ndarray]] = {}
        self._peak_speed: dict[str, float] = {}  # [m/s] of each tip
        self._residual: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._joints: dict[str, tuple[float, float]] = {}  # of a mechanism: least and most

    def accumulate(self, chunks: Iterable[TrackResult]) -> Iterator[TrackResult]:
        """Iterate over chunks, and add each."""
        for chunk in chunks:
            self.add(chunk)
            yield chunk

    def add(self, tracked: TrackResult) -> None:
        """Add the next chunk."""
        rows = slice(-self._samples % self._every, None, self._every)
        self._poses.append(tracked.pose.cut(rows))
        for segment, orientation in tracked.segments.orientation.items():
            self._static.setdefault(segment, []).append(orientation.static)
            self._orientations.setdefault(segment, []).append(orientation.take(rows))
        rate_hz, pose = tracked.recording.rate_hz, tracked.pose
        if self._samples:  # from the chunk before into this one
            pose = join_poses([self.last.pose.cut(slice(-max(1, round(PEAK_OVER_S * rate_hz)), None)), pose])
        for name, tip in measure_tips(pose, rate_hz, tracked.model.table).items():
            self._peak_speed[name] = max(self._peak_speed.get(name, 0.0), tip.peak_speed)
        for segment, angle in tracked.compute_orientation_residuals().items():
            self._residual[segment] = self._residual.get(segment, 0.0) + float(np.sum(angle**2))
        for name, values in tracked.joints.items() if tracked.model.table.is_mechanism else ():
            least, most = self._joints.get(name, (np.inf, -np.inf))
            self._joints[name] = float(np.minimum(least, values.min())), float(np.maximum(most, values.max()))
        self._samples += len(tracked.time)
        self.last = tracked

    def finish(self) -> TrackSummary:
        """The summary, after the last chunk."""
        last, n, every = self.last, len(self._recording), self._every
        recording = self._recording.cut(slice(n - self._samples, n))
        orientation = {segment: join_orientations(parts) for segment, parts in self._orientations.items()}
        static = {segment: np.concatenate(parts) for segment, parts in self._static.items()}
        shown = replace(
            recording,
            time=recording.time[::every],
            rate_hz=recording.rate_hz / every,
            sensors={name: sensor.part(slice(None, None, every)) for name, sensor in recording.sensors.items()},
        )
        source = replace(last.segments, recording=shown, orientation=orientation)
        tracked = replace(last, pose=join_poses(self._poses), source=source)
        residual_rms = {name: float(np.sqrt(squares / self._samples)) for name, squares in self._residual.items()}
        signals = {
            name: measure_signal(recording, name, orientation.get(name), static.get(name), every)
            for name in recording.sensors
        }
        stds, drifts = compute_heading_stds(tracked)
        tips = measure_tips(tracked.pose, tracked.recording.rate_hz, tracked.model.table)
        diagnostics = (*last.segments.diagnostics, *last.model.diagnostics, *_diagnose_model(last, residual_rms))
        diagnostics = merge(diagnostics, _diagnose_motion(tracked, signals, drifts))
        ordered = tuple(gravest_first(drop_consequences(diagnostics)))
        budget, steps = compute_error_budget(tracked), 1e3 * np.diff(recording.time)
        return TrackSummary(
            content=self._compose(recording, static, residual_rms, budget, ordered),
            diagnostics=ordered,
            tracked=tracked,
            samples=len(recording),
            rate_hz=recording.rate_hz,
            steps_ms=(float(steps.min()), float(steps.max())),
            signals=signals,
            headings=stds,
            tips={name: tip._replace(peak_speed=self._peak_speed[name]) for name, tip in tips.items()},
            error_budget=budget,
        )

    def _compose(
        self,
        recording: Recording,
        static: Mapping[str, np.ndarray],
        residual_rms: Mapping[str, float],
        budget: Mapping[str, Mapping[str, float]],
        diagnostics: Iterable[Diagnostic],
    ) -> dict[str, Any]:
        """Compose the content of ``summary.json``; `recording` is what was tracked of it."""
        last = self.last
        table, correction, segments = last.model.table, last.correction, last.segments
        sensors: dict[str, Any] = {}
        for segment, sensor in recording.sensors.items():
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(segments.heading_offset[segment])), 3)}
            orientation = segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(int(np.count_nonzero(static[segment])) / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if sensor.gap is not None:
                about["gaps"] = len(find_runs(sensor.gap))
                about["gap_s"] = round(int(np.count_nonzero(sensor.gap)) / recording.rate_hz, 3)
            sensors[segment] = about
        content = {
            "recording": last.recording.name,
            "session": str(last.recording.source) if last.recording.source else None,
            "method": last.options["method"] if segments.orientation else "measured orientations",
            "causal": last.options["causal"],
            "model": last.model.robot.name,
            "subject": {"name": last.subject.name, "note": last.subject.note},
            "samples": self._samples,
            "rate_hz": round(last.recording.rate_hz, 4),
            "duration_s": round(float(recording.time[-1] - recording.time[0]), 3),
            "phases": {"start": list(segments.start), "static": list(segments.static_phase)},
            "sensors": sensors,
            "points": sorted(last.points),
            "orientation_residual_rms_deg": {name: round(float(np.degrees(v)), 3) for name, v in residual_rms.items()},
        }
        if table.is_mechanism:
            content |= {
                "start_joints": dict(table.poses.get(recording.start_pose, recording.joints)),  # others are at zero
                "joints": {
                    name: {"min": round(least, 5), "max": round(most, 5)}
                    for name, (least, most) in self._joints.items()
                },
                "undetermined_joints": last.find_undetermined_joints(),
            }
        return content | {
            "heading_correction": None if correction is None else correction.summarize(),
            "error_budget_mm": {
                point: {part: round(1e3 * std, 1) for part, std in parts.items()} for point, parts in budget.items()
            },
            "diagnostics": [as_json(diagnostic) for diagnostic in diagnostics],
        }


# Diagnostics ----------------------------------------------------------------------------------------------------------


def _diagnose_model(tracked: TrackResult, residual_rms: dict[str, float]) -> Iterator[Diagnostic]:
    table = tracked.model.table
    missing = [point for point in table.points if point not in tracked.points]
    lacking = [name for name in table.needed if name not in tracked.quat_WL]
    if missing and lacking:
        yield Diagnostic("sensors-missing", INFO, facts={"segments": ", ".join(lacking), "points": ", ".join(missing)})
    if joints := tracked.find_undetermined_joints():
        facts = {"variant": "joints", "joints": ", ".join(joints)}
        yield Diagnostic("sensors-missing", WARNING, facts=facts)
    for segment, rms in residual_rms.items():
        if rms > MOST_RESIDUAL:
            yield Diagnostic("orientation-residual", WARNING, segment, rms, MOST_RESIDUAL)


def _diagnose_motion(
    tracked: TrackResult, signals: Mapping[str, Signal], drifts: Mapping[str, np.ndarray]
) -> Iterator[Diagnostic]:
    """The diagnostics of signals, headings, start pose and hinges."""
    for name, signal in signals.items():
        yield from _diagnose_signal(tracked, name, signal)
    since, start = find_samples_after_start(tracked), tracked.segments.start
    joints = compute_joint_heading_stds(drifts, tracked.model)
    wide = {joint: most for joint, std in joints.items() if (most := finite_max(std[since])) > HEADING}
    for joint in sorted(wide, key=wide.__getitem__, reverse=True):
        yield Diagnostic("heading-uncertain", WARNING, joint, wide[joint], HEADING)
    corrections = {} if tracked.correction is None else tracked.correction.max_correction_deg
    for name, turned_deg in corrections.items():
        start_var = sum(find_start_variances(tracked.recording, name, tracked.subject, tracked.model))
        limit = max(TURNED, TURNED_STDS * float(np.sqrt(start_var)))
        if (turned := float(np.deg2rad(turned_deg))) > limit:
            yield Diagnostic("heading-corrected-far", WARNING, name, turned, limit)
    if (late := float(start[0] - tracked.time[0])) > LATE_START_S:
        yield Diagnostic("start-pose-late", INFO, "", late, LATE_START_S)
    subject = replace(tracked.subject, hinges=tracked.subject.turn_hinges(tracked.model))
    for name, hinge in tracked.model.table.hinges.items():
        motion = measure_hinge(tracked.pose, tracked.model.table, name, subject)
        if motion is None:
            continue
        bend, flexion, aside = motion[0], motion[1], np.abs(motion[2])
        extended = min(float(np.sign(sum(hinge.range) or 1.0)) * end for end in hinge.range) - RANGE_MARGIN
        back = (aside < np.deg2rad(45.0)) & (flexion < extended) & (bend < np.deg2rad(90.0))
        if (seconds := np.count_nonzero(back) / tracked.recording.rate_hz) > LASTING_S:
            most, facts = float(-flexion[back].min()), {"duration": seconds}
            yield Diagnostic("hinge-implausible", WARNING, name, most, -extended, facts)
        sideways = (bend > BENT) & (aside > ASIDE)
        if np.count_nonzero(sideways) / tracked.recording.rate_hz > LASTING_S:
            most = float(aside[sideways].max())
            yield Diagnostic("hinge-implausible", WARNING, name, most, ASIDE, {"variant": "sideways"})


def _diagnose_signal(tracked: TrackResult, name: str, signal: Signal) -> Iterator[Diagnostic]:
    rate_hz = tracked.recording.rate_hz
    if signal.cut.any():
        yield Diagnostic("signal-saturated", WARNING, name, np.count_nonzero(signal.cut) / rate_hz)
    largest_bias = 0.0 if signal.bias is None else float(np.linalg.norm(signal.bias, axis=1).max())
    if largest_bias > BIAS_LARGE:
        yield Diagnostic("gyro-bias-large", INFO, name, largest_bias, BIAS_LARGE)
    if signal.static is not None:
        share, seconds = float(signal.static.mean()), longest_run_s(~signal.static, rate_hz)
        if seconds > LONG_MOTION_S or share < LITTLE_STATIC:
            severity = WARNING if tracked.options["method"] in STATIC_ONLY else INFO
            yield Diagnostic("static-phases-rare", severity, name, share, LITTLE_STATIC, {"longest": seconds})
