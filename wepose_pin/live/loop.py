"""A live session: samples of a source → ticks → poses → outputs and the recording."""

import gc
import itertools
import math
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..body import BodyModel, load_table
from ..body.configuration import KinematicsSolver
from ..body.kinematics import compute_axis_std
from ..body.mounts import compute_start_configuration
from ..body.soft_tissue import make_correction
from ..body.subject import parse_subject
from ..body.table import check_segments
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadModel, BadSession, WeposeError
from ..filters import BEST
from ..recording import Recording
from ..recording.arrivals import COUNTS, CUT_OFF, MISSING, Samples, Ticks
from ..recording.plausibility import find_unseen_rate
from ..tracking import Tracker
from ..tracking.heading_filter import CAUSAL_KNOT_S
from ..writers.result import versions
from .setup import SensorSetup, build_subject_model, check_mounts
from .sources import Source
from .sources.replay import ReplaySource
from .state import LONGEST_TEXT, QUIT, Action, LivePose, Output, SensorStatus, Stage, Status, StreamInfo, join_names
from .ticks import Recorder, SensorMonitor, StartPoseSearch, check_units

CONNECT_S = 0.2  # [s] for which a source searches before the user is asked again
SWITCH_INTERVAL_S = 5e-4  # [s] after which page and robot hand over the interpreter to the loop; Python has 5 ms
MAX_SILENCE_S = 0.5  # [s] without a sample after which a sensor is lost, before the ticks begin
MAX_LATENCIES = 100_000  # newest latencies in the summary
SHOWN_LATENCIES = 1000  # and in the status

RESET = Action("reset", "Reset headings", "r")
BEGIN_TAKE = Action("take", "Begin take", "t")
BEGIN_PHASE = Action("phase", "Begin phase", "p", "name of the phase (clasp)")


class SessionSummary(NamedTuple):
    """Outcome of a session; that of one that ended before a sample came is empty."""

    poses: int = 0
    seconds: float = 0.0  # [s] from the first pose to the last, on the source's clock
    counts: Mapping[str, Mapping[str, int]] = {}  # segment → each of `arrivals.COUNTS`
    latency: np.ndarray = np.empty(0)  # (n,) [s] of the newest ticks with a sample, from its time to its pose
    diagnostics: tuple[Diagnostic, ...] = ()
    record: Path | None = None  # the recording
    problems: Mapping[str, int] = {}  # problem → count of what the source left out


class LiveLoop(Stage):
    """One session, from the first sample of an open source to its end; `run` closes the recording.

    Parameters and errors as of `run_session`.
    """

    def __init__(
        self,
        source: Source,
        setup: SensorSetup,
        *,
        method: str = BEST,
        model: BodyModel | None = None,
        record: str | Path | None = None,
        force: bool = False,
        outputs: Sequence[Output] = (),
    ) -> None:
        super().__init__(source, outputs)
        check_mounts(source, setup)
        header = setup.header(source.sensors, source.orientations) | {"method": method, "versions": versions()}
        if setup.subject is not None:  # as a reader of the recording gets it, with the decimals of its text
            setup = replace(setup, subject=parse_subject(header["subject"], Path("subject.toml")))
        self.setup, self.model = setup, build_subject_model(setup, source.sensors, model)
        check_segments(self.model.table, source.sensors, f"{setup.name}: sensors.", BadSession)
        with suppress(BadModel):  # measured before samples come; the parts of the way to a point
            _ = self.model.reaches
        calibrated = () if setup.subject is None or setup.remounted else setup.subject.mounts
        self._absent = [name for name in calibrated if name not in source.sensors]
        start = compute_start_configuration(self.model, setup.start_pose, setup.joints, setup.name)
        self.kinematics = KinematicsSolver(self.model, source.sensors, start=start)
        self._correct_soft_tissue = make_correction(self.model, tuple(source.sensors))
        self._correct_soft_tissue(np.tile([0.0, 0.0, 0.0, 1.0], (len(source.sensors), 1)))  # compiles before poses come
        self._tracker = Tracker(setup.subject, model=self.model, method=method, causal=True)
        self._is_tracking = False  # True from when the start pose is found
        self._stream = Recorder(source, header, None if record is None else Path(record), force)
        self._monitor, self.log = SensorMonitor(source), self._stream.log
        self._search: StartPoseSearch | None = None  # from when the ticks begin
        # Where stated phases begin (True) and end, in order of time; a phase holds its first second and its last.
        spans = [(name, *span) for name, spans in setup.phases.items() for span in spans]
        edges = [edge for name, t0, t1 in spans for edge in ((t0 - 1e-9, name, True), (t1 + 1e-9, name, False))]
        self._edges = deque(sorted(edges))
        self._std, self._heading_std = (np.full(len(source.sensors), np.nan) for _ in range(2))
        self._latency: deque[float] = deque(maxlen=MAX_LATENCIES)  # [s]
        self._poses, self._first_pose, self._last_pose = 0, 0.0, 0.0
        self._open_phases: dict[str, str] = {}  # name of the action that began it and ends it → phase
        self._takes = 0
        self._end_message = ""  # empty: it goes on
        self._diagnostics: tuple[Diagnostic, ...] = ()

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> SessionSummary:
        """Run until the source ends, the user quits, or `should_stop` returns True.

        Without a start pose no recording remains. Raises `BadData` where it shows that a sensor sends another unit.
        """
        switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()
        try:
            self.loop(should_stop)
            self._end_message = "The session has ended."
        except (WeposeError, OSError) as error:
            self._end_message = f"The session has ended: {error}"
            raise
        finally:
            gc.unfreeze()
            sys.setswitchinterval(switch_interval)
            self.log.close()
            if self.log.path is not None and not self._poses:
                self.log.path.unlink(missing_ok=True)  # nothing in it can be tracked
                self.log.path = None
            if self._end_message:  # when the recording is complete
                self.send_status()
        if self.log.problem and self.log.path is not None:
            facts = {"variant": "disk", "reason": self.log.problem}
            self._diagnostics += (Diagnostic("file-incomplete", WARNING, str(self.log.path), facts=facts),)
        rows = zip(self.source.sensors, self._stream.clock.counts.tolist(), strict=True)
        counts = {name: dict(zip(COUNTS, row, strict=True)) for name, row in rows}
        seconds, latency = self._last_pose - self._first_pose, np.array(self._latency)
        return SessionSummary(
            self._poses, seconds, counts, latency, self._diagnostics, self.log.path, self.source.problems
        )

    # Samples to poses ------------------------------------------------------------------------------------------------

    def process(self, samples: list[Samples]) -> None:
        pose = None
        self._monitor.push(samples)
        for ticks in self._stream.push(samples):
            pose = self._track(ticks) or pose
            if self._is_tracking:
                self._stream.ticks.clear()
        self.log.flush_if_due()  # before it is shown: a pose that others know is in the file soon
        if pose is not None:
            for output in self.outputs:
                output.show(pose)

    def _track(self, ticks: Ticks) -> LivePose | None:
        """Track these ticks, log every pose, and return the last one; None before tracking starts."""
        row, quat_WL = 0, None
        if not self._is_tracking:
            self._search = self._search or StartPoseSearch(self._stream, self.setup, self.model.table)
            start = self._search.push(ticks)
            if start is None:
                return None
            begin, end, row = start
            self._start_tracking(begin, end)
        for n in range(row, len(ticks.time)):
            while self._edges and self._edges[0][0] <= ticks.time[n]:
                _, phase, begins = self._edges.popleft()
                self._tracker.mark_phase(phase, begins=begins)
            quat_WL = self._correct_soft_tissue(self._tracker.step(ticks.gyro_S[n], ticks.accel_S[n]))
            self._update_std(ticks.first + n)
            self.log.pose(ticks.first + n, quat_WL)
        if quat_WL is None:
            return None
        points = self.kinematics.compute_points(quat_WL)
        now, time_s = self.source.clock(), float(ticks.time[-1])
        self._poses += len(ticks.time) - row
        with_sample = ~ticks.lost[row:].all(axis=1)  # a tick of silent sensors is not late
        self._latency += (now - ticks.time[row:][with_sample]).tolist()
        self._last_pose, quat_WL = time_s, self.kinematics.orient_segments(quat_WL).copy()
        return LivePose(time_s, quat_WL, points, self._std.copy(), ticks.lost[-1].copy(), now - time_s)

    def _update_std(self, tick: int) -> None:
        """Compute the covariances of the segments whose turn it is; by ticks, so that a recording reproduces them."""
        period = max(1, round(self.STATUS_PERIOD_S * self._stream.clock.rate_hz))  # ticks from one turn to the next
        for i in range(len(self._std)):
            if i * period // len(self._std) == tick % period:
                covariance = self._tracker.compute_covariance(i)
                self._std[i], self._heading_std[i] = compute_axis_std(covariance[None])[0], np.sqrt(covariance[2, 2])

    def _start_tracking(self, begin: int, end: int) -> None:
        """Align by the start pose, ticks `begin` to `end`."""
        recording = self._stream.make_recording((begin, end), last=end)
        diagnostics = check_units(recording)
        self._tracker.push(recording)
        self._monitor.keeps_samples = False
        self._diagnostics = (*self._tracker.diagnostics, *diagnostics)
        self._first_pose = self._last_pose = float(recording.time[-1])
        self.log.event("start", begin=begin, end=end)
        info = StreamInfo(tuple(self.source.sensors), self.kinematics.points, self._stream.clock.rate_hz)
        for output in self.outputs:
            output.start(info)
        self._is_tracking = True

    # Actions ---------------------------------------------------------------------------------------------------------

    @property
    def actions(self) -> tuple[Action, ...]:
        if self._end_message:
            return ()
        if not self._is_tracking or self.log.path is None:
            return (RESET,)
        actions = [RESET, BEGIN_TAKE, BEGIN_PHASE]
        for k, action in enumerate(actions):
            if name := self._open_phases.get(action.name):
                actions[k] = action._replace(label=f"End {name.replace('_', ' ')}", entry="", is_on=True)
        return tuple(actions)

    def do(self, action: Action, text: str) -> None:
        text, time_s = text[:LONGEST_TEXT], self._stream.newest
        if action.name == RESET.name:
            if self._is_tracking:
                self._tracker.reset_headings()
                self.log.event("reset", tick=self._stream.clock.next_tick)
            for output in self.outputs:
                output.resume()
        elif action.name in self._open_phases:
            phase = self._open_phases.pop(action.name)
            self.log.event("end", phase=phase, time=time_s)
            self._tracker.mark_phase(phase, begins=False)
        else:
            self._takes += action.name == BEGIN_TAKE.name
            phase = f"take_{self._takes}" if action.name == BEGIN_TAKE.name else text or "clasp"
            self._open_phases[action.name] = phase
            # It begins with the next tick: the ticks before have been tracked without it.
            self.log.event("begin", phase=phase, time=time_s + 1.0 / self._stream.clock.rate_hz)
            self._tracker.mark_phase(phase, begins=True)

    # The state -------------------------------------------------------------------------------------------------------

    def build_status(self) -> Status:
        sensors, clock, heading_std = self.source.sensors, self._stream.clock, self._heading_std.tolist()
        now, frozen = self.source.clock(), clock.frozen.copy()
        rates = self._monitor.update(now)
        lost = np.isin(sensors, self._monitor.list_silent(sensors, now, MAX_SILENCE_S)) | frozen | clock.lost
        static, bias = np.zeros(len(sensors), dtype=bool), np.full((len(sensors), 3), np.nan)
        if self._is_tracking:
            static, bias = self._tracker.static, self._tracker.gyro_bias
        missing = clock.counts[:, MISSING].tolist() if self._stream.has_begun else [None] * len(sensors)
        known = lost.tolist(), static.tolist(), map(tuple, bias.tolist()), heading_std, missing, frozen.tolist()
        rows = zip(sensors, *known, strict=True)
        statuses = tuple(SensorStatus(name, rates.get(name, 0.0), *row) for name, *row in rows)
        problems = dict(self.source.problems)
        for name, count in zip(sensors, clock.counts[:, CUT_OFF].tolist(), strict=True):
            if count:
                problems[f"rates of {join_names([name])} beyond the range of its gyroscope"] = count
        if self._absent:
            names = join_names(self._absent)
            problems[f"sensors of the subject that sent nothing at the start and are not tracked ({names})"] = 1
        problems |= {self.log.problem: 1} if self.log.problem else {}
        recorded_s = 0.0 if self.log.path is None else max(0.0, clock.newest - clock.begin)
        latency = list(itertools.islice(reversed(self._latency), SHOWN_LATENCIES)) or [0.0]
        p50, p99 = (1e3 * np.quantile(latency, (0.5, 0.99))).tolist()
        description = self._describe_state(lost, frozen)
        return Status(*description, now, statuses, (p50, p99), recorded_s, problems, self.actions)

    def _describe_state(self, lost: np.ndarray, frozen: np.ndarray) -> tuple[str, str, float]:
        """Return the state, the message to the person, and the progress of the start pose."""
        if self._end_message:
            return "ended", self._end_message, 1.0
        names = np.array(self.source.sensors, dtype=object)
        silent, repeats = list(names[lost & ~frozen]), list(names[frozen])
        repeated = f"Repeated values from {join_names(repeats)}: switch it off and on." if repeats else ""
        if self._is_tracking:
            sentences = [f"No samples from {join_names(silent)}." if silent else "", repeated]
            sentences = [sentence for sentence in sentences if sentence] or ["Tracking."]
            return "ready", " ".join(filter(None, sentences + [each.describe() for each in self.outputs])), 1.0
        if self._search is not None:
            return self._search.describe(self._monitor.wrong_unit, repeated)
        missing = [name for name in self.source.sensors if name not in self._monitor.sending]
        if not missing:
            return "waiting", "Measuring the sampling rate.", 0.0
        awaited = self.source.describe_awaited()
        where = f" Waiting for {awaited}." if awaited else ""
        return "waiting", f"Nothing has come yet from {join_names(missing)}.{where}", 0.0


def run_session(
    source: Source,
    setup: SensorSetup,
    *,
    method: str = BEST,
    model: BodyModel | None = None,
    record: str | Path | None = None,
    force: bool = False,
    outputs: Sequence[Output] = (),
    until: Callable[[], bool] = lambda: False,
) -> SessionSummary:
    """Open the source, track it to its end or until `until` returns True, close everything.

    `model` None is the body of the setup, with the subject's lengths. Raises `WeposeError` where there is no such
    source, the mount of a sensor is not known, or the file `record` is there and `force` is not given.
    """
    try:
        warm_up(method)  # before samples come
        if not open_and_wait(source, outputs, until):
            return SessionSummary()
        loop = LiveLoop(source, setup, method=method, model=model, record=record, force=force, outputs=outputs)
        return loop.run(until)
    finally:
        source.close()
        for output in outputs:
            output.close()


def open_and_wait(source: Source, outputs: Sequence[Output], until: Callable[[], bool]) -> bool:
    """Open the source and show what it waits for; return False where the user ends that by a key.

    Raises `KeyboardInterrupt` where `until` returns True meanwhile, and `WeposeError` where there is no such source.
    """
    try:
        source.open()
        while not source.connect(CONNECT_S):
            message = f"Waiting for {source.describe_awaited()}."
            for output in outputs:
                output.status(Status("waiting", message, problems=dict(source.problems)))
            if until():
                raise KeyboardInterrupt
            if QUIT in [request for output in outputs for request in output.take_requests()]:
                return False
    except (WeposeError, OSError) as error:
        for output in outputs:
            output.status(Status("ended", f"The session has ended: {error}", 1.0))
        raise
    return True


def warm_up(method: str) -> None:
    """Track a person who stands: compilation and reading of files must not delay the start pose, nor a correction."""
    n, rng, names = 200 + round(200.0 * CAUSAL_KNOT_S), np.random.default_rng(0), tuple(load_table().segments)[:5]
    sensors: dict[str, Any] = {"phases": {"start": ((0.0, 1.9),)}, "mounts": dict.fromkeys(names, ("+z", "+x"))}
    for name in names:
        accel_S = [0.0, 0.0, 9.81] + 1e-2 * rng.standard_normal((n, 3))
        sensors[name] = 1e-3 * rng.standard_normal((n, 3)), accel_S
    recording = Recording.from_arrays(100.0, **sensors)
    find_unseen_rate(np.zeros((200, 3)), np.tile([0.0, 0.0, 9.81], (200, 1)), 100.0)
    source = ReplaySource(recording, math.inf)
    LiveLoop(source, SensorSetup.from_recording(recording), method=method).loop(lambda: False)
