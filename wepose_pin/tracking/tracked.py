"""`TrackedRecording`: a pose with its inputs and intermediate results; `TrackedBody`: its body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..alignment import SegmentOrientations, StartFrames, find_start_frames
from ..errors import BadSession
from ..kinematics import PosedBody, compute_orientation_residuals
from ..model import BodyModel
from ..model.body import load_sensed_model
from ..model.configurations import find_undetermined_joints
from ..model.start_pose import compute_start_configuration
from ..recording import Recording
from ..subject import Subject, population_subject
from .headings import HeadingCorrection
from .options import TrackOptions


@dataclass(frozen=True, repr=False)
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

    def orientation_residual(self) -> dict[str, np.ndarray]:
        """Segment → angle (n,) [rad] between its measured orientation and the model's, where joints are too few."""
        return compute_orientation_residuals(self.model, self.q, self.segments.quat_WL)

    def find_undetermined_joints(self) -> list[str]:
        """The joints of a mechanism that the measured segments leave open, at least in part: they move little."""
        if not self.model.table.is_mechanism:
            return []
        return find_undetermined_joints(self.model.pin, list(self.quat_WL))


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
