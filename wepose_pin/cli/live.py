"""``wepose live``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..diagnostics import WARNING, Diagnostic
from ..jobs.live import LiveJob, run_live
from .output import print_diagnostics, print_table, say
from .parser import Command
from .stopping import stop_requests

if TYPE_CHECKING:
    from ..live import SessionSummary
    from ..live.robot import RobotSummary


def run(job: LiveJob) -> int:
    """Track the stream in the terminal; print a summary at its end."""
    from ..compilation import announce_compilation
    from ..live.terminal import TerminalView

    announce_compilation()  # a stream is waiting
    outcome = run_live(job, views=[TerminalView()], stop=stop_requests(), say=say, tell=print_diagnostics)
    session = outcome.session
    if session is None:
        say("The guided session was ended before a calibration was accepted.")
        return 0
    print_diagnostics(session.diagnostics)
    _print_session(session)
    if outcome.robot is not None:
        _print_robot(outcome.robot)
    if session.problem:
        reason = {"reason": session.problem}
        print_diagnostics([Diagnostic("live-recording-incomplete", WARNING, str(session.record), facts=reason)])
    elif session.record is not None:
        again = f"  (wepose track {session.record} -o DIR gives these poses again)"
        say(f"Recorded: {session.record}{again}")
    elif job.record is not None:
        say(f"Nothing was recorded to {job.record}: without the start pose there is nothing to track.")
    return 0


def _print_session(session: SessionSummary) -> None:
    title = "no poses: the start pose was not held"
    if session.poses:
        p50, p99 = (1e3 * session.latency.quantile(share) for share in (0.5, 0.99))
        title = (
            f"{session.poses} poses in {session.seconds:.1f} s; from the newest sample to its pose {p50:.2f} ms (p50), "
            f"{p99:.2f} ms (p99)"
        )
    print_table(
        title,
        ("sensor", "samples", "lost", "ticks without", "late", "twice", "unsound", "frozen", "cut off"),
        [
            (
                name,
                *(
                    str(counts[key])
                    for key in ("taken", "lost", "missing", "late", "duplicate", "bad", "frozen", "cut_off")
                ),
            )
            for name, counts in session.counts.items()
        ],
    )


def _print_robot(robot: RobotSummary) -> None:
    title = f"{robot.robot}: {robot.commands} commands, none with a pose"
    if robot.share:
        shares = ", ".join(f"{100.0 * share:.1f} % {state}" for state, share in robot.share.items())
        p50, p99 = (1e3 * robot.step.quantile(share) for share in (0.5, 0.99))
        took = f"each took {p50:.2f} ms (p50), {p99:.2f} ms (p99)"
        title = f"{robot.robot}: {robot.commands} commands; with a pose {shares}; {took}"
    print_table(
        title,
        ("arm", "hand off its target [mm]", "in 90 % under"),
        [
            (side, *(f"{1e3 * error.quantile(share):.1f}" if error.count else "–" for share in (0.5, 0.9)))
            for side, error in robot.error.items()
        ],
    )
    print_diagnostics(robot.diagnostics)


ON_YOUR_OWN = "--udp sends each pose as JSON, from which examples/live_consumer.py shows how to go on"
COMMAND = Command(
    LiveJob,
    run,
    example="live --source udp:9000 --subject anna --record morning.mcap",
    removed={"--mvn": ON_YOUR_OWN, "--vmc": ON_YOUR_OWN},
)
