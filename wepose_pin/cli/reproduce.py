"""``wepose reproduce``."""

from __future__ import annotations

from ..jobs.reproduce import ReproduceJob
from .output import print_diagnostics, progress_bar, say
from .parser import Command


def run(job: ReproduceJob) -> int:
    """Make the result again; print what differs."""
    from ..batch import run_reproduce

    with progress_bar() as progress:
        outcome = run_reproduce(job, progress)
    print_diagnostics(outcome.diagnostics)
    result = "different" if outcome.differences else "the same"
    say(f"{job.result}: {result}, made again by wepose {outcome.command}" + ":" * bool(outcome.differences))
    for line in outcome.differences:
        say(f"  {line}")
    return 3 if outcome.differences else 0


COMMAND = Command(
    ReproduceJob,
    run,
    example="reproduce result",
    arguments=("result",),
    exit_codes="0 bit-identical, 3 different; 2 it cannot be run again: an input is missing or has changed.",
)
