"""The report of a calibration: what was estimated, how well it is known, and what of the motion showed it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.kinematics import Pose
from ..body.subject import Subject, mount_rows
from ..calibration import Calibration
from ..calibration.result import MIN_CONTACT, find_intervals
from ..diagnostics import Diagnostic, lines
from ..errors import WeposeError
from ..filters import BEST
from ..recording import Recording, compute_mount, find_mount_axes
from ..tracking import Tracker, TrackOptions, TrackResult
from .figures import BAND, COLOURS, SOFT, ReportFigure, draw_over_time, styled
from .page import Banner, Item, render_page, write_pages
from .viewer import show_motion
from .words import Table, capital, intervals, kinds, listed, number, plain, plus_minus

QUALITIES = {
    "pass": "**Pass:** the calibration is good to use.",
    "poor": "**Poor:** usable, with larger errors than usual.",
    "fail": "**Fail:** do not use this calibration.",
}


def write_calibration_page(
    folder: Path, calibration: Calibration, recording: Recording, *, method: str
) -> list[Diagnostic]:
    """Write ``report.html`` beside a calibration's result; what cannot be made, as of `write_track_pages`."""
    return write_pages(
        folder,
        {"report.html": lambda: render_calibration_report(calibration, recording, method=method)},
        "calibration.json",
    )


def render_calibration_report(
    calibration: Calibration, recording: Recording, *, tracked: TrackResult | None = None, method: str = BEST
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Parameters
    ----------
    tracked : the recording tracked with the calibrated subject, for the 3D view; None: it is tracked here
    method : as the calibration was run
    """
    quality = calibration.quality
    entries = lines(quality.further, titled=True)
    return render_page(
        f"Calibration of {recording.name or 'a recording'}",
        [
            _describe_reliance(calibration),
            Banner(quality.quality, QUALITIES[quality.quality], lines(quality.reasons, titled=True)),
            *([Banner("info", "What to know", entries)] if entries else []),
        ],
        {
            "Lengths": [draw_lengths(calibration), _describe_lengths(calibration), tabulate_lengths(calibration)],
            "Sensors": _list_sensors(calibration),
            f"{capital(_name_gap(calibration))} over time": _list_gap(calibration),
            "The motion in 3D": _list_view(calibration, recording, tracked, method),
            "What was run": [_tabulate_run(calibration, recording, method)],
        },
    )


def _name_gap(calibration: Calibration) -> str:
    """What the gap of the protocol's closures is, as "palm to palm"."""
    closures, table = calibration.problem.protocol.closures, calibration.problem.model.table
    points = dict.fromkeys(point for closure in closures for point in closure.points)
    each = [plain(table.shared_name(point)) for point in points]
    if len(each) < 2:
        return f"{each[0]} to its point" if each else "gap"
    several = listed(kinds(table, points))
    gaps = {"coincide": " to ".join(each), "plane": f"{several} against the plane"}
    return gaps.get(closures[0].kind, f"{several} to their points")


# Sections -------------------------------------------------------------------------------------------------------------


def _describe_reliance(calibration: Calibration) -> str:
    """Two sentences: how well the lengths are known, and the mounts."""
    subject, chain = calibration.subject, calibration.problem.lengths_in_closures
    stds = {name: 1e3 * subject.std(name) for name in chain or subject.lengths}
    stds = {name: std for name, std in stds.items() if np.isfinite(std)}
    text = "The uncertainty of the lengths is not known."
    if stds:
        worst = max(stds, key=stds.__getitem__)
        text = f"Lengths are known to ± {stds[worst]:.0f} mm or better ({plain(worst)})"
        text += f", their common scale to ± {100 * calibration.scale_std:.1f} %." if chain else "."
        if calibration.formulation == "paper":
            text += " These ± leave out errors of mounts, headings and soft tissue, and are too small."
    mounts = {name: _find_mount_stds(subject, name) for name in subject.mounts}
    mounts = {name: std for name, std in mounts.items() if np.isfinite(std).all()}
    if mounts:
        worst = max(mounts, key=lambda name: max(mounts[name]))
        tilt, heading = mounts[worst]
        text += f" The mount known least is that of the {plain(worst)}: tilt ± {tilt:.1f}°, heading ± {heading:.1f}°."
    return text


def _describe_lengths(calibration: Calibration) -> str:
    """What of the lengths the motion determines, and what it does not."""
    subject, problem = calibration.subject, calibration.problem
    text = "± is one standard deviation throughout: two times out of three the truth lies within."
    if problem.lengths_in_closures and np.isfinite(calibration.scale_std):
        measured = listed([plain(name) for name in problem.scale_lengths])
        scale = f"comes from the measured {measured}" if measured else "is that of the prior"
        text += (
            " The motion determines the proportions of the lengths. Their common scale "
            f"{scale}, to ± {100 * calibration.scale_std:.1f} %."
        )
    outside = [plain(n) for n in subject.lengths if n not in problem.lengths_in_closures and n not in problem.measured]
    if outside:
        text += f" Not in the chain, known by the prior's proportions alone: {', '.join(outside)}."
    return text


def tabulate_lengths(calibration: Calibration) -> Table:
    """Each length beside the prior's and the measured one, and how well the motion shows its proportion alone."""
    subject, problem = calibration.subject, calibration.problem
    rows = []
    for name, value in subject.lengths.items():
        estimated, before = (
            plus_minus(1e3 * person.lengths.get(name, np.nan), 1e3 * person.std(name))
            for person in (subject, problem.prior)
        )
        of_scale = calibration.scale_std * value
        proportion = 1e3 * np.sqrt(max(subject.std(name) ** 2 - of_scale**2, 0.0))
        in_chain = name in problem.lengths_in_closures and np.isfinite(proportion)
        measured = number(1e3 * problem.measured[name][0], 0) if name in problem.measured else ""
        rows.append([plain(name), f"**{estimated}**", f"± {proportion:.0f}" if in_chain else "", before, measured])
    return Table("", ["length [mm]", "estimated", "its proportion alone", "prior", "measured"], rows)


def tabulate_mounts(calibration: Calibration) -> Table:
    """Each mount: its nearest axes, how well it is known, and how the segment was held in the start pose."""
    subject, rows = calibration.subject, []
    for name, quat_LS in subject.mounts.items():
        offset, drift = subject.start_pose_offset.get(name), subject.heading_drift.get(name)
        up, forward = find_mount_axes(quat_LS)
        nearest = Rotation.from_quat(compute_mount(up, forward))
        off = np.degrees((nearest.inv() * Rotation.from_quat(quat_LS)).magnitude())
        rows.append(
            [
                plain(name),
                f"{up} up, {forward} ahead, turned {off:.0f}°".replace("-", "−"),
                *(number(std, 1, "°") for std in _find_mount_stds(subject, name)),
                number(float(np.degrees(np.linalg.norm(offset.tilt))) if offset else np.nan, 1, "°"),
                number(float(np.degrees(drift.rate)) * 60.0, 1, " °/min", "+") if drift else "",
            ]
        )
    return Table("", ["sensor", "nearest axes", "tilt ±", "heading ±", "off at start", "drift"], rows)


def _list_sensors(calibration: Calibration) -> list[Item]:
    table = tabulate_mounts(calibration)
    if not table.rows:
        return []
    soft = [f"{plain(joint)} {np.degrees(rms):.1f}°" for joint, rms in calibration.hinge_rms.items()]
    hinges = (
        f" Out of the plane of its hinge, root mean square, a segment rotates by: {', '.join(soft)}." if soft else ""
    )
    return [
        "Which axes of each sensor point up and forward, and the angle from there. Nobody stands exactly in the start "
        "pose: by how much each segment was off was estimated with the lengths. `subject.toml` has the directions, "
        f"and the exact rotations.{hinges}",
        table,
    ]


def describe_gap(calibration: Calibration) -> str:
    """The gap before and after, and how much the motion tells."""
    return (
        f"{capital(_name_gap(calibration))}, root mean square while touching: {1e3 * calibration.prior_rms_gap:.1f} mm "
        f"before, {1e3 * calibration.rms_gap:.1f} mm after. The effective sample size is "
        f"{calibration.effective_sample_size:.0f}: neighbouring samples repeat the same information."
    )


def _list_gap(calibration: Calibration) -> list[Item]:
    if np.count_nonzero(np.isfinite(calibration.gap)) < 2:
        return []
    return [draw_gap(calibration, capital(_name_gap(calibration))), describe_gap(calibration)]


def _list_view(calibration: Calibration, recording: Recording, tracked: TrackResult | None, method: str) -> list[Item]:
    """The motion of the protocol, tracked with what was calibrated."""
    if not len(calibration.time):
        return []
    if tracked is None:
        try:
            model, options = calibration.problem.model, TrackOptions(method)
            tracker = Tracker(calibration.subject, model=model, options=options)
            tracked = tracker.push(recording) or next(tracker.smooth())
        except WeposeError as error:
            return [f"The motion cannot be tracked: {error}"]
    begin, end = float(calibration.time.min()), float(calibration.time.max())
    samples = slice(*np.searchsorted(tracked.time, [begin - 1e-6, end + 1e-6]))
    if samples.stop - samples.start < 2:
        return []
    cut = Pose(
        tracked.time[samples],
        {name: quat[samples] for name, quat in tracked.quat_WL.items()},
        {name: points[samples] for name, points in tracked.points.items()},
    )
    phases = {
        name: [(max(a, begin), min(b, end)) for a, b in spans if b > begin and a < end]
        for name, spans in recording.phases.items()
    }
    shown = {name: spans for name, spans in phases.items() if spans}
    return [show_motion(tracked.model, cut, shown, recording.name)]


def _tabulate_run(calibration: Calibration, recording: Recording, method: str) -> Table:
    lengths = {name: calibration.measured_lengths[name] for name in calibration.problem.measured}
    measured = [f"{plain(n)} {1e3 * v.metres:.0f} ± {1e3 * v.measured_std:.0f} mm" for n, v in lengths.items()]
    imu, fused = len(recording.imus), len(recording.sensors) - len(recording.imus)
    raw = ["gyroscope and accelerometer"] * (imu > 0) + ["measured orientations"] * (fused > 0)
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("sensors", f"{', '.join(map(plain, recording.sensors))} ({', '.join(raw)})"),
        ("length", f"{recording.time[-1] - recording.time[0]:.1f} s at {recording.rate_hz:g} Hz"),
        ("phases", "; ".join(f"{name} {intervals(spans)}" for name, spans in recording.phases.items())),
        ("protocol", f"{calibration.problem.protocol.name}, {len(calibration.time)} samples of it"),
        ("filter", method),
        ("measured lengths", ", ".join(measured) or "none"),
        ("prior", calibration.problem.prior.note or calibration.problem.prior.name),
        ("sensors mounted again", "yes" if recording.remounted else "no"),
    ]
    return Table("", (), rows)


def _find_mount_stds(subject: Subject, segment: str) -> tuple[float, float]:
    """Standard deviations [deg] of a mount's tilt, root mean square of both axes, and of its heading."""
    x, y, z = np.degrees([subject.std(row) for row in mount_rows(segment)])
    return float(np.sqrt(0.5 * (x**2 + y**2))), float(z)


# Figures --------------------------------------------------------------------------------------------------------------


@styled
def draw_lengths(calibration: Calibration) -> ReportFigure:
    """Each length against the prior's, with intervals."""
    subject, problem = calibration.subject, calibration.problem
    names, at = list(subject.lengths), -np.arange(len(subject.lengths), dtype=float)
    prior = np.array([problem.prior.lengths.get(name, np.nan) for name in names])
    std, before = (1e3 * np.array([person.std(name) for name in names]) for person in (subject, problem.prior))
    off = 1e3 * (np.array(list(subject.lengths.values())) - prior)
    measured = 1e3 * (np.array([problem.measured.get(name, (np.nan,))[0] for name in names]) - prior)
    figure = ReportFigure(
        "Lengths against the prior's; bars are one, thin lines two standard deviations.", 0.28 * len(names) + 0.1
    )
    ax = figure.grid(left_in=1.7)[0, 0]
    ax.barh(at, 2 * before, left=-before, height=0.62, color=BAND, label="prior, ± 1 standard deviation")
    ax.errorbar(off, at, xerr=2 * std, fmt="none", color=COLOURS["right"], elinewidth=0.9)
    ax.errorbar(off, at, xerr=std, fmt="o", color=COLOURS["right"], elinewidth=3, markersize=5, label="estimated")
    if np.isfinite(measured).any():
        ax.plot(measured, at + 0.3, "v", color="black", markerfacecolor="white", label="measured")
    ax.axvline(0.0, color=SOFT, linewidth=0.8)
    ax.set_yticks(at, [plain(name) for name in names])
    ax.set_xlabel("longer than the prior [mm]")
    ax.grid(axis="y", visible=False)
    ax.margins(x=0.04)
    figure.add_legend()
    return figure


@styled
def draw_gap(calibration: Calibration, label: str) -> ReportFigure:
    """The gap over time with the prior's and with the estimated lengths; `label` says what it is."""
    order = np.argsort(calibration.time, kind="stable")
    order = order[np.isfinite(calibration.gap[order])]
    time, touched = calibration.time[order], calibration.contact[order] >= MIN_CONTACT
    gaps = {
        "with the prior's lengths": 1e3 * calibration.prior_gap[order],
        "with the estimated lengths": 1e3 * calibration.gap[order],
    }
    styles = {
        name: {"color": COLOURS[side], "linestyle": dashes, "label": name}
        for name, side, dashes in zip(gaps, ("left", "right"), ("--", "-"), strict=True)
    }
    half = 0.5 * float(np.median(np.diff(time)))
    apart = [(begin - half, end + half) for begin, end in find_intervals(time, ~touched)]
    figure = draw_over_time(
        insert_breaks(time, time),
        {f"{label} [mm]": {name: insert_breaks(time, gap) for name, gap in gaps.items()}},
        f"{label} over time, before and after.",
        styles,
        spans=("apart, left out", apart),
    )
    usual = np.concatenate([gap[touched] if touched.any() else gap for gap in gaps.values()])
    most = max(float(np.nanmax(usual, initial=1.0)), 1.0)  # lines may leave the plot while apart
    figure.axes[0].set_ylim(0.0, 1.12 * most)
    return figure


def insert_breaks(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n,) with a NaN inserted wherever time jumps, so that a line breaks there."""
    jumps = np.flatnonzero(np.diff(time) > 3.0 * np.median(np.diff(time))) + 1
    return np.insert(values.astype(float), jumps, time[jumps] if values is time else np.nan)
