"""``wepose view``: the motion of a result as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ..errors import BadOption, MissingFile
from .options import MORE, Force, Interval, OutFile, PhaseName, described_by
from .output import progress_bar, say


@described_by("writers/export.py:export")
def view(
    result: Path,
    /,
    *,
    out: OutFile | None = None,
    open: bool = True,
    force: Force = False,
    interval: Annotated[Interval | None, MORE] = None,
    phase: Annotated[PhaseName | None, MORE] = None,
) -> Path:
    """Show the motion of a result as one HTML page that opens offline.

    Example: wepose view result

    Parameters
    ----------
    result
        Folder that `wepose track` wrote.
    out
        Write the page to this file. Without it view.html in RESULT is used, and written if it is missing.
    open
        Open the page in the browser.
    """
    import webbrowser

    from ..documents import check_output, whole_file
    from ..report.viewer import pose_html
    from ..writers import load_result, select_pose

    if out is None and (interval is not None or phase is not None):
        option = f"phase {phase}" if interval is None else "interval {:g} {:g}".format(*interval)
        raise BadOption(f"--{option}: needs -o FILE; view.html in the result shows the whole recording")
    page = out or result / "view.html"
    if not (result / "pose.parquet").is_file():
        raise MissingFile(f"{result}: no pose.parquet in it; a folder that `wepose track` wrote is needed")
    if out is not None or force or not page.is_file():
        check_output(page, force)
        with progress_bar() as progress:
            progress("making the page", 0.0)
            tracked = load_result(result)
            pose = select_pose(tracked, interval, phase)
            text = pose_html(tracked.model, pose, phases=tracked.phases, title=tracked.name)
            with whole_file(page, force) as partial:
                partial.write_text(text, encoding="utf-8")
    say(f"Motion:  {page}")
    if open and not webbrowser.open(page.absolute().as_uri()):
        say("No browser could be started: open the page yourself.")
    return page
