"""The pages of a tracked recording beside its result, and both written to a folder."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path

from ..diagnostics import Diagnostic
from ..tracking import TrackResult, TrackSummary, summarize
from ..writers import write_result
from ..writers.folder import result_folder
from ..writers.provenance import CALL, collect_provenance
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


def save_result(result: TrackResult, folder: str | Path, force: bool = False) -> Path:
    """Write what `wepose track -o` writes, whole or not at all, and return the folder; as `TrackResult.save`."""
    out, source = Path(folder), result.source
    with result_folder(out, force) as partial:
        if isinstance(source, Path):
            for file in source.iterdir():
                if file.is_file():
                    shutil.copyfile(file, partial / file.name)
            return out
        summary, options = summarize(result), result.options
        # Inputs and options of `track`, under the names that they have in `wepose track`.
        inputs = {"session": result.recording.source, "subject": result.subject.name, "model": result.model.table.name}
        inputs |= {field.name: getattr(options, field.name) for field in fields(options)}
        write_result(partial, result, summary, provenance=collect_provenance(CALL, inputs))
    write_track_pages(out, summary)
    return out
