"""``wepose evaluate``: a result against a reference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..diagnostics import Diagnostic
from ..errors import BadOption, WrongOption
from .options import MORE, File, Interval, PhaseName, Seconds, described_by
from .output import print_diagnostics, print_table, progress_bar, say

if TYPE_CHECKING:
    from ..evaluation import Evaluation, Registration


@described_by("evaluation/scores.py:evaluate", "writers/export.py:export")
def evaluate(
    result: Path,
    truth: Path,
    /,
    *,
    interval: Interval | None = None,
    phase: PhaseName | None = None,
    align: Annotated[bool, MORE] = True,
    fit: Annotated[Literal["world", "segments"] | None, MORE] = None,
    time_offset: Annotated[Seconds | None, MORE] = None,
    markers: Annotated[File | None, MORE] = None,
) -> Any:  # an Evaluation, whose room loads late
    """Compare a result with a reference: attitude, drift, joint angles, positions, stated uncertainty.

    Prints the errors of each segment's attitude and heading, of each joint's angles with their agreement
    (Bland-Altman, ICC), and of each point's position, relative to the root and to the place where its limb begins; and
    whether the stated standard deviations are consistent with them. Writes nothing.

    A table with the columns of pose.parquet is compared as it is, without alignment. A file of another system (.c3d,
    .trc, .mvnx) is brought to the clock and the heading of the result first, by the first third of the result, which
    is then not scored.

    Example: wepose evaluate result truth.parquet --interval 72 115

    Parameters
    ----------
    result
        Folder that `wepose track` wrote.
    truth
        Table (.parquet or .csv) with the columns of pose.parquet, or a session that names one (data.truth); markers or
        rotations (.c3d), markers (.trc), an Xsens MVNX.
    align
        Bring a file of another system to the clock and the world of the result.
    fit
        Fit this to the result, also of a table. world: clock, heading and place; segments: in addition a constant
        rotation of each segment's frame, for frames that are not those of docs/concepts.md.
    time_offset
        Add this to the times of the reference, instead of fitting the offset.
    markers
        Use this table of markers before the one of the package (docs/formats.md).
    """
    from ..body.kinematics import Pose, parse_pose_table
    from ..data_tables import read_table
    from ..evaluation import evaluate as compare
    from ..evaluation import register
    from ..readers import load_session
    from ..readers.reference import is_reference, read_reference
    from ..recording import select_interval
    from ..writers import load_result

    if not align and fit is not None:
        raise WrongOption("fit", fit, "nothing is fitted with --no-align; leave out one of the two")
    with progress_bar() as progress:
        progress("comparing", 0.0)
        tracked = load_result(result)
        pose, table = tracked.pose, tracked.model.table
        selected = select_interval(pose.time, tracked.phases, interval, phase)
        file = load_session(truth, gaps=True).truth if truth.suffix == ".toml" or truth.is_dir() else truth
        if file is None:
            raise BadOption(f"{truth}: data.truth is missing; the session names no reference to compare with")
        up, diagnostics = None, tuple[Diagnostic, ...]()
        if is_reference(file):
            measured = read_reference(file, markers)
            reference = Pose(measured.time, measured.quat_VT, measured.points)
            up, diagnostics = measured.up, measured.diagnostics
            fit = fit or ("segments" if measured.own_frames else "world")
        elif markers is not None:
            raise WrongOption("markers", str(markers), f"a .c3d or .trc as TRUTH; {file.name} has no markers")
        else:
            reference = parse_pose_table(read_table(file), str(file))
        if align and fit is not None:
            reference, registration = register(pose, reference, up=up, frames=fit == "segments", offset_s=time_offset)
            first, last = registration.scored
            begin, end = selected or registration.scored
            scored = max(first, begin), min(last, end)
            if not scored[0] < scored[1]:
                needed = f"seconds after {first:.1f}, as those before align the reference; or --no-align"
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
    if errors.registration is not None:
        _say_registration(errors.registration)
    rows: list[tuple[str, ...]] = []
    for name, error in errors.attitude.items():
        axes = (f"{mean:.2f} ± {std:.2f}" for mean, std in (error.roll, error.pitch, error.yaw))
        rms = (f"{value:.2f}" for value in (error.inclination_rmse, error.heading_rmse, error.total_rmse))
        rows.append((name, *axes, *rms, f"{error.drift_deg_min:+.2f}"))
    print_table(
        "Attitude error [deg]: mean ± std of the absolute; root mean square; drift of the heading [deg/min]",
        ("segment", "roll", "pitch", "yaw", "inclination", "heading", "total", "drift"),
        rows,
    )
    rows = []
    for joint, angles in errors.joints.items():
        for angle, e in angles.items():
            limits, icc, extent = f"{e.lower:+.2f} to {e.upper:+.2f}", f"{e.icc:.3f}", f"{e.range:.0f}"
            rows.append((joint, angle, f"{e.mean:+.2f}", f"{e.rmse:.2f}", f"{e.worst:.2f}", limits, icc, extent))
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
        "Stated uncertainty: right are a normalised squared error of 3, and 68 % and 95 % of the errors within",
        ("of", "normalised", "within 1 std", "within 2 std"),
        [
            (name, f"{u.nees:.2f}", f"{100 * u.within_1:.0f} %", f"{100 * u.within_2:.0f} %")
            for name, u in {**errors.attitude_uncertainty, **points}.items()
        ],
    )


def _say_registration(registration: Registration) -> None:
    """Say how the reference was brought to the result, and by which seconds."""
    from ..recording import format_span

    say(f"The reference was aligned by {format_span(registration.fitted)}, which are not scored:")
    known = registration.correlation == registration.correlation  # NaN where the offset was stated
    clock = f"speeds correlate by {registration.correlation:.3f}" if known else "stated"
    say(f"  its clock {registration.offset_s:+.3f} s ({clock})")
    say(f"  its world: {registration.up} is up, rotated by {registration.heading_deg:+.1f} deg about the vertical")
    say("  its points moved by {:+.3f} {:+.3f} {:+.3f} m".format(*registration.shift_m))
    if registration.frames_deg:
        angles = ", ".join(f"{segment} {angle:.1f}" for segment, angle in registration.frames_deg.items())
        say(f"  its segments' frames rotated [deg], so that no constant error of these is left: {angles}")
