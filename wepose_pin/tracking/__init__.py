"""Recording and subject → pose: filter, align, hold the headings together, kinematics."""

from __future__ import annotations

from ..alignment import segment_orientations
from ..arguments import check_arguments
from ..errors import BadOption
from ..filters import BEST, check_method
from ..model import BodyModel
from ..recording import CONFIGURATION, Recording
from ..static import StaticTest
from ..subject import Subject
from .causal import causal_segments
from .chain import TrackedChain, track_chain
from .headings import held_together
from .pieces import AHEAD_S, LARGE, PIECE_S, track_pieces
from .tracked import TrackedPose, tracked_pose

__all__ = [
    "AHEAD_S",
    "LARGE",
    "PIECE_S",
    "TrackedChain",
    "TrackedPose",
    "track",
    "track_chain",
    "track_pieces",
]


def track(
    recording: Recording,
    subject: Subject | None = None,
    *,
    method: str = BEST,
    model: BodyModel | None = None,
    static_test: StaticTest | None = None,
    hold_headings: bool = True,
    causal: bool = False,
    limits: bool = True,
) -> TrackedPose:
    """The pose of the upper body.

    Parameters
    ----------
    subject : lengths and mounts; None for the anthropometric average and the session's stated mounts
    method : the orientation filter, a key of `wepose_pin.filters.METHODS`
    hold_headings : use what a calibrated subject's elbows, and the joined hands of a phase `clasp`, say of drift
    causal : begin at the end of the start pose and look at nothing ahead, as a live session does
    limits : keep the limits of the model's joints of one axis
    model : a body; None for ours. It gets the subject's lengths; without a subject its own stand

    Raises
    ------
    WeposeError
        What the recording, the subject or the model lacks; sensors on links that are no segments.
    """
    check_arguments(track, locals())
    check_method(method)
    if recording.start_pose == CONFIGURATION:
        raise BadOption(
            f'{recording.where()}: start_pose = "{CONFIGURATION}" is that of a chain: give its URDF (--model; in '
            f"Python track_chain)"
        )
    if causal:
        rest, segments = causal_segments(recording, subject, method=method, static_test=static_test)
        return tracked_pose(rest, segments, subject, model, method, causal=True, limits=limits)
    segments = segment_orientations(recording, subject, method=method, static_test=static_test)
    reset = None
    own = any(sensor.aligned for sensor in recording.sensors.values())  # frames that no calibration of ours knows
    if hold_headings and subject is not None and subject.mounts and not recording.remounted and not own:
        segments, reset = held_together(recording, segments, subject)
    return tracked_pose(recording, segments, subject, model, method, reset, limits=limits)
