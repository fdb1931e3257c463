"""The report of a tracked recording: what can be relied on, the recording, headings, hands, joint angles."""

from collections.abc import Mapping

import numpy as np

from ..angles import Angles
from ..angles import summary as summarize_angles
from ..body import BodyTable
from ..body.kinematics import compute_axis_std
from ..recording import format_span
from ..recording.plausibility import GRAVITY_ERROR_NOTED
from ..tracking import TrackResult, TrackSummary
from ..tracking import summary as measures
from . import figures as fig
from .angles import draw_joint_angles
from .figures import Figures, ReportFigure, styled
from .page import Frame, Item, render_page, show_diagnostics
from .viewer import compute_angles
from .words import Table, explain_no_covariance, kinds, listed, name_tips, number, plain, plural, spread

PATH_POINTS = 1000
VIEWS = (("from the front", 1, 2), ("from the right", 0, 2), ("from above", 1, 0))  # axes across and up
AXES = ("forwards [cm]", "to the left [cm]", "upwards [cm]")


def render_track_report(summary: TrackSummary, reliance: str, angles: Angles | None, page: str) -> str:
    """Return the text of ``report.html``, one page that opens offline and can be printed. It is deterministic.

    Its size does not grow with the recording's length. `reliance` is said first; `page` is the view inside.
    """
    tracked, recording, table = summary.tracked, summary.recording, summary.tracked.model.table
    checked = listed(["Rates", "ranges", "static phases", "headings", *kinds(table, table.hinges)])
    return render_page(
        f"Motion of {recording.name or 'a recording'}",
        [
            reliance,
            show_diagnostics(summary.diagnostics, f"**No warnings.** {checked} are within their limits."),
            _describe_recording(tracked),
        ],
        {
            "What was recorded": _list_recorded(tracked, summary),
            "Drift of the headings": _list_drift(tracked),
            f"The {name_tips(table, table.drawn_limbs)}": _list_tips(tracked, summary),
            "Joint angles": _list_angles(tracked, angles) if angles is not None else [],
            "The motion in 3D": [Frame(page)],
        },
    )


# Sections -------------------------------------------------------------------------------------------------------------


def _describe_recording(tracked: TrackResult) -> str:
    recording, time = tracked.recording, tracked.time
    mounts = "as the session states them" if measures.has_stated_mounts(tracked) else "as calibrated"
    quality = f"; quality of the calibration: {tracked.subject.quality}" if tracked.subject.quality else ""
    text = (
        f"{recording.time[-1] - recording.time[0]:.0f} s at {recording.rate_hz:g} Hz from {len(recording.sensors)} "
        f"sensors, {tracked.options['method'] if recording.imus else 'measured orientations'}. Lengths: "
        f"{plain(tracked.subject.note or tracked.subject.name)}; mounts {mounts}{quality}. ± is one standard deviation "
        "throughout: two times out of three the truth lies within."
    )
    if tracked.subject.is_population and not tracked.model.table.is_mechanism:
        text += " `wepose calibrate` measures the lengths of the person."
    if len(recording) > len(time):
        text += (
            f" Angles and positions are shown for {len(time)} samples, one in {len(recording) / len(time):.0f}; "
            "extremes, static phases and losses include all samples."
        )
    before = float(time[np.argmax(measures.find_samples_after_start(tracked))] - time[0])
    if before >= 1.0:
        text += f" Each ± is taken after the start pose, so the first {before:.0f} s are left out."
    return text


def _list_recorded(tracked: TrackResult, summary: TrackSummary) -> list[Item]:
    rate_hz, rows = tracked.recording.rate_hz, []
    phases = "; ".join(
        f"{name} {', '.join(map(format_span, spans))}" for name, spans in tracked.recording.phases.items()
    )
    for name, (rate, cut) in summary.signals.items():
        gap, orientation = tracked.recording.sensors[name].gap, tracked.segments.orientation.get(name)
        lost = 0 if gap is None else np.count_nonzero(gap)
        cells = [f"{np.degrees(rate.max()):.0f} °/s"]
        cells += [f"{samples / rate_hz:.2f} s" for samples in (np.count_nonzero(cut), lost)]
        if orientation is None:  # measured orientations
            cells += [""] * 5
        else:
            static, biases = summary.static[name], (orientation.noise.gyro_bias, orientation.gyro_bias[-1])
            cells += [f"{100 * static.mean():.0f} %", f"{measures.longest_run_s(~static, rate_hz):.0f} s"]
            cells += [f"{np.degrees(np.linalg.norm(bias)):.2f} °/s" for bias in biases]
            cells.append(f"{orientation.noise.gravity:.3f} m/s²")
        rows.append([plain(name), *cells])
    header = ["sensor", "fastest rotation", "saturated", "lost", "static", "longest motion"]
    steps_ms = 1e3 * np.diff(tracked.recording.time)
    steps = " to ".join(dict.fromkeys(f"{step:.2f}" for step in (steps_ms.min(), steps_ms.max())))
    return [
        f"{len(tracked.recording)} samples at {rate_hz:g} Hz, one every {steps} ms."
        f"{f' Phases: {phases}.' if phases else ''}",
        draw_timeline(summary),
        Table("", [*header, "bias at first", "bias at the end", "gravity"], rows),
        "Saturated: an axis was at the end of its range, and the orientation lacks the rotation beyond it. While a "
        "sensor is static its gyroscope measures its bias, and the heading does not drift. An error of 0.1 °/s in the "
        "bias rotates the heading by 6° in a minute. Gravity should measure 9.81 m/s², to "
        f"{100 * GRAVITY_ERROR_NOTED:.0f} %.",
    ]


def _list_drift(tracked: TrackResult) -> list[Item]:
    stds, _ = measures.compute_heading_stds(tracked)
    if not stds:
        return [explain_no_covariance(tracked)]
    table, after_start = tracked.model.table, measures.find_samples_after_start(tracked)
    text = (
        "Gravity corrects the tilt. No sensor measures the heading, the rotation about the vertical: it is set in the "
        "start pose and then drifts with the gyroscope's errors."
    )
    if tracked.correction is not None:
        most = max(tracked.correction.max_correction_deg.values(), default=0.0)
        text += (
            f" What the joints and joined hands show corrected the headings by up to {most:.1f}°. This does not "
            "correct errors that all segments share, such as the heading of the whole person."
        )
    rows = []
    for name, std in [*stds.items(), *measures.compute_joint_heading_stds(stds, tracked.model).items()]:
        ends = measures.finite_median(std[after_start]), measures.finite_max(std[after_start]), std[-1]
        rows.append([plain(name), *(number(float(np.degrees(each)), 1, "°") for each in ends)])
    sides = {side: [name for name in stds if table.side(name) == side] for side in map(table.side, stds)}
    figure = fig.draw_over_time(
        tracked.time,
        {"heading, ± [°]": {name: np.degrees(std) for name, std in stds.items()}},
        "Uncertainty of each heading: one standard deviation, with mounts, start pose and soft tissue.",
        {name: fig.line_style(name, side, rank) for side, own in sides.items() for rank, name in enumerate(own)},
        spans=("clasp", tracked.recording.phases.get("clasp", ())),
    )
    return [text, figure, Table("", ["segment or joint", "median ±", "largest ±", "± at the end"], rows)]


def _list_tips(tracked: TrackResult, summary: TrackSummary) -> list[Item]:
    table, after_start = tracked.model.table, measures.find_samples_after_start(tracked)
    reaches, covs = measures.measure_reach(tracked.pose, table), tracked.pose.point_cov
    items: list[Item] = list(draw_tips(tracked.time, reaches, table).values())
    for title, tips in group_tips(reaches, table).items():
        rows = []
        for name, reach in tips.items():
            low, high = np.nanpercentile(100 * reach, [1.0, 99.0], axis=0)
            ranges = [f"{number(a, 0)} to {number(b, 0)}" for a, b in zip(low, high, strict=True)]
            std = 1e3 * compute_axis_std(covs[name])[after_start] if name in covs else np.full(1, np.nan)
            stds = [spread(each(std), 0, " mm") for each in (measures.finite_median, measures.finite_max)]
            rows.append([plain(name), *ranges, *stds])
        items.append(Table(f"The {title}", ["", *AXES, "median ±", "largest ±"], rows))
    if not items:
        return []
    items.append(
        "Ranges hold 98 % of the time. The ± is of one axis, relative to the root, and includes the lean and the "
        "lengths of all that lies between."
    )
    return [*items, *tabulate_error_budget(summary.error_budget)]


def tabulate_error_budget(budget: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """The share of each source of error in the ± of each point; none where no ± is known."""
    rows = []
    for point, shares in budget.items():
        stds = *(shares.get(source, 0.0) for source in measures.SOURCES), float(np.linalg.norm([*shares.values()]))
        rows.append([plain(point), *(number(1e3 * std, 0) for std in stds)])
    title = "What the ± is made of: root mean square of an axis; the parts add up in squares"
    return [Table(title, ["", *(f"{source} [mm]" for source in (*measures.SOURCES, "all"))], rows)] if rows else []


def _list_angles(tracked: TrackResult, angles: Angles) -> list[Item]:
    rows = []
    for joint, ranges in summarize_angles(angles).items():
        stds = angles[joint].std
        for k, name in enumerate(angles[joint].names):
            extremes = np.degrees([ranges.lowest[k], ranges.highest[k], ranges.range[k]])
            ends = (number(each, 0, "°", unknown="") for each in extremes)
            rate = number(np.degrees(ranges.peak_rate[k]), 0, " °/s", unknown="")
            std = spread(np.degrees(measures.finite_median(stds[:, k])) if stds is not None else np.nan, 1, "°")
            near_lock = f"{100 * ranges.near_lock:.0f} %" if k != 1 else ""
            rows.append([f"{plain(joint)}, {plain(name)}", *ends, rate, std, near_lock])
    stated = " The start pose counts as the exact N-pose: elbows that were bent by 10° in it read 10° too little."
    return [
        "After the International Society of Biomechanics (Wu 2005), left and right with the same signs: an angle named "
        "elevation is negative where the arm is raised, pronation is 90° with the palms at the thighs."
        f"{stated if measures.has_stated_mounts(tracked) else ''}",
        draw_joint_angles(angles),
        Table("", ["angle", "lowest", "highest", "range", "peak rate", "median ±", "near gimbal lock"], rows),
        "Near gimbal lock (10°) the first and the third angle of a joint are not separable and are left out; the "
        "quaternions in pose.parquet have no such singularity.",
    ]


# Figures --------------------------------------------------------------------------------------------------------------


def draw_figures(result: TrackResult) -> Figures:
    """Draw the paths of the hands and their reach, and the joint angles, of what is known; as `TrackResult.plot`."""
    figures, table = Figures(), result.model.table
    if len(result.time) > 1:
        figures |= draw_tips(result.time, measures.measure_reach(result.pose, table), table)
    if (angles := compute_angles(result.pose)) is not None:
        figures["angles"] = draw_joint_angles(angles)
    return figures


@styled
def draw_timeline(summary: TrackSummary) -> ReportFigure:
    """Each sensor over time: how fast it rotated, where it was static, lost, or cut off by its range."""
    recording, signals, table = summary.recording, summary.signals, summary.last.model.table
    time = recording.time
    most = max(1.0, max(float(np.degrees(rate.max())) for rate, _ in signals.values()))
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
    for name, spans in recording.phases.items():
        fig.shade(ax, spans, "phase")
        for begin, end in spans:
            if 110.0 * (end - begin) / (time[-1] - time[0]) > len(name):  # as many letters are as wide as the plot
                ax.text(begin, 1.02, f" {name}", fontsize=8)
    for row, (name, (rate, cut)) in enumerate(signals.items()):
        at, rate = fig.envelope(time, np.degrees(rate))
        ax.fill_between(at, -row, 0.85 * rate / most - row, color=fig.COLOURS[table.side(name) or "other"], linewidth=0)
        gap = recording.sensors[name].gap
        for mask, label, low, height, look in (
            (summary.static.get(name), "static", -0.1, 0.07, {"facecolor": "black"}),
            (gap, "lost and interpolated", 0.0, 0.85, {"facecolor": "none", "edgecolor": fig.SOFT, "hatch": "////"}),
            (cut, "saturated", 0.85, 0.1, {"facecolor": fig.ALARM, "edgecolor": fig.ALARM, "linewidth": 1.0}),
        ):
            if mask is not None and mask.any():
                bars = [(begin, end - begin) for begin, end in fig.find_spans(time, mask)]
                ax.broken_barh(bars, (low - row, height), label=label, **{"linewidth": 0, **look})
    figure.add_legend()
    return figure


def group_tips(tips: Mapping[str, np.ndarray], table: BodyTable) -> dict[str, dict[str, np.ndarray]]:
    """Group points by where their limbs begin: what the points are on and where a reach begins, in words → points."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for origin in dict.fromkeys(table.drawn_limbs[name].origin for name in tips):
        own = {name: tip for name, tip in tips.items() if table.drawn_limbs[name].origin == origin}
        base, start = table.drawn_limbs[next(iter(own))].base, plain(table.shared_name(origin[0]))
        start = f"middle of the {plural(start)}" if len(origin) > 1 else start
        frame = f"the {plain(base)}'s own axes" if base else "the axes of W"
        groups[f"{name_tips(table, own)}, from the {start} along {frame}"] = own
    return groups


@styled
def draw_tips(time: np.ndarray, tips: Mapping[str, np.ndarray], table: BodyTable) -> dict[str, ReportFigure]:
    """Draw "paths", the tips seen from the front, the right and above, and "reach", the tips over time."""
    groups = group_tips(tips, table)
    if not groups:
        return {}
    caption = f"The {'; the '.join(groups)}"
    paths = ReportFigure(f"{caption}: paths. A mark shows the beginning.", 2.7 * len(groups))
    styles = {name: fig.line_style(name, table.side(name)) for name in tips}
    panels: dict[str, dict[str, np.ndarray]] = {}
    for axes, (title, group) in zip(paths.grid(len(groups), 3), groups.items(), strict=True):
        for ax, (view, across, up) in zip(axes, VIEWS, strict=True):
            ax.set_title(view)
            ax.set_xlabel(AXES[across])
            ax.set_ylabel(AXES[up], labelpad=1)
            ax.set_aspect("equal", adjustable="datalim")
            ax.margins(0.05)
            if view == "from above":
                ax.invert_xaxis()
            ax.plot(0.0, 0.0, "+", color=fig.SOFT, markersize=10, label="where the reach begins")
            for name, reach in group.items():
                at = 100.0 * reach[:: max(1, len(reach) // PATH_POINTS)][:, [across, up]]
                ax.plot(at[:, 0], at[:, 1], **{**styles[name], "linewidth": 0.7})
                ax.plot(at[:1, 0], at[:1, 1], "s" if table.side(name) == "right" else "o", color=styles[name]["color"])
        for k, label in enumerate(AXES):
            heading = label if len(groups) == 1 else f"{title.partition(',')[0]}: {label}"
            panels[heading] = {name: 100.0 * reach[:, k] for name, reach in group.items()}
    paths.add_legend()
    return {"paths": paths, "reach": fig.draw_over_time(time, panels, f"{caption}: over time.", styles)}
