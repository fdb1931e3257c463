"""The report of a calibration: what was estimated, how well it is known, and what of the motion showed it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration import Calibration, CalibrationQuality
from ..calibration.conditions import find_measured_lengths, group_lengths, is_scale_observed
from ..calibration.observability import find_intervals
from ..calibration.priors import DRIFT_STD
from ..calibration.protocols import Protocol, load_protocol
from ..calibration.quality import Check
from ..calibration.weights import MIN_CONTACT
from ..diagnostics import WARNING, Diagnostic, lines, quantity
from ..errors import WeposeError, reason
from ..filters import BEST
from ..kinematics import Pose
from ..model import ROOT, BodyTable
from ..recording import Recording, compute_mount, find_mount_axes
from ..subject import Subject, mount_rows
from ..tracking import TrackedRecording, Tracker, TrackOptions
from .calibration_figures import (
    Length,
    Places,
    Sensor,
    direction,
    draw_gap,
    draw_lengths,
    draw_places,
    draw_posture,
    draw_sensors,
    smoothed,
)
from .page import Page, PageWriter, Table
from .viewer import pose_html
from .words import capital, degrees, intervals, listed, plain, plural, plus_minus, signed, versions

TEMPLATE = "report/templates/calibration.html.j2"
FRAMES_A_SECOND = 20.0  # of the 3D view
UNOBSERVED = 0.97  # of the start pose's standard deviation, above which the motion showed nothing
# Zones of the joined hands, seen from the middle of the shoulders [m], and of their distance over the limb's length.
LOW, ASIDE, BENT, STRETCHED = -0.25, 0.10, 0.60, 0.80


def write_calibration_page(
    folder: Path,
    calibration: Calibration,
    recording: Recording,
    *,
    method: str,
    protocol: Protocol,
    quality: CalibrationQuality,
) -> list[Diagnostic]:
    """Write ``report.html`` beside a calibration's result; what cannot be made, as of `write_track_pages`."""
    writer = PageWriter(folder, ["report.html"])
    writer.write(
        "report.html",
        lambda failures: render_calibration_report(
            calibration, recording, method=method, protocol=protocol, quality=quality, failures=failures
        ),
    )
    writer.save_diagnostics("calibration.json")
    return writer.diagnostics


def render_calibration_report(
    calibration: Calibration,
    recording: Recording,
    *,
    quality: CalibrationQuality | None = None,
    tracked: TrackedRecording | None = None,
    method: str = BEST,
    protocol: str | Path | Protocol = "clasp",
    failures: list[str] | None = None,
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Parameters
    ----------
    quality : of `assess`; None: the page has none
    tracked : the recording tracked with the calibrated subject, for the hands and the 3D view; None: it is tracked here
    method, protocol : as the calibration was run
    failures : takes a line for each section that cannot be made; the page has the line in its place
    """
    contact = _describe_contact(protocol if isinstance(protocol, Protocol) else load_protocol(protocol), calibration)
    untracked: list[Diagnostic] = []
    if tracked is None:
        try:
            options = TrackOptions(method)
            tracker = Tracker(calibration.subject, model=calibration.model, options=options, with_point_cov=False)
            [tracked] = tracker.push(recording) + tracker.finish()
        except Exception as error:
            untracked = [Diagnostic("motion-not-shown", WARNING, facts={"reason": str(error)})]
            if not isinstance(error, WeposeError) and failures is not None:
                failures.append(f"the motion cannot be tracked: {reason(error)}")
    page = Page(TEMPLATE, f"Calibration of {recording.name or 'a recording'}", failures)
    page.add("first", lambda: _build_diagnostics_section(calibration, quality, untracked), name="The quality")
    page.add("short", lambda: _build_summary_section(calibration, contact), name="In short")
    page.add("lengths", lambda: _build_lengths_section(calibration, contact), "Lengths")
    page.add("sensors", lambda: _build_sensors_section(calibration, recording), "Sensors")
    page.add("gap", lambda: _build_gap_section(calibration, contact), f"{capital(contact.gap)} over time")
    page.add(
        "places",
        lambda: _build_places_section(calibration, contact, None if tracked is None else tracked.pose),
        "Where the motion was informative",
    )
    page.add("posture", lambda: _build_posture_section(calibration), "The start pose")
    joints = dict.fromkeys(plural(plain(calibration.model.table.shared_name(name))) for name in calibration.hinge_axes)
    page.add("hinges", lambda: _build_hinges_section(calibration), f"The {listed([*joints])} as hinges")
    page.add("view", lambda: _build_view_section(calibration, recording, tracked), "The motion in 3D")
    page.add("checks", lambda: _build_checks_section(quality, contact), "Behind the quality")
    page.add("run", lambda: _build_run_section(calibration, recording, contact, method), "What was run")
    return page.html(f"Calibration of {recording.name}" if recording.name else "Calibration")


class _Contact(NamedTuple):
    """The words for a protocol's closure."""

    protocol: str
    points: tuple[str, ...]
    noun: str
    gap: str
    chain: tuple[str, ...]  # lengths in it


def _describe_contact(protocol: Protocol, calibration: Calibration) -> _Contact:
    chain, table = find_measured_lengths(protocol, calibration.model), calibration.model.table
    points = tuple(dict.fromkeys(point for closure in protocol.closures for point in closure.points))
    if not points:
        return _Contact(protocol.name, (), "the limbs", "gap", chain)
    closure, limbs = protocol.closures[0], table.drawn_limbs
    ends = (limbs[point].segments[-1] if point in limbs and limbs[point].segments else point for point in points)
    nouns = listed([plural(name) for name in dict.fromkeys(plain(table.shared_name(end)) for end in ends)])
    each = [plain(table.shared_name(point)) for point in points]
    several = listed([plural(name) for name in dict.fromkeys(each)])
    if len(points) < 2:
        return _Contact(protocol.name, points, f"the {plain(points[0])}", f"{each[0]} to its point", chain)
    noun, gap = {
        "coincide": (f"the joined {nouns}", " to ".join(each)),
        "plane": (f"the {nouns}", f"{several} against the plane"),
    }.get(closure.kind, (f"the {nouns}", f"{several} to their points"))
    return _Contact(protocol.name, points, noun, gap, chain)


# The sections: the values that the macros of the template take --------------------------------------------------------


def _build_diagnostics_section(
    calibration: Calibration, quality: CalibrationQuality | None, untracked: Sequence[Diagnostic]
) -> dict[str, Any]:
    further = calibration.remarks if quality is None else quality.further
    return {
        "quality": "" if quality is None else quality.quality,
        "reasons": [] if quality is None else lines(quality.reasons, titled=True),
        "further": lines([*further, *untracked], titled=True),
    }


def _build_summary_section(calibration: Calibration, contact: _Contact) -> dict[str, Any]:
    subject = calibration.subject
    scaling = [name for name in calibration.measured if name in contact.chain or name not in subject.lengths]
    tilts = {name: _mount_stds(subject, name) for name in subject.mounts}
    known = {name: std for name, std in tilts.items() if np.isfinite(std).all()}
    worst = [max(known, key=lambda name, k=k: known[name][k]) for k in (0, 1)] if known else []  # type: ignore[misc]
    return {
        "chain": bool(contact.chain),
        "closed": is_scale_observed(calibration.conditions),
        "scaling": [plain(name) for name in scaling],
        "scale_percent": 100 * calibration.scale_std,
        "gap": contact.gap if np.isfinite(calibration.rms_gap) else None,
        "gap_mm": 1e3 * calibration.rms_gap,
        "prior_gap_mm": 1e3 * calibration.prior_rms_gap,
        "mounts": [(known[name][k], plain(name)) for k, name in enumerate(worst)],
    }


def _build_lengths_section(calibration: Calibration, contact: _Contact) -> dict[str, Any]:
    subject, prior = calibration.subject, calibration.prior
    rows, lines, table = [], [], calibration.model.table
    for parts in _list_lengths(table):
        weights = np.ones(len(parts))
        value, before = (sum(person.lengths.get(part, np.nan) for part in parts) for person in (subject, prior))
        std, before_std = (_std(person, parts, weights) for person in (subject, prior))
        measured = calibration.measured.get(parts[0], np.nan) if len(parts) == 1 else np.nan
        label = " + ".join(plain(table.shared_name(part) if k else part) for k, part in enumerate(parts))
        rows.append(Length(label, value, std, before, before_std, measured))
        learned = calibration.information_shares.get(" + ".join(parts))
        lines.append(
            [
                label,
                f"**{plus_minus(1e3 * value, 1e3 * std, 'mm')}**",
                plus_minus(1e3 * before, 1e3 * before_std, "mm"),
                f"{1e3 * measured:.0f} mm" if np.isfinite(measured) else "",
                f"{100 * float(np.sum(learned)):.0f} %" if learned is not None else "",
            ]
        )
    header = ["length", "estimated", "prior", "measured", "learned from the motion"]
    return {
        "rigid": [
            [plain(table.shared_name(part)) for part in reversed(parts)]
            for parts in _list_lengths(table)
            if len(parts) > 1 and set(parts) <= set(contact.chain) and table.side(parts[0]) != "right"
        ],
        "outside": [plain(n) for n in subject.lengths if n not in contact.chain and n not in calibration.measured],
        "learned": bool(calibration.information_shares),
        "picture": draw_lengths(rows),
        "lengths": Table(header, lines),
    }


def _build_sensors_section(calibration: Calibration, recording: Recording) -> dict[str, Any] | None:
    subject = calibration.subject
    rows, lines = [], []
    for name, quat_LS in subject.mounts.items():
        tilt, heading = _mount_stds(subject, name)
        drift = np.degrees(calibration.heading_drift.get(name, np.nan)) * 60.0
        rows.append(Sensor(plain(name), tilt, heading, drift))
        up, forward = find_mount_axes(quat_LS)
        nearest = Rotation.from_quat(compute_mount(up, forward))
        off = np.degrees((nearest.inv() * Rotation.from_quat(quat_LS)).magnitude())
        sensor = recording.sensors.get(name)
        stated = sensor is not None and sensor.stated_quat_LS is not None
        lines.append(
            [
                plain(name),
                f"{_minus_sign(up)} up, {_minus_sign(forward)} forward, turned {off:.0f}°",
                "yes" if stated else "no",
                degrees(tilt),
                degrees(heading),
                f"{signed(drift)} °/min" if np.isfinite(drift) else "",
            ]
        )
    if not rows:
        return None
    header = ["sensor", "nearest axes in the start pose", "stated before", "tilt ±", "heading ±", "heading drift"]
    starts = [calibration.model.table.segments[name].start_std[:2] for name in calibration.start_pose_offset]
    picture = draw_sensors(rows, float(np.degrees(_rms(np.array(starts)))), float(np.degrees(DRIFT_STD)) * 60.0)
    return {"picture": picture, "sensors": Table(header, lines)}


def _build_gap_section(calibration: Calibration, contact: _Contact) -> dict[str, Any] | None:
    order = _closure_order(calibration)
    if len(order) < 2:
        return None
    time = calibration.time[order]
    learned = {
        label: smoothed(time, np.mean([calibration.information_shares[name] for name in names], axis=0)[order])
        for label, names in _group_shares(calibration, contact).items()
    }
    step = float(np.median(np.diff(time)))
    half = {}
    for label, values in learned.items():
        share = np.cumsum(np.sort(values)[::-1]) / max(float(np.sum(values)), 1e-12)
        half[label] = (int(np.searchsorted(share, 0.5)) + 1) * step
    gap, prior_gap = calibration.gap[order], calibration.prior_gap[order]
    apart = _open_spans(time, calibration.contact[order])
    return {
        "picture": draw_gap(time, gap, prior_gap, apart, learned, contact.gap),
        "gap": contact.gap,
        "before_mm": 1e3 * calibration.prior_rms_gap,
        "after_mm": 1e3 * calibration.rms_gap,
        "half": half,
        "seconds": len(time) * step,
        "samples": calibration.effective_sample_size,
    }


def _build_places_section(calibration: Calibration, contact: _Contact, pose: Pose | None) -> dict[str, Any] | None:
    """Where the motion was informative."""
    if pose is None:
        return None
    shares = [
        calibration.information_shares[name] for names in _group_shares(calibration, contact).values() for name in names
    ]
    order = _closure_order(calibration)
    table, lengths = calibration.model.table, calibration.subject.lengths
    limbs = [limb for point in contact.points if (limb := table.find_limb(point)) is not None]
    starts = [limb.points[0] for limb in limbs]
    if not (shares and len(order) and limbs) or not {*contact.points, *starts} <= set(pose.points):
        return None
    base = limbs[0].base or ""
    if len(limbs) < len(contact.points) or base not in pose.quat_WL or {limb.base or "" for limb in limbs} != {base}:
        return None
    at = np.clip(np.searchsorted(pose.time, calibration.time[order] - 1e-6), 0, len(pose.time) - 1)
    reach = np.mean([pose.points[name][at] for name in contact.points], axis=0)
    reach = reach - np.mean([pose.points[name][at] for name in starts], axis=0)
    reach = Rotation.from_quat(pose.quat_WL[base][at]).inv().apply(reach)
    share = np.mean(shares, axis=0)[order]
    touched = (calibration.contact[order] >= MIN_CONTACT) & np.isfinite(reach).all(axis=1)
    if not touched.any():
        return None
    parts = [[table.find_length(*ends) for ends in pairwise(limb.points)] for limb in limbs]
    straight = float(np.mean([sum(lengths[name] for name in names if name is not None) for names in parts]))
    far = np.linalg.norm(reach, axis=1) / straight
    width, trunk = (
        lengths.get(table.find_length(*points) or "") for points in (limbs[0].origin, (ROOT, *limbs[0].origin))
    )
    sides = [{"left": 0.5, "right": -0.5}.get(table.side(name), 0.0) for name in contact.points]
    reach = reach + [0.0, (width or 0.0) * float(np.mean(sides)), 0.0]
    origin = plain(table.shared_name(starts[0]))
    origins = plural(origin) if len(limbs[0].origin) > 1 else origin
    places = Places(reach, 100 * share, touched, width, trunk, origins, plain(base))
    zones = {
        f"above the {origins}": reach[:, 2] > 0.0,
        f"from the {origins} to {-100 * LOW:.0f} cm below": (reach[:, 2] <= 0.0) & (reach[:, 2] > LOW),
        "lower": reach[:, 2] <= LOW,
        f"to the left by over {100 * ASIDE:.0f} cm": reach[:, 1] > ASIDE,
        f"in front of the {plain(base)}": np.abs(reach[:, 1]) <= ASIDE,
        f"to the right by over {100 * ASIDE:.0f} cm": reach[:, 1] < -ASIDE,
        f"near: under {100 * BENT:.0f} % of the limb's length": far < BENT,
        "half stretched": (far >= BENT) & (far < STRETCHED),
        f"stretched: over {100 * STRETCHED:.0f} %": far >= STRETCHED,
    }
    total = max(float(share[touched].sum()), 1e-12)
    lines, rare = [], []
    for name, inside in zones.items():
        spent, learned = float(np.mean(inside[touched])), float(share[touched & inside].sum()) / total
        rate = f"{learned / spent:.1f} × the mean" if spent > 0.005 else ""
        lines.append([name, f"{100 * spent:.0f} %", f"{100 * learned:.0f} %", rate])
        if spent < 0.05:
            rare.append(name.split(":")[0])
    low, high = np.percentile(reach[touched], [2.0, 98.0], axis=0) * 100
    near, away = np.percentile(far[touched], [2.0, 98.0]) * 100
    both = len(starts) > 1
    header = [f"{contact.noun} {'were' if both else 'was'}", "of the time", "of what was learned", "per second"]
    return {
        "noun": contact.noun,
        "origin": origins if both else origin,
        "across": [_format_side(end[1], "right", "left") for end in (low, high)],
        "up": [_format_side(end[2], "below", "above") for end in (low, high)],
        "stretch": [near, away],
        "rare": rare if both else [],
        "picture": draw_places(places, contact.noun),
        "zones": Table(header, lines),
    }


def _build_posture_section(calibration: Calibration) -> dict[str, Any] | None:
    tilt = {name: np.asarray(t, dtype=float) for name, t in calibration.start_pose_offset.items()}
    tilt = {name: t for name, t in tilt.items() if np.isfinite(t).all()}
    if not tilt:
        return None
    lines, observed, table = [], {}, calibration.model.table
    for name, (x, y) in tilt.items():
        std = np.degrees([calibration.subject.std(row) for row in mount_rows(name)[:2]])
        observed[name] = (~(std > UNOBSERVED * np.degrees(table.segments[name].start_std[:2]))).tolist()
        tilts = ((1, x, std[0], observed[name][0]), (0, y, std[1], observed[name][1]))
        lines.append([plain(name), *(_format_tilt(table, name, *about) for about in tilts)])
    hinges = {}
    for name, hinge in table.hinges.items():
        if hinge.on in tilt and hinge.moves in tilt:
            along = [
                Rotation.from_rotvec([*tilt[segment], 0.0]).apply(table.segments[segment].along)
                for segment in (hinge.on, hinge.moves)
            ]
            hinges[plain(name)] = float(np.degrees(np.arccos(np.clip(along[0] @ along[1], -1.0, 1.0))))
    return {
        "hinges": hinges,
        "picture": None if table.is_mechanism else draw_posture(tilt, observed, calibration.body),
        "tilts": Table(["segment", "sideways", "forwards or backwards"], lines),
    }


def _build_hinges_section(calibration: Calibration) -> dict[str, Any] | None:
    lines, table = [], calibration.model.table
    for joint, axis in calibration.hinge_axes.items():
        x, y, z = np.asarray(axis, dtype=float)
        if table.side(joint) == "right":  # seen along its outer end
            x, y, z = -x, -y, -z
        forward, up = np.degrees(np.arctan2(x, abs(y))), np.degrees(np.arctan2(z, abs(y)))
        softness = float(np.degrees(calibration.hinge_rms.get(joint, np.nan)))
        if not np.isfinite([forward, up]).all():
            continue
        ends = f"{abs(forward):.1f}° {'forwards' if forward > 0 else 'backwards'}", f"{abs(up):.1f}° "
        lines.append([plain(joint), ends[0], ends[1] + ("up" if up > 0 else "down"), degrees(softness)])
    header = ["joint", "axis turned", "axis raised", "softness"]
    return {"hinges": Table(header, lines)} if lines else None


def _build_view_section(
    calibration: Calibration, recording: Recording, tracked: TrackedRecording | None
) -> dict[str, Any] | None:
    if tracked is None or not len(calibration.time):
        return None
    begin, end = float(calibration.time.min()), float(calibration.time.max())
    samples = slice(*np.searchsorted(tracked.time, [begin - 1e-6, end + 1e-6]))
    if samples.stop - samples.start < 2:
        return None
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
    return {"page": pose_html(tracked.model, cut, phases=phases, title=recording.name, fps=FRAMES_A_SECOND)}


def _build_run_section(
    calibration: Calibration, recording: Recording, contact: _Contact, method: str
) -> dict[str, Any]:
    lengths = {name: calibration.measured_lengths[name] for name in calibration.measured}
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
        ("prior", calibration.prior.note or calibration.prior.name),
        ("sensors mounted again", "yes" if recording.remounted else "no"),
        ("made with", versions()),
    ]
    return {"rows": rows}


def _build_checks_section(quality: CalibrationQuality | None, contact: _Contact) -> dict[str, Any] | None:
    if quality is None:
        return None
    rows = []
    for check in quality.checks:
        if np.isfinite(check.value):
            quantity_name, unit = _describe_check(check, contact)
            bound = "at least" if check.limits.passes > check.limits.poor else "up to"
            limits = [f"{bound} {quantity(limit, unit)}" for limit in check.limits]
            rows.append([quantity_name, quantity(check.value, unit), *limits, check.quality])
    header = ["checked", "value", "passes", "poor", "quality"]
    unknowns = {"unknowns": quality.unknowns, "rank": quality.rank, "determined": quality.determined}
    return {**unknowns, "checks": Table(header, rows)} if rows else None


# Words and small sums -------------------------------------------------------------------------------------------------


def _list_lengths(table: BodyTable) -> list[tuple[str, ...]]:
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


def _group_shares(calibration: Calibration, contact: _Contact) -> dict[str, list[str]]:
    """Label → names in `Calibration.information_shares`, of the quantities that the motion can show."""
    learned, table = calibration.information_shares, calibration.model.table
    groups = group_lengths(calibration.conditions, calibration.model.lengths)
    limbs = [" + ".join(names) for sensor, names in groups.items() if not table.segments[sensor].spine]
    shown = {
        "lengths": [name for name in limbs if name in learned and set(name.split(" + ")) <= set(contact.chain)],
        "headings": [name for name in learned if name.startswith("mounts.") and name.endswith(".z")],
    }
    return {label: names for label, names in shown.items() if names}


def _closure_order(calibration: Calibration) -> np.ndarray:
    """Indices of the samples of a closure, in the order of time."""
    order = np.argsort(calibration.time, kind="stable")
    return order[np.isfinite(calibration.gap[order])]


def _open_spans(time: np.ndarray, contact: np.ndarray) -> list[tuple[float, float]]:
    """Spans [s] in which the palms were apart."""
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return [(begin - half, end + half) for begin, end in find_intervals(time, contact < MIN_CONTACT)]


def _mount_stds(subject: Subject, segment: str) -> tuple[float, float]:
    """Standard deviations [deg] of a mount's tilt, root mean square of both axes, and of its heading."""
    x, y, z = np.degrees([subject.std(row) for row in mount_rows(segment)])
    return float(np.sqrt(0.5 * (x**2 + y**2))), float(z)


def _std(subject: Subject, names: Sequence[str], weights: np.ndarray) -> float:
    if not set(names) <= set(subject.order):
        return float("nan")
    return float(np.sqrt(weights @ subject.lengths_covariance(names) @ weights))


def _minus_sign(axis: str) -> str:
    return axis.replace("-", "−")


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
    return f"{plus_minus(abs(deg), std, '°')} {direction(table, name, across, deg)}".replace(" °", "°")


def _format_side(value: float, negative: str, positive: str) -> str:
    return f"{abs(value):.0f} cm {positive if value >= 0.0 else negative}"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")
