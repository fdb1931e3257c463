"""``wepose live``: track a stream while the person moves."""

from __future__ import annotations

import itertools
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadOption, ExistingOutput, one_of
from ..libraries import find_plugins, load_plugin
from . import options as opt
from . import stop_requests
from .options import described_by
from .output import print_diagnostics, print_table, say

if TYPE_CHECKING:
    from ..body import BodyModel
    from ..live import Output, SessionSummary
    from ..live.outputs import RobotOutput
    from ..live.page import LivePage

GUIDE = Parameter(group=Group("Options with --guide", sort_key=1))


@described_by("tracking/__init__.py:track", "calibration/procedure.py:calibrate")
def live(
    *,
    source: Annotated[str, Parameter(metavar="SOURCE")],
    subject: opt.Subject | None = None,
    session: opt.Session | None = None,
    setup: opt.Folder | None = None,
    guide: bool = False,
    out: opt.Out | None = None,
    record: opt.File | None = None,
    robot: opt.Robot | None = None,
    output: Annotated[tuple[str, ...] | None, Parameter(metavar="NAME:ARGUMENT")] = None,
    page: bool = True,
    open: bool = True,
    force: opt.Force = False,
    stature: Annotated[opt.Stature | None, GUIDE] = None,
    sex: Annotated[Literal["f", "m"] | None, GUIDE] = None,
    measured: Annotated[opt.Measured | None, GUIDE] = None,
    protocol: Annotated[opt.ProtocolName | None, GUIDE] = None,
    host: Annotated[opt.Address | None, opt.MORE] = None,
    port: Annotated[opt.Number, opt.MORE] = 0,
    model: Annotated[opt.Model | None, opt.MORE] = None,
    speed: Annotated[opt.Speed, opt.MORE] = "1",
    accept_failed: Annotated[bool, opt.MORE] = False,
    method: Annotated[opt.LiveMethod, opt.RESEARCH] = "amekf",
) -> None:
    """Track a person live: show the pose in the browser and the terminal, send it to programs or a robot, record it.

    Stand still in the start pose until the message says "ready". To reset the headings later, stand in the start pose
    again and press r. With --robot, r also lets a stopped robot move again. q or Ctrl-C ends the session. If it is
    killed, at most the last quarter of a second of --record is lost.

    Example: wepose live --source udp:9000 --subject anna --record morning.mcap

    Parameters
    ----------
    source
        Take samples from replay:SESSION, udp:[HOST:]PORT, lsl:NAME or a plug-in (docs/live-sources.md). Without HOST
        only this machine can send.
    subject
        SUBJECT is a subject.toml or its folder, as `wepose calibrate` writes it.
    session
        Take the mounts of the sensors from this session file; its data are not read.
    setup
        Take from this folder, of an earlier --guide, which sensor sits on which segment.
    guide
        Lead through the calibration first (docs/live.md). Needs no subject and no session.
    out
        With --guide: write subject, recordings and the sensors' setup to this folder. Without it, a new folder is
        named by the date.
    record
        Record all samples and poses in this file. Keys mark takes and phases in it. `wepose track FILE` gives the same
        poses again.
    robot
        Send joint commands with which this robot follows the person: a robot as in `wepose retarget --robot`, or a TOML
        that names the robot, its arm, UDP port, rate, margins and timeouts (docs/live-outputs.md). First bring the
        robot into the rest posture of its robot map.
    output
        Send each pose to udp:[HOST:]PORT as JSON, to lsl:NAME as a stream of the Lab Streaming Layer, or to the output
        of a plug-in (docs/live-outputs.md); may be given several times.
    page
        Serve the page that shows the pose (which only this machine can open).
    open
        Open the page in the browser.
    measured
        May be given several times.
    protocol
        In the guide it is then clasp+t_pose; a bow is added for sensors that measure only orientations, if no session
        states the torso's mount.
    host
        Serve the page on this address of this machine, such as 0.0.0.0 for all, to open it on a phone. Its URL then
        holds a token, without which nobody can open it.
    port
        Serve the page at this port; 0 takes any that is free.
    speed
        With --source replay: replay at this multiple of the recording's own speed; max is as fast as possible.
    """
    from ..live import find_setup, open_source, run_session
    from ..live.guide import GuideOptions, choose_protocol
    from ..live.log import check_absent
    from ..live.outputs import RobotOutput, read_robot
    from ..live.setup import AssignedSource, build_subject_model, check_mounts, read_segments
    from ..live.steps import run_guide
    from ..live.terminal import Keyboard, TerminalView
    from ..retargeting.targets import check_person_arms

    for option, value in {"out": out, "measured": measured, "stature": stature, "sex": sex}.items():
        if value is not None and not guide:
            raise BadOption(f"--{option}: goes with --guide, which is not given")
    # A wrong robot is found before the person does anything.
    commands, receiver = (None, "") if robot is None else read_robot(robot)
    replays = source.startswith("replay:")
    samples = open_source(source, speed=speed) if replays else None
    worn = find_setup(samples, subject, session, model)
    if worn.subject is not None and not accept_failed:
        worn.subject.check_quality()
    body = build_subject_model(worn, () if samples is None else samples.sensors)
    segments = tuple(body.table.segments)
    assigned = {} if setup is None else read_segments(setup, segments)
    if samples is None and assigned and not guide:
        stream = open_source(source, sensors=tuple(assigned), segments=tuple(assigned))
        samples = AssignedSource(stream, assigned, segments)
    elif samples is None:
        names = None if guide else tuple(worn.mounts) or None
        samples = open_source(source, sensors=names, segments=segments, any_name=guide)
    if not guide:
        check_mounts(samples, worn)
    print_diagnostics(body.diagnostics)
    outputs: list[Output] = [TerminalView(keyboard=Keyboard())]
    driven: RobotOutput | None = None
    try:
        for text in output or ():
            name, _, argument = text.partition(":")
            if name not in find_plugins("outputs"):
                raise BadOption(f"--output {text}: '{name}' is not known; {one_of(find_plugins('outputs'), name)}")
            outputs.append(load_plugin("outputs", name)(argument))
        folder = _make_guide_folder(out, force) if guide else Path()
        if record is not None:
            check_absent(record, force)
        title = worn.name if out is None else out.absolute().name
        served = _open_page(body, title, host, port, open) if page else None
        if served is not None:
            outputs.insert(0, served)
        with stop_requests() as should_stop:
            if guide:
                task, known = protocol or choose_protocol(samples, worn, body), measured or {}
                options = GuideOptions(folder, worn, body, task, method, known, stature, sex, subject, assigned)
                if commands is not None:
                    check_person_arms(commands.robot, options.joined.needs, table=body.table)
                guided = run_guide(samples, options, outputs, should_stop)
                if guided is None:
                    say("The guided session was ended before a calibration was accepted.")
                    return
                (samples, worn), paths = guided, (folder / f"session-{number}.mcap" for number in itertools.count(1))
                record = record or next(path for path in paths if not path.exists())
                body = build_subject_model(worn, samples.sensors)
            if commands is not None:
                factor = float(speed.replace("max", "inf")) if replays else 1.0
                driven = RobotOutput(commands, receiver, samples.sensors, worn.subject, body.table, factor)
                outputs.insert(0, driven)
                if not commands.collision.pairs:
                    print_diagnostics([Diagnostic("robot-shapes-missing", WARNING, driven.robot.map.name)])
            if served is not None and (guide or driven is not None):
                served.set_body(body, driven)
            summary = run_session(
                samples, worn, method=method, model=body, outputs=outputs, until=should_stop, record=record, force=force
            )
    finally:
        samples.close()
        for each in outputs:
            each.close()
    _print_end(summary, driven, record)


def _make_guide_folder(out: Path | None, force: bool) -> Path:
    folder = out or Path(time.strftime("wepose-%Y%m%d-%H%M%S"))
    if (folder / "subject.toml").exists() and not force:
        raise ExistingOutput(f"{folder}: holds a subject; --force replaces it, -o names another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ExistingOutput(f"{folder}: cannot be written: {error.strerror}; -o names another folder") from error
    return folder


def _print_end(session: SessionSummary, robot: RobotOutput | None, record: Path | None) -> None:
    import numpy as np

    print_diagnostics(session.diagnostics)
    title = "no poses: the start pose was not held"
    if session.poses:
        p50, p99 = (1e3 * np.quantile(session.latency, (0.5, 0.99))).tolist()
        latency = f"from the newest sample to its pose {p50:.2f} ms (p50), {p99:.2f} ms (p99)"
        title = f"{session.poses} poses in {session.seconds:.1f} s; {latency}"
    titles = ("sensor", "ticks without", "late", "twice", "unsound", "samples", "frozen", "cut off")
    print_table(title, titles, [(name, *map(str, counts.values())) for name, counts in session.counts.items()])
    for problem, count in session.problems.items():
        say(f"Left out: {problem}{f', {count} times' if count > 1 else ''}.")
    if robot is not None:
        posed, name = robot.states.total(), robot.robot.map.name
        shares = ", ".join(f"{100.0 * count / posed:.1f} % {state}" for state, count in robot.states.most_common())
        count = 0 if robot.newest is None else robot.newest.number + 1
        rows = [
            (side, *(f"{1e3 * np.quantile(error, share):.1f}" if error else "–" for share in (0.5, 0.9)))
            for side, error in robot.errors.items()
        ]
        title = f"{name}: {count} commands; with a pose {shares or 'none'}"
        print_table(title, ("arm", "hand off its target [mm]", "in 90 % under"), rows)
        print_diagnostics(robot.diagnostics)
    if any(each.code == "file-incomplete" for each in session.diagnostics):
        return  # which says what remains
    if session.record is not None:
        say(f"Recorded: {session.record}  (wepose track {session.record} -o DIR gives these poses again)")
    elif record is not None:
        say(f"Nothing was recorded to {record}: without the start pose there is nothing to track.")


def _open_page(model: BodyModel, title: str, host: str | None, port: int, in_browser: bool) -> LivePage:
    import webbrowser

    from ..live.page import LivePage
    from ..live.sources.udp import LOOPBACK

    page = LivePage(model, host=host or LOOPBACK, port=port, title=title)
    page.open()
    everybody = "whoever has this address can watch and press the page's buttons"
    say(f"Page: {page.url}  ({everybody if page.token else 'this machine only'})")
    if in_browser and not webbrowser.open(page.url):
        say("No browser could be started: open the page yourself.")
    return page
