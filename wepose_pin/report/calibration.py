"""The report of a calibration: what was estimated, how well it is known, and what of the motion showed it."""

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.subject import Subject, mount_rows
from ..calibration import Calibration
from ..calibration.least_squares import MIN_CONTACT
from ..diagnostics import lines
from ..recording import Recording, compute_mount, find_mount_axes
from .figures import COLOURS, ReportFigure, draw_over_time
from .page import Banner, Item, render_page
from .words import Table, kinds, listed, number, plain, plus_minus, spread

QUALITIES = {
    "pass": "**Pass:** the calibration is good to use.",
    "poor": "**Poor:** usable, with larger errors than usual.",
    "fail": "**Fail:** do not use this calibration.",
}


def render_calibration_report(calibration: Calibration, recording: Recording) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic."""
    quality, gap = calibration.quality, _name_gap(calibration)
    entries = lines(quality.further, titled=True)
    has_gap = np.count_nonzero(np.isfinite(calibration.gap)) > 1
    return render_page(
        f"Calibration of {recording.name or 'a recording'}",
        [
            _describe_reliance(calibration),
            Banner(quality.quality, QUALITIES[quality.quality], lines(quality.reasons, titled=True)),
            *([Banner("info", "What to know", entries)] if entries else []),
            _describe_recording(calibration, recording),
        ],
        {
            "Lengths": [_describe_lengths(calibration), tabulate_lengths(calibration)],
            "Sensors": _list_sensors(calibration),
            f"{gap} over time": [draw_gap(calibration, gap), describe_gap(calibration)] if has_gap else [],
        },
    )


def _name_gap(calibration: Calibration) -> str:
    """What the gap of the protocol's closures is, as "Palm to palm"."""
    closures, table = calibration.problem.protocol.closures, calibration.problem.model.table
    points = dict.fromkeys(point for closure in closures for point in closure.points)
    several = listed(kinds(table, points))
    if closures and closures[0].kind == "coincide":
        return " to ".join(plain(table.shared_name(point)) for point in points).capitalize()
    return f"Gap of the {several}" if points else "Gap"


# Sections -------------------------------------------------------------------------------------------------------------


def _describe_reliance(calibration: Calibration) -> str:
    """Two sentences: how well the lengths are known, and the mounts."""
    subject, chain = calibration.subject, calibration.problem.layout.lengths_in_closures
    stds = {name: std for name in chain or subject.lengths if np.isfinite(std := 1e3 * subject.std(name))}
    if calibration.quality.quality == "fail":
        return "**No ± holds:** the calibration failed."
    text = "The uncertainty of the lengths is not known."
    if stds:
        worst = max(stds, key=stds.__getitem__)
        which = "Lengths that the motion determines" if chain else "Lengths"
        text = f"{which} are known to ± {stds[worst]:.0f} mm or better ({plain(worst)})"
        scale = f", their common scale to ± {100 * calibration.scale_std:.1f} %."
        text += scale if chain and np.isfinite(calibration.scale_std) else "."
        if calibration.formulation == "paper":
            text += " These ± leave out errors of mounts, headings and soft tissue, and are too small."
    mounts = {name: both for name in subject.mounts if np.isfinite(both := _find_mount_stds(subject, name)).all()}
    if mounts:
        worst = max(mounts, key=lambda name: max(mounts[name]))
        tilt, heading = mounts[worst]
        text += f" The mount known least is that of the {plain(worst)}: tilt ± {tilt:.1f}°, heading ± {heading:.1f}°."
    return text


def _describe_recording(calibration: Calibration, recording: Recording) -> str:
    problem = calibration.problem
    return (
        f"{recording.time[-1] - recording.time[0]:.1f} s at {recording.rate_hz:g} Hz from {len(recording.sensors)} "
        f"sensors; protocol {problem.protocol.name}, {len(calibration.time)} samples of it. "
        f"Prior: {problem.prior.note or problem.prior.name}."
    )


def _describe_lengths(calibration: Calibration) -> str:
    """Which of the lengths the motion determines, and which it does not."""
    subject, problem = calibration.subject, calibration.problem
    text = "± is one standard deviation throughout: two times out of three the truth lies within."
    if problem.layout.lengths_in_closures and np.isfinite(calibration.scale_std):
        measured = listed([plain(name) for name in problem.scale_lengths])
        scale = f"comes from the measured {measured}" if measured else "is that of the prior"
        text += f" The motion determines the proportions of the lengths. Their common scale {scale}."
    outside = [
        plain(n) for n in subject.lengths if n not in problem.layout.lengths_in_closures and n not in problem.measured
    ]
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
        variance = subject.std(name) ** 2 - (calibration.scale_std * value) ** 2
        in_chain = name in problem.layout.lengths_in_closures and np.isfinite(variance)
        proportion = spread(1e3 * np.sqrt(max(variance, 0.0)), 0) if in_chain else ""
        measured = number(1e3 * problem.measured[name][0], 0) if name in problem.measured else ""
        rows.append([plain(name), f"**{estimated}**", proportion, before, measured])
    return Table("", ["length [mm]", "estimated", "its proportion alone", "prior", "measured"], rows)


def tabulate_mounts(calibration: Calibration) -> Table:
    """Each mount: its nearest axes, how well it is known, and how the segment was held in the start pose."""
    subject, rows = calibration.subject, []
    for name, quat_LS in subject.mounts.items():
        offset, drift = subject.start_pose_offset.get(name), subject.heading_drift.get(name)
        up, forward = find_mount_axes(quat_LS)
        off = (Rotation.from_quat(compute_mount(up, forward)).inv() * Rotation.from_quat(quat_LS)).magnitude()
        axes = f"{up} up, {forward} forward, turned {np.degrees(off):.0f}°".replace("-", "−")
        stds = (number(std, 1, "°") for std in _find_mount_stds(subject, name))
        at_start = number(np.degrees(np.linalg.norm(offset[:2])) if offset is not None else np.nan, 1, "°")
        rate = number(60.0 * np.degrees(drift[0]), 1, " °/min", "+") if drift is not None else ""
        rows.append([plain(name), axes, *stds, at_start, rate])
    return Table("", ["sensor", "nearest axes", "tilt ±", "heading ±", "off at start", "drift"], rows)


def _list_sensors(calibration: Calibration) -> list[Item]:
    if not calibration.subject.mounts:
        return []
    text = (
        "Which axes of each sensor point up and forward, and the angle from there; `subject.toml` has the exact "
        "rotations. Off at start: by how much the segment was off the start pose, which was estimated too."
    )
    soft = [f"{plain(joint)} {np.degrees(rms):.1f}°" for joint, rms in calibration.hinge_rms.items()]
    if soft:
        text += f" Root mean square rotation out of the plane of a hinge: {', '.join(soft)}."
    return [text, tabulate_mounts(calibration)]


def describe_gap(calibration: Calibration) -> str:
    """What is left of the gap, and how much the motion tells."""
    return (
        f"{_name_gap(calibration)}, root mean square of the samples used: {1e3 * calibration.rms_gap:.1f} mm. The "
        f"effective sample size is {calibration.effective_sample_size:.0f}: neighbouring samples repeat the same "
        f"information."
    )


def _find_mount_stds(subject: Subject, segment: str) -> tuple[float, float]:
    """Standard deviations [deg] of a mount's tilt, root mean square of both axes, and of its heading."""
    x, y, z = np.degrees([subject.std(row) for row in mount_rows(segment)])
    return float(np.sqrt(0.5 * (x**2 + y**2))), float(z)


# The figure -----------------------------------------------------------------------------------------------------------


def draw_gap(calibration: Calibration, label: str) -> ReportFigure:
    """The gap over time while touching; `label` says what it is."""
    order = np.argsort(calibration.time, kind="stable")
    order = order[np.isfinite(calibration.gap[order])]
    time, touching = calibration.time[order], calibration.contact[order] >= MIN_CONTACT
    touching |= not touching.any()
    jumps = np.flatnonzero(np.diff(time) > 3.0 * np.median(np.diff(time))) + 1  # where a line breaks
    gap = np.insert(np.where(touching, 1e3 * calibration.gap[order], np.nan), jumps, np.nan)
    caption = f"{label} over time. Where the line breaks they are apart."
    lines, styles = {f"{label} [mm]": {"gap": gap}}, {"gap": {"color": COLOURS["right"]}}
    figure = draw_over_time(np.insert(time, jumps, time[jumps]), lines, caption, styles)
    figure.axes[0].set_ylim(bottom=0.0)
    return figure
