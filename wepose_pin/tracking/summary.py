"""`TrackSummary`: what a tracked recording is worth saying in ``summary.json``, to the user and on its pages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic, as_json, gravest_first, merge
from ..errors import BadData, reason
from .decimation import Decimator
from .error_budget import ErrorBudget
from .headings import HeadingCorrection
from .pose_diagnostics import diagnose_pose
from .tracked import TrackedRecording

MOST_RESIDUAL = float(np.deg2rad(1.0))  # [rad] rms by which the model may miss a segment
_MOST_LATER = 10  # diagnostics of the later chunks of a long recording


@dataclass(frozen=True)
class TrackSummary:
    """The summary of a tracked recording.

    Parameters
    ----------
    content : of ``summary.json``: inputs, options and results
    diagnostics : what the user should know, the gravest first; `content` has them too
    decimator : has the samples and measures that pages show
    """

    content: dict[str, Any]
    diagnostics: tuple[Diagnostic, ...]
    decimator: Decimator


def summarize(tracked: TrackedRecording) -> TrackSummary:
    """The summary of a recording that was tracked as a whole."""
    accumulator = SummaryAccumulator()
    accumulator.add(tracked)
    return accumulator.finish()


class SummaryAccumulator:
    """The summary of a recording that is tracked in chunks, each added as it comes.

    Parameters
    ----------
    samples : of the whole recording, where pages shall show as many as fit into memory; 0 for all
    """

    def __init__(self, samples: int = 0) -> None:
        self._decimator = Decimator(samples)
        self._last: TrackedRecording | None = None
        self._begin, self._samples = 0.0, 0
        self._static: dict[str, int] = {}
        self._lost: dict[str, tuple[int, int, bool]] = {}  # segment → gaps, lost samples, whether the last one was
        self._residual: dict[str, float] = {}  # segment → sum of squares [rad²]
        self._ranges: dict[str, tuple[float, float]] = {}  # joint of a mechanism → least and largest value [rad or m]
        self._later: list[Diagnostic] = []  # of reading later chunks than the first
        self._error_budget = ErrorBudget()

    @property
    def last(self) -> TrackedRecording:
        """The last chunk.

        Raises
        ------
        BadData
            No chunk was added.
        """
        if self._last is None:
            raise BadData("no chunk was tracked: there is nothing to summarise")
        return self._last

    def add(self, tracked: TrackedRecording) -> None:
        """Add the next chunk."""
        if self._last is None:
            self._begin = float(tracked.time[0])
        else:
            known = (*self._later, *tracked.segments.diagnostics)
            self._later += [each for each in tracked.recording.diagnostics if each not in known]
        self._samples += len(tracked.time)
        for segment, orientation in tracked.segments.orientation.items():
            self._static[segment] = self._static.get(segment, 0) + int(np.count_nonzero(orientation.static))
        for segment, gap in tracked.pose.gap.items():
            gaps, samples, before = self._lost.get(segment, (0, 0, False))
            begun = int(np.count_nonzero(np.diff(gap, prepend=before) & gap))
            self._lost[segment] = gaps + begun, samples + int(np.count_nonzero(gap)), bool(gap[-1])
        for segment, angle in tracked.orientation_residual().items():
            self._residual[segment] = self._residual.get(segment, 0.0) + float(np.sum(angle**2))
        for joint, values in tracked.joints.items():
            low, high = self._ranges.get(joint, (np.inf, -np.inf))
            self._ranges[joint] = min(low, float(values.min())), max(high, float(values.max()))
        self._error_budget.add(tracked)
        self._decimator.add(tracked)
        self._last = tracked

    def finish(self) -> TrackSummary:
        """The summary, after the last chunk.

        Raises
        ------
        BadData
            No chunk was added.
        """
        diagnostics = self._diagnose()
        return TrackSummary(self._compose(diagnostics), diagnostics, self._decimator)

    def _compose(self, diagnostics: Iterable[Diagnostic]) -> dict[str, Any]:
        last = self.last
        sensors: dict[str, Any] = {}
        for segment in last.recording.sensors:
            about: dict[str, Any] = {"heading_deg": round(float(np.degrees(last.segments.heading_offset[segment])), 3)}
            orientation = last.segments.orientation.get(segment)
            if orientation is None:
                about["orientations"] = "from the recording"
            else:
                about["static_share"] = round(self._static[segment] / self._samples, 4)
                about["gyro_bias_start_deg_s"] = np.degrees(orientation.noise.gyro_bias).round(5).tolist()
                about["gyro_bias_end_deg_s"] = np.degrees(orientation.gyro_bias[-1]).round(5).tolist()
                about["gravity_m_s2"] = round(orientation.noise.gravity, 4)
            if segment in self._lost:
                about["gaps"], lost, _ = self._lost[segment]
                about["gap_s"] = round(lost / last.recording.rate_hz, 3)
            sensors[segment] = about
        residual_rms = self._residual_rms()
        return {
            "recording": last.recording.name,
            "session": str(last.recording.source) if last.recording.source else None,
            "method": last.options.method if last.segments.orientation else "measured orientations",
            "causal": last.options.causal,
            "model": last.model.robot.name,
            "subject": {"name": last.subject.name, "note": last.subject.note},
            "samples": self._samples,
            "rate_hz": round(last.recording.rate_hz, 4),
            "duration_s": round(float(last.time[-1]) - self._begin, 3),
            "phases": {"start": list(last.segments.start), "static": list(last.segments.static_phase)},
            "sensors": sensors,
            "points": sorted(last.points),
            "orientation_residual_rms_deg": {name: round(float(np.degrees(v)), 3) for name, v in residual_rms.items()},
            **self._summarize_joints(),
            "heading_correction": _correction_json(last.correction),
            "error_budget_mm": {
                point: {part: round(1e3 * std, 1) for part, std in parts.items()}
                for point, parts in self._error_budget.summarize().items()
            },
            "diagnostics": [as_json(diagnostic) for diagnostic in diagnostics],
        }

    def _diagnose(self) -> tuple[Diagnostic, ...]:
        """Those of reading, alignment and model, and those of the motion. Of later chunks a day's would be too many."""
        last = self.last
        variant = {"variant": "mechanism"} if last.model.table.is_mechanism else {}
        more = len(self._later) - _MOST_LATER
        known = (
            *last.segments.diagnostics,
            *self._later[:_MOST_LATER],
            *([Diagnostic("diagnostics-omitted", INFO, value=more)] if more > 0 else []),
            *_diagnose_unknown_points(last),
            *_diagnose_undetermined_joints(last),
            *(
                Diagnostic("orientation-residual", WARNING, segment, rms, MOST_RESIDUAL, variant)
                for segment, rms in self._residual_rms().items()
                if rms > MOST_RESIDUAL
            ),
            *last.model.diagnostics,
        )
        try:
            of_motion = diagnose_pose(*self._decimator.decimated)
        except Exception as error:  # hours of tracking are not lost by what only assesses them
            of_motion = [Diagnostic("motion-not-assessed", WARNING, facts={"reason": reason(error)})]
        return tuple(gravest_first(merge(known, of_motion)))

    def _summarize_joints(self) -> dict[str, Any]:
        """Start configuration, ranges and undetermined joints of a mechanism; of a person nothing."""
        table, recording = self.last.model.table, self.last.recording
        if not table.is_mechanism:
            return {}
        return {
            "start_joints": dict(table.poses.get(recording.start_pose, recording.joints)),  # others are at zero
            "joints": {name: {"min": round(a, 5), "max": round(b, 5)} for name, (a, b) in self._ranges.items()},
            "undetermined_joints": self.last.find_undetermined_joints(),
        }

    def _residual_rms(self) -> dict[str, float]:
        """Segment → [rad]."""
        return {name: float(np.sqrt(squares / self._samples)) for name, squares in self._residual.items()}


def _correction_json(correction: HeadingCorrection | None) -> dict[str, Any] | None:
    """What was observed, residuals of clasp and elbows before and after, and the largest correction of each heading."""
    if correction is None:
        return None
    about: dict[str, Any] = {
        "joint_accelerations": list(correction.joint_accelerations),
        "hinges": list(correction.hinges),
        "found_clasps": [[round(value, 2) for value in span] for span in correction.found_clasps],
        "hinge_rms_deg": {
            joint: [round(v, 3) for v in values] for joint, values in correction.hinge_residual_rms_deg.items()
        },
        "largest_correction_deg": {name: round(value, 3) for name, value in correction.max_correction_deg.items()},
    }
    if correction.gap_rms_mm is not None:
        about["clasp_gap_rms_mm"] = [round(value, 2) for value in correction.gap_rms_mm]
    return about


def _diagnose_unknown_points(tracked: TrackedRecording) -> list[Diagnostic]:
    """The points that are unknown for lack of a sensor."""
    missing = [point for point in tracked.model.table.points if point not in tracked.points]
    lacking = [name for name in tracked.model.table.needed if name not in tracked.quat_WL]
    if not missing or not lacking:
        return []
    facts = {"segments": ", ".join(lacking), "points": ", ".join(missing)}
    return [Diagnostic("points-unknown", INFO, facts=facts)]


def _diagnose_undetermined_joints(tracked: TrackedRecording) -> list[Diagnostic]:
    """The joints that sensors are too few to tell apart."""
    joints = tracked.find_undetermined_joints()
    return [Diagnostic("joints-undetermined", WARNING, facts={"joints": ", ".join(joints)})] if joints else []
