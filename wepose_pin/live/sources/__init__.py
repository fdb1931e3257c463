"""Sources of live samples: one file a kind, one protocol (`Source`); pyproject.toml registers the kinds."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...body import load_table
from ...errors import BadOption, one_of
from ...libraries import find_plugins, load_plugin
from ...recording.arrivals import Samples
from ...recording.limits import HIGHEST_ACCEL, HIGHEST_RATE

PLUGINS = ("mti", "slimevr")  # in examples/
MAX_PROBLEMS = 24  # kinds
MAX_TIME = 1e10  # [s] seconds since 1970 have ten digits; larger times are in another unit, or damaged
MAX_VALUES = np.repeat([HIGHEST_RATE, HIGHEST_ACCEL], 3)
IMPLAUSIBLE = "samples with values that no body sensor gives"
# Of `HostClock`: minima over BUCKET_S are kept for WINDOW_S; the offset follows with SETTLE_S, MAX_SLEW at most.
BUCKET_S, WINDOW_S, SETTLE_S, MAX_SLEW = 1.0, 10.0, 2.0, 0.01
JUMP_S = 0.05  # [s] by which a sample is faster than all before: the sender's clock was set, or the first came late
SPEED_S = 1.0  # [s] over which the speed of the sender's clock is measured
BACK_S = 1.0  # [s] by which time goes back: the sender has restarted. Less: a datagram was overtaken


@dataclass(frozen=True)
class SourceOptions:
    """How a source is opened."""

    spec: str  # the text that names it, for messages
    sensors: tuple[str, ...] | None  # to take; None: all that it has
    segments: tuple[str, ...]  # names that sensors may have
    any_name: bool = False  # sensors have any names, begin to send at any time, and are assigned to segments later
    speed: float | str = 1.0  # of a replay: 1.0 its own, 4.0 four times that, "max" as fast as possible

    def error(self, reason: str) -> BadOption:
        return BadOption(f"source '{self.spec}': {reason}")

    def check_segment(self, name: str) -> None:
        if name not in self.segments:
            raise self.error(f"'{name}' is not a segment; {one_of(self.segments, name)}")

    def choose(self, present: Iterable[str], kind: str) -> tuple[str, ...]:
        """The sensors to take of those that are present; raises `BadOption` where one is not."""
        present = tuple(present)
        for name in self.sensors or ():
            if name not in present:
                raise self.error(f"no {kind} {name}; {one_of(present, name)}")
        return self.sensors or present


class SourceKind(NamedTuple):
    """A kind of sources, which an entry point of `wepose.sources` names."""

    form: str  # what to write, as ``udp:PORT``
    open_spec: Callable[[str, SourceOptions], Source]  # what stands after the colon, and options → the source, not open


class Source(ABC):
    """Samples of several sensors as they come: `open` it, `connect` until that returns True, `read`, `close`.

    Attributes
    ----------
    sensors : segments, in the order in which results name them
    rate_hz : nominal samples a second of each; None where it has to be measured
    begin : [s] time of the first sample of all; None where it is not known
    orientations : sensors whose samples are measured orientations (`pack_orientations`) → whether these are the
        segment's own, in one world; else they are the sensor's, in a world of its own
    problems : problem → count of what was dropped so far ("bad checksums": 3)
    measures_orientations : whether it has orientations in place of rates and specific forces
    """

    measures_orientations = False
    begin: float | None = None

    def __init__(self, sensors: Iterable[str] = (), rate_hz: float | None = None) -> None:
        self.sensors, self.rate_hz = tuple(sensors), rate_hz
        self.problems: dict[str, int] = Counter()

    @property
    def orientations(self) -> Mapping[str, bool]:
        return {}

    def describe_awaited(self) -> str:
        """Describe what is awaited, and where; empty where nothing is."""
        return ""

    def open(self) -> None:  # noqa: B027
        """Take what is needed, such as a port; raises `WeposeError` where that cannot be done."""

    def connect(self, timeout_s: float) -> bool:  # noqa: ARG002
        """Search what sends, for about so long; whether all of it is there. Raises `WeposeError` where it cannot be."""
        return True

    @abstractmethod
    def read(self, timeout_s: float) -> list[Samples] | None:
        """Samples since the last call, in the order of arrival; [] after `timeout_s` without any; None at the end."""

    def clock(self) -> float:
        """Now [s], on the clock of the samples' times."""
        return time.monotonic()

    def close(self) -> None:  # noqa: B027
        """Disconnect and free what `open` took. May be called twice, or without `open`."""

    def count(self, problem: str, number: int = 1) -> None:
        """Count a problem; of very many kinds the rest is one."""
        if problem not in self.problems and len(self.problems) >= MAX_PROBLEMS:
            problem = "other problems"
        self.problems[problem] += number

    def keep_plausible(self, samples: Samples) -> list[Samples]:
        """These samples without the implausible ones, which are counted; empty if none remains."""
        values = np.hstack(samples[2:])
        plausible = (np.abs(samples.time) < MAX_TIME) & (np.abs(values) <= MAX_VALUES).all(axis=1)  # a NaN is neither
        if not plausible.all():
            self.count(IMPLAUSIBLE, int(np.count_nonzero(~plausible)))
            samples = Samples(samples.sensor, *(column[plausible] for column in samples[1:]))
        return [samples] if len(samples.time) else []


def open_source(
    spec: str,
    *,
    sensors: Sequence[str] | None = None,
    speed: float | str = 1.0,
    segments: Sequence[str] | None = None,
    any_name: bool = False,
) -> Source:
    """The source that `spec` describes, as the form of its kind says (docs/live-sources.md), not yet opened.

    `segments` are names that sensors of a stream may have, None: the upper body's; the other parameters are those of
    `SourceOptions`. Raises `BadOption` where there is no such kind of source, or what it names, and the `WeposeError`
    of a recording that is replayed.
    """
    name, colon, rest = spec.partition(":")
    names = find_plugins("sources")
    kind: SourceKind | None = load_plugin("sources", name) if name in names and colon else None
    if kind is None or not rest:
        forms = []
        for each in names:
            with suppress(BadOption):  # a plug-in that cannot be imported
                forms.append(load_plugin("sources", each).form)
        plugin = f"; {name} is a plug-in: pip install examples/{name}" if name in PLUGINS and name not in names else ""
        raise BadOption(f"source '{spec}' is not known; {one_of(forms, name)}{plugin}")
    known = tuple(load_table().segments if segments is None else segments)
    options = SourceOptions(spec, None if sensors is None else tuple(sensors), known, any_name, speed)
    if name != "replay":
        for sensor in options.sensors or ():
            options.check_segment(sensor)
    return kind.open_spec(rest, options)


class HostClock:
    """The offset of one sender's clock from ours, from the samples with the smallest delay.

    A sample's arrival minus its time is the clocks' offset plus its delay, and a delay is never negative: the smallest
    of the last ten seconds is the best estimate of the offset (the minimum filter of NTP, RFC 5905, section 10). The
    applied offset follows that estimate smoothly, so that regular samples stay regular.

    `speed` is that of the sender's clock relative to ours, the lower one of the last two spans of `SPEED_S`: a clock
    that was set is fast in only one of them.
    """

    def __init__(self) -> None:
        self._buckets: deque[tuple[float, float]] = deque()  # (begin [s] of arrival, smallest arrival − time [s])
        self._newest, self._offset = -math.inf, 0.0
        self.speed = self._last_speed = 0.0
        self._span = -math.inf, 0.0  # [s] arrival and time of the sample with which it began

    def to_host(self, time: np.ndarray, arrival: float) -> np.ndarray:
        """Times (m,) [s] on our clock of samples that came together, at `arrival` [s] on it."""
        newest, buckets = float(time.max()), self._buckets
        if arrival - self._span[0] > SPEED_S:
            speed = (newest - self._span[1]) / (arrival - self._span[0])
            self.speed, self._last_speed, self._span = min(speed, self._last_speed), speed, (arrival, newest)
        delay = arrival - newest  # with the offset
        if newest < self._newest - BACK_S or delay < self._offset - JUMP_S or not math.isfinite(self._newest):
            buckets.clear()
            self._newest, self._offset = newest, delay
        if buckets and arrival - buckets[-1][0] < BUCKET_S:
            buckets[-1] = (buckets[-1][0], min(delay, buckets[-1][1]))
        else:
            buckets.append((arrival, delay))
        while arrival - buckets[0][0] > WINDOW_S:
            buckets.popleft()
        passed = newest - self._newest
        if passed <= 0.0:
            return time + self._offset
        change = (min(smallest for _, smallest in buckets) - self._offset) * -math.expm1(-passed / SETTLE_S)
        offset = self._offset + min(max(change, -MAX_SLEW * passed), MAX_SLEW * passed)
        host = time + (offset if len(time) == 1 else np.interp(time, [self._newest, newest], [self._offset, offset]))
        self._newest, self._offset = newest, offset
        return host
