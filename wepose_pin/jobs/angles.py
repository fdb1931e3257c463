"""``wepose angles``: joint angles of results as tables and figures for a paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from ..diagnostics import Diagnostic
from . import Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..angles.movement import Movement

PAGE = "angles.html"
DECIMALS = 4  # of tables; degrees and seconds


@dataclass(frozen=True)
class AnglesJob:
    """Write the joint angles of results as tables and figures for a paper.

    Angles are those of the International Society of Biomechanics (docs/angles.md). Repetitions of the movement are
    found by the angle of the largest range, or taken from a phase of the recording, and normalised in time, 0 to 100 %.
    Several results are compared with the first one, for example of the same person before and after a treatment.

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` wrote.
    further : RESULT…
        Further results, each compared with the first one.
    out : DIR
        Write to this folder: repetitions.csv (lowest, highest, range, peak rate of each angle in each repetition),
        phases.csv (the same in the whole time and in each phase), summary.csv (mean and standard deviation over
        repetitions), curves.csv (0 to 100 %), comparison.csv (of several results), sessions.csv, definitions.csv
        (sequences and signs), the figures as .svg, and angles.html, which shows all of it.
    interval : FROM TO
        Use only this time of each recording, in seconds.
    phase : NAME
        Use only this phase of each recording. Of a phase with several intervals NAME:2 is the second.
    repetitions : PHASE
        Take each interval of this phase as a repetition. Without it repetitions are found.
    main_angle : ANGLE
        Find repetitions by this angle, such as right_elbow_flexion. Without it by the angle of the largest range.
    cycles
        Let a repetition last until the next one begins, as a gait cycle does, and not only until the angle is back.
    low_pass_hz : HZ
        Low-pass the orientations at this frequency (Butterworth, second order, forwards and backwards; half the
        amplitude at HZ). Without it they are not filtered.
    shoulder
        Use this sequence for the shoulder: YXY (plane of elevation, elevation, internal rotation), XZY or ZXY (flexion
        and adduction: no gimbal lock where the arm hangs).
    force
        Replace the files of an earlier run in DIR.
    """

    result: Path
    out: Path
    further: tuple[Path, ...] = ()
    interval: tuple[float, float] | None = None
    phase: str | None = None
    repetitions: str | None = None
    main_angle: str | None = None
    cycles: bool = False
    low_pass_hz: float | None = None
    shoulder: Literal["YXY", "XZY", "ZXY"] = "YXY"
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where the interval is none, or options contradict each other."""
        from ..errors import BadOption
        from ..recording import check_selection

        check_selection(self.interval, self.phase)
        finds = f"--main-angle {self.main_angle}" if self.main_angle is not None else "--cycles" if self.cycles else ""
        if finds and self.repetitions is not None:
            raise BadOption(
                f"{finds}: finds repetitions, and --repetitions {self.repetitions} marks them; leave one out"
            )


class AnglesOutcome(NamedTuple):
    """What came of an `AnglesJob`."""

    movements: list[Movement]
    page_failures: list[Diagnostic]


def run_angles(job: AnglesJob, progress: Progress = no_progress) -> AnglesOutcome:
    """Write the folder, whole or not at all; its page follows.

    Raises
    ------
    WeposeError
        No result; no such phase or angle; a cut-off that is not possible.
    """
    from polars import selectors

    from ..angles import movement_tables as tables
    from ..documents import whole_folder
    from ..report.angles import draw_figures, render_angles_page
    from ..report.page import PageWriter
    from ..writers.provenance import collect_provenance, write_provenance
    from ..writers.tables import write_table_csv

    job.check()
    with whole_folder(job.out, job.force) as folder:
        movements = _analyze(job, progress)
        progress("writing", 0.7)
        builders = {
            "sessions": tables.build_session_table,
            "repetitions": tables.build_repetition_table,
            "phases": tables.build_phase_table,
            "summary": tables.build_summary_table,
            "curves": tables.build_curve_table,
            "comparison": tables.build_comparison_table,
            "definitions": tables.build_definition_table,
        }
        for name, build in builders.items():
            table = build(movements)
            if len(table):
                write_table_csv(folder / f"{name}.csv", table.with_columns(selectors.float().round(DECIMALS)))
        figures = draw_figures(movements)
        for figure_name, figure in figures.items():
            (folder / f"{figure_name}.svg").write_text(figure.svg(), encoding="utf-8")
        files = sorted(path.name for path in folder.iterdir())
        write_provenance(folder, collect_provenance("angles", field_values(job)))
    progress("making the page", 0.9)
    writer = PageWriter(job.out, [PAGE])
    writer.write(PAGE, lambda failures: render_angles_page(movements, figures, files, failures))
    return AnglesOutcome(movements, writer.diagnostics)


def _analyze(job: AnglesJob, progress: Progress) -> list[Movement]:
    """The movements of all results; by the angle, and in the direction, of the first one that has repetitions."""
    from dataclasses import replace

    from ..angles.movement import MovementOptions, analyze_movement
    from ..errors import BadOption, WrongOption
    from ..writers import read_result
    from ..writers.result import read_phases

    options = MovementOptions(job.shoulder, job.low_pass_hz, job.repetitions, job.main_angle, None, job.cycles)
    movements: list[Movement] = []
    folders = (job.result, *job.further)
    for k, folder in enumerate(folders):
        progress("reading", 0.7 * k / len(folders))
        pose, _, summary = read_result(folder, job.interval, job.phase)
        name = str(summary.get("recording") or folder.name)
        if name in [each.name for each in movements]:
            name = f"{name} ({k + 1})"
        try:
            movement = analyze_movement(name, pose, read_phases(summary), options)
        except WrongOption as error:
            raise BadOption(f"{folder}: {error}" if job.further else str(error)) from None
        if job.repetitions is None and len(movement.repetitions.spans):
            repetitions = movement.repetitions
            options = replace(options, main_angle=repetitions.source, rising=repetitions.rising)
        movements.append(movement)
    return movements
