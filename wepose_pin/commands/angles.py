"""``wepose angles``: joint angles of results as tables and figures for a paper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..errors import BadOption, WrongOption
from .options import MORE, Angle, Force, Hz, Interval, Out, PhaseName, described_by
from .output import print_diagnostics, print_table, progress_bar, say, say_pages

if TYPE_CHECKING:
    from ..angles.movement import Movement

PAGE = "angles.html"
DECIMALS = 4  # of tables; degrees and seconds


@described_by("writers/export.py:export")
def angles(
    result: Path,
    /,
    *further: Path,
    out: Out,
    interval: Interval | None = None,
    phase: PhaseName | None = None,
    low_pass_hz: Hz | None = None,
    force: Force = False,
    repetitions: Annotated[PhaseName | None, MORE] = None,
    main_angle: Annotated[Angle | None, MORE] = None,
    shoulder: Annotated[Literal["auto", "YXY", "XZY", "ZXY"], MORE] = "auto",
) -> None:
    """Write the joint angles of results as tables and figures for a paper.

    Angles are those of the International Society of Biomechanics (docs/angles.md). Repetitions of the movement are
    found by the angle of the largest range, or taken from a phase of the recording, and normalised in time, 0 to 100 %.
    Several results are shown side by side, for example of the same person before and after a treatment.

    Example: wepose angles before after -o angles --low-pass-hz 6

    Parameters
    ----------
    result
        Folder that `wepose track` wrote.
    further
        Further results, shown beside the first one.
    out
        Write tables as .csv (all angles over time; lowest, highest, range and peak rate in each repetition and phase;
        means; curves), the figures as .svg, and angles.html, which shows all of it, to this folder.
    low_pass_hz
        Low-pass the orientations at this frequency (half the amplitude there). Without it they are not filtered.
    repetitions
        Take each interval of this phase as a repetition. Without it repetitions are found.
    main_angle
        Find repetitions by this angle, such as right_elbow_flexion. Without it by the angle of the largest range.
    shoulder
        Use this sequence for the shoulder: YXY (plane of elevation, elevation, internal rotation), XZY or ZXY (flexion
        and adduction: no gimbal lock where the arm hangs). auto: YXY, or if it is near gimbal lock in the first result
        for more than 1 % of the time, the one that is so least.
    """
    options = dict(locals())
    from polars import selectors

    from ..angles import diagnose_lock
    from ..angles import movement as build
    from ..documents import whole_folder
    from ..report import angles as report
    from ..report.page import write_pages
    from ..writers import load_result, select_pose
    from ..writers.provenance import collect_provenance, write_provenance

    if main_angle is not None and repetitions is not None:
        raise BadOption(f"--main-angle {main_angle} finds repetitions, and --repetitions {repetitions} marks them")
    with progress_bar() as progress:
        with whole_folder(out, force) as folder:
            # All are analysed by the sequence, the angle and the direction of the first that has repetitions.
            chosen: dict[str, Any] = {"sequence": shoulder, "cutoff_hz": low_pass_hz, "phase": repetitions}
            chosen["main_angle"] = main_angle
            movements: list[Movement] = []
            for k, each in enumerate((result, *further), 1):
                progress("reading", 0.7 * (k - 1) / (1 + len(further)))
                tracked = load_result(each)
                pose, name = select_pose(tracked, interval, phase), tracked.name
                name = f"{name} ({k})" if name in [movement.name for movement in movements] else name
                try:
                    movement = build.analyze_movement(name, pose, tracked.phases, **chosen)
                except WrongOption as error:
                    raise BadOption(f"{each}: {error}" if further else str(error)) from None
                movements.append(movement)
                chosen["sequence"] = movement.sequence or chosen["sequence"]
                if repetitions is None and len(movement.repetitions.spans):
                    chosen |= {"main_angle": movement.repetitions.source, "rising": movement.repetitions.rising}
            progress("writing", 0.7)
            tables = build.build_tables(movements)
            for name, table in tables.items():
                if len(table):
                    rounded = table.with_columns(selectors.float().round(DECIMALS))
                    with (folder / f"{name}.csv").open("wb") as file:  # polars takes only a path in UTF-8
                        rounded.fill_nan(None).write_csv(file)
            figures = report.draw_figures(movements)
            for name, figure in figures.items():
                (folder / f"{name}.svg").write_text(figure.svg(), encoding="utf-8")
            write_provenance(folder, collect_provenance("angles", options))
        progress("making the page", 0.9)
        failures = write_pages(out, {PAGE: lambda: report.render_angles_page(movements, tables, figures)})
    lock = {each.place: each for movement in movements for each in diagnose_lock(movement.angles)}
    print_diagnostics([*lock.values(), *failures])
    print_table(*report.tabulate_sessions(tables["sessions"]))
    for text in report.explain_missing(movements):
        say(text)
    if len(tables["summary"]):
        print_table(*report.tabulate_means(tables["summary"]))
    filtered = "not low-passed" if low_pass_hz is None else f"low-passed at {low_pass_hz:g} Hz (half amplitude)"
    sequence = movements[0].sequence
    by = f"; shoulder {'-'.join(sequence)}{', chosen by gimbal lock' if shoulder == 'auto' else ''}" if sequence else ""
    say(f"Orientations {filtered}{by}")
    say_pages(out)
    say(f"Tables and figures: {out}")
