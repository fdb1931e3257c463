"""``wepose reproduce``."""

from __future__ import annotations

from ..jobs.reproduce import ReproduceJob
from .output import print_diagnostics, progress_bar, say
from .parser import Command


def run(job: ReproduceJob) -> int:
    """Make the result again; say what differs."""
    from ..batch import run_reproduce

    with progress_bar() as progress:
        found = run_reproduce(job, progress)
    print_diagnostics(found.diagnostics)
    same = "different" if found.differences else "the same"
    say(f"{job.result}: {same}, made again by wepose {found.command}" + ":" * bool(found.differences))
    for line in found.differences:
        say(f"  {line}")
    return 3 if found.differences else 0


COMMAND = Command(
    ReproduceJob,
    run,
    example="reproduce result",
    arguments=("result",),
    exit_codes="0 the same, 3 different. 2: it cannot be made again, as an input is gone or has changed.",
)
