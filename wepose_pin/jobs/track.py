"""``wepose track``: a recording → its pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..diagnostics import Diagnostic
from ..errors import WrongOption
from . import Method, Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..subject import Subject


@dataclass(frozen=True)
class TrackJob:
    """Estimate the pose of a person from a recording: segment orientations and joint centres, with their uncertainty.

    `wepose angles` and `wepose export` compute the joint angles of a person from the result.

    A recording of `wepose live` is tracked causally, with the subject and the method of that session, and gives the
    displayed poses again, bit-identical. With --subject or --method it is tracked as any other recording.

    To track as Lisini Baldi et al. 2019 do, give --method smekf_published --open-loop and a subject of `wepose
    calibrate --formulation paper --method smekf_published`, which holds lengths and no mounts.

    Parameters
    ----------
    session : SESSION
        The recording: session.toml, the folder that holds it, or a file that `wepose live --record` wrote.
    out : DIR
        Write pose.parquet, subject.toml, subject.urdf, summary.json, view.html and report.html to this folder; of a
        mechanism joints.parquet too.
    subject : SUBJECT
        Use the lengths and mounts of this subject.toml, or of the one in this folder, as `wepose calibrate` writes it;
        or the lengths in an Xsens .mvnx. Without it lengths are those of the population prior, and mounts those that
        the session states.
    accept_failed
        Use a subject whose calibration failed (quality = "fail" in subject.toml), which is refused otherwise.
    model : URDF|TOML|NAME
        Use this body: a URDF, a TOML that names a URDF and its links, or the name of a body of the package, such as
        whole_body (docs/models.md). A URDF without such a TOML, as a robot's, is a mechanism: its sensors are named by
        its links. Without it the body that the session names, else the upper body.
    method : METHOD
        Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), smoother (the same forward
        and backward in time), smekf (Kalman filter of Lisini Baldi et al. 2019, corrected in static phases, with an
        exact covariance and two more conditions of the static test), smekf_published (the same as published), ncf
        (complementary filter, Mahony et al. 2008), gdc (gradient descent, Madgwick et al. 2011). Without it amekf, or
        the method of the live session.
    causal
        Use only past samples, as `wepose live` does. Poses begin at the end of the start pose.
    open_loop
        Correct no headings: neither by joint accelerations, by elbows as hinges and by joined hands, nor by the resets
        of a live session. Orientations are those of the filter from the start pose on.
    gaps
        Accept gaps of more than 50 ms: bridge them and mark them in pose.parquet (<segment>_gap). Without it such a gap
        is an error.
    covariance
        Write the covariance of each orientation and point too, not only the standard deviations.
    error_budget
        Print the contribution of each source of error to the standard deviation of each point: soft tissue, sensors
        with their mounts and start poses, lengths, the shoulder girdle. summary.json and report.html have it in any
        case.
    limits
        Keep joints with one or two axes within the limits of the model.
    torques
        Write torques.parquet too: joint torques by inverse dynamics. Assumed are a fixed base, gravity as the only
        external force and no load in the hands; the motion is low-pass filtered at 6 Hz.
    view
        Write view.html, the animation of the motion.
    report
        Write report.html, which shows diagnostics and what to do about them, noise, drift, hands and joint angles.
    force
        Replace the files of an earlier run in DIR.
    """

    session: Path
    out: Path
    subject: Path | None = None
    accept_failed: bool = False
    model: Path | None = None
    method: Method | None = None
    causal: bool = False
    open_loop: bool = False
    gaps: bool = False
    covariance: bool = False
    error_budget: bool = False
    limits: bool = True
    torques: bool = False
    view: bool = True
    report: bool = True
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where options contradict each other or name what is not there."""
        if self.model is not None and not self.model.is_file() and (self.model.suffix or len(self.model.parts) > 1):
            raise WrongOption(
                "model",
                self.model,
                "no such file; a URDF, a TOML that names one, or the name of a body of the package is needed",
            )


class TrackOutcome(NamedTuple):
    """What came of a `TrackJob`."""

    summary: Mapping[str, Any]  # as in summary.json, page failures apart
    page_failures: list[Diagnostic]  # pages, and parts of pages, that could not be made
    view_rate_hz: float | None = None  # of view.html, where it shows fewer samples than there are


def run_track(job: TrackJob, progress: Progress = no_progress) -> TrackOutcome:
    """Track a recording and write its result folder, whole or not at all; its pages follow.

    A long recording is tracked in chunks, so that only its samples are in memory as a whole.

    Raises
    ------
    WeposeError
        What the session, the subject, the model or an option lacks.
    """
    from ..filters import BEST
    from ..readers import is_live_log, load_session, read_live_log
    from ..report import write_track_pages
    from ..report.track import MOST_FRAMES
    from ..subject import parse_subject
    from ..tracking import CHUNK_S, SummaryAccumulator, TrackedRecording, TrackOptions, track_chunks
    from ..writers.folder import result_folder
    from ..writers.result import write_about, write_poses

    job.check()
    method, causal = job.method or BEST, job.causal
    with result_folder(job.out, job.force) as folder:
        progress("reading", 0.0)
        subject = _load_subject(job)
        if is_live_log(job.session):
            log = read_live_log(job.session)
            recording, causal = log.recording, causal or (job.method is None and subject is None)
            method = job.method or log.header["method"]
            if subject is None and log.header["subject"]:
                subject = parse_subject(log.header["subject"], job.session)
        else:
            recording = load_session(job.session, gaps=job.gaps)
        accumulator = SummaryAccumulator(recording)

        def track() -> Iterator[TrackedRecording]:
            for tracked in track_chunks(
                recording,
                subject,
                model=job.model,
                options=TrackOptions(method, causal=causal, open_loop=job.open_loop, limits=job.limits),
                chunk_s=float("inf") if job.torques else CHUNK_S,
                progress=lambda share: progress(f"tracking by {method}", (1.0 + share) / 3.0),
            ):
                accumulator.add(tracked)
                yield tracked

        write_poses(folder, track(), job.covariance)
        summary, torques = accumulator.finish(), None
        if job.torques:
            from ..angles.torques import pose_torques

            torques = pose_torques(accumulator.last)
        write_about(folder, accumulator.last, summary, recording.phases, torques, _collect_provenance(job))
    is_decimated = len(summary.tracked.time) < summary.content["samples"]
    view_rate_hz = min(30.0, MOST_FRAMES / summary.content["duration_s"]) if is_decimated else None
    failures: list[Diagnostic] = []
    if job.view or job.report:
        progress("making the pages", 2 / 3)
        failures = write_track_pages(job.out, summary, view=job.view, report=job.report, fps=view_rate_hz or 30.0)
    return TrackOutcome(summary.content, failures, view_rate_hz)


def _load_subject(job: TrackJob) -> Subject | None:
    from ..readers.subject import read_subject

    if job.subject is None:
        return None
    subject = read_subject(job.subject)
    if not job.accept_failed:
        subject.check_quality()
    return subject


def _collect_provenance(job: TrackJob) -> Mapping[str, Any]:
    """The provenance of the result. Collected last, so that an input that is wrong is reported by its reader."""
    from ..writers.provenance import collect_provenance

    return collect_provenance("track", field_values(job))
