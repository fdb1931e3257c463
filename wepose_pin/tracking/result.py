"""`TrackResult`: a body and its motion, with what made it; it prints, draws, shows and saves itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from ..body import BodyModel
from ..body.configuration import solve_configuration
from ..body.kinematics import Pose, build_pose_table, find_usual_rate
from ..body.subject import Subject
from ..diagnostics import WARNING, Diagnostic, notebook_html
from ..errors import BadData, Named, WeposeError
from ..recording import Intervals, Recording
from .headings import HeadingCorrection
from .segment_orientations import SegmentOrientations

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class TrackResult:
    """The motion of a body, as `track` computes it and `load_result` reads it from a folder.

    It prints itself in one line, and a notebook shows its diagnostics too. `export`, `retarget`, `joint_angles` and
    `evaluate` take it as it is. `time` (n,) [s], `quat_WL` segment → (n, 4) xyzw, `points` point → (n, 3) [m] in W and
    `q` (n, nq) are the pose's; `pose` also has their covariances.
    """

    name: str  # of the recording, as titles and files state it
    pose: Pose  # in W, n samples
    model: BodyModel  # the body with the subject's lengths
    subject: Subject  # lengths and mounts as used
    phases: Mapping[str, Intervals] = field(default_factory=dict)  # name → intervals [s] of the recording
    # From `track` the recording and the intermediate results, also as `recording` and `segments`; from `load_result`
    # the folder; None: made in code.
    source: SegmentOrientations | Path | None = None
    correction: HeadingCorrection | None = None  # of the headings so far; None where nothing can correct them
    # The content of ``summary.json``, and what the user should know; both empty of a chunk (`track_chunks`).
    summary: Mapping[str, Any] = field(default_factory=dict)
    diagnostics: tuple[Diagnostic, ...] = ()

    @property
    def time(self) -> np.ndarray:
        """(n,) [s]."""
        return self.pose.time

    @property
    def rate_hz(self) -> float:
        """One over the usual time step, to six digits; NaN of one sample."""
        return find_usual_rate(self.time)

    @property
    def where(self) -> str:
        """Its folder or name, for the beginning of an error's text."""
        return str(self.source) if isinstance(self.source, Path) else self.name

    @property
    def quat_WL(self) -> Mapping[str, np.ndarray]:
        """Segment → (n, 4) xyzw."""
        return Named("segment", self.pose.quat_WL)

    @property
    def points(self) -> Mapping[str, np.ndarray]:
        """Point → (n, 3) [m] in W."""
        return Named("point", self.pose.points)

    @property
    def joints(self) -> Mapping[str, np.ndarray]:
        """Joint of one axis → its values (n,) [rad or m]; of a mechanism."""
        return Named("joint", self.pose.joints)

    @cached_property
    def q(self) -> np.ndarray:
        """(n, nq) configuration of `model`."""
        return solve_configuration(self.model, self.quat_WL) if self.pose.q is None else self.pose.q

    @property
    def segments(self) -> SegmentOrientations:
        """The recording with its intermediate results; raises `BadData` where the result does not come from `track`."""
        if not isinstance(self.source, SegmentOrientations):
            raise BadData(f"{self.name}: only a result of `wp.track` has its recording, not one that was read or made")
        return self.source

    @property
    def recording(self) -> Recording:
        """The input; of a causal tracker the part after the start pose. Raises as `segments`."""
        return self.segments.recording

    @property
    def options(self) -> Mapping[str, Any]:
        """How it was tracked: `method` and others of `track` by their names. Raises as `segments`."""
        return self.segments.options

    def check(self) -> TrackResult:
        self.pose.check()
        return self

    def to_dataframe(self) -> pl.DataFrame:
        """Return the table of ``pose.parquet``, a row a sample, as polars has it.

        Columns: ``time`` [s]; ``<segment>_qx,_qy,_qz,_qw``, segment to W, and ``<segment>_std`` [rad];
        ``<point>_x,_y,_z`` [m] in W and ``<point>_std`` [m]; ``<segment>_gap``, true where the sensor lost samples.
        A ``_std`` is one standard deviation of one axis.

        Examples
        --------
        >>> result.to_dataframe().columns[:6]
        ['time', 'torso_qx', 'torso_qy', 'torso_qz', 'torso_qw', 'torso_std']
        """
        return build_pose_table(self.pose)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table of `to_dataframe` as pandas has it; raises `WeposeError` where pandas is not installed.

        Examples
        --------
        >>> result.to_pandas()[["time", "right_palm_x", "right_palm_std"]].shape == (len(result.time), 3)
        True
        """
        try:
            import pandas
        except ImportError:
            raise WeposeError("to_pandas: needs pandas: pip install pandas") from None
        table = self.to_dataframe()
        return pandas.DataFrame({name: table[name].to_numpy() for name in table.columns})

    # Figures, pages and files are rooms above this one; the package, which knows all rooms, has their functions.

    def plot(self) -> dict[str, Figure]:
        """Draw the report's figures: paths and reach of the hands, joint angles.

        Name → `matplotlib.figure.Figure`, to be changed as you like and saved by its ``savefig``. A notebook shows
        them; ``figures.save(folder)`` writes an SVG each.

        Examples
        --------
        >>> figures = result.plot()
        >>> list(figures)
        ['paths', 'reach', 'angles']
        >>> figures["angles"].set_size_inches(7.0, 4.0)
        >>> figures["angles"].savefig("angles.pdf")
        """
        from .. import draw_figures

        return draw_figures(self)

    def show(self, open: bool = True) -> Any:
        """Show the motion in 3D: in a notebook in its cell, else in the browser unless `open` is false.

        ``page.save(path)`` writes the page that it gives to a file, which opens offline.

        Examples
        --------
        >>> page = result.show(open=False)
        >>> page.save("view.html")
        PosixPath('view.html')
        """
        from .. import show_result

        return show_result(self, open)

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write what `wepose track -o` writes, whole or not at all, and return the folder.

        The summary says what made it: versions, options, and the file of the recording with its hash where it was read
        from one. Of a result that `load_result` read, its files are copied. `force` replaces an earlier result there;
        without it a folder that is not empty is `ExistingOutput`.

        Examples
        --------
        >>> result.save("result")
        PosixPath('result')
        """
        from .. import save_result

        return save_result(self, folder, force)

    def __repr__(self) -> str:
        seconds = float(self.time[-1] - self.time[0]) if len(self.time) else 0.0
        warnings = sum(diagnostic.severity == WARNING for diagnostic in self.diagnostics)
        parts = [
            f"{seconds:.1f} s at {self.rate_hz:g} Hz",
            f"{len(self.quat_WL)} segments",
            f"{len(self.points)} points",
            *([str(self.summary["method"])] if "method" in self.summary else []),
            f"{warnings} warning{'' if warnings == 1 else 's'}",
        ]
        return f"TrackResult({self.name!r}: {', '.join(parts)})"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics)
