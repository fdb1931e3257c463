"""The report of a calibration: what was estimated, how well it is known, and what of the motion showed it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration import Calibration, CalibrationQuality
from ..calibration.observability import find_intervals
from ..calibration.result import MIN_CONTACT, Check
from ..diagnostics import WARNING, Diagnostic, lines, quantity
from ..errors import WeposeError, reason
from ..filters import BEST
from ..kinematics import Pose
from ..model import ROOT, BodyTable
from ..recording import Recording, compute_mount, find_mount_axes
from ..subject import Subject, mount_rows
from ..tracking import TrackedRecording, Tracker, TrackOptions
from .figures import BAND, COLOURS, SOFT, ReportFigure, draw_over_time, styled
from .page import Banner, Facts, Frame, Item, Page, PageWriter, Table
from .viewer import pose_html
from .words import capital, degrees, intervals, listed, plain, plural, plus_minus, signed, versions

FRAMES_A_SECOND = 20.0  # of the 3D view
UNOBSERVED = 0.97  # of the start pose's standard deviation, above which the motion showed nothing
QUALITIES = {
    "pass": "**Pass:** the calibration is good to use.",
    "poor": "**Poor:** usable, with larger errors than usual.",
    "fail": "**Fail:** do not use this calibration.",
}


def write_calibration_page(
    folder: Path,
    calibration: Calibration,
    recording: Recording,
    *,
    method: str,
) -> list[Diagnostic]:
    """Write ``report.html`` beside a calibration's result; what cannot be made, as of `write_track_pages`."""
    writer = PageWriter(folder, ["report.html"])
    writer.write(
        "report.html",
        lambda failures: render_calibration_report(calibration, recording, method=method, failures=failures),
    )
    writer.save_diagnostics("calibration.json")
    return writer.diagnostics


def render_calibration_report(
    calibration: Calibration,
    recording: Recording,
    *,
    tracked: TrackedRecording | None = None,
    method: str = BEST,
    failures: list[str] | None = None,
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Parameters
    ----------
    tracked : the recording tracked with the calibrated subject, for the hands and the 3D view; None: it is tracked here
    method : as the calibration was run
    failures : takes a line for each section that cannot be made; the page has the line in its place
    """
    contact = _describe_contact(calibration)
    untracked: list[Diagnostic] = []
    if tracked is None:
        try:
            options = TrackOptions(method)
            model = calibration.problem.model
            tracker = Tracker(calibration.subject, model=model, options=options, with_point_cov=False)
            tracked = tracker.push(recording) or next(tracker.smooth())
        except Exception as error:
            untracked = [Diagnostic("motion-not-shown", WARNING, facts={"reason": str(error)})]
            if not isinstance(error, WeposeError) and failures is not None:
                failures.append(f"the motion cannot be tracked: {reason(error)}")
    page = Page(f"Calibration of {recording.name or 'a recording'}", failures)
    page.add("What can be relied on", lambda: [_describe_reliance(calibration, contact)], heading=False)
    page.add("The quality", lambda: _list_diagnostics(calibration.quality, untracked), heading=False)
    page.add("Lengths", lambda: _list_lengths(calibration, contact))
    page.add("Sensors", lambda: _list_sensors(calibration, recording))
    page.add(f"{capital(contact.gap)} over time", lambda: _list_gap(calibration, contact))
    page.add("The start pose", lambda: _list_posture(calibration))
    table = calibration.problem.model.table
    joints = dict.fromkeys(plural(plain(table.shared_name(name))) for name in calibration.hinge_rms)
    page.add(f"The {listed([*joints])} as hinges", lambda: _list_hinges(calibration))
    page.add("The motion in 3D", lambda: _list_view(calibration, recording, tracked))
    page.add("Behind the quality", lambda: _list_checks(calibration.quality, contact))
    page.add("What was run", lambda: _list_run(calibration, recording, contact, method))
    return page.html()


class _Contact(NamedTuple):
    """The words for a protocol's closure."""

    protocol: str
    gap: str
    chain: tuple[str, ...]  # lengths in it


def _describe_contact(calibration: Calibration) -> _Contact:
    protocol, chain = calibration.problem.protocol, calibration.problem.lengths_in_closures
    table = calibration.problem.model.table
    points = dict.fromkeys(point for closure in protocol.closures for point in closure.points)
    if not points:
        return _Contact(protocol.name, "gap", chain)
    each = [plain(table.shared_name(point)) for point in points]
    several = listed([plural(name) for name in dict.fromkeys(each)])
    gaps = {"coincide": " to ".join(each), "plane": f"{several} against the plane"}
    gap = gaps.get(protocol.closures[0].kind, f"{several} to their points")
    return _Contact(protocol.name, gap if len(each) > 1 else f"{each[0]} to its point", chain)


# Sections -------------------------------------------------------------------------------------------------------------


def _describe_reliance(calibration: Calibration, contact: _Contact) -> str:
    """Two sentences: how well the lengths are known, and the mounts."""
    subject = calibration.subject
    stds = {name: 1e3 * subject.std(name) for name in contact.chain or subject.lengths}
    stds = {name: std for name, std in stds.items() if np.isfinite(std)}
    text = "The uncertainty of the lengths is not known."
    if stds:
        worst = max(stds, key=stds.__getitem__)
        text = f"Lengths are known to ± {stds[worst]:.0f} mm or better ({plain(worst)})"
        text += f", their common scale to ± {100 * calibration.scale_std:.1f} %." if contact.chain else "."
    mounts = {name: _mount_stds(subject, name) for name in subject.mounts}
    mounts = {name: std for name, std in mounts.items() if np.isfinite(std).all()}
    if mounts:
        worst = max(mounts, key=lambda name: max(mounts[name]))
        tilt, heading = mounts[worst]
        text += f" The mount known least is that of the {plain(worst)}: tilt ± {tilt:.1f}°, heading ± {heading:.1f}°."
    return text


def _list_diagnostics(quality: CalibrationQuality, untracked: Sequence[Diagnostic]) -> list[Item]:
    banner = Banner(quality.quality, QUALITIES[quality.quality], lines(quality.reasons, titled=True))
    entries = lines([*quality.further, *untracked], titled=True)
    return [banner, Banner("info", "What to know", entries)] if entries else [banner]


def _list_lengths(calibration: Calibration, contact: _Contact) -> list[Item]:
    subject, prior, table = calibration.subject, calibration.problem.prior, calibration.problem.model.table
    rows, cells = [], []
    scales = calibration.scale_std if contact.chain else np.nan, _compute_scale_std(prior)
    for parts in _group_rigid_lengths(table):
        value, before = (sum(person.lengths.get(part, np.nan) for part in parts) for person in (subject, prior))
        std, before_std = (_std(person, parts) for person in (subject, prior))
        measured = calibration.problem.measured.get(parts[0], (np.nan,))[0] if len(parts) == 1 else np.nan
        label = " + ".join(plain(table.shared_name(part) if k else part) for k, part in enumerate(parts))
        rows.append(LengthRow(label, value, std, before, before_std, measured))
        proportion, proportion_before = (
            1e3 * np.sqrt(max(total**2 - (scale * length) ** 2, 0.0))
            for total, scale, length in ((std, scales[0], value), (before_std, scales[1], before))
        )
        in_chain = set(parts) <= set(contact.chain) and np.isfinite(proportion)
        cells.append(
            [
                label,
                f"**{plus_minus(1e3 * value, 1e3 * std, 'mm')}**",
                f"± {proportion:.0f} mm, before ± {proportion_before:.0f}" if in_chain else "",
                plus_minus(1e3 * before, 1e3 * before_std, "mm"),
                f"{1e3 * measured:.0f} mm" if np.isfinite(measured) else "",
            ]
        )
    outside = [plain(n) for n in subject.lengths if n not in contact.chain and n not in calibration.problem.measured]
    text = "± is one standard deviation throughout: two times out of three the truth lies within."
    if np.isfinite(scales[0]):
        source = listed([plain(name) for name in calibration.problem.scale_lengths])
        text += (
            " The motion determines the proportions of the lengths, as if one common scale of all were known. "
            f"{'The scale comes from the measured ' + source if source else 'The scale is that of the prior'}, to "
            f"± {100 * scales[0]:.1f} %."
        )
    if any(len(parts) > 1 and set(parts) <= set(contact.chain) for parts in _group_rigid_lengths(table)):
        text += (
            " Of a segment without a sensor and the one above it, the motion determines the sum; the prior splits it."
        )
    if outside:
        text += f" Not in the chain, known by the prior's proportions alone: {', '.join(outside)}."
    return [
        draw_lengths(rows),
        text,
        Table(["length", "estimated", "its proportion", "prior, before the motion", "measured"], cells),
    ]


def _compute_scale_std(subject: Subject) -> float:
    """The relative standard deviation of the common scale of all lengths, with their proportions as they are."""
    lengths = np.array(list(subject.lengths.values()))
    covariance = subject.lengths_covariance()
    if not np.linalg.cond(covariance) < 1e12:
        return float("nan")
    return float(1.0 / np.sqrt(lengths @ np.linalg.solve(covariance, lengths)))


def _list_sensors(calibration: Calibration, recording: Recording) -> list[Item]:
    rows = []
    for name, quat_LS in calibration.subject.mounts.items():
        drift = np.degrees(calibration.heading_drift.get(name, np.nan)) * 60.0
        up, forward = find_mount_axes(quat_LS)
        nearest = Rotation.from_quat(compute_mount(up, forward))
        off = np.degrees((nearest.inv() * Rotation.from_quat(quat_LS)).magnitude())
        sensor = recording.sensors.get(name)
        rows.append(
            [
                plain(name),
                f"{up} up, {forward} forward, turned {off:.0f}°".replace("-", "−"),
                "yes" if sensor is not None and sensor.stated_quat_LS is not None else "no",
                *map(degrees, _mount_stds(calibration.subject, name)),
                f"{signed(drift)} °/min" if np.isfinite(drift) else "",
            ]
        )
    if not rows:
        return []
    header = ["sensor", "nearest axes in the start pose", "stated before", "tilt ±", "heading ±", "heading drift"]
    return [
        "Which axes of each sensor point up and forward, and the angle from there; `subject.toml` has the "
        "exact rotations. Without a magnetometer a heading drifts; the drift during the calibration was estimated "
        "and removed.",
        Table(header, rows),
    ]


def _list_gap(calibration: Calibration, contact: _Contact) -> list[Item]:
    order = _closure_order(calibration)
    if len(order) < 2:
        return []
    time = calibration.time[order]
    text = (
        f"{capital(contact.gap)}, root mean square while touching: {1e3 * calibration.prior_rms_gap:.1f} mm before, "
        f"{1e3 * calibration.rms_gap:.1f} mm after. The effective sample size is "
        f"{calibration.effective_sample_size:.0f}: neighbouring samples repeat the same information."
    )
    gaps = {
        "with the prior's lengths": calibration.prior_gap[order],
        "with the estimated lengths": calibration.gap[order],
    }
    return [draw_gap(time, gaps, calibration.contact[order], contact.gap), text]


def _list_posture(calibration: Calibration) -> list[Item]:
    tilt = {name: np.asarray(t, dtype=float) for name, t in calibration.start_pose_offset.items()}
    tilt = {name: t for name, t in tilt.items() if np.isfinite(t).all()}
    if not tilt:
        return []
    rows, table = [], calibration.problem.model.table
    for name, (x, y) in tilt.items():
        std = np.degrees([calibration.subject.std(row) for row in mount_rows(name)[:2]])
        observed = ~(std > UNOBSERVED * np.degrees(table.segments[name].start_std[:2]))
        tilts = ((1, x, std[0], observed[0]), (0, y, std[1], observed[1]))
        rows.append([plain(name), *(_format_tilt(table, name, *about) for about in tilts)])
    bends = []
    for name, hinge in table.hinges.items():
        if hinge.on in tilt and hinge.moves in tilt:
            along = [
                Rotation.from_rotvec([*tilt[segment], 0.0]).apply(table.segments[segment].along)
                for segment in (hinge.on, hinge.moves)
            ]
            bend = float(np.degrees(np.arccos(np.clip(along[0] @ along[1], -1.0, 1.0))))
            bends.append(f"{plain(name)} bent by {bend:.1f}°")
    text = "Nobody stands exactly in the start pose. The offset of each segment was estimated with the lengths"
    return [
        f"{text}{': ' if bends else ''}{', '.join(bends)}.",
        Table(["segment", "sideways", "forwards or backwards"], rows),
    ]


def _list_hinges(calibration: Calibration) -> list[Item]:
    rows, table = [], calibration.problem.model.table
    for joint, rms in calibration.hinge_rms.items():
        x, y, z = calibration.subject.hinges[joint].axis
        if table.side(joint) == "right":  # seen along its outer end
            x, y, z = -x, -y, -z
        forward, up = np.degrees(np.arctan2(x, abs(y))), np.degrees(np.arctan2(z, abs(y)))
        softness = float(np.degrees(rms))
        if not np.isfinite([forward, up]).all():
            continue
        ends = f"{abs(forward):.1f}° {'forwards' if forward > 0 else 'backwards'}", f"{abs(up):.1f}° "
        rows.append([plain(joint), ends[0], ends[1] + ("up" if up > 0 else "down"), degrees(softness)])
    if not rows:
        return []
    return [
        "In the N-pose the axes point sideways; their outer ends are turned as stated. Softness: how far the segment "
        "below leaves the plane of the hinge, root mean square; over 5° a sensor slides, or soft tissue moves.",
        Table(["joint", "axis turned", "axis raised", "softness"], rows),
    ]


def _list_view(calibration: Calibration, recording: Recording, tracked: TrackedRecording | None) -> list[Item]:
    if tracked is None or not len(calibration.time):
        return []
    begin, end = float(calibration.time.min()), float(calibration.time.max())
    samples = slice(*np.searchsorted(tracked.time, [begin - 1e-6, end + 1e-6]))
    if samples.stop - samples.start < 2:
        return []
    cut = Pose(
        tracked.time[samples],
        {name: quat[samples] for name, quat in tracked.quat_WL.items()},
        {name: points[samples] for name, points in tracked.points.items()},
    )
    visible = {
        name: [(max(a, begin), min(b, end)) for a, b in spans if b > begin and a < end]
        for name, spans in recording.phases.items()
    }
    phases: Mapping[str, Sequence[tuple[float, float]]] = {name: spans for name, spans in visible.items() if spans}
    page = pose_html(tracked.model, cut, phases=phases, title=recording.name, fps=FRAMES_A_SECOND)
    caption = (
        "The calibration motion as tracked with the calibrated subject. Drag to turn, scroll to zoom, space to pause."
    )
    return [Frame("The motion in 3D", caption, page)]


def _list_run(calibration: Calibration, recording: Recording, contact: _Contact, method: str) -> list[Item]:
    lengths = {name: calibration.measured_lengths[name] for name in calibration.problem.measured}
    measured = [f"{plain(n)} {1e3 * v.metres:.0f} ± {1e3 * v.measured_std:.0f} mm" for n, v in lengths.items()]
    imu, fused = len(recording.imus), len(recording.sensors) - len(recording.imus)
    raw = ["gyroscope and accelerometer"] * (imu > 0) + ["measured orientations"] * (fused > 0)
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("sensors", f"{', '.join(map(plain, recording.sensors))} ({', '.join(raw)})"),
        ("length", f"{recording.time[-1] - recording.time[0]:.1f} s at {recording.rate_hz:g} Hz"),
        *((f"phase {name}", intervals(spans)) for name, spans in recording.phases.items()),
        ("protocol", f"{contact.protocol}, {len(calibration.time)} samples of it"),
        ("filter", method),
        ("measured lengths", ", ".join(measured) or "none"),
        ("prior", calibration.problem.prior.note or calibration.problem.prior.name),
        ("sensors mounted again", "yes" if recording.remounted else "no"),
        ("made with", versions()),
    ]
    return [Facts(rows)]


def _list_checks(quality: CalibrationQuality, contact: _Contact) -> list[Item]:
    rows = []
    for check in quality.checks:
        if np.isfinite(check.value):
            quantity_name, unit = _describe_check(check, contact)
            bound = "at least" if check.limits.passes > check.limits.poor else "up to"
            limits = [f"{bound} {quantity(limit, unit)}" for limit in check.limits]
            rows.append([quantity_name, quantity(check.value, unit), *limits, check.quality])
    header = ["checked", "value", "passes", "poor", "quality"]
    if not rows:
        return []
    return [
        f"The motion showed {quality.rank} of {quality.unknowns} independent combinations of lengths and mounts, and "
        f"determined {quality.determined} of them better than the prior.",
        Table(header, rows),
    ]


# Figures --------------------------------------------------------------------------------------------------------------


class LengthRow(NamedTuple):
    """A row of the lengths, all in m; NaN where something is not known."""

    label: str
    value: float
    std: float
    prior: float
    prior_std: float
    measured: float


@styled
def draw_lengths(rows: Sequence[LengthRow]) -> ReportFigure:
    """Each length against the prior's, with intervals."""
    figure = ReportFigure(
        "Lengths against the prior's; bars are one, thin lines two standard deviations.", 0.28 * len(rows) + 0.1
    )
    ax = figure.grid(left_in=1.7)[0, 0]
    at = -np.arange(len(rows), dtype=float)
    off, std, before = (
        1e3 * np.array(values)
        for values in ([r.value - r.prior for r in rows], [r.std for r in rows], [r.prior_std for r in rows])
    )
    measured = 1e3 * np.array([row.measured - row.prior for row in rows])
    ax.barh(at, 2 * before, left=-before, height=0.62, color=BAND, label="prior, ± 1 standard deviation")
    ax.errorbar(off, at, xerr=2 * std, fmt="none", color=COLOURS["right"], elinewidth=0.9)
    ax.errorbar(off, at, xerr=std, fmt="o", color=COLOURS["right"], elinewidth=3, markersize=5, label="estimated")
    if np.isfinite(measured).any():
        ax.plot(measured, at + 0.3, "v", color="black", markerfacecolor="white", label="measured")
    ax.axvline(0.0, color=SOFT, linewidth=0.8)
    ax.set_yticks(at, [row.label for row in rows])
    ax.set_xlabel("longer than the prior [mm]")
    ax.grid(axis="y", visible=False)
    ax.margins(x=0.04)
    figure.add_legend()
    return figure


@styled
def draw_gap(time: np.ndarray, gaps: Mapping[str, np.ndarray], contact: np.ndarray, label: str) -> ReportFigure:
    """The gap before and after over time.

    Parameters
    ----------
    gaps : label → (n,) [m]
    contact : (n,) weight, below `MIN_CONTACT` where the points were apart
    label : what the gap is
    """
    panels = {f"{label} [mm]": {name: insert_breaks(time, 1e3 * gap) for name, gap in gaps.items()}}
    caption = capital(f"{label} over time, before and after.")
    at = insert_breaks(time, time)
    line_styles = [(COLOURS["left"], "--"), (COLOURS["right"], "-")]
    styles = {name: {"color": c, "linestyle": d, "label": name} for name, (c, d) in zip(gaps, line_styles, strict=True)}
    half = 0.5 * float(np.median(np.diff(time)))
    apart = [(begin - half, end + half) for begin, end in find_intervals(time, contact < MIN_CONTACT)]
    figure = draw_over_time(at, panels, caption, styles, spans=("apart, left out", apart))
    touched = contact >= MIN_CONTACT
    usual = 1e3 * np.concatenate([gap[touched] if touched.any() else gap for gap in gaps.values()])
    figure.axes[0].set_ylim(
        0.0, 1.12 * max(float(np.nanmax(usual, initial=1.0)), 1.0)
    )  # lines may leave it while apart
    return figure


def insert_breaks(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n,) with a NaN inserted wherever time jumps, so that a line breaks there."""
    jumps = np.flatnonzero(np.diff(time) > 3.0 * np.median(np.diff(time))) + 1
    return np.insert(values.astype(float), jumps, time[jumps] if values is time else np.nan)


# Words and small sums -------------------------------------------------------------------------------------------------


def _group_rigid_lengths(table: BodyTable) -> list[tuple[str, ...]]:
    """The lengths of the page, those from the root last, each in a tuple.

    A segment that lies rigidly along the one above where it has no sensor is followed by the sum of both lengths.
    """
    by_root = {
        name: any(ROOT in part.start + part.end for part in length.stretches) for name, length in table.lengths.items()
    }
    rows: list[tuple[str, ...]] = []
    for name in sorted(table.lengths, key=by_root.__getitem__):
        rows.append((name,))
        ends = {part.segment: part for part in table.lengths[name].stretches}
        for segment, part in ends.items():
            above = [
                (other, stretch.segment)
                for other, length in table.lengths.items()
                for stretch in length.stretches
                if stretch.end == part.start and other != name
            ]
            own = table.segments[segment]
            if own.rigid_without_sensor and len(above) == 1 and table.segments[above[0][1]].along == own.along:
                rows.append((above[0][0], name))
    return rows


def _closure_order(calibration: Calibration) -> np.ndarray:
    """Indices of the samples of a closure, in the order of time."""
    order = np.argsort(calibration.time, kind="stable")
    return order[np.isfinite(calibration.gap[order])]


def _mount_stds(subject: Subject, segment: str) -> tuple[float, float]:
    """Standard deviations [deg] of a mount's tilt, root mean square of both axes, and of its heading."""
    x, y, z = np.degrees([subject.std(row) for row in mount_rows(segment)])
    return float(np.sqrt(0.5 * (x**2 + y**2))), float(z)


def _std(subject: Subject, names: Sequence[str]) -> float:
    if not set(names) <= set(subject.order):
        return float("nan")
    return float(np.sqrt(subject.lengths_covariance(names).sum()))


def _describe_check(check: Check, contact: _Contact) -> tuple[str, str]:
    """The quantity of a check, and the unit in which its value is shown."""
    place = plain(check.diagnostic.place)
    return {
        "limb-motion-implausible": ("doubt of the sensors' places, by anatomy", "number"),
        "sensors-exchanged": ("doubt of the sensors' places, by anatomy", "number"),
        "mount-not-used": (f"stated mount that was not used, {place}", "deg"),
        "pose-contradicted": (f"standard deviations of {place} from all else", "number"),
        "length-uncertain": (f"± {place}, without the common scale", "mm"),
        "mount-heading-uncertain": (f"± heading, {place}", "deg"),
        "scale-uncertain": ("± scale, all lengths together", "percent"),
        "scale-from-prior": ("± scale, all lengths together", "percent"),
        "closure-gap-large": (f"{contact.gap}, root mean square", "mm"),
        "motion-too-short": ("effective sample size of the motion", "count"),
        "closure-open": ("share of the time apart", "percent"),
        "start-pose-off": (f"segment farthest off the start pose: {place}", "deg"),
        "measured-length-contradicted": (f"standard deviations of the measured {place} from all else", "number"),
        "length-unusual": (f"standard deviations from the prior, {place}", "number"),
    }[check.diagnostic.code]


def _format_tilt(table: BodyTable, name: str, across: int, angle: float, std: float, observed: bool) -> str:
    deg = float(np.degrees(angle))
    if not observed:
        return f"not seen, ± {std:.1f}° assumed"
    return f"{plus_minus(abs(deg), std, '°')} {describe_direction(table, name, across, deg)}".replace(" °", "°")


def describe_direction(table: BodyTable, segment: str, across: int, angle: float) -> str:
    """Where a tilt takes the free end of a segment: a torso's upper one, an arm's lower one, a foot's front one.

    `across` 0: from the side, 1: from the front.
    """
    positive, own = angle > 0.0, table.segments[segment]
    if abs(own.along[2]) < 0.5 and across == 0:
        return "downwards" if positive else "upwards"
    if own.spine or abs(own.along[2]) < 0.5:
        if across == 0:
            return "forwards" if positive else "backwards"
        return "to the right" if positive else "to the left"
    if across == 0:
        return "backwards" if positive else "forwards"
    if not table.side(segment):
        return "to the left" if positive else "to the right"
    return "outwards" if positive == (table.side(segment) == "left") else "inwards"
