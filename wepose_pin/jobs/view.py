"""``wepose view``: the motion of a result as a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..errors import BadOption, MissingFile
from . import Progress, no_progress


@dataclass(frozen=True)
class ViewJob:
    """Show the motion of a result as one HTML page that opens offline.

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` wrote.
    out : FILE
        Write the page to this file. Without it view.html in RESULT is used, and written if it is missing.
    interval : FROM TO
        Show only this time of the recording, in seconds; needs --out.
    phase : NAME
        Show only this phase of the recording; needs --out. Of a phase with several intervals NAME:2 is the second.
    open
        Open the page in the browser.
    force
        Write the page again if it exists.
    """

    result: Path
    out: Path | None = None
    interval: tuple[float, float] | None = None
    phase: str | None = None
    open: bool = True
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where the interval is none, or the page of a part would be taken for that of all."""
        from ..recording import check_selection

        check_selection(self.interval, self.phase)
        if self.out is None and (self.interval is not None or self.phase is not None):
            option = f"phase {self.phase}" if self.interval is None else "interval {:g} {:g}".format(*self.interval)
            raise BadOption(f"--{option}: needs -o FILE; view.html in the result shows the whole recording")


class ViewOutcome(NamedTuple):
    """What came of a `ViewJob`."""

    page: Path
    opened: bool  # in a browser


def run_view(job: ViewJob, progress: Progress = no_progress) -> ViewOutcome:
    """Make the page where it is asked for or missing, whole or not at all, and open it.

    Raises
    ------
    WeposeError
        No result; a page that exists or cannot be written.
    """
    import webbrowser

    from ..documents import check_file, whole_file
    from ..report.viewer import pose_html
    from ..writers import read_result
    from ..writers.result import read_phases

    job.check()
    page = job.out or job.result / "view.html"
    if not (job.result / "pose.parquet").is_file():
        raise MissingFile(f"{job.result}: no pose.parquet in it; a folder that `wepose track` wrote is wanted here")
    check_file(page, force=job.force or job.out is None)
    if job.out is not None or job.force or not page.is_file():
        progress("making the page", 0.0)
        pose, model, summary = read_result(job.result, job.interval, job.phase)
        text = pose_html(model, pose, phases=read_phases(summary), title=summary.get("recording", job.result.name))
        with whole_file(page, force=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return ViewOutcome(page, job.open and webbrowser.open(page.absolute().as_uri()))
