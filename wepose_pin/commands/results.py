"""From a recording to a result that prints, draws, shows and saves itself: `wepose_pin.track` and `load_result`."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from .. import tracking
from ..arguments import check_arguments, check_value
from ..body import BodyModel
from ..body.kinematics import PosedBody
from ..body.pose_table import build_pose_table
from ..body.subject import Subject, load_subject
from ..diagnostics import WARNING, Diagnostic, from_json, notebook_html
from ..errors import BadData, WeposeError, how_to_install
from ..filters import BEST
from ..filters.static import StaticTest
from ..recording import Intervals, Mark, Recording
from ..tracking import TrackedRecording
from ..writers import read_result, write_result
from ..writers.folder import result_folder
from ..writers.provenance import CALL, collect_provenance
from ..writers.result import read_marks

if TYPE_CHECKING:
    import pandas

    from ..calibration import Calibration
    from ..report.figures import Figures
    from ..report.notebook import ViewPage


@dataclass(frozen=True, repr=False)
class TrackResult(PosedBody):
    """The motion of a body, as `track` computes it and `load_result` reads it from a folder.

    It prints itself in one line, and a notebook shows its diagnostics too. `export`, `retarget`, `joint_angles` and
    `evaluate` take it as it is. `time` (n,) [s], `quat_WL` segment → (n, 4) xyzw, `points` point → (n, 3) [m] in W and
    `q` (n, nq) are the pose's; `pose` also has their covariances.

    Parameters
    ----------
    name : str
        Of the recording.
    pose : Pose
        In W, n samples.
    model : BodyModel
        The body with the subject's lengths.
    subject : Subject
        Lengths and mounts as used.
    phases : mapping
        Name → intervals [s] of the recording.
    marks : tuple of Mark
        Texts that were marked in a live session, with their times [s].
    summary : mapping
        The content of ``summary.json``: inputs, options and results.
    diagnostics : tuple of Diagnostic
        What the user should know, each with a code, severity, place, value and limit.
    source : TrackedRecording or Path
        From `track` the recording with intermediate results, such as `source.segments`; from `load_result` the folder.
    """

    phases: Mapping[str, Intervals]
    marks: tuple[Mark, ...]
    summary: Mapping[str, Any]
    diagnostics: tuple[Diagnostic, ...]
    source: TrackedRecording | Path

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
            raise WeposeError(f"to_pandas: needs pandas: {how_to_install('pandas')}") from None
        table = self.to_dataframe()
        return pandas.DataFrame({name: table[name].to_numpy() for name in table.columns})

    def plot(self) -> Figures:
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
        from ..report.notebook import draw_figures

        return draw_figures(self)

    def show(self, open: bool = True) -> ViewPage:
        """Show the motion in 3D: in a notebook in its cell, else in the browser unless `open` is false.

        ``page.save(path)`` writes the page that it gives to a file, which opens offline.

        Examples
        --------
        >>> page = result.show(open=False)
        >>> page.save("view.html")
        PosixPath('view.html')
        """
        from ..report.notebook import ViewPage, runs_in_notebook
        from ..report.viewer import pose_html

        page = ViewPage(self.name, pose_html(self.model, self.pose, phases=self.phases, title=self.name))
        if open and not runs_in_notebook():
            page.open()
        return page

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
        out = Path(folder)
        if isinstance(self.source, Path):
            with result_folder(out, force) as partial:
                for file in self.source.iterdir():
                    if file.is_file():
                        shutil.copyfile(file, partial / file.name)
            return out
        from ..report import write_track_pages

        with result_folder(out, force) as partial:
            summary = tracking.summarize(self.source)
            made = collect_provenance(CALL, _list_inputs(self.source))
            write_result(partial, self.source, summary, phases=self.phases, provenance=made)
        write_track_pages(out, summary)
        return out

    def __repr__(self) -> str:
        seconds = float(self.time[-1] - self.time[0])
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


def track(
    recording: Recording,
    subject: Subject | Calibration | None = None,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    static_test: StaticTest | None = None,
    open_loop: bool = False,
    causal: bool = False,
    limits: bool = True,
    accept_failed: bool = False,
) -> TrackResult:
    """Estimate the pose of a body from a recording.

    Parameters
    ----------
    recording : Recording
        As `load_session` reads it, or built in code.
    subject : Subject or Calibration, optional
        Lengths and mounts; None: the mean lengths of the population, or of a chosen model its own, and the mounts that
        the session states.
    method : str
        The orientation filter: "amekf", "smoother", "smekf", "smekf_published", "ncf" or "gdc", as in
        `estimate_orientation`.
    model : BodyModel, str or Path, optional
        A body; or its file, as for `load_model`, or the URDF of a mechanism whose links carry the sensors; or the name
        of a body of the package. None: the one that the recording names, else the upper body. It is scaled to the
        subject's lengths.
    static_test : StaticTest, optional
        When a sensor counts as static; None: the default values.
    open_loop : bool
        Do not correct heading drift: orientations are the filter's from the start pose on.
    causal : bool
        Begin at the end of the start pose and use no later samples, as a live session does.
    limits : bool
        Keep joints of one axis, such as those of a mechanism, within the limits that the model states.
    accept_failed : bool
        Use the subject even if its calibration failed.

    Returns
    -------
    TrackResult
        Pose, body and subject; `time` (n,) [s], `quat_WL` segment → (n, 4) xyzw, `points` point → (n, 3) [m] in W.

    Raises
    ------
    WeposeError
        The recording, the subject or the model lacks something that is needed; the calibration of the subject failed;
        a sensor is on no segment of the model.

    Examples
    --------
    >>> recording = wp.load_session("session.toml")
    >>> result = wp.track(recording, wp.load_subject("subject.toml"))
    >>> result
    TrackResult('simulated': 22.5 s at 100 Hz, 5 segments, 8 points, amekf, 0 warnings)
    >>> result.quat_WL["right_forearm"].shape == (len(result.time), 4)
    True
    """
    person: Any = getattr(subject, "subject", subject)  # a calibration has one
    check_value("accept_failed", accept_failed, bool)
    if isinstance(person, Subject) and not accept_failed:
        person.check_quality()
    tracked = tracking.track(
        recording,
        person,
        method=method,
        model=model,
        static_test=static_test,
        open_loop=open_loop,
        causal=causal,
        limits=limits,
    )
    summary = tracking.summarize(tracked)
    return TrackResult(
        name=tracked.name,
        pose=tracked.pose,
        model=tracked.model,
        subject=tracked.subject,
        phases=recording.phases,
        marks=recording.marks,
        summary=summary.content,
        diagnostics=summary.diagnostics,
        source=tracked,
    )


def load_result(folder: str | Path) -> TrackResult:
    """Read a result folder, as `wepose track` and `TrackResult.save` write it.

    Parameters
    ----------
    folder : str or Path
        Holds ``pose.parquet``, ``subject.toml``, ``subject.urdf`` and ``summary.json``.

    Returns
    -------
    TrackResult
        The content of its files. These have no covariances but standard deviations, the same for all axes, unless
        `wepose track --covariance` wrote them.

    Raises
    ------
    MissingFile, BadData, BadSubject, BadModel
        The folder is not there or lacks a file, or a file is damaged.

    Examples
    --------
    >>> wp.load_result("result")
    TrackResult('simulated': 22.5 s at 100 Hz, 5 segments, 8 points, amekf, 0 warnings)
    """
    check_arguments(load_result, locals())
    folder = Path(folder)
    pose, model, summary = read_result(folder)
    try:
        phases = _parse_phases(summary.get("recorded_phases", {}))
        diagnostics = tuple(from_json(each) for each in summary.get("diagnostics", ()))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadData(f"{folder / 'summary.json'}: is damaged: {error}") from error
    return TrackResult(
        name=str(summary.get("recording") or folder.name),
        pose=pose,
        model=model,
        subject=load_subject(folder),
        phases=phases,
        marks=read_marks(summary),
        summary=summary,
        diagnostics=diagnostics,
        source=folder,
    )


def _list_inputs(tracked: TrackedRecording) -> dict[str, Any]:
    """Inputs and options of `track`, under the names that they have in `wepose track`."""
    options = {field.name: getattr(tracked.options, field.name) for field in fields(tracked.options)}
    about = {"subject": tracked.subject.name, "model": tracked.model.table.name}
    return {"session": tracked.recording.source, **about, **options}


def _parse_phases(recorded: Mapping[str, Iterable[tuple[float, float]]]) -> dict[str, Intervals]:
    return {name: tuple((float(begin), float(end)) for begin, end in spans) for name, spans in recorded.items()}
