"""`Tracker`: recording and subject → pose, chunk by chunk: filter, align, correct headings, kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..alignment import SegmentOrientations
from ..errors import BadOption, BadPhase
from ..filters import OFFLINE
from ..filters.noise import BEGINNING_S
from ..kinematics import KinematicsSolver, compute_point_covariances
from ..model import BodyModel
from ..recording import Recording
from ..subject import Subject
from .causal import CausalEstimator, CausalSegmentEstimator
from .heading_problem import HeadingProblem
from .headings import HeadingCorrector, make_heading_problem
from .options import TrackOptions
from .segments import Oriented, SegmentEstimator
from .tracked import TrackedBody, TrackedRecording, make_body

CHUNK_S = 600.0  # of `track_chunks`
SHORTEST_S = 2.0  # of a chunk: a filter's first window has to fit


class Tracker:
    """Tracks the body of a recording that comes in chunks; the whole recording may be one chunk.

    `push` returns the pose of a chunk where nothing later changes it: of a causal tracker, and where nothing observes
    headings. Other chunks are returned by `finish`, after the heading correction has seen all of them: the tracker
    keeps their samples and filters them again, so that its memory holds the results of one chunk. A causal tracker
    takes single samples as well, by `segment_estimator.step`.

    All chunks of a recording carry its phases; `start` and `static` are in the first. The smoother takes the whole
    recording as one chunk; the results of other filters do not depend on the chunks.

    Parameters
    ----------
    subject : lengths and mounts; None: the population prior and the mounts that the session states
    model : a body, its file, or the name of a body of the package, scaled to the subject's lengths; None: the one that
        the recording names, else the upper body. Without a subject a model that is given or named keeps its own lengths
    options : None: the default ones
    with_point_cov : compute the covariances of the points; a page that shows none does without
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        model: BodyModel | str | Path | None = None,
        options: TrackOptions | None = None,
        with_point_cov: bool = True,
    ) -> None:
        self.options = options or TrackOptions()
        self._with_point_cov = with_point_cov
        self._subject, self._model = subject, model
        self._headings: HeadingCorrector | None = None
        self._estimator: SegmentEstimator | CausalEstimator | None = None  # made at the first chunk
        self._body: TrackedBody | None = None
        self._kinematics: KinematicsSolver | None = None
        self._waiting: list[Recording] = []  # until the headings are solved
        self._first: Oriented | None = None  # of the first chunk, while it is the only one

    @property
    def segment_estimator(self) -> CausalSegmentEstimator:
        """The estimator of segment orientations for single samples, of a causal tracker after the start pose.

        Raises
        ------
        BadOption, BadPhase
            The tracker is not causal; the start pose has not ended.
        """
        if not self.options.causal:
            raise BadOption("a tracker takes single samples where its options are causal")
        if not isinstance(self._estimator, CausalEstimator):
            raise BadPhase("the start pose has not ended: push a recording that includes it")
        return self._estimator.segment_estimator

    def push(self, chunk: Recording) -> TrackedRecording | None:
        """Add the next chunk; return it with its pose, or None where `finish` returns it.

        Raises
        ------
        WeposeError
            The recording, the subject or the model lacks something that is needed; a sensor is on no segment.
        """
        is_first = self._body is None
        if self._body is None or self._estimator is None:
            self._body = make_body(self._subject, self._model, chunk)
            self._estimator = _make_estimator(self._subject, self._body, self.options)
        elif self.options.method in OFFLINE:
            raise BadOption(f"method '{self.options.method}' takes the whole recording as one chunk")
        if self.options.open_loop and chunk.resets:
            chunk = replace(chunk, resets=())
        oriented = self._estimator.push(chunk)
        if oriented is None:
            return None
        if is_first:
            self._headings = _make_heading_corrector(oriented, self._body, self.options)
        if self._headings is None:
            return self._solve_pose(oriented, self._body)
        self._headings.add_observations(*oriented)
        self._waiting.append(chunk)
        self._first = oriented if is_first else None
        return None

    def finish(self) -> Iterator[TrackedRecording]:
        """Iterate over the chunks that `push` did not return, after the last one has been pushed.

        Raises
        ------
        WeposeError
            A causal tracker was given no start pose, or nothing after it.
        """
        if isinstance(self._estimator, CausalEstimator):
            self._estimator.finish()
        if self._headings is None or self._body is None:
            return
        if not self._headings.solve():
            self._headings = None
        if self._first is not None:
            yield self._solve_pose(self._first, self._body)
            return
        self._estimator = _make_estimator(self._subject, self._body, self.options)
        for chunk in self._waiting:
            oriented = self._estimator.push(chunk)
            if oriented is not None:
                yield self._solve_pose(oriented, self._body)

    def _solve_pose(self, oriented: Oriented, tracked_body: TrackedBody) -> TrackedRecording:
        """Return a chunk with its pose, after its headings have been corrected."""
        recording, segments = oriented
        person, body = tracked_body.subject, tracked_body.model
        if self._headings is not None:
            segments = self._headings.correct(recording, segments)
        if self._kinematics is None:
            self._kinematics = KinematicsSolver(
                body, segments.quat_WL, limits=self.options.limits, start=tracked_body.start
            )
        pose = self._kinematics.solve_chunk(recording.time, segments.quat_WL)
        headings = self._estimator.headings if isinstance(self._estimator, CausalEstimator) else self._headings
        correction = None if headings is None else headings.summarize()
        point_cov: dict[str, np.ndarray] = {}
        if self._with_point_cov:
            segment_cov, shape_cov = segments.covariance_W, person.shape_covariance(body.table)
            shared = {} if correction is None else correction.correlate_segments(recording.time, segment_cov)
            point_cov = compute_point_covariances(body, pose.quat_WL, segment_cov, shape_cov, pose.q, shared)
        pose = replace(
            pose,
            segment_cov=segments.covariance_W,
            point_cov=point_cov,
            gap={name: sensor.gap for name, sensor in recording.sensors.items() if sensor.gap is not None},
        )
        return TrackedRecording(recording.name, pose, body, person, recording, segments, self.options, correction)


def track_chunks(
    recording: Recording,
    subject: Subject | None = None,
    *,
    model: BodyModel | str | Path | None = None,
    options: TrackOptions | None = None,
    chunk_s: float = CHUNK_S,
    progress: Callable[[float], None] | None = None,
) -> Iterator[TrackedRecording]:
    """Iterate over a recording's chunks with their poses: results of a day that are too long for memory.

    The smoother's is one chunk. Parameters as of `Tracker`.

    Parameters
    ----------
    chunk_s : [s] of the chunks; the first one is as much longer as the phases `start` and `static` need
    progress : is called with the share that is done, chunk by chunk

    Raises
    ------
    WeposeError
        As `Tracker`.
    """
    options = options or TrackOptions()
    tracker = Tracker(subject, model=model, options=options)
    begin, end = float(recording.time[0]), float(recording.time[-1])
    spans = [recording.phases[phase][0] for phase in ("start", "static") if recording.phases.get(phase)]
    first_s = max(last for _, last in spans) - begin + SHORTEST_S if spans else BEGINNING_S
    chunk_s = min(end - begin + 1.0, np.inf if options.method in OFFLINE else max(chunk_s, SHORTEST_S))

    def report(tracked: TrackedRecording | Recording, part: int) -> None:
        if progress is not None:
            progress((part + (float(tracked.time[-1]) - begin) / (end - begin)) / 2.0)

    for chunk in recording.chunks(chunk_s, first_s):
        tracked = tracker.push(chunk)
        report(chunk, 0)
        if tracked is not None:
            yield tracked
    for tracked in tracker.finish():
        report(tracked, 1)
        yield tracked


def _make_heading_corrector(oriented: Oriented, body: TrackedBody, options: TrackOptions) -> HeadingCorrector | None:
    """Return a heading corrector for a recording whose first chunk this is; None: nothing observes its headings."""
    recording, segments = oriented
    if options.causal or options.open_loop or any(sensor.aligned for sensor in recording.sensors.values()):
        return None
    problem = make_heading_problem(recording, segments, body.subject, body.model, causal=False)
    return None if problem is None else HeadingCorrector(recording, segments, problem)


def _make_estimator(
    subject: Subject | None, body: TrackedBody, options: TrackOptions
) -> SegmentEstimator | CausalEstimator:
    """Return the estimator of segment orientations of a recording."""

    def make_problem(recording: Recording, segments: SegmentOrientations) -> HeadingProblem | None:
        if any(sensor.aligned for sensor in recording.sensors.values()):
            return None
        return make_heading_problem(recording, segments, body.subject, body.model, causal=True)

    start_frames, method, static_test = body.start_frames, options.method, options.static_test
    if not options.causal:
        return SegmentEstimator(subject, start_frames=start_frames, method=method, static_test=static_test)
    return CausalEstimator(
        subject,
        start_frames=start_frames,
        method=method,
        static_test=static_test,
        make_problem=None if options.open_loop else make_problem,
    )
