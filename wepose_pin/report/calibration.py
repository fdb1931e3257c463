"""The report of a calibration: what was found, how well it is known, and what of the motion told it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import START_POSE_STD
from ..calibration import Calibration
from ..calibration.known import DRIFT_STD
from ..calibration.lengths import GAUGE_STD
from ..calibration.protocols import Protocol, load_protocol
from ..calibration.verdict import EFFECTIVE, Finding, Verdict
from ..calibration.weighing import TOUCHED
from ..errors import WeposeError
from ..filters import BEST
from ..page import Banner, Block, Bullets, Facts, Frame, Heading, Sections, Table, as_html, capital, reason
from ..pose import Pose
from ..recording import Recording, axes_from_mount, mount_from_axes
from ..subject import Subject, mount_rows
from ..tracking import TrackedPose, track
from ..viewer import pose_html
from .figures import (
    Hands,
    Length,
    Sensor,
    direction,
    gap_picture,
    hands_picture,
    lengths_picture,
    posture_picture,
    sensors_picture,
    smoothed,
)
from .words import degrees, intervals, plain, plus_minus, signed, versions

SIDES, PARTS = ("left", "right"), ("upper_arm", "forearm", "hand")
FRAMES_A_SECOND = 20.0  # of the 3D view
VERDICTS = {
    "pass": "**Pass:** the calibration is good to use.",
    "poor": "**Poor:** usable, with larger errors than usual.",
    "fail": "**Fail:** do not use this calibration.",
}
UNSEEN = 0.97  # of the standard deviation that the start pose has anyway: the motion told nothing
# Zones of the joined hands, seen from the middle of the shoulders [m], and of their distance over the arm's length.
LOW, ASIDE, BENT, STRETCHED = -0.25, 0.10, 0.60, 0.80


def calibration_report(
    calibration: Calibration,
    recording: Recording,
    *,
    verdict: Verdict | tuple[str, Sequence[str]] | None = None,
    pose: TrackedPose | None = None,
    method: str = BEST,
    protocol: str | Path | Protocol = "clasp",
    gauge_std: float = GAUGE_STD,
    failures: list[str] | None = None,
) -> str:
    """``report.html``: one page that opens offline and prints; equal arguments give equal text.

    Parameters
    ----------
    verdict : of `judge`, or "pass", "poor" or "fail" and its reasons in words; None: the page gives none
    pose : the recording tracked with the calibrated subject, for the hands and the 3D view; None: it is tracked here
    method, protocol, gauge_std : as the calibration was run
    failures : takes a line for each section that cannot be made; the page says so in its place
    """
    contact = _contact(protocol if isinstance(protocol, Protocol) else load_protocol(protocol))
    trouble = ""
    if pose is None:
        try:
            pose = track(recording, calibration.subject, method=method)
        except Exception as error:
            trouble = f"Without the tracked motion, hence without hand positions and 3D view: {error}"
            if not isinstance(error, WeposeError) and failures is not None:
                failures.append(f"the motion cannot be tracked: {reason(error)}")
    sections = Sections(failures)
    blocks: list[Block] = [Heading(f"Calibration of {recording.name or 'a recording'}", 1)]
    if verdict is not None:
        grade, reasons = verdict if isinstance(verdict, tuple) else (verdict.grade, verdict.in_words())
        blocks.append(Banner(grade, VERDICTS.get(grade, grade), [capital(reason) for reason in reasons]))
    warnings = calibration.warnings
    if isinstance(verdict, Verdict):
        warnings = tuple(unsaid(warnings, verdict))
    notes = [capital(warning) for warning in (*warnings, *([trouble] if trouble else []))]
    if notes:
        blocks.append(Banner("note", "What to know" if len(notes) > 1 else "One thing to know", notes))
    blocks += [
        *sections("In short", lambda: [Bullets(_in_short(calibration, contact))]),
        "± is one standard deviation throughout: two times out of three the truth lies within.",
        *sections("Lengths", lambda: _lengths(calibration, contact)),
        *sections("Sensors", lambda: _sensors(calibration, recording)),
        *sections(f"{capital(contact.gap)} over time", lambda: _gap(calibration, contact)),
        *sections("Where the motion was informative", lambda: _hands(calibration, contact, pose) if pose else []),
        *sections("The start pose", lambda: _posture(calibration)),
        *sections("The elbows as hinges", lambda: _elbows(calibration)),
        *sections("The motion in 3D", lambda: _view(calibration, recording, pose) if pose else []),
        *sections("Behind the verdict", lambda: _findings(verdict, contact) if isinstance(verdict, Verdict) else []),
        *sections("What was run", lambda: _run(calibration, recording, contact, method, gauge_std)),
    ]
    return as_html(blocks, f"Calibration of {recording.name}" if recording.name else "Calibration")


def unsaid(warnings: Sequence[str], verdict: Verdict) -> list[str]:
    """The warnings that the verdict does not repeat word for word."""
    said = " ".join(verdict.in_words())
    return [warning for warning in warnings if warning not in said]


class _Contact(NamedTuple):
    """What a protocol holds together, in words."""

    protocol: str
    hands: tuple[str, ...]
    noun: str
    gap: str
    chain: tuple[str, ...]  # lengths that it holds


def _contact(protocol: Protocol) -> _Contact:
    hands = tuple(dict.fromkeys(p for c in protocol.closures for p in c.points if p.endswith("_hand")))
    if len(hands) < 2:
        noun = f"the {plain(hands[0])}" if hands else "the hands"
        return _Contact(protocol.name, hands, noun, "palm to its point", protocol.chain)
    bar = any(c.kind == "distance" for c in protocol.closures)
    noun, gap = ("the hands on the handle", "palms against the handle") if bar else ("the joined hands", "palm to palm")
    return _Contact(protocol.name, hands, noun, gap, protocol.chain)


# The sections ---------------------------------------------------------------------------------------------------------


def _in_short(calibration: Calibration, contact: _Contact) -> list[str]:
    subject = calibration.subject
    scaling = [name for name in calibration.gauge if name in contact.chain or name not in subject.lengths]
    scale = f"from the tape ({', '.join(map(plain, scaling))})" if scaling else "the average person's, nothing taped"
    said = []
    if contact.chain:
        said.append(f"Scale {scale}: all lengths together may be off by {100 * calibration.scale_std:.1f} %.")
    if np.isfinite(calibration.rms_gap):
        said.append(
            f"{capital(contact.gap)}: **{1e3 * calibration.rms_gap:.0f} mm** are left (root mean square), of "
            f"{1e3 * calibration.prior_rms_gap:.0f} mm with the average person's lengths."
        )
    tilts = {name: _mount_stds(subject, name) for name in subject.mounts}
    known = {name: std for name, std in tilts.items() if np.isfinite(std).all()}
    if known:
        tilt, heading = (max(known, key=lambda name, k=k: known[name][k]) for k in (0, 1))  # type: ignore[misc]
        said.append(
            f"Mounts: tilt known to ± {known[tilt][0]:.1f}° or better ({plain(tilt)}), heading to "
            f"± {known[heading][1]:.1f}° or better ({plain(heading)})."
        )
    return said


def _lengths(calibration: Calibration, contact: _Contact) -> list[Block]:
    subject, prior = calibration.subject, calibration.prior
    rows, lines = [], []
    for parts in _ROWS:
        weights = np.ones(len(parts))
        value, before = (sum(who.lengths.get(part, np.nan) for part in parts) for who in (subject, prior))
        std, before_std = (_std(who, parts, weights) for who in (subject, prior))
        taped = calibration.gauge.get(parts[0], np.nan) if len(parts) == 1 else np.nan
        label = _label(parts)
        rows.append(Length(label, value, std, before, before_std, taped))
        learned = calibration.learned.get(" + ".join(parts))
        lines.append(
            [
                label,
                f"**{plus_minus(1e3 * value, 1e3 * std, 'mm')}**",
                plus_minus(1e3 * before, 1e3 * before_std, "mm"),
                f"{1e3 * taped:.0f} mm" if np.isfinite(taped) else "",
                f"{100 * float(np.sum(learned)):.0f} %" if learned is not None else "",
            ]
        )
    said = []
    if any(f"{side}_hand" in contact.chain for side in SIDES):
        said.append(
            "A hand without a sensor moves with its forearm: only their sum is seen, the average ratio splits it."
        )
    outside = [plain(name) for name in subject.lengths if name not in contact.chain and name not in calibration.gauge]
    if outside:
        said.append(f"Not in the chain, known by the average person's proportions alone: {', '.join(outside)}.")
    if calibration.learned:
        said.append("Learned from the motion: its share of what is now known; the rest is average and tape.")
    header = ["length", "found", "average person", "taped", "learned from the motion"]
    return [Heading("Lengths"), lengths_picture(rows), *([" ".join(said)] if said else []), Table(header, lines)]


def _sensors(calibration: Calibration, recording: Recording) -> list[Block]:
    subject = calibration.subject
    rows, lines = [], []
    for name, quat_LS in subject.mounts.items():
        tilt, heading = _mount_stds(subject, name)
        drift = np.degrees(calibration.drift.get(name, np.nan)) * 60.0
        rows.append(Sensor(plain(name), tilt, heading, drift))
        up, forward = axes_from_mount(quat_LS)
        nearest = Rotation.from_quat(mount_from_axes(up, forward))
        off = np.degrees((nearest.inv() * Rotation.from_quat(quat_LS)).magnitude())
        sensor = recording.sensors.get(name)
        stated = sensor is not None and sensor.stated_quat_LS is not None
        lines.append(
            [
                plain(name),
                f"{_sign(up)} up, {_sign(forward)} forward, turned {off:.0f}°",
                "yes" if stated else "no",
                degrees(tilt),
                degrees(heading),
                f"{signed(drift)} °/min" if np.isfinite(drift) else "",
            ]
        )
    if not rows:
        return []
    header = ["sensor", "nearest axes in the start pose", "stated before", "tilt ±", "heading ±", "heading drift"]
    picture = sensors_picture(rows, float(np.degrees(START_POSE_STD)), float(np.degrees(DRIFT_STD)) * 60.0)
    text = (
        "How each sensor sits on its segment: which of its axes point up and forward, and by how much it is turned "
        "from there; the exact rotations are in `subject.toml`. Without a magnetometer a heading drifts; what drifted "
        "during the calibration was found and taken out."
    )
    return [Heading("Sensors"), text, picture, Table(header, lines)]


def _gap(calibration: Calibration, contact: _Contact) -> list[Block]:
    order = _looked(calibration)
    if len(order) < 2:
        return []
    time = calibration.time[order]
    told = {
        label: smoothed(time, np.mean([calibration.learned[name] for name in names], axis=0)[order])
        for label, names in _told(calibration, contact).items()
    }
    blocks: list[Block] = [Heading(f"{capital(contact.gap)} over time")]
    gap, prior_gap = calibration.gap[order], calibration.prior_gap[order]
    blocks.append(gap_picture(time, gap, prior_gap, _apart(time, calibration.kept[order]), told, contact.gap))
    said = []
    for label, values in told.items():
        kept = np.argsort(values)[::-1]
        share = np.cumsum(values[kept]) / max(float(np.sum(values)), 1e-12)
        step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
        half = (int(np.searchsorted(share, 0.5)) + 1) * step
        said.append(f"{half:.0f} s of {len(time) * step:.0f} s told half of what the motion told about {label}")
    rms = f"{1e3 * calibration.prior_rms_gap:.1f} mm before, {1e3 * calibration.rms_gap:.1f} mm after"
    said.insert(0, f"{contact.gap}, root mean square where they touched: {rms}")
    said.append(
        f"the motion counts as {calibration.independent:.0f} independent measurements: neighbours tell the same"
    )
    return [*blocks, Bullets([f"{capital(text)}." for text in said])]


def _hands(calibration: Calibration, contact: _Contact, pose: Pose) -> list[Block]:
    """Where the motion was informative."""
    told = [calibration.learned[name] for names in _told(calibration, contact).values() for name in names]
    order = _looked(calibration)
    shoulders = [name.replace("hand", "shoulder") for name in contact.hands]
    if not (told and len(order) and contact.hands) or not {*contact.hands, *shoulders} <= set(pose.points):
        return []
    if "torso" not in pose.quat_WL:
        return []
    lengths = calibration.subject.lengths
    at = np.clip(np.searchsorted(pose.time, calibration.time[order] - 1e-6), 0, len(pose.time) - 1)
    reach = np.mean([pose.points[name][at] for name in contact.hands], axis=0)
    reach = reach - np.mean([pose.points[name][at] for name in shoulders], axis=0)
    reach = Rotation.from_quat(pose.quat_WL["torso"][at]).inv().apply(reach)
    share = np.mean(told, axis=0)[order]
    touched = (calibration.kept[order] >= TOUCHED) & np.isfinite(reach).all(axis=1)
    if not touched.any():
        return []
    arm = np.mean([[lengths[f"{name[:-5]}_{part}"] for part in PARTS] for name in contact.hands]) * len(PARTS)
    far = np.linalg.norm(reach, axis=1) / arm
    sides = [0.5 if name.startswith("left") else -0.5 for name in contact.hands]
    reach = reach + [0.0, lengths["shoulder_width"] * float(np.mean(sides)), 0.0]
    hands = Hands(reach, 100 * share, touched, lengths["shoulder_width"], lengths["trunk"])
    zones = {
        "above the shoulders": reach[:, 2] > 0.0,
        f"from the shoulders to {-100 * LOW:.0f} cm below": (reach[:, 2] <= 0.0) & (reach[:, 2] > LOW),
        "lower": reach[:, 2] <= LOW,
        f"to the left by over {100 * ASIDE:.0f} cm": reach[:, 1] > ASIDE,
        "in front of the chest": np.abs(reach[:, 1]) <= ASIDE,
        f"to the right by over {100 * ASIDE:.0f} cm": reach[:, 1] < -ASIDE,
        f"near: under {100 * BENT:.0f} % of the arm's length": far < BENT,
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
    plural = "s" if len(shoulders) > 1 else ""
    text = (
        f"{capital(contact.noun)} went from {_side(low[1], 'right', 'left')} to {_side(high[1], 'right', 'left')}, "
        f"from {_side(low[2], 'below', 'above')} to {_side(high[2], 'below', 'above')} the shoulder{plural}, "
        f"{near:.0f} to {away:.0f} % of the arm's length away."
    )
    if rare and plural:
        text += f" Hardly visited: {', '.join(rare)}; a repeat that goes there too tells more."
    header = [f"{contact.noun} {'were' if plural else 'was'}", "of the time", "of what was learned", "per second"]
    return [Heading("Where the motion was informative"), text, hands_picture(hands, contact.noun), Table(header, lines)]


def _posture(calibration: Calibration) -> list[Block]:
    tilt = {name: np.asarray(t, dtype=float) for name, t in calibration.start_tilt.items()}
    tilt = {name: t for name, t in tilt.items() if np.isfinite(t).all()}
    if not tilt:
        return []
    lines, seen = [], {}
    for name, (x, y) in tilt.items():
        std = np.degrees([calibration.subject.std(row) for row in mount_rows(name)[:2]])
        seen[name] = (~(std > UNSEEN * np.degrees(START_POSE_STD))).tolist()
        of = ((1, x, std[0], seen[name][0]), (0, y, std[1], seen[name][1]))
        lines.append([plain(name), *(_tilt(name, *about) for about in of)])
    said = []
    for side in SIDES:
        upper, fore = (tilt.get(f"{side}_{part}") for part in ("upper_arm", "forearm"))
        if upper is not None and fore is not None:
            down = [Rotation.from_rotvec([*t, 0.0]).apply([0.0, 0.0, -1.0]) for t in (upper, fore)]
            bend = np.degrees(np.arccos(np.clip(down[0] @ down[1], -1.0, 1.0)))
            said.append(f"{side} elbow bent by {bend:.1f}°")
    text = "Nobody stands exactly upright with hanging arms. How far each segment was off was found with the rest"
    text += f": {', '.join(said)}." if said else "."
    header = ["segment", "sideways", "forwards or backwards"]
    return [
        Heading("The start pose"),
        text,
        posture_picture(tilt, seen, calibration.subject.lengths),
        Table(header, lines),
    ]


def _elbows(calibration: Calibration) -> list[Block]:
    lines = []
    for side, axis in calibration.hinge.items():
        x, y, z = np.asarray(axis, dtype=float)
        if side == "right":  # seen along its outer end
            x, y, z = -x, -y, -z
        forward, up = np.degrees(np.arctan2(x, abs(y))), np.degrees(np.arctan2(z, abs(y)))
        softness = float(np.degrees(calibration.hinge_rms.get(side, np.nan)))
        if not np.isfinite([forward, up]).all():
            continue
        ends = f"{abs(forward):.1f}° {'forwards' if forward > 0 else 'backwards'}", f"{abs(up):.1f}° "
        lines.append([side, ends[0], ends[1] + ("up" if up > 0 else "down"), degrees(softness)])
    if not lines:
        return []
    text = (
        "An elbow is nearly a hinge. With a hanging upper arm its axis points sideways; the outer end of the axis is "
        "turned as stated. Softness: how far the forearm leaves the plane of that hinge, root mean square; over 5° "
        "points to a sensor that slides or to soft tissue."
    )
    header = ["elbow", "axis turned", "axis raised", "softness"]
    return [Heading("The elbows as hinges"), text, Table(header, lines)]


def _view(calibration: Calibration, recording: Recording, pose: TrackedPose) -> list[Block]:
    if pose.model is None or not len(calibration.time):
        return []
    begin, end = float(calibration.time.min()), float(calibration.time.max())
    of = slice(*np.searchsorted(pose.time, [begin - 1e-6, end + 1e-6]))
    if of.stop - of.start < 2:
        return []
    cut = Pose(
        pose.time[of],
        {name: quat[of] for name, quat in pose.quat_WL.items()},
        {name: points[of] for name, points in pose.points.items()},
    )
    shown = {
        name: [(max(a, begin), min(b, end)) for a, b in spans if b > begin and a < end]
        for name, spans in recording.phases.items()
    }
    phases: Mapping[str, Sequence[tuple[float, float]]] = {name: spans for name, spans in shown.items() if spans}
    inside = pose_html(pose.model, cut, phases=phases, title=recording.name, fps=FRAMES_A_SECOND)
    caption = (
        "The calibration motion as tracked with the calibrated subject. Drag to turn, scroll to zoom, space to pause."
    )
    return [Heading("The motion in 3D"), Frame("The motion in 3D", caption, inside)]


def _run(
    calibration: Calibration, recording: Recording, contact: _Contact, method: str, gauge_std: float
) -> list[Block]:
    gauge = [f"{plain(name)} {1e3 * v:.0f} ± {1e3 * gauge_std:.0f} mm" for name, v in calibration.gauge.items()]
    raw = sorted(
        {"ready orientations" if s.ready else "gyroscope and accelerometer" for s in recording.sensors.values()}
    )
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("sensors", f"{', '.join(map(plain, recording.sensors))} ({', '.join(raw)})"),
        ("length", f"{recording.time[-1] - recording.time[0]:.1f} s at {recording.rate_hz:g} Hz"),
        *((f"phase {name}", intervals(spans)) for name, spans in recording.phases.items()),
        ("protocol", f"{contact.protocol}, {len(calibration.time)} moments of it"),
        ("filter", method),
        ("gauge", ", ".join(gauge) or "none"),
        ("average person", calibration.prior.note or calibration.prior.name),
        ("strapping", recording.strapping.replace("_", " ")),
        *(("while reading", note) for note in recording.notes),
        ("made with", versions()),
    ]
    return [Heading("What was run"), Facts(rows)]


def _findings(verdict: Verdict, contact: _Contact) -> list[Block]:
    lines = [
        [
            _looked_at(found.name, contact),
            _shown(found.value, found.unit, ".0f" if found.unit == EFFECTIVE else ".1f"),
            *(f"{_bound(found)} {_shown(limit, found.unit, '.3g')}" for limit in (found.passes, found.poor)),
            found.grade,
        ]
        for found in verdict.findings
        if np.isfinite(found.value)
    ]
    text = (
        f"Of {verdict.unknowns} unknown directions of lengths and mounts the motion showed {verdict.rank}, and told "
        f"{verdict.determined} of them better than they were known before."
    )
    if not lines:
        return []
    header = ["looked at", "found", "passes", "poor", "verdict"]
    return [Heading("Behind the verdict"), text, Table(header, lines)]


# Words and small sums -------------------------------------------------------------------------------------------------

_SIDED = [((f"{s}_upper_arm",), (f"{s}_forearm",), (f"{s}_hand",), (f"{s}_forearm", f"{s}_hand")) for s in SIDES]
_ROWS: list[tuple[str, ...]] = [("shoulder_width",), *_SIDED[0], *_SIDED[1], ("trunk",)]


def _told(calibration: Calibration, contact: _Contact) -> dict[str, list[str]]:
    """What the motion can tell: label → names in `Calibration.learned`."""
    learned = calibration.learned
    arms = [f"{s}_upper_arm" for s in SIDES] + [f"{s}_forearm + {s}_hand" for s in SIDES]
    groups = {
        "lengths": [name for name in arms if name in learned and set(name.split(" + ")) <= set(contact.chain)],
        "headings": [name for name in learned if name.startswith("mounts.") and name.endswith(".z")],
    }
    return {label: names for label, names in groups.items() if names}


def _looked(calibration: Calibration) -> np.ndarray:
    """Indices, in the order of time, of the looks at which a gap was to close."""
    order = np.argsort(calibration.time, kind="stable")
    return order[np.isfinite(calibration.gap[order])]


def _apart(time: np.ndarray, kept: np.ndarray) -> list[tuple[float, float]]:
    """Spans [s] in which the palms were apart."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (kept < TOUCHED).astype(int), [0]))))
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return [(time[a] - half, time[b - 1] + half) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _mount_stds(subject: Subject, segment: str) -> tuple[float, float]:
    """Standard deviations [deg] of a mount's tilt, root mean square of both axes, and of its heading."""
    x, y, z = np.degrees([subject.std(row) for row in mount_rows(segment)])
    return float(np.sqrt(0.5 * (x**2 + y**2))), float(z)


def _std(subject: Subject, names: Sequence[str], weights: np.ndarray) -> float:
    if not set(names) <= set(subject.order):
        return float("nan")
    return float(np.sqrt(weights @ subject.lengths_covariance(names) @ weights))


def _label(parts: Sequence[str]) -> str:
    return plain(parts[0]) if len(parts) == 1 else f"{plain(parts[0])} + hand"


def _sign(axis: str) -> str:
    return axis.replace("-", "−")


def _looked_at(name: str, contact: _Contact) -> str:
    """What a finding is about."""
    what, _, of = name.partition(".")
    if what == "heading":
        return f"± heading, {plain(of)}"
    if what == "tape":
        return f"tape of {plain(of)}, against all else that is known"
    return {
        "anatomy": "doubt of the sensors' places, by anatomy",
        "upper_arms": "± upper arm, the scale apart",
        "forearms": "± forearm + hand, the scale apart",
        "shoulder_width": "± shoulder width, the scale apart",
        "scale": "± scale, all lengths together",
        "gap": f"{contact.gap}, root mean square",
        "motion": "effective sample size: what the motion is worth",
        "apart": "share of the time apart",
        "start_pose": "segment farthest off the start pose",
        "person": "length farthest from the average person",
    }.get(what, plain(name))


def _bound(found: Finding) -> str:
    return "at least" if found.passes > found.poor else "up to"


def _shown(value: float, unit: str, digits: str) -> str:
    """A value of a finding in the unit that people use."""
    scale, shown = {
        "m": (1e3, "mm"),
        "rad": (np.degrees(1.0), "°"),
        "relative": (100.0, "%"),
        "share": (100.0, "%"),
        "std of the average person": (1.0, "std"),
        "std of what is known without it": (1.0, "std"),
        EFFECTIVE: (1.0, ""),
    }.get(unit, (1.0, unit))
    return f"{scale * value:{digits}} {shown}".replace(" °", "°").strip()


def _tilt(name: str, across: int, angle: float, std: float, seen: bool) -> str:
    deg = float(np.degrees(angle))
    if not seen:
        return f"not seen, ± {std:.1f}° assumed"
    return f"{plus_minus(abs(deg), std, '°')} {direction(name, across, deg)}".replace(" °", "°")


def _side(value: float, negative: str, positive: str) -> str:
    return f"{abs(value):.0f} cm {positive if value >= 0.0 else negative}"
