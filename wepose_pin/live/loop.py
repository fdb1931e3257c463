"""The live loop: samples of a source → ticks → poses → outputs and the recording."""

from __future__ import annotations

import gc
import itertools
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import Diagnostic
from ..errors import BadModel, BadSession, WeposeError
from ..filters import BEST
from ..kinematics import LiveKinematics, compute_axis_std
from ..model import BodyModel, load_model, load_table
from ..model.body import load_sensed_model
from ..model.start_pose import compute_start_configuration
from ..model.table import NEUTRAL_POSE
from ..readers.live_log import LONGEST_TEXT, build_recording
from ..recording import ImuSensor, Intervals, Recording
from ..recording.arrivals import (
    COUNTS,
    CUT_OFF,
    DUPLICATE,
    LATE,
    TAKEN,
    WAIT_S,
    Samples,
    StreamSynchronizer,
    Ticks,
    order_arrivals,
)
from ..recording.plausibility import check_signals, find_unseen_rate
from ..subject import population_subject
from ..tracking import Tracker, TrackOptions
from ..tracking.headings import CAUSAL_KNOT_S
from ..tracking.segments import SegmentEstimator
from ..tracking.start_pose import START_POSE_HOLD_S, StartPoseDetector, TickRates
from ..writers.live_log import LiveLog
from .losses import SampleLosses
from .setup import SensorSetup
from .sources.base import Source
from .state import LivePose, Output, SensorStatus, Status, StreamInfo, join_names
from .ticks import TickStream
from .units import RateWatch, check_units

STATUS_PERIOD_S = 0.2  # [s]
SWITCH_INTERVAL_S = 5e-4  # [s] after which page and robot hand over the interpreter to the loop; Python has 5 ms
READ_TIMEOUT_S = 0.05  # [s]; keys and the status wait for a read
MAX_SILENCE_S = 0.5  # [s] without a sample after which a sensor is lost, before the ticks begin
MAX_LATENCIES = 1000  # newest latencies in the status
MAX_TICK_BLOCKS = 64  # blocks of ticks kept before those older than the start pose are dropped
BEGUN_S = 0.5  # [s] of standing still after which who moves is told so
START_POSES = {NEUTRAL_POSE: "Stand upright and still, arms hanging, palms to the thighs"}  # what to tell a person


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
    """Finds the start pose in the ticks before tracking: stated by the session, or held for `START_POSE_HOLD_S`."""

    def __init__(
        self,
        synchronizer: StreamSynchronizer,
        orientations: Collection[str] = (),
        stated: tuple[float, float] | None = None,
    ) -> None:
        self.synchronizer, self.stated = synchronizer, stated
        self.detector = StartPoseDetector(synchronizer.rate_hz, len(synchronizer.sensors))
        measured = np.array([name in orientations for name in synchronizer.sensors], dtype=np.bool_)
        self._rates = TickRates(measured, synchronizer.rate_hz)
        self.ticks: list[Ticks] = []

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """Add ticks; return the start pose's first and last tick and the row in `ticks` after it; None: not yet."""
        self.ticks.append(ticks)
        for n in range(len(ticks.time)):
            if self.stated is not None:
                rate_hz = self.synchronizer.rate_hz
                if ticks.time[n] >= self.stated[1] - 0.5 / rate_hz:
                    begin = max(0, round((self.stated[0] - self.synchronizer.begin) * rate_hz))
                    return begin, ticks.first + n, n + 1
            elif self.detector.push(self._rates.push(ticks.gyro_S[n], ticks.accel_S[n])) == "ready":
                return self.detector.begin, self.detector.end, n + 1
        if self.stated is None and len(self.ticks) > MAX_TICK_BLOCKS:
            self.ticks = [t for t in self.ticks if t.first + len(t.time) > self.detector.begin]
        return None

    @property
    def progress(self) -> float:
        """Progress of the start pose, 0 to 1."""
        if self.stated is None:
            return min(1.0, self.detector.held_s / START_POSE_HOLD_S)
        return float(np.clip((self.synchronizer.newest - self.stated[0]) / (self.stated[1] - self.stated[0]), 0.0, 1.0))


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


class LiveLoop:
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
        wait_s: float = WAIT_S,
    ) -> None:
        self.source, self.method, self.log, self.outputs = source, method, log, tuple(outputs)
        self._open_log = open_log
        self.setup = setup.as_recorded()
        self.model = build_subject_model(setup, model, source.sensors)
        self.model.table.check_segments(source.sensors, f"{setup.name}: sensors.", BadSession)
        with suppress(BadModel):  # measured before samples come; the parts of the way to a point
            _ = self.model.reaches
        start = compute_start_configuration(self.model, setup.start_pose, setup.joints, setup.name)
        self.kinematics = LiveKinematics(self.model, source.sensors, start)
        self._instruction = START_POSES.get(setup.start_pose, f"Hold still in the start pose, {setup.start_pose}")
        if self.model.table.is_mechanism:
            self._instruction = f"{self.model.table.name} must stand still in its start configuration"
        self._stream = TickStream(source.sensors, source.rate_hz, begin, wait_s, log, source.orientations)
        self._losses = SampleLosses()
        self._rates = RateWatch()
        self._stood_s = 0.0  # [s] longest time that the person stood still before tracking
        self._phase_edges = PhaseEdges(self.setup.phases)
        self._start_search: StartPoseSearch | None = None  # set when the ticks begin
        self._segment_estimator: SegmentEstimator | None = None  # set when the start pose is found
        self._heading_reset_time = 0.0
        self._std, self._heading_std = (np.full(len(source.sensors), np.nan) for _ in range(2))
        self._covariance: Iterator[np.ndarray | None] = iter(())  # computed in parts, one or more with each tick
        self._covariance_ticks, self._covariance_parts = 1, 1  # from one to the next, and parts with a tick
        self._latency = Latencies()
        self._recent_latencies: deque[float] = deque(maxlen=MAX_LATENCIES)  # [s] of displayed poses
        self._poses, self._first_pose, self._last_pose = 0, 0.0, 0.0
        self._count_history: deque[tuple[float, np.ndarray]] = deque(maxlen=round(1.0 / STATUS_PERIOD_S) + 1)
        self._events: list[tuple[str, dict[str, Any]]] = []  # that decide poses
        self._open_phases: list[str] = []
        self._takes = 0
        self._end_message = ""  # empty: it goes on
        self._unit_diagnostics: tuple[Diagnostic, ...] = ()

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> SessionSummary:
        """Run until the source ends, the user presses q, or `should_stop` returns True.

        Without a start pose there is nothing to track, and no recording remains.

        Raises
        ------
        BadData
            The start pose shows that a sensor sends another unit.
        """
        next_status, switch_interval = 0.0, sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()
        try:
            while not should_stop():
                samples = self.source.read(READ_TIMEOUT_S)
                if samples is None:
                    break
                self._process_samples(samples)
                if self.log is not None:
                    self.log.flush_if_due()
                if not self._handle_keys():
                    break
                if time.monotonic() >= next_status:
                    next_status = time.monotonic() + STATUS_PERIOD_S
                    self._send_status()
            self._end_message = "The session has ended."
            self._send_status()
        except WeposeError as error:
            self._end_message = f"The session has ended: {error}"
            self._send_status()
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

    # Samples to ticks ------------------------------------------------------------------------------------------------

    def _process_samples(self, samples: list[Samples]) -> None:
        """Record the samples of one read, track the ticks that they complete, and show the last pose."""
        pose = None
        self._losses.push(samples)
        if self._segment_estimator is None:
            self._rates.push(samples, self.source.orientations)
        for ticks in self._stream.push(samples):
            if (search := self._begin_search()) is not None:
                pose = self._track_ticks(ticks, search) or pose
        self._begin_search()
        if pose is not None:
            for output in self.outputs:
                output.show(pose)

    def _begin_search(self) -> StartPoseSearch | None:
        """The search of the start pose, which begins with the ticks; None before them."""
        synchronizer = self._stream.synchronizer
        if self._start_search is None and synchronizer is not None:
            stated = next(iter(self.setup.phases.get("start", ())), None)
            self._start_search = StartPoseSearch(synchronizer, self.source.orientations, stated)
            self._covariance_ticks = max(1, round(STATUS_PERIOD_S * synchronizer.rate_hz))
            self._covariance_parts = math.ceil((len(self.source.sensors) + 2) / self._covariance_ticks)
        return self._start_search

    # Ticks to poses --------------------------------------------------------------------------------------------------

    def _track_ticks(self, ticks: Ticks, search: StartPoseSearch) -> LivePose | None:
        """Track these ticks, log every pose, and return the last one; None before tracking starts."""
        estimator, row, quat_WL = self._segment_estimator, 0, None
        if not len(ticks.time):
            return None
        if estimator is None:
            start = search.push(ticks)
            if start is None:
                return None
            begin, end, row = start
            estimator = self._segment_estimator = self._start_tracking(search, begin, end)
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
        self._last_pose = float(ticks.time[-1])
        now = self.source.clock()
        self._poses += len(ticks.time) - row
        for tick in ticks.time[row:][~ticks.lost[row:].all(axis=1)].tolist():  # who slept is not late
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
        rate_hz = search.synchronizer.rate_hz
        recording = build_recording(
            self.setup.header(self.source.sensors, self.source.orientations),
            rate_hz,
            search.ticks,
            (begin, end),
            last=end,
        )
        self._unit_diagnostics = check_units(recording, self.source)
        tracker = Tracker(self.setup.subject, model=self.model, options=TrackOptions(self.method, causal=True))
        tracker.push(recording)
        for phase in self._open_phases:
            tracker.segment_estimator.mark_phase(phase, begins=True)
        search.ticks = []
        self._first_pose = self._heading_reset_time = float(recording.time[-1])
        self._record_event("start", begin=begin, end=end)
        info = StreamInfo(tuple(self.source.sensors), self.kinematics.points, rate_hz)
        for output in self.outputs:
            output.start(info)
        return tracker.segment_estimator

    # Keys and status -------------------------------------------------------------------------------------------------

    def _handle_keys(self) -> bool:
        """Carry out the keys pressed since the last call; return False to end."""
        for key in [key for output in self.outputs for key in output.take_keys()]:
            if key == "q":
                return False
            if key == "r" and self._segment_estimator is not None and self._start_search is not None:
                self._segment_estimator.reset_headings()
                self._heading_reset_time = self._start_search.synchronizer.newest
                self._record_event("reset", tick=self._start_search.synchronizer.next_tick)
            if key == "r":
                for output in self.outputs:
                    output.resume()
            self._mark(key)
        return True

    def _record_event(self, kind: str, **values: Any) -> None:
        """Record an event that decides poses, now or once a recording begins."""
        self._events.append((kind, values))
        if self.log is not None:
            self.log.event(kind, **values)

    def _begin_recording(self) -> None:
        """Begin to record where nothing was recorded so far; the file holds what came before as well."""
        if self._open_log is None or self._stream.history is None or self._segment_estimator is None:
            return
        self.log = self._open_log()
        self._stream.record(self.log)
        for kind, values in self._events:
            self.log.event(kind, **values)

    def _mark(self, key: str) -> None:
        """Mark in the recording what a key asks for: "mark TEXT", "begin PHASE", "end PHASE", or "take"."""
        synchronizer = self._stream.synchronizer
        if (key == "take" or key.startswith("begin ")) and self.log is None:
            self._begin_recording()
        if self.log is None or synchronizer is None or not synchronizer.next_tick:
            return
        time_s = synchronizer.begin + (synchronizer.next_tick - 1) / synchronizer.rate_hz
        kind, _, name = key.partition(" ")
        if key == "take":
            takes = [phase for phase in self._open_phases if phase.startswith("take_")]
            self._takes += not takes
            kind, name = ("end", takes[0]) if takes else ("begin", f"take_{self._takes}")
        name = name[:LONGEST_TEXT]
        if kind == "mark" and name:
            self.log.event("mark", text=name, time=time_s)
        elif kind == "begin" and name and name not in self._open_phases:
            # It holds from the next tick on: the ticks before have been tracked without it.
            self._open_phases.append(name)
            self._mark_phase(name, begins=True)
            self.log.event("begin", phase=name, time=time_s + 1.0 / synchronizer.rate_hz)
        elif kind == "end" and name in self._open_phases:
            self._open_phases.remove(name)
            self._mark_phase(name, begins=False)
            self.log.event("end", phase=name, time=time_s)

    def _mark_phase(self, phase: str, *, begins: bool) -> None:
        if self._segment_estimator is not None:
            self._segment_estimator.mark_phase(phase, begins=begins)

    def _send_status(self) -> None:
        status = self._build_status()
        for output in self.outputs:
            output.status(status)

    def _build_status(self) -> Status:
        """Return the state of the session and of each sensor now."""
        sensors, estimator = self.source.sensors, self._segment_estimator
        synchronizer = None if self._start_search is None else self._start_search.synchronizer
        now, k = self.source.clock(), len(sensors)
        counts, frozen = np.zeros((k, len(COUNTS)), dtype=np.int64), np.zeros(k, dtype=bool)
        lost = np.array([now - self._stream.newest_times[name] > MAX_SILENCE_S for name in sensors])
        recorded_s = 0.0
        if synchronizer is not None:
            counts, frozen = synchronizer.counts.copy(), synchronizer.frozen.copy()
            lost |= synchronizer.lost | frozen
            recorded_s = 0.0 if self.log is None else max(0.0, synchronizer.newest - synchronizer.begin)
        static, bias, heading_age = np.zeros(k, dtype=bool), np.zeros((k, 3)), 0.0
        if estimator is not None:
            static, bias = estimator.static, estimator.gyro_bias
            heading_age = max(0.0, now - self._heading_reset_time)
        self._count_history.append((now, counts[:, TAKEN]))
        (first_time, first_count), (_, last_count) = self._count_history[0], self._count_history[-1]
        rates = (last_count - first_count) / (now - first_time) if now > first_time else np.zeros(k)
        battery = self.source.batteries
        latencies_ms = 1e3 * np.array(self._recent_latencies or [0.0])
        return Status(
            *self._describe_state(lost, frozen),
            now,
            tuple(
                SensorStatus(
                    name,
                    float(rates[i]),
                    bool(lost[i]),
                    bool(static[i]),
                    (float(bias[i, 0]), float(bias[i, 1]), float(bias[i, 2])),
                    float(self._heading_std[i]),
                    heading_age,
                    self._losses.count(name, now),
                    int(counts[i, LATE]),
                    int(counts[i, DUPLICATE]),
                    bool(frozen[i]),
                    battery.get(name, math.nan),
                )
                for i, name in enumerate(sensors)
            ),
            (float(np.quantile(latencies_ms, 0.5)), float(np.quantile(latencies_ms, 0.99))),
            recorded_s,
            self._count_problems(counts),
            tuple(self._open_phases),
        )

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
        if self._segment_estimator is not None:
            sentences = [
                self._describe_lost(lost, frozen) or "Tracking.",
                *(output.describe() for output in self.outputs),
            ]
            return "ready", " ".join(filter(None, sentences)), 1.0
        if self._start_search is None:
            missing_sensors = [name for name in self.source.sensors if self._stream.newest_times[name] == -np.inf]
            if missing_sensors:
                awaited = self.source.describe_awaited(missing_sensors)
                where = f" Waiting for {awaited}." if awaited else ""
                return "waiting", f"Nothing has come yet from {join_names(missing_sensors)}.{where}", 0.0
            return "waiting", "Measuring the sampling rate.", 0.0
        search, detector = self._start_search, self._start_search.detector
        if search.stated is not None:
            return "start_pose", f"{self._instruction}, until {search.stated[1]:g} s.", search.progress
        if detector.state == "waiting":
            missing = np.isin(np.arange(len(lost)), detector.missing)
            text = self._describe_lost(missing & frozen, frozen) or f"Waiting for {self._join_sensors(missing)}."
            return "waiting", text, 0.0
        if wrong_unit := self._rates.describe(self.source):
            return "moved", wrong_unit, search.progress
        self._stood_s = max(self._stood_s, detector.held_s)
        if detector.state == "moved" and self._stood_s < BEGUN_S:  # the person walks to the place, or joins the pose
            return "start_pose", f"{self._instruction}.", 0.0
        if detector.state == "moved":
            moved = join_names([self.source.sensors[i] for i in detector.moving])
            again = self._instruction[0].lower() + self._instruction[1:]
            return "moved", f"You moved ({moved}). Once more: {again}.", search.progress
        return (
            "start_pose",
            f"{self._instruction}: {max(0.0, START_POSE_HOLD_S - detector.held_s):.0f} s more.",
            search.progress,
        )

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
        sensors = self.source.sensors
        counts = (
            np.zeros((len(sensors), len(COUNTS)), int)
            if self._start_search is None
            else self._start_search.synchronizer.counts
        )
        return SessionSummary(
            self._poses,
            self._last_pose - self._first_pose if self._poses else 0.0,
            {
                name: dict(zip(COUNTS, row.tolist(), strict=True)) | {"lost": self._losses.count(name, -math.inf)}
                for name, row in zip(sensors, counts, strict=True)
            },
            self._latency,
            () if self._segment_estimator is None else (*self._segment_estimator.diagnostics, *self._unit_diagnostics),
            "" if self.log is None else self.log.problem,
            None if self.log is None else self.log.path,
        )


def build_subject_model(
    setup: SensorSetup, model: BodyModel | str | Path | None = None, sensors: Sequence[str] = ()
) -> BodyModel:
    """Return `model`, else the body that the setup names, else the upper body, with the subject's lengths.

    Without a subject a chosen body has its own lengths, the upper body those of the population prior. `sensors` are
    those of the source where it knows them; without them those of the setup.
    """
    chosen = model or setup.model or None
    body = chosen
    if not isinstance(body, BodyModel):
        body = load_sensed_model(body, tuple(sensors) or tuple(setup.mounts), setup.name)
    if setup.subject is None and chosen is not None:
        return body
    return (setup.subject or population_subject(body=body)).shape(body)


def warm_up(method: str) -> None:
    """Run a tracker once: compilation and reading of files must not delay the start pose, nor a heading correction."""
    n, rng, sensors = 200, np.random.default_rng(0), tuple(load_table().segments)[:5]
    recording = Recording(
        "warm",
        np.arange(n) / 100.0,
        100.0,
        {
            name: ImuSensor(
                gyro_S=1e-3 * rng.standard_normal((n, 3)),
                accel_S=[0.0, 0.0, 9.81] + 1e-2 * rng.standard_normal((n, 3)),
                stated_quat_LS=np.array([0.0, 0.0, 0.0, 1.0]),
            )
            for name in sensors
        },
        {"start": ((0.0, 1.9),)},
    )
    check_signals(recording)
    find_unseen_rate(np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)), recording.rate_hz)
    tracker = Tracker(options=TrackOptions(method, causal=True))
    tracker.push(recording)
    estimator = tracker.segment_estimator
    for _ in range(round(2.0 * CAUSAL_KNOT_S * recording.rate_hz)):
        estimator.step(np.zeros((len(sensors), 3)), np.tile([0.0, 0.0, 9.81], (len(sensors), 1)))
    estimator.covariance()
    LiveKinematics(load_model(), sensors).compute_points(np.tile([0.0, 0.0, 0.0, 1.0], (len(sensors), 1)))
    synchronizer = StreamSynchronizer(sensors, 100.0, 0.0)
    synchronizer.push(order_arrivals([Samples(sensors[0], np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))], sensors))
