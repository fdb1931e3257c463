"""`Stage` and `Output` of a live session, and what they tell each other: poses, the state, what may be asked for."""

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..recording.arrivals import Samples
from .sources import Source

LONGEST_TEXT = 120  # letters that a person may type


class StreamInfo(NamedTuple):
    """What stays the same from the start of tracking on."""

    segments: tuple[str, ...]
    points: tuple[str, ...]
    rate_hz: float


class LivePose(NamedTuple):
    """Pose of the person at one moment; the arrays belong to the receiver."""

    time: float  # [s] on the source's clock
    quat_WL: np.ndarray  # (k, 4) xyzw, in the order of `StreamInfo.segments`
    points: np.ndarray  # (p, 3) [m] in W, in the order of `StreamInfo.points`
    std: np.ndarray  # (k,) [rad] one standard deviation of an axis; NaN where the filter has none
    lost: np.ndarray  # (k,) bool: the sensor is silent for longer than the loop waits, or frozen
    latency: float  # [s] from the time of the newest sample to this pose


class SensorStatus(NamedTuple):
    """State of one sensor."""

    segment: str
    rate_hz: float = 0.0  # samples a second over the last second, on the source's clock
    lost: bool = False  # silent for longer than the loop waits, or frozen
    static: bool = False
    gyro_bias: tuple[float, ...] = (math.nan, math.nan, math.nan)  # [rad/s]
    heading_std: float = math.nan  # [rad]; NaN where the filter has no covariance
    missing: int | None = None  # ticks without its value; None before ticks are made
    frozen: bool = False  # its values repeat bit for bit, though it has noise


class Action(NamedTuple):
    """Something that the person may ask for now, by a button of the page or a key."""

    name: str  # of the `Request`
    label: str
    key: str
    entry: str = ""  # what the person types for it; empty: nothing
    is_on: bool = False  # it is going on, and asking ends it


class Request(NamedTuple):
    """What a person asks for: an `Action` that is offered, or to quit."""

    action: str  # its name
    text: str = ""  # that was typed for it


QUIT = Request("quit")


class GuideView(NamedTuple):
    """What the guide tells the person."""

    sentence: str  # what to do now
    note: str = ""  # what went wrong; empty: nothing
    countdown: float | None = None  # [s] until it begins, or until the start pose was held
    remaining: float | None = None  # [s] of motion that are left
    progress: float = 0.0  # 0 to 1 of this step
    steps: tuple[Mapping[str, str], ...] = ()  # `name`, `title` and `state` of each: "done", "now", "ahead"
    actions: tuple[Action, ...] = ()  # of this step; the first is the usual one
    highlight: str = ""  # segment to draw apart from the others
    demonstration: str = ""  # phase of the protocol to draw; empty: the start pose
    lengths: Mapping[str, tuple[float, float]] = MappingProxyType({})  # name → value and standard deviation [m]
    quality: str = ""  # of the calibration: pass, poor, fail; empty before
    reasons: tuple[str, ...] = ()  # what to do more so far, or why it does not pass


class Status(NamedTuple):
    """State of the session, a few times a second."""

    state: str  # "guide", "waiting" for sensors, "start_pose" the start pose, "moved" in it, "ready", "ended"
    message: str  # the state as a sentence to the person
    progress: float = 0.0  # 0 to 1 of the start pose; 1 when ready
    time: float = 0.0  # [s] on the source's clock
    sensors: tuple[SensorStatus, ...] = ()
    latency_ms: tuple[float, float] = (math.nan, math.nan)  # p50, p99 of the last poses
    recorded_s: float = 0.0  # [s] in the file of --record; 0 without one
    problems: Mapping[str, int] = MappingProxyType({})  # problem → count: of the source, the sensors, the recording
    actions: tuple[Action, ...] = ()
    guide: GuideView | None = None  # None: no guided session, or it is over


class Output:
    """Base of what receives the poses. No method may take long: the loop waits for it."""

    def start(self, info: StreamInfo) -> None:
        """Tracking starts: from now on poses come, of these segments and points."""

    def show(self, pose: LivePose) -> None:
        """Take the newest pose. Of poses that became due together, only the last comes."""

    def status(self, status: Status) -> None:
        """Take the status, a few times a second from the first sample on."""

    def demonstrate(self, pose: LivePose, info: StreamInfo) -> None:
        """Draw a pose that nobody took: an instruction of the guide."""

    def describe(self) -> str:
        """What to add to the message to the person while tracking; empty: nothing."""
        return ""

    def resume(self) -> None:
        """Go on: the person stands in the start pose and asks for new headings."""

    def take_requests(self) -> list[Request]:
        """What the person has asked for since the last call."""
        return []

    def close(self) -> None:
        """End; may be called twice."""


class Stage(ABC):
    """A part of a live session, the guide or tracking: reads an open source until it ends; the outputs stay open.

    A subclass states what the person may ask for now (`actions`), does it, with the text that was typed (`do`), takes
    the samples of one read, perhaps none (`process`), and describes the state now (`build_status`).
    """

    READ_TIMEOUT_S = 0.05  # [s]; requests and the status wait for a read
    STATUS_PERIOD_S = 0.2  # [s]

    def __init__(self, source: Source, outputs: Sequence[Output]) -> None:
        self.source, self.outputs = source, tuple(outputs)
        self.is_over = False  # there is nothing more to do

    @property
    @abstractmethod
    def actions(self) -> tuple[Action, ...]: ...

    @abstractmethod
    def do(self, action: Action, text: str) -> None: ...

    @abstractmethod
    def process(self, samples: list[Samples]) -> None: ...

    @abstractmethod
    def build_status(self) -> Status: ...

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
            self.process([chunk for chunk in samples if len(chunk.time)])
            for output in self.outputs:
                for request in output.take_requests():
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


def join_names(segments: list[str]) -> str:
    """Segments as words: "torso, left upper arm"."""
    return ", ".join(segment.replace("_", " ") for segment in segments)
