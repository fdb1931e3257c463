"""Recording and subject → pose: filter, align, correct headings, kinematics.

`Tracker` does it, chunk by chunk; `track` gives it a recording as one chunk, `track_chunks` in chunks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arguments import check_arguments
from ..body import BodyModel
from ..body.subject import Subject
from ..filters import BEST
from ..filters.static import StaticTest
from ..recording import Recording
from .result import TrackResult
from .segment_orientations import TrackOptions
from .summary import SummaryAccumulator, TrackSummary, summarize
from .tracker import CHUNK_S, Tracker, track_chunks

if TYPE_CHECKING:
    from ..calibration import Calibration
else:  # checked as the subject that it has; the room of calibrations loads slowly
    Calibration = Subject

__all__ = [
    "CHUNK_S",
    "SummaryAccumulator",
    "TrackOptions",
    "TrackResult",
    "TrackSummary",
    "Tracker",
    "summarize",
    "track",
    "track_chunks",
]


def track(
    recording: Recording,
    subject: Subject | Calibration | None = None,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    static_test: StaticTest | None = None,
    open_loop: bool = False,
    causal: bool = False,
    limits: bool = True,
    accept_failed: bool = False,
) -> TrackResult:
    """Estimate the pose of a body from a recording.

    Parameters
    ----------
    recording : Recording
        As `load_session` reads it, or built in code.
    subject : Subject or Calibration, optional
        Lengths and mounts; None: the mean lengths of the population, or of a chosen model its own, and the mounts that
        the session states.
    method : str
        The orientation filter: "amekf", "smoother", "smekf", "smekf_published", "ncf" or "gdc", as in
        `estimate_orientation`.
    model : BodyModel, str or Path, optional
        A body; or its file, as for `load_model`, or the URDF of a mechanism whose links carry the sensors; or the name
        of a body of the package. None: the one that the recording names, else the upper body. It is scaled to the
        subject's lengths.
    static_test : StaticTest, optional
        When a sensor counts as static; None: the default values.
    open_loop : bool
        Do not correct heading drift, neither by joint accelerations, hinges and joined hands, nor by the resets of a
        live session: orientations are the filter's from the start pose on.
    causal : bool
        Begin at the end of the start pose and use no later samples, as a live session does.
    limits : bool
        Keep joints of one axis, such as those of a mechanism, within the limits that the model states.
    accept_failed : bool
        Use the subject even if its calibration failed.

    Returns
    -------
    TrackResult
        Pose, body and subject; `time` (n,) [s], `quat_WL` segment → (n, 4) xyzw, `points` point → (n, 3) [m] in W.

    Raises
    ------
    WeposeError
        The recording, the subject or the model lacks something that is needed; the calibration of the subject failed;
        a sensor is on no segment of the model.

    Examples
    --------
    >>> recording = wp.load_session("session.toml")
    >>> result = wp.track(recording, wp.load_subject("subject.toml"))
    >>> result
    TrackResult('simulated': 22.5 s at 100 Hz, 5 segments, 8 points, amekf, 0 warnings)
    >>> result.quat_WL["right_forearm"].shape == (len(result.time), 4)
    True
    """
    person: Any = getattr(subject, "subject", subject)
    check_arguments(track, locals() | {"subject": person})
    if person is not None and not accept_failed:
        person.check_quality()
    options = TrackOptions(method, static_test, open_loop, causal, limits)
    [result] = track_chunks(recording, person, model=model, options=options, chunk_s=np.inf)
    summary = summarize(result)
    return replace(result, summary=summary.content, diagnostics=summary.diagnostics)
