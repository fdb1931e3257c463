"""``wepose view``."""

from __future__ import annotations

from ..diagnostics import INFO, Diagnostic
from ..jobs.view import ViewJob, run_view
from .output import print_diagnostics, progress_bar, say
from .parser import Command


def run(job: ViewJob) -> int:
    """Show the page; say where it lies."""
    with progress_bar() as progress:
        outcome = run_view(job, progress)
    say(f"Motion:  {outcome.page}")
    if job.open and not outcome.opened:
        print_diagnostics([Diagnostic("browser-not-started", INFO)])
    return 0


COMMAND = Command(ViewJob, run, example="view result", arguments=("result",))
