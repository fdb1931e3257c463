"""Recording and subject → pose: filter, align, kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .alignment import Segments, segment_orientations
from .model import BodyModel, load_model
from .pose import Pose, pose_of
from .recording import Recording
from .static import StaticTest
from .subject import Subject, average_subject


@dataclass(frozen=True)
class TrackedPose(Pose):
    """A `Pose` with all that led to it."""

    recording: Recording | None = None
    subject: Subject | None = None
    model: BodyModel | None = None
    segments: Segments | None = None
    method: str = ""

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
            sensors[segment] = about
        return {
            "recording": self.recording.name,
            "method": self.method,
            "subject": {"name": self.subject.name, "note": self.subject.note},
            "samples": len(self.time),
            "rate_hz": round(self.recording.rate_hz, 4),
            "duration_s": round(float(self.time[-1] - self.time[0]), 3),
            "phases": {"start": list(self.segments.start), "still": list(self.segments.still)},
            "sensors": sensors,
            "points": sorted(self.points),
            "warnings": list(self.segments.warnings),
        }


def track(
    recording: Recording,
    subject: Subject | None = None,
    *,
    method: str = "smekf",
    model: BodyModel | None = None,
    static_test: StaticTest | None = None,
) -> TrackedPose:
    """The pose of the upper body.

    Parameters
    ----------
    subject : lengths and mounts; None for the anthropometric average and the session's stated mounts
    method : the orientation filter, a key of `wepose_pin.filters.METHODS`
    model : a body; None for ours. It gets the subject's lengths

    Raises
    ------
    WeposeError
        What the recording, the subject or the model lacks.
    """
    segments = segment_orientations(recording, subject, method=method, static_test=static_test)
    who = subject or average_subject()
    body = model or load_model()
    own = body.lengths
    body = body.with_lengths({name: value for name, value in who.lengths.items() if name in own})
    pose = pose_of(body, recording.time, segments.quat_WL)
    return TrackedPose(
        pose.time,
        pose.quat_WL,
        pose.points,
        pose.q,
        recording=recording,
        subject=who,
        model=body,
        segments=segments,
        method=method,
    )
