"""What a notebook shows of a motion: the report's figures, and the view page."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import webbrowser
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import escape

from ..angles import joint_angles
from ..documents import whole_file, whole_folder
from ..errors import BadData, UnknownKey, one_of
from ..kinematics import PosedBody
from ..tracking.measures import measure_tips
from .chart import Picture
from .joints import draw_joint_angles
from .page import load_template
from .track_figures import draw_paths, draw_reach, find_sides, group_tips

FRAME_HEIGHT = 560  # [px] of the view page in a notebook


@dataclass(frozen=True)
class Figure:
    """A figure as SVG; a notebook shows it.

    Parameters
    ----------
    caption : what it shows, in a sentence or two
    svg : a whole SVG file
    """

    caption: str
    svg: str

    def _repr_svg_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        return f"Figure({self.caption!r})"

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the SVG to a file and return its path.

        Raises
        ------
        ExistingOutput
            The file is there and `force` is not given, or it cannot be written.
        """
        with whole_file(Path(path), force) as partial:
            partial.write_text(self.svg, encoding="utf-8")
        return Path(path)


class Figures(Mapping[str, Figure]):
    """Figures by name; a notebook shows all of them.

    Parameters
    ----------
    figures : name → figure, such as ``paths``, ``reach``, ``angles-elbow``
    """

    def __init__(self, figures: Mapping[str, Figure]) -> None:
        self._figures = dict(figures)

    def __getitem__(self, name: str) -> Figure:
        if name not in self._figures:
            raise UnknownKey(f"no figure '{name}'; {one_of(self._figures, name)}")
        return self._figures[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._figures)

    def __len__(self) -> int:
        return len(self._figures)

    def __repr__(self) -> str:
        return f"Figures({', '.join(self._figures)})"

    def _repr_html_(self) -> str:
        return "\n".join(
            f"<figure>{figure.svg}<figcaption>{escape(figure.caption)}</figcaption></figure>"
            for figure in self._figures.values()
        )

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write each figure to ``<name>.svg`` in a folder and return the folder.

        Raises
        ------
        ExistingOutput
            The folder is not empty and `force` is not given, or it cannot be written.
        """
        with whole_folder(Path(folder), force) as partial:
            for name, figure in self._figures.items():
                figure.save(partial / f"{name}.svg")
        return Path(folder)


def draw_figures(body: PosedBody) -> Figures:
    """Draw the paths of the hands and their reach, and the joint angles, of what is known."""
    table = body.model.table
    tips = measure_tips(body.pose, body.rate_hz, table) if len(body.time) > 1 else {}
    pictures: list[Picture] = []
    for k, group in enumerate(group_tips(tips, table, body.subject.lengths)):
        number, sides = f"-{k + 1}" if k else "", find_sides(tips, table)
        pictures += [
            draw_paths(group, sides, f"paths{number}"),
            draw_reach(body.time, group, sides, f"reach{number}"),
        ]
    with contextlib.suppress(BadData):  # no joint has both of its segments
        pictures += draw_joint_angles(joint_angles(body.pose))
    chart: Any = load_template("report/templates/chart.svg.j2").module
    return Figures(
        {each.stem: Figure(each.caption, str(chart.svg(each, standalone=True)).strip()) for each in pictures}
    )


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


def runs_in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    find_shell = getattr(sys.modules.get("IPython"), "get_ipython", None)
    return find_shell is not None and hasattr(find_shell(), "kernel")
