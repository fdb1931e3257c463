"""The pages of a tracked motion: beside its result, in a saved folder, and in a notebook."""

from __future__ import annotations

import shutil
import sys
import tempfile
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path

from markupsafe import escape

from ..diagnostics import Diagnostic
from ..documents import whole_file
from ..tracking import TrackResult, TrackSummary, summarize
from ..writers.provenance import CALL, collect_provenance, result_folder
from ..writers.result import write_about, write_poses
from .page import write_pages
from .viewer import pose_html

FRAME_HEIGHT = 560  # [px] of the view page in a notebook


def write_track_pages(
    folder: Path, summary: TrackSummary, *, view: bool = True, report: bool = True
) -> list[Diagnostic]:
    """Write ``view.html`` and ``report.html`` beside a result; as `write_pages`."""
    tracked, recording = summary.tracked, summary.tracked.recording

    def make_view() -> str:
        return pose_html(tracked.model, tracked.pose, phases=recording.phases, title=recording.name)

    def make_report() -> str:
        from .track import render_track_report  # with it comes matplotlib

        return render_track_report(summary)

    pages = {"view.html": make_view if view else None, "report.html": make_report if report else None}
    return write_pages(folder, pages)


def save_result(result: TrackResult, folder: str | Path, force: bool = False) -> Path:
    """Write what `wepose track -o` writes, whole or not at all, and return the folder; as `TrackResult.save`."""
    out, source = Path(folder), result.source
    with result_folder(out, force) as partial:
        if isinstance(source, Path):
            for file in source.iterdir():
                if file.is_file():
                    shutil.copyfile(file, partial / file.name)
            return out
        summary = summarize(result)
        # Inputs and options of `track`, under the names that they have in `wepose track`.
        inputs = {"session": result.recording.source, "subject": result.subject.name, "model": result.model.table.name}
        write_poses(partial, [result])
        write_about(partial, result, summary, provenance=collect_provenance(CALL, inputs | dict(result.options)))
    write_track_pages(out, summary)
    return out


@dataclass(frozen=True)
class ViewPage:
    """The page that plays a motion, which opens offline; a notebook shows it in a frame."""

    title: str  # of the motion
    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        look = f'sandbox="allow-scripts" style="width:100%;height:{FRAME_HEIGHT}px;border:0"'
        return f'<iframe title="{escape(self.title)}" {look} srcdoc="{escape(self.html)}"></iframe>'

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the page to a file and return its path; `ExistingOutput` where it is there, without `force`."""
        with whole_file(Path(path), force) as partial:
            partial.write_text(self.html, encoding="utf-8")
        return Path(path)

    def open(self) -> bool:
        """Open the page in the browser, from a temporary file; returns whether there is one."""
        file = Path(tempfile.mkdtemp(prefix="wepose-")) / "view.html"
        return webbrowser.open(self.save(file).as_uri())


def show_result(result: TrackResult, open: bool = True) -> ViewPage:
    """Return the page that plays the motion, and open it in the browser where `open` and this is no notebook."""
    page = ViewPage(result.name, pose_html(result.model, result.pose, phases=result.phases, title=result.name))
    if open and "ipykernel" not in sys.modules:
        page.open()
    return page
