"""`GuidedSession`: runs the guide on a source, and shows what it says."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from ..recording.arrivals import Samples
from .demonstration import RATE_HZ, Demonstration
from .guide import Calibrated, Guide, GuideOptions
from .sources.base import Source
from .stage import Stage
from .state import Output, Request, SensorStatus, Status
from .steps import make_steps


class GuidedSession(Stage):
    """Runs a guide on an open source, which stays open.

    Parameters
    ----------
    outputs : views; they stay open
    """

    READ_TIMEOUT_S = 0.02  # [s]; the figure moves meanwhile
    STATUS_PERIOD_S = 0.1  # [s]

    def __init__(self, source: Source, options: GuideOptions, outputs: Sequence[Output]) -> None:
        super().__init__(source, outputs)
        self.guide = Guide(source, options, make_steps(options.protocol))
        self._figure, self._figure_due = Demonstration(options.model, options.protocol), 0.0

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> Calibrated | None:
        """Lead the person until a calibration is accepted; None: the person, the source or `should_stop` ended it."""
        try:
            self.loop(should_stop)
        finally:
            self.guide.close()
        if self.is_over:
            self.send_status()
        return self.guide.accepted

    @property
    def is_over(self) -> bool:
        return self.guide.accepted is not None

    def process(self, samples: list[Samples]) -> None:
        """Guide the person by the samples, and move the figure."""
        self.guide.push(samples, self.source.clock())
        now = time.monotonic()
        if now >= self._figure_due:
            self._figure_due = now + 1.0 / RATE_HZ
            pose = self._figure.pose(self.guide.view(), now)
            for output in self.outputs:
                output.demonstrate(pose, self._figure.segments)

    def ask(self, request: Request) -> None:
        self.guide.ask(request)

    def build_status(self) -> Status:
        view, guide = self.guide.view(), self.guide
        rates, batteries = guide.monitor.measure_rates(guide.now), self.source.batteries
        sensors = []
        for name in sorted(rates):
            segment = guide.segments.get(name, "")
            label = f"{segment} ({name})" if segment and segment != name else name
            missing = guide.monitor.count_missing(name, guide.now)
            battery = batteries.get(name, math.nan)
            sensors.append(SensorStatus(label, rates[name], name in guide.silent, missing=missing, battery=battery))
        state, message = ("guide", view.sentence)
        if self.is_over:
            state, message = ("waiting", "The subject is saved. Tracking begins.")
        return Status(
            state, message, view.progress, guide.now, tuple(sensors), (math.nan, math.nan), 0.0,
            dict(self.source.problems), guide=None if self.is_over else view,
        )  # fmt: skip
