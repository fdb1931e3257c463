"""The guided session: from sensors that send to a calibrated subject.

`steps.make_steps` is the table of its steps. A step is a generator: it yields what to tell the person, gets the action
that the person asks for, None where there is none, and returns the name of the step that follows, "" for the next one.
Ticks that came meanwhile, and the text that was typed, are in the guide's attributes. Steps can be repeated. Times are
those of the source's clock.
"""

from __future__ import annotations

import itertools
import shutil
import time
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import DEFAULT_BODY, BodyModel
from ..body.configuration import KinematicsSolver
from ..body.subject import load_subject
from ..calibration import Calibration, Protocol, calibrate, load_protocol
from ..calibration.protocols import BOW, GUIDED, split_protocol
from ..errors import BadOption, WeposeError
from ..filters import BEST
from ..readers import load_session
from ..recording import Recording
from ..recording.arrivals import Samples, Ticks
from ..report.calibration import render_calibration_report
from ..report.page import write_pages
from ..simulation import simulate
from ..writers.result import collect_provenance, result_folder, write_calibration
from .setup import AssignedSource, SensorSetup, rename_sensors, write_segments
from .sources import Source
from .state import Action, GuideView, LivePose, Output, SensorStatus, Stage, Status, StreamInfo, join_names
from .ticks import Recorder, SensorMonitor

STATURE = "stature"  # that may be measured in place of a length
SILENCE_S = 1.0  # [s] without a sample after which a sensor counts as silent
FIGURE_RATE_HZ = 30.0
MOTION_S = 14.0  # [s] of the motion of a protocol's part; it is drawn again and again
LEAD_S = 2.0  # [s] before the phase in which the figure takes its place
SHAKE_HZ, SHAKE_ANGLE = 2.5, 0.45  # of a shaken segment; angle in rad


@dataclass(frozen=True)
class GuideOptions:
    """What a guided session does; fields without a comment are options of `wepose live`."""

    folder: Path  # where recordings, calibrations and the sensors' setup go
    setup: SensorSetup  # name, start pose and body of the session; its mounts, where known
    model: BodyModel
    protocol: str
    method: str = BEST
    measured: Mapping[str, float] = field(default_factory=dict)
    stature: float | None = None
    sex: Literal["f", "m"] | None = None
    subject: Path | None = None
    known: Mapping[str, str] = field(default_factory=dict)  # sensor → segment, as in an earlier session

    @cached_property
    def joined(self) -> Protocol:
        return load_protocol(self.protocol)

    def calibrate(self, source: Recording | Path, entered: Mapping[str, float] = MappingProxyType({})) -> Calibration:
        """Calibrate a recording, with lengths [m] that the person has `entered`; that of a file is saved beside it."""
        recording = source.check() if isinstance(source, Recording) else load_session(source)
        measured, protocol = {**self.measured, **entered}, choose_parts(self.protocol, recording.phases)
        calibration = calibrate(
            recording,
            measured={name: value for name, value in measured.items() if name != STATURE},
            prior=None if self.subject is None else load_subject(self.subject),
            stature=measured.get(STATURE, self.stature),
            sex=self.sex,
            protocol=protocol,
            method=self.method,
        )
        if isinstance(source, Path):
            stated = {"session": source, "measured": measured, "prior": self.subject, "method": self.method}
            with result_folder(source.with_suffix(""), force=True, command="calibrate") as folder:
                write_calibration(folder, calibration, collect_provenance("calibrate", stated | {"protocol": protocol}))
                page = partial(render_calibration_report, calibration, recording)
                write_pages(folder, {"report.html": page})
        return calibration


def choose_protocol(source: Source, setup: SensorSetup, model: BodyModel) -> str:
    """Choose the protocol where none is named: a bow follows where else nothing shows the reference's heading."""
    known = model.table.is_mechanism or model.table.reference in setup.mounts
    return f"{GUIDED}+{BOW}" if source.measures_orientations and not known else GUIDED


def choose_parts(protocol: str, phases: Collection[str]) -> str:
    """Choose the parts of a joined protocol whose phases are there, all where none is: others are still to come."""
    parts = [part for part in split_protocol(protocol) if {s.phase for s in load_protocol(part).steps} <= {*phases}]
    return "+".join(parts) or protocol


StepRun = Generator[GuideView, Action | None, str]


class GuideStep(NamedTuple):
    """A step of the guide; `run` is told whether the step was asked for, and does not just follow the one before."""

    name: str
    title: str
    run: Callable[[Guide, bool], StepRun]
    records: bool = True  # the attempt goes on recording; else its samples wait for the next step


class Guide(Stage):
    """Leads a person from sensors that send to an accepted calibration.

    The source and the outputs are open and stay so.
    """

    READ_TIMEOUT_S = 0.02  # [s]; the figure moves meanwhile
    STATUS_PERIOD_S = 0.1  # [s]

    def __init__(
        self, source: Source, options: GuideOptions, steps: Sequence[GuideStep], outputs: Sequence[Output] = ()
    ) -> None:
        super().__init__(source, outputs)
        self.options, self.steps, self.monitor = options, tuple(steps), SensorMonitor(source)
        self._figure, self._figure_due = Demonstration(options.model, options.joined) if outputs else None, 0.0
        self.now, self.text = 0.0, ""  # [s] on the source's clock; what the person typed for the action
        self.ticks: list[Ticks] = []  # of the attempt, that came since the step has last yielded
        self.segments: dict[str, str] = {}  # sensor → segment that it is assigned to
        self.attempt: Recorder | None = None  # None before it begins
        self.measured: dict[str, float] = {}  # lengths [m] that the person entered
        self.reason = ""  # for which the person must begin again from the start pose
        self.accepted: Calibration | None = None
        self._postponed: list[Samples] = []  # that came while an attempt is evaluated
        self._index = 0
        self._view: GuideView
        self._running: StepRun
        self._begin(steps[0].name)

    @property
    def step(self) -> GuideStep:
        return self.steps[self._index]

    @property
    def silent(self) -> list[str]:
        return self.monitor.list_silent(self.segments or self.monitor.sending, self.now, SILENCE_S)

    @property
    def actions(self) -> tuple[Action, ...]:
        """Those of the step, and to go back to an earlier one."""
        back = [Action(step.name, f"{step.title} again", str(k)) for k, step in enumerate(self.steps[: self._index], 1)]
        return (*self._view.actions, *back)

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> Calibration | None:
        """Lead the person until a calibration is accepted; None: the person, the source or `should_stop` ended it."""
        end = Status("ended", "The session has ended.", 1.0)
        try:
            self.loop(should_stop)
        except (WeposeError, OSError) as error:
            end = end._replace(message=f"The session has ended: {error}")
            raise
        finally:
            self.close()
            for output in self.outputs:
                output.status(end if self.accepted is None else self.build_status())
        return self.accepted

    def process(self, samples: list[Samples]) -> None:
        self.now, self.ticks = self.source.clock(), []
        self.monitor.push(samples)
        if self.attempt is not None:
            self._postponed += samples
            if self.step.records:
                postponed, self._postponed = self._postponed, []
                self.ticks = [*self.attempt.push(rename_sensors(postponed, self.segments))]
        self._go_on(None)
        now = time.monotonic()
        if self._figure is not None and now >= self._figure_due:
            self._figure_due = now + 1.0 / FIGURE_RATE_HZ
            pose = self._figure.pose(self._view, now)
            for output in self.outputs:
                output.demonstrate(pose, self._figure.info)

    def do(self, action: Action, text: str) -> None:
        self.ticks, self.text = [], text
        if action.name in [step.name for step in self.steps]:  # it is repeated
            self._running.close()
            self._begin(action.name)
        else:
            self._go_on(action)

    def _go_on(self, action: Action | None) -> None:
        try:
            self._view = self._running.send(action)
        except StopIteration as ended:
            self._begin(ended.value)

    def _begin(self, name: str) -> None:
        """Begin the step of this name, "": the next one."""
        while True:
            self._index = [step.name for step in self.steps].index(name) if name else self._index + 1
            self.ticks, self._running = [], self.step.run(self, bool(name))
            try:
                self._view = next(self._running)
                return
            except StopIteration as ended:  # there is nothing to do in it
                name = ended.value

    def begin_attempt(self) -> Recorder:
        """Begin to record, unless a recording of these sensors runs."""
        if self.attempt is None:
            paths = (self.options.folder / f"calibration-{number}.mcap" for number in itertools.count(1))
            path, source = next(path for path in paths if not path.exists()), self.assign_source()
            header = replace(self.options.setup, remounted=True).header(source.sensors, source.orientations)
            self.attempt = Recorder(source, header | {"method": self.options.method}, path)
            self._postponed = []
        return self.attempt

    def assign_source(self) -> AssignedSource:
        """The source with the sensors named by their segments."""
        return AssignedSource(self.source, self.segments, self.options.model.table.segments, is_open=True)

    def accept(self, calibration: Calibration, result: Path) -> None:
        """Save the subject of the attempt's calibration, whose files are in the folder `result`, and end."""
        with result_folder(self.options.folder, force=True, command="calibrate") as folder:
            for file in result.glob("*"):
                shutil.copyfile(file, folder / file.name)
            write_segments(folder, self.segments)
        self.accepted, self.is_over = calibration, True

    def close(self) -> None:
        if self.attempt is not None:
            self.attempt.log.close()
            self.attempt = None

    def view(self) -> GuideView:
        states = ["done"] * self._index + ["now"] + ["ahead"] * (len(self.steps) - self._index - 1)
        pairs = zip(self.steps, states, strict=True)
        steps = tuple({"name": step.name, "title": step.title, "state": state} for step, state in pairs)
        problem = "" if self.attempt is None else self.attempt.log.problem
        return self._view._replace(note=self._view.note or problem, steps=steps)

    def build_status(self) -> Status:
        sensors = []
        for name, rate_hz in sorted(self.monitor.update(self.now).items()):
            segment = self.segments.get(name, name)
            label = name if segment == name else f"{segment} ({name})"
            sensors.append(SensorStatus(label, rate_hz, name in self.silent))
        about: dict[str, Any] = {"time": self.now, "sensors": tuple(sensors), "problems": dict(self.source.problems)}
        if self.is_over:
            return Status("waiting", "The subject is saved. Tracking begins.", **about)
        view = self.view()
        return Status("guide", view.sentence, view.progress, actions=self.actions, guide=view, **about)

    def describe_problems(self) -> str:
        """A sentence on sensors that send nothing, else on rates in another unit; empty: there are none."""
        silent = [self.segments.get(name, name) for name in self.silent]
        if silent:
            every = len(silent) == len(self.segments or self.monitor.sending) > 1
            return f"No samples from {'any sensor' if every else join_names(silent)}. Switched on and in reach?"
        return self.monitor.wrong_unit


class Demonstration:
    """What the figure of the page does to show a step; that of a body without a simulated protocol stands still."""

    def __init__(self, model: BodyModel, protocol: Protocol) -> None:
        self._motion, self._phases = dict[str, np.ndarray](), dict[str, tuple[float, float]]()
        for task in (protocol.name, "clasp") if model.table.name == DEFAULT_BODY else ():
            with suppress(BadOption):  # a protocol of one's own is shown as a clasp
                motion_s, rate_hz = MOTION_S * len(task.split("+")), FIGURE_RATE_HZ
                motion = simulate(model.lengths, seed=1, rate_hz=rate_hz, clasp_s=motion_s, circles=0, protocol=task)
                self._motion = motion.quat_WL
                self._phases = {name: spans[0] for name, spans in motion.phases.items() if spans}
                break
        self.segments = tuple(model.table.needed)
        self._kinematics = KinematicsSolver(model, self.segments)
        self.info = StreamInfo(self.segments, self._kinematics.points, FIGURE_RATE_HZ)  # of the poses

    def pose(self, view: GuideView, time: float) -> LivePose:
        """The figure at a time [s]: the start pose, the motion of a phase, or one segment that is shaken."""
        quat_WL = np.tile([0.0, 0.0, 0.0, 1.0], (len(self.segments), 1))
        dimmed = np.zeros(len(self.segments), dtype=bool)
        if view.demonstration in self._phases:
            first, last = self._phases[view.demonstration]
            row = round(FIGURE_RATE_HZ * (first - LEAD_S + time % (last - first + LEAD_S)))
            quat_WL = np.array([self._motion[name][row] for name in self.segments])
        elif view.highlight in self.segments:
            angle = SHAKE_ANGLE * np.sin(2.0 * np.pi * SHAKE_HZ * time) * (time % 2.0 < 1.2)
            k = self.segments.index(view.highlight)
            quat_WL[k] = Rotation.from_rotvec([0.0, -abs(angle), 0.0]).as_quat()
            dimmed = np.arange(len(self.segments)) != k
        points = self._kinematics.compute_points(quat_WL)
        return LivePose(time, quat_WL, points, np.full(len(quat_WL), np.nan), dimmed, 0.0)
