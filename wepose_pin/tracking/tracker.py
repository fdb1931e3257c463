"""`Tracker`: recording and subject → pose, chunk by chunk: filter, align, correct headings, kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..alignment import SegmentOrientations
from ..errors import BadOption, BadPhase
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

Chunks = Callable[[], Iterable[Recording]]


class Tracker:
    """Tracks the body of a recording that comes in chunks; the whole recording may be one chunk.

    `push` returns the chunks that are complete, `finish` the rest: the smoother needs the next chunk, and the heading
    correction the whole recording. To save memory, pass over the chunks with `observe_headings` first and give its
    result as `headings`. A causal tracker takes single samples as well, by `segment_estimator.step`.

    All chunks of a recording carry its phases; `start` and `static` are in the first. The result of a causal filter
    does not depend on the chunks.

    Parameters
    ----------
    subject : lengths and mounts; None: the population prior and the mounts that the session states
    model : a body, its file, or the name of a body of the package, scaled to the subject's lengths; None: the one that
        the recording names, else the upper body. Without a subject a model that is given or named keeps its own lengths
    options : None: the default ones
    headings : what `observe_headings` returned; None with `observed`: nothing observes the headings
    observed : `observe_headings` has passed over all chunks. False: the tracker observes headings itself, and where
        there is something to observe, all chunks are returned by `finish`
    with_point_cov : compute the covariances of the points; a page that shows none does without
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        model: BodyModel | str | Path | None = None,
        options: TrackOptions | None = None,
        headings: HeadingCorrector | None = None,
        observed: bool = False,
        with_point_cov: bool = True,
    ) -> None:
        self.options = options or TrackOptions()
        self._with_point_cov = with_point_cov
        self._subject, self._model = subject, model
        self._headings, self._solved = headings, observed
        self._estimator: SegmentEstimator | CausalEstimator | None = None  # made at the first chunk
        self._body: TrackedBody | None = None
        self._kinematics: KinematicsSolver | None = None
        self._waiting: list[Oriented] = []  # until the headings are solved

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

    def push(self, chunk: Recording) -> list[TrackedRecording]:
        """Add the next chunk; return those that are complete.

        Raises
        ------
        WeposeError
            The recording, the subject or the model lacks something that is needed; a sensor is on no segment.
        """
        if self._estimator is None or self._body is None:
            self._body = make_body(self._subject, self._model, chunk)
            self._estimator = _make_estimator(self._subject, self._body, self.options)
        if self.options.open_loop and chunk.resets:
            chunk = replace(chunk, resets=())
        return [tracked for oriented in self._estimator.push(chunk) for tracked in self._process(oriented, self._body)]

    def finish(self) -> list[TrackedRecording]:
        """Return the remaining chunks, after the last one has been pushed."""
        if self._estimator is None or self._body is None:
            return []
        done = [tracked for oriented in self._estimator.finish() for tracked in self._process(oriented, self._body)]
        if self._headings is not None and not self._solved:
            self._solved = True
            if not self._headings.solve():
                self._headings = None
            waiting, self._waiting = self._waiting, []
            done += [self._solve_pose(oriented, self._body) for oriented in waiting]
        return done

    def _process(self, oriented: Oriented, body: TrackedBody) -> list[TrackedRecording]:
        """Return a chunk with its pose, or nothing while the headings are observed."""
        if self._headings is None and not self._solved:
            self._headings = make_heading_corrector(oriented, body.subject, body.model, self.options)
            self._solved = self._headings is None
        if self._headings is not None and not self._solved:
            self._headings.add_observations(*oriented)
            self._waiting.append(oriented)
            return []
        return [self._solve_pose(oriented, body)]

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


def observe_headings(
    chunks: Iterable[Recording],
    subject: Subject | None = None,
    options: TrackOptions | None = None,
    model: BodyModel | str | Path | None = None,
) -> HeadingCorrector | None:
    """Pass over the chunks of a recording and return its heading corrector; None: nothing observes headings.

    Parameters as of `Tracker`.

    Raises
    ------
    WeposeError
        As `Tracker.push`.
    """
    options = options or TrackOptions()
    headings: HeadingCorrector | None = None
    for oriented, body in _estimate(chunks, subject, model, options):
        headings = headings or make_heading_corrector(oriented, body.subject, body.model, options)
        if headings is None:
            return None
        headings.add_observations(*oriented)
    return headings if headings is not None and headings.solve() else None


def _estimate(
    chunks: Iterable[Recording], subject: Subject | None, model: BodyModel | str | Path | None, options: TrackOptions
) -> Iterator[tuple[Oriented, TrackedBody]]:
    """Iterate over all chunks with their segment orientations, each with the body."""
    body: TrackedBody | None = None
    estimator: SegmentEstimator | CausalEstimator | None = None
    for chunk in chunks:
        if body is None or estimator is None:
            body = make_body(subject, model, chunk)
            estimator = _make_estimator(subject, body, options)
        for oriented in estimator.push(chunk):
            yield oriented, body
    if body is not None and estimator is not None:
        for oriented in estimator.finish():
            yield oriented, body


def make_heading_corrector(
    oriented: Oriented, subject: Subject, body: BodyModel, options: TrackOptions
) -> HeadingCorrector | None:
    """Return a heading corrector for a recording whose first chunk this is; None: nothing observes its headings."""
    recording, segments = oriented
    if options.causal or options.open_loop or any(sensor.aligned for sensor in recording.sensors.values()):
        return None
    problem = make_heading_problem(recording, segments, subject, body, causal=False)
    return None if problem is None else HeadingCorrector(recording, segments, problem)


def track_chunks(
    chunks: Chunks,
    subject: Subject | None = None,
    *,
    model: BodyModel | str | Path | None = None,
    options: TrackOptions | None = None,
    progress: Callable[[str, Recording], None] | None = None,
) -> Iterator[TrackedRecording]:
    """Iterate over the tracked chunks of a recording that is too long for memory.

    `chunks()` iterates over the recording's chunks; it is called twice where headings are corrected. `progress` is
    called with the name of the task and each chunk that it has finished.

    Raises
    ------
    WeposeError
        As `Tracker.push`, at the chunk that it comes from.
    """
    options = options or TrackOptions()

    def report(task: str) -> Iterator[Recording]:
        for chunk in chunks():
            yield chunk
            if progress is not None:
                progress(task, chunk)

    observed = not options.open_loop and not options.causal
    headings = observe_headings(report("observing headings"), subject, options, model) if observed else None
    tracker = Tracker(subject, model=model, options=options, headings=headings, observed=observed)
    for chunk in report(f"tracking by {options.method}"):
        yield from tracker.push(chunk)
    yield from tracker.finish()


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
