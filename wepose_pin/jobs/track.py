"""``wepose track``: a recording → its pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..diagnostics import Diagnostic
from ..errors import BadOption, WrongOption
from . import Method, Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..subject import Subject
    from ..tracking import TrackedRecording


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
    chunk_seconds : SECONDS
        Track in chunks of this length, so that the memory does not grow with the recording (docs/long-recordings.md).
        Without it recordings of 500 MB and more are tracked in chunks of 120 s (smoother: 600 s), others as a whole; 0
        tracks any as a whole.
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
    chunk_seconds: float | None = None
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
    tracked: TrackedRecording | None = None  # where it was tracked as a whole


def run_track(job: TrackJob, progress: Progress = no_progress) -> TrackOutcome:
    """Track a recording and write its result folder, whole or not at all; its pages follow.

    Raises
    ------
    WeposeError
        What the session, the subject, the model or an option lacks.
    """
    from ..readers import estimate_data_bytes, is_live_log
    from ..tracking import LARGE

    job.check()
    as_whole = (
        "--torques" if job.torques
        else f"{job.session}, a recording of wepose live," if is_live_log(job.session)
        else ""
    )  # fmt: skip
    if job.chunk_seconds and as_whole:
        raise BadOption(f"--chunk-seconds {job.chunk_seconds:g}: {as_whole} is tracked as a whole; leave it out")
    if job.chunk_seconds or (job.chunk_seconds is None and not as_whole and estimate_data_bytes(job.session) >= LARGE):
        return _track_in_chunks(job, progress)
    return _track_as_whole(job, progress)


def _track_as_whole(job: TrackJob, progress: Progress) -> TrackOutcome:
    from ..filters import BEST
    from ..readers import is_live_log, load_session, read_live_log
    from ..report import write_track_pages
    from ..subject import parse_subject
    from ..tracking import summarize, track
    from ..writers import write_result
    from ..writers.folder import result_folder

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
        progress(f"tracking by {method}", 1 / 3)
        tracked = track(
            recording,
            subject,
            method=method,
            model=job.model,
            causal=causal,
            open_loop=job.open_loop,
            limits=job.limits,
        )
        summary, torques = summarize(tracked), None
        if job.torques:
            from ..angles.torques import pose_torques

            torques = pose_torques(tracked)
        stated = _collect_provenance(job)
        write_result(folder, tracked, summary, job.covariance, recording.phases, torques, stated)
    failures: list[Diagnostic] = []
    if job.view or job.report:
        progress("making the pages", 2 / 3)
        failures = write_track_pages(job.out, summary, view=job.view, report=job.report)
    return TrackOutcome(summary.content, failures, tracked=tracked)


def _track_in_chunks(job: TrackJob, progress: Progress) -> TrackOutcome:
    """Track in chunks: the memory does not grow with the recording."""
    from ..filters import BEST
    from ..readers.session import SessionReader
    from ..report import write_track_pages
    from ..report.track import MOST_FRAMES
    from ..tracking import TrackOptions, track_session
    from ..writers.chunks import ChunkWriter
    from ..writers.folder import result_folder

    with result_folder(job.out, job.force) as folder:
        progress("reading the times", 0.0)
        subject = _load_subject(job)
        reader = SessionReader(job.session, gaps=job.gaps, in_memory=False)
        writer = ChunkWriter(folder, len(reader.time), job.covariance)
        options = TrackOptions(job.method or BEST, causal=job.causal, open_loop=job.open_loop, limits=job.limits)
        for chunk in track_session(
            reader, subject, seconds=job.chunk_seconds, model=job.model, options=options, progress=progress
        ):
            writer.add(chunk)
        progress("writing the result", 1.0)
        summary = writer.finish(reader.phases, _collect_provenance(job))
    view_rate_hz = min(30.0, MOST_FRAMES / max(summary.content["duration_s"], 1e-3))
    failures: list[Diagnostic] = []
    if job.view or job.report:
        progress("making the pages", 1.0)
        failures = write_track_pages(job.out, summary, view=job.view, report=job.report, fps=view_rate_hz)
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
