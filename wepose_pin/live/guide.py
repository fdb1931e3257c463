"""The guided session: from sensors that send to a calibrated subject, as a state machine.

It is independent of pages and terminals: `Guide.push` takes samples, `Guide.act` an action of the person, `Guide.view`
returns what to tell the person. Each step is a class, before the motion in `guide_preparation`, from then on in
`guide_motion`; steps can be repeated, and all but the start pose skipped. Times are those of the source's clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..calibration import Calibration, CalibrationQuality, Protocol
from ..model import BodyTable
from ..recording import Recording
from ..recording.arrivals import Samples, Ticks
from .assignment import AssignedSource
from .attempt import Attempt
from .setup import SensorSetup
from .sources.base import Source
from .state import GuideAction, GuideStep, GuideView, join_names
from .units import RateWatch

SILENCE_S = 1.0  # [s] without a sample after which a sensor counts as silent
GET_READY_S = 8.0  # [s] to leave the keyboard and stand ready

NEXT = GuideAction("next", "Continue", "n")
AGAIN = GuideAction("again", "Once more", "a")
SKIP = GuideAction("skip", "Skip", "s")
KEEP = GuideAction("skip", "Keep as it was", "s")
RESTART = GuideAction("restart", "All again from the start pose", "a")


class Calibrated(NamedTuple):
    """Outcome of the calibration of an attempt."""

    calibration: Calibration
    quality: CalibrationQuality
    folder: Path  # of the subject and its report


@dataclass(frozen=True)
class GuideOptions:
    """What a guided session does.

    Parameters
    ----------
    folder : where recordings, calibrations and the sensors' setup go
    setup : name, start pose and body of the session; its mounts, where known
    table : of the body
    depth : segment → number of segments between it and the root
    calibrate : calibrates a recorded file, with lengths [m] that the person measured, or "stature"
    estimate : calibrates the recording so far
    method : of the filter, for the recording's header
    known : sensor → segment, as in an earlier session
    optional : phases of the protocol that may be skipped
    measured : names of the lengths that are given already, "stature" among them where it is
    """

    folder: Path
    protocol: Protocol
    setup: SensorSetup
    table: BodyTable
    depth: Mapping[str, int]
    calibrate: Callable[[Path, Mapping[str, float]], Calibrated]
    estimate: Callable[[Recording], tuple[Calibration, CalibrationQuality]]
    method: str
    known: Mapping[str, str] = field(default_factory=dict)
    optional: frozenset[str] = frozenset()
    measured: frozenset[str] = frozenset()


class Guide:
    """Leads a person from sensors that send to an accepted calibration.

    Parameters
    ----------
    source : open
    make_steps : makes the steps of a guide, one of them named "start"

    Attributes
    ----------
    now : [s] on the source's clock
    newest_times : sensor → time [s] of its newest sample
    segments : sensor → segment that it is assigned to
    attempt : the recording of the current attempt; None before
    accepted : the calibration that the person accepted; None before
    """

    def __init__(self, source: Source, options: GuideOptions, make_steps: Callable[[Guide], list[Step]]) -> None:
        self.source, self.options = source, options
        self.now = 0.0
        self.newest_times: dict[str, float] = {}
        self.segments: dict[str, str] = {}
        self.attempt: Attempt | None = None
        self.attempts = 0
        self.accepted: Calibrated | None = None
        self.steps = make_steps(self)
        self._index = 0
        self._rates = RateWatch()
        self._postponed: list[Sequence[Samples]] = []  # that came while an attempt is evaluated
        self.step.enter()

    @property
    def step(self) -> Step:
        return self.steps[self._index]

    @property
    def order(self) -> tuple[str, ...]:
        """Segments in the order of the body."""
        return tuple(self.options.table.segments)

    @property
    def needs(self) -> tuple[str, ...]:
        """Segments that must carry a sensor."""
        return self.options.protocol.needs

    @property
    def silent(self) -> list[str]:
        """Sensors that have sent nothing for a while."""
        wanted = self.segments or self.newest_times
        return [name for name in wanted if self.now - self.newest_times.get(name, -np.inf) > SILENCE_S]

    def push(self, samples: Sequence[Samples], now: float) -> None:
        """Take what came since the last call, up to the time `now` [s]."""
        self.now = now
        for chunk in samples:
            if len(chunk.time):
                self.newest_times[chunk.sensor] = float(chunk.time[-1])
        self._rates.push(samples, self.source.orientations)
        self.step.push_samples(samples)
        self._postponed.append(samples)
        if self.attempt is not None and self.step.records:
            postponed, self._postponed = self._postponed, []
            for each in postponed:
                for ticks in self.attempt.push(each):
                    self.step.push_ticks(ticks)
            self.attempt.log.flush_if_due()
        elif self.attempt is None:
            self._postponed.clear()
        self.step.update()

    def act(self, action: str) -> None:
        """Do what the person asks for; an action that the step does not offer is ignored."""
        if action.startswith("go "):
            name = action.removeprefix("go ")
            index = next((k for k, step in enumerate(self.steps) if step.name == name), self._index)
            if index < self._index:
                self.go(index, again=True)
        elif action.startswith("measure "):
            self.step.measure(action.removeprefix("measure "))
        elif action.startswith("mark ") and self.attempt is not None:
            self.attempt.mark("mark", text=action.removeprefix("mark "), time=self.attempt.newest)
        elif action in [offered.name for offered in self.step.actions()]:
            self.step.act(action)

    def go_on(self) -> None:
        """Go to the next step."""
        self.go(self._index + 1)

    def go(self, index: int, again: bool = False) -> None:
        """Go to a step, which is repeated where `again`; where sensors may change, a new attempt begins with it."""
        self.step.leave()
        self._index = index
        if self.step.before_attempt:
            self.close()
        if again:
            self.step.repeat()
        else:
            self.step.enter()

    def restart(self, reason: str = "") -> None:
        """Go to the start pose; where there is a reason, what was recorded cannot go on."""
        if reason:
            self.discard_phases()
        self.go(next(k for k, step in enumerate(self.steps) if step.name == "start"))
        self.step.reason = reason

    def assigned(self) -> AssignedSource:
        """The source with the sensors named by their segments."""
        return AssignedSource(self.source, self.segments, self.order, is_open=True)

    def begin_attempt(self) -> Attempt:
        """Begin to record, unless a recording of these sensors runs."""
        if self.attempt is None:
            self.attempts += 1
            while (path := self.options.folder / f"calibration-{self.attempts}.mcap").exists():
                self.attempts += 1
            source = self.assigned()
            header = self.options.setup.header(source.sensors, source.orientations) | {"method": self.options.method}
            self.attempt = Attempt(path, source, header)
        return self.attempt

    def discard_phases(self) -> None:
        """Take back what was recorded of the protocol."""
        if self.attempt is not None:
            for phase in ("start", *(step.phase for step in self.options.protocol.steps)):
                self.attempt.mark("discard", phase=phase)

    def close(self) -> None:
        """End the recording; may be called twice."""
        if self.attempt is not None:
            self.attempt.close()
            self.attempt = None

    def view(self) -> GuideView:
        """What to tell the person now."""
        states = ["done"] * self._index + ["now"] + ["ahead"] * len(self.steps)
        steps = tuple(GuideStep(s.name, s.title, state) for s, state in zip(self.steps, states, strict=False))
        sensors = tuple((name, self.segments.get(name, "")) for name in sorted(self.newest_times))
        view = self.step.view()
        return view._replace(steps=steps, segments=sensors, actions=tuple(self.step.actions()))

    def describe_problems(self) -> str:
        """A sentence on sensors that send nothing, else on rates in another unit; empty: there are none."""
        silent = [self.segments.get(name, name) for name in self.silent]
        if silent:
            return f"No samples from {self.join_sensors(silent)}. Switched on and in reach?"
        return self._rates.describe(self.source)

    def join_sensors(self, names: Sequence[str]) -> str:
        """Sensors as words."""
        count = len(self.segments or self.newest_times)
        return "any sensor" if len(names) == count > 1 else join_names(list(names))


class Step:
    """A step of the guide."""

    name = title = ""
    before_attempt = False  # sensors and their segments may still change: the recording begins after it
    records = True  # the attempt goes on recording; else its samples wait for the next step

    def __init__(self, guide: Guide) -> None:
        self.guide, self.reason = guide, ""  # why the person must repeat it

    def enter(self) -> None:
        """Begin this step."""

    def repeat(self) -> None:
        """Begin this step because the person wants it once more."""
        self.enter()

    def leave(self) -> None:
        """Go to another step."""

    def push_samples(self, samples: Sequence[Samples]) -> None:
        """Take samples under the names of the source."""

    def push_ticks(self, ticks: Ticks) -> None:
        """Take ticks of the attempt."""

    def update(self) -> None:
        """Do what is due by now."""

    def actions(self) -> list[GuideAction]:
        """What the person may ask for, the usual first."""
        return []

    def act(self, action: str) -> None:
        """Do what the person asks for."""

    def measure(self, stated: str) -> None:
        """Take a measured length, as ``name=metres``."""

    def view(self) -> GuideView:
        raise NotImplementedError
