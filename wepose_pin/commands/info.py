"""``wepose info``: what a file is, and a session for it."""

from __future__ import annotations

from pathlib import Path

from ..errors import BadOption
from .options import Force, Model, OutFile
from .output import print_diagnostics, print_table, progress_bar, say


def info(
    file: Path,
    /,
    *,
    write: bool = False,
    out: OutFile | None = None,
    model: Model | None = None,
    force: Force = False,
) -> None:
    """Describe a file, its sensors, rates and gaps, and propose a session file for it.

    Prints the description and the proposal; writes nothing without --write or -o. Reads tables, the files of many
    sensors and programs (docs/formats.md), recordings of `wepose live`, sessions, subjects and results. Entries of the
    proposed session that are guesses are marked CHECK.

    Example: wepose info trial.mvnx --write

    Parameters
    ----------
    file
        A file, or a folder with one recording or with one file for each sensor.
    write
        Write the session to session.toml beside the file.
    out
        Write the session to this file.
    model
        Propose the segments of this body, such as whole_body (docs/models.md). Without it, those of the upper body.
    """
    from ..body import load_model
    from ..documents import check_output, whole_file
    from ..readers.describe import describe_file, find_file

    with progress_bar() as progress:
        progress("reading", 0.0)
        body = None if model is None else load_model(model).table
        file = find_file(file, body)
        session = out or file.absolute().parent / "session.toml"
        writes = write or out is not None
        if writes:
            check_output(session, force)
        description = describe_file(file, session.absolute().parent, body, None if model is None else Path(model))
        if writes:
            if description.session is None:
                raise BadOption(f"--write: there is no session to write for {file}: {description.title}")
            with whole_file(session, force) as partial:
                partial.write_text(description.session, encoding="utf-8")
    say(f"{file}: {description.title}")
    for fact in description.facts:
        say(f"  {fact}")
    print_diagnostics(description.diagnostics)
    if description.recording is not None:
        header = ("sensor", "in the file", "holds", "peak rate", "median specific force", "gaps over 50 ms")
        print_table("Sensors", header, list(description.list_sensors()))
    if writes:
        then = description.then.replace("SESSION", str(session))
        check = "check the lines marked CHECK, then: " if "CHECK" in (description.session or "") else ""
        say(f"Session: {session}  ({check}{then})")
    elif description.session is not None:
        say(f"# A session for it; --write writes it to {session}")
        print(description.session, end="")
