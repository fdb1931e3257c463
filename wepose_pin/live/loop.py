"""The live loop: a source's samples → ticks → poses → whoever shows, sends and records them."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from ..diagnostics import Diagnostic
from ..filters import BEST
from ..model import BodyModel, load_model
from ..pose import LiveKinematics
from ..readers.live_log import recording_of
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
    arrivals,
)
from ..subject import Subject, average_subject
from ..tracking import Tracker, TrackOptions
from ..tracking.causal import SegmentFollower
from ..tracking.start_pose import HOLD_S, StartGuide
from ..writers.live_log import LiveLog
from .setup import SensorSetup
from .sources.base import Source
from .state import LivePose, SensorStatus, Stage, Status

STATUS_S = 0.2  # [s] from status to status
READ_S = 0.05  # [s] that a read waits at most, so that keys and status are not held up
LISTEN_S = 1.0  # [s] for which samples are counted where the source does not know its rate
ABSENT_S = 3.0  # [s] after which ticks begin without a sensor that never came
SILENT_S = 0.5  # [s] without a sample after which a sensor counts as lost, where no other drives the ticks
LATENCIES = 1000  # newest ones that the status speaks of


class Output(Protocol):
    """Whoever wants the poses. Nothing that it does may take long: the loop waits for it."""

    def start(self, stage: Stage) -> None:
        """The start pose is held: from now on poses come, of these segments and points."""
        ...

    def show(self, pose: LivePose) -> None:
        """The newest pose. Of poses that became due together, only the last."""
        ...

    def status(self, status: Status) -> None:
        """A few times a second, from the first sample on."""
        ...

    def take_keys(self) -> list[str]:
        """Keys since the last call: "r" for headings anew, "q" to end."""
        ...

    def close(self) -> None: ...


class Latencies:
    """Counts of latencies in bins of 2 %: as small after a day as after a second."""

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


class Ended(NamedTuple):
    """What came of a session."""

    poses: int
    seconds: float  # [s] from the first pose to the last, on the source's clock
    counts: Mapping[str, Mapping[str, int]]  # segment → each of `arrivals.COUNTS`
    latency: Latencies  # [s] from the newest sample's time to its pose, of every tick
    diagnostics: tuple[Diagnostic, ...]
    problem: str  # of the recording; empty where it is whole


class LiveLoop:
    """One session, from the source's first sample to its end.

    Parameters
    ----------
    source : opened already; `run` closes it
    model : a body; None for ours with the subject's lengths
    log : where all is recorded; closed by `run`
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
        self.model = wearer_model(setup.subject, model)
        self.kinematics = LiveKinematics(self.model, source.sensors)
        self._begin, self._wait = begin, wait_s
        self._aligner: Aligner | None = None
        self._waiting: list[Arrivals] = []
        self._before: list[Ticks] = []  # the start pose's
        self._guide: StartGuide | None = None
        self._named: tuple[float, float] | None = next(iter(setup.phases.get("start", ())), None)
        self._tracker: SegmentFollower | None = None
        self._newest = dict.fromkeys(source.sensors, -np.inf)
        self._heading_set = 0.0
        self._std, self._std_every = np.full(len(source.sensors), np.nan), 1
        self._latency = Latencies()
        self._latest: deque[float] = deque(maxlen=LATENCIES)  # [s] of the poses that were shown
        self._first_pose = self._last_pose = 0.0
        self._taken: deque[tuple[float, np.ndarray]] = deque(maxlen=round(1.0 / STATUS_S) + 1)
        self._ended = False

    def run(self, until: Callable[[], bool] = lambda: False) -> Ended:
        """Go on until the source ends, someone presses q, or `until` says so."""
        next_status = 0.0
        try:
            while not until():
                got = self.source.read(READ_S)
                if got is None:
                    break
                self._take(got)
                if self.log is not None:
                    self.log.due()
                if not self._keys():
                    break
                if time.monotonic() >= next_status:
                    next_status = time.monotonic() + STATUS_S
                    self._tell()
            self._ended = True
            self._tell()
        finally:
            self.source.close()
            if self.log is not None:
                self.log.close()
            for output in self.outputs:
                output.close()
        return self._summary()

    # Samples to ticks ------------------------------------------------------------------------------------------------

    def _take(self, got: list[Samples]) -> None:
        got = [samples for samples in got if len(samples.time)]
        if not got:
            return
        for samples in got:
            self._newest[samples.sensor] = max(self._newest[samples.sensor], float(samples.time[-1]))
        came = arrivals(got, self.source.sensors)
        if self.log is not None:
            self.log.samples(came)
        if self._aligner is None:
            self._waiting.append(came)
            self._set_clock()
            return
        pose = None
        for ticks in self._aligner.pieces(came):
            pose = self._follow(ticks) or pose
            if self.log is not None:
                self.log.due()
        if pose is not None:
            for output in self.outputs:
                output.show(pose)

    def _set_clock(self) -> None:
        """Begin the ticks when every sensor has come and the rate is known."""
        which, time_s = (np.concatenate(of) for of in tuple(zip(*self._waiting, strict=True))[:2])
        times = {int(i): time_s[which == i] for i in np.unique(which)}
        first = {i: float(of[0]) for i, of in times.items()}
        newest, oldest = max(self._newest.values()), min(first.values())
        if len(first) < len(self.source.sensors) and newest - oldest < ABSENT_S:
            return
        rate = self.source.rate_hz
        if rate is None:
            if newest - max(first.values()) < LISTEN_S:
                return
            rate = _measured_rate(list(times.values()))
        began = np.array(list(first.values()))
        # One wild clock must not put all others before the beginning.
        begin = self._begin if self._begin is not None else float(began[began < np.median(began) + JUMP_S].max())
        self._aligner = Aligner(self.source.sensors, rate, begin, self._wait)
        self._std_every = max(1, round(STATUS_S * rate))
        self._guide = StartGuide(rate, len(self.source.sensors))
        if self.log is not None:
            self.log.event("clock", rate_hz=rate, begin=begin, wait_s=self._wait)
        waiting, self._waiting = self._waiting, []
        for came in waiting:
            self._follow(self._aligner.push(came))

    # Ticks to poses --------------------------------------------------------------------------------------------------

    def _follow(self, ticks: Ticks) -> LivePose | None:
        """The last of the poses that these ticks give; None before the start."""
        at = 0
        if not len(ticks.time):
            return None
        if self._tracker is None:
            at = self._until_start(ticks)
            if self._tracker is None:
                return None
        tracker, quat_WL = self._tracker, None
        for n in range(at, len(ticks.time)):
            quat_WL = tracker.step(ticks.gyro_S[n], ticks.accel_S[n])
            if (ticks.first + n) % self._std_every == 0:  # by ticks: a recording gives the same ones again
                self._std = tracker.std()
            if self.log is not None:
                self.log.pose(ticks.first + n, quat_WL)
        if quat_WL is None:
            return None
        points = self.kinematics.points_of(quat_WL)
        self._last_pose = float(ticks.time[-1])
        now = self.source.clock()
        for tick in ticks.time[at:].tolist():
            self._latency.add(now - tick)
        self._latest.append(now - self._last_pose)
        lost = ticks.lost[-1].copy()
        return LivePose(self._last_pose, quat_WL.copy(), points, self._std, lost, now - self._last_pose)

    def _until_start(self, ticks: Ticks) -> int:
        """Look for the start pose; the first tick after it, as a place in `ticks`."""
        assert self._guide is not None
        assert self._aligner is not None
        self._before.append(ticks)
        for n in range(len(ticks.time)):
            if self._named is not None:
                half = 0.5 / self._aligner.rate_hz
                if ticks.time[n] < self._named[1] - half:
                    continue
                begin = max(0, round((self._named[0] - self._aligner.begin) * self._aligner.rate_hz))
                end = ticks.first + n
            elif self._guide.push(ticks.gyro_S[n]) == "ready":
                begin, end = self._guide.begin, self._guide.end
            else:
                continue
            self._begin_tracking(begin, end)
            return n + 1
        if self._named is None and len(self._before) > 64:
            self._forget()
        return len(ticks.time)

    def _forget(self) -> None:
        """Ticks from before the stillness so far."""
        assert self._guide is not None
        self._before = [t for t in self._before if t.first + len(t.time) > self._guide.begin]

    def _begin_tracking(self, begin: int, end: int) -> None:
        assert self._aligner is not None
        recording = recording_of(
            self.setup.header(self.source.sensors), self._aligner.rate_hz, self._before, (begin, end), last=end
        )
        tracker = Tracker(self.setup.subject, model=self.model, options=TrackOptions(self.method, causal=True))
        tracker.push(recording)
        self._tracker = tracker.follower
        self._before = []
        self._first_pose = self._heading_set = float(recording.time[-1])
        if self.log is not None:
            self.log.event("start", begin=begin, end=end)
        stage = Stage(tuple(self.source.sensors), self.kinematics.points, self._aligner.rate_hz)
        for output in self.outputs:
            output.start(stage)

    # The person and whoever stands beside ----------------------------------------------------------------------------

    def _keys(self) -> bool:
        """Do what keys ask for; False to end."""
        for output in self.outputs:
            for key in output.take_keys():
                if key == "q":
                    return False
                if key == "r" and self._tracker is not None and self._aligner is not None:
                    self._tracker.reset_headings()
                    self._heading_set = self._aligner.newest
                    if self.log is not None:
                        self.log.event("reset", tick=self._aligner.next_tick)
        return True

    def _tell(self) -> None:
        status = self._status()
        for output in self.outputs:
            output.status(status)

    def _status(self) -> Status:
        sensors, aligner, tracker = self.source.sensors, self._aligner, self._tracker
        now = self.source.clock()
        counts = np.zeros((len(sensors), len(COUNTS)), dtype=np.int64) if aligner is None else aligner.counts.copy()
        self._taken.append((now, counts[:, TAKEN]))
        (then, before), (_, after) = self._taken[0], self._taken[-1]
        rates = (after - before) / (now - then) if now > then else np.zeros(len(sensors))
        silent = np.array([now - self._newest[name] > SILENT_S for name in sensors])
        frozen = np.zeros(len(sensors), dtype=bool) if aligner is None else aligner.frozen.copy()
        lost = silent if aligner is None else silent | aligner.lost | frozen
        static = np.zeros(len(sensors), dtype=bool) if tracker is None else tracker.static
        bias = np.zeros((len(sensors), 3)) if tracker is None else tracker.gyro_bias
        heading = np.full(len(sensors), np.nan)
        if tracker is not None:
            heading = tracker.heading_std()
        latest = 1e3 * np.array(self._latest or [0.0])
        state, message, progress = self._state(lost, frozen)
        return Status(
            state,
            message,
            progress,
            now,
            tuple(
                SensorStatus(
                    name,
                    float(rates[i]),
                    bool(lost[i]),
                    bool(static[i]),
                    (float(bias[i, 0]), float(bias[i, 1]), float(bias[i, 2])),
                    float(heading[i]),
                    0.0 if tracker is None else max(0.0, now - self._heading_set),
                    int(counts[i, MISSING]),
                    int(counts[i, LATE]),
                    int(counts[i, DUPLICATE]),
                    bool(frozen[i]),
                )
                for i, name in enumerate(sensors)
            ),
            (float(np.quantile(latest, 0.5)), float(np.quantile(latest, 0.99))),
            0.0 if self.log is None or aligner is None else max(0.0, aligner.newest - aligner.begin),
            self._problems(counts),
        )

    def _problems(self, counts: np.ndarray) -> dict[str, int]:
        """What is wrong → how often, beside what each sensor's row says."""
        problems = dict(self.source.problems)
        for name, count in zip(self.source.sensors, counts[:, CUT_OFF].tolist(), strict=True):
            if count:
                problems[f"rates of {_listed([name])} beyond the range of its gyroscope"] = count
        if self.log is not None and self.log.problem:
            problems[self.log.problem] = 1
        return problems

    def _state(self, lost: np.ndarray, frozen: np.ndarray) -> tuple[str, str, float]:
        """State, what to tell the person, and how far the start pose is."""
        if self._ended:
            return "ended", "The session has ended.", 1.0
        if self._tracker is not None:
            return "ready", self._of_lost(lost, frozen) or "Tracking.", 1.0
        if self._aligner is None or self._guide is None:
            absent = [name for name in self.source.sensors if self._newest[name] == -np.inf]
            return "waiting", f"Waiting for {_listed(absent)}." if absent else "Counting samples.", 0.0
        pose = "Stand upright and still, arms hanging, palms to the thighs"
        if self._named is not None:
            return "hold", f"{pose}, until {self._named[1]:g} s.", self._share_of_named()
        guide = self._guide
        progress = min(1.0, guide.held_s / HOLD_S)
        if guide.state == "waiting":
            missing = np.isin(np.arange(len(lost)), guide.missing)
            return "waiting", self._of_lost(missing & frozen, frozen) or f"Waiting for {self._listed(missing)}.", 0.0
        if guide.state == "moved":
            moved = _listed([self.source.sensors[i] for i in guide.moving])
            return "moved", f"You moved ({moved}). Once more: {pose[0].lower()}{pose[1:]}.", progress
        return "hold", f"{pose}: {max(0.0, HOLD_S - guide.held_s):.0f} s more.", progress

    def _of_lost(self, lost: np.ndarray, frozen: np.ndarray) -> str:
        """What to say of sensors that are lost (k,) bool, of them those that are frozen; empty where none is."""
        said = []
        if (lost & ~frozen).any():
            said.append(f"No samples from {self._listed(lost & ~frozen)}.")
        if (lost & frozen).any():
            said.append(f"The same values again and again from {self._listed(lost & frozen)}: switch it off and on.")
        return " ".join(said)

    def _listed(self, which: np.ndarray) -> str:
        """The sensors (k,) bool in words."""
        return _listed([name for name, is_one in zip(self.source.sensors, which, strict=True) if is_one])

    def _share_of_named(self) -> float:
        assert self._named is not None
        assert self._aligner is not None
        return float(np.clip((self._aligner.newest - self._named[0]) / (self._named[1] - self._named[0]), 0.0, 1.0))

    def _summary(self) -> Ended:
        shape = len(self.source.sensors), len(COUNTS)
        counts = np.zeros(shape, int) if self._aligner is None else self._aligner.counts
        return Ended(
            self._latency.count,
            self._last_pose - self._first_pose if self._latency.count else 0.0,
            {
                name: dict(zip(COUNTS, row.tolist(), strict=True))
                for name, row in zip(self.source.sensors, counts, strict=True)
            },
            self._latency,
            () if self._tracker is None else self._tracker.start.diagnostics,
            "" if self.log is None else self.log.problem,
        )


def wearer_model(subject: Subject | None, model: BodyModel | None) -> BodyModel:
    """The body with the subject's lengths; without a subject the model's own, and ours the average person's."""
    body = model or load_model()
    if subject is None and model is not None:
        return body
    lengths = (subject or average_subject()).lengths
    return body.with_lengths({name: value for name, value in lengths.items() if name in body.lengths})


def _listed(segments: Sequence[str]) -> str:
    return ", ".join(segment.replace("_", " ") for segment in segments)


def _measured_rate(times: Sequence[np.ndarray]) -> float:
    """Samples a second of the slowest sensor, to a tenth."""
    rates = []
    for time_s in map(np.unique, times):
        if len(time_s) > 2:
            usual = 1.0 / float(np.median(np.diff(time_s)))
            mean = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
            # Without loss the mean is the finer one; of stamps that come in bursts it is the only one.
            rates.append(mean if abs(mean / usual - 1.0) < 0.05 or usual > 3.0 * mean else usual)
    return max(1.0, round(min(rates), 1)) if rates else 100.0


def warm(method: str) -> None:
    """Run a tracker once: what is compiled or read from disk then is there when the person holds the pose."""
    n, rng, sensors = 200, np.random.default_rng(0), SEGMENTS[:2]
    made = Recording(
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
    tracker.push(made)
    follower = tracker.follower
    follower.step(np.zeros((2, 3)), np.tile([0.0, 0.0, 9.81], (2, 1)))
    follower.std()
    aligner = Aligner(sensors, 100.0, 0.0)
    aligner.push(arrivals([Samples(sensors[0], np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))], sensors))
