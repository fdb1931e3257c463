"""Recording and subject → pose: filter, align, correct headings, kinematics.

`Tracker` does it, chunk by chunk; `track` gives it a recording as one chunk, `track_chunks` in chunks.
"""

from __future__ import annotations

from pathlib import Path

from ..arguments import check_arguments
from ..body import BodyModel
from ..body.subject import Subject
from ..filters import BEST
from ..filters.static import StaticTest
from ..recording import Recording
from .summary import SummaryAccumulator, TrackSummary, summarize
from .tracked import TrackedRecording, TrackOptions
from .tracker import CHUNK_S, Tracker, track_chunks

__all__ = [
    "CHUNK_S",
    "SummaryAccumulator",
    "TrackOptions",
    "TrackSummary",
    "TrackedRecording",
    "Tracker",
    "summarize",
    "track",
    "track_chunks",
]


def track(
    recording: Recording,
    subject: Subject | None = None,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    static_test: StaticTest | None = None,
    open_loop: bool = False,
    causal: bool = False,
    limits: bool = True,
) -> TrackedRecording:
    """The pose of a body.

    Parameters
    ----------
    subject : lengths and mounts; None for the population's mean and the session's stated mounts
    model : a body; its file, as for `load_model`, or the URDF of a mechanism whose links bear the sensors; or the name
        of one of the package's. None for that which the recording names, else the upper body. It gets the subject's
        lengths; without a subject its own stand
    method, static_test, open_loop, causal, limits : as `TrackOptions`

    Raises
    ------
    WeposeError
        What the recording, the subject or the model lacks; sensors on links that are no segments.
    """
    check_arguments(track, locals())
    tracker = Tracker(subject, model=model, options=TrackOptions(method, static_test, open_loop, causal, limits))
    return tracker.push(recording) or next(tracker.smooth())
