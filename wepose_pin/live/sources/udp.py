"""Samples that come as UDP datagrams, JSON or binary; formats in `packets`."""

from __future__ import annotations

import select
import socket
import time
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from ...errors import BadSource
from ...recording import SEGMENTS
from ...recording.arrivals import Samples
from .checks import MOST_TIME, UNSOUND, sound
from .clocks import HostClock
from .packets import Batch, decode

LARGEST = 65536  # no datagram is larger
# No `read` takes more datagrams: a flood delays nobody for long.
MOST_DATAGRAMS = 2000
# The system keeps this much [bytes] while nobody reads: some seconds of five sensors at 1 kHz.
BUFFER = 4 << 20
# So many senders' clocks are remembered, and so many kinds of problems told apart.
MOST_CLOCKS = 64
MOST_KINDS = 24
# After the first datagram, how long the other sensors have to show themselves [s].
COLLECT_S = 1.0


class UdpSource:
    """A socket on `host` and `port` that takes datagrams from anybody who can reach it.

    Times of each sender are mapped to ours (`HostClock`); a sender is an address and port.

    Parameters
    ----------
    port : 0 takes a free one; `address` says which
    sensors : those that are taken; None: those that send while `open` waits
    wait_s : how long `open` waits for the first datagram where `sensors` are not given [s]
    """

    def __init__(self, host: str, port: int, sensors: Sequence[str] | None = None, wait_s: float = 10.0) -> None:
        self.sensors = tuple(sensors or ())
        self.rate_hz: float | None = None
        self.problems: dict[str, int] = {}
        self.address = (host, port)
        self._wait_s = wait_s
        self._socket: socket.socket | None = None
        self._clocks: OrderedDict[tuple[str, int], HostClock] = OrderedDict()
        self._waiting: list[Samples] = []

    def open(self) -> None:
        """Bind; where the sensors are not given, wait for them.

        Raises
        ------
        BadSource
            The address cannot be bound, or nobody sends.
        """
        host, port = self.address
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket.bind(address)
        except (OSError, UnicodeError) as error:
            self.close()
            raise BadSource(
                f"udp:{host}:{port}: cannot listen there ({getattr(error, 'strerror', None) or error}); "
                f"an address of this machine and a port that nobody uses, as udp:9000"
            ) from None
        self._socket.setblocking(False)
        self.address = self._socket.getsockname()[:2]
        if not self.sensors:
            self._find_sensors()

    def _find_sensors(self) -> None:
        host, port = self.address
        self.sensors = SEGMENTS
        deadline = time.monotonic() + self._wait_s
        while not self._waiting and time.monotonic() < deadline:
            self._waiting = self._receive(0.1)
        if not self._waiting:
            self.close()
            seen = "; thrown away: " + ", ".join(f"{n} {what}" for what, n in self.problems.items())
            raise BadSource(
                f"udp:{host}:{port}: no samples within {self._wait_s:g} s{seen if self.problems else ''}; "
                f"send to this address, in a format of docs/live-sources.md"
            )
        deadline = time.monotonic() + COLLECT_S
        while time.monotonic() < deadline:
            self._waiting += self._receive(0.1)
        there = {samples.sensor for samples in self._waiting}
        self.sensors = tuple(segment for segment in SEGMENTS if segment in there)

    def read(self, timeout_s: float) -> list[Samples]:
        """What came, one `Samples` a sensor and sender."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            return waiting
        return self._receive(timeout_s)

    def _receive(self, timeout_s: float) -> list[Samples]:
        """What the socket holds, or what comes within `timeout_s`."""
        assert self._socket is not None, "open() first"
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        deadline = time.monotonic() + timeout_s
        while not parts:
            left = deadline - time.monotonic()
            ready, _, _ = select.select([self._socket], [], [], max(left, 0.0))
            if ready:
                self._drain(parts)
            if left <= 0.0:
                break
        return [samples for sensor, of in parts.items() for samples in self._sound(sensor, of)]

    def clock(self) -> float:
        """Now [s], monotonic."""
        return time.monotonic()

    def close(self) -> None:
        """Free the port."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _drain(self, parts: dict[str, list[tuple[np.ndarray, np.ndarray]]]) -> None:
        """Take what is there, by sensor; of each sender together, as its newest sample tells its clock best."""
        came: dict[tuple[str, int], list[Batch]] = {}
        for _ in range(MOST_DATAGRAMS):
            found = self._datagram()
            if found is None:
                break
            batches, problems = decode(found[0])
            for problem in problems:
                self._count(problem)
            batches = [batch for batch in batches if self._taken(batch)]
            if batches:
                came.setdefault(found[1], []).extend(batches)
        now = time.monotonic()
        for sender, batches in came.items():
            times = self._clock_of(sender).to_host(np.concatenate([batch.time for batch in batches]), now)
            for batch in batches:
                own, times = times[: len(batch.time)], times[len(batch.time) :]
                parts.setdefault(batch.sensor, []).append((own, batch.values))

    def _datagram(self) -> tuple[bytes, tuple[str, int]] | None:
        """The next one and its sender's address and port; None where none waits."""
        assert self._socket is not None
        try:
            datagram, sender = self._socket.recvfrom(LARGEST)
        except BlockingIOError:
            return None
        except OSError:  # an ICMP message that came back for another datagram
            self._count("errors of the socket")
            return None
        return datagram, sender[:2]

    def _taken(self, batch: Batch) -> bool:
        """The batch is of a sensor that is wanted, and its times can teach the sender's clock."""
        if batch.sensor not in self.sensors:
            self._count(f"samples of {batch.sensor}, which is not tracked", len(batch.time))
            return False
        if not float(np.abs(batch.time).max()) < MOST_TIME:
            self._count(UNSOUND, len(batch.time))
            return False
        return True

    def _sound(self, sensor: str, parts: list[tuple[np.ndarray, np.ndarray]]) -> list[Samples]:
        """The parts as one, without samples that cannot be; none where nothing is left."""
        times, values = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        good = sound(times, values)
        if not good.all():
            self._count(UNSOUND, int((~good).sum()))
            times, values = times[good], values[good]
        return [Samples(sensor, times, values[:, :3], values[:, 3:])] if len(times) else []

    def _clock_of(self, sender: tuple[str, int]) -> HostClock:
        clock = self._clocks.get(sender)
        if clock is None:
            clock = self._clocks[sender] = HostClock()
            if len(self._clocks) > MOST_CLOCKS:
                self._clocks.popitem(last=False)
        self._clocks.move_to_end(sender)
        return clock

    def _count(self, problem: str, number: int = 1) -> None:
        if problem not in self.problems and len(self.problems) >= MOST_KINDS:
            problem = "other problems"
        self.problems[problem] = self.problems.get(problem, 0) + number
