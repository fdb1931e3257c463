"""What a notebook shows of a motion: the report's figures, and the view page."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import webbrowser
from dataclasses import dataclass
from pathlib import Path

from markupsafe import escape

from ..angles import AUTO, joint_angles
from ..documents import whole_file
from ..errors import BadData
from ..tracking import TrackResult
from ..tracking.measures import measure_tips
from .angles import draw_joint_angles
from .figures import Figures
from .track import draw_tips, group_tips
from .viewer import pose_html

FRAME_HEIGHT = 560  # [px] of the view page in a notebook


def draw_figures(result: TrackResult) -> Figures:
    """Draw the paths of the hands and their reach, and the joint angles, of what is known."""
    figures, table = Figures(), result.model.table
    tips = measure_tips(result.pose, result.rate_hz, table) if len(result.time) > 1 else {}
    if tips:
        figures |= draw_tips(result.time, group_tips(tips, table, result.subject.lengths), table)
    with contextlib.suppress(BadData):  # no joint has both of its segments
        figures["angles"] = draw_joint_angles(joint_angles(result.pose, AUTO))
    return figures


@dataclass(frozen=True)
class ViewPage:
    """The page that plays a motion; a notebook shows it in a frame.

    Parameters
    ----------
    title : of the motion
    html : the whole page, which opens offline
    """

    title: str
    html: str

    def __repr__(self) -> str:
        return f"ViewPage({self.title!r}, {len(self.html) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{FRAME_HEIGHT}px;border:0"
        return (
            f'<iframe title="{escape(self.title)}" sandbox="allow-scripts" style="{style}" '
            f'srcdoc="{escape(self.html)}"></iframe>'
        )

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the page to a file and return its path.

        Raises
        ------
        ExistingOutput
            The file is there and `force` is not given, or it cannot be written.
        """
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
    if open and not runs_in_notebook():
        page.open()
    return page


def runs_in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    find_shell = getattr(sys.modules.get("IPython"), "get_ipython", None)
    return find_shell is not None and hasattr(find_shell(), "kernel")
