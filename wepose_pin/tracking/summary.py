"""`TrackSummary`: what a tracked recording is worth saying in ``summary.json``, to the user and on its pages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..body.kinematics import Pose, join_poses
from ..diagnostics import INFO, WARNING, Diagnostic, as_json, drop_consequences, gravest_first, merge
from ..errors import BadData, reason
from ..filters import Orientation, join_orientations
from ..recording import Recording
from ..recording.gaps import find_runs
from .error_budget import ErrorBudget
from .headings import HeadingCorrection
from .measures import PEAK_OVER_S, Measures, measure, measure_tips
from .pose_diagnostics import diagnose_pose
from .result import TrackResult

MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment
MOST_SAMPLES = 50_000  # that pages show; a longer recording is decimated to fewer than twice as many


@dataclass(frozen=True)
class TrackSummary:
    """The summary of a tracked recording.

    Parameters
    ----------
    content : of ``summary.json``: inputs, options and results
    diagnostics : what the user should know, the gravest first; `content` has them too
    tracked : the samples that pages show, as if the recording had been so slow
    measures : what pages state; None: it could not be measured
    """

    content: dict[str, Any]
    diagnostics: tuple[Diagnostic, ...]
    tracked: TrackResult
    measures: Measures | None


def summarize(tracked: TrackResult) -> TrackSummary:
    """The summary of a recording that was tracked as a whole."""
    accumulator = SummaryAccumulator(tracked.recording)
    accumulator.add(tracked)
    return accumulator.finish()


class SummaryAccumulator:
    """The summary of a recording that is tracked in chunks, each added as it comes; it does not depend on the chunks.

    Parameters
    ----------
    recording : the whole one
    """

    def __init__(self, recording: Recording) -> None:
        self._recording, self._every = recording, max(1, len(recording) // MOST_SAMPLES)
        self._last: TrackResult | None = None
        self._samples = 0
        self._poses: list[Pose] = []  # decimated, as the orientations
        self._orientations: dict[str, list[Orientation]] = {}
        self._static: dict[str, list[np.ndarray]] = {}
        self._peak_speed: dict[str, float] = {}  # of each tip, where poses are decimated
        self._residual: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._ranges: dict[str, tuple[float, float]] = {}  # joint of a mechanism → least and largest value [rad or m]
        self._error_budget = ErrorBudget()

    @property
    def last(self) -> TrackResult:
        """The last chunk.

        Raises
        ------
        BadData
            No chunk was added.
        """
        if self._last is None:
            raise BadData("no chunk was tracked: there is nothing to summarise")
        return self._last

    def accumulate(self, chunks: Iterable[TrackResult]) -> Iterator[TrackResult]:
        """Iterate over chunks, and add each."""
        for chunk in chunks:
            self.add(chunk)
            yield chunk

    def add(self, tracked: TrackResult) -> None:
        """Add the next chunk."""
        rows = (
            np.arange(-self._samples % self._every, len(tracked.time), self._every) if self._every > 1 else slice(None)
        )
        self._poses.append(tracked.pose.cut(rows))
        for segment, orientation in tracked.segments.orientation.items():
            self._static.setdefault(segment, []).append(orientation.static)
            self._orientations.setdefault(segment, []).append(orientation.take(rows))
        if self._every > 1:
            self._add_peak_speeds(tracked)
        for segment, angle in tracked.compute_orientation_residuals().items():
            self._residual[segment] = self._residual.get(segment, 0.0) + float(np.sum(angle**2))
        for joint, values in tracked.joints.items():
            low, high = self._ranges.get(joint, (np.inf, -np.inf))
            self._ranges[joint] = min(low, float(values.min())), max(high, float(values.max()))
        self._error_budget.add(tracked)
        self._samples += len(tracked.time)
        self._last = tracked

    def _add_peak_speeds(self, tracked: TrackResult) -> None:
        """Take the highest speeds within a chunk, and from the one before into it."""
        poses, size = [tracked.pose], max(1, round(PEAK_OVER_S * tracked.recording.rate_hz))
        if self._last is not None:
            poses.append(join_poses([self._last.pose.cut(slice(-size, None)), tracked.pose.cut(slice(size))]))
        for pose in poses:
            for name, tip in measure_tips(pose, tracked.recording.rate_hz, tracked.model.table).items():
                self._peak_speed[name] = max(self._peak_speed.get(name, 0.0), tip.peak_speed)

    def finish(self) -> TrackSummary:
        """The summary, after the last chunk.

        Raises
        ------
        BadData
            No chunk was added.
        """
        tracked, recording = self._decimate()
        measures = None
        try:  # hours of tracking are not lost by what only assesses them
            static = {segment: np.concatenate(parts) for segment, parts in self._static.items()}
            budget = self._error_budget.summarize()
            measures = measure(tracked, recording, static, budget, self._peak_speed)
            of_motion = diagnose_pose(tracked, measures)
        except Exception as error:
            facts = {"variant": "checks", "reason": reason(error)}
            of_motion = [Diagnostic("output-incomplete", WARNING, facts=facts)]
        diagnostics = tuple(gravest_first(drop_consequences(merge(self._diagnose(), of_motion))))
        return TrackSummary(self._compose(recording, diagnostics), diagnostics, tracked, measures)

    def _decimate(self) -> tuple[TrackResult, Recording]:
        """Return what pages show, and the tracked part of the recording with all samples."""
        last, n = self.last, len(self._recording)
        recording = self._recording.cut(slice(n - self._samples, n))
        orientation = {segment: join_orientations(parts) for segment, parts in self._orientations.items()}
        shown = replace(
            recording,
            time=recording.time[:: self._every],
            rate_hz=recording.rate_hz / self._every,
            sensors={name: sensor.part(slice(None, None, self._every)) for name, sensor in recording.sensors.items()},
        )
        tracked = replace(
            last,
            pose=join_poses(self._poses),
            source=replace(last.segments, recording=shown, orientation=orientation),
        )
        return tracked, recording

    def _compose(self, recording: Recording, diagnostics: Iterable[Diagnostic]) -> dict[str, Any]:
        last = self.last
        sensors: dict[str, Any] = {}
        for segment, sensor in recording.sensors.items():
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(last.segments.heading_offset[segment])), 3)}
            orientation = last.segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                static = sum(int(np.count_nonzero(part)) for part in self._static[segment])
                about["static_share"] = round(static / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if sensor.gap is not None:
                about["gaps"] = len(find_runs(sensor.gap))
                about["gap_s"] = round(int(np.count_nonzero(sensor.gap)) / recording.rate_hz, 3)
            sensors[segment] = about
        residual_rms = self._residual_rms()
        return {
            "recording": last.recording.name,
            "session": str(last.recording.source) if last.recording.source else None,
            "method": last.options.method if last.segments.orientation else "measured orientations",
            "causal": last.options.causal,
            "model": last.model.robot.name,
            "subject": {"name": last.subject.name, "note": last.subject.note},
            "samples": self._samples,
            "rate_hz": round(last.recording.rate_hz, 4),
            "duration_s": round(float(recording.time[-1] - recording.time[0]), 3),
            "phases": {"start": list(last.segments.start), "static": list(last.segments.static_phase)},
            "sensors": sensors,
            "points": sorted(last.points),
            "orientation_residual_rms_deg": {name: round(float(np.degrees(v)), 3) for name, v in residual_rms.items()},
            **self._summarize_joints(),
            "heading_correction": _correction_json(last.correction),
            "error_budget_mm": {
                point: {part: round(1e3 * std, 1) for part, std in parts.items()}
                for point, parts in self._error_budget.summarize().items()
            },
            "diagnostics": [as_json(diagnostic) for diagnostic in diagnostics],
        }

    def _diagnose(self) -> tuple[Diagnostic, ...]:
        """The diagnostics of reading, alignment and model."""
        last = self.last
        variant = {"variant": "mechanism"} if last.model.table.is_mechanism else {}
        return (
            *last.segments.diagnostics,
            *_diagnose_unknown_points(last),
            *_diagnose_undetermined_joints(last),
            *(
                Diagnostic("orientation-residual", WARNING, segment, rms, MOST_RESIDUAL, variant)
                for segment, rms in self._residual_rms().items()
                if rms > MOST_RESIDUAL
            ),
            *last.model.diagnostics,
        )

    def _summarize_joints(self) -> dict[str, Any]:
        """Start configuration, ranges and undetermined joints of a mechanism; of a person nothing."""
        table, recording = self.last.model.table, self.last.recording
        if not table.is_mechanism:
            return {}
        return {
            "start_joints": dict(table.poses.get(recording.start_pose, recording.joints)),  # others are at zero
            "joints": {name: {"min": round(a, 5), "max": round(b, 5)} for name, (a, b) in self._ranges.items()},
            "undetermined_joints": self.last.find_undetermined_joints(),
        }

    def _residual_rms(self) -> dict[str, float]:
        """Segment → [rad]."""
        return {name: float(np.sqrt(squares / self._samples)) for name, squares in self._residual.items()}


def _correction_json(correction: HeadingCorrection | None) -> dict[str, Any] | None:
    """What was observed, residuals of clasp and elbows before and after, and the largest correction of each heading."""
    if correction is None:
        return None
    about: dict[str, Any] = {
        "joint_accelerations": list(correction.joint_accelerations),
        "hinges": list(correction.hinges),
        "found_clasps": [[round(value, 2) for value in span] for span in correction.found_clasps],
        "hinge_rms_deg": {
            joint: [round(v, 3) for v in values] for joint, values in correction.hinge_residual_rms_deg.items()
        },
        "largest_correction_deg": {name: round(value, 3) for name, value in correction.max_correction_deg.items()},
    }
    if correction.gap_rms_mm is not None:
        about["clasp_gap_rms_mm"] = [round(value, 2) for value in correction.gap_rms_mm]
    return about


def _diagnose_unknown_points(tracked: TrackResult) -> list[Diagnostic]:
    """The points that are unknown for lack of a sensor."""
    missing = [point for point in tracked.model.table.points if point not in tracked.points]
    lacking = [name for name in tracked.model.table.needed if name not in tracked.quat_WL]
    if not missing or not lacking:
        return []
    facts = {"segments": ", ".join(lacking), "points": ", ".join(missing)}
    return [Diagnostic("sensors-missing", INFO, facts=facts)]


def _diagnose_undetermined_joints(tracked: TrackResult) -> list[Diagnostic]:
    """The joints that sensors are too few to tell apart."""
    joints = tracked.find_undetermined_joints()
    facts = {"variant": "joints", "joints": ", ".join(joints)}
    return [Diagnostic("sensors-missing", WARNING, facts=facts)] if joints else []
