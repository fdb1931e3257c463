"""`Tracker`: recording and subject → pose, chunk by chunk: filter, align, correct headings, kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..body import BodyModel
from ..body.body import load_sensed_model
from ..body.kinematics import KinematicsSolver
from ..body.links import compute_point_covariances
from ..body.mounts import StartPose, find_start_pose
from ..body.soft_tissue import SoftTissueCorrection, correct_table
from ..body.subject import Subject, population_subject
from ..body.table import check_segments
from ..errors import BadOption, BadPhase, BadSession
from ..filters import OFFLINE
from ..filters.phases import BEGINNING_S
from ..recording import Recording, join_recordings
from .headings import HeadingCorrection
from .result import TrackResult
from .segment_orientations import SegmentOrientations, TrackOptions
from .segments import SegmentEstimator
from .start_pose import START_POSE_HOLD_S, split_start_pose

CHUNK_S = 600.0  # of `track_chunks`
SHORTEST_S = 2.0  # of a chunk: a filter's first window has to fit


class Tracker:
    """Tracks the body of a recording that comes in chunks; the whole recording may be one chunk.

    `push` returns the pose of a chunk where nothing later changes it: of a causal tracker, and where nothing observes
    headings. Other chunks are returned by `smooth`, after the heading correction has seen all of them: the tracker
    keeps their samples and filters them again, so that its memory holds the results of one chunk. A causal tracker
    takes single samples as well, by `segment_estimator.step`.

    All chunks of a recording carry its phases; `start` and `static` are in the first, unless the tracker is causal. The
    smoother takes the whole recording as one chunk; the results of other filters do not depend on the chunks.

    Parameters
    ----------
    subject : lengths and mounts; None: the population prior and the mounts that the session states
    model : a body, its file, or the name of a body of the package, scaled to the subject's lengths; None: the one that
        the recording names, else the upper body. Without a subject a model that is given or named keeps its own lengths
    options : None: the default ones

    Attributes
    ----------
    segment_estimator : takes single samples, of a causal tracker after the start pose; None before it has ended
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        model: BodyModel | str | Path | None = None,
        options: TrackOptions | None = None,
    ) -> None:
        self.options = options or TrackOptions()
        self._subject, self._model = subject, model
        self._fitted: tuple[Subject, BodyModel, StartPose] | None = None  # as used, from the first chunk on
        self._where = ""  # begins an error's text
        self.segment_estimator: SegmentEstimator | None = None
        self._kinematics: KinematicsSolver | None = None
        # Chunks that wait: causally for the end of the start pose, joined; offline for the headings.
        self._chunks: list[Recording] = []
        self._only: SegmentOrientations | None = None  # of the first chunk, while it is the only one

    def push(self, chunk: Recording) -> TrackResult | None:
        """Add the next chunk; return it with its pose; None: `smooth` returns it, or the start pose has not ended.

        It raises `WeposeError` where the recording, the subject or the model lacks something that is needed.
        """
        options, is_first, self._where = self.options, self.segment_estimator is None, f"{chunk.where()}: "
        self._fitted = self._fitted or _fit_body(self._subject, self._model, chunk)
        if chunk.resets and (options.open_loop or not options.causal):
            chunk = replace(chunk, resets=())
        if not is_first and options.method in OFFLINE:
            raise BadOption(f"method '{options.method}' takes the whole recording as one chunk")
        if is_first and options.causal:
            self._chunks = [join_recordings(self._chunks[0], chunk) if self._chunks else chunk]
            parts = split_start_pose(self._chunks[0])
            if parts is None:
                return None
            start, chunk = parts
            self._chunks, self.segment_estimator = [], self._make_estimator(observes_headings=not options.open_loop)
            self.segment_estimator.push(start)
        estimator = self.segment_estimator = self.segment_estimator or self._make_estimator(
            observes_headings=not options.open_loop
        )
        if not len(chunk):
            return None
        segments, headings = estimator.push(chunk), estimator.headings
        if headings is None or options.causal:
            return self._solve_pose(segments, None if headings is None else headings.collect())
        self._chunks.append(chunk)
        self._only = segments if is_first else None
        return None

    def smooth(self) -> Iterator[TrackResult]:
        """Iterate over the chunks that `push` did not return, after the last one has been pushed.

        It raises `BadPhase` where a causal tracker was given no start pose, or nothing after it.
        """
        if self.options.causal and self._kinematics is None:
            if self._chunks and not self._chunks[0].phases.get("start"):
                raise BadPhase(
                    f"{self._where}no start pose of {START_POSE_HOLD_S:g} s without motion; state the seconds of the "
                    f"start pose, [phases] start = [[from, to]]"
                )
            raise BadPhase(f"{self._where}phases.start ends with the recording; nothing is left to track")
        if self.options.causal or self.segment_estimator is None:
            return
        correction, estimator = self.segment_estimator.smooth_headings(), self._make_estimator(observes_headings=False)
        for chunk in self._chunks:
            segments = self._only or estimator.push(chunk)
            yield self._solve_pose(segments if correction is None else correction.correct(segments), correction)

    def _make_estimator(self, *, observes_headings: bool) -> SegmentEstimator:
        assert self._fitted is not None
        person, body, start_pose = self._fitted
        return SegmentEstimator(self._subject, self.options, start_pose, (person, body) if observes_headings else None)

    def _solve_pose(self, segments: SegmentOrientations, correction: HeadingCorrection | None = None) -> TrackResult:
        """Return a chunk with its pose; its headings have been corrected."""
        assert self._fitted is not None
        recording, (person, body, start_pose) = segments.recording, self._fitted
        if self._kinematics is None:
            limits = self.options.limits
            self._kinematics = KinematicsSolver(body, segments.quat_WL, limits=limits, start=start_pose.q)
        tissue = SoftTissueCorrection(body.table, body.tissue_means, tuple(segments.quat_WL))
        pose = self._kinematics.solve_chunk(recording.time, tissue.correct_segments(segments.quat_WL))
        segment_cov, shape_cov = segments.covariance_W, person.shape_covariance(body.table)
        shared = {} if correction is None else correction.correlate_segments(recording.time, segment_cov)
        point_cov = compute_point_covariances(body, pose.quat_WL, segment_cov, shape_cov, pose.q, shared)
        gap = {name: sensor.gap for name, sensor in recording.sensors.items() if sensor.gap is not None}
        pose = replace(pose, segment_cov=segment_cov, point_cov=point_cov, gap=gap)
        return TrackResult(recording.name, pose, body, person, recording.phases, recording.marks, segments, correction)


def track_chunks(
    recording: Recording,
    subject: Subject | None = None,
    *,
    model: BodyModel | str | Path | None = None,
    options: TrackOptions | None = None,
    chunk_s: float = CHUNK_S,
    progress: Callable[[float], None] | None = None,
) -> Iterator[TrackResult]:
    """Iterate over a recording's chunks with their poses: results of a day that are too long for memory.

    The smoother's is one chunk. Parameters and errors are those of `Tracker`. Chunks last `chunk_s` [s], the first one
    as much longer as the phases `start` and `static` need; `progress` is called with the share that is done.
    """
    options = options or TrackOptions()
    tracker = Tracker(subject, model=model, options=options)
    begin, end = float(recording.time[0]), float(recording.time[-1])
    spans = [recording.phases[phase][0] for phase in ("start", "static") if recording.phases.get(phase)]
    first_s = max(last for _, last in spans) - begin + SHORTEST_S if spans else BEGINNING_S
    chunk_s = min(end - begin + 1.0, np.inf if options.method in OFFLINE else max(chunk_s, SHORTEST_S))
    for chunk in recording.chunks(chunk_s, first_s):
        tracked = tracker.push(chunk)
        if progress is not None:
            progress(0.5 * (float(chunk.time[-1]) - begin) / (end - begin))
        if tracked is not None:
            yield tracked
    for tracked in tracker.smooth():
        if progress is not None:
            progress(0.5 + 0.5 * (float(tracked.time[-1]) - begin) / (end - begin))
        yield tracked


def _fit_body(
    subject: Subject | None, model: BodyModel | str | Path | None, recording: Recording
) -> tuple[Subject, BodyModel, StartPose]:
    """Return the person and the body of a recording with their lengths, and its segment frames in the start pose.

    The body is `model`, else the one that the recording names, else the upper body. Without a subject the lengths are
    those of the population prior, or of a chosen model its own.
    """
    where = recording.where()
    chosen = model or recording.model or None
    body = chosen if isinstance(chosen, BodyModel) else load_sensed_model(chosen, recording.sensors, where)
    check_segments(body.table, recording.sensors, f"{where}: sensors.", BadSession)
    start_pose = find_start_pose(body, recording)
    person = subject or population_subject(body=body)
    person.check_body(body.table)
    if subject is None and chosen is not None:  # a chosen model has its person's lengths
        person = replace(person, name=body.robot.name, lengths=body.lengths, note="lengths of the model")
    body = person.shape(body, remounted=recording.remounted)
    return person, body, replace(start_pose, table=correct_table(body.table, body.tissue_means))
