"""``wepose live``: track a stream while the person moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..diagnostics import INFO, Diagnostic
from ..errors import BadOption
from . import Arms, LiveMethod, arm_sides

if TYPE_CHECKING:
    from ..live import Output, SessionSummary
    from ..live.robot import RobotOutput, RobotSummary


@dataclass(frozen=True)
class LiveJob:
    """Track a person live: show the pose in the browser and the terminal, send it to programs or a robot, record it.

    Stand still in the start pose until the message says that it is ready. After that, stand in the start pose again and
    press r to reset the headings. With --robot, r also lets a stopped robot move again. q or Ctrl-C ends the session.
    If it is killed, at most the last second of --record is lost.

    Parameters
    ----------
    source : SOURCE
        Take samples from replay:SESSION, udp:[HOST:]PORT, lsl:NAME or mti:DEVICE=SEGMENT,... (docs/live-sources.md).
    subject : SUBJECT
        Use the lengths and mounts of this subject.toml, or of the one in this folder, as `wepose calibrate` writes it.
        Without it lengths are those of the population prior, and mounts those that --session states.
    accept_failed
        Use a subject whose calibration failed (quality = "fail" in subject.toml), which is refused otherwise.
    session : SESSION
        Take the mounts of the sensors from this session file; its data are not read.
    record : FILE
        Write all that is received and the poses to this file; `wepose track FILE` gives the same poses again.
    method
        Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), smekf (Kalman filter of
        Lisini Baldi et al. 2019, corrected in static phases), ncf (complementary filter, Mahony et al. 2008), gdc
        (gradient descent, Madgwick et al. 2011).
    model : URDF|TOML|NAME
        Use this body: a URDF, a TOML that names a URDF and its links, or the name of a body of the package
        (docs/models.md). Without it the body that the session names, else the upper body.
    speed : FACTOR
        With --source replay: replay at this speed; 1 that of the recording, 4 four times that, max as fast as possible.
    page
        Serve the page that shows the pose (which only this machine can open).
    open
        Open the page in the browser.
    port : PORT
        Serve the page at this port; 0 takes any that is free.
    udp : [HOST:]PORT
        Send each pose as JSON to this UDP port (docs/live-page.md). Without HOST to this machine.
    lsl : NAME
        Send each pose as a Lab Streaming Layer stream of this name; liblsl then listens on every interface.
    robot : NAME|FILE.urdf
        Send joint commands that let this robot follow the person (docs/live-robot.md). Names are those of `wepose
        retarget --robot`. Bring the robot into the rest posture of its map before.
    arm
        Move only this arm of the robot, or both. Without it all arms that it has. Needs --robot.
    map : TOML
        Use this map of the URDF in --robot, if none lies beside it. Needs --robot.
    to : [HOST:]PORT
        Send the robot's commands as JSON to this UDP port. Without it to port 9002 of this machine. Needs --robot.
    robot_hz : HZ
        Send this many robot commands a second.
    hold_after : SECONDS
        Brake the robot after this time without a pose. It continues by itself, slowly at first, when poses come again.
    stop_after : SECONDS
        Stop the robot after this time without a pose. It moves again only after r is pressed.
    force
        Replace the file of --record.
    """

    source: str
    subject: Path | None = None
    accept_failed: bool = False
    session: Path | None = None
    record: Path | None = None
    method: LiveMethod = "amekf"
    model: Path | None = None
    speed: str = "1"
    page: bool = True
    open: bool = True
    port: int = 0
    udp: str | None = None
    lsl: str | None = None
    robot: str | None = None
    arm: Arms | None = None
    map: Path | None = None
    to: str | None = None
    robot_hz: float = 100.0
    hold_after: float = 0.1
    stop_after: float = 1.0
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where an option of the robot is given without one."""
        for option, value in (("arm", self.arm), ("map", self.map), ("to", self.to)):
            if value is not None and self.robot is None:
                raise BadOption(f"--{option} {value}: goes with --robot, which is not given")

    @property
    def replays(self) -> bool:
        """Whether the source is a recording."""
        return self.source.startswith("replay:")


class LiveOutcome(NamedTuple):
    """Outcome of a `LiveJob`."""

    session: SessionSummary
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
    from ..subject import load_subject

    job.check()
    if job.subject is not None and not job.accept_failed:
        load_subject(job.subject).check_quality()
    stated = None if job.session is None else find_setup(None, job.subject, job.session)
    if job.replays:
        source = open_source(job.source, speed=job.speed)
        setup = stated or find_setup(source, job.subject, None)
        model = build_subject_model(setup, job.model, source.sensors)
    else:
        setup = stated or find_setup(None, job.subject, None)
        model = build_subject_model(setup, job.model)
        sensors, segments = list(setup.mounts), list(model.table.segments)
        source = open_source(job.source, sensors=sensors or None, segments=segments)
    tell(model.diagnostics)
    outputs: list[Output] = []
    robot: RobotOutput | None = None
    try:
        if job.robot is not None:
            from ..live.robot import PORT, RobotOptions, connect_robot
            from ..retargeting.stream import StreamOptions

            timing = StreamOptions(job.robot_hz, job.hold_after, job.stop_after)
            options = RobotOptions(job.robot, arm_sides(job.arm), job.map, job.to or str(PORT), timing)
            speed = float(job.speed.replace("max", "inf")) if job.replays else 1.0
            robot, source = connect_robot(options, source, setup, speed, model.table)
            outputs.append(robot)
        if job.udp is not None:
            from ..live.outputs import UdpOutput

            outputs.append(UdpOutput(job.udp))
        if job.lsl is not None:
            from ..live.outputs import LslOutput

            outputs.append(LslOutput(job.lsl))
        if job.page:
            from ..live.page import LivePage

            page = LivePage(model, port=job.port, title=setup.name)
            page.open()
            outputs.append(_add_robot_status(page, robot))
            say(f"Page: {page.url}  (this machine only)")
            if job.open:
                import webbrowser

                if not webbrowser.open(page.url):
                    tell([Diagnostic("browser-not-started", INFO)])
        outputs += [_add_robot_status(view, robot) for view in views]
        if robot is not None:
            warm_up(job.method)  # compiles before commands are due
            robot.open()
        with stop or contextlib.nullcontext(lambda: False) as until:
            summary = run_session(
                source,
                setup,
                method=job.method,
                model=model,
                record=job.record,
                force=job.force,
                outputs=outputs,
                until=until,
            )
    finally:
        for output in outputs:
            output.close()
    return LiveOutcome(summary, None if robot is None else robot.summary())


def _add_robot_status(view: Output, robot: RobotOutput | None) -> Output:
    if robot is None:
        return view
    from ..live.robot import RobotStatusView

    return RobotStatusView(view, robot)
