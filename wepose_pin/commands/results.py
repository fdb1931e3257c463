"""The commands that show, compare and export a result: ``wepose view``, ``evaluate``, ``angles``, ``export``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..diagnostics import Diagnostic
from ..errors import BadOption, WrongOption, one_of
from . import options as opt
from .options import described_by
from .output import print_diagnostics, print_table, progress_bar, say, say_pages

if TYPE_CHECKING:
    from ..angles.movement import Movement
    from ..evaluation import Evaluation

DECIMALS = 4  # of tables of angles; degrees and seconds


@described_by("writers/export.py:export")
def view(
    result: Path,
    /,
    *,
    out: opt.OutFile | None = None,
    open: bool = True,
    force: opt.Force = False,
    interval: Annotated[opt.Interval | None, opt.MORE] = None,
    phase: Annotated[opt.PhaseName | None, opt.MORE] = None,
) -> Path:
    """Show the motion of a result as one HTML page that opens offline.

    Example: wepose view result

    Parameters
    ----------
    result
        Folder written by `wepose track`, or by `wepose retarget` for a robot.
    out
        Write the page to this file. Without it view.html in RESULT is used, and written if it is missing.
    open
        Open the page in the browser.
    """
    import webbrowser

    from ..documents import whole_file
    from ..report.viewer import pose_html
    from ..writers import load_result, select_pose

    if out is None and (interval is not None or phase is not None):
        option = f"phase {phase}" if interval is None else "interval {:g} {:g}".format(*interval)
        raise BadOption(f"--{option}: needs -o FILE; view.html in the result shows the whole recording")
    page = out or result / "view.html"
    if out is not None or force or not page.is_file():
        with progress_bar() as progress:
            progress("making the page", 0.0)
            tracked = load_result(result)
            pose = select_pose(tracked, interval, phase)
            text = pose_html(tracked.model, pose, phases=tracked.phases, title=tracked.name)
            with whole_file(page, force) as partial:
                partial.write_text(text, encoding="utf-8")
    say(f"Motion:  {page}")
    if open and not webbrowser.open(page.absolute().as_uri()):
        say("No browser could be started: open the page yourself.")
    return page


@described_by("evaluation/scores.py:evaluate", "writers/export.py:export")
def evaluate(
    result: Path,
    truth: Path,
    /,
    *,
    interval: opt.Interval | None = None,
    phase: opt.PhaseName | None = None,
    fit: Annotated[Literal["none", "world", "segments"] | None, opt.MORE] = None,
    time_offset: Annotated[opt.Seconds | None, opt.MORE] = None,
    markers: Annotated[opt.File | None, opt.MORE] = None,
) -> Any:  # an Evaluation, whose room loads late
    """Compare a result with a reference: attitude, drift, joint angles, positions, stated uncertainty.

    Prints the errors of each segment's attitude and heading, of each joint's angles with their agreement
    (Bland-Altman, ICC), and of each point's position, relative to the root and to the place where its limb begins; and
    whether the stated standard deviations are consistent with them. Writes nothing.

    A table with the columns of pose.parquet is compared without alignment. A file of another system (.c3d, .trc,
    .mvnx) is first aligned with the clock and the heading of the result. The first third of the result serves for
    that and is not scored.

    Example: wepose evaluate result truth.parquet --interval 72 115

    Parameters
    ----------
    result
        Folder that `wepose track` wrote.
    truth
        Table (.parquet or .csv) with the columns of pose.parquet, or a session that names one (data.truth); markers or
        rotations (.c3d), markers (.trc), an Xsens MVNX.
    fit
        Fit this to the result. world: clock, heading and place; segments: in addition a constant rotation of each
        segment's frame, for frames that are not those of docs/concepts.md. Without it world for a file of another
        system (segments for rotations), none for a table.
    time_offset
        Add this to the times of the reference, instead of fitting the offset.
    markers
        Use this table of markers before the one of the package (docs/formats.md).
    """
    from ..body.kinematics import Pose, parse_pose_table
    from ..data_tables import FORMATS, read_table
    from ..evaluation import evaluate as compare
    from ..evaluation import register
    from ..readers import load_session
    from ..readers.reference import SUFFIXES, read_reference
    from ..recording import select_interval
    from ..writers import load_result

    with progress_bar() as progress:
        progress("comparing", 0.0)
        tracked = load_result(result)
        pose, table = tracked.pose, tracked.model.table
        selected = select_interval(pose.time, tracked.phases, interval, phase)
        file = load_session(truth, gaps=True).truth if truth.suffix == ".toml" or truth.is_dir() else truth
        if file is None:
            needed = 'write truth = "FILE" below its [data], or give FILE in place of the session'
            raise BadOption(f"{truth}: data.truth is missing; {needed}")
        up, diagnostics = None, tuple[Diagnostic, ...]()
        if file.suffix.lower() in SUFFIXES:
            measured = read_reference(file, markers)
            reference = Pose(measured.time, measured.quat_VT, measured.points)
            up, diagnostics = measured.up, measured.diagnostics
            fit = fit or ("segments" if measured.own_frames else "world")
        elif markers is not None:
            raise WrongOption("markers", str(markers), f"a .c3d or .trc as TRUTH; {file.name} has no markers")
        elif file.is_file() and file.suffix.lower() not in FORMATS:
            raise BadOption(f"{file}: no reference by its suffix; {one_of((*SUFFIXES, *FORMATS))}")
        else:
            reference = parse_pose_table(read_table(file), str(file))
        if fit not in (None, "none"):
            reference, registration = register(pose, reference, up=up, frames=fit == "segments", offset_s=time_offset)
            first, last = registration.scored
            begin, end = selected or registration.scored
            scored = max(first, begin), min(last, end)
            if not scored[0] < scored[1]:
                needed = f"seconds after {first:.1f}, as those before align the reference; or --fit none"
                raise WrongOption("interval", f"{begin:g} {end:g}", needed)
            errors = compare(pose, reference, scored, table)
            errors = replace(errors, registration=replace(registration, scored=scored))
        else:
            reference = replace(reference, time=reference.time + (time_offset or 0.0))
            errors = compare(pose, reference, selected, table)
    print_diagnostics(diagnostics)
    _print_errors(errors)
    return errors


def _print_errors(errors: Evaluation) -> None:
    from ..recording import format_span

    say(f"{errors.samples} samples from {format_span(errors.interval)}")
    if (registration := errors.registration) is not None:
        say(f"The reference was aligned by {format_span(registration.fitted)}, which are not scored:")
        fitted = registration.correlation == registration.correlation  # NaN where the offset was stated
        clock = f"speeds correlate by {registration.correlation:.3f}" if fitted else "stated"
        say(f"  its clock {registration.offset_s:+z.3f} s ({clock})")
        say(f"  its world: {registration.up} is up, rotated by {registration.heading_deg:+z.1f} deg about the vertical")
        say("  its points moved by {:+z.3f} {:+z.3f} {:+z.3f} m".format(*registration.shift_m))
        if registration.frames_deg:
            frames = ", ".join(f"{segment} {angle:.1f}" for segment, angle in registration.frames_deg.items())
            say(f"  its segments' frames rotated [deg], so that no constant error of these is left: {frames}")
    rows: list[tuple[str, ...]] = []
    for name, error in errors.attitude.items():
        axes = (f"{mean:.2f} ± {std:.2f}" for mean, std in (error.roll, error.pitch, error.yaw))
        rms = (f"{value:.2f}" for value in (error.inclination_rmse, error.heading_rmse, error.total_rmse))
        rows.append((name, *axes, *rms, f"{error.drift_deg_min:+z.2f}"))
    print_table(
        "Attitude error [deg]: mean ± std of the absolute; root mean square; drift of the heading [deg/min]",
        ("segment", "roll", "pitch", "yaw", "inclination", "heading", "total", "drift"),
        rows,
    )
    rows = []
    for joint, angles in errors.joints.items():
        for angle, e in angles.items():
            limits, icc, extent = f"{e.lower:+z.2f} to {e.upper:+z.2f}", f"{e.icc:z.3f}", f"{e.range:.0f}"
            rows.append((joint, angle, f"{e.mean:+z.2f}", f"{e.rmse:.2f}", f"{e.worst:.2f}", limits, icc, extent))
    print_table(
        "Joint angle error [deg], near gimbal lock left out; limits of agreement (Bland-Altman, 95 %); ICC(A,1)",
        ("joint", "angle", "mean", "rms", "largest", "limits of agreement", "ICC", "range"),
        rows,
    )
    rows = []
    for name in errors.position:
        known = [each.get(name) for each in (errors.position, errors.position_on_limb)]
        rows.append((name, *("" if each is None else f"{each.mean:.1f} ± {each.std:.1f}" for each in known)))
    print_table("Position error [mm], mean ± std", ("point", "from the root", "from where its limb begins"), rows)
    points = {f"{name} (point)": stated for name, stated in errors.position_uncertainty.items()}
    print_table(
        "Stated uncertainty: if right, the normalised squared error is 3, and 68 % and 95 % of the errors are within",
        ("quantity", "normalised", "within 1 std", "within 2 std"),
        [
            (name, f"{u.nees:.2f}", f"{100 * u.within_1:.0f} %", f"{100 * u.within_2:.0f} %")
            for name, u in {**errors.attitude_uncertainty, **points}.items()
        ],
    )


@described_by("writers/export.py:export")
def angles(
    result: Path,
    /,
    *further: Path,
    out: opt.Out,
    interval: opt.Interval | None = None,
    phase: opt.PhaseName | None = None,
    low_pass_hz: opt.Hz | None = None,
    force: opt.Force = False,
    repetitions: Annotated[opt.Repetitions | None, opt.MORE] = None,
    shoulder: Annotated[Literal["auto", "YXY", "XZY", "ZXY"], opt.MORE] = "auto",
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
        Take each interval of this phase as a repetition, or find them by this angle, such as right_elbow_flexion.
        Without it, they are found by the angle of the largest range.
    shoulder
        Use this sequence for the shoulder: YXY (plane of elevation, elevation, internal rotation), XZY or ZXY (flexion
        and adduction: no gimbal lock where the arm hangs). auto: YXY, or if it is near gimbal lock in the first result
        for more than 1 % of the time, the sequence that is near it least.
    """
    options = dict(locals())
    from polars import selectors

    from ..angles import diagnose_lock
    from ..angles import movement as build
    from ..documents import whole_folder
    from ..report import angles as report
    from ..report.page import write_pages
    from ..writers import load_result, select_pose
    from ..writers.result import collect_provenance, write_provenance

    of_repetitions = ("repetitions.csv", "repetitions.svg", "summary.csv", "curves.csv", "curves-*.svg")
    earlier = ("angles.html", "angles.svg", "angles-*.svg", *of_repetitions)
    with progress_bar() as progress, whole_folder(out, force, earlier) as folder:
        # All are analysed by the sequence, the angle and the direction of the first that has repetitions.
        chosen: dict[str, Any] = {"sequence": shoulder, "cutoff_hz": low_pass_hz, "repetitions": repetitions}
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
            if len(movement.repetitions.spans):
                chosen |= {"repetitions": movement.repetitions.source, "rising": movement.repetitions.rising}
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
        page = partial(report.render_angles_page, movements, tables, figures)
        failures = write_pages(folder, {"angles.html": page})
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


@described_by("writers/export.py:export")
def export(
    result: Path,
    /,
    *further: Path,
    out: opt.OutFile,
    format: opt.Name | None = None,
    rate_hz: opt.ExportHz | None = None,
    interval: opt.Interval | None = None,
    phase: opt.PhaseName | None = None,
    force: opt.Force = False,
    names: Annotated[Literal["isb", "opensim"] | None, opt.MORE] = None,
    osim_model: Annotated[opt.File | None, opt.MORE] = None,
    episodes: Annotated[opt.PhaseName | None, opt.MORE] = None,
    instruction: Annotated[opt.Text | None, opt.MORE] = None,
) -> Any:  # an Exported, whose room loads late
    """Write the motion of a person or of a robot for other programs: OpenSim, BVH, C3D, LeRobot, ROS 2 and others.

    What each file holds: docs/export.md.

    Example: wepose export result -o circles.trc

    Parameters
    ----------
    result
        Folder written by `wepose track`, or by `wepose retarget` for a robot.
    further
        Only for lerobot: further results, which become episodes of the same data set.
    out
        Write this file. Its suffix selects the format.
    """
    options = {name: value for name, value in locals().items() if name not in ("result", "further", "out")}
    from ..writers import export as room

    with progress_bar() as progress:
        progress("writing", 0.0)
        written = room.export([result, *further], out, **options)
    print_diagnostics(written.diagnostics)
    say(f"Written: {out}  ({written.format})")
    return written
