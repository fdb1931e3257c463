"""The command line: ``wepose COMMAND``.

Heavy rooms load inside the commands, so that ``wepose --help`` answers at once.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from .errors import BadData, BadOption, ExistingOutput, MissingFile, WeposeError, one_of, printable

if TYPE_CHECKING:
    from .calibration import Calibration, Verdict
    from .live import Output
    from .live.robot import Driven, RobotOut
    from .recording import Recording
    from .simulation import Imperfections
    from .subject import Subject
    from .validation import Document

Method = Literal["amekf", "smoother", "smekf", "ncf", "gdc"]
Session = Annotated[Positional[Path], arg(metavar="SESSION")]
Result = Annotated[Positional[Path], arg(metavar="RESULT")]
OptionalPath = Annotated[Path | None, arg(metavar="PATH")]
Out = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]


def demo(*, out: Out = Path("wepose-demo"), seed: int = 1, force: bool = False) -> None:
    """The whole chain on a recording that it makes itself: simulate, calibrate, track, evaluate, view.

    A person of random size stands in the N-pose, moves the joined hands for a minute, then draws six circles in the
    air with rests on a table, with five Xsens MTi-3 on. All of it is simulated, so that the truth is known.

    Example: wepose demo -o demo

    Args:
        out: Folder for session, subject, result and view.html.
        seed: Another number is another person and another motion.
        force: Replace files of an earlier run.
    """
    given = dict(locals())
    import json
    from dataclasses import asdict

    from .calibration import calibrate_lengths
    from .evaluation import evaluate as compare
    from .filters import BEST, METHODS
    from .report import write_track_pages
    from .simulation import simulate as make
    from .simulation import simulated_person
    from .tracking import track as follow
    from .writers import whole_folder, write_result, write_session
    from .writers.provenance import made_by, write_made_by
    from .writers.result import as_json, write_subject

    if seed < 0:
        raise BadOption(f"--seed {seed}: a whole number from 0 on")
    with whole_folder(out, force) as folder, _steps(2 + 2 * len(METHODS)) as step:
        step("simulating a person")
        person = simulated_person(seed)
        simulation = make(person.lengths, seed=seed)
        recording, truth = simulation.recording(f"demo-{seed}"), simulation.truth()
        (folder / "session").mkdir()
        write_session(folder / "session", recording, truth)
        circles = simulation.phases["circles"][0]

        found, errors = {}, {}
        for method in METHODS:
            step(f"calibrating by {method}")
            found[method] = calibrate_lengths(
                recording, gauge=person.taped, prior=person.average, method=method, gauge_std=person.taped_std
            )
            step(f"tracking by {method}")
            pose = follow(recording, found[method].subject, method=method)
            errors[method] = compare(pose, truth, circles)
            if method == BEST:
                (folder / "subject").mkdir()
                (folder / "result").mkdir()
                write_subject(folder / "subject", found[method].subject, pose.model)
                write_result(folder / "result", pose, phases=recording.phases)
                best = pose
        step("making the page")
        failed = write_track_pages(folder / "result", best, report=False)
        report = {
            "seed": seed,
            "lengths": {
                name: {
                    "true": value,
                    "estimated": found[BEST].subject.lengths[name],
                    "std": found[BEST].subject.std(name),
                }
                for name, value in person.lengths.items()
            },
            "errors": {method: asdict(error) for method, error in errors.items()},
        }
        (folder / "demo.json").write_text(json.dumps(as_json(report), indent=2) + "\n", encoding="utf-8")
        write_made_by(folder, made_by("demo", given))
    _lengths_table("Lengths from the joined hands", found[BEST].subject, person.average, person.lengths, person.taped)
    _print_table(
        "Right hand while drawing six circles: distance to the truth [mm], mean ± std",
        ("filter", "from the shoulders", "from the root"),
        [
            (
                method,
                _mean_std(error.position_from_shoulders["right_hand"]),
                _mean_std(error.position["right_hand"]),
            )
            for method, error in errors.items()
        ],
    )
    _say("One person, one motion: the order of the filters changes with both, see --seed. Each filter tracks with the")
    _say("lengths that it calibrated. From the root the trunk counts too, whose length joined hands do not show.")
    _warn(failed)
    _say_pages(out / "result", {"Motion to look at": "view.html"})
    _say(f"Session, subject, result, figures:  {out}/session  {out}/subject  {out}/result  {out}/demo.json")


def track(
    session: Session,
    /,
    *,
    out: Out,
    subject: OptionalPath = None,
    model: OptionalPath = None,
    method: Method | None = None,
    causal: bool = False,
    gaps: bool = False,
    covariance: bool = False,
    limits: bool = True,
    torques: bool = False,
    report: bool = True,
    pieces: Annotated[float | None, arg(metavar="SECONDS")] = None,
    force: bool = False,
) -> None:
    """Recording to pose: orientations, points, a summary, a page to look at, and a report on how far to trust it.

    Of a recording of `wepose live` it gives the poses that were shown, to the bit: with its own subject and method, and
    causally, unless one of them is given.

    Example: wepose track session.toml --subject anna/subject.toml -o result

    Args:
        session: session.toml, or the folder that holds it; or a recording of `wepose live`.
        out: Folder for pose.parquet, subject.toml, subject.urdf, summary.json, view.html, report.html.
        subject: subject.toml of `wepose calibrate`, or its folder; without it lengths are an average person's.
        model: A body's URDF, or a TOML that names it and its links (docs/models.md); without it ours. Where the
            sensors are on links of another chain (start_pose = "configuration"), the URDF of that.
        method: The orientation filter; without it amekf, or that of the live session.
        causal: Begin at the end of the start pose and look at nothing ahead, as `wepose live` does.
        gaps: Accept lost samples for longer than 50 ms: bridge them and mark them in pose.parquet (<segment>_gap).
        covariance: Write the covariances of orientations and points, not only their standard deviations.
        limits: Let elbows and wrists of one or two axes pass the model's limits.
        torques: Write torques.parquet too, joint torques by the model's inertias and the smoothed motion: estimates.
        report: Leave out report.html (warnings and what to do, noise, drift, hands, joint angles).
        pieces: Track in pieces of so many seconds, in the same memory however long the recording is
            (docs/long-recordings.md). Files of 500 MB and more always are; 0: not even those.
        force: Replace files of an earlier run.
    """
    given = dict(locals())
    from .filters import BEST
    from .model import load_model
    from .readers import data_bytes, is_live_log, load_session, read_live_log
    from .recording import CONFIGURATION
    from .report import write_track_pages
    from .subject import load_subject, subject_of
    from .tracking import LARGE
    from .tracking import track as follow
    from .writers import whole_folder, write_result
    from .writers.provenance import made_by, write_made_by

    if pieces is not None and pieces and (causal or torques or is_live_log(session)):
        what = "--causal" if causal else "--torques" if torques else f"{session}, a recording of wepose live,"
        raise BadOption(f"--pieces {pieces:g}: {what} is tracked as a whole; leave --pieces out")
    if pieces or (pieces is None and not causal and not torques and data_bytes(session) >= LARGE):
        _track_pieces(session, out, subject, model, method or BEST, pieces, gaps, covariance, limits, report, given)
        return
    with _steps(3) as step:
        with whole_folder(out, force) as folder:
            step("reading")
            who = load_subject(subject) if subject else None
            if is_live_log(session):
                log = read_live_log(session)
                recording, causal = log.recording, causal or (method is None and subject is None)
                by = str(method or log.header["method"])
                if who is None and log.header["subject"]:
                    who = subject_of(log.header["subject"], session)
            else:
                recording, by = load_session(session, gaps=gaps), method or BEST
            if model is not None and recording.start_pose == CONFIGURATION:
                if who is not None or causal:
                    raise BadOption(f"--{'subject' if who else 'causal'}: for a person; {session} is of another chain")
                _track_chain(recording, model, folder, step, method=by, limits=limits, torques=torques)
                write_made_by(folder, made_by("track", given))
                files = ["joints.parquet", *(["torques.parquet"] if torques else []), "pose.parquet", "summary.json"]
                _say(f"Chain: {'  '.join(str(out / file) for file in files)}")
                return
            body = load_model(model) if model else None
            step(f"tracking by {by}")
            pose = follow(recording, who, method=by, model=body, causal=causal, limits=limits)
            found = None
            if torques:
                from .angles.torques import pose_torques

                found = pose_torques(pose)
            write_result(folder, pose, covariance, recording.phases, found, made_by("track", given))
        step("making the pages")
        failed = write_track_pages(out, pose, report=report)
    _tracked_table(pose.summary())
    _warn(failed)
    _say_pages(out, {**_reported(report), "Motion to look at": "view.html"})
    _say(f"Pose: {out / 'pose.parquet'}  ({len(pose.quat_WL)} segments, {len(pose.points)} points)")
    if torques:
        _say(f"Torques, estimates: {out / 'torques.parquet'}")


def calibrate(
    session: Session,
    /,
    *,
    out: Out,
    protocol: Annotated[str, arg(metavar="NAME|FILE.toml")] = "clasp",
    gauge: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="NAME=METRES")] = (),
    stature: Annotated[float | None, arg(metavar="METRES")] = None,
    sex: Annotated[Literal["f", "m"] | None, arg(metavar="{f,m}")] = None,
    method: Method = "amekf",
    gaps: bool = False,
    force: bool = False,
) -> None:
    """Hands-together recording to subject: arm lengths and sensor mounts, with standard deviations and a verdict.

    Hands together fix the proportions of the arms and not their scale: tape one length (the shoulder width serves) and
    give it as gauge. Without one the scale is that of the average person, and the output says how uncertain that is.

    Exit code: 0 the calibration passes, 3 it is poor, 4 it fails; the files are written in each case and carry the
    verdict. 2: the input is wrong, and nothing is written.

    Example: wepose calibrate session.toml --gauge shoulder_width=0.385 --stature 1.78 --sex f -o anna

    Args:
        session: session.toml with the phases of the protocol, such as clasp, in which the palms are held together.
        out: Folder for subject.toml, subject.urdf, calibration.json (the verdict and all figures) and report.html.
        protocol: What was done: clasp (hands together), clasp_taped (the same, a gauge must be given), handle (hands on
            a bar of known length), touch_left and touch_right (one palm on a fixed point), poses (T-pose and bow:
            headings only), or a file of your own made like those in calibration/.
        gauge: A length measured with a tape, such as shoulder_width=0.385; may be given several times. With protocol
            handle also handle=0.42, the bar between the palms.
        stature: Body height in metres; narrows the average person.
        sex: f or m; narrows the average person.
        method: The orientation filter.
        gaps: Accept lost samples for longer than 50 ms, which are bridged.
        force: Replace files of an earlier run.
    """
    given = dict(locals())
    from .calibration import calibrate_lengths, judge, load_protocol
    from .model import load_model
    from .readers import load_session
    from .report import unsaid, write_calibration_page
    from .subject import average_subject
    from .writers import whole_folder
    from .writers.calibration import write_calibration
    from .writers.provenance import made_by
    from .writers.result import write_subject

    what = load_protocol(protocol)
    taped = _gauges(gauge, what.gauges)
    with _steps(3) as step:
        with whole_folder(out, force) as folder:
            step("reading")
            average = average_subject(stature, sex)
            recording = load_session(session, gaps=gaps)
            step("calibrating")
            found = calibrate_lengths(recording, gauge=taped, prior=average, protocol=what, method=method)
            verdict = judge(found)
            write_subject(folder, found.subject, load_model(lengths=found.subject.lengths))
            write_calibration(folder, found, verdict, made_by("calibrate", given))
        step("writing the report")
        failed = write_calibration_page(out, found, recording, method=method, protocol=what, verdict=verdict)
    _warn([*unsaid(found.warnings, verdict), *failed])
    _lengths_table(f"Lengths, by {what.title}", found.subject, average, None, taped)
    _mounts_table(found)
    if what.closures:
        gap = {"coincide": "Palm-to-palm gap", "distance": "Palms off their distance"}.get(
            found.closure, "Gap from palm to its point"
        )
        _say(
            f"{gap}: {1e3 * found.rms_gap:.1f} mm rms, {1e3 * found.prior_rms_gap:.1f} mm with the average person's "
            f"lengths"
        )
        _say(f"the motion counts as {found.independent:.0f} independent measurements")
    _say_pages(out, _reported(True))
    _say(f"Subject: {out / 'subject.toml'}  {out / 'subject.urdf'}  {out / 'calibration.json'}")
    _verdict(verdict)
    if verdict.grade != "pass":
        sys.exit({"poor": 3, "fail": 4}[verdict.grade])


def evaluate(
    result: Result,
    truth: Annotated[Positional[Path], arg(metavar="TRUTH")],
    /,
    *,
    interval: Annotated[tuple[float, float] | None, arg(metavar="FROM TO")] = None,
) -> None:
    """Errors against a reference: attitude, drift, positions, and how far the stated uncertainty is right.

    Example: wepose evaluate result truth.parquet --interval 72 115

    Args:
        result: Folder that `wepose track` wrote.
        truth: Table (.parquet or .csv) with columns as in pose.parquet, or a session file that names one.
        interval: Only from this to this time, in seconds.
    """
    from .evaluation import evaluate as compare
    from .pose import pose_from_table
    from .readers import load_session
    from .readers.tables import read_table
    from .recording import span_text
    from .writers import read_result

    if interval is not None and not interval[0] < interval[1]:
        raise BadOption(f"--interval {interval[0]:g} {interval[1]:g}: the first number is the earlier one, in seconds")
    pose, _, _ = read_result(result)
    if truth.suffix == ".toml" or truth.is_dir():
        named = load_session(truth).truth
        if named is None:
            raise BadOption(f"{truth}: data.truth is missing; the session names no reference to compare with")
        truth = named
    errors = compare(pose, pose_from_table(read_table(truth), str(truth)), interval)
    _say(f"{errors.samples} samples from {span_text(errors.interval)}")
    if errors.attitude:
        _print_table(
            "Attitude error [deg]: mean ± std of the absolute; root mean square; drift of the heading [deg/min]",
            ("segment", "roll", "pitch", "yaw", "inclination", "heading", "total", "drift"),
            [
                (
                    name,
                    *(f"{mean:.2f} ± {std:.2f}" for mean, std in (e.roll, e.pitch, e.yaw)),
                    *(f"{rmse:.2f}" for rmse in (e.inclination_rmse, e.heading_rmse, e.total_rmse)),
                    f"{e.drift_deg_min:+.2f}",
                )
                for name, e in errors.attitude.items()
            ],
        )
    if errors.position:
        shoulders = errors.position_from_shoulders
        _print_table(
            "Position error [mm], mean ± std",
            ("point", "from the root", "from the shoulders"),
            [
                (name, _mean_std(e), _mean_std(shoulders[name]) if name in shoulders else "")
                for name, e in errors.position.items()
            ],
        )
    stated = {**errors.attitude_uncertainty, **{f"{k} (point)": v for k, v in errors.position_uncertainty.items()}}
    if stated:
        _print_table(
            "Stated uncertainty: right are a normalised squared error of 3, and 68 % and 95 % of the errors within",
            ("of", "normalised", "within 1 std", "within 2 std"),
            [(k, f"{u.nees:.2f}", f"{100 * u.within_1:.0f} %", f"{100 * u.within_2:.0f} %") for k, u in stated.items()],
        )


def simulate(
    *,
    out: Out,
    seed: int = 1,
    rate_hz: float = 100.0,
    protocol: Literal["clasp", "handle", "touch_left", "touch_right", "poses"] = "clasp",
    world: Literal["perfect", "realistic"] = "perfect",
    change: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(name="set", metavar="NAME=VALUE")] = (),
    force: bool = False,
) -> None:
    """A subject with known truth: session file, recording, and truth.parquet as pose.parquet.

    The sensors have an MTi-3's noise and bias in either world; what else is wrong in a realistic one stands with sizes
    and sources in wepose_pin/simulation/imperfections.py. `wepose calibrate DIR --gauge …`, `wepose track DIR` go on.

    Example: wepose simulate -o made --seed 7 --world realistic --set palm_slip=0 --set mount=any

    Args:
        out: Folder for session.toml, recording.parquet, truth.parquet, subject.toml (the true lengths and mounts).
        seed: Another number is another person and another motion.
        rate_hz: Samples a second.
        protocol: What the person does to be calibrated, as of `wepose calibrate --protocol`; with poses no circles
            follow.
        world: Nothing wrong but the sensors' noise, or soft tissue, slip, sway and sensor errors of a usual size.
        change: One imperfection at another size; may be given several times. mount=any: sensors in any rotation,
            nothing stated; the rest are numbers, 0 for off: soft_tissue_deg, palm_slip [m], shoulder_wander [m],
            start_elbow_deg, start_segment_deg, sway_deg_s, gyro_scale, accel_scale, misalignment_deg,
            g_sensitivity_deg_s, gyro_range_deg_s, accel_range_g, bits, clock_jitter [s], clock_offset [s], dropped.
        force: Replace files of an earlier run.
    """
    given = dict(locals())
    from dataclasses import replace

    import numpy as np

    from .simulation import PERFECT_WORLD, REALISTIC, simulated_person
    from .simulation import simulate as make
    from .subject import LENGTHS, mount_rows, subject_toml
    from .writers import whole_folder, write_session
    from .writers.provenance import made_by, write_made_by

    if seed < 0:
        raise BadOption(f"--seed {seed}: a whole number from 0 on")
    if not 20.0 <= rate_hz <= 2000.0:
        raise BadOption(f"--rate-hz {rate_hz:g}: between 20 and 2000 samples a second")
    imperfections = _changed(REALISTIC if world == "realistic" else PERFECT_WORLD, change)
    with whole_folder(out, force) as folder, _steps(1) as step:
        step("simulating a person")
        person = simulated_person(seed)
        circles = 0 if protocol == "poses" else 6
        simulation = make(
            person.lengths, seed=seed, rate_hz=rate_hz, imperfections=imperfections, protocol=protocol, circles=circles
        )
        write_session(folder, simulation.recording(f"simulated-{seed}"), simulation.truth())
        order = (*LENGTHS, *(row for segment in simulation.quat_LS for row in mount_rows(segment)))
        true = replace(
            person.average,
            name="truth",
            lengths=person.lengths,
            mounts=simulation.quat_LS,
            order=order,
            covariance=np.zeros((len(order), len(order))),
            note="simulated: the true lengths and mounts",
        )
        (folder / "subject.toml").write_text(subject_toml(true), encoding="utf-8")
        write_made_by(folder, made_by("simulate", given))
    taped = " ".join(f"{name}={value:.4f}" for name, value in person.taped.items())
    _say(f"Session: {out / 'session.toml'}  (taped: {taped}, stature {person.stature:.2f} m, sex {person.sex})")
    _say(f"Truth: {out / 'truth.parquet'}  {out / 'subject.toml'}")


def live(
    *,
    source: Annotated[str, arg(metavar="SPEC")],
    subject: OptionalPath = None,
    session: Annotated[Path | None, arg(metavar="SESSION")] = None,
    record: Annotated[Path | None, arg(metavar="FILE")] = None,
    method: Literal["amekf", "smekf", "ncf", "gdc"] = "amekf",
    model: OptionalPath = None,
    speed: Annotated[str, arg(metavar="FACTOR")] = "1",
    no_page: bool = False,
    no_open: bool = False,
    port: int = 0,
    udp: Annotated[str | None, arg(metavar="[HOST:]PORT")] = None,
    lsl: Annotated[str | None, arg(metavar="NAME")] = None,
    robot: Annotated[str | None, arg(metavar="NAME|FILE.urdf")] = None,
    arm: Literal["left", "right", "both"] | None = None,
    map: OptionalPath = None,
    to: Annotated[str | None, arg(metavar="[HOST:]PORT")] = None,
    robot_hz: float = 100.0,
    hold_after: float = 0.1,
    stop_after: float = 1.0,
    force: bool = False,
) -> None:
    """The pose while it happens: from a stream to a page in the browser, the terminal, other programs and a file.

    Stand still in the start pose until you are told that it is ready. Then r sets the headings anew while you stand so
    again, and q ends (Ctrl-C too). What --record wrote up to any end is whole but for its last second.

    Example: wepose live --source udp:9000 --subject anna --record morning.wepose

    Args:
        source: Where samples come from: replay:SESSION, udp:[HOST:]PORT, lsl:NAME, mti:DEVICE=SEGMENT,…
            (docs/live-sources.md).
        subject: subject.toml of `wepose calibrate`, or its folder; without it lengths are an average person's and
            mounts those that --session states.
        session: A session file that states how the sensors are mounted; what it says of data is not read.
        record: Write all that is received and the poses there; `wepose track FILE` gives the same poses again.
        method: The orientation filter.
        model: A body's URDF, or a TOML that names it and its links (docs/models.md); without it ours.
        speed: Of a replay: 1 its own, 4 four times that, max as fast as it is read.
        no_page: Serve no page, only the terminal's view.
        no_open: Do not open the page in the browser.
        port: Of the page, on this machine only; without it any free one.
        udp: Send each pose as JSON to this port, of this machine where no host is named (docs/live-page.md).
        lsl: Send each pose as a Lab Streaming Layer stream of this name; liblsl then listens on every interface.
        robot: Send commands for this robot (as `wepose retarget`) that follows the person (docs/live-robot.md).
        arm: Which of the robot's arms; without it all that it has.
        map: The map of a URDF in --robot, where it does not lie beside it.
        to: Where the robot's commands go, as JSON; without it port 9002 of this machine.
        robot_hz: Commands a second.
        hold_after: Seconds without a pose after which the robot brakes.
        stop_after: Seconds without a pose after which it stops, until r is pressed.
        force: Replace the file of --record.
    """
    import webbrowser

    from .live import open_source, run_session, wearing_of
    from .live.loop import warm, wearer_model
    from .live.terminal import TerminalView
    from .model import load_model

    for option, value in (("arm", arm), ("map", map), ("to", to)):
        if value is not None and robot is None:
            raise BadOption(f"--{option} {value}: goes with --robot, which is not given")
    stated = None if session is None else wearing_of(None, subject, session)
    named = None if stated is None or source.startswith("replay:") else list(stated.mounts)
    stream = open_source(source, sensors=named or None, speed=speed)
    wearing = stated or wearing_of(stream, subject, None)
    body = wearer_model(wearing.subject, load_model(model) if model else None)
    _warn(body.warnings)
    outputs: list[Output] = []
    follower: RobotOut | None = None
    try:
        if robot is not None:
            from .live.robot import Watched, follower_of

            sides = None if arm is None else ("left", "right") if arm == "both" else (arm,)
            times = {"rate_hz": robot_hz, "hold_after": hold_after, "stop_after": stop_after}
            if source.startswith("replay:"):
                times["speed"] = float(speed.replace("max", "inf"))
            follower, stream = follower_of(robot, stream, wearing, arms=sides, map_file=map, to=to, **times)
            outputs.append(follower)
        if udp is not None:
            from .live.out import udp_out

            outputs.append(udp_out(udp))
        if lsl is not None:
            from .live.out import LslOut

            outputs.append(LslOut(lsl))
        if not no_page:
            from .live.page import LivePage

            page = LivePage(body, port=port, title=wearing.name)
            page.open()
            outputs.append(Watched(page, follower) if follower else page)
            _say(f"Page: {page.url}  (this machine only)")
            if not no_open and not webbrowser.open(page.url):
                _warn(["no browser could be started; open the page by hand"])
        terminal = TerminalView()
        outputs.append(Watched(terminal, follower) if follower else terminal)
        if follower is not None:
            warm(method)  # what is compiled then does not hold up commands
            follower.open()
        with _asked_to_stop() as asked:
            ended = run_session(
                stream,
                wearing,
                method=method,
                model=body,
                record=record,
                force=force,
                outputs=outputs,
                until=asked,
            )
    finally:
        for output in outputs:
            output.close()
    _warn(ended.warnings)
    _print_table(
        f"{ended.poses} poses in {ended.seconds:.1f} s; from the newest sample to its pose "
        f"{1e3 * ended.latency.quantile(0.5):.2f} ms (p50), {1e3 * ended.latency.quantile(0.99):.2f} ms (p99)"
        if ended.poses
        else "no poses: the start pose was not held",
        ("sensor", "samples", "ticks without", "late", "twice", "unsound"),
        [
            (name, *(str(of[key]) for key in ("taken", "missing", "late", "duplicate", "bad")))
            for name, of in ended.counts.items()
        ],
    )
    if follower is not None:
        _driven_table(follower.summary())
    if ended.problem:
        _warn([ended.problem])
    if record is not None and not ended.problem:
        again = f"  (wepose track {record} -o DIR gives these poses again)" if ended.poses else ""
        _say(f"Recorded: {record}{again}")


def view(
    result: Result,
    /,
    *,
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE")] = None,
    no_open: bool = False,
    force: bool = False,
) -> None:
    """The motion of a result as one HTML page that opens offline.

    Example: wepose view result

    Args:
        result: Folder that `wepose track` wrote.
        out: Write the page there; without it view.html in the result's folder is opened, and made if it is missing.
        no_open: Do not open the page in the browser.
        force: Replace an existing page.
    """
    import webbrowser

    from .report.viewer import pose_html
    from .writers import read_result

    page = out or result / "view.html"
    if not (result / "pose.parquet").is_file():
        raise MissingFile(f"{result}: no pose.parquet in it; a folder that `wepose track` wrote is wanted here")
    if out is not None and out.exists() and not force:
        raise ExistingOutput(f"{out}: exists; --force replaces it, -o names another file")
    if page.is_dir() or not page.absolute().parent.is_dir():
        raise ExistingOutput(f"{page}: not a file that can be written; -o names an HTML file in an existing folder")
    if out is not None or force or not page.is_file():
        pose, model, summary = read_result(result)
        phases = {name: [(a, b) for a, b in spans] for name, spans in summary.get("recorded_phases", {}).items()}
        text = pose_html(model, pose, phases=phases, title=summary.get("recording", result.name))
        partial = page.with_name(f".{page.name}.partial")
        try:
            partial.write_text(text, encoding="utf-8")
            partial.replace(page)
        finally:
            partial.unlink(missing_ok=True)
    _say(f"Motion to look at:  {page}")
    if not no_open and not webbrowser.open(page.absolute().as_uri()):
        _warn(["no browser could be started; open the page by hand"])


def retarget(
    result: Result,
    /,
    *,
    robot: Annotated[str, arg(metavar="NAME|FILE.urdf")],
    out: Out,
    arm: Literal["left", "right", "both"] | None = None,
    rate_hz: float = 100.0,
    task: Literal["both", "position", "orientation"] = "both",
    scale: float | None = None,
    smoothing_hz: float = 6.0,
    strict: bool = False,
    episode: bool = False,
    view: bool = True,
    force: bool = False,
) -> None:
    """A person's arms to a robot's: a joint trajectory within its limits that does not hit itself.

    Exit code: 0 the trajectory keeps the robot's limits and it does not touch itself, as the check of what was written
    says; 3 it does not: the files are there to be looked at, no robot should run them. 2: the input is wrong, and
    nothing is written.

    Robots by name: panda, ur5, baxter, tiago_dual, talos, g1 (of example-robot-data). Any other by its URDF with a map
    beside it that says which links are shoulder, elbow and hand (docs/retargeting.md).

    Example: wepose retarget result --robot panda -o panda

    Args:
        result: Folder that `wepose track` wrote.
        robot: One of the names above, a URDF with a map beside it (ARM.urdf, ARM.toml), or the map.
        out: Folder for trajectory.parquet and .csv, joint_trajectory.json and .yaml, summary.json, view.html.
        arm: Which arms; without it all that the robot has.
        rate_hz: Of the trajectory, as the controller wants it.
        task: What the hands follow: the person's position, orientation, or both.
        scale: The robot's metres for one of the person's; without it a straight arm becomes a straight arm.
        smoothing_hz: Of the low-pass on what was measured; 0: none.
        strict: Refuse a motion that is too fast for the robot, in place of slowing it.
        episode: Write episode/ too: a data set of one episode as LeRobot reads it.
        view: Leave out view.html.
        force: Replace files of an earlier run.
    """
    given = dict(locals())
    import json
    from dataclasses import replace

    from .retargeting import Tasks, find_map, kept, load, summary, table, touching, write_episode, write_trajectory
    from .retargeting import retarget as follow
    from .writers import whole_folder
    from .writers.provenance import made_by
    from .writers.result import as_json, read_result

    sides = None if arm is None else ("left", "right") if arm == "both" else (arm,)
    tasks = replace(Tasks(), **{name: 0.0 for name in ("position", "orientation") if task not in ("both", name)})
    with _steps(104) as step:
        with whole_folder(out, force) as folder:
            step("reading")
            pose, body, _ = read_result(result)
            model = load(find_map(robot), sides)
            seen = 0

            def progress(text: str, share: float) -> None:
                nonlocal seen
                at = int(50 * share) + (50 if text == "solving" else 0)
                while seen < at:
                    seen += 1
                    step(text)

            trajectory = follow(
                pose,
                model,
                rate_hz=rate_hz,
                tasks=tasks,
                scale=scale,
                smoothing_hz=smoothing_hz,
                strict=strict,
                progress=progress,
            )
            step("checking")
            held = kept(table(trajectory), model.map.urdf, model.map.acceleration, model.map.jerk)
            touched = touching(model, trajectory.time, trajectory.u)
            step("writing")
            write_trajectory(folder, trajectory)
            if episode:
                write_episode(folder / "episode", trajectory, f"follow the arms of {result.name}")
            found = summary(trajectory, held, touched)
            text = json.dumps(as_json(found) | {"made_by": made_by("retarget", given)}, indent=2)
            (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
        if view:
            step("making the page")
            from .report.page import PageWriter
            from .report.viewer import retarget_html

            writer = PageWriter(out, ["view.html"])
            writer.write(
                "view.html",
                lambda _: retarget_html(body, pose, trajectory, title=f"{result.name} on {model.map.name}"),
            )
            writer.add_warnings("summary.json")
            _warn(writer.warnings)
    sound = _retarget_tables(found)
    _say(f"Trajectory: {out / 'trajectory.parquet'}  {out / 'joint_trajectory.json'}  {out / 'summary.json'}")
    if view:
        _say_pages(out, {"Motion to look at": "view.html"})
    if not sound:
        sys.exit(3)


def export(
    result: Result,
    /,
    *,
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")],
    format: Annotated[str | None, arg(metavar="FORMAT")] = None,
    names: Annotated[str | None, arg(metavar="{opensim,isb}")] = None,
    rate_hz: Annotated[float | None, arg(metavar="HZ")] = None,
    force: bool = False,
) -> None:
    """The motion of a result for other programs: CSV, Parquet, OpenSim, BVH, C3D, URDF (docs/formats/export.md).

    Example: wepose export result -o circles.trc

    Args:
        result: Folder that `wepose track` wrote.
        out: File to write.
        format: csv, parquet (pose and joint angles), mot (joint angles for OpenSim), sto (orientations for OpenSense),
            placement (the sample for its IMU Placer), trc, c3d (points), bvh (skeleton and motion), urdf (the subject).
            Left out, it is the file's suffix.
        names: Columns of a .mot: coordinates of OpenSim's Rajagopal model, the default, or the ISB's angles.
        rate_hz: Resample to this many samples a second.
        force: Replace an existing file.
    """
    given = dict(locals())
    from .writers.export import export as write
    from .writers.provenance import made_by

    with _steps(1) as step:
        step("writing")
        block = made_by("export", given)
        written = write(result, out, format, names=names, rate_hz=rate_hz, force=force, made_by=block)
    _warn(written.notes)
    _say(f"Written: {out}  ({written.format})")


def validate(
    *,
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="DIR")] = None,
    data: OptionalPath = None,
    quick: bool = False,
    from_: Annotated[Path | None, arg(name="from", metavar="FILE")] = None,
    force: bool = False,
) -> None:
    """The paper's experiments on simulated subjects, and real recordings, beside the paper's own figures.

    On two cores a quick run takes under a minute, a full one some ten.

    Example: wepose validate --quick

    Args:
        out: Folder for validation.json with every trial, and the page with tables and figures: validation.html,
            validation.md with validation/*.svg.
        data: Folder of the real recordings (broad/, wepose_hr/, ring/, ur5/), to measure on them too.
        quick: One trial of each experiment, and two of BROAD, instead of all; without the account of what costs how
            many millimetres and without the search for gains.
        from_: validation.json of an earlier run: tables and pages are made from it anew, and nothing is run.
        force: Replace files of an earlier run.
    """
    import json

    from .errors import reason
    from .validation import Skipped, document_text, experiments, run
    from .validation.document import as_document, read_document
    from .validation.page import write_pages
    from .writers import whole_folder
    from .writers.result import versions

    if from_ is not None and (quick or data is not None):
        raise BadOption(f"--from {from_}: measures nothing, so that --quick and --data mean nothing beside it")
    document = read_document(from_) if from_ is not None else None
    todo = experiments(quick, data) if document is None else {}
    jobs = [job for of in todo.values() for job in of]
    place = whole_folder(out, force) if out is not None else contextlib.nullcontext(None)
    failed: list[str] = []
    with _steps(len(jobs) + (out is not None)) as step:
        with place as folder:
            if document is None:
                results, skipped = [], []
                for job, found in zip(jobs, run(jobs), strict=True):
                    step(job.experiment)
                    if isinstance(found, Skipped):
                        skipped.append(found)
                    else:
                        results += found
                if not results:
                    raise BadData(f"nothing could be scored; {skipped[0].line()}")
                text = document_text(results, quick, versions(), skipped)
                if folder is not None:
                    (folder / "validation.json").write_text(text, encoding="utf-8")
                document = as_document(json.loads(text), "this run")
            elif folder is not None:
                step("drawing the figures")
                failed = write_pages(folder, document)
        if out is not None and from_ is None:
            step("drawing the figures")
            try:
                with whole_folder(out, force=True) as folder:
                    failed = write_pages(folder, document)
            except Exception as error:
                failed = [f"validation.html and validation.md: cannot be made: {reason(error)}"]
    _validation_tables(document)
    _warn([*(each.line() for each in document.skipped), *failed])
    if out is not None and (out / "validation.html").is_file():
        _say(f"Page: {out / 'validation.html'}  {out / 'validation.md'}  {out / 'validation'}/*.svg")
    if out is not None and from_ is None:
        _say(f"Every trial: {out / 'validation.json'}")


def bench(
    *,
    quick: bool = False,
    live: bool = False,
    batch: bool = False,
    sessions: int | None = None,
    day: bool = False,
    data: OptionalPath = None,
    save: Annotated[Path | None, arg(metavar="FILE")] = None,
    compare: Annotated[Path | None, arg(metavar="FILE")] = None,
    force: bool = False,
) -> None:
    """Speed and accuracy of the filters on this machine, beside VQF and imufusion where they are installed.

    Times belong to the machine and the moment; what counts are the ratios to VQF, timed in turn in the same run.

    Example: wepose bench --quick --save before.json

    Args:
        quick: Less than half a minute in place of two: shorter data, fewer rounds, nothing compiled anew.
        live: Nothing but a live session: five sensors at 1 kHz, five minutes with a file and five with the page too, of
            which --quick makes half a minute each.
        batch: Nothing but a study of 500 short sessions by wepose batch, on one worker, two, and two of which one is
            killed; --quick makes it twelve. Stopped, the same command goes on from there.
        sessions: Of --batch: so many.
        day: Nothing but a recording of 24 hours, and shorter ones, in pieces: time, memory, whether it gives what
            the whole gives; --quick makes it one hour.
        data: Folder of real recordings (broad/, wepose_hr/) to measure accuracy on; WEPOSE_DATA names one too.
        save: Write the figures there, with versions, machine and date, as JSON.
        compare: A file that --save wrote: then/now shows how much slower each was then, by its ratio to VQF.
        force: Replace the file of --save.
    """
    import json

    from .bench import FULL, QUICK, document, live_sections, read_document, sections, then_by_now
    from .writers.result import versions

    if data is None and os.environ.get("WEPOSE_DATA"):
        data = Path(os.environ["WEPOSE_DATA"])
    before = None if compare is None else read_document(compare)
    if save is not None and save.exists() and not force:
        raise ExistingOutput(f"{save}: exists; --force replaces it, --save names another file")
    if save is not None and (save.is_dir() or not save.absolute().parent.is_dir()):
        raise ExistingOutput(f"{save}: not a file that can be written; --save names a JSON file in an existing folder")
    if sessions is not None and (not batch or sessions < 2):
        raise BadOption(f"--sessions {sessions}: {'at least 2' if batch else 'goes with --batch'}")
    if batch:
        from .bench.study import study_sections

        todo = study_sections(quick, sessions)
    elif day:
        from .bench.day import day_sections

        todo = day_sections(quick)
    else:
        todo = live_sections(quick) if live else sections(QUICK if quick else FULL, data)
    tables = {}
    with _steps(len(todo)) as step:
        for name, measure in todo.items():
            step(f"measuring {name.replace('_', ' ')}")
            tables[name] = measure()
    for name, table in tables.items():
        header, rows = [""], {of: [of] for of in table.rows}
        for column in table.columns:
            compared = before is not None and column.compared
            header += [column.header, "then/now"] if compared else [column.header]
            for of, figures in table.rows.items():
                value = figures.get(column.key, float("nan"))
                rows[of].append(f"{value:.{column.digits}f}" if value == value else "")
                if before is not None and compared:
                    ratio = then_by_now(before, name, of, column.key, value)
                    rows[of].append(f"{ratio:.2f}" if ratio == ratio else "")
        _print_table(table.title, tuple(header), [tuple(row) for row in rows.values()])
        for note in table.notes:
            _say(note)
        _say("")
    if before is not None:
        _say(f"then: {compare}, {before.get('date', 'undated')}; over 1, it was slower against VQF then")
    if save is not None:
        text = json.dumps(document(tables, quick, versions()), indent=1, allow_nan=False) + "\n"
        partial = save.with_name(f".{save.name}.partial")
        try:
            partial.write_text(text, encoding="utf-8")
            partial.replace(save)
        finally:
            partial.unlink(missing_ok=True)
        _say(f"Figures: {save}")


def info(
    file: Annotated[Positional[Path], arg(metavar="FILE")],
    /,
    *,
    write: bool = False,
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE")] = None,
    force: bool = False,
) -> None:
    """What a file is: its sensors, rates and gaps, and a session file that is ready for it.

    Knows Xsens MVNX, MT Manager's text, Movella DOT, x-IMU3, APDM, OpenSim .sto of orientations, CSV, Parquet, HDF5,
    MATLAB (docs/formats/), recordings of wepose live, and sessions, subjects and results. What is marked CHECK in the
    session is guessed.

    Example: wepose info trial.mvnx --write

    Args:
        file: A file or folder.
        write: Write the session too, to session.toml beside the file.
        out: Write it there instead.
        force: Replace an existing session.
    """
    from .readers.describe import describe

    beside = file.absolute().parent
    target = out or (beside / "session.toml" if write else None)
    if target is not None and target.exists() and not force:
        raise ExistingOutput(f"{target}: exists; --force replaces it, -o names another file")
    if target is not None and (target.is_dir() or not target.absolute().parent.is_dir()):
        raise ExistingOutput(f"{target}: not a file that can be written; -o names a .toml file in an existing folder")
    with _steps(1) as step:
        step("reading")
        found = describe(file, target.absolute().parent if target is not None else beside)
    if target is not None and found.session is None:
        raise BadOption(f"--write: there is no session to write for {found.what}")
    _say(found.what)
    for fact in found.facts:
        _say(f"  {fact}")
    if found.sensors:
        header = ("sensor", "in the file", "holds", "fastest turn", "median force", "gaps over 50 ms")
        _print_table("Sensors", header, list(found.sensors))
    if target is None:
        if found.session is not None:
            _say(f"# A session for it; --write writes it to {beside / 'session.toml'}")
            print(found.session, end="")
        return
    assert found.session is not None
    partial = target.with_name(f".{target.name}.partial")
    try:
        partial.write_text(found.session, encoding="utf-8")
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    _say(f"Session: {target}  (check the lines marked CHECK, then: {found.then.replace('SESSION', str(target))})")


def batch(
    plan: Annotated[Positional[Path], arg(metavar="PLAN")],
    /,
    *,
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR|URL")],
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None,
    workers: int | None = None,
    force: bool = False,
) -> None:
    """Many recordings: a plan of sessions, subjects and steps, on all processors or on a Dask cluster.

    Each item is made by itself: one that fails leaves its error in the table, the others go on. The same command goes
    on where it was stopped and repeats nothing that is done. Sessions and DIR may lie on s3:// (docs/batch.md).

    Exit code: 0 all items are done, 3 some are not.

    Example: wepose batch plan.toml -o study

    Args:
        plan: PLAN.toml: which sessions, whose, and the steps calibrate, track, retarget, export, evaluate.
        out: Folder or URL for items/, a folder an item, results.parquet and report.html.
        scheduler: Address of a running Dask scheduler, tcp://HOST:8786; without it workers are started here.
        workers: How many are started here; without it one a processor.
        force: Make items again whose inputs, options or version have changed since they were made.
    """
    from .batch import run_study

    if workers is not None and (workers < 1 or scheduler is not None):
        why = "they run at the scheduler, which knows how many" if scheduler else "at least 1"
        raise BadOption(f"--workers {workers}: {why}")
    try:
        with _items() as progress:
            study = run_study(plan, out, scheduler=scheduler, workers=workers, force=force, progress=progress)
    except KeyboardInterrupt:
        print("wepose: stopped; what is done stays, and the same command goes on from there", file=sys.stderr)
        sys.exit(130)
    failed = study.table.filter(study.table["status"] != "done")
    if failed.height:
        counts = failed["error"].value_counts(sort=True).iter_rows()
        causes: list[tuple[str, ...]] = [(cause, str(count)) for cause, count in counts]
        _print_table("Not done", ("cause", "items"), causes)
        first = failed.unique("error", keep="first", maintain_order=True)
        for item, message in first.select("item", "message").iter_rows():
            _say(f"  {item}: {message}")
    _warn(study.warnings)
    kept = f", {study.kept} of them before" if study.kept else ""
    _say(f"{study.table.height - failed.height} of {study.table.height} items done{kept}")
    _say(f"Report to look at:  {out.rstrip('/')}/report.html")
    _say(f"Table: {out.rstrip('/')}/results.parquet")
    if failed.height:
        sys.exit(3)


def rerun(result: Result, /) -> None:
    """Make a result again from what it says made it, and say whether it is the same: tables exactly, to the last bit.

    Nothing is changed. Exit code: 0 the same, 3 different, 2 it cannot be made again: an input is gone or has changed.

    Example: wepose rerun result

    Args:
        result: Folder of wepose track, calibrate, simulate, retarget or demo, a study of wepose batch or an item of it,
            or a file of wepose export.
    """
    from .batch.rerun import parts
    from .batch.rerun import rerun as again

    with _steps(parts(result)) as step:
        found = again(result, COMMANDS, step)
    _warn(found.notes)
    if found.differences:
        _say(f"{result}: different, made again by wepose {found.command}:")
        for line in found.differences:
            _say(f"  {line}")
        sys.exit(3)
    _say(f"{result}: the same, made again by wepose {found.command}")


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "simulate": simulate,
    "calibrate": calibrate,
    "track": track,
    "live": live,
    "view": view,
    "retarget": retarget,
    "export": export,
    "info": info,
    "evaluate": evaluate,
    "validate": validate,
    "batch": batch,
    "rerun": rerun,
    "bench": bench,
}


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``wepose``; ends by `SystemExit`: 0, or 2 after one line on what was wrong."""
    alone = argv is None
    if argv is None:
        argv = sys.argv[1:]
        # The last bits of BLAS depend on its number of threads, and `wepose rerun` looks at them. Before numpy loads.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        signal.signal(signal.SIGINT, _stop)
        signal.signal(signal.SIGTERM, _stop)
    if argv in (["--version"], ["-V"]):
        from . import __version__

        print(f"wepose-pin {__version__}")
        sys.exit(0)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that knows no ± still shows the rest
    try:
        _parse_and_run(argv)
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python would complain once more on its way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (KeyboardInterrupt, Exception) as error:
        # A library may turn the interrupt into an error of its own.
        if _stopped or isinstance(error, KeyboardInterrupt):
            print(f"wepose: stopped; {_what_there_is()}", file=sys.stderr)
            sys.exit(130)
        if isinstance(error, WeposeError):
            print(f"wepose: {error}", file=sys.stderr)
            sys.exit(2)
        if isinstance(error, OSError):
            where = error.filename or "output"
            print(f"wepose: {where}: {error.strerror or error}; {_what_there_is()}", file=sys.stderr)
            sys.exit(2)
        raise
    finally:
        if alone:  # a signal while Python itself ends would take the exit code's place
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
    sys.exit(0)


def _what_there_is() -> str:
    """What a command that ends early has written all the same, whole."""
    folders = getattr(sys.modules.get("wepose_pin.writers.folder"), "written", ())
    return f"{', '.join(map(str, folders))} was written before" if folders else "nothing was written"


_stopped: list[int] = []


def _stop(number: int, _frame: Any) -> None:
    """Remember the signal: libraries that call back into Python swallow the exception."""
    _stopped.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Signals only ask, so that nothing is cut off in the middle; asked twice, or before anyone looks, it stops."""
    asked: list[int] = []
    looks = False

    def ask(number: int, frame: Any) -> None:
        if asked or not looks:
            _stop(number, frame)
        asked.append(number)

    def is_asked() -> bool:
        nonlocal looks
        looks = True
        return bool(asked or _stopped)  # a library may have swallowed what `_stop` raised

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield is_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _parse_and_run(argv: list[str]) -> None:
    """Parse with tyro, then run; tyro's panels on wrong usage become one line."""
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise BadOption(f"'{argv[0]}' is not a command; {one_of(COMMANDS, argv[0])}")
    chosen: list[Callable[[], None]] = []

    def later(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def keep(*args: Any, **options: Any) -> None:
            chosen.append(lambda: command(*args, **options))

        if argv[:1] in ([], ["--help"], ["-h"]):  # the list of commands: a line each
            keep.__doc__ = (command.__doc__ or "").splitlines()[0]
        return keep

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            tyro.extras.subcommand_cli_from_dict(
                {name: later(command) for name, command in COMMANDS.items()},
                prog="wepose",
                description="Upper-body pose from wearable IMUs without magnetometers. `wepose demo` shows all of it.",
                args=argv or ["--help"],
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        frame = r"[│╭╮╰╯─]+|^[+|]|[+|]$|-{4,}"  # of ASCII where the terminal knows no other
        lines = [re.sub(frame, " ", line).strip() for line in complaint.getvalue().splitlines()]
        text = " ".join(line for line in lines[1:] if line)  # the first line is the panel's title
        text = re.sub(r"\[/?bold\]|\{None\}\||Argument helptext:.*?(?=For full)", "", text)
        head, missing, rest = text.partition("Missing from wepose ")
        if missing:  # each with its whole help: its name is enough
            command, _, said = rest.partition(": ")
            *of, rest = said.split("(required)")
            text = f"{head}{missing}{command}: {', '.join(_option_name(each) for each in of)}{rest}"
        text = re.sub(r"(Perhaps you meant: --[\w-]+).*?(?=For full|$)", r"\1 ", text)
        text = re.sub(r"\.? *For full helptext, (run|see)", "; see", text)
        raise BadOption(text.removesuffix(":")) from None
    chosen[0]()


def _option_name(text: str) -> str:
    """What stands before an option's help: "-o DIR, --out DIR Folder for …" → "-o DIR"."""
    name, *more = text.split()
    return f"{name} {more[0].rstrip(',')}" if name.startswith("-") and more else name


def _gauges(gauge: tuple[str, ...], distances: tuple[str, ...] = ()) -> dict[str, float]:
    """Name → [m] of lengths of the body, and of the protocol's own `distances`."""
    from .subject import LENGTHS

    known = (*LENGTHS, *distances)
    taped: dict[str, float] = {}
    for text in gauge:
        name, _, value = text.partition("=")
        if name == "handle" and name not in known:
            raise BadOption(f"--gauge {text}: the bar of --protocol handle, which is not given")
        if name in taped:
            raise BadOption(f"--gauge {text}: '{name}' is given twice; give the mean of both")
        if name not in known:
            raise BadOption(f"--gauge {text}: '{name}' is not a length; {one_of(known, name)}")
        try:
            taped[name] = float(value)
        except ValueError:
            raise BadOption(f"--gauge {text}: '{value}' is not a number of metres, as in {name}=0.385") from None
    return taped


def _changed(imperfections: Imperfections, changes: tuple[str, ...]) -> Imperfections:
    """The imperfections with those of --set at other sizes."""
    from dataclasses import fields, replace

    names = [field.name for field in fields(imperfections)]
    for text in changes:
        name, _, value = text.partition("=")
        if name not in names:
            raise BadOption(f"--set {text}: '{name}' is no imperfection; {one_of(names, name, len(names))}")
        try:
            size: Any = value if name == "mount" else int(value) if name == "bits" else float(value)
        except ValueError:
            kind = "whole number" if name == "bits" else "number"
            raise BadOption(f"--set {text}: '{value}' is not a {kind}, as in {name}=0") from None
        try:
            imperfections = replace(imperfections, **{name: size})
        except ValueError as error:
            raise BadOption(f"--set {text}: {error}") from None
    return imperfections


def _reported(report: bool) -> dict[str, str]:
    return {"Report to look at": "report.html"} if report else {}


def _say_pages(folder: Path, pages: Mapping[str, str]) -> None:
    """What each of the pages is and where it lies; not of those that could not be made."""
    for what, name in pages.items():
        if (folder / name).is_file():
            _say(f"{what}:  {folder / name}")


def _tracked_table(summary: Mapping[str, Any]) -> None:
    """What `track` found of the sensors."""
    _warn(summary["warnings"])
    _print_table(
        f"{summary['recording']}: {summary['duration_s']:g} s at {summary['rate_hz']:g} Hz, {summary['method']}, "
        f"lengths: {summary['subject']['note'] or summary['subject']['name']}",
        ("sensor", "at rest", "gyro bias, start → end [deg/s]", "gravity [m/s²]"),
        [
            (
                segment,
                f"{100 * about['static_share']:.0f} %",
                f"{_norm(about['gyro_bias_start_deg_s']):.3f} → {_norm(about['gyro_bias_end_deg_s']):.3f}",
                f"{about['gravity_m_s2']:.3f}",
            )
            if "static_share" in about
            else (segment, "", "orientations from the recording", "")
            for segment, about in summary["sensors"].items()
        ],
    )


def _track_pieces(
    session: Path,
    out: Path,
    subject: Path | None,
    model: Path | None,
    method: str,
    seconds: float | None,
    gaps: bool,
    covariance: bool,
    limits: bool,
    report: bool,
    given: Mapping[str, Any],
) -> None:
    """`track` in a memory that does not grow with the recording."""
    from .model import load_model
    from .readers.session import SessionReader
    from .report import write_thinned_pages
    from .report.thinned import Decimator
    from .report.track import MOST_FRAMES
    from .subject import load_subject
    from .tracking import track_pieces
    from .writers import whole_folder
    from .writers.pieces import PieceWriter
    from .writers.provenance import made_by

    with _shares() as told:
        with whole_folder(out, given["force"]) as folder:
            told("reading the times", 0.0)
            who = load_subject(subject) if subject else None
            body = load_model(model) if model else None
            reader = SessionReader(session, gaps=gaps, in_memory=False)
            writer, thinner = PieceWriter(folder, covariance), Decimator(len(reader.time))
            for piece in track_pieces(
                reader, who, seconds=seconds, method=method, model=body, limits=limits, told=told
            ):
                writer.add(piece)
                thinner.add(piece)
            told("writing the result", 1.0)
            writer.finish(reader.phases, made_by("track", given))
            summary = writer.tally.summary()
        told("making the pages", 1.0)
        fps = min(30.0, MOST_FRAMES / max(summary["duration_s"], 1e-3))
        failed = write_thinned_pages(out, thinner, reader.phases, summary["warnings"], report=report, fps=fps)
    _tracked_table(summary)
    _warn(failed)
    motion = f"Motion to look at, {fps:.2g} pictures a second"
    _say_pages(out, {**_reported(report), motion: "view.html"})
    _say(f"Pose: {out / 'pose.parquet'}  ({len(summary['sensors'])} segments, {len(summary['points'])} points)")


def _track_chain(
    recording: Recording,
    urdf: Path,
    folder: Path,
    step: Callable[[str], None],
    *,
    method: str,
    limits: bool,
    torques: bool,
) -> None:
    """`track` where the sensors are on links of a chain that is no person's arms."""
    from .angles.torques import joint_torques
    from .model.robot import load_robot
    from .tracking import track_chain
    from .writers.chain import write_chain

    model = load_robot(urdf)
    step(f"tracking by {method}")
    chain = track_chain(recording, model, method=method, limits=limits)
    write_chain(folder, chain, joint_torques(model, chain.time, chain.q) if torques else None)
    summary = chain.summary()
    _warn(summary["warnings"])
    _print_table(
        f"{summary['recording']}: {summary['duration_s']:g} s at {summary['rate_hz']:g} Hz, {method}, on {model.name}",
        ("link", "missed by the joints, rms [deg]"),
        [(link, f"{angle:.2f}") for link, angle in summary["orientation_residual_rms_deg"].items()],
    )
    _print_table(
        "Joints [rad or m]",
        ("joint", "least", "greatest", ""),
        [
            (name, f"{value.min():.3f}", f"{value.max():.3f}", "left open" if name in chain.open else "")
            for name, value in chain.joints.items()
        ],
    )


# What the user sees ------------------------------------------------------------------------------------------------


def _say(text: str) -> None:
    print(_shown(text))


def _shown(text: str) -> str:
    """The text without control characters, which a file's names may hold."""
    return "\n".join(map(printable, text.split("\n")))


def _warn(warnings: Any) -> None:
    for warning in warnings:
        print(f"note: {_shown(str(warning))}", file=sys.stderr)


@contextlib.contextmanager
def _steps(total: int) -> Iterator[Callable[[str], None]]:
    """A progress bar over named steps; none when not on a terminal."""

    def check() -> None:
        if _stopped:
            raise KeyboardInterrupt

    if not sys.stderr.isatty():
        yield lambda _: check()
        check()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    parts = TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn()
    with Progress(*parts, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=total)
        done = -1

        def step(text: str) -> None:
            nonlocal done
            check()
            done += 1
            progress.update(task, description=text, completed=done)

        yield step
        check()


@contextlib.contextmanager
def _shares() -> Iterator[Callable[[str, float], None]]:
    """A progress bar told what is done and which share of it; none when not on a terminal."""

    def check() -> None:
        if _stopped:
            raise KeyboardInterrupt

    if not sys.stderr.isatty():
        yield lambda *_: check()
        check()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    parts = TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*parts, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=1.0)

        def told(what: str, share: float) -> None:
            check()
            progress.update(task, description=what, completed=share)

        yield told
        check()


@contextlib.contextmanager
def _items() -> Iterator[Callable[[int, int, int], None]]:
    """A progress bar over many items, told how many are done, failed, and there; none when not on a terminal."""
    if not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting workers", total=None)

        def told(done: int, failed: int, total: int) -> None:
            description = f"{failed} failed" if failed else "items"
            if done or total == 0:
                progress.update(task, description=description, completed=done, total=total)

        yield told


def _print_table(title: str, header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="left" if k == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(_shown, row))
    # Wide enough for every table: rich would cut numbers off to fit a narrow terminal, which wraps by itself.
    console = Console(width=160)
    console.print(escape(_shown(title)), style="bold", highlight=False)
    console.print(table)


def _lengths_table(
    title: str, subject: Subject, average: Subject, true: Mapping[str, float] | None, taped: Collection[str]
) -> None:
    rows = []
    for name, value in subject.lengths.items():
        row = [name, f"{1e3 * true[name]:.1f}"] if true is not None else [name]
        row += [f"{1e3 * value:.1f}", f"± {1e3 * subject.std(name):.1f}"]
        row.append(f"{1e3 * average.lengths[name]:.1f} ± {1e3 * average.std(name):.1f}")
        rows.append((*row, "taped" if name in taped else ""))
    header = (
        "length [mm]",
        *(["true"] if true is not None else []),
        "estimated",
        "std",
        "average person",
        "",
    )
    _print_table(title, header, rows)


def _mounts_table(found: Calibration) -> None:
    import numpy as np

    from .recording import axes_from_mount
    from .subject import mount_rows

    rows: list[tuple[str, ...]] = []
    for segment, tilt in found.start_tilt.items():
        quat = found.subject.mounts[segment]
        x, y, z = (np.degrees(found.subject.std(row)) for row in mount_rows(segment))
        up, forward = axes_from_mount(quat)
        rows.append(
            (
                segment,
                f"{up} up, {forward} ahead",
                f"± {z:.1f}",
                f"± {np.hypot(x, y) / 2**0.5:.1f}",
                f"{np.degrees(np.linalg.norm(tilt)):.1f}",
                f"{60.0 * np.degrees(found.drift[segment]):+z.1f}",
            )
        )
    header = ("sensor", "nearest axes", "heading", "tilt", "off the start pose", "heading drift [1/min]")
    _print_table("Mounts, in deg: ± is one standard deviation", header, rows)


def _verdict(verdict: Verdict) -> None:
    import textwrap

    from rich.console import Console

    colour = {"pass": "green", "poor": "yellow", "fail": "red"}[verdict.grade]
    seen = f"the motion tells {verdict.determined} of {verdict.unknowns} unknowns better than they were known"
    console = Console(width=160)
    console.print(f"Verdict: [bold {colour}]{verdict.grade}[/] ({seen})", highlight=False)
    for text in verdict.in_words():
        _say(textwrap.fill(text, 98, initial_indent="  ", subsequent_indent="    "))


def _validation_tables(document: Document) -> None:
    """A table an experiment, and the targets."""
    from .validation import summary
    from .validation.tables import experiment_table, shared_unit, targets_table

    rows = summary(document.results)
    for experiment in dict.fromkeys(row.experiment for row in rows):
        of = [row for row in rows if row.experiment == experiment]
        trials = len({result.trial for result in document.results if result.experiment == experiment})
        unit = shared_unit(of)
        header, lines = experiment_table(of, whole=False)
        # A long name in two lines: the tables stay within 100 columns.
        header = [name if len(name) < 12 else "\n".join(name.rsplit(" ", 1)) for name in header]
        title = f"{experiment}, {trials} trial{'s' * (trials != 1)}" + (f" [{unit}]" if unit else "")
        _print_table(title + ", a quick run" * document.quick, tuple(header), [tuple(map(str, line)) for line in lines])
        _say("")
    targets = targets_table(rows)
    if targets.rows:
        cells = [tuple(str(cell).replace("**", "") for cell in row) for row in targets.rows]
        _print_table("Targets for the mean errors", tuple(targets.header), cells)
    _say("± is one standard deviation over time, averaged over the trials. The static phase's bias is removed for")
    _say("every filter but those with default gains; the heading is aligned once, where nothing is scored, and never")
    _say("fitted to the truth afterwards.")


def _driven_table(driven: Driven) -> None:
    """What became of a robot that followed."""
    shares = ", ".join(f"{100.0 * share:.1f} % {state}" for state, share in driven.share.items())
    _print_table(
        f"{driven.robot}: {driven.commands} commands, {shares}; each took "
        f"{1e3 * driven.step.quantile(0.5):.2f} ms (p50), {1e3 * driven.step.quantile(0.99):.2f} ms (p99)"
        if driven.share
        else f"{driven.robot}: {driven.commands} commands, none with a pose",
        ("arm", "hand off its aim [mm]", "in 90 % under"),
        [
            (side, *(f"{1e3 * error.quantile(share):.1f}" if error.count else "–" for share in (0.5, 0.9)))
            for side, error in driven.error.items()
        ],
    )
    if driven.skipped:
        _warn([f"{driven.skipped} commands were skipped: the machine was too slow for them; --robot-hz asks for fewer"])
    if driven.held:
        _warn([f"in {driven.held} steps links were near each other and the joints' limits left no way apart"])
    if driven.dropped:
        _warn([f"{driven.dropped} commands were not taken by the network or by their receiver"])


def _retarget_tables(found: dict[str, Any]) -> bool:
    """How well the hands follow and why they do not, and what the trajectory keeps; whether a robot can run it."""
    rows, reasons = [], []
    for side, of in found["arms"].items():
        inside, turn, swivel, possible = (
            of[key] for key in ("hand_error_mm", "hand_error_deg", "swivel_error_deg", "possible")
        )
        near = possible["hand_error_where_reachable_mm"]
        rows.append(
            (
                side,
                f"{of['scale']:.2f}",
                *((f"{error[key]:.1f}" if error else "") for error in (inside, near) for key in ("median", "p90")),
                f"{turn['median']:.1f}",
                f"{swivel['median']:.0f}" if swivel else "",
                f"{100 * possible['reachable_share']:.0f}",
            )
        )
        reasons.append((side, *(f"{100 * share:.1f}" for share in of["causes"].values())))
    header = ("arm", "scale", "hand [mm] median", "90 %", "where it can: median", "90 %", "turn [deg]",
              "elbow swivel [deg]", "can reach [%]")  # fmt: skip
    _print_table(
        f"{found['robot']}: {found['duration_s']:.1f} s for {found['recorded_s']:.1f} s recorded", header, rows
    )
    _print_table("Hand more than 20 mm off [% of the time], for", ("arm", *of["causes"]), reasons)
    margins, touched = found["limit_margins"], found["self_collision"]
    _say(
        f"Limits {'kept' if found['limits_kept'] else 'NOT KEPT'}: position {margins['position_rad']:.4f} rad, "
        f"velocity {100 * margins['velocity_share']:.1f} %, "
        f"acceleration {100 * margins['acceleration_share']:.1f} %, jerk {100 * margins['jerk_share']:.1f} % to spare"
    )
    slow = found["slowest"]
    if slow is not None:
        _say(f"Slowed most for {slow['joint']} at {slow['time']:.1f} s of the recording ({slow['what']})")
    if found["slowed_for_contact_s"]:
        moments = ", ".join(f"{moment:.1f}" for moment in found["slowed_for_contact_s"][:6])
        _say(f"Slowed so that it can stop before it touches itself, about {moments} s of the recording")
    if touched["samples_touching"]:
        _warn(
            [
                f"the robot touches itself in {touched['samples_touching']} samples, first {touched['first']}: do not "
                f"run this trajectory; a smaller --scale keeps the hands apart"
            ]
        )
    else:
        closest = touched["closest_hulls_mm"]
        _say("No self-collision" + ("" if closest is None else f"; at the closest, {closest:.0f} mm between hulls"))
    _say(f"Solved in {found['solve_ms']['p50']:.2f} ms (p50), {found['solve_ms']['p99']:.2f} ms (p99) a step")
    return bool(found["limits_kept"]) and not touched["samples_touching"]


def _mean_std(error: Any) -> str:
    return f"{error.mean:.1f} ± {error.std:.1f}"


def _norm(values: list[float]) -> float:
    return sum(v * v for v in values) ** 0.5


if __name__ == "__main__":
    main()
