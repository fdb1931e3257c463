"""The commands that read a recording: ``wepose info``, ``calibrate`` and ``track``."""

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from ..diagnostics import from_json, lines
from ..errors import BadOption, WrongOption, one_of
from . import options as opt
from .options import described_by
from .output import Outcome, print_diagnostics, print_table, progress_bar, say, say_pages, say_paragraph

EXIT_CODES = {"pass": 0, "poor": 3, "fail": 4}  # by the quality of a calibration


def info(
    file: Path,
    /,
    *,
    write: bool = False,
    out: opt.OutFile | None = None,
    model: opt.Model | None = None,
    force: opt.Force = False,
) -> None:
    """Describe a file, its sensors, rates and gaps, and propose a session file for it.

    Prints the description and the proposal; writes nothing without --write or -o. Reads tables, the files of many
    sensors and programs (docs/formats.md), recordings of `wepose live`, sessions, subjects and results. Entries of the
    proposed session that are guesses are marked CHECK.

    Example: wepose info trial.mvnx --write

    Parameters
    ----------
    file
        A file, or a folder with one recording or with one file for each sensor.
    write
        Write the session to session.toml beside the file.
    out
        Write the session to this file.
    model
        Propose the segments of this body, such as whole_body (docs/models.md). Without it, those of the upper body.
    """
    from ..body import load_model
    from ..documents import whole_file
    from ..readers.describe import describe_file, find_file

    with progress_bar() as progress:
        progress("reading", 0.0)
        body = None if model is None else load_model(model).table
        file, beside = find_file(file, body)
        session = out or file.parent / "session.toml"
        writes = write or out is not None
        description = describe_file(file, session.absolute().parent, body, None if model is None else Path(model))
        if writes:
            if description.session is None:
                raise BadOption(f"--write: there is no session to write for {file}: {description.title}")
            with whole_file(session, force) as partial:
                partial.write_text(description.session, encoding="utf-8")
    say(f"{file}: {description.title}")
    for fact in description.facts:
        say(f"  {fact}")
    used = {file.name, *(Path(keys["file"]).name for keys in description.sensors.values() if "file" in keys)}
    if unused := [each.name for each in beside if each.name not in used]:
        say(f"  also in the folder, not used: {one_of(unused).removeprefix('there is: ')}")
    print_diagnostics(description.diagnostics)
    if description.recording is not None:
        header = ("sensor", "in the file", "holds", "peak rate", "median specific force", "gaps over 50 ms")
        print_table("Sensors", header, list(description.list_sensors()))
    if writes:
        then = description.then.replace("SESSION", str(session))
        check = "check the lines marked CHECK, then: " if "CHECK" in (description.session or "") else ""
        say(f"Session: {session}  ({check}{then})")
    elif description.session is not None:
        say(f"# A session for it; --write writes it to {session}")
        print(description.session, end="")


@described_by("tracking/__init__.py:track", "calibration/procedure.py:calibrate", "readers/__init__.py:load_session")
def calibrate(
    session: Path,
    /,
    *,
    out: opt.Out,
    measured: opt.Measured | None = None,
    stature: opt.Stature | None = None,
    sex: Literal["f", "m"] | None = None,
    protocol: opt.ProtocolName | None = None,
    model: opt.Model | None = None,
    prior: opt.Subject | None = None,
    gaps: bool = False,
    report: bool = True,
    force: opt.Force = False,
    method: Annotated[opt.Method, opt.RESEARCH] = "amekf",
    formulation: Annotated[opt.Formulation, opt.RESEARCH] = "full",
) -> Outcome:  # of a Calibration
    """Calibrate lengths and sensor mounts from a recording of a protocol, such as joined hands.

    Joined hands determine the proportions of the arms and not their scale. Measure one length, such as the breadth of
    the shoulders, and give it with --measured. Without one the scale is that of the population prior, and the output
    says how uncertain it is.

    Exit code: 0 quality pass, 3 poor, 4 fail, by the limits in docs/calibrate.md; the files are written in all three
    cases; 2 invalid input, nothing is written.

    Example: wepose calibrate session.toml --measured biacromial=0.41 --stature 1.78 --sex f -o anna

    Parameters
    ----------
    session
        The recording: session.toml, or the folder that holds it. It names the phases of the protocol, such as clasp, in
        which the palms are held together.
    out
        Write subject.toml, subject.urdf, calibration.json (the quality and all numbers) and report.html to this folder.
    measured
        May be given several times, as in --measured biacromial=0.41 --measured trunk=0.50.
    prior
        SUBJECT is a subject.toml or its folder.
    report
        Write report.html, which shows the quality and what to do about it, lengths, mounts and the gap between the
        palms.
    """
    options = dict(locals())
    from .. import calibration as room
    from ..body.body import load_sensed_model
    from ..body.subject import load_subject
    from ..readers import load_session
    from ..report import calibration as report_room
    from ..report.page import write_pages
    from ..writers.result import collect_provenance, result_folder, write_calibration

    if prior is not None and (stature is not None or sex is not None):
        needed = "has the lengths of a person; --stature and --sex narrow those of the population"
        raise WrongOption("prior", prior, needed)
    with progress_bar() as progress, result_folder(out, force, "calibrate") as folder:
        progress("reading", 0.0)
        recording = load_session(session, gaps=gaps)
        body = load_sensed_model(model or recording.model or None, recording.sensors, recording.where())
        earlier = None if prior is None else load_subject(prior)
        progress("calibrating", 1 / 3)
        names = ("measured", "stature", "sex", "protocol", "method", "formulation")
        chosen: dict[str, Any] = {name: options[name] for name in names}
        calibration = room.calibrate(recording, prior=earlier, model=body, **chosen)
        write_calibration(folder, calibration, collect_provenance("calibrate", options))
        progress("writing the report", 2 / 3)
        make = partial(report_room.render_calibration_report, calibration, recording) if report else None
        failures = write_pages(folder, {"report.html": make})
    quality = calibration.quality
    print_diagnostics([*quality.further, *failures])
    print_table(*report_room.tabulate_lengths(calibration))
    print_table(*report_room.tabulate_mounts(calibration))
    if not math.isnan(calibration.rms_gap):  # a protocol without a closure
        say_paragraph(report_room.describe_gap(calibration))
    say_pages(out)
    say(f"Subject: {out / 'subject.toml'}  {out / 'subject.urdf'}  {out / 'calibration.json'}")
    say(f"Quality: {quality.quality}")
    for _, line in lines(quality.reasons):
        say_paragraph(line, "  ")
    return Outcome(calibration, EXIT_CODES[quality.quality])


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
    from ..report.pages import write_track_pages
    from ..tracking import CHUNK_S, Tracker, TrackSummary, track_chunks
    from ..writers.result import collect_provenance, result_folder, write_about, write_poses

    chosen = method or BEST
    with progress_bar() as progress, result_folder(out, force, "track") as folder:
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
        tracker = Tracker(person, model=model, method=chosen, causal=causal, open_loop=open_loop)
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
