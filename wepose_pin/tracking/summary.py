"""`TrackSummary`: what a tracked recording is worth saying in ``summary.json``, to the user and on its pages.

The error budget is the contribution of each source of error to the standard deviation of each point. The contributions
add up in variance. The correlation of lengths and girdles goes to the lengths, that of the segments' headings to the
sensors.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel, BodyTable
from ..body.configuration import compute_orientation_residuals
from ..body.kinematics import Pose, compute_point_covariances, find_undetermined_joints, join_poses
from ..diagnostics import INFO, WARNING, Diagnostic, as_json, drop_consequences, gravest_first, merge
from ..filters import STATIC_ONLY, Orientation, join_orientations
from ..recording import ImuSensor, Recording, compute_rate, find_runs
from ..recording.faults import find_saturation
from ..recording.limits import NARROWEST_ACCEL_RANGE, NARROWEST_GYRO_RANGE
from .result import TrackResult
from .segment_orientations import compute_heading_variance, compute_soft_tissue_covariance

PERIOD_S = 1.0  # [s] from one sample of the error budget to the next
SOURCES = ("soft tissue", "sensor, mount, start pose", "lengths", "shoulder girdle")  # of the error budget
MOST_SAMPLES = 50_000  # that pages show; a longer recording is decimated to fewer than twice as many
# Limits of the diagnostics
MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment, if its ± is not larger
BIAS_LARGE = np.deg2rad(3.0)  # [rad/s] on an axis; data sheets allow 0.5 to 3 deg/s
LITTLE_STATIC, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
HEADING = np.deg2rad(15.0)  # one standard deviation of the drift between the segments of a joint; 14 at a good waist
# Correction of a heading: beyond this, and beyond so many standard deviations of what start pose, mount and drift leave
# open. In four walks of the preset `people`, whose start poses are as people hold them, it is at most 2.1 of them.
TURNED, TURNED_STDS = np.deg2rad(10.0), 2.5
# Beyond the range of a hinge while it extends: in the start pose a hanging elbow is bent by 5 to 15 deg.
RANGE_MARGIN = np.deg2rad(5.0)
# A hinge that is bent so far shows the plane in which it bends; right stated mounts leave up to 37 deg in people.
BENT, ASIDE = np.deg2rad(20.0), float(np.deg2rad(45.0))
LASTING_S = 1.0


class TrackSummary:
    """The summary of a recording that is tracked in chunks; it is complete after the last one.

    Parameters
    ----------
    recording : the whole one

    Attributes
    ----------
    last : the last chunk
    """

    last: TrackResult

    def __init__(self, recording: Recording) -> None:
        self._whole, self._every, self._samples = recording, max(1, len(recording) // MOST_SAMPLES), 0
        self._poses: list[Pose] = []  # decimated, as the orientations
        self._orientations: dict[str, list[Orientation]] = {}
        self._static: dict[str, list[np.ndarray]] = {}
        self._residual: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._joints: dict[str, tuple[float, float]] = {}  # of a mechanism: least and most

    def accumulate(self, chunks: Iterable[TrackResult]) -> Iterator[TrackResult]:
        """Iterate over chunks, and add each."""
        for tracked in chunks:
            # Numbers, since a slice would keep all of a chunk in memory.
            rows = np.arange(-self._samples % self._every, len(tracked.time), self._every)
            self._poses.append(tracked.pose.cut(rows))
            for segment, orientation in tracked.segments.orientation.items():
                self._static.setdefault(segment, []).append(orientation.static)
                self._orientations.setdefault(segment, []).append(orientation.take(rows))
            residuals = compute_orientation_residuals(tracked.model, tracked.q, tracked.segments.quat_WL)
            for segment, angle in residuals.items():
                self._residual[segment] = self._residual.get(segment, 0.0) + float(np.sum(angle**2))
            for name, values in tracked.joints.items() if tracked.model.table.is_mechanism else ():
                least, most = self._joints.get(name, (np.inf, -np.inf))
                self._joints[name] = float(np.minimum(least, values.min())), float(np.maximum(most, values.max()))
            self._samples += len(tracked.time)
            self.last = tracked
            yield tracked

    @cached_property
    def recording(self) -> Recording:
        """What was tracked of the recording, all samples."""
        return self._whole.cut(slice(len(self._whole) - self._samples, len(self._whole)))

    @cached_property
    def tracked(self) -> TrackResult:
        """The samples that pages show, at most twice `MOST_SAMPLES`; its `recording` has all."""
        orientation = {segment: join_orientations(parts) for segment, parts in self._orientations.items()}
        source = replace(self.last.segments, recording=self.recording, orientation=orientation)
        return replace(self.last, pose=join_poses(self._poses), source=source)

    @cached_property
    def static(self) -> dict[str, np.ndarray]:
        """Segment → (n,) bool, static by its filter's test; all samples."""
        return {segment: np.concatenate(parts) for segment, parts in self._static.items()}

    @cached_property
    def signals(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Segment → rate (n,) [rad/s] of its sensor, and where that is saturated (n,) bool; all samples."""
        signals = {}
        for name, sensor in self.recording.sensors.items():
            cut = np.zeros((len(self.recording), 3), dtype=bool)
            if isinstance(sensor, ImuSensor):
                cut |= find_saturation(sensor.gyro_S, NARROWEST_GYRO_RANGE)
                cut |= find_saturation(sensor.accel_S, NARROWEST_ACCEL_RANGE)
            rate = np.linalg.norm(compute_rate(sensor, self.recording.rate_hz), axis=1)
            signals[name] = rate, np.asarray(cut.any(axis=1))
        return signals

    @cached_property
    def undetermined_joints(self) -> list[str]:
        """The joints that the measured segments leave open, at least in part: they move little."""
        return find_undetermined_joints(self.last.model, self.last.quat_WL)

    @cached_property
    def error_budget(self) -> dict[str, dict[str, float]]:
        """Point → source of error → its share of the standard deviation [m] per axis, rms over time; the largest first.

        Shares below a tenth of a millimetre are left out. It is empty of a mechanism, and where no covariance is known.
        """
        tracked, pose, body = self.tracked, self.tracked.pose, self.tracked.model
        every = max(1, round(PERIOD_S * tracked.rate_hz)) if len(tracked.time) > 1 else 1
        rows = np.arange(0, len(tracked.time), every)
        for known in (*pose.quat_WL.values(), *pose.segment_cov.values()):
            rows = rows[np.isfinite(known[rows].sum(axis=tuple(range(1, known.ndim))))]
        if body.table.is_mechanism or not pose.point_cov or not len(rows):
            return {}
        quat_WL = {name: quat[rows] for name, quat in pose.quat_WL.items()}
        soft = {name: compute_soft_tissue_covariance(body.personal_table, quat_WL, name) for name in pose.segment_cov}
        zero = {name: np.zeros_like(cov) for name, cov in soft.items()}
        shape_cov = tracked.subject.shape_covariance(body.table)
        of_girdles, none, k = shape_cov.copy(), 0.0 * shape_cov, len(body.lengths)
        of_girdles[:k], of_girdles[:, :k] = 0.0, 0.0
        cases = (zero, none), (zero, of_girdles), (zero, shape_cov), (soft, none)
        covs = [compute_point_covariances(body, quat_WL, *case) for case in cases]
        budget = {}
        for point, cov in pose.point_cov.items():
            total, law, girdles, shape, tissue = (
                float(np.mean(np.trace(each, axis1=1, axis2=2))) / 3.0
                for each in (cov[rows], *(own[point] for own in covs))
            )
            variances = tissue - law, total - shape - tissue + law, shape - girdles, girdles
            stds = {source: float(np.sqrt(max(value, 0.0))) for source, value in zip(SOURCES, variances, strict=True)}
            ordered = sorted(stds.items(), key=lambda item: -item[1])
            budget[point] = {source: std for source, std in ordered if std >= 1e-4}
        return budget

    @cached_property
    def residual_rms(self) -> dict[str, float]:
        """Segment → rms [rad] by which the model misses its orientation, where joints are too few."""
        return {name: float(np.sqrt(squares / self._samples)) for name, squares in self._residual.items()}

    @cached_property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know, the gravest first; `content` has them too."""
        last = self.last
        diagnostics = merge((*last.segments.diagnostics, *last.model.diagnostics), self._diagnose())
        return tuple(gravest_first(drop_consequences(diagnostics)))

    @cached_property
    def content(self) -> dict[str, Any]:
        """The content of ``summary.json``: inputs, options and results."""
        last, recording = self.last, self.recording
        table, correction, segments = last.model.table, last.correction, last.segments
        sensors: dict[str, Any] = {}
        for segment, sensor in recording.sensors.items():
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(segments.heading_offset[segment])), 3)}
            orientation = segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(int(np.count_nonzero(self.static[segment])) / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if sensor.gap is not None:
                about["gaps"] = len(find_runs(sensor.gap))
                about["gap_s"] = round(int(np.count_nonzero(sensor.gap)) / recording.rate_hz, 3)
            sensors[segment] = about
        residual_deg = {name: round(float(np.degrees(rms)), 3) for name, rms in self.residual_rms.items()}
        content = {
            "recording": last.recording.name,
            "session": str(last.recording.source) if last.recording.source else None,
            "method": last.options["method"] if segments.orientation else "measured orientations",
            "causal": last.options["causal"],
            "model": last.model.robot.name,
            "subject": {"name": last.subject.name, "note": last.subject.note},
            "samples": self._samples,
            "rate_hz": round(last.recording.rate_hz, 4),
            "duration_s": round(float(recording.time[-1] - recording.time[0]), 3),
            "phases": {"start": list(segments.start), "static": list(segments.static_phase)},
            "sensors": sensors,
            "points": sorted(last.points),
            "orientation_residual_rms_deg": residual_deg,
        }
        if table.is_mechanism:
            content |= {
                "start_joints": dict(table.poses.get(recording.start_pose, recording.joints)),  # others are at zero
                "joints": {name: {"min": round(a, 5), "max": round(b, 5)} for name, (a, b) in self._joints.items()},
                "undetermined_joints": self.undetermined_joints,
            }
        corrected = None
        if correction is not None:
            corrected = {
                "joint_accelerations": [far for _, far in correction.filter.pairs],
                "hinges": [hinge.name for hinge in correction.filter.hinges],
                "largest_correction_deg": {name: round(v, 3) for name, v in correction.max_correction_deg.items()},
            }
        return content | {
            "heading_correction": corrected,
            "error_budget_mm": {
                point: {part: round(1e3 * std, 1) for part, std in parts.items()}
                for point, parts in self.error_budget.items()
            },
            "diagnostics": [as_json(diagnostic) for diagnostic in self.diagnostics],
        }

    # Diagnostics -----------------------------------------------------------------------------------------------------

    def _diagnose(self) -> Iterator[Diagnostic]:
        """Diagnose the model, signals, headings, start pose and hinges."""
        last = self.last
        missing = [point for point in last.model.table.points if point not in last.points]
        lacking = [name for name in last.model.table.needed if name not in last.quat_WL]
        if missing and lacking:
            facts = {"segments": ", ".join(lacking), "points": ", ".join(missing)}
            yield Diagnostic("sensors-missing", INFO, facts=facts)
        if (last.model.table.is_mechanism or (missing and not lacking)) and self.undetermined_joints:
            facts = {"variant": "joints", "joints": ", ".join(self.undetermined_joints)}
            yield Diagnostic("sensors-missing", WARNING, facts=facts)
        for segment, rms in self.residual_rms.items():
            cov = self.tracked.pose.segment_cov.get(segment, np.zeros((1, 3, 3)))
            limit = max(MOST_RESIDUAL, float(np.sqrt(finite_median(np.trace(cov, axis1=1, axis2=2)))))
            if rms > limit:
                yield Diagnostic("orientation-residual", WARNING, segment, rms, limit)
        for name in self.signals:
            yield from self._diagnose_signal(name)
        yield from self._diagnose_headings()
        if (late := float(last.segments.start[0] - self.tracked.time[0])) > LATE_START_S:
            yield Diagnostic("start-pose-late", INFO, "", late, LATE_START_S)
        for name in last.model.table.hinges:
            yield from self._diagnose_hinge(name)

    def _diagnose_signal(self, name: str) -> Iterator[Diagnostic]:
        (_, cut), rate_hz = self.signals[name], self.recording.rate_hz
        if cut.any():
            yield Diagnostic("signal-saturated", WARNING, name, np.count_nonzero(cut) / rate_hz)
        orientation = self.tracked.segments.orientation.get(name)
        if orientation is None:
            return
        bias = np.abs([orientation.noise.gyro_bias, orientation.gyro_bias[-1]])
        if (largest := float(bias.max())) > BIAS_LARGE:
            yield Diagnostic("gyro-bias-large", INFO, name, largest, BIAS_LARGE)
        share, seconds = float(self.static[name].mean()), longest_run_s(~self.static[name], rate_hz)
        if seconds > LONG_MOTION_S or share < LITTLE_STATIC:
            severity = WARNING if self.last.options["method"] in STATIC_ONLY else INFO
            yield Diagnostic("static-phases-rare", severity, name, share, LITTLE_STATIC, {"longest": seconds})

    def _diagnose_headings(self) -> Iterator[Diagnostic]:
        since, correction = find_samples_after_start(self.tracked), self.last.correction
        joints = compute_joint_heading_stds(compute_heading_stds(self.tracked)[1], self.last.model)
        wide = {joint: most for joint, std in joints.items() if (most := finite_max(std[since])) > HEADING}
        for joint in sorted(wide, key=wide.__getitem__, reverse=True):
            yield Diagnostic("heading-uncertain", WARNING, joint, wide[joint], HEADING)
        if correction is None:
            return
        for name, (turned, limit) in correction.filter.find_turned_mounts().items():
            yield Diagnostic("mount-contradicted", WARNING, name, abs(turned), limit, {"variant": "turned"})
        start_var = np.diag(correction.filter.start_cov + correction.filter.mount_cov)
        for (name, turned_deg), variance in zip(correction.max_correction_deg.items(), start_var, strict=True):
            orientation = self.tracked.segments.orientation.get(name)
            if orientation is not None and orientation.attitude_cov is not None:
                variance += finite_max(compute_heading_variance(orientation.quat_VS, orientation.attitude_cov)[since])
            limit = max(TURNED, TURNED_STDS * float(np.sqrt(variance)))
            if (turned := float(np.deg2rad(turned_deg))) > limit:
                yield Diagnostic("heading-corrected-far", WARNING, name, turned, limit)

    def _diagnose_hinge(self, name: str) -> Iterator[Diagnostic]:
        model, quat_WL, rate_hz = self.last.model, self.tracked.pose.quat_WL, self.recording.rate_hz / self._every
        hinge, calibrated = model.table.hinges[name], self.last.subject.turn_hinges(model).get(name)
        if not {hinge.on, hinge.moves} <= set(quat_WL):
            return
        axis = np.array(hinge.axis) if calibrated is None else calibrated.axis
        along_on, along_moves = (np.array(model.table.segments[each].along) for each in (hinge.on, hinge.moves))
        # Where the moving segment points at 90° of flexion: it bends to the wider end of its range.
        flexed = (-1.0 if sum(hinge.range) < 0.0 else 1.0) * np.cross(axis, along_on)
        R_on, R_moves = (Rotation.from_quat(quat_WL[each]) for each in (hinge.on, hinge.moves))
        moves = R_on.inv().apply(R_moves.apply(along_moves))
        # [rad] between the two segments; the same in the plane of the hinge, negative against the way it bends; aside.
        bend = np.arctan2(np.linalg.norm(np.cross(along_on, moves), axis=1), moves @ along_on)
        flexion = np.arctan2(moves @ (flexed / np.linalg.norm(flexed)), moves @ along_on)
        aside = np.abs(np.arcsin(np.clip(moves @ axis, -1.0, 1.0)))
        extended = min(float(np.sign(sum(hinge.range) or 1.0)) * end for end in hinge.range) - RANGE_MARGIN
        back = (aside < np.deg2rad(45.0)) & (flexion < extended) & (bend < np.deg2rad(90.0))
        if (seconds := np.count_nonzero(back) / rate_hz) > LASTING_S:
            most, facts = float(-flexion[back].min()), {"duration": seconds}
            yield Diagnostic("hinge-implausible", WARNING, name, most, -extended, facts)
        sideways = (bend > BENT) & (aside > ASIDE)
        if np.count_nonzero(sideways) / rate_hz > LASTING_S:
            most = float(aside[sideways].max())
            yield Diagnostic("hinge-implausible", WARNING, name, most, ASIDE, {"variant": "sideways"})


def summarize(tracked: TrackResult) -> TrackSummary:
    """Return the summary of a recording that was tracked as a whole."""
    summary = TrackSummary(tracked.recording)
    list(summary.accumulate([tracked]))
    return summary


# Measures -----------------------------------------------------------------------------------------------------------


def compute_heading_stds(tracked: TrackResult) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Compute segment → one standard deviation (n,) [rad] of its heading, and of the drift of its filter alone.

    The first includes start pose, soft tissue and the heading correction; with that the drift is at most what it
    leaves. There is none without a filter, or where that has no covariance.
    """
    stds, drifts, correction = {}, {}, tracked.correction
    for name, cov_W in tracked.pose.segment_cov.items():
        orientation = tracked.segments.orientation.get(name)
        if orientation is None or orientation.attitude_cov is None:
            continue
        drift = np.sqrt(np.maximum(compute_heading_variance(orientation.quat_VS, orientation.attitude_cov), 0.0))
        if correction is not None and len(correction.time) and name in correction.filter.names:
            i = correction.filter.names.index(name)
            drift = np.minimum(drift, np.sqrt(np.interp(tracked.time, correction.time, correction.covariance[:, i, i])))
        stds[name], drifts[name] = np.sqrt(np.maximum(cov_W[:, 2, 2], 0.0)), drift
    return stds, drifts


def compute_joint_heading_stds(stds: Mapping[str, np.ndarray], model: BodyModel) -> dict[str, np.ndarray]:
    """Joint → (n,) [rad] of the heading between its segments, as if `stds` of these were independent."""
    return {
        model.table.joint_name(segment): np.hypot(stds[above], stds[segment])
        for segment, above in model.parents.items()
        if above is not None and {above, segment} <= set(stds)
    }


def measure_reach(pose: Pose, table: BodyTable) -> dict[str, np.ndarray]:
    """Measure the reach (n, 3) [m] of each point whose path is drawn, as of a hand; only of points that are known.

    It is from the origin of its limb, in the segment on which that hangs; NaN: not known.
    """
    reaches = {}
    for name, limb in table.drawn_limbs.items():
        if not {name, *limb.origin} <= set(pose.points) or (limb.base is not None and limb.base not in pose.quat_WL):
            continue
        reach = pose.points[name] - np.mean([pose.points[point] for point in limb.origin], axis=0)
        if limb.base is not None:
            known = np.isfinite(pose.quat_WL[limb.base]).all(axis=1)
            quat = np.where(known[:, None], pose.quat_WL[limb.base], [0.0, 0.0, 0.0, 1.0])
            reach = Rotation.from_quat(quat).inv().apply(reach)
            reach[~known] = np.nan
        if np.isfinite(reach).all(axis=1).any():
            reaches[name] = reach
    return reaches


def find_samples_after_start(tracked: TrackResult) -> np.ndarray:
    """(n,) bool, the samples after the start pose, which the summaries of uncertainty are of.

    Before it the filters have not converged, and headings are extrapolated backwards.
    """
    since = tracked.time >= tracked.segments.start[1] - 1e-9
    return since if since.any() else ~since


def finite_max(values: np.ndarray) -> float:
    """The largest of the finite values; NaN where there is none."""
    return float(np.max(values, initial=-np.inf, where=np.isfinite(values))) if np.isfinite(values).any() else np.nan


def finite_median(values: np.ndarray) -> float:
    """The median of the finite values; NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def longest_run_s(mask: np.ndarray, rate_hz: float) -> float:
    """The longest run of true values [s]."""
    return max((b - a for a, b in find_runs(mask)), default=0) / rate_hz


def has_stated_mounts(tracked: TrackResult) -> bool:
    """Whether the mounts are the session's and not calibrated ones."""
    return not tracked.subject.mounts or tracked.recording.remounted
