"""``wepose track``: a recording → its pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from ..diagnostics import from_json
from . import options as opt
from .options import described_by
from .output import print_diagnostics, progress_bar, say, say_pages, say_paragraph


@described_by("tracking/__init__.py:track", "readers/__init__.py:load_session")
def track(
    session: Path,
    /,
    *,
    out: opt.Out,
    subject: opt.Subject | None = None,
    method: opt.Method | None = None,
    model: opt.Model | None = None,
    gaps: bool = False,
    view: bool = True,
    report: bool = True,
    force: opt.Force = False,
    accept_failed: Annotated[bool, opt.MORE] = False,
    covariance: Annotated[bool, opt.MORE] = False,
    torques: Annotated[bool, opt.MORE] = False,
    causal: Annotated[bool, opt.RESEARCH] = False,
    open_loop: Annotated[bool, opt.RESEARCH] = False,
    limits: Annotated[bool, opt.RESEARCH] = True,
) -> Mapping[str, Any]:  # as in summary.json
    """Estimate the pose of a person from a recording: segment orientations and joint centres, with their uncertainty.

    `wepose angles` and `wepose export` compute the joint angles of a person from the result.

    A recording of `wepose live` is tracked causally, with the subject and the method of that session, and gives the
    displayed poses again, bit-identical. With --subject or --method it is tracked as any other recording.

    To track as Lisini Baldi et al. 2019 do, give --method smekf_published --open-loop and a subject of `wepose
    calibrate --formulation paper --method smekf_published`, which holds lengths and no mounts.

    Example: wepose track session.toml --subject anna/subject.toml -o result

    Parameters
    ----------
    session
        The recording: session.toml, the folder that holds it, or a file that `wepose live --record` wrote.
    out
        Write pose.parquet, subject.toml, subject.urdf, summary.json, view.html and report.html to this folder; for a
        mechanism joints.parquet too.
    subject
        SUBJECT is a subject.toml or its folder, as `wepose calibrate` writes it.
    method
        Without it amekf, or for a recording of `wepose live` the filter of that session.
    view
        Write view.html, the animation of the motion.
    report
        Write report.html, which shows diagnostics and what to do about them, noise, drift, hands and joint angles.
    covariance
        Write the covariance of each orientation and point too, not only the standard deviations.
    torques
        Write torques.parquet too: joint torques by inverse dynamics. They assume a fixed base, gravity as the
        only external force and no load in the hands; the motion is low-pass filtered at 6 Hz.
    """
    options = dict(locals())
    from ..body.subject import load_subject, parse_subject
    from ..filters import BEST
    from ..readers import is_live_log, load_session, read_live_log
    from ..report.page import PAGES
    from ..report.pages import write_track_pages
    from ..tracking import CHUNK_S, Tracker, TrackSummary, track_chunks
    from ..writers.result import collect_provenance, result_folder, write_about, write_poses

    chosen = method or BEST
    with progress_bar() as progress, result_folder(out, force, PAGES) as folder:
        progress("reading", 0.0)
        person = None if subject is None else load_subject(subject)
        if person is not None and not accept_failed:
            person.check_quality()
        if is_live_log(session):
            log = read_live_log(session)
            recording, causal = log.recording, causal or (method is None and person is None)
            chosen = method or log.header["method"]
            if person is None and log.header["subject"]:
                person = parse_subject(log.header["subject"], session)
        else:
            recording = load_session(session, gaps=gaps)
        tracker = Tracker(person, model=model, method=chosen, causal=causal, open_loop=open_loop, limits=limits)
        chunks = track_chunks(
            tracker,
            recording,
            float("inf") if torques else CHUNK_S,
            lambda share: progress(f"tracking by {chosen}", (1.0 + share) / 3.0),
        )
        summary, joint_torques = TrackSummary(recording), None
        write_poses(folder, summary.accumulate(chunks), covariance)
        if torques:
            from ..angles.torques import pose_torques

            joint_torques = pose_torques(summary.last)
        # Collected last, so that an input that is wrong is reported by its reader.
        provenance = collect_provenance("track", options)
        write_about(folder, summary.last, summary, joint_torques, provenance)
        progress("making the pages", 2 / 3)
        reliance, failures = write_track_pages(folder, summary, view=view, report=report)
    content = summary.content
    print_diagnostics(from_json(each) for each in content["diagnostics"])
    lengths = content["subject"]["note"] or content["subject"]["name"]
    say("{recording}: {duration_s:g} s at {rate_hz:g} Hz, {method}, lengths: ".format(**content) + lengths)
    say_paragraph(reliance)
    print_diagnostics(failures)
    say_pages(out)
    say(f"Pose: {out / 'pose.parquet'}  ({len(content['sensors'])} segments, {len(content['points'])} points)")
    if "joints" in content:
        say(f"Joints: {out / 'joints.parquet'}")
    if torques:
        say(f"Torques, estimates: {out / 'torques.parquet'}")
    return content
