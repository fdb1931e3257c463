"""Steps of the guide before the motion: the sensors, their segments, a check of them, the start pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..recording.arrivals import Samples, Ticks
from ..recording.limits import GRAVITY_ERROR_NOTED, STANDARD_GRAVITY
from ..tracking.start_pose import StartPoseDetector
from .assignment import ShakeDetector
from .guide import AGAIN, GET_READY_S, NEXT, Guide, Step
from .state import GuideAction, GuideView, join_names

STATIC_S = 2.0  # [s] of standing still in which the sensors are checked
START_POSE_S = 4.0  # [s] where the protocol does not say how long

READY = GuideAction("next", f"Ready: begin in {GET_READY_S:.0f} s", "n")
ANEW = GuideAction("again", "Assign all anew", "a")
SKIP = GuideAction("skip", "Skip", "s")


class SensorStep(Step):
    """Sees which sensors are there."""

    name, title, before_attempt = "sensors", "Sensors", True

    def actions(self) -> list[GuideAction]:
        return [NEXT] if len(self.guide.newest_times) - len(self.guide.silent) >= len(self.guide.needs) else []

    def act(self, action: str) -> None:  # noqa: ARG002
        self.guide.go_on()

    def view(self) -> GuideView:
        count, needed = len(self.guide.newest_times) - len(self.guide.silent), len(self.guide.needs)
        sentence = f"Strap the sensors on and switch them on: {count} of {needed} send."
        if count >= needed:
            sentence = f"{count} sensors send. Are all strapped on tightly?"
        return GuideView(sentence, self.guide.describe_silent(), progress=min(1.0, count / max(needed, 1)))


class AssignmentStep(Step):
    """Finds by shaking which sensor sits on which segment."""

    name, title, before_attempt = "assignment", "Segments", True

    def enter(self) -> None:
        names = {name: name for name in self.guide.newest_times if name in self.guide.options.order}
        known = names | dict(self.guide.options.known) | self.guide.segments
        known = {name: segment for name, segment in known.items() if name in self.guide.newest_times}
        self.repeat()
        if set(self.guide.needs) <= set(known.values()):
            self.guide.segments = known
            self.guide.go_on()

    def repeat(self) -> None:
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
        self._shakes.push(samples)

    def update(self) -> None:
        shaken = self._shakes.find(self._free)
        if shaken is not None:
            self.guide.segments[shaken] = self._open[0]
        if len(self._open) == 1 and len(self._free) == 1:
            self.guide.segments[self._free[0]] = self._open[0]
        if not self._open:
            self.guide.go_on()

    def actions(self) -> list[GuideAction]:
        return [ANEW] if self.guide.segments else []

    def act(self, action: str) -> None:  # noqa: ARG002
        self.repeat()

    def view(self) -> GuideView:
        segment, place = self._open[0], join_names([self._open[0]])
        shaken = [name for name in self.guide.segments if self._shakes.is_shaken(name)]
        moving = [name for name in self._free if self._shakes.is_shaken(name)]
        note = self.guide.describe_silent()
        if len(moving) > 1:
            note = "Several sensors move. Hold the others still."
        elif shaken and not moving:
            note = f"This is the sensor on the {join_names([self.guide.segments[shaken[-1]]])}, which is known already."
        done = len(self.guide.segments) / len(self.guide.needs)
        return GuideView(f"Shake the sensor on the {place}.", note, progress=done, highlight=segment)


class StaticStep(Step):
    """Checks the sensors while the person stands still."""

    name, title = "static", "Check"

    def enter(self) -> None:
        self._detector: StartPoseDetector | None = None
        self._ticks: list[Ticks] = []
        self._faults: tuple[str, ...] = ()
        self.guide.begin_attempt()

    def push_ticks(self, ticks: Ticks) -> None:
        if self._detector is None:
            assert self.guide.attempt is not None
            assert self.guide.attempt.rate_hz is not None
            self._detector = StartPoseDetector(self.guide.attempt.rate_hz, ticks.lost.shape[1], STATIC_S)
        self._ticks = [*self._ticks[-200:], ticks]
        for gyro_S in ticks.gyro_S:
            if self._detector.push(gyro_S) == "ready" and not self._faults:
                self._check()
                return

    def _check(self) -> None:
        """Compare the specific force of each sensor with gravity."""
        accel = np.concatenate([each.accel_S for each in self._ticks])[-round(STATIC_S * 50) :]
        force = np.linalg.norm(np.nanmean(accel, axis=0), axis=1)
        off = np.abs(force / STANDARD_GRAVITY - 1.0) > GRAVITY_ERROR_NOTED
        assert self.guide.attempt is not None
        names = self.guide.attempt.segments
        self._faults = tuple(
            f"The accelerometer on the {join_names([name])} shows {value:.2f} m/s² at rest, and gravity is "
            f"{STANDARD_GRAVITY:.2f} m/s²: is its unit right?"
            for name, value, is_off in zip(names, force.tolist(), off.tolist(), strict=True)
            if is_off
        )
        if not self._faults:
            self.guide.go_on()

    def actions(self) -> list[GuideAction]:
        return [AGAIN, SKIP] if self._faults else [SKIP]

    def act(self, action: str) -> None:
        if action == "skip":
            self.guide.go_on()
        else:
            self.enter()

    def view(self) -> GuideView:
        detector, note = self._detector, self.guide.describe_silent()
        if detector is not None and detector.state == "moved":
            note = f"{_name_moving(self.guide, detector)} moved."
        held = 0.0 if detector is None else detector.held_s / STATIC_S
        return GuideView("Stand still for a moment.", note, progress=held, reasons=self._faults)


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
        self._detector: StartPoseDetector | None = None
        attempt = self.guide.begin_attempt()
        for phase in ("start", *(step.phase for step in self.guide.options.protocol.steps)):
            attempt.mark("discard", phase=phase)

    def push_ticks(self, ticks: Ticks) -> None:
        attempt = self.guide.attempt
        if self._begin is None or self.guide.now < self._begin or attempt is None or attempt.rate_hz is None:
            return
        if self._detector is None:
            self._detector = StartPoseDetector(attempt.rate_hz, ticks.lost.shape[1], self._seconds)
        for n, gyro_S in enumerate(ticks.gyro_S):
            if self._detector.push(gyro_S) == "ready":
                end = float(ticks.time[n])
                attempt.mark("begin", phase="start", time=end - (self._detector.held_s - 1.0 / attempt.rate_hz))
                attempt.mark("end", phase="start", time=end)
                self.guide.go_on()
                return

    def actions(self) -> list[GuideAction]:
        return [READY] if self._begin is None else [AGAIN]

    def act(self, action: str) -> None:
        self.enter()
        if action == "next":
            self._begin = self.guide.now + GET_READY_S

    def view(self) -> GuideView:
        detector, countdown, held = self._detector, None, 0.0
        note = self.guide.describe_silent() or self.reason
        if self._begin is not None and self.guide.now < self._begin:
            countdown = self._begin - self.guide.now
        elif detector is not None:
            held = detector.held_s / self._seconds
            countdown = self._seconds - detector.held_s
            if detector.state == "moved":
                note = f"You moved ({_name_moving(self.guide, detector)}). Once more: {self._seconds:.0f} s still."
        return GuideView(self._do, note, countdown, progress=held)


def _name_moving(guide: Guide, detector: StartPoseDetector) -> str:
    assert guide.attempt is not None
    return join_names([guide.attempt.segments[k] for k in detector.moving])
