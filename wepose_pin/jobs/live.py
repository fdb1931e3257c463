"""``wepose live``: track a stream while the person moves."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..diagnostics import INFO, Diagnostic
from ..errors import BadOption
from . import Arms, LiveMethod

if TYPE_CHECKING:
    from ..live import Output, SensorSetup, SessionSummary
    from ..live.page import LivePage
    from ..live.robot import RobotOptions, RobotOutput, RobotSummary
    from ..live.sources.base import Source
    from ..model import BodyModel


@dataclass(frozen=True)
class LiveJob:
    """Track a person live: show the pose in the browser and the terminal, send it to programs or a robot, record it.

    Stand still in the start pose until the message says that it is ready. After that, stand in the start pose again and
    press r to reset the headings. With --robot, r also lets a stopped robot move again. q or Ctrl-C ends the session.
    If it is killed, at most the last second of --record is lost.

    Parameters
    ----------
    source : SOURCE
        Take samples from replay:SESSION, udp:[HOST:]PORT, lsl:NAME, mti:DEVICE=SEGMENT,... or slimevr:[HOST]
        (docs/live-sources.md). Without HOST only this machine can send.
    guide
        Lead through the calibration first: which sensor sits where, the start pose, the motion, its quality
        (docs/live.md). Needs no subject and no session.
    out : DIR
        With --guide: write subject, recordings and the sensors' setup to this folder. Without it to a new folder
        named by the date.
    protocol : NAME|FILE.toml
        With --guide: calibrate by this protocol, as `wepose calibrate`. Without it clasp+t_pose, and a bow after them
        for sensors that measure orientations and no accelerations where no session states the torso's mount. All but
        the first part may be skipped.
    measured : NAME=METRES
        With --guide: use this measured length, such as shoulder_width=0.385; may be given several times.
    stature : METRES
        With --guide: narrow the population prior to people of this body height.
    setup : DIR
        Take from this folder, of an earlier --guide, which sensor sits on which segment.
    subject : SUBJECT
        Use the lengths and mounts of this subject.toml, or of the one in this folder, as `wepose calibrate` writes it.
        Without it lengths are those of the population prior, and mounts those that --session states.
    accept_failed
        Use a subject whose calibration failed (quality = "fail" in subject.toml), which is refused otherwise.
    session : SESSION
        Take the mounts of the sensors from this session file; its data are not read.
    record : FILE
        Write all that is received and the poses to this file; `wepose track FILE` gives the same poses again. Without
        it the first take (key T) begins such a file, which also holds what came before the take.
    method
        Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), smekf (Kalman filter of
        Lisini Baldi et al. 2019, corrected in static phases, with an exact covariance and two more conditions of the
        static test), smekf_published (the same as published), ncf (complementary filter, Mahony et al. 2008), gdc
        (gradient descent, Madgwick et al. 2011).
    model : URDF|TOML|NAME
        Use this body: a URDF, a TOML that names a URDF and its links, or the name of a body of the package
        (docs/models.md). Without it the body that the session names, else the upper body.
    speed : FACTOR
        With --source replay: replay at this speed; 1 is that of the recording, 4 is four times that, max is as fast as
        possible.
    page
        Serve the page that shows the pose (which only this machine can open).
    open
        Open the page in the browser.
    host : ADDRESS
        Serve the page on this address of this machine, such as 0.0.0.0 for all, to open it on a phone. Its URL then
        holds a token, without which nobody can open it. Without --host this machine alone can open the page.
    port : PORT
        Serve the page at this port; 0 takes any that is free.
    udp : [HOST:]PORT
        Send each pose as JSON to this UDP port (docs/live-outputs.md). Without HOST to this machine.
    lsl : NAME
        Send each pose as a Lab Streaming Layer stream of this name; liblsl then listens on every interface.
    robot : NAME|FILE
        Send joint commands that let this robot follow the person (docs/live-outputs.md): one of the names of `wepose
        retarget --robot`, a URDF with a robot map beside it (ARM.urdf, ARM.toml), or the robot map. First bring the
        robot into the rest posture of its robot map.
    arm
        Move only this arm of the robot, or both. Without it all arms that it has. Needs --robot.
    to : [HOST:]PORT
        Send the robot's commands as JSON to this UDP port. Without it to port 9002 of this machine. Needs --robot.
    robot_hz : HZ
        Send this many robot commands a second.
    speed_scale : SHARE
        Use this share of the robot's limits of velocity, acceleration and jerk, above 0, up to 1.
    limit_margin : RAD
        Keep this distance from the robot's position limits, in radians; from those of a prismatic joint a tenth of it,
        in metres.
    hold_after : SECONDS
        Brake the robot after this time without a pose. It continues by itself, slowly at first, when poses come again.
    stop_after : SECONDS
        Stop the robot after this time without a pose. It moves again only after r is pressed.
    force
        Replace the file of --record.
    """

    source: str
    guide: bool = False
    out: Path | None = None
    protocol: str | None = None
    measured: Mapping[str, float] = field(default_factory=dict)
    stature: float | None = None
    setup: Path | None = None
    subject: Path | None = None
    accept_failed: bool = False
    session: Path | None = None
    record: Path | None = None
    method: LiveMethod = "amekf"
    model: Path | None = None
    speed: str = "1"
    page: bool = True
    open: bool = True
    host: str | None = None
    port: int = 0
    udp: str | None = None
    lsl: str | None = None
    robot: str | None = None
    arm: Arms | None = None
    to: str | None = None
    robot_hz: float = 100.0
    speed_scale: float = 0.9
    limit_margin: float = 0.05
    hold_after: float = 0.1
    stop_after: float = 1.0
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where an option of the robot or the guide is given without one."""
        guided = {"out": self.out, "measured": self.measured or None, "stature": self.stature}
        for option, given in guided.items():
            if given is not None and not self.guide:
                raise BadOption(f"--{option}: goes with --guide, which is not given")
        for option, value in (("arm", self.arm), ("to", self.to)):
            if value is not None and self.robot is None:
                raise BadOption(f"--{option} {value}: goes with --robot, which is not given")

    @property
    def replays(self) -> bool:
        """Whether the source is a recording."""
        return self.source.startswith("replay:")


class LiveOutcome(NamedTuple):
    """Outcome of a `LiveJob`."""

    session: SessionSummary | None  # None: the guided session was ended before tracking
    robot: RobotSummary | None


def run_live(
    job: LiveJob,
    *,
    views: Sequence[Output] = (),
    stop: contextlib.AbstractContextManager[Callable[[], bool]] | None = None,
    say: Callable[[str], None] = lambda _: None,
    tell: Callable[[Sequence[Diagnostic]], None] = lambda _: None,
) -> LiveOutcome:
    """Track a stream to its end.

    Parameters
    ----------
    views : outputs that show the user the person and the state of the robot
    stop : context of a function that returns True to stop
    say, tell : called with the page's address, and with diagnostics, before the stream begins

    Raises
    ------
    WeposeError
        What the source, the subject, the robot or an option lacks.
    """
    from ..live import find_setup, open_source, run_session
    from ..live.loop import build_subject_model, warm_up
    from ..live.session import check_mounts
    from ..subject import load_subject

    job.check()
    # A wrong robot is found before the person does anything.
    following = None if job.robot is None else _load_robot(job, job.robot)
    if job.subject is not None and not job.accept_failed:
        load_subject(job.subject).check_quality()
    setup: SensorSetup
    stated = None if job.session is None else find_setup(None, job.subject, job.session)
    if job.replays:
        source = open_source(job.source, speed=job.speed)
        setup = stated or find_setup(source, job.subject, None)
        model = build_subject_model(setup, job.model, source.sensors)
    else:
        setup = stated or find_setup(None, job.subject, None)
        model = build_subject_model(setup, job.model)
        source = _open_stream(job, setup, model)
    if not job.guide:
        check_mounts(source, setup)  # before the page opens
    tell(model.diagnostics)
    outputs: list[Output] = list(views)
    robot: RobotOutput | None = None
    title = job.out.absolute().name if job.out is not None else setup.name
    record, page = job.record, _open_page(job, model, title, say, tell)
    if page is not None:
        outputs.insert(0, page)
    try:
        with stop or contextlib.nullcontext(lambda: False) as until:
            if job.guide:
                from .guide import run_guide

                guided = run_guide(job, source, setup, model, outputs, until)
                if guided is None:
                    return LiveOutcome(None, None)
                source, setup, record = guided.source, guided.setup, record or _name_recording(guided.folder)
                model = build_subject_model(setup, job.model, source.sensors)
            if following is not None:
                from ..live.robot import connect_robot

                speed = float(job.speed.replace("max", "inf")) if job.replays else 1.0
                robot, source = connect_robot(following, source, setup, speed, model.table)
            if page is not None and (job.guide or robot is not None):
                page.set_body(model, None if robot is None else robot.figure(model))
            if robot is not None:
                outputs.insert(0, robot)
            outputs += _open_senders(job)
            if robot is not None:
                warm_up(job.method)  # compiles before commands are due
                robot.open()
            summary = run_session(
                source,
                setup.with_model(job.model),
                method=job.method,
                model=model,
                record=record,
                force=job.force,
                outputs=outputs,
                until=until,
            )
    finally:
        for output in outputs:
            output.close()
    return LiveOutcome(summary, None if robot is None else robot.summary())


def _open_stream(job: LiveJob, setup: SensorSetup, model: BodyModel) -> Source:
    """The source of a stream, not yet opened; with the segments of --setup."""
    from ..live import open_source
    from ..live.assignment import AssignedSource, read_segments

    sensors, segments = list(setup.mounts), list(model.table.segments)
    if job.guide:
        return open_source(job.source, segments=segments, any_name=True)
    if job.setup is None:
        return open_source(job.source, sensors=sensors or None, segments=segments)
    assigned = read_segments(job.setup, segments)
    source = open_source(job.source, sensors=list(assigned), segments=list(assigned))
    return AssignedSource(source, assigned, segments)


def _open_page(
    job: LiveJob, model: BodyModel, title: str, say: Callable[[str], None], tell: Callable[[Sequence[Diagnostic]], None]
) -> LivePage | None:
    """Serve the page, and say where; None where it is not wanted."""
    if not job.page:
        return None
    from ..live.addresses import LOOPBACK
    from ..live.page import LivePage

    page = LivePage(model, host=job.host or LOOPBACK, port=job.port, title=title)
    page.open()
    if "token=" in page.url:
        say(f"Page: {page.url}")
        say("Whoever reaches this machine there and has this address can watch and press the page's buttons.")
    else:
        say(f"Page: {page.url}  (this machine only)")
    if job.open:
        import webbrowser

        if not webbrowser.open(page.url):
            tell([Diagnostic("browser-not-started", INFO)])
    return page


def _load_robot(job: LiveJob, name: str) -> RobotOptions:
    """The robot, and how it is to follow."""
    from ..calibration import load_protocol
    from ..calibration.protocols import GUIDED
    from ..live.robot import PORT, RobotOptions
    from ..retargeting import LimitMargins, find_map, load_robot
    from ..retargeting.maps import list_sides
    from ..retargeting.stream import StreamOptions, check_segments

    timing = StreamOptions(job.robot_hz, job.hold_after, job.stop_after)
    margins = LimitMargins(job.speed_scale, job.limit_margin)
    robot = load_robot(find_map(name), list_sides(job.arm), margins)
    if job.guide:
        check_segments(robot, load_protocol(job.protocol or GUIDED).needs)
    return RobotOptions(robot, job.to or str(PORT), timing)


def _open_senders(job: LiveJob) -> list[Output]:
    """Outputs for other programs."""
    senders: list[Output] = []
    if job.udp is not None:
        from ..live.outputs import UdpOutput

        senders.append(UdpOutput(job.udp))
    if job.lsl is not None:
        from ..live.outputs import LslOutput

        senders.append(LslOutput(job.lsl))
    return senders


def _name_recording(folder: Path) -> Path:
    """A file in the folder that is not there yet."""
    number = next(n for n in itertools.count(1) if not (folder / f"session-{n}.mcap").exists())
    return folder / f"session-{number}.mcap"
