"""The live loop: samples of a source → ticks → poses → outputs and the recording."""

from __future__ import annotations

import gc
import itertools
import math
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..body import BodyModel
from ..body.covariance import compute_axis_std
from ..body.kinematics import KinematicsSolver
from ..body.start_pose import compute_start_configuration
from ..body.table import NEUTRAL_POSE
from ..body.table_file import check_segments
from ..diagnostics import Diagnostic
from ..errors import BadModel, BadSession, WeposeError
from ..filters import BEST
from ..readers.live_log import LONGEST_TEXT, build_recording
from ..recording import Intervals
from ..recording.arrivals import COUNTS, CUT_OFF, DUPLICATE, LATE, Samples, Ticks
from ..tracking import Tracker, TrackOptions
from ..tracking.segments import SegmentEstimator
from ..tracking.start_pose import START_POSE_HOLD_S, StartPoseDetector
from ..writers.live_log import LiveLog
from .monitor import SensorMonitor, check_units
from .setup import SensorSetup, build_subject_model
from .sources.base import Source
from .stage import Stage
from .state import LivePose, Output, Request, SensorStatus, Status, StreamInfo, join_names
from .ticks import TickStream

SWITCH_INTERVAL_S = 5e-4  # [s] after which page and robot hand over the interpreter to the loop; Python has 5 ms
MAX_SILENCE_S = 0.5  # [s] without a sample after which a sensor is lost, before the ticks begin
MAX_LATENCIES = 1000  # newest latencies in the status
MAX_TICK_BLOCKS = 64  # blocks of ticks kept before those older than the start pose are dropped
BEGUN_S = 0.5  # [s] of standing still after which a person who moves is told so
START_POSES = {NEUTRAL_POSE: "Stand upright and still, arms hanging, palms to the thighs"}  # what to tell a person
TAKE = "take_"  # the names of takes begin so


class Latencies:
    """Histogram of latencies in bins of 2 %; its size is constant."""

    MIN_LATENCY_S, BIN_RATIO = 1e-6, 1.02
    BINS = 1024  # up to ten minutes

    def __init__(self) -> None:
        self.count = 0
        self._bins = [0] * self.BINS

    def add(self, latency_s: float) -> None:
        bin_index = int(math.log(max(latency_s, self.MIN_LATENCY_S) / self.MIN_LATENCY_S) / math.log(self.BIN_RATIO))
        self._bins[min(bin_index, len(self._bins) - 1)] += 1
        self.count += 1

    def quantile(self, probability: float) -> float:
        """Return the quantile [s], accurate to 2 %; NaN before the first latency."""
        if not self.count:
            return math.nan
        bin_index = int(np.searchsorted(np.cumsum(self._bins), probability * self.count))
        return self.MIN_LATENCY_S * self.BIN_RATIO ** (min(bin_index, len(self._bins) - 1) + 0.5)


class SessionSummary(NamedTuple):
    """Outcome of a session."""

    poses: int
    seconds: float  # [s] from the first pose to the last, on the source's clock
    counts: Mapping[str, Mapping[str, int]]  # segment → each of `arrivals.COUNTS`, and "lost" samples
    latency: Latencies  # of every tick with a sample: [s] from its time to its pose
    diagnostics: tuple[Diagnostic, ...]
    problem: str  # of the recording; empty where it is complete
    record: Path | None  # the recording


EMPTY_SESSION = SessionSummary(0, 0.0, {}, Latencies(), (), "", None)  # ended before a sample came


class StartPoseSearch:
    """Finds the start pose in the ticks before tracking: stated by the session, or held for `START_POSE_HOLD_S`.

    Attributes
    ----------
    ticks : since before the start pose
    """

    def __init__(self, stream: TickStream, stated: tuple[float, float] | None = None) -> None:
        self._stream, self.stated = stream, stated
        self.detector = StartPoseDetector(stream.clock.rate_hz, stream.measured)
        self.ticks: list[Ticks] = []

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """Add ticks; return the start pose's first and last tick and the row in `ticks` after it; None: not yet."""
        self.ticks.append(ticks)
        clock, detector = self._stream.clock, self.detector
        for n in range(len(ticks.time)):
            if self.stated is not None:
                if ticks.time[n] >= self.stated[1] - 0.5 / clock.rate_hz:
                    begin = max(0, round((self.stated[0] - clock.begin) * clock.rate_hz))
                    return begin, ticks.first + n, n + 1
            elif detector.push(ticks.gyro_S[n], ticks.accel_S[n]) == "ready":
                return detector.begin, detector.end, n + 1
        if self.stated is None and len(self.ticks) > MAX_TICK_BLOCKS:
            self.ticks = [t for t in self.ticks if t.first + len(t.time) > detector.begin]
        return None

    @property
    def progress(self) -> float:
        """Progress of the start pose, 0 to 1."""
        if self.stated is None:
            return min(1.0, self.detector.held_s / START_POSE_HOLD_S)
        passed_s = self._stream.clock.newest - self.stated[0]
        return float(np.clip(passed_s / (self.stated[1] - self.stated[0]), 0.0, 1.0))


class PhaseEdges:
    """Where stated phases begin and end, in order of time; a phase holds from its first second to its last, both in."""

    def __init__(self, phases: Mapping[str, Intervals]) -> None:
        edges = [(a - 1e-9, name, True) for name, spans in phases.items() for a, _ in spans]
        edges += [(b + 1e-9, name, False) for name, spans in phases.items() for _, b in spans]
        self._edges = deque(sorted(edges))

    def take_due(self, time_s: float) -> Iterator[tuple[str, bool]]:
        """Iterate over the phases that begin (True) or have ended by this time [s], each once."""
        while self._edges and self._edges[0][0] <= time_s:
            _, name, begins = self._edges.popleft()
            yield name, begins


class LiveLoop(Stage):
    """One session, from the source's first sample to its end.

    Parameters
    ----------
    source : an open source; `run` closes it
    model : a body; None: that of the setup, with the subject's lengths
    log : the recording; `run` closes it
    open_log : opens a recording when the person begins a take and there is none; None: there is none then
    begin : time [s] of the first tick; None: when every sensor has sent a sample

    Raises
    ------
    WeposeError
        A method that cannot run live; mounts that are not known.
    """

    def __init__(
        self,
        source: Source,
        setup: SensorSetup,
        *,
        method: str = BEST,
        model: BodyModel | str | Path | None = None,
        log: LiveLog | None = None,
        open_log: Callable[[], LiveLog] | None = None,
        outputs: Sequence[Output] = (),
        begin: float | None = None,
    ) -> None:
        super().__init__(source, outputs)
        self.method, self.log, self._open_log, self.setup = method, log, open_log, setup.as_recorded()
        self.model = build_subject_model(setup, model, source.sensors)
        check_segments(self.model.table, source.sensors, f"{setup.name}: sensors.", BadSession)
        with suppress(BadModel):  # measured before samples come; the parts of the way to a point
            _ = self.model.reaches
        start = compute_start_configuration(self.model, setup.start_pose, setup.joints, setup.name)
        self.kinematics = KinematicsSolver(self.model, source.sensors, start=start)
        self._instruction = START_POSES.get(setup.start_pose, f"Hold still in the start pose, {setup.start_pose}")
        if self.model.table.is_mechanism:
            self._instruction = f"{self.model.table.name} must stand still in its start configuration"
        self._monitor = SensorMonitor()
        self._stream = TickStream(source.sensors, source.rate_hz, begin, log, source.orientations)
        self._search: StartPoseSearch | None = None  # from when the ticks begin
        self._stood_s = 0.0  # [s] longest time that the person stood still before tracking
        self._estimator: SegmentEstimator | None = None  # from when the start pose is found
        self._phase_edges = PhaseEdges(self.setup.phases)
        self._heading_reset_time = 0.0
        self._std, self._heading_std = (np.full(len(source.sensors), np.nan) for _ in range(2))
        self._covariance: Iterator[np.ndarray | None] = iter(())  # computed in parts, one or more with each tick
        self._covariance_ticks, self._covariance_parts = 1, 1  # from one to the next, and parts with a tick
        self._latency = Latencies()
        self._recent_latencies: deque[float] = deque(maxlen=MAX_LATENCIES)  # [s] of displayed poses
        self._poses, self._first_pose, self._last_pose = 0, 0.0, 0.0
        self._events: list[tuple[str, dict[str, Any]]] = []  # that decide poses
        self._open_phases: list[str] = []
        self._takes = 0
        self._end_message = ""  # empty: it goes on
        self._diagnostics: tuple[Diagnostic, ...] = ()

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> SessionSummary:
        """Run until the source ends, the user quits, or `should_stop` returns True.

        Without a start pose there is nothing to track, and no recording remains.

        Raises
        ------
        BadData
            The start pose shows that a sensor sends another unit.
        """
        switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()
        try:
            self.loop(should_stop)
            self._end_message = "The session has ended."
            self.send_status()
        except WeposeError as error:
            self._end_message = f"The session has ended: {error}"
            self.send_status()
            raise
        finally:
            gc.unfreeze()
            sys.setswitchinterval(switch_interval)
            self.source.close()
            if self.log is not None:
                self.log.close()
                if not self._poses:
                    self.log.path.unlink(missing_ok=True)  # nothing in it can be tracked
                    self.log = None
            for output in self.outputs:
                output.close()
        return self._summarize()

    # Samples to poses ------------------------------------------------------------------------------------------------

    def process(self, samples: list[Samples]) -> None:
        """Record the samples of one read, track the ticks that they complete, and show the last pose."""
        pose = None
        self._monitor.push(samples, self.source.sensors if self._estimator else self.source.orientations)
        for ticks in self._stream.push(samples):
            pose = self._track(ticks) or pose
        self._begin_search()
        if pose is not None:
            for output in self.outputs:
                output.show(pose)
        if self.log is not None:
            self.log.flush_if_due()

    def _begin_search(self) -> StartPoseSearch | None:
        """The search of the start pose, which begins with the ticks; None before them."""
        if self._search is None and self._stream.synchronizer is not None:
            self._search = StartPoseSearch(self._stream, next(iter(self.setup.phases.get("start", ())), None))
            self._covariance_ticks = max(1, round(self.STATUS_PERIOD_S * self._stream.clock.rate_hz))
            self._covariance_parts = math.ceil((len(self.source.sensors) + 2) / self._covariance_ticks)
        return self._search

    def _track(self, ticks: Ticks) -> LivePose | None:
        """Track these ticks, log every pose, and return the last one; None before tracking starts."""
        search, estimator, row, quat_WL = self._begin_search(), self._estimator, 0, None
        if search is None or not len(ticks.time):
            return None
        if estimator is None:
            start = search.push(ticks)
            if start is None:
                return None
            begin, end, row = start
            estimator = self._estimator = self._start_tracking(search, begin, end)
        for n in range(row, len(ticks.time)):
            for phase, begins in self._phase_edges.take_due(ticks.time[n]):
                estimator.mark_phase(phase, begins=begins)
            quat_WL = estimator.step(ticks.gyro_S[n], ticks.accel_S[n])
            self._update_std(estimator, ticks.first + n)
            if self.log is not None:
                self.log.pose(ticks.first + n, quat_WL)
        if quat_WL is None:
            return None
        points = self.kinematics.compute_points(quat_WL)
        now, self._last_pose = self.source.clock(), float(ticks.time[-1])
        self._poses += len(ticks.time) - row
        for tick in ticks.time[row:][~ticks.lost[row:].all(axis=1)].tolist():  # a tick of silent sensors is not late
            self._latency.add(now - tick)
        latency = now - self._last_pose
        self._recent_latencies.append(latency)
        quat_WL = self.kinematics.orient_segments(quat_WL).copy()
        return LivePose(self._last_pose, quat_WL, points, self._std, ticks.lost[-1].copy(), latency)

    def _update_std(self, estimator: SegmentEstimator, tick: int) -> None:
        """Compute some of the covariances; by ticks, so that a recording reproduces the values."""
        if tick % self._covariance_ticks == 0:
            self._covariance = estimator.covariance_gradually()
        for covariance in itertools.islice(self._covariance, self._covariance_parts):
            if covariance is not None:
                self._std, self._heading_std = compute_axis_std(covariance), np.sqrt(covariance[:, 2, 2])

    def _start_tracking(self, search: StartPoseSearch, begin: int, end: int) -> SegmentEstimator:
        """Align by the start pose, ticks `begin` to `end`, and return the estimator for the ticks after it."""
        rate_hz = self._stream.clock.rate_hz
        header = self.setup.header(self.source.sensors, self.source.orientations)
        recording = build_recording(header, rate_hz, search.ticks, (begin, end), last=end)
        diagnostics = check_units(recording, self.source)
        tracker = Tracker(self.setup.subject, model=self.model, options=TrackOptions(self.method, causal=True))
        tracker.push(recording)
        estimator = tracker.segment_estimator
        for phase in self._open_phases:
            estimator.mark_phase(phase, begins=True)
        search.ticks = []
        self._diagnostics = (*estimator.diagnostics, *diagnostics)
        self._first_pose = self._heading_reset_time = float(recording.time[-1])
        self._record_event("start", begin=begin, end=end)
        info = StreamInfo(tuple(self.source.sensors), self.kinematics.points, rate_hz)
        for output in self.outputs:
            output.start(info)
        return estimator

    # Requests --------------------------------------------------------------------------------------------------------

    def ask(self, request: Request) -> None:
        """Reset the headings, or mark a take, a phase or a text in the recording."""
        kind, name = request.kind, request.name[:LONGEST_TEXT]
        if kind == "reset":
            if self._estimator is not None:
                self._estimator.reset_headings()
                self._heading_reset_time = self._stream.clock.newest
                self._record_event("reset", tick=self._stream.clock.next_tick)
            for output in self.outputs:
                output.resume()
            return
        if kind in ("take", "begin") and self.log is None:
            self._begin_recording()
        if self.log is None or self._stream.synchronizer is None or not self._stream.clock.next_tick:
            return
        clock = self._stream.clock
        time_s = clock.begin + (clock.next_tick - 1) / clock.rate_hz
        if kind == "take":
            takes = [phase for phase in self._open_phases if phase.startswith(TAKE)]
            self._takes += not takes
            kind, name = ("end", takes[0]) if takes else ("begin", f"{TAKE}{self._takes}")
        if kind == "mark" and name:
            self.log.event("mark", text=name, time=time_s)
        elif kind == "begin" and name and name not in self._open_phases:
            # It holds from the next tick on: the ticks before have been tracked without it.
            self._open_phases.append(name)
            self.log.event("begin", phase=name, time=time_s + 1.0 / clock.rate_hz)
        elif kind == "end" and name in self._open_phases:
            self._open_phases.remove(name)
            self.log.event("end", phase=name, time=time_s)
        else:
            return
        if kind != "mark" and self._estimator is not None:
            self._estimator.mark_phase(name, begins=kind == "begin")

    def _record_event(self, kind: str, **values: Any) -> None:
        """Record an event that decides poses, now or once a recording begins."""
        self._events.append((kind, values))
        if self.log is not None:
            self.log.event(kind, **values)

    def _begin_recording(self) -> None:
        """Begin to record where nothing was recorded so far; the file holds what came before as well."""
        if self._open_log is None or self._stream.history is None or self._estimator is None:
            return
        self.log = self._open_log()
        self._stream.record(self.log)
        for kind, values in self._events:
            self.log.event(kind, **values)

    # The state -------------------------------------------------------------------------------------------------------

    def build_status(self) -> Status:
        """The state of the session and of each sensor now."""
        sensors, estimator, synchronizer = self.source.sensors, self._estimator, self._stream.synchronizer
        now, k = self.source.clock(), len(sensors)
        counts, frozen = np.zeros((k, len(COUNTS)), dtype=np.int64), np.zeros(k, dtype=bool)
        lost = np.isin(sensors, self._monitor.list_silent(sensors, now, MAX_SILENCE_S))
        recorded_s = 0.0
        if synchronizer is not None:
            counts, frozen = synchronizer.counts.copy(), synchronizer.frozen.copy()
            lost |= synchronizer.lost | frozen
            recorded_s = 0.0 if self.log is None else max(0.0, synchronizer.newest - synchronizer.begin)
        static, bias, heading_age = np.zeros(k, dtype=bool), np.zeros((k, 3)), 0.0
        if estimator is not None:
            static, bias = estimator.static, estimator.gyro_bias
            heading_age = max(0.0, now - self._heading_reset_time)
        rates, battery = self._monitor.measure_rates(now), self.source.batteries
        statuses = [
            SensorStatus(
                name,
                rates.get(name, 0.0),
                bool(lost[i]),
                bool(static[i]),
                (float(bias[i, 0]), float(bias[i, 1]), float(bias[i, 2])),
                float(self._heading_std[i]),
                heading_age,
                self._monitor.count_missing(name, now),
                int(counts[i, LATE]),
                int(counts[i, DUPLICATE]),
                bool(frozen[i]),
                battery.get(name, math.nan),
            )
            for i, name in enumerate(sensors)
        ]
        p50, p99 = np.quantile(1e3 * np.array(self._recent_latencies or [0.0]), (0.5, 0.99))
        state, message, progress = self._describe_state(lost, frozen)
        return Status(
            state, message, progress, now, tuple(statuses), (float(p50), float(p99)), recorded_s,
            self._count_problems(counts), tuple(self._open_phases),
        )  # fmt: skip

    def _count_problems(self, counts: np.ndarray) -> dict[str, int]:
        """Count problems that are not in a sensor's status: problem → count."""
        problems = dict(self.source.problems)
        for name, count in zip(self.source.sensors, counts[:, CUT_OFF].tolist(), strict=True):
            if count:
                problems[f"rates of {join_names([name])} beyond the range of its gyroscope"] = count
        if self.log is not None and self.log.problem:
            problems[self.log.problem] = 1
        return problems

    def _describe_state(self, lost: np.ndarray, frozen: np.ndarray) -> tuple[str, str, float]:
        """Return the state, the message to the person, and the progress of the start pose."""
        if self._end_message:
            return "ended", self._end_message, 1.0
        if self._estimator is not None:
            sentences = self._describe_lost(lost, frozen) or "Tracking.", *(each.describe() for each in self.outputs)
            return "ready", " ".join(filter(None, sentences)), 1.0
        if self._search is None:
            missing_sensors = [name for name in self.source.sensors if name not in self._monitor.sending]
            if not missing_sensors:
                return "waiting", "Measuring the sampling rate.", 0.0
            awaited = self.source.describe_awaited(missing_sensors)
            where = f" Waiting for {awaited}." if awaited else ""
            return "waiting", f"Nothing has come yet from {join_names(missing_sensors)}.{where}", 0.0
        search, detector, instruction = self._search, self._search.detector, self._instruction
        if search.stated is not None:
            return "start_pose", f"{instruction}, until {search.stated[1]:g} s.", search.progress
        if detector.state == "waiting":
            missing = np.isin(np.arange(len(lost)), detector.missing)
            text = self._describe_lost(missing & frozen, frozen) or f"Waiting for {self._join_sensors(missing)}."
            return "waiting", text, 0.0
        if wrong_unit := self._monitor.describe_wrong_unit(self.source):
            return "moved", wrong_unit, search.progress
        self._stood_s = max(self._stood_s, detector.held_s)
        if detector.state != "moved":
            left_s = max(0.0, START_POSE_HOLD_S - detector.held_s)
            return "start_pose", f"{instruction}: {left_s:.0f} s more.", search.progress
        if self._stood_s < BEGUN_S:  # the person walks to the place, or takes the pose
            return "start_pose", f"{instruction}.", 0.0
        moved = join_names([self.source.sensors[i] for i in detector.moving])
        again = instruction[0].lower() + instruction[1:]
        return "moved", f"You moved ({moved}). Once more: {again}.", search.progress

    def _describe_lost(self, lost: np.ndarray, frozen: np.ndarray) -> str:
        """Return the message on lost sensors (k,) bool; some of them are frozen. Empty: none is lost."""
        parts = []
        if (lost & ~frozen).any():
            parts.append(f"No samples from {self._join_sensors(lost & ~frozen)}.")
        if (lost & frozen).any():
            parts.append(f"Repeated values from {self._join_sensors(lost & frozen)}: switch it off and on.")
        return " ".join(parts)

    def _join_sensors(self, mask: np.ndarray) -> str:
        return join_names([name for name, chosen in zip(self.source.sensors, mask, strict=True) if chosen])

    def _summarize(self) -> SessionSummary:
        sensors, synchronizer = self.source.sensors, self._stream.synchronizer
        counts = np.zeros((len(sensors), len(COUNTS)), int) if synchronizer is None else synchronizer.counts
        return SessionSummary(
            self._poses,
            self._last_pose - self._first_pose if self._poses else 0.0,
            {
                name: dict(zip(COUNTS, row, strict=True)) | {"lost": self._monitor.count_missing(name, -math.inf)}
                for name, row in zip(sensors, counts.tolist(), strict=True)
            },
            self._latency,
            self._diagnostics,
            "" if self.log is None else self.log.problem,
            None if self.log is None else self.log.path,
        )
