"""`TrackedPose`: a pose with all that led to it, and what is to be said of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..alignment import Segments
from ..model import POINTS, BodyModel, load_model
from ..pose import Pose, deviation, point_covariance, pose_of
from ..recording import SEGMENTS, Recording
from ..subject import Subject, average_subject
from .headings import Reset

_WORTH_A_WARNING_DEG = 1.0


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
        assert self.recording is not None
        assert self.subject is not None
        assert self.segments is not None
        sensors: dict[str, Any] = {}
        for segment in self.recording.sensors:
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(self.segments.heading[segment])), 3)}
            orientation = self.segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(float(orientation.static.mean()), 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if segment in self.gap:
                lost = self.gap[segment]
                about["gaps"] = int(np.count_nonzero(np.diff(lost, prepend=False) & lost))
                about["gap_s"] = round(float(np.count_nonzero(lost)) / self.recording.rate_hz, 3)
            sensors[segment] = about
        missed = self._not_followed()
        lame = [f"{segment} {angle:.3g}" for segment, angle in missed.items() if angle > _WORTH_A_WARNING_DEG]
        if lame:
            lame = [
                f"the model's joints are too few or end too soon and miss segments by, rms [deg]: {', '.join(lame)}"
            ]
        return {
            "recording": self.recording.name,
            "session": str(self.recording.source) if self.recording.source else None,
            "method": self.method if self.segments.orientation else "ready orientations",
            "causal": self.causal,
            "model": self.model.robot.name if self.model else None,
            "subject": {"name": self.subject.name, "note": self.subject.note},
            "samples": len(self.time),
            "rate_hz": round(self.recording.rate_hz, 4),
            "duration_s": round(float(self.time[-1] - self.time[0]), 3),
            "phases": {"start": list(self.segments.start), "still": list(self.segments.still)},
            "sensors": sensors,
            "points": sorted(self.points),
            "not_followed_rms_deg": missed,
            "headings_held_together": self._held_together(),
            "warnings": [*self.segments.warnings, *self._not_known(), *lame],
        }

    def _held_together(self) -> dict[str, Any] | None:
        """Residuals of clasp and elbows before and after, and how far each heading was turned."""
        if self.reset is None:
            return None
        about: dict[str, Any] = {
            "hinge_rms_deg": {side: [round(v, 3) for v in values] for side, values in self.reset.hinge_deg.items()},
            "largest_turn_deg": {name: round(value, 3) for name, value in self.reset.largest_deg.items()},
        }
        if self.reset.clasp_mm is not None:
            about["clasp_gap_rms_mm"] = [round(value, 2) for value in self.reset.clasp_mm]
        return about

    def _not_known(self) -> list[str]:
        """A line on the points that have no place for want of a sensor."""
        missing = [point for point in POINTS if point not in self.points]
        lacking = [name for name in SEGMENTS[:5] if name not in self.quat_WL]
        if not missing or not lacking:
            return []
        return [f"no sensor on {', '.join(lacking)}: not known and not written: {', '.join(missing)}"]

    def _not_followed(self) -> dict[str, float]:
        """Segment → rms angle [deg] between its measured orientation and the model's, where joints are too few."""
        if self.model is None or self.q is None:
            return {}
        missed = deviation(self.model, self.q, self.quat_WL)
        return {name: round(float(np.degrees(np.sqrt(np.mean(angle**2)))), 3) for name, angle in missed.items()}


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
    who = subject or average_subject()
    body = model or load_model()
    own = body.lengths
    if subject is None and model is not None:
        # A model that somebody chose has that person's lengths; what it lacks stays the average person's.
        who = replace(who, name=body.robot.name, lengths={**who.lengths, **own}, note="lengths of the model")
    body = body.with_lengths({name: value for name, value in who.lengths.items() if name in own})
    pose = pose_of(body, recording.time, segments.quat_WL, limits=limits)
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
