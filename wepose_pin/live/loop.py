"""The live loop: samples of a source → ticks → poses → outputs and the recording."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..diagnostics import Diagnostic
from ..filters import BEST
from ..kinematics import LiveKinematics
from ..model import BodyModel, load_model
from ..readers.live_log import build_recording
from ..recording import SEGMENTS, ImuSensor, Recording
from ..recording.arrivals import (
    COUNTS,
    CUT_OFF,
    DUPLICATE,
    JUMP_S,
    LATE,
    MISSING,
    TAKEN,
    WAIT_S,
    Aligner,
    Arrivals,
    Samples,
    Ticks,
    order_arrivals,
)
from ..subject import Subject, population_subject
from ..tracking import Tracker, TrackOptions
from ..tracking.causal import SegmentFollower
from ..tracking.start_pose import HOLD_S, StartGuide
from ..writers.live_log import LiveLog
from .setup import SensorSetup
from .sources.base import Source
from .state import LivePose, Output, SensorStatus, Status, StreamInfo, join_names

STATUS_S = 0.2  # [s] from status to status
READ_S = 0.05  # [s] that a read waits at most, so that keys and status are not delayed
MEASURE_S = 1.0  # [s] over which the rate is measured where the source does not know it
ABSENT_S = 3.0  # [s] after which ticks begin without a sensor that never came
SILENT_S = 0.5  # [s] without a sample after which a sensor is lost, before the ticks begin
MAX_LATENCIES = 1000  # newest latencies in the status
MAX_WAITING = 64  # blocks of ticks kept before those older than the static phase are dropped
START_POSE = "Stand upright and still, arms hanging, palms to the thighs"


class Latencies:
    """Histogram of latencies with bins of 2 %: its size does not grow."""

    LEAST_S, STEP = 1e-6, 1.02

    def __init__(self) -> None:
        self.count = 0
        self._bins = [0] * 1024  # up to ten minutes

    def add(self, latency_s: float) -> None:
        place = int(math.log(max(latency_s, self.LEAST_S) / self.LEAST_S) / math.log(self.STEP))
        self._bins[min(place, len(self._bins) - 1)] += 1
        self.count += 1

    def quantile(self, share: float) -> float:
        """[s], to 2 %; NaN before the first."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return self.LEAST_S * self.STEP ** (min(place, len(self._bins) - 1) + 0.5)


class SessionSummary(NamedTuple):
    """Outcome of a session."""

    poses: int
    seconds: float  # [s] from the first pose to the last, on the source's clock
    counts: Mapping[str, Mapping[str, int]]  # segment → each of `arrivals.COUNTS`
    latency: Latencies  # [s] from the time of the newest sample to its pose, of every tick
    diagnostics: tuple[Diagnostic, ...]
    problem: str  # of the recording; empty where it is complete


class StartSearch:
    """The ticks before tracking, in which the start pose is found: stated by the session, or held for `HOLD_S`."""

    def __init__(self, aligner: Aligner, sensors: int, stated: tuple[float, float] | None) -> None:
        self.aligner, self.stated = aligner, stated
        self.guide = StartGuide(aligner.rate_hz, sensors)
        self.ticks: list[Ticks] = []

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """First and last tick of the start pose, and the row in `ticks` after it; None where it is still to come."""
        self.ticks.append(ticks)
        for n in range(len(ticks.time)):
            if self.stated is not None:
                rate_hz = self.aligner.rate_hz
                if ticks.time[n] >= self.stated[1] - 0.5 / rate_hz:
                    begin = max(0, round((self.stated[0] - self.aligner.begin) * rate_hz))
                    return begin, ticks.first + n, n + 1
            elif self.guide.push(ticks.gyro_S[n]) == "ready":
                return self.guide.begin, self.guide.end, n + 1
        if self.stated is None and len(self.ticks) > MAX_WAITING:
            self.ticks = [t for t in self.ticks if t.first + len(t.time) > self.guide.begin]
        return None

    @property
    def progress(self) -> float:
        """0 to 1 of the start pose."""
        if self.stated is None:
            return min(1.0, self.guide.held_s / HOLD_S)
        return float(np.clip((self.aligner.newest - self.stated[0]) / (self.stated[1] - self.stated[0]), 0.0, 1.0))


class LiveLoop:
    """One session, from the source's first sample to its end.

    Parameters
    ----------
    source : opened already; `run` closes it
    model : a body; None: ours with the subject's lengths
    log : the recording; `run` closes it
    begin : time [s] of the first tick; None: when every sensor has come

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
        model: BodyModel | None = None,
        log: LiveLog | None = None,
        outputs: Sequence[Output] = (),
        begin: float | None = None,
        wait_s: float = WAIT_S,
    ) -> None:
        self.source, self.method, self.log, self.outputs = source, method, log, tuple(outputs)
        self.setup = setup.as_recorded()
        self.model = build_subject_model(setup.subject, model)
        self.kinematics = LiveKinematics(self.model, source.sensors)
        self._begin, self._wait = begin, wait_s
        self._search: StartSearch | None = None  # set when the ticks begin
        self._tracker: SegmentFollower | None = None  # set when the start pose is found
        self._waiting: list[Arrivals] = []
        self._newest = dict.fromkeys(source.sensors, -np.inf)
        self._heading_time = 0.0
        self._std, self._std_every = np.full(len(source.sensors), np.nan), 1
        self._latency = Latencies()
        self._latest: deque[float] = deque(maxlen=MAX_LATENCIES)  # [s] of the poses that were shown
        self._first_pose = self._last_pose = 0.0
        self._counted: deque[tuple[float, np.ndarray]] = deque(maxlen=round(1.0 / STATUS_S) + 1)
        self._ended = False

    def run(self, until: Callable[[], bool] = lambda: False) -> SessionSummary:
        """Run until the source ends, someone presses q, or `until` returns True."""
        next_status = 0.0
        try:
            while not until():
                samples = self.source.read(READ_S)
                if samples is None:
                    break
                self._receive(samples)
                self._flush_log()
                if not self._handle_keys():
                    break
                if time.monotonic() >= next_status:
                    next_status = time.monotonic() + STATUS_S
                    self._send_status()
            self._ended = True
            self._send_status()
        finally:
            self.source.close()
            if self.log is not None:
                self.log.close()
            for output in self.outputs:
                output.close()
        return self._summarize()

    # Samples to ticks ------------------------------------------------------------------------------------------------

    def _receive(self, samples: list[Samples]) -> None:
        samples = [some for some in samples if len(some.time)]
        if not samples:
            return
        for some in samples:
            self._newest[some.sensor] = max(self._newest[some.sensor], float(some.time[-1]))
        arrivals = order_arrivals(samples, self.source.sensors)
        if self.log is not None:
            self.log.samples(arrivals)
        if self._search is None:
            self._waiting.append(arrivals)
            self._begin_ticks()
            return
        pose = None
        for ticks in self._search.aligner.iterate_ticks(arrivals):
            pose = self._process(ticks, self._search) or pose
            self._flush_log()
        if pose is not None:
            for output in self.outputs:
                output.show(pose)

    def _flush_log(self) -> None:
        if self.log is not None:
            self.log.due()

    def _begin_ticks(self) -> None:
        """Begin the ticks when every sensor has come and the rate is known."""
        sensor, time_s = (np.concatenate(parts) for parts in tuple(zip(*self._waiting, strict=True))[:2])
        times = {int(i): time_s[sensor == i] for i in np.unique(sensor)}
        first = np.array([float(own[0]) for own in times.values()])
        newest = max(self._newest.values())
        if len(first) < len(self.source.sensors) and newest - first.min() < ABSENT_S:
            return
        rate = self.source.rate_hz
        if rate is None:
            if newest - first.max() < MEASURE_S:
                return
            rate = _measure_rate(list(times.values()))
        # A time-stamp outlier must not put all other sensors before the beginning.
        begin = self._begin if self._begin is not None else float(first[first < np.median(first) + JUMP_S].max())
        aligner = Aligner(self.source.sensors, rate, begin, self._wait)
        stated = next(iter(self.setup.phases.get("start", ())), None)
        self._search = StartSearch(aligner, len(self.source.sensors), stated)
        self._std_every = max(1, round(STATUS_S * rate))
        if self.log is not None:
            self.log.event("clock", rate_hz=rate, begin=begin, wait_s=self._wait)
        waiting, self._waiting = self._waiting, []
        for arrivals in waiting:
            self._process(aligner.push(arrivals), self._search)

    # Ticks to poses --------------------------------------------------------------------------------------------------

    def _process(self, ticks: Ticks, search: StartSearch) -> LivePose | None:
        """The last of the poses of these ticks; None before the start."""
        tracker, row, quat_WL = self._tracker, 0, None
        if not len(ticks.time):
            return None
        if tracker is None:
            start = search.push(ticks)
            if start is None:
                return None
            begin, end, row = start
            tracker = self._tracker = self._start_tracking(search, begin, end)
        for n in range(row, len(ticks.time)):
            quat_WL = tracker.step(ticks.gyro_S[n], ticks.accel_S[n])
            if (ticks.first + n) % self._std_every == 0:  # by ticks, so that a recording gives the same again
                self._std = tracker.std()
            if self.log is not None:
                self.log.pose(ticks.first + n, quat_WL)
        if quat_WL is None:
            return None
        points = self.kinematics.points_of(quat_WL)
        self._last_pose = float(ticks.time[-1])
        now = self.source.clock()
        for tick in ticks.time[row:].tolist():
            self._latency.add(now - tick)
        latency = now - self._last_pose
        self._latest.append(latency)
        return LivePose(self._last_pose, quat_WL.copy(), points, self._std, ticks.lost[-1].copy(), latency)

    def _start_tracking(self, search: StartSearch, begin: int, end: int) -> SegmentFollower:
        """Track from the start pose on, ticks `begin` to `end`."""
        rate_hz = search.aligner.rate_hz
        recording = build_recording(
            self.setup.header(self.source.sensors), rate_hz, search.ticks, (begin, end), last=end
        )
        tracker = Tracker(self.setup.subject, model=self.model, options=TrackOptions(self.method, causal=True))
        tracker.push(recording)
        search.ticks = []
        self._first_pose = self._heading_time = float(recording.time[-1])
        if self.log is not None:
            self.log.event("start", begin=begin, end=end)
        info = StreamInfo(tuple(self.source.sensors), self.kinematics.points, rate_hz)
        for output in self.outputs:
            output.start(info)
        return tracker.follower

    # Keys and status -------------------------------------------------------------------------------------------------

    def _handle_keys(self) -> bool:
        """Do what the keys ask for; False to end."""
        for key in [key for output in self.outputs for key in output.take_keys()]:
            if key == "q":
                return False
            if key == "r" and self._tracker is not None and self._search is not None:
                self._tracker.reset_headings()
                self._heading_time = self._search.aligner.newest
                if self.log is not None:
                    self.log.event("reset", tick=self._search.aligner.next_tick)
        return True

    def _send_status(self) -> None:
        status = self._build_status()
        for output in self.outputs:
            output.status(status)

    def _build_status(self) -> Status:
        sensors, tracker = self.source.sensors, self._tracker
        aligner = None if self._search is None else self._search.aligner
        now, k = self.source.clock(), len(sensors)
        counts, frozen = np.zeros((k, len(COUNTS)), dtype=np.int64), np.zeros(k, dtype=bool)
        lost = np.array([now - self._newest[name] > SILENT_S for name in sensors])
        recorded_s = 0.0
        if aligner is not None:
            counts, frozen = aligner.counts.copy(), aligner.frozen.copy()
            lost |= aligner.lost | frozen
            recorded_s = 0.0 if self.log is None else max(0.0, aligner.newest - aligner.begin)
        static, bias, heading_std, heading_age = np.zeros(k, dtype=bool), np.zeros((k, 3)), np.full(k, np.nan), 0.0
        if tracker is not None:
            static, bias, heading_std = tracker.static, tracker.gyro_bias, tracker.heading_std()
            heading_age = max(0.0, now - self._heading_time)
        self._counted.append((now, counts[:, TAKEN]))
        (then, before), (_, after) = self._counted[0], self._counted[-1]
        rates = (after - before) / (now - then) if now > then else np.zeros(k)
        latest = 1e3 * np.array(self._latest or [0.0])
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
                    float(heading_std[i]),
                    heading_age,
                    int(counts[i, MISSING]),
                    int(counts[i, LATE]),
                    int(counts[i, DUPLICATE]),
                    bool(frozen[i]),
                )
                for i, name in enumerate(sensors)
            ),
            (float(np.quantile(latest, 0.5)), float(np.quantile(latest, 0.99))),
            recorded_s,
            self._count_problems(counts),
        )

    def _count_problems(self, counts: np.ndarray) -> dict[str, int]:
        """Problem → count, besides those in a sensor's status."""
        problems = dict(self.source.problems)
        for name, count in zip(self.source.sensors, counts[:, CUT_OFF].tolist(), strict=True):
            if count:
                problems[f"rates of {join_names([name])} beyond the range of its gyroscope"] = count
        if self.log is not None and self.log.problem:
            problems[self.log.problem] = 1
        return problems

    def _describe_state(self, lost: np.ndarray, frozen: np.ndarray) -> tuple[str, str, float]:
        """State, message to the person, and progress of the start pose."""
        if self._ended:
            return "ended", "The session has ended.", 1.0
        if self._tracker is not None:
            return "ready", self._describe_lost(lost, frozen) or "Tracking.", 1.0
        if self._search is None:
            absent = [name for name in self.source.sensors if self._newest[name] == -np.inf]
            return "waiting", f"Waiting for {join_names(absent)}." if absent else "Counting samples.", 0.0
        search, guide = self._search, self._search.guide
        if search.stated is not None:
            return "hold", f"{START_POSE}, until {search.stated[1]:g} s.", search.progress
        if guide.state == "waiting":
            missing = np.isin(np.arange(len(lost)), guide.missing)
            text = self._describe_lost(missing & frozen, frozen) or f"Waiting for {self._join_sensors(missing)}."
            return "waiting", text, 0.0
        if guide.state == "moved":
            moved = join_names([self.source.sensors[i] for i in guide.moving])
            again = START_POSE[0].lower() + START_POSE[1:]
            return "moved", f"You moved ({moved}). Once more: {again}.", search.progress
        return "hold", f"{START_POSE}: {max(0.0, HOLD_S - guide.held_s):.0f} s more.", search.progress

    def _describe_lost(self, lost: np.ndarray, frozen: np.ndarray) -> str:
        """Message on lost sensors (k,) bool, of them those that are frozen; empty where none is lost."""
        parts = []
        if (lost & ~frozen).any():
            parts.append(f"No samples from {self._join_sensors(lost & ~frozen)}.")
        if (lost & frozen).any():
            parts.append(
                f"The same values again and again from {self._join_sensors(lost & frozen)}: switch it off and on."
            )
        return " ".join(parts)

    def _join_sensors(self, mask: np.ndarray) -> str:
        return join_names([name for name, chosen in zip(self.source.sensors, mask, strict=True) if chosen])

    def _summarize(self) -> SessionSummary:
        sensors = self.source.sensors
        counts = np.zeros((len(sensors), len(COUNTS)), int) if self._search is None else self._search.aligner.counts
        return SessionSummary(
            self._latency.count,
            self._last_pose - self._first_pose if self._latency.count else 0.0,
            {name: dict(zip(COUNTS, row.tolist(), strict=True)) for name, row in zip(sensors, counts, strict=True)},
            self._latency,
            () if self._tracker is None else self._tracker.start.diagnostics,
            "" if self.log is None else self.log.problem,
        )


def build_subject_model(subject: Subject | None, model: BodyModel | None) -> BodyModel:
    """The body with the subject's lengths; without a subject its own, and for ours those of the population prior."""
    body = model or load_model()
    if subject is None and model is not None:
        return body
    lengths = (subject or population_subject()).lengths
    return body.with_lengths({name: value for name, value in lengths.items() if name in body.lengths})


def _measure_rate(times: Sequence[np.ndarray]) -> float:
    """Samples a second of the slowest sensor, to a tenth."""
    rates = []
    for time_s in map(np.unique, times):
        if len(time_s) > 2:
            usual = 1.0 / float(np.median(np.diff(time_s)))
            mean = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
            # Without loss the mean is more precise; for stamps that come in bursts only the mean is right.
            rates.append(mean if abs(mean / usual - 1.0) < 0.05 or usual > 3.0 * mean else usual)
    return max(1.0, round(min(rates), 1)) if rates else 100.0


def warm_up(method: str) -> None:
    """Run a tracker once, so that compilation and files do not delay the start pose."""
    n, rng, sensors = 200, np.random.default_rng(0), SEGMENTS[:2]
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
    tracker = Tracker(options=TrackOptions(method, causal=True))
    tracker.push(recording)
    follower = tracker.follower
    follower.step(np.zeros((2, 3)), np.tile([0.0, 0.0, 9.81], (2, 1)))
    follower.std()
    aligner = Aligner(sensors, 100.0, 0.0)
    aligner.push(order_arrivals([Samples(sensors[0], np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))], sensors))
