"""Recording and subject → pose: filter, align, correct headings, kinematics.

`Tracker` does it, chunk by chunk; `track` gives it a recording as one chunk, `track_chunks` in chunks.
"""

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
from .summary import TrackSummary, summarize
from .tracker import CHUNK_S, Tracker, track_chunks

if TYPE_CHECKING:
    from ..calibration import Calibration
else:  # checked as the subject that it has; the room of calibrations loads slowly
    Calibration = Subject

__all__ = ["CHUNK_S", "TrackResult", "TrackSummary", "Tracker", "summarize", "track", "track_chunks"]


def track(
    recording: Recording,
    subject: Subject | Calibration | None = None,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    static_test: StaticTest | None = None,
    open_loop: bool = False,
    causal: bool = False,
    accept_failed: bool = False,
) -> TrackResult:
    """Estimate the pose of a body from a recording.

    Parameters
    ----------
    recording : Recording
        As `load_session` reads it, or built in code.
    subject : Subject or Calibration, optional
        Use the lengths and mounts of this person. Without it the lengths are those of the population prior, or of the
        chosen model, and the mounts those that the session states.
    method : str
        Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), smoother (the same forward
        and backward in time, not live), smekf (Kalman filter of Lisini Baldi et al. 2019, corrected in static phases,
        with an exact covariance and two more conditions of the static test), smekf_published (the same as published),
        ncf (complementary filter, Mahony et al. 2008), gdc (gradient descent, Madgwick et al. 2011).
    model : BodyModel, str or Path, optional
        Use this body: a URDF, a TOML that names a URDF and its links, or the name of a body of the package, such as
        whole_body (docs/models.md). A URDF without such a TOML, such as a robot's, is a mechanism, whose sensors are
        named by its links. Without it the body that the session names, or the upper body.
    static_test : StaticTest, optional
        When a sensor counts as static; None: the default values.
    open_loop : bool
        Correct no headings: neither by joint accelerations, elbows as hinges or joined hands, nor by the resets of a
        live session. Orientations are those of the filter from the start pose on.
    causal : bool
        Use only past samples, as `wepose live` does. Poses begin at the end of the start pose.
    accept_failed : bool
        Use a subject even if its calibration failed, which is otherwise refused.

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
    options: dict[str, Any] = {"static_test": static_test, "open_loop": open_loop, "causal": causal}
    tracker = Tracker(person, model=model, method=method, **options)
    [result] = track_chunks(tracker, recording, np.inf)
    summary = summarize(result)
    return replace(result, summary=summary.content, diagnostics=summary.diagnostics)
