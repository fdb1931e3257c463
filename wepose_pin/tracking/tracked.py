"""`TrackedPose`: a pose with all that led to it, and what is to be said of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..alignment import Segments
from ..diagnostics import INFO, WARNING, Diagnostic, as_json, unclassified
from ..model import POINTS, BodyModel, load_model
from ..pose import Pose, Poser, deviation, point_covariance
from ..recording import SEGMENTS, Recording
from ..subject import Subject, average_subject
from .headings import Reset

MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment
_MOST_NOTES = 10  # of the later pieces of a long recording


@dataclass(frozen=True)
class TrackedPose(Pose):
    """A `Pose` with all that led to it."""

    recording: Recording | None = None
    subject: Subject | None = None
    model: BodyModel | None = None
    segments: Segments | None = None
    method: str = ""
    reset: Reset | None = None
    causal: bool = False

    def summary(self) -> dict[str, Any]:
        """What was run on what, in numbers and words, for ``summary.json``."""
        tally = Tally()
        tally.add(self)
        return tally.summary()

    def not_followed(self) -> dict[str, np.ndarray]:
        """Segment → angle (n,) [rad] between its measured orientation and the model's, where joints are too few."""
        if self.model is None or self.q is None:
            return {}
        return deviation(self.model, self.q, self.quat_WL)


class Tally:
    """The summary of a pose that comes in pieces, each added as it comes."""

    def __init__(self) -> None:
        self.last: TrackedPose | None = None
        self._begin, self._samples = 0.0, 0
        self._still: dict[str, int] = {}
        self._lost: dict[str, tuple[int, int, bool]] = {}  # segment → gaps, lost samples, whether the last one was
        self._missed: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._notes: list[str] = []  # what was said while reading, later than in the first piece

    def add(self, pose: TrackedPose) -> None:
        """The next piece."""
        assert pose.recording is not None
        assert pose.segments is not None
        if self.last is None:
            self._begin = float(pose.time[0])
        else:
            known = (*self._notes, *pose.segments.warnings)
            self._notes += [note for note in pose.recording.notes if note not in known]
        self._samples += len(pose.time)
        for segment, of in pose.segments.orientation.items():
            self._still[segment] = self._still.get(segment, 0) + int(np.count_nonzero(of.static))
        for segment, gap in pose.gap.items():
            gaps, samples, before = self._lost.get(segment, (0, 0, False))
            begun = int(np.count_nonzero(np.diff(gap, prepend=before) & gap))
            self._lost[segment] = gaps + begun, samples + int(np.count_nonzero(gap)), bool(gap[-1])
        for segment, angle in pose.not_followed().items():
            self._missed[segment] = self._missed.get(segment, 0.0) + float(np.sum(angle**2))
        self.last = pose

    def summary(self) -> dict[str, Any]:
        """As `TrackedPose.summary`, of all pieces."""
        last = self.last
        assert last is not None
        assert last.recording is not None
        assert last.subject is not None
        assert last.segments is not None
        sensors: dict[str, Any] = {}
        for segment in last.recording.sensors:
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(last.segments.heading[segment])), 3)}
            orientation = last.segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(self._still[segment] / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if segment in self._lost:
                about["gaps"], lost, _ = self._lost[segment]
                about["gap_s"] = round(lost / last.recording.rate_hz, 3)
            sensors[segment] = about
        residual_rms = {name: float(np.sqrt(squares / self._samples)) for name, squares in self._missed.items()}
        diagnostics = [
            *map(unclassified, last.segments.warnings),
            *self._later(),
            *_not_known(last),
            *(
                Diagnostic("orientation-residual", WARNING, segment, rms, MOST_RESIDUAL)
                for segment, rms in residual_rms.items()
                if rms > MOST_RESIDUAL
            ),
            *(last.model.diagnostics if last.model else ()),
        ]
        return {
            "recording": last.recording.name,
            "session": str(last.recording.source) if last.recording.source else None,
            "method": last.method if last.segments.orientation else "ready orientations",
            "causal": last.causal,
            "model": last.model.robot.name if last.model else None,
            "subject": {"name": last.subject.name, "note": last.subject.note},
            "samples": self._samples,
            "rate_hz": round(last.recording.rate_hz, 4),
            "duration_s": round(float(last.time[-1]) - self._begin, 3),
            "phases": {"start": list(last.segments.start), "still": list(last.segments.still)},
            "sensors": sensors,
            "points": sorted(last.points),
            "not_followed_rms_deg": {name: round(float(np.degrees(v)), 3) for name, v in residual_rms.items()},
            "headings_held_together": _held_together(last.reset),
            "diagnostics": [as_json(diagnostic) for diagnostic in diagnostics],
        }

    def _later(self) -> list[Diagnostic]:
        """Those of later pieces; a day's would be too many to read."""
        found, more = [unclassified(note) for note in self._notes[:_MOST_NOTES]], len(self._notes) - _MOST_NOTES
        return [*found, Diagnostic("diagnostics-omitted", INFO, value=more)] if more > 0 else found


def _held_together(reset: Reset | None) -> dict[str, Any] | None:
    """Residuals of clasp and elbows before and after, and how far each heading was turned."""
    if reset is None:
        return None
    about: dict[str, Any] = {
        "hinge_rms_deg": {side: [round(v, 3) for v in values] for side, values in reset.hinge_deg.items()},
        "largest_turn_deg": {name: round(value, 3) for name, value in reset.largest_deg.items()},
    }
    if reset.clasp_mm is not None:
        about["clasp_gap_rms_mm"] = [round(value, 2) for value in reset.clasp_mm]
    return about


def _not_known(pose: TrackedPose) -> list[Diagnostic]:
    """The points that have no place for want of a sensor."""
    missing = [point for point in POINTS if point not in pose.points]
    lacking = [name for name in SEGMENTS[:5] if name not in pose.quat_WL]
    if not missing or not lacking:
        return []
    facts = {"segments": ", ".join(lacking), "points": ", ".join(missing)}
    return [Diagnostic("points-unknown", INFO, facts=facts)]


def tracked_pose(
    recording: Recording,
    segments: Segments,
    subject: Subject | None,
    model: BodyModel | None,
    method: str,
    reset: Reset | None = None,
    causal: bool = False,
    limits: bool = True,
) -> TrackedPose:
    """The pose of segments that are known: a body of the subject's lengths, and its kinematics."""
    who, body = who_and_body(subject, model)
    poser = Poser(body, segments.quat_WL, limits=limits)
    return posed(poser, recording, segments, who, body, method=method, reset=reset, causal=causal)


def who_and_body(subject: Subject | None, model: BodyModel | None) -> tuple[Subject, BodyModel]:
    """The subject as used, the average one for want of another, and a body of those lengths."""
    who = subject or average_subject()
    body = model or load_model()
    own = body.lengths
    if subject is None and model is not None:
        # A model that somebody chose has that person's lengths; what it lacks stays the average person's.
        who = replace(who, name=body.robot.name, lengths={**who.lengths, **own}, note="lengths of the model")
    return who, body.with_lengths({name: value for name, value in who.lengths.items() if name in own})


def posed(
    poser: Poser,
    recording: Recording,
    segments: Segments,
    who: Subject,
    body: BodyModel,
    *,
    method: str,
    reset: Reset | None = None,
    causal: bool = False,
) -> TrackedPose:
    """A recording's pose, or that of the piece which follows what `poser` had last."""
    pose = poser.pose(recording.time, segments.quat_WL)
    return TrackedPose(
        pose.time,
        pose.quat_WL,
        pose.points,
        pose.q,
        segment_cov=segments.covariance_W,
        point_cov=point_covariance(pose.points, pose.quat_WL, segments.covariance_W, who.lengths_covariance()),
        gap={name: sensor.gap for name, sensor in recording.sensors.items() if sensor.gap is not None},
        recording=recording,
        subject=who,
        model=body,
        segments=segments,
        method=method,
        reset=reset,
        causal=causal,
    )
