"""`Stage`: a part of a live session, the guide or tracking: samples in, requests of the person in, views out."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from ..recording.arrivals import Samples
from .sources.base import Source
from .state import QUIT, Action, Output, Request, Status


class Stage(ABC):
    """Reads an open source until it ends, and shows what comes of it; the outputs stay open."""

    READ_TIMEOUT_S = 0.05  # [s]; requests and the status wait for a read
    STATUS_PERIOD_S = 0.2  # [s]

    def __init__(self, source: Source, outputs: Sequence[Output]) -> None:
        self.source, self.outputs = source, tuple(outputs)
        self.is_over = False  # there is nothing more to do

    @property
    @abstractmethod
    def actions(self) -> tuple[Action, ...]:
        """What the person may ask for now."""

    @abstractmethod
    def do(self, action: Action, text: str) -> None:
        """Do what the person asks for, with the text that was typed for it."""

    @abstractmethod
    def process(self, samples: list[Samples]) -> None:
        """Take the samples of one read, perhaps none."""

    @abstractmethod
    def build_status(self) -> Status:
        """The state now."""

    def ask(self, request: Request) -> None:
        """Do what the person asks for; what is not offered now is ignored."""
        for action in self.actions:
            if action.name == request.action:
                self.do(action, request.text)
                return

    def loop(self, should_stop: Callable[[], bool]) -> None:
        """Read, until this is over, the source ends, the person quits or `should_stop` returns True."""
        due = 0.0
        while not (self.is_over or should_stop()):
            samples = self.source.read(self.READ_TIMEOUT_S)
            if samples is None:
                return
            self.process(samples)
            requests = [request for output in self.outputs for request in output.take_requests()]
            for request in requests:
                if request == QUIT:
                    return
                self.ask(request)
            if time.monotonic() >= due:
                due = time.monotonic() + self.STATUS_PERIOD_S
                self.send_status()

    def send_status(self) -> None:
        status = self.build_status()
        for output in self.outputs:
            output.status(status)
