"""``wepose live``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..diagnostics import WARNING, Diagnostic
from ..jobs.live import LiveJob, run_live
from .output import print_diagnostics, print_table, say
from .parser import Command
from .stopping import stop_requests

if TYPE_CHECKING:
    from ..live import Ended
    from ..live.robot import Driven


def run(job: LiveJob) -> int:
    """Follow the stream in the terminal; say at its end what came of it."""
    from ..live.terminal import TerminalView

    outcome = run_live(job, views=[TerminalView()], stop=stop_requests(), say=say, tell=print_diagnostics)
    ended = outcome.session
    print_diagnostics(ended.diagnostics)
    _print_session(ended)
    if outcome.robot is not None:
        _print_robot(outcome.robot)
    if ended.problem:
        reason = {"reason": ended.problem}
        print_diagnostics([Diagnostic("live-recording-incomplete", WARNING, str(job.record), facts=reason)])
    elif job.record is not None:
        again = f"  (wepose track {job.record} -o DIR gives these poses again)" if ended.poses else ""
        say(f"Recorded: {job.record}{again}")
    return 0


def _print_session(ended: Ended) -> None:
    title = "no poses: the start pose was not held"
    if ended.poses:
        p50, p99 = (1e3 * ended.latency.quantile(share) for share in (0.5, 0.99))
        title = (
            f"{ended.poses} poses in {ended.seconds:.1f} s; from the newest sample to its pose {p50:.2f} ms (p50), "
            f"{p99:.2f} ms (p99)"
        )
    print_table(
        title,
        ("sensor", "samples", "ticks without", "late", "twice", "unsound", "frozen", "cut off"),
        [
            (name, *(str(of[key]) for key in ("taken", "missing", "late", "duplicate", "bad", "frozen", "cut_off")))
            for name, of in ended.counts.items()
        ],
    )


def _print_robot(driven: Driven) -> None:
    """What became of a robot that followed."""
    title = f"{driven.robot}: {driven.commands} commands, none with a pose"
    if driven.share:
        shares = ", ".join(f"{100.0 * share:.1f} % {state}" for state, share in driven.share.items())
        p50, p99 = (1e3 * driven.step.quantile(share) for share in (0.5, 0.99))
        title = (
            f"{driven.robot}: {driven.commands} commands, {shares}; each took {p50:.2f} ms (p50), {p99:.2f} ms (p99)"
        )
    print_table(
        title,
        ("arm", "hand off its aim [mm]", "in 90 % under"),
        [
            (side, *(f"{1e3 * error.quantile(share):.1f}" if error.count else "–" for share in (0.5, 0.9)))
            for side, error in driven.error.items()
        ],
    )
    print_diagnostics(driven.diagnostics)


COMMAND = Command(LiveJob, run, example="live --source udp:9000 --subject anna --record morning.wepose")
