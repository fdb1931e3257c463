"""``wepose track``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..diagnostics import from_json
from ..jobs.track import TrackJob, TrackOutcome, run_track
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .parser import Command

if TYPE_CHECKING:
    from ..tracking import TrackedChain


def run(job: TrackJob) -> int:
    """Track; print the sensors' static share, bias and gravity, and the files."""
    with progress_bar() as progress:
        outcome = run_track(job, progress)
    print_diagnostics(from_json(each) for each in outcome.summary["diagnostics"])
    if outcome.chain is not None:
        _print_chain(job, outcome.chain, outcome.summary)
    else:
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
    print_diagnostics(outcome.page_failures)
    motion = "Motion" + (f", {rate_hz:.2g} frames a second" if rate_hz else "")
    pages = {"Report": "report.html"} if job.report else {}
    say_pages(job.out, pages | ({motion: "view.html"} if job.view else {}))
    say(f"Pose: {job.out / 'pose.parquet'}  ({len(summary['sensors'])} segments, {len(summary['points'])} points)")
    if job.torques:
        say(f"Torques, estimates: {job.out / 'torques.parquet'}")


def _sensor_cells(about: Mapping[str, Any]) -> tuple[str, str, str]:
    if "static_share" not in about:
        return "", "orientations from the recording", ""
    begin, end = (_norm(about[f"gyro_bias_{when}_deg_s"]) for when in ("start", "end"))
    return f"{100 * about['static_share']:.0f} %", f"{begin:.3f} → {end:.3f}", f"{about['gravity_m_s2']:.3f}"


def _norm(values: Sequence[float]) -> float:
    return sum(value * value for value in values) ** 0.5


def _print_chain(job: TrackJob, chain: TrackedChain, summary: Mapping[str, Any]) -> None:
    print_table(
        f"{summary['recording']}: {summary['duration_s']:g} s at {summary['rate_hz']:g} Hz, {chain.method}, on "
        f"{chain.model.name}",
        ("link", "orientation residual, rms [deg]"),
        [(link, f"{angle:.2f}") for link, angle in summary["orientation_residual_rms_deg"].items()],
    )
    print_table(
        "Joints [rad or m]",
        ("joint", "minimum", "maximum", ""),
        [
            (name, f"{value.min():.3f}", f"{value.max():.3f}", "undetermined" if name in chain.open else "")
            for name, value in chain.joints.items()
        ],
    )
    files = ["joints.parquet", *(["torques.parquet"] if job.torques else []), "pose.parquet", "summary.json"]
    say(f"Chain: {'  '.join(str(job.out / file) for file in files)}")


COMMAND = Command(
    TrackJob,
    run,
    example="track session.toml --subject anna/subject.toml -o result",
    arguments=("session",),
)
