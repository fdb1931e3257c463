"""The loop of a guided session: samples of a source → `Guide` → views."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence

from ..model import BodyModel
from ..recording.arrivals import Samples
from .demonstration import RATE_HZ, Demonstration
from .guide import Calibrated, Guide, GuideOptions, Step
from .guide_motion import CalibrationStep, ExerciseStep
from .guide_preparation import AssignmentStep, SensorStep, StartPoseStep, StaticStep
from .losses import SampleLosses
from .sources.base import Source
from .state import Output, SensorStatus, Status

STATUS_PERIOD_S = 0.1  # [s]
READ_TIMEOUT_S = 0.02  # [s]; the figure moves meanwhile
RATE_WINDOW_S = 1.0  # [s] over which rates are counted


def make_steps(guide: Guide) -> list[Step]:
    """The steps of a guided session, with the motions of the guide's protocol."""
    exercises = [step for step in guide.options.protocol.steps if step.phase != "start"]
    return [
        SensorStep(guide),
        AssignmentStep(guide),
        StaticStep(guide),
        StartPoseStep(guide),
        *(ExerciseStep(guide, step.phase, step.seconds, step.do) for step in exercises),
        CalibrationStep(guide),
    ]


class GuidedSession:
    """Runs a guide on an open source, which stays open.

    Parameters
    ----------
    model : the body that the figure has
    outputs : views; they stay open
    """

    def __init__(self, source: Source, options: GuideOptions, model: BodyModel, outputs: Sequence[Output]) -> None:
        self.source, self.outputs = source, tuple(outputs)
        self.guide = Guide(source, options, make_steps)
        self._figure = Demonstration(model, options.protocol)
        self._counts: dict[str, deque[tuple[float, int]]] = {}
        self._losses = SampleLosses()
        self.ended = False

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> Calibrated | None:
        """Lead the person until a calibration is accepted; None: the person, the source or `should_stop` ended it."""
        due_status = due_figure = 0.0
        try:
            while self.guide.accepted is None and not self.ended and not should_stop():
                samples = self.source.read(READ_TIMEOUT_S)
                if samples is None:
                    break
                self._count(samples)
                self.guide.push(samples, self.source.clock())
                self._handle_keys()
                now = time.monotonic()
                if now >= due_figure:
                    due_figure = now + 1.0 / RATE_HZ
                    self._draw(now)
                if now >= due_status:
                    due_status = now + STATUS_PERIOD_S
                    self._send_status()
        finally:
            self.guide.close()
        if self.guide.accepted is not None:
            self._send_status("waiting", "The subject is saved. Tracking begins.")
        return self.guide.accepted

    def _count(self, samples: Sequence[Samples]) -> None:
        now = self.source.clock()
        self._losses.push(samples)
        for chunk in samples:
            self._counts.setdefault(chunk.sensor, deque()).append((now, len(chunk.time)))
        for counts in self._counts.values():
            while counts and counts[0][0] < now - RATE_WINDOW_S:
                counts.popleft()

    def _handle_keys(self) -> None:
        for key in [key for output in self.outputs for key in output.take_keys()]:
            if key == "q":
                self.ended = True
            self.guide.act(key)

    def _draw(self, now: float) -> None:
        pose = self._figure.pose(self.guide.view(), now)
        for output in self.outputs:
            output.demonstrate(pose, self._figure.segments)

    def _send_status(self, state: str = "guide", message: str = "") -> None:
        view = self.guide.view()
        sensors = tuple(self._sensor_status(name) for name in sorted(self._counts))
        status = Status(
            state, message or view.sentence, view.progress, self.guide.now, sensors, (math.nan, math.nan), 0.0,
            dict(self.source.problems), guide=None if message else view,
        )  # fmt: skip
        for output in self.outputs:
            output.status(status)

    def _sensor_status(self, name: str) -> SensorStatus:
        rate_hz = sum(count for _, count in self._counts[name]) / RATE_WINDOW_S
        segment = self.guide.segments.get(name, "")
        label = f"{segment} ({name})" if segment and segment != name else name
        battery = self.source.batteries.get(name, math.nan)
        missing = self._losses.count(name, self.guide.now)
        return SensorStatus(label, rate_hz, name in self.guide.silent, missing=missing, battery=battery)
