"""The pages beside the result of a tracked recording that is written already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..diagnostics import Diagnostic
from ..errors import reason
from ..recording import Intervals
from ..tracking import TrackedRecording
from .decimation import Decimator, Totals
from .page import PageWriter, page_incomplete
from .track import render_track_report
from .viewer import pose_html

PAGES = ("view.html", "report.html")


def write_track_pages(
    folder: Path,
    tracked: TrackedRecording,
    *,
    view: bool = True,
    report: bool = True,
    totals: Totals | None = None,
    fps: float = 30.0,
) -> list[Diagnostic]:
    """Write ``view.html`` and ``report.html`` beside a result that is there already.

    Parameters
    ----------
    view, report : which of them
    totals : of a `tracked` that `Decimator` made
    fps : of ``view.html``

    Returns
    -------
    list[str]
        A line for each page, or part of one, that cannot be made; they stand in ``summary.json`` too.
    """
    model, recording = tracked.model, tracked.recording
    writer = PageWriter(folder, [name for name, wanted in zip(PAGES, (view, report), strict=True) if wanted])
    page = None
    if view:
        page = writer.write(
            "view.html",
            lambda _: pose_html(model, tracked.pose, phases=recording.phases, title=recording.name, fps=fps),
        )
    if report:
        writer.write(
            "report.html", lambda failures: render_track_report(tracked, view=page, totals=totals, failures=failures)
        )
    writer.save_diagnostics("summary.json")
    return writer.diagnostics


def write_decimated_pages(
    folder: Path,
    decimator: Decimator,
    phases: Mapping[str, Intervals],
    diagnostics: Sequence[Diagnostic],
    *,
    view: bool = True,
    report: bool = True,
    fps: float = 30.0,
) -> list[Diagnostic]:
    """`write_track_pages` of a recording that came in pieces; `phases` and `diagnostics` of the whole recording."""
    try:
        pose, totals = decimator.decimated(phases, diagnostics)
    except Exception as error:
        writer = PageWriter(folder, PAGES)
        writer.diagnostics.append(page_incomplete(" and ".join(PAGES), f"cannot be made: {reason(error)}"))
        writer.save_diagnostics("summary.json")
        return writer.diagnostics
    return write_track_pages(folder, pose, view=view, report=report, totals=totals, fps=fps)
