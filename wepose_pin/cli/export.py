"""``wepose export``."""

from __future__ import annotations

from ..jobs.export import ExportJob, run_export
from .output import print_diagnostics, progress_bar, say
from .parser import Command


def run(job: ExportJob) -> int:
    """Write the file; say what it cannot hold."""
    with progress_bar() as progress:
        written = run_export(job, progress)
    print_diagnostics(written.diagnostics)
    say(f"Written: {job.out}  ({written.format})")
    return 0


COMMAND = Command(ExportJob, run, example="export result -o circles.trc", arguments=("result", "further"))
