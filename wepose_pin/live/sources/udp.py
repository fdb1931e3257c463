"""Samples from UDP datagrams, JSON or binary (`packets`)."""

from __future__ import annotations

import math
import select
import socket
import time
from collections import Counter, OrderedDict
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ...errors import BadSource
from ...model import load_table
from ...recording.arrivals import Samples
from .checks import IMPLAUSIBLE, MAX_TIME, keep_plausible
from .clocks import HostClock
from .datagrams import MAX_DATAGRAMS, MAX_SIZE, bind_socket
from .packets import AnyName, Batch, decode
from .waiting import Waiting, wait_for

MAX_CLOCKS = 64  # of senders
MAX_KINDS = 24  # of problems
MAX_SENSORS = 64  # of any name
COLLECT_S = 1.0  # [s] after the first datagram in which the other sensors may appear


class UdpSource:
    """A socket on `host` and `port` that takes datagrams from any sender.

    Times of each sender, an address and port, are mapped to our clock (`HostClock`).

    Parameters
    ----------
    port : 0 for any free one; then see `address`
    sensors : to take; None: those that send while `open` waits
    segments : names that sensors may have; None: those of the upper body; `AnyName`: `sensors` grows as new ones send
    wait_s : [s] for which `open` waits for the first datagram where `sensors` are not given
    """

    def __init__(
        self,
        host: str,
        port: int,
        sensors: Sequence[str] | None = None,
        wait_s: float = 10.0,
        segments: Collection[str] | None = None,
    ) -> None:
        self.sensors = tuple(sensors or ())
        self._finds = isinstance(segments, AnyName)
        self._segments = load_table().segments if segments is None else segments
        self.rate_hz: float | None = None
        self.problems: dict[str, int] = Counter()
        self.batteries: dict[str, float] = {}
        self.orientations: Mapping[str, bool] = {}
        self.address = (host, port)
        self._wait_s = wait_s
        self._socket: socket.socket | None = None
        self._clocks: OrderedDict[tuple[str, int], HostClock] = OrderedDict()
        self._waiting: list[Samples] = []

    def open(self, waiting: Waiting | None = None) -> None:
        """Bind; where the sensors are not given, wait for them, with `waiting` until it returns False.

        Raises
        ------
        BadSource
            The address cannot be bound, or no samples come.
        """
        self._socket = bind_socket("udp", *self.address)
        self.address = self._socket.getsockname()[:2]
        if not self.sensors and not self._finds:
            self._find_sensors(waiting)

    def _find_sensors(self, waiting: Waiting | None) -> None:
        self.sensors = tuple(self._segments)
        try:
            found = wait_for(self._find_any, self._describe_wait, self._wait_s, waiting)
        except BadSource:
            self.close()
            raise
        if not found:
            self.close()
            self.sensors = ()
            return
        deadline = time.monotonic() + COLLECT_S
        while time.monotonic() < deadline:
            self._waiting += self._receive(0.1)
        present = {samples.sensor for samples in self._waiting}
        self.sensors = tuple(segment for segment in self._segments if segment in present)

    def _find_any(self, timeout_s: float) -> bool:
        self._waiting += self._receive(timeout_s)
        return bool(self._waiting)

    def _describe_wait(self) -> str:
        host, port = self.address
        dropped = "; dropped so far: " + ", ".join(f"{n} {problem}" for problem, n in self.problems.items())
        return f"samples at UDP {host}:{port}, in a format of docs/live-sources.md{dropped if self.problems else ''}"

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, one `Samples` a sensor."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            return waiting
        return self._receive(timeout_s)

    def _receive(self, timeout_s: float) -> list[Samples]:
        """Samples in the socket, or the first that come within `timeout_s`."""
        if self._socket is None:
            return []
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        deadline = time.monotonic() + timeout_s
        while not parts:
            left = deadline - time.monotonic()
            ready, _, _ = select.select([self._socket], [], [], max(left, 0.0))
            if ready:
                self._drain(self._socket, parts)
            if left <= 0.0:
                break
        return [samples for sensor, own in parts.items() for samples in self._join(sensor, own)]

    def clock(self) -> float:
        """Now [s], monotonic."""
        return time.monotonic()

    def close(self) -> None:
        """Free the port."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _drain(self, udp: socket.socket, parts: dict[str, list[tuple[np.ndarray, np.ndarray]]]) -> None:
        """Take what has come, by sensor; each sender's together, since its newest sample determines its clock best."""
        came: dict[tuple[str, int], list[Batch]] = {}
        for _ in range(MAX_DATAGRAMS):
            try:
                datagram, sender = udp.recvfrom(MAX_SIZE)
            except BlockingIOError:
                break
            except OSError:  # an ICMP reply to another datagram
                self._count("errors of the socket")
                break
            batches, problems = decode(datagram, self._segments)
            for problem in problems:
                self._count(problem)
            batches = [batch for batch in batches if self._accepts(batch)]
            if batches:
                came.setdefault(sender[:2], []).extend(batches)
        now = time.monotonic()
        for sender, batches in came.items():
            times = self._clock_of(sender).to_host(np.concatenate([batch.time for batch in batches]), now)
            for batch in batches:
                own, times = times[: len(batch.time)], times[len(batch.time) :]
                parts.setdefault(batch.sensor, []).append((own, batch.values))

    def _accepts(self, batch: Batch) -> bool:
        """Whether the batch is of a tracked sensor, with times that fit a clock."""
        if self._finds and batch.sensor not in self.sensors and len(self.sensors) < MAX_SENSORS:
            self.sensors += (batch.sensor,)
        if batch.sensor not in self.sensors:
            self._count(f"samples of {batch.sensor}, which is not tracked", len(batch.time))
            return False
        if not float(np.abs(batch.time).max()) < MAX_TIME:
            self._count(IMPLAUSIBLE, len(batch.time))
            return False
        if math.isfinite(batch.battery):
            self.batteries[batch.sensor] = batch.battery
        return True

    def _join(self, sensor: str, parts: list[tuple[np.ndarray, np.ndarray]]) -> list[Samples]:
        """The plausible samples of the parts as one; none where nothing is left."""
        times, values = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        samples, dropped = keep_plausible(sensor, times, values)
        if dropped:
            self._count(IMPLAUSIBLE, dropped)
        return samples

    def _clock_of(self, sender: tuple[str, int]) -> HostClock:
        clock = self._clocks.get(sender)
        if clock is None:
            clock = self._clocks[sender] = HostClock()
            if len(self._clocks) > MAX_CLOCKS:
                self._clocks.popitem(last=False)
        self._clocks.move_to_end(sender)
        return clock

    def _count(self, problem: str, number: int = 1) -> None:
        if problem not in self.problems and len(self.problems) >= MAX_KINDS:
            problem = "other problems"
        self.problems[problem] += number
