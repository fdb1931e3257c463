"""``wepose calibrate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..diagnostics import lines
from ..jobs.calibrate import CalibrateJob, run_calibrate
from .output import print_diagnostics, print_table, progress_bar, say, say_indented, say_pages
from .parser import Command
from .tables import print_lengths

if TYPE_CHECKING:
    from ..calibration import Calibration, CalibrationQuality

EXIT_CODES = {"pass": 0, "poor": 3, "fail": 4}
COLOURS = {"pass": "green", "poor": "yellow", "fail": "red"}
GAPS = {
    "coincide": "Gap between {}",
    "fixed_point": "Gap from {} to its place",
    "plane": "Height of {} off the plane",
    "recorded": "Gap from {} to its recorded place",
}


def run(job: CalibrateJob) -> int:
    """Calibrate; print lengths, mounts, the gap of the closed chain and the quality."""
    with progress_bar() as progress:
        outcome = run_calibrate(job, progress)
    calibration, quality, protocol = outcome.calibration, outcome.quality, outcome.protocol
    print_diagnostics([*quality.further, *outcome.page_failures])
    of_people = outcome.prior.is_population and not calibration.problem.model.table.is_mechanism
    prior_name = "population prior" if of_people else "prior"
    print_lengths(
        f"Lengths, by {protocol.title}",
        calibration.subject,
        outcome.prior,
        {name: metres for name, (metres, _) in calibration.problem.measured.items()},
        prior_name=prior_name,
    )
    _print_mounts(calibration)
    if protocol.closures:
        points = " and ".join(point.replace("_", " ") for point in protocol.closures[0].points)
        gap = GAPS[calibration.problem.closure_kind].format(points)
        prior_mm = f"{1e3 * calibration.prior_rms_gap:.1f} mm with the lengths of the {prior_name}"
        say(f"{gap}: {1e3 * calibration.rms_gap:.1f} mm rms, {prior_mm}")
        say(f"Effective sample size of the motion: {calibration.effective_sample_size:.0f}")
    if job.report:
        say_pages(job.out, {"Report": "report.html"})
    say(f"Subject: {job.out / 'subject.toml'}  {job.out / 'subject.urdf'}  {job.out / 'calibration.json'}")
    _print_quality(quality)
    return EXIT_CODES[quality.quality]


def _print_mounts(calibration: Calibration) -> None:
    import numpy as np

    from ..recording import find_mount_axes
    from ..subject import mount_rows

    rows: list[tuple[str, ...]] = []
    for segment, tilt in calibration.start_pose_offset.items():
        x, y, z = (np.degrees(calibration.subject.std(row)) for row in mount_rows(segment))
        up, forward = find_mount_axes(calibration.subject.mounts[segment])
        off_start, drift = np.degrees(np.linalg.norm(tilt)), 60.0 * np.degrees(calibration.heading_drift[segment])
        cells = f"± {z:.1f}", f"± {np.hypot(x, y) / 2**0.5:.1f}", f"{off_start:.1f}", f"{drift:+.1f}"
        rows.append((segment, f"{up} up, {forward} ahead", *cells))
    if not rows:
        return
    header = ("sensor", "nearest axes", "heading", "tilt", "off the start pose", "heading drift per min")
    print_table("Mounts, in deg: ± is one standard deviation", header, rows)


def _print_quality(quality: CalibrationQuality) -> None:
    from rich.console import Console

    colour = COLOURS[quality.quality]
    determined = f"the motion determines {quality.determined} of {quality.unknowns} unknowns better than the prior"
    Console(width=160).print(f"Quality: [bold {colour}]{quality.quality}[/] ({determined})", highlight=False)
    for _, line in lines(quality.reasons):
        say_indented(line)


COMMAND = Command(
    CalibrateJob,
    run,
    example="calibrate session.toml --measured biacromial=0.41 --stature 1.78 --sex f -o anna",
    arguments=("session",),
    exit_codes="0 quality pass, 3 poor, 4 fail, by the limits in docs/calibrate.md; the files are written in all three "
    "cases; 2 invalid input, nothing is written.",
)
