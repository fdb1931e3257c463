"""The pages beside the result of a tracked recording that is written already."""

from __future__ import annotations

from pathlib import Path

from ..diagnostics import Diagnostic
from ..tracking import TrackSummary
from .page import PageWriter
from .viewer import pose_html

PAGES = ("view.html", "report.html")


def write_track_pages(
    folder: Path, summary: TrackSummary, *, view: bool = True, report: bool = True, fps: float = 30.0
) -> list[Diagnostic]:
    """Write ``view.html`` and ``report.html`` beside a result that is there already.

    Parameters
    ----------
    view, report : which of them
    fps : of ``view.html``

    Returns
    -------
    list of Diagnostic
        Pages, or parts of them, that cannot be made; they stand in ``summary.json`` too.
    """
    writer = PageWriter(folder, [name for name, wanted in zip(PAGES, (view, report), strict=True) if wanted])

    def render_view(_: list[str]) -> str:
        tracked, recording = summary.tracked, summary.tracked.recording
        return pose_html(tracked.model, tracked.pose, phases=recording.phases, title=recording.name, fps=fps)

    page = writer.write("view.html", render_view) if view else None
    if report:
        from .track import render_track_report  # with it comes matplotlib

        writer.write("report.html", lambda failures: render_track_report(summary, view=page, failures=failures))
    writer.save_diagnostics("summary.json")
    return writer.diagnostics
