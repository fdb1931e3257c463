"""``wepose track``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..diagnostics import from_json
from ..jobs.track import TrackJob, TrackOutcome, run_track
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .parser import Command


def run(job: TrackJob) -> int:
    """Track; print the sensors' static share, bias and gravity, and the files."""
    with progress_bar() as progress:
        outcome = run_track(job, progress)
    print_diagnostics(from_json(each) for each in outcome.summary["diagnostics"])
    _print_pose(job, outcome)
    return 0


def _print_pose(job: TrackJob, outcome: TrackOutcome) -> None:
    summary, rate_hz = outcome.summary, outcome.view_rate_hz
    print_table(
        f"{summary['recording']}: {summary['duration_s']:g} s at {summary['rate_hz']:g} Hz, {summary['method']}, "
        f"lengths: {summary['subject']['note'] or summary['subject']['name']}",
        ("sensor", "static", "gyro bias, start → end [deg/s]", "gravity [m/s²]"),
        [(segment, *_sensor_cells(about)) for segment, about in summary["sensors"].items()],
    )
    if "joints" in summary:
        _print_joints(summary)
    if job.error_budget:
        _print_error_budget(summary["error_budget_mm"])
    print_diagnostics(outcome.page_failures)
    motion = "Motion" + (f", {rate_hz:.2g} frames a second" if rate_hz else "")
    pages = {"Report": "report.html"} if job.report else {}
    say_pages(job.out, pages | ({motion: "view.html"} if job.view else {}))
    say(f"Pose: {job.out / 'pose.parquet'}  ({len(summary['sensors'])} segments, {len(summary['points'])} points)")
    if "joints" in summary:
        say(f"Joints: {job.out / 'joints.parquet'}")
    if job.torques:
        say(f"Torques, estimates: {job.out / 'torques.parquet'}")


def _sensor_cells(about: Mapping[str, Any]) -> tuple[str, str, str]:
    if "static_share" not in about:
        return "", "orientations from the recording", ""
    begin, end = (_norm(about[f"gyro_bias_{when}_deg_s"]) for when in ("start", "end"))
    return f"{100 * about['static_share']:.0f} %", f"{begin:.3f} → {end:.3f}", f"{about['gravity_m_s2']:.3f}"


def _norm(values: Sequence[float]) -> float:
    return sum(value * value for value in values) ** 0.5


def _print_joints(summary: Mapping[str, Any]) -> None:
    print_table(
        "Joints [rad or m]",
        ("joint", "minimum", "maximum", ""),
        [
            (
                name,
                f"{values['min']:.3f}",
                f"{values['max']:.3f}",
                "undetermined" if name in summary["undetermined_joints"] else "",
            )
            for name, values in summary["joints"].items()
        ],
    )


def _print_error_budget(budget: Mapping[str, Mapping[str, float]]) -> None:
    from ..tracking.error_budget import group_by_source

    rows = {point: group_by_source(parts) for point, parts in budget.items()}
    if not rows:
        say("Error budget: none, since the filter states no uncertainty, or no point of a person is known")
        return
    print_table(
        "Error budget: one standard deviation of an axis [mm], root mean square; by segment in summary.json",
        ("point", *next(iter(rows.values()))),
        [(point, *(f"{value:.1f}" for value in row.values())) for point, row in rows.items()],
    )


COMMAND = Command(
    TrackJob,
    run,
    example="track session.toml --subject anna/subject.toml -o result",
    arguments=("session",),
)
