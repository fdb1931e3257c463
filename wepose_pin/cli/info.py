"""``wepose info``."""

from __future__ import annotations

from ..jobs.info import InfoJob, run_info
from .output import print_diagnostics, print_table, progress_bar, say
from .parser import Command


def run(job: InfoJob) -> int:
    """Say what the file is; print a session for it, or say where it was written."""
    with progress_bar() as progress:
        description, session_file, written = run_info(job, progress)
    say(description.what)
    for fact in description.facts:
        say(f"  {fact}")
    print_diagnostics(description.diagnostics)
    if description.sensors:
        header = ("sensor", "in the file", "holds", "peak rate", "median specific force", "gaps over 50 ms")
        print_table("Sensors", header, description.sensors)
    if written:
        then = description.then.replace("SESSION", str(session_file))
        check = "check the lines marked CHECK, then: " if "CHECK" in (description.session or "") else ""
        say(f"Session: {session_file}  ({check}{then})")
    elif description.session is not None:
        say(f"# A session for it; --write writes it to {session_file}")
        print(description.session, end="")
    return 0


COMMAND = Command(InfoJob, run, example="info trial.mvnx --write", arguments=("file",))
