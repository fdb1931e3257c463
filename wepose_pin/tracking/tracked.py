"""`TrackedRecording`: a pose with its inputs and intermediate results, and its summary."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..alignment import SegmentOrientations, StartFrames, find_start_frames
from ..diagnostics import INFO, WARNING, Diagnostic, as_json
from ..errors import BadData, BadSession
from ..kinematics import PosedBody, compute_orientation_residuals
from ..model import BodyModel
from ..model.body import load_sensed_model
from ..model.configurations import find_undetermined_joints
from ..model.start_pose import compute_start_configuration
from ..recording import Recording
from ..subject import Subject, population_subject
from .error_budget import ErrorBudget
from .headings import HeadingCorrection
from .options import TrackOptions

MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment
_MOST_LATER = 10  # diagnostics of the later chunks of a long recording


@dataclass(frozen=True)
class TrackedRecording(PosedBody):
    """The pose of a recording or a chunk, with its inputs and intermediate results.

    Parameters
    ----------
    recording : the input; of a causal tracker the part after the start pose
    correction : of the headings so far; None where nothing can correct them
    """

    recording: Recording
    segments: SegmentOrientations
    options: TrackOptions
    correction: HeadingCorrection | None

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know."""
        return self._accumulated.diagnostics()

    def summary(self) -> dict[str, Any]:
        """The content of ``summary.json``: inputs, options and results."""
        return self._accumulated.summary()

    @cached_property
    def _accumulated(self) -> SummaryAccumulator:
        accumulator = SummaryAccumulator()
        accumulator.add(self)
        return accumulator

    def orientation_residual(self) -> dict[str, np.ndarray]:
        """Segment → angle (n,) [rad] between its measured orientation and the model's, where joints are too few."""
        return compute_orientation_residuals(self.model, self.q, self.segments.quat_WL)

    def find_undetermined_joints(self) -> list[str]:
        """The joints of a mechanism that the measured segments leave open, at least in part: they move little."""
        if not self.model.table.is_mechanism:
            return []
        return find_undetermined_joints(self.model.pin, list(self.quat_WL))


class SummaryAccumulator:
    """The summary of a recording that is tracked in chunks, each added as it comes."""

    def __init__(self) -> None:
        self._last: TrackedRecording | None = None
        self._begin, self._samples = 0.0, 0
        self._static: dict[str, int] = {}
        self._lost: dict[str, tuple[int, int, bool]] = {}  # segment → gaps, lost samples, whether the last one was
        self._residual: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._ranges: dict[str, tuple[float, float]] = {}  # joint of a mechanism → least and largest value [rad or m]
        self._later: list[Diagnostic] = []  # of reading later chunks than the first
        self._error_budget = ErrorBudget()

    @property
    def last(self) -> TrackedRecording:
        """The last chunk.

        Raises
        ------
        BadData
            No chunk was added.
        """
        if self._last is None:
            raise BadData("no chunk was tracked: there is nothing to summarise")
        return self._last

    def add(self, tracked: TrackedRecording) -> None:
        """Add the next chunk."""
        if self._last is None:
            self._begin = float(tracked.time[0])
        else:
            known = (*self._later, *tracked.segments.diagnostics)
            self._later += [each for each in tracked.recording.diagnostics if each not in known]
        self._samples += len(tracked.time)
        for segment, orientation in tracked.segments.orientation.items():
            self._static[segment] = self._static.get(segment, 0) + int(np.count_nonzero(orientation.static))
        for segment, gap in tracked.pose.gap.items():
            gaps, samples, before = self._lost.get(segment, (0, 0, False))
            begun = int(np.count_nonzero(np.diff(gap, prepend=before) & gap))
            self._lost[segment] = gaps + begun, samples + int(np.count_nonzero(gap)), bool(gap[-1])
        for segment, angle in tracked.orientation_residual().items():
            self._residual[segment] = self._residual.get(segment, 0.0) + float(np.sum(angle**2))
        for joint, values in tracked.joints.items():
            low, high = self._ranges.get(joint, (np.inf, -np.inf))
            self._ranges[joint] = min(low, float(values.min())), max(high, float(values.max()))
        self._error_budget.add(tracked)
        self._last = tracked

    def summary(self) -> dict[str, Any]:
        """As `TrackedRecording.summary`, of all chunks."""
        last = self.last
        sensors: dict[str, Any] = {}
        for segment in last.recording.sensors:
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(last.segments.heading_offset[segment])), 3)}
            orientation = last.segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(self._static[segment] / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if segment in self._lost:
                about["gaps"], lost, _ = self._lost[segment]
                about["gap_s"] = round(lost / last.recording.rate_hz, 3)
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
            "duration_s": round(float(last.time[-1]) - self._begin, 3),
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
            "diagnostics": [as_json(diagnostic) for diagnostic in self.diagnostics()],
        }

    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """As `TrackedRecording.diagnostics`, of all chunks; of later ones a day's would be too many to read."""
        last = self.last
        variant = {"variant": "mechanism"} if last.model.table.is_mechanism else {}
        more = len(self._later) - _MOST_LATER
        return (
            *last.segments.diagnostics,
            *self._later[:_MOST_LATER],
            *([Diagnostic("diagnostics-omitted", INFO, value=more)] if more > 0 else []),
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
        if not self.last.model.table.is_mechanism:
            return {}
        return {
            "start_joints": find_start_joints(self.last.model, self.last.recording),
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


def _diagnose_unknown_points(tracked: TrackedRecording) -> list[Diagnostic]:
    """The points that are unknown for lack of a sensor."""
    missing = [point for point in tracked.model.table.points if point not in tracked.points]
    lacking = [name for name in tracked.model.table.needed if name not in tracked.quat_WL]
    if not missing or not lacking:
        return []
    facts = {"segments": ", ".join(lacking), "points": ", ".join(missing)}
    return [Diagnostic("points-unknown", INFO, facts=facts)]


def _diagnose_undetermined_joints(tracked: TrackedRecording) -> list[Diagnostic]:
    """The joints that sensors are too few to tell apart."""
    joints = tracked.find_undetermined_joints()
    return [Diagnostic("joints-undetermined", WARNING, facts={"joints": ", ".join(joints)})] if joints else []


def find_start_joints(model: BodyModel, recording: Recording) -> dict[str, float]:
    """Joint → its value [rad or m] in the start pose; those that are not named are at zero."""
    return dict(model.table.poses.get(recording.start_pose, recording.joints))


@dataclass(frozen=True)
class TrackedBody:
    """The body of a recording.

    Parameters
    ----------
    subject : lengths and mounts as used
    model : the body with those lengths
    start_frames : its segment frames in the start pose
    start : (nq,) its configuration then
    """

    subject: Subject
    model: BodyModel
    start_frames: StartFrames
    start: np.ndarray


def make_body(subject: Subject | None, model: BodyModel | str | Path | None, recording: Recording) -> TrackedBody:
    """The body of a recording: `model`, else the one that the recording names, else the upper body.

    It has the subject's lengths, without a subject those of the population prior, or of a chosen model its own.

    Raises
    ------
    WeposeError
        A body that cannot be read; sensors, a start pose or lengths that are not its own.
    """
    where = recording.where()
    chosen = model or recording.model or None
    body = chosen if isinstance(chosen, BodyModel) else load_sensed_model(chosen, recording.sensors, where)
    body.table.check_segments(recording.sensors, f"{where}: sensors.", BadSession)
    start_frames = find_start_frames(body, recording)
    person = subject or population_subject(body=body)
    person.check_body(body.table)
    if subject is None and chosen is not None:  # a chosen model has its person's lengths
        person = replace(person, name=body.robot.name, lengths=body.lengths, note="lengths of the model")
    body = person.shape(body)
    start = compute_start_configuration(body, recording.start_pose, recording.joints, where)
    return TrackedBody(person, body, start_frames, start)
