"""Steps of the guide before the motion: the sensors, their segments, a check of them, the start pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..calibration.protocols import Axis
from ..diagnostics import render
from ..errors import BadData
from ..recording.arrivals import Samples, Ticks
from ..tracking.start_pose import StartPoseDetector, TickRates
from .assignment import ShakeDetector
from .attempt import Attempt
from .guide import AGAIN, GET_READY_S, KEEP, NEXT, SKIP, Guide, Step
from .state import GuideAction, GuideView, join_names
from .units import check_units

STATIC_S = 2.0  # [s] of standing still in which the sensors are checked
START_POSE_S = 4.0  # [s] where the protocol does not say how long

READY = GuideAction("next", f"Ready: begin in {GET_READY_S:.0f} s", "n")
ANEW = GuideAction("again", "Assign all anew", "a")


class SensorStep(Step):
    """Sees which sensors are there."""

    name, title, before_attempt = "sensors", "Sensors", True

    def actions(self) -> list[GuideAction]:
        return [NEXT] if len(self.guide.newest_times) - len(self.guide.silent) >= len(self.guide.needs) else []

    def act(self, action: str) -> None:  # noqa: ARG002
        self.guide.go_on()

    def view(self) -> GuideView:
        count, needed = len(self.guide.newest_times) - len(self.guide.silent), len(self.guide.needs)
        sentence, note = "Strap the sensors on and switch them on", self.guide.describe_problems()
        absent = [name for name in self.guide.source.sensors if name not in self.guide.newest_times]
        awaited = self.guide.source.describe_awaited(absent)
        sentence = f"{sentence}: {count} of {needed} send." + (f" Waiting for {awaited}." if awaited else "")
        if count >= needed:
            sentence = f"{count} sensors send. Are all strapped on tightly?"
        return GuideView(sentence, note, progress=min(1.0, count / max(needed, 1)), reasons=self._warn_of_trackers())

    def _warn_of_trackers(self) -> tuple[str, ...]:
        """What the motion cannot show of sensors that measure orientations in worlds of their own."""
        table, setup, protocol = self.guide.options.table, self.guide.options.setup, self.guide.options.protocol
        trackers = [name for name, aligned in self.guide.source.orientations.items() if not aligned]
        bows = any(isinstance(each, Axis) and each.segment == table.reference for each in protocol.conditions)
        if table.is_mechanism or not trackers or bows or table.reference in setup.mounts:
            return ()
        place = join_names([table.reference])
        return (
            f"These sensors measure orientations and no accelerations: the motion does not show how the one on the "
            f"{place} is turned, and the calibration will not pass. Add a bow to the protocol (+bow), or state that "
            f"sensor's mount, as docs/live.md says.",
        )


class AssignmentStep(Step):
    """Finds by shaking which sensor sits on which segment."""

    name, title, before_attempt = "assignment", "Segments", True

    def __init__(self, guide: Guide) -> None:
        super().__init__(guide)
        self._before: dict[str, str] = {}  # sensor → segment, all assigned, before they are assigned anew

    def enter(self) -> None:
        names = {name: name for name in self.guide.newest_times if name in self.guide.order}
        known = names | dict(self.guide.options.known) | self.guide.segments
        known = {name: segment for name, segment in known.items() if name in self.guide.newest_times}
        self.repeat()
        if set(self.guide.needs) <= set(known.values()):
            self.guide.segments = known
            self.guide.go_on()

    def repeat(self) -> None:
        if set(self.guide.needs) <= set(self.guide.segments.values()):
            self._before = self.guide.segments
        self.guide.segments = {}
        self._shakes = ShakeDetector()

    @property
    def _open(self) -> list[str]:
        """Segments without a sensor, the ends of limbs first: who shakes an upper arm moves the forearm too."""
        segments = [name for name in self.guide.needs if name not in self.guide.segments.values()]
        return sorted(segments, key=lambda name: -self.guide.options.depth.get(name, 0))

    @property
    def _free(self) -> list[str]:
        """Sensors without a segment."""
        return [name for name in self.guide.newest_times if name not in self.guide.segments]

    def push_samples(self, samples: Sequence[Samples]) -> None:
        self._shakes.push(samples, self.guide.source.orientations)

    def update(self) -> None:
        shaken = self._shakes.find(self._free)
        if shaken is not None:
            self.guide.segments[shaken] = self._open[0]
        if len(self._open) == 1 and len(self._free) == 1:
            self.guide.segments[self._free[0]] = self._open[0]
        if not self._open:
            self.guide.go_on()

    def actions(self) -> list[GuideAction]:
        return [ANEW] * bool(self.guide.segments) + [KEEP] * bool(self._before)

    def act(self, action: str) -> None:
        if action == "skip":
            self.guide.segments = self._before
            self.guide.go_on()
        else:
            self.repeat()

    def view(self) -> GuideView:
        segment, place = self._open[0], join_names([self._open[0]])
        note = self.guide.describe_problems() or self._describe_motion()
        done = len(self.guide.segments) / len(self.guide.needs)
        return GuideView(f"Shake the sensor on the {place}.", note, progress=done, highlight=segment)

    def _describe_motion(self) -> str:
        """A sentence on motion that assigns no sensor; empty: there is none."""
        moving = self._shakes.list_moving()
        if not moving:
            return ""
        if not self._shakes.is_calm:
            return f"Hold all sensors still for a moment. Moving: {join_names(moving)}."
        shaken = [name for name in moving if self._shakes.is_shaken(name)]
        known = [name for name in shaken if name in self.guide.segments]
        if len(shaken) - len(known) > 1:
            return "Several sensors move. Hold the others still."
        if len(shaken) == len(known) > 0:
            return f"This is the sensor on the {join_names([self.guide.segments[known[-1]]])}, which is known already."
        if not shaken:
            return f"Too gentle: {join_names(moving)}. Shake harder."
        return ""


class Stillness:
    """Waits in the ticks of an attempt until no sensor has moved for some seconds."""

    def __init__(self, attempt: Attempt, seconds: float) -> None:
        self._attempt, self.seconds, self.measured = attempt, seconds, attempt.measured
        self.detector = StartPoseDetector(attempt.rate_hz, len(self.measured), seconds)
        self._rates = TickRates(self.measured, attempt.rate_hz)

    def push(self, ticks: Ticks) -> int | None:
        """Add ticks; return the row of the one with which the seconds are full; None: not yet."""
        for n, (gyro_S, accel_S) in enumerate(zip(ticks.gyro_S, ticks.accel_S, strict=True)):
            if self.detector.push(self._rates.push(gyro_S, accel_S)) == "ready":
                return n
        return None

    @property
    def progress(self) -> float:
        return self.detector.held_s / self.seconds

    @property
    def moving(self) -> str:
        """The segments that have just moved, as words; empty: none."""
        if self.detector.state != "moved":
            return ""
        return join_names([self._attempt.segments[k] for k in self.detector.moving])


class StaticStep(Step):
    """Checks the sensors while the person stands still."""

    name, title = "static", "Check"

    def enter(self) -> None:
        self._stillness: Stillness | None = None
        self._refused, self._faults = False, tuple[str, ...]()
        self.guide.begin_attempt()

    def push_ticks(self, ticks: Ticks) -> None:
        if self._stillness is None:
            self._stillness = Stillness(self.guide.begin_attempt(), STATIC_S)
        last = self._stillness.push(ticks)
        if last is not None and not self._faults:
            self._check(float(ticks.time[last]))

    def _check(self, end: float) -> None:
        """Check the units of the sensors, which have been static up to `end` [s]."""
        attempt = self.guide.begin_attempt()
        recording = replace(attempt.recording(), phases={"static": ((end - STATIC_S, end),)})
        try:
            diagnostics = check_units(recording, self.guide.source)
        except BadData as error:
            self._refused, self._faults = True, (str(error),)
            return
        self._faults = tuple(render(each).line() for each in diagnostics if each.code == "accel-scale")
        if not self._faults:
            self.guide.go_on()

    def actions(self) -> list[GuideAction]:
        if self._refused:
            return [AGAIN]
        return [AGAIN, SKIP] if self._faults else [SKIP]

    def act(self, action: str) -> None:
        if action == "skip":
            self.guide.go_on()
        else:
            self.enter()

    def view(self) -> GuideView:
        stillness, note = self._stillness, self.guide.describe_problems()
        if stillness is not None and stillness.moving and not note:
            note = f"{stillness.moving.capitalize()} moved."
        progress = 0.0 if stillness is None else stillness.progress
        return GuideView("Stand still for a moment.", note, progress=progress, reasons=self._faults)


class StartPoseStep(Step):
    """Waits until the person is ready, and until the start pose was held."""

    name, title = "start", "Start pose"

    def __init__(self, guide: Guide) -> None:
        super().__init__(guide)
        stated = [step for step in guide.options.protocol.steps if step.phase == "start"]
        self._seconds = stated[0].seconds if stated else START_POSE_S
        self._do = stated[0].do if stated else "Stand still in the start pose."

    def enter(self) -> None:
        self.reason = ""
        self._begin: float | None = None
        self._stillness: Stillness | None = None
        self.guide.begin_attempt()

    @property
    def _is_held(self) -> bool:
        """Whether it was held already, and what was recorded then can go on."""
        return self.guide.attempt is not None and self.guide.attempt.measured_s("start") > 0.0

    def push_ticks(self, ticks: Ticks) -> None:
        attempt = self.guide.attempt
        if self._begin is None or self.guide.now < self._begin or attempt is None or not attempt.has_begun:
            return
        if self._stillness is None:
            self._stillness = Stillness(attempt, self._seconds)
        last = self._stillness.push(ticks)
        if last is not None:
            end = float(ticks.time[last])
            held_s = self._stillness.detector.held_s
            attempt.mark("begin", phase="start", time=end - (held_s - 1.0 / attempt.rate_hz))
            attempt.mark("end", phase="start", time=end)
            self.guide.go_on()

    def actions(self) -> list[GuideAction]:
        if self._begin is not None:
            return [AGAIN]
        return [READY, KEEP] if self._is_held else [READY]

    def act(self, action: str) -> None:
        if action == "skip":
            self.guide.go_on()
            return
        self.enter()
        if action == "next":
            self._begin = self.guide.now + GET_READY_S
            self.guide.discard_phases()

    def view(self) -> GuideView:
        stillness, countdown, progress = self._stillness, None, 0.0
        note = self.guide.describe_problems() or self.reason
        if self._begin is not None and self.guide.now < self._begin:
            countdown = self._begin - self.guide.now
        elif stillness is not None:
            progress = stillness.progress
            countdown = (1.0 - progress) * self._seconds
            if stillness.moving and not note:
                note = f"You moved ({stillness.moving}). Once more: {self._seconds:.0f} s still."
        return GuideView(self._do, note, countdown, progress=progress)
