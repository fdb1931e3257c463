"""The report of a tracked recording: what can be relied on, the recording, headings, hands, joint angles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..angles import AUTO, Angles, group_sides, joint_angles, summary
from ..body import ROOT, BodyTable
from ..errors import BadData
from ..tracking import TrackResult, TrackSummary
from ..tracking.error_budget import group_by_source
from ..tracking.measures import (
    Budget,
    Measures,
    Signal,
    TipMotion,
    compute_joint_heading_stds,
    find_samples_after_start,
    finite_max,
    finite_median,
    has_stated_mounts,
    longest_run_s,
)
from ..tracking.pose_diagnostics import GRAVITY_OFF, describe_heading_remedy
from .angles import FULL_TURN, draw_joint_angles
from .figures import (
    ALARM,
    COLOURS,
    SOFT,
    ReportFigure,
    draw_over_time,
    envelope,
    find_spans,
    line_style,
    set_up_views,
    shade,
    styled,
)
from .page import Facts, Frame, Item, Page, Table, show_diagnostics
from .viewer import show_motion
from .words import capital, degrees, intervals, kinds, listed, plain, plural, whole

LARGEST_VIEW = 3_000_000  # characters of a given view that the report embeds
PATH_POINTS = 1000
METHODS_WITH_COVARIANCE = "amekf, smoother, smekf and smekf_published"


def render_track_report(summary: TrackSummary, *, view: str | None = None, failures: list[str] | None = None) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic.

    Its size does not grow with the recording's length.

    Parameters
    ----------
    summary : of `summarize`
    view : the page of `pose_html`, embedded up to `LARGEST_VIEW`; None: a view is made here
    failures : gets a line for each section that cannot be made; the page has the line in place of the section

    Raises
    ------
    BadData
        The motion could not be measured.
    """
    tracked, measures = summary.tracked, summary.measures
    if measures is None:
        raise BadData("the motion could not be measured")
    table = tracked.model.table
    find_angles = cache(lambda: _find_joint_angles(tracked))
    checked = listed(["Rates", "ranges", "static phases", "headings", *kinds(table, table.hinges)])
    reliable = f"**No warnings.** {checked} are within their limits."
    page = Page(f"Motion of {tracked.recording.name or 'a recording'}", failures)
    page.add("What can be relied on", lambda: _list_reliance(tracked, measures, find_angles()), heading=False)
    page.add("Diagnostics", lambda: [show_diagnostics(summary.diagnostics, reliable)], heading=False)
    page.add("In short", lambda: _list_facts(tracked, measures), heading=False)
    page.add("What was recorded", lambda: _list_recorded(tracked, measures))
    page.add("Drift of the headings", lambda: _list_drift(tracked, measures.budgets))
    page.add(f"The {_name_tips(table)}", lambda: _list_tips(tracked, measures))
    page.add("Joint angles", lambda: _list_angles(tracked, find_angles()))
    page.add("The motion in 3D", lambda: _list_view(tracked, view))
    page.add("What was run", lambda: _list_run(tracked))
    return page.html()


# Sections -------------------------------------------------------------------------------------------------------------


def _list_reliance(tracked: TrackResult, measures: Measures, angles: Angles | None) -> list[Item]:
    """Return what the motion is good for: the usual ± of hinges, hands and rotations, and the least certain angle."""
    after_start, table = find_samples_after_start(tracked), tracked.model.table
    stds = _find_angle_stds(angles, after_start) if angles is not None else {}
    tips = [finite_median(tip.std[after_start]) for tip in measures.tips.values() if tip.std is not None]
    hinges = {plain(table.shared_name(hinge)) for hinge in table.hinges}
    best = min(stds, key=stds.__getitem__, default=None)
    best = next((name for name in stds if name.removesuffix(" flexion") in hinges), best)
    worst = max(stds, key=stds.__getitem__, default=None)
    known = [f"{best} to ± {stds[best]:.0f}°"] if best is not None else []
    if tips and np.isfinite(tips).any():
        known.append(f"{_name_tips(table)} to ± {1e3 * np.nanmax(tips):.0f} mm from {_name_root(table)}")
    known += [f"{name} to ± {std:.0f}°" for name, std in stds.items() if name.endswith("rotation") and name != worst]
    if not known:
        return [_explain_no_covariance(tracked)]
    least = f" Least certain: {worst}, ± {stds[worst]:.0f}°." if worst not in (best, None) else ""
    return [f"**Good for** {listed(known)}.{least}"]


def _find_angle_stds(angles: Angles, samples: np.ndarray) -> dict[str, float]:
    """Angle, as "elbow flexion" → its median ± [deg] where it is determined, of the side where that is larger."""
    stds = {}
    for group, members in group_sides(angles.joints).items():
        for k, name in enumerate(angles[next(iter(members.values()))].names):
            each = [
                float(np.degrees(finite_median(joint.std[samples & ~joint.hidden(k), k])))
                for joint in (angles[member] for member in members.values())
                if joint.std is not None
            ]
            if np.isfinite(each).any():
                stds[f"{plain(group)} {plain(name)}"] = float(np.nanmax(each))
    return stds


def _explain_no_covariance(tracked: TrackResult) -> str:
    source = f"The filter {tracked.options.method}" if tracked.recording.imus else "The device"
    return (
        f"{source} states no uncertainty, so that this page cannot say how far angles and positions may be off. "
        f"The methods {METHODS_WITH_COVARIANCE} state it."
    )


def _list_facts(tracked: TrackResult, measures: Measures) -> list[Item]:
    recording = tracked.recording
    text = (
        f"{_format_duration(float(recording.time[-1] - recording.time[0]))} at {measures.rate_hz:g} Hz from "
        f"{len(measures.signals)} sensors. Lengths: {plain(tracked.subject.note or tracked.subject.name)}. ± is one "
        "standard deviation throughout: two times out of three the truth lies within."
    )
    if tracked.subject.is_population and not tracked.model.table.is_mechanism:
        text += " `wepose calibrate` measures those of the person."
    if measures.samples > len(recording):
        text += (
            f" Angles and positions are shown for {len(recording)} samples, one in "
            f"{measures.samples / len(recording):.0f}; extremes, static phases and losses include all samples."
        )
    before = float(tracked.time[np.argmax(find_samples_after_start(tracked))] - tracked.time[0])
    if before >= 1.0:
        text += (
            f" Each ± is of the time after the start pose; the {_format_duration(before)} before its end are left out."
        )
    return [text]


def _list_recorded(tracked: TrackResult, measures: Measures) -> list[Item]:
    recording, rate_hz = tracked.recording, tracked.recording.rate_hz
    low, high = (f"{step:.2f}" for step in measures.steps_ms)
    phases = "; ".join(f"{name} {intervals(spans)}" for name, spans in recording.phases.items())
    rows = []
    for name, signal in measures.signals.items():
        static = signal.static
        cells = [
            f"{np.degrees(signal.rate.max()):.0f} °/s",
            *(f"{np.count_nonzero(mask) / rate_hz:.2f} s" for mask in (signal.cut, signal.gap)),
            f"{100 * float(static.mean()):.0f} %" if static is not None else "",
            f"{longest_run_s(~static, rate_hz):.0f} s" if static is not None else "",
        ]
        if signal.bias is not None:
            cells += [f"{np.degrees(np.linalg.norm(bias)):.2f} °/s" for bias in signal.bias]
            cells.append(f"{signal.gravity:.3f} m/s²")
        rows.append([plain(name), *cells])
    header = ["sensor", "fastest rotation", "saturated", "lost", "static", "longest motion"]
    if any(signal.bias is not None for signal in measures.signals.values()):
        header += ["bias at first", "bias at the end", "gravity"]
    return [
        f"{measures.samples} samples at {measures.rate_hz:g} Hz, one every {low if low == high else f'{low} to {high}'}"
        f" ms.{f' Phases: {phases}.' if phases else ''}",
        draw_timeline(tracked, measures.signals),
        Table(header, [row + [""] * (len(header) - len(row)) for row in rows]),
        "Saturated: an axis was at the end of its range, and the orientation lacks the rotation beyond it. While a "
        "sensor is static its gyroscope measures its bias, and the heading does not drift. An error of 0.1 °/s in the "
        f"bias rotates the heading by 6° in a minute. Gravity should measure 9.81 m/s², to {100 * GRAVITY_OFF:.0f} %.",
    ]


def _list_drift(tracked: TrackResult, budgets: Mapping[str, Budget]) -> list[Item]:
    if not budgets:
        return [_explain_no_covariance(tracked)]
    recording, correction = tracked.recording, tracked.correction
    after_start = find_samples_after_start(tracked)
    text = (
        "Gravity corrects the tilt. No sensor measures the heading, the rotation about the vertical: it is set in the "
        "start pose and then drifts with the gyroscope's errors."
    )
    growth = {name: budget.growth for name, budget in budgets.items() if np.isfinite(budget.growth)}
    if growth:
        fastest = max(growth, key=growth.__getitem__)
        text += (
            f" By drift alone its uncertainty grows by up to {np.degrees(growth[fastest]):.1f}° in a minute of motion "
            f"(the {plain(fastest)}). {describe_heading_remedy(tracked)}"
        )
    has_clasp = correction is not None and (correction.gap_rms_mm is not None or bool(correction.found_clasps))
    if correction is not None:
        table = tracked.model.table
        sources = ["accelerations of the joints"] * bool(correction.joint_accelerations)
        sources += [f"{name}' hinges" for name in kinds(table, table.hinges)] + ["the joined hands"] * has_clasp
        if sources:
            text += (
                f" The {listed(sources)} corrected the headings, by up to "
                f"{max(correction.max_correction_deg.values(), default=0.0):.1f}°. This does not correct errors that "
                "all segments share, such as the heading of the whole person."
            )
    unknown = [plain(name) for name in recording.sensors if name not in budgets]
    text += f" The filter states no uncertainty: {listed(unknown)}." if unknown else ""
    if has_stated_mounts(tracked):
        text += " A mount that is stated and not calibrated is as uncertain as people are off the start pose."
    stds = {name: budget.std for name, budget in budgets.items()}
    rows = []
    for name, std in [*stds.items(), *compute_joint_heading_stds(budgets, tracked.model).items()]:
        ends = finite_median(std[after_start]), finite_max(std[after_start]), std[-1]
        rate = ""
        if name in budgets:
            rate = f"{np.degrees(growth[name]):.2f} °/min" if name in growth else "never in motion"
        rows.append([plain(name), *(degrees(float(np.degrees(each))) for each in ends), rate])
    header = ["segment or joint", "median ±", "largest ±", "± at the end", "growth in motion, filter alone"]
    figure = draw_over_time(
        tracked.time,
        {"heading, ± [°]": {name: np.degrees(std) for name, std in stds.items()}},
        "Uncertainty of each heading: one standard deviation, with mounts, start pose and soft tissue.",
        _style_segments(budgets, tracked.model.table),
        spans=("hands joined", recording.phases.get("clasp", ()) if has_clasp else ()),
    )
    text += " A joint has the errors of both its segments, here taken as independent."
    return [text, figure, Table(header, rows)]


def _list_tips(tracked: TrackResult, measures: Measures) -> list[Item]:
    table, after_start = tracked.model.table, find_samples_after_start(tracked)
    groups = group_tips(measures.tips, table, tracked.subject.lengths)
    if not groups:
        return []
    items: list[Item] = list(draw_tips(tracked.time, groups, table).values())
    for group in groups:
        rows = []
        for name, tip in group.tips.items():
            low, high = np.nanpercentile(100 * tip.reach, [1.0, 99.0], axis=0)
            stds = [
                pick(tip.std[after_start]) if tip.std is not None else np.nan for pick in (finite_median, finite_max)
            ]
            ranges = [f"{whole(a)} to {whole(b)}" for a, b in zip(low, high, strict=True)]
            known = [f"± {whole(1e3 * std)} mm" if np.isfinite(std) else "not known" for std in stds]
            rows.append([plain(name), *ranges, f"{tip.peak_speed:.1f} m/s", *known])
        points = capital(listed([plain(name) for name in group.tips]))
        items.append(f"{points}, from {group.start} along {group.frame}:")
        header = ["", "forwards [cm]", "to the left [cm]", f"above {group.origin} [cm]"]
        items.append(Table([*header, "highest speed", "median ±", "largest ±"], rows))
    items.append(
        "Ranges hold 98 % of the time; the highest speed is the mean of a tenth of a second. The ± is of one axis, "
        f"relative to {_name_root(table)}, and includes the lean and the lengths of all that lies between."
    )
    sources = {point: group_by_source(parts) for point, parts in measures.error_budget.items()}
    if sources:
        header = ["", *(f"{source} [mm]" for source in next(iter(sources.values())))]
        rows = [[plain(point), *(whole(1e3 * std) for std in each.values())] for point, each in sources.items()]
        items += [
            "What it is made of, root mean square over the recording; the parts add up in squares. Soft tissue, start "
            "poses and the shoulder girdle are as in the literature, not measured on this person.",
            Table(header, rows),
        ]
    return items


def _list_angles(tracked: TrackResult, angles: Angles | None) -> list[Item]:
    if angles is None:
        return []
    rows = []
    for joint, ranges in summary(angles).items():
        stds = angles[joint].std
        for k, name in enumerate(angles[joint].names):
            std = np.degrees(finite_median(stds[:, k])) if stds is not None else np.nan
            ends = [f"{whole(np.degrees(value))}°" for value in (ranges.lowest[k], ranges.highest[k], ranges.range[k])]
            if not np.isfinite(ranges.range[k]):
                ends = ["", "", ""]  # every sample is in a gap or near the lock, as of an arm that hangs
            elif ranges.range[k] >= FULL_TURN and ranges.near_lock:
                ends = ["", "", "all round"]
            rows.append(
                [
                    f"{plain(joint)}, {plain(name)}",
                    *ends,
                    f"{np.degrees(ranges.peak_rate[k]):.0f} °/s" if np.isfinite(ranges.peak_rate[k]) else "",
                    f"± {std:.1f}°" if np.isfinite(std) else "not known",
                    f"{100 * ranges.near_lock:.0f} %" if k != 1 else "",
                ]
            )
    stated = (
        " The start pose counts as the exact N-pose: elbows that were bent by 10° in it read 10° too little."
        if has_stated_mounts(tracked)
        else ""
    )
    return [
        "After the International Society of Biomechanics (Wu 2005), left and right with the same signs. Elevation "
        f"is negative where the arm is raised, and pronation is 90° with the palms at the thighs.{stated}",
        draw_joint_angles(angles),
        Table(["angle", "lowest", "highest", "range", "peak rate", "median ±", "near gimbal lock"], rows),
        "Near gimbal lock (10°) the first and the third angle of a joint are not separable and are left out; the "
        "quaternions in pose.parquet have no such singularity.",
    ]


def _list_view(tracked: TrackResult, view: str | None) -> list[Item]:
    if view is not None and len(view) <= LARGEST_VIEW:
        return [Frame(view)]
    return [show_motion(tracked.model, tracked.pose, tracked.recording.phases, tracked.recording.name)]


def _list_run(tracked: TrackResult) -> list[Item]:
    recording, subject = tracked.recording, tracked.subject
    rows = [
        ("recording", recording.name + (f", {recording.source.name}" if recording.source else "")),
        ("filter", tracked.options.method if tracked.segments.orientation else "none: measured orientations"),
        ("start pose", f"{recording.start_pose.replace('_', '-')}, {intervals([tracked.segments.start])}"),
        ("static phase", intervals([tracked.segments.static_phase])),
        ("person", f"{subject.name}; {subject.note}" if subject.note else subject.name),
        ("lengths", ", ".join(f"{plain(name)} {1e3 * value:.0f} mm" for name, value in subject.lengths.items())),
        ("mounts", "as the session states them" if has_stated_mounts(tracked) else "as calibrated"),
        ("body model", tracked.model.robot.name),
    ]
    return [Facts(rows)]


# Figures --------------------------------------------------------------------------------------------------------------


@styled
def draw_timeline(tracked: TrackResult, signals: Mapping[str, Signal]) -> ReportFigure:
    """Each sensor over time: how fast it rotated, where it was static, lost, or cut off by its range."""
    time, table = tracked.time, tracked.model.table
    most = max(1.0, max(float(np.degrees(signal.rate.max())) for signal in signals.values()))
    figure = ReportFigure(
        f"How fast each sensor rotated, on one scale: a row is {most:.0f} °/s high. "
        "Black bars under a row: static by the filter's test.",
        0.42 * len(signals) + 0.2,
    )
    ax = figure.grid(left_in=1.15)[0, 0]
    ax.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
    ax.set_ylim(-len(signals) + 0.8, 1.2)
    ax.set_yticks(-np.arange(len(signals)), [plain(name) for name in signals])
    ax.set_xlabel("time [s]")
    ax.grid(axis="y", visible=False)
    for name, spans in tracked.recording.phases.items():
        shade(ax, spans, "phase")
        for begin, end in spans:
            if 110.0 * (end - begin) / (time[-1] - time[0]) > len(name):  # as many letters are as wide as the plot
                ax.text(begin, 1.02, f" {name}", fontsize=8)
    for row, (name, signal) in enumerate(signals.items()):
        at, rate = envelope(time, np.degrees(signal.rate))
        ax.fill_between(at, -row, 0.85 * rate / most - row, color=COLOURS[table.side(name) or "other"], linewidth=0)
        for mask, label, low, height, look in (
            (signal.static, "static", -0.1, 0.07, {"facecolor": "black"}),
            (signal.gap, "lost and interpolated", 0.0, 0.85, {"facecolor": "none", "edgecolor": SOFT, "hatch": "////"}),
            (signal.cut, "saturated", 0.85, 0.1, {"facecolor": ALARM, "edgecolor": ALARM, "linewidth": 1.0}),
        ):
            if mask is not None and mask.any():
                bars = [(begin, end - begin) for begin, end in find_spans(time, mask)]
                ax.broken_barh(bars, (low - row, height), label=label, **{"linewidth": 0, **look})
    figure.add_legend()
    return figure


class TipGroup(NamedTuple):
    """Points whose paths are drawn together, for their limbs hang on the same points.

    Parameters
    ----------
    tips : point → its motion
    nouns : what the points are on, as "hands"
    origin, start : what the limbs hang at, as "shoulders", and where a reach begins, as "the middle of the shoulders"
    frame : whose axes its coordinates are along, in words
    width, trunk : [m] between the points at which they hang, and from the root to their middle; None: no such length
    """

    tips: Mapping[str, TipMotion]
    nouns: str
    origin: str
    start: str
    frame: str
    width: float | None
    trunk: float | None


def group_tips(tips: Mapping[str, TipMotion], table: BodyTable, lengths: Mapping[str, float]) -> list[TipGroup]:
    """The tips by the points at which their limbs hang; `lengths` [m] are the person's."""
    limbs, groups = table.drawn_limbs, []
    for origin in dict.fromkeys(limbs[name].origin for name in tips):
        names = [name for name in tips if limbs[name].origin == origin]
        width, trunk = (lengths.get(table.find_length(*points) or "") for points in (origin, (ROOT, *origin)))
        nouns = listed(kinds(table, [(limbs[name].segments or (name,))[-1] for name in names]))
        hangs_at, start = plain(table.shared_name(origin[0])), "the "
        if len(origin) > 1:
            hangs_at, start = plural(hangs_at), "the middle of the "
        base = limbs[names[0]].base
        groups.append(
            TipGroup(
                {name: tips[name] for name in names},
                nouns,
                hangs_at,
                start + hangs_at,
                f"the {plain(base)}'s own axes" if base else "the axes of W",
                width,
                trunk,
            )
        )
    return groups


@styled
def draw_tips(time: np.ndarray, groups: Sequence[TipGroup], table: BodyTable) -> dict[str, ReportFigure]:
    """Draw "paths", the tips seen from the front, the right and above, and "reach", the tips over time."""
    nouns = listed([group.nouns for group in groups])
    paths = ReportFigure(f"Paths of the {nouns}, seen from the body; a mark shows the beginning.", 2.7 * len(groups))
    styles: dict[str, dict[str, Any]] = {}
    panels: dict[str, dict[str, np.ndarray]] = {}
    for axes, group in zip(paths.grid(len(groups), 3), groups, strict=True):
        styles |= {name: line_style(name, table.side(name)) for name in group.tips}
        for ax, across, up in set_up_views(axes, group.width, group.trunk, group.origin):
            for name, tip in group.tips.items():
                at = 100.0 * tip.reach[:: max(1, len(tip.reach) // PATH_POINTS)][:, [across, up]]
                ax.plot(at[:, 0], at[:, 1], **{**styles[name], "linewidth": 0.7})
                ax.plot(at[:1, 0], at[:1, 1], "s" if table.side(name) == "right" else "o", color=styles[name]["color"])
        for k, label in enumerate(("forwards [cm]", "to the left [cm]", f"above the {group.origin} [cm]")):
            title = label if len(groups) == 1 else f"{group.nouns}: {label}"
            panels[title] = {name: 100.0 * tip.reach[:, k] for name, tip in group.tips.items()}
    paths.add_legend()
    caption = "; ".join(f"the {group.nouns} from {group.start} along {group.frame}" for group in groups)
    return {"paths": paths, "reach": draw_over_time(time, panels, capital(f"{caption}, over time."), styles)}


def _style_segments(names: Iterable[str], table: BodyTable) -> dict[str, dict[str, Any]]:
    """Styles of the segments' lines: colour by side, dashes by the place among the segments of that side."""
    ranks = {
        name: [each for each in table.segments if table.side(each) == table.side(name)].index(name) for name in names
    }
    return {name: line_style(name, table.side(name), rank) for name, rank in ranks.items()}


def _find_joint_angles(tracked: TrackResult) -> Angles | None:
    """The joint angles; None where no joint has both of its segments."""
    try:
        return joint_angles(tracked.pose, AUTO)
    except BadData:
        return None


# Words ----------------------------------------------------------------------------------------------------------------


def _name_tips(table: BodyTable) -> str:
    """Return what the points whose path is drawn are on, as "hands"."""
    return listed(kinds(table, [(limb.segments or (name,))[-1] for name, limb in table.drawn_limbs.items()]))


def _name_root(table: BodyTable) -> str:
    """Return what the origin of W is."""
    return "the root" if table.is_mechanism else "the middle of the hips"


def _format_duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"
