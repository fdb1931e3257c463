"""``wepose view``."""

from __future__ import annotations

from ..jobs.view import ViewJob, run_view
from .output import note, progress_bar, say
from .parser import Command


def run(job: ViewJob) -> int:
    """Show the page; say where it lies."""
    with progress_bar() as progress:
        outcome = run_view(job, progress)
    say(f"Motion to look at:  {outcome.page}")
    if job.open and not outcome.opened:
        note(["no browser could be started; open the page yourself"])
    return 0


COMMAND = Command(ViewJob, run, example="view result", arguments=("result",))
